"""The recorded-leader kernel against ``Simulator``: the same values, the same derivatives."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from idm_env.effects import IDM, Brakes, Replay
from idm_env.kernels import recorded
from idm_env.roads import Lane
from idm_env.simulator import Simulator
from idm_env.types import Record

STEPS = 30


def problem(seed: int, drivers: int, dtype: torch.dtype, steps: int = STEPS, dt: float = 0.1):
    """Leaders that brake to a stop and drive off again; some drivers start too close, some far too fast."""
    generator = torch.Generator().manual_seed(seed)

    def draw(low, high, *shape):
        return low + (high - low) * torch.rand(*shape, generator=generator, dtype=dtype)

    time = torch.arange(steps + 1, dtype=dtype)[:, None] * dt
    lead_speed = (draw(0, 15, drivers) + draw(0, 12, drivers) * torch.sin(time + draw(0, 6, drivers))).clamp_min(0)
    lead_position = 50 + torch.cumsum(lead_speed * dt, 0)
    gap, speed = draw(-0.5, 40, drivers), draw(0, 25, drivers)
    bounds = ((0.5, 3.0), (0.5, 3.0), (0.5, 2.5), (1.0, 4.0), (10.0, 40.0))
    params = torch.stack([draw(low, high, drivers) for low, high in bounds], -1)
    return gap, speed, lead_position, lead_speed, params, draw(3, 9, drivers)


def by_simulator(gap, speed, lead_position, lead_speed, params, max_decel, integration, dt=0.1, width=0.1):
    simulator = Simulator(Lane(), (IDM(), Brakes(width=width), Replay()), dt, integration)
    pair = {
        "idm": {name: params[:, j, None] for j, name in enumerate(recorded.PARAMETERS)},
        "brakes": {"max_decel": max_decel[:, None]},
        "replay": {},
    }
    lead = lead_position[0]
    state = simulator.state(
        torch.stack((lead, lead - 5.0 - gap.detach()), -1), torch.stack((lead_speed[0], speed), -1), pair
    )
    state = state._replace(gap=torch.stack((state.gap[:, 0], gap), -1))
    active = torch.tensor([True, False])
    columns = [x[1:, :, None].expand(-1, -1, 2) for x in (lead_position, lead_speed, torch.zeros_like(lead_speed))]
    steps = len(lead_position) - 1
    record = Record(*columns, active.expand(steps, 2))
    _, kept = simulator.rollout(state, {"replay": record}, pair, steps)
    return kept.gap[..., 1], kept.speed[..., 1], kept.accel[..., 1]


def close(ours, theirs, dtype):
    scale = theirs.abs().max().clamp_min(1.0)
    assert float((ours - theirs).abs().max() / scale) < (2e-4 if dtype == torch.float32 else 1e-11)


@settings(max_examples=15, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    drivers=st.sampled_from([1, 7, 64, 1100]),
    dtype=st.sampled_from([torch.float32, torch.float64]),
    integration=st.sampled_from(["ballistic", "euler"]),
    threads=st.sampled_from([1, 2]),
)
def test_rollout_is_the_simulators(seed, drivers, dtype, integration, threads):
    given = problem(seed, drivers, dtype)
    ours = recorded.rollout(*given[:5], max_decel=given[5], integration=integration, threads=threads)
    for mine, theirs in zip(ours, by_simulator(*given, integration), strict=True):
        close(mine, theirs, dtype)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_values_do_not_depend_on_the_graph_or_the_threads(dtype):
    given = problem(2, 3000, dtype)
    plain = recorded.rollout(*given[:5], max_decel=given[5], threads=1)
    graph = recorded.rollout(*given[:4], given[4].clone().requires_grad_(), max_decel=given[5], threads=2)
    assert graph.gap.requires_grad
    for mine, other in zip(plain, graph, strict=True):
        assert torch.equal(mine, other)


@settings(max_examples=12, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    drivers=st.sampled_from([1, 33]),
    dtype=st.sampled_from([torch.float32, torch.float64]),
    integration=st.sampled_from(["ballistic", "euler"]),
)
def test_gradients_are_autograds(seed, drivers, dtype, integration):
    given = problem(seed, drivers, dtype)
    generator = torch.Generator().manual_seed(seed)
    seeds = [torch.randn(STEPS, drivers, generator=generator, dtype=dtype) for _ in range(3)]

    def gradients(run):
        leaves = [given[i].clone().requires_grad_() for i in (0, 1, 4, 5)]
        out = run(leaves[0], leaves[1], given[2], given[3], leaves[2], leaves[3])
        return torch.autograd.grad(sum((x * s).sum() for x, s in zip(out, seeds, strict=True)), leaves)

    ours = gradients(lambda *x: recorded.rollout(*x[:5], max_decel=x[5], integration=integration))
    theirs = gradients(lambda *x: by_simulator(*x, integration))
    for mine, other in zip(ours, theirs, strict=True):
        close(mine, other, dtype)


@pytest.mark.parametrize("integration", ["ballistic", "euler"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_sensitivities_are_the_jacobian(dtype, integration):
    given = problem(3, 9, dtype)
    followed, by = recorded.sensitivities(*given[:5], max_decel=given[5], integration=integration)
    plain = recorded.rollout(*given[:5], max_decel=given[5], integration=integration)
    for mine, other in zip(followed, plain, strict=True):
        assert torch.equal(mine, other)
    params = given[4].clone().requires_grad_()
    gap, speed, _ = by_simulator(*given[:4], params, given[5], integration)
    for mine, signal in ((by.gap, gap), (by.speed, speed)):
        # Drivers do not act on each other, so the derivative of the sum over drivers is every driver's own.
        rows = [torch.autograd.grad(signal[t].sum(), params, retain_graph=True)[0] for t in range(STEPS)]
        assert mine.shape == (STEPS, 9, 5)
        close(mine, torch.stack(rows), dtype)


def test_normal_equations_are_those_of_the_jacobian():
    given = problem(4, 600, torch.float64)
    generator = torch.Generator().manual_seed(0)
    shape = (STEPS, 600)
    data = [torch.rand(shape, generator=generator, dtype=torch.float64) * scale for scale in (30, 20, 1, 1)]
    ours = recorded.normal_equations(
        *given[:5], max_decel=given[5],
        gap_target=data[0], speed_target=data[1], gap_weight=data[2], speed_weight=data[3],
    )  # fmt: skip
    followed, by = recorded.sensitivities(*given[:5], max_decel=given[5])
    residual = torch.cat((data[2] * (followed.gap - data[0]), data[3] * (followed.speed - data[1])))
    jacobian = torch.cat((data[2][..., None] * by.gap, data[3][..., None] * by.speed))
    torch.testing.assert_close(ours.cost, residual.square().sum(0))
    torch.testing.assert_close(ours.gradient, torch.einsum("tbj,tb->bj", jacobian, residual))
    torch.testing.assert_close(ours.normal, torch.einsum("tbj,tbk->bjk", jacobian, jacobian))


def test_errors_name_the_cure():
    gap, speed, lead_position, lead_speed, params, _ = problem(0, 3, torch.float32)
    with pytest.raises(ValueError, match=r"params has shape \(5, 3\)"):
        recorded.rollout(gap, speed, lead_position, lead_speed, params.T)
    with pytest.raises(ValueError, match=r"Give both the same"):
        recorded.rollout(gap, speed.double(), lead_position, lead_speed, params)
    with pytest.raises(ValueError, match=r"unknown. Known: ballistic, euler"):
        recorded.rollout(gap, speed, lead_position, lead_speed, params, integration="verlet")
    with pytest.raises(ValueError, match=r"float32 or float64"):
        recorded.rollout(gap.half(), speed, lead_position, lead_speed, params)
    with pytest.raises(ValueError, match=r"at least one step"):
        recorded.rollout(gap, speed, lead_position[:1], lead_speed[:1], params)
