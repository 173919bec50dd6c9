"""What is known of drivers who drift: the law of the process, and the variance that it gives to speeds."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.linalg import solve_continuous_lyapunov

from idm_env.effects import IDM, AccelNoise, Brakes, Effect, PerceptionNoise, Wander
from idm_env.roads import Lane
from idm_env.simulator import Simulator

DTYPE = torch.float64
DRIFTS: tuple[Effect, ...] = (
    AccelNoise(),
    Wander(),
    Wander(of="desired_speed"),
    Wander(of="min_gap"),
    PerceptionNoise(),
    PerceptionNoise(signal="closing_speed"),
)


@pytest.mark.parametrize("effect", DRIFTS, ids=lambda e: e.name)
@pytest.mark.parametrize("dt", [0.1, 0.5])
def test_the_process_has_unit_variance_and_its_memory_time_whatever_the_step(effect: Effect, dt: float) -> None:
    """Exact over a step: statistics of 4000 processes, from their long run on."""
    simulator = Simulator(Lane(), (IDM(), effect, Brakes()), dt=dt)
    params = simulator.defaults(dtype=DTYPE)
    params[effect.name]["memory_time"] = torch.tensor(2.0, dtype=DTYPE)
    there = torch.zeros(4000, 1, dtype=DTYPE)
    state = simulator.state(there, there + 20.0, params, seed=1)
    first = state.memory[effect.name]
    steps = round(2.0 / dt)
    last = simulator.rollout(state, {}, params, steps, seed=2)[0].memory[effect.name]
    assert first.var().item() == pytest.approx(1.0, abs=0.07)
    assert last.var().item() == pytest.approx(1.0, abs=0.07)
    assert (first * last).mean().item() == pytest.approx(math.exp(-1.0), abs=0.06)


def test_the_same_seed_draws_the_same_bits_and_another_effect_beside_changes_none_of_them() -> None:
    """Common random numbers: of a driver with one effect more, and of a batch in blocks of its own."""
    one, both = (Simulator(Lane(), (IDM(), *more, Brakes())) for more in ((Wander(),), (AccelNoise(), Wander())))
    like = torch.zeros(2, 3, dtype=DTYPE)
    drawn = one.drawn(like, {}, 5, seed=7)
    assert torch.equal(drawn["wander"], one.drawn(like, {}, 5, seed=7)["wander"])
    assert torch.equal(drawn["wander"], both.drawn(like, {}, 5, seed=7)["wander"])
    assert not torch.equal(drawn["wander"], both.drawn(like, {}, 5, seed=7)["accel_noise"])
    assert not torch.equal(drawn["wander"], one.drawn(like, {}, 5, seed=8)["wander"])
    given = {"wander": torch.zeros(5, 2, 3, dtype=DTYPE)}
    assert one.drawn(like, given, 5, seed=7)["wander"] is given["wander"]


def test_normals_that_nobody_gives_are_asked_for() -> None:
    """A rollout without inputs and without a seed says what is missing."""
    simulator = Simulator(Lane(), (IDM(), Wander(), Brakes()))
    params = simulator.defaults(dtype=DTYPE)
    state = simulator.state(torch.zeros(1, dtype=DTYPE), torch.ones(1, dtype=DTYPE), params)
    with pytest.raises(ValueError, match=r"'wander' takes normals.*seed="):
        simulator.rollout(state, {}, params, 3)


def test_speed_on_a_free_road_has_the_variance_of_a_filtered_process() -> None:
    """Near v0 ``dδv/dt = −λ δv + σ n`` with λ = 4a/v0, so ``var v = σ² τ / (λ (1 + λτ))``."""
    simulator = Simulator(Lane(), (IDM(), AccelNoise(), Brakes()))
    params = simulator.defaults(dtype=DTYPE)
    sigma, tau, a, v0 = 0.05, 2.0, 1.4, 20.0
    params["idm"] |= {"max_accel": torch.tensor(a, dtype=DTYPE), "desired_speed": torch.tensor(v0, dtype=DTYPE)}
    params["accel_noise"] = {k: torch.tensor(x, dtype=DTYPE) for k, x in (("sigma", sigma), ("memory_time", tau))}
    there = torch.zeros(4000, 1, dtype=DTYPE)
    end, _ = simulator.rollout(simulator.state(there, there + v0, params, seed=3), {}, params, 300, seed=4)
    rate = 4.0 * a / v0
    assert end.speed.var().item() == pytest.approx(sigma**2 * tau / (rate * (1.0 + rate * tau)), rel=0.08)


PARTIALS = ("accel_noise", "wander", "perception_noise", "perception_noise_closing_speed")


@pytest.mark.parametrize("name", PARTIALS)
def test_speeds_of_a_platoon_have_the_variances_of_linear_theory(name: str) -> None:
    """Behind a steady leader: ``δs' = δv_l − δv, δv' = f_s δs + f_v δv + f_l δv_l + g σ n``, with IDM's partials.

    The stationary covariance solves Lyapunov's equation ``A P + P Aᵀ + Q = 0``.
    """
    effect = next(e for e in DRIFTS if e.name == name)
    simulator = Simulator(Lane(), (IDM(), effect, Brakes()), dt=0.1, integration="midpoint")
    params = simulator.defaults(dtype=DTYPE)
    sigma, tau, followers, worlds = 0.01, 4.0, 3, 3000
    params[name] = {k: torch.tensor(x, dtype=DTYPE) for k, x in (("sigma", sigma), ("memory_time", tau))}
    a, b, time_gap, s0, v0 = (
        float(params["idm"][k]) for k in ("max_accel", "comfort_decel", "time_gap", "min_gap", "desired_speed")
    )
    v = 10.0
    desired = s0 + v * time_gap
    s = desired / math.sqrt(1.0 - (v / v0) ** 4)
    closing = v / (2.0 * math.sqrt(a * b))
    by_desired = -2.0 * a * desired / s**2
    f_s, f_l = 2.0 * a * desired**2 / s**3, -by_desired * closing
    f_v = -4.0 * a * v**3 / v0**4 + by_desired * (time_gap + closing)
    gain = {
        "accel_noise": 1.0,
        "wander": by_desired * v * time_gap,
        "perception_noise": f_s * s,
        "perception_noise_closing_speed": -f_l * s,
    }[name]
    size = 3 * followers
    matrix, drive = np.zeros((size, size)), np.zeros((size, size))
    for i in range(followers):
        gap, speed, level = 3 * i, 3 * i + 1, 3 * i + 2
        matrix[gap, speed], matrix[speed, gap], matrix[speed, speed], matrix[speed, level] = (
            -1.0,
            f_s,
            f_v,
            gain * sigma,
        )
        matrix[level, level], drive[level, level] = -1.0 / tau, 2.0 / tau
        if i:
            matrix[gap, speed - 3], matrix[speed, speed - 3] = 1.0, f_l
    expected = np.diag(solve_continuous_lyapunov(matrix, -drive))[1::3]

    position = -(s + 5.0) * torch.arange(followers + 1, dtype=DTYPE).expand(worlds, -1)
    steady = torch.full_like(position, v)
    params["idm"] = {k: x.expand(worlds, followers + 1).clone() for k, x in params["idm"].items()}
    # The leader has nobody ahead: his desired speed is v, and nothing disturbs him.
    params["idm"]["desired_speed"][:, 0] = v
    params[name]["sigma"] = torch.tensor([0.0] + [sigma] * followers, dtype=DTYPE)
    state = simulator.state(position, steady, params, seed=5)
    end, _ = simulator.rollout(state, {}, params, 500, seed=6)
    got = end.speed[:, 1:].var(0).numpy()
    assert got == pytest.approx(expected, rel=0.12)
