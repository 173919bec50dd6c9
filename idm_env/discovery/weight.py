"""How much the population says of one driver: the weight of its prior, chosen before any effect is judged.

On short or noisy records this decides more than any effect does. With too light a prior drivers are over-fitted, and an
effect that only regularises them looks like a finding.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from idm_env.discovery import judge
from idm_env.discovery.records import Records, whole
from idm_env.discovery.solve import Solution

GRID_S = (5.0, 15.0, 50.0, 150.0)
"""Times (s) over which errors of free simulation may be taken to be alike: the longer, the more the prior weighs."""


@dataclass(frozen=True)
class Weight:
    """The time chosen (s), and the gap RMSE (m) of free simulation that every time of ``GRID_S`` left."""

    alike_s: float
    gap_rmse_m: tuple[float, ...]


def chosen(records: Records, null: Solution) -> Weight:
    """Return the weight with which the null predicts best what its drivers' parameters have not seen.

    As the judgement does on runs kept back, but on the runs that choose: θ of every driver from every other block of
    time, with the population as prior; scored on the blocks between.
    """
    rows = whole(records)
    scored = judge.halves(rows)
    part = replace(rows, valid=rows.valid & ~scored)
    task, theta = judge.unweighed(records, null.model, null.values, null.prior, part, null.theta)
    thetas = []
    for seconds in GRID_S:
        heavier = replace(task, prior=replace(task.prior, alike_s=seconds))
        thetas.append(judge.weighed(heavier, null.model, null.values, theta).theta)
    values = np.repeat(null.values[None], len(GRID_S), axis=0)
    errors = replace(task, rows=replace(rows, valid=scored)).errors(np.stack(thetas), null.model, values)
    squares = (errors**2).sum((1, 2)) / max(scored.sum(), 1)
    return Weight(GRID_S[int(squares.argmin())], tuple(np.sqrt(squares).tolist()))
