"""Side by side in one run: diffidm, our eager, compiled and kernel paths, SUMO, HighwayEnv and a memory triad.

Compare ratios: they hold wherever it runs; milliseconds depend on the machine. One-core figures are CPU time with one
thread; two-core figures are wall time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch

from benchmarks.bench import fits, gpu, gradients, memory, peers, tables, traffic
from benchmarks.bench.measure import Case, machine, measure
from idm_env.compiled import kernels
from idm_env.compiled.kernels import dispatch
from idm_env.jobs import storage
from idm_env.jobs.progress import OnProgress, silent

OUTPUT = ("performance.json", "performance.png", "report.html")
SIZES = (2_000, 20_000, 200_000, 2_000_000)
Say = Callable[[str], None]


def run(
    out: Path | str | None = None,
    *,
    sizes: Sequence[int] = SIZES,
    rounds: int = 5,
    compiled: bool = True,
    others: bool = True,
    verbose: bool = False,
    say: Say | None = None,
    on_progress: OnProgress | None = None,
) -> dict[str, Any]:
    """Run everything; write ``performance.json``, ``performance.png`` and ``report.html`` into the folder ``out``.

    ``sizes`` are numbers of vehicles, multiples of 50; ``compiled`` includes ``Simulator.compile()`` (which takes half
    a minute to warm up); ``others`` includes SUMO and HighwayEnv; ``verbose`` tells ``say`` which path ran, and why.
    Returns what the JSON holds; ``tables.of`` makes tables of it. ValueError for sizes that are not multiples of 50.
    """
    for size in sizes:
        if size <= 0 or size % traffic.LANE:
            raise ValueError(f"size {size} is no multiple of {traffic.LANE}, the length of a lane. Take {SIZES}.")
    if out is not None:
        with storage.results(out, OUTPUT):  # what is in the way is told before anything is measured
            pass
    say = say or print
    threads = torch.get_num_threads()
    result: dict[str, Any] = {"machine": machine(), "physics": " ".join((traffic.__doc__ or "").split())}
    numba = kernels.available()

    def lanes() -> dict[str, Any]:
        done = {}
        for i, n in enumerate(sizes):
            tell(f"{n:,} vehicles, one core", i / len(sizes))
            done[str(n)] = _lanes(n, rounds, compiled, verbose, say)
        return done

    # Each takes about as long as the number beside it, relative to the others.
    jobs: list[tuple[str, float, Callable[[], object]]] = [
        ("one_core", 4.0 * len(sizes), lanes),
        ("growth", 0.0, lambda: growth(result["one_core"])),
        ("memory_mb_100_steps", 2.0, lambda: memory.peaks(sizes, 100)),
        ("gradient_error", 1.0, lambda: traffic.accuracy() if numba else {}),
        ("fit", 6.0, lambda: fits.recorded_leaders(rounds) if numba else {}),
        ("corrected", 2.0, lambda: fits.corrected_models(rounds) if numba else {}),
        ("rings", 2.0, lambda: fits.rings() if numba else {}),
        ("gradient_steps", 20.0, lambda: gradients.rows(rounds) if numba else []),
        ("discovery", 6.0, lambda: fits.discovery() if numba else {}),
    ]
    if others:
        jobs.append(("peers", 3.0, lambda: {"sumo": peers.sumo(), "highway": peers.highway_rate()}))
    jobs.append(("all_cores", 4.0, lambda: _all_cores(threads, max(sizes), rounds)))
    whole = sum(weight for _, weight, _ in jobs)
    progress, before, weight = on_progress or silent, 0.0, 0.0

    def tell(words: str, share: float = 0.0) -> None:
        progress("bench", round(100 * (before + share * weight) / whole), 100, words)

    try:
        torch.set_num_threads(1)
        for name, weight, job in jobs:
            tell(name.replace("_", " "))
            result[name] = job()
            before += weight
    finally:
        torch.set_num_threads(threads)
    tell("gpu" if torch.cuda.is_available() else "the report")
    result["gpu"] = dict(gpu.rows(sizes, rounds)) if torch.cuda.is_available() else None
    if out is not None:
        from benchmarks.bench.picture import draw

        with storage.results(out, OUTPUT) as folder:
            storage.write_json(folder / "performance.json", result)
            tables.write(folder, result, draw(result, folder / "performance.png"))
    return result


def _all_cores(threads: int, vehicles: int, rounds: int) -> dict[str, Any]:
    torch.set_num_threads(threads)
    return {"threads": threads, **_lanes(vehicles, rounds, False, False, lambda _: None)}


def _lanes(vehicles: int, rounds: int, compiled: bool, verbose: bool, say: Say) -> dict[str, Any]:
    lanes = traffic.Traffic(vehicles)
    why = dispatch.refusal(lanes.simulator, lanes.state, {}, lanes.params)
    if verbose:
        say(f"{vehicles} vehicles: kernels {'run' if why is None else 'do not run: ' + why}")
    layer = peers.diffidm_layer()
    cases: dict[str, Case] = {}
    for backward in (False, True):
        kind = "forward+backward" if backward else "forward"
        if layer is not None:
            cases[f"diffidm {kind}"] = lanes.theirs(layer, backward)
        cases[f"eager {kind}"] = lanes.ours(lanes.simulator, False, backward)
        if compiled and vehicles == 200_000:
            cases[f"compiled {kind}"] = lanes.ours(lanes.simulator.compile(), False, backward)
        if why is None:
            cases[f"kernel {kind}"] = lanes.ours(lanes.simulator, True, backward)
    if why is None:
        cases["kernel forward, one step per call"] = lanes.calls()
        if torch.get_num_threads() == 1:
            cases["reads and writes of one step alone"] = lanes.moves()
    cases["triad"], moved = traffic.triad()
    times = measure(cases, rounds)
    clock = "cpu" if torch.get_num_threads() == 1 else "wall"
    triad = times["triad"][f"{clock}_min_ms"]
    return {"times_ms_per_step": times, "triad_bytes": moved, "triad_gb_s": moved / triad / 1e6}


def growth(one_core: dict[str, Any]) -> dict[str, float]:
    """Return the exponent of time over the number of vehicles, from 2e4 (or the smallest) to the largest size."""
    sizes = sorted(int(n) for n in one_core)
    low = next((n for n in sizes if n >= 20_000), sizes[0])
    high = sizes[-1]
    if low == high:
        return {}
    first, last = (one_core[str(n)]["times_ms_per_step"] for n in (low, high))
    return {
        name: math.log(last[name]["cpu_min_ms"] / first[name]["cpu_min_ms"]) / math.log(high / low)
        for name in last
        if name in first and name != "triad"
    }


__all__ = ["SIZES", "growth", "run"]
