"""Environment steps per second beside HighwayEnv, and what warm-up costs.

CPU time of one thread, everything in one run, so that ratios hold wherever it runs: ratios are the figures to compare,
rates depend on the machine. Run: python -m benchmarks.environments [--quick].
"""

from __future__ import annotations

import time
import warnings

import gymnasium as gym
import numpy as np
import torch

import idm_env  # noqa: F401
from benchmarks import command
from benchmarks.bench.gradients import rows as steps_with_gradients
from benchmarks.bench.measure import rate, turning
from benchmarks.bench.peers import highway
from idm_env.effects import CANDIDATES

warnings.filterwarnings("ignore")


def single(seconds: float) -> None:
    theirs, ours = highway(), gym.make("DiffIDM-v0")
    if theirs is None:
        print("highway-env is not installed (pip install highway-env): no ratio.")
        return
    them, us = (rate(turning(env, lambda action=action: action), seconds)
                for env, action in ((theirs, 1), (ours, np.zeros(1, np.float32))))  # fmt: skip
    config = theirs.unwrapped.config
    per_step = config["simulation_frequency"] // config["policy_frequency"] * (config["vehicles_count"] + 1)
    print("\nsingle environment            env steps/s   vehicle updates/s")
    print(f"  HighwayEnv highway-fast-v0   {them:11,.0f} {them * per_step:19,.0f}")
    print(f"  DiffIDM-v0 ring of 22        {us:11,.0f} {us * 22:19,.0f}")
    print(f"  ratio                        {us / them:11,.0f} {us * 22 / (them * per_step):19,.0f}")


def vector(seconds: float, count: int) -> None:
    print(f"\nvector of {count}, ring of 22, numpy output, resets included       M env steps/s")
    zero = np.zeros((count, 1), np.float32)
    random = np.random.default_rng(0).uniform(-1.0, 1.0, (64, count, 1)).astype(np.float32)
    for name, keywords in (("pool of 256", {"warmup_pool": 256}), ("no pool", {})):
        for dtype in ("float32", "float64"):
            for policy in ("constant speed", "random"):
                env = gym.make_vec("DiffIDM-v0", num_envs=count, dtype=dtype, autoreset_mode="SameStep", **keywords)
                env.reset(seed=0)
                counter = iter(range(10**9))
                actions = (
                    (lambda: zero)
                    if policy == "constant speed"
                    else (lambda counter=counter: random[next(counter) % 64])
                )
                ended = [0]

                def step(env=env, actions=actions, ended=ended) -> None:
                    info = env.step(actions())[4]
                    ended[0] += int(np.sum(info.get("_final_obs", 0)))

                per_second = rate(step, seconds) * count
                print(f"  {name:12s} {dtype} {policy:15s} {ended[0]:6d} episodes ended {per_second / 1e6:18.2f}")


def faces(seconds: float) -> None:
    """Print the rates of every task, effect and output with random actions; episodes that end begin anew within."""
    random = np.random.default_rng(0).uniform(-1.0, 1.0, (64, 4096, 1)).astype(np.float32)
    counter = iter(range(10**9))
    print("\nrandom actions, resets included: environments: env steps/s")
    rows: list[tuple[str, dict[str, object], tuple[int, ...]]] = [
        (task, {"task": task}, (1, 1024, 4096)) for task in ("ring", "follow", "platoon", "replay")
    ]
    rows += [("ring, torch output", {"output": "torch"}, (256, 1024))]
    rows += [(f"ring, {name}", {"effects": [name]}, (1024,)) for name in CANDIDATES if rings(name)]
    for name, keywords, counts in rows:
        cells = []
        for count in counts:
            if count == 1:
                step = turning(gym.make("DiffIDM-v0", **keywords), lambda: random[next(counter) % 64, 0])
            else:
                env = gym.make_vec("DiffIDM-v0", num_envs=count, **keywords)
                env.reset(seed=0)

                def step(env=env, count=count) -> None:
                    env.step(random[next(counter) % 64, :count])

            step()
            cells.append(f"{count}: {rate(step, seconds) * count:12,.0f}")
        print(f"  {name:32s} {'   '.join(cells)}", flush=True)


def rings(effect: str) -> bool:
    """Return whether the ring takes an effect without more being said."""
    try:
        gym.make("DiffIDM-v0", effects=[effect], warmup=0)
    except ValueError:
        return False
    return True


def gradient_steps(turns: int) -> None:
    """Print the least and the median CPU time of a step with its gradients."""
    print("\ntorch output, 32 x 32 policy in torch, forward + backward: ms of CPU time a step, least (median)")
    for row in steps_with_gradients(turns):
        what, way, least, median = row.values()
        print(f"  {what:32s} {way:32s} {least:8.4f} ({median:.4f})", flush=True)


def warmup(count: int) -> None:
    print("\nwarm-up of 750 steps, CPU ms per environment that ends")
    for ending in (1, 64, count):
        for name, keywords in (("drawn anew", {}), ("pool of 256", {"warmup_pool": 256})):
            env = gym.make_vec("DiffIDM-v0", num_envs=count, autoreset_mode="Disabled", **keywords)
            env.reset(seed=0)
            mask = np.zeros(count, bool)
            mask[:ending] = True
            begin, runs = time.process_time(), 3
            for _ in range(runs):
                env.reset(options={"reset_mask": mask})
            each = (time.process_time() - begin) / runs / ending * 1e3
            print(f"  {name:12s} {ending:5d} of {count} end at once {each:12.4f}")
    env = gym.make("DiffIDM-v0")
    env.reset(seed=0)
    print(f"  single environment, drawn anew {1e3 / rate(lambda: env.reset(), 0.5):26.4f}")
    begin = time.process_time()
    gym.make("DiffIDM-v0", warmup_pool=256).reset(seed=0)
    print(f"  making the pool once (256 worlds, ms in all) {1e3 * (time.process_time() - begin):12.1f}")


def main(quick: bool = False, envs: int = 4096, gradients: bool = False) -> None:
    """Print rates of steps, with their gradients and without, and what a warm-up costs.

    Args:
        quick: Short measurements.
        envs: Environments of a vector.
        gradients: Only steps with their gradients.
    """
    torch.set_num_threads(1)
    gradient_steps(3 if quick else 7)
    if gradients:
        return
    seconds = 0.3 if quick else 4.0
    faces(seconds)
    single(seconds)
    vector(seconds, envs)
    warmup(envs)


if __name__ == "__main__":
    command(main)
