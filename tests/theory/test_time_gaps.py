"""Known solutions of what changes the time gap: equilibria of a line over speed, of two branches, and of habit."""

from __future__ import annotations

import math

import pytest
import torch

from idm_env.effects import IDM, Brakes, Replay, make
from idm_env.roads import Lane
from idm_env.simulator import Simulator
from idm_env.types import Record

DTYPE = torch.float64
T, S0, V0 = 1.5, 2.0, 33.0


def accelerations(effect: str, gap: float, speed: float, lead_accel: float = 0.0, **given: float) -> float:
    """Return the acceleration of IDM with an effect, behind a leader of the same speed."""
    simulator = Simulator(Lane(), (IDM(), make(effect), Brakes()))
    params = simulator.defaults(dtype=DTYPE)
    params[effect] |= {k: torch.tensor(v, dtype=DTYPE) for k, v in given.items()}
    position = torch.tensor([0.0, -5.0 - gap], dtype=DTYPE)
    both = torch.tensor([speed, speed], dtype=DTYPE)
    state = simulator.state(position, both, params, accel=torch.tensor([lead_accel, 0.0], dtype=DTYPE))
    return float(simulator.acceleration(state, {}, params)[1])


def equilibrium(time_gap: float, speed: float) -> float:
    """Return IDM's equilibrium gap with a time gap."""
    return (S0 + time_gap * speed) / math.sqrt(1 - (speed / V0) ** 4)


@pytest.mark.parametrize(("speed", "factor"), [(0.0, 1.4), (10.0, 1.2), (20.0, 1.0), (30.0, 0.8)])
def test_a_time_gap_linear_in_speed(speed: float, factor: float) -> None:
    """With k = −0.4, T is its own value at 20 m/s, 20 % more at 10 m/s, 20 % less at 30 m/s."""
    assert abs(accelerations("speed_time_gap", equilibrium(factor * T, speed), speed, slope=-0.4)) < 1e-12


@pytest.mark.parametrize(("lead_accel", "factor"), [(0.0, 1.0), (0.3, 1 + 0.2 / math.sqrt(2)), (-30.0, 0.8)])
def test_two_branches(lead_accel: float, factor: float) -> None:
    """Half of the way at w = 0.3 m/s² (in the sense of 1/√2), all of it behind hard braking."""
    got = accelerations("set_point_asymmetry", equilibrium(factor * T, 15.0), 15.0, lead_accel, strength=0.2)
    assert abs(got) < 1e-4


@pytest.mark.parametrize(
    ("change", "lasts", "exponent"), [(1.5, 0.0, 0.5), (-1.5, 5.0, -0.5 / math.e), (9.0, 0.0, 2.0)]
)
def test_a_time_gap_by_the_leaders_trend(change: float, lasts: float, exponent: float) -> None:
    """T κ^x just after the leader's speed has changed by 3 x m/s, and so with x e^(−t/τ) when he holds it."""
    kappa, tau, speed = 0.6, 5.0, 15.0
    simulator = Simulator(Lane(), (IDM(), make("leader_trend"), Brakes()))
    params = simulator.defaults(dtype=DTYPE)
    params["leader_trend"] |= {
        "factor": torch.tensor(kappa, dtype=DTYPE),
        "memory_time": torch.tensor(tau, dtype=DTYPE),
    }
    gap = equilibrium(T * kappa**exponent, speed)
    both = torch.tensor([speed, speed], dtype=DTYPE)
    state = simulator.state(torch.tensor([0.0, -5.0 - gap], dtype=DTYPE), both, params)
    memory = torch.full_like(both, speed - change * math.exp(-lasts / tau))
    assert abs(float(simulator.acceleration(state._replace(memory={"leader_trend": memory}), {}, params)[1])) < 1e-12


def test_the_leaders_trend_fades_with_its_own_time() -> None:
    """Behind a leader who holds another speed than that remembered, the memory comes to it as e^(−t/τ)."""
    simulator = Simulator(Lane(), (IDM(), make("leader_trend"), Replay(), Brakes()))
    params = simulator.defaults(dtype=DTYPE)
    both, steps = torch.tensor([15.0, 15.0], dtype=DTYPE), 50
    state = simulator.state(torch.tensor([0.0, -40.0], dtype=DTYPE), both, params)
    ahead = 1.5 * torch.arange(1, steps + 1, dtype=DTYPE)[:, None].expand(steps, 2)
    same = torch.full((steps, 2), 15.0, dtype=DTYPE)
    record = Record(ahead, same, 0 * same, torch.tensor([True, False]).expand(steps, 2))
    begun = state._replace(memory={"leader_trend": both - 2.0})
    end, _ = simulator.rollout(begun, {"replay": record}, params, steps)
    assert float(end.memory["leader_trend"][1]) == pytest.approx(15.0 - 2.0 * math.exp(-1.0), abs=1e-9)


def test_a_driver_returns_from_a_gap_that_he_is_used_to_in_the_time_of_relaxation() -> None:
    """m − 1 decays with τ/(1 − β h), where h = vT/(s0 + vT) is the share of the gap that the time gap makes.

    The driver is so quick that he keeps the gap that he wants: then q − 1 = β h (m − 1).
    """
    beta, tau, speed, steps = 0.5, 10.0, 15.0, 300
    simulator = Simulator(Lane(), (IDM(), make("relaxation"), Replay(), Brakes()))
    params = simulator.defaults(dtype=DTYPE)
    params["relaxation"] |= {"strength": torch.tensor(beta), "memory_time": torch.tensor(tau)}
    params["idm"] |= {"max_accel": torch.tensor(10.0), "comfort_decel": torch.tensor(10.0)}
    share = speed * T / (S0 + speed * T)
    first = 0.7  # of the time gap, that a cut-in has left
    place = torch.tensor([0.0, -5.0 - equilibrium(first * T, speed)], dtype=DTYPE)
    start = simulator.state(place, torch.tensor([speed, speed], dtype=DTYPE), params)
    begin = float(start.memory["relaxation"][1])
    assert begin == pytest.approx(1 - (1 - first) * share, abs=1e-9)
    ahead = speed * 0.1 * torch.arange(1, steps + 1, dtype=DTYPE)[:, None].expand(steps, 2)
    same = torch.full((steps, 2), speed, dtype=DTYPE)
    record = Record(ahead, same, 0 * same, torch.tensor([True, False]).expand(steps, 2))
    end, kept = simulator.rollout(start, {"replay": record}, params, steps)
    expected = (begin - 1) * math.exp(-steps * 0.1 * (1 - beta * share) / tau)
    assert float(end.memory["relaxation"][1]) - 1 == pytest.approx(expected, rel=0.1)
    # IDM alone opens to its own gap within seconds; he takes half a minute and longer.
    params["relaxation"] |= {"strength": torch.tensor(0.0)}
    _, alone = simulator.rollout(start, {"replay": record}, params, steps)
    assert kept.gap[60, 1] < equilibrium(T, speed) - 2.0 < alone.gap[60, 1]
