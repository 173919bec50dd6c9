"""Several lanes: whose way goes on beside moves over where there is room, and stops at the end of his lane before."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from idm_env import IDM, Brakes, Simulator
from idm_env.backends import off
from idm_env.effects import LinkLimit, StopLine
from idm_env.multilane.junctions import counts, deadlocked, journeys_of, travelling
from idm_env.roads.network import Network, Plan, padded
from idm_env.roads.network_demand import Demand
from idm_env.roads.ways import Ways
from tests.networks.laws import broken

A, B, X, Y, C, D = range(6)
WAYS = (A, X, C), (B, Y, D), (A, B, Y, D), (B, A, X, C)
"""On both lanes straight on, to the left and to the right."""


def street(before: float = 120.0, longer: float = 0.0) -> Network:
    """Return a street of two lanes, a to the right of b, a signal, and two lanes behind it."""
    links = {
        "name": ["a", "b", "x", "y", "c", "d"], "length": [before, before + longer, 12.0, 12.0, 100.0, 100.0],
        "limit": [13.89] * 6, "inner": [0, 0, 1, 1, 0, 0], "edge": ["in", "in", "x", "y", "out", "out"],
        "left": ["b", None, None, None, "d", None], "right": [None, "a", None, None, None, "c"],
    }  # fmt: skip
    moves = {"start": ["a", "b"], "end": ["c", "d"], "path": [["x"], ["y"]], "signal": ["s", "s"], "index": [0, 1]}
    return Network.from_tables(links, moves, [Plan("s", (20.0, 3.0, 17.0), ("GG", "yy", "rr"))])


def entered_aside() -> Network:
    """Return a street of two lanes, of which one comes to a from e, and only b leads on, over y to d."""
    names = ["a", "b", "y", "d", "e"]
    links = {"name": names, "length": [100.0] * 5, "limit": [13.89] * 5, "inner": [0, 0, 1, 0, 0]}
    links |= {"edge": ["in", "in", "y", "out", "before"], "left": ["b", *[None] * 4], "right": [None, "a", *[None] * 3]}
    return Network.from_tables(links, {"start": ["b", "e"], "end": ["d", "a"], "path": [["y"], []]})


def crowded(network: Network, vehicles: int, seed: int, every: float = 2.5) -> Demand:
    """Return vehicles whose ways are drawn, two of three of which cross those of others."""
    route = np.random.default_rng(seed).choice(4, vehicles, p=(0.15, 0.15, 0.35, 0.35))
    return Demand(padded(WAYS), route, every * np.arange(vehicles), length=np.where(route == 0, 12.0, 5.0))


def simulated(network: Network) -> tuple[Simulator, dict[str, dict[str, Any]]]:
    """Return a simulator of a network, and its parameters in float64."""
    simulator = Simulator(network, (IDM(), StopLine(), LinkLimit(), Brakes()), 0.1)
    return simulator, simulator.defaults(dtype=torch.float64)


@pytest.mark.parametrize("longer", [0.0, 4.0])
def test_lanes_are_changed_and_nothing_is_broken(longer: float) -> None:
    """Everybody comes to the end of his route although two of three must cross the others, and nobody overlaps."""
    network = street(longer=longer)
    simulator, params = simulated(network)
    demand = [crowded(network, 60, seed) for seed in range(4)]
    before = travelling(simulator, demand, params, dtype=torch.float64)
    before, _ = simulator.rollout(before, {}, params, 1, keep=None)
    for _ in range(1000):
        after, _ = simulator.rollout(before, {}, params, 5, keep=None)
        assert broken(simulator, before, after) == []
        before = after
    assert (counts(before).left == 60).all()


def test_all_paths_change_lanes_alike() -> None:
    """A row is the single run bit by bit, torch decides as the kernel does, and gradients agree."""
    network = street(longer=4.0)
    simulator, params = simulated(network)
    many = [crowded(network, 16, seed) for seed in (1, 2)]
    params["idm"]["time_gap"] = torch.tensor(1.2, dtype=torch.float64, requires_grad=True)
    ends = []
    for compiled, demand in ((True, many), (False, many), (True, many[1])):
        state = travelling(simulator, demand, params, dtype=torch.float64)
        with torch.enable_grad():
            if compiled:
                state, _ = simulator.rollout(state, {}, params, 400)
            else:
                with off():
                    state, _ = simulator.rollout(state, {}, params, 400)
            (slope,) = torch.autograd.grad(state.speed.sum(), [params["idm"]["time_gap"]])
        ends.append((state, slope))
    with torch.no_grad():
        begun = travelling(simulator, many, params, dtype=torch.float64)
        plain, _ = simulator.rollout(begun, {}, params, 400, keep=None)
    (kernel, a), (reference, b), (single, _) = ends
    assert kernel.lanes is not None and reference.lanes is not None and single.lanes is not None
    assert (journeys_of(kernel).hop > 0).any() and (journeys_of(kernel).route != journeys_of(begun).route).any()
    assert torch.equal(journeys_of(kernel).route, journeys_of(reference).route)
    assert torch.equal(kernel.lanes.lane, reference.lanes.lane)
    assert torch.equal(kernel.position, plain.position) and torch.equal(kernel.position[1], single.position)
    assert torch.allclose(kernel.position, reference.position, rtol=0.0, atol=1e-9)
    assert a.abs() > 0.1 and torch.allclose(a, b, rtol=1e-8)


@pytest.mark.parametrize("length", [5.0, 12.0, 18.0])
def test_two_who_want_each_others_lane_get_it(length: float) -> None:
    """They stand at the end of their lanes, a queue beside one; he who must go to the right leaves room ahead.

    That was room for a car, and lorries stood there for ever.
    """
    network = street()
    simulator, params = simulated(network)
    demand = Demand(padded(WAYS), [2, 0, 3], np.zeros(3), length=np.array([length, 5.0, 5.0]))
    place = [117.9, 115.8 - length, 110.9 - length]
    state = travelling(simulator, demand, params, hop=[0] * 3, position=place, speed=[0.0] * 3)
    state, _ = simulator.rollout(state, {}, params, 600, keep=None)
    assert int(counts(state).left) == 3


@pytest.mark.parametrize(
    ("leads", "beside", "changes"), [(True, 900.0, True), (False, 900.0, False), (True, 36.0, False)]
)
def test_who_gains_on_the_lane_beside_goes_there(leads: bool, beside: float, changes: bool) -> None:
    """Behind somebody slow one changes if a way goes on from there, and if nobody is close on that lane."""
    network = street(1000.0)
    simulator, params = simulated(network)
    params["idm"]["desired_speed"] = torch.tensor([2.0, 13.0, 13.0], dtype=torch.float64)
    # Of a way that must come back no use is made.
    demand = Demand(padded([WAYS[0], WAYS[1] if leads else WAYS[3]]), [0, 0, 1], np.zeros(3))
    state = travelling(
        simulator, demand, params, hop=[0] * 3, position=[80.0, 40.0, beside],
        speed=[2.0, 9.0, 9.0], dtype=torch.float64,
    )  # fmt: skip
    state, _ = simulator.rollout(state, {}, params, 6, keep=None)
    assert state.lanes is not None
    assert state.lanes.lane.tolist()[:2] == [A, B if changes else A]
    assert journeys_of(state).route.tolist() == [0, int(changes), 1]


def test_routes_take_both_lanes_and_change_where_they_must() -> None:
    """Lanes are taken evenly where both lead on, and a change is planned where one does not."""
    network = street()
    ways = Ways(network)
    routes = [ways.route_along(["in", "out"], "test") for _ in range(10)]
    assert {*routes} == {WAYS[0], WAYS[1]} and 4 <= routes.count(WAYS[0]) <= 6
    assert Ways(entered_aside()).route_along(["before", "in", "out"], "test") == (4, 0, 1, 2, 3)


def test_nobody_is_followed_to_the_lane_beside() -> None:
    """Whoever comes to a lane from which he must change follows nobody who is ahead on the other one.

    The way there was counted twice, and kept when the leader came over: they overlapped.
    """
    simulator, params = simulated(entered_aside())
    demand = Demand(padded([(4, 0, 1, 2, 3), (1, 2, 3)]), np.arange(2), np.zeros(2))
    state = travelling(simulator, demand, params, hop=[0, 0], position=[95.0, 30.0])
    state, _ = simulator.rollout(state, {}, params, 1, keep=None)
    assert state.lanes is not None and state.lanes.leader.tolist() == [0, 1]


def test_a_lane_too_short_for_a_change_is_refused() -> None:
    """Whoever could not stop at its end would miss his way."""
    with pytest.raises(ValueError, match=r"^route 2: link 'a' \(25 m\) is too short for a change at its limit\.$"):
        Demand(padded(WAYS), [2], [0.0]).check(street(25.0))
    with pytest.raises(ValueError, match=r"^route 0: link 'd' does not follow 'a', nor is it the lane beside\.$"):
        Demand(padded([(A, D)]), [0], [0.0]).check(street())


def test_a_standstill_at_lane_ends_is_counted() -> None:
    """A lorry and a car want each other's lane, and a queue fills the room that either would need."""
    network = street()
    simulator, params = simulated(network)
    demand = Demand(padded(WAYS), [2, 0, 3, 1], np.zeros(4), length=np.array([12.0, 5.0, 5.0, 5.0]))
    state = travelling(simulator, demand, params, hop=[0] * 4, position=[117.9, 103.5, 105.9, 98.5], speed=[0.0] * 4)
    state, _ = simulator.rollout(state, {}, params, 1200, keep=None)
    assert int(counts(state).left) == 0 and int(deadlocked(simulator, state, params)) == 3
