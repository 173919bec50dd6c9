"""Lanes and their links in place during a rollout: laid out for compiled steps, and changed by compiled decisions."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from idm_env.compiled.kernels import lane_change_loops, order_loops
from idm_env.compiled.kernels.lane_changes import Deciding, Decision, looked_at, rows_of
from idm_env.compiled.kernels.memory import addresses
from idm_env.compiled.kernels.operands import dense, operand
from idm_env.compiled.kernels.tiles import Array
from idm_env.multilane.demand import turnover
from idm_env.multilane.incentives import seen_merging
from idm_env.multilane.lane_change import decided
from idm_env.roads import Lanes
from idm_env.roads.chains import Places
from idm_env.roads.linked import Linked
from idm_env.roads.merging import on_lanes
from idm_env.types import LINKS, Inputs, LaneState, Params, State

if TYPE_CHECKING:
    from idm_env.simulator import Simulator


_Lasting = tuple[Array, Array, list[tuple[int, str]], list[Array]]
"""The plan of rows, the places in it, the rows whose arrays move with every decision, and what must be kept alive."""


class Traffic:
    """The lanes of a state, whose links are in arrays of their own that decisions change."""

    _lanes: LaneState
    _changed: bool

    def __init__(self, simulator: Simulator, state: State) -> None:
        assert isinstance(simulator.road, Lanes) and state.lanes is not None
        self.simulator, self.road = simulator, simulator.road
        self.shape = tuple(state.speed.shape)
        self.n = self.shape[-1]
        self.rows = state.speed.numel() // self.n
        self._take(state.lanes)
        self._kind = state.speed.detach().numpy().dtype
        self._deciding = Deciding(simulator, self.rows, self.n, self._kind)
        self._ring = float(self.road.ring or 0.0)
        self._lasting: _Lasting | None = None
        self._order: tuple[Array, Array] | None = None

    @property
    def lanes(self) -> LaneState:
        """The lanes as they are now: those that were given, or after a decision in memory that decisions change."""
        if self._changed:
            links: Any = (torch.from_numpy(x).view(self.shape) for x in self._links)
            self._lanes = self._lanes._replace(**dict(zip(LINKS, links, strict=True)))
            self._changed = False
        return self._lanes

    @cached_property
    def _links(self) -> Array:
        return np.stack([getattr(self._lanes, n).expand(self.shape).reshape(-1).numpy() for n in LINKS])

    def _take(self, lanes: LaneState | None) -> None:
        assert lanes is not None
        self._lanes, self._changed = lanes, False
        self.__dict__.pop("_links", None)

    def begin(self, state: State, params: Params) -> State:
        """Return the state after those have left and entered for whom it is time."""
        if state.present is not None:
            state = turnover(self.simulator, state._replace(lanes=self.lanes), params)
            self._take(state.lanes)
        return state

    def _present(self, state: State) -> Array:
        return np.empty(0, self._kind) if state.present is None else dense(state.present, self.shape)

    def places(self, state: State, halo: int) -> Places | None:
        """Return where vehicles lie in a row for as many steps as the halo is for; None where links are no order."""
        around = halo if self.road.ring is not None else 0
        wide = self.n + 2 * around * self.road.count
        slots, own = np.empty(self.rows * wide, np.int64), np.empty(self.rows * self.n, np.int64)
        led, leads = (np.empty(self.rows * wide, dense(state.position, self.shape).dtype) for _ in range(2))
        if not self._lay(state, around, wide, slots, own, led, leads):
            return None
        shape, (slot_of, first, last) = (*self.shape[:-1], wide), (torch.from_numpy(x) for x in (slots, led, leads))
        slot_of = slot_of.view(shape)
        ends = None
        if self.road.closed:
            lane = self.lanes.lane.expand(self.shape).gather(-1, slot_of)
            ends = self.road.closed_at(lane, state.position)
        return Places(slot_of, torch.from_numpy(own).view(self.shape), first.view(shape), last.view(shape), ends)

    def _lay(self, state: State, around: int, wide: int, *to: Array) -> bool:
        """Lay all rows out into four arrays; False where links are no order. Whoever has just decided knows it."""
        count, order = self.road.count, self._order
        self._order = None
        if order is not None:
            order_loops.laid_by(*order, self.rows, self.n, count, around, wide, *to)
            return True
        lanes_of, leader, follower = (dense(x, self.shape) for x in self.lanes[:3])
        position, present = dense(state.position, self.shape), self._present(state)
        world = leader, follower, lanes_of, position, present, len(present) > 0
        arguments = *world, np.arange(self.rows), self.n, count, self._ring
        return bool(order_loops.laid(*arguments, around, wide, *to))

    def decide(
        self, wishes: Decision | str, state: State, inputs: Inputs, params: Params, turn: Sequence[Array]
    ) -> State | None:
        """Return the state after those have decided whose turn it is, or None where links are no order.

        ``turn`` are the rows that decide, and their stages.
        """
        if isinstance(wishes, str):
            after = decided(self.simulator, state._replace(lanes=self.lanes), inputs, params)
            self._take(after.lanes)
            return after
        *plan, held = self._plan(wishes, state, inputs, params)
        world = self._links, dense(state.position, self.shape), self._present(state)
        choices = self._deciding.decide(wishes, world, turn, plan)
        del held
        self._changed = True
        if choices is None:
            return None
        self._order = choices[2:] if len(turn[0]) == self.rows else None
        which = torch.from_numpy(np.flatnonzero(choices.fresh))
        links = self.lanes
        if len(which):
            gap = Linked(self.road, links, state.position).gaps_of(which, state.position, state.length)
            full = state.gap.expand(self.shape).reshape(-1)
            state = state._replace(gap=full.index_put((which,), gap).view(self.shape))
        state = on_lanes(state._replace(lanes=links))
        if not self.simulator.sees_mergers:
            return state
        due = torch.zeros(self.rows, dtype=torch.bool).index_fill(0, torch.from_numpy(turn[0]), True)
        due = due.view(*self.shape[:-1], 1) & (True if state.present is None else state.present > 0)
        view = Linked(self.road, links, state.position)
        return seen_merging(view, state, torch.from_numpy(choices.merger).view(self.shape), due)

    def _plan(self, kernel: Decision, state: State, inputs: Inputs, params: Params) -> tuple[Array, Array, list[Array]]:
        """Return source and strides of each workspace row, its vehicle, and the arrays to keep alive.

        What does not change in a rollout is looked up once.
        """
        if self._lasting is None:
            self._lasting = self._begun(kernel, state, inputs, params)
        plan, places, moving, held = self._lasting
        more = []
        for i, name in moving:
            array, _, _ = self._operand(name, state, inputs, params)
            plan[i, lane_change_loops.ADDRESS] = addresses([array])[0]
            more.append(array)
        return plan, places, [*held, *more]

    def _begun(self, kernel: Decision, state: State, inputs: Inputs, params: Params) -> _Lasting:
        held, moving = [], []

        def find(i: int, name: str) -> tuple[int, int, int]:
            array, by_row, by_vehicle = self._operand(name, state, inputs, params)
            held.append(array)
            if not self._lasts(name):
                moving.append((i, name))
            return int(addresses([array])[0]), by_row, by_vehicle

        return *rows_of(kernel.slots, find), moving, held

    def _operand(self, name: str, state: State, inputs: Inputs, params: Params) -> tuple[Array, int, int]:
        """Return an array and its strides by row and vehicle."""
        x = looked_at(self.simulator, state._replace(lanes=self.lanes), inputs, params, name).to(state.speed.dtype)
        if not self._lasts(name):
            x = x.expand(self.shape).contiguous()  # strides that hold at every decision
        array, (_, by_row, by_vehicle) = operand(x, self.shape[:-1], self.n)
        return array, by_row, by_vehicle

    def _lasts(self, name: str) -> bool:
        """Whether this does not change in a rollout."""
        return "." in name or name == "length" or (name in ("led", "leads") and self.road.ring is not None)
