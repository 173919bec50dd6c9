"""A step of a batch: one function of worlds, recorded whole with torch's derivative (``kernels.rows``).

What an environment does between two observations is in ``moves``; nothing of it is written twice. On several lanes
decisions come first (``lane_transition``). What holds for many steps is laid out once; a call hands over addresses.

Shapes: worlds are blocks ``[rows · vehicles]`` of every leaf, parameters ``[rows, 1]`` or ``[rows, vehicles]``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cached_property, partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from idm_env.compiled.kernels import threads as pool
from idm_env.compiled.kernels.past_in_place import Stepper
from idm_env.compiled.kernels.reads import Reads
from idm_env.compiled.kernels.rows import RowFunction, adjoint, storage
from idm_env.compiled.kernels.sameness import digest
from idm_env.compiled.kernels.window_loop import each_table
from idm_env.compiled.scalar.record import Unordered, Untraceable
from idm_env.delay_buffer import PAST
from idm_env.envs.moves import Moves
from idm_env.envs.past import ROOM, Array
from idm_env.envs.settings import INFO
from idm_env.envs.worlds import WHOLE, Frame, Layout, Moment, Room, RowTable, address, named, row_addresses, world_of
from idm_env.tasks import EnvState
from idm_env.types import Params, State

_ROWS = (1009, 1013, 1019, 1021, 1031)
"""Numbers of rows of a recording: one that is no other dimension tells rows apart from everything else."""
_BLOCK = 8
"""Rows that do all steps of an action before the next ones."""

Form = tuple[tuple[str, str, bool, bool], ...]
"""Parameters as a recording knows them: effect, name, whether vehicles differ, and whether a gradient is wanted."""


class WholeStep:
    """A step of worlds as a function of rows, and its adjoint.

    ``kind`` says whether nobody acts, and whether all actions count; ``told`` are the outputs beside worlds.
    """

    def __init__(
        self, moves: Moves, world: EnvState, layout: Layout, kind: tuple[bool, bool], draws: Sequence[str], form: Form
    ) -> None:
        (idle, every), task, like, blocks = kind, moves.task, world.state, layout.blocks
        self._world, self._blocks, self._draws = world, blocks, tuple(draws)
        size, agents = like.speed.shape[-1], len(task.agents)
        many = self.many = next(p for p in _ROWS if p not in (size, agents))
        real = like.speed.dtype
        self.sample = inputs = {
            n: x.detach()[:1].expand(many, *x.shape[1:]).contiguous() for n, x in named(world).items()
        }
        # On several lanes vehicles drive in the worlds after decisions: agents have commanded in those before.
        self.changing = [] if like.lanes is None else [*blocks, *(n for n in WHOLE if n in inputs)]
        inputs = inputs | {f"mid_{n}": inputs[n].clone() for n in self.changing}
        if not idle:
            inputs["action"] = torch.zeros(many, agents * len(task.commands), dtype=real)
        if not (idle or every):
            inputs["live"] = torch.ones(many, agents, dtype=torch.bool)
        inputs |= {f"normal_{n}": torch.zeros(many, size, dtype=real) for n in draws}
        self.parameters = {f"p{i}": (e, p) for i, (e, p, _, _) in enumerate(form)}
        wide = {f"p{i}": size if per_vehicle else 1 for i, (_, _, per_vehicle, _) in enumerate(form)}
        self.sample = self.sample | {n: torch.ones(many, count, dtype=real) for n, count in wide.items()}
        inputs |= {n: self.sample[n] for n in wide}
        self.wanted = [f"p{i}" for i, (_, _, _, flows) in enumerate(form) if flows]
        if task.held > 1:
            inputs["looks"] = torch.ones(many, dtype=torch.bool)
        past, pitches = like.memory.get(PAST), {}
        if past is not None:
            slots, count = past.shape[-2:]
            pitches["then_past"] = (slots + ROOM) * count * size
            room = torch.zeros(many, slots + ROOM, count, size, dtype=real)
            inputs["past"] = room[:, :slots].movedim(-1, 1)
        self.inputs, self._moves = inputs, moves
        flowing = [*blocks, *(f"mid_{n}" for n in blocks if self.changing)]
        self._by = [*flowing, *(n for n in ("action", "past") if n in inputs), *self.wanted]
        simulator = task.simulator
        self._stepper = Stepper(simulator.road, simulator.effects, simulator.dt, simulator.integration)
        seldom = ("observation", *(f"info_{n}" for n in INFO if n != "rewards")) if task.held > 1 else ()
        when = "looks", "whole_terminated", "whole_truncated"
        self.forward = RowFunction(self._step, inputs, many, pitches=pitches, seldom=seldom, when=when)
        self.told = [n for n in self.forward.outs if not n.startswith("then_")]

    def _step(self, **leaves: Tensor) -> dict[str, Tensor]:
        """Return the worlds Δt later and what is told."""
        world = world_of(leaves, self._world)
        if "past" in leaves:
            memory = {**world.state.memory, PAST: leaves["past"]}
            world = world._replace(state=world.state._replace(memory=memory))
        mid, task = {n: leaves[f"mid_{n}"] for n in self.changing}, self._moves.task
        driving = world_of({**leaves, **mid}, self._world).state if mid else world.state

        def drive(_: State, inputs: Any, params: Params) -> State:
            return self._stepper.step(driving, inputs, params)

        normals = {n: leaves[f"normal_{n}"] for n in self._draws} or None
        operands = leaves.get("action"), leaves.get("live"), normals, self.params_of(leaves)
        after, outputs = self._moves.by(drive).step(world, *operands)
        later = named(after)
        out = {f"then_{n}": later[n] for n in self._blocks} | outputs | {"clock": after.state.step}
        whole = self.changing[len(self._blocks) :]
        out |= {f"then_{n}": later[n] for n in whole if storage(later[n]) != storage(mid[n])}
        if task.journeys:
            out["on_road"] = task.there(after.state, torch.ones_like(outputs["terminated"]))
        return out | ({"then_past": self._stepper.looked[0].now} if "past" in leaves else {})  # type: ignore[return-value]

    def refuse_chance(self, graph: bool) -> None:
        """Record the adjoint, too, of the same values; Untraceable for a step that is another one at every call.

        So it is, with a ``graph``, for a tensor that requires a gradient and is no parameter (``digest``).
        """
        if len({digest(self._step, self.inputs, {}, gradients=graph) for _ in range(2)}) > 1:
            raise Untraceable("a function of one's own does something else at every call")
        _ = self.backward if graph else None

    def params_of(self, leaves: Mapping[str, Tensor]) -> dict[str, dict[str, Tensor]]:
        """Return parameters as a simulator takes them."""
        params: dict[str, dict[str, Tensor]] = {e.name: {} for e in self._moves.task.simulator.effects}
        for name, (effect, own) in self.parameters.items():
            params.setdefault(effect, {})[own] = leaves[name]
        return params

    @cached_property
    def flowing(self) -> list[str]:
        """What is told with a derivative."""
        with torch.enable_grad():
            out = self._step(**{n: x.detach().requires_grad_(n in self._by) for n, x in self.inputs.items()})
        return [n for n, x in out.items() if x.requires_grad and not n.startswith("then_")]

    @cached_property
    def backward(self) -> RowFunction:
        """What falls on worlds, actions, wanted parameters and the past from what falls on outputs (``on_NAME``).

        ``on_past`` falls on the past after the step. Untraceable where torch's derivative cannot be recorded.
        """
        inputs, flowing, blocks = self.inputs, self.flowing, [f"then_{n}" for n in self._blocks]
        past = ["then_past"] if "past" in inputs else []
        back = adjoint(self._step, [*blocks, *flowing, *past], self._by)
        out = self._step(**inputs)
        seeds = {f"on_{n}": torch.zeros_like(out[n]).contiguous() for n in (*blocks, *flowing)}
        if past:
            seeds["on_past"] = torch.zeros_like(inputs["past"].movedim(1, -1)).contiguous()

        def pulled(**leaves: Tensor) -> dict[str, Tensor]:
            on_past = leaves.pop("on_past", None)
            gradients = back(**leaves, **({} if on_past is None else {"on_then_past": on_past[:, 0]}))
            to = {f"to_{n}": gradients.get(n, torch.zeros_like(leaves[n])) for n in self._by if n != "past"}
            if on_past is not None:
                carried = torch.cat((on_past[:, 1:], torch.zeros_like(on_past[:, :1])), dim=1)
                own = gradients.get("past")
                to["to_past"] = carried if own is None else carried + own.movedim(1, -1)
            return to

        return RowFunction(pulled, {**inputs, **seeds}, self.many)


class Tables:
    """What parameters give: the tables of a recording, with the arrays of parameters.

    ``wanted`` are those that require a gradient, with their numbers.
    """

    def __init__(self, plan: CompiledTransition, layout: Layout, params: Params) -> None:
        self.plan, self.layout, self.params = plan, layout, params
        self.recorded = recorded = plan.recorded(params)
        self.still = {**layout.still, **{n: self._array(params[e][p]) for n, (e, p) in recorded.parameters.items()}}
        self._forward = (*plan.before, *plan.groups("then_"))
        self._watched = [(own, p, x, x._version) for own in params.values() for p, x in own.items()]
        names = [recorded.parameters[n] for n in recorded.wanted]
        self.wanted = [(i, params[e][p]) for i, (e, p) in enumerate(names)]
        self.room = Room(recorded.forward, plan.rows, [n for n in recorded.told if n != "clock"])

    def _array(self, x: Tensor) -> Array:
        wide = self.plan.size if _wide(x) else 1
        x = x.detach().to(self.plan.world.state.speed.dtype)
        return np.array(x.expand(self.plan.rows, wide).numpy(), order="C")

    @cached_property
    def ahead(self) -> RowTable:
        """The table of windows, which have arrays of their own for what is told."""
        return RowTable(self.recorded.forward, self.still, self._forward)

    @cached_property
    def once(self) -> RowTable:
        """The table of single steps."""
        return RowTable(self.recorded.forward, self.still | self.room.arrays, self._forward)

    @cached_property
    def together(self) -> tuple[Tensor, Array, dict[str, Array], dict[str, Array]]:
        """Memory for the steps of one action: worlds, clocks, what is told ``[steps, …]``, and where that begins."""
        steps, world = self.plan.task.held, (len(self.layout.blocks), self.plan.rows, self.plan.size)
        outputs, clocks = self.room.take(steps), np.empty((steps, self.plan.rows), np.int64)
        places = {n: row_addresses(x, np.arange(steps)) for n, x in (outputs | {"clock": clocks}).items()}
        return torch.from_numpy(np.empty((steps, *world), self.plan.real)), clocks, outputs, places

    @cached_property
    def back(self) -> RowTable:
        """The table of the adjoint."""
        pitch, blocks = self.plan.pitch, self.layout.blocks
        groups = [(prefix, blocks, pitch) for prefix in ("on_then_", *(f"to_{n}" for n in self.plan.worlds))]
        groups = [*self.plan.before, *groups, ("to_", tuple(self.recorded.wanted), pitch)]  # type: ignore[list-item]
        return RowTable(self.recorded.backward, self.still, groups)

    def with_values(self, values: Sequence[Tensor]) -> dict[str, dict[str, Tensor]]:
        """Return the parameters with others in place of those that are ``wanted``."""
        params = {effect: dict(own) for effect, own in self.params.items()}
        for name, x in zip(self.recorded.wanted, values, strict=True):
            effect, parameter = self.recorded.parameters[name]
            params[effect][parameter] = x
        return params

    def changed(self) -> bool:
        """Return whether a parameter is another tensor now, or was written to."""
        # A loop: a generator would cost as much again.
        for held, name, x, version in self._watched:  # noqa: SIM110
            if held[name] is not x or x._version != version:
                return True
        return False


class CompiledTransition:
    """Steps of worlds with or without actions (``kind`` as in ``WholeStep``), as laid out.

    Raises:
        Untraceable: For a task or a simulator that cannot be recorded.
    """

    reads: Reads | None = None
    """What functions of one's own read when the step was recorded."""
    graph = False
    """Whether steps may have a graph."""
    worlds: tuple[str, ...] = ("",)
    """How the names of the leaves of worlds begin from which a step is computed."""

    def __init__(
        self, moves: Moves, world: EnvState, layout: Layout, kind: tuple[bool, bool], draws: tuple[str, ...]
    ) -> None:
        self.moves, self.task, self.world, self.layout = moves, moves.task, world, layout
        self.rows, self.size = world.state.speed.shape
        self.real = np.dtype(np.float32 if world.state.speed.dtype == torch.float32 else np.float64)
        self.count = self.rows * self.size
        self.pitch = self.count * self.real.itemsize
        past = world.state.memory.get(PAST)
        self.past_shape = () if past is None else (self.rows, *past.shape[-2:], self.size)
        self.slot = math.prod(self.past_shape[2:]) * self.real.itemsize
        self._kind, self._draws, self._recorded = kind, draws, dict[Form, WholeStep]()
        self._bound: Tables | None = None
        self._normals: dict[str, tuple[Array, int]] = {}
        self._places: tuple[Array | None, ...] | None = None
        self._looked = np.full(self.rows, True), np.full(self.rows, False)
        self._looks = [address(x) for x in self._looked]
        self.threads = 1 if self.count < 2 * pool.GRAIN else pool.count(self.count)
        self.before = tuple(group for prefix in self.worlds for group in self.groups(prefix))

    def placed(self, *given: Any) -> tuple[Array | None, ...]:
        """Return actions and who acts, None where nobody does or all do, in memory that stays."""
        if self._places is None:
            self._places = tuple(None if x is None else np.asarray(x).copy() for x in given)
        for held, x in zip(self._places, given, strict=True):
            if held is not None:
                held[:] = x
        return self._places

    def groups(self, prefix: str) -> tuple[tuple[str, Sequence[str], int], ...]:
        """Return how worlds lie, whose leaves have names that begin so."""
        return ((prefix, self.layout.blocks, self.pitch),)

    def recorded(self, params: Params) -> WholeStep:
        """Return the step as recorded for such parameters; Unordered, if it changes its own values by being called."""
        form = tuple((e, p, _wide(x), x.requires_grad) for e, own in params.items() for p, x in own.items())
        if form not in self._recorded:
            step = WholeStep(self.moves, self.world, self.layout, self._kind, self._draws, form)
            if self.reads is not None and self.reads.watches:
                step.refuse_chance(self.graph)
                if self.reads.changed():
                    raise Unordered("a function of one's own changes what it reads")
            self._recorded[form] = step
        return self._recorded[form]

    def of(self, layout: Layout, params: Params) -> Tables:
        """Return what parameters give, laid out once for many steps."""
        bound = self._bound
        if bound is None or layout.version != bound.layout.version or bound.params is not params or bound.changed():
            bound = self._bound = self._tables(layout, params)
        return bound

    def _tables(self, layout: Layout, params: Params) -> Tables:
        """Lay out what parameters give."""
        return Tables(self, layout, params)

    # -- forwards ------------------------------------------------------------------------------------------------

    def run(self, moment: Moment, now: Frame, later: Frame, stays: bool) -> dict[str, Array]:
        """Do one step; return what is told, until the next call.

        ``stays`` says that worlds take turns in two places; else nothing that a step has read is written to later.
        Untraceable where an effect of the user's own returned NaN.
        """
        bound = moment.bound
        begins = moment.begins = self.begins(moment, now, later)
        clock = {"clock": later.clock_at}
        moment.given = self.moving(moment) if stays else self.pointers(moment) | clock
        key = begins if stays else None
        _, where = bound.once.laid(key, lambda: (self.pointers(moment) | clock, *begins), moment.given)
        self.split(bound.recorded.forward, where)
        self.refuse_nan(later.blocks)
        return bound.room.arrays

    def refuse_nan(self, worlds: Tensor) -> None:
        """Raise Untraceable where an effect of the user's own returned NaN: blocks ``[…, blocks, rows, vehicles]``."""
        if self.task.simulator.own and bool(worlds[..., self.layout.blocks.index("state_speed"), :, :].isnan().any()):
            raise Untraceable("an effect returned nan: the step itself tells which")

    def run_together(self, moment: Moment, now: Frame, first: int, steps: int) -> None:
        """Do some steps under one action, of which only the first changes lanes; ``first`` is its number in memory."""
        bound, count = moment.bound, np.arange(steps)
        worlds, _, _, places = bound.together
        later = worlds.data_ptr() + (first + count) * (worlds.shape[1] * self.pitch)
        begins = self.columns(moment, now, np.concatenate(([now.at], later[:-1])), later)
        moving = self.moving(moment, count)

        def lay() -> tuple[Any, ...]:
            cells = self.pointers(moment) | moving | {n: x[first : first + steps] for n, x in places.items()}
            return cells | {"state_step": np.concatenate(([now.clock_at], cells["clock"][:-1]))}, *begins

        tables, _ = bound.ahead.laid(tuple(x.tobytes() for x in begins), lay, moving)
        some = partial(each_table, bound.recorded.forward.call, _BLOCK, tables)
        pool.split(some, self.rows, 1, self.threads)

    def begins(self, moment: Moment, now: Frame, later: Frame) -> tuple[int, ...]:
        """Return where the worlds of a step begin (``before``), and those after it."""
        return now.at, later.at

    def until(self, clock: Array) -> int:
        """Return the number of steps before the next one at which vehicles change lanes, come or go."""
        return 1 << 40

    def columns(self, moment: Moment, now: Frame, begins: Array, later: Array) -> tuple[Array, ...]:
        """Return where the worlds of some steps begin, and those after them; ``moment`` is the first of these steps.

        ``now`` are the worlds before it, and no other one changes lanes.
        """
        return begins, later

    def split(self, loops: RowFunction, where: int) -> None:
        """Do the loops over all rows, with a table at an address, in some threads where there are many."""
        pool.split(lambda begin, end: loops.run(begin, end, where), self.rows, 1, self.threads)

    def pointers(self, moment: Moment) -> dict[str, int]:
        """Return the addresses of all that a step is given beside its worlds: its adjoint is given the same."""
        own = {"action": moment.action, "live": moment.live, "state_step": moment.clock}
        return {n: address(x) for n, x in own.items() if x is not None} | self.moving(moment)

    def moving(self, moment: Moment, count: Any = 0) -> dict[str, Any]:
        """Return the addresses of that of it which lies elsewhere at every step, ``count`` steps after the first."""
        pointers: dict[str, Any] = {}
        for name, x in (moment.normals or {}).items():
            if name not in self._normals or self._normals[name][0] is not x:
                self._normals[name] = x, address(x)
            pointers[f"normal_{name}"] = self._normals[name][1] + (moment.at + count) * self.pitch
        if self.past_shape:
            pointers["past"] = address(moment.past) + (moment.newest - count) * self.slot
            pointers["then_past"] = pointers["past"] - self.slot
        if self.task.held > 1:
            pointers["looks"] = np.where((count - moment.looks) % self.task.held == 0, *self._looks)
        return pointers

    # -- backwards -----------------------------------------------------------------------------------------------

    @cached_property
    def zeros(self) -> Array:
        """What falls on outputs on which nothing falls."""
        recorded = self._bound.recorded if self._bound is not None else next(iter(self._recorded.values()))
        wide = (len(self.layout.blocks) * self.size, *(math.prod(s) for s in recorded.forward.shapes.values()))
        return np.zeros(self.rows * max(wide), self.real)

    def back(
        self, moment: Moment, on_told: Mapping[str, Tensor | None], on_later: Tensor | None, on_past: Array | None
    ) -> tuple[Array, Array | None, Array, Array]:
        """Return what falls on the world's blocks, on actions, on parameters (parameters, vehicles) and on the past.

        ``on_told`` is what falls on ``flowing``, ``on_later`` on the blocks of the world Δt later and ``on_past`` on
        the past (rows, slots, signals, vehicles); None is nothing.
        """
        bound, zeros = moment.bound, address(self.zeros)
        on_worlds = np.empty((len(self.worlds), len(self.layout.blocks), self.count), self.real)
        on_action = None if moment.action is None else np.zeros(moment.action.shape, self.real)
        on_parameters = np.empty((len(bound.wanted), self.count), self.real)
        before = np.empty(self.past_shape, self.real)
        pointers = {f"on_{n}": zeros if x is None else x.data_ptr() for n, x in on_told.items()} | moment.given
        if on_action is not None:
            pointers["to_action"] = address(on_action)
        if self.past_shape:
            on_past = np.zeros(self.past_shape, self.real) if on_past is None else on_past
            pointers |= {"on_past": address(on_past), "to_past": address(before)}
        seeds = zeros if on_later is None else on_later.data_ptr()
        begins = *moment.begins[: len(self.before)], seeds, *(address(x) for x in on_worlds), address(on_parameters)
        cells = bound.back.filled(pointers, *begins)
        self.split(bound.recorded.backward, address(cells))
        return self.first(moment, [*on_worlds], on_parameters), on_action, on_parameters, before

    def first(self, moment: Moment, on_worlds: Sequence[Array], on_parameters: Array) -> Array:
        """Return the gradient of the first of the worlds that a step is computed from."""
        return on_worlds[0]


def _wide(x: Tensor) -> bool:
    """Return whether a parameter has a number for every vehicle, or needs one for its gradient."""
    return x.requires_grad or (x.dim() > 0 and x.shape[-1] > 1)
