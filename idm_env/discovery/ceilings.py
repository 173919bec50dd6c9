"""How much could be explained at all: what repeats, what a driver's own drift takes, what the sensors leave.

None of these needs a candidate. They stand beside the errors before and after, because an error that does not repeat
and that a refitted driver does not have is no model's fault.
"""

from dataclasses import replace

import numpy as np
import polars as pl
from scipy.integrate import cumulative_trapezoid
from scipy.spatial import cKDTree

from idm_env.data import Trajectories
from idm_env.data.columns import with_step
from idm_env.discovery import judge
from idm_env.discovery.closed_loop import ClosedLoopFit
from idm_env.discovery.records import Records, whole
from idm_env.discovery.result import Ceilings
from idm_env.discovery.solve import Problem, Solution

NEIGHBOURS = 10
EVERY = 4
"""Every so many samples of 0.5 s of free simulation are compared with matched situations."""
CORRECTED_S = 10.0
"""Time in which a driver corrects an error of the gap; slow drift adds up over about that long."""
LAGS_S = (5.0, 20.0)


def ceilings_of(at: ClosedLoopFit, test: Records, null: Solution, smooth_gain: float) -> Ceilings:
    """Return the ceilings, None where these data have none.

    Args:
        at: IDM in free simulation of the validation runs.
        test: Runs of the test set, or all.
        null: IDM.
        smooth_gain: Of the best smooth function of the state over IDM, in log RMSE in windows of 5 s.
    """
    values = repeats(at), refitted(test, null), 1.0 - float(np.exp(-smooth_gain))
    return Ceilings(*(value if np.isfinite(value) else None for value in values))


def repeats(at: ClosedLoopFit) -> float:
    """Return the share of the gap's squared error that repeats in matched situations of other runs.

    A situation is speed, time gap, closing speed and the leader's acceleration; the covariance of an error with the
    mean error of the nearest ones in other runs, over the variance.
    """
    rows, records = at.problem.rows, at.problem.rows.records
    valid = at.scored.copy()
    valid[:, np.arange(valid.shape[1]) % EVERY != 0] = False
    i, j = np.nonzero(valid)
    samples, error, run = rows.samples[i, j], at.errors[i, j], rows.run[i]
    speed, gap = records.speed[samples], records.gap[samples]
    closing, lead_accel = speed - records.column("lead_speed")[samples], records.column("lead_accel")[samples]
    situation = np.stack([speed, np.log(np.maximum(gap, 1.0) / (speed + 2.0)), closing, lead_accel], 1)
    situation /= situation.std(0) + 1e-9
    error = np.clip(error, *np.quantile(error, [0.01, 0.99])) if len(error) else error
    square, product = 0.0, 0.0
    for r in np.unique(run):
        mine = run == r
        if (~mine).sum() < NEIGHBOURS:
            continue
        _, near = cKDTree(situation[~mine]).query(situation[mine], k=NEIGHBOURS)
        product += float((error[mine] * error[~mine][near].mean(1)).sum())
        square += float((error[mine] ** 2).sum())
    return float("nan") if square == 0.0 else float(np.clip(product / square, 0.0, 1.0))


def refitted(records: Records, null: Solution) -> float:
    """Return the gap RMSE (m) of records if drivers are fitted to just the half of their time that is scored."""
    rows, empty, square = whole(records), np.zeros((1, 0)), 0.0
    second = judge.halves(rows)
    for half in (second, rows.valid & ~second):
        own = replace(rows, valid=half)
        problem, theta = judge.unweighed(records, null.model, null.values, null.prior, own, null.theta)
        errors = Problem(own, None, problem.prior).errors(theta[None], null.model.fixed(null.values), empty)[0]
        square += float((errors**2).sum())
    return float(np.sqrt(square / rows.valid.sum()))


def drift(trajectories: Trajectories) -> float:
    """Return by how much a measured gap wanders against integrated speeds: the root of its variance per time (m/√s).

    ``gap(t) − ∫ (lead speed − speed) dt`` is white noise and a random walk; lags of 5 and 20 s tell them apart. A
    straight line, which a constant offset of a speed leaves, is taken out of every stretch. 0 where the file does not
    give gap and speed both.
    """
    if any(r.kind == "speed estimated" for r in trajectories.repairs):
        return 0.0
    table = with_step(trajectories)
    leaders = table.select("run_id", "step", leader_id="vehicle_id", lead_speed="speed_mps")
    both = table.filter(pl.col("gap_measured") & pl.col("gap_m").is_finite()).join(
        leaders, on=["run_id", "leader_id", "step"], how="inner", maintain_order="left"
    )
    sums, counts = np.zeros(len(LAGS_S)), np.zeros(len(LAGS_S))
    pair = ["run_id", "vehicle_id", "leader_id"]
    for (run, _, _), part in both.partition_by(pair, as_dict=True, maintain_order=True).items():
        dt = trajectories.steps[run]
        time = part["time_s"].to_numpy()
        opening = (part["lead_speed"] - part["speed_mps"]).to_numpy()
        off = part["gap_m"].to_numpy() - cumulative_trapezoid(opening, dx=dt, initial=0.0)
        for piece in np.split(np.arange(len(time)), np.flatnonzero(np.diff(time) > 1.5 * dt) + 1):
            if len(piece) * dt < 3.0 * LAGS_S[1]:
                continue
            line = np.polyval(np.polyfit(time[piece] - time[piece[0]], off[piece], 1), time[piece] - time[piece[0]])
            rest = off[piece] - line
            for k, lag in enumerate(LAGS_S):
                step = rest[round(lag / dt) :] - rest[: -round(lag / dt)]
                sums[k] += float((step**2).sum())
                counts[k] += len(step)
    if not counts.all():
        return 0.0
    short, long = sums / counts
    return float(np.sqrt(max(long - short, 0.0) / (LAGS_S[1] - LAGS_S[0])))


def floor(records: Records, drift_m: float) -> dict[str, float]:
    """Return the errors that sensors alone would leave: white noise, and what a gap drifts by (m/√s) till corrected."""
    white = judge.floor(records)
    slow = drift_m**2 * CORRECTED_S / 2.0
    gaps = {name: float(np.sqrt(m**2 + slow)) for name, m in white.items() if name != "speed_rmse_mps"}
    return white | gaps | {"drift_m_per_sqrt_s": drift_m}
