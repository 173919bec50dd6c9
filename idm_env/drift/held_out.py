"""How well drivers who were kept back are foreseen: with drift as estimated on others, and without any.

Shapes: places of drivers are ``[k]``.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.stats import t as student

from idm_env.data import Episode
from idm_env.drift import forecast
from idm_env.drift.estimate import Estimate
from idm_env.drift.linear import MeasuredDrivers, stacked
from idm_env.fitting.problem import IDM_NAMES

HORIZONS_S = (1.0, 5.0, 10.0)
EVERY_S, FIRST_S = 5.0, 10.0
"""A forecast begins so often (s), after the driver has been followed for so long."""
DRAWS = 100
MOST = 20
"""Drivers at most who are kept back."""
NARROW = 85.0
"""Percent of the truths below which a band of 90 % is too narrow."""
LEAST = 8
"""Drivers below which none is kept back."""


def split(count: int, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the places of drivers to estimate on, and of every fourth, kept back; none of fewer than ``LEAST``."""
    back = np.arange(count)[3::4] if count >= LEAST else np.zeros(0, int)
    return evenly(np.setdiff1d(np.arange(count), back), most), evenly(back, MOST)


def evenly(places: np.ndarray, most: int) -> np.ndarray:
    """Return at most so many places, evenly spread."""
    return places[np.unique(np.linspace(0, len(places) - 1, min(most, len(places))).astype(int))]


def scores(
    estimates: Mapping[str, Estimate], smooth: Sequence[Episode], measured: Sequence[Episode], seed: int = 0
) -> list[dict[str, Any]]:
    """Return the errors of forecasts of the gap, a row for every model and horizon.

    A driver's own parameters and his drift are known from his past alone, about the median of the drivers of the
    estimate. He is followed on what was measured; a forecast begins every 5 s behind the recorded leader. Draws have
    the noise of measurement that the measured gaps have.

    A row has ``model``, ``ahead_s``, ``forecasts``, ``gap_rmse_m`` of the mean, ``gap_crps_m`` (Gneiting, Raftery
    2007), ``crps_by_driver_m`` [drivers with forecasts], and how many percent of measured gaps the central 90 % of
    the draws hold. ``widening`` is the factor by which such a band would hold 90 %; ``widened_90_percent`` is what
    they hold widened by that of the other drivers (None of a single driver).
    """
    batch, raw = (stacked(x) for x in (smooth, measured))
    dt, longest = smooth[0].dt, HORIZONS_S[-1]
    begins = [np.arange(FIRST_S, (len(e) - 1) * dt - longest, EVERY_S) for e in smooth]
    starts = [(r, round(t / dt)) for r, times in enumerate(begins) for t in times]
    later = {ahead: round(ahead / dt) for ahead in HORIZONS_S}
    starts = [(r, t) for r, t in starts if all(np.isfinite(measured[r].gap_m[t + x]) for x in later.values())]
    driver = np.array([r for r, _ in starts])
    rows: list[dict[str, Any]] = []
    for name, estimate in estimates.items() if starts else ():
        drivers = MeasuredDrivers(estimate.drivers.simulator, batch, raw, IDM_NAMES)
        theta = np.broadcast_to(np.median(estimate.theta, 0), (len(smooth), len(IDM_NAMES))).copy()
        levels = forecast.followed(drivers, estimate.settings, theta)
        gap = forecast.draw_gaps(drivers, estimate.settings, theta, levels, starts, longest, DRAWS, seed)
        noise = estimate.settings.noise[0] * np.random.default_rng(seed).standard_normal(gap.shape[1:])
        for ahead, steps in later.items():
            truth, draws = np.array([measured[r].gap_m[t + steps] for r, t in starts]), gap[steps - 1] + noise
            row: dict[str, Any] = {"model": name, "ahead_s": ahead, "forecasts": len(starts)}
            row["gap_rmse_m"] = float(np.sqrt(np.mean((draws.mean(0) - truth) ** 2)))
            crps = forecast.crps(draws, truth)
            row["gap_crps_m"] = float(crps.mean())
            row["crps_by_driver_m"] = [float(crps[driver == r].mean()) for r in np.unique(driver)]
            wide = forecast.half_widths(draws, truth, 0.9)
            row["in_90_percent"] = 100.0 * float((wide <= 1.0).mean())
            row["widening"] = float(np.quantile(wide, 0.9))
            others = [np.quantile(wide[driver != r], 0.9) for r in driver if (driver != r).any()]
            rows.append(row | {"widened_90_percent": 100.0 * float((wide <= others).mean()) if others else None})
    return rows


def foremost(rows: Sequence[Mapping[str, Any]], told: str) -> str:
    """Return the model of the headline and of ``model.yaml``: ``told``, unless another forecasts better beyond chance.

    The error of a driver is his CRPS over the mean of no drift, averaged over the horizons. The model of the least mean
    error takes the place of ``told`` where the difference, paired by driver, is beyond its 95 % interval: Student's t,
    for as many comparisons as there are other models (Bonferroni).
    """
    crps: dict[str, list[list[float]]] = {}
    for row in rows:
        crps.setdefault(row["model"], []).append(row["crps_by_driver_m"])
    errors = {name: np.mean(np.array(x) / np.mean(crps["no drift"], 1, keepdims=True), 0) for name, x in crps.items()}
    least = min(errors, key=lambda name: float(errors[name].mean()), default=told)
    if least == told or len(errors[told]) < 2:
        return told
    gain, level = errors[told] - errors[least], 1.0 - 0.025 / (len(errors) - 1)
    reach = student.ppf(level, len(gain) - 1) * gain.std(ddof=1) / math.sqrt(len(gain))
    return least if gain.mean() > reach else told


def sentence(rows: Sequence[Mapping[str, Any]], told: str) -> str:
    """Return what forecasts best, its CRPS beside those of ``told`` and no drift, and its bands; "" of no rows."""
    best = foremost(rows, told)
    own, *others = ([row for row in rows if row["model"] == name] for name in dict.fromkeys((best, told, "no drift")))
    if not own:
        return ""
    claim = f"forecasts {len(own[0]['crps_by_driver_m'])} drivers kept back better beyond chance"
    first = f"no other model {claim}" if best == told else f"it {claim} than {told}, which the likelihood tells"
    scores = "; ".join(f"{_listed(x, 'gap_crps_m', '.2f')} m with {x[0]['model']}" for x in (own, *others))
    told_of = (
        f"{best.capitalize()}: {first}. CRPS of the gap {_listed(own, 'ahead_s')} s ahead: {scores}. "
        f"Its 90 % bands hold {_listed(own, 'in_90_percent')} % of the gaps."
    )
    if narrow := [row for row in own if row["in_90_percent"] < NARROW]:
        told_of += f" They are too narrow {_listed(narrow, 'ahead_s')} s ahead: {_listed(narrow, 'widening', '.2f')} "
        told_of += (
            "times as wide they hold 90 %. Sigma in model.yaml is not widened: no factor of it suits all horizons."
        )
    return told_of


def _listed(rows: Sequence[Mapping[str, Any]], key: str, digits: str = ".0f") -> str:
    return " and ".join(", ".join(f"{row[key]:{digits}}" for row in rows).rsplit(", ", 1))
