"""A step of a batch on several lanes as compiled loops: who comes and goes and changes lanes, then the kernel's step.

Between decisions a lane's order does not change: the kernel is that of lanes behind one another (``roads.chains``).
Choices are frozen; what they do to gaps and memories is recorded as everything else, with its adjoint.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from idm_env.delay_buffer import PAST
from idm_env.envs.plan import (
    Array,
    Bound,
    Group,
    Laid,
    Layout,
    Moment,
    Plan,
    RowTable,
    Scratch,
    address,
    block_of,
    examples_of,
    named,
    summed,
    world_of,
)
from idm_env.kernels import chain_loops, lane_change_loops, tiles
from idm_env.kernels.lane_changes import decision, rows_of
from idm_env.kernels.memory import addresses
from idm_env.kernels.operands import Strides
from idm_env.kernels.rows import RowFunction, adjoint, storage
from idm_env.multilane.demand import turned
from idm_env.multilane.incentives import seen_merging
from idm_env.roads.merging import on_lanes
from idm_env.scalar.record import Form, Unordered, Untraceable
from idm_env.tasks import EnvState
from idm_env.types import LINKS, Params

WHOLE = (*(f"links_{n}" for n in LINKS), "trips_entered", "trips_left")
"""Whole numbers of every vehicle that steps change, in the order in which they lie."""


_SERIALS = itertools.count()


@dataclass
class Chain:
    """Where vehicles lie in the order of their lanes (``chain_loops``); ``stale`` are rows to be laid out anew.

    ``serial`` tells one layout from all others, and ``before`` is that of the one of which it is a change.
    """

    slots: Array
    own: Array
    led: Array
    leads: Array
    ends: Array
    stale: Array
    serial: int = -1
    before: int = -1

    @classmethod
    def empty(cls, rows: int, places: int, vehicles: int, real: Any) -> Chain:
        """Return a layout of rows of so many places in which nobody lies yet."""
        slots, (led, leads, ends) = np.zeros(rows * places, np.int64), np.zeros((3, rows * places), real)
        return cls(slots, np.zeros(vehicles, np.int64), led, leads, ends, np.ones(rows, np.bool_))

    def copy(self) -> Chain:
        """Return another one, with memory of its own."""
        arrays = {n: getattr(self, n).copy() for n in ("slots", "own", "led", "leads", "ends", "stale")}
        return dataclasses.replace(self, **arrays)


@dataclass
class Crossing:
    """What becomes of links in one step: whole numbers ``(WHOLE, vehicles)`` before it, after decisions, and after it.

    ``mid`` are the blocks of the world after decisions; ``turned`` are rows in which vehicles may come and go, and
    ``decided`` those in which lanes were decided about; ``fresh`` marks new leaders then, and ``placed`` those whom a
    record put behind another one.
    """

    whole: Array
    chain: Chain | None
    kept: bool
    mid: Tensor | None = None
    whole_mid: Array | None = None
    whole_later: Array | None = None
    turned: Array = field(default_factory=lambda: np.empty(0, np.int64))
    decided: Array = field(default_factory=lambda: np.empty(0, np.int64))
    fresh: Array | None = None
    merger: Array | None = None
    placed: Array | None = None


class Stage:
    """A function of worlds that changes some of their leaves, as loops over rows, and its adjoint.

    ``function`` returns the leaves that it changes; gradients flow through those that move and to the leaves ``more``,
    which are no part of worlds. Before and after a stage worlds are blocks and whole numbers (``LanePlan.lies``).
    """

    def __init__(
        self, plan: LanePlan, function: Callable[..., dict[str, Tensor]], examples: Mapping[str, Tensor],
        more: Sequence[str] = (),
    ) -> None:  # fmt: skip
        self.plan, self.more = plan, tuple(more)
        self._function, self._examples = function, examples
        self.loops = RowFunction(self._then, examples, plan.recorded.many, apart=True)
        self._tables: dict[bool, tuple[int, RowTable]] = {}

    def _then(self, **leaves: Tensor) -> dict[str, Tensor]:
        return {f"then_{n}": x for n, x in self._function(**leaves).items()}

    @cached_property
    def back(self) -> RowFunction:
        """The adjoint: from ``pass_NAME``, what falls on the leaves afterwards, to ``new_NAME`` before."""
        moving = self.plan.recorded.moving
        passes = {f"pass_{n}": self._examples[n].clone() for n in moving}
        changed = [n for n in moving if f"then_{n}" in self.loops.outs]
        back = adjoint(self._then, [f"then_{n}" for n in changed], [*moving, *self.more])

        def through(**leaves: Tensor) -> dict[str, Tensor]:
            seeds = {f"on_then_{n}": leaves[f"pass_{n}"] for n in changed}
            gradients = back(**{n: x for n, x in leaves.items() if n[:5] != "pass_"}, **seeds)
            before = {
                n: gradients.get(n, 0.0 * leaves[f"pass_{n}"]) if n in changed
                else summed(leaves[f"pass_{n}"], gradients.get(n)) for n in moving
            }  # fmt: skip
            before |= {n: gradients[n] for n in self.more if n in gradients}
            return {f"new_{n}": x for n, x in before.items()}

        return RowFunction(through, {**self._examples, **passes}, self.plan.recorded.many, apart=True)

    def table(self, layout: Layout, own: Mapping[str, int], *begins: int, back: bool = False) -> Array:
        """Return the addresses of the loops, or of the adjoint's; ``begins`` are where groups begin.

        Blocks and whole numbers before the stage, and those after it; of the adjoint what falls on leaves after it, on
        those before it, and on ``more``.
        """
        version, filled = self._tables.get(back, (-1, None))
        if filled is None or version != layout.version:
            plan, moving, pitch = self.plan, self.plan.recorded.moving, self.plan.pitch
            groups: tuple[Group, ...] = plan.groups_of("then_")
            if back:
                groups = ("pass_", moving, pitch), ("new_", moving, pitch), ("new_", self.more, pitch)
            filled = RowTable(self.back if back else self.loops, layout.still, plan.groups_of("") + groups)
            self._tables[back] = layout.version, filled
        return filled.filled(own, *begins)


class LaneBound(Bound):
    """What parameters give a plan of lanes: operands as they are where vehicles share them, else copied to places.

    ``moving`` is copied at every step, what stays where vehicles were laid out anew, and ``chained`` with the layout.
    """

    plan: LanePlan

    def __init__(self, plan: LanePlan, laid: Laid, params: Params) -> None:
        self._moves, self._stays = list[Any](), list[Any]()
        self.chained = {n: np.zeros(plan.rows * plan.places, plan.real) for n in ("led", "leads", "ends")}
        self._laid_out: int | None = None  # the serial of the layout by which what stays is in place
        super().__init__(plan, laid, params)
        self.moving, self._staying = _Copies(self._moves, plan), _Copies(self._stays, plan)
        dtype, shape = plan.world.state.speed.dtype, (plan.rows, plan.size)
        tensors = {n: params[e][p].detach().to(dtype).expand(shape) for n, (e, p) in plan.turn_params.items()}
        self.turn_params = {n: np.array(x.numpy(), order="C") for n, x in tensors.items()}
        self.decides = self._decision()

    def _operand(self, name: str) -> tuple[Array | str | None, Strides]:
        """Return an operand, with room for a copy where it is not the same for all vehicles of a row."""
        plan, in_places = self.plan, (0, self.plan.places, 1)
        if name in self.chained:
            return self.chained[name], in_places
        truth, later = name in plan.kernel.flags, name.startswith("later ")
        array = np.zeros(plan.rows * plan.places, np.uint8 if truth else plan.real)
        if not later:
            source, by = self._source(name)
            if by[2] == 0:
                assert not isinstance(source, int)
                return source, by
            into = self._moves if isinstance(source, str) or name in plan.kernel.program.states else self._stays
            into.append((source, by[1:], truth, array))
        return array, in_places

    def _source(self, name: str) -> tuple[Array | str | int, Strides]:
        """Return an array, the name of what is given with every call, or the number of a block; and its strides."""
        if name.endswith(" now"):
            return self._input(name)
        if block_of(name) in self.plan.layout.blocks:
            return self.plan.layout.blocks.index(block_of(name)), (0, self.plan.size, 1)
        return self._static(name)

    def _decision(self) -> Any:
        """Return the plan of what drivers wish, and what in it moves: blocks, what is given, and who is led.

        Untraceable for wishes that look at what no plan has.
        """
        plan, blocks, inputs = self.plan, list[tuple[int, int]](), list[tuple[int, str]]()
        if plan.found is None:
            return None
        marks = {n: np.ones(1 if plan.ring else plan.count, plan.real) for n in ("led", "leads")}
        by_mark = (0, 0, 0) if plan.ring else (0, plan.size, 1)

        def find(i: int, name: str) -> tuple[int, int, int]:
            source, by = (marks[name], by_mark) if name in marks else self._source(name)
            if isinstance(source, str):
                if plan.recorded.before.types.get(source, plan.real) != plan.real:
                    raise Untraceable(f"drivers who change lanes look at {name.removesuffix(' now')}")
                inputs.append((i, source))
            elif isinstance(source, int):
                blocks.append((i, source * plan.pitch))
            else:
                self._arrays.append(source.astype(plan.real) if name.endswith(" now") else source)
                return address(self._arrays[-1]), *by[1:]
            return 0, *by[1:]

        rows, places = rows_of(plan.found.slots, find)
        which, offsets = np.array(blocks, np.int64).reshape(-1, 2).T
        return rows, places, which, offsets, inputs, marks, plan.found.compiled(plan.real.name)

    def to_places(self, rows: Array, chain: Chain, mid: int) -> None:
        """Copy what holds as long as a layout does to its places, in those rows that were laid out anew."""
        if self._laid_out != chain.serial:
            some = len(rows) and self._laid_out == chain.before
            self._staying.copy(rows if some else np.arange(self.plan.rows), chain, mid, {})
            for name, array in self.chained.items():
                np.copyto(array, getattr(chain, name))
            self._laid_out = chain.serial

    def forget(self) -> None:
        """Copy everything when it is needed next."""
        self._laid_out = None


class _Copies:
    """What is copied to places: sources (``LaneBound``), strides, which are truth values, and targets."""

    def __init__(self, entered: Sequence[tuple[Any, tuple[int, int], bool, Array]], plan: LanePlan) -> None:
        self._entered, self._plan = entered, plan
        sources = [source for source, *_ in entered]
        self._base = addresses([x if isinstance(x, np.ndarray) else None for x in sources])
        blocks = [(i, x * plan.pitch) for i, x in enumerate(sources) if isinstance(x, int)]
        self._blocks, self._offsets = np.array(blocks, np.int64).reshape(-1, 2).T
        self._given = [(i, x) for i, x in enumerate(sources) if isinstance(x, str)]
        strides = np.array([by for _, by, _, _ in entered], np.int64).reshape(-1, 2)
        truths = np.array([truth for _, _, truth, _ in entered], np.bool_)
        self.fixed = strides, truths, addresses([to for *_, to in entered])

    def sources(self, mid: int, given: Mapping[str, int]) -> Array:
        """Return where everything is: blocks begin at ``mid``."""
        cells = self._base.copy()
        cells[self._blocks] = self._offsets + mid
        for i, name in self._given:
            cells[i] = given[name]
        return cells

    def copy(self, rows: Array, chain: Chain, mid: int, given: Mapping[str, int]) -> None:
        """Copy some rows."""
        plan = self._plan
        chain_loops.to_places(rows, self.sources(mid, given), *self.fixed, chain.slots, plan.places, plan.like)


class LanePlan(Plan):
    """Steps on several lanes, as ``Plan``."""

    def __init__(
        self, moves: Any, world: EnvState, layout: Layout, kind: tuple[bool, bool], draws: tuple[str, ...]
    ) -> None:  # fmt: skip
        simulator, self.road = moves.task.simulator, moves.task.simulator.road
        if self.road.duration:
            raise Untraceable("compiled changes take no time, and Lanes has a duration")
        if PAST in world.state.memory:
            raise Untraceable("an effect looks back, where vehicles change lanes")
        self.ring = float(self.road.ring or 0.0)
        super().__init__(moves, world, layout, kind, draws)
        recorded, like = self.recorded, world.state
        self.like, self._drawn_by = np.empty(0, self.real), self.pitch
        self.coming = like.present is not None
        self.tables = np.array([self.road.table(name) for name in ("opens", "closes", "stops")], self.real)
        self._whole = [n for n in WHOLE if n in named(world)]
        self.lies = self.groups_of("") + self.groups_of("later_")
        self.said = "replay_lane_now" if "replay_lane_now" in recorded.before.shapes else None
        if self.said and self.ring:
            raise Untraceable("records of lanes on a ring")
        sample, shape = examples_of(world, recorded.many), (recorded.many, self.size)
        self.turn_params: dict[str, tuple[str, str]] = {}
        self.turn = self.settle = self.place = None
        if self.coming:
            pairs = (n.split(".", 1) for n in self.kernel.program.parameters)
            self.turn_params = {f"param_{effect}_{name}": (effect, name) for effect, name in pairs}
            ones = {n: torch.ones(shape, dtype=like.speed.dtype) for n in self.turn_params}
            self.turn = Stage(self, self._turned, {**sample, **ones}, list(ones))
        sample["fresh"] = torch.ones(shape, dtype=torch.bool)
        self.found: Any = None
        if simulator.lane_change_models:
            self.found = decision(simulator, Form.of(like._replace(lanes=None), recorded.inputs))
            if isinstance(self.found, str):
                raise Untraceable(self.found)
            sees = {"merger": torch.zeros(shape, dtype=torch.int64)} if simulator.sees_mergers else {}
            self.settle = Stage(self, self._settled, {**sample, **sees})
        if self.said:
            plain = self.settle if self.settle is not None and not simulator.sees_mergers else None
            self.place = plain or Stage(self, self._settled, sample)
        blocks = simulator.decides_in_blocks
        self.turns = simulator.turns(self.size).numpy() if blocks else np.empty(0, np.int64)
        self.stages = np.unique(self.turns) if blocks else np.zeros(1, np.int64)
        self._mid: Tensor | None = None

    def _bind(self, laid: Laid, params: Params) -> Bound:
        """Lay out what parameters give."""
        return LaneBound(self, laid, params)

    def _along(self) -> int:
        """Return how many places a row has."""
        self.halo = tiles.halo(1, self.kernel.program.reach) if self.ring else 0
        self.places = self.size + 2 * self.halo * self.road.count
        return self.places

    def groups_of(self, prefix: str) -> tuple[Group, ...]:
        """Return how worlds lie: blocks, and whole numbers."""
        return (prefix, self.layout.blocks, self.pitch), (prefix, self._whole, self.count * np.dtype(np.int64).itemsize)

    # -- what is recorded beside ---------------------------------------------------------------------------------

    def _turned(self, **leaves: Tensor) -> dict[str, Tensor]:
        """Return what changes where vehicles come and go, of leaves and parameters."""
        params: dict[str, dict[str, Tensor]] = {e: dict(v) for e, v in self.task.params(torch.float64, "cpu").items()}
        for leaf, (effect, name) in self.turn_params.items():
            params.setdefault(effect, {})[name] = leaves[leaf]
        world = world_of(leaves, self.world)
        now = torch.ones_like(world.state.speed[..., :1], dtype=torch.bool)
        after = world._replace(state=turned(self.task.simulator, world.state, params, now))
        return {n: x for n, x in named(after).items() if storage(x) != storage(leaves[n])}

    def _settled(self, **leaves: Tensor) -> dict[str, Tensor]:
        """Return gaps to new leaders, and who signals, after a decision."""
        state = world_of(leaves, self.world).state
        view = self.road.view(state)
        gap = torch.where(leaves["fresh"], view.gaps(state.position, state.length), state.gap)
        after = on_lanes(state)
        if "merger" in leaves:
            due = torch.ones_like(gap, dtype=torch.bool) if state.present is None else state.present > 0
            after = seen_merging(view, after, leaves["merger"], due)
        held = {f"memory_{n}": x for n, x in after.memory.items() if x is not state.memory[n]}
        return {"state_gap": gap, **held}

    # -- forwards ------------------------------------------------------------------------------------------------

    def _part(
        self, moment: Moment, now: Tensor, later: Tensor, clock: Array, pointers: Mapping[str, int], tape: bool
    ) -> Callable[[int, int, Any, bool], None]:
        """Decide about lanes; return the function that then steps some groups of tiles. Unordered as ``_decide``."""
        bound, lanes, recorded = moment.bound, moment.lanes, self.recorded
        assert isinstance(bound, LaneBound) and isinstance(lanes, Crossing)
        whole = address(lanes.whole)
        asks = bound.laid.ask.filled(pointers, moment.now, whole, 0, 0)
        chain_loops.all_rows(recorded.before.call, self.rows, asks)
        self._decide(moment, now, pointers, tape)
        assert lanes.mid is not None and lanes.whole_mid is not None and lanes.chain is not None
        mid, chain, by_record = lanes.mid.data_ptr(), lanes.chain, self.said is not None
        lanes.whole_later = lanes.whole_mid.copy() if by_record else lanes.whole_mid
        tells = bound.laid.tell.filled(pointers, moment.now, whole, moment.later, address(lanes.whole_later))
        position, was, present = (self._view(x, n) for x, n in (
            (later, "position"), (lanes.mid, "present"), (later, "present")))  # fmt: skip
        records, settle, settled = np.empty(0, np.int64), 0, np.empty(0, np.int64)
        lanes.placed = np.zeros(self.count if by_record else 0, np.bool_)
        for i in self._carried:
            later[i].copy_(lanes.mid[i])
        if self.said and self.place is not None:
            records, settle = moment.held[0][self.said].reshape(-1), self.place.loops.call
            own = {"fresh": address(lanes.placed), "state_step": pointers["later_state_step"]}
            after = moment.later, address(lanes.whole_later)
            settled = self.place.table(bound.laid.layout, own, *after, *after)
        places, ends = bound.operands(pointers), self._states + moment.later
        copied = bound.moving.sources(mid, pointers), *bound.moving.fixed

        def part(begin: int, end: int, work: Any, kept: bool) -> None:
            chain_loops.step_chains(
                recorded.after.call, tells, moment.clock, clock, by_record, settled, settle, records, lanes.whole_mid,
                lanes.whole_later, position, was, present, self.coming, self.road.count, lanes.placed, *copied,
                places[len(ends) : 2 * len(ends)], ends, chain.slots, chain.own, places, bound.strides, *work,
                self.like, 0, *self.loops, 0, False, self.size, begin, end,
            )  # fmt: skip

        return part

    def _decide(self, moment: Moment, now: Tensor, pointers: Mapping[str, int], tape: bool) -> None:
        """Let vehicles come, go and change lanes in the rows whose turn it is; and lay out who is elsewhere now.

        Unordered, with nothing changed, where links are not the order of positions.
        """
        bound, lanes = moment.bound, moment.lanes
        assert isinstance(bound, LaneBound) and isinstance(lanes, Crossing)
        phase = moment.clock % self.task.simulator.decides_after
        if self.turn is not None:
            lanes.turned = np.flatnonzero(phase == 0)
        if self.found is not None:
            due = phase == 0 if len(self.stages) == 1 else np.isin(phase, self.stages)
            lanes.decided = np.flatnonzero(due)
        lanes.mid, lanes.whole_mid = now, lanes.whole
        chain = lanes.chain = lanes.chain or Chain.empty(self.rows, self.places, self.count, self.real)
        try:
            if len(lanes.turned) or len(lanes.decided):
                self._change(moment, now, pointers, phase, tape)
            anew = chain.stale.copy()
            anew[lanes.turned] = anew[lanes.decided] = True
            rows = np.flatnonzero(anew)
            if len(rows):
                if lanes.kept:
                    chain = lanes.chain = chain.copy()
                if not chain_loops.lay_out(
                    lanes.whole_mid, self._view(lanes.mid, "position"), self._view(lanes.mid, "present"), self.coming,
                    rows, self.size, self.road.count, self.ring, self.halo, self.places, self.tables[2], chain.slots,
                    chain.own, chain.led, chain.leads, chain.ends,
                ):  # fmt: skip
                    raise Unordered("links are not the order of positions")
                chain.stale[:] = self.said is not None
                chain.before, chain.serial = chain.serial, next(_SERIALS)
            bound.to_places(rows, chain, lanes.mid.data_ptr())
        except Unordered:
            chain.stale[:] = True
            raise

    def _change(self, moment: Moment, now: Tensor, pointers: Mapping[str, int], phase: Array, tape: bool) -> None:
        """Let vehicles come, go and change lanes, on copies."""
        bound, lanes = moment.bound, moment.lanes
        assert isinstance(bound, LaneBound) and isinstance(lanes, Crossing)
        if tape:
            mid = now.detach().clone()
        else:
            mid = self._mid = torch.empty_like(now) if self._mid is None else self._mid
            mid.copy_(now.detach())
        lanes.mid, lanes.whole_mid = mid, lanes.whole.copy()
        layout, step = bound.laid.layout, {"state_step": moment.given["state_step"]}
        after = mid.data_ptr(), address(lanes.whole_mid)
        if self.turn is not None and len(lanes.turned):
            own = {n: address(x) for n, x in bound.turn_params.items()} | step
            stage = self.turn.table(layout, own, moment.now, address(lanes.whole), *after)
            chain_loops.each_row(self.turn.loops.call, lanes.turned, stage)
        if self.settle is None or not len(lanes.decided):
            return
        plan, places, which, offsets, inputs, marks, (phase_at, constants) = bound.decides
        plan[which, lane_change_loops.ADDRESS] = offsets + mid.data_ptr()
        for i, name in inputs:
            plan[i, lane_change_loops.ADDRESS] = pointers[name]
        if not self.ring:
            chain_loops.mark_led(lanes.decided, self.size, *lanes.whole_mid[1:3], marks["led"], marks["leads"])
        lanes.fresh = np.zeros(self.count, np.uint8)
        lanes.merger = np.tile(np.arange(self.size), self.rows if self.task.simulator.sees_mergers else 0)
        order, begin = np.empty(self.count, np.int64), np.empty(self.rows * (self.road.count + 1), np.int64)
        if not lane_change_loops.decide(
            lanes.whole_mid[: len(LINKS)], self._view(mid, "position"), self._view(mid, "present"), self.coming,
            lanes.decided, phase[lanes.decided], self.size, self.road.count, self.ring, self.road.handed == "left",
            self.tables, plan, places, phase_at, constants, len(self.found.slots), lanes.fresh, lanes.merger,
            self.turns, order, begin,
        ):  # fmt: skip
            raise Unordered("links are not the order of positions")
        own = {"fresh": address(lanes.fresh), "merger": address(lanes.merger), **step}
        chain_loops.each_row(self.settle.loops.call, lanes.decided, self.settle.table(layout, own, *after, *after))

    def _view(self, blocks: Tensor, name: str) -> Array:
        """Return one block as an array; an empty one for presence where everybody is there."""
        if name == "present" and not self.coming:
            return self.like
        return blocks.detach()[self.layout.blocks.index(f"state_{name}")].reshape(-1).numpy()  # type: ignore[no-any-return]

    # -- backwards -----------------------------------------------------------------------------------------------

    @cached_property
    def scratch(self) -> LaneScratch:
        """Memory of the adjoint."""
        return LaneScratch(self)

    def _retreat(
        self, moment: Moment, pointers: dict[str, int], seeds: int, on_now: int, on_parameters: Array, on_past: Array,
        past: Array,
    ) -> None:  # fmt: skip
        """Run the loops of the adjoint, as in ``Plan``: what is told, who was put where, the kernel, decisions."""
        bound, lanes, room, rows = moment.bound, moment.lanes, self.scratch, np.arange(self.rows)
        assert isinstance(bound, LaneBound) and isinstance(lanes, Crossing)
        assert lanes.mid is not None and lanes.chain is not None
        assert lanes.whole_mid is not None and lanes.whole_later is not None
        (asks, tells), (before, after) = bound.laid.back, self.recorded.backward
        worlds = moment.now, address(lanes.whole), moment.later, address(lanes.whole_later)
        pointers |= {f"end_{n}": x for n, x in zip(self.recorded.moving, room.now, strict=True)}
        chain_loops.all_rows(after.call, self.rows, tells.filled(pointers, *worlds, seeds))
        mid, chain = lanes.mid.data_ptr(), lanes.chain
        layout, step = bound.laid.layout, {"state_step": pointers["state_step"]}
        if self.place is not None and self.said and lanes.placed is not None:
            own = {"fresh": address(lanes.placed), "state_step": pointers["later_state_step"]}
            room.through(self.place, layout, rows, own, moment.later, address(lanes.whole_later))
        bound.moving.copy(rows, chain, mid, moment.given)
        bound.forget()
        bound.to_places(rows, chain, mid)
        room.clear()
        slots = np.concatenate((room.then, addresses([*room.on_inputs, *on_parameters])))
        chain_loops.retreat_chains(
            room.now, room.ends, room.sums, slots, chain.slots, chain.own, self.size, bound.operands(moment.given),
            bound.strides, *room.work, self.like, 0, room.ends, room.begins, address(room.on_parameters),
            address(room.inputs), *room.loops, 0, 0, self.groups,
        )  # fmt: skip
        room.turn()
        if self.settle is not None and len(lanes.decided):
            assert lanes.fresh is not None and lanes.merger is not None
            own = {"fresh": address(lanes.fresh), "merger": address(lanes.merger), **step}
            room.through(self.settle, layout, lanes.decided, own, mid, address(lanes.whole_mid))
        if self.turn is not None and len(lanes.turned):
            own = {n: address(x) for n, x in bound.turn_params.items()} | step
            on_parameters += room.through(self.turn, layout, lanes.turned, own, moment.now, address(lanes.whole))
        pointers |= {f"carried_{n}": x for n, x in zip(self.recorded.moving, room.now, strict=True)}
        chain_loops.all_rows(before.call, self.rows, asks.filled(pointers, *worlds, on_now))


class LaneScratch(Scratch):
    """Memory of the adjoint of a plan of lanes: by slot and by place.

    What falls on the moving leaves of worlds is there twice, before and after a stage of the adjoint, by turns: ``now``
    are the addresses where it lies, ``then`` those to which it is carried.
    """

    def __init__(self, plan: LanePlan) -> None:
        super().__init__(plan)
        room, moving = plan.rows * plan.places, len(plan.recorded.moving)
        self._flow = np.zeros((2, moving, plan.count), plan.real)
        self.now, self.then = (addresses(list(x)) for x in self._flow)
        inputs, parameters = len(plan.kernel.numbers), len(plan.kernel.program.parameters)
        self._ends, self._begins, self.inputs, self.on_parameters = (
            np.zeros((count, room), plan.real) for count in (moving, moving, inputs, parameters)
        )
        self.ends, self.begins = addresses(list(self._ends)), addresses(list(self._begins))
        self.sums = addresses([*self._begins, *self.inputs, *self.on_parameters])

    def clear(self) -> None:
        """Empty what is added to."""
        self._flow[1] = self.on_inputs[:] = self.on_parameters[:] = 0

    def turn(self) -> None:
        """Let what was carried be what lies there now."""
        self._flow, self.now, self.then = self._flow[::-1], self.then, self.now

    def through(self, stage: Stage, layout: Layout, rows: Array, own: Mapping[str, int], now: int, whole: int) -> Array:
        """Carry it from the leaves after a stage to those before it, in some rows; return that on its ``more``."""
        np.copyto(self._flow[1], self._flow[0])
        more = np.zeros((len(stage.more), self._flow.shape[-1]), self._flow.dtype)
        begins = now, whole, int(self.now[0]), int(self.then[0]), address(more)
        chain_loops.each_row(stage.back.call, rows, stage.table(layout, own, *begins, back=True))
        self.turn()
        return more


__all__ = ["WHOLE", "Chain", "Crossing", "LanePlan"]
