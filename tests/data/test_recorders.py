"""Clocks of recorders that are apart are put together; the delays of drivers are not taken for clocks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import polars as pl
import pytest

from idm_env.data import Trajectories, synthetic
from idm_env.data.recorders import clock_offsets, on_one_clock
from tests.data.tables import kinds

OFFSETS = {"1": 0.0, "2": 0.3, "3": -0.3, "4": 0.3}


def platoons(effect: str | None = None) -> Trajectories:
    return synthetic.generate(1, runs=6, seconds=100.0, effect=effect, noise=0.1)[0]


def apart(trajectories: Trajectories, without: Sequence[str] = ("gap_m", "gap_measured")) -> Trajectories:
    """The same platoons, every car with a logger of its own clock."""
    seconds = pl.col("vehicle_id").replace_strict(OFFSETS, return_dtype=pl.Float64)
    table = trajectories.table.drop(without).with_columns((pl.col("time_s") + seconds).round(3))
    return Trajectories.from_frame(table)


def test_loggers_of_several_clocks_are_put_on_one() -> None:
    """To 0.1 s, which leaves gaps as they were to 1.5 m where they were off by 12 m; said and counted."""
    truth, measured = platoons(), apart(platoons())
    offsets = clock_offsets(measured)
    assert len(offsets) == 18
    assert all(abs(seconds - OFFSETS[vehicle]) < 0.1 for (_, vehicle), seconds in offsets.items())
    together = on_one_clock(measured)
    assert kinds(together.repairs)["clocks apart"] == 18
    assert any("0.6 s apart" in repair.text for repair in together.repairs)

    def errors(some: Trajectories) -> np.ndarray:
        keys = ["run_id", "vehicle_id", "tick"]
        a, b = (x.table.with_columns((10 * pl.col("time_s")).round().alias("tick")) for x in (some, truth))
        both = a.join(b, on=keys, suffix="_true").drop_nulls(["gap_m", "gap_m_true"])
        return np.abs(both["gap_m"] - both["gap_m_true"]).to_numpy()

    assert errors(measured).max() > 8.0 and errors(together).max() < 2.5


@pytest.mark.parametrize("effect", [None, "delay", "second_leader", "brake_light"])
def test_one_clock_stays_as_it_is_whatever_drivers_do(effect: str | None) -> None:
    trajectories = platoons(effect)
    assert clock_offsets(trajectories) == {} and on_one_clock(trajectories) is trajectories


@pytest.mark.parametrize("has_gaps", [False, True])
def test_one_clock_stays_as_it_is_where_drivers_delay_and_foresee_unlike(has_gaps: bool) -> None:
    """Shifts of 24 drivers happen to be opposite for neighbours; all are of one sign, as answers are."""
    both = {"delay": 0.5, "leader_acceleration": 0.4}
    drivers = synthetic.generate(4, runs=6, seconds=100.0, effect=both, gap_column=has_gaps)[0]
    assert clock_offsets(drivers) == {}


def test_measured_gaps_tell_clocks_whatever_drivers_do() -> None:
    measured = synthetic.generate(1, runs=6, seconds=100.0, effect="delay", gap_column=True)[0]
    assert clock_offsets(measured) == {}
    offsets = clock_offsets(apart(measured, without=["gap_measured"]))
    assert len(offsets) == 18
    assert all(abs(seconds - OFFSETS[vehicle]) < 0.1 for (_, vehicle), seconds in offsets.items())


def test_nobody_behind_a_follower_tells_no_clock() -> None:
    measured = apart(platoons())
    few = replace(measured, table=measured.table.filter(pl.col("vehicle_id").is_in(["1", "2"])))
    assert clock_offsets(few) == {}


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_waves_in_which_every_shift_fits_alike_warn_of_nothing() -> None:
    """All shifts end at the same bound then: they have no spread, and nothing correlates with them."""
    time, cars, noise = np.arange(0.0, 30.0, 0.1), [], partial(np.random.default_rng(0).normal, 0.0, 0.05, 300)
    for run in range(8):
        lead = 15.0 + 4.0 * np.sin(time / 7.0 + run)
        place = 200.0 + 0.1 * np.cumsum(lead)
        for k in range(4):
            names = {"run_id": [f"{run}"] * 300, "vehicle_id": [f"{k}"] * 300, "length_m": [5.0] * 300}
            cars.append(pl.DataFrame({**names, "time_s": time, "position_m": place + noise(), "speed_mps": lead}))
            x, v = [place[0] - 30.0], [15.0]
            for ahead, faster in zip(place[:-1], lead[:-1], strict=True):
                wish = 2.0 + max(0.0, 1.5 * v[-1] + v[-1] * (v[-1] - faster) / 3.4641)
                accel = 1.5 * (1.0 - (v[-1] / 30.0) ** 4 - (wish / (ahead - x[-1] - 5.0)) ** 2)
                v.append(v[-1] + 0.1 * accel)
                x.append(x[-1] + 0.05 * (v[-1] + v[-2]))
            place, lead = np.array(x), np.array(v)
    assert clock_offsets(Trajectories.from_frame(pl.concat(cars))) == {}
