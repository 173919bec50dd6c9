"""Worlds of a batch as arrays: leaves by name, blocks in which they lie, and tables of addresses for loops over rows.

Shapes: worlds are blocks ``[rows · vehicles]`` of every leaf; outputs have rows first: ``[rows, …]``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from ctypes import addressof, c_char
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from idm_env.compiled.kernels.rows import RowFunction
from idm_env.delay_buffer import PAST
from idm_env.tasks import EnvState
from idm_env.types import LINKS, State, Trips

Array = np.ndarray
Group = tuple[str, Sequence[str], int]
"""Arrays that lie one after another: what their names begin with, their names, and the bytes of each."""
WHOLE = (*(f"links_{n}" for n in LINKS), "trips_entered", "trips_left")
"""Whole numbers of every vehicle that steps change, in the order in which they lie."""


class Layout(NamedTuple):
    """Where a world lies: numbers of every vehicle that steps change are ``blocks`` of one array, one after another.

    ``still`` are the arrays of all else, and ``version`` counts how often one was replaced by another.
    """

    blocks: tuple[str, ...]
    still: dict[str, Array]
    version: int


class Frame:
    """Worlds at one moment, where they lie: blocks, the steps of all rows, and on several lanes whole numbers.

    ``whole`` has shape ``(WHOLE, rows · vehicles)``; ``at`` and ``clock_at`` are where blocks and steps begin.
    """

    def __init__(self, blocks: Tensor, clock: Array, whole: Array | None = None) -> None:
        self.blocks, self.clock, self.whole = blocks, clock, whole
        self.at, self.clock_at = blocks.data_ptr(), address(clock)
        self.views: tuple[Any, ...] = None, None, None
        """Tensors that look at them, behind the layout and the whole numbers of which they were made."""

    def take(self, other: Frame) -> None:
        """Take over other worlds, where these lie."""
        self.blocks.copy_(other.blocks.detach())
        self.clock[:] = other.clock
        if self.whole is not None:
            self.whole[:] = other.whole


@dataclass(slots=True)
class Moment:
    """One step of a batch: all that its loops were given, so that its adjoint can be computed."""

    clock: Array
    action: Array | None
    live: Array | None
    normals: Mapping[str, Array] | None
    at: int
    past: Array
    newest: int
    bound: Any = None
    whole: Array | None = None
    """Whole numbers ``(WHOLE, vehicles)`` before the step, on a road of several lanes."""
    crossing: Any = None
    """What became of them (``lane_transition.Crossing``)."""
    spare: Array | None = None
    """Where they are put, where memory stays."""
    looks: int = 0
    """After how many further steps somebody looks at what is seldom told, and again with every action."""
    given: dict[str, int] = field(default_factory=dict)
    """The addresses of what the step's loops were given beside its worlds."""
    begins: tuple[int, ...] = ()
    """Where worlds begin, before the step and after it; the caller keeps their memory."""


class RowTable:
    """Argument table of a compiled row function: constant addresses, arrays that change per step, addresses by name."""

    def __init__(self, loops: RowFunction, still: Mapping[str, Array], groups: Sequence[Group]) -> None:
        self._stays = loops.table(still)
        self._given = {n: loops.place(n) for n in (*loops.needs, *loops.outs) if n not in still}
        self._groups = [self._within(*group) for group in groups]
        self._laid: dict[Any, tuple[Array, int]] = {}

    def _within(self, prefix: str, names: Sequence[str], pitch: int) -> tuple[Array, Array]:
        places = {i: self._given.pop(prefix + n) for i, n in enumerate(names) if prefix + n in self._given}
        return np.array(list(places.values()), np.int64), np.array(list(places), np.int64) * pitch

    def filled(self, given: Mapping[str, Any], *begins: Any) -> Array:
        """Return the addresses for one call, or for some: where groups begin, and what is given, is one a call then."""
        several = isinstance(begins[0], np.ndarray)
        cells = np.repeat(self._stays[:, None], len(begins[0]), 1) if several else self._stays.copy()
        for (places, offsets), begin in zip(self._groups, begins, strict=True):
            cells[places] = (offsets[:, None] if several else offsets) + begin
        for name, place in self._given.items():
            cells[place] = given[name]
        return cells.T.copy() if several else cells

    def laid(self, key: Any, lay: Callable[[], tuple[Any, ...]], moving: Mapping[str, Any]) -> tuple[Array, int]:
        """Return the addresses for one call, or for some, and where they lie, until the next call.

        ``lay`` returns what ``filled`` takes; a ``key`` is laid out once, and later only what is ``moving`` is put in.
        Without a key all is laid out anew.
        """
        if key is None or key not in self._laid:
            if len(self._laid) >= 128:
                self._laid.clear()
            cells = self.filled(*lay())
            self._laid[key] = cells, address(cells)
        held = self._laid[key]
        for name, x in moving.items():
            if name in self._given:
                held[0][..., self._given[name]] = x
        return held


class Room:
    """Arrays of outputs of loops that are taken together: one piece of memory for each of their types."""

    def __init__(self, loops: RowFunction, rows: int, names: Sequence[str]) -> None:
        self._sizes: dict[Any, int] = {}
        self._at: list[tuple[str, Any, int, tuple[int, ...]]] = []
        for name in names:
            kind, shape = np.dtype(loops.types[name]), (rows, *loops.shapes[name])
            begin = self._sizes.get(kind, 0)
            self._at.append((name, kind, begin * kind.itemsize, shape))
            self._sizes[kind] = begin + math.prod(shape)

    @cached_property
    def arrays(self) -> dict[str, Array]:
        """Arrays that are filled again and again, by name."""
        return {n: x[0] for n, x in self.take(1).items()}

    def take(self, steps: int) -> dict[str, Array]:
        """Return fresh arrays by name, with ``steps`` as their first dimension."""
        memory = {kind: np.empty(size * steps, kind) for kind, size in self._sizes.items()}
        return {n: np.ndarray((steps, *shape), kind, memory[kind], begin * steps) for n, kind, begin, shape in self._at}


def named(world: EnvState) -> dict[str, Tensor]:
    """Return the tensors of a world by names that can stand in a program; the past is not among them."""
    state = world.state
    leaves = {f"state_{n}": x for n, x in zip(State._fields, state, strict=True) if isinstance(x, Tensor)}
    shape = state.speed.shape
    leaves |= {f"memory_{n}": x.expand(shape) for n, x in state.memory.items() if n != PAST}
    if state.lanes is not None:
        leaves |= {f"links_{n}": getattr(state.lanes, n).expand(shape) for n in LINKS}
        trips = {} if state.lanes.trips is None else state.lanes.trips._asdict()
        leaves |= {f"trips_{n}": x.expand(shape) for n, x in trips.items()}
    return leaves | {f"episode_{n}": x for n, x in world.episode.items()}


def world_of(own: Mapping[str, Tensor], like: EnvState) -> EnvState:
    """Return a world of the leaves that ``named`` gives, memories as in ``like``."""
    fields = {n.removeprefix("state_"): x for n, x in own.items() if n.startswith("state_")}
    episode = {n.removeprefix("episode_"): x for n, x in own.items() if n.startswith("episode_")}
    state, lanes = like.state._replace(**fields), like.state.lanes  # type: ignore[arg-type]
    if lanes is not None:
        links: Any = {n: own[f"links_{n}"] for n in LINKS}
        lanes = lanes._replace(**links)
        if lanes.trips is not None:
            lanes = lanes._replace(trips=Trips(*(own[f"trips_{n}"] for n in Trips._fields)))
        state = state._replace(lanes=lanes)
    memory = {n: own.get(f"memory_{n}", x) for n, x in state.memory.items()}
    return EnvState(state._replace(memory=memory), episode)


def row_addresses(x: Array, numbers: Array) -> Array:
    """Return where some elements of an array begin, by their numbers along its first dimension."""
    return address(x) + numbers * (x.nbytes // len(x))


def address(x: Array | None) -> int:
    """Return where an array begins."""
    try:
        return addressof(c_char.from_buffer(x))  # type: ignore[arg-type]
    except (TypeError, ValueError):  # it may not be written to, or is empty
        assert x is not None
        return x.__array_interface__["data"][0]  # type: ignore[no-any-return]
