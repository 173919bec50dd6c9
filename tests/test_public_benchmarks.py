"""Published outputs and figures of car-following benchmarks come back from this package's step, by their rules."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.public_benchmarks import BASELINES, Clip, Event, RawIDM, events, follow, lost, opencf, transfollower


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
