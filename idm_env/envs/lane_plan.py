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

from idm_env.envs.plan import (
    Array,
    Bound,
    Laid,
    Layout,
    Moment,
    Plan,
    Scratch,
    _block,
    _Table,
    address,
    examples_of,
    named,
    world_of,
)
from idm_env.kernels import lane_change_loops, tiles
from idm_env.kernels import threads as pool
from idm_env.kernels.chain_loops import (
    all_rows,
    each_row,
    lay_out,
    mark_led,
    retreat_chains,
    step_chains,
    to_places,
)
from idm_env.kernels.lane_changes import decision, rows_of
from idm_env.kernels.lanes import static_of
from idm_env.kernels.memory import addresses
from idm_env.kernels.operands import operand, table
from idm_env.kernels.rows import RowFunction, adjoint, storage
from idm_env.kernels.world_loop import workspaces
from idm_env.multilane.demand import turned
from idm_env.multilane.incentives import seen_merging
from idm_env.roads import Lanes
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

    ``function`` returns the leaves that it changes; gradients flow through the ``moving`` ones and to the leaves
    ``more``.
    """

    def __init__(
        self, function: Callable[..., dict[str, Tensor]], examples: Mapping[str, Tensor], many: int,
        moving: Sequence[str], more: Sequence[str] = (),
    ) -> None:  # fmt: skip
        self._function, self._examples, self._many = function, examples, many
        self.moving, self.more = tuple(moving), tuple(more)
        self.loops = RowFunction(self._then, examples, many, apart=True)

    def _then(self, **leaves: Tensor) -> dict[str, Tensor]:
        return {f"then_{n}": x for n, x in self._function(**leaves).items()}

    @cached_property
    def back(self) -> RowFunction:
        """The adjoint: from ``pass_NAME``, what falls on the leaves afterwards, to ``new_NAME`` before."""
        passes = {f"pass_{n}": self._examples[n].clone() for n in self.moving}
        changed = [n for n in self.moving if f"then_{n}" in self.loops.outs]
        by = [*self.moving, *self.more]
        back = adjoint(self._then, [f"then_{n}" for n in changed], by)

        def through(**leaves: Tensor) -> dict[str, Tensor]:
            seeds = {f"on_then_{n}": leaves[f"pass_{n}"] for n in changed}
            gradients = back(**{n: x for n, x in leaves.items() if n[:5] != "pass_"}, **seeds)
            results = {}
            for n in self.moving:
                if n in changed:
                    results[f"new_{n}"] = gradients[n] if n in gradients else 0.0 * leaves[f"pass_{n}"]
                else:
                    results[f"new_{n}"] = (
                        leaves[f"pass_{n}"] + gradients[n] if n in gradients else leaves[f"pass_{n}"].clone()
                    )
            return results | {f"new_{n}": gradients[n] for n in self.more if n in gradients}

        return RowFunction(through, {**self._examples, **passes}, self._many, apart=True)


class LaneLaid(Laid):
    """Tables and operands of a plan of lanes."""

    _plan: LanePlan

    def bind(self, params: Params) -> Bound:
        """Lay out what parameters give."""
        plan = self._plan
        kernel, real, like = plan.kernel, plan.real, plan.world.state.speed
        program, rows, n, wide = kernel.program, plan.rows, plan.size, plan.places
        states, room = len(program.states), rows * wide
        ends = np.zeros((2 * states, room), real)
        bound = LaneBound(self, params, program.parameters, [ends], np.zeros(0, np.int64), np.zeros((0, 3)))
        places, strides = list(addresses(list(ends))), []
        for i in range(states):
            bound.moves.append((("block", int(plan.states_at[i])), (n, 1), False, int(places[i])))
        for name in (*program.statics, *program.parameters):
            if name in ("led", "leads", "ends"):
                array = np.zeros(room, real)
                bound.chained.append((name, array))
                places.append(address(array))
                strides.append((0, wide, 1))
                continue
            if name in ("length", "present"):
                x, by = self.layout.still.get(f"state_{name}"), (0, n, 1)
                source: Any = ("block", self.layout.blocks.index("state_present")) if x is None else x
            else:
                tensor = static_of(plan.task.simulator, plan.world.state, params, name)
                source, by = operand(tensor.to(like.dtype), (rows,), n)
            self._enter(bound, bound.stays, source, by, False, places, strides)
        for i, (slot, (x, by)) in enumerate(zip((*kernel.numbers, *kernel.flags), self.inputs, strict=True)):
            call_name = self.given.get(2 * states + plan.fixed + i)
            source = x if call_name is None else ("given", call_name)
            into = bound.stays if call_name is None else bound.moves
            if call_name is not None and by[2] == 0:
                bound.given[len(places)] = call_name
                places.append(0)
                strides.append(by)
                continue
            self._enter(bound, into, source, by, slot in kernel.flags, places, strides)
        bound.places = np.array(places, np.int64)
        bound.strides = table([*strides, (0, wide, 1)])
        bound.finish(plan)
        return bound

    def _enter(
        self, bound: LaneBound, into: list[Any], source: Any, by: Any, truth: bool, places: list[int],
        strides: list[Any],
    ) -> None:  # fmt: skip
        """Enter an operand: as it is where all vehicles of a row share it, else with room for a copy."""
        plan = self._plan
        if isinstance(source, np.ndarray):
            bound.held.append(source)
            if by[2] == 0:
                places.append(address(source))
                strides.append(by)
                return
            source = ("array", address(source))
        array = np.zeros(plan.rows * plan.places, np.uint8 if truth else plan.real)
        bound.held.append(array)
        into.append((source, by[1:], truth, address(array)))
        places.append(address(array))
        strides.append((0, plan.places, 1))


class LaneBound(Bound):
    """What parameters give a plan of lanes: where operands come from, and where the kernel finds them by place.

    ``moves`` are copied at every step, ``stays`` where vehicles were laid out anew, ``chained`` with the layout.
    """

    def __init__(self, *laid: Any) -> None:
        super().__init__(*laid)
        self.moves: list[Any] = []
        self.stays: list[Any] = []
        self.chained: list[tuple[str, Array]] = []
        self.given: dict[int, str] = {}
        self.held: list[Array] = []
        self.laid_out: int | None = None
        """The serial of the layout by which ``stays`` are in place."""

    def _read(self, pairs: list[list[str]]) -> list[list[str]]:
        """Decisions read parameters that the kernel does not."""
        return [[effect, name] for effect, values in self.params.items() for name in values]

    def finish(self, plan: LanePlan) -> None:
        """Sort what was entered into arrays, and lay out what decisions read."""
        self._moving, self._staying = _Copies(self.moves, plan), _Copies(self.stays, plan)
        self.turn_params = {}
        for effect, name in plan.turn_params:
            x = self.params[effect][name].detach().to(plan.world.state.speed.dtype)
            self.turn_params[f"param_{effect}_{name}"] = np.array(x.expand(plan.rows, plan.size).numpy(), order="C")
        self.decides = plan.decides(self)

    def to_places(self, rows: Array, chain: Chain, plan: LanePlan, mid: int) -> None:
        """Copy what holds as long as a layout does to its places, in those rows that were laid out anew."""
        if self.laid_out != chain.serial:
            which = rows if len(rows) and self.laid_out == chain.before else np.arange(plan.rows)
            self._staying.copy(which, chain, plan, mid, {})
            for name, array in self.chained:
                np.copyto(array, getattr(chain, name))
            self.laid_out = chain.serial

    def forget(self) -> None:
        """Copy everything when it is needed next."""
        self.laid_out = None


class _Copies:
    """What is copied to places: addresses, strides and targets."""

    def __init__(self, entered: list[Any], plan: LanePlan) -> None:
        self._where = [source for source, *_ in entered]
        self.strides = np.array([by for _, by, _, _ in entered], np.int64).reshape(-1, 2)
        self.truths = np.array([truth for _, _, truth, _ in entered], np.bool_)
        self.targets = np.array([to for *_, to in entered], np.int64)
        self._base = np.array([x if kind == "array" else 0 for kind, x in self._where], np.int64)
        self._blocks = np.array([i for i, (kind, _) in enumerate(self._where) if kind == "block"], np.int64)
        self._block_at = np.array([x for kind, x in self._where if kind == "block"], np.int64) * plan.pitch
        self._given = [(i, x) for i, (kind, x) in enumerate(self._where) if kind == "given"]

    def sources(self, mid: int, given: Mapping[str, int]) -> Array:
        """Return where everything is: blocks begin at ``mid``."""
        cells = self._base.copy()
        cells[self._blocks] = self._block_at + mid
        for i, name in self._given:
            cells[i] = given[name]
        return cells

    def copy(self, rows: Array, chain: Chain, plan: LanePlan, mid: int, given: Mapping[str, int]) -> None:
        """Copy some rows."""
        to_places(
            rows, self.sources(mid, given), self.strides, self.truths, self.targets, chain.slots, plan.places, plan.like
        )  # fmt: skip


class LanePlan(Plan):
    """Steps on several lanes, as ``Plan``."""

    kind_of_laid = LaneLaid

    def __init__(
        self, moves: Any, world: EnvState, layout: Layout, kind: tuple[bool, bool], draws: tuple[str, ...]
    ) -> None:  # fmt: skip
        simulator = moves.task.simulator
        self.road: Lanes = simulator.road
        if self.road.duration:
            raise Untraceable("compiled changes take no time, and Lanes has a duration")
        super().__init__(moves, world, layout, kind, draws)
        if self.kernel.signals:
            raise Untraceable("an effect looks back, where vehicles change lanes")
        recorded, like = self.recorded, world.state
        self.like = np.empty(0, self.real)
        self.states_at = self._states // self.pitch
        self.every = simulator.decides_after
        self.coming = like.present is not None
        self.ring = float(self.road.ring or 0.0)
        self.halo = tiles.halo(1, self.kernel.program.reach) if self.ring else 0
        self.tables = np.array([self.road.table(name) for name in ("opens", "closes", "stops")], self.real)
        self.moving = [_block(n) for n in self.kernel.program.moving]
        self.whole = [n for n in WHOLE if n in named(world)]
        sample = examples_of(world, recorded.many)
        self.said = "replay_lane_now" if "replay_lane_now" in recorded.before.shapes else None
        if self.said and self.ring:
            raise Untraceable("records of lanes on a ring")
        pairs = [n.split(".", 1) for n in self.kernel.program.parameters]
        self.turn_params: list[tuple[str, str]] = []
        self.turn = self.settle = self.place = None
        if self.coming:
            names = {f"param_{e}_{p}": (e, p) for e, p in pairs}
            dtype = like.speed.dtype
            examples = {n: torch.ones(recorded.many, self.size, dtype=dtype) for n in names}
            self.turn_params = [tuple(x) for x in pairs]  # type: ignore[misc]
            self.turn = Stage(self._turned(names), {**sample, **examples}, recorded.many, self.moving, list(names))
        truths = {"fresh": torch.ones(recorded.many, self.size, dtype=torch.bool)}
        self.found: Any = None
        if simulator.lane_change_models:
            self.found = decision(simulator, Form.of(like._replace(lanes=None), recorded.inputs))
            if isinstance(self.found, str):
                raise Untraceable(self.found)
            slots = torch.zeros(recorded.many, self.size, dtype=torch.int64)
            sees = {"merger": slots} if simulator.sees_mergers else {}
            self.settle = Stage(self._settled, {**sample, **truths, **sees}, recorded.many, self.moving)
        if self.said:
            plain = self.settle if self.settle is not None and not simulator.sees_mergers else None
            self.place = plain or Stage(self._settled, {**sample, **truths}, recorded.many, self.moving)
        blocks = simulator.decides_in_blocks
        self.turns = simulator.turns(self.size).numpy() if blocks else np.empty(0, np.int64)
        self.stages = np.unique(self.turns) if blocks else np.zeros(1, np.int64)
        self._tables: dict[Any, tuple[int, _Table]] = {}
        self._mid: Tensor | None = None

    def _along(self) -> int:
        """Return how many places a row has."""
        road: Lanes = self.task.simulator.road  # type: ignore[assignment]
        halo = tiles.halo(1, self.kernel.program.reach) if road.ring else 0
        self.places = self.size + 2 * halo * road.count
        return self.places

    # -- what is recorded beside ---------------------------------------------------------------------------------

    def _turned(self, names: Mapping[str, tuple[str, str]]) -> Callable[..., dict[str, Tensor]]:
        """Return the function that has vehicles come and go, of leaves and parameters."""
        simulator, like = self.task.simulator, self.world

        def function(**leaves: Tensor) -> dict[str, Tensor]:
            params: dict[str, dict[str, Tensor]] = {
                e: dict(v) for e, v in self.task.params(torch.float64, "cpu").items()
            }
            for name, (effect, parameter) in names.items():
                params.setdefault(effect, {})[parameter] = leaves[name]
            world = world_of(leaves, like)
            now = torch.ones_like(world.state.speed[..., :1], dtype=torch.bool)
            after = world._replace(state=turned(simulator, world.state, params, now))
            return {n: x for n, x in named(after).items() if storage(x) != storage(leaves[n])}

        return function

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

    def decides(self, bound: LaneBound) -> Any:
        """Return the plan of what drivers wish, and what in it moves: blocks, what is given, and who is led.

        Untraceable for wishes that look at what no plan has.
        """
        if self.found is None:
            return None
        blocks, inputs, led = [], [], []
        like = self.world.state
        laid: LaneLaid = bound.laid  # type: ignore[assignment]

        def find(i: int, name: str) -> tuple[int, int, int]:
            if name in ("led", "leads"):
                if self.ring:
                    return self._keep(bound, np.ones(1, self.real)), 0, 0
                led.append((i, name))
                return 0, self.size, 1
            if name.endswith(" now"):
                (x, (_, by_row, by_vehicle)), to = laid._input(name)
                if to is not None:
                    if self.recorded.before.types.get(to, self.real) != self.real:
                        raise Untraceable(f"drivers who change lanes look at {name.removesuffix(' now')}")
                    inputs.append((i, to))
                    return 0, by_row, by_vehicle
                return self._keep(bound, x.astype(self.real)), by_row, by_vehicle
            still = laid.layout.still.get(_block(name))
            if still is not None:
                return address(still), self.size, 1
            if "." in name:
                x, (_, by_row, by_vehicle) = operand(
                    static_of(self.task.simulator, like, bound.params, name).to(like.speed.dtype),
                    (self.rows,),
                    self.size,
                )
                return self._keep(bound, x), by_row, by_vehicle
            blocks.append((i, laid.layout.blocks.index(_block(name))))
            return 0, self.size, 1

        plan, places = rows_of(self.found.slots, find)
        offsets = np.array([b for _, b in blocks], np.int64) * self.pitch
        which = np.array([i for i, _ in blocks], np.int64)
        marks = {name: np.zeros(self.count, self.real) for name in ("led", "leads")}
        for i, name in led:
            plan[i, lane_change_loops.ADDRESS] = address(marks[name])
        return plan, places, which, offsets, inputs, marks, self.found.compiled(self.real.name)

    def _keep(self, bound: LaneBound, x: Array) -> int:
        bound.held.append(x)
        return address(x)

    # -- forwards ------------------------------------------------------------------------------------------------

    def run(self, moment: Moment, now: Tensor, later: Tensor, tape: bool) -> dict[str, Array]:
        """Do one step of blocks [rows · vehicles], as ``Plan.run``; Unordered, nothing changed, where torch must."""
        bound, lanes, recorded = moment.bound, moment.lanes, self.recorded
        assert isinstance(bound, LaneBound) and isinstance(lanes, Crossing)
        moment.now, moment.later = now.data_ptr(), later.data_ptr()
        between, between_at = self.between.take() if tape else self._reused
        clock, whole = np.empty_like(moment.clock), self._named(lanes.whole, "")
        pointers = self._given(moment, between, between_at, clock)
        all_rows(recorded.before.call, self.rows, bound.laid.ask.filled(moment.now, 0, pointers | whole))
        before = pointers | self._drawn(moment)
        self._decide(moment, now, before, tape)
        assert lanes.mid is not None and lanes.whole_mid is not None and lanes.chain is not None
        mid, chain = lanes.mid.data_ptr(), lanes.chain
        lanes.whole_later = lanes.whole_mid.copy() if self.said else lanes.whole_mid
        outputs, where = self.told.take()
        where |= pointers | whole | self._named(lanes.whole_later, "later_")
        tells = bound.laid.tell.filled(moment.now, moment.later, where)
        copies = bound._moving
        position, was, present = (self._view(x, n) for x, n in (
            (later, "position"), (lanes.mid, "present"), (later, "present")))  # fmt: skip
        record_lanes, settle, settled = np.empty(0, np.int64), 0, np.empty(0, np.int64)
        lanes.placed = np.zeros(self.count if self.said else 0, np.bool_)
        for i in self._carried:
            later[i].copy_(lanes.mid[i])
        if self.said and self.place is not None:
            record_lanes, settle = between[self.said].reshape(-1), self.place.loops.call
            own = {"fresh": address(lanes.placed), "state_step": pointers["later_state_step"]}
            settled = self._stage(bound, self.place.loops, moment.later, lanes.whole_later, own, moment.later, None)
        places = self._operands(bound, before)

        def part(begin: int, end: int, work: Any) -> None:
            step_chains(
                recorded.after.call, tells, moment.clock, clock, bool(self.said), settled, settle, record_lanes,
                lanes.whole_mid, lanes.whole_later, position, was, present, self.coming, self.road.count, lanes.placed,
                copies.sources(mid, before), copies.strides, copies.truths, copies.targets,
                places[len(self._states) : 2 * len(self._states)], self._states + moment.later, chain.slots, chain.own,
                places, bound.strides, *work, self.like, 0, *self.loops, 0, False, self.size, begin, end,
            )  # fmt: skip

        threads = 1 if self._small else pool.count(self.count)
        if threads == 1:
            part(0, self.groups, self.work)
        else:
            new = self.kernel, self.slots, self.real
            pool.split(lambda begin, end: part(begin, end, workspaces(*new)), self.groups, 1, threads)
        return self._finished(later, outputs, clock, bound)

    def _decide(self, moment: Moment, now: Tensor, pointers: Mapping[str, int], tape: bool) -> None:
        """Let vehicles come, go and change lanes in the rows whose turn it is; and lay out who is elsewhere now."""
        bound, lanes = moment.bound, moment.lanes
        assert isinstance(bound, LaneBound) and isinstance(lanes, Crossing)
        phase = moment.clock % self.every
        if self.turn is not None:
            lanes.turned = np.flatnonzero(phase == 0)
        if self.found is not None:
            due = phase == 0 if len(self.stages) == 1 else np.isin(phase, self.stages)
            lanes.decided = np.flatnonzero(due)
        lanes.mid, lanes.whole_mid = now, lanes.whole
        chain = lanes.chain
        if chain is None:
            room = self.rows * self.places
            slots, led = np.zeros(room, np.int64), np.zeros(room, self.real)
            own, stale = np.zeros(self.count, np.int64), np.ones(self.rows, np.bool_)
            chain = lanes.chain = Chain(slots, own, led, led.copy(), led.copy(), stale)
        try:
            if len(lanes.turned) or len(lanes.decided):
                self._change(moment, now, pointers, phase, tape)
            anew = chain.stale.copy()
            anew[lanes.turned] = anew[lanes.decided] = True
            rows = np.flatnonzero(anew)
            if len(rows):
                if lanes.kept:
                    chain = lanes.chain = chain.copy()
                if not lay_out(
                    lanes.whole_mid, self._view(lanes.mid, "position"), self._view(lanes.mid, "present"), self.coming,
                    rows, self.size, self.road.count, self.ring, self.halo, self.places, self.tables[2], chain.slots,
                    chain.own, chain.led, chain.leads, chain.ends,
                ):  # fmt: skip
                    raise Unordered("links are not the order of positions")
                chain.stale[:] = bool(self.said)
                chain.before, chain.serial = chain.serial, next(_SERIALS)
            bound.to_places(rows, chain, self, lanes.mid.data_ptr())
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
        step = {"state_step": moment.given["state_step"]}
        if self.turn is not None and len(lanes.turned):
            own = {n: address(x) for n, x in bound.turn_params.items()} | step
            stage = self._stage(bound, self.turn.loops, moment.now, lanes.whole, own, mid.data_ptr(), lanes.whole_mid)
            each_row(self.turn.loops.call, lanes.turned, stage)
        if self.settle is None or not len(lanes.decided):
            return
        plan, places, which, offsets, inputs, marks, (phase_at, constants) = bound.decides
        plan[which, lane_change_loops.ADDRESS] = offsets + mid.data_ptr()
        for i, name in inputs:
            plan[i, lane_change_loops.ADDRESS] = pointers[name]
        if not self.ring:
            mark_led(lanes.decided, self.size, *lanes.whole_mid[1:3], marks["led"], marks["leads"])
        lanes.fresh = np.zeros(self.count, np.uint8)
        sees = self.task.simulator.sees_mergers
        lanes.merger = np.tile(np.arange(self.size), self.rows if sees else 0)
        order, begin = np.empty(self.count, np.int64), np.empty(self.rows * (self.road.count + 1), np.int64)
        if not lane_change_loops.decide(
            lanes.whole_mid[: len(LINKS)], self._view(mid, "position"), self._view(mid, "present"), self.coming,
            lanes.decided, phase[lanes.decided], self.size, self.road.count, self.ring, self.road.handed == "left",
            self.tables, plan, places, phase_at, constants, len(self.found.slots), lanes.fresh, lanes.merger,
            self.turns, order, begin,
        ):  # fmt: skip
            raise Unordered("links are not the order of positions")
        own = {"fresh": address(lanes.fresh), "merger": address(lanes.merger), **step}
        stage = self._stage(bound, self.settle.loops, mid.data_ptr(), lanes.whole_mid, own, mid.data_ptr(), None)
        each_row(self.settle.loops.call, lanes.decided, stage)

    def _stage(
        self, bound: LaneBound, loops: RowFunction, now: int, whole: Array, own: Mapping[str, int], to: int,
        whole_to: Array | None,
    ) -> Array:  # fmt: skip
        """Return the table of a stage that reads blocks at ``now`` and writes what it changes to those at ``to``."""
        layout = bound.laid.layout
        held = self._tables.get(id(loops))
        if held is None or held[0] != layout.version:
            held = self._tables[id(loops)] = (layout.version, _Table(loops, layout, self.pitch))
        pointers = {**self._named(whole, ""), **own}
        pointers |= {f"then_{n}": to + i * self.pitch for i, n in enumerate(layout.blocks)}
        if whole_to is not None:
            pointers |= self._named(whole_to, "then_")
        return held[1].filled(now, 0, pointers)

    def _named(self, whole: Array, prefix: str) -> dict[str, int]:
        """Return the addresses of whole numbers by name."""
        first, pitch = address(whole), whole.strides[0]
        return {f"{prefix}{n}": first + i * pitch for i, n in enumerate(self.whole)}

    def _view(self, blocks: Tensor, name: str) -> Array:
        """Return one block as an array; an empty one for presence where everybody is there."""
        if name == "present" and not self.coming:
            return self.like
        return blocks.detach()[self.layout.blocks.index(f"state_{name}")].reshape(-1).numpy()  # type: ignore[no-any-return]

    def _drawn(self, moment: Moment) -> dict[str, int]:
        """Return where this step's normals are."""
        step = moment.at * self.pitch
        return {n: address(x) + step for n, x in (moment.normals or {}).items()}

    def _operands(self, bound: LaneBound, pointers: Mapping[str, int]) -> Array:
        """Return the addresses of states and operands by place."""
        if not bound.given:
            return bound.places
        places = bound.places.copy()
        for place, name in bound.given.items():
            places[place] = pointers[name]
        return places

    # -- backwards -----------------------------------------------------------------------------------------------

    @cached_property
    def scratch(self) -> Scratch:
        """Memory of the adjoint."""
        return LaneScratch(self)

    def back(
        self, moment: Moment, on_told: Mapping[str, Tensor | None], on_later: Tensor | None, on_past: Array | None
    ) -> tuple[Array, Array | None, Array, Array]:
        """Return what falls on the world's blocks, on actions and on parameters ``(parameters, vehicles)``.

        The rest is as in ``Plan.back``.
        """
        bound, lanes, room = moment.bound, moment.lanes, self.scratch
        assert isinstance(bound, LaneBound) and isinstance(lanes, Crossing) and isinstance(room, LaneScratch)
        assert lanes.mid is not None and lanes.chain is not None
        assert lanes.whole_mid is not None and lanes.whole_later is not None
        whole = self._named(lanes.whole, "") | self._named(lanes.whole_later, "later_")
        on_now, on_action, pointers = self._seeded(moment, on_told, on_later, room)
        on_parameters = np.zeros((len(self.kernel.program.parameters), self.count), self.real)
        pointers |= whole
        flow = room.flows
        flow.begin()
        recorded, tables = self.recorded, bound.laid.back
        before, after = recorded.backward
        all_rows(after.call, self.rows, tables[1].filled(moment.now, moment.later, pointers))
        if self.place is not None and self.said and lanes.placed is not None:
            own = {"fresh": address(lanes.placed), "state_step": pointers["later_state_step"]}
            self._through(bound, self.place, np.arange(self.rows), moment.later, lanes.whole_later, own, flow, None)
        mid, chain, n = lanes.mid.data_ptr(), lanes.chain, self.size
        inputs_at = moment.given | self._drawn(moment)
        bound._moving.copy(np.arange(self.rows), chain, self, mid, inputs_at)
        bound.forget()
        bound.to_places(np.arange(self.rows), chain, self, mid)
        room.clear()
        slots = np.concatenate((flow.then(), room.on_input_slots, addresses(list(on_parameters))))
        retreat_chains(
            flow.now(), room.ends, room.sums, slots, chain.slots, chain.own, n, self._operands(bound, inputs_at),
            bound.strides, *room.work, self.like, 0, room.ends, room.begins, address(room.by_place),
            address(room.inputs_by_place), *room.loops, 0, 0, self.groups,
        )  # fmt: skip
        flow.turn()
        if self.settle is not None and len(lanes.decided):
            assert lanes.fresh is not None and lanes.merger is not None
            own = {
                "fresh": address(lanes.fresh),
                "merger": address(lanes.merger),
                "state_step": pointers["state_step"],
            }
            self._through(bound, self.settle, lanes.decided, mid, lanes.whole_mid, own, flow, None)
        if self.turn is not None and len(lanes.turned):
            own = {n: address(x) for n, x in bound.turn_params.items()} | {"state_step": pointers["state_step"]}
            self._through(bound, self.turn, lanes.turned, moment.now, lanes.whole, own, flow, on_parameters)
        pointers |= {f"carried_{n}": x for n, x in zip(self.moving, flow.now(), strict=True)}
        all_rows(before.call, self.rows, tables[0].filled(moment.now, moment.later, pointers))
        return on_now, on_action, on_parameters, np.empty((0, self.count), self.real)

    def _through(
        self, bound: LaneBound, stage: Stage, rows: Array, now: int, whole: Array, own: Mapping[str, int], flow: Flow,
        on_parameters: Array | None,
    ) -> None:  # fmt: skip
        """Carry what falls on the leaves after a stage to those before it, in some rows."""
        flow.copy()
        pointers = dict(own)
        pointers |= {f"pass_{n}": x for n, x in zip(self.moving, flow.now(), strict=True)}
        pointers |= {f"new_{n}": x for n, x in zip(self.moving, flow.then(), strict=True)}
        more = np.zeros((len(stage.more), self.count), self.real)
        pointers |= {f"new_{n}": x for n, x in zip(stage.more, addresses(list(more)), strict=True)}
        each_row(stage.back.call, rows, self._stage(bound, stage.back, now, whole, pointers, 0, None))
        flow.turn()
        if on_parameters is not None:
            on_parameters += more


class Flow:
    """What falls on the moving leaves of worlds, twice: before and after a stage of the adjoint, by turns."""

    def __init__(self, count: int, moving: int, kind: Any) -> None:
        self._held = np.zeros((2, moving, count), kind)
        self._at = [addresses(list(x)) for x in self._held]
        self._first = 0

    def now(self) -> Array:
        """Return where it lies now."""
        return self._at[self._first]

    def then(self) -> Array:
        """Return where it is carried to."""
        return self._at[1 - self._first]

    def turn(self) -> None:
        """Let what was carried be what lies there now."""
        self._first = 1 - self._first

    def copy(self) -> None:
        """Carry everything as it is."""
        np.copyto(self._held[1 - self._first], self._held[self._first])

    def clear(self) -> None:
        """Empty the room to which is carried."""
        self._held[1 - self._first] = 0

    def begin(self) -> None:
        """Begin with the first room."""
        self._first = 0


class LaneScratch(Scratch):
    """Memory of the adjoint of a plan of lanes: by slot and by place."""

    def __init__(self, plan: LanePlan) -> None:
        super().__init__(plan)
        room, real, moving = plan.rows * plan.places, plan.real, len(plan.moving)
        self.flows = Flow(plan.count, moving, real)
        self.there |= {f"end_{n}": x for n, x in zip(plan.moving, self.flows.now(), strict=True)}
        inputs, parameters = len(plan.kernel.numbers), len(plan.kernel.program.parameters)
        self._ends, self._begins = (np.zeros((moving, room), real) for _ in range(2))
        self.inputs_by_place, self.by_place = np.zeros((inputs, room), real), np.zeros((parameters, room), real)
        self.ends, self.begins = addresses(list(self._ends)), addresses(list(self._begins))
        self.on_input_slots = addresses(list(self.on_inputs))
        self.sums = np.concatenate((self.begins, addresses(list(self.inputs_by_place)), addresses(list(self.by_place))))

    def clear(self) -> None:
        """Empty what is added to."""
        self.flows.clear()
        self.on_inputs[:] = 0
        self.by_place[:] = 0


__all__ = ["WHOLE", "Chain", "Crossing", "LanePlan"]
