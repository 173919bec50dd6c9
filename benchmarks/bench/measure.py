"""How everything here is timed: cases interleaved in rounds, CPU time and wall, minimum and median."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple


class Case(NamedTuple):
    """One thing to time: a call, and by how many units (steps, iterations) its time is divided."""

    run: Callable[[], object]
    units: float = 1.0


def measure(cases: Mapping[str, Case], rounds: int) -> dict[str, dict[str, float]]:
    """Return milliseconds per unit of every case, after one call to warm up.

    Cases take turns in every round, so that whatever else the machine does falls on all of them alike.
    """
    for case in cases.values():
        case.run()
    taken: dict[str, list[tuple[float, float]]] = {name: [] for name in cases}
    for _ in range(rounds):
        for name, case in cases.items():
            cpu, wall = time.process_time(), time.perf_counter()
            case.run()
            taken[name].append((time.process_time() - cpu, time.perf_counter() - wall))
    return {
        name: {
            f"{clock}_{kind}_ms": 1e3 * statistic(column) / cases[name].units
            for clock, column in zip(("cpu", "wall"), zip(*rows, strict=True), strict=True)
            for kind, statistic in (("min", min), ("median", statistics.median))
        }
        for name, rows in taken.items()
    }


def rate(step: Callable[[], object], seconds: float) -> float:
    """Return calls per second of CPU time, after one to warm up."""
    step()
    count, begin = 0, time.process_time()
    while time.process_time() - begin < seconds:
        step()
        count += 1
    return count / (time.process_time() - begin)


def turning(env: Any, action: Callable[[], object]) -> Callable[[], None]:
    """Return a step of an environment that resets where an episode ends; the reset is part of the cost."""
    env.reset(seed=0)

    def step() -> None:
        *_, terminated, truncated, _ = env.step(action())
        if terminated or truncated:
            env.reset()

    return step


def machine() -> dict[str, Any]:
    """Return what the figures depend on."""
    import os
    import platform

    import torch

    name = platform.processor() or platform.machine()
    try:
        with open("/proc/cpuinfo") as lines:
            name = next((x.split(":", 1)[1].strip() for x in lines if x.startswith("model name")), name)
    except OSError:
        pass
    return {
        "processor": name,
        "cores": os.cpu_count(),
        "vector": torch.backends.cpu.get_cpu_capability(),
        "torch": torch.__version__,
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "date": time.strftime("%Y-%m-%d"),
    }
