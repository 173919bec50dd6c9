"""The recipe as published: five IDM parameters and an imagined leader per step, by Adam on the mean absolute error.

Son et al. 2024. Per trajectory: p(0) is the first point, v(0) comes from the first two; initial parameters a, b, T, s0,
v0 = 10, 2, 1, 5, 50 within [5, 10], [0.1, 5], [0.1, 5], [1, 10], [20, 60]; imagined gap 10 m and closing speed 0 at
first; braking at most 10 m/s²; 500 steps of Adam, learning rate linearly from 0.1 to 0.01; the smooth equations
(sharpness 1), explicit Euler, steps of 0.1 s for filtering and 1 s for reconstruction. The paper states no bounds for
the imagined inputs: here the gap stays in [1, 10 000] m and the closing speed in [−100, 100] m/s, and all values are
put back into their bounds after every step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor

from idm_env.effects import IDM, Brakes, ImaginedLeader
from idm_env.effects.base import Effect, P
from idm_env.roads import Lane
from idm_env.simulator import Simulator
from idm_env.trajectories.recipe import clock_of
from idm_env.trajectories.scores import RegularMotion
from idm_env.trajectories.tracks import TrackPiece
from idm_env.types import Imagined, Neighbour, Scene

if TYPE_CHECKING:
    from idm_env.compiled.kernels.descent import Bounds, DescentResult

NAMES = ("max_accel", "comfort_decel", "time_gap", "min_gap", "desired_speed")
START = np.array([10.0, 2.0, 1.0, 5.0, 50.0])
LOW = np.array([5.0, 0.1, 0.1, 1.0, 20.0])
HIGH = np.array([10.0, 5.0, 5.0, 10.0, 60.0])
FIVE = {f"idm.{name}": (low, high) for name, low, high in zip(NAMES, LOW.tolist(), HIGH.tolist(), strict=True)}
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

    ``fixed_parameters`` keeps the five at their initial values (the paper's ablation). ImportError without numba.
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
    bounds = {"imagined.gap": GAP_BOUNDS, "imagined.closing_speed": CLOSING_BOUNDS} | ({} if fixed else FIVE)
    ahead = Imagined(gap, torch.zeros_like(gap))
    start = np.tile(START, (len(tracks), 1))
    driven = _descended(ImaginedLeader(), ahead, start, speed0, dt, steps, targets, bounds, iterations)
    values = np.stack([driven.params[f"idm.{name}"] for name in NAMES], axis=-1)
    fits = []
    for i, (track, clock) in enumerate(zip(tracks, clocks, strict=True)):
        own = slice(0, len(clock))
        # The acceleration of a step starts at its own speed.
        position, speed, accel = driven.position[own, i], driven.speed[own, i], driven.accel[1:][own, i]
        loss = float(np.abs(position[steps[i]] - targets[i]).mean())
        motion = RegularMotion(clock, position + track.position_m[0], speed, accel)
        fits.append(Imitated(motion, values[i], driven.inputs["imagined.gap"][own, i], loss))
    return fits


def follow(
    position_m: np.ndarray, speed0: float, rear_m: np.ndarray, pace: np.ndarray, dt: float, iterations: int = ITERATIONS
) -> np.ndarray:
    """Return the five values fitted behind a real leader to positions [K] every ``dt`` (s), by the same optimisation.

    This is the recipe of prediction: nothing is imagined. ``rear_m`` and ``pace`` [K] are the leader's rear bumper (m)
    and speed (m/s), ``speed0`` the first speed (m/s).
    """
    origin = position_m[0]
    steps, target = np.arange(len(position_m)), position_m - origin
    ahead = _record_ahead(rear_m - origin, pace)
    result = _descended(RealLeader(), ahead, START[None], [speed0], dt, [steps], [target], FIVE, iterations)
    return np.array([result.params[f"idm.{name}"][0] for name in NAMES])


def drive(values: np.ndarray, speed0: float, rear_m: np.ndarray, pace: np.ndarray, dt: float) -> np.ndarray:
    """Return the distances [K] that the five values drive from 0 at ``speed0``, behind a leader as in ``follow``."""
    ahead = _record_ahead(rear_m, pace)
    return _descended(RealLeader(), ahead, values[None], [speed0], dt, [], [], {}, 0).position[:-1, 0]


def _record_ahead(rear_m: np.ndarray, pace: np.ndarray) -> Ahead:
    return Ahead(*(torch.as_tensor(np.asarray(x, float))[:, None, None] for x in (rear_m, pace)))


def _descended(
    leader: Effect, ahead: Imagined | Ahead, values: np.ndarray, speed0: Sequence[float], dt: float,
    steps: Sequence[np.ndarray], targets: Sequence[np.ndarray], bounds: Bounds, iterations: int,
) -> DescentResult:  # fmt: skip
    """Fit rows of ``values`` [N, 5] and of the input ``ahead`` (steps, N, 1) to distances at ``steps`` [N]."""
    from idm_env.compiled.kernels.descent import Observed, descend

    simulator = Simulator(Lane(), (IDM(sharpness=1.0), leader, Brakes(sharpness=1.0)), dt, "euler")
    params: Any = simulator.defaults(dtype=torch.float64)
    params["idm"] = dict(zip(NAMES, torch.as_tensor(values).T[..., None], strict=True))
    params["brakes"]["max_decel"] = torch.tensor(MAX_DECEL, dtype=torch.float64)
    speed = torch.tensor(speed0, dtype=torch.float64)[:, None]
    state = simulator.state(torch.zeros_like(speed), speed, params)
    sizes = [len(x) for x in steps]
    step, row = np.concatenate([np.empty(0, np.int64), *steps]), np.repeat(np.arange(len(steps)), sizes)
    weight = np.repeat([1.0 / size for size in sizes], sizes)
    observed = Observed(step, row, np.concatenate([[], *targets]), weight)
    call = simulator, state, {leader.name: ahead}, params, len(ahead[0]), observed, bounds
    return descend(*call, iterations=iterations, rates=RATES)
