"""Signals, priorities and foes: what passes in a green, what SUMO lets pass, and what no event breaks."""

from __future__ import annotations

import itertools
import warnings
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from idm_env import IDM, Brakes, Simulator
from idm_env.backends import off
from idm_env.compiled.kernels import network_loops
from idm_env.effects import LinkLimit, Noise, StopLine
from idm_env.multilane import junctions
from idm_env.multilane.junctions import by_link, counts, deadlocked, journeys_of, showing, travelling
from idm_env.roads.network import AMBER, GREEN, RED, YIELD, Network, Plan, padded
from idm_env.roads.network_demand import Demand
from idm_env.roads.ways import Ways
from idm_env.types import State
from tests.networks.laws import broken

EFFECTS = (IDM(), StopLine(), LinkLimit(), Brakes())
SUMO = {"max_accel": 2.6, "comfort_decel": 4.5, "time_gap": 1.0, "min_gap": 2.5}
"""Numbers of SUMO's passenger car."""


def simulated(network: Network, *effects: Any, **driver: float) -> tuple[Simulator, dict[str, dict[str, Any]]]:
    """Return a simulator of a network, and its parameters in float64."""
    simulator = Simulator(network, (*EFFECTS, *effects), 0.1)
    params = simulator.defaults(dtype=torch.float64)
    params["idm"] |= {k: torch.tensor(v, dtype=torch.float64) for k, v in driver.items()}
    return simulator, params


def signalised(green: float) -> Network:
    """Return one road with a signal, of a cycle of 90 s."""
    plan = Plan("s", (green, 3.0, 87.0 - green), ("G", "y", "r"))
    links = {"name": ["a", "x", "b"], "length": [400.0, 15.0, 300.0], "limit": [13.89] * 3, "inner": [0, 1, 0]}
    moves = {"start": ["a"], "end": ["b"], "path": [["x"]], "signal": ["s"], "index": [0]}
    return Network.from_tables(links, moves, [plan])


def crossing(seed: int, signals: bool) -> Network:
    """Return a crossing of four roads with all ways but back, whose foes are drawn, and their priorities."""
    random, arms = np.random.default_rng(seed), range(4)
    names = [f"{way}{arm}" for way in ("in", "out") for arm in arms]
    pairs = [(a, b) for a, b in itertools.product(arms, arms) if a != b]
    inner = [f"x{a}{b}" for a, b in pairs]
    foes: list[set[int]] = [set() for _ in pairs]
    for (i, (a, b)), (j, (c, d)) in itertools.combinations(enumerate(pairs), 2):
        if a != c and (b == d or random.random() < 0.6):
            foes[i].add(j)
            foes[j].add(i)
    yields = [[j for j in foe if j > i and random.random() < 0.7] for i, foe in enumerate(foes)]
    length = [*random.uniform(30.0, 150.0, 8), *random.uniform(4.0, 20.0, len(pairs))]
    links = {"name": [*names, *inner], "length": length, "limit": random.uniform(5.0, 20.0, len(length))}
    links["inner"] = [False] * 8 + [True] * len(pairs)
    moves: dict[str, Any] = {"start": [f"in{a}" for a, _ in pairs], "end": [f"out{b}" for _, b in pairs]}
    moves |= {"path": [[x] for x in inner], "foes": [sorted(f) for f in foes], "yields": yields}
    plans = []
    if signals:
        moves |= {"signal": ["s"] * len(pairs), "index": list(range(len(pairs)))}
        states = ["".join("g" if a % 2 == k else "r" for a, _ in pairs) for k in range(2)]
        plans = [Plan("s", (17.0, 3.0, 9.0, 3.0), (states[0], states[0].replace("g", "y"), states[1], "r" * 12), 2.0)]
    return Network.from_tables(links, moves, plans)


def busy(network: Network, seed: int, rows: int = 2) -> list[Demand]:
    """Return demands that a crossing cannot serve."""
    random, routes = np.random.default_rng(seed), []
    for m in range(len(network.start)):
        routes.append([network.start[m], network.path[m, 0], network.end[m]])
    n = 150
    return [
        Demand(routes, random.integers(0, len(routes), n), random.uniform(0, 200, n), length=random.uniform(3, 15, n))
        for _ in range(rows)
    ]


@pytest.mark.parametrize(("green", "vehicles"), [(3.0, 1), (5.0, 2), (8.0, 4), (12.0, 6), (20.0, 10), (42.0, 21)])
def test_as_many_pass_in_a_green_as_in_sumo(green: float, vehicles: int) -> None:
    """SUMO, with IDM and its car's numbers, lets 1.00, 2.00, 4.01, 6.00, 10.01 and 21.0 pass."""
    simulator, params = simulated(signalised(green), **SUMO)
    waiting = travelling(simulator, Demand([[0, 1, 2]], [0] * 200, np.arange(200) * 2.0), params, dtype=torch.float64)
    state, passed = waiting, list[int]()
    for _ in range(7):
        state, _ = simulator.rollout(state, {}, params, 900, keep=None)
        assert state.lanes is not None and state.present is not None
        passed.append(int(counts(state).left) + int((state.lanes.lane[state.present > 0] > 0).sum()))
    assert np.diff(passed)[2:].tolist() == [vehicles] * 4


def test_two_of_each_stream_pass_in_five_seconds_as_in_sumo() -> None:
    """Nobody waits at green for a foe who will have left the junction when he is at his line."""
    network = Network.crossing(arm=300.0, green=5.0)
    simulator, params = simulated(network, max_accel=1.5, comfort_decel=2.0, time_gap=1.5, min_gap=2.0)
    ways, n = Ways(network), 100
    streets = ("bottom0A0", "A0top0"), ("top0A0", "A0bottom0"), ("left0A0", "A0right0"), ("right0A0", "A0left0")
    routes = [ways.route_along(street, "") for street in streets]
    demand = Demand(padded(routes), [*range(4)] * n, np.arange(4 * n) // 4)
    state, passed = travelling(simulator, demand, params, dtype=torch.float64), []
    for _ in range(3):
        state, _ = simulator.rollout(state, {}, params, 640, keep=None)
        journeys = journeys_of(state)
        passed.append(torch.bincount(journeys.route[journeys.left >= 0].long(), minlength=4))
    assert (passed[2] - passed[1]).tolist() == [8] * 4


def test_who_drives_more_than_a_limit_does_so_on_every_link() -> None:
    """Before a link of the same limit nobody brakes."""
    network = Network.grid(1, 3, control="none", block=150.0)
    simulator, params = simulated(network, **SUMO)
    params["link_limit"]["factor"] = torch.tensor([1.2], dtype=torch.float64)
    route = Ways(network).route_along(["left0A0", "A0B0", "B0C0", "C0right0"], "")
    state = travelling(simulator, Demand(padded([route]), [0], [0.0]), params, dtype=torch.float64)
    _, trajectory = simulator.rollout(state, {}, params, 350)
    assert trajectory is not None
    assert trajectory.speed[200:, 0].min() > 1.19 * 13.89


def test_one_turns_left_after_each_green() -> None:
    """Oncoming traffic leaves no gap. SUMO lets 1.0 a cycle clear the junction when it has ended."""
    network = Network.crossing(arm=300.0)
    simulator, params = simulated(network, **SUMO)
    ways, n = Ways(network), 400
    routes = [ways.route_along(way, "") for way in (["bottom0A0", "A0left0"], ["top0A0", "A0bottom0"])]
    demand = Demand(padded(routes), [0, 1] * n, np.repeat(np.arange(n) * 1.5, 2))
    state = travelling(simulator, demand, params, dtype=torch.float64)
    cleared = list[int]()
    for _ in range(6):
        state, _ = simulator.rollout(state, {}, params, 900, keep=None)
        journeys = journeys_of(state)
        cleared.append(int(((journeys.left >= 0) & (journeys.route == 0)).sum()))
    assert np.diff(cleared)[1:].tolist() == [1] * 4


@pytest.mark.parametrize(("seed", "signals"), [(0, True), (1, False), (2, True), (3, False)])
def test_nothing_is_broken_at_a_crowded_crossing(seed: int, signals: bool) -> None:
    """No overlap, no foes inside together, nobody begins to cross in red who could stop, and books balance."""
    network = crossing(seed, signals)
    simulator, params = simulated(network, **(SUMO if seed % 2 else {}))
    before = travelling(simulator, busy(network, seed), params, dtype=torch.float64)
    before, _ = simulator.rollout(before, {}, params, 1, keep=None)
    for _ in range(300):
        after, _ = simulator.rollout(before, {}, params, 5, keep=None)
        assert broken(simulator, before, after) == []
        before = after
    assert int(counts(before).left.min()) > 10 and int(counts(before).queued.min()) > 0


def same(one: State, other: State, exactly: bool) -> None:
    """Compare two states: decisions always to the bit."""
    assert one.lanes is not None and other.lanes is not None and one.lanes.journeys and other.lanes.journeys
    for mine, theirs in ((one.lanes, other.lanes), (one.lanes.journeys, other.lanes.journeys)):
        for name in ("lane", "leader", "follower", "hop", "told", "reserved", "entered", "left"):
            if hasattr(mine, name):
                assert torch.equal(getattr(mine, name), getattr(theirs, name)), name
    for name in ("position", "speed", "accel", "gap", "present"):
        a, b = getattr(one, name), getattr(other, name)
        assert torch.equal(a, b) if exactly else torch.allclose(a, b, rtol=0.0, atol=1e-9), name


def test_all_paths_do_the_same() -> None:
    """The step itself to rounding; chains, rows in place, and a row by itself bit by bit."""
    network = crossing(4, True)
    simulator, params = simulated(network)
    demands = busy(network, 4)
    start, _ = simulator.rollout(
        travelling(simulator, demands, params, dtype=torch.float64), {}, params, 603, keep=None
    )
    assert start.present is not None and int(start.present.sum(-1).min()) > 15
    place, _ = simulator.rollout(start, {}, params, 104, keep=None)
    chains, _ = simulator.rollout(start, {}, params, 104)
    with off():
        plain, _ = simulator.rollout(start, {}, params, 104, keep=None)
    same(place, chains, True)
    same(place, plain, False)
    single, _ = simulator.rollout(
        travelling(simulator, demands[1], params, dtype=torch.float64), {}, params, 603, keep=None
    )
    single, _ = simulator.rollout(single, {}, params, 104, keep=None)
    assert torch.equal(single.position, place.position[1]) and torch.equal(single.gap, place.gap[1])


def test_a_mirrored_network_is_mirrored_traffic() -> None:
    """Who keeps to the right keeps to the left, and left turns are right turns: every number stays, bit by bit."""
    network = Network.grid(1, 2)
    shape = tuple(points * (-1.0, 1.0) for points in network.shape)
    mirrored = replace(network, shape=shape, left=network.right, right=network.left)
    turns = (0.3, 0.5, 0.2)
    ends = []
    for road, shares in ((network, turns), (mirrored, turns[::-1]), (mirrored, turns)):
        simulator, params = simulated(road)
        demand = Demand.by_turns(road, 600.0, 120.0, seed=2, shares=shares)
        state = travelling(simulator, demand, params, dtype=torch.float64)
        ends.append(simulator.rollout(state, {}, params, 1500, keep=None)[0])
        assert int(counts(ends[-1]).left) > 30
    same(ends[0], ends[1], True)
    assert not torch.equal(ends[0].speed, ends[2].speed)


def test_any_effect_works_on_a_network() -> None:
    """Noise is drawn by slot, so chains, rows in place and the step itself see the same."""
    network = crossing(5, False)
    simulator, params = simulated(network, Noise())
    start = travelling(simulator, busy(network, 5), params, dtype=torch.float64)
    ends = []
    for keep in (None, lambda state: (state.speed,)):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            ends.append(simulator.rollout(start, {}, params, 300, keep=keep, seed=3)[0])
    assert (ends[0].speed > 0).any()
    same(ends[0], ends[1], False)


def test_an_agent_may_hold_a_signal() -> None:
    """A phase that is set is shown until another one is; whoever waits is counted by link."""
    network = signalised(20.0)
    simulator, params = simulated(network)
    state = travelling(simulator, Demand([[0, 1, 2]], [0] * 40, [0.0] * 40), params, dtype=torch.float64)
    state, _ = simulator.rollout(showing(state, torch.tensor([2])), {}, params, 1500, keep=None)
    links = by_link(network, state)
    assert int(counts(state).left) == 0 and links.halting.tolist() == links.vehicles.tolist()
    assert int(links.queued[0]) + int(links.vehicles[0]) == 40
    state, _ = simulator.rollout(showing(state, torch.tensor([0])), {}, params, 1500, keep=None)
    assert int(counts(state).left) == 40


def test_codes_are_those_of_the_compiled_loops() -> None:
    """They stand twice, because compiled code is kept by what stands beside it alone."""
    assert [getattr(network_loops, k) for k in ("RED", "GREEN", "AMBER", "YIELD")] == [RED, GREEN, AMBER, YIELD]
    loops = network_loops.LED, network_loops.CAME, network_loops.CAME_BEHIND
    assert loops == (junctions.LED, junctions.ENTERED, junctions.ENTERED_BEHIND)


def test_a_network_needs_somebody_who_obeys() -> None:
    """One line says what is missing."""
    simulator = Simulator(signalised(20.0), (IDM(), Brakes()), 0.1)
    with pytest.raises(ValueError, match=r"no effect obeys them\. Add StopLine"):
        travelling(simulator, Demand([[0, 1, 2]], [0], [0.0]), simulator.defaults())


@pytest.mark.parametrize("circle", [True, False])
def test_who_yields_in_a_circle_gets_through(circle: bool) -> None:
    """Of four who come at once, each of whom yields to the one on his right, one goes: who stands does not arrive.

    They stood for ever, on every crossing of right before left, where SUMO's drive on.
    """
    arms = range(4)
    names = [*(f"in{a}" for a in arms), *(f"out{a}" for a in arms), *(f"x{a}" for a in arms)]
    links = {"name": names, "length": [60.0] * 8 + [15.0] * 4, "limit": [14.0] * 12, "inner": [0] * 8 + [1] * 4}
    across = [[(a + 1) % 4, (a + 3) % 4] for a in arms]
    yields = [[1], [2], [3], [0]] if circle else [[1, 3], [2], [3], []]
    moves = {"start": names[:4], "end": names[4:8], "path": [[x] for x in names[8:]], "foes": across, "yields": yields}
    network = Network.from_tables(links, moves)
    assert bool(network.cautions()) is circle
    simulator, params = simulated(network)
    demand = Demand([[a, 8 + a, 4 + a] for a in arms], [0, 1, 2, 3] * 2, [0.0] * 8)
    state = travelling(simulator, [demand], params, dtype=torch.float64)
    state, _ = simulator.rollout(state, {}, params, 900, keep=None)
    assert deadlocked(simulator, state, params).tolist() == [0]
    assert int(counts(state).left) == 8
