"""Routes over a network: along given edges, the quickest, or drawn by shares of turns; and demand by such turns.

A route is links in order, those inside junctions included; where it changes lanes, those beside are in it, too.
"""

import heapq
import math
import zlib
from bisect import bisect
from collections.abc import Mapping, Sequence
from functools import cached_property
from itertools import accumulate, pairwise
from typing import Any

import numpy as np

from idm_env import validation
from idm_env.roads.network import Network, padded

Route = tuple[int, ...]
CHANGE_S, NEVER_S = 1.0, 1e6
"""Cost of a change to the lane beside in the choice of lanes (s), on a long link and on one too short for it."""
BALANCE_S = 5.0
"""Cost of a lane that all have taken before (s), where none has taken that beside."""
STRAIGHT = math.radians(45.0)
MOST_MOVES = 200
"""A route that has not left the network after so many moves is drawn again."""


class Ways:
    """Lanes of every edge, and the moves from every link: its end, its inner links and its row."""

    def __init__(self, network: Network) -> None:
        self.network = network
        self.beside = network.left.tolist(), network.right.tolist()
        self.time = (network.length / network.limit).tolist()
        self.change = np.where(network.cramped, NEVER_S, CHANGE_S * (1.0 + 100.0 / network.length)).tolist()
        self.taken = [0] * len(network.names)
        self.lanes: dict[str, list[int]] = {}
        for link in np.flatnonzero(~network.inner).tolist():
            self.lanes.setdefault(network.edge[link], []).append(link)
        self.moves: list[list[tuple[int, Route, int]]] = [[] for _ in network.names]
        rows = network.start.tolist(), network.end.tolist(), network.path.tolist()
        for move, (start, end, path) in enumerate(zip(*rows, strict=True)):
            self.moves[start].append((end, tuple(link for link in path if link >= 0), move))
        self._trees: dict[str, dict[str, str]] = {}

    def lanes_of(self, edge: str, owner: str) -> list[int]:
        """Return the links of an edge, from right to left. ValueError, for ``owner``, where there is none."""
        if edge not in self.lanes:
            near = validation.nearest(edge, self.lanes)
            raise ValueError(f"{owner}: edge {validation.shown(edge)} has no lane for cars here.{near}")
        return self.lanes[edge]

    def route_along(self, edges: Sequence[str], owner: str) -> Route:
        """Return the route along edges with few changes of lanes, which avoids those that earlier ones have taken.

        It is empty where a link is too short for its changes. ValueError where two edges do not connect.
        """
        routes: dict[int, tuple[float, Route]] = {link: (0.0, (link,)) for link in self.lanes_of(edges[0], owner)}
        for edge, following in pairwise(edges):
            lanes, onward = set(self.lanes_of(following, owner)), dict[int, tuple[float, Route]]()
            taken = 1 + sum(self.taken[link] for link in self.lanes[edge])
            for cost, route in self._on_all_lanes(routes):
                cost += BALANCE_S * self.taken[route[-1]] / taken
                for end, path, _ in self.moves[route[-1]]:
                    if end in lanes and cost < onward.get(end, (math.inf,))[0]:
                        onward[end] = cost, (*route, *path, end)
            if not onward:
                raise ValueError(f"{owner}: edge '{edge}' does not lead to '{following}'. Give edges that connect.")
            routes = onward
        cost, route = min(routes.values())
        for link in route:
            self.taken[link] += 1
        return route if cost < NEVER_S else ()

    def _on_all_lanes(self, routes: Mapping[int, tuple[float, Route]]) -> list[tuple[float, Route]]:
        """Return routes, and with them those that go on to the lanes beside."""
        longer = list(routes.values())
        for side in self.beside:
            for cost, route in routes.values():
                while (lane := side[route[-1]]) >= 0:
                    cost, route = cost + self.change[route[-1]], (*route, lane)
                    longer.append((cost, route))
        return longer

    def quickest(self, stops: Sequence[str], owner: str) -> Route:
        """Return the quickest route at the limits over some edges, as ``route_along``; ValueError for none."""
        self.lanes_of(stops[0], owner)
        edges = [stops[0]]
        for start, end in pairwise(stops):
            self.lanes_of(end, owner)
            tree, leg = self._tree(start), [end]
            while leg[-1] != start:
                if leg[-1] not in tree:
                    raise ValueError(f"{owner}: no way leads from edge '{start}' to '{end}'. Give edges that connect.")
                leg.append(tree[leg[-1]])
            edges += leg[-2::-1]
        return self.route_along(edges, owner)

    def _tree(self, origin: str) -> dict[str, str]:
        """Return for every edge that can be reached the edge before it (Dijkstra)."""
        if origin not in self._trees:
            tree: dict[str, str] = {}
            best, heap = {origin: 0.0}, [(0.0, origin)]
            while heap:
                cost, edge = heapq.heappop(heap)
                for link in self.lanes[edge] if cost <= best[edge] else ():
                    for end, path, _ in self.moves[link]:
                        following, total = self.network.edge[end], cost + sum(self.time[k] for k in (*path, end))
                        if total < best.get(following, math.inf):
                            best[following], tree[following] = total, edge
                            heapq.heappush(heap, (total, following))
            self._trees[origin] = tree
        return self._trees[origin]

    # -- routes by shares of turns -----------------------------------------------------------------------------------

    @cached_property
    def entries(self) -> dict[str, int]:
        """The right lane of every edge to which none leads."""
        ends = {end for moves in self.moves for end, *_ in moves}
        return {edge: lanes[0] for edge, lanes in self.lanes.items() if not ends & {*lanes}}

    @cached_property
    def sides(self) -> list[int]:
        """Whether each move turns left (0), goes on (1) or turns right (2), by the shapes of its links."""
        network = self.network
        angles = [
            _heading(network.shape[end], 0) - _heading(network.shape[start], -2) if network.shape else 0.0
            for start, end in zip(network.start, network.end, strict=True)
        ]
        turns = ((angle + math.pi) % (2.0 * math.pi) - math.pi for angle in angles)
        return [0 if turn > STRAIGHT else 2 if turn < -STRAIGHT else 1 for turn in turns]

    def _turns(self, edge: str) -> dict[str, int]:
        onward = (move for lane in self.lanes[edge] for move in self.moves[lane])
        return {self.network.edge[end]: self.sides[move] for end, _, move in onward}

    def draw_route(self, edge: str, shares: Sequence[float], random: np.random.Generator) -> Route:
        """Return a route from an edge to where no move leads on. ValueError where none is seen."""
        for _ in range(100):
            edges = [edge]
            while (turns := self._turns(edges[-1])) and len(edges) < MOST_MOVES:
                sides = [*turns.values()]
                weights = [shares[side] / sides.count(side) + 1e-9 for side in sides]
                edges.append([*turns][bisect(sums := list(accumulate(weights)), random.random() * sums[-1])])
            if not turns and (route := self.route_along(edges, f"a way from '{edge}'")):
                return route
        raise ValueError(f"no way leads out of the network from '{edge}'. Give vehicles routes.")


def _heading(points: np.ndarray, piece: int) -> float:
    """Return the heading of a line ``(k, 2)`` in its first (0) or last (−2) piece (rad)."""
    return math.atan2(*(points[piece + 1] - points[piece])[::-1]) if len(points) > 1 else 0.0


def others(network: Network, routes: Any) -> np.ndarray:
    """Return where else routes ``(R, H)`` go on from the lanes beside over the same roads: ``Journeys.others``."""
    if not (network.left >= 0).any():
        return np.zeros((0,), np.int32)
    numbers, places = dict[tuple[str, int], int](), dict[tuple[int, int], int]()
    links, wide = np.ravel(routes).tolist(), np.shape(routes)[1]
    edge, way, ways = "", 0, [0] * len(links)
    for place in reversed(range(len(links))):
        edge, way = (edge, way) if (place + 1) % wide else ("", 0)
        if (link := links[place]) < 0 or network.inner[link]:
            continue
        if network.edge[link] != edge:
            edge = network.edge[link]
            way = numbers.setdefault((edge, way), len(numbers) + 1)
            places[link, way] = place
        ways[place] = way
    lanes = np.stack((network.left, network.right), 1).tolist()
    pairs = zip(links, ways, strict=True)
    return np.array([[places.get((k, way), -1) for k in lanes[i]] for i, way in pairs], np.int32)


def keyed(seed: int, name: str) -> np.random.Generator:
    """Return random numbers by a counter under the key of a seed and a name: no other name changes them."""
    return np.random.Generator(np.random.Philox(key=[seed, zlib.crc32(name.encode())]))


def draw_turns(
    network: Network, per_hour: float | Mapping[str, float], seconds: float, seed: int, shares: Sequence[float]
) -> dict[str, Any]:
    """Return columns of ``Demand``: Poisson arrivals on entries for ``seconds`` s, routes by shares of turns.

    Several moves to one side are equally likely, and a share without a move goes to the others. ValueError for a rate
    below 0, an edge that is no entry, or no share above 0.
    """
    ways = Ways(network)
    rates = per_hour if isinstance(per_hour, Mapping) else dict.fromkeys(ways.entries, per_hour)
    validation.in_interval("seconds", float(seconds), 0.0, 1e6, "s")
    if len(shares) != 3 or not (min(shares) >= 0.0 and 0.0 < sum(shares) < math.inf):
        raise ValueError(f"shares = {tuple(shares)} must be three numbers from 0 on: left, straight on, right.")
    numbers: dict[Route, int] = {}
    route, depart = list[int](), list[float]()
    for edge, rate in rates.items():
        validation.one_of("edge", edge, ways.entries)
        validation.in_interval(f"per_hour of {edge}", float(rate), 0.0, 1e5, "1/h")
        random = keyed(seed, edge)
        for time in arrivals(rate / 3600.0, 0.0, seconds, random):
            links = ways.draw_route(edge, shares, random)
            route.append(numbers.setdefault(links, len(numbers)))
            depart.append(time)
    return {"routes": padded(list(numbers)), "route": route, "depart": depart}


def arrivals(rate: float, begin: float, end: float, random: np.random.Generator) -> list[float]:
    """Return the times of a Poisson process of some rate (1/s) between two times (s), rising."""
    return np.sort(random.uniform(begin, end, random.poisson(rate * max(end - begin, 0.0)))).tolist()
