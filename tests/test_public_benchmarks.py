"""Published outputs and figures of car-following benchmarks come back from this package's step, by their rules."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.opencf_forecast import FIRST, forecasts, submission
from benchmarks.public_benchmarks import BASELINES, Event, events, follow, lost, opencf, transfollower

from benchmarks.public_benchmarks import Clip, RawIDM  # isort: skip


def test_the_published_idm_trajectories_come_back(measured) -> None:  # type: ignore[no-untyped-def]
    """All three submitted IDM baselines on all 500 pairs; the table of their outputs is rounded to 1e-6 m."""
    apart = opencf(measured("opencf_published_outputs.parquet").parent)
    assert set(apart) == set(BASELINES)
    assert max(apart.values()) < 1e-5


def test_the_figures_of_transfollower_come_back(measured) -> None:  # type: ignore[no-untyped-def]
    folder = measured("transfollower_ngsim_pairs.parquet").parent
    assert len(events(folder / "transfollower_ngsim_pairs.parquet", "time_s")) == 202
    whole, first = transfollower(folder), transfollower(folder, most=150)
    assert (whole.total, whole.spacing, whole.speed) == pytest.approx((17.65, 17.08, 0.566), abs=0.006)
    assert (first.total, first.spacing, first.speed) == pytest.approx((11.71, 11.15, 0.565), abs=0.006)
    assert whole.collisions == first.collisions == 0


def event(steps: int = 50) -> Event:
    """A leader that stands 20 m ahead of a follower at 5 m/s."""
    time = 0.1 * np.arange(steps)
    return Event("one", np.full(steps, 20.0), np.zeros(steps), 5.0 * time, np.full(steps, 5.0))


def test_one_step_by_hand() -> None:
    """a = 1 − (5/30) − (s*/20)², s* = 2 + 5 (1.5 + 5/2) = 22 m; the position moves by the mean of both speeds."""
    ((position, speed),) = follow([event()], (30.0, 1.5, 1.0, 1.0, 2.0, 1.0), (RawIDM(exponent=None), Clip()), 0)
    after = 5.0 + 0.1 * (1.0 - 5.0 / 30.0 - 1.1**2)
    assert speed[0] == pytest.approx(after) and position[0] == pytest.approx(0.05 * (5.0 + after))


def test_a_halt_is_the_trapezoidal_rule_to_the_end_and_limits_hold() -> None:
    ((position, speed),) = follow(
        [event()], (30.0, 1.5, 1.0, 1.0, 2.0, 1.0), (RawIDM(exponent=None), Clip(-3.0, 5.0)), 0
    )
    whole, every = np.concatenate([[0.0], position]), np.concatenate([[5.0], speed])
    assert np.allclose(np.diff(whole), 0.05 * (every[1:] + every[:-1]), atol=1e-12)
    assert (speed >= 0.0).all() and np.diff(every).min() >= -0.3 - 1e-12


def test_a_collision_costs_what_it_loses() -> None:
    one = event()
    right = [(one.follower[1:].copy(), one.follower_speed[1:])]
    # 5 m/s reach the leader at 20 m after 40 steps, exactly; the step after is an overlap, and 9 of 50 steps are lost
    found = lost([one], right)
    assert found.collisions == 1 and found.total == pytest.approx(100.0 * 9)
    assert found.spacing == found.speed == 0.0
    right[0][0][:] = one.follower[1:] - 6.0
    found = lost([one], right)
    assert found.collisions == 0 and found.spacing == pytest.approx(36.0 * 49 / 50)


def test_a_submission_has_the_benchmarks_columns_and_times() -> None:
    """Six samples from 3.0 s on; acceleration is the change of speed, the first one from the last known speed."""
    one = replace(event(40), name="pair007")
    made = [(np.arange(60.0).reshape(6, 10), np.full((6, 10), 5.2))]
    table = submission([one], made)
    assert table.columns == [
        "CF_pair_id", "sample_id", "Time", "follower_dist", "follower_speed", "follower_acceleration"
    ]  # fmt: skip
    assert table["CF_pair_id"].unique().to_list() == ["test_7"] and table.height == 60
    first = table.filter(table["sample_id"] == 3)
    assert first["Time"].to_list() == [round(3.0 + 0.1 * k, 1) for k in range(10)]
    assert first["follower_dist"].to_list() == list(range(30, 40))
    assert first["follower_acceleration"].to_numpy() == pytest.approx([2.0] + 9 * [0.0])


def test_a_forecast_of_a_pair_begins_where_the_history_ends() -> None:
    """Behind a leader at a steady 5 m/s, 12 m ahead: six different samples, none of which jumps or collides."""
    time = 0.1 * np.arange(60)
    items = [Event(f"pair{k:03}", 12.0 + k + 5.0 * time, 0 * time + 5.0, 5.0 * time, 0 * time + 5.0) for k in range(3)]
    for one, (position, speed) in zip(items, forecasts(items, FIRST, count=12), strict=True):
        assert position.shape == speed.shape == (6, 30)
        assert np.abs(position[:, 0] - one.follower[FIRST + 1]).max() < 0.1
        assert (position < one.leader[FIRST + 1 :]).all() and len(np.unique(position[:, -1])) == 6
