"""The prior and the noise of a trajectory, and the fit of both to one track: the inputs that the simulator will get.

The unknowns of a track are the accelerations of ballistic steps, which the imagined leader's gap sets one to one
(``imagined.py``). Their prior is that they change little from step to step: a random walk whose variance adapts to
how lively the driving is (Student-t jerk). The measured positions carry white and correlated noise, and outliers.
With the step's dynamics linear in the accelerations, every Gauss–Newton step is a Kalman smoother, in time linear in
the length of the track; reweighting and the active set of bounds repeat it.

Shapes: a track has ``[samples]`` on its clock (s, m, m/s, m/s²).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from idm_env.compiled.records import smoother_loops as loops

N = loops.N
TIGHT = 1e-8
"""Variance of an observation that stands for a bound."""


@dataclass(frozen=True)
class PositionNoise:
    """How positions are wrong, and how lively the driving is.

    Attributes:
        white: Standard deviation of noise that is independent from sample to sample (m).
        sigma: Standard deviation of the correlated noise, an Ornstein–Uhlenbeck process (m).
        time: Its correlation time (s).
        jerk: Spectral density of the jerk, m²/s⁵, the prior of the imagined inputs.
        accel_time: Time in which an acceleration fades (s); infinite is a random walk.
    """

    white: float = 0.05
    sigma: float = 0.0
    time: float = 0.3
    jerk: float = 0.3
    accel_time: float = math.inf

    def step(self, dt: float) -> tuple[float, float, float, float]:
        """Return the decay of acceleration and noise over a step, and the variances that each gains."""
        keep = math.exp(-dt / self.accel_time)
        fade = math.exp(-dt / self.time)
        return keep, fade, self.jerk * dt, self.sigma**2 * (1 - fade * fade) + 1e-12


@dataclass(frozen=True)
class SmootherOptions:
    """Static options of the smoother.

    ``rounds`` of reweighting; ``degrees`` of freedom of the positions' Student-t noise (None for normal noise);
    ``jerk_degrees`` and ``window`` (s): weight, in samples, of the prior variance of the jerk against that over a
    window around each step (None keeps the prior's); ``highest`` and ``lowest`` acceleration (m/s²), exact in the
    result.
    """

    rounds: int = 10
    degrees: float | None = 4.0
    jerk_degrees: float | None = 0.5
    window: float = 2.0
    highest: float = 5.0
    lowest: float = -8.0


SPARSE = SmootherOptions(rounds=1, degrees=None, jerk_degrees=None)
"""For sparse samples, among which outliers cannot be told."""


@dataclass(eq=False)
class TrackObservations:
    """Observations of a track on the clock of its steps, positions relative to ``origin`` (m).

    Step of each, the row that looks at the state, value and whether it is measured (else it is a bound).
    """

    steps: int
    dt: float
    origin: float
    at: np.ndarray
    look: np.ndarray
    value: np.ndarray
    measured: np.ndarray

    @classmethod
    def on_clock(
        cls, time_s: np.ndarray, position_m: np.ndarray, dt: float, steps: int | None = None
    ) -> TrackObservations:
        """Put samples on the clock ``time_s[0] + k dt``; a sample between ticks is seen from the tick before it."""
        since = (time_s - time_s[0]) / dt
        ticks = np.floor(since + 1e-6).astype(np.int64)
        rest = np.maximum(since - ticks, 0.0) * dt
        rest[rest < 1e-6] = 0.0
        look = np.stack([np.ones_like(rest), rest, 0.5 * rest * rest, np.ones_like(rest)], axis=1)
        count = int(np.ceil(since[-1] - 1e-6)) + 1 if steps is None else steps
        origin = float(position_m[0])
        return cls(count, dt, origin, ticks, look, position_m - origin, np.ones(len(ticks), bool))

    def start(self) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and covariance before the first sample: the mean speed over 3 s, give or take 10 m/s."""
        span = min(len(self.at) - 1, int(np.searchsorted(self.at, self.at[0] + 3.0 / self.dt)))
        seconds = max(self.at[span] - self.at[0], 1) * self.dt
        mean = np.array([self.value[0], (self.value[span] - self.value[0]) / seconds, 0.0, 0.0])
        return mean, np.diag([25.0, 100.0, 4.0, 0.0])

    def bounded(self, at: np.ndarray, which: int, value: np.ndarray) -> TrackObservations:
        """Return these observations and bounds: state ``which`` (0 position, 1 speed, 2 acceleration) at steps."""
        look = np.zeros((len(at), N))
        look[:, which] = 1.0
        every = np.concatenate([self.at, at])
        order = np.argsort(every, kind="stable")
        measured = np.concatenate([self.measured, np.zeros(len(at), bool)])
        values = np.concatenate([self.value, value - (self.origin if which == 0 else 0.0)])
        looks = np.concatenate([self.look, look])
        return TrackObservations(
            self.steps, self.dt, self.origin, every[order], looks[order], values[order], measured[order]
        )


@dataclass(eq=False)
class Smoothed:
    """Position, speed and acceleration per step [K] with their standard deviations [K, 3]."""

    position: np.ndarray
    speed: np.ndarray
    accel: np.ndarray
    sigma: np.ndarray


def log_likelihood(observed: TrackObservations, noise: PositionNoise, inflated: np.ndarray | None = None) -> float:
    """Return the log-likelihood of a track, with ``inflated`` white variances of single samples where given."""
    start, spread = observed.start()
    spread[3, 3] = noise.sigma**2
    variance = np.full(len(observed.at), noise.white**2) if inflated is None else noise.white**2 + inflated
    keep, fade, push, drift = noise.step(observed.dt)
    seen = (observed.steps, observed.at, observed.look, observed.value)
    return float(loops.likelihood(*seen, variance, start, spread, observed.dt, keep, fade, push, drift))


def smooth(observed: TrackObservations, noise: PositionNoise, options: SmootherOptions = SmootherOptions()) -> Smoothed:
    """Return the most likely motion of a track, reweighted for outliers and bursts, within its bounds.

    Bounds (no reverse, accelerations between ``lowest`` and ``highest``) enter as an active set: where the motion
    breaks one, it is tied to it, until none is broken by more than what rounding and a final clip take away.
    """
    mean, cov, push = _fitted(observed, noise, options, None)
    for _ in range(6):
        broken = _broken(mean, options)
        if not any(len(steps) for steps, _, _ in broken):
            break
        for steps, which, value in broken:
            observed = observed.bounded(steps, which, np.full(len(steps), value))
        mean, cov, push = _fitted(observed, noise, options, push)
    sigma = np.sqrt(np.maximum(np.einsum("kii->ki", cov)[:, :3], 0.0))
    return Smoothed(mean[:, 0] + observed.origin, mean[:, 1], mean[:, 2], sigma)


def _broken(mean: np.ndarray, options: SmootherOptions) -> list[tuple[np.ndarray, int, float]]:
    speed, accel = mean[:, 1], mean[:, 2]
    return [
        (np.flatnonzero(speed < -0.01), 1, 0.0),
        (np.flatnonzero(accel > options.highest + 0.01), 2, options.highest),
        (np.flatnonzero(accel < options.lowest - 0.01), 2, options.lowest),
    ]


def _fitted(
    observed: TrackObservations, noise: PositionNoise, options: SmootherOptions, push: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return mean [K, 4], covariance [K, 4, 4] and the variances of the jerk, fitted unless they are given."""
    start, spread = observed.start()
    spread[3, 3] = noise.sigma**2
    keep, fade, scale, drift = noise.step(observed.dt)
    white = max(noise.white, 1e-4) ** 2
    variance = np.where(observed.measured, white, TIGHT)
    mean, cov = np.empty((observed.steps, N)), np.empty((observed.steps, N, N))
    square = np.empty(observed.steps)
    rounds = options.rounds if push is None else 2
    adapting = push is None and options.jerk_degrees is not None
    if push is None:
        push = np.full(observed.steps, scale)
    half = max(1, round(0.5 * options.window / observed.dt))
    seen, prior = (observed.at, observed.look, observed.value), (start, spread, observed.dt, keep, fade, push, drift)
    for turn in range(rounds):
        loops.smooth(*seen, variance, *prior, mean, cov, square)
        if turn == rounds - 1:
            break
        if options.degrees is not None:
            loops.reweigh(*seen, mean, cov, white, options.degrees, observed.measured, variance)
        if adapting and options.jerk_degrees is not None:
            loops.adapt(square, push, half, options.jerk_degrees, scale)
    return mean, cov, push
