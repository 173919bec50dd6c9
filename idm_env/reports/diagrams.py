"""Space-time diagrams, one panel per run and lane, and the colours of speeds that all pictures share."""

import base64
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from idm_env.extras import needed
from idm_env.reports import page

COLOURS = np.array([(178, 24, 43), (239, 138, 98), (253, 219, 120), (120, 190, 110), (26, 120, 80)], float)
"""Red at standstill, over yellow, to green at full speed; RGB in 0–255."""
CONTROLLED = "#1e5adc"
MOST_POINTS = 150_000
"""An interactive page has at most so many points; denser tracks are thinned."""
MOST_DRAWN = 60_000
"""A picture has at most so many: it has fewer pixels, and matplotlib draws each segment by itself."""


@dataclass(frozen=True, eq=False)
class VehicleLine:
    """One vehicle: time (s), position (m) and speed (m/s), each [T], by rising time; ``marked`` where controlled."""

    name: str
    time: np.ndarray
    position: np.ndarray
    speed: np.ndarray
    marked: bool = False

    def whole(self, ring_length: float | None) -> np.ndarray:
        """Return [T − 1] where two samples belong to one line: not across a hole in time or the end of a lap."""
        step = np.diff(self.time)
        joined = step < 1.5 * (np.median(step) if len(step) else 1.0)
        if ring_length is not None:
            joined &= np.abs(np.diff(self.position % ring_length)) < 0.5 * ring_length
        return np.asarray(joined)


@dataclass(frozen=True, eq=False)
class Panel:
    """The vehicles of one run and lane."""

    title: str
    lines: tuple[VehicleLine, ...]
    ring_length: float | None = None

    @property
    def points(self) -> int:
        """Samples of all vehicles."""
        return sum(len(line.time) for line in self.lines)


def panels(data: Any, *, ring_length: float | None = None) -> list[Panel]:
    """Return the panels of a table or of ``idm_env.data.Trajectories``: one per run and lane, most samples first.

    Needs ``vehicle_id, time_s, position_m, speed_mps``; uses ``run_id``, ``lane``, ``ring_length_m`` and
    ``controlled`` where they are. Tables of polars and of pandas do. ValueError if a column is missing.
    """
    table = getattr(data, "table", data)
    needed = ("vehicle_id", "time_s", "position_m", "speed_mps")
    missing = [name for name in needed if name not in table.columns]
    if missing:
        raise ValueError(f"the table has no column '{missing[0]}'. A diagram needs {', '.join(needed)}.")
    count = len(table)
    runs, lanes, vehicles = (
        np.asarray(table[name]).astype(str) if name in table.columns else np.full(count, "")
        for name in ("run_id", "lane", "vehicle_id")
    )
    time, position, speed = (np.asarray(table[name], float) for name in needed[1:])
    marked = np.asarray(table["controlled"], bool) if "controlled" in table.columns else np.zeros(count, bool)
    rings = np.asarray(table["ring_length_m"], float) if "ring_length_m" in table.columns else np.full(count, np.nan)
    order = np.lexsort((time, vehicles, lanes, runs))
    edges = np.flatnonzero(_changes(runs[order]) | _changes(lanes[order]) | _changes(vehicles[order]))
    by_lane: dict[tuple[str, str], list[VehicleLine]] = {}
    lengths: dict[tuple[str, str], float | None] = {}
    for rows in np.split(order, edges[1:]):
        key = str(runs[rows[0]]), str(lanes[rows[0]])
        line = VehicleLine(str(vehicles[rows[0]]), time[rows], position[rows], speed[rows], bool(marked[rows].any()))
        by_lane.setdefault(key, []).append(line)
        finite = rings[rows][np.isfinite(rings[rows])]
        lengths[key] = ring_length or (float(finite[0]) if len(finite) else None)
    several = len({run for run, _ in by_lane}) > 1
    drawings = []
    for (run, lane), lines in by_lane.items():
        where = [f"run {run}"] * several + [f"lane {lane}"] * (lane not in ("", "None", "nan"))
        size = f"{len(lines)} vehicle{'s' if len(lines) > 1 else ''}"
        drawings.append(Panel(", ".join([*where, size]), tuple(lines), lengths[run, lane]))
    return sorted(drawings, key=lambda panel: -panel.points)


def rollout_panel(
    data: Any, *, dt: float = 0.1, row: int = 0, ring_length: float | None = None, marked: Sequence[int] = ()
) -> Panel:
    """Return the panel of a rollout's trajectory (position and speed, time first, vehicles last)."""
    position, speed = (np.asarray(x.detach().cpu(), float) for x in (data.position, data.speed))
    while position.ndim > 2:
        index = row if position.ndim == 3 else 0
        position, speed = position[:, index], speed[:, index]
    time = dt * np.arange(1, len(position) + 1)
    lines = [VehicleLine(str(i), time, position[:, i], speed[:, i], i in marked) for i in range(position.shape[1])]
    return Panel(f"{len(lines)} vehicles", tuple(lines), ring_length)


def panels_of(data: Any, *, ring_length: float | None = None, **rollout: Any) -> list[Panel]:
    """Return the panels of the ``data`` of ``space_time``; ``rollout`` are keywords of ``rollout_panel``."""
    if isinstance(data, list):
        return data
    if hasattr(data, "position") and hasattr(data, "speed"):
        return [rollout_panel(data, ring_length=ring_length, **rollout)]
    return panels(data, ring_length=ring_length)


def lane_panels(
    data: Any, lane: Any, present: Any, *, dt: float = 0.1, ring_length: float | None = None, marked: Sequence[int] = ()
) -> list[Panel]:
    """Return one panel per lane of a rollout on several, the left one first; whoever changes goes on in another panel.

    ``data`` is what a rollout keeps, ``lane`` (0 on the right) and ``present`` (0 or 1) are of the same shape: time
    first, vehicles last. A slot that makes another trip is another vehicle.
    """
    position, speed = (np.asarray(x.detach().cpu(), float) for x in (data.position, data.speed))
    lanes, on_road = np.asarray(lane.detach().cpu()), np.asarray(present.detach().cpu()) > 0
    time = dt * np.arange(1, len(position) + 1)
    by_lane: dict[int, list[VehicleLine]] = {}
    for i in range(position.shape[1]):
        # A piece ends where the lane changes, where nobody is there, and where a slot begins anew.
        back = np.diff(position[:, i], prepend=position[:1, i]) < -1.0
        cut = _changes(lanes[:, i]) | _changes(on_road[:, i]) | back
        trip = np.cumsum(_changes(on_road[:, i]) & on_road[:, i] | back)
        for steps in np.split(np.arange(len(time)), np.flatnonzero(cut)[1:]):
            if on_road[steps[0], i]:
                # One sample more, so that a change leaves no hole.
                more = steps if steps[-1] + 1 == len(time) or back[steps[-1] + 1] else np.append(steps, steps[-1] + 1)
                more = more[on_road[more, i]]
                name = str(i) if trip[steps[0]] == 1 else f"{i}, trip {trip[steps[0]]}"
                line = VehicleLine(name, time[more], position[more, i], speed[more, i], i in marked)
                by_lane.setdefault(int(lanes[steps[0], i]), []).append(line)
    drawings = []
    for k in sorted(by_lane, reverse=True):
        title = f"lane {k}, {len({line.name for line in by_lane[k]})} vehicles"
        drawings.append(Panel(title, tuple(by_lane[k]), ring_length))
    return drawings


def space_time(
    data: Any,
    *,
    dt: float = 0.1,
    row: int = 0,
    ring_length: float | None = None,
    marked: tuple[int, ...] = (),
    fastest: float | None = None,
    title: str = "",
    most: int = 6,
) -> Any:
    """Return a matplotlib figure: position over time, one line per vehicle, coloured by speed.

    Args:
        data: What a rollout keeps (``Trajectory``: position and speed, time first, vehicles last, perhaps a batch
            between), a table with ``vehicle_id, time_s, position_m, speed_mps`` (polars or pandas),
            ``idm_env.data.Trajectories``, or panels.
        dt: Time step of a rollout (s).
        row: Which row of a batch to draw.
        ring_length: Circumference (m); positions are then drawn on one lap.
        marked: Vehicles (indices of a rollout) to underline in blue, as controlled ones.
        fastest: Speed of the colour scale's end (m/s); None takes nearly the fastest of the data.
        title: Above the picture.
        most: Panels at most: one per run and lane, the largest first.

    Raises:
        ValueError: If the table lacks a column.
        ImportError: If matplotlib is missing, with the command that installs it.
    """
    pictures = panels_of(data, dt=dt, row=row, ring_length=ring_length, marked=marked)
    figure = figure_of(pictures[:most], title, fastest)
    page.legible(figure)
    return figure


def figure_of(drawn: Sequence[Panel], title: str = "", fastest: float | None = None, columns: int | None = None) -> Any:
    """Return a matplotlib figure of panels, in one column up to three of them, else in two; not yet ``legible``."""
    with needed("a diagram"):
        from matplotlib.collections import LineCollection
        from matplotlib.colors import LinearSegmentedColormap
        from matplotlib.figure import Figure
    columns = columns or (1 if len(drawn) <= 3 else 2)
    rows = max(1, -(-len(drawn) // columns))
    height = 4.8 if rows == 1 else 0.8 + 3.0 * rows
    figure = Figure(figsize=(9.0 if columns == 1 else 12.0, height), dpi=120, layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False).ravel()
    top = fastest or _fastest(drawn)
    scale = LinearSegmentedColormap.from_list("speed", COLOURS / 255.0)
    coloured = None
    stride = _stride(drawn, MOST_DRAWN)
    for axes, panel in zip(grid, drawn, strict=False):
        (began, first), names = axes_of(panel, drawn)
        for line in panel.lines:
            line = _thinned(line, stride)
            place = line.position if panel.ring_length is None else line.position % panel.ring_length
            points = np.stack((line.time - began, place - first), axis=-1)
            segments: Any = np.stack((points[:-1], points[1:]), axis=1)
            whole = line.whole(panel.ring_length)
            if line.marked:
                axes.add_collection(LineCollection(segments[whole], colors=CONTROLLED, linewidths=3.0))
            lines = LineCollection(segments[whole], cmap=scale, linewidths=1.0)
            lines.set_array(line.speed[1:][whole])
            lines.set_clim(0.0, top)
            coloured = axes.add_collection(lines)
        axes.autoscale()
        axes.margins(0.01)
        axes.set(xlabel=names[0], ylabel=names[1])
        if any(line.marked for line in panel.lines):
            axes.plot([], [], color=CONTROLLED, lw=3.0, label="controlled")
            axes.legend(loc="upper left", fontsize=8, framealpha=0.9)
        if len(drawn) > 1:
            axes.set_title(panel.title, fontsize=10)
    for axes in grid[len(drawn) :]:
        axes.set_visible(False)
    if title:
        figure.suptitle(title, fontsize=11)
    if coloured is not None:
        figure.colorbar(coloured, ax=list(grid), label="speed (m/s)")
    return figure


def write_html(path: Path, drawn: Sequence[Panel], title: str) -> None:
    """Write an interactive page: choose a panel, look closer, point at a vehicle. It needs nothing from elsewhere."""
    stride, fastest = _stride(drawn, MOST_POINTS), _fastest(drawn)
    content = {
        "colours": COLOURS.tolist(),
        "fastest": fastest,
        "panels": [_packed(panel, drawn, stride, fastest) for panel in drawn],
    }
    text = json.dumps(content, ensure_ascii=False).replace("<", "\\u003c")
    fragment = Path(__file__).with_name("space_time.html").read_text(encoding="utf-8").replace("{{ data }}", text)
    several = f" {len(drawn)} panels, one per run and lane, the largest first." if len(drawn) > 1 else ""
    words = f"One line per vehicle, coloured by speed.{several}"
    thinned = f" Every {stride}th sample is drawn." if stride > 1 else ""
    page.write_page(path, title, [page.Block("note", words + thinned), page.Block("html", fragment)])


def axes_of(panel: Panel, drawn: Sequence[Panel]) -> tuple[tuple[float, float], tuple[str, str]]:
    """Return offsets of times (s) and positions (m), so that axes begin near 0, and the axes' names.

    Times of all that are ``drawn`` have one origin.
    """
    began = far_from_0(_range([line.time for each in drawn for line in each.lines]))
    first = 0.0 if panel.ring_length else far_from_0(_range([line.position for line in panel.lines]))
    place_name = f"{less('position', first, 'm')} (m)" if first else place_label(panel.ring_length)
    return (began, first), (f"{less('time', began, 's')} (s)", place_name)


def far_from_0(values: tuple[float, float]) -> float:
    """Return the offset of values between two: 0, unless they lie far from 0 for the width they have."""
    low, high = values
    if not low > 2.0 * (high - low) and not high < -2.0 * (high - low):
        return 0.0
    unit = 10.0 ** np.floor(np.log10(high - low) - 1.0)
    return float(np.floor(low / unit) * unit)


def less(name: str, offset: float, unit: str) -> str:
    """Return the name of an axis from which an offset is subtracted."""
    return name if not offset else f"{name} {'−' if offset > 0 else '+'} {abs(offset):.12g} {unit}"


def place_label(ring_length: float | None) -> str:
    """Return the label of the position axis."""
    return "position (m)" if ring_length is None else "position on the ring (m)"


def _packed(panel: Panel, together: Sequence[Panel], stride: int, fastest: float) -> dict[str, Any]:
    """Return a panel for the page: numbers as 16 bits of their range in the panel, base64."""
    lines = [_thinned(line, stride) for line in panel.lines]
    places = [x.position if panel.ring_length is None else x.position % panel.ring_length for x in lines]
    time = _range([line.time for line in lines])
    place = _range(places)
    packed = []
    for line, along in zip(lines, places, strict=True):
        one = {"name": line.name, "marked": line.marked, "time": _bits(line.time, *time)}
        one |= {"place": _bits(along, *place), "speed": _bits(line.speed, 0.0, fastest)}
        packed.append(one | {"breaks": (np.flatnonzero(~line.whole(panel.ring_length)) + 1).tolist()})
    offsets, names = axes_of(panel, together)
    return {"title": panel.title, "time": time, "place": place, "vehicles": packed, "offsets": offsets, "names": names}


def _bits(values: np.ndarray, low: float, high: float) -> str:
    share = np.clip((values - low) / (high - low), 0.0, 1.0)
    return base64.b64encode((65535 * np.nan_to_num(share)).round().astype("<u2").tobytes()).decode()


def _range(arrays: Sequence[np.ndarray]) -> tuple[float, float]:
    low, high = min(float(a.min()) for a in arrays), max(float(a.max()) for a in arrays)
    return low, high if high > low else low + 1.0


def _fastest(pictures: Sequence[Panel]) -> float:
    """Return the end of the colours' scale (m/s): nearly the fastest, so that a few samples do not set it."""
    speeds = np.concatenate([np.zeros(1), *(line.speed for panel in pictures for line in panel.lines)])
    finite = speeds[np.isfinite(speeds)]
    return float(np.percentile(finite, 99.5)) or float(finite.max()) or 1.0


def _stride(pictures: Sequence[Panel], most: int) -> int:
    return max(1, -(-sum(panel.points for panel in pictures) // most))


def _thinned(line: VehicleLine, stride: int) -> VehicleLine:
    if stride == 1 or len(line.time) < 3:
        return line
    index = np.unique(np.append(np.arange(0, len(line.time), stride), len(line.time) - 1))
    return VehicleLine(line.name, line.time[index], line.position[index], line.speed[index], line.marked)


def _changes(values: np.ndarray) -> np.ndarray:
    """Return [N]: where a value differs from the one before; the first one does."""
    return np.concatenate([np.ones(min(1, len(values)), bool), values[1:] != values[:-1]])
