"""Drivers of several kinds in one file: told by a column or by their errors, and only where there are several."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from idm_env.data import synthetic
from idm_env.discovery import bases, discover, fleet, write_report
from idm_env.discovery.bases import Law
from idm_env.discovery.fleet import Among
from idm_env.discovery.judge import Judged
from idm_env.discovery.march import Catalogue
from idm_env.discovery.model import Hypothesis
from idm_env.discovery.records import Records, whole, windows
from idm_env.effects import base_named
from idm_env.model_file import load_model
from tests.discovery.conftest import Mixing

NAMES = ("idm", "constant_time_gap", "gipps")


def judged(records: Records, scale: np.ndarray, seed: int) -> Judged:
    """Return errors that are noise, of every record as large as ``scale`` [records] says."""
    random, rows, short = np.random.default_rng(seed), whole(records), windows(records)
    gap, speed = (random.standard_normal(rows.valid.shape) * scale[rows.record][:, None] for _ in range(2))
    measured = [x[np.minimum(rows.samples, len(x) - 1)] for x in (records.gap, records.speed)]
    ahead = random.standard_normal(len(short)) * scale[short.record]
    return Judged(rows, measured[0] + gap, measured[1] + speed, ahead, short.record)


def laws(records: Records, scales: np.ndarray, seed: int) -> tuple[list[Law], Among]:
    """Return laws whose errors are as large as ``scales`` [laws, records], and what judges them for some drivers."""
    models = [Hypothesis((), Catalogue((), base_named(name), located=False)) for name in NAMES]
    every = [judged(records, s, 10 * seed + i) for i, s in enumerate(scales)]
    found = [
        Law(m.catalogue.base, m, e, {"of": None} if i else {})  # type: ignore[dict-item]
        for i, (m, e) in enumerate(zip(models, every, strict=True))
    ]

    def among(model: Hypothesis, wanted: np.ndarray) -> Judged:
        of = every[next(i for i, m in enumerate(models) if m is model)]
        part = whole(records.some(wanted))
        gap, speed = (x[wanted[of.rows.record], : part.valid.shape[1]] for x in (of.gap, of.speed))
        mine = wanted[of.ahead_record]
        record = (np.cumsum(wanted) - 1)[of.ahead_record[mine]]
        return Judged(part, gap, speed, of.ahead[mine], record)

    return found, among


@pytest.mark.parametrize("column", [True, False])
def test_kinds_are_told_where_there_are_some_and_hardly_ever_elsewhere(
    platoon: Records, column: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Laws that err alike are the hardest null: nothing but chance says which is better for a driver."""
    monkeypatch.setattr(fleet, "in_blocks", lambda records: None)
    linear = np.arange(len(platoon)) % 2 == 1
    labels = [e.labels | ({"vehicle_class": "ACC" if x else "car"} if column else {})
              for e, x in zip(platoon.episodes, linear, strict=True)]  # fmt: skip
    episodes = tuple(replace(e, labels=text) for e, text in zip(platoon.episodes, labels, strict=True))
    records = replace(platoon, episodes=episodes)
    alike = np.ones((3, len(records)))
    false = [
        fleet.found(found, found[0].errors, among, seed) is not None
        for seed in range(40) for found, among in [laws(records, alike, seed)]
    ]  # fmt: skip
    assert sum(false) <= 4, "of 40; told and judged by the same half it is 32"
    kinds = np.stack([np.where(linear, 1.0, 0.5), np.where(linear, 0.5, 1.0), alike[0]])
    for seed in range(5):
        found, among = laws(records, kinds, seed)
        told = fleet.found(found, found[0].errors, among, seed)
        assert told is not None and [law.law.kind for law in told.laws] == list(NAMES[:2])
        assert (
            told.group.tolist() == linear[[told.errors.follower.tolist().index(i) for i in range(len(linear))]].tolist()
        )
        assert (told.column, told.classes) == (("vehicle_class", (("car",), ("ACC",))) if column else ("", ()))
        assert told.agreed == len(told.group) and told.against["gap_rmse_m"].ratio == pytest.approx(0.63, abs=0.05)


@pytest.mark.parametrize("column", ["acc_run", ""])
def test_a_mixed_file_has_a_law_for_each_kind_of_driver(
    column: str, kinds: Mixing, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every second driver is a linear controller; what each kind follows is said first, and each has a model."""
    monkeypatch.setattr(bases, "BASES", ("idm", "constant_time_gap"))  # all are compared in test_bases.py
    linear = np.add.outer(np.arange(8), np.arange(2)) % 2 == 1
    kinds(linear)
    made, _ = synthetic.generate(31, runs=8, followers=2, seconds=90.0)
    if column:
        drivers = made.table.filter(pl.col("leader_id").is_not_null()).select("run_id", "vehicle_id").unique()
        names = pl.Series(column, np.where(linear.ravel(), "ACC", "Human"))
        drivers = drivers.sort("run_id", "vehicle_id").with_columns(names)
        table = made.table.join(drivers, on=["run_id", "vehicle_id"], how="left", maintain_order="left")
        made = replace(made, table=table)
    found = discover(made, effects=["lag", "drag"])
    report = found.report
    assert (report["verdict"], report["reason"]) == ("unexplained", "law") and report["fleet"]["column"] == column
    idm, law = report["fleet"]["kinds"]
    assert (idm["base"], law["base"]) == ("idm", "constant_time_gap")
    true = {f"{run + 1}/{2 + i}" for run, i in zip(*np.nonzero(linear), strict=True)}
    assert set(law["drivers"]) == true if column else len(true & set(law["drivers"])) >= 6
    assert law["classes"] == (["ACC"] if column else [])
    first = report["sentence"].split(". ")[0]
    count = len(idm["drivers"]), len(law["drivers"])
    assert first == f"{count[0]} of 16 drivers are predicted best by IDM, {count[1]} by {law['title']}"
    assert (f". Of acc_run, Human by IDM; ACC by {law['title']}. " in report["sentence"]) is bool(column)
    assert not column or count == (8, 8)
    assert all(c["high"] < 1.0 for c in report["fleet"]["against"].values())
    assert law["errors"]["gap_rmse_m"] < 0.5 * law["with_one"]["gap_rmse_m"]
    paths = write_report(found, tmp_path)
    saved = {name: load_model(paths[name]) for name in ("model.yaml", "model_group_1.yaml", "model_group_2.yaml")}
    assert [model.effects[0].name for model in saved.values()] == ["idm", "idm", "constant_time_gap"]
    assert [len(model.drivers) for model in saved.values()] == [16, *count]
    page = paths["report.html"].read_text()
    assert "Drivers of several kinds" in page and "Drivers follow several laws here" in page
    write_report(replace(found, models={"model.yaml": found.model}), tmp_path)
    assert [path.name for path in tmp_path.glob("*.yaml")] == ["model.yaml"], "models of kinds do not stay"
