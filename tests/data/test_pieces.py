"""A long recording cut into runs: every driver counts once, and where the same ones stay it is refused."""

from __future__ import annotations

import polars as pl
import pytest

from idm_env.data import DataError, Trajectories, pieces
from idm_env.data.fingerprint import fitted_on


def passing(stay: float, every: float, seconds: float = 480.0) -> Trajectories:
    """A recording of vehicles that enter one after another and stay in view for a while."""
    rows = []
    for vehicle in range(int(seconds / every)):
        for step in range(int(stay / 0.5)):
            time = vehicle * every + 0.5 * step
            rows.append((vehicle, time, 10.0 * (time - vehicle * every), vehicle - 1 if vehicle else None))
    frame = pl.DataFrame(
        rows, schema=["vehicle_id", "time_s", "position_m", "leader_id"], orient="row", infer_schema_length=None
    )
    return Trajectories.from_frame(frame, source="road.csv")


def test_every_driver_counts_in_one_run_and_keeps_his_neighbours() -> None:
    whole = passing(stay=30.0, every=6.0)
    cut = pieces.split_runs(whole, 60.0)
    assert cut.runs()[:2] == ["0@0s", "0@120s"] and len(cut.runs()) == 9 and set(cut.steps) == set(cut.runs())
    assert cut.table.height == whole.table.height
    assert sorted(vehicle for _, vehicle in cut.followers()) == sorted(vehicle for _, vehicle in whole.followers())
    spans = cut.table.group_by("run_id").agg(pl.col("time_s").max() - pl.col("time_s").min())["time_s"]
    assert spans.max() <= 60.0
    names = {mark.partition(";")[2] for mark in fitted_on(cut, cut.followers())["tracks"]}
    assert names == {f"0/{vehicle}" for _, vehicle in whole.followers()}  # as the file has them
    part = whole.where("vehicle_id=7")
    with pytest.raises(DataError, match="only 1 would have drivers of their own"):
        pieces.split_runs(part, 60.0)


@pytest.mark.parametrize(
    ("stay", "every", "cure"),
    [(30.0, 6.0, "add --split-runs 60s"), (10.0, 6.0, "add --split-runs 60s"), (480.0, 160.0, "record 7 runs")],
)
def test_the_cure_is_named_only_where_it_is_one(stay: float, every: float, cure: str) -> None:
    """A platoon that is in view all the time has no drivers to hold out."""
    whole = passing(stay, every)
    assert cure in str(pieces.cure(whole))
    assert "add" not in cure or pieces.cure(pieces.split_runs(whole, 60.0)) is None


@pytest.mark.parametrize("text", ["60x", "", "5s", "nan", "1e9"])
def test_what_is_no_duration_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"--split-runs = .*(no duration|outside)"):
        pieces.seconds_of(text)


def test_durations_have_a_unit_or_none() -> None:
    assert pieces.seconds_of("60s") == pieces.seconds_of(" 60 S") == pieces.seconds_of("60") == 60.0
