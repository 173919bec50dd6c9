"""Layouts of files: what is written is what is read, in any order of rows, and the file itself is left alone."""

from __future__ import annotations

import gzip
import hashlib
import io
import math
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings, strategies as st

from idm_env.data import DataError, Trajectories, episodes, folder, load, schema
from idm_env.trajectories.files import filter_file
from idm_env.trajectories.spool import Spool
from tests.data.tables import kinds, platoon, with_value

FOOT = 0.3048
quick = settings(max_examples=25, derandomize=True)


def write(table: pl.DataFrame, path: Path) -> Path:
    if path.name.endswith(".parquet"):
        table.write_parquet(path)
    elif path.name.endswith(".gz"):
        path.write_bytes(gzip.compress(table.write_csv().encode()))
    else:
        table.write_csv(path)
    return path


@pytest.mark.parametrize("name", ["t.csv", "t.csv.gz", "t.parquet", "T.CSV"])
def test_round_trip(name: str, tmp_path: Path) -> None:
    table = platoon().with_columns(driver=pl.lit("x"), slope=pl.lit(0.01))
    path = write(table, tmp_path / name)
    before = hashlib.sha256(path.read_bytes()).hexdigest()
    loaded = load(path)
    assert hashlib.sha256(path.read_bytes()).hexdigest() == before
    assert loaded.table.equals(Trajectories.from_frame(table).table)
    assert loaded.source == name
    assert np.allclose(loaded.table["position_m"], table["position_m"])
    (first, _) = episodes(loaded)
    assert first.labels == {"driver": "x", "lane": "1"}
    assert np.allclose(first.columns["slope"], 0.01)


@pytest.mark.parametrize("name", ["[t].csv", "t*.parquet", "?.csv.gz", "{t,u}.parquet", "~.csv", "runs=[7]/t.parquet"])
def test_a_path_is_a_path(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Never a pattern that names another file beside it: in load, in the pieces of filter, in a folder of fit."""
    monkeypatch.chdir(tmp_path)
    for other in ("t.csv", "t2.parquet", "u.parquet", "a.csv.gz", "runs=7/t.parquet"):
        Path(other).parent.mkdir(exist_ok=True)
        write(platoon(vehicles=2, speed=30.0), Path(other))
    Path(name).parent.mkdir(exist_ok=True)
    path = write(platoon(vehicles=5), Path(name))
    assert load(path).table["vehicle_id"].n_unique() == 5
    assert Spool(path, Path("[spool]*"), 2).shelf.table(2)["vehicle_id"].unique().to_list() == ["5"]
    if path.parent != Path():
        (share,) = folder.shares(path.parent, 100)
        assert share.vehicles == 5 and share.trajectories().table["vehicle_id"].n_unique() == 5


def test_a_folder_of_results_is_a_path(tmp_path: Path) -> None:
    path = write(platoon(vehicles=2), tmp_path / "t.csv")
    filter_file(path, tmp_path / "o[1]*", baselines=False)
    assert pl.read_parquet(tmp_path / "o[1]*" / "trajectories.parquet", glob=False)["vehicle_id"].n_unique() == 2


@quick
@given(
    seed=st.integers(0, 2**32 - 1),
    vehicles=st.integers(2, 5),
    text_ids=st.booleans(),
    with_leaders=st.booleans(),
)
def test_shuffled_rows_change_nothing(seed: int, vehicles: int, text_ids: bool, with_leaders: bool) -> None:
    table = platoon(vehicles, seconds=6.0)
    if text_ids:
        table = table.with_columns(pl.col("vehicle_id", "leader_id").cast(pl.String).str.replace(r"^(\d+)$", "car $1"))
    expected = Trajectories.from_frame(table)
    given_table = table if with_leaders else table.drop("leader_id")
    shuffled = Trajectories.from_frame(given_table.sample(fraction=1.0, shuffle=True, seed=seed))
    assert shuffled.table.equals(expected.table)


@quick
@given(
    values=st.lists(
        st.tuples(
            st.sampled_from(["position_m", "speed_mps", "length_m", "time_s"]),
            st.integers(0, 179),
            st.sampled_from([math.nan, math.inf, -math.inf, None]),
        ),
        max_size=120,
    )
)
def test_arbitrary_missing_values_are_counted_and_never_passed_on(values: list) -> None:
    table = platoon(seconds=6.0)
    for column, row, value in values:
        table = with_value(table, column, [row], value)
    made = Trajectories.from_frame(table)
    for column in ("time_s", "position_m", "speed_mps", "length_m"):
        assert made.table[column].is_finite().all()
    assert bool(values) == bool(set(kinds(made.repairs)) - {"gap from positions"})
    try:
        found = episodes(made)
    except DataError as error:
        assert "no driver follows" in str(error)
        return
    for episode in found:
        assert np.isfinite(episode.gap_m).all()
        assert np.allclose(np.diff(episode.time_s), 0.1)


NUMBERS = [
    "",
    "nan",
    "inf",
    "1e308",
    "1e-300",
    "-5",
    "0",
    "3",
    "100",
    "9999999",
    "-9999999",
    "500.5",
    "99999999999999999999",
]


@quick
@given(
    cells=st.lists(st.tuples(st.integers(0, 179), st.integers(0, 7), st.sampled_from(NUMBERS)), max_size=200),
    dropped=st.sets(st.sampled_from(["leader_id", "lane", "speed_mps", "length_m", "run_id"])),
    ring=st.sampled_from([None, 90.0]),
)
def test_arbitrary_numbers_never_end_in_a_traceback(
    cells: list, dropped: set, ring: float | None, tmp_path: Path
) -> None:
    header, *rows = [line.split(",") for line in platoon(seconds=6.0).write_csv().splitlines()]
    for row, column, value in cells:
        rows[row][column] = value
    text = "\n".join(",".join(row) for row in [header, *rows])
    table = pl.read_csv(io.StringIO(text), infer_schema_length=None).drop(dropped)
    try:
        found = episodes(load(write(table, tmp_path / "t.csv"), ring_length=ring), smooth=True)
    except DataError as error:
        assert "\n" not in str(error)
        return
    for episode in found:
        for record in (episode, episode.leader, episode.second_leader, episode.behind):
            assert np.isfinite(record.position_m).all() and np.isfinite(record.speed_mps).all()


def test_types_that_no_rule_foresaw(tmp_path: Path) -> None:
    table = platoon().with_columns(position_m=pl.concat_list("position_m"))
    with pytest.raises(DataError):
        load(write(table, tmp_path / "t.parquet"))


@pytest.mark.parametrize(("name", "value", "told"), [
    ("speed_mps", 200.0, "-1 to 70 m/s"), ("speed_mps", float("nan"), "-1 to 70 m/s"),
    ("length_m", 0.0, "above 0, up to 30 m"), ("length_m", float("nan"), "above 0, up to 30 m"),
    ("gap_m", float("inf"), "finite"), ("time_s", float("nan"), "finite"), ("lane", 1.5, "must be Int64"),
    ("position_m", "far", "must be Float64"), ("vehicle_id", pl.lit(None, pl.String), "lacks a value"),
])  # fmt: skip
def test_the_schema_names_column_and_rule(name: str, value: object, told: str) -> None:
    table = Trajectories.from_frame(platoon()).table
    given = value if isinstance(value, pl.Expr) else pl.lit(value)
    with pytest.raises(DataError, match=rf"^table: column '{name}' .*{told}"):
        schema.check(table.with_columns(given.alias(name)), "table")


def test_the_schema_lets_pass_what_the_tidy_table_may_lack_and_no_missing_column() -> None:
    table = Trajectories.from_frame(platoon()).table
    empty = table.with_columns(pl.lit(None, pl.Int64).alias("lane"), pl.lit(None, pl.Float64).alias("gap_m"))
    assert schema.check(empty, "table") is empty
    for name in schema.COLUMNS:
        with pytest.raises(DataError, match=rf"column '{name}' of the tidy table is missing"):
            schema.check(table.drop(name), "table")


@quick
@given(content=st.binary(max_size=300))
def test_arbitrary_bytes_never_end_in_a_traceback(content: bytes, tmp_path: Path) -> None:
    for name in ("t.csv", "t.csv.gz", "t.parquet"):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(DataError):
            load(tmp_path / name)


def ngsim_table() -> pl.DataFrame:
    table = platoon()
    feet = {"Local_Y": "position_m", "v_Vel": "speed_mps", "v_Length": "length_m"}
    return table.select(
        pl.col("vehicle_id").alias("Vehicle_ID"),
        (pl.col("time_s") * 10).round().cast(pl.Int64).alias("Frame_ID"),
        pl.lit(100).alias("Total_Frames"),
        (pl.col("time_s") * 1000).round().cast(pl.Int64).alias("Global_Time") + 1_113_433_135_300,
        *((pl.col(old) / FOOT).alias(new) for new, old in feet.items()),
        pl.lit(2).alias("Lane_ID"),
        pl.col("leader_id").fill_null(0).alias("Preceding"),
    )


def test_ngsim_in_its_original_capitals(tmp_path: Path) -> None:
    loaded = load(write(ngsim_table(), tmp_path / "ngsim.csv"))
    table = platoon()
    for column in ("position_m", "speed_mps", "length_m", "time_s"):
        assert np.allclose(loaded.table[column], table[column])
    assert [episode.leader_id for episode in episodes(loaded)] == ["1", "2"]
    assert loaded.runs() == ["ngsim"]


def test_ngsim_of_the_data_portal(tmp_path: Path) -> None:
    """Lower-case names, Location, thousands separators, and identifiers that a later period uses again."""
    table = ngsim_table().rename(str.lower)
    later = table.with_columns(pl.col("global_time") + 900_000, pl.lit(90).alias("total_frames"))
    both = pl.concat([table, later]).with_columns(
        pl.lit("us-101").alias("location"),
        pl.col("global_time").map_elements(lambda value: f"{value:,}", return_dtype=pl.String),
    )
    loaded = load(write(both, tmp_path / "portal.csv"))
    assert loaded.runs() == ["us-101"]
    assert kinds(loaded.repairs)["identifier used again"] == 3
    pairs = [(e.vehicle_id, e.leader_id) for e in episodes(loaded)]
    assert pairs == [("2", "1"), ("3", "2"), ("2.1", "1.1"), ("3.1", "2.1")]


def test_ngsim_without_local_y_is_named(tmp_path: Path) -> None:
    path = write(ngsim_table().rename({"Local_Y": "Locl_Y"}), tmp_path / "t.csv")
    with pytest.raises(DataError, match="'local_y' is missing; did you mean 'locl_y'"):
        load(path, layout="ngsim")


def openacc_text(slots: int = 3, rows: int = 100) -> str:
    """An OpenACC file as published: five lines, then columns per quantity and slot; one gap and one speed missing."""
    time = np.round(np.arange(rows) * 0.1, 1)
    names = ["Time"]
    columns = [time]
    for slot in range(1, slots + 1):
        names += [f"{name}{slot}" for name in ("Speed", "Lat", "Lon", "Alt", "E", "N", "U", "Driver")]
        speed = 20 + np.cos(0.3 * time)
        columns += [speed, time * 0 + 0.8, time * 0 + 0.15, time * 0 + 100 + slot, 20 * time, time * 0, time * 0]
        columns.append(np.array(["ACC" if slot > 1 else "Human"] * rows))
    for slot in range(1, slots):
        names.append(f"IVS{slot}")
        columns.append(25.0 + slot + 0 * time)
    lines = [
        "Date,04,07,2019",
        "Vehicle_order," + ",".join(f"Car {letter}" for letter in "ABC"[:slots]),
        f"Number_of_vehicles,{slots}",
        "ACC,1",
        "Distance_setting,shortest",
        ",".join(names),
    ]
    cells = [[str(column[row]) for column in columns] for row in range(rows)]
    cells[50][names.index("IVS1")] = ""
    cells[60][names.index(f"Speed{slots}")] = ""
    return "\n".join([*lines, *(",".join(row) for row in cells)]) + "\n"


def test_openacc_as_published(tmp_path: Path) -> None:
    path = tmp_path / "ASta_platoon.csv"
    path.write_text(openacc_text())
    loaded = load(path)
    assert loaded.runs() == ["ASta_platoon"]
    second, third = episodes(loaded)
    assert (second.leader_id, third.leader_id) == ("1", "2")
    assert np.allclose(second.gap_m, 26.0) and np.allclose(third.gap_m, 27.0)
    assert len(second) == len(third) == 100
    assert second.labels["vehicle_name"] == "Car B" and second.labels["driver"] == "ACC"
    assert second.labels["acc_run"] == "1" and second.labels["time_gap_setting"] == "shortest"
    assert np.allclose(second.columns["altitude_m"], 102.0)
    assert np.allclose(np.diff(second.position_m), 0.1 * (second.speed_mps[1:] + second.speed_mps[:-1]) / 2)
    assert kinds(loaded.repairs) == {"interpolated": 1, "length assumed": 3, "missing row": 1}


def test_openacc_without_gaps_has_no_followers(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    text = openacc_text(slots=2).replace("IVS1", "Other")
    path.write_text(text)
    with pytest.raises(DataError, match="nobody follows anybody"):
        load(path)


def test_layouts_can_be_named(tmp_path: Path) -> None:
    path = write(platoon(), tmp_path / "t.csv")
    assert load(path, layout="tidy").table.equals(load(path).table)
    with pytest.raises(DataError, match="layout = 'tydi'"):
        load(path, layout="tydi")
    with pytest.raises(DataError, match="local_y"):
        load(path, layout="ngsim")
    with pytest.raises(DataError):
        load(path, layout="openacc")


def test_leaders_from_lane_and_position() -> None:
    table = (
        platoon(vehicles=4)
        .drop("leader_id")
        .with_columns(pl.when(pl.col("vehicle_id") == 2).then(2).otherwise(1).alias("lane"))
    )
    made = Trajectories.from_frame(table)
    assert {(e.vehicle_id, e.leader_id) for e in episodes(made)} == {("3", "1"), ("4", "3")}
    assert kinds(made.repairs)["leaders derived"] == 2
    beside = {e.vehicle_id: e.adjacent for e in episodes(made)}
    assert beside["3"].present.all() and np.allclose(beside["3"].position_m - episodes(made)[0].position_m, 20.0)
    ring = Trajectories.from_frame(table, ring_length=100.0)
    assert {(e.vehicle_id, e.leader_id) for e in episodes(ring)} == {("3", "1"), ("4", "3"), ("1", "4")}
    last = next(e for e in episodes(ring) if e.vehicle_id == "1")
    assert np.allclose(last.gap_m, 100.0 - 60.0 - 4.0)
    assert last.place_m.min() >= 0.0 and last.place_m.max() < 100.0


def test_wrapped_positions_on_a_ring_are_unwrapped() -> None:
    table = platoon(vehicles=3).drop("leader_id")
    wrapped = table.with_columns(pl.col("position_m") % 150.0)
    made = Trajectories.from_frame(wrapped, ring_length=150.0)
    assert kinds(made.repairs)["unwrapped"] > 0
    for episode in episodes(made):
        assert (np.diff(episode.position_m) > 0).all()
        assert np.allclose(np.diff(episode.position_m), np.diff(episode.time_s) * episode.speed_mps[:-1], atol=0.02)


def test_who_drives_behind_a_hole_follows_nobody_else_meanwhile() -> None:
    """A vehicle that is not measured for 5 s is still ahead; after 15 s nobody knows."""
    table = platoon(vehicles=3, seconds=40.0).drop("leader_id", "gap_m", strict=False)
    for seconds, leaders in ((5.0, {"2"}), (15.0, {"2", "1"})):
        hole = pl.col("time_s").is_between(10.05, 10.05 + seconds) & (pl.col("vehicle_id") == 2)
        made = Trajectories.from_frame(table.filter(~hole))
        assert set(made.table.filter(vehicle_id="3")["leader_id"]) == leaders
        assert kinds(made.repairs).get("hole", 0) == (seconds < 10)


def test_splits() -> None:
    runs = pl.concat(
        [
            platoon().with_columns(run_id=pl.lit(name), split=pl.lit(part))
            for name, part in zip("abcd", ["fit", "fit", "fit", "Test"], strict=True)
        ]
    )
    made = Trajectories.from_frame(runs)
    fit, test = made.split("split=test")
    assert (fit.runs(), test.runs()) == (["a", "b", "c"], ["d"])
    fit, test = made.split(0.5, seed=3)
    assert len(fit.runs()) == len(test.runs()) == 2 and set(fit.runs()) | set(test.runs()) == set("abcd")
    assert made.split("0.5", seed=3)[1].runs() == test.runs()
    drivers, other = made.split("vehicle_id=3")
    assert {e.vehicle_id for e in episodes(drivers)} == {"2"} and {e.vehicle_id for e in episodes(other)} == {"3"}
    assert all(e.second_leader.present.all() for e in episodes(other))
    single = Trajectories.from_frame(platoon(vehicles=5))
    fit, test = single.split(0.25)
    assert len(episodes(fit)) == 3 and len(episodes(test)) == 1
    for wrong, words in [
        ("split=none", "it has"),
        ("spilt=test", "did you mean 'split'"),
        ("half", "neither"),
        (1.5, "outside"),
        ("time_s=1", "changes along"),
    ]:
        with pytest.raises(DataError, match=words):
            made.split(wrong)
    with pytest.raises(DataError, match="nothing is left"):
        made.split("lane=1")
    with pytest.raises(DataError, match="one driver only"):
        Trajectories.from_frame(platoon(vehicles=2)).split(0.5)


def test_summary_counts() -> None:
    summary = Trajectories.from_frame(platoon()).summary()
    assert summary["rows"] == 300 and summary["runs"] == 1 and summary["followers"] == 2
    assert summary["time_steps_s"] == [0.1]
