"""Baselines against known answers, and the metrics that all methods share."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.trajectories import truth_errors
from idm_env.trajectories.baselines import BASELINES, bounded_spline
from idm_env.trajectories.scores import RegularMotion, Tally, from_positions, implausible, position_error_rate

CLOCK = np.arange(0, 60.05, 0.1)


def wave(clock: np.ndarray) -> RegularMotion:
    """A speed that swings by 3 m/s about 12 m/s, once in 25 s."""
    w = 2 * np.pi / 25
    return RegularMotion(
        clock, 12 * clock - 3 / w * np.cos(w * clock), 12 + 3 * np.sin(w * clock), 3 * w * np.cos(w * clock)
    )


@pytest.mark.parametrize("name", BASELINES)
def test_a_straight_line_is_kept_exactly(name: str) -> None:
    line = 5.0 + 10.0 * CLOCK
    motion = BASELINES[name](CLOCK, line, CLOCK)
    assert np.allclose(motion.position_m, line, atol=1e-3)
    assert np.allclose(motion.speed_mps, 10.0, atol=1e-3)
    assert np.allclose(motion.accel_mps2, 0.0, atol=2e-2)


@pytest.mark.parametrize("name", [name for name in BASELINES if name != "linear"])
def test_every_smoother_beats_straight_lines_on_noise(name: str) -> None:
    rng = np.random.default_rng(0)
    truth = wave(CLOCK)
    noisy = truth.position_m + 0.3 * rng.normal(size=len(CLOCK))
    errors = {}
    for method in ("linear", name):
        errors[method] = truth_errors([(BASELINES[method](CLOCK, noisy, CLOCK), truth)])
    assert errors[name]["speed_rmse_mps"] < 0.5 * errors["linear"]["speed_rmse_mps"]
    assert errors[name]["accel_rmse_mps2"] < 0.5 * errors["linear"]["accel_rmse_mps2"]


@pytest.mark.parametrize("name", BASELINES)
@pytest.mark.parametrize("count", [2, 3, 5])
def test_short_tracks_have_a_motion(name: str, count: int) -> None:
    time = np.arange(count) * 1.0
    clock = np.arange(0, time[-1] + 0.05, 0.1)
    motion = BASELINES[name](time, 3.0 * time, clock)
    assert np.isfinite(motion.accel_mps2).all()
    assert np.allclose(motion.speed_mps, 3.0, atol=0.1)


def test_the_bounded_spline_keeps_its_bounds_where_the_free_one_breaks_them() -> None:
    time = np.arange(0, 20.0, 1.0)
    position = np.where(time < 10, 15 * time, 150.0)  # an instant stop
    motion = bounded_spline(time, position, np.arange(0, 19.05, 0.1), 1.0, 4.0)
    free = bounded_spline(time, position, np.arange(0, 19.05, 0.1), 1.0, 1e3)
    assert np.abs(free.accel_mps2).max() > 4.0
    assert np.abs(motion.accel_mps2).max() <= 4.0
    assert motion.speed_mps.min() >= -1e-6


def test_long_splines_are_blended_from_blocks() -> None:
    clock = np.arange(0, 400.05, 0.1)
    truth = wave(clock)
    whole = bounded_spline(clock, truth.position_m, clock)
    assert np.abs(whole.speed_mps - truth.speed_mps).max() < 0.02


def test_kalman_agrees_with_the_exact_posterior_of_its_model() -> None:
    kalman = pytest.importorskip("benchmarks.trajectories").kalman
    clock = np.arange(0, 3.05, 0.1)
    rng = np.random.default_rng(1)
    data = wave(clock).position_m + 0.3 * rng.normal(size=len(clock))
    motion = kalman(clock, data, clock, density=0.3, sigma=0.3)
    # dense Gaussian: x(t) = x0 + v0 t + a0 t²/2 + ∫(t−s)² dW/2
    s, t = np.minimum.outer(clock, clock), np.maximum.outer(clock, clock)
    jerk = 0.3 * (s**5 / 20 + (t - s) * s**4 / 8 + (t - s) ** 2 * s**3 / 12)
    start = 25.0 + 100 * np.outer(clock, clock) + 10 * np.outer(clock**2, clock**2) / 4
    prior = jerk + start
    mean = data[0] + (data[-1] - data[0]) / clock[-1] * clock
    gain = np.linalg.solve(prior + 0.09 * np.eye(len(clock)), data - mean)
    assert np.allclose(motion.position_m, mean + prior @ gain, atol=1e-3)


def test_the_paper_s_metrics() -> None:
    clock = np.arange(0, 10.05, 0.1)
    motion = from_positions(clock, 10.0 * clock)
    assert position_error_rate(motion, clock, 10.0 * clock + 0.5) == pytest.approx(0.005)
    assert np.isnan(position_error_rate(motion, clock, np.zeros_like(clock)))
    assert not implausible(motion)
    hard = RegularMotion(clock, motion.position_m, motion.speed_mps, np.where(clock == 5.0, -10.5, 0.0))
    assert implausible(hard)
    first, second = Tally(), Tally()
    first.add(motion, clock, 10.0 * clock + 0.5)
    second.add(hard, clock, 10.0 * clock)
    first.merge(second)
    row = first.row()
    assert row["trajectories"] == 2 and row["implausible_percent"] == 50.0
    assert row["position_error_rate_percent"] == pytest.approx(0.25)
    assert row["accel_mean_mps2"] == pytest.approx(10.5 / (2 * len(clock)))
