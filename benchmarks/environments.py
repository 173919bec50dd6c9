"""Environment steps per second beside HighwayEnv, and what warm-up costs.

CPU time of one thread, everything in one run, so that ratios hold wherever it runs: ratios are the figures to compare,
rates depend on the machine. Run: python -m benchmarks.environments [--quick]. With --returns it writes what episodes of
every task return under no command, IDM, the best rule that a search finds and an agent: 5 seeds.
"""

from __future__ import annotations

import sys
import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch

import idm_env  # noqa: F401
from benchmarks import command
from benchmarks.bench.gradients import rows as steps_with_gradients
from benchmarks.bench.measure import rate, turning
from benchmarks.bench.peers import highway
from idm_env.effects import CANDIDATES
from idm_env.tasks import TASKS

ROOT = Path(__file__).resolve().parents[1]
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


GENERATIONS, RULES, JUDGED_ON = 6, 16, range(5)
"""Turns of the search for a rule, rules of each, and seeds of what is reported."""
RANGES = ((2.5, 40.0), (0.1, 3.0), (0.3, 6.0), (0.3, 3.0), (0.5, 4.0), (0.005, 1.0))
"""Where rules are looked for: v0 (m/s), T (s), s0 (m), a, b (m/s²), and the share of IDM's acceleration."""


def write_returns(tasks: list[str], out: Path) -> None:
    """Write the returns of an episode of every task, a row each: zero action, IDM, best rule, best agent."""
    sys.path.insert(0, str(ROOT / "examples"))
    import train_apg

    rows = [line.split(",") for line in out.read_text().splitlines()[1:]] if out.exists() else []
    for task in tasks:
        begin = time.process_time()
        env = gym.make("DiffIDM-v0", task=task)
        limit, shape = env.unwrapped.task.command_limits[1], env.action_space.shape

        def of(rules: torch.Tensor, seeds: Sequence[int], task=task, limit=limit) -> torch.Tensor:
            act = rule(rules.repeat_interleave(len(seeds), 0), limit)
            return train_apg.returns(task, act, [*seeds] * len(rules)).view(len(rules), -1)

        best = searched(of)
        by_policy = {
            "zero action": train_apg.returns(task, lambda seen, shape=shape: torch.zeros(len(seen), *shape), JUDGED_ON),
            "IDM": train_apg.returns(task, None, JUDGED_ON),
            "best rule": of(best.unsqueeze(0), JUDGED_ON)[0],
        }
        print(f"{task}: v0, T, s0, a, b, share: {', '.join(f'{x:.3g}' for x in best)}")
        if task in train_apg.RECIPES:
            policy = train_apg.trained(task, shown=lambda words: None)
            by_policy["best agent"] = train_apg.returns(task, policy, JUDGED_ON)
        rows = [row for row in rows if row[0] != task]
        for name, each in by_policy.items():
            rows.append([task, name, *(f"{x:.1f}" for x in (each.mean(), each.min(), each.max()))])
        print(f"{task}: {time.process_time() - begin:.0f} CPU s", *rows[-len(by_policy) :], sep="\n  ", flush=True)
        rows.sort(key=lambda row: list(TASKS).index(row[0]))  # stable: policies stay in their order
        out.write_text("\n".join(["task,policy,mean,lowest,highest", *(",".join(row) for row in rows)]) + "\n")


def searched(of: Callable[[torch.Tensor, Sequence[int]], torch.Tensor]) -> torch.Tensor:
    """Return the rule with the best mean return, by the cross-entropy method over the logarithms of its numbers.

    ``of`` gives the returns ``(rules, seeds)``. Every generation drives other episodes; the best quarter is the next
    one's middle, and the best of the last are compared on ten episodes more. None of these are reported.
    """
    drawing = torch.Generator().manual_seed(0)
    low, high = torch.tensor(RANGES).log().unbind(-1)
    middle, spread = (low + high) / 2.0, (high - low) / 2.0
    for generation in range(GENERATIONS):
        rules = (middle + spread * torch.randn(RULES, len(RANGES), generator=drawing)).clamp(low, high)
        rules[0] = middle
        paid = of(rules.exp(), range(100 + 4 * generation, 104 + 4 * generation)).mean(1)
        best = rules[paid.topk(RULES // 4).indices]
        middle, spread = best.mean(0), best.std(0) + 0.05 * (high - low)
    best = torch.cat([best, middle.unsqueeze(0)]).exp()
    return best[int(of(best, range(200, 210)).mean(1).argmax())]


def rule(values: torch.Tensor, limit: float) -> Callable[[torch.Tensor], torch.Tensor]:
    """Return actions of IDM's formula with a row of values per environment, times a share; as in ``train_apg``."""
    v0, headway, s0, a, b, share = values.unsqueeze(1).unbind(-1)

    def act(seen: torch.Tensor) -> torch.Tensor:
        speed, lead, gap = seen.reshape(len(values), -1, 3).unbind(-1)
        wish = s0 + (speed * headway + speed * (speed - lead) / (2.0 * (a * b).sqrt())).clamp_min(0.0)
        accel = share * a * (1.0 - (speed / v0) ** 4 - (wish / gap.clamp_min(0.5)) ** 2)
        return (accel / limit).clamp(-1.0, 1.0)

    return act


def main(quick: bool = False, envs: int = 4096, gradients: bool = False, returns: Sequence[str] | None = None) -> None:
    """Print rates of steps, with their gradients and without, and what a warm-up costs.

    Args:
        quick: Short measurements.
        envs: Environments of a vector.
        gradients: Only steps with their gradients.
        returns: Only the returns of these tasks, of all if none is named, into docs/returns.csv.
    """
    torch.set_num_threads(1)
    if returns is not None:
        write_returns(list(returns or TASKS), ROOT / "docs" / "returns.csv")
        return
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
