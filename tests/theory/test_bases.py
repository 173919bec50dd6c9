"""Known solutions and published figures of the car-following laws beside IDM."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from idm_env.effects import BASES, Brakes, CarFollowing, Replay, make
from idm_env.roads import Lane
from idm_env.simulator import Simulator
from idm_env.types import Record, State

DTYPE = torch.float64
DRIVER = {"max_accel": 1.3, "comfort_decel": 1.9, "time_gap": 1.4, "min_gap": 2.5, "desired_speed": 30.0}


def acceleration(name: str, gap: float, speed: float, lead_speed: float, **given: float) -> float:
    """Return what a law wants behind a leader (m/s²), its other parameters at their defaults."""
    simulator = Simulator(Lane(), (make(name), Brakes()))
    params = simulator.defaults(dtype=DTYPE)
    params[name] |= {k: torch.tensor(v, dtype=DTYPE) for k, v in given.items()}
    position = torch.tensor([0.0, -5.0 - gap], dtype=DTYPE)
    state = simulator.state(position, torch.tensor([lead_speed, speed], dtype=DTYPE), params)
    return float(simulator.acceleration(state, {}, params)[1])


def idm_ratio(gap: float, speed: float, lead_speed: float) -> float:
    """Return s*/s of IDM."""
    a, b, time_gap, min_gap, _ = DRIVER.values()
    return (min_gap + max(0.0, speed * time_gap + speed * (speed - lead_speed) / (2 * math.sqrt(a * b)))) / gap


@pytest.mark.parametrize("speed", [0.0, 5.0, 15.0, 28.0])
@pytest.mark.parametrize("name", ["idm_plus", "iidm"])
def test_both_improvements_of_idm_keep_the_time_gap_at_every_speed(name: str, speed: float) -> None:
    """``s_e = s0 + v T`` below v0, which IDM reaches at standstill only (Treiber and Kesting 2013, 11.3.7)."""
    assert abs(acceleration(name, 2.5 + 1.4 * speed, speed, speed, **DRIVER)) < 1e-9


def test_idm_plus_and_improved_idm_are_their_published_formulas() -> None:
    """Written out again in plain Python, over gaps, speeds on both sides of v0, and leaders."""
    a, b, _, _, v0 = DRIVER.values()
    random = np.random.default_rng(0)
    for gap, speed, lead_speed in random.uniform((2.0, 0.0, 0.0), (90.0, 36.0, 36.0), (60, 3)):
        z, free = idm_ratio(gap, speed, lead_speed), 1 - (speed / v0) ** 4
        plus = a * min(free, 1 - z * z)
        if speed <= v0:
            f = a * free
            improved = a * (1 - z * z) if z >= 1 else f * (1 - z ** (2 * a / f))
        else:
            f = -b * (1 - (v0 / speed) ** (4 * a / b))
            improved = f + a * (1 - z * z) if z >= 1 else f
        for name, expected in (("idm_plus", plus), ("iidm", improved)):
            got = acceleration(name, gap, speed, lead_speed, **DRIVER)
            assert got == pytest.approx(max(expected, -9.0), abs=0.03 if expected < -8.8 else 1e-6), name


def test_gipps_steps_of_the_reaction_time_are_the_published_model() -> None:
    """A platoon that starts and stops, by the two rules of 1981 with the means of its sample of drivers.

    a = 1.7 m/s², b = 2a, b̂ = (3 + b)/2, τ = 2/3 s, an effective size of 6.5 m, v0 = 20 m/s.
    """
    a, b, hat, tau, size, v0, cars, steps = 1.7, 3.4, 3.2, 2 / 3, 6.5, 20.0, 5, 120
    lead = np.clip(np.concatenate([np.linspace(0, 20, 40), np.linspace(20, 4, 20), np.linspace(4, 15, 60)]), 0, None)
    lead = np.append(lead, lead[-1])
    x, v = -8.0 * np.arange(cars), np.zeros(cars)
    expected = []
    for k in range(steps):
        free = v + 2.5 * a * tau * (1 - v / v0) * np.sqrt(0.025 + v / v0)
        room = 2 * (x[:-1] - size - x[1:]) - v[1:] * tau
        safe = -b * tau + np.sqrt(b**2 * tau**2 + b * (room + v[:-1] ** 2 / hat))
        after = np.append(lead[k + 1], np.minimum(free[1:], safe))
        x, v = x + 0.5 * tau * (v + after), after
        expected.append(x)
    # A length of 5 m and a smallest gap of 1.5 m are an effective size of 6.5 m.
    simulator = Simulator(Lane(), (make("gipps"), Replay(), Brakes()), dt=tau)
    params = simulator.defaults(dtype=DTYPE)
    params["gipps"] |= {"min_gap": torch.tensor(1.5, dtype=DTYPE), "desired_speed": torch.tensor(v0, dtype=DTYPE)}
    front, speed = torch.tensor(np.array(expected)[:, :1]), torch.tensor(lead[1:, None])
    active = (torch.arange(cars) == 0).expand(steps, cars)
    record = Record(front.expand(steps, cars), speed.expand(steps, cars), torch.zeros(steps, cars).double(), active)
    start = simulator.state(-8.0 * torch.arange(cars, dtype=DTYPE), torch.zeros(cars, dtype=DTYPE), params)
    _, kept = simulator.rollout(start, {"replay": record}, params, steps)
    np.testing.assert_allclose(kept.position.numpy(), np.array(expected), atol=1e-8)
    assert kept.speed[-1, -1] > 5.0


@pytest.mark.parametrize("speed", [2.0, 10.0, 25.0])
def test_gipps_equilibrium(speed: float) -> None:
    """``s_e = s0 + 1.5 v τ + v² (1/b − 1/b̂)/2``."""
    gap = 2.0 + 1.5 * speed * 2 / 3 + 0.5 * speed**2 * (1 / 3.4 - 1 / 3.2)
    assert abs(acceleration("gipps", gap, speed, speed)) < 1e-9


def test_the_full_velocity_difference_model_starts_a_queue_as_published() -> None:
    """Cars 7.4 m apart start at a green light one after the other every 1.4 s (Jiang, Wu, Zhu 2001, table I).

    V(s) = 6.75 + 7.91 tanh(0.13 s − 1.57) m/s, κ = 0.41 1/s, λ = 0.5 1/s, vehicles of 5 m. The optimal velocity model
    (κ = 0.85 1/s, λ = 0) takes 1.6 s.
    """
    assert make("fvdm").offset == pytest.approx(math.atanh(6.75 / 7.91), abs=1e-3)  # type: ignore[attr-defined]
    v0 = 6.75 + 7.91
    given = {
        "sensitivity": 0.41, "desired_speed": v0, "min_gap": (1.57 - math.atanh(6.75 / 7.91)) / 0.13,
        "time_gap": (1 + 6.75 / 7.91) / (0.13 * v0),
    }  # fmt: skip
    # The law itself is the published one.
    for gap, speed, lead_speed in ((2.4, 0.0, 3.0), (15.0, 8.0, 5.0), (60.0, 12.0, 14.0)):
        published = 0.41 * (6.75 + 7.91 * math.tanh(0.13 * gap - 1.57) - speed) + 0.5 * (lead_speed - speed)
        assert acceleration("fvdm", gap, speed, lead_speed, speed_gain=0.5, **given) == pytest.approx(
            published, abs=2e-3
        )
    for kappa, gain, seconds in ((0.41, 0.5, 1.4), (0.85, 0.0, 1.6)):
        simulator = Simulator(Lane(), (make("fvdm"), Brakes()), dt=0.02)
        params = simulator.defaults(dtype=DTYPE)
        own = {"sensitivity": kappa, "speed_gain": gain}
        params["fvdm"] |= {k: torch.tensor(v, dtype=DTYPE) for k, v in {**given, **own}.items()}
        position = -7.4 * torch.arange(11, dtype=DTYPE)
        _, kept = simulator.rollout(simulator.state(position, 0 * position, params), {}, params, 1500)
        # Followers' speed curves are shifted copies of each other: the shift of the speed of half of v0.
        half = (kept.speed < 0.5 * v0).sum(0) * simulator.dt
        assert float(half[1:].diff().mean()) == pytest.approx(seconds, abs=0.1)


def behind_a_sine(simulator: Simulator, params: dict, omega: float) -> float:
    """Return the gain of speed from a leader that oscillates by 0.5 m/s about 20 m/s to its follower."""
    dt = simulator.dt
    steps = round(40 * 2 * math.pi / omega / dt)
    time = dt * torch.arange(1, steps + 1, dtype=DTYPE)
    speed = 20 + 0.5 * torch.sin(omega * time)
    place = 20 * time + 0.5 / omega * (1 - torch.cos(omega * time))
    accel = 0.5 * omega * torch.cos(omega * time)
    two = [torch.stack((x, x), -1) for x in (place, speed, accel)]
    record = Record(*two, torch.tensor([True, False]).expand(steps, 2))
    start: State = simulator.state(
        torch.tensor([0.0, -31.0], dtype=DTYPE), torch.tensor([20.0, 20.0], dtype=DTYPE), params
    )
    _, kept = simulator.rollout(start, {"replay": record}, params, steps)
    late = kept.speed[steps // 2 :, 1]
    return float((late.max() - late.min()) / 2 / 0.5)


@pytest.mark.parametrize("omega", [0.1, 0.3, 0.8])
def test_a_linear_controller_has_its_transfer_function(omega: float) -> None:
    """``(c z² + k_v z + k_s)/(τ z³ + z² + (k_s T + k_v) z + k_s)`` at z = iω, with the measured gains of 2014."""
    simulator = Simulator(Lane(), (make("constant_time_gap"), Replay(), Brakes()), dt=0.02)
    params = simulator.defaults(dtype=DTYPE)
    p = {name: float(value) for name, value in params["constant_time_gap"].items()}
    assert (p["gap_gain"], p["speed_gain"], p["time_gap"]) == (0.23, 0.07, pytest.approx(1.1))
    z = 1j * omega
    top = p["feed_forward"] * z**2 + p["speed_gain"] * z + p["gap_gain"]
    below = p["lag"] * z**3 + z**2 + (p["gap_gain"] * p["time_gap"] + p["speed_gain"]) * z + p["gap_gain"]
    assert behind_a_sine(simulator, params, omega) == pytest.approx(abs(top / below), rel=0.01)


def test_a_linear_controller_is_limited_and_goes_no_faster_than_set() -> None:
    """Wide gaps ask for k_0 (v0 − v) at most, and nothing asks for more than the limits."""
    given = {"lag": 0.01, "max_accel": 1.5, "comfort_decel": 3.0, "desired_speed": 25.0}
    share = 0.1 / 0.11  # of a lag of 10 ms in a step of 100 ms
    for gap, speed, lead_speed, expected in ((500.0, 24.0, 30.0, 0.4), (500.0, 5.0, 30.0, 1.5), (5.0, 25.0, 5.0, -3.0)):
        got = acceleration("constant_time_gap", gap, speed, lead_speed, **given)
        assert got == pytest.approx(expected * share, rel=1e-6)


@pytest.mark.parametrize("name", BASES)
def test_other_effects_act_on_every_base(name: str) -> None:
    """A regime that doubles the time gap makes everybody slower behind the same leader."""
    assert issubclass(type(make(name)), CarFollowing)
    ends = []
    for strength in (0.0, 1.0):
        simulator = Simulator(Lane(), (make(name), make("regime_shift"), Brakes()))
        params = simulator.defaults(dtype=DTYPE)
        params["regime_shift"] |= {"strength": torch.tensor(strength), "time": torch.tensor(0.0)}
        position = torch.tensor([0.0, -30.0], dtype=DTYPE)
        start = simulator.state(position, torch.tensor([15.0, 15.0], dtype=DTYPE), params)
        ends.append(float(simulator.rollout(start, {}, params, 100)[0].position[1]))
    assert ends[1] < ends[0] - 1.0
