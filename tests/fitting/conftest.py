"""Small generated platoons with known drivers, shared by the tests of fitting."""

from __future__ import annotations

import numpy as np
import pytest

from idm_env.data import Episodes, episodes, synthetic
from idm_env.data.synthetic import Truth

NAMES = ("max_accel", "comfort_decel", "time_gap", "min_gap", "desired_speed")


@pytest.fixture(scope="session")
def platoon() -> tuple[Episodes, Truth]:
    """Four runs of two followers, 100 s, 5 cm of position noise."""
    trajectories, truth = synthetic.generate(5, runs=4, followers=2, seconds=100.0, noise=0.05)
    return episodes(trajectories, max_gap=None, smooth=True), truth


def true_values(truth: Truth, groups: tuple[str, ...]) -> np.ndarray:
    """Return the drivers' parameters in the order of groups named run/vehicle, [G, 5]."""
    rows = {f"{r['run_id']}/{r['vehicle_id']}": r for r in truth.drivers.to_dicts()}
    return np.array([[rows[g][n] for n in NAMES] for g in groups])
