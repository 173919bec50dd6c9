"""The 20 published I-80 test pairs, driver-adapted: parameters of a pair from its first half, errors on its second.

The population (centre and spread of log θ) and the strength of an effect come from the 100 training pairs, by whitened
5 s predictions; θ of a test pair from its first half, in free simulation, with the population as prior; its second half
is simulated freely from the measured state in the middle.

    python -m benchmarks.adapted --data ../shared/data
"""

from __future__ import annotations

import argparse
import dataclasses
import os
from pathlib import Path

import numpy as np

from idm_env.data import load
from idm_env.discovery import judge, records, search
from idm_env.discovery import model as terms
from idm_env.discovery.discover import prepare
from idm_env.discovery.model import Frozen, Model
from idm_env.discovery.solve import Solution, Task
from idm_env.keep import Store

EFFECTS = ("asymmetry", "delay", "lag", "leader_acceleration", "speed_dependent_gap", "memory", "dead_zone", "gap_bias")


def fitted(training: records.Records) -> list[Solution]:
    """Return IDM and IDM with every effect on the training pairs: population, and the effect's strength."""
    rows = records.windows(training)
    task = Task(rows, search.first_noise(rows), search.first_prior())
    theta = np.tile(task.prior.centre, (task.groups, 1))
    found = []
    for name in (None, *EFFECTS):
        model = Model() if name is None else Model((terms.simple(name),))
        searching = search.Search(task, (), False, Store(None, "", False), lambda *_: None)
        starts = [np.zeros(0)] if name is None else [np.array(s) for s in terms.simple(name).starts]
        best = min((searching.null(model, theta, s) for s in starts), key=lambda s: s.cost)
        found.append(searching.weighed(best)[1])
    return found


def errors(test: records.Records, s: Solution) -> np.ndarray:
    """Return the spacing RMSE (m) of every test pair's second half."""
    rows = records.whole(test, longest_s=1e6)
    middle = ((test.first + test.bounds[1:]) // 2)[rows.record]
    ahead = rows.start[:, None] + rows.every * (1 + np.arange(rows.valid.shape[1]))
    early = dataclasses.replace(rows, valid=rows.valid & (ahead < middle[:, None]))
    theta = judge.calibrate(test, s.model, s.values, s.prior, early).theta
    count = int((test.bounds[rows.record + 1] - middle).max() - 1) // rows.every
    ahead = middle[:, None] + rows.every * (1 + np.arange(count))
    late = dataclasses.replace(
        rows, start=middle, steps=count * rows.every, valid=ahead < test.bounds[rows.record + 1][:, None]
    )
    task = Task(late, None, s.prior)
    off = task.errors(theta[None], Frozen(s.model, s.values), np.zeros((1, 0)))[0]
    return np.asarray(np.sqrt((off**2).sum(1) / late.valid.sum(1)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("IDM_ENV_DATA", "../shared/data")))
    arguments = parser.parse_args()
    trajectories = load(arguments.data / "ngsim_i80_pairs.parquet").where("in_manifest=true")
    training, test = (prepare(part, "driver") for part in trajectories.split("split=test"))
    print(f"{len(training)} training pairs, {len(test)} test pairs")
    print("model | mean spacing RMSE of the second halves, m | median | pairs better than IDM\n--- | --- | --- | ---")
    base = None
    for s in fitted(training):
        rmse = errors(test, s)
        base = rmse if base is None else base
        strength = "".join(
            f" + {t.effect} {', '.join(f'{v:.3f}' for v in s.values)}" for t in s.model.terms
        )  # fmt: skip
        print(f"IDM{strength} | {rmse.mean():.3f} | {np.median(rmse):.3f} | {(rmse < base).mean():.0%}", flush=True)


if __name__ == "__main__":
    main()
