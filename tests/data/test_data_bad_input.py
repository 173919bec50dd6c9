"""Each kind of bad input is a one-line DataError, or a repair that is counted; never a traceback or a silent drop.

What every command says of the corpus in ``bad.py`` is a law of its own: ``tests/test_commands_read_alike.py``.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest

from idm_env.data import DataError, Trajectories, episodes, load
from idm_env.trajectories.spool import read_table
from tests.data.tables import kinds, platoon, with_value

make = Trajectories.from_frame


def fails(table: pl.DataFrame, *words: str, **options: object) -> None:
    with pytest.raises(DataError) as caught:
        make(table, **options)  # type: ignore[arg-type]
    message = str(caught.value)
    assert "\n" not in message
    for word in words:
        assert word in message, message


def all_finite(trajectories: Trajectories) -> bool:
    arrays = [
        array
        for episode in episodes(trajectories)
        for record in (episode, episode.leader, episode.second_leader, episode.behind, episode.adjacent)
        for array in (record.position_m, record.speed_mps)
    ]
    return all(np.isfinite(array).all() for array in arrays)


@pytest.mark.parametrize("column", ["position_m", "speed_mps"])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), None])
def test_single_missing_values_are_interpolated_and_counted(column: str, value: float | None) -> None:
    made = make(with_value(platoon(), column, [130, 150], value))
    assert kinds(made.repairs)["interpolated"] == 2
    assert len(episodes(made)) == 2
    assert all_finite(made)
    clean = make(platoon()).table
    assert np.allclose(made.table[column], clean[column], atol=0.02)


def test_a_long_hole_splits_the_track() -> None:
    made = make(with_value(platoon(vehicles=2, seconds=20), "position_m", list(range(300, 305)), float("nan")))
    assert kinds(made.repairs) | {"no position": 5} == kinds(made.repairs)
    assert [len(episode) for episode in episodes(made)] == [100, 95]


def test_missing_speeds_are_estimated() -> None:
    table = platoon()
    made = make(table.drop("speed_mps"))
    assert kinds(made.repairs)["speed estimated"] == table.height
    assert np.abs(made.table["speed_mps"] - table["speed_mps"]).max() < 0.05


def test_time_not_increasing_is_sorted() -> None:
    table = platoon()
    made = make(table.reverse())
    assert kinds(made.repairs)["time not increasing"] > 0
    assert made.table.equals(make(table).table)


def test_duplicated_rows_are_left_out() -> None:
    table = platoon()
    made = make(pl.concat([table, table.slice(20, 3)]))
    assert kinds(made.repairs)["duplicated time"] == 3
    assert made.table.equals(make(table).table)


def test_jitter_is_resampled() -> None:
    table = platoon(vehicles=2, seconds=30)
    jitter = np.random.default_rng(0).uniform(-0.02, 0.02, table.height)
    spoilt = table.with_columns(
        pl.col("time_s") + jitter,
        pl.col("position_m") + jitter * table["speed_mps"].to_numpy(),
    )
    made = make(spoilt)
    assert kinds(made.repairs)["irregular time"] == 2
    (episode,) = episodes(made)
    assert np.allclose(np.diff(episode.time_s), 0.1)
    assert np.allclose(episode.gap_m, 16.0, atol=0.02)


def test_a_hole_in_time_splits_and_a_missing_row_is_filled() -> None:
    table = platoon(vehicles=2, seconds=30).with_row_index()
    made = make(table.filter(~pl.col("index").is_in([400, 450, 451, 452])).drop("index"))
    assert kinds(made.repairs)["missing row"] == 1
    assert [len(episode) for episode in episodes(made)] == [150, 147]


def test_irregular_clock_of_30_hertz_is_kept() -> None:
    made = make(platoon(dt=1 / 30, seconds=10))
    assert abs(made.steps["a"] - 1 / 30) < 1e-6
    assert "irregular time" not in kinds(made.repairs)


def test_unknown_leader_is_counted() -> None:
    made = make(with_value(platoon(), "leader_id", list(range(200, 300)), 99))
    assert kinds(made.repairs)["leader does not exist"] == 100
    assert [episode.vehicle_id for episode in episodes(made)] == ["2"]


def test_a_vehicle_that_leads_itself() -> None:
    made = make(with_value(platoon(), "leader_id", list(range(200, 300)), 3))
    assert kinds(made.repairs)["own leader"] == 100


@pytest.mark.parametrize("none", [None, "", "0", "-1", "NaN"])
def test_words_for_no_leader(none: str | None) -> None:
    text = pl.col("leader_id").cast(pl.String)
    made = make(
        platoon().with_columns(pl.when(pl.col("vehicle_id") == 1).then(pl.lit(none)).otherwise(text).alias("leader_id"))
    )
    assert made.table.filter(pl.col("vehicle_id") == "1")["leader_id"].null_count() == 100
    assert len(episodes(made)) == 2


def test_vehicle_zero_may_lead() -> None:
    table = platoon(vehicles=2).with_columns(pl.col("vehicle_id") - 1, pl.col("leader_id") - 1)
    assert [(e.vehicle_id, e.leader_id) for e in episodes(make(table))] == [("1", "0")]


def test_leaders_behind() -> None:
    table = platoon(vehicles=2).with_columns(pl.when(pl.col("vehicle_id") == 1).then(2).alias("leader_id"))
    fails(table, "leader 2 is behind vehicle 1", "ring_length")
    assert len(episodes(make(table, ring_length=80.0))) == 1
    with_gap = table.with_columns(pl.when(pl.col("vehicle_id") == 1).then(30.0).alias("gap_m"))
    assert np.allclose(episodes(make(with_gap))[0].gap_m, 30.0)


def test_a_change_of_leader_splits() -> None:
    table = platoon(vehicles=3, seconds=20)
    late = (pl.col("vehicle_id") == 3) & (pl.col("time_s") >= 8.0)
    made = make(table.with_columns(pl.when(late).then(1).otherwise("leader_id").alias("leader_id")))
    found = episodes(made)
    assert [(e.key, e.leader_id, len(e)) for e in found] == [
        ("a/2/0", "1", 200),
        ("a/3/0", "2", 80),
        ("a/3/1", "1", 120),
    ]
    assert kinds(found.left_out)["leader changes"] == 1


def test_gaps_that_are_not_positive_are_left_out() -> None:
    table = platoon(vehicles=2, seconds=20).with_columns(gap_m=pl.lit(10.0))
    found = episodes(make(with_value(table, "gap_m", list(range(300, 310)), -0.5)))
    assert kinds(found.left_out)["gap not positive"] == 10
    assert [len(episode) for episode in found] == [100, 90]


def test_lost_leaders_are_left_out_by_a_rule_that_can_be_set() -> None:
    table = platoon(vehicles=2, seconds=20).with_columns(gap_m=pl.lit(10.0))
    made = make(with_value(table, "gap_m", list(range(300, 310)), 80.5))
    found = episodes(made)
    assert kinds(found.left_out)["gap above 80 m"] == 10
    assert "80 m" in " ".join(map(str, found.left_out))
    assert [len(e) for e in episodes(made, max_gap=None)] == [200]
    made = make(with_value(table, "gap_m", list(range(290, 400)), 80.5))
    assert kinds(episodes(made).left_out) == {"most rows (is --max-gap too small?), gap above 80 m": 110}
    assert [len(e) for e in episodes(made, max_gap=90.0)] == [200]


def test_speeds_of_no_car_without_a_speed_column() -> None:
    table = platoon(speed=30.0).drop("speed_mps").with_columns(pl.col("position_m") * 3.6)
    fails(table, "70 m/s")


def test_single_implausible_values_are_counted() -> None:
    made = make(with_value(platoon(), "speed_mps", [150], 300.0))
    assert kinds(made.repairs)["implausible value"] == 1
    assert made.table["speed_mps"].max() < 14.0


@pytest.mark.parametrize(
    ("renamed", "words"),
    [
        ({"position_m": "positon_m"}, ("'position_m' is missing", "did you mean 'positon_m'?")),
        ({"time_s": "Time_S"}, ("'time_s' is missing", "did you mean 'Time_S'?", "--columns time_s=Time_S")),
        ({"vehicle_id": "zzz"}, ("'vehicle_id' is missing", "the file has", "--columns 'vehicle_id=?'")),
        ({"vehicle_id": "car", "time_s": "t"}, ("'vehicle_id' is missing", "--columns vehicle_id=car,time_s=t")),
        ({"leader_id": "leaderid"}, ("'leader_id' is missing", "'leaderid' looks like it")),
        ({"speed_mps": "speed_mp"}, ("'speed_mps' is missing", "'speed_mp' looks like it")),
    ],
)
def test_a_missing_column_suggests_the_nearest(renamed: dict[str, str], words: tuple[str, ...]) -> None:
    fails(platoon().rename(renamed), *words)


def test_rows_without_a_time_are_counted() -> None:
    assert kinds(make(with_value(platoon(), "time_s", [299], None)).repairs)["no time"] == 1
    fails(platoon().with_columns(time_s=pl.lit(None, pl.Float64)), "time_s")


def test_a_short_track_is_left_out_and_counted() -> None:
    table = platoon(vehicles=3)
    made = make(table.filter((pl.col("vehicle_id") < 3) | (pl.col("time_s") < 4.85)))
    found = episodes(made)
    assert [episode.vehicle_id for episode in found] == ["2"]
    assert kinds(found.left_out)["too short"] == 1
    assert found[0].behind.present.sum() == 49


def test_nothing_but_short_tracks() -> None:
    with pytest.raises(DataError, match="no driver follows a leader for 5 s"):
        episodes(make(platoon(seconds=3.0)))


def test_only_leaders() -> None:
    fails(platoon().with_columns(leader_id=pl.lit(None, pl.Int64)), "nobody follows anybody")
    fails(platoon(vehicles=1).drop("leader_id"), "nobody follows anybody")


def test_missing_lengths_are_assumed_and_counted() -> None:
    made = make(platoon().drop("length_m"))
    assert kinds(made.repairs)["length assumed"] == 3
    assert set(made.table["length_m"]) == {4.5}


def test_a_place_that_does_not_exist() -> None:
    fails(platoon(), "did you mean 'position_m'", place="positon")
    with pytest.raises(DataError, match="is empty in run a"):
        episodes(make(platoon().with_columns(hill=pl.lit(None, pl.Float64)), place="hill"))


@pytest.mark.parametrize("ring", [0.0, -3.0, float("nan"), float("inf")])
def test_a_ring_needs_a_length(ring: float) -> None:
    fails(platoon(), "ring_length", ring_length=ring)


def test_files_that_cannot_be_read(tmp_path) -> None:
    def message(path) -> str:
        with pytest.raises(DataError) as caught:
            load(path)
        assert "\n" not in str(caught.value)
        return str(caught.value)

    (tmp_path / "corrupt.parquet").write_bytes(b"PAR1" + b"rubbish" * 20 + b"PAR1")
    (tmp_path / "truncated.csv.gz").write_bytes(b"\x1f\x8b\x08\x00rubbish")
    (tmp_path / "empty.csv").write_bytes(b"")
    (tmp_path / "header.csv").write_text("vehicle_id,time_s,position_m\n")
    (tmp_path / "table.doc").write_text("x")
    (tmp_path / "other.csv").write_text("a,b\n1,2\n")
    (tmp_path / "spelled.csv").write_text("Vehicle ID,Time [s],Position (m)\n1,0.1,2.5\n")
    (tmp_path / "binary.csv").write_bytes(bytes(range(256)) * 4)
    whole = tmp_path / "whole.parquet"
    platoon().write_parquet(whole)
    (tmp_path / "cut.parquet").write_bytes(whole.read_bytes()[:-40])
    assert "cannot be read" in message(tmp_path / "corrupt.parquet")
    assert "cannot be read" in message(tmp_path / "cut.parquet")
    assert "cannot be read" in message(tmp_path / "truncated.csv.gz")
    assert "is empty" in message(tmp_path / "empty.csv")
    assert "no rows" in message(tmp_path / "header.csv")
    assert "unknown extension" in message(tmp_path / "table.doc")
    assert "no known layout" in message(tmp_path / "other.csv")
    assert "--columns 'vehicle_id=Vehicle ID,time_s=Time [s],position_m=Position (m)'" in message(
        tmp_path / "spelled.csv"
    )
    assert message(tmp_path / "binary.csv")
    assert "directory" in message(tmp_path)
    assert "does not exist" in message(tmp_path / "nothing.csv")


def with_gaps(factor: float) -> pl.DataFrame:
    table = platoon()
    gap = pl.when(pl.col("leader_id").is_not_null()).then(16.0 * factor + 0.1 * pl.col("time_s").sin())
    return table.with_columns(gap.alias("gap_m"))


def test_gaps_with_a_length_in_them_are_refused_where_lengths_are_given() -> None:
    """Positions of some files are those of the leader's rear bumper: their vehicles have no length."""
    table = platoon()
    lead = table.select("run_id", "time_s", leader_id="vehicle_id", lead="position_m")
    table = table.join(lead, on=["run_id", "time_s", "leader_id"], how="left")
    table = table.with_columns(gap_m=pl.col("lead") - pl.col("position_m")).drop("lead")
    fails(table.with_columns(length_m=pl.lit(4.2)), "from front to front", "subtract that")
    assert make(table.with_columns(length_m=pl.lit(0.0))).table["gap_measured"].any()


def test_gaps_in_feet_beside_positions_in_metres_are_refused() -> None:
    fails(with_gaps(3.281), "gap_m looks like feet", "0.3048")
    make(with_gaps(1.0))
    make(with_gaps(1.25))  # an antenna four metres from the bumper


def test_positions_in_feet_beside_gaps_in_metres_are_refused() -> None:
    feet = with_gaps(16.5 / 16.0).drop("speed_mps").with_columns(pl.col("position_m") * 3.281, length_m=11.5)
    fails(feet, "position_m looks like feet")


@pytest.mark.parametrize("layout", ["position_m,speed_mps,speed_mps", "position_m,position_m , speed_mps"])
def test_a_column_twice_is_refused(tmp_path: Path, layout: str) -> None:
    path = tmp_path / "twice.csv"
    path.write_text(f"vehicle_id,time_s,{layout}\n1,0.0,1,2,3\n1,0.1,1,2,3\n")
    for read in (load, read_table):
        with pytest.raises(DataError, match=r"column '(speed_mps|position_m)' is there twice; remove or rename one"):
            read(path)


@pytest.mark.parametrize("name", ["vehicle_id", "leader_id"])
def test_identifiers_that_are_floats_beyond_2_to_the_53_are_refused(name: str) -> None:
    large = pl.col("vehicle_id").cast(pl.Float64) + 2.0**53
    fails(platoon().with_columns(large.alias(name)), name, "2^53", "write identifiers as integers or text")
    exact = platoon().with_columns(pl.col("vehicle_id", "leader_id") + 2**53)
    assert make(exact).table["vehicle_id"].n_unique() == 3


@pytest.mark.parametrize("name", ["Vehicle_ID", "Preceding"])
def test_identifiers_of_ngsim_are_held_to_the_same(tmp_path: Path, name: str) -> None:
    path, feet = tmp_path / "ngsim.csv", {"position_m": "Local_Y", "speed_mps": "v_Vel", "length_m": "v_Length"}
    table = platoon().select(
        (pl.col("vehicle_id") + 2**53).alias("Vehicle_ID"),
        (pl.col("time_s") * 10).round().cast(pl.Int64).alias("Frame_ID"),
        *((pl.col(old) / 0.3048).alias(new) for old, new in feet.items()),
        (pl.col("leader_id").fill_null(-(2**53)) + 2**53).alias("Preceding"),
    )
    table.write_csv(path)
    loaded = load(path).table
    assert loaded["vehicle_id"].n_unique() == 3
    assert loaded["leader_id"].drop_nulls().unique().sort().to_list() == [str(2**53 + n) for n in (1, 2)]
    table.with_columns(pl.col(name).cast(pl.Float64)).write_csv(path)
    for read in (load, read_table):
        with pytest.raises(DataError, match=rf"{name.lower()} = .* 2\^53.*write identifiers as integers or text"):
            read(path)
