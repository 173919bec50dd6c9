"""Measured drivers with their own residuals: pushed in order they drive as measured; an effect is what differs."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from benchmarks import spiked
from benchmarks.spiked import Drivers
from idm_env.data import synthetic
from idm_env.data.samples import VEHICLES
from idm_env.fitting.batch import Batch


@pytest.fixture(scope="module")
def drivers() -> Drivers:
    """Six drivers with a delay and noise of their own, fitted as measured ones are."""
    return spiked.fitted(synthetic.generate(5, runs=3, followers=2, seconds=40.0, effect="delay", ou=0.1)[0])


def test_residuals_in_their_order_make_a_driver_drive_as_measured(drivers: Drivers) -> None:
    batch = Batch.stack(drivers.stretches, substeps=1)
    push = torch.zeros(batch.steps, len(batch), dtype=torch.float64)
    for row, e in enumerate(batch.episodes):
        push[: len(e) - 1, row] = torch.from_numpy(drivers.residuals[e.run_id, e.vehicle_id])
    _, speed = spiked.driven(batch, drivers.theta, push)
    driver = VEHICLES.index("driver")
    for row, e in enumerate(batch.episodes):
        difference = (speed[: len(e), row] - batch.all_speed[: len(e), row, driver]).abs().max()
        assert float(difference) < 0.05, e.key
    still, _ = spiked.driven(batch, drivers.theta, torch.zeros_like(push))
    assert float((still[250] - batch.position[250, :, driver]).abs().max()) > 0.2


def test_an_effect_at_strength_0_changes_nothing_and_at_2_it_does(drivers: Drivers) -> None:
    none, zero, twice = (
        spiked.spiked(drivers, effect, times, 3).table["position_m"].to_numpy()
        for effect, times in (("none", 0.0), ("gap_stiffness", 0.0), ("gap_stiffness", 2.0))
    )
    np.testing.assert_array_equal(none, zero)
    assert np.abs(twice - none).max() > 0.5
    (curve,), numbers = spiked.added("T after braking", 0.5)
    assert curve.name == "time_gap_over_braking_15s" and numbers == {"knot_0": 0.0, "knot_1": 0.15, "knot_2": 0.45}


def test_the_table_counts_what_is_false_where_nothing_was_added_and_right_names_where_something_was() -> None:
    errors = {"gap_rmse_m": 2.0, "horizon_rmse_m": 1.0}
    usual = {"source": "I-80", "before": errors, "after": {"gap_rmse_m": 1.0, "horizon_rmse_m": 0.5}}
    rows = [
        usual | {"effect": "none", "times": 0.0, "verdict": "named", "found": ["drag"], "named": ["drag"]},
        usual | {"effect": "none", "times": 0.0, "verdict": "none", "found": [], "named": []},
        usual | {"effect": "delay", "times": 1.0, "verdict": "one_of", "found": ["lag"], "named": ["lag"]},
        usual | {"effect": "memory", "times": 2.0, "verdict": "named", "found": ["drag"], "named": ["drag"]},
    ]
    said = spiked.shown(rows)
    assert "| none, I-80 | 1 of 2 |" in said and "| delay | 1 | 1 of 1 | 0 of 1 | 1 of 1 | 2.00, 0.50 |" in said
    assert "| memory | 2 | 0 of 1 | 1 of 1 | 1 of 1 |" in said
