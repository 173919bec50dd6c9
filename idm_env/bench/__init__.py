"""Side by side in one run: diffidm, our eager, compiled and kernel paths, SUMO, HighwayEnv and a memory triad.

Compare ratios: they hold wherever it runs; milliseconds depend on the machine. One-core figures are CPU time with one
thread; two-core figures are wall time.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch

from idm_env import keep, kernels
from idm_env.bench import fits, memory, peers, traffic
from idm_env.bench.measure import Case, machine, measure
from idm_env.kernels import dispatch

OUTPUT = ("performance.json", "performance.png")
SIZES = (2_000, 20_000, 200_000, 2_000_000)
BYTES = 4 * (3 + 6 + 4)
"""What one step of one vehicle has to read (state, parameters) and write (state, acceleration) in float32."""

Say = Callable[[str], None]


def run(
    out: Path | str | None = None,
    *,
    sizes: Sequence[int] = SIZES,
    rounds: int = 5,
    compiled: bool = True,
    others: bool = True,
    verbose: bool = False,
    say: Say = print,
) -> dict[str, Any]:
    """Run everything, say a table, and write ``performance.json`` and ``performance.png`` into the folder ``out``.

    ``sizes`` are numbers of vehicles, multiples of 50; ``compiled`` includes ``Simulator.compile()`` (which takes half
    a minute to warm up); ``others`` includes SUMO and HighwayEnv; ``verbose`` says which path ran, and why. Returns
    what the JSON holds. ValueError for sizes that are not multiples of 50.
    """
    for size in sizes:
        if size <= 0 or size % traffic.LANE:
            raise ValueError(f"size {size} is no multiple of {traffic.LANE}, the length of a lane. Take {SIZES}.")
    if out is not None:
        with keep.results(out, OUTPUT):  # what is in the way is told before anything is measured
            pass
    threads = torch.get_num_threads()
    result: dict[str, Any] = {"machine": machine(), "physics": " ".join((traffic.__doc__ or "").split())}
    say(f"{result['machine']}")
    try:
        torch.set_num_threads(1)
        result["one_core"] = {str(n): _lanes(n, rounds, compiled, verbose, say) for n in sizes}
        result["growth"] = growth(result["one_core"])
        result["memory_mb_100_steps"] = memory.peaks(sizes, 100)
        result["gradient_error"] = traffic.accuracy() if kernels.available() else {}
        result["fit"] = fits.recorded_leaders(rounds) if kernels.available() else {}
        result["rings"] = fits.rings() if kernels.available() else {}
        result["discovery"] = fits.discovery() if kernels.available() else {}
        if others:
            result["peers"] = {"sumo": peers.sumo(), "highway": peers.highway()}
        torch.set_num_threads(threads)
        result["all_cores"] = {"threads": threads, **_lanes(max(sizes), rounds, False, False, lambda _: None)}
    finally:
        torch.set_num_threads(threads)
    result["gpu"] = _gpu(sizes, rounds) if torch.cuda.is_available() else None
    for line in summary(result):
        say(line)
    if out is not None:
        from idm_env.bench.picture import draw

        with keep.results(out, OUTPUT) as folder:
            keep.write_text(folder / "performance.json", json.dumps(result, indent=1))
            keep.write(folder / "performance.png", lambda beside: draw(result, beside))
    return result


def _lanes(vehicles: int, rounds: int, compiled: bool, verbose: bool, say: Say) -> dict[str, Any]:
    made = traffic.Traffic(vehicles)
    why = dispatch.refusal(made.simulator, made.state, {}, made.params)
    if verbose:
        say(f"{vehicles} vehicles: kernels {'run' if why is None else 'do not run: ' + why}")
    layer = peers.diffidm_layer()
    cases: dict[str, Case] = {}
    for backward in (False, True):
        kind = "forward+backward" if backward else "forward"
        if layer is not None:
            cases[f"diffidm {kind}"] = made.theirs(layer, backward)
        cases[f"eager {kind}"] = made.ours(made.simulator, False, backward)
        if compiled and vehicles == 200_000:
            cases[f"compiled {kind}"] = made.ours(made.simulator.compile(), False, backward)
        if why is None:
            cases[f"kernel {kind}"] = made.ours(made.simulator, True, backward)
    if why is None:
        cases["kernel forward, one step per call"] = made.calls()
    cases["triad"], moved = traffic.triad()
    times = measure(cases, rounds)
    clock = "cpu" if torch.get_num_threads() == 1 else "wall"
    triad = times["triad"][f"{clock}_min_ms"]
    return {"times_ms_per_step": times, "triad_bytes": moved, "triad_gb_s": moved / triad / 1e6}


def _gpu(sizes: Sequence[int], rounds: int) -> dict[str, Any]:
    """Return milliseconds per step of the compiled step on the GPU, by CUDA events."""
    found: dict[str, Any] = {}
    for vehicles in sizes:
        made = traffic.Traffic(vehicles, "cuda")
        for backward in (False, True):
            case = made.ours(made.simulator.compile(), False, backward)
            case.run()
            times = []
            for _ in range(rounds):
                begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
                begin.record()
                case.run()
                end.record()
                torch.cuda.synchronize()
                times.append(begin.elapsed_time(end) / case.units)
            found[f"{vehicles} {'forward+backward' if backward else 'forward'}"] = min(times)
    return found


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


def summary(result: dict[str, Any]) -> list[str]:
    """Return the lines of the table."""
    lines = ["", "CPU ms per step, one core (min; median), and how many times diffidm's min"]
    for size, part in result["one_core"].items():
        lines.append(f"{int(size):,} vehicles (triad {part['triad_gb_s']:.1f} GB/s)")
        lines += _rows(part["times_ms_per_step"], "cpu")
    every = result["all_cores"]
    lines.append(f"wall ms per step, {every['threads']} threads (triad {every['triad_gb_s']:.1f} GB/s)")
    lines += _rows(every["times_ms_per_step"], "wall")
    size = max(int(n) for n in result["one_core"])
    for name in ("kernel forward", "kernel forward, one step per call"):
        if name in every["times_ms_per_step"]:
            rate = size * BYTES / every["times_ms_per_step"][name]["wall_min_ms"] / 1e6
            lines.append(f"  {name}: {BYTES} B per vehicle-step make {rate:.1f} GB/s, {rate / every['triad_gb_s']:.0%}")
    for name in ("growth", "memory_mb_100_steps", "gradient_error", "fit", "rings", "discovery", "peers", "gpu"):
        if result.get(name):
            lines.append(f"{name}: {json.dumps(result[name])}")
    return lines


def _rows(times: dict[str, dict[str, float]], clock: str) -> list[str]:
    rows = []
    for name, t in times.items():
        theirs = times.get("diffidm forward+backward" if "backward" in name else "diffidm forward")
        ratio = (
            "" if theirs is None or name == "triad" else f"{theirs[f'{clock}_min_ms'] / t[f'{clock}_min_ms']:6.1f} ×"
        )
        rows.append(f"  {name:36s} {t[f'{clock}_min_ms']:9.3f} {t[f'{clock}_median_ms']:9.3f} {ratio}")
    return rows


__all__ = ["SIZES", "growth", "run", "summary"]
