"""How much drivers drift, and for how long: σ and τ by an approximate marginal likelihood, with intervals.

What is approximated: the step of a calibrated driver is linear about the most likely path (gap, speed, levels), so that
the path integrates out in closed form: the innovations of a Kalman filter give the likelihood of σ, τ and the noise of
measurement, a smoother the path, and the two alternate (Laplace's approximation with the Gauss–Newton curvature). A
driver's own mean of T is part of the path: a level that stays. His other parameters are those of his calibration, and
what is not known of them is not in the intervals. Noise of measurement is taken as white and normal.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import minimize

from idm_env.drift import filter_loops as loops
from idm_env.drift.linear import Drivers, Path
from idm_env.fitting.batch import Batch
from idm_env.parameters import catalogue
from idm_env.progress import OnProgress, silent
from idm_env.simulator import Simulator

JITTER = (0.005, 2.0)
"""Least and most white acceleration (m/s per √s)."""
QUIETEST = 0.01
"""Least noise of measurement (m and m/s)."""
NUDGE = 0.02
"""By how much logarithms of the settings are moved to see the curvature."""
LIKELY = 1.96
SKIPPED = 10
"""Innovations at the beginning of a record that do not count."""


@dataclass(frozen=True, eq=False)
class Settings:
    """What a filter assumes: σ and τ (s) of every drift [k], noise of gap (m) and speed (m/s) [2].

    ``style`` is the standard deviation of drivers' own log T about their calibration; ``jitter`` is white acceleration
    (m/s per √s) beside the drift: errors of the leader's record, and what a linear step leaves out.
    """

    sigma: np.ndarray
    memory_time: np.ndarray
    noise: np.ndarray
    style: float
    jitter: float

    def packed(self) -> np.ndarray:
        """Return logarithms of σ, τ, noise, style and jitter, one after the other."""
        return np.log(np.concatenate((self.sigma, self.memory_time, self.noise, [self.style, self.jitter])))

    def unpacked(self, x: np.ndarray) -> Settings:
        """Return settings from such logarithms."""
        k, y = len(self.sigma), np.exp(x)
        return Settings(y[:k], y[k : 2 * k], y[2 * k : -2], float(y[-2]), float(y[-1]))


@dataclass(frozen=True, eq=False)
class Estimate:
    """Settings as estimated, their log standard errors, the log-likelihood, and what the drivers are made of.

    ``names`` are those of the entries of ``Settings.packed``; intervals are of 95 %, on the logarithm.
    """

    drivers: Drivers
    settings: Settings
    names: tuple[str, ...]
    log_error: np.ndarray
    log_likelihood: float
    path: Path = field(repr=False)

    def table(self) -> list[dict[str, float | str]]:
        """Return one row per number: estimate and interval."""
        rows: list[dict[str, float | str]] = []
        for name, x, error in zip(self.names, self.settings.packed(), self.log_error, strict=True):
            low, high = (math.exp(min(x + s * LIKELY * error, 50.0)) for s in (-1.0, 1.0))
            rows.append({"name": name, "estimate": math.exp(x), "low": low, "high": high})
        return rows


class Likelihood:
    """The marginal likelihood of settings, about a path."""

    def __init__(self, drivers: Drivers, path: Path) -> None:
        batch, linear = drivers.measured, drivers.linearise(path)
        self.dt = batch.dt
        steps = (linear.to, linear.by_state, linear.by_level, path.gap, path.speed, path.level)
        measured = (np.ascontiguousarray(x.numpy()) for x in (batch.gap, batch.speed))
        self.given = (np.array([len(e) for e in batch.episodes]), *measured, *map(np.ascontiguousarray, steps))

    def _settings(self, s: Settings) -> tuple[np.ndarray | float, ...]:
        decay = np.append(1.0, np.exp(-self.dt / s.memory_time))
        return decay, np.append(s.style, s.sigma), s.noise, s.jitter**2 * self.dt

    def __call__(self, s: Settings) -> float:
        """Return the log-likelihood of all records."""
        return float(loops.likelihood(*(*self.given, *self._settings(s), SKIPPED)).sum())

    def filtered(self, s: Settings) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return filtered means and covariances and smoothed means [T, rows, …] of gap, speed and levels."""
        found: tuple[np.ndarray, np.ndarray, np.ndarray] = loops.smooth(*(*self.given, *self._settings(s)))
        return found


def estimate(
    simulator: Simulator,
    batch: Batch,
    free: Sequence[str],
    theta: np.ndarray,
    *,
    measured: Batch | None = None,
    noise: tuple[float, float] | None = None,
    rounds: int = 3,
    on_progress: OnProgress = silent,
) -> Estimate:
    """Estimate σ and τ of every drifting effect of the simulator, and the noise of measurement, on measured drivers.

    Args:
        simulator: One step per sample; ``midpoint``, so that no step's delay is taken for a driver's.
        batch: Drivers and those around them, smoothed, one sample per step (``substeps=1``).
        free: Full names of the parameters in which drivers differ.
        theta: Their logarithms [rows, p], from a calibration.
        measured: The same with gap and speed as measured; None takes ``batch`` for that.
        noise: Noise of measured gap (m) and speed (m/s), where it is known; None estimates it along.
        rounds: How often steps are linearised about a new path.
        on_progress: Called with phase, done, total and the log-likelihood.

    Raises:
        ValueError: For a simulator that looks back.
    """
    drivers = Drivers(simulator, batch, measured or batch, tuple(free))
    known = catalogue(simulator.effects)
    k = len(drivers.drifts)
    settings = Settings(
        np.array([known[f"{n}.sigma"].default for n in drivers.drifts]),
        np.array([known[f"{n}.memory_time"].default for n in drivers.drifts]),
        np.array(noise or (0.1, 0.1)), 0.2, 0.1,
    )  # fmt: skip
    limits = _limits(drivers, noise)
    path = Path(batch.gap.numpy(), batch.speed.numpy(), np.zeros((*batch.gap.shape, 1 + k)), theta)
    for number in range(rounds):
        around = Likelihood(drivers, path)
        settings = _maximised(around, settings, limits)
        on_progress("drift", number + 1, rounds, around(settings))
        if number < rounds - 1:
            path = _path(path, around.filtered(settings)[2], settings)
    names = [f"{n}.{p}" for p in ("sigma", "memory_time") for n in drivers.drifts]
    names += ["gap_noise_m", "speed_noise_mps", "style", "jitter"]
    error = _errors(around, settings, limits)
    return Estimate(drivers, settings, tuple(names), error, around(settings), path)


def _limits(drivers: Drivers, noise: tuple[float, float] | None) -> np.ndarray:
    known = catalogue(drivers.simulator.effects)
    highest = [known[f"{n}.sigma"].high for n in drivers.drifts]
    found = [(1e-3 * x, x) for x in highest] + [(2.0 * drivers.batch.dt, 300.0)] * len(highest)
    both = [(QUIETEST, 5.0)] * 2 if noise is None else [(x, x) for x in noise]
    return np.log([*found, *both, (0.01, 0.8), JITTER])


def _maximised(around: Likelihood, settings: Settings, limits: np.ndarray) -> Settings:
    def cost(x: np.ndarray) -> float:
        value = -around(settings.unpacked(x))
        return value if math.isfinite(value) else 1e12

    x0 = np.clip(settings.packed(), limits[:, 0], limits[:, 1])
    options = {"maxiter": 40, "ftol": 1e-9, "eps": 1e-4}
    return settings.unpacked(minimize(cost, x0, method="L-BFGS-B", bounds=limits, options=options).x)


def _path(path: Path, mean: np.ndarray, settings: Settings) -> Path:
    reach = 3.0 * np.append(settings.style, settings.sigma)
    level = np.clip(mean[..., 2:], -reach, reach)
    return Path(np.maximum(mean[..., 0], 0.2), np.maximum(mean[..., 1], 0.0), level, path.theta)


def _errors(around: Likelihood, settings: Settings, limits: np.ndarray) -> np.ndarray:
    """Return standard errors of the packed settings, from the curvature; inf for what lies at a limit."""
    x = settings.packed()
    inside = [int(i) for i in np.flatnonzero((x > limits[:, 0] + 1e-3) & (x < limits[:, 1] - 1e-3))]

    def value(*moves: tuple[int, float]) -> float:
        y = x.copy()
        for i, by in moves:
            y[i] += by
        return around(settings.unpacked(y))

    here, size = value(), len(inside)
    up, down = ([value((i, sign * NUDGE)) for i in inside] for sign in (1.0, -1.0))
    curvature = np.zeros((size, size))
    for a, i in enumerate(inside):
        curvature[a, a] = -(up[a] - 2.0 * here + down[a]) / NUDGE**2
        for b, j in enumerate(inside[:a]):
            both = value((i, NUDGE), (j, NUDGE)) - up[a] - up[b] + here
            curvature[a, b] = curvature[b, a] = -both / NUDGE**2
    error = np.full(len(x), np.inf)
    variance = np.diag(np.linalg.pinv(curvature))
    error[inside] = np.where(variance > 0, np.sqrt(np.maximum(variance, 0.0)), np.inf)
    return error
