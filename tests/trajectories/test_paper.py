"""The published recipe: against the published layer with torch's Adam, and what the paper reports of it."""

from __future__ import annotations

import numpy as np
import pytest

from idm_env.trajectories import paper
from idm_env.trajectories.scores import implausible, position_error_rate
from tests.trajectories.direct import behind, direct
from tests.trajectories.tracks import swinging, track_of


def test_settings_are_the_published_ones() -> None:
    assert paper.START.tolist() == [10, 2, 1, 5, 50]
    assert list(zip(paper.LOW.tolist(), paper.HIGH.tolist(), strict=True)) == [
        (5, 10), (0.1, 5), (0.1, 5), (1, 10), (20, 60),
    ]  # fmt: skip
    assert (paper.ITERATIONS, paper.RATES, paper.MAX_DECEL) == (500, (0.1, 0.01), 10.0)
    assert (paper.FILTER_STEP_S, paper.RECONSTRUCT_STEP_S) == (0.1, 1.0)


def test_same_values_behind_a_real_leader_as_the_published_layer_s() -> None:
    pace = np.linspace(12.0, 4.0, 30)
    rear = 40.0 + np.concatenate([[0.0], np.cumsum(0.1 * pace[:-1])])
    target = np.cumsum(np.random.default_rng(5).uniform(0.4, 1.2, 30))
    [ours] = paper.follow([paper.Followed(target, 8.0, rear, pace)], 0.1, iterations=60)
    assert np.allclose(ours, behind(target, 8.0, rear, pace, 0.1, 60), atol=1e-9)
    assert (np.abs(ours - paper.START) > 0.01).all()  # each of the five has moved


def test_tracks_share_nothing_but_the_loop() -> None:
    tracks = [track_of(swinging(seconds, phase=seconds)) for seconds in (6.0, 2.0, 4.0)]
    for track, among in zip(tracks, paper.imitate(tracks, iterations=20), strict=True):
        [alone] = paper.imitate([track], iterations=20)
        assert np.allclose(among.motion.position_m, alone.motion.position_m, rtol=1e-12)
        assert np.allclose(among.gap, alone.gap, rtol=1e-12) and len(among.gap) == len(track)
        assert among.loss == pytest.approx(alone.loss, rel=1e-12)


def test_same_result_as_the_published_layer_with_torch_s_adam() -> None:
    rng = np.random.default_rng(3)
    tracks = [track_of(swinging(5.0, phase=p), 0.2 * rng.normal(size=51)) for p in (0.0, 2.0)]
    positions, values, gaps = direct(tracks, 0.1, 25)
    for i, (track, ours) in enumerate(zip(tracks, paper.imitate(tracks, 0.1, iterations=25), strict=True)):
        assert np.allclose(ours.motion.position_m - track.position_m[0], positions[:, i], atol=1e-9)
        assert np.allclose(ours.values, values[i], atol=1e-9)
        assert np.allclose(ours.gap, gaps[:, i], atol=1e-8)


def test_published_quality_on_a_smooth_track_and_nothing_implausible() -> None:
    rng = np.random.default_rng(4)
    motion = swinging(60.0)
    found = paper.imitate([track_of(motion, 0.05 * rng.normal(size=601))])[0]
    assert 100 * position_error_rate(found.motion, motion.time_s, motion.position_m) < 0.2
    assert not implausible(found.motion)
    assert (found.values >= paper.LOW).all() and (found.values <= paper.HIGH).all()


def test_ablation_keeps_the_five_and_reconstruction_steps_by_one_second() -> None:
    motion = swinging(60.0, dt=2.0)
    [fixed] = paper.imitate([track_of(motion)], paper.RECONSTRUCT_STEP_S, fixed_parameters=True)
    [free] = paper.imitate([track_of(motion)], paper.RECONSTRUCT_STEP_S)
    assert fixed.values.tolist() == paper.START.tolist()
    assert free.values.tolist() != paper.START.tolist()
    assert len(fixed.motion.time_s) == 61
    assert fixed.loss < 2.0 and free.loss < 2.0


def test_prediction_s_fit_finds_the_driver_behind_a_real_leader() -> None:
    """Driven by known values behind a braking leader, ten seconds give the motion back."""
    pace = np.linspace(12.0, 6.0, 101)
    rear = 20.0 + np.concatenate([[0.0], np.cumsum(pace[:-1] * 0.1)])
    truth = paper.drive(np.array([6.0, 2.5, 1.4, 3.0, 40.0]), 12.0, rear, pace, 0.1)
    [found] = paper.follow([paper.Followed(truth, 12.0, rear, pace)], 0.1)
    assert (found >= paper.LOW).all() and (found <= paper.HIGH).all()
    again = paper.drive(found, 12.0, rear, pace, 0.1)
    first = paper.drive(paper.START, 12.0, rear, pace, 0.1)
    assert np.abs(again - truth).mean() < 0.1 * np.abs(first - truth).mean()
