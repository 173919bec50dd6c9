"""Reading tracks tolerantly: what is left out is counted, and the others are still there."""

from __future__ import annotations

import subprocess
import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from idm_env.data import DataError, Trajectories, episodes, load
from idm_env.trajectories import spool as spool_module
from idm_env.trajectories.files import filter_file
from idm_env.trajectories.spool import Spool, read_table
from idm_env.trajectories.tracks import Pieces
from tests.data.tables import platoon
from tests.trajectories.tracks import read_frame, read_repaired


def rows(vehicle: str, time: np.ndarray, position: np.ndarray, **more: object) -> pl.DataFrame:
    return pl.DataFrame({"vehicle_id": vehicle, "time_s": time, "position_m": position, **more})


TIME = np.arange(0, 10.0, 0.1)


def test_one_bad_track_does_not_stop_the_others() -> None:
    frame = pl.concat(
        [
            rows("good", TIME, 10 * TIME, lane=1),
            rows("point", np.array([1.0]), np.array([5.0]), lane=2),
            rows("two", np.array([0.0, 1.0]), np.array([0.0, 9.0]), lane=3),
            rows("parked", TIME, 0 * TIME, lane=4),
            rows("backwards", TIME, 25 - np.abs(5 * TIME - 25), lane=5),
            rows("jump", TIME, 10 * TIME + 100.0 * (TIME > 4.95), lane=6),
            rows("spike", TIME, 10 * TIME + 100.0 * (np.abs(TIME - 5) < 0.01), lane=7),
        ]
    )
    table, repairs = read_repaired(frame)
    counts = {repair.kind: repair.count for repair in repairs}
    assert counts["track split"] == counts["position jumps"] == 1
    pieces = Pieces(table)
    tracks = {track.key: track for track in pieces}
    assert sorted(tracks) == ["0/good/0", "0/jump.1/0", "0/jump/0", "0/parked/0", "0/spike/0", "0/two/0"]
    assert {name: why.split()[0] for name, why in pieces.left_out} == {"0/point": "a", "0/backwards/0": "drives"}
    assert not pieces.notes
    assert len(tracks["0/jump/0"]) == len(tracks["0/jump.1/0"]) == 50 and len(tracks["0/spike/0"]) == 99


def test_times_are_sorted_and_repeats_counted() -> None:
    time = np.array([0.0, 0.2, 0.1, 0.3, 0.3, 0.4])
    table, repairs = read_repaired(rows("a", time, 10 * time))
    (track,) = Pieces(table)
    assert np.allclose(track.time_s, [0.0, 0.1, 0.2, 0.3, 0.4])
    assert {repair.kind: repair.count for repair in repairs} == {
        "time not increasing": 1, "duplicated time": 1, "length assumed": 1,
    }  # fmt: skip


def test_holes_divide_a_track_unless_told_to_bridge() -> None:
    time = np.concatenate([TIME, TIME + 30.0])
    table = read_frame(rows("a", time, 10 * time))
    assert [len(track) for track in Pieces(table)] == [100, 100]
    assert [len(track) for track in Pieces(table, bridge=None)] == [200]


def test_leaders_come_from_the_column_or_from_lanes_or_from_positions_where_there_is_no_lane() -> None:
    """As in ``load``."""
    both = [rows("front", TIME, 10 * TIME + 30), rows("back", TIME, 10 * TIME)]
    alone = pl.when(pl.col("vehicle_id") == "front").then(1)
    for laned in (pl.lit(None), pl.lit(1), alone):
        found = {t.vehicle_id: set(t.leader) for t in Pieces(read_frame(pl.concat(both).with_columns(lane=laned)))}
        assert found == {"front": {""}, "back": {""} if laned is alone else {"front"}}
    named = pl.concat([both[0].with_columns(leader_id=pl.lit("0")), both[1].with_columns(leader_id=pl.lit("front"))])
    found = {track.vehicle_id: set(track.leader) for track in Pieces(read_frame(named))}
    assert found == {"front": {""}, "back": {"front"}}


def switches(frame: pl.DataFrame) -> int:
    leader = pl.col("leader_id").fill_null("")
    order = frame.sort("run_id", "vehicle_id", "time_s")
    return int(order.select((leader != leader.shift(1)).over("run_id", "vehicle_id").sum()).item())


@pytest.mark.parametrize("how", ["rows are missing", "lanes flicker"])
def test_missing_rows_and_flickering_lanes_make_no_switch_of_leader(tmp_path: Path, how: str) -> None:
    """One vehicle of twelve changes lanes; 2 % of rows are missing, also two and three in a row, or lanes flicker."""
    table = platoon(vehicles=12, seconds=60.0).drop("leader_id").with_columns(lane=pl.col("vehicle_id") % 2)
    moves = (pl.col("vehicle_id") == 5) & (pl.col("time_s") > 30)
    table = table.with_columns(lane=pl.when(moves).then(0).otherwise("lane"))
    rng = np.random.default_rng(3)
    dropped = rng.random(table.height) < 0.015
    for after in (1, 2):
        dropped[after:] |= dropped[:-after] & (rng.random(table.height - after) < 0.3)
    quiet = (pl.col("time_s") < 1) | (pl.col("time_s") > 59) | pl.col("time_s").is_between(29, 31)
    if how == "rows are missing":
        spoilt = table.filter(quiet | ~pl.Series(dropped))
    else:
        flicker = (pl.int_range(pl.len()) % 41 == 7) & ~quiet
        spoilt = table.with_columns(lane=pl.when(flicker).then(1 - pl.col("lane")).otherwise("lane"))
    clean, found = read_frame(table), read_frame(spoilt)
    assert switches(clean) == switches(found) == 3  # his own, and those behind him in both lanes
    spoilt.write_csv(tmp_path / "spoilt.csv")
    filter_file(tmp_path / "spoilt.csv", tmp_path / "out", baselines=False)
    written = load(tmp_path / "out" / "trajectories.parquet")
    assert switches(written.table) == 3
    assert len(episodes(written)) == len(episodes(Trajectories.from_frame(table))) == 13


def test_a_file_without_positions_is_refused_in_one_line() -> None:
    frame = pl.DataFrame(
        {"vehicle_id": [1], "time_s": [0.0], "position_m": [None]}, schema_overrides={"position_m": pl.Float64}
    )
    with pytest.raises(DataError, match="position_m is empty in every row"):
        read_frame(frame)


def test_laps_go_on_where_the_ring_has_its_start() -> None:
    frame = rows("a", TIME, (10 * TIME + 50) % 100, ring_length_m=100.0)
    (track,) = Pieces(read_frame(frame))
    assert np.allclose(track.position_m, 10 * TIME + 50)


def test_measured_file_reads_whole(measured) -> None:  # type: ignore[no-untyped-def]
    pieces = Pieces(read_table(measured("ngsim_i80_rawlike.csv.gz"))[0])
    tracks = list(pieces)
    assert len({track.vehicle_id for track in tracks}) == 222
    assert len(pieces.left_out) == 0
    assert all((np.diff(track.time_s) > 0).all() for track in tracks)


def spooled(tmp_path: Path, frame: pl.DataFrame, chunk: int = 2, name: str = "x.csv") -> Spool:
    (frame.write_csv if name.endswith("csv") else frame.write_parquet)(tmp_path / name)
    return Spool(tmp_path / name, tmp_path / "spool", chunk)


@pytest.mark.parametrize("name", ["x.csv", "x.parquet"])
@pytest.mark.parametrize("laned", [False, True])
def test_a_spool_holds_what_the_whole_table_holds(
    tmp_path: Path, name: str, laned: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In pieces of a few rows and chunks of two vehicles, shuffled in time, with repeats and empty cells."""
    monkeypatch.setattr(import_module("idm_env.data.load"), "BATCH_BYTES", 1500)
    monkeypatch.setattr(import_module("idm_env.data.load"), "BATCH_ROWS", 70)
    monkeypatch.setattr(spool_module, "BUCKET_ROWS", 60)
    rng = np.random.default_rng(0)
    parts = [rows(str(i), TIME + 0.5 * i, 10 * TIME + 200 - 30 * i) for i in range(5)]
    frame = pl.concat(parts).with_columns(lane=pl.lit(1)) if laned else pl.concat(parts)
    frame = pl.concat([frame, frame[17:20]])[rng.permutation(frame.height + 3)]
    frame = frame.with_columns(pl.when(pl.int_range(pl.len()) != 11).then(pl.col("position_m")).alias("position_m"))
    spool = spooled(tmp_path, frame, name=name)
    assert spool.chunks == 3 and [vehicle for _, vehicle in spool.vehicles] == list("01234")
    whole = {track.key: track for track in Pieces(read_frame(frame))}
    tables = [spool.shelf.table(number) for number in range(3)]
    found = {t.key: t for table in tables for t in Pieces(table)}
    assert list(found) == list(whole)
    for key, track in whole.items():
        assert np.allclose(found[key].time_s, track.time_s) and np.allclose(found[key].position_m, track.position_m)
        assert found[key].leader.tolist() == track.leader.tolist()
    assert any(track.leader.any() for track in whole.values())
    counts = {repair.kind: repair.count for repair in spool.repairs}
    assert counts["duplicated time"] == 3 and counts["no position"] == 1 and counts["time not increasing"] > 50
    (table,) = spool.picked([3])
    assert table["vehicle_id"].unique().to_list() == ["3"]


def test_units_that_are_named_are_converted(tmp_path: Path) -> None:
    frame = pl.DataFrame(
        {"vehicle_id": "a", "time_ms": 1e3 * TIME, "position_ft": 10 * TIME / 0.3048, "length_ft": 15.0}
    )
    spool = spooled(tmp_path, frame)
    (track,) = Pieces(spool.shelf.table(0))
    assert np.allclose(track.time_s, TIME) and np.allclose(track.position_m, 10 * TIME)
    assert track.length_m == pytest.approx(4.572)
    assert sorted(r.text.split()[0] for r in spool.repairs) == ["length_ft", "position_ft", "time_ms"]


@pytest.mark.parametrize(
    ("position", "speed", "cure"),
    [
        (1 / 0.3048, 1.0, "position_m looks like feet; multiply it by 0.3048"),
        (1.0, 3.6, "speed_mps looks like km/h; divide it by 3.6"),
        (1.0, 1 / 0.3048, "speed_mps looks like feet per second"),
    ],
)
def test_units_that_disagree_are_refused_with_their_cure(
    tmp_path: Path, position: float, speed: float, cure: str
) -> None:
    frame = rows("a", TIME, 10 * TIME * position, speed_mps=10.0 * speed)
    for read in (read_frame, lambda f: spooled(tmp_path, f)):
        with pytest.raises(DataError, match=cure):
            read(frame)
    sparse = rows("a", 10 * TIME, 100 * TIME, speed_mps=10.0)
    backwards = rows("b", 10 * TIME, -100 * TIME, speed_mps=10.0)
    assert len(list(Pieces(read_frame(pl.concat([sparse, backwards])), bridge=None))) == 2


SPOOLING = """
import resource, sys
from pathlib import Path
from idm_env.trajectories.spool import Spool
spool = Spool(sys.argv[1], Path(sys.argv[2]), 100)
rows = sum(spool.shelf.table(number).height for number in range(spool.chunks))
print(rows, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
"""


def test_memory_does_not_grow_with_the_file(tmp_path: Path) -> None:
    """Ten times the rows, which would be 300 MB as a sorted table: the peak rises by less than half of that."""
    peaks = []
    for count in (400, 4000):
        time = np.round(np.arange(500) * 0.1, 1)
        vehicle = np.repeat(np.arange(count), 500)
        start = np.tile(time, count) + vehicle * 0.5
        frame = pl.DataFrame({"vehicle_id": vehicle, "lane": vehicle % 4, "time_s": np.round(start, 1)})
        path = tmp_path / f"{count}.parquet"
        frame.with_columns(position_m=10 * pl.Series(np.tile(time, count))).write_parquet(path)
        command = [sys.executable, "-c", SPOOLING, str(path), str(tmp_path / "spool")]
        rows, peak = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
        assert int(rows) == 500 * count
        peaks.append(float(peak))
    assert peaks[1] < peaks[0] + 150.0, peaks
