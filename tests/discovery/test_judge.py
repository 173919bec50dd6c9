"""Errors on runs kept back: parameters of drivers never see what they are scored on, nor what nobody could know."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from idm_env.data import Trajectories, episodes, synthetic
from idm_env.discovery import calibrate, discover, judge
from idm_env.discovery.calibrate import first_prior
from idm_env.discovery.model import Model
from idm_env.discovery.records import Records, gather, whole
from idm_env.effects import BASES

POSITION = 14


@pytest.fixture(scope="module")
def records() -> Records:
    made, _ = synthetic.generate(3, runs=2, followers=2, seconds=120.0)
    return gather(list(episodes(made, smooth=True, min_seconds=12.0)))


def moved(records: Records, begin_s: float, end_s: float) -> Records:
    """Return records in which every driver's measured position is off by 2 m for some time."""
    signals = records.signals.copy()
    for first in records.first:
        signals[first + round(begin_s / records.dt) : first + round(end_s / records.dt), POSITION] += 2.0
    return replace(records, signals=signals)


def theta(records: Records) -> np.ndarray:
    return judge.calibrate(records, Model(), np.zeros(0), first_prior()).theta


def test_what_happens_before_a_driver_has_settled_moves_no_parameter(records: Records) -> None:
    assert np.array_equal(theta(moved(records, 0.5, 7.9)), theta(records))
    assert not np.allclose(theta(moved(records, 10.0, 20.0)), theta(records), rtol=1e-3)


def test_all_time_is_scored_and_by_parameters_that_have_not_seen_it(records: Records) -> None:
    def gaps(of: Records) -> np.ndarray:
        return judge.judge(of, Model(), np.zeros(0), first_prior(), None, True).gap

    rows = whole(records)
    second = judge.halves(rows)
    assert second.any(1).all() and (rows.valid & ~second).any(1).all()
    # The second block of 30 s is moved: what is simulated there stays, what it has fitted changes.
    before, after = gaps(records), gaps(moved(records, 31.0, 59.0))
    assert np.array_equal(before[second], after[second])
    assert np.abs(before - after)[rows.valid & ~second].max() > 0.01
    judged = judge.judge(records, Model(), np.zeros(0), first_prior(), None, True)
    assert judged.squares["gap_rmse_m"][1].sum() == rows.valid.sum()


def test_null_addition_and_other_laws_are_calibrated_by_one_procedure(monkeypatch: pytest.MonkeyPatch) -> None:
    """Else the calibration, and not the effect, would decide which of them errs less."""
    calibrated, judged = [], []
    right, judge_right = calibrate.calibrate, judge.judge

    def kept(records, model, values, start=None):  # type: ignore[no-untyped-def]
        calibrated.append((len(records), right(records, model, values, start)))
        return calibrated[-1][1]

    def seen(records, model, values, prior, *rest):  # type: ignore[no-untyped-def]
        judged.append((model, prior))
        return judge_right(records, model, values, prior, *rest)

    monkeypatch.setattr(calibrate, "calibrate", kept)
    monkeypatch.setattr(judge, "judge", seen)
    made, _ = synthetic.generate(5, runs=8, followers=2, seconds=80.0, effect="lag")
    found = discover(made, effects=["lag"])
    assert found.verdict == "named"
    assert {size for size, _ in calibrated} == {12}, "all on the runs that fit"
    of = {id(c.prior): c.model for _, c in calibrated}
    assert all(of[id(prior)] is model for model, prior in judged), "each judged by its own population and weight"
    assert len({m.catalogue.base.kind for m, _ in judged}) == len(BASES) and any(m.terms for m, _ in judged)


@pytest.mark.parametrize("every", [10, 20])
def test_data_of_one_and_half_a_sample_a_second_are_judged(every: int) -> None:
    """Windows hold at least two steps, and a second at least one."""
    made, _ = synthetic.generate(4, runs=3, followers=2, seconds=120.0)
    some = made.table.filter((pl.col("time_s") * 10.0).round().cast(pl.Int64) % every == 0)
    found = discover(Trajectories.from_frame(some), effects=["drag"])
    assert found.records.dt == pytest.approx(every / 10)
    assert found.report["error"]["before"]["horizon_rmse_m"] > 0.0
