"""Laws of roads of several lanes: without changes they are stacked lanes and rings; links are a permutation; ends."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from benchmarks import lanes
from idm_env.compiled.kernels import dispatch
from idm_env.effects import IDM, Brakes, make
from idm_env.jobs import progress
from idm_env.roads import Lane, Lanes, Ring, lane_drop, off_ramp, on_ramp
from idm_env.simulator import Simulator
from idm_env.types import Record, State

DTYPE = torch.float64
LANES, EACH = 3, 6
EFFECTS = (IDM(), make("second_leader"), make("follower"), make("delay"), make("memory"), Brakes())


def rolled(road: Lane | Ring | Lanes, dtype: torch.dtype) -> tuple[list[Tensor], list[Tensor]]:
    """Return every step of three platoons, stacked, and the gradients of a random sum; slots of lanes are shuffled."""
    generator = torch.Generator().manual_seed(3)
    wiggle, pace, spread = (torch.rand((LANES, EACH), generator=generator, dtype=DTYPE).to(dtype) for _ in range(3))
    mixed = torch.randperm(LANES * EACH, generator=generator)
    several = isinstance(road, Lanes)

    def laid(x: Tensor) -> Tensor:
        return x.reshape(-1)[mixed] if several else x

    def back(x: Tensor) -> Tensor:
        if not several:
            return x
        return torch.empty_like(x).index_copy(-1, mixed, x).reshape(*x.shape[:-1], LANES, EACH)

    simulator = Simulator(road, EFFECTS)
    params = simulator.defaults(dtype=dtype)
    leaves = [
        (300 - 25.0 * torch.arange(EACH, dtype=dtype) + 4 * wiggle).requires_grad_(),
        (9 + 4 * pace).requires_grad_(),
        (1.2 + 0.5 * spread).requires_grad_(),
    ]
    params["idm"]["time_gap"] = laid(leaves[2])
    lane = laid(torch.arange(LANES)[:, None].expand(LANES, EACH)) if several else None
    state = simulator.state(laid(leaves[0]), laid(leaves[1]), params, lane=lane)
    _, kept = simulator.rollout(state, {}, params, 60)
    every = [back(x) for x in kept]
    loss = sum((x * torch.randn(x.shape, generator=generator, dtype=dtype)).sum() for x in every)
    return [x.detach() for x in every], list(torch.autograd.grad(loss, leaves))  # type: ignore[arg-type]


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=str)
@pytest.mark.parametrize("ring", [None, 400.0], ids=["lane", "ring"])
def test_lanes_without_changes_are_stacked_lanes_to_the_last_bit(ring: float | None, dtype: torch.dtype) -> None:
    """Values and gradients, wherever in the tensors the vehicles are."""
    plain, plain_gradients = rolled(Lane() if ring is None else Ring(ring), dtype)
    several, gradients = rolled(Lanes(LANES, ring=ring), dtype)
    for one, other in zip(plain + plain_gradients, several + gradients, strict=True):
        assert torch.equal(one, other)


def scattered(road: Lanes, generator: torch.Generator, batch: int = 4, n: int = 40) -> State:
    """Return vehicles anywhere on a road, some of them absent."""
    simulator = Simulator(road, (IDM(), Brakes()))
    position = 3000.0 * torch.rand((batch, n), generator=generator, dtype=DTYPE)
    lane = torch.randint(road.count, (batch, n), generator=generator)
    present = (torch.rand((batch, n), generator=generator) < 0.8).to(DTYPE)
    params = simulator.defaults(dtype=DTYPE)
    return simulator.state(position, torch.full_like(position, 9.0), params, lane=lane, present=present, length=0.1)


@pytest.mark.parametrize("ring", [None, 3100.0])
def test_links_are_inverse_and_lead_to_the_next_vehicle_of_the_lane(ring: float | None) -> None:
    """leader ∘ follower = identity, and the leader is whom a search of all vehicles finds; absent ones have nobody."""
    state = scattered(Lanes(3, ring=ring), torch.Generator().manual_seed(5))
    links = state.lanes
    assert links is not None and state.present is not None
    own = torch.arange(state.speed.shape[-1])
    for row in range(len(own[:4])):
        for i in own.tolist():
            leader, follower = int(links.leader[row, i]), int(links.follower[row, i])
            assert int(links.follower[row, leader]) == i or leader == i
            assert int(links.leader[row, follower]) == i or follower == i
            mine = (links.lane[row] == links.lane[row, i]) & (state.present[row] > 0)
            way = state.position[row] - state.position[row, i]
            way = way % ring if ring else torch.where(way < 0, torch.inf, way)
            way = torch.where(mine & (own != i), way, torch.inf)
            expected = int(way.argmin()) if bool(state.present[row, i] > 0) and bool(way.min() < torch.inf) else i
            assert leader == expected


def test_random_traffic_breaks_no_law() -> None:
    """A little of what ``python -m benchmarks.lanes laws`` does over 10⁹ vehicle-steps; and its counts can count."""
    with dispatch.off():
        found = lanes.check(3e4, progress.silent, rows=3, each=90, decisions=60)
        for kind, counts in found.items():
            assert not any(counts[law] for law in lanes.LAWS), (kind, counts)
            assert counts["changed"] > 0 and counts["blocked"] > 50
            assert (counts["entered"] > 20) == (kind != "ring")
        assert sum(counts["changed"] for counts in found.values()) > 100
        simulator, state, params = lanes.world("ring", 1, 1, 40, DTYPE)
        after, kept = simulator.without("lane_command").rollout(state, {}, params, 10)
    assert after.lanes is not None
    swapped = after.lanes._replace(leader=after.lanes.leader.roll(1, -1))
    wrong = after._replace(lanes=swapped, gap=-after.gap)
    counts = lanes.broken(simulator, state, wrong, kept._replace(gap=-kept.gap), params)
    assert all(counts[law] > 0 for law in lanes.LAWS if law not in ("vehicles lost", "moved too far"))


def test_forward_mode_sees_neighbours_by_links_too() -> None:
    """Jacobian-vector products agree with back-propagation."""
    simulator = Simulator(Lanes(2), (IDM(), Brakes()))
    params = simulator.defaults(dtype=DTYPE)
    lane = torch.tensor([0, 1, 0, 1, 0, 1])

    def end(position: Tensor) -> Tensor:
        state = simulator.state(position, torch.full_like(position, 12.0), params, lane=lane)
        return simulator.rollout(state, {}, params, 5)[0].position.square().sum()

    position = torch.tensor([100.0, 90.0, 70.0, 66.0, 50.0, 20.0], dtype=DTYPE)
    ones = torch.ones_like(position)
    (reverse,) = torch.autograd.grad(end(position.requires_grad_()), position)
    _, forward = torch.func.jvp(end, (position.detach(),), (ones,))
    torch.testing.assert_close(forward, reverse.sum())
    assert torch.autograd.gradgradcheck(end, position)


def test_a_lane_that_ends_is_a_standing_leader() -> None:
    """Who stays on it stops s0 before its end, as behind a parked vehicle; the other lane drives on."""
    simulator = Simulator(Lanes(2, ends=(lane_drop(1, at=400.0),)), (IDM(), make("second_leader"), Brakes()))
    params = simulator.defaults(dtype=DTYPE)
    position, speed = torch.tensor([0.0, -30.0, 0.0], dtype=DTYPE), torch.full((3,), 20.0, dtype=DTYPE)
    state = simulator.state(position, speed, params, lane=torch.tensor([1, 1, 0]))
    end, _ = simulator.rollout(state, {}, params, 800)
    plain = simulator.without("second_leader")
    here, _ = plain.rollout(plain.state(position, speed, params, lane=torch.tensor([1, 1, 0])), {}, params, 800)
    # A parked vehicle without a length stands where the lane ends.
    parked = Simulator(Lane(), (IDM(), make("replay"), Brakes()))
    still = torch.tensor([400.0, 0.0, 0.0], dtype=DTYPE).expand(800, 3)
    record = Record(still, 0 * still, 0 * still, torch.tensor([True, False, False]).expand(800, 3))
    ahead = torch.tensor([400.0, 0.0, -30.0], dtype=DTYPE), torch.tensor([0.0, 20.0, 20.0], dtype=DTYPE)
    begin = parked.state(*ahead, {**params, "replay": {}}, length=torch.tensor([0.0, 5.0, 5.0], dtype=DTYPE))
    expected, _ = parked.rollout(begin, {"replay": record}, {**params, "replay": {}}, 800)
    torch.testing.assert_close(here.position[:2], expected.position[1:], rtol=0, atol=1e-5)
    assert 397.5 < end.position[0] < 398.5 and end.speed[0] < 0.05
    assert end.position[2] > 1500.0


def test_vehicles_leave_at_the_end_of_the_road_and_of_an_off_ramp() -> None:
    """They are absent from then on, and nobody follows them; nobody else is gone."""
    road = Lanes(2, length=500.0, ends=(off_ramp(0, begin=100.0, end=200.0, leaves=300.0),))
    simulator = Simulator(road, (IDM(), Brakes()))
    params = simulator.defaults(dtype=DTYPE)
    position = torch.tensor([250.0, 220.0, 250.0, 220.0], dtype=DTYPE)
    lane = torch.tensor([0, 0, 1, 1])
    state = simulator.state(position, torch.full_like(position, 20.0), params, lane=lane)
    seen = []
    for _ in range(200):
        before, state = state, simulator.step(state, {}, params)
        assert state.present is not None and before.present is not None
        seen.append(state.present.tolist())
        if state.step % 10 == 1:
            gone = (before.position >= torch.where(lane == 0, 300.0, 500.0)).to(DTYPE)
            assert torch.equal(state.present, 1 - gone)
        else:
            assert torch.equal(state.present, before.present)
    assert [0.0, 1.0, 1.0, 1.0] in seen and seen[-1] == [0.0, 0.0, 0.0, 0.0]


def test_errors_name_value_rule_and_cure() -> None:
    """One line each."""
    two = Simulator(Lanes(2), (IDM(), Brakes()))
    params = two.defaults(dtype=DTYPE)
    here = torch.zeros(3, dtype=DTYPE)
    with pytest.raises(ValueError, match="lane 2 does not exist: this road has lanes 0 to 1"):
        two.state(here, here, params, lane=torch.tensor([0, 1, 2]))
    with pytest.raises(ValueError, match="needs each vehicle's lane"):
        two.state(here, here, params)
    with pytest.raises(ValueError, match="lanes are whole numbers"):
        two.state(here, here, params, lane=here)
    with pytest.raises(ValueError, match=r"a Ring has one lane.*Use Lanes\(count\)"):
        Simulator(Ring(99.0), (IDM(),)).state(here, here, params, lane=0)
    with pytest.raises(ValueError, match="this state has no lanes"):
        two.step(Simulator(Lane(), (IDM(), Brakes())).state(here, here, params), {}, params)
    with pytest.raises(ValueError, match="lane 3 does not exist"):
        Lanes(2, ends=(lane_drop(3, at=100.0),))
    with pytest.raises(ValueError, match="ends at 900 m: these must rise, and lie on the road of 500"):
        Lanes(2, length=500.0, ends=(on_ramp(0, begin=100.0, end=900.0),))
    with pytest.raises(ValueError, match="a ring has no ends"):
        Lanes(2, ring=500.0, ends=(lane_drop(0, at=100.0),))
    with pytest.raises(ValueError, match="a road is one of them"):
        Lanes(2, length=500.0, ring=500.0)
    with pytest.raises(ValueError, match="do not fit a lane of 20 m"):
        crowded = torch.arange(9, dtype=DTYPE)
        Simulator(Lanes(2, ring=20.0), (IDM(), Brakes())).state(crowded, crowded, params, lane=0)
