"""What vehicles of one run miss alike at one time: found by turning their clocks against each other, and located.

A driver's own noise knows nothing of another's. Where the vehicles of a run miss the model together, the cause is
theirs together: weather, a closed lane, a sensor's clock. (If they do so in most runs, the model lacks something, and
no run is special.) What leaders' motion foretells by other runs is an answer to the leader, and no cause of a run.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations, product

import numpy as np
from scipy.stats import norm as normal

from idm_env.discovery.march import PULSED
from idm_env.discovery.model import SPREAD
from idm_env.discovery.places import Responses, hats, linear_curve, scan
from idm_env.discovery.records import Rows
from idm_env.effects.free import HISTORY

TURNS = 199
ALPHA = 0.002
"""Scores of chance have longer tails than a normal one: at 0.01 three of 128 generated sets with nothing in them stood
out."""
LARGEST = 6.0
"""A residual counts at most so much: one vehicle's emergency is nobody else's."""
FEWEST_RUNS = 4
LAG_S = 10.0
"""How long ago what a leader did may still be answered to."""
RIDGES = (0.003, 0.03, 0.3)
"""Weights of the prior of coefficients of scaled features, in units of the number of windows."""
STOP_S = 90.0
"""How long after a stop drivers may still answer to it."""
KNOTS = 6
"""Of curves over the past, from the 0.2nd to the 99.8th percentile."""
USUAL = 1.0
"""Score of the other runs, in the median and in units of chance, above which all miss the model and none is special."""


@dataclass(frozen=True)
class Shared:
    """Run, interval of its clock (s), acceleration added there (m/s²), number of vehicles, and p over all runs."""

    run: str
    begin_s: float
    end_s: float
    accel_mps2: float
    vehicles: int
    p_value: float


def find(responses: Responses, seed: int) -> Shared | None:
    """Return the interval of a run in which its vehicles miss the model alike, or None where chance does as much.

    The score of a run is the sum, over pairs of its vehicles and windows of 5 s on one clock, of products of whitened
    residuals. Chance: each vehicle's residuals turned by a random time, which keeps what lasts in a driver, and, as
    vehicles behind each other are unsteady at the same times (all move, or all stand), no less than the root of the
    sum of these products squared; p of a normal score, times the number of runs. The interval is the one of time in
    which an added acceleration explains most of that run, drivers re-calibrated. Followers of one leader have one past,
    so a run has to stand out in what is measured and ``beyond`` what the leaders' motion foretells, and the past by
    ``past_out``: that may err in a run whose past is unlike all others. What comes ``after_stops`` does not count.
    """
    rows, records = responses.rows, responses.rows.records
    counts = ~after_stops(rows, responses.coordinates["time_since_stop"][:, 0])
    left = counts[:, None] * beyond(past_out(responses), leaders(rows), rows.run)
    both = replace(responses, residual=np.hstack([counts[:, None] * responses.residual, left]))
    number = np.round(records.column("time")[rows.start] / (rows.steps * records.dt)).astype(int)
    random = np.random.default_rng(seed)
    score, vehicles = np.full(len(records.runs), np.nan), np.zeros(len(records.runs), int)
    for run in range(len(records.runs)):
        tables = _tables(both, run, number)
        vehicles[run] = len(tables)
        if len(tables) > 1 and tables.shape[1] > 3:
            score[run] = min(standing_out(table, random) for table in np.split(tables, 2, axis=-1))
    tested = int(np.isfinite(score).sum())
    if tested < FEWEST_RUNS:
        return None
    run = int(np.nanargmax(score))
    p_value = float(normal.sf(score[run])) * tested
    if p_value > ALPHA or np.nanmedian(np.delete(score, run)) > USUAL:
        return None
    mine = (rows.run == run) & counts
    of_run = replace(responses, change=responses.change * mine[:, None], residual=left * mine[:, None])
    # Of an interval and the rest of the run drivers' parameters make one and the same: it is the shorter one.
    time = responses.coordinates["time"][mine]
    stretch = scan(of_run, "acceleration", "time", 5.0, longest=0.5 * float(time.max() - time.min()))
    if stretch is None:
        return None
    return Shared(records.runs[run], stretch.begin, stretch.end, stretch.amount, int(vehicles[run]), p_value)


def after_stops(rows: Rows, since: np.ndarray) -> np.ndarray:
    """Return which rows [R] begin less than ``STOP_S`` after their driver stood, ``since`` [R] s ago.

    None does where only one run has such rows: nothing elsewhere tells how drivers answer to a stop.
    """
    after: np.ndarray = since < STOP_S
    return after & (len(np.unique(rows.run[after])) > 1)


def past_out(responses: Responses) -> np.ndarray:
    """Return residuals [R, m] less what the best curve over a feature of the past foresees, fitted to the other runs.

    Where no curve gains, these stand.
    """
    left, most = responses.residual, 0.0
    for what, feature in product(PULSED, HISTORY):
        values = responses.coordinates[feature]
        low, high = np.quantile(values, (0.002, 0.998))
        basis = hats(values, low, max(high - low, 1e-6) / (KNOTS - 1), KNOTS)
        _, gains, without = linear_curve(responses, what, basis, SPREAD)
        if gains.mean() > most:
            of_row, most = responses.units.of_record[responses.rows.record], float(gains.mean())
            left = responses.residual + np.einsum("rmb,rb->rm", responses.answer(what, basis), without[of_row])
    return left


def leaders(rows: Rows) -> np.ndarray:
    """Return what each window's leader did [R, features]: accelerations, brakings and changes of speed at every lag.

    Lags are whole seconds from the window's end to ``LAG_S`` before its begin.
    """
    records = rows.records
    second, end = max(1, round(1.0 / records.dt)), rows.start + rows.steps - 1
    back = second * np.arange(round(LAG_S) + rows.steps // second + 1)
    sample = np.maximum(end[:, None] - back, records.bounds[rows.record][:, None])
    accel, speed = records.column("lead_accel")[sample], records.column("lead_speed")
    return np.concatenate([accel, np.minimum(accel, 0.0), speed[sample] - speed[end][:, None]], axis=1)


def beyond(residual: np.ndarray, features: np.ndarray, run: np.ndarray) -> np.ndarray:
    """Return residuals [R, m] less what a ridge on features [R, F], fitted to the other runs [R], foresees of them.

    Its weight is the one that leaves least; where none leaves less than the residuals themselves, these stand.
    """
    clipped = np.clip(residual, -LARGEST, LARGEST)
    scaled = (features - features.mean(0)) / (features.std(0) + 1e-9)
    masks = [run == number for number in np.unique(run)]
    parts = [(mine, scaled[mine].T @ scaled[mine], scaled[mine].T @ clipped[mine]) for mine in masks]
    matrix, vector = (np.sum([part[i] for part in parts], axis=0) for i in (1, 2))
    best, least = residual, float((clipped**2).sum())
    for weight in RIDGES:
        prior, foreseen = weight * len(run) * np.eye(scaled.shape[1]), np.zeros_like(residual)
        for mine, own, cross in parts:
            foreseen[mine] = scaled[mine] @ np.linalg.solve(matrix - own + prior, vector - cross)
        left = float(((clipped - foreseen) ** 2).sum())
        if left < least:
            best, least = residual - foreseen, left
    return best


def _tables(responses: Responses, run: int, number: np.ndarray) -> np.ndarray:
    """Return residuals [vehicles, windows, m] of a run on one clock, 0 where there is none."""
    rows, episodes = responses.rows, responses.rows.records.episodes
    mine = np.flatnonzero(rows.run == run)
    names = [episodes[r].vehicle_id for r in rows.record[mine]]
    if not names:
        return np.zeros((0, 0, 0))
    vehicles = list(dict.fromkeys(names))
    first = int(number[mine].min())
    table = np.zeros((len(vehicles), int(number[mine].max()) - first + 1, responses.residual.shape[1]))
    table[[vehicles.index(n) for n in names], number[mine] - first] = responses.residual[mine]
    return np.clip(table, -LARGEST, LARGEST)


def standing_out(table: np.ndarray, random: np.random.Generator) -> float:
    """Return the sum of products of residuals [vehicles, windows, m] in units of chance: normal without a cause."""
    vehicles, count, _ = table.shape
    # As it is, and with every vehicle's residuals turned by a random time.
    by = np.concatenate([np.zeros((1, vehicles), int), random.integers(0, count, (TURNS, vehicles))])
    turned = (np.arange(count) + by[..., None]) % count
    total = np.zeros(len(by))
    unsteady = 0.0
    for i, j in combinations(range(vehicles), 2):
        product = np.einsum("ntm,ntm->nt", table[i][turned[:, i]], table[j][turned[:, j]])
        total += product.sum(1)
        unsteady += float((product[0] ** 2).sum())
    return float((total[0] - total[1:].mean()) / (max(total[1:].std(), np.sqrt(unsteady)) + 1e-12))
