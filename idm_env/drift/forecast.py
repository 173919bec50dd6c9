"""Forecasts of drivers who drift: how they are is followed on the past, the future is drawn, and both are scored.

Shapes: levels are ``[T, rows, p + k]``, drawn futures ``[steps, draws, starts]``.
"""

import math
from dataclasses import replace

import numpy as np
import torch

from idm_env.drift.estimate import DriftSettings, Likelihood, predicted
from idm_env.drift.linear import MeasuredDrivers, Path, stacked
from idm_env.effects import AccelNoise
from idm_env.types import mapped

NO_MEMORY_S = 1e-3
"""Memory time (s) of noise that is new in every step."""


def followed(
    drivers: MeasuredDrivers, settings: DriftSettings, theta: np.ndarray, passes: int = 2
) -> tuple[np.ndarray, np.ndarray]:
    """Return mean [T, rows, p + k] and covariance of a driver's levels, each from the record up to that sample only.

    Steps are linear about the record and about the levels that the pass before had found one sample earlier.
    """
    path = Path.without_drift(drivers, theta)
    for _ in range(passes):
        mean, covariance, _ = Likelihood(drivers, path).filtered(settings)
        path = predicted(path, settings, drivers.batch.dt, mean, covariance)
    return mean[..., 2:], covariance[..., 2:, 2:]


def draw_gaps(
    drivers: MeasuredDrivers, settings: DriftSettings, theta: np.ndarray, levels: tuple[np.ndarray, np.ndarray],
    starts: list[tuple[int, int]], seconds: float, count: int, seed: int = 0,
) -> np.ndarray:  # fmt: skip
    """Return ``count`` drawn futures of the gap [steps, count, starts], each start a (row, sample).

    They begin at the measured state, with a draw of what is known of the ``levels`` (of ``followed``) then. Where no
    drift is one of the acceleration, this has the white noise of the settings (``jitter``). Beyond the end of a record
    a future means nothing.
    """
    steps = round(seconds / drivers.batch.dt)
    some = range(0, len(starts), 64)
    chunks = [_chunk(drivers, settings, theta, levels, starts[i : i + 64], steps, count, seed + i) for i in some]
    return np.concatenate(chunks, -1)


def _chunk(
    drivers: MeasuredDrivers, settings: DriftSettings, theta: np.ndarray, levels: tuple[np.ndarray, np.ndarray],
    starts: list[tuple[int, int]], steps: int, count: int, seed: int,
) -> np.ndarray:  # fmt: skip
    simulator, d, one = drivers.simulator, drivers.driver, torch.ones((), dtype=torch.float64)
    batch = stacked(drivers.batch.episodes[r].part(t, t + steps + 1) for r, t in starts)
    rows, samples = np.array(starts).T
    values, vectors = np.linalg.eigh(levels[1][samples, rows])
    root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None]
    normals = np.random.default_rng(seed).standard_normal((count, *levels[0].shape[2:], len(starts)))
    level = levels[0][samples, rows] + np.einsum("rij,njr->nri", root, normals)
    own = len(drivers.free)
    params = drivers.params(torch.tensor(np.clip(theta[rows] + level[..., :own], *drivers.bounds)))
    noise = dict(zip(drivers.drifts, zip(settings.sigma, settings.memory_time, strict=True), strict=True))
    if AccelNoise.kind not in noise:  # the filter's white acceleration
        simulator = replace(simulator, effects=(*simulator.effects, AccelNoise()))
        noise[AccelNoise.kind] = settings.jitter / math.sqrt(simulator.dt), NO_MEMORY_S
    for name, (sigma, memory_time) in noise.items():
        params[name] = {"sigma": sigma * one, "memory_time": memory_time * one}
    state = batch.start(simulator, params)
    units = torch.tensor(np.moveaxis(level[..., own:] / settings.sigma, -1, 0)).unsqueeze(-1)
    memory = dict(zip(drivers.drifts, units.expand(-1, *state.speed.shape).contiguous(), strict=True))
    state = state._replace(memory={**state.memory, **memory}, step=state.step.expand(state.speed.shape[:-1]))
    inputs = mapped(lambda x: x.unsqueeze(1), dict(batch.inputs(simulator.without(*simulator.draws))))
    inputs = simulator.drawn(state.speed, inputs, batch.steps, seed)
    _, trajectory = simulator.rollout(state, inputs, params, batch.steps)
    gap = trajectory.gap[batch.substeps - 1 :: batch.substeps, ..., d].numpy()
    return np.pad(gap, [(0, steps - len(gap)), (0, 0), (0, 0)], constant_values=np.nan)


def crps(drawn: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return the continuous ranked probability score of draws [n, …], without the bias of few draws.

    ``E|X − y| − ½ E|X − X'|`` (Gneiting, Raftery 2007, JASA 102); of a single draw the absolute error.
    """
    n = len(drawn)
    first = np.abs(drawn - truth).mean(0)
    if n == 1:
        return np.asarray(first)
    ranked = np.sort(drawn, 0)
    weight = (2.0 * np.arange(1, n + 1) - n - 1.0).reshape(-1, *(1,) * truth.ndim)
    return np.asarray(first - (weight * ranked).sum(0) / (n * (n - 1.0)))


def half_widths(drawn: np.ndarray, truth: np.ndarray, share: float) -> np.ndarray:
    """Return how far truths […] are from medians of draws [n, …], in half widths of their central bands of ``share``.

    A band holds what is within 1; the quantile ``share`` is the factor that widens bands to hold as many truths.
    """
    low, middle, high = np.quantile(drawn, [0.5 - 0.5 * share, 0.5, 0.5 + 0.5 * share], axis=0)
    half = np.where(truth < middle, middle - low, high - middle)
    return np.asarray(np.abs(truth - middle) / np.maximum(half, 1e-9))
