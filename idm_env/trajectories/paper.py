"""The recipe as published: five IDM parameters and an imagined leader per step, by Adam on the mean absolute error.

Son et al. 2024. Per trajectory: p(0) is the first point, v(0) comes from the first two; initial parameters a, b, T, s0,
v0 = 10, 2, 1, 5, 50 within [5, 10], [0.1, 5], [0.1, 5], [1, 10], [20, 60]; imagined gap 10 m and closing speed 0 at
first; braking at most 10 m/s²; 500 steps of Adam, learning rate linearly from 0.1 to 0.01; the smooth equations
(sharpness 1), explicit Euler, steps of 0.1 s for filtering and 1 s for reconstruction. The paper states no bounds for
the imagined inputs: here the gap stays in [1, 10 000] m and the closing speed in [−100, 100] m/s, and all values are
put back into their bounds after every step.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor

from idm_env.effects import IDM, Brakes, ImaginedLeader
from idm_env.effects.base import Effect, P
from idm_env.roads import Lane
from idm_env.simulator import Simulator, Trajectory
from idm_env.trajectories.scores import RegularMotion
from idm_env.trajectories.tracks import TrackPiece, clock_of
from idm_env.types import Imagined, Neighbour, Scene

NAMES = ("max_accel", "comfort_decel", "time_gap", "min_gap", "desired_speed")
START = np.array([10.0, 2.0, 1.0, 5.0, 50.0])
LOW = np.array([5.0, 0.1, 0.1, 1.0, 20.0])
HIGH = np.array([10.0, 5.0, 5.0, 10.0, 60.0])
FIVE = torch.as_tensor(LOW), torch.as_tensor(HIGH)
GAP_BOUNDS = (1.0, 1e4)
CLOSING_BOUNDS = (-100.0, 100.0)
MAX_DECEL = 10.0
ITERATIONS = 500
RATES = (0.1, 0.01)
FILTER_STEP_S, RECONSTRUCT_STEP_S = 0.1, 1.0
NEAREST_M = 0.1
"""A real leader is never nearer than this (m)."""
TOGETHER = 300_000
"""Steps of all tracks that are fitted at a time (some 50 MB); they share nothing but the loop."""


class Ahead(NamedTuple):
    """Input of ``RealLeader``: a leader's rear bumper (m) and speed (m/s)."""

    rear: Tensor
    speed: Tensor


@dataclass(frozen=True)
class RealLeader(Effect):
    """A leader whose motion is given, never nearer than ``NEAREST_M``: 1/s² has no other floor as published."""

    kind: ClassVar[str] = "real_leader"
    takes: ClassVar[type | None] = Ahead

    def perceive(self, scene: Scene, p: P) -> Scene:
        """Return the scene with the given leader."""
        ahead: Ahead = scene.input(self.name)
        gap = (ahead.rear - scene.position).clamp_min(NEAREST_M)
        present = torch.ones_like(scene.leader.present)
        return scene._replace(leader=Neighbour(gap, ahead.speed, torch.zeros_like(ahead.speed), present))


@dataclass(frozen=True, eq=False)
class Imitated:
    """Result for one track: motion [K], the five values, imagined gap [K] (m), final loss."""

    motion: RegularMotion
    values: np.ndarray
    gap: np.ndarray
    loss: float


def imitate(
    tracks: Sequence[TrackPiece],
    dt: float = FILTER_STEP_S,
    *,
    iterations: int = ITERATIONS,
    fixed_parameters: bool = False,
) -> list[Imitated]:
    """Fit each track by the published recipe; a data point is compared at the simulation step nearest in time.

    ``fixed_parameters`` keeps the five at their initial values (the paper's ablation).
    """
    clocks = [clock_of(track, dt) for track in tracks]
    by_length = sorted(range(len(tracks)), key=lambda i: len(clocks[i]))
    fits: dict[int, Imitated] = {}
    while by_length:
        # The longest one left, and as many of like length as fit beside it.
        many = max(TOGETHER // len(clocks[by_length[-1]]), 1)
        some, by_length = by_length[-many:], by_length[:-many]
        done = _imitated([tracks[i] for i in some], [clocks[i] for i in some], dt, iterations, fixed_parameters)
        fits.update(zip(some, done, strict=True))
    return [fits[i] for i in range(len(tracks))]


def _imitated(
    tracks: Sequence[TrackPiece], clocks: Sequence[np.ndarray], dt: float, iterations: int, fixed: bool
) -> list[Imitated]:
    targets = [track.position_m - track.position_m[0] for track in tracks]
    steps = [
        np.clip(np.round((track.time_s - clock[0]) / dt).astype(np.int64), 0, len(clock) - 1)
        for track, clock in zip(tracks, clocks, strict=True)
    ]
    speed0 = [max(0.0, x[1] / (track.time_s[1] - track.time_s[0])) for x, track in zip(targets, tracks, strict=True)]
    gap = torch.full((max(len(clock) for clock in clocks), len(tracks), 1), 10.0, dtype=torch.float64)
    ahead = Imagined(gap, torch.zeros_like(gap))
    values = torch.as_tensor(START).repeat(len(tracks), 1)
    free = [(ahead.gap, *GAP_BOUNDS), (ahead.closing_speed, *CLOSING_BOUNDS)]
    course = _Course(ImaginedLeader(), ahead, speed0, dt)
    driven = course.fit(values, free if fixed else [(values, *FIVE), *free], steps, targets, iterations)
    position, speed, accel = (x[..., 0].numpy() for x in driven[:3])
    fits = []
    for i, (track, clock) in enumerate(zip(tracks, clocks, strict=True)):
        own = slice(0, len(clock))
        loss = float(np.abs(position[steps[i], i] - targets[i]).mean())
        # The acceleration of a step starts at its own speed.
        columns = position[own, i] + track.position_m[0], speed[own, i], accel[1:][own, i]
        fits.append(Imitated(RegularMotion(clock, *columns), values[i].numpy(), gap[own, i, 0].numpy(), loss))
    return fits


class Followed(NamedTuple):
    """What a driver did behind a leader, every so many seconds [K], and at first.

    ``position`` (m) is the front bumper's, ``rear`` (m) the leader's rear bumper, ``pace`` (m/s) the leader's speed,
    ``speed0`` (m/s) the driver's first one.
    """

    position: np.ndarray
    speed0: float
    rear: np.ndarray
    pace: np.ndarray


def follow(drivers: Sequence[Followed], dt: float, iterations: int = ITERATIONS) -> np.ndarray:
    """Return the five values [N, 5] of drivers, fitted to their positions every ``dt`` (s) by the same optimisation.

    This is the recipe of prediction: nothing is imagined.
    """
    most, values = max(len(each.pace) for each in drivers), torch.as_tensor(START).repeat(len(drivers), 1)
    columns = [(each.rear - each.position[0], each.pace) for each in drivers]
    ahead = _leader_input([[np.pad(x, (0, most - len(x)), "edge") for x in pair] for pair in columns])
    steps, targets = zip(*((np.arange(len(x)), x - x[0]) for x in (each.position for each in drivers)), strict=True)
    course = _Course(RealLeader(), ahead, [each.speed0 for each in drivers], dt)
    course.fit(values, [(values, *FIVE)], steps, targets, iterations)
    return values.numpy()


def drive(values: np.ndarray, speed0: float, rear_m: np.ndarray, pace: np.ndarray, dt: float) -> np.ndarray:
    """Return the distances [K] that the five values drive from 0 at ``speed0``, behind a leader as in ``Followed``."""
    course = _Course(RealLeader(), _leader_input([(rear_m, pace)]), [speed0], dt)
    return course.motion(torch.as_tensor(values)[None]).position[:-1, 0, 0].numpy()


def _leader_input(leaders: Sequence[Sequence[np.ndarray]]) -> Ahead:
    """Return the input of rears and paces, each [K], of several leaders."""
    return Ahead(*(torch.as_tensor(np.stack(columns, axis=1))[..., None] for columns in zip(*leaders, strict=True)))


class _Course:
    """Drivers (rows) behind one kind of leader, whose input ``ahead`` (steps, rows, 1) may be moved, too."""

    def __init__(self, leader: Effect, ahead: Imagined | Ahead, speed0: Sequence[float], dt: float) -> None:
        self._simulator = Simulator(Lane(), (IDM(sharpness=1.0), leader, Brakes(sharpness=1.0)), dt, "euler")
        self._params: Any = self._simulator.defaults(dtype=torch.float64)
        self._params["brakes"]["max_decel"] = torch.tensor(MAX_DECEL, dtype=torch.float64)
        speed = torch.tensor(speed0, dtype=torch.float64)[:, None]
        self._state = self._simulator.state(torch.zeros_like(speed), speed, self._params)
        self._inputs, self._steps = {leader.name: ahead}, len(ahead[0])

    def motion(self, values: Tensor) -> Trajectory:
        """Return the motion of drivers with these values [N, 5], (steps + 1, rows, 1), the start first."""
        params = {**self._params, "idm": dict(zip(NAMES, values.T[..., None], strict=True))}
        _, later = self._simulator.rollout(self._state, self._inputs, params, self._steps)
        first = (getattr(self._state, name) for name in Trajectory._fields)
        return Trajectory(*(torch.cat((x[None], y)) for x, y in zip(first, later, strict=True)))

    def fit(
        self, values: Tensor, free: Sequence[tuple[Tensor, Any, Any]], steps: Sequence[np.ndarray],
        targets: Sequence[np.ndarray], iterations: int,
    ) -> Trajectory:  # fmt: skip
        """Move tensors that are ``free`` between bounds, in place, so that distances at ``steps`` near ``targets``."""
        sizes = [len(x) for x in steps]
        place = torch.as_tensor(np.concatenate(steps)), torch.as_tensor(np.repeat(np.arange(len(steps)), sizes))
        target = torch.as_tensor(np.concatenate(targets))
        weight = torch.as_tensor(np.repeat([1.0 / size for size in sizes], sizes))
        adam = torch.optim.Adam([x.requires_grad_() for x, _, _ in free])
        for turn in range(iterations):
            adam.param_groups[0]["lr"] = RATES[0] + (RATES[1] - RATES[0]) * turn / iterations
            adam.zero_grad()
            apart = self.motion(values).position[..., 0][place] - target
            (weight * apart.abs()).sum().backward()
            adam.step()
            with torch.no_grad():
                for x, low, high in free:
                    x.clamp_(low, high)
        for x, _, _ in free:
            x.requires_grad_(False)
        return self.motion(values)
