"""Pictures: a live view of rings and lanes with pygame; space-time diagrams are in ``reports/diagrams.py``."""

from __future__ import annotations

import math
import os
import sys
from typing import TYPE_CHECKING, Any

import numpy as np

from idm_env.extras import needed
from idm_env.reports.diagrams import COLOURS, space_time
from idm_env.roads import Lanes
from idm_env.types import State

if TYPE_CHECKING:
    from idm_env.tasks import Task

__all__ = ["SIZE", "Viewer", "colour", "space_time"]

SIZE = 600
"""Width, and on a ring also height, of a picture (pixels)."""
_LANE_HEIGHT = 200
_NEAR = 150.0
"""How far from the agent one sees on a ring of several lanes, and on an endless road (m)."""
_MOST_LANES = 8
"""Lanes beyond these are drawn over the first ones again."""
_ASPHALT, _GROUND, _INK, _MARK = (70, 74, 82), (244, 243, 238), (30, 32, 36), (30, 90, 220)
_CHANGE = (208, 60, 150)
COLOURS_DRAWN = (_ASPHALT, _GROUND, _INK, _MARK, _CHANGE)
"""Colours of a picture besides those of speeds (red, green, blue)."""
_CHANGE_SHOWN = 1.0
"""How long an arrow shows that a vehicle has changed lanes (s)."""


def colour(speed: float, fastest: float) -> tuple[int, int, int]:
    """Return the colour of a speed: red at standstill, over yellow, to green at ``fastest`` and above."""
    x = min(max(speed / fastest, 0.0), 1.0) * (len(COLOURS) - 1)
    left = min(int(x), len(COLOURS) - 2)
    mixed = COLOURS[left] + (x - left) * (COLOURS[left + 1] - COLOURS[left])
    return int(mixed[0]), int(mixed[1]), int(mixed[2])


def _pygame() -> Any:
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    with needed("rendering"):
        import pygame
    return pygame


def _around(task: Task, values: dict[str, np.ndarray], ring: float | None) -> None:
    """Leave only what is near the first agent, at places beside it: a whole road would be too small to see."""
    first = values["position"][task.agents[0]]
    away = values["position"] - first
    if ring is not None:
        away = (away + 0.5 * ring) % ring - 0.5 * ring
    values["position"] = first + away
    values["present"] = values["present"] * (np.abs(away) <= _NEAR)


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
        self._lanes: np.ndarray | None = None
        self._changes: dict[int, tuple[int, float]] = {}
        self._pygame.font.init()
        self._font = self._pygame.font.Font(None, 22)

    def show(self, task: Task, state: State, row: int = 0) -> np.ndarray | None:
        """Return the picture of one row of a state as ``(height, width, 3)`` uint8, or show it in the window."""
        ring = task.name == "ring"
        lane, lanes = np.array(task.lanes), min(max(task.lanes) + 1, _MOST_LANES)
        if isinstance(task.road, Lanes) and state.links is not None:
            # The left lane is on top, as seen by drivers who go to the right.
            lane, lanes = task.road.count - 1 - state.links.lane[row].cpu().numpy(), task.road.count
        canvas = self._pygame.Surface((SIZE, SIZE if ring else _LANE_HEIGHT + 40 * (lanes - 1)))
        canvas.fill(_GROUND)
        values = {
            name: getattr(state, name)[row].detach().cpu().double().numpy()
            for name in ("position", "speed", "gap", "length")
        }
        everybody = np.ones(task.vehicles)
        values["present"] = everybody if state.present is None else state.present[row].detach().cpu().numpy()
        values["lane"] = lane
        self._watch(task, state, row, lane)
        if isinstance(task.road, Lanes) and task.road.length is None:
            _around(task, values, task.road.ring)
        fastest = 10.0 if ring else 30.0
        (self._ring if ring else self._lane)(canvas, task, values, fastest)
        self._legend(canvas, task, state, row, values, fastest)
        if self._mode == "human":
            self._display(canvas)
            return None
        return np.transpose(self._pygame.surfarray.array3d(canvas), (1, 0, 2)).copy()

    def _watch(self, task: Task, state: State, row: int, lane: np.ndarray) -> None:
        """Keep who has changed lanes in the last second, and from where."""
        now = float(state.step.expand(len(state.speed))[row]) * task.simulator.dt
        self._changes = {i: (old, at) for i, (old, at) in self._changes.items() if 0.0 <= now - at <= _CHANGE_SHOWN}
        if self._lanes is not None and len(self._lanes) == len(lane):
            for i in np.flatnonzero(np.abs(lane - self._lanes) == 1):
                self._changes[int(i)] = int(self._lanes[i]), now
        self._lanes = lane.copy()

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
        lanes = (canvas.get_height() - _LANE_HEIGHT) // 40 + 1
        top = 0.55 * _LANE_HEIGHT
        height = top + 40 * (lanes - 1)
        road = task.road if isinstance(task.road, Lanes) and task.road.ring is None else None
        front, back = 150.0, 0.0
        if road is not None and road.length is not None:
            front = road.length
        elif there.any():
            front = float(values["position"][there].max())
            back = float((values["position"] - values["length"])[there].min())
        shown = max(front - back, 150.0)
        scale = 0.94 * SIZE / shown
        for lane in range(lanes):
            left, right = 0.0, float(SIZE)
            if road is not None:
                k = road.count - 1 - lane
                ends = min(road.table("stops")[k], road.table("leaves")[k])
                left = 0.97 * SIZE - (front - road.table("begins")[k]) * scale
                right = min(0.97 * SIZE - (front - ends) * scale, right)
            self._pygame.draw.rect(canvas, _ASPHALT, (left, top + 40 * lane - 13, right - left, 26))
        # Posts stand still on the ground, so that motion can be seen.
        for post in range(math.ceil((front - shown) / 50.0), math.floor(front / 50.0) + 1):
            x = 0.97 * SIZE - (front - 50.0 * post) * scale
            self._pygame.draw.line(canvas, _ASPHALT, (x, height + 17), (x, height + 24), 2)
        for i in np.flatnonzero(there):
            length = values["length"][i]
            x = 0.97 * SIZE - (front - values["position"][i] + 0.5 * length) * scale
            y = top + 40 * (int(values["lane"][i]) % lanes)
            if int(i) in self._changes:
                # An arrow from the lane that it has left.
                side = math.copysign(1.0, y - (top + 40 * self._changes[int(i)][0]))
                self._pygame.draw.line(canvas, _CHANGE, (x, y - 34 * side), (x, y - 8 * side), 3)
                tip = [(x, y - 7 * side), (x - 5, y - 16 * side), (x + 5, y - 16 * side)]
                self._pygame.draw.polygon(canvas, _CHANGE, tip)
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
