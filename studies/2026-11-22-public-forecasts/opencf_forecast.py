"""A forecast of OpenCF's 500 test pairs, as a file to submit: drivers fitted to 2.9 s, with drift, six samples.

    python -m benchmarks.opencf_forecast --data ../shared/data --out submission.csv

Every driver's IDM is fitted to his history, with the benchmark's own best IDM for prior (histories alone leave a and v0
open). His time gap wanders as it does on I-80 (docs/drift.md), is followed on the history and drawn into the future; of
30 draws six are submitted, at evenly spaced quantiles of where they end. The truth is hidden, so the end of the history
is masked for an own one.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from pathlib import Path

for variable in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "POLARS_MAX_THREADS"):
    os.environ.setdefault(variable, "1")

import numpy as np  # noqa: E402 (threads are set before numpy starts)
import polars as pl  # noqa: E402
import torch  # noqa: E402

from benchmarks.public_benchmarks import DT, FIRST, NAMES, Clip, Event, RawIDM, events, follow  # noqa: E402
from idm_env.data import Episode, Trajectories, episodes  # noqa: E402
from idm_env.drift import forecast  # noqa: E402
from idm_env.drift.estimate import Settings  # noqa: E402
from idm_env.drift.kinds import behind_a_record  # noqa: E402
from idm_env.drift.linear import Drivers  # noqa: E402
from idm_env.effects import Noise, Wander  # noqa: E402
from idm_env.fitting.batch import Batch  # noqa: E402
from idm_env.fitting.fit import fit  # noqa: E402
from idm_env.fitting.prior import Prior  # noqa: E402
from idm_env.fitting.problem import IDM_NAMES  # noqa: E402

IDM_S = (34.33229236981562, 1.4035660292431589, 1.5441303102564532, 0.2941837321627761, 3.01474382196376, 10.0)
"""The benchmark's best IDM, of its leaderboard: v0, T, a, b, s0, δ."""
SAMPLES, DRAWS = 6, 30
SPREAD, ALIKE_M = 0.3, 2.7
"""Of drivers' log θ about all, and the weight of that: errors of 0.5 m that stay alike over the history."""
SIGMA, MEMORY_S = 0.62, 13.0
NOISE = (2.2, 1.1)
"""I-80's 1 m and 0.5 m/s every half second, every tenth."""
JITTER = 0.1
LEAST = 0.5
"""Least parameter of the prior: a b of 0.29 m/s² is at the bound of ours."""
LENGTH_M = 4.5
NEAREST_M = 0.1
MASKED = 10
"""Steps at the end of the history that are an own truth."""


def prepared(items: list[Event], last: int) -> list[Episode]:
    """Return pairs as episodes, the follower known up to step ``last`` and standing for nothing beyond."""
    tables = []
    for e in items:
        steps = len(e.leader)
        beyond = e.follower[last] + e.follower_speed[last] * DT * np.arange(1, steps - last)
        front = np.concatenate([e.follower[: last + 1], np.minimum(beyond, e.leader[last + 1 :] - NEAREST_M)])
        speed = np.concatenate([e.follower_speed[: last + 1], np.full(steps - last - 1, e.follower_speed[last])])
        rear = np.maximum(e.leader, front + NEAREST_M)
        for vehicle, x, v in ((1, rear + LENGTH_M, e.leader_speed), (2, front, speed)):
            tables.append(pl.DataFrame({
                "run_id": e.name, "vehicle_id": vehicle, "leader_id": [1 if vehicle == 2 else None] * steps,
                "time_s": DT * np.arange(steps), "position_m": x, "speed_mps": np.maximum(v, 0.0),
                "length_m": LENGTH_M,
            }, schema_overrides={"leader_id": pl.Int64}))  # fmt: skip
    found = episodes(Trajectories.from_frame(pl.concat(tables), source="OpenCF"), min_seconds=1.0, max_gap=None)
    by_name = {e.run_id: e for e in found if len(e) == len(next(i for i in items if i.name == e.run_id).leader)}
    return [by_name[e.name] for e in items]


def calibrated(items: list[Episode], last: int, prior_idm: Sequence[float]) -> np.ndarray:
    """Return log θ [pairs, 5] of every driver, fitted to the history up to step ``last`` with a prior."""
    known = [e.part(0, last + 1) for e in items]
    usual = dict(zip(NAMES, prior_idm, strict=True))
    centre = torch.tensor([max(usual[name.removeprefix("idm.")], LEAST) for name in IDM_NAMES]).double()
    prior = Prior(centre.expand(len(known), -1), torch.full((len(known), len(centre)), SPREAD).double(), ALIKE_M)
    own = fit(known, by="driver", loss="mse", starts=1, iterations=25, substeps=1, prior=prior)
    at = {name: i for i, name in enumerate(own.problem.groups)}
    return np.log(np.stack([own.own.numpy()[at[f"{e.run_id}/{e.vehicle_id}"]] for e in items]))


def forecasts(
    items: list[Event], last: int, most: int | None = None, count: int = DRAWS, *,
    prior_idm: Sequence[float] = IDM_S, few: bool = True,
) -> list[tuple[np.ndarray, np.ndarray]]:  # fmt: skip
    """Return positions and speeds [samples, steps] of every follower after step ``last``, ``most`` steps at most.

    ``few`` picks ``SAMPLES`` of ``count`` draws.
    """
    found = prepared(items, last)
    theta = calibrated(found, last, prior_idm)
    batch = Batch.of([e.part(0, last + 1) for e in found], substeps=1)
    drivers = Drivers(behind_a_record(DT, Wander(), Noise()), batch, batch, IDM_NAMES)
    settings = Settings(
        np.array([SIGMA]), np.array([MEMORY_S]), np.array(NOISE), JITTER, np.full(len(IDM_NAMES), 0.0)
    )  # fmt: skip
    levels = forecast.followed(drivers, settings, theta)
    whole = Drivers(drivers.simulator, Batch.of(found, substeps=1), drivers.measured, IDM_NAMES)
    longest = max(len(e.leader) for e in items) - last - 1 if most is None else most
    gap, speed = forecast.drawn(
        whole, settings, theta, levels, [(r, last) for r in range(len(found))], longest * DT, count
    )
    result = []
    for r, e in enumerate(items):
        steps = min(len(e.leader) - last - 1, longest)
        position = e.leader[last + 1 : last + 1 + steps] - gap[:steps, :, r].T
        result.append((position, speed[:steps, :, r].T))
    return [_few(*one) for one in result] if few else result


def _few(position: np.ndarray, speed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the samples at evenly spaced quantiles of where they end."""
    order = np.argsort(position[:, -1])
    at = order[((np.arange(SAMPLES) + 0.5) / SAMPLES * len(order)).astype(int)]
    return position[at], speed[at]


def submission(items: list[Event], made: list[tuple[np.ndarray, np.ndarray]], last: int = FIRST) -> pl.DataFrame:
    """Return the benchmark's table: pair, sample, time from the first unknown step on, place, speed, acceleration."""
    tables = []
    for e, (position, speed) in zip(items, made, strict=True):
        steps = position.shape[1]
        before = np.concatenate([np.full((len(speed), 1), e.follower_speed[last]), speed[:, :-1]], 1)
        for k in range(len(position)):
            tables.append(pl.DataFrame({
                "CF_pair_id": f"test_{int(e.name.removeprefix('pair'))}", "sample_id": k,
                "Time": np.round(DT * np.arange(last + 1, last + 1 + steps), 1), "follower_dist": position[k],
                "follower_speed": speed[k], "follower_acceleration": (speed[k] - before[k]) / DT,
            }))  # fmt: skip
    return pl.concat(tables)


def smallest(items: list[Event], made: list[tuple[np.ndarray, np.ndarray]], last: int) -> tuple[float, float]:
    """Return minADE and minFDE (m) where the truth is known, over ``MASKED`` steps."""
    rows = []
    for e, (position, _) in zip(items, made, strict=True):
        truth = e.follower[last + 1 : last + 1 + MASKED]
        off = np.abs(position[:, : len(truth)] - truth)
        rows.append([off.mean(1).min(), off[:, -1].min()])
    ade, fde = (float(x) for x in np.mean(rows, 0))
    return ade, fde


def main() -> None:
    """Print the errors on what is masked, and write the file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("IDM_ENV_DATA", "../shared/data")))
    parser.add_argument("--out", type=Path, default=Path("opencf_submission.csv"))
    arguments = parser.parse_args()
    items = events(arguments.data / "opencf_test_pairs.parquet", "step")
    last = FIRST - MASKED
    theirs = [
        (p[None], v[None]) for p, v in follow(items, IDM_S, (RawIDM(exponent=None), Clip(-10.0, 5.0)), last)
    ]  # fmt: skip
    steady = [
        (e.follower[last] + e.follower_speed[last] * DT * np.arange(1.0, MASKED + 1.0)[None], np.zeros((1, MASKED)))
        for e in items
    ]
    ours = forecasts(items, last, MASKED)
    rows = {"speed stays": steady, "IDM(s) of the benchmark": theirs, "ours, six samples": ours,
            "ours, their mean": [(p.mean(0, keepdims=True), v.mean(0, keepdims=True)) for p, v in ours]}  # fmt: skip
    for name, made in rows.items():
        ade, fde = smallest(items, made, last)
        print(f"last {MASKED * DT:g} s of the history, {name}: minADE {ade:.3f} m, minFDE {fde:.3f} m")
    made = forecasts(items, FIRST)
    through = sum(bool((p > e.leader[FIRST + 1 :]).any()) for e, (p, _) in zip(items, made, strict=True))
    submission(items, made).write_csv(arguments.out)
    print(f"{arguments.out}: {len(items)} pairs, {SAMPLES} samples; a sample collides in {through}")


if __name__ == "__main__":
    main()
