"""The noise of a file, fitted to the file itself by maximum likelihood: no truth and no user's guess.

White and correlated noise of positions and the liveliness of the driving have different spectra, so dense data tell
them apart; data sparser than the correlation of the noise do not, and get white noise only.

Shapes: times and positions of a track are ``[samples]`` (s, m).
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy.optimize import minimize
from scipy.signal import savgol_filter

from idm_env.trajectories.smoother import PositionNoise, TrackObservations, log_likelihood

MOST_TRACKS = 32
MOST_SAMPLES = 400
DENSE_S = 0.25
"""Up to this sampling interval correlated noise can be told from white noise (s)."""
TELLING_S = 3.0
"""Up to this sampling interval white noise can be told from driving (s)."""
SPARSE_WHITE_M, NOISY_WHITE_M = 0.01, 0.7
"""White noise assumed of sparse samples, and what a search for more starts from (m): that of satellite navigation."""
DECISIVE = 0.07
"""Sparse samples are taken as noisy where that makes each likelier by a factor of e to this: driving that is not normal
looks a little like noise, too. Tracks of TGSIM, which are quiet, gain 0.055, those of ZalaZone with 7 cm 0.084."""
BOUNDS = {
    "white": (2e-3, 5.0),
    "sigma": (2e-3, 10.0),
    "time": (0.1, 3.0),
    "jerk": (1e-3, 30.0),
    "accel_time": (0.5, 100.0),
}


def sample(tracks: Sequence[tuple[np.ndarray, np.ndarray]]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return parts of tracks (times, positions) that speak for all: evenly chosen, the longest stretch of each."""
    usable = [track for track in tracks if len(track[0]) >= 5] or list(tracks)
    chosen = [usable[i] for i in np.unique(np.linspace(0, len(usable) - 1, MOST_TRACKS).round().astype(int))]
    return [(time[:MOST_SAMPLES], position[:MOST_SAMPLES]) for time, position in chosen]


def interval(times: Sequence[np.ndarray]) -> float:
    """Return the usual time between samples (s)."""
    return float(np.median(np.concatenate([np.diff(time) for time in times])))


def is_dense(times: Sequence[np.ndarray]) -> bool:
    """Tell whether samples are dense enough to tell correlated noise from driving."""
    return interval(times) <= DENSE_S


def outlying(position: np.ndarray) -> np.ndarray:
    """Return an extra variance for samples far off a local parabola (m²), 0 for all others."""
    if len(position) < 9:
        return np.zeros(len(position))
    rest = position - savgol_filter(position, 9, 2)
    scale = 1.4826 * float(np.median(np.abs(rest)))
    return np.where(np.abs(rest) > 5.0 * scale + 1e-3, 100.0 * (rest * rest + 1e-6), 0.0)


def fit_noise(tracks: Sequence[tuple[np.ndarray, np.ndarray]], dt: float, evaluations: int = 110) -> PositionNoise:
    """Return the noise model under which the tracks (times, positions) are most likely.

    Four numbers for dense data (white, correlated, its time, jerk), by a simplex search over their logarithms; jerk and
    the time in which an acceleration fades for sparse data. Up to ``TELLING_S``, sparse data get white noise where they
    are clearly noisy (``DECISIVE``), and else no fading. ValueError if no track has three samples.
    """
    parts = [part for part in sample(tracks) if len(part[0]) >= 3]
    if not parts:
        raise ValueError("no track has three samples to fit the noise to. Give noise=Noise(…).")
    usual = interval([time for time, _ in parts])
    dense = usual <= DENSE_S
    observed = [TrackObservations.on_clock(time, position, dt) for time, position in parts]
    inflated = [outlying(position) if dense else np.zeros(len(position)) for _, position in parts]
    search = _Search(observed, inflated, evaluations)
    if dense:
        return search.best(PositionNoise(0.1, 0.2, 0.3, 0.5), ("white", "sigma", "time", "jerk"))[0]
    clean, cost = search.best(PositionNoise(SPARSE_WHITE_M, 0.0, 0.3, 0.5, 5.0), ("jerk", "accel_time"))
    if usual > TELLING_S:
        return clean
    noisy, less = search.best(PositionNoise(NOISY_WHITE_M, 0.0, 0.3, 0.5, 5.0), ("white", "jerk", "accel_time"))
    if less < cost - DECISIVE * sum(len(o.at) for o in observed):
        return noisy
    # between clean samples so near to each other accelerations hardly fade
    return search.best(PositionNoise(SPARSE_WHITE_M, 0.0, 0.3, 0.5), ("jerk",))[0]


@dataclasses.dataclass(frozen=True, eq=False)
class _Search:
    """Maximum likelihood of some tracks, with extra variances of their samples."""

    observed: Sequence[TrackObservations]
    inflated: Sequence[np.ndarray]
    evaluations: int

    def best(self, begin: PositionNoise, names: tuple[str, ...]) -> tuple[PositionNoise, float]:
        """Return the likeliest noise that differs from ``begin`` in some of its numbers, and −log-likelihood."""
        low, high = (np.log([BOUNDS[name][side] for name in names]) for side in (0, 1))

        def noise(point: np.ndarray) -> PositionNoise:
            values = np.exp(np.clip(point, low, high)).tolist()
            return dataclasses.replace(begin, **dict(zip(names, values, strict=True)))

        def cost(point: np.ndarray) -> float:
            model = noise(point)
            pairs = zip(self.observed, self.inflated, strict=True)
            outside = np.maximum(low - point, 0) ** 2 + np.maximum(point - high, 0) ** 2
            return float(outside.sum()) - sum(log_likelihood(o, model, extra) for o, extra in pairs)

        first = np.log([getattr(begin, name) for name in names])
        simplex = np.vstack([first, first + 0.7 * np.eye(len(names))])
        options = {"maxfev": self.evaluations, "xatol": 0.03, "fatol": 0.3, "initial_simplex": simplex}
        optimum = minimize(cost, first, method="Nelder-Mead", options=options)
        return noise(optimum.x), float(optimum.fun)
