"""The result of a benchmark in words: tables for the terminal and the page, largest first where sizes differ."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from idm_env.reports import page

Rows = list[dict[str, Any]]
RINGS = {
    "env_steps_per_s_at_8192": ("8192 rings at once", "environment steps per CPU second"),
    "env_steps_per_s_at_8192_ten_per_call": ("8192 rings, ten steps a call", "environment steps per CPU second"),
    "single_ring_step_us": ("a single ring, one step", "µs of CPU"),
    "lane_of_1000_vehicle_updates_per_s": ("a lane of 1000", "vehicle updates per CPU second"),
}
PEERS = {
    "sumo": ("SUMO, a lane of 1000", "vehicle_updates_per_cpu_second", "vehicle updates per CPU second"),
    "highway": ("HighwayEnv, highway-fast-v0", "env_steps_per_cpu_second", "environment steps per CPU second"),
}


def of(result: Mapping[str, Any]) -> list[tuple[str, Rows, str]]:
    """Return (title, rows, what it means) of everything that was measured."""
    tables: list[tuple[str, Rows, str]] = []
    ratios = "× diffidm: how many times as fast as the published package, by the minimum."
    for size, part in sorted(result["one_core"].items(), key=lambda item: -int(item[0])):
        title = f"{int(size):,} vehicles, one core"
        tables.append((title, _paths(part, int(size), "cpu"), ratios + _triad(part)))
    every = result["all_cores"]
    size = max(int(n) for n in result["one_core"])
    title = f"{size:,} vehicles, {every['threads']} thread{'s' if every['threads'] > 1 else ''} (wall time)"
    tables.append((title, _paths(every, size, "wall"), ratios + _triad(every)))
    others = [*_rings(result), *_peers(result)]
    if others:
        tables.append(("Environments and other simulators", others, "One core; higher is faster but for µs."))
    if result.get("gradient_steps"):
        words = "A 32 × 32 policy in torch, torch output, one core, ms of CPU time; JAX where it is installed."
        tables.append(("A step of environments with its gradients", result["gradient_steps"], words))
    tables += _fits(result)
    if result.get("gradient_error"):
        rows = [{"path": name, "largest relative error": value} for name, value in result["gradient_error"].items()]
        tables.append(("Error of the gradient", rows, "Against float64 through torch."))
    if result.get("growth"):
        rows = [{"path": name, "exponent": value} for name, value in result["growth"].items()]
        tables.append(("Growth of time with the number of vehicles", rows, "1 is linear."))
    if result.get("memory_mb_100_steps"):
        rows = [
            {"": f"{int(n):,} vehicles" if n.isdigit() else n, "peak (MB)" if n.isdigit() else "exponent": value}
            for n, value in result["memory_mb_100_steps"].items()
        ]
        names = list(dict.fromkeys(name for row in rows for name in row))
        rows = [{name: row.get(name, "") for name in names} for row in rows]
        tables.append(("Memory of 100 steps with their gradient", rows, "1 is linear."))
    if result.get("gpu"):
        rows = [
            {"case": name, "ms per step": value} for name, value in result["gpu"].items() if isinstance(value, float)
        ]
        tables.append(("GPU: compiled rollouts, and environments in torch", rows, str(result["machine"].get("gpu"))))
    return tables


def _triad(part: Mapping[str, Any]) -> str:
    return f" Memory moves at {part['triad_gb_s']:.1f} GB/s (triad), the floor of any path."


def _paths(part: Mapping[str, Any], vehicles: int, clock: str) -> Rows:
    times = part["times_ms_per_step"]
    rows = []
    for name, t in times.items():
        if name == "triad":
            continue
        theirs = times.get("diffidm forward+backward" if "backward" in name else "diffidm forward")
        best = t[f"{clock}_min_ms"]
        rows.append({
            "path": name, "ms per step, min": best, "median": t[f"{clock}_median_ms"],
            "ns per vehicle": 1e6 * best / vehicles,
            "× diffidm": float("nan") if theirs is None else theirs[f"{clock}_min_ms"] / best,
        })  # fmt: skip
    return rows


def _rings(result: Mapping[str, Any]) -> Rows:
    rings = result.get("rings") or {}
    return [{"what": words, "": rings[key], "unit": unit} for key, (words, unit) in RINGS.items() if key in rings]


def _peers(result: Mapping[str, Any]) -> Rows:
    peers = result.get("peers") or {}
    return [
        {"what": words, "": peers[name][key], "unit": unit}
        for name, (words, key, unit) in PEERS.items() if peers.get(name)
    ]  # fmt: skip


def _fits(result: Mapping[str, Any]) -> list[tuple[str, Rows, str]]:
    tables = []
    fit = result.get("fit")
    if fit:
        rows = [{"what": n, "CPU ms, min": t["cpu_min_ms"], "median": t["cpu_median_ms"]} for n, t in fit["ms"].items()]
        words = (
            f"500 iterations of Adam: {fit['seconds_for_500_iterations']:.1f} s by the kernel, "
            f"{fit['times_eager']:.0f} times as fast as eager torch."
        )
        tables.append(("Fits of 6000 drivers over 600 steps", rows, words))
    discovery = result.get("discovery")
    if discovery:
        rows = [{"effect": n, "Jacobian, CPU ms": value} for n, value in discovery["jacobian_cpu_ms"].items()]
        words = f"{discovery['windows']} windows; a whole discovery takes {discovery['set_cpu_s']:.1f} CPU s."
        tables.append(("Discovery", rows, words))
    return tables


def absent(result: Mapping[str, Any]) -> str:
    """Return one line on what could not be measured here, and why."""
    one = next(iter(result["one_core"].values()))["times_ms_per_step"]
    gone = [name for name, measured in (
        ("diffidm (not installed)", any(n.startswith("diffidm") for n in one)),
        ("kernels (see --verbose)", any(n.startswith("kernel") for n in one)),
        ("GPU (none)", bool(result.get("gpu"))),
        ("SUMO", "peers" not in result or bool(result["peers"].get("sumo"))),
        ("HighwayEnv", "peers" not in result or bool(result["peers"].get("highway"))),
    ) if not measured]  # fmt: skip
    if "peers" not in result:
        gone.append("other simulators (--no-peers)")
    return f"Not measured: {', '.join(gone)}." if gone else "Everything was measured."


def write(out: Path, result: Mapping[str, Any], drawn: page.Block | None) -> None:
    """Write report.html."""
    machine = result["machine"]
    where = f"{machine['cores']} cores of {machine['processor']}, GPU: {machine['gpu'] or 'none'}, torch "
    where += f"{machine['torch']} ({machine['vector']}), {machine['date']}"
    blocks = [page.Block("lead", _lead(result)), page.Block("note", where)]
    if drawn is not None:
        blocks.append(drawn)
    for title, rows, words in of(result):
        blocks += [page.Block("heading", title), page.table(rows), page.Block("note", words)]
    blocks += [page.Block("heading", "How"), page.Block("text", result["physics"]), page.Block("text", absent(result))]
    blocks.append(
        page.Block("note", "All figures are in performance.json. Compare ratios: milliseconds depend on the machine.")
    )
    page.write_page(out / "report.html", "Speed, side by side", blocks)


def _lead(result: Mapping[str, Any]) -> str:
    size, part = max(result["one_core"].items(), key=lambda item: int(item[0]))
    rows = {row["path"]: row for row in _paths(part, int(size), "cpu")}
    parts = []
    for kind, words in (("forward", "a step"), ("forward+backward", "a step with its gradient")):
        row = min((r for n, r in rows.items() if n.split(" ", 1)[1] == kind), key=lambda r: r["ns per vehicle"])
        ratio = row["× diffidm"]
        more = f", {ratio:.3g} × diffidm" if ratio == ratio and not row["path"].startswith("diffidm") else ""
        parts.append(f"{words} takes {row['ns per vehicle']:.3g} ns per vehicle ({row['path'].split()[0]}{more})")
    return f"With {int(size):,} vehicles on one core, " + ", ".join(parts) + "."
