"""The published recipe: its kernel against torch, against the published layer, and what the paper reports of it."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from idm_env.effects import IDM, Brakes, ImaginedLeader
from idm_env.roads import Lane
from idm_env.simulator import Simulator
from idm_env.trajectories import paper
from idm_env.trajectories.scores import implausible, position_error_rate
from idm_env.types import Imagined
from tests.trajectories.direct import direct
from tests.trajectories.tracks import swinging, track_of

loops = pytest.importorskip("idm_env.trajectories.paper_loops", reason="numba is not installed")


def test_settings_are_the_published_ones() -> None:
    assert paper.START.tolist() == [10, 2, 1, 5, 50]
    assert list(zip(paper.LOW.tolist(), paper.HIGH.tolist(), strict=True)) == [
        (5, 10), (0.1, 5), (0.1, 5), (1, 10), (20, 60),
    ]  # fmt: skip
    assert (paper.ITERATIONS, paper.RATES, paper.MAX_DECEL) == (500, (0.1, 0.01), 10.0)
    assert (paper.FILTER_STEP_S, paper.RECONSTRUCT_STEP_S) == (0.1, 1.0)


def inputs(steps: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    return np.array([7.0, 2.5, 1.2, 4.0, 40.0]), rng.uniform(3, 60, steps), rng.uniform(-3, 3, steps)


def test_kernel_is_the_simulator_in_the_paper_s_form() -> None:
    values, gap, closing = inputs(80)
    position, speed, accel = (np.empty(80) for _ in range(3))
    loops.forward(8.0, values, gap, closing, paper.NOBODY, paper.NOBODY, 0.1, 10.0, position, speed, accel)
    sim = Simulator(Lane(), (IDM(sharpness=1.0), ImaginedLeader(), Brakes(sharpness=1.0)), 0.1, "euler")
    params = sim.defaults(dtype=torch.float64)
    params["idm"] = dict(zip(paper.NAMES, torch.as_tensor(values), strict=True))
    params["brakes"]["max_decel"] = torch.tensor(10.0, dtype=torch.float64)
    state = sim.state(torch.zeros(1, dtype=torch.float64), torch.tensor([8.0], dtype=torch.float64), params)
    imagined = Imagined(torch.as_tensor(gap)[:, None], torch.as_tensor(closing)[:, None])
    _, kept = sim.rollout(state, {"imagined": imagined}, params, 79)
    assert np.allclose(kept.position[:, 0], position[1:], rtol=1e-12)
    assert np.allclose(kept.accel[:, 0], accel[:-1], rtol=1e-10)
    assert accel.min() < -5  # the floor is felt


@pytest.mark.parametrize("real", [False, True])
def test_gradient_is_exact(real: bool) -> None:
    values, gap, closing = inputs(30)
    closing = np.abs(closing)
    rear = 12.0 + 0.7 * np.arange(30) if real else paper.NOBODY
    pace = np.linspace(7.0, 4.0, 30) if real else paper.NOBODY
    seeds = np.linspace(-1, 1, 30)
    position, speed, accel = (np.empty(30) for _ in range(3))

    def loss(v: np.ndarray, g: np.ndarray, c: np.ndarray) -> float:
        loops.forward(8.0, v, g, c, rear, pace, 0.1, 10.0, position, speed, accel)
        return float(seeds @ position)

    loss(values, gap, closing)
    on = np.empty(5), np.empty(30), np.empty(30)
    loops.backward(values, gap, closing, real, 0.1, 10.0, speed.copy(), seeds, *on)
    points = (values,) if real else (values, gap, closing)
    for which, (point, gradient) in enumerate(zip(points, on, strict=False)):
        for i in range(0, len(point), 1 if which == 0 else 3):
            sides = []
            for sign in (1, -1):
                moved = [values.copy(), gap.copy(), closing.copy()]
                moved[which][i] += sign * 1e-5
                sides.append(loss(*moved))
            assert (sides[0] - sides[1]) / 2e-5 == pytest.approx(gradient[i], rel=2e-5, abs=1e-7)


def test_same_result_as_the_published_layer_with_torch_s_adam() -> None:
    rng = np.random.default_rng(3)
    tracks = [track_of(swinging(5.0, phase=p), 0.2 * rng.normal(size=51)) for p in (0.0, 2.0)]
    positions, values, gaps = direct(tracks, 0.1, 25)
    for i, track in enumerate(tracks):
        ours = paper.imitate(track, 0.1, iterations=25)
        assert np.allclose(ours.motion.position_m - track.position_m[0], positions[:, i], atol=1e-5)
        assert np.allclose(ours.values, values[i], atol=1e-5)
        assert np.allclose(ours.gap, gaps[:, i], atol=1e-4)


def test_published_quality_on_a_smooth_track_and_nothing_implausible() -> None:
    rng = np.random.default_rng(4)
    motion = swinging(60.0)
    found = paper.imitate(track_of(motion, 0.05 * rng.normal(size=601)))
    assert 100 * position_error_rate(found.motion, motion.time_s, motion.position_m) < 0.2
    assert not implausible(found.motion)
    assert (found.values >= paper.LOW).all() and (found.values <= paper.HIGH).all()


def test_ablation_keeps_the_five_and_reconstruction_steps_by_one_second() -> None:
    motion = swinging(60.0, dt=2.0)
    fixed = paper.imitate(track_of(motion), paper.RECONSTRUCT_STEP_S, fixed_parameters=True)
    free = paper.imitate(track_of(motion), paper.RECONSTRUCT_STEP_S)
    assert fixed.values.tolist() == paper.START.tolist()
    assert free.values.tolist() != paper.START.tolist()
    assert len(fixed.motion.time_s) == 61
    assert fixed.loss < 2.0 and free.loss < 2.0


def test_prediction_s_fit_finds_the_driver_behind_a_real_leader() -> None:
    """Driven by known values behind a braking leader, ten seconds give the motion back."""
    pace = np.linspace(12.0, 6.0, 101)
    rear = 20.0 + np.concatenate([[0.0], np.cumsum(pace[:-1] * 0.1)])
    truth = paper.drive(np.array([6.0, 2.5, 1.4, 3.0, 40.0]), 12.0, rear, pace, 0.1)
    found = paper.follow(truth, 12.0, rear, pace, 0.1)
    assert (found >= paper.LOW).all() and (found <= paper.HIGH).all()
    again = paper.drive(found, 12.0, rear, pace, 0.1)
    first = paper.drive(paper.START, 12.0, rear, pace, 0.1)
    assert np.abs(again - truth).mean() < 0.1 * np.abs(first - truth).mean()
