"""What holds on every network at every event, found out from states alone, without a look at the compiled loops."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from idm_env.multilane.junctions import counts, guided
from idm_env.roads.network import AMBER, LETTERS, RED, YIELD, Network
from idm_env.simulator import Simulator
from idm_env.types import State


def shown(network: Network, seconds: float) -> list[int]:
    """Return what every move is shown at a time, by the plans."""
    now = []
    for plan in network.plans:
        ends = np.cumsum(plan.durations)
        now.append(plan.states[int(np.searchsorted(ends, (seconds - plan.offset + 1e-6) % ends[-1], side="right"))])
    return [
        YIELD if s < 0 else LETTERS[now[s][i]]
        for s, i in zip(network.signal.tolist(), network.index.tolist(), strict=True)
    ]


def stretches(network: Network, state: State, row: int) -> dict[int, list[tuple[float, float, int]]]:
    """Return what is taken of each link: (from, to, by whom), in m."""
    taken: dict[int, list[tuple[float, float, int]]] = {}
    links = state.lanes
    assert links is not None and links.journeys is not None and state.present is not None
    ways, routes = links.journeys, links.journeys.routes
    for i in np.flatnonzero(state.present[row].numpy() > 0):
        front, left, hop = float(state.position[row, i]), float(state.length[row, i]), int(ways.hop[row, i])
        while left > 0.0 and hop >= 0:
            k = int(routes[int(ways.route[row, i]), hop])
            taken.setdefault(k, []).append((front - left, front, int(i)))
            left -= front
            hop -= 1
            if hop >= 0:
                front = float(network.length[int(routes[int(ways.route[row, i]), hop])])
    return taken


def broken(simulator: Simulator, before: State, after: State) -> list[str]:
    """Return what is wrong in a state after an event, with the one half a second before it; both are ``(rows, n)``."""
    network, wrong = simulator.road, list[str]()
    assert isinstance(network, Network)
    links, was, now = after.lanes, before.lanes, after.present
    assert links is not None and was is not None and links.journeys and was.journeys and now is not None
    first = {int(k): m for m, k in enumerate(network.path[:, 0]) if k >= 0}
    lights = shown(network, int(before.step) * simulator.dt)
    for row in range(len(after.speed)):
        taken = stretches(network, after, row)
        for k, parts in taken.items():
            parts.sort()
            for (_, end, i), (begin, _, j) in pairwise(parts):
                if begin < end - 1e-2 and i != j:
                    wrong.append(f"row {row}: {i} and {j} overlap by {end - begin:.2f} m on {network.names[k]}")
        inside: dict[int, set[int]] = {}
        for k, parts in taken.items():
            if network.move_of[k] >= 0:
                inside.setdefault(int(network.move_of[k]), set()).update(i for *_, i in parts)
        for m, who in inside.items():
            for f in network.foes[m][network.foes[m] > m]:
                if inside.get(int(f), set()) - who:
                    wrong.append(f"row {row}: {who} and {inside[int(f)]} on foes {m} and {f}")
        wrong += _crossed(simulator, before, after, row, first, lights)
    due, in_there, left, queued = counts(after)
    late = (links.journeys.due <= int(after.step)).sum(-1)
    if not ((due == late) & (due == in_there + left + queued)).all():
        wrong.append("books do not balance")
    return wrong


def _crossed(
    simulator: Simulator, before: State, after: State, row: int, first: dict[int, int], lights: list[int]
) -> list[str]:
    """Return who has begun to cross in red or amber although he could have stopped."""
    network, links, was = simulator.road, after.lanes, before.lanes
    assert isinstance(network, Network) and links is not None and was is not None and links.journeys and was.journeys
    wrong, most = [], guided(simulator)["stop"].most_decel
    moved = (links.journeys.hop[row] > was.journeys.hop[row]) & (before.present[row] > 0)  # type: ignore[index]
    for i in np.flatnonzero(moved.numpy()):
        hop, route = int(was.journeys.hop[row, i]), links.journeys.routes[int(was.journeys.route[row, i])]
        room, speed = network.length[int(route[hop])] - float(before.position[row, i]), float(before.speed[row, i])
        m = first.get(int(route[hop + 1]))
        if m is not None and lights[m] in (RED, AMBER) and speed * speed < 2.0 * most * room - 1e-3:
            wrong.append(f"row {row}: {i} passed {network.move_name(m)} in red, at {speed:.1f} m/s and {room:.1f} m")
    return wrong
