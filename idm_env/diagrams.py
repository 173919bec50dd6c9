"""Space-time diagrams with matplotlib, and the colours of speeds that all pictures share."""

from __future__ import annotations

from typing import Any

import numpy as np

from idm_env.fonts import legible

COLOURS = np.array([(178, 24, 43), (239, 138, 98), (253, 219, 120), (120, 190, 110), (26, 120, 80)], float)
"""Red at standstill, over yellow, to green at full speed; RGB in 0–255."""


def space_time(
    data: Any,
    *,
    dt: float = 0.1,
    row: int = 0,
    ring_length: float | None = None,
    marked: tuple[int, ...] = (),
    fastest: float | None = None,
    title: str = "",
) -> Any:
    """Return a matplotlib figure: position over time, one line per vehicle, coloured by speed.

    Args:
        data: What a rollout keeps (``Trajectory``: position and speed, time first, vehicles last, perhaps a batch
            between), a table with ``vehicle_id, time_s, position_m, speed_mps`` (polars or pandas), or
            ``idm_env.data.Trajectories``.
        dt: Time step of a rollout (s).
        row: Which row of a batch to draw.
        ring_length: Circumference (m); positions are then drawn on one lap.
        marked: Vehicles (indices of a rollout) to underline in blue.
        fastest: Speed of the colour scale's end (m/s); None takes the fastest of the data.
        title: Above the picture.

    Raises:
        ValueError: If the table lacks a column.
        ImportError: If matplotlib is missing, with the command that installs it.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.collections import LineCollection
        from matplotlib.colors import LinearSegmentedColormap
        from matplotlib.figure import Figure
    except ImportError:
        raise ImportError("diagrams need matplotlib. Install it with: pip install 'idm-env[data]'") from None
    tracks = _tracks(data, dt, row)
    figure = Figure(figsize=(9.0, 4.8), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    top = fastest or max((float(speed.max()) for _, _, speed in tracks if len(speed)), default=1.0) or 1.0
    scale = LinearSegmentedColormap.from_list("speed", COLOURS / 255.0)
    drawn = None
    for index, (time, position, speed) in enumerate(tracks):
        place = position if ring_length is None else position % ring_length
        points = np.stack((time, place), axis=-1)
        segments: Any = np.stack((points[:-1], points[1:]), axis=1)
        # A lap that ends, or a hole in time, is not a line across the picture.
        step = np.median(np.diff(time)) if len(time) > 1 else 1.0
        whole = np.diff(time) < 1.5 * step
        if ring_length is not None:
            whole &= np.abs(np.diff(place)) < 0.5 * ring_length
        if index in marked:
            axes.add_collection(LineCollection(segments[whole], colors="#1e5adc", linewidths=3.0))
        lines = LineCollection(segments[whole], cmap=scale, linewidths=1.0)
        lines.set_array(speed[1:][whole])
        lines.set_clim(0.0, top)
        drawn = axes.add_collection(lines)
    axes.autoscale()
    axes.margins(0.01)
    place_label = "position (m)" if ring_length is None else "position on the ring (m)"
    axes.set(xlabel="time (s)", ylabel=place_label, title=title)
    if drawn is not None:
        figure.colorbar(drawn, ax=axes, label="speed (m/s)")
    legible(figure)
    return figure


def _tracks(data: Any, dt: float, row: int) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Return (time, position, speed) of every vehicle."""
    if hasattr(data, "position") and hasattr(data, "speed"):
        position, speed = (np.asarray(x.detach().cpu(), float) for x in (data.position, data.speed))
        while position.ndim > 2:
            index = row if position.ndim == 3 else 0
            position, speed = position[:, index], speed[:, index]
        time = dt * np.arange(1, len(position) + 1)
        return [(time, position[:, i], speed[:, i]) for i in range(position.shape[1])]
    table = getattr(data, "table", data)
    needed = ("vehicle_id", "time_s", "position_m", "speed_mps")
    missing = [name for name in needed if name not in table.columns]
    if missing:
        raise ValueError(f"the table has no column '{missing[0]}'. A diagram needs {', '.join(needed)}.")
    runs = np.asarray(table["run_id"]).astype(str) if "run_id" in table.columns else np.full(len(table), "")
    keys = np.char.add(np.char.add(runs, "/"), np.asarray(table["vehicle_id"]).astype(str))
    columns = [np.asarray(table[name], float) for name in needed[1:]]
    tracks = []
    for key in dict.fromkeys(keys.tolist()):
        time, position, speed = (column[keys == key] for column in columns)
        order = np.argsort(time)
        tracks.append((time[order], position[order], speed[order]))
    return tracks
