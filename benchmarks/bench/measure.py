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
            wall, cpu = time.perf_counter(), time.process_time()
            case.run()
            taken[name].append(
                (
                    1e3 * (time.process_time() - cpu) / case.units,
                    1e3 * (time.perf_counter() - wall) / case.units,
                )
            )
    return {name: _summary(values) for name, values in taken.items()}


def _summary(values: list[tuple[float, float]]) -> dict[str, float]:
    cpu, wall = [c for c, _ in values], [w for _, w in values]
    return {
        "cpu_min_ms": min(cpu),
        "cpu_median_ms": statistics.median(cpu),
        "wall_min_ms": min(wall),
        "wall_median_ms": statistics.median(wall),
    }


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
