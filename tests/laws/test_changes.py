"""Laws of lane changes: nobody overlaps, mirrored roads give mirrored changes, and hypothetical pairs are real ones."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from hypothesis import given, settings, strategies as st
from torch import Tensor

from idm_env.effects import IDM, Brakes, Effect, LaneCommand, MandatoryChange, Mobil, make
from idm_env.multilane import demand
from idm_env.multilane.incentives import lane_scene
from idm_env.roads import Lane, Lanes, lane_drop, off_ramp, on_ramp
from idm_env.simulator import Simulator
from idm_env.types import State

DTYPE = torch.float64


def mixed(
    road: Lanes, n: int, span: float, *, batch: int = 3, seed: int = 0, effects: tuple[Effect, ...] = (Mobil(),)
) -> tuple[Simulator, State, dict[str, dict[str, Tensor]]]:
    """Return drivers of different desired speeds anywhere on the lanes of a road, nobody in another's body."""
    generator = torch.Generator().manual_seed(seed)
    simulator = Simulator(road, (IDM(), *effects, Brakes()))
    params = simulator.defaults(dtype=DTYPE)
    params["idm"]["desired_speed"] = 15.0 + 20.0 * torch.rand((batch, n), generator=generator, dtype=DTYPE)
    place = torch.stack([torch.randperm(n, generator=generator) for _ in range(batch)])
    lane = torch.randint(road.count, (batch, n), generator=generator)
    position = place * (span / n) + 0.5 * torch.rand((batch, n), generator=generator, dtype=DTYPE)
    # Side by side in the same lane there is room only if a place is longer than a vehicle.
    lane = torch.where(torch.tensor(span / n < 8.0), place % road.count, lane)
    return simulator, simulator.state(position, torch.full_like(position, 8.0), params, lane=lane), params


ROADS = {
    "ring": lambda count: Lanes(count, ring=600.0),
    "open": lambda count: Lanes(count),
    "drop": lambda count: Lanes(count, ends=(lane_drop(count - 1, at=900.0),)),
    "ramps": lambda count: Lanes(
        count, length=1500.0, ends=(on_ramp(0, begin=300.0, end=800.0), off_ramp(count - 1, 200.0, 700.0, leaves=900.0))
    ),
}


@pytest.mark.parametrize("bias", [-1.0, 1.0])
def test_a_side_that_does_not_exist_blocks_nobody(bias: float) -> None:
    """Whoever would rather drive on the lane on which he is already wishes for nothing."""
    simulator = Simulator(Lanes(2), (IDM(), Mobil(), Brakes()))
    params = simulator.defaults(dtype=DTYPE)
    params["mobil"]["keep_right"] = torch.tensor(bias, dtype=DTYPE)
    position = torch.tensor([0.0], dtype=DTYPE)
    start = simulator.state(position, position + 20.0, params, lane=0 if bias > 0 else 1)
    end, _ = simulator.rollout(start, {}, params, 35)
    assert end.lanes is not None
    assert (int(end.lanes.blocked), int(end.lanes.changed)) == (0, 0)


@settings(max_examples=8)
@given(
    road=st.sampled_from(sorted(ROADS)),
    count=st.integers(2, 5),
    n=st.integers(5, 60),
    seed=st.integers(0, 10_000),
    politeness=st.floats(-0.5, 1.0),
    safe=st.floats(0.5, 6.0),
)
def test_nobody_overlaps_and_nobody_is_lost(
    road: str, count: int, n: int, seed: int, politeness: float, safe: float
) -> None:
    """At every step of random traffic: gaps are positive and what positions say, links are inverse, all are counted."""
    simulator, state, params = mixed(ROADS[road](count), n, 580.0, seed=seed, effects=(Mobil(), MandatoryChange()))
    for name, value in (("politeness", politeness), ("safe_decel", safe)):
        params["mobil"][name] = torch.tensor(value, dtype=DTYPE)
    params["mandatory_change"]["safe_decel"] = params["mobil"]["safe_decel"]
    own = torch.arange(n).expand_as(state.speed)
    gone = torch.zeros_like(state.speed)
    for _ in range(150):
        before = state
        state = simulator.step(state, {}, params)
        links = state.lanes
        assert links is not None
        assert (state.gap > 0).all()
        fresh = simulator.road.view(state).gaps(state.position, state.length)
        there = state.gap < 5e3
        torch.testing.assert_close(state.gap[there], fresh[there], rtol=0, atol=1e-8)
        back = links.follower.gather(-1, links.leader)
        assert ((back == own) | (links.leader == own)).all()
        if state.present is not None and before.present is not None:
            gone += before.present - state.present
            assert torch.equal(state.present + gone, torch.ones_like(gone))
    assert (links.changed + links.refused + links.blocked).sum() >= 0


@pytest.mark.parametrize("road", sorted(ROADS))
def test_traffic_changes_lanes_on_every_road(road: str) -> None:
    """Otherwise the laws above would hold of nothing."""
    simulator, state, params = mixed(ROADS[road](3), 40, 580.0, seed=4, effects=(Mobil(), MandatoryChange()))
    end, _ = simulator.rollout(state, {}, params, 200)
    assert end.lanes is not None
    assert end.lanes.changed.sum() >= 20 and end.lanes.refused.sum() > 0
    lanes = end.lanes.lane if end.present is None else end.lanes.lane[end.present > 0]
    assert len(lanes.unique()) >= 2


@pytest.mark.parametrize("ring", [None, 600.0])
def test_mirrored_roads_give_mirrored_changes(ring: float | None) -> None:
    """With the hand that settles equal claims mirrored as well, to the last bit."""
    ends = () if ring else (lane_drop(0, at=900.0),)
    other = () if ring else (lane_drop(3, at=900.0),)
    simulator, state, params = mixed(Lanes(4, ring=ring, ends=ends), 50, 580.0, effects=(Mobil(), MandatoryChange()))
    params["mobil"]["keep_right"] = torch.tensor(0.1, dtype=DTYPE)
    params["idm"]["desired_speed"] = params["idm"]["desired_speed"].round(decimals=-1)  # so that claims are equal
    mirror = Simulator(Lanes(4, ring=ring, ends=other, handed="right"), simulator.effects)
    turned = {**params, "mobil": {**params["mobil"], "keep_right": -params["mobil"]["keep_right"]}}
    assert state.lanes is not None
    start = mirror.state(state.position, state.speed, turned, lane=3 - state.lanes.lane)
    one, kept = simulator.rollout(state, {}, params, 200)
    two, same = mirror.rollout(start, {}, turned, 200)
    assert one.lanes is not None and two.lanes is not None and one.lanes.changed.sum() > 20
    assert torch.equal(one.lanes.lane, 3 - two.lanes.lane)
    assert all(torch.equal(a, b) for a, b in zip(kept, same, strict=True))


def test_blocks_of_slots_take_turns_to_decide() -> None:
    """Once a second each, a step apart; nobody overlaps, links stay inverse; fewer than 256 slots are refused."""
    mobil = Mobil(stagger=256)
    simulator, state, params = mixed(Lanes(3, ring=7200.0), 700, 7100.0, batch=1, effects=(mobil,))
    own, changed = torch.arange(700), torch.zeros(3)
    for step in range(20):
        before, state = state, simulator.step(state, {}, params)
        assert before.lanes is not None and state.lanes is not None
        decided = sum(b - a for a, b in zip(before.lanes[3:6], state.lanes[3:6], strict=True))[0] > 0
        assert not decided[own // 256 != step % 10].any()
        changed += torch.stack(
            [(state.lanes.changed - before.lanes.changed)[0, own // 256 == k].sum() for k in range(3)]
        )
        assert (state.gap > 0).all()
        assert torch.equal(state.lanes.follower.gather(-1, state.lanes.leader)[0], own)
    assert (changed > 5).all()
    with pytest.raises(ValueError, match=r"stagger = 10 slots must be 0 \(all at once\) or at least 256"):
        Mobil(stagger=10)
    with pytest.raises(ValueError, match="every = 0 s must be a number above 0"):
        Mobil(every=0.0)
    with pytest.raises(ValueError, match="who takes turns to decide does not see who signals"):
        Simulator(Lanes(2), (IDM(), make("courtesy"), mobil))


def test_claims_of_equal_utility_go_to_the_hand_of_the_road() -> None:
    """Two drivers beside one gap, alike in all: who goes to the road's hand is granted, the other is counted."""
    for handed, winner in (("left", 0), ("right", 1)):
        simulator = Simulator(Lanes(3, handed=handed), (IDM(), Mobil(), Brakes()))  # type: ignore[arg-type]
        params = simulator.defaults(dtype=DTYPE)
        position = torch.tensor([0.0, 0.0, 25.0, 25.0, -200.0], dtype=DTYPE)
        speed = torch.tensor([20.0, 20.0, 5.0, 5.0, 20.0], dtype=DTYPE)
        state = simulator.state(position, speed, params, lane=torch.tensor([0, 2, 0, 2, 1]))
        links = simulator.step(state, {}, params).lanes
        assert links is not None
        assert links.lane.tolist()[winner] == 1 and links.lane.tolist()[1 - winner] == 2 * (1 - winner)
        assert links.changed.tolist()[:2] == [1 - winner, winner]
        assert links.refused.tolist()[:2] == [winner, 1 - winner]


def test_drivers_who_never_wish_drive_as_without_lane_changes() -> None:
    """A threshold that nothing exceeds leaves no trace, to the last bit; and rows do not see each other."""
    simulator, state, params = mixed(Lanes(3, ring=600.0), 30, 580.0)
    never = {**params, "mobil": {**params["mobil"], "threshold": torch.tensor(1e3, dtype=DTYPE)}}
    _, kept = simulator.rollout(state, {}, never, 60)
    _, plain = simulator.without("mobil").rollout(state, {}, params, 60)
    assert all(torch.equal(a, b) for a, b in zip(kept, plain, strict=True))
    _, together = simulator.rollout(state, {}, params, 60)
    for row in range(3):
        mine = {**params, "idm": {n: v[row] if v.dim() else v for n, v in params["idm"].items()}}
        assert state.lanes is not None
        alone = simulator.state(state.position[row], state.speed[row], mine, lane=state.lanes.lane[row])
        _, single = simulator.rollout(alone, {}, mine, 60)
        assert all(torch.equal(a[:, row], b) for a, b in zip(together, single, strict=True))


FOLLOWING = (
    IDM(),
    make("second_leader"),
    make("speed_dependent_gap"),
    make("gap_bias"),
    make("grade"),
    make("follower"),
)


def test_hypothetical_pairs_are_answered_by_the_simulators_own_effects() -> None:
    """What drivers would want beside is what a lane of these very vehicles says, followers' drivers included."""
    road = Lanes(3)
    simulator, state, params = mixed(road, 14, 300.0, batch=1, seed=8, effects=(*FOLLOWING[1:], Mobil()))
    params["idm"]["time_gap"] = 1.0 + torch.rand((1, 14), generator=torch.Generator().manual_seed(2), dtype=DTYPE)
    lane = Simulator(Lane(), FOLLOWING)
    view = simulator.road.view(state)
    sides = view.side(view.order(None), 1, state), view.side(view.order(None), -1, state)  # type: ignore[attr-defined]
    scene = lane_scene(simulator, view, sides, state, {}, params)  # type: ignore[arg-type]
    place, which = state.position[0], state.lanes.lane[0]  # type: ignore[union-attr]

    def lone(slots: list[int], who: int) -> Tensor:
        """Return what one of these vehicles wants where they alone are on a lane."""
        slots = sorted(slots, key=lambda i: -float(place[i]))
        mine = {
            e: {n: v[0, slots] if v.dim() else v for n, v in p.items()} for e, p in params.items() if e in lane.by_name
        }
        alone = lane.state(place[slots], state.speed[0, slots], mine)
        return lane.acceleration(alone, {}, mine)[slots.index(who)]

    checked = 0
    for i in range(14):
        for name, to in (("left", int(which[i]) + 1), ("here", int(which[i])), ("right", int(which[i]) - 1)):
            if not 0 <= to < 3:
                continue
            seen = getattr(scene, name)
            there = [j for j in range(14) if which[j] == to and j != i]
            behind = [j for j in there if place[j] <= place[i]]
            torch.testing.assert_close(seen.wanted[0, i], lone([*there, i], i))
            if behind:
                n = max(behind, key=lambda j: float(place[j]))
                torch.testing.assert_close(seen.with_me[0, i], lone([*there, i], n))
                # A follower behind a gap that one leaves has the same vehicle behind, as everybody else.
                torch.testing.assert_close(seen.without_me[0, i], lone(there, n))
                checked += 1
    assert checked > 20


def test_mobils_rule_is_the_published_one() -> None:
    """Utility and margin of a scene, from the accelerations that the paper names."""
    simulator, state, params = mixed(Lanes(2), 10, 250.0, batch=1, seed=3)
    view = simulator.road.view(state)
    sides = view.side(view.order(None), 1, state), view.side(view.order(None), -1, state)  # type: ignore[attr-defined]
    scene = lane_scene(simulator, view, sides, state, {}, params)  # type: ignore[arg-type]
    values = {"politeness": 0.5, "threshold": 0.2, "safe_decel": 3.0, "keep_right": 0.3}
    p = {name: torch.tensor(value, dtype=DTYPE) for name, value in values.items()}
    wish = Mobil().change(scene, None, p)  # type: ignore[arg-type]
    here, left, right = scene.here, scene.left, scene.right
    assert here is not None and left is not None and right is not None
    for side, utility, margin, bias in (
        (left, wish.left, wish.left_margin, -0.3),
        (right, wish.right, wish.right_margin, 0.3),
    ):
        others = side.with_me - side.without_me + here.without_me - here.with_me
        there = side.exists > 0
        expected = side.wanted - here.wanted + 0.5 * others - 0.2 + bias
        torch.testing.assert_close(utility[there], expected[there])
        assert (utility[~there] <= 0).all()
        safe = (side.with_me >= -3.0) & ((side.wanted >= -3.0) | (side.wanted >= here.wanted))
        assert torch.equal(margin >= 0, safe)


def test_commands_are_done_at_the_next_decision_or_counted() -> None:
    """To the left, off the road, into another vehicle, and left to the driver."""
    simulator = Simulator(Lanes(2), (IDM(), Mobil(), LaneCommand(), Brakes()))
    params = simulator.defaults(dtype=DTYPE)
    position = torch.tensor([0.0, 300.0, 600.0, 602.0, 900.0, 1200.0], dtype=DTYPE)
    lane = torch.tensor([0, 0, 0, 1, 1, 1])
    state = simulator.state(position, torch.full_like(position, 20.0), params, lane=lane)
    nan = float("nan")
    command = torch.tensor([1.0, -1.0, 1.0, nan, 0.0, -1.0], dtype=DTYPE)
    after = simulator.step(state, {"lane_command": command}, params).lanes
    assert after is not None
    assert after.lane.tolist() == [1, 0, 0, 1, 1, 0]
    assert after.changed.tolist() == [1, 0, 0, 0, 0, 1]
    assert after.blocked.tolist() == [0, 1, 1, 0, 0, 0]


def test_a_change_in_front_of_another_follower_than_the_one_judged_is_counted() -> None:
    """Safety is judged against the follower at the time of proposal: if he leaves in the same decision, that is said.

    Vehicle 0 enters the middle lane in front of 1, who is judged; 1 leaves it at the same time, and 2 is behind then.
    """
    simulator = Simulator(Lanes(3), (IDM(), Mobil(), LaneCommand(), Brakes()))
    params = simulator.defaults(dtype=DTYPE)
    position = torch.tensor([60.0, 0.0, -40.0], dtype=DTYPE)
    state = simulator.state(position, torch.full_like(position, 20.0), params, lane=torch.tensor([0, 1, 1]))
    for leaves in (0.0, 1.0):
        command = torch.tensor([1.0, leaves, 0.0], dtype=DTYPE)
        after = simulator.step(state, {"lane_command": command}, params)
        links = after.lanes
        assert links is not None and links.lane.tolist() == [1, 1 + int(leaves), 1]
        assert links.unjudged.tolist() == [int(leaves), 0, 0]
        assert links.follower[0] == (2 if leaves else 1) and (after.gap > 0).all()
    fast = state._replace(speed=torch.tensor([20.0, 20.0, 60.0], dtype=DTYPE))  # nobody asks 2, who cannot brake softly
    after = simulator.step(fast, {"lane_command": command}, params)
    assert after.lanes is not None and after.lanes.changed.tolist() == [1, 1, 0]


def test_courtesy_opens_a_gap_for_whoever_signals() -> None:
    """A driver whose lane ends is let in by the one beside him, who never brakes harder than b for it."""
    position = torch.cat((torch.zeros(1), 71.0 - 16.0 * torch.arange(12))).to(DTYPE)  # the fifth is 5 m behind his rear
    lane = torch.tensor([1, *[0] * 12])
    for weight in (0.0, 1.0):
        road = Lanes(2, ends=(lane_drop(1, at=200.0),))
        simulator = Simulator(road, (IDM(), make("courtesy"), MandatoryChange(), Brakes()))
        params = simulator.defaults(dtype=DTYPE)
        params["courtesy"]["weight"] = torch.tensor(weight, dtype=DTYPE)
        params["mandatory_change"]["safe_decel"] = torch.tensor(2.0, dtype=DTYPE)
        state = simulator.state(position, torch.full_like(position, 10.0), params, lane=lane)
        plain = simulator.without("courtesy").acceleration(state, {}, params)
        after = simulator.step(state, {}, params)
        assert after.lanes is not None and after.lanes.changed.sum() == 0
        less = plain - after.accel
        assert 0.1 < less[6] <= float(params["idm"]["comfort_decel"]) if weight else less[6] == 0
        assert (less[torch.arange(13) != 6] == 0).all()
        for _ in range(18):
            state, kept = simulator.rollout(state, {}, params, 10)
            assert (kept.gap > 0).all()
        assert state.lanes is not None
        assert (int(state.lanes.changed[0]), int(state.lanes.follower[0])) == ((1, 4) if weight else (0, 0))


def test_courtesy_waits_for_nobody_for_ever() -> None:
    """Two that stand side by side at the end of a lane, and all behind them, get on, however courteous they are."""
    position = torch.tensor([198.0, 192.8, 190.5, 185.0, 183.0, 177.5], dtype=DTYPE)  # the second 0.2 m behind a rear
    lane = torch.tensor([1, 0, 1, 0, 1, 0])
    simulator = Simulator(
        Lanes(2, ends=(lane_drop(1, at=200.0),)), (IDM(), make("courtesy"), Mobil(), MandatoryChange(), Brakes())
    )
    params = simulator.defaults(dtype=DTYPE)
    params["courtesy"]["weight"] = torch.tensor(1.0, dtype=DTYPE)
    state = simulator.state(position, torch.zeros_like(position), params, lane=lane)
    for _ in range(12):
        state, kept = simulator.rollout(state, {}, params, 50)
        assert (kept.gap > 0).all()
    assert state.lanes is not None and (state.lanes.lane == 0).all() and (state.position > 205.0).all()


@pytest.mark.parametrize("duration", [0.0, 2.0])
def test_gradients_with_choices_frozen_are_exact(duration: float) -> None:
    """Finite differences that flip no choice agree with back-propagation through changes, ends of lanes included."""
    road, courtesy = Lanes(3, ends=(lane_drop(2, at=330.0),), duration=duration), make("courtesy")
    simulator, state, params = mixed(road, 8, 200.0, batch=1, seed=5, effects=(courtesy, Mobil(), MandatoryChange()))
    assert state.lanes is not None
    lane = state.lanes.lane

    def run(position: Tensor, speed: Tensor, time_gap: Tensor) -> tuple[Tensor, Tensor]:
        p = {**params, "idm": {**params["idm"], "time_gap": time_gap}}
        end, _ = simulator.rollout(simulator.state(position, speed, p, lane=lane), {}, p, 22)
        assert end.lanes is not None and end.lanes.changed.sum() >= 3
        return end.position, end.gap.clamp_max(1e3)

    leaves = state.position, state.speed, torch.full((1, 8), 1.4, dtype=DTYPE)
    assert torch.autograd.gradcheck(run, [x.clone().requires_grad_() for x in leaves], eps=1e-6, atol=1e-5)


def shadows(state: State, simulator: Simulator) -> Tensor:
    """Return everybody's gap to whoever is still leaving his lane (m)."""
    assert state.lanes.moving is not None
    view = simulator.road.view(state)
    return view.to_slot(state.position, state.length, state.lanes.moving.shadow)  # type: ignore[attr-defined, no-any-return]


@pytest.mark.parametrize("road", sorted(ROADS))
def test_whoever_takes_time_to_change_is_a_leader_in_both_lanes(road: str) -> None:
    """Nobody runs into him on either lane; he decides nothing meanwhile; links stay inverse."""
    timed = dataclasses.replace(ROADS[road](3), duration=3.0)
    simulator, state, params = mixed(timed, 40, 580.0, seed=4, effects=(Mobil(), MandatoryChange()))
    own, met = torch.arange(40).expand_as(state.speed), 0
    last = torch.full_like(own, -1000)
    for step in range(200):
        before, state = state, simulator.step(state, {}, params)
        links, was = state.lanes, before.lanes
        assert links is not None and was is not None and state.lanes.moving is not None
        went = links.changed > was.changed
        assert (step - last[went] >= 30).all()
        last = torch.where(went, step, last)
        there = torch.ones_like(went) if state.present is None else state.present > 0
        assert (state.gap[there] > 0).all() and (shadows(state, simulator)[there] > 0).all()
        met += int((shadows(state, simulator)[there] < 100.0).sum())
        back = links.follower.gather(-1, links.leader)
        assert ((back == own) | (links.leader == own)).all()
    assert (last >= 0).sum() > 10 and met > 50


def test_a_change_that_takes_time_holds_the_old_follower_until_it_is_done() -> None:
    """Two seconds as if he were there; then free, as at once where a change is at a point."""
    kept, position = {}, torch.tensor([60.0, 30.0], dtype=DTYPE)
    for duration in (0.0, 2.0):
        simulator = Simulator(Lanes(2, duration=duration), (IDM(), LaneCommand(), Brakes()))
        params = simulator.defaults(dtype=DTYPE)
        state = simulator.state(position, torch.full_like(position, 15.0), params, lane=0)
        command = torch.tensor([[1.0, 0.0]] + 39 * [[0.0, 0.0]], dtype=DTYPE)
        end, kept[duration] = simulator.rollout(state, {"lane_command": command}, params, 40)
        assert end.lanes is not None and end.lanes.lane.tolist() == [1, 0]
    follows = simulator.without("lane_command")
    _, behind = follows.rollout(
        follows.state(position, torch.full_like(position, 15.0), params, lane=0), {}, params, 20
    )
    torch.testing.assert_close(kept[2.0].accel[:20, 1], behind.accel[:, 1])
    assert (kept[2.0].accel[:20, 1] < kept[0.0].accel[:20, 1] - 0.1).all()
    assert (kept[2.0].accel[21:, 1] > 0.9).all()


def test_timed_changes_on_mirrored_roads_and_with_trips() -> None:
    """Mirrored to the last bit; everybody who is due is inside, left or queued, and enters behind nobody's back."""
    simulator, state, params = mixed(Lanes(4, ring=600.0, duration=2.0), 40, 580.0)
    mirror = Simulator(Lanes(4, ring=600.0, handed="right", duration=2.0), simulator.effects)
    assert state.lanes is not None
    start = mirror.state(state.position, state.speed, params, lane=3 - state.lanes.lane)
    one, _ = simulator.rollout(state, {}, params, 150)
    two, _ = mirror.rollout(start, {}, params, 150)
    assert one.lanes is not None and two.lanes is not None and one.lanes.changed.sum() > 20
    assert torch.equal(one.lanes.lane, 3 - two.lanes.lane) and torch.equal(one.position, two.position)
    road = Lanes(2, length=400.0, ends=(lane_drop(1, at=250.0),), duration=3.0)
    simulator = Simulator(road, (IDM(), Mobil(), MandatoryChange(), Brakes()))
    params = simulator.defaults(dtype=DTYPE)
    params["idm"]["desired_speed"] = 12.0 + 20.0 * torch.rand(16, generator=torch.Generator().manual_seed(1)).double()
    given = demand.trips({0: 900.0, 1: 900.0}, 3600.0, slots=16, dtype=DTYPE)
    state = demand.waiting(simulator, given, params)
    for _ in range(600):
        state = simulator.step(state, {}, params)
        found = demand.counts(simulator, state)
        assert found.due == found.inside + found.left + found.queued and state.present is not None
        if state.lanes.moving is not None:
            there = state.present > 0
            assert (state.gap[there] > 0).all() and (shadows(state, simulator)[there] > 0).all()
    assert found.left > 5 and state.lanes is not None and state.lanes.changed.sum() > 5


def test_durations_that_cannot_be_are_one_line() -> None:
    """Below 0."""
    with pytest.raises(ValueError, match="duration = -1 s must be at least 0"):
        Lanes(2, duration=-1.0)
