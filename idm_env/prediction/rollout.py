"""Many drivers on routes at once, by the simulator: behind a leader, before bends, and up to stop lines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from idm_env.effects import IDM, Brakes, Replay
from idm_env.prediction.lanes import Route
from idm_env.roads import Lane as Road
from idm_env.simulator import Simulator
from idm_env.types import Record

DT = 0.1
CUT_M = 3.0
"""Drivers use about a metre of the lane's width, which adds this to the radius of a right-angled turn (m)."""
AWAY_M = 1e5
"""Where an empty road has its leader (m of arc length)."""
HALTED_MPS = 1.0
"""Slower drivers count as having halted at a stop line (m/s)."""
AT_LINE_M = 6.0
"""… if it is this near (m)."""


@dataclass(frozen=True, eq=False)
class RouteDrivers:
    """Drivers [N]: IDM's five, lateral acceleration accepted in bends (m/s²), distance to a stop (m, inf for none).

    A stop ends ``wait`` seconds after the driver has halted at it, or ``opens`` seconds from now (inf for never).
    ``passing`` in [0, 1] decides who goes around a standing vehicle: those below the share that does.
    """

    max_accel: np.ndarray
    comfort_decel: np.ndarray
    time_gap: np.ndarray
    min_gap: np.ndarray
    desired_speed: np.ndarray
    lateral: np.ndarray
    stop: np.ndarray
    wait: np.ndarray
    opens: np.ndarray
    passing: np.ndarray

    @classmethod
    def joined(cls, parts: Sequence[RouteDrivers]) -> RouteDrivers:
        """Return the drivers of several groups as one."""
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in cls.__dataclass_fields__))


@dataclass(frozen=True, eq=False)
class RouteLeader:
    """The vehicle ahead on a route: rear bumper (m of arc length) and speed (m/s) per step [S + 1].

    ``passed`` is the share of drivers who go around it, which only standing vehicles are.
    """

    rear: np.ndarray
    speed: np.ndarray
    passed: float = 0.0


@dataclass(frozen=True, eq=False)
class Course:
    """Drivers on a route behind a leader, from arc length ``begin`` (m, centre) on."""

    route: Route
    drivers: RouteDrivers
    ahead: RouteLeader
    begin: float


def nobody(steps: int) -> RouteLeader:
    """Return a leader that stands for an empty road: far away, and keeping away."""
    return RouteLeader(np.full(steps + 1, AWAY_M), np.full(steps + 1, 30.0))


def bend_speed(route: Route, lateral: np.ndarray, comfort: np.ndarray) -> np.ndarray:
    """Return the speed [N, M] from which every bend ahead can be taken: √(v_bend² + 2 b d), at every metre (m/s)."""
    bend = np.sqrt(lateral[:, None] * (1.0 / np.maximum(np.abs(route.curvature), 1e-4) + CUT_M))
    step = float(route.length[1] - route.length[0])
    speed = np.minimum(bend, 60.0)
    for k in range(speed.shape[1] - 2, -1, -1):
        speed[:, k] = np.minimum(speed[:, k], np.sqrt(speed[:, k + 1] ** 2 + 2 * comfort * step))
    return speed


def roll(courses: Sequence[Course], speed: float, steps: int, front: float) -> list[np.ndarray]:
    """Drive the drivers [N] of every course from ``speed`` on; return their arc lengths and speeds, [2, S, N] each.

    ``front`` (m) is from the centre to the front bumper. Speeds wanted fall before bends; the leader, or a stop line
    if it is nearer, is replayed. An overlap at the start is taken as bumper to bumper.
    """
    drivers = RouteDrivers.joined([c.drivers for c in courses])
    sizes = [len(c.drivers.stop) for c in courses]
    rows = np.repeat(np.arange(len(courses)), sizes)
    begin = np.array([c.begin for c in courses])[rows]
    spacing = torch.as_tensor(np.array([c.route.length[1] - c.route.length[0] for c in courses])[rows])
    limits = _limits(courses)
    passes = drivers.passing < np.array([c.ahead.passed for c in courses])[rows]
    rear = torch.as_tensor(np.where(passes, AWAY_M, np.stack([c.ahead.rear for c in courses], axis=1)[:, rows]))
    pace = torch.as_tensor(np.where(passes, 30.0, np.stack([c.ahead.speed for c in courses], axis=1)[:, rows]))
    stops = _StopLine(drivers, begin + front)
    line = stops.line
    own = torch.minimum(torch.as_tensor(begin + front), torch.minimum(rear[0], line) - 0.2)
    shift = torch.as_tensor(begin + front) - own
    sim = Simulator(Road(), (IDM(), Replay(), Brakes()), dt=DT)
    params = sim.defaults(dtype=torch.float64)
    names = ("max_accel", "comfort_decel", "time_gap", "min_gap")
    idm = {name: torch.as_tensor(getattr(drivers, name))[:, None] for name in names}
    desired = torch.as_tensor(drivers.desired_speed)
    # IDM brakes without measure above its desired speed: there it is kept to comfortable braking
    gentle = (1.0 + idm["comfort_decel"][:, 0] / idm["max_accel"][:, 0]) ** -0.25
    position = torch.stack([torch.minimum(rear[0], line), own], dim=-1)
    speeds = torch.stack([torch.where(line < rear[0], 0.0, pace[0]), torch.full_like(own, speed)], dim=-1)
    length = torch.tensor([0.0, 2 * front], dtype=torch.float64)
    state = sim.state(position, speeds, params | {"idm": {**params["idm"], **idm}}, length=length)
    active = torch.tensor([True, False]).expand(len(rows), 2)
    motion = torch.empty(2, steps, len(rows), dtype=torch.float64)
    index, nothing = torch.arange(len(rows)), torch.zeros_like(own)
    with torch.no_grad():
        for k in range(steps):
            cell = ((state.position[:, 1] - front) / spacing).round().long().clamp(0, limits.shape[1] - 1)
            now = state.speed[:, 1]
            target = torch.maximum(torch.minimum(desired, limits[index, cell]), now * gentle).clamp_min(0.5)
            line = stops.after(k, state.position[:, 1], now)
            place = torch.stack([torch.minimum(rear[k + 1], line), nothing], dim=-1)
            speeds = torch.stack([torch.where(line < rear[k + 1], 0.0, pace[k + 1]), nothing], dim=-1)
            record = Record(place, speeds, torch.zeros_like(speeds), active)
            state = sim.step(state, {"replay": record}, params | {"idm": {**idm, "desired_speed": target[:, None]}})
            motion[0, k], motion[1, k] = state.position[:, 1] - front + shift, state.speed[:, 1]
    return [part.numpy() for part in motion.split(sizes, dim=-1)]


class _StopLine:
    """The stop line [N] of every driver (m of arc length), which goes away once its stop has ended."""

    def __init__(self, drivers: RouteDrivers, front: np.ndarray) -> None:
        self.line = torch.as_tensor(np.minimum(front + drivers.stop, AWAY_M))
        self._wait, self._opens = torch.as_tensor(drivers.wait), torch.as_tensor(drivers.opens)
        self._halted = torch.zeros_like(self.line)
        self._ends = bool((torch.isfinite(self._wait) | torch.isfinite(self._opens)).any())

    def after(self, step: int, front: Tensor, speed: Tensor) -> Tensor:
        """Return the lines after a step, at which drivers are at ``front`` (m) with ``speed`` (m/s)."""
        if self._ends:
            self._halted += DT * ((speed < HALTED_MPS) & (self.line - front < AT_LINE_M))
            over = ((self._halted > 0) & (self._halted >= self._wait)) | (step * DT >= self._opens)
            self.line = torch.where(over, AWAY_M, self.line)
        return self.line


def _limits(courses: Sequence[Course]) -> Tensor:
    """Return the bend speeds of all courses, [N, M]; beyond the end of a shorter route its last one."""
    tables = [bend_speed(c.route, c.drivers.lateral, c.drivers.comfort_decel) for c in courses]
    most = max(table.shape[1] for table in tables)
    padded = [np.pad(table, [(0, 0), (0, most - table.shape[1])], mode="edge") for table in tables]
    return torch.as_tensor(np.concatenate(padded))
