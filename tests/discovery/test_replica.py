"""Records made once more by fitted drivers and their noise: it is that of the data, and tells what noise alone does."""

from __future__ import annotations

import numpy as np
import pytest

from idm_env.data import episodes, hidden, synthetic
from idm_env.discovery import judge, replica, search
from idm_env.discovery.calibrate import first_prior
from idm_env.discovery.model import Hypothesis
from idm_env.discovery.records import gather, windows
from idm_env.discovery.search import Search
from idm_env.discovery.solve import Problem, Solution
from idm_env.jobs.storage import Store


def fitted(ou: float) -> tuple[Problem, Solution]:
    """Return the windows of 24 drivers with noise, and drivers of IDM fitted to them."""
    made, _ = synthetic.generate(4, runs=8, followers=3, seconds=120.0, ou=ou)
    records = gather(list(episodes(made, smooth=True, min_seconds=12.0)))
    rows = windows(records)
    problem = Problem(rows, search.first_noise(rows), first_prior())
    searching = Search(problem, ("drag",), False, Store(None, "", False), lambda *_: None)
    null = searching.null(Hypothesis(), np.tile(problem.prior.centre, (problem.groups, 1)))
    return judge.windowed(records, searching.problem, null)


@pytest.mark.parametrize("ou", [0.0, 0.1])
def test_noise_of_drivers_is_that_of_the_data_and_what_it_leaves_agrees(ou: float) -> None:
    """An Ornstein–Uhlenbeck acceleration of 0.1 m/s² whose memory is 5 s."""
    problem, found = fitted(ou)
    drivers = replica.drivers_of(problem, found)
    assert np.median(drivers.sigma) == pytest.approx(ou, abs=0.03)
    assert not ou or 2.0 <= drivers.memory_s <= 8.0
    agreement = replica.agreement(problem, found, judge.floor(problem.rows.records)["horizon_rmse_m"], 0)
    assert not agreement.is_refused and agreement.p_value >= 0.05 and agreement.replicas >= replica.ENOUGH


def test_what_drivers_do_in_a_state_is_no_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    """Closing speeds count double above 2 m/s, under noise of 0.1 m/s²."""
    usual = hidden._desired_gap

    def doubled(speed, closing, time_gap, drivers):  # type: ignore[no-untyped-def]
        return usual(speed, np.where(closing > 2.0, 2.0 * closing - 2.0, closing), time_gap, drivers)

    monkeypatch.setattr(hidden, "_desired_gap", doubled)
    agreement = replica.agreement(*fitted(0.1), 0.05, 0)
    assert agreement.is_refused and agreement.replicas == replica.DRAWS
