"""On a GPU: milliseconds per step of the compiled rollout, and of environments with ``output="torch"``.

Run alone as ``python -m benchmarks.bench.gpu``; ``python -m benchmarks.bench`` has it where there is a GPU. Times are
those of CUDA events, the least of the rounds.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import gymnasium
import torch

import idm_env  # noqa: F401
from benchmarks.bench import traffic

STEPS = 10
FACES: dict[str, tuple[dict[str, Any], tuple[int, ...]]] = {
    "ring": ({"warmup": 0}, (64, 1024, 16_384, 131_072)),
    "merge": ({}, (64, 1024, 8192)),
}


def rows(sizes: Sequence[int], rounds: int) -> Iterator[tuple[str, float]]:
    """Yield cases and their milliseconds per step: a ``rollout`` of N vehicles, a ``step`` of N environments."""
    for vehicles in sizes:
        lanes = traffic.Traffic(vehicles, "cuda")
        for backward in (False, True):
            torch.compiler.reset()  # type: ignore[no-untyped-call]
            case = lanes.ours(lanes.simulator.compile(), False, backward)
            yield f"rollout {vehicles} {_kind(backward)}", _least(case.run, rounds) / case.units
    for task, (keywords, counts) in FACES.items():
        for count in counts:
            for backward in (False, True):
                loop = _loop(task, count, backward, **keywords)
                yield f"step {task} {count} {_kind(backward)}", _least(loop, rounds) / STEPS


def _kind(backward: bool) -> str:
    return "forward+backward" if backward else "forward"


def _loop(task: str, count: int, backward: bool, **keywords: Any) -> Callable[[], None]:
    """Return a call that takes STEPS steps of ``count`` environments, with the gradient by their actions if asked."""
    env: Any = gymnasium.make_vec("DiffIDM-v0", num_envs=count, task=task, output="torch", device="cuda", **keywords)
    env.reset(seed=0)
    shape = env.action_space.shape

    def run() -> None:
        action = torch.zeros(shape, device="cuda", requires_grad=backward)
        total = torch.zeros((), device="cuda")
        with torch.set_grad_enabled(backward):
            for _ in range(STEPS):
                _, reward, *_ = env.step(action)
                total = total + reward.sum()
        if backward:
            total.backward()  # type: ignore[no-untyped-call]
            env.detach()

    return run


def _least(run: Callable[[], object], rounds: int) -> float:
    """Return the milliseconds of the fastest of ``rounds`` calls, after one that compiles."""
    run()
    milliseconds = []
    for _ in range(rounds):
        begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        begin.record()  # type: ignore[no-untyped-call]
        run()
        end.record()  # type: ignore[no-untyped-call]
        torch.cuda.synchronize()
        milliseconds.append(begin.elapsed_time(end))
    return float(min(milliseconds))


if __name__ == "__main__":
    if not torch.cuda.is_available():
        sys.exit("There is no GPU here: run this where torch.cuda.is_available() says True.")
    print(torch.cuda.get_device_name(), torch.__version__)
    for case, milliseconds in rows((2_000, 20_000, 200_000, 2_000_000), 3):
        print(f"{case:40} {milliseconds:9.4f} ms", flush=True)
