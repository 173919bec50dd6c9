"""Reading tracks tolerantly: what is left out is counted, and the others are still there."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from idm_env.data import DataError
from idm_env.trajectories.tracks import Pieces, from_frame, jumps, read_table


def rows(vehicle: str, time: np.ndarray, position: np.ndarray, **more: object) -> pl.DataFrame:
    return pl.DataFrame({"vehicle_id": vehicle, "time_s": time, "position_m": position, **more})


TIME = np.arange(0, 10.0, 0.1)


def test_one_bad_track_does_not_stop_the_others() -> None:
    frame = pl.concat(
        [
            rows("good", TIME, 10 * TIME),
            rows("point", np.array([1.0]), np.array([5.0])),
            rows("two", np.array([0.0, 1.0]), np.array([0.0, 9.0])),
            rows("parked", TIME, 0 * TIME),
            rows("backwards", TIME, -5 * TIME),
            rows("jump", TIME, 10 * TIME + 100.0 * (TIME > 4.95)),
            rows("spike", TIME, 10 * TIME + 100.0 * (np.abs(TIME - 5) < 0.01)),
        ]
    )
    pieces = Pieces(from_frame(frame))
    tracks = {track.key: track for track in pieces}
    assert sorted(tracks) == ["0/good/0", "0/jump/0", "0/jump/1", "0/parked/0", "0/spike/0", "0/two/0"]
    assert {name: why.split()[0] for name, why in pieces.left_out} == {"0/point": "a", "0/backwards/0": "drives"}
    assert pieces.notes == [("0/jump", "divided into 2 tracks at holes or jumps")]
    assert len(tracks["0/jump/0"]) == len(tracks["0/jump/1"]) == 50


def test_times_are_sorted_and_repeats_counted() -> None:
    time = np.array([0.0, 0.2, 0.1, 0.3, 0.3, 0.4])
    table = from_frame(rows("a", time, 10 * time))
    (track,) = Pieces(table)
    assert np.allclose(track.time_s, [0.0, 0.1, 0.2, 0.3, 0.4])
    assert {repair.kind: repair.count for repair in table.repairs} == {"time not increasing": 1, "duplicated time": 1}


def test_holes_divide_a_track_unless_told_to_bridge() -> None:
    time = np.concatenate([TIME, TIME + 30.0])
    table = from_frame(rows("a", time, 10 * time))
    assert [len(track) for track in Pieces(table)] == [100, 100]
    assert [len(track) for track in Pieces(table, bridge=None)] == [200]


def test_leaders_come_from_the_column_or_from_lanes_never_from_nothing() -> None:
    both = [rows("front", TIME, 10 * TIME + 30), rows("back", TIME, 10 * TIME)]
    (front, back) = Pieces(from_frame(pl.concat(both)))
    assert set(front.leader) == set(back.leader) == {""}
    laned = pl.concat(both).with_columns(lane=pl.lit(1))
    found = {track.vehicle_id: set(track.leader) for track in Pieces(from_frame(laned))}
    assert found == {"front": {""}, "back": {"front"}}
    named = pl.concat([both[0].with_columns(leader_id=pl.lit("0")), both[1].with_columns(leader_id=pl.lit("front"))])
    found = {track.vehicle_id: set(track.leader) for track in Pieces(from_frame(named))}
    assert found == {"front": {""}, "back": {"front"}}


def test_a_file_without_positions_is_refused_in_one_line() -> None:
    frame = pl.DataFrame(
        {"vehicle_id": [1], "time_s": [0.0], "position_m": [None]}, schema_overrides={"position_m": pl.Float64}
    )
    with pytest.raises(DataError, match="position_m is empty in every row"):
        from_frame(frame)


def test_a_jump_stays_away_and_an_outlier_comes_back() -> None:
    x = 10 * TIME
    assert not jumps(TIME, x + 50.0 * (np.arange(100) == 40)).any()
    assert np.flatnonzero(jumps(TIME, x + 50.0 * (np.arange(100) >= 40))).tolist() == [39]


def test_laps_go_on_where_the_ring_has_its_start() -> None:
    frame = rows("a", TIME, (10 * TIME + 50) % 100, ring_length_m=100.0)
    (track,) = Pieces(from_frame(frame))
    assert np.allclose(track.position_m, 10 * TIME + 50)


def test_measured_file_reads_whole(measured) -> None:  # type: ignore[no-untyped-def]
    pieces = Pieces(read_table(measured("ngsim_i80_rawlike.csv.gz")))
    tracks = list(pieces)
    assert len({track.vehicle_id for track in tracks}) == 222
    assert len(pieces.left_out) == 0
    assert all((np.diff(track.time_s) > 0).all() for track in tracks)
