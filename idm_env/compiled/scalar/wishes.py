"""Records a decision about lanes on scalars, and prints it: what drivers would want beside, and which side is better.

``beside``, every effect's ``change`` and ``roads.adjacent.preferred`` run once, on names. A name of another lane
is ``left speed`` or ``right speed``; there 0 is the follower that a driver would have, 1 the leader, and so on up and
down that lane. On the driver's own lane 0 is himself, as in every recording.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch

from idm_env.compiled.scalar.graph import Graph, Leaf, Node, inputs_of
from idm_env.compiled.scalar.record import Form, Parameters, SeenRoad, inputs_of_form, state_of
from idm_env.compiled.scalar.scalar import Scalar, Untraceable, value_of
from idm_env.compiled.scalar.source import Constants, Write, body, function, row
from idm_env.multilane.incentives import lane_scene, wished
from idm_env.roads.adjacent import Preference, Side, Sideways, is_open_beside, preferred
from idm_env.roads.chains import Chains
from idm_env.roads.lanes import Lanes
from idm_env.step import CarFollowingStep
from idm_env.types import State, Wish

SIDES = ("left", "right")
SEARCHED = ("lane", "ahead", "behind", "laps ahead", "laps behind", "opens", "closes", "stops")
"""What a loop finds of the lane on a side of every vehicle: whether there is such a lane, a leader and a follower on
it; laps to add to positions (m); and where the lane may be entered, left, and ends (m)."""
HERE = ("here opens", "here closes", "ends")
"""The same three places of a driver's own lane."""


class Where(NamedTuple):
    """A vehicle by its place: on a side (or '' for the own lane), so many vehicles up the lane."""

    side: str
    up: int


@dataclass(frozen=True)
class _Sides(SeenRoad, Sideways):
    """A road on which places in lanes stand for slots."""

    def at(self, x: Any, slot: Where) -> Any:
        def moved(read: Leaf) -> Leaf:
            name = f"{slot.side} {read.name}".strip()
            return read if read.name == "step" else Leaf(name, read.shift + slot.up)

        if not isinstance(x, Scalar):
            return x
        return Scalar(self.graph, self.graph.renamed(x.node, moved))

    def beyond(self) -> Where:
        return Where("", 2)

    def read(self, name: str) -> Any:
        return Scalar(self.graph, self.graph.input(name))

    def goes_on(self) -> Any:
        return self.read("ends") - self.read("position")

    def side(self, name: str, state: State) -> Side:
        lane, ahead, behind, to_leader, to_follower, opens, closes, stops = (
            self.read(f"{name} {what}") for what in SEARCHED
        )
        exists = lane > 0
        for places in ((self.read("here opens"), self.read("here closes")), (opens, closes)):
            exists = exists & is_open_beside(state.position, state.length, *places)
        around = Where(name, 1), Where(name, 0), ahead > 0, behind > 0, to_leader, to_follower
        return self.look(state, exists, *around, stops - state.position)


def _or_nan(sides: tuple[Side, Side], wish: Wish, blocked: Any) -> Any:
    """Return who is blocked, NaN where a wish for a side that is there and free is."""
    for side, *parts in zip(sides, wish[:2], wish[2:4], strict=True):
        free = side.exists & (side.gap > 0) & (side.back_gap > 0)
        for part in parts:
            blocked = torch.where(free & (part != part), torch.nan, blocked)
    return blocked


class Wishes:
    """A recorded decision: slots that it reads, and its text; ``Untraceable`` where an effect cannot be recorded."""

    def __init__(self, simulator: CarFollowingStep, form: Form) -> None:
        road = simulator.road
        assert isinstance(road, Lanes)
        graph = Graph()
        view = _Sides(Chains(road.closed), graph)
        stepping = CarFollowingStep(view, simulator.effects, simulator.dt, simulator.integration)
        params, state = Parameters(stepping, graph), state_of(form, graph)
        inputs: Mapping[str, Any] = inputs_of_form(form, graph)
        try:
            left, right = (view.side(name, state) for name in SIDES)
            scene = lane_scene(stepping, view, (left, right), state, inputs, params)  # type: ignore[arg-type]
            wish = wished(stepping, scene, params)
            preference = preferred(left, right, wish, road.handed == "left")  # type: ignore[arg-type]
            if graph.suspects:  # effects of the user's own: their NaN is told by who is blocked
                preference = preference._replace(blocked=_or_nan((left, right), wish, preference.blocked))
            # Who signals is asked for only where somebody looks.
            outputs = preference if simulator.sees_mergers else preference[:-1]
            self.outputs: tuple[Node, ...] = tuple(value_of(graph, x) for x in outputs)
        except Untraceable:
            raise
        except Exception as error:  # as in ``record``
            raise Untraceable(
                f"effect '{graph.note}' does what cannot be recorded: {' '.join(str(error).split())}"
            ) from error
        self.slots: tuple[Leaf, ...] = tuple(inputs_of(self.outputs))
        self.rows = len(self.slots) + len(self.outputs)
        self.constants = Constants()

    def text(self) -> str:
        """Return rows and the one phase as text; constants are complete afterwards."""
        places = {slot: f"{i} * ROW" for i, slot in enumerate(self.slots)}
        names = {slot: row(slot) for slot in self.slots}
        results = [f"BEST_{name.upper()}" for name in Preference._fields[: len(self.outputs)]]
        lines = [f"{names[slot]} = {place}" for slot, place in places.items()]
        lines += [f"{name} = {len(places) + i} * ROW" for i, name in enumerate(results)]
        writes = [Write(f"w[{name} + j]", node) for name, node in zip(results, self.outputs, strict=True)]
        content = body(writes, lambda slot: f"w[{names[slot]} + j]", self.constants)
        return "\n".join([*lines, "", "", function("wish", "What every driver would do.", content, "exact")])
