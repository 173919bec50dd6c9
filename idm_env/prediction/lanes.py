"""Lanes as a graph: which follow which, where an agent is on them, and the routes that lie ahead.

Shapes: points are ``[k, 2]`` (m), arc lengths and headings ``[k]`` (m, rad).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from idm_env.data.scenario import MapLane

JOIN_M = 1.5
"""A lane that begins this near to another's end follows it, where the file does not say what follows (m)."""
JOIN_TURN = np.pi / 4
"""… and whose direction differs by less than this (rad)."""
FARTHEST_M = 2.5
"""An agent farther than this from a centre line is not on that lane (m)."""
LARGEST_TURN = np.pi / 3
"""An agent that points elsewhere by more than this does not travel on that lane (rad)."""
MOST_ROUTES = 8
SPACING_M = 1.0


def turn(angle: np.ndarray | float) -> np.ndarray:
    """Return an angle in [−π, π) (rad)."""
    return (np.asarray(angle) + np.pi) % (2 * np.pi) - np.pi


@dataclass(frozen=True, eq=False)
class Route:
    """A centre line [M, 2] about every metre, its arc length [M] (m), heading and curvature [M] (rad, 1/m).

    ``begin`` is the arc length at which the agent is, ``lateral`` its distance to the left of the line (m), ``weight``
    how plausible the route is before any speed is looked at, ``limit`` the speed limit (m/s, NaN where unknown),
    ``chain`` the lanes that it follows.
    """

    line: np.ndarray
    length: np.ndarray
    heading: np.ndarray
    curvature: np.ndarray
    begin: float
    lateral: float
    weight: float
    limit: float
    chain: tuple[int, ...] = ()

    def lift(self, along: np.ndarray, lateral: np.ndarray) -> np.ndarray:
        """Return the points [..., 2] at arc lengths and lateral distances; straight on beyond the line's end."""
        last = self.length[-1]
        inside = np.clip(along, 0.0, last)
        x, y = (np.interp(inside, self.length, self.line[:, i]) for i in (0, 1))
        heading = np.interp(inside, self.length, np.unwrap(self.heading))
        beyond = along - inside
        c, s = np.cos(heading), np.sin(heading)
        return np.stack([x + beyond * c - lateral * s, y + beyond * s + lateral * c], axis=-1)

    def locate(self, point: np.ndarray) -> tuple[float, float, float]:
        """Return arc length, lateral distance (m) and heading (rad) of the line where it is nearest to a point."""
        return nearest(self.line, self.length, point)


def nearest(line: np.ndarray, length: np.ndarray, point: np.ndarray) -> tuple[float, float, float]:
    """Return arc length, distance to the left (m) and heading (rad) of a line where it is nearest to a point."""
    begin, step = line[:-1], np.diff(line, axis=0)
    square = np.maximum((step * step).sum(1), 1e-12)
    share = np.clip(((point - begin) * step).sum(1) / square, 0.0, 1.0)
    apart = point - (begin + share[:, None] * step)
    segment = int(np.argmin((apart * apart).sum(1)))
    heading = float(np.arctan2(step[segment, 1], step[segment, 0]))
    lateral = float(-np.sin(heading) * apart[segment, 0] + np.cos(heading) * apart[segment, 1])
    return float(length[segment] + share[segment] * (length[segment + 1] - length[segment])), lateral, heading


def arc_length(line: np.ndarray) -> np.ndarray:
    """Return the arc length at every point of a line (m)."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])


class LaneGraph:
    """The lanes of a scene and their successors: by the file, or by ends that meet in one direction."""

    def __init__(self, lanes: Sequence[MapLane]) -> None:
        self.lanes = {lane.id: lane for lane in lanes if arc_length(lane.line)[-1] > 0.1}
        self.lengths = {key: arc_length(lane.line) for key, lane in self.lanes.items()}
        self.exits = {
            key: tuple(e for e in (lane.exits if lane.exits is not None else self._meeting(lane)) if e in self.lanes)
            for key, lane in self.lanes.items()
        }

    def _meeting(self, lane: MapLane) -> tuple[int, ...]:
        end, along = lane.line[-1], lane.line[-1] - lane.line[-2]
        lanes = []
        for other in self.lanes.values():
            if other.id == lane.id or np.hypot(*(other.line[0] - end)) > JOIN_M:
                continue
            ahead = other.line[1] - other.line[0]
            if abs(turn(np.arctan2(ahead[1], ahead[0]) - np.arctan2(along[1], along[0]))) < JOIN_TURN:
                lanes.append(other.id)
        return tuple(lanes)

    def lanes_at(
        self, point: np.ndarray, heading: float, *, bike: bool = False
    ) -> list[tuple[int, float, float, float]]:
        """Return (lane, arc length, lateral, weight) of every lane that an agent may be on, the likeliest first.

        The weight falls with the distance from the centre line (deviation 0.8 m) and the difference of direction
        (0.25 rad); lanes for bicycles are for cyclists only.
        """
        candidates = []
        for key, lane in self.lanes.items():
            if lane.bike and not bike:
                continue
            along, lateral, direction = nearest(lane.line, self.lengths[key], point)
            off = abs(float(turn(direction - heading)))
            # beyond an end of the line the lateral distance is no measure: there the point is off the lane
            place = lane.line[0] if along <= 0.0 else lane.line[-1] if along >= self.lengths[key][-1] else None
            distance = abs(lateral) if place is None else float(np.hypot(*(point - place)))
            if distance <= FARTHEST_M and off <= LARGEST_TURN:
                weight = float(np.exp(-0.5 * (distance / 0.8) ** 2 - 0.5 * (off / 0.25) ** 2))
                candidates.append((key, along, lateral, weight))
        return sorted(candidates, key=lambda item: -item[3])

    def routes(self, point: np.ndarray, heading: float, reach: float, *, bike: bool = False) -> list[Route]:
        """Return the routes that lie ahead of an agent for ``reach`` metres, the likeliest first, at most eight.

        Every branch is followed; turns are taken to be half as likely as going straight on.
        """
        candidates: list[tuple[float, tuple[int, ...], float, float]] = []
        for key, along, lateral, weight in self.lanes_at(point, heading, bike=bike)[:4]:
            for chain in self._chains(key, along + reach):
                candidates.append((weight * self._straightness(chain, along), chain, along, lateral))
        candidates.sort(key=lambda item: -item[0])
        routes: list[Route] = []
        for weight, chain, along, lateral in candidates:
            route = self._route(chain, along, lateral, weight)
            if route is not None and not any(_same(route, other, reach) for other in routes):
                routes.append(route)
            if len(routes) == MOST_ROUTES:
                break
        return routes

    def _chains(self, key: int, reach: float) -> list[tuple[int, ...]]:
        chains: list[tuple[int, ...]] = []
        open_chains: list[tuple[tuple[int, ...], float]] = [((key,), float(self.lengths[key][-1]))]
        while open_chains and len(chains) < 4 * MOST_ROUTES:
            chain, length = open_chains.pop(0)
            exits = [e for e in self.exits[chain[-1]] if e not in chain]
            if length >= reach or not exits:
                chains.append(chain)
            else:
                open_chains += [((*chain, e), length + float(self.lengths[e][-1])) for e in exits]
        return chains

    def _straightness(self, chain: tuple[int, ...], along: float) -> float:
        total = 1.0
        for key, after in pairwise(chain):
            if len(self.exits[key]) > 1:
                line = self.lanes[after].line
                first, last = line[1] - line[0], line[-1] - line[-2]
                change = abs(float(turn(np.arctan2(last[1], last[0]) - np.arctan2(first[1], first[0]))))
                total *= 0.5 if change > np.pi / 6 else 1.0
        return total

    def _route(self, chain: tuple[int, ...], along: float, lateral: float, weight: float) -> Route | None:
        line = np.concatenate([self.lanes[key].line for key in chain])
        line = line[np.concatenate([[True], np.hypot(*np.diff(line, axis=0).T) > 0.05])]
        if len(line) < 2:
            return None
        length = arc_length(line)
        ticks = np.linspace(0.0, length[-1], max(3, int(length[-1] / SPACING_M) + 1))
        smooth = np.stack([np.interp(ticks, length, line[:, i]) for i in (0, 1)], axis=1)
        heading = np.unwrap(np.arctan2(*np.gradient(smooth, axis=0).T[::-1]))
        width = min(5, len(ticks))
        padded = np.pad(np.gradient(heading, ticks), width // 2, mode="edge")
        curvature = np.convolve(padded, np.full(width, 1 / width), mode="valid")[: len(ticks)]
        limit = self.lanes[chain[0]].speed_limit
        return Route(smooth, ticks, heading, curvature, along, lateral, weight, limit, chain)


def _same(one: Route, other: Route, reach: float) -> bool:
    """Tell whether two routes stay within a metre of each other over the reach."""
    ahead = np.linspace(0.0, reach, 12)
    apart = one.lift(one.begin + ahead, np.zeros(12)) - other.lift(other.begin + ahead, np.zeros(12))
    return bool((np.hypot(*apart.T) < 1.0).all())
