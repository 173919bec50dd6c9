"""Known solutions: what theory says of the model, without the simulator."""

from __future__ import annotations

import math

import pytest
import torch
from diffidm import IDMLayer
from scipy.integrate import solve_ivp

from idm_env.effects import IDM, Brakes, make
from idm_env.roads import Lane, Ring
from idm_env.simulator import Simulator
from idm_env.types import Command, Record

DTYPE = torch.float64
A, B, T, S0, V0 = 1.4, 2.0, 1.5, 2.0, 33.0


def pair(simulator: Simulator, gap: float, speed: float, lead_speed: float) -> tuple:
    """Return a state of a leader and one follower, and default parameters."""
    params = simulator.defaults(dtype=DTYPE)
    position = torch.tensor([0.0, -5.0 - gap], dtype=DTYPE)
    return simulator.state(position, torch.tensor([lead_speed, speed], dtype=DTYPE), params), params


@pytest.mark.parametrize("speed", [0.0, 5.0, 15.0, 30.0])
def test_the_equilibrium_gap_gives_zero_acceleration(speed: float) -> None:
    """``s_e = (s0 + v T) / √(1 − (v/v0)⁴)``."""
    simulator = Simulator(Lane(), (IDM(), Brakes()))
    gap = (S0 + speed * T) / math.sqrt(1 - (speed / V0) ** 4)
    state, params = pair(simulator, gap, speed, speed)
    assert simulator.acceleration(state, {}, params)[1].abs() < 1e-12


def test_accelerations_and_gradients_of_the_published_package() -> None:
    """``sharpness=1`` is diffidm 0.0.3, to float64's last digits, gradients with respect to everything included."""
    generator = torch.Generator().manual_seed(0)
    n = 400

    def draw(low: float, high: float) -> torch.Tensor:
        return low + (high - low) * torch.rand(n, generator=generator, dtype=DTYPE)

    x = {
        "max_accel": draw(0.5, 5), "comfort_decel": draw(0.5, 5), "time_gap": draw(0.3, 3), "min_gap": draw(1, 5),
        "desired_speed": draw(10, 40), "max_decel": draw(4, 10),
    }  # fmt: skip
    speed, gap, lead_speed = draw(0, 30), draw(0.5, 80), draw(0, 30)
    leaves = [*x.values(), speed, gap, lead_speed]
    for leaf in leaves:
        leaf.requires_grad_()
    theirs = IDMLayer.apply(
        x["max_accel"], -x["max_decel"], x["comfort_decel"], speed, x["desired_speed"], gap, speed - lead_speed,
        x["min_gap"], x["time_gap"], torch.tensor(0.1, dtype=DTYPE),
    )  # fmt: skip
    simulator = Simulator(Lane(), (IDM(sharpness=1.0), Brakes(sharpness=1.0)), dt=0.1, integration="euler")
    params = {
        "idm": {k: v[:, None] for k, v in x.items() if k != "max_decel"},
        "brakes": {"max_decel": x["max_decel"][:, None]},
    }
    zero = torch.zeros_like(gap)
    state = simulator.state(torch.stack((gap + 5.0, zero), -1), torch.stack((lead_speed, speed), -1), params)
    ours = simulator.acceleration(state, {}, params)[:, 1]
    torch.testing.assert_close(ours, theirs, rtol=1e-12, atol=1e-10)
    weights = draw(-1, 1)
    for mine, other in zip(
        torch.autograd.grad((ours * weights).sum(), leaves),
        torch.autograd.grad((theirs * weights).sum(), leaves),
        strict=True,
    ):
        torch.testing.assert_close(mine, other, rtol=1e-9, atol=1e-10)


def test_the_published_faults_are_reproduced_by_the_paper_form_and_absent_from_the_default() -> None:
    """A free road from standstill: the paper's form exceeds a_max = 1.5 (1.701), ours does not."""
    for sharpness, expected in ((1.0, 1.7014), (None, 1.5)):
        simulator = Simulator(
            Lane(), (IDM(sharpness=sharpness), Brakes(sharpness=sharpness)), dt=0.1, integration="euler"
        )
        params = simulator.defaults(dtype=DTYPE)
        params["idm"]["max_accel"] = torch.tensor(1.5, dtype=DTYPE)
        state = simulator.state(torch.zeros(1, dtype=DTYPE), torch.zeros(1, dtype=DTYPE), params)
        torch.testing.assert_close(
            simulator.acceleration(state, {}, params)[0], torch.tensor(expected, dtype=DTYPE), rtol=0, atol=1e-4
        )


def parked(simulator: Simulator, seconds: float) -> float:
    """Return the gap behind a leader parked 45 m ahead, after ``seconds``, approaching at 10 m/s."""
    state, params = pair(simulator, 45.0, 10.0, 0.0)
    steps = round(seconds / simulator.dt)
    zero = torch.zeros(1, 2, dtype=DTYPE).expand(steps, 2)
    record = Record(zero, zero, zero, torch.tensor([True, False]).expand(steps, 2))
    return simulator.rollout(state, {"replay": record}, params, steps)[1].gap[-1, 1].item()


def clipped_idm(seconds: float, dt: float = 1e-3) -> float:
    """Return the same gap from the exact clipped IDM, integrated by a fine explicit loop of its own."""
    v, s = 10.0, 45.0
    for _ in range(round(seconds / dt)):
        wanted = S0 + max(0.0, v * T + v * v / (2 * math.sqrt(A * B)))
        a = max(-9.0, A * (1 - (v / V0) ** 4 - (wanted / s) ** 2))
        after = max(0.0, v + a * dt)
        s -= 0.5 * (v + after) * dt
        v = after
    return s


@pytest.mark.parametrize("integration", ["ballistic", "euler", "midpoint"])
def test_no_creep_behind_a_parked_leader(integration: str) -> None:
    """Within 5 cm of the exact clipped IDM after 600 s; the paper's floor creeps to 0.9 m."""
    exact = clipped_idm(200.0)
    ours = parked(Simulator(Lane(), (IDM(), make("replay"), Brakes()), integration=integration), 600.0)  # type: ignore[arg-type]
    assert abs(ours - exact) < 0.05
    smooth = (IDM(sharpness=1.0), make("replay"), Brakes(sharpness=1.0))
    assert parked(Simulator(Lane(), smooth, integration="euler"), 600.0) < 1.0


def _partials(speed: float, time_gap: float) -> tuple[float, float, float]:
    """Return ∂a/∂s, ∂a/∂v, ∂a/∂v_lead of IDM at equilibrium, by hand."""
    s = (S0 + speed * time_gap) / math.sqrt(1 - (speed / V0) ** 4)
    star = S0 + speed * time_gap
    by_gap = 2 * A * star**2 / s**3
    by_lead = 2 * A * star / s**2 * speed / (2 * math.sqrt(A * B))
    by_speed = -4 * A * speed**3 / V0**4 - 2 * A * star / s**2 * time_gap - by_lead
    return by_gap, by_speed, by_lead


@pytest.mark.parametrize("speed", [3.0, 8.0, 14.0, 20.0, 26.0])
@pytest.mark.parametrize("time_gap", [0.8, 1.5, 2.5])
def test_linear_string_stability(speed: float, time_gap: float) -> None:
    """A long wave on a ring grows exactly where ``v_e'(s) > (f_l − f_v)/2`` (Treiber and Kesting 2013, ch. 15)."""
    by_gap, by_speed, by_lead = _partials(speed, time_gap)
    slope = -by_gap / (by_speed + by_lead)
    margin = slope - 0.5 * (by_lead - by_speed)
    n = 60
    k = 2 * math.pi / n
    # The exact growth rate of that mode: λ² − (f_v + f_l e^{−ik}) λ + f_s (1 − e^{−ik}) = 0 for position deviations.
    phase = complex(math.cos(k), -math.sin(k))
    b, c = -(by_speed + by_lead * phase), by_gap * (1 - phase)
    roots = [(-b + sign * (b * b - 4 * c) ** 0.5) / 2 for sign in (1, -1)]
    growth = max(r.real for r in roots)
    assert (growth > 0) == (margin > 0) or abs(margin) < 2e-3
    gap = (S0 + speed * time_gap) / math.sqrt(1 - (speed / V0) ** 4)
    simulator = Simulator(Ring(n * (gap + 5.0)), (IDM(), Brakes()), dt=0.05)
    params = simulator.defaults(dtype=DTYPE)
    params["idm"]["time_gap"] = torch.tensor(time_gap, dtype=DTYPE)
    index = torch.arange(n, dtype=DTYPE)
    position = -(gap + 5.0) * index + 1e-4 * torch.cos(k * index)
    state = simulator.state(position, torch.full((n,), speed, dtype=DTYPE), params)
    _, kept = simulator.rollout(state, {}, params, 6000)
    deviation = (kept.speed - kept.speed.mean(-1, keepdim=True)).std(-1)
    measured = torch.log(deviation[-1] / deviation[3000]) / (0.05 * 2999)
    assert measured.item() == pytest.approx(growth, abs=2e-4 + 0.02 * abs(growth))


@pytest.mark.parametrize(("integration", "order"), [("euler", 1.0), ("ballistic", 1.0), ("midpoint", 2.0)])
def test_integrators_converge_with_their_order(integration: str, order: float) -> None:
    """Against an adaptive eighth-order solution; the first two update speeds explicitly, so first order in Δt."""

    def right_hand_side(t: float, y: list[float]) -> list[float]:
        s, v = y
        wanted = S0 + max(0.0, v * T + v * (v - 12.0) / (2 * math.sqrt(A * B)))
        return [12.0 - v, A * (1 - (v / V0) ** 4 - (wanted / s) ** 2)]

    truth = solve_ivp(right_hand_side, (0, 16), [30.0, 9.0], method="DOP853", rtol=1e-12, atol=1e-12).y[0, -1]
    errors = []
    for dt in (0.2, 0.1, 0.05):
        simulator = Simulator(Lane(), (IDM(), make("replay"), Brakes()), dt=dt, integration=integration)  # type: ignore[arg-type]
        state, params = pair(simulator, 30.0, 9.0, 12.0)
        steps = round(16 / dt)
        column = 12.0 * dt * torch.arange(1, steps + 1, dtype=DTYPE)
        position = torch.stack((column, 0 * column), -1)
        record = Record(
            position,
            torch.full_like(position, 12.0),
            torch.zeros_like(position),
            torch.tensor([True, False]).expand(steps, 2),
        )
        end, _ = simulator.rollout(state, {"replay": record}, params, steps)
        errors.append(abs(end.gap[1].item() - truth))
    observed = math.log2(errors[0] / errors[2]) / 2
    assert observed == pytest.approx(order, abs=0.15)


def test_a_ballistic_step_is_exact_under_constant_acceleration_and_stops_in_the_step() -> None:
    """``x = v²/(2 |a|)`` when the car comes to rest inside a step; Euler is late by ``v Δt / 2``."""
    simulator = Simulator(Lane(), (IDM(), make("control"), Brakes()), dt=0.7)
    params = simulator.defaults(dtype=DTYPE)
    state = simulator.state(torch.zeros(1, dtype=DTYPE), torch.full((1,), 10.0, dtype=DTYPE), params)
    command = Command(torch.full((20, 1), -3.0, dtype=DTYPE), torch.ones(20, 1, dtype=torch.bool))
    end, kept = simulator.rollout(state, {"control": command}, params, 20)
    assert end.position.item() == pytest.approx(100 / 6, rel=1e-12)
    assert end.speed.item() == 0.0 and kept.speed[3, 0].item() == pytest.approx(10 - 3 * 2.8)


def test_a_delay_of_whole_steps_is_idm_of_that_many_steps_ago() -> None:
    """Against a plain loop with a list as buffer."""
    dt, lag = 0.1, 6
    simulator = Simulator(Lane(), (IDM(), make("delay"), make("replay"), Brakes()), dt=dt)
    steps = 200
    t = dt * torch.arange(steps + 1, dtype=DTYPE)
    lead_speed = 12.0 + 2.0 * torch.sin(0.4 * t)
    lead = 12.0 * t + 5.0 * (1 - torch.cos(0.4 * t))
    state, params = pair(simulator, 22.0, 12.0, 12.0)
    params["delay"]["delay"] = torch.tensor(lag * dt, dtype=DTYPE)
    zero = torch.zeros(steps, dtype=DTYPE)
    record = Record(
        torch.stack((lead[1:], zero), -1),
        torch.stack((lead_speed[1:], zero), -1),
        torch.zeros(steps, 2, dtype=DTYPE),
        torch.tensor([True, False]).expand(steps, 2),
    )
    _, kept = simulator.rollout(state, {"replay": record}, params, steps)
    x, v, past = -27.0, 12.0, []
    for k in range(steps):
        past.append((lead[k].item() - 5.0 - x, v, lead_speed[k].item()))
        s, own, other = past[max(0, k - lag)]
        wanted = S0 + max(0.0, own * T + own * (own - other) / (2 * math.sqrt(A * B)))
        a = A * (1 - (own / V0) ** 4 - (wanted / s) ** 2)
        x, v = x + v * dt + 0.5 * a * dt * dt, v + a * dt
    assert kept.position[-1, 1].item() == pytest.approx(x, abs=1e-6)


def test_a_lag_answers_a_step_exponentially() -> None:
    """``A(t) → a (1 − e^{−t/τ})``, to first order in Δt."""
    simulator = Simulator(Lane(), (IDM(), make("lag"), Brakes()), dt=0.005)
    params = simulator.defaults(dtype=DTYPE)
    params["idm"]["desired_speed"] = torch.tensor(70.0, dtype=DTYPE)
    state = simulator.state(torch.zeros(1, dtype=DTYPE), torch.zeros(1, dtype=DTYPE), params)
    _, kept = simulator.rollout(state, {}, params, 200)
    assert kept.accel[-1, 0].item() == pytest.approx(A * (1 - math.exp(-1.0 / 0.5)), rel=0.01)


def test_memory_relaxes_with_its_time() -> None:
    """``λ`` follows ``v/v0`` with time constant τ."""
    simulator = Simulator(Lane(), (IDM(), make("memory"), make("replay"), Brakes()))
    state, params = pair(simulator, 45.0, 0.0, 0.0)
    state = state._replace(memory={"memory": torch.ones(2, dtype=DTYPE)})
    zero = torch.zeros(600, 2, dtype=DTYPE)
    record = Record(zero - 5.0, zero, zero, torch.ones(600, 2, dtype=torch.bool))
    end, _ = simulator.rollout(state, {"replay": record}, params, 600)
    assert end.memory["memory"][0].item() == pytest.approx(math.exp(-1.0), rel=1e-6)


def test_gravity_on_a_known_slope() -> None:
    """Five percent uphill costs g sin(arctan 0.05)."""
    from idm_env.effects import Grade

    simulator = Simulator(Lane(), (IDM(), Brakes()))
    hilly = simulator.adding(Grade(knots=(0.0, 1000.0), profile=(0.05, 0.05)))
    params = hilly.defaults(dtype=DTYPE)
    state = simulator.state(torch.full((1,), 300.0, dtype=DTYPE), torch.full((1,), 20.0, dtype=DTYPE), params)
    difference = simulator.acceleration(state, {}, params) - hilly.acceleration(state, {}, params)
    assert difference.item() == pytest.approx(9.81 * math.sin(math.atan(0.05)), rel=1e-12)
