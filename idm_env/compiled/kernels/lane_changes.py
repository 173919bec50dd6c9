"""Decisions about lanes: what drivers wish, printed and compiled once, and what a decision is given and gives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from idm_env.compiled.kernels import lane_change_loops
from idm_env.compiled.kernels.lanes import part_of, starts, static_of
from idm_env.compiled.kernels.printed import HEADER, printed
from idm_env.compiled.kernels.tiles import ROW, Array
from idm_env.compiled.scalar import library
from idm_env.compiled.scalar.graph import Leaf
from idm_env.compiled.scalar.record import Form
from idm_env.compiled.scalar.wishes import HERE, SEARCHED, SIDES, Wishes
from idm_env.roads import Lanes
from idm_env.step import CarFollowingStep
from idm_env.types import Inputs, Params, State


class Decision:
    """The compiled wishes of one simulator: what the rows of its phase are, and where it begins."""

    def __init__(self, wishes: Wishes, title: str) -> None:
        self.slots = wishes.slots
        self._text, self._title = wishes.text(), title
        self._constants = wishes.constants.values

    @lru_cache(maxsize=2)  # noqa: B019  (as long as the process: decisions are cached, too)
    def compiled(self, kind: str) -> tuple[int, Array]:
        """Return the address of the phase in a precision, and its constants."""
        text = HEADER.format(title=self._title, row=ROW, kind=kind) + self._text
        module = library.load("wishes", text)
        return int(module.wish.address), np.array([float(x) for x in self._constants], kind)


def decision(simulator: CarFollowingStep, form: Form) -> Decision | str:
    """Return the compiled decision of a simulator, or why there is none."""
    return printed(_decision, simulator, form, "decisions about lanes are not compiled")


def _decision(simulator: CarFollowingStep, form: Form) -> Decision:
    names = ", ".join(e.name for e in simulator.effects)
    return Decision(Wishes(simulator, form), f"One decision about lanes of {names}, {simulator.integration}.")


class Choices(NamedTuple):
    """Decisions of some rows: which vehicles have new leaders, mergers beside drivers, and the order of lanes.

    ``fresh`` (bool), ``merger`` and ``order`` (slots) have shape ``(rows · n,)``, ``begin`` ``(rows · (lanes + 1),)``.
    """

    fresh: Array
    merger: Array
    order: Array
    begin: Array


class Deciding:
    """Decisions about the lanes of ``rows`` of ``n`` slots, in numbers of a ``kind``."""

    def __init__(self, simulator: CarFollowingStep, rows: int, n: int, kind: Any) -> None:
        road = simulator.road
        assert isinstance(road, Lanes)
        self._rows, self._n, self._road, self._sees = rows, n, road, simulator.sees_mergers
        self._tables = np.array([road.table(name) for name in ("opens", "closes", "stops")], kind)
        self.turns = simulator.turns(n).numpy() if simulator.decides_in_blocks else np.empty(0, np.int64)

    def decide(self, wishes: Decision, world: Any, turn: Sequence[Array], plan: Sequence[Array]) -> Choices | None:
        """Change links in place; None where they are not the order of positions.

        ``world`` are links ``(7, rows · n)``, positions, and presence ``(rows · n,)`` (empty: everybody is there),
        ``turn`` the rows that decide, and their stages; ``plan`` as ``rows_of`` returns it.
        """
        size, lanes, road = self._rows * self._n, self._road.count, self._road
        mergers = np.tile(np.arange(self._n), self._rows if self._sees else 0)
        order, begin = np.empty(size, np.int64), np.empty(self._rows * (lanes + 1), np.int64)
        choices = Choices(np.zeros(size, np.uint8), mergers, order, begin)
        own = self._n, lanes, float(road.ring or 0.0), road.handed == "left", self._tables
        wish = *wishes.compiled(world[1].dtype.name), len(wishes.slots), *choices[:2]
        done = lane_change_loops.decide(*world, len(world[2]) > 0, *turn, *own, *plan, *wish, self.turns, *choices[2:])
        return choices if done else None


KINDS = {**{name: i + 1 for i, name in enumerate(SEARCHED)}, HERE[0]: lane_change_loops.OPENS}
KINDS |= {HERE[1]: lane_change_loops.CLOSES, HERE[2]: lane_change_loops.STOPS}
"""Rows that are searched for instead of read from an array."""


def rows_of(slots: Sequence[Leaf], find: Callable[[int, str], tuple[int, int, int]]) -> tuple[Array, Array]:
    """Return the plan of a phase's rows and whose numbers these are; ``find`` returns an address and its strides."""
    rows, places = [], dict[tuple[int, int], int]()
    for i, slot in enumerate(slots):
        side, name = side_of(slot)
        if name in KINDS:
            rows.append((KINDS[name], side, 0, 0, 0, 0))
            continue
        address, by_row, by_vehicle = find(i, name)
        place = places.setdefault((side, slot.shift), len(places)) if by_vehicle else 0
        rows.append((lane_change_loops.ARRAY, side, place, address, by_row, by_vehicle))
    return np.array(rows, np.int64), np.array(list(places), np.int64).reshape(-1, 2)


def side_of(slot: Leaf) -> tuple[int, str]:
    """Return the side of a slot, 0 for the own lane, and its name there."""
    first, _, rest = slot.name.partition(" ")
    return (SIDES.index(first) + 1, rest) if first in SIDES else (0, slot.name)


def looked_at(simulator: CarFollowingStep, state: State, inputs: Inputs, params: Params, name: str) -> Tensor:
    """Return the numbers of a row of the phase, of a state ``(…, vehicles)`` whose links are up to date."""
    if name in ("led", "leads"):
        assert isinstance(simulator.road, Lanes) and state.lanes is not None
        if simulator.road.ring is not None:
            return torch.ones((), dtype=state.speed.dtype)
        other = state.lanes.leader if name == "led" else state.lanes.follower
        return other != torch.arange(other.shape[-1], device=other.device)
    if name.endswith(" now"):
        return part_of(inputs, name)
    if "." in name or name in ("length", "present"):
        return static_of(simulator, state, params, name)
    return starts(state, (name,))[0]
