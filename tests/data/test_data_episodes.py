"""Episodes: the right neighbours, gaps that agree with positions, and smoothing that keeps what was measured."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest

from idm_env.data import DataError, Episodes, Trajectories, episodes
from idm_env.data.synthetic import generate
from tests.data.tables import platoon


@pytest.fixture(scope="module")
def five() -> Episodes:
    return episodes(Trajectories.from_frame(platoon(vehicles=5)))


def test_neighbours_are_the_right_ones(five: Episodes) -> None:
    by_vehicle = {episode.vehicle_id: episode for episode in five}
    middle = by_vehicle["3"]
    assert middle.key == "a/3/0" and middle.leader_id == "2" and len(middle) == 100
    assert np.isclose(middle.seconds, 10.0) and np.isclose(middle.dt, 0.1)
    assert np.allclose(middle.gap_m, 16.0)
    assert middle.leader.present.all() and middle.second_leader.present.all() and middle.behind.present.all()
    assert np.allclose(middle.second_leader.position_m - middle.position_m, 40.0)
    assert np.allclose(middle.behind.position_m - middle.position_m, -20.0)
    assert not middle.adjacent.present.any()
    assert not by_vehicle["2"].second_leader.present.any()
    assert not by_vehicle["5"].behind.present.any()


def test_absent_neighbours_are_finite_and_far(five: Episodes) -> None:
    last = five[len(five) - 1]
    for record in (last.behind, last.adjacent):
        assert np.isfinite(record.position_m).all() and (np.abs(record.position_m - last.position_m) > 500).all()
        assert np.allclose(record.accel_mps2, 0.0) and np.allclose(record.speed_mps, last.speed_mps)


def test_accelerations_are_those_of_the_motion(five: Episodes) -> None:
    leader = five[0].leader
    truth = -0.5 * np.sin(0.5 * five[0].time_s)
    assert np.abs(leader.accel_mps2 - truth)[5:-5].max() < 0.05


def test_accelerations_of_the_file_are_not_trusted() -> None:
    spoilt = platoon().with_columns(accel_mps2=pl.lit(99.0))
    assert np.abs(episodes(Trajectories.from_frame(spoilt))[0].leader.accel_mps2).max() < 1.0


@pytest.mark.parametrize("smooth", [False, True])
@pytest.mark.parametrize("gap_column", [False, True])
def test_the_leader_is_rebuilt_from_the_gap(smooth: bool, gap_column: bool) -> None:
    made, _ = generate(3, runs=1, seconds=60.0, noise=0.2, gap_column=gap_column)
    for episode in episodes(made, smooth=smooth):
        rebuilt = episode.leader.position_m - episode.leader.length_m - episode.position_m
        assert np.abs(rebuilt - episode.gap_m).max() < 1e-9
        rows = made.table.filter(
            (pl.col("vehicle_id") == episode.vehicle_id)
            & pl.col("time_s").is_between(episode.time_s[0], episode.time_s[-1])
        )
        if not smooth or gap_column:
            assert np.allclose(episode.gap_m, rows["gap_m"])
        if not smooth or not gap_column:
            assert np.allclose(episode.position_m, rows["position_m"])


def test_smoothing_comes_nearer_to_the_truth() -> None:
    made, truth = generate(4, runs=1, followers=2, seconds=60.0, noise=0.3, speed_noise=0.3)
    motion = truth.motion.filter(pl.col("vehicle_id") == "1")
    raw, smooth = (episodes(made, smooth=flag)[0].leader for flag in (False, True))
    for name, column in (("position_m", "position_m"), ("speed_mps", "speed_mps")):
        true = motion[column].to_numpy()
        errors = [np.sqrt(np.mean((getattr(record, name) - true) ** 2)) for record in (raw, smooth)]
        assert errors[1] < 0.6 * errors[0]
    assert np.sqrt(np.mean((smooth.accel_mps2 - motion["accel_mps2"].to_numpy()) ** 2)) < 0.4


def test_gap_measured_wins_over_positions() -> None:
    table = platoon(vehicles=2).with_columns(gap_m=pl.when(pl.col("vehicle_id") == 2).then(9.0))
    (episode,) = episodes(Trajectories.from_frame(table))
    assert np.allclose(episode.gap_m, 9.0)
    assert np.allclose(episode.leader.position_m - episode.position_m, 13.0)


def test_a_neighbour_that_comes_later_is_present_from_then_on() -> None:
    table = platoon(vehicles=3).filter((pl.col("vehicle_id") != 1) | (pl.col("time_s") >= 4.0))
    third = next(e for e in episodes(Trajectories.from_frame(table)) if e.vehicle_id == "3")
    assert third.second_leader.present.tolist() == [t >= 3.999 for t in third.time_s]


def test_a_coarser_step() -> None:
    made = Trajectories.from_frame(platoon(vehicles=3))
    for smooth in (False, True):
        episode = episodes(made, dt=0.5, smooth=smooth)[0]
        assert np.isclose(episode.dt, 0.5) and len(episode) == 20
        assert np.allclose(np.diff(episode.time_s), 0.5)
        assert np.allclose(episode.gap_m, 16.0, atol=0.05)
    with pytest.raises(DataError, match="no multiple"):
        episodes(made, dt=0.25)


def test_extra_columns_are_finite_and_labels_constant() -> None:
    numbers = pl.int_range(pl.len()).over("vehicle_id")
    table = platoon(vehicles=2).with_columns(
        grade=pl.when(numbers >= 10).then(0.02),
        empty=pl.lit(None, pl.Float64),
        name=pl.lit("x"),
        mode=pl.when(numbers < 50).then(pl.lit("a")).otherwise(pl.lit("b")),
        group=pl.lit(7),
    )
    (episode,) = episodes(Trajectories.from_frame(table))
    assert np.allclose(episode.columns["grade"], 0.02) and "empty" not in episode.columns
    assert episode.labels == {"name": "x", "group": "7", "lane": "1"}


def test_a_place_column_that_wraps() -> None:
    table = platoon(vehicles=2).with_columns((pl.col("position_m") % 50.0).alias("track_s_m"))
    rows = table.with_row_index().filter(pl.col("index") != 150).drop("index")
    (episode,) = episodes(Trajectories.from_frame(rows, place="track_s_m"))
    assert len(episode) == 100
    lap = (episode.position_m - episode.place_m) % 50.0
    assert np.minimum(lap, 50.0 - lap).max() < 1.4


def test_slices_and_iteration(five: Episodes) -> None:
    assert isinstance(five[:2], Episodes) and len(five[:2]) == 2
    assert [episode.key for episode in five] == [five[i].key for i in range(len(five))]
