"""Pictures: a live view of rings and lanes with pygame; space-time diagrams are in ``reports/diagrams.py``."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

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
"""How far from the agent one sees in the window around it (m): so much is drawn to scale."""
_TOP, _EDGE, _BELOW = 72, 15, 54
"""Where the first road is drawn, the ground on both sides of it, and between two roads (pixels)."""
FRAMES = 10
"""Pictures a second in a window."""
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
_Point = tuple[float, float]
_Values = dict[str, np.ndarray]
_CHANGE_SHOWN = 1.0
"""How long a line shows that a vehicle has changed lanes (s)."""


def colour(speed: float, fastest: float) -> tuple[int, int, int]:
    """Return the colour of a speed: red at standstill, over yellow, to green at ``fastest`` and above."""
    place = min(max(speed / fastest, 0.0), 1.0) * (len(COLOURS) - 1)
    red, green, blue = (int(np.interp(place, range(len(COLOURS)), COLOURS[:, k])) for k in range(3))
    return red, green, blue


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


def _read(task: Task, state: State, row: int) -> _Values:
    """Return the numbers of one row of a state that a picture takes: vehicles, lanes (0 on top), lap (m), time (s)."""
    names = ("position", "speed", "gap", "length")
    values = {name: getattr(state, name)[row].detach().cpu().numpy().astype(float) for name in names}
    present, lanes, outline = state.present, state.lanes, task.road.outline
    values["present"] = np.ones(task.vehicles) if present is None else present[row].detach().cpu().numpy().copy()
    # The left lane is on top, as seen by drivers who go to the right.
    values["lane"] = np.array(task.lanes)
    if lanes is not None and outline is not None:
        values["lane"] = len(outline.lanes) - 1 - lanes.lane[row].cpu().numpy()
    lap = task.road.lap(state)
    values["lap"] = np.array(math.nan if lap is None else float(lap.expand(len(state.speed))[row]))
    values["time"] = np.array(float(state.step.expand(len(state.speed))[row]) * task.simulator.dt)
    return values


def _interpolated(before: _Values, after: _Values, share: float) -> _Values:
    """Interpolate two steps linearly; vehicles are present where they are at both."""
    values = {name: x + share * (after[name] - x) for name, x in before.items()}
    return values | {"present": before["present"] * after["present"]}


def _crashed(values: _Values) -> np.ndarray:
    """Return which vehicles touch the one ahead."""
    return np.asarray((values["gap"] <= 0.0) & (values["present"] > 0))


def _marks(task: Task, now: float, row: int, params: Params) -> list[Mark]:
    """Return the marks on the road of one row at a time (s)."""
    marks: list[Mark] = []
    for effect in task.simulator.effects if params else ():
        own = params[effect.name].items()
        marks += effect.marks(now, {name: (x[row] if x.dim() else x).detach().reshape(-1)[0] for name, x in own})
    return marks


class _View(NamedTuple):
    """What is shown of a road, below ``top`` (pixels): from ``back`` to ``front`` (m), lanes so many pixels wide."""

    back: float
    front: float
    lanes: int
    lane: float
    top: float = _TOP

    @property
    def scale(self) -> float:
        return (WIDE - 2 * _EDGE) / (self.front - self.back)

    @property
    def bottom(self) -> float:
        """Where the road ends below (pixels)."""
        return self.top + self.lanes * self.lane

    def x(self, position: float) -> float:
        """Return the pixel of a position (m)."""
        return WIDE - _EDGE - (self.front - position) * self.scale

    def y(self, lane: float) -> float:
        """Return the pixel of a lane's middle; lane 0 is on top."""
        return self.top + (lane + 0.5) * self.lane


def _views(task: Task, values: _Values, ego: int) -> list[_View]:
    """Return the whole of a road that ends, and a window around the ego; else all vehicles, or a window."""
    outline, place, on_road = task.road.outline, values["position"], values["present"] > 0
    lanes = min(max(task.lanes) + 1, _MOST_LANES) if outline is None else len(outline.lanes)
    middle, wide = float(place[ego]), _LANE_PIXELS[1]
    if outline is not None and outline.length is not None:
        pixels = LANE_M * (WIDE - 2 * _EDGE) / outline.length
        whole = _View(0.0, outline.length, lanes, float(np.clip(pixels, *_LANE_PIXELS)))
        middle = min(max(middle, _NEAR), max(outline.length - _NEAR, _NEAR))
        return [whole, _View(middle - _NEAR, middle + _NEAR, lanes, wide, whole.bottom + _BELOW)]
    if outline is None and on_road.any():
        back, front = float((place - values["length"])[on_road].min()), float(place[on_road].max())
        if front - back < 4.0 * _NEAR:
            return [_View(min(back, front - 2.0 * _NEAR), front, lanes, wide)]
    return [_View(middle - _NEAR, middle + _NEAR, lanes, wide)]


class Viewer:
    """Draws one environment to scale: vehicles coloured by speed, agents framed in blue, crashes marked by a cross.

    ``mode`` is ``"rgb_array"`` or ``"rgb_array_list"`` (pictures are returned; no display is needed) or ``"human"`` (a
    window; without a display it is drawn into memory).
    """

    def __init__(self, mode: str) -> None:
        self._pygame, self._mode = _pygame(), mode
        self._window: Any = None
        self._clock: Any = None
        self._last: _Values | None = None
        self._ego = 0
        self._changes: dict[int, tuple[int, float]] = {}
        self._pygame.font.init()
        self._font, self._small = (self._pygame.font.Font(None, size) for size in (24, 20))

    def show(self, task: Task, state: State, row: int = 0, params: Params | None = None) -> Any:
        """Return the picture of one row of a state as ``(height, width, 3)`` uint8, or show it in the window.

        In mode ``"rgb_array_list"`` it is a list of those since the last one, ten a second where an action is held for
        longer. With the ``params`` of its episodes, what stands on the road is drawn, too.
        """
        values, params = _read(task, state, row), params or {}
        before, self._last = self._last, values
        self._watch(before, values)
        self._look(task, values["present"], values["position"])
        frames, moments = max(1, round(FRAMES * task.step_time)), [values]
        held = before is not None and abs(values["time"] - before["time"] - task.step_time) < 1e-3
        if before is not None and held and self._mode != "rgb_array":
            moments = [_interpolated(before, values, k / frames) for k in range(1, frames)] + moments
        pictures = [self._picture(task, each, row, params) for each in moments]
        if self._mode == "human":
            for each in pictures:
                self._display(each, frames / task.step_time)
            return None
        arrays = [np.transpose(self._pygame.surfarray.array3d(each), (1, 0, 2)).copy() for each in pictures]
        return arrays if self._mode == "rgb_array_list" else arrays[-1]

    def _picture(self, task: Task, values: _Values, row: int, params: Params) -> Any:
        """Return a surface with the roads, what stands on them, and the legend."""
        outline, lap = task.road.outline, float(values["lap"])
        if outline is None and lap > 0.0:
            canvas = self._pygame.Surface((SIZE, SIZE))
            canvas.fill(_GROUND)
            self._ring(canvas, task, values)
            self._legend(canvas, task, values, None, ())
            return canvas
        if lap > 0.0:
            own = values["position"][self._ego]
            values = {**values, "position": own + (values["position"] - own + 0.5 * lap) % lap - 0.5 * lap}
        views, marks = _views(task, values, self._ego), _marks(task, float(values["time"]), row, params)
        canvas = self._pygame.Surface((WIDE, 2 * math.ceil(0.5 * (views[-1].bottom + 34))))
        canvas.fill(_GROUND)
        for view in views:
            self._lane(canvas, task, values, view, marks)
        if len(views) > 1:
            left, right, y = views[0].x(views[1].back), views[0].x(views[1].front), views[0].top
            self._pygame.draw.lines(canvas, _MARK, False, [(left, y), (left, y - 5), (right, y - 5), (right, y)])
        self._legend(canvas, task, values, views[0], marks)
        return canvas

    def _look(self, task: Task, present: np.ndarray, position: np.ndarray) -> None:
        """Keep the agent in the middle of the window while it is there; then take the last one on the road."""
        agents = [i for i in task.agents if present[i] > 0]
        if agents and self._ego not in agents:
            self._ego = task.agents[0] if len(agents) == len(task.agents) else min(agents, key=lambda i: position[i])

    def _watch(self, before: _Values | None, values: _Values) -> None:
        """Keep the lane that each vehicle has left in the last second, and the time (s)."""
        now, lane = float(values["time"]), values["lane"]
        self._changes = {i: x for i, x in self._changes.items() if 0.0 <= now - x[1] <= _CHANGE_SHOWN}
        if before is not None:
            for i in np.flatnonzero(np.abs(lane - before["lane"]) == 1):
                self._changes[int(i)] = int(before["lane"][i]), now

    def _ring(self, canvas: Any, task: Task, values: _Values) -> None:
        circumference = float(values["lap"])
        radius, middle, level = 0.38 * SIZE, 0.5 * SIZE, 0.53 * SIZE  # below the legend
        pixels = 2.0 * math.pi * radius / circumference
        lane = max(LANE_M * pixels, 18.0)

        def place(position: float, away: float = 0.0) -> tuple[_Point, float]:
            angle = 2.0 * math.pi * (position % circumference) / circumference
            far = radius + away
            return (middle + far * math.cos(angle), level - far * math.sin(angle)), angle

        self._pygame.draw.circle(canvas, _ASPHALT, (middle, level), radius + 0.5 * lane, round(lane))
        step = next((m for m in _TICKS_M if m * pixels > 80.0), _TICKS_M[-1])
        for post in np.arange(0.0, circumference - 0.3 * step, step):
            ends = [place(post, 0.5 * lane + away)[0] for away in (2.0, 8.0)]
            self._pygame.draw.line(canvas, _INK, *ends)
            self._text(canvas, f"{post:.0f} m", place(post, 0.5 * lane + 24.0)[0])
        tip, ends = place(0.26 * circumference, -30.0)[0], [place(0.24 * circumference, x)[0] for x in (-35.0, -25.0)]
        self._pygame.draw.polygon(canvas, _INK, [tip, *ends])
        for i, (position, length) in enumerate(zip(values["position"], values["length"], strict=True)):
            centre, angle = place(position - 0.5 * length)
            size = length * pixels, VEHICLE_M / LANE_M * lane
            fill = colour(values["speed"][i], 10.0)
            self._vehicle(canvas, centre, angle + 0.5 * math.pi, size, fill, i in task.agents)
        for position in values["position"][_crashed(values)]:
            self._crash(canvas, place(position)[0])

    def _lane(self, canvas: Any, task: Task, values: _Values, view: _View, marks: Sequence[Mark]) -> None:
        draw = self._pygame.draw
        outline = task.road.outline
        lap, length = (None, None) if outline is None else (outline.ring, outline.length)
        for lane in range(view.lanes):
            first, last, stops = view.back - 1e4, view.front + 1e4, math.inf
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
        step = next((m for m in _TICKS_M if m * view.scale > 70.0), _TICKS_M[-1])
        for post in np.arange(step * math.ceil(view.back / step), view.front + 1e-6, step):
            x = view.x(post)
            draw.line(canvas, _INK, (x, view.bottom + 3), (x, view.bottom + 9))
            self._text(canvas, f"{post if lap is None else post % lap:.0f} m", (x, view.bottom + 20))
        for standing in marks:
            self._stands(canvas, standing, view)
        if length is not None:  # nobody is seen where there is no road
            begin, end = max(view.x(0.0), 0.0), min(view.x(length), float(WIDE))
            canvas.set_clip((begin, 0, end - begin, canvas.get_height()))
        for i in np.flatnonzero(values["present"] > 0):
            x = view.x(values["position"][i] - 0.5 * values["length"][i])
            y = view.y(values["lane"][i] % view.lanes)
            size = values["length"][i] * view.scale, VEHICLE_M / LANE_M * view.lane
            if int(i) in self._changes:  # a line from the lane that it has left
                draw.line(canvas, _CHANGE, (x, view.y(self._changes[int(i)][0])), (x, y), 3)
            self._vehicle(canvas, (x, y), 0.0, size, colour(values["speed"][i], 30.0), i in task.agents)
        for i in np.flatnonzero(_crashed(values)):
            self._crash(canvas, (view.x(values["position"][i]), view.y(values["lane"][i] % view.lanes)))
        canvas.set_clip(None)

    def _stands(self, canvas: Any, mark: Mark, view: _View) -> None:
        """Draw a stretch that is closed, or a line: in red where one must stop, else in green."""
        top, bottom = view.top, view.bottom
        if mark.lane is not None:
            middle = view.y(view.lanes - 1 - mark.lane)
            top, bottom = middle - 0.5 * view.lane, middle + 0.5 * view.lane
        left, right = (min(max(view.x(m), 0.0), float(WIDE)) for m in (mark.begin, mark.end))
        if right > left:
            self._pygame.draw.rect(canvas, _CLOSED, (left, top, right - left, bottom - top))
        if view.back <= mark.begin <= view.front:
            self._pygame.draw.line(canvas, _STOP if mark.stops else _PASS, (left, top), (left, bottom), 4)
            if mark.begin == mark.end:
                self._head(canvas, (left, view.top - 10.0), mark.stops)

    def _head(self, canvas: Any, place: _Point, stops: bool) -> None:
        """Draw a signal: its red lamp is on the left, its green one on the right."""
        self._pygame.draw.rect(canvas, _INK, (place[0] - 11, place[1] - 7, 22, 14))
        for side, lit, on in ((-5, _STOP, stops), (5, _PASS, not stops)):
            self._pygame.draw.circle(canvas, lit if on else _ASPHALT, (place[0] + side, place[1]), 4)

    def _crash(self, canvas: Any, place: _Point) -> None:
        """Draw a cross where two vehicles touch."""
        self._pygame.draw.circle(canvas, _CRASH, place, 11)
        self._pygame.draw.circle(canvas, _INK, place, 11, 2)
        self._text(canvas, "X", place)

    def _text(self, canvas: Any, words: str, place: _Point, left: float = 0.5) -> float:
        """Write small words, a share of them ``left`` of a place, within the picture; return where the next begin."""
        image = self._small.render(words, True, _INK)
        wide = float(image.get_width())
        x = min(max(place[0] - left * wide, 2.0), canvas.get_width() - wide - 2.0)
        canvas.blit(image, (x, place[1] - 0.5 * image.get_height()))
        return x + wide + 20.0

    def _vehicle(self, canvas: Any, centre: _Point, heading: float, size: _Point, fill: Any, marked: bool) -> None:
        """Draw a vehicle of a length and a width (pixels) in a colour; a controlled one has a frame."""
        c, s = math.cos(heading), -math.sin(heading)
        for more, paint in ((3.0, _MARK), (0.0, fill))[not marked :]:
            half, side = max(0.5 * size[0], 2.0) + more, max(0.5 * size[1], 2.0) + more
            corners = [(-half, -side), (half, -side), (half, side), (-half, side)]
            points = [(centre[0] + x * c - y * s, centre[1] + x * s + y * c) for x, y in corners]
            self._pygame.draw.polygon(canvas, paint, points)
        self._pygame.draw.polygon(canvas, _INK, points, 1)

    def _legend(self, canvas: Any, task: Task, values: _Values, view: _View | None, marks: Sequence[Mark]) -> None:
        on_road, draw, fastest = values["present"] > 0, self._pygame.draw, 10.0 if view is None else 30.0
        mean = float(values["speed"][on_road].mean()) if on_road.any() else 0.0
        crash = "   crash" if _crashed(values).any() else ""
        text = f"{task.name}   t = {float(values['time']):.1f} s   mean speed {mean:.1f} m/s{crash}"
        canvas.blit(self._font.render(text, True, _INK), (12, 10))
        level, width = 40, 120
        for x in range(12, 12 + width):
            draw.line(canvas, colour((x - 12) / width * fastest, fastest), (x, level - 4), (x, level + 4))
        after = self._text(canvas, f"0 to {fastest:.0f} m/s", (width + 20, level), 0.0)
        self._vehicle(canvas, (after + 10, level), 0.0, (18, 8), colour(5.0, 10.0), True)
        after = self._text(canvas, "agent", (after + 30, level), 0.0)
        for mark in marks:
            if mark.begin == mark.end:
                self._head(canvas, (after + 11, level), mark.stops)
                after = self._text(canvas, "traffic light", (after + 30, level), 0.0)
        kinds = [("closed", _CLOSED)] * any(mark.begin < mark.end for mark in marks)
        for name, fill in kinds + [("lane change", _CHANGE)] * bool(self._changes):
            draw.rect(canvas, fill, (after, level - 4, 18, 8))
            after = self._text(canvas, name, (after + 26, level), 0.0)
        if view is None:
            return
        draw.polygon(canvas, _INK, [(after, level - 5), (after + 16, level), (after, level + 5)])
        after = self._text(canvas, "direction of travel", (after + 24, level), 0.0)
        if (wider := view.lane / (LANE_M * view.scale)) >= 1.5:
            self._text(canvas, f"widths above: × {wider:.0f}", (after, level), 0.0)

    def _display(self, canvas: Any, fps: float) -> None:
        pygame = self._pygame
        if self._window is None:
            display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
            if sys.platform.startswith("linux") and not display:
                os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
            pygame.display.init()
            self._window = pygame.display.set_mode(canvas.get_size())
            pygame.display.set_caption("idm-env")
            self._clock = pygame.time.Clock()
        self._window.blit(canvas, (0, 0))
        pygame.event.pump()
        pygame.display.flip()
        if os.environ.get("SDL_VIDEODRIVER") != "dummy":
            self._clock.tick(fps)

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._pygame.display.quit()
            self._window = None
