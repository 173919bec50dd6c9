"""Two driving directions in one file, as on the motorways of highD: each vehicle by its own net displacement."""

from __future__ import annotations

import importlib
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from idm_env.data import DataError, Trajectories, load
from idm_env.trajectories import spool
from idm_env.trajectories.files import filter_file
from tests.data.tables import kinds, platoon
from tests.trajectories.tracks import read_repaired


def both_ways(signed: bool = True, lane: int | None = 5) -> pl.DataFrame:
    """Three vehicles of lane 2 that drive towards rising, three of `lane` (7 to 9) towards falling positions.

    Front bumpers; speeds of those who fall are negative where ``signed``, as in highD.
    """
    there = platoon(speed=25.0).drop("leader_id").with_columns(lane=pl.lit(2), run_id=pl.lit("60"))
    sign = -1.0 if signed else 1.0
    back = there.with_columns(
        pl.col("vehicle_id") + 6, position_m=900.0 - pl.col("position_m"), speed_mps=sign * pl.col("speed_mps"),
        lane=pl.lit(lane, pl.Int32),
    )  # fmt: skip
    return pl.concat([there, back], how="vertical_relaxed")


def leaders(table: pl.DataFrame) -> dict[str, set[str | None]]:
    return {
        str(vehicle): set(part["leader_id"])
        for (vehicle,), part in table.partition_by("vehicle_id", as_dict=True).items()
    }


@pytest.mark.parametrize("signed", [True, False], ids=["signed_speeds", "magnitudes"])
@pytest.mark.parametrize("lane", [5, 2], ids=["lanes_apart", "one_number_for_both"])
def test_leaders_are_right_both_ways(signed: bool, lane: int) -> None:
    """Vehicle 7 is in front of 8 where positions fall; nobody follows across the median."""
    made = Trajectories.from_frame(both_ways(signed, lane))
    expected = {"1": {None}, "2": {"1"}, "3": {"2"}, "7": {None}, "8": {"7"}, "9": {"8"}}
    assert leaders(made.table) == expected
    assert kinds(made.repairs)["direction mirrored"] == 3
    assert set(made.runs()) == {"60", "60-reverse"}
    alone = Trajectories.from_frame(platoon(speed=25.0)).table
    for run in made.runs():
        mine = made.table.filter(pl.col("run_id") == run)
        assert np.allclose(mine["gap_m"].drop_nulls(), alone["gap_m"].drop_nulls())
        assert np.allclose(mine["speed_mps"], alone["speed_mps"])
        assert np.allclose(mine["position_m"].diff(), alone["position_m"].diff(), equal_nan=True)


def test_who_hardly_moves_drives_as_his_lane_does() -> None:
    """A vehicle that stands at the end of the queue is mirrored with the others of its lane."""
    table = both_ways()
    stand = table.filter(pl.col("vehicle_id") == 9).with_columns(position_m=pl.lit(500.0), speed_mps=pl.lit(0.0))
    made = Trajectories.from_frame(pl.concat([table.filter(pl.col("vehicle_id") != 9), stand]))
    assert kinds(made.repairs)["direction mirrored"] == 3
    assert leaders(made.table)["9"] == {"8"}


def test_a_file_in_which_all_positions_fall_is_refused_and_a_ring_is_left_alone() -> None:
    """There the sign is wrong, or a fall is a new lap."""
    with pytest.raises(DataError, match="change its sign"):
        Trajectories.from_frame(both_ways(False).filter(pl.col("vehicle_id") > 3))
    lap = platoon(speed=12.0).with_columns(pl.col("position_m") % 300.0)
    assert "direction mirrored" not in kinds(Trajectories.from_frame(lap, ring_length=300.0).repairs)


def test_filter_mirrors_too_whatever_the_pieces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same vehicles, counted, with leaders, although the rows of a vehicle are spread over pieces of the file."""
    table = both_ways().sort("time_s", maintain_order=True)
    path = tmp_path / "both.parquet"
    table.write_parquet(path)
    monkeypatch.setattr(importlib.import_module("idm_env.data.load"), "BATCH_ROWS", 100)
    made = spool.Spool(path, tmp_path / "spool", 100)
    whole, repairs = read_repaired(table)
    for found in (made.shelf.table(0), whole):
        assert {k: v - {""} for k, v in leaders(found).items()} == {
            "1": set(), "2": {"1"}, "3": {"2"}, "7": set(), "8": {"7"}, "9": {"8"},
        }  # fmt: skip
        assert (found.group_by("run_id", "vehicle_id").agg(pl.col("position_m").last() > pl.col("position_m").first()))[
            "position_m"
        ].all()
    assert made.vehicles == [("60", str(i)) for i in (1, 2, 3)] + [("60-reverse", str(i)) for i in (7, 8, 9)]
    assert kinds(made.repairs)["direction mirrored"] == kinds(repairs)["direction mirrored"] == 3


def test_filter_says_which_lengths_it_assumed(tmp_path: Path) -> None:
    """In the words of ``fit``, by vehicles."""
    table = both_ways().with_columns(length_m=pl.when(pl.col("vehicle_id") < 7).then(pl.col("length_m")))
    for change, count in ((table, 3), (table.drop("length_m"), 6), (table.with_columns(length_m=pl.lit(0.0)), 6)):
        path = tmp_path / "some.csv"
        change.write_csv(path)
        report = filter_file(path, tmp_path / "out", baselines=False)
        said = [repair["text"] for repair in report["repairs"] if repair["kind"] == "length assumed"]
        assert said == [f"{count} vehicles have no length_m; 4.5 m is assumed."]
        fitted = [r.text for r in load(path).repairs if r.kind == "length assumed"]
        assert fitted == said
