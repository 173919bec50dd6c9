"""How well drivers who were kept back are foreseen: with drift as estimated on others, and without any.

Shapes: places of drivers are ``[k]``.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from idm_env.data import Episode
from idm_env.drift import forecast
from idm_env.drift.estimate import Estimate
from idm_env.drift.linear import MeasuredDrivers
from idm_env.fitting.batch import Batch
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
    estimate. He is followed on what was measured; a forecast begins every 5 s behind the recorded leader. A row has
    ``model``, ``ahead_s``, ``forecasts``, ``gap_rmse_m`` of the mean, ``gap_crps_m`` (Gneiting, Raftery 2007) and how
    many percent of true gaps the central 50 and 90 % of the draws hold. ``widening`` is the factor by which the latter
    would hold 90 %.
    """
    batch, raw = (Batch.stack(x, substeps=1) for x in (smooth, measured))
    dt, longest = smooth[0].dt, HORIZONS_S[-1]
    begins = [np.arange(FIRST_S, (len(e) - 1) * dt - longest, EVERY_S) for e in smooth]
    starts = [(r, round(t / dt)) for r, times in enumerate(begins) for t in times]
    rows: list[dict[str, Any]] = []
    for name, estimate in estimates.items() if starts else ():
        drivers = MeasuredDrivers(estimate.drivers.simulator, batch, raw, IDM_NAMES)
        theta = np.broadcast_to(np.median(estimate.theta, 0), (len(smooth), len(IDM_NAMES))).copy()
        levels = forecast.followed(drivers, estimate.settings, theta)
        gap, _ = forecast.draw_gaps(drivers, estimate.settings, theta, levels, starts, longest, DRAWS, seed)
        for ahead in HORIZONS_S:
            steps = round(ahead / dt)
            truth = np.array([measured[r].gap_m[t + steps] for r, t in starts])
            draws = gap[steps - 1]
            able = np.isfinite(truth) & np.isfinite(draws).all(0)
            truth, draws = truth[able], draws[:, able]
            row = {"model": name, "ahead_s": ahead, "forecasts": int(able.sum())}
            row["gap_rmse_m"] = float(np.sqrt(np.mean((draws.mean(0) - truth) ** 2)))
            row["gap_crps_m"] = float(forecast.crps(draws, truth).mean())
            for percent in (50, 90):
                inside = forecast.covers(draws, truth, percent / 100)[0]
                row[f"in_{percent}_percent"] = 100.0 * float(inside.mean())
            rows.append(row | {"widening": forecast.widening(draws, truth, 0.9)})
    return rows


def sentence(rows: Sequence[Mapping[str, Any]], name: str | None, drivers: int) -> tuple[str, str]:
    """Return the model with the best longest forecasts and what they score beside ``name`` and no drift; "" of none."""
    last = {row["model"]: row for row in rows if row["ahead_s"] == HORIZONS_S[-1]}
    if not last:
        return "", ""
    least = min(last.values(), key=lambda row: row["gap_crps_m"])
    shown = [least, *(last[n] for n in dict.fromkeys((name, "no drift")) if n and n != least["model"])]
    band = f"the 90 % band of the first holds {least['in_90_percent']:.0f} %"
    if least["in_90_percent"] < NARROW:
        band += f", which is too narrow: {least['widening']:.2f} times as wide it holds 90 %"
    scores = ", ".join(f"{row['gap_crps_m']:.2f} m with {row['model']}" for row in shown)
    return least["model"], (
        f"{least['model'].capitalize()} forecasts best: on {drivers} drivers kept back the CRPS of the gap "
        f"{HORIZONS_S[-1]:.0f} s ahead is {scores}; {band}."
    )
