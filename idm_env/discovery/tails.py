"""Where errors are: noise of drivers is everywhere, an effect is somewhere."""

from dataclasses import dataclass

import numpy as np

from idm_env.discovery.records import Rows
from idm_env.discovery.ridge import by_group

WORST = 0.05
"""Share of the windows whose squared errors are added up."""
FLOOR_M = 0.05
"""Error (m) that a window counts at least: drivers who are predicted perfectly tell nothing."""
BEFORE_S = 15.0
"""How long before a window a stop or a braking may have ended."""
LEAST_LIFT = 1.5
"""Times that a condition must be commoner among the worst windows than among all to be told."""


@dataclass(frozen=True)
class Worst:
    """The commonest condition of the worst windows: in words, its share of their squared error and of all windows."""

    where: str
    share: float
    of_all: float


def _relative(rows: Rows, error: np.ndarray) -> np.ndarray:
    square = error**2 + FLOOR_M**2
    return np.asarray(square / by_group(rows, square))


def concentration(rows: Rows, error: np.ndarray) -> float:
    """Return the share of squared errors [W], each over its driver's mean, that the ``WORST`` of all windows hold."""
    relative = np.sort(_relative(rows, error))[::-1]
    return float(relative[: max(1, round(WORST * len(relative)))].sum() / relative.sum())


def held_by(rows: Rows, error: np.ndarray) -> tuple[str, ...]:
    """Return the fewest groups of drivers who hold half of the squared errors [W]."""
    total = np.bincount(rows.group, error**2)
    order = np.argsort(-total)
    count = int(np.searchsorted(np.cumsum(total[order]), 0.5 * total.sum())) + 1
    return tuple(rows.records.groups[group] for group in order[:count])


def worst(rows: Rows, error: np.ndarray) -> Worst | None:
    """Return the condition that is commoner in the windows with the largest errors [W] than in all, or None."""
    relative, records, dt = _relative(rows, error), rows.records, rows.records.dt
    largest = relative >= np.quantile(relative, 1.0 - WORST)
    half = max(1, round(0.5 / dt))
    inside = rows.start[:, None] + np.arange(0, rows.steps, half)
    before = rows.start[:, None] - np.arange(0, round(BEFORE_S / dt), half)
    past = np.maximum(before, records.bounds[rows.record][:, None])
    leader, speed, own = records.column("lead_accel"), records.speed, records.column("accel")
    conditions = {
        "after a stop": speed[past].min(1) < 1.0,
        "at speeds below 5 m/s": speed[inside].mean(1) < 5.0,
        "at speeds above 20 m/s": speed[inside].mean(1) > 20.0,
        "while the leader brakes": leader[inside].min(1) < -1.0,
        "while the leader accelerates": leader[inside].max(1) > 0.7,
        "after hard braking of the leader": leader[past].min(1) < -2.0,
        "after hard braking": own[past].min(1) < -2.0,
        "far behind the leader": records.gap[rows.start] > 3.0 * np.maximum(speed[rows.start], 5.0),
    }
    each = [
        Worst(name, float(relative[largest & on].sum() / relative[largest].sum()), float(on.mean()))
        for name, on in conditions.items()
    ]
    common = [one for one in each if one.share > LEAST_LIFT * one.of_all]
    return max(common, key=lambda one: one.share - one.of_all, default=None)
