"""A step of a batch on several lanes: who comes and goes and changes lanes, then the whole step as on one lane.

Choices are frozen; what they do to gaps and memories is recorded as everything else, with its adjoint.

Shapes: worlds are blocks ``[rows · vehicles]`` of every leaf, and as many whole numbers; rows are indices ``[k]``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from idm_env.compiled.kernels import lane_change_loops
from idm_env.compiled.kernels.lane_changes import KINDS, Deciding, decision, looked_at, rows_of, side_of
from idm_env.compiled.kernels.lanes import static_of
from idm_env.compiled.kernels.operands import operand
from idm_env.compiled.kernels.rows import RowFunction, adjoint, storage
from idm_env.compiled.scalar.record import Form, Unordered, Untraceable
from idm_env.delay_buffer import PAST
from idm_env.envs.moves import Moves
from idm_env.envs.transition import CompiledTransition, Tables, WholeStep
from idm_env.envs.worlds import WHOLE, Array, Frame, Group, Layout, Moment, Room, RowTable, address, named, world_of
from idm_env.multilane.demand import turned
from idm_env.multilane.incentives import seen_merging
from idm_env.roads import Lanes
from idm_env.roads.merging import on_lanes
from idm_env.tasks import EnvState
from idm_env.types import LINKS, Params


@dataclass
class Crossing:
    """What becomes of lanes in one step: worlds after decisions, blocks and whole numbers, and these after the step.

    ``turned`` are rows in which vehicles may come and go, and ``decided`` those in which lanes were decided about;
    ``fresh`` marks new leaders then, and ``merger`` who signals beside whom. ``later`` are whole numbers after every
    step until the next one like this.
    """

    mid: Tensor
    whole_mid: Array
    later: list[Array]
    turned: Array = field(default_factory=lambda: np.empty(0, np.int64))
    decided: Array = field(default_factory=lambda: np.empty(0, np.int64))
    fresh: Array = field(default_factory=lambda: np.empty(0, np.bool_))
    merger: Array = field(default_factory=lambda: np.empty(0, np.int64))


class Stage:
    """A function of worlds that changes some of their leaves, as loops over rows, and its adjoint.

    ``function`` returns the leaves that it changes; gradients flow through blocks and to the leaves ``more``, which are
    no part of worlds.
    """

    def __init__(
        self, plan: LaneTransition, function: Callable[..., dict[str, Tensor]], examples: Mapping[str, Tensor],
        many: int, more: Sequence[str] = (),
    ) -> None:  # fmt: skip
        self.plan, self.more, self._many = plan, tuple(more), many
        self._function, self._examples = function, examples
        self.loops = RowFunction(self._then, examples, many)
        self._forward: tuple[Any, Any] = None, None

    def _then(self, **leaves: Tensor) -> dict[str, Tensor]:
        return {f"then_{n}": x for n, x in self._function(**leaves).items()}

    @cached_property
    def back(self) -> RowFunction:
        """The adjoint: from ``pass_NAME``, what falls on the leaves afterwards, to ``new_NAME`` before."""
        blocks = self.plan.layout.blocks
        passes = {f"pass_{n}": self._examples[n].clone() for n in blocks}
        changed = [n for n in blocks if f"then_{n}" in self.loops.outs]
        back = adjoint(self._then, [f"then_{n}" for n in changed], [*blocks, *self.more])

        def through(**leaves: Tensor) -> dict[str, Tensor]:
            passed = {n: leaves.pop(f"pass_{n}") for n in blocks}
            gradients = back(**leaves, **{f"on_then_{n}": passed[n] for n in changed})
            past = {n: 0.0 * x if n in changed else x for n, x in passed.items()}
            before = {n: gradients[n] + x if n in gradients else x.clone() for n, x in past.items()}
            before |= {n: gradients[n] for n in self.more if n in gradients}
            return {f"new_{n}": x for n, x in before.items()}

        return RowFunction(through, {**self._examples, **passes}, self._many)

    def run(self, still: Mapping[str, Array], rows: Array, own: Mapping[str, int], *begins: int) -> None:
        """Change some rows (indices): blocks and whole numbers before it, and those after it, begin there."""
        if self._forward[0] is not still:
            self._forward = still, RowTable(self.loops, still, self.plan.groups("") + self.plan.groups("then_"))
        table, _ = self._forward[1].laid(begins, lambda: (own, *begins), own)
        lane_change_loops.each_row(self.loops.call, rows, table)

    def through(
        self, still: Mapping[str, Array], rows: Array, own: Mapping[str, int], begins: Sequence[int], on: Array
    ) -> tuple[Array, Array]:
        """Return what falls on blocks before the stage and on ``more``, from what falls on those after it."""
        blocks, pitch, before = self.plan.layout.blocks, self.plan.pitch, on.copy()
        more = np.zeros((len(self.more), self.plan.count), on.dtype)
        groups = *self.plan.groups(""), ("pass_", blocks, pitch), ("new_", blocks, pitch), ("new_", self.more, pitch)
        table = RowTable(self.back, still, groups).filled(own, *begins, address(on), address(before), address(more))
        lane_change_loops.each_row(self.back.call, rows, table)
        return before, more


class Looks:
    """The rows of wishes to change lanes, as loops over worlds: all that drivers look at, but parameters.

    They see worlds after some have come and gone, and commands that agents have given in those before. ``wishes`` is
    None where nobody changes lanes.
    """

    def __init__(self, step: WholeStep, plan: LaneTransition) -> None:
        simulator, like, moves = plan.task.simulator, plan.world, plan.moves

        def inputs_of(**leaves: Tensor) -> Any:
            normals = {n.removeprefix("normal_"): x for n, x in leaves.items() if n.startswith("normal_")}
            return moves.commanded(world_of(leaves, like), leaves.get("action"), normals or None, leaves.get("live"))[2]

        def looked(**leaves: Tensor) -> dict[str, Tensor]:
            state = world_of({**leaves, **{n: leaves[f"mid_{n}"] for n in step.changing}}, like).state
            out, inputs = dict[str, Tensor](), inputs_of(**leaves)
            for name in self.names:
                x = looked_at(simulator, state, inputs, {}, name).to(state.speed.dtype)
                out[name.replace(" ", "_")] = x.expand(step.many, x.shape[-1] if x.dim() else 1)
            return out

        form = Form.of(like.state._replace(lanes=None), torch.no_grad()(inputs_of)(**step.inputs))
        self.wishes: Any = decision(simulator, form) if simulator.lane_change_models else None
        if isinstance(self.wishes, str):
            raise Untraceable(self.wishes)
        slots = () if self.wishes is None else self.wishes.slots
        self.names = {name: None for slot in slots if (name := side_of(slot)[1]) not in KINDS and "." not in name}
        self.loops = RowFunction(looked, step.inputs, step.many)
        self.arrays = Room(self.loops, plan.rows, self.loops.outs).arrays


class LaneTables(Tables):
    """What parameters give, on several lanes: also what drivers look at who think of changing lanes."""

    plan: LaneTransition

    def __init__(self, plan: LaneTransition, layout: Layout, params: Params) -> None:
        super().__init__(plan, layout, params)
        self.by_record = any(n.startswith("then_links") for n in self.recorded.forward.outs)
        """Whether a step itself writes who leads whom."""
        looks, self._arrays = plan.looks, list[Array]()
        self.ask = RowTable(looks.loops, layout.still | looks.arrays, plan.before)
        self.decides: Any = None if looks.wishes is None else rows_of(looks.wishes.slots, self._find)
        """The rows of wishes: where their numbers lie, and whose they are."""

    def _find(self, i: int, name: str) -> tuple[int, int, int]:
        """Return where the numbers of a row of wishes lie, and their strides by row and vehicle."""
        plan, array = self.plan, self.plan.looks.arrays.get(name.replace(" ", "_"))
        if array is not None:
            return address(array), array.shape[-1], int(array.shape[-1] == plan.size)
        x = static_of(plan.task.simulator, plan.world.state, self.params, name).to(plan.world.state.speed.dtype)
        array, (_, *by) = operand(x, (plan.rows,), plan.size)
        self._arrays.append(array)
        return address(array), *by  # type: ignore[return-value]


class LaneTransition(CompiledTransition):
    """Steps on several lanes, as ``CompiledTransition``."""

    worlds = ("", "mid_")

    def __init__(self, moves: Moves, world: EnvState, *others: Any) -> None:
        simulator, road = moves.task.simulator, moves.task.simulator.road
        assert isinstance(road, Lanes)
        self.road = road
        if road.duration:
            raise Untraceable("compiled changes take no time, and Lanes has a duration")
        if PAST in world.state.memory:
            raise Untraceable("an effect looks back, where vehicles change lanes")
        self.ring = float(self.road.ring or 0.0)
        self._whole = [n for n in WHOLE if n in named(world)]
        super().__init__(moves, world, *others)
        self.deciding = Deciding(simulator, self.rows, self.size, self.real)
        self._absent = np.empty(0, self.real)
        self._turns: dict[WholeStep, Stage] = {}
        self._stages = np.unique(self.deciding.turns) if simulator.decides_in_blocks else np.zeros(1, np.int64)
        self._turns_at, self._every = np.append(self._stages, 0)[:, None], simulator.decides_after
        self._mid = torch.empty(len(self.layout.blocks), self.rows, self.size, dtype=world.state.speed.dtype)

    def groups(self, prefix: str) -> tuple[Group, ...]:
        """Return how worlds lie: blocks, and whole numbers."""
        return *super().groups(prefix), (prefix, self._whole, self.count * np.dtype(np.int64).itemsize)

    # -- what is recorded beside ---------------------------------------------------------------------------------

    def _tables(self, layout: Layout, params: Params) -> Tables:
        """Lay out what parameters give."""
        step = self.recorded(params)
        if self.world.state.present is not None and step not in self._turns:
            self._turns[step] = Stage(self, self._turned(step), step.sample, step.many, step.wanted)
        return LaneTables(self, layout, params)

    @cached_property
    def looks(self) -> Looks:
        """The rows of wishes to change lanes. Untraceable where they, or a wish, cannot be recorded."""
        return Looks(next(iter(self._recorded.values())), self)

    @cached_property
    def settle(self) -> Stage:
        """The stage of gaps to new leaders, and of who signals, after a decision."""
        step = next(iter(self._recorded.values()))
        examples = {n: x for n, x in step.sample.items() if n not in step.parameters}
        like = torch.zeros(step.many, self.size, dtype=torch.int64)
        sees = {"merger": like} if self.task.simulator.sees_mergers else {}
        return Stage(self, self._settled, {**examples, "fresh": like == 0, **sees}, step.many)

    def _turned(self, step: WholeStep) -> Callable[..., dict[str, Tensor]]:
        """Return the function of what changes where vehicles come and go."""

        def changed(**leaves: Tensor) -> dict[str, Tensor]:
            world = world_of(leaves, self.world)
            now = torch.ones_like(world.state.speed[..., :1], dtype=torch.bool)
            after = turned(self.task.simulator, world.state, step.params_of(leaves), now)
            return {n: x for n, x in named(world._replace(state=after)).items() if storage(x) != storage(leaves[n])}

        return changed

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

    def until(self, clock: Array) -> int:
        """Return the number of steps before the next one at which vehicles change lanes, come or go."""
        return int(((self._turns_at - clock) % self._every).min())

    def columns(self, moment: Moment, now: Frame, begins: Array, later: Array) -> tuple[Array, ...]:
        """Decide about lanes; return where worlds begin: before decisions, after them, and after each step."""
        moment.begins = self._decided(moment, now)
        whole = moment.crossing.later
        whole += [whole[0].copy() if moment.bound.by_record else whole[0] for _ in later[1:]]
        after = np.array([address(x) for x in whole])
        blocks, wholes = (
            np.concatenate(([x], y)) for x, y in zip(moment.begins[2:4], (begins[1:], after[:-1]), strict=True)
        )
        return begins, np.concatenate((moment.begins[1:2], after[:-1])), blocks, wholes, later, after

    def begins(self, moment: Moment, now: Frame, later: Frame) -> tuple[int, ...]:
        """Decide about lanes; return where worlds begin: before decisions, after them, and after the step.

        Unordered, with nothing changed, where links are not the order of positions.
        """
        return *self._decided(moment, now), later.at, address(moment.crossing.later[0])

    def _decided(self, moment: Moment, now: Frame) -> tuple[int, ...]:
        """Decide about lanes; return where worlds begin, before it and after it."""
        bound, whole = moment.bound, moment.whole
        assert isinstance(bound, LaneTables) and whole is not None
        lanes = moment.crossing = Crossing(now.blocks, whole, [])
        phase = moment.clock % self._every
        if bound.recorded in self._turns:
            lanes.turned = np.flatnonzero(phase == 0)
        if self.looks.wishes is not None:
            lanes.decided = np.flatnonzero(np.isin(phase, self._stages) if len(self._stages) > 1 else phase == 0)
        begins = after = now.at, address(whole)
        if len(lanes.turned) or len(lanes.decided):
            spare: Any = None if moment.spare is None else (self._mid, moment.spare)
            lanes.mid, lanes.whole_mid = spare or (torch.empty_like(now.blocks), np.empty_like(whole))
            lanes.whole_mid[:] = whole
            lanes.mid.copy_(now.blocks.detach())
            after, step = (lanes.mid.data_ptr(), address(lanes.whole_mid)), {"state_step": address(moment.clock)}
            if len(lanes.turned):
                self._turns[bound.recorded].run(bound.still, lanes.turned, step, *begins, *after)
            if len(lanes.decided):
                self._decide(moment, bound, phase[lanes.decided], begins + after)
                self.settle.run(bound.still, lanes.decided, self._decision_inputs(moment), *after, *after)
        lanes.later = [lanes.whole_mid.copy() if bound.by_record else lanes.whole_mid]
        return begins + after

    def _decision_inputs(self, moment: Moment) -> dict[str, int]:
        """Return the addresses of what ``_settled`` is given beside worlds."""
        own = {"fresh": address(moment.crossing.fresh), "merger": address(moment.crossing.merger)}
        return own | {"state_step": address(moment.clock)}

    def _decide(self, moment: Moment, bound: LaneTables, stages: Array, begins: tuple[int, ...]) -> None:
        """Let vehicles change lanes, in the worlds after some have come and gone."""
        lanes = moment.crossing
        pointers = self.pointers(moment)
        cells, _ = bound.ask.laid(begins, lambda: (pointers, *begins), pointers)
        lane_change_loops.each_row(self.looks.loops.call, lanes.decided, cells)
        blocks = dict(zip(self.layout.blocks, lanes.mid.view(len(lanes.mid), -1).numpy(), strict=True))
        world = lanes.whole_mid[: len(LINKS)], blocks["state_position"], blocks.get("state_present", self._absent)
        choices = self.deciding.decide(self.looks.wishes, world, (lanes.decided, stages), bound.decides)
        if choices is None:
            raise Unordered("links are not the order of positions")
        lanes.fresh, lanes.merger = choices[:2]

    # -- backwards -----------------------------------------------------------------------------------------------

    def first(self, moment: Moment, on_worlds: Sequence[Array], on_parameters: Array) -> Array:
        """Return the gradient of worlds before decisions, and add that of parameters in them."""
        bound, lanes, (on, between) = moment.bound, moment.crossing, on_worlds
        assert isinstance(bound, LaneTables)
        if len(lanes.decided):
            mid = lanes.mid.data_ptr(), address(lanes.whole_mid)
            between, _ = self.settle.through(bound.still, lanes.decided, self._decision_inputs(moment), mid, between)
        if len(lanes.turned):
            step = {"state_step": address(moment.clock)}
            turn = self._turns[bound.recorded]
            between, more = turn.through(bound.still, lanes.turned, step, moment.begins[:2], between)
            on_parameters += more
        return on + between  # type: ignore[no-any-return]
