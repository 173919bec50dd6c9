r"""What several named terms together do for free simulation of runs that fitted nothing: all are left out in turn.

    python -m benchmarks.joint_terms ../shared/data/openacc_astazero.parquet --where acc_run=ACC \
        --terms lag,leader_acceleration,asymmetry,speed_time_gap,set_point_asymmetry [--per vehicle_name] [--folds 3]

The terms' parameters are shared (by all, or by all of one value of ``--per``) and fitted with every driver's IDM in
free simulation on the other runs. Drivers of the run left out get their IDM from every other 30 s with the population
as prior, with and without the terms, and the stretches between are scored. Nothing is chosen on them.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

for variable in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "POLARS_MAX_THREADS"):
    os.environ.setdefault(variable, "1")

import numpy as np  # noqa: E402 (threads are set before numpy starts)

from idm_env.data import Trajectories, load  # noqa: E402
from idm_env.discovery import judge, search  # noqa: E402
from idm_env.discovery.discover import prepare  # noqa: E402
from idm_env.discovery.march import Catalogue  # noqa: E402
from idm_env.discovery.model import Model, simple  # noqa: E402
from idm_env.discovery.records import Records, whole  # noqa: E402
from idm_env.discovery.solve import Prior, Task, solve  # noqa: E402
from idm_env.effects import make  # noqa: E402

ERRORS = ("gap_rmse_m", "horizon_rmse_m", "speed_rmse_mps")


def fitted(records: Records, names: Sequence[str]) -> list[tuple[Model, np.ndarray, Prior]]:
    """Return IDM and IDM with the terms as fitted on these records, each with its drivers' spread."""
    catalogue = Catalogue(tuple(make(name) for name in names), located=False)
    plain, joint = Model((), catalogue), Model(tuple(simple(name) for name in names), catalogue)
    rows, weak = whole(records).settled(), replace(search.first_prior(), free=False)
    task = Task(rows, None, weak)
    first = solve(task, plain, np.tile(weak.centre, (task.groups, 1)), np.zeros(0), iterations=10, tolerance=1e-3)
    prior = search.population(first.theta, rows)
    found = [(plain, np.zeros(0), prior)]
    starts = np.concatenate([np.array(t.starts[0]) for t in joint.terms])
    best = solve(replace(task, prior=replace(prior, free=False)), joint, first.theta, starts, iterations=15)
    found.append((joint, best.values, search.population(best.theta, rows)))
    return found


def left_out(
    trajectories: Trajectories, names: Sequence[str], folds: int
) -> list[dict[str, tuple[np.ndarray, np.ndarray]]]:
    """Return sums of squares and counts of every held-out follower's errors, without and with the terms."""
    records = prepare(trajectories, "driver")
    kept: list[list[dict[str, tuple[np.ndarray, np.ndarray]]]] = [[], []]
    for i in range(min(folds, len(records.runs))):
        runs = records.runs[i::folds]
        rest = records.of_runs([r for r in records.runs if r not in runs])
        told = []
        for which, (model, values, prior) in enumerate(fitted(rest, names)):
            judged = judge.judge(records.of_runs(runs), model, values, prior, None, True)
            kept[which].append(judged.squares)
            told.append(judged.summary())
            if len(values):
                numbers = ", ".join(f"{p.symbol} {x:.3g}" for p, x in zip(model.parameters, values, strict=True))
        print(
            f"  {', '.join(runs)}: gap {told[0]['gap_rmse_m']:.2f} -> {told[1]['gap_rmse_m']:.2f} m; {numbers}",
            flush=True,
        )
    return [
        {key: (np.concatenate([s[key][0] for s in part]), np.concatenate([s[key][1] for s in part])) for key in ERRORS}
        for part in kept
    ]


def main() -> None:
    """Print errors before and after, pooled and of the median follower, with a bootstrap over followers."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path)
    parser.add_argument("--where", action="append", default=[])
    parser.add_argument("--terms", default="lag,leader_acceleration,asymmetry,speed_time_gap,set_point_asymmetry")
    parser.add_argument("--per", default="", help="column: the terms' parameters are its own for every value")
    parser.add_argument("--folds", type=int, default=1000, help="parts of the runs to leave out; default: one run each")
    arguments = parser.parse_args()
    begin = time.process_time()
    trajectories = load(arguments.file).where(arguments.where)
    followers = trajectories.table.drop_nulls("leader_id")
    values = followers[arguments.per].unique().sort().to_list() if arguments.per else [None]
    parts = []
    for value in values:
        print(value or "all followers", flush=True)
        some = trajectories if value is None else trajectories.where(f"{arguments.per}={value}")
        parts.append(left_out(some, arguments.terms.split(","), arguments.folds))
    random = np.random.default_rng(0)
    for key in ERRORS:
        squares = [np.concatenate([part[which][key][0] for part in parts]) for which in range(2)]
        count = np.concatenate([part[0][key][1] for part in parts])
        seen = count > 0
        was, now, count = squares[0][seen], squares[1][seen], count[seen]
        drawn = random.integers(0, len(count), (2000, len(count)))
        pooled = np.sqrt(now[drawn].sum(1) / was[drawn].sum(1))
        before, after = np.sqrt(was / count), np.sqrt(now / count)
        medians = np.median(after[drawn], 1) / np.median(before[drawn], 1)
        print(
            f"{key}: pooled {np.sqrt(was.sum() / count.sum()):.3f} -> {np.sqrt(now.sum() / count.sum()):.3f}, ratio "
            f"{np.sqrt(now.sum() / was.sum()):.3f} [{np.quantile(pooled, 0.025):.3f}, "
            f"{np.quantile(pooled, 0.975):.3f}]; "
            f"median follower {np.median(before):.3f} -> {np.median(after):.3f}, ratio "
            f"{np.median(after) / np.median(before):.3f} [{np.quantile(medians, 0.025):.3f}, "
            f"{np.quantile(medians, 0.975):.3f}]; {(after < before).sum()} of {len(count)} improve"
        )
    print(f"{time.process_time() - begin:.0f} CPU s")


if __name__ == "__main__":
    main()
