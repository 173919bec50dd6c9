"""What holds on every network at every event, found out from states alone, without a look at the compiled loops."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from idm_env.multilane.junctions import counts, guided, journeys_of
from idm_env.roads.network import AMBER, LETTERS, RED, YIELD, Array, Network
from idm_env.simulator import Simulator
from idm_env.types import State


class Part(NamedTuple):
    """A stretch of a link that a vehicle takes: row, link, from and to (m), vehicle; a column each."""

    row: Array
    link: Array
    begin: Array
    end: Array
    vehicle: Array


def shown(network: Network, seconds: float) -> Array:
    """Return what every move is shown at a time, by the plans ``(M,)``."""
    now = []
    for plan in network.plans:
        ends = np.cumsum(plan.durations)
        now.append(plan.states[int(np.searchsorted(ends, (seconds - plan.offset + 1e-6) % ends[-1], side="right"))])
    return np.array([
        YIELD if s < 0 else LETTERS[now[s][i]]
        for s, i in zip(network.signal.tolist(), network.index.tolist(), strict=True)
    ])  # fmt: skip


def stretches(network: Network, state: State) -> Part:
    """Return what vehicles take of links, sorted by row, link and place."""
    ways, here = journeys_of(state), state.present
    assert here is not None
    row, vehicle = np.nonzero(here.numpy() > 0)
    way, hop = ways.routes.numpy()[ways.route.numpy()[row, vehicle]], ways.hop.numpy()[row, vehicle]
    front, left = (x.double().numpy()[row, vehicle] for x in (state.position, state.length))
    parts: list[tuple[Array, ...]] = []
    while len(row):
        link = way[np.arange(len(row)), hop]
        parts.append((row, link, front - left, front, vehicle))
        left, hop = left - front, hop - 1
        some = (left > 0.0) & (hop >= 0)
        row, vehicle, way, hop, left = (x[some] for x in (row, vehicle, way, hop, left))
        front = network.length[way[np.arange(len(row)), hop]]
    part = Part(*map(np.concatenate, zip(*parts, strict=True))) if parts else Part(*np.zeros((5, 0), int))
    order = np.lexsort((part.vehicle, part.end, part.begin, part.link, part.row))
    return Part(*(x[order] for x in part))


def broken(simulator: Simulator, before: State, after: State) -> list[str]:
    """Return what is wrong in a state after an event, with the one half a second before it; both are ``(rows, n)``."""
    network = simulator.road
    assert isinstance(network, Network) and after.lanes is not None
    part, wrong = stretches(network, after), list[str]()
    beside = (part.row[1:] == part.row[:-1]) & (part.link[1:] == part.link[:-1])
    over = beside & (part.begin[1:] < part.end[:-1] - 1e-2) & (part.vehicle[1:] != part.vehicle[:-1])
    for k in np.flatnonzero(over):
        who, depth = part.vehicle[k : k + 2].tolist(), part.end[k] - part.begin[k + 1]
        wrong.append(f"row {part.row[k]}: {who} overlap by {depth:.2f} m on {network.names[part.link[k]]}")
    wrong += _met(network, part, after.speed.shape) + _crossed(simulator, before, after)
    due, in_there, left, queued = counts(after)
    late = (journeys_of(after).due <= after.clock).sum(-1)
    if not ((due == late) & (due == in_there + left + queued)).all():
        wrong.append("books do not balance")
    return wrong


def _met(network: Network, part: Part, shape: tuple[int, ...]) -> list[str]:
    """Return which vehicles are on moves that are foes."""
    moves, (rows, n) = len(network.start), shape
    inner = network.move_of[part.link] >= 0
    cells = (part.row[inner] * moves + network.move_of[part.link[inner]]) * n + part.vehicle[inner]
    cells = np.unique(cells)
    place, vehicle = cells // n, cells % n
    number = np.bincount(place, minlength=rows * moves)
    move, row = place % moves, place // moves
    foe = network.foes[move]
    other = row[:, None] * moves + foe
    own = np.isin(other * n + vehicle[:, None], cells)
    met = (foe >= 0) & (number[other] - own > 0)
    return [
        f"row {row[i]}: {vehicle[i]} is on {network.move_name(move[i])}, others on {network.move_name(foe[i, j])}"
        for i, j in zip(*np.nonzero(met), strict=True)
    ]


def _crossed(simulator: Simulator, before: State, after: State) -> list[str]:
    """Return who has begun to cross in red or amber although he could have stopped.

    Whoever waited for a gap in green counts as inside (``told`` 2), and clears the junction.
    """
    network, ways, was = simulator.road, journeys_of(after), journeys_of(before)
    assert isinstance(network, Network) and before.present is not None
    rules = guided(simulator)["stop"]
    # Nobody comes to another link and to the lane beside in one event.
    row, i = np.nonzero(((ways.hop > was.hop) & (ways.route == was.route) & (before.present > 0)).numpy())
    route, hop = ways.routes.numpy()[was.route.numpy()[row, i]], was.hop.numpy()[row, i]
    link, ahead = (route[np.arange(len(row)), k] for k in (hop, hop + 1))
    position, speed = (x.double().numpy()[row, i] for x in (before.position, before.speed))
    room, move = network.length[link] - position, network.move_of[ahead]
    lights, stops = shown(network, int(before.step) * simulator.dt)[move], was.told.numpy()[row, i] < 2
    wrong = ((lights == RED) | (lights == AMBER)) & stops
    wrong &= (move >= 0) & (network.path[move, 0] == ahead) & (speed * speed < 2.0 * rules.most_decel * room - 1e-3)
    return [
        f"row {row[k]}: {i[k]} passed {network.move_name(move[k])} in red, at {speed[k]:.1f} m/s and {room[k]:.1f} m"
        for k in np.flatnonzero(wrong)
    ]
