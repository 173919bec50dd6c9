"""Pictures for teaching: the fundamental diagram and the moving picture of traffic, from a rollout or a table."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from idm_env.extras import needed
from idm_env.reports.diagrams import COLOURS, Panel, panels_of, place_label


def edie(drawn: Sequence[Panel], *, seconds: float = 60.0, metres: float = 100.0) -> tuple[np.ndarray, np.ndarray]:
    """Return density (vehicles/m) and flow (vehicles/s) [cells] of whole cells of ``seconds`` by ``metres``.

    Edie (1963): with the area A of a cell, density is the time that vehicles spend in it over A, flow the distance
    that they cover in it over A. On a ring a cell is the whole lap. ValueError where no cell is whole.
    """
    density: list[np.ndarray] = []
    flow: list[np.ndarray] = []
    for panel in drawn:
        ring = panel.ring_length
        lines = panel.lines
        time, speed = (np.concatenate([getattr(line, name)[1:] for line in lines]) for name in ("time", "speed"))
        place = np.concatenate([line.position[1:] % ring if ring else line.position[1:] for line in lines])
        step = np.concatenate([np.diff(line.time) for line in lines])
        if not ring:  # the end of a lap would be a hole
            step = np.where(np.concatenate([line.whole(None) for line in lines]), step, 0.0)
        low = 0.0 if ring else float(place.min())
        wide = ring or metres
        times = np.arange(time.min(), time.max() + 1e-6, seconds)
        places = np.arange(low, (low + ring if ring else float(place.max())) + 1e-6, wide)
        if len(times) < 2 or len(places) < 2:
            continue
        area = seconds * wide
        for values, totals in ((step, density), (step * speed, flow)):
            cells = np.histogram2d(time, place, bins=(times, places), weights=values)[0]
            totals.append(cells.ravel() / area)
    if not density:
        raise ValueError(f"no cell of {seconds:g} s by {metres:g} m is whole. Give smaller seconds= or metres=.")
    occupied = np.concatenate(density) > 0.0
    return np.concatenate(density)[occupied], np.concatenate(flow)[occupied]


def fundamental_diagram(
    data: Any, *, dt: float = 0.1, ring_length: float | None = None, seconds: float = 60.0, metres: float = 100.0
) -> Any:
    """Return a matplotlib figure of flow (vehicles/h) over density (vehicles/km), a point per cell.

    Args:
        data: As in ``idm_env.reports.diagrams.space_time``; or a list of panels, as one ring for each density.
        dt: Time step of a rollout (s).
        ring_length: Circumference of a rollout's ring (m).
        seconds: Duration of a cell (s).
        metres: Length of a cell (m); on a ring it is the lap.

    Raises:
        ValueError: If no cell is whole, or a table lacks a column.
    """
    with needed("a diagram"):
        from matplotlib.figure import Figure
    density, flow = edie(panels_of(data, dt=dt, ring_length=ring_length), seconds=seconds, metres=metres)
    figure = Figure(figsize=(6.0, 4.2), dpi=120, layout="constrained")
    axes = figure.subplots()
    axes.plot(1000.0 * density, 3600.0 * flow, "o", ms=4.0, alpha=0.7, color="#0b5fa5")
    axes.set(xlabel="density (vehicles/km)", ylabel="flow (vehicles/h)", xlim=(0.0, None), ylim=(0.0, None))
    axes.grid(alpha=0.25)
    return figure


def animate(data: Any, *, dt: float = 0.1, ring_length: float | None = None, every: float = 1.0) -> Any:
    """Return a matplotlib animation of the largest panel; ``.save("ring.gif", "pillow")`` keeps it.

    Vehicles are dots, red at standstill and green at full speed, on a circle where there is a ring.

    Args:
        data: As in ``idm_env.reports.diagrams.space_time``, or a list of panels.
        dt: Time step of a rollout (s).
        ring_length: Circumference of a rollout's ring (m).
        every: Time of the traffic between two pictures (s).
    """
    with needed("an animation"):
        from matplotlib.animation import FuncAnimation
        from matplotlib.colors import LinearSegmentedColormap
        from matplotlib.figure import Figure
    panel = panels_of(data, dt=dt, ring_length=ring_length)[0]
    ring = panel.ring_length
    figure = Figure(figsize=(5.0, 4.0) if ring else (8.0, 2.0), dpi=80, layout="constrained")
    axes = figure.subplots()
    times = np.arange(min(x.time[0] for x in panel.lines), max(x.time[-1] for x in panel.lines), every)
    top = max(1.0, max(float(line.speed.max()) for line in panel.lines))
    scale = LinearSegmentedColormap.from_list("speed", COLOURS / 255.0)
    dots = axes.scatter([0.0], [0.0], s=60, c=[0.0], cmap=scale, vmin=0.0, vmax=top)
    figure.colorbar(dots, ax=axes, label="speed (m/s)")
    if ring:
        axes.set(xlim=(-1.2, 1.2), ylim=(-1.2, 1.2), aspect="equal", xticks=[], yticks=[])
    else:
        every_place = np.concatenate([line.position for line in panel.lines])
        axes.set(xlim=(every_place.min(), every_place.max()), ylim=(-1, 1), yticks=[], xlabel=place_label(None))

    def picture(time: float) -> tuple[Any]:
        lines = [line for line in panel.lines if line.time[0] <= time <= line.time[-1]]
        samples = [min(int(np.searchsorted(line.time, time)), len(line.time) - 1) for line in lines]
        place = np.array([line.position[i] for line, i in zip(lines, samples, strict=True)])
        angle = 2.0 * np.pi * place / (ring or 1.0)
        points = (np.cos(angle), np.sin(angle)) if ring else (place, np.zeros_like(place))
        dots.set_offsets(np.stack(points, axis=-1))
        dots.set_array(np.array([line.speed[i] for line, i in zip(lines, samples, strict=True)]))
        axes.set_title(f"{time:.0f} s", fontsize=10)
        return (dots,)

    return FuncAnimation(figure, picture, frames=list(times), interval=100)
