"""Known solutions of desired speeds by place: a free driver ends at the speed that the place allows."""

from __future__ import annotations

import math

import pytest
import torch

from idm_env.effects import IDM, Brakes, Effect
from idm_env.effects.place_speeds import CurveSpeed, SpeedProfile
from idm_env.effects.places import interpolate
from idm_env.roads import Lane
from idm_env.simulator import Simulator

DTYPE = torch.float64
RING_M = 1000.0


def speeds(effect: Effect, laps: float = 2.0, **given: float) -> torch.Tensor:
    """Return the speeds of a lone driver (v0 = 33 m/s) over places of the last lap, one per metre."""
    simulator = Simulator(Lane(), (IDM(), effect, Brakes()))
    params = simulator.defaults(dtype=DTYPE)
    params[effect.name] |= {k: torch.tensor(v, dtype=DTYPE) for k, v in given.items()}
    start = simulator.state(torch.zeros(1, dtype=DTYPE), torch.full((1,), 10.0, dtype=DTYPE), params)
    _, kept = simulator.rollout(start, {}, params, 3000)
    place = kept.position[:, 0]
    inside = (place > (laps - 1.0) * RING_M) & (place <= laps * RING_M)
    return torch.stack((place[inside] % RING_M, kept.speed[inside, 0]))


@pytest.mark.parametrize("radius", [50.0, 200.0])
def test_a_long_bend_is_taken_at_the_speed_of_its_lateral_acceleration(radius: float) -> None:
    """``v²/R = a_lat``, left and right alike; IDM comes to v0 as (v/v0)⁴ → 1, so from above or below within 1 %."""
    for sign in (1.0, -1.0):
        bend = CurveSpeed(knots=(0.0, 500.0), profile=(sign / radius, sign / radius), period=RING_M)
        ends = speeds(bend, lateral_accel=2.5)[1, -1]
        assert float(ends) ** 2 / radius == pytest.approx(2.5, rel=0.02)
    straight = CurveSpeed(knots=(0.0, 500.0), profile=(0.0, 0.0), period=RING_M)
    assert float(speeds(straight, 3.0)[1, -1]) > 28.0


def test_several_dips_are_one_effect() -> None:
    """v0 falls to 40 and 60 % at two places of the lap: the driver is slowest there, and nowhere else below 80 %."""
    knots = (0.0, 200.0, 300.0, 400.0, 600.0, 700.0, 800.0, 999.0)
    changes = {"change_2": -0.6, "change_5": -0.4} | {f"change_{i}": 0.0 for i in (0, 1, 3, 4, 6, 7)}
    place, speed = speeds(SpeedProfile(knots=knots, period=RING_M), 3.0, **changes)
    first, second = (speed[(place > x - 60) & (place < x + 60)].min() for x in (300.0, 700.0))
    assert 0.35 * 33 < float(first) < 0.62 * 33 and float(first) < float(second) < 0.8 * 33
    assert math.isclose(float(speed.min()), float(first))


def test_profiles_that_are_none_are_refused() -> None:
    """One line with the value."""
    with pytest.raises(ValueError, match=r"curve_speed\.profile has 3 values for 2 knots"):
        CurveSpeed(knots=(0.0, 1.0), profile=(0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="at least two rising positions"):
        SpeedProfile(knots=(5.0, 1.0))


def test_as_many_heights_as_knots_that_rise() -> None:
    """In one line: whoever edits a file of a found effect counts wrong."""
    height = torch.tensor(0.0)
    for knots in ((0.0, 1.0), (0.0, 2.0, 1.0)):
        with pytest.raises(ValueError, match=r"^3 heights at knots \(.*\): knots must rise, one for every height\.$"):
            interpolate(height, knots, [height] * 3)
