"""How much drivers drift, and for how long: σ and τ by an approximate marginal likelihood, with intervals.

What is approximated: the step of a driver is linear about the most likely path (gap, speed, levels), so that the path
integrates out in closed form: the innovations of a Kalman filter give the likelihood of σ, τ and the noise of
measurement, and the path itself, and the two alternate. Every driver's own parameters are levels that stay, log-normal
about what is known before, and integrate out with the rest: a calibration in free simulation bends them towards his
drift, and what it bent would count as drift again. Noise of measurement is taken as white and normal.

Shapes: log θ is ``[rows, p]``, levels are ``[T, rows, p + k]``, k drifts.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, fields, replace

import numpy as np
import torch
from scipy.optimize import minimize
from scipy.stats import t as student

from idm_env.compiled.records import filter_loops as loops
from idm_env.drift.linear import MeasuredDrivers, Path
from idm_env.fitting.batch import Batch
from idm_env.parameters import catalogue
from idm_env.simulator import Simulator

JITTER = (0.005, 2.0)
"""Least and most white acceleration (m/s per √s)."""
SLOWEST_S = 300.0
"""Longest τ that is tried: drift beyond it is a driver's own parameters."""
QUIETEST = 0.01
"""Least noise of measurement (m and m/s)."""
NUDGE = 0.02
"""By how much logarithms of the settings are moved to see the curvature."""
NEAR = 0.3
"""Distance from a limit, on the logarithm, within which a number counts as at it: there the likelihood is flat."""
FLAT = 4.0
"""Curvature below which a number is known worse than by half of itself: the likelihood is no parabola there."""
LIKELY = 0.975
"""Quantile of Student's t for an end of an interval, with one degree of freedom less than drivers."""
LINEAR = {"sigma": 0.04, "memory_time": 0.08}
"""What linear steps leave of the logarithms, alike in all sets, so that no curvature shows it.

Means over sets of generated drivers, by sort: −0.04 to 0.02 of log σ, −0.08 to −0.03 of log τ (a wandering v0 −0.17).
"""
LONGEST = 0.3
"""By how much a driver's log θ may move from one path to the next."""
SETTLED = 4
"""Paths before the first settings are sought: far from the drivers' path steps are not linear, and settings that make
up for that lead to a worse one (a wandering v0 of 0.24 came out as 0.98)."""
SPREAD = 0.3
"""Spread of drivers' log θ about what is usual.

Centre and spread of the drivers, estimated along, ran away along what records hardly tell: s0 against T.
"""
USUAL = {"max_accel": 1.3, "comfort_decel": 1.8, "time_gap": 1.3, "min_gap": 2.2, "desired_speed": 32.0}
"""Usual drivers."""
ASTRAY = 5.0
"""Log-likelihood by which a search that ends below a case of what it seeks has gone astray; steps are not linear.

On drivers whose T wanders, σ of v0 leaps to and fro with the path: 1287 above no drift, then 4873 below.
"""
SKIPPED = 10
"""Innovations at the beginning of a record that do not count."""


@dataclass(frozen=True, eq=False)
class DriftSettings:
    """What a filter assumes: σ and τ (s) of every drift [k], noise of gap (m) and speed (m/s) [2].

    ``spread`` [p] is the standard deviation of what drivers' own log θ has more than theirs in a path: over drivers, or
    of what is not known of one. ``jitter`` is white acceleration (m/s per √s) beside the drift: errors of the leader's
    record, and what a linear step leaves out.
    """

    sigma: np.ndarray
    memory_time: np.ndarray
    noise: np.ndarray
    jitter: float
    spread: np.ndarray

    def packed(self) -> np.ndarray:
        """Return logarithms of σ, τ, noise and jitter, one after the other."""
        return np.log(np.concatenate((self.sigma, self.memory_time, self.noise, [self.jitter])))

    def unpacked(self, x: np.ndarray) -> DriftSettings:
        """Return settings from such logarithms."""
        k, y = len(self.sigma), np.exp(x)
        return replace(self, sigma=y[:k], memory_time=y[k : 2 * k], noise=y[2 * k : -1], jitter=float(y[-1]))


@dataclass(frozen=True, eq=False)
class Estimate:
    """Settings as estimated, their log standard errors, the log-likelihood, and what the drivers are made of.

    Intervals are of 95 %, on the logarithm, with what linear steps leave in them. ``nested`` is the log-likelihood of
    the likeliest case of these drifts: fewer of them, or none.
    """

    drivers: MeasuredDrivers
    settings: DriftSettings
    log_error: np.ndarray
    log_likelihood: float
    path: Path = field(repr=False)
    nested: float = -math.inf

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the entries of ``DriftSettings.packed``."""
        own = (f"{n}.{p}" for p in ("sigma", "memory_time") for n in self.drivers.drifts)
        return (*own, "gap_noise_m", "speed_noise_mps", "jitter")

    def table(self) -> list[dict[str, float | str]]:
        """Return one row per number: estimate and interval."""
        rows: list[dict[str, float | str]] = []
        reach = float(student.ppf(LIKELY, max(len(self.drivers.batch) - 1, 1)))
        for name, x, error in zip(self.names, self.settings.packed(), self.log_error, strict=True):
            width = math.hypot(reach * error, 1.96 * LINEAR.get(name.split(".")[-1], 0.0))
            low, high = (math.exp(min(x + s * width, 50.0)) for s in (-1.0, 1.0))
            rows.append({"name": name, "estimate": math.exp(x), "low": low, "high": high})
        return rows

    @property
    def why_not(self) -> str:
        """Why these numbers are no estimate, "" where they are.

        Nothing is finite, a drift is at an end of the search, or a case of these drifts is likelier.
        """
        if not math.isfinite(self.log_likelihood):
            return "its likelihood is not finite"
        limits, packed = _limits(self.drivers), self.settings.packed()
        drifts = len(self.settings.sigma)
        for j in range(drifts):
            if packed[j] < limits[j, 0] + NEAR:
                continue  # no drift at all, and τ of nothing
            if self.log_likelihood < self.nested - ASTRAY:
                below = self.nested - self.log_likelihood
                return f"the search went astray: with less drift the log-likelihood is {below:.0f} higher"
            if packed[drifts + j] > limits[drifts + j, 1] - 1e-6:
                return f"tau is at {SLOWEST_S:.0f} s, the longest that is tried: slower than these records tell"
            for i, symbol in ((j, "sigma"), (drifts + j, "tau")):
                if packed[i] > limits[i, 1] - 1e-6 or packed[i] < limits[i, 0] + 1e-6:
                    return f"{symbol} is at the end of what is searched, {math.exp(packed[i]):.3g}"
        return ""

    def numbers(self) -> dict[str, torch.Tensor]:
        """Return the numbers as a store takes them; ``of_numbers`` makes the estimate of them again."""
        s, path = self.settings, self.path
        arrays = {**vars(s), "log_error": self.log_error, "log_likelihood": self.log_likelihood, **vars(path)}
        return {name: torch.as_tensor(np.asarray(value, float)) for name, value in arrays.items()}

    @classmethod
    def of_numbers(cls, drivers: MeasuredDrivers, numbers: Mapping[str, torch.Tensor]) -> Estimate:
        """Return the estimate with these ``numbers``, on the same drivers."""
        x = {name: value.numpy() for name, value in numbers.items()}
        settings = DriftSettings(x["sigma"], x["memory_time"], x["noise"], float(x["jitter"]), x["spread"])
        path = Path(**{f.name: x[f.name] for f in fields(Path)})
        return cls(drivers, settings, x["log_error"], float(x["log_likelihood"]), path)

    @property
    def theta(self) -> np.ndarray:
        """Every driver's most likely own log θ [rows, p]."""
        return np.clip(self.path.theta + self.path.level[0, :, : len(self.drivers.free)], *self.drivers.bounds)


def usual(free: Sequence[str]) -> np.ndarray:
    """Return the log parameters [p] of usual IDM drivers; ``free`` are full names."""
    return np.log([USUAL[name.split(".")[1]] for name in free])


class Likelihood:
    """The marginal likelihood of settings, about a path."""

    def __init__(self, drivers: MeasuredDrivers, path: Path) -> None:
        self.drivers, self.path = drivers, path
        batch, linear = drivers.measured, drivers.linearise(path)
        steps = (linear.to, linear.by_state, linear.by_level, path.gap, path.speed)
        measured = (np.ascontiguousarray(x.numpy()) for x in (batch.gap, batch.speed))
        self.length = np.array([len(e) for e in batch.episodes])
        self.records = (self.length, *measured, *map(np.ascontiguousarray, steps))

    def centred(self, theta: np.ndarray) -> Likelihood:
        """Return the same with levels of log θ counted from ``theta`` [rows, p]: no step changes by that."""
        own = len(self.drivers.free)
        level = self.path.level.copy()
        level[..., :own] += self.path.theta - theta
        other = copy(self)
        other.path = replace(self.path, theta=theta, level=level)
        return other

    def _settings(self, s: DriftSettings) -> tuple[np.ndarray | float, ...]:
        dt = self.drivers.batch.dt
        decay = np.append(np.ones(len(s.spread)), np.exp(-dt / s.memory_time))
        return self.path.level, decay, np.append(s.spread, s.sigma), s.noise, s.jitter**2 * dt

    def __call__(self, s: DriftSettings) -> float:
        """Return the log-likelihood of all records."""
        return float(loops.likelihood(*(*self.records, *self._settings(s), SKIPPED)).sum())

    def filtered(self, s: DriftSettings) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return filtered means and covariances and smoothed means [T, rows, …] of gap, speed and levels."""
        return loops.smooth(*(*self.records, *self._settings(s)))


def estimate(
    simulator: Simulator, batch: Batch, free: Sequence[str], theta: np.ndarray, *,
    spread: float | np.ndarray = SPREAD, measured: Batch | None = None, rounds: int = 4,
) -> Estimate:  # fmt: skip
    """Estimate σ and τ of every drifting effect of the simulator, and the noise of measurement, on measured drivers.

    Args:
        simulator: With the step of ``batch``; ``midpoint``, so that no step's delay is taken for a driver's.
        batch: Drivers and those around them, smoothed (``linear.stacked``).
        free: Full names of the parameters in which drivers differ.
        theta: Their logarithms [rows, p] or [p] as far as known before: what is usual, or of a calibration.
        spread: How well ``theta`` is known, one number or [p]; 0 for sure.
        measured: The same with gap and speed as measured; None takes ``batch`` for that.
        rounds: How often steps are linearised about a new path.

    Raises:
        ValueError: For a simulator that looks back.
    """
    drivers = MeasuredDrivers(simulator, batch, measured or batch, tuple(free))
    wide = np.broadcast_to(np.asarray(spread, float), len(free)).copy()
    parameters, limits = catalogue(simulator.effects), _limits(drivers)
    sigma, tau = (np.array([parameters[f"{n}.{p}"].default for n in drivers.drifts]) for p in ("sigma", "memory_time"))
    settings = DriftSettings(sigma, tau, np.array((0.1, 0.1)), 0.02, wide)
    path = Path.without_drift(drivers, np.broadcast_to(np.clip(theta, *drivers.bounds), (len(batch), len(free))).copy())
    for _ in range(SETTLED):
        path = _path(Likelihood(drivers, path), settings)
    for _ in range(rounds):
        around = Likelihood(drivers, path)
        settings = _maximised(around, settings, limits)
        path = _path(around, settings)
    return Estimate(drivers, settings, _errors(around, settings, limits), around(settings), path)


def _limits(drivers: MeasuredDrivers) -> np.ndarray:
    parameters = catalogue(drivers.simulator.effects)
    highest = [parameters[f"{n}.sigma"].high for n in drivers.drifts]
    drifts = [(1e-3 * x, x) for x in highest] + [(2.0 * drivers.batch.dt, SLOWEST_S)] * len(highest)
    return np.log([*drifts, *[(QUIETEST, 5.0)] * 2, JITTER])


def _maximised(around: Likelihood, settings: DriftSettings, limits: np.ndarray) -> DriftSettings:
    def cost(x: np.ndarray) -> float:
        value = -around(settings.unpacked(x))
        return value if math.isfinite(value) else 1e12

    x0 = np.clip(settings.packed(), limits[:, 0], limits[:, 1])
    options = {"maxiter": 20, "ftol": 1e-8, "eps": 1e-4}
    return settings.unpacked(minimize(cost, x0, method="L-BFGS-B", bounds=limits, options=options).x)


def _path(around: Likelihood, settings: DriftSettings) -> Path:
    """Return where the next steps are linear about: drivers as their whole records tell, the rest as the past tells.

    A drift that knows the sample that it is about to explain would be told apart from the driver by nothing: his
    parameters would follow every innovation.
    """
    mean, own, path = around.filtered(settings)[0], len(settings.spread), around.path
    last = mean[around.length - 1, np.arange(len(around.length)), 2 : 2 + own]
    before = path.level[0, :, :own]
    theta = np.clip(path.theta + np.clip(last, before - LONGEST, before + LONGEST), *around.drivers.bounds)
    level = np.zeros_like(path.level)
    level[..., :own] = theta - path.theta
    mean, covariance, _ = around.centred(theta).filtered(replace(settings, spread=np.zeros(own)))
    return predicted(replace(path, level=level), settings, around.drivers.batch.dt, mean, covariance)


def predicted(path: Path, settings: DriftSettings, dt: float, mean: np.ndarray, covariance: np.ndarray) -> Path:
    """Return a path with gap and speed as filtered, and drifts as foreseen one sample earlier."""
    own = len(settings.spread)
    decay, level, unsure = np.exp(-dt / settings.memory_time), path.level.copy(), np.zeros_like(path.unsure)
    reach = 3.0 * settings.sigma
    level[..., own:] = 0.0
    level[1:, :, own:] = np.clip(decay * mean[:-1, :, 2 + own :], -reach, reach)
    variance = np.diagonal(covariance, axis1=-2, axis2=-1)[:-1, :, 2 + own :]
    unsure[1:] = np.sqrt(settings.sigma**2 + decay**2 * (np.maximum(variance, 0.0) - settings.sigma**2))
    gap, speed = np.maximum(mean[..., 0], 0.2), np.maximum(mean[..., 1], 0.0)
    return replace(path, gap=gap, speed=speed, level=level, unsure=unsure)


def _errors(around: Likelihood, settings: DriftSettings, limits: np.ndarray) -> np.ndarray:
    """Return standard errors of the packed settings, from the curvature; inf for what lies at a limit or is flat."""
    x = settings.packed()
    inside = np.flatnonzero((x > limits[:, 0] + NEAR) & (x < limits[:, 1] - NEAR)).tolist()

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
    # What the likelihood hardly knows (a jitter next to nothing) may not spoil the others.
    sharp = np.diag(curvature) > FLAT
    inside, curvature = [i for i, y in zip(inside, sharp, strict=True) if y], curvature[np.ix_(sharp, sharp)]
    variance = np.diag(np.linalg.pinv(curvature))
    error[inside] = np.where(variance > 0, np.sqrt(np.maximum(variance, 0.0)), np.inf)
    return error
