"""Pictures: a live view of rings and lanes with pygame, and space-time diagrams with matplotlib."""

from __future__ import annotations

import math
import os
import sys
from typing import TYPE_CHECKING, Any

import numpy as np

from idm_env.types import State

if TYPE_CHECKING:
    from idm_env.tasks import Task

SIZE = 600
"""Width, and on a ring also height, of a picture (pixels)."""
_LANE_HEIGHT = 200
_MOST_LANES = 8
"""Lanes beyond these are drawn over the first ones again."""
_ASPHALT, _GROUND, _INK, _MARK = (70, 74, 82), (244, 243, 238), (30, 32, 36), (30, 90, 220)
_COLOURS = np.array([(178, 24, 43), (239, 138, 98), (253, 219, 120), (120, 190, 110), (26, 120, 80)], float)


def colour(speed: float, fastest: float) -> tuple[int, int, int]:
    """Return the colour of a speed: red at standstill, over yellow, to green at ``fastest`` and above."""
    x = min(max(speed / fastest, 0.0), 1.0) * (len(_COLOURS) - 1)
    left = min(int(x), len(_COLOURS) - 2)
    mixed = _COLOURS[left] + (x - left) * (_COLOURS[left + 1] - _COLOURS[left])
    return int(mixed[0]), int(mixed[1]), int(mixed[2])


def _pygame() -> Any:
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    try:
        import pygame
    except ImportError:
        raise ImportError("rendering needs pygame-ce. Install it with: pip install 'idm-env[render]'") from None
    return pygame


class Viewer:
    """Draws one environment: vehicles coloured by speed, controlled ones outlined in blue with a dot.

    ``mode`` is ``"rgb_array"`` (a picture is returned; no display is needed) or ``"human"`` (a window; without a
    display it is drawn into memory).
    """

    def __init__(self, mode: str, fps: int) -> None:
        self._pygame = _pygame()
        self._mode = mode
        self._fps = fps
        self._window: Any = None
        self._clock: Any = None
        self._pygame.font.init()
        self._font = self._pygame.font.Font(None, 22)

    def show(self, task: Task, state: State, row: int = 0) -> np.ndarray | None:
        """Return the picture of one row of a state as ``(height, width, 3)`` uint8, or show it in the window."""
        ring = task.name == "ring"
        lanes = min(max(task.lanes) + 1, _MOST_LANES)
        canvas = self._pygame.Surface((SIZE, SIZE if ring else _LANE_HEIGHT + 40 * (lanes - 1)))
        canvas.fill(_GROUND)
        values = {
            name: getattr(state, name)[row].detach().cpu().double().numpy()
            for name in ("position", "speed", "gap", "length")
        }
        everybody = np.ones(task.vehicles)
        values["present"] = everybody if state.present is None else state.present[row].detach().cpu().numpy()
        fastest = 10.0 if ring else 30.0
        (self._ring if ring else self._lane)(canvas, task, values, fastest)
        self._legend(canvas, task, state, row, values, fastest)
        if self._mode == "human":
            self._display(canvas)
            return None
        return np.transpose(self._pygame.surfarray.array3d(canvas), (1, 0, 2)).copy()

    def _ring(self, canvas: Any, task: Task, values: dict[str, np.ndarray], fastest: float) -> None:
        circumference = float((values["gap"] + values["length"]).sum())
        radius, middle = 0.38 * SIZE, 0.5 * SIZE
        self._pygame.draw.circle(canvas, _ASPHALT, (middle, middle), radius + 13, 26)
        for i, (position, length) in enumerate(zip(values["position"], values["length"], strict=True)):
            angle = 2.0 * math.pi * ((position - 0.5 * length) % circumference) / circumference
            centre = middle + radius * math.cos(angle), middle - radius * math.sin(angle)
            along = 2.0 * math.pi * radius * length / circumference
            self._vehicle(canvas, centre, angle + 0.5 * math.pi, along, values["speed"][i], fastest, i in task.agents)

    def _lane(self, canvas: Any, task: Task, values: dict[str, np.ndarray], fastest: float) -> None:
        there = values["present"] > 0
        lanes = min(max(task.lanes) + 1, _MOST_LANES)
        top = 0.55 * _LANE_HEIGHT
        for lane in range(lanes):
            self._pygame.draw.rect(canvas, _ASPHALT, (0, top + 40 * lane - 13, SIZE, 26))
        height = top + 40 * (lanes - 1)
        if not there.any():
            return
        front = float(values["position"][there].max())
        shown = max(front - float((values["position"] - values["length"])[there].min()), 150.0)
        scale = 0.94 * SIZE / shown
        # Posts stand still on the ground, so that motion can be seen.
        for post in range(math.ceil((front - shown) / 50.0), math.floor(front / 50.0) + 1):
            x = 0.97 * SIZE - (front - 50.0 * post) * scale
            self._pygame.draw.line(canvas, _ASPHALT, (x, height + 17), (x, height + 24), 2)
        for i in np.flatnonzero(there):
            length = values["length"][i]
            x = 0.97 * SIZE - (front - values["position"][i] + 0.5 * length) * scale
            y = top + 40 * (task.lanes[i] % _MOST_LANES)
            self._vehicle(canvas, (x, y), 0.0, length * scale, values["speed"][i], fastest, i in task.agents)

    def _vehicle(
        self,
        canvas: Any,
        centre: tuple[float, float],
        heading: float,
        along: float,
        speed: float,
        fastest: float,
        marked: bool,
    ) -> None:
        c, s = math.cos(heading), -math.sin(heading)
        half, side = max(0.5 * along, 2.0), 6.0
        corners = [(-half, -side), (half, -side), (half, side), (-half, side)]
        points = [(centre[0] + x * c - y * s, centre[1] + x * s + y * c) for x, y in corners]
        self._pygame.draw.polygon(canvas, colour(speed, fastest), points)
        self._pygame.draw.polygon(canvas, _MARK if marked else _INK, points, 3 if marked else 1)
        if marked:
            self._pygame.draw.circle(canvas, _MARK, (centre[0] + 20 * s, centre[1] - 20 * c), 5)

    def _legend(
        self, canvas: Any, task: Task, state: State, row: int, values: dict[str, np.ndarray], fastest: float
    ) -> None:
        there = values["present"] > 0
        mean = float(values["speed"][there].mean()) if there.any() else 0.0
        seconds = float(state.step.expand(len(state.speed))[row]) * task.simulator.dt
        text = f"{task.name}   t = {seconds:.1f} s   mean speed {mean:.1f} m/s"
        canvas.blit(self._font.render(text, True, _INK), (12, 10))
        left, top, width = 12, 34, 120
        for x in range(width):
            self._pygame.draw.line(canvas, colour(x / width * fastest, fastest), (left + x, top), (left + x, top + 8))
        canvas.blit(self._font.render(f"0 to {fastest:.0f} m/s", True, _INK), (left + width + 8, top - 4))

    def _display(self, canvas: Any) -> None:
        pygame = self._pygame
        if self._window is None:
            headless = sys.platform.startswith("linux") and not (
                os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
            )
            if headless:
                os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
            pygame.display.init()
            self._window = pygame.display.set_mode(canvas.get_size())
            pygame.display.set_caption("idm-env")
            self._clock = pygame.time.Clock()
        self._window.blit(canvas, (0, 0))
        pygame.event.pump()
        pygame.display.flip()
        if os.environ.get("SDL_VIDEODRIVER") != "dummy":
            self._clock.tick(self._fps)

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._pygame.display.quit()
            self._window = None


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
    scale = LinearSegmentedColormap.from_list("speed", _COLOURS / 255.0)
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
