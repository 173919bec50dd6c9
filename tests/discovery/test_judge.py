"""Errors on runs kept back: parameters of drivers never see what they are scored on, nor what nobody could know."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from idm_env.data import Trajectories, episodes, synthetic
from idm_env.discovery import crossed, discover, judge
from idm_env.discovery.calibrate import first_prior
from idm_env.discovery.march import Catalogue
from idm_env.discovery.model import Hypothesis
from idm_env.discovery.records import Records, gather, whole, windows
from idm_env.effects import BASES, base_named
from tests.discovery.conftest import Mixing

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
    return judge.calibrate(records, Hypothesis(), np.zeros(0), first_prior()).theta


def test_what_happens_before_a_driver_has_settled_moves_no_parameter(records: Records) -> None:
    assert np.array_equal(theta(moved(records, 0.5, 7.9)), theta(records))
    assert not np.allclose(theta(moved(records, 10.0, 20.0)), theta(records), rtol=1e-3)


def test_all_time_is_scored_and_by_parameters_that_have_not_seen_it(records: Records) -> None:
    fold = np.array([0, 1])

    def judged(of: Records) -> judge.Judged:
        return crossed.crossed(of, Hypothesis(), np.zeros((2, 0)), fold)

    rows = whole(records)
    second = judge.halves(rows)
    assert second.any(1).all() and (rows.valid & ~second).any(1).all()
    # The second block of 30 s is moved: what is simulated there stays, what it has fitted changes.
    before, after = judged(records), judged(moved(records, 31.0, 59.0))
    change, block = np.abs(before.gap - after.gap), windows(records).block
    assert change[second].max() < 0.05 * change[rows.valid & ~second].max()
    off = np.abs(before.ahead - after.ahead)
    assert off[block == 3].max() < 0.1 * off[block % 2 == 0].max()
    assert before.squares["gap_rmse_m"][1].sum() == rows.valid.sum()


def test_null_addition_and_other_laws_are_judged_by_one_procedure(monkeypatch: pytest.MonkeyPatch) -> None:
    """Else the calibration, and not the effect, would decide which of them errs less."""
    models, alike = [], set()
    right = crossed.crossed

    def kept(records, model, values, fold, *rest, **named):  # type: ignore[no-untyped-def]
        models.append(model)
        alike.add((id(records), fold.tobytes()))
        return right(records, model, values, fold, *rest, **named)

    monkeypatch.setattr(crossed, "crossed", kept)
    made, _ = synthetic.generate(5, runs=8, followers=2, seconds=80.0, effect="lag")
    found = discover(made, effects=["lag"])
    assert found.verdict == "named"
    assert len(alike) == 1, "the same runs and folds for all"
    judged = {(m.catalogue.base.kind, *m.catalogue.personal) for m in models}
    rows = {(row["base"], *row["own"]) for row in found.report["bases"]}
    assert models[0] is found.null.model and judged >= rows >= {(name,) for name in BASES}


def test_a_driver_whose_fit_stops_in_a_corner_begins_anew(kinds: Mixing) -> None:
    """Two of sixteen linear controllers erred by 4 m under their own law, whose nine parameters had stopped short."""
    kinds(np.ones((8, 2), bool))
    records = gather(list(episodes(synthetic.generate(33, runs=8, followers=2, seconds=90.0)[0], smooth=True)))
    model = Hypothesis((), Catalogue((), base_named("constant_time_gap"), located=False))
    theta = judge.unweighed(records, model, np.zeros(0), first_prior(model.catalogue.own))[1]
    assert judge.judge(records, model, np.zeros(0), theta).gap_rmse.max() < 0.3


@pytest.mark.usefixtures("two_laws")
@pytest.mark.parametrize("every", [11, 20])
def test_data_of_less_than_a_sample_a_second_are_judged(every: int) -> None:
    """Windows hold at least two steps, and a second at least one. Whole seconds have loops of their own."""
    made, _ = synthetic.generate(4, runs=3, followers=2, seconds=120.0)
    some = made.table.filter((pl.col("time_s") * 10.0).round().cast(pl.Int64) % every == 0)
    found = discover(Trajectories.from_frame(some), effects=["drag"])
    assert found.records.dt == pytest.approx(every / 10)
    assert found.report["error"]["before"]["horizon_rmse_m"] > 0.0
