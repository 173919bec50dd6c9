r"""Is there a place of a lap where drivers slow down? It is chosen on some runs and judged on others.

    python -m benchmarks.lap_places ../shared/data/openacc_zalazone.parquet --where layout=handling --place track_s_m \
        --per vehicle_name --only TESLA_MODEL3,TESLA_MODELS,TESLA_MODELX [--folds 5] [--longest 200]

For every value of ``--per`` the runs are left out in turn, in ``--folds`` parts. On the other runs that interval of the
lap, of at most ``--longest`` m, is sought in which an added acceleration explains most of the errors of predictions (5
s, whitened, every driver's own parameters following). Judged on the runs left out: the acceleration that is missing in
that interval, drivers fitted anew; and what it does for free simulation, as do a curve of acceleration over the whole
lap and IDM alone, all fitted in free simulation on the other runs. Intervals 95 %, of whole runs.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

for variable in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "POLARS_MAX_THREADS"):
    os.environ.setdefault(variable, "1")

import numpy as np  # noqa: E402 (threads are set before numpy starts)
import polars as pl  # noqa: E402
from scipy.stats import t as student  # noqa: E402

from idm_env.data import Trajectories, load  # noqa: E402
from idm_env.discovery import free, judge, places, search  # noqa: E402
from idm_env.discovery import model as terms  # noqa: E402
from idm_env.discovery.compare import compared  # noqa: E402
from idm_env.discovery.discover import prepare  # noqa: E402
from idm_env.discovery.model import Model  # noqa: E402
from idm_env.discovery.records import Records, windows  # noqa: E402
from idm_env.discovery.search import Search  # noqa: E402
from idm_env.discovery.solve import Task  # noqa: E402
from idm_env.keep import Store  # noqa: E402
from idm_env.progress import silent  # noqa: E402

KNOTS_M = 80.0
MODELS = ("IDM", "interval", "curve")


@dataclass(frozen=True, eq=False)
class Part:
    """Runs left out: the interval that others chose, what is missing there, and every model's errors.

    ``weight`` and ``push`` [runs left out] of the added acceleration (m/s²) there, its estimate is the ratio of their
    sums; of the gap in free simulation ``squares`` [models, followers] of errors (m²) and ``count`` [followers] of
    samples, in runs ``runs`` [followers].
    """

    begin: float
    end: float
    amount: float
    weight: np.ndarray
    push: np.ndarray
    squares: np.ndarray
    count: np.ndarray
    runs: np.ndarray


def part(rest: Records, kept: Records, longest: float) -> Part:
    """Choose an interval of at most ``longest`` m on ``rest`` and judge it on ``kept``, which share no run."""
    rows = windows(rest)
    task = Task(rows, search.first_noise(rows), search.first_prior())
    searching = Search(task, [], True, Store(None, "", False), silent)
    null = searching.null(Model(), np.tile(task.prior.centre, (task.groups, 1)))
    found = places.scan(
        places.respond(searching.task, null), "acceleration", "position", 20.0, shortest=2, longest=longest
    )
    assert found is not None
    there = judge.everywhere(kept, searching.task, null)
    inside = (there.coordinates["position"] >= found.begin) & (there.coordinates["position"] < found.end)
    weight, push = there.design("acceleration", inside[..., None].astype(float))

    at, null = searching.weighed(null)
    count = round(rest.period / KNOTS_M)
    interval = terms.interval("acceleration", "position", found.begin, found.end, found.amount, rest.period)
    curve = terms.curve("acceleration", "position", 0.0, rest.period / count, count, rest.period)
    tried = [(null.model, null.values)]
    tried += [(s.model, s.values) for s in (free.nested(at, t, np.array(t.starts[0])) for t in (interval, curve))]
    judged = [judge.judge(kept, model, values, null.prior, None, True) for model, values in tried]
    squares, counts = zip(*(j.squares["gap_rmse_m"] for j in judged), strict=True)
    runs = np.array([run for run, _ in judged[0].followers])
    # Of few runs followers are counted: summed, so that runs are what an interval rests on.
    of_run = there.units.run[None] == np.arange(len(kept.runs))[:, None]
    return Part(
        found.begin, found.end, found.amount, of_run @ weight[:, 0, 0], of_run @ push[:, 0], np.array(squares),
        counts[0], runs,
    )  # fmt: skip


def parts(trajectories: Trajectories, place: str, folds: int, longest: float) -> list[Part]:
    """Return what all runs say, left out in turn."""
    records = prepare(trajectories, "driver", place)
    runs = [r for i, r in enumerate(records.runs) if np.any(records.run == i)]
    found = []
    for i in range(min(folds, len(runs))):
        out = runs[i::folds]
        found.append(part(records.of_runs([r for r in runs if r not in out]), records.of_runs(out), longest))
        p = found[-1]
        print(f"  others say {p.begin:.0f} to {p.end:.0f} m, {p.amount:+.2f} m/s²; runs left out "
              f"{p.push.sum() / p.weight.sum():+.2f}", flush=True)  # fmt: skip
    return found


def told(name: str, found: Sequence[Part]) -> str:
    """Return a line of the table from the parts [folds], whose runs and followers follow each other in it."""
    weight, push = (np.concatenate([getattr(p, key) for p in found]) for key in ("weight", "push"))
    amount = push.sum() / weight.sum()
    off = push - amount * weight
    runs = int((weight > 0).sum())
    width = student.ppf(0.975, runs - 1) * np.sqrt((off**2).sum() * runs / (runs - 1)) / weight.sum()
    begin, end = np.median([p.begin for p in found]), np.median([p.end for p in found])
    alike = sum(p.begin < end and p.end > begin for p in found)
    cells = [name, f"{begin:.0f} … {end:.0f} m ({alike} of {len(found)})",
             f"{amount:+.2f} ({amount - width:+.2f} … {amount + width:+.2f}) m/s²"]  # fmt: skip
    squares = np.concatenate([p.squares for p in found], axis=1)
    count, run = (np.concatenate([getattr(p, key) for p in found]) for key in ("count", "runs"))
    seen = count > 0
    squares, count, run = squares[:, seen], count[seen], run[seen]
    each = np.sqrt(squares / count)
    cells.append(f"{np.sqrt(squares[0].sum() / count.sum()):.2f}, {np.median(each[0]):.2f} m")
    for i in range(1, len(MODELS)):
        c = compared(squares[0], squares[i], float(count.sum()), run, 0)
        cells.append(f"{c.ratio:.2f} ({c.low:.2f} … {c.high:.2f}), {np.median(each[i]) / np.median(each[0]):.2f}")
    return " | ".join(cells)


def main() -> None:
    """Print a line for every value."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path)
    parser.add_argument("--where", action="append", default=[])
    parser.add_argument("--place", default="position_m")
    parser.add_argument("--per", default="vehicle_name")
    parser.add_argument("--only", default="", help="values of --per; default: all with at least 7 runs")
    parser.add_argument("--folds", type=int, default=5)
    parser.add_argument("--longest", type=float, default=200.0, help="of a place (m)")
    arguments = parser.parse_args()
    begin = time.process_time()
    trajectories = load(arguments.file).where(arguments.where)
    # What the road is like is not told: it is to be found.
    trajectories = replace(trajectories, table=trajectories.table.drop("grade", "altitude_m", strict=False))
    runs = trajectories.table.drop_nulls("leader_id").group_by(arguments.per).agg(pl.col("run_id").n_unique())
    names = arguments.only.split(",") if arguments.only else sorted(r[0] for r in runs.rows() if r[1] >= 7)
    lines = []
    for name in names:
        print(name, flush=True)
        found = parts(
            trajectories.where(f"{arguments.per}={name}"), arguments.place, arguments.folds, arguments.longest
        )
        lines.append(told(name, found))
    print(
        "car | place chosen on other runs (folds that overlap) | missing there on runs left out | IDM: gap, median "
        "follower | with the interval: gap, median follower | with the curve\n--- | --- | --- | --- | --- | ---"
    )
    print("\n".join(lines))
    print(f"{time.process_time() - begin:.0f} CPU s")


if __name__ == "__main__":
    main()
