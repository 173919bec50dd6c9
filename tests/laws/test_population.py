"""Laws of vehicles that come and go: nobody vanishes or overlaps, and whoever finds no room waits and is counted."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import Phase, example, given, settings, strategies as st
from torch import Tensor

from idm_env.effects import IDM, Brakes, MandatoryChange, Mobil, make
from idm_env.multilane import demand
from idm_env.roads import Lane, Lanes, lane_drop, off_ramp, on_ramp
from idm_env.simulator import Simulator
from idm_env.types import State

DTYPE = torch.float64
ROADS = {
    "open": Lanes(3, length=600.0),
    "drop": Lanes(3, length=900.0, ends=(lane_drop(2, at=400.0),)),
    "ramps": Lanes(
        3,
        length=900.0,
        ends=(on_ramp(0, begin=150.0, end=400.0, entry=50.0), off_ramp(2, 200.0, 500.0, leaves=600.0)),
    ),
}


def begun(
    road: Lanes, per_hour: dict[int, float], seconds: float, *, slots: int | None = None, seed: int = 0
) -> tuple[Simulator, State, dict[str, dict[str, Tensor]]]:
    """Return an empty road and drivers of different desired speeds who wait for it."""
    changing = (Mobil(), MandatoryChange()) if road.count > 1 else ()
    simulator = Simulator(road, (IDM(), *changing, Brakes()))
    params = simulator.defaults(dtype=DTYPE)
    trips = demand.trips(per_hour, seconds, slots=slots, dtype=DTYPE)
    generator = torch.Generator().manual_seed(seed)
    n = len(trips.departs)
    params["idm"]["desired_speed"] = 15.0 + 20.0 * torch.rand(n, generator=generator, dtype=DTYPE)
    return simulator, demand.waiting(simulator, trips, params), params


@settings(max_examples=5, phases=(Phase.explicit, Phase.generate))
@example(road="drop", flow=2400, slots=20, seed=0)
@given(
    road=st.sampled_from(sorted(ROADS)),
    flow=st.integers(900, 4000),
    slots=st.sampled_from([None, 20]),
    seed=st.integers(0, 1000),
)
def test_entered_is_inside_and_left_and_the_rest_is_queued(road: str, flow: int, slots: int | None, seed: int) -> None:
    """At every step: trips that are due are inside, left or queued; gaps are positive and what positions say."""
    simulator, state, params = begun(ROADS[road], {0: flow, 1: 0.7 * flow}, 40.0, slots=slots, seed=seed)
    own = torch.arange(state.speed.shape[-1])
    for _ in range(400):
        before, state = state, simulator.step(state, {}, params)
        due, inside, left, queued = (int(x) for x in demand.counts(simulator, state))
        assert due == inside + left + queued and queued >= 0
        assert state.lanes.trips is not None and state.present is not None and before.present is not None
        assert inside == int((state.lanes.trips.entered - state.lanes.trips.left).sum())
        there, links = state.present > 0, state.lanes
        assert links is not None
        assert (state.gap[there] > 0).all()
        fresh = simulator.road.view(state).gaps(state.position, state.length)
        near = there & (state.gap < 5e3)
        torch.testing.assert_close(state.gap[near], fresh[near], rtol=0, atol=1e-8)
        assert ((links.follower[links.leader] == own) | (links.leader == own) | ~there).all()
        # Whoever drives on was nowhere else a step before.
        stays = there & (before.present > 0)
        assert ((state.position - before.position)[stays] < 5.0).all()
    assert left + inside > 10


def test_trips_enter_at_their_time_with_the_gap_that_they_need() -> None:
    """One after the other on an empty road; then as soon as s0 + vT and braking allow, neither before nor later."""
    simulator = Simulator(Lanes(1), (IDM(), Brakes()))
    params = simulator.defaults(dtype=DTYPE)
    trips = demand.trips({0: 3600.0}, 10.0, speed=20.0, dtype=DTYPE)
    state = demand.waiting(simulator, trips, params)
    at: dict[int, float] = {}
    for k in range(600):
        before, state = state, simulator.step(state, {}, params)
        assert state.present is not None and before.present is not None and state.lanes is not None
        for i in torch.nonzero((state.present > 0) & (before.present <= 0)).flatten().tolist():
            at[i] = 0.1 * k
            leader = int(state.lanes.leader[i])
            gap = float(before.position[leader] - before.length[leader]) if leader != i else math.inf
            assert gap >= 2.0 + 20.0 * float(params["idm"]["time_gap"])
            earlier = gap - 1.1 * float(before.speed[leader])  # a decision before
            assert leader == i or earlier < 2.0 + 20.0 * float(params["idm"]["time_gap"]) or at[i] == 1.0 + i
    assert sorted(at) == list(range(10)) and list(at.values()) == sorted(at.values())
    assert at[0] == 1.0 and at[9] > 10.5


def test_an_inflow_beyond_capacity_is_queued_and_counted() -> None:
    """The queue grows at one end, while as many drive as the lane takes."""
    simulator, state, params = begun(Lanes(1, length=800.0), {0: 3400.0}, 200.0)
    queues = []
    for _ in range(4):
        state, _ = simulator.rollout(state, {}, params, 400)
        queues.append(int(demand.counts(simulator, state).queued))
    assert queues[0] < queues[1] < queues[2] < queues[3] and queues[3] > 30


def test_slots_that_make_trips_again_keep_up_an_inflow_for_ever() -> None:
    """Far more trips than slots; parameters stay with their slot; too few slots are counted as a queue."""
    simulator, state, params = begun(Lanes(2, length=500.0), {0: 600.0, 1: 600.0}, 60.0, slots=20)
    state, _ = simulator.rollout(state, {}, params, 4000)
    due, inside, left, queued = (int(x) for x in demand.counts(simulator, state))
    assert due == inside + left + queued and 130 <= due <= 134 and left >= 110 and queued <= 2
    few, state, params = begun(Lanes(2, length=500.0), {0: 600.0, 1: 600.0}, 60.0, slots=4)
    state, _ = few.rollout(state, {}, params, 3000)
    assert demand.counts(few, state).queued > 10


def test_drivers_begin_with_fresh_memories_and_rows_do_not_see_each_other() -> None:
    """What a driver remembers begins when he does, not when the simulation did."""
    simulator = Simulator(Lanes(1, length=2000.0), (IDM(), make("memory"), make("delay"), Brakes()))
    params = simulator.defaults(dtype=DTYPE)
    late = demand.trips({0: 60.0}, 60.0, dtype=DTYPE)
    state = demand.waiting(simulator, late, params)
    for _ in range(601):
        before, state = state, simulator.step(state, {}, params)
    assert before.present is not None and state.present is not None
    assert before.present[0] == 0 and state.present[0] == 1
    early = demand.waiting(simulator, late._replace(departs=late.departs - 60.0), params)
    early = simulator.step(early, {}, params)
    for name, held in state.memory.items():
        torch.testing.assert_close(held, early.memory[name])
    both = late._replace(departs=torch.tensor([[60.0], [0.0]], dtype=DTYPE))
    rows = demand.waiting(simulator, demand.spread(both, (2, 1)), params)
    rows = simulator.step(rows, {}, params)
    assert rows.present is not None and rows.present.flatten().tolist() == [0.0, 1.0]


def test_gradients_flow_through_entries() -> None:
    """Finite differences that change nobody's entry agree with back-propagation."""
    simulator, state, params = begun(
        Lanes(2, length=700.0, ends=(lane_drop(1, at=400.0),)), {0: 1800.0, 1: 1500.0}, 20.0
    )

    weights = torch.rand(state.speed.shape, generator=torch.Generator().manual_seed(1), dtype=DTYPE)

    def run(time_gap: Tensor) -> Tensor:
        p = {**params, "idm": {**params["idm"], "time_gap": time_gap}}
        end, _ = simulator.rollout(state, {}, p, 205)
        assert end.present is not None and end.present.sum() > 10
        return (end.position * end.present * weights).sum()

    assert torch.autograd.gradcheck(run, torch.full((), 1.31, dtype=DTYPE, requires_grad=True), eps=1e-6, atol=1e-4)


def test_bad_input_is_refused_in_one_line() -> None:
    """With the value, the rule and the cure."""
    with pytest.raises(ValueError, match="must give every lane that is entered vehicles an hour above 0"):
        demand.trips({0: -5.0}, 60.0)
    with pytest.raises(ValueError, match="no slot for lane 0: 10 vehicles an hour"):
        demand.trips({0: 10.0}, 60.0)
    simulator = Simulator(Lanes(2, ring=500.0), (IDM(), Brakes()))
    params = simulator.defaults(dtype=DTYPE)
    trips = demand.trips({0: 600.0}, 60.0, dtype=DTYPE)
    with pytest.raises(ValueError, match="trips need a road that begins somewhere"):
        demand.waiting(simulator, trips, params)
    with pytest.raises(ValueError, match="trips need a road that begins somewhere"):
        demand.waiting(Simulator(Lane(), (IDM(), Brakes())), trips, params)
    with pytest.raises(ValueError, match="lane 2 does not exist"):
        demand.waiting(
            Simulator(Lanes(2), (IDM(), Brakes())), trips._replace(lane=torch.full_like(trips.lane, 2)), params
        )
    with pytest.raises(ValueError, match="has no trips"):
        demand.counts(simulator, simulator.state(torch.zeros(1), torch.zeros(1), params, lane=0))
