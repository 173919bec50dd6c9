"""Several lanes on the kernels of one: values, links, counts and gradients are those of the torch path."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from idm_env.compiled.kernels import dispatch
from idm_env.effects import IDM, Brakes, Effect, LaneCommand, MandatoryChange, Mobil, make
from idm_env.multilane import demand
from idm_env.roads import Lanes, lane_drop, off_ramp, on_ramp
from idm_env.simulator import Simulator, Trajectory
from idm_env.types import State

pytest.importorskip("numba")

N, STEPS = 24, 47
CASES: dict[str, tuple[Lanes, tuple[Effect, ...]]] = {
    "ring": (Lanes(3, ring=500.0), (IDM(), make("memory"), make("noise"), Mobil(), Brakes())),
    "one lane empty": (Lanes(5, ring=500.0), (IDM(), make("memory"), make("noise"), Mobil(), Brakes())),
    "drop": (
        Lanes(3, ends=(lane_drop(2, at=460.0),)),
        (
            *(IDM(), make("second_leader"), make("follower"), make("courtesy")),
            *(Mobil(every=0.5), MandatoryChange(), Brakes()),
        ),
    ),
}


def rolled(
    road: Lanes, effects: tuple[Effect, ...], dtype: torch.dtype, graph: bool
) -> tuple[State, Trajectory, list[Tensor]]:
    """Return a rollout of shuffled vehicles, and the gradients of all that is kept."""
    generator = torch.Generator().manual_seed(5)
    simulator = Simulator(road, effects)
    params = simulator.defaults(dtype=dtype)
    place = torch.stack([torch.randperm(N, generator=generator) for _ in range(2)])
    position = (place * (480.0 / N)).to(dtype).requires_grad_(graph)
    lane = torch.randint(3, (2, N), generator=generator)
    desired = (15.0 + 20.0 * torch.rand((2, N), generator=generator)).to(dtype).requires_grad_(graph)
    params["idm"]["desired_speed"] = desired
    noise = torch.randn((STEPS, 2, N), generator=generator).to(dtype)
    inputs = {"noise": noise} if "noise" in simulator.by_name else {}
    speed = torch.full_like(position, 8.0, requires_grad=False)
    state = simulator.state(position, speed, params, lane=lane, step=3)
    end, kept = simulator.rollout(state, inputs, params, STEPS)
    if not graph:
        return end, kept, []
    weights = [torch.randn(x.shape, generator=generator).to(dtype) for x in kept]
    loss = sum((x.clamp_max(500.0) * w).sum() for x, w in zip(kept, weights, strict=True))
    return end, kept, list(torch.autograd.grad(loss, [position, desired]))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("road", "dtype", "more"),
    [
        (Lanes(3, ring=8100.0), torch.float64, (make("courtesy"), Mobil())),
        (Lanes(3, ends=(lane_drop(0, at=8300.0),)), torch.float32, (make("courtesy"), Mobil())),
        (Lanes(3, ring=8100.0), torch.float64, (Mobil(stagger=256),)),
    ],
    ids=["ring", "drop", "blocks in turn"],
)
def test_compiled_decisions_are_those_of_the_torch_path(
    road: Lanes, dtype: torch.dtype, more: tuple[Effect, ...]
) -> None:
    """Every link and every count, over more vehicles than one call of the printed phase takes; commands among wishes.

    What is compared is one decision after another from the same states, so that rounding cannot add up.
    """
    generator = torch.Generator().manual_seed(2)
    n = 900
    simulator = Simulator(road, (IDM(), make("gap_bias"), *more, LaneCommand(), Brakes()))
    params = simulator.defaults(dtype=dtype)
    params["idm"]["desired_speed"] = (15.0 + 20.0 * torch.rand((2, n), generator=generator)).to(dtype)
    position = (torch.randperm(n, generator=generator) * 9.0).to(dtype).expand(2, n)
    lane = torch.randint(3, (2, n), generator=generator)
    state = simulator.state(position, torch.full_like(position, 8.0), params, lane=lane)
    command = torch.full((10, 2, n), torch.nan, dtype=dtype)
    command[:, 0, ::7], command[:, 1, ::5] = 1.0, -1.0
    counts, seen = torch.zeros(4), 0
    for _ in range(12):
        inputs = {"lane_command": command}
        with dispatch.off():
            expected, _ = simulator.rollout(state, inputs, params, 10, keep=None)
        before, (state, _) = state, simulator.rollout(state, inputs, params, 10, keep=None)
        assert before.lanes is not None and state.lanes is not None and expected.lanes is not None
        for one, other in zip(expected.lanes[:7], state.lanes[:7], strict=True):
            assert torch.equal(one, other)
        torch.testing.assert_close(state.gap, expected.gap)
        for name, held in expected.memory.items():  # who signals beside whom
            torch.testing.assert_close(state.memory[name], held)
            seen += int((held < 5e3).sum())
        counts += torch.stack([(a - b).sum() for a, b in zip(state.lanes[3:7], before.lanes[3:7], strict=True)])
    assert (counts[:3] > 100).all() and counts[3] > 0 and (seen > 1000 or not state.memory)


@pytest.mark.parametrize("case", CASES)
def test_several_lanes_run_on_compiled_steps(case: str) -> None:
    """And the same bits come out with and without a graph."""
    with dispatch.off():
        end, kept, gradients = rolled(*CASES[case], torch.float64, graph=True)
    road, effects = CASES[case]
    simulator = Simulator(road, effects)
    params = simulator.defaults(dtype=torch.float64)
    state = simulator.state(torch.tensor([50.0, 0.0]).double(), torch.ones(2).double(), params, lane=0)
    inputs = {"noise": torch.zeros(1, 2).double()} if "noise" in simulator.by_name else {}
    assert dispatch.refusal(simulator, state, inputs, params) is None
    fast, quick, fast_gradients = rolled(road, effects, torch.float64, graph=True)
    assert end.lanes is not None and fast.lanes is not None and end.lanes.changed.sum() > 3
    for one, other in zip(end.lanes[:7], fast.lanes[:7], strict=True):
        assert torch.equal(one, other)
    for a, b in zip([*kept, *gradients], [*quick, *fast_gradients], strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-9)
    for name, held in end.memory.items():
        torch.testing.assert_close(held, fast.memory[name], rtol=1e-9, atol=1e-9)
    assert torch.equal(end.step, fast.step)
    plain, same, _ = rolled(road, effects, torch.float64, graph=False)
    assert all(torch.equal(a, b) for a, b in zip(quick, same, strict=True))
    assert torch.equal(plain.gap, fast.gap)


def test_the_past_goes_with_its_vehicle() -> None:
    """Delayed drivers on several lanes, values alone: a graph would compile for half a minute."""
    road, effects = Lanes(3, ring=500.0), (IDM(), make("delay"), Mobil(), Brakes())
    with dispatch.off():
        end, kept, _ = rolled(road, effects, torch.float64, graph=False)
    fast, quick, _ = rolled(road, effects, torch.float64, graph=False)
    assert end.lanes is not None and fast.lanes is not None and torch.equal(end.lanes.lane, fast.lanes.lane)
    for a, b in zip([*kept, end.memory["past"]], [*quick, fast.memory["past"]], strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-9)


def test_rows_may_decide_at_different_steps_one_call_a_step_or_many() -> None:
    """As rows of a vector whose episodes began at different times do: links and gaps of the torch path."""
    generator = torch.Generator().manual_seed(3)
    simulator = Simulator(Lanes(3, ring=500.0), (IDM(), Mobil(), Brakes()))
    params = simulator.defaults(dtype=torch.float64)
    params["idm"]["desired_speed"] = 15.0 + 20.0 * torch.rand((3, N), generator=generator).double()
    place = torch.stack([torch.randperm(N, generator=generator) for _ in range(3)])
    position, lane = place * (480.0 / N), torch.randint(3, (3, N), generator=generator)
    speed = torch.full((3, N), 8.0, dtype=torch.float64)
    begin = simulator.state(position.double(), speed, params, lane=lane, step=torch.tensor([0, 3, 10]))
    assert dispatch.refusal(simulator, begin, {}, params) is None
    with dispatch.off():
        expected, _ = simulator.rollout(begin, {}, params, 60, keep=None)
    many, _ = simulator.rollout(begin, {}, params, 60, keep=None)
    single = begin
    for _ in range(60):
        single = simulator.advance(single, {}, params)
    assert expected.lanes is not None and (expected.lanes.changed.sum(-1) > 0).all()
    for found in (many, single):
        assert found.lanes is not None
        for one, other in zip(expected.lanes[:7], found.lanes[:7], strict=True):
            assert torch.equal(one, other)
        torch.testing.assert_close(found.gap, expected.gap, rtol=1e-9, atol=1e-9)
    assert begin.lanes is not None and begin.lanes.changed.sum() == 0


@pytest.mark.parametrize(
    ("again", "steps"), [(None, (0, 0)), (24, (0, 0)), (24, (0, 4))],
    ids=["one slot per trip", "slots used again", "rows at different steps"],
)  # fmt: skip
def test_vehicles_come_and_go_in_compiled_rollouts(again: int | None, steps: tuple[int, int]) -> None:
    """Entries, exits, ramps and ends of lanes: links, counts, values and gradients of the torch path."""
    road = Lanes(3, length=700.0, ends=(on_ramp(0, 150.0, 400.0, entry=50.0), off_ramp(2, 200.0, 400.0, leaves=500.0)))
    simulator = Simulator(road, (IDM(), make("second_leader"), make("memory"), Mobil(), MandatoryChange(), Brakes()))
    params = simulator.defaults(dtype=torch.float64)
    trips = demand.trips({0: 900.0, 1: 1500.0, 2: 1500.0}, 60.0, slots=again, dtype=torch.float64)
    n = len(trips.departs)
    desired = 15.0 + 20.0 * torch.rand((2, n), generator=torch.Generator().manual_seed(1)).double()
    begin = demand.waiting(simulator, demand.spread(trips, (2, n)), params)
    begin = begin._replace(step=torch.tensor(steps) if steps[1] else begin.step)

    def run() -> tuple[State, Trajectory, Tensor]:
        free = desired.clone().requires_grad_()
        given = {**params, "idm": {**params["idm"], "desired_speed": free}}
        state, _ = simulator.rollout(begin, {}, given, 733, keep=None)
        end, kept = simulator.rollout(state, {}, given, 40)
        assert end.present is not None
        total = (end.position * end.present).sum() + (kept.speed * end.present).sum()
        return end, kept, torch.autograd.grad(total, free)[0]

    with dispatch.off():
        end, kept, gradient = run()
    assert dispatch.refusal(simulator, begin, {}, params) is None
    fast, quick, fast_gradient = run()
    assert (
        end.lanes is not None
        and fast.lanes is not None
        and end.lanes.trips is not None
        and fast.lanes.trips is not None
    )
    assert (end.lanes.trips.left > 0).any() and end.lanes.changed.sum() > 10 and (end.present == 1).any()
    there = end.present > 0  # type: ignore[operator]
    for one, other in zip([*end.lanes[3:7], *end.lanes.trips], [*fast.lanes[3:7], *fast.lanes.trips], strict=True):
        assert torch.equal(one, other)
    for one, other in zip(end.lanes[:3], fast.lanes[:3], strict=True):
        assert torch.equal(one[there], other[there])
    assert torch.equal(end.present, fast.present)  # type: ignore[arg-type]
    for a, b in zip(
        [*kept, gradient, end.memory["memory"]], [*quick, fast_gradient, fast.memory["memory"]], strict=True
    ):
        torch.testing.assert_close(a, b, rtol=1e-8, atol=1e-8)
    assert gradient.abs().sum() > 0


def test_changes_that_take_time_are_not_compiled() -> None:
    """They take the torch path, which is said; without effects that change lanes nothing is decided."""
    simulator = Simulator(Lanes(2), (IDM(), Mobil(), Brakes()))
    params = simulator.defaults(dtype=torch.float64)
    here = torch.zeros(1, dtype=torch.float64)
    state = simulator.state(here, here, params, lane=0)
    assert dispatch.refusal(simulator, state, {}, params) is None
    assert dispatch.refusal(simulator.without("mobil"), state, {}, params) is None
    timed = Simulator(Lanes(2, duration=2.0), simulator.effects)
    assert dispatch.refusal(timed, state, {}, params) == "compiled changes take no time, and Lanes has a duration"


def test_single_steps_in_inference_mode_are_those_without() -> None:
    """Inference tensors do not tell when they change, so nothing is remembered of them."""
    simulator = Simulator(Lanes(3, ring=500.0), (IDM(), Mobil(), Brakes()))
    params = simulator.defaults(dtype=torch.float32)
    ends = []
    for quick in (True, False):
        with torch.inference_mode(quick):
            position = torch.arange(N) * (480.0 / N)
            state = simulator.state(position, torch.full((N,), 8.0), params, lane=torch.arange(N) % 3)
            for _ in range(12):
                state = simulator.advance(state, {}, params)
            ends.append(state.position)
    assert torch.equal(*ends)


def test_vehicles_that_have_passed_through_each_other_take_the_torch_path() -> None:
    """Their links are no order of positions, and are not guessed at."""
    simulator = Simulator(Lanes(2, ring=300.0), (IDM(), Brakes()))
    params = simulator.defaults(dtype=torch.float64)
    position = torch.tensor([100.0, 50.0, 0.0], dtype=torch.float64)
    state = simulator.state(position, torch.full_like(position, 5.0), params, lane=0)
    crossed = state._replace(position=torch.tensor([40.0, 50.0, 0.0], dtype=torch.float64))
    with dispatch.off():
        expected, _ = simulator.rollout(crossed, {}, params, 5)
    found, _ = simulator.rollout(crossed, {}, params, 5)
    assert torch.equal(found.gap, expected.gap)
