"""What was asked of every face of an environment, CPU time of one thread: python musts.py [PART ...], beside JAX where it is installed.

Parts: gradients, single, lanes, vector, effects, cores. Cases of a part take turns; least (median) is printed.
"""

import os
import sys
import time
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import torch

import idm_env  # noqa: F401
from benchmarks.bench import jax_ring
from benchmarks.bench.gradients import RING, of
from benchmarks.bench.measure import Case, measure
from idm_env.effects import CANDIDATES

warnings.simplefilter("ignore")
Cases = dict[str, Case]
ROUNDS = int(os.environ.get("ROUNDS", "9"))


def forward(count: int, steps: int) -> Case:
    """Return a window without its gradient, as an agent drives it."""
    env: Any = gym.make_vec("DiffIDM-v0", num_envs=count, output="torch", **RING).unwrapped
    width = env.reset(seed=0)[0].shape[-1]
    layers = (torch.nn.Linear(width, 32), torch.nn.Linear(32, 32), torch.nn.Linear(32, 1))
    policy = torch.nn.Sequential(*(part for layer in layers for part in (layer, torch.nn.Tanh())))

    @torch.no_grad()
    def run() -> None:
        env.detach()
        env.unroll(policy, steps).reward.mean()

    return Case(run, steps)


def gradients() -> None:
    """Print windows of rings with and without gradients, and the same in JAX."""
    for count, steps in ((1, 600), (64, 600), (1024, 100)):
        cases = {**of(RING, count, steps, True), "unroll, forward alone": forward(count, steps)}
        for name, alone in (("JAX", False), ("JAX, forward alone", True)):
            theirs = jax_ring.window(count, steps, alone)
            cases |= {} if theirs is None else {name: Case(theirs, steps)}
        told(f"ring, {count} × {steps}", cases)


def stepping(env: Any, steps: int, resets: bool, action: Any = None) -> Callable[[], None]:
    """Return some steps of an environment; without ``resets`` their time is not counted."""
    env.reset(seed=0)
    act = np.zeros(env.action_space.shape, np.float32) if action is None else action

    def run() -> None:
        left = steps
        while left:
            left -= 1
            *_, terminated, truncated, _ = env.step(act)
            if terminated or truncated:
                before = time.process_time()
                env.reset()
                AWAY[0] += 0.0 if resets else time.process_time() - before

    return run


AWAY = [0.0]


def single() -> None:
    """Print a ring of ``gym.make``, with its wrappers and without them, with resets and without."""
    cases: Cases = {}
    for name, bare in (("gym.make", False), ("unwrapped", True)):
        for how, resets in (("with resets", True), ("without", False)):
            env = gym.make("DiffIDM-v0", task="ring")
            cases[f"{name}, {how}"] = Case(stepping(env.unwrapped if bare else env, 3000, resets), 3000)
    told("one ring, a step", cases)


def lanes() -> None:
    """Print ``merge``: one environment, 64 with numpy, and windows of 64 with their gradients."""
    steps = gym.make_vec("DiffIDM-v0", num_envs=1, task="merge").unwrapped.task.held  # type: ignore[attr-defined]
    one = Case(stepping(gym.make("DiffIDM-v0", task="merge"), 60, False), 60)
    many = gym.make_vec("DiffIDM-v0", num_envs=64, task="merge")
    many.reset(seed=0)
    act = np.zeros(many.action_space.shape, np.float32)
    told("merge", {
        "single, an action of ten Δt": one, "vector of 64, a Δt": Case(lambda: many.step(act), steps),
        "unroll 64 with gradients, a Δt": of({"task": "merge"}, 64, 10, True)["unroll"]._replace(units=10 * steps),
    })  # fmt: skip


def vector() -> None:
    """Print vectors of rings with random actions, resets included, and the steps of environments in a CPU second."""
    for count, steps in ((64, 400), (1024, 60), (4096, 30)):
        env = gym.make_vec("DiffIDM-v0", num_envs=count, task="ring")
        env.reset(seed=0)
        random = np.random.default_rng(0).uniform(-1.0, 1.0, (steps, count, 1)).astype(np.float32)

        def run(env: Any = env, random: Any = random) -> None:
            for action in random:
                env.step(action)

        mean = told(f"vector of {count} rings", {"a step": Case(run, steps)})["a step"]
        print(f"  {count / mean / 1e3:.2f} M env steps per CPU second, over all rounds", flush=True)


def effects() -> None:
    """Print a vector of 1024 rings and a window of 64 with gradients for every effect, as multiples of none."""
    names = [None]
    for name in CANDIDATES:
        try:
            gym.make("DiffIDM-v0", effects=[name], warmup=0)
        except ValueError:
            continue
        names.append(name)
    for name in names[1:]:
        numbers, windows = {}, {}
        for own in (None, name):
            keywords = {} if own is None else {"effects": [own]}
            env = gym.make_vec("DiffIDM-v0", num_envs=1024, task="ring", **keywords)
            env.reset(seed=0)
            numbers[str(own)] = Case(lambda env=env: [env.step(None) for _ in range(20)], 20)
            windows[str(own)] = of({**RING, **keywords}, 64, 100, True)["unroll"]
        by = [measure(cases, ROUNDS) for cases in (numbers, windows)]
        cells = [t[str(name)][f"cpu_{k}_ms"] / t["None"][f"cpu_{k}_ms"] for t in by for k in ("min", "median")]
        print(
            "  {:24s} vector 1024 {:5.2f} ({:5.2f}) × plain   unroll 64 {:5.2f} ({:5.2f}) × plain".format(name, *cells),
            flush=True,
        )


def cores() -> None:
    """Print the wall time of windows with gradients on one core and on two: for a quiet minute."""
    for count, steps in ((1024, 100), (4096, 50)):
        window = of(RING, count, steps, True)["unroll"]

        def on(threads: int, window: Case = window) -> None:
            torch.set_num_threads(threads)
            window.run()

        taken = measure({f"{n} core{'s' * (n > 1)}": Case(partial(on, n), steps) for n in (1, 2)}, ROUNDS)
        (one, two) = ([t[f"wall_{k}_ms"] for k in ("min", "median")] for t in taken.values())
        print(
            f"unroll, {count} rings × {steps}, wall ms a step: {one[0]:.3f} ({one[1]:.3f}) on one core, {two[0]:.3f} "
            f"({two[1]:.3f}) on two: {one[0] / two[0]:.2f} ({one[1] / two[1]:.2f}) ×",
            flush=True,
        )
    torch.set_num_threads(1)


def told(title: str, cases: Cases) -> dict[str, float]:
    """Time cases in turn, without what ``AWAY`` says; print least and median, and return means, milliseconds a step."""
    print(title, flush=True)
    result = {}
    for case in cases.values():
        case.run()
    taken: dict[str, list[float]] = {name: [] for name in cases}
    for _ in range(ROUNDS):
        for name, case in cases.items():
            AWAY[0], before = 0.0, time.process_time()
            case.run()
            taken[name].append((time.process_time() - before - AWAY[0]) / case.units * 1e3)
    for name, each in taken.items():
        result[name] = sum(each) / len(each)
        print(f"  {name:32s} {min(each):9.4f} ({sorted(each)[len(each) // 2]:.4f}) ms", flush=True)
    return result


if __name__ == "__main__":
    torch.set_num_threads(1)
    parts = (gradients, single, lanes, vector, effects, cores)
    for part in parts:
        if not sys.argv[1:] or part.__name__ in sys.argv[1:]:
            part()
