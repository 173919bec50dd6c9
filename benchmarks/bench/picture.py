"""One picture of the benchmark: time per vehicle-step over the number of vehicles, every path a line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from idm_env.jobs import storage
from idm_env.reports import page


def draw(result: dict[str, Any], path: Path) -> page.Block:
    """Draw forward and forward + backward, nanoseconds of one core per vehicle-step, with the triad as the floor.

    Returns the picture for a page.
    """
    figure, grid = page.figure(1, 2, size=(10.0, 4.0))
    panels = grid[0]
    panels[1].sharey(panels[0])
    sizes = [int(n) for n in result["one_core"]]
    for panel, kind in zip(panels, ("forward", "forward+backward"), strict=True):
        for name in ("diffidm", "eager", "compiled", "kernel"):
            points = [
                (n, 1e6 * part["times_ms_per_step"][f"{name} {kind}"]["cpu_min_ms"] / n)
                for n, part in zip(sizes, result["one_core"].values(), strict=True)
                if f"{name} {kind}" in part["times_ms_per_step"]
            ]
            if points:
                panel.plot(*zip(*points, strict=True), marker="o", label=name)
        floor = [52.0 / part["triad_gb_s"] for part in result["one_core"].values()]
        panel.plot(sizes, floor, "k:", label="52 B at the triad's speed")
        panel.set(xscale="log", yscale="log", xlabel="vehicles (lanes of 50)", title=f"{kind}, 10 steps, one core")
        panel.grid(alpha=0.3)
    panels[0].set_ylabel("ns per vehicle-step")
    panels[1].legend()
    storage.write(path, lambda file: figure.savefig(file, dpi=120))
    return page.picture(figure, "Time of one core per vehicle-step over the number of vehicles; lower is faster.")
