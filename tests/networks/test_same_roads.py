"""Links in a row are a lane, links in a circle are a ring: values and gradients, on the torch path and by kernels."""

from __future__ import annotations

from contextlib import nullcontext
from typing import Any

import pytest
import torch
from torch import Tensor

from idm_env import IDM, Brakes, Simulator
from idm_env.backends import off
from idm_env.effects import LinkLimit, StopLine
from idm_env.multilane.junctions import travelling
from idm_env.roads import Lane, Ring
from idm_env.roads.network import Network
from idm_env.roads.network_demand import Demand
from idm_env.types import State

BEGIN = (0.0, 60.0, 100.0)
"""Where three links of a row or a circle begin (m)."""


def simulators(ring: bool) -> tuple[Simulator, Simulator, Demand]:
    """Return a network of three links, the road that it is, and five vehicles on it."""
    length, ends = [60.0, 40.0, 3000.0 if not ring else 110.0], [1, 2, 0] if ring else [1, 2]
    network = Network(("a", "b", "c"), length, [1e3] * 3, [0, 1, 2][: len(ends)], ends)
    demand = Demand([[0, 1, 2] * (12 if ring else 1)], [0] * 5, [0.0] * 5)
    road = Ring(210.0) if ring else Lane()
    on_network = Simulator(network, (IDM(), StopLine(), LinkLimit(), Brakes()), 0.1)
    return on_network, Simulator(road, (IDM(), Brakes()), 0.1), demand


def started(ring: bool, speed: Tensor, first: Tensor) -> tuple[Any, ...]:
    """Return both simulators, with their states and parameters, differentiated by speeds and the first's place."""
    net, plain, demand = simulators(ring)
    place = torch.tensor([130.0, 95.0, 61.0, 30.0, 5.0], dtype=torch.float64) + first
    hop = torch.bucketize(place.detach(), torch.tensor(BEGIN, dtype=torch.float64), right=True) - 1
    params = net.defaults(dtype=torch.float64)
    params["idm"]["time_gap"] = torch.tensor(1.3, dtype=torch.float64, requires_grad=True)
    local = place - torch.tensor(BEGIN, dtype=torch.float64)[hop]
    state = travelling(net, demand, params, hop=hop, position=local, speed=speed, dtype=torch.float64)
    own = {name: params[name] for name in plain.by_name}
    kind = {"circumference": 210.0} if ring else {}
    return net, state, params, plain, plain.state(place, speed, own, **kind), own


def results(end: State, by: list[Tensor]) -> list[Tensor]:
    """Return values, and the gradients of a sum of them."""
    weights = torch.linspace(1.0, 2.0, 5, dtype=torch.float64)
    grads = torch.autograd.grad(((end.speed + 0.1 * end.gap.clamp_max(500.0)) * weights).sum(), by)
    return [end.speed, end.gap, end.accel, *grads]


@pytest.mark.parametrize("ring", [False, True], ids=["lane", "ring"])
@pytest.mark.parametrize("compiled", [False, True], ids=["torch", "kernel"])
def test_links_are_the_road_that_they_make(ring: bool, compiled: bool) -> None:
    """Gaps are state, and where a link begins no driver sees: so values and gradients are the same."""
    speed = torch.tensor([3.0, 8.0, 6.0, 7.0, 9.0], dtype=torch.float64, requires_grad=True)
    first = torch.zeros(5, dtype=torch.float64, requires_grad=True)
    net, state, params, plain, same, own = started(ring, speed, first)
    by = [speed, first, params["idm"]["time_gap"]]
    with nullcontext() if compiled else off():
        end, _ = net.rollout(state, {}, params, 400, keep=None)
    with off():
        expected, _ = plain.rollout(same, {}, own, 400, keep=None)
    assert end.lanes is not None and len(set(end.lanes.lane.tolist())) > (1 if ring else 0)
    if ring:
        assert end.lanes.journeys is not None and int(end.lanes.journeys.hop.min()) >= 3  # a lap and more
    for mine, theirs in zip(results(end, by), results(expected, by), strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-9, atol=1e-9)


def test_a_rollout_without_a_graph_has_the_same_bits() -> None:
    """Rows that run in place do what chains do that are laid out for a graph."""
    net, state, params, *_ = started(True, torch.full((5,), 5.0, dtype=torch.float64), torch.zeros(5).double())
    with_graph, _ = net.rollout(state, {}, params, 123)
    with torch.no_grad():
        without, _ = net.rollout(state, {}, params, 123, keep=None)
    for name in ("position", "speed", "accel", "gap"):
        assert torch.equal(getattr(with_graph, name), getattr(without, name))
