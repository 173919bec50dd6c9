"""Pictures: a live view of rings and lanes with pygame; space-time diagrams are in ``reports/diagrams.py``."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from idm_env.extras import needed
from idm_env.reports.diagrams import COLOURS, Panel, lane_panels, rollout_panel, space_time
from idm_env.types import Mark, Params, State

if TYPE_CHECKING:
    from idm_env.tasks import Task

__all__ = ["SIZE", "Viewer", "colour", "panels_of", "space_time"]

SIZE, WIDE = 600, 1000
"""Width and height of a ring's picture, and width of a road's (pixels)."""
LANE_M, VEHICLE_M = 3.5, 1.9
"""Widths of a lane and of a vehicle (m)."""
_NEAR = 85.0
"""How far from the agent one sees on a ring of several lanes and on an endless road (m): so much is drawn to scale."""
_TOP, _EDGE = 64, 15
"""Height of what is written above a road, and the ground on both sides of what is shown (pixels)."""
_LANE_PIXELS = 12.0, 20.0
"""A lane's width at least and at most; where the least is more than to scale, the picture says how much."""
_TICKS_M = 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0
_MOST_LANES = 8
"""Lanes beyond these are drawn over the first ones again."""
_ASPHALT, _GROUND, _INK, _MARK = (70, 74, 82), (244, 243, 238), (30, 32, 36), (30, 90, 220)
_CHANGE, _CRASH, _PAINT = (208, 60, 150), (255, 210, 0), (226, 226, 220)
_CLOSED, _STOP, _PASS = (150, 130, 120), (225, 25, 25), (40, 200, 110)
COLOURS_DRAWN = (_ASPHALT, _GROUND, _INK, _MARK, _CHANGE, _CRASH, _PAINT, _CLOSED, _STOP, _PASS)
"""Colours of a picture besides those of speeds (red, green, blue)."""
_CHANGE_SHOWN = 1.0
"""How long an arrow shows that a vehicle has changed lanes (s)."""


def colour(speed: float, fastest: float) -> tuple[int, int, int]:
    """Return the colour of a speed: red at standstill, over yellow, to green at ``fastest`` and above."""
    x = min(max(speed / fastest, 0.0), 1.0) * (len(COLOURS) - 1)
    left = min(int(x), len(COLOURS) - 2)
    mixed = COLOURS[left] + (x - left) * (COLOURS[left + 1] - COLOURS[left])
    return int(mixed[0]), int(mixed[1]), int(mixed[2])


def panels_of(task: Task, states: Sequence[State]) -> list[Panel]:
    """Return the panel of what one environment went through ``(1, vehicles)``, or one for each of several lanes."""
    position, speed = (torch.cat([getattr(state, name) for state in states]) for name in ("position", "speed"))
    motion, lap = states[0]._replace(position=position, speed=speed), task.road.lap(states[0])
    ring = None if lap is None else float(lap.reshape(-1)[0])
    if states[0].lanes is None:
        return [rollout_panel(motion, dt=task.step_time, ring_length=ring, marked=task.agents)]
    lane = torch.cat([state.lanes.lane for state in states if state.lanes is not None])
    present = torch.cat([torch.ones_like(s.speed) if s.present is None else s.present for s in states])
    return lane_panels(motion, lane, present, dt=task.step_time, ring_length=ring, marked=task.agents)


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


def _crashed(values: dict[str, np.ndarray]) -> np.ndarray:
    """Return which vehicles touch the one ahead."""
    return np.asarray((values["gap"] <= 0.0) & (values["present"] > 0))


def _time(task: Task, state: State, row: int) -> float:
    """Return the time of one row of a state (s)."""
    return float(state.step.expand(len(state.speed))[row]) * task.simulator.dt


def _marks(task: Task, state: State, row: int, params: Params) -> list[Mark]:
    """Return what stands on the road of one row of a state."""
    now = _time(task, state, row)
    marks: list[Mark] = []
    for effect in task.simulator.effects if params else ():
        own = params[effect.name].items()
        marks += effect.marks(now, {name: (x[row] if x.dim() else x).detach().reshape(-1)[0] for name, x in own})
    return marks


@dataclass(frozen=True)
class _View:
    """What is shown of a road: from ``back`` to ``front`` (m), ``scale`` pixels a metre, lanes so many pixels wide."""

    back: float
    front: float
    lanes: int
    lane: float

    @property
    def scale(self) -> float:
        return (WIDE - 2 * _EDGE) / (self.front - self.back)

    @property
    def wider(self) -> float:
        """How many times as large widths are drawn as lengths."""
        return self.lane / (LANE_M * self.scale)

    @property
    def bottom(self) -> float:
        """Where the road ends below (pixels)."""
        return _TOP + self.lanes * self.lane

    @property
    def step(self) -> float:
        """Metres between numbers along the road."""
        return next((m for m in _TICKS_M if m * self.scale > 70.0), _TICKS_M[-1])

    def x(self, position: float) -> float:
        """Return the pixel of a position (m)."""
        return WIDE - _EDGE - (self.front - position) * self.scale

    def y(self, lane: int) -> float:
        """Return the pixel of a lane's middle; lane 0 is on top."""
        return _TOP + (lane + 0.5) * self.lane


def _view(task: Task, values: dict[str, np.ndarray], lanes: int) -> _View:
    """Return the whole of a road that ends, else what is around its vehicles, at least 170 m."""
    on_road = values["present"] > 0
    outline = task.road.outline
    if outline is not None and outline.length is not None:
        pixels = LANE_M * (WIDE - 2 * _EDGE) / outline.length
        return _View(0.0, outline.length, lanes, float(np.clip(pixels, *_LANE_PIXELS)))
    if outline is not None:
        middle = float(values["position"][task.agents[0]])
        return _View(middle - _NEAR, middle + _NEAR, lanes, _LANE_PIXELS[1])
    front = float(values["position"][on_road].max()) if on_road.any() else 2.0 * _NEAR
    back = float((values["position"] - values["length"])[on_road].min()) if on_road.any() else 0.0
    return _View(min(back, front - 2.0 * _NEAR), front, lanes, _LANE_PIXELS[1])


class Viewer:
    """Draws one environment to scale: vehicles coloured by speed, agents framed in blue, crashes marked by a cross.

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
        self._font, self._small = (self._pygame.font.Font(None, size) for size in (24, 20))

    def show(self, task: Task, state: State, row: int = 0, params: Params | None = None) -> np.ndarray | None:
        """Return the picture of one row of a state as ``(height, width, 3)`` uint8, or show it in the window.

        With the ``params`` of its episodes, what stands on the road is drawn, too.
        """
        ring = state.lanes is None and task.road.lap(state) is not None
        lane, lanes = np.array(task.lanes), min(max(task.lanes) + 1, _MOST_LANES)
        outline = task.road.outline
        if outline is not None and state.lanes is not None:
            # The left lane is on top, as seen by drivers who go to the right.
            lanes = len(outline.lanes)
            lane = lanes - 1 - state.lanes.lane[row].cpu().numpy()
        values = {
            name: getattr(state, name)[row].detach().cpu().double().numpy()
            for name in ("position", "speed", "gap", "length")
        }
        everybody = np.ones(task.vehicles)
        values["present"] = everybody if state.present is None else state.present[row].detach().cpu().numpy()
        values["lane"] = lane
        self._watch(task, state, row, lane)
        if outline is not None and outline.length is None:
            _around(task, values, outline.ring)
        fastest = 10.0 if ring else 30.0
        view = _view(task, values, lanes)
        canvas = self._pygame.Surface((SIZE, SIZE) if ring else (WIDE, 2 * math.ceil(0.5 * (view.bottom + 34))))
        canvas.fill(_GROUND)
        if ring:
            self._ring(canvas, task, values, fastest)
        else:
            self._lane(canvas, task, values, fastest, view, _marks(task, state, row, params or {}))
        self._legend(canvas, task, state, row, values, fastest, 1.0 if ring else view.wider)
        if self._mode == "human":
            self._display(canvas)
            return None
        return np.transpose(self._pygame.surfarray.array3d(canvas), (1, 0, 2)).copy()

    def _watch(self, task: Task, state: State, row: int, lane: np.ndarray) -> None:
        """Keep who has changed lanes in the last second, and from where."""
        now = _time(task, state, row)
        self._changes = {
            i: (old, since) for i, (old, since) in self._changes.items() if 0.0 <= now - since <= _CHANGE_SHOWN
        }
        if self._lanes is not None and len(self._lanes) == len(lane):
            for i in np.flatnonzero(np.abs(lane - self._lanes) == 1):
                self._changes[int(i)] = int(self._lanes[i]), now
        self._lanes = lane.copy()

    def _ring(self, canvas: Any, task: Task, values: dict[str, np.ndarray], fastest: float) -> None:
        circumference = float((values["gap"] + values["length"]).sum())
        radius, middle, level = 0.38 * SIZE, 0.5 * SIZE, 0.53 * SIZE  # below the legend
        pixels = 2.0 * math.pi * radius / circumference
        lane = max(LANE_M * pixels, 18.0)

        def place(position: float, away: float = 0.0) -> tuple[tuple[float, float], float]:
            angle = 2.0 * math.pi * (position % circumference) / circumference
            far = radius + away
            return (middle + far * math.cos(angle), level - far * math.sin(angle)), angle

        self._pygame.draw.circle(canvas, _ASPHALT, (middle, level), radius + 0.5 * lane, round(lane))
        step = next((m for m in _TICKS_M if m * pixels > 80.0), _TICKS_M[-1])
        for post in np.arange(0.0, circumference - 0.3 * step, step):
            ends = [place(post, 0.5 * lane + away)[0] for away in (2.0, 8.0)]
            self._pygame.draw.line(canvas, _INK, *ends)
            self._text(canvas, f"{post:.0f} m", place(post, 0.5 * lane + 24.0)[0])
        crashed = _crashed(values)
        for i, (position, length) in enumerate(zip(values["position"], values["length"], strict=True)):
            centre, angle = place(position - 0.5 * length)
            size = length * pixels, VEHICLE_M / LANE_M * lane
            self._vehicle(canvas, centre, angle + 0.5 * math.pi, size, values["speed"][i], fastest, i in task.agents)
        for position in values["position"][crashed]:
            self._crash(canvas, place(position)[0])

    def _lane(
        self, canvas: Any, task: Task, values: dict[str, np.ndarray], fastest: float, view: _View,
        marks: Sequence[Mark],
    ) -> None:  # fmt: skip
        draw = self._pygame.draw
        outline = task.road.outline
        lap = None if outline is None else outline.ring
        for lane in range(view.lanes):
            first, last = view.back - 1e4, view.front + 1e4
            stops = math.inf
            if outline is not None and lap is None:
                first, stops, leaves = outline.lanes[-1 - lane]
                last = min(stops, leaves, last)
            left, right = (min(max(view.x(m), 0.0), float(WIDE)) for m in (first, last))
            top = view.y(lane) - 0.5 * view.lane
            draw.rect(canvas, _ASPHALT, (left, top, right - left, view.lane + 1))
            # Marks stand still on the ground, so that motion can be seen.
            for mark in range(math.ceil(view.back / 12.0) - 9, math.floor(view.front / 12.0) + 9) if lane else ():
                ends = [min(max(view.x(12.0 * mark + m), left), right) for m in (0.0, 4.0)]
                draw.line(canvas, _PAINT, *((x, top) for x in ends))
            if stops < view.front:
                draw.line(canvas, _CRASH, (right, top), (right, top + view.lane), 3)
        for post in np.arange(view.step * math.ceil(view.back / view.step), view.front + 1e-6, view.step):
            x = view.x(post)
            draw.line(canvas, _INK, (x, view.bottom + 3), (x, view.bottom + 9))
            self._text(canvas, f"{post if lap is None else post % lap:.0f} m", (x, view.bottom + 20))
        for standing in marks:
            self._stands(canvas, standing, view)
        for i in np.flatnonzero(values["present"] > 0):
            x = view.x(values["position"][i] - 0.5 * values["length"][i])
            y = view.y(int(values["lane"][i]) % view.lanes)
            size = values["length"][i] * view.scale, VEHICLE_M / LANE_M * view.lane
            self._vehicle(canvas, (x, y), 0.0, size, values["speed"][i], fastest, i in task.agents)
            if int(i) in self._changes:
                # An arrow from the lane that it has left.
                before = view.y(self._changes[int(i)][0])
                side = math.copysign(1.0, y - before)
                draw.line(canvas, _CHANGE, (x, before), (x, y - 0.3 * view.lane * side), 3)
                tip = y - 0.1 * view.lane * side
                draw.polygon(canvas, _CHANGE, [(x, tip), (x - 5, tip - 7 * side), (x + 5, tip - 7 * side)])
        for i in np.flatnonzero(_crashed(values)):
            self._crash(canvas, (view.x(values["position"][i]), view.y(int(values["lane"][i]) % view.lanes)))

    def _stands(self, canvas: Any, mark: Mark, view: _View) -> None:
        """Draw a stretch that is closed, or a line: in red where one must stop, else in green."""
        top, bottom = float(_TOP), view.bottom
        if mark.lane is not None:
            middle = view.y(view.lanes - 1 - mark.lane)
            top, bottom = middle - 0.5 * view.lane, middle + 0.5 * view.lane
        left, right = (min(max(view.x(m), 0.0), float(WIDE)) for m in (mark.begin, mark.end))
        if right > left:
            self._pygame.draw.rect(canvas, _CLOSED, (left, top, right - left, bottom - top))
        if view.back <= mark.begin <= view.front:
            self._pygame.draw.line(canvas, _STOP if mark.stops else _PASS, (left, top), (left, bottom), 4)

    def _crash(self, canvas: Any, place: tuple[float, float]) -> None:
        """Draw a cross where two vehicles touch."""
        self._pygame.draw.circle(canvas, _CRASH, place, 11)
        self._pygame.draw.circle(canvas, _INK, place, 11, 2)
        for side in (-1, 1):
            ends = (place[0] - 5, place[1] - 5 * side), (place[0] + 5, place[1] + 5 * side)
            self._pygame.draw.line(canvas, _INK, *ends, 3)

    def _text(self, canvas: Any, words: str, place: tuple[float, float]) -> None:
        """Write small words around a place, within the picture."""
        image = self._small.render(words, True, _INK)
        half = 0.5 * image.get_width()
        x = min(max(place[0], half + 2), canvas.get_width() - half - 2)
        canvas.blit(image, (x - half, place[1] - 0.5 * image.get_height()))

    def _vehicle(
        self, canvas: Any, centre: tuple[float, float], heading: float, size: tuple[float, float], speed: float,
        fastest: float, marked: bool,
    ) -> None:  # fmt: skip
        """Draw a vehicle of a length and a width (pixels) in the colour of its speed; a controlled one has a frame."""
        c, s = math.cos(heading), -math.sin(heading)
        for more, fill in ((3.0, _MARK), (0.0, colour(speed, fastest))) if marked else ((0.0, colour(speed, fastest)),):
            half, side = max(0.5 * size[0], 2.0) + more, max(0.5 * size[1], 2.0) + more
            corners = [(-half, -side), (half, -side), (half, side), (-half, side)]
            points = [(centre[0] + x * c - y * s, centre[1] + x * s + y * c) for x, y in corners]
            self._pygame.draw.polygon(canvas, fill, points)
        self._pygame.draw.polygon(canvas, _INK, points, 1)

    def _legend(
        self, canvas: Any, task: Task, state: State, row: int, values: dict[str, np.ndarray], fastest: float,
        wider: float,
    ) -> None:  # fmt: skip
        on_road = values["present"] > 0
        mean = float(values["speed"][on_road].mean()) if on_road.any() else 0.0
        seconds = _time(task, state, row)
        crash = "   crash" if _crashed(values).any() else ""
        text = f"{task.name}   t = {seconds:.1f} s   mean speed {mean:.1f} m/s{crash}"
        canvas.blit(self._font.render(text, True, _INK), (12, 10))
        left, top, width = 12, 36, 120
        for x in range(width):
            self._pygame.draw.line(canvas, colour(x / width * fastest, fastest), (left + x, top), (left + x, top + 8))
        self._pygame.draw.rect(canvas, _MARK, (left + width + 110, top - 1, 20, 10))
        canvas.blit(self._small.render(f"0 to {fastest:.0f} m/s", True, _INK), (left + width + 8, top - 3))
        label = "agent" + ("" if wider < 1.5 else f"      widths are drawn {wider:.0f} times as large")
        canvas.blit(self._small.render(label, True, _INK), (left + width + 136, top - 3))

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
