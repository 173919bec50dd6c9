"""The smoother: exact where there is nothing to smooth, near the truth where there is, consistent in itself."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from idm_env.data.smooth import fuse, noise_sigma, smooth

TIME = np.arange(600) * 0.1


def motion() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return 12 * TIME + 8 * np.sin(0.5 * TIME), 12 + 4 * np.cos(0.5 * TIME), -2 * np.sin(0.5 * TIME)


@settings(max_examples=30, derandomize=True)
@given(start=st.floats(-1e5, 1e5), speed=st.floats(-5, 40), accel=st.floats(-3, 3), length=st.integers(1, 50))
def test_a_constant_acceleration_is_left_alone(start: float, speed: float, accel: float, length: int) -> None:
    time = TIME[:length]
    position = start + speed * time + accel * time**2 / 2
    found = smooth(position, speed + accel * time, 0.1, 0.3, 0.1)
    assert all(len(part) == length and np.isfinite(part).all() for part in found)
    assert np.allclose(found.position, position, atol=1e-5)
    if length >= 4:
        assert np.allclose(found.speed, speed + accel * time, atol=1e-4)
        assert np.allclose(found.accel, accel, atol=1e-3)


@pytest.mark.parametrize("sigma", [0.02, 0.1, 0.5])
def test_noise_is_estimated(sigma: float) -> None:
    noisy = motion()[0] + sigma * np.random.default_rng(0).standard_normal(len(TIME))
    assert abs(noise_sigma(noisy) / sigma - 1) < 0.15


def test_noise_is_reduced_and_the_parts_agree() -> None:
    random = np.random.default_rng(1)
    position, speed, accel = motion()
    found = smooth(
        position + 0.3 * random.standard_normal(600), speed + 0.3 * random.standard_normal(600), 0.1, 0.3, 0.3
    )
    assert np.std(found.position - position) < 0.12
    assert np.std(found.speed - speed) < 0.12
    assert np.std(found.accel - accel) < 0.3
    assert np.allclose(found.speed[1:-1], (found.position[2:] - found.position[:-2]) / 0.2)
    assert np.allclose(found.accel[1:-1], np.diff(found.position, 2) / 0.01)


def test_speeds_help() -> None:
    random = np.random.default_rng(2)
    position, speed, _ = motion()
    noisy = position + 0.5 * random.standard_normal(600)
    alone = smooth(noisy, None, 0.1, 0.5).speed
    both = smooth(noisy, speed + 0.05 * random.standard_normal(600), 0.1, 0.5, 0.05).speed
    assert np.std(both - speed) < 0.5 * np.std(alone - speed)


def test_far_from_the_origin_nothing_changes() -> None:
    """A smoother that was kept for a rounded noise once put a car 1 m off at 1 km."""
    noisy = motion()[0] + 0.1 * np.random.default_rng(3).standard_normal(600)
    near, far = smooth(noisy, None, 0.1, 0.1234), smooth(noisy + 1e5, None, 0.1, 0.1234)
    assert np.allclose(near.position, far.position - 1e5, atol=1e-5)
    assert np.mean(near.position - noisy) == pytest.approx(0.0, abs=1e-6)


def test_every_noise_gives_its_own_solution() -> None:
    noisy = motion()[0] + 0.1 * np.random.default_rng(3).standard_normal(600)
    first, second = (smooth(noisy, None, 0.1, sigma).position for sigma in (0.100, 0.104))
    assert not np.allclose(first, second, atol=1e-5)


def test_single_jumps_are_resisted() -> None:
    position = motion()[0]
    spoilt = position + 0.05 * np.random.default_rng(4).standard_normal(600)
    spoilt[[100, 300]] += 5.0
    plain, robust = (smooth(spoilt, None, 0.1, 0.05, robust=times).position for times in (0, 8))
    assert abs(robust[100] - position[100]) < 0.3 * abs(plain[100] - position[100])


def test_fusing_trusts_speed_where_positions_drift() -> None:
    position, speed, accel = motion()
    drifting = position + 0.5 * np.sin(0.9 * TIME)
    found = fuse(drifting, speed, 0.1)
    assert np.std(found.speed - speed) < 0.05
    assert np.std(found.accel - accel) < 0.05
