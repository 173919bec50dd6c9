"""A step of a batch as compiled loops, and its adjoint: what a task says before and after it, its kernel between.

The task's own functions are recorded (``kernels.rows``), and so is what torch's autograd makes of them: nothing of
theirs is written twice. Everything that holds for many steps is laid out once; a call hands over addresses.

Shapes: worlds are blocks ``[rows · vehicles]`` of every leaf, commands ``[rows, agents]``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from idm_env.delay_buffer import PAST
from idm_env.envs.moves import Moves
from idm_env.kernels import threads as pool
from idm_env.kernels import tiles
from idm_env.kernels.lanes import part_of, static_of
from idm_env.kernels.memory import addresses
from idm_env.kernels.operands import Strides, operand, table
from idm_env.kernels.printed import TileKernel, tile_kernel
from idm_env.kernels.rows import RowFunction, adjoint
from idm_env.kernels.several import between
from idm_env.kernels.world_loop import retreat_worlds, step_worlds, workspaces
from idm_env.scalar.record import Form, Untraceable, slot_name
from idm_env.tasks import EnvState
from idm_env.types import LINKS, Params, Record, State, Trips

Array = np.ndarray
_ROWS = (1009, 1013, 1019, 1021, 1031)
_GIVEN = ("command", "given")


@dataclass
class Recorded:
    """A task's step as it was recorded: functions before and after it, the kernel, and the inputs between.

    ``normals`` are the kernel's slots for what effects draw, ``many`` the number of rows in the recording, and
    ``flowing`` what is told and has derivatives.
    """

    before: RowFunction
    kernel: TileKernel
    after: RowFunction
    inputs: Mapping[str, Any]
    normals: Mapping[str, str]
    many: int
    flowing: list[str]
    back: Callable[[], tuple[RowFunction, RowFunction]]

    @cached_property
    def backward(self) -> tuple[RowFunction, RowFunction]:
        """The adjoints of what comes before and after. Untraceable where torch's derivative cannot be recorded."""
        return self.back()


class Layout(NamedTuple):
    """Where a world lies: numbers of every vehicle that steps change are ``blocks`` of one array, one after another.

    ``still`` are the arrays of all else, and ``version`` counts how often one was replaced by another.
    """

    blocks: tuple[str, ...]
    still: dict[str, Array]
    version: int


@dataclass(slots=True)
class Moment:
    """One step of a batch: all that its loops were given, so that its adjoint can be computed.

    ``now`` and ``later`` are addresses of the world's blocks, whose memory the caller keeps.
    """

    now: int
    later: int
    clock: Array
    action: Array | None
    live: Array | None
    normals: Mapping[str, Array] | None
    at: int
    past: Array
    newest: int
    bound: Bound | None = None
    lanes: Any = None
    """What becomes of links (``lane_plan.Crossing``) on a road of several lanes."""
    held: Any = None
    """The arrays whose addresses ``given`` are, but those above."""
    given: dict[str, int] = field(default_factory=dict)
    """The addresses of what the step's loops were given beside its worlds."""


class _Table:
    """The addresses that loops over rows are called with: what stays, what lies in the world, and what is given."""

    def __init__(self, loops: RowFunction, layout: Layout, pitch: int) -> None:
        still = {**layout.still, **{f"later_{n}": x for n, x in layout.still.items()}}
        self._stays = loops.table(still)
        self.given = {n: loops.place(n) for n in (*loops.needs, *loops.outs) if n not in still}
        """Places of what is given with every call, by name."""
        self._now, self._now_at = self._within(layout, pitch, "")
        self._later, self._later_at = self._within(layout, pitch, "later_")

    def _within(self, layout: Layout, pitch: int, prefix: str) -> tuple[Array, Array]:
        places = {i: self.given.pop(prefix + n) for i, n in enumerate(layout.blocks) if prefix + n in self.given}
        return np.array(list(places.values()), np.int64), np.array(list(places), np.int64) * pitch

    def filled(self, now: int, later: int, given: Mapping[str, int]) -> Array:
        """Return the addresses for one call."""
        cells = self._stays.copy()
        cells[self._now] = self._now_at + now
        cells[self._later] = self._later_at + later
        for name, place in self.given.items():
            cells[place] = given[name]
        return cells

    def each(self, now: Array, later: Array, given: Mapping[str, Any]) -> Array:
        """Return the addresses for some calls, of which the worlds' and what is given are one a call."""
        cells = np.repeat(self._stays[None], len(now), 0)
        cells[:, self._now] = self._now_at + now[:, None]
        cells[:, self._later] = self._later_at + later[:, None]
        for name, place in self.given.items():
            cells[:, place] = given[name]
        return cells


class _Room:
    """Arrays of fixed shapes that are taken together: one piece of memory for each of their types."""

    def __init__(self, shapes: Mapping[str, tuple[int, ...]], types: Mapping[str, Any]) -> None:
        self._sizes: dict[Any, int] = {}
        self._at: list[tuple[str, Any, int, int, tuple[int, ...]]] = []
        for name, shape in shapes.items():
            kind = np.dtype(types[name])
            begin, count = self._sizes.get(kind, 0), math.prod(shape)
            self._at.append((name, kind, begin, count, shape))
            self._sizes[kind] = begin + count

    def take(self, steps: int = 0) -> tuple[dict[str, Array], dict[str, int]]:
        """Return fresh arrays by name, with ``steps`` as their first dimension where there are any; and addresses."""
        base = {kind: np.empty(size * max(steps, 1), kind) for kind, size in self._sizes.items()}
        first = {kind: x.__array_interface__["data"][0] for kind, x in base.items()}
        arrays, pointers = {}, {}
        for name, kind, begin, count, shape in self._at:
            own = max(steps, 1)
            flat = base[kind][begin * own : (begin + count) * own]
            arrays[name] = flat.reshape((steps, *shape) if steps else shape)
            pointers[name] = first[kind] + begin * own * kind.itemsize
        return arrays, pointers


class Laid:
    """Tables and operands of a plan for the arrays of one layout."""

    def __init__(self, plan: Plan, layout: Layout) -> None:
        recorded, self.layout, self._plan = plan.recorded, layout, plan
        self.ask = _Table(recorded.before, layout, plan.pitch)
        self.tell = _Table(recorded.after, layout, plan.pitch)
        self.inputs: list[tuple[Array, Strides]] = []
        self.given: dict[int, str] = {}
        """Places of the kernel's inputs that are given with every call, by name."""
        first = 2 * len(plan.kernel.program.states) + plan.fixed
        for i, slot in enumerate((*plan.kernel.numbers, *plan.kernel.flags)):
            source, name = self._input(slot)
            self.inputs.append(source)
            if name is not None:
                self.given[first + i] = name

    def _input(self, slot: str) -> tuple[tuple[Array, Strides], str | None]:
        """Return where the kernel finds an input, and its name where that is given with every call."""
        recorded, rows, size = self._plan.recorded, self._plan.rows, self._plan.size
        empty = np.empty(0, self._plan.real)
        if slot in recorded.normals:
            return (empty, (rows * size, size, 1)), recorded.normals[slot]
        name = _plain(slot)
        other, width = recorded.before.same.get(name, (name, recorded.before.shapes.get(name)))
        if width is not None:
            wide = math.prod(width)
            return (empty, (0, wide, 0 if wide < size else 1)), other
        x = part_of(recorded.inputs, slot)
        if x.dim() == 2 and x.shape[0] == recorded.many:
            x = x[:1]
        return operand(x[None], (rows,), size, 1), None

    @cached_property
    def back(self) -> tuple[_Table, _Table]:
        """The tables of the adjoints of what comes before and after."""
        before, after = self._plan.recorded.backward
        return _Table(before, self.layout, self._plan.pitch), _Table(after, self.layout, self._plan.pitch)

    def bind(self, params: Params) -> Bound:
        """Lay out what parameters give."""
        plan = self._plan
        kernel, task, state = plan.kernel, plan.task, plan.world.state
        still = {n: self.layout.still.get(f"state_{n}") for n in ("length", "present")}
        views = {n: torch.from_numpy(x).view(plan.rows, plan.size) for n, x in still.items() if x is not None}
        state = state._replace(**views)  # type: ignore[arg-type]
        program = kernel.program
        values = [static_of(task.simulator, state, params, n) for n in (*program.statics, *program.parameters)]
        operands = [operand(x.to(state.speed.dtype), (plan.rows,), plan.size) for x in values] + self.inputs
        places = np.concatenate((np.zeros(2 * len(program.states), np.int64), addresses([a for a, _ in operands])))
        strides = table([*(s for _, s in operands), (0, plan.size, 1)])
        return Bound(self, params, program.parameters, [a for a, _ in operands], places, strides)


class Plan:
    """Steps of worlds with or without actions (``kind``: nobody acts, all actions count), as laid out.

    Raises:
        Untraceable: For a task or a simulator that cannot be recorded.
    """

    kind_of_laid = Laid

    def __init__(
        self, moves: Moves, world: EnvState, layout: Layout, kind: tuple[bool, bool], draws: tuple[str, ...]
    ) -> None:
        self.moves, task = moves, moves.task
        recorded = self.recorded = _record(moves, world, kind, draws)
        self.kernel = kernel = recorded.kernel
        self.task, self.world = task, world
        self.rows, self.size = rows, size = world.state.speed.shape
        self.real = real = np.dtype(np.float32 if world.state.speed.dtype == torch.float32 else np.float64)
        self.count = rows * size
        self.pitch = self.count * real.itemsize
        self.between = _Room({n: (rows, *s) for n, s in recorded.before.shapes.items()}, recorded.before.types)
        self._reused = self.between.take()
        self.told = _Room({n: (rows, *s) for n, s in recorded.after.shapes.items()}, recorded.after.types)
        self._same = [(n, other, (rows, *s)) for n, (other, s) in recorded.after.same.items()]
        self.constant = {n: np.repeat(x[None], rows, 0) for n, x in recorded.after.constants.items()}
        past = world.state.memory.get(PAST)
        self.slots = past.shape[-2] if past is not None and kernel.signals else 0
        along = self._along()
        wide = tiles.width(along, self.slots)
        around = tiles.halo(1, kernel.program.reach)
        self.groups = tiles.tiles(rows, along, wide, around) if along <= wide else rows
        self._one = tiles.tiles(rows, along, wide, around) == 1
        self.extent = np.array((self.slots, rows, along, wide, around))
        self._small = rows * size < 2 * pool.GRAIN
        self.work = workspaces(kernel, self.slots, real)
        self.loops = (
            kernel.measures, kernel.forward(real.name), kernel.looks, kernel.recalls,
            kernel.read, kernel.constants[real.name], self.extent,
        )  # fmt: skip
        states = [layout.blocks.index(_block(n)) for n in kernel.program.states]
        self._states = np.array(states, np.int64) * self.pitch
        self._carried = [i for i, n in enumerate(layout.blocks) if i not in states]
        program = kernel.program
        self.fixed = len(program.statics) + len(program.parameters)
        self.layout = layout
        self._laid = self.kind_of_laid(self, layout)
        self._bound: Bound | None = None
        self._loaded: Bound | None = None

    def _along(self) -> int:
        """Return how many vehicles the kernel steps in a row."""
        return int(self.size)

    # -- forwards ------------------------------------------------------------------------------------------------

    def of(self, layout: Layout, params: Params) -> Bound:
        """Return what parameters give, laid out once for many steps."""
        bound = self._bound
        if layout.version != self._laid.layout.version:
            self._laid, bound = self.kind_of_laid(self, layout), None
        if bound is None or bound.params is not params or bound.changed():
            bound = self._bound = self._laid.bind(params)
        return bound

    def run(self, moment: Moment, now: Tensor, later: Tensor, tape: bool) -> dict[str, Array]:
        """Do one step from blocks to blocks; return what is told. With ``tape`` what is between is kept for ``back``.

        Untraceable where an effect of the user's own returned NaN.
        """
        bound = moment.bound
        moment.now, moment.later = now.data_ptr(), later.data_ptr()
        assert bound is not None
        between, between_at = self.between.take() if tape else self._reused
        clock = np.empty_like(moment.clock)
        pointers = self._given(moment, between, between_at, clock)
        outputs, where = self.told.take()
        where |= {n: pointers[n] for n in _GIVEN if n in pointers}
        where["state_step"], where["later_state_step"] = pointers["state_step"], pointers["later_state_step"]
        asks, tells = (
            bound.laid.ask.filled(moment.now, moment.later, pointers),
            bound.laid.tell.filled(moment.now, moment.later, where),
        )
        places = self._places(moment, between_at)
        call = (moment.past, moment.newest, *self.loops, moment.at)
        recorded = self.recorded
        head = (recorded.before.call, asks, recorded.after.call, tells, moment.clock, clock, places, bound.strides)
        threads = 1 if self._small else pool.count(self.count)
        if threads == 1:
            step_worlds(*head, *self.work, *call, self._one and self._loaded is bound, 0, self.groups)
            self._loaded = bound
        else:

            def part(begin: int, end: int) -> None:
                step_worlds(*head, *workspaces(self.kernel, self.slots, self.real), *call, False, begin, end)

            pool.split(part, self.groups, 1, threads)
        for i in self._carried:
            later[i].copy_(now[i])
        return self._finished(later, outputs, clock, bound)

    def _given(self, moment: Moment, between: Any, between_at: Mapping[str, int], clock: Array) -> dict[str, int]:
        """Return the addresses of all that a step is given, and note them: its adjoint is given the same."""
        pointers = {**between_at, "state_step": address(moment.clock), "later_state_step": address(clock)}
        if moment.action is not None:
            pointers["action"] = address(moment.action)
        if moment.live is not None:
            pointers["live"] = address(moment.live)
        pointers |= {n: pointers[other] for n, (other, _) in self.recorded.before.same.items()}
        moment.held, moment.given = (between, clock), pointers
        return pointers

    def _finished(self, later: Tensor, outputs: dict[str, Array], clock: Array, bound: Bound) -> dict[str, Array]:
        """Return all that is told; Untraceable where an effect of the user's own returned NaN."""
        if self.task.simulator.own and bool(later[bound.laid.layout.blocks.index("state_speed")].isnan().any()):
            raise Untraceable("an effect returned nan: the step itself tells which")
        outputs["clock"] = clock
        for name, other, shape in self._same:
            outputs[name] = outputs[other].reshape(shape)
        for name, value in self.constant.items():
            outputs[name] = value.copy()
        return outputs

    def _places(self, moment: Moment, between: Mapping[str, int]) -> Array:
        """Return the addresses of states now and later and of the kernel's operands."""
        assert moment.bound is not None
        states = len(self._states)
        places = moment.bound.places.copy()
        places[:states] = self._states + moment.now
        places[states : 2 * states] = self._states + moment.later
        for place, name in moment.bound.laid.given.items():
            places[place] = between[name] if name in between else address((moment.normals or {})[name])
        return places

    def places_of(
        self, bound: Bound, normals: Mapping[str, Array] | None, now: Array, later: Array, between: Mapping[str, Any]
    ) -> Array:
        """Return the addresses of states and operands of some steps, one row each."""
        states = len(self._states)
        places = np.repeat(bound.places[None], len(now), 0)
        places[:, :states] = self._states + now[:, None]
        places[:, states : 2 * states] = self._states + later[:, None]
        for place, name in bound.laid.given.items():
            places[:, place] = between[name] if name in between else address((normals or {})[name])
        return places

    # -- backwards -----------------------------------------------------------------------------------------------

    @cached_property
    def scratch(self) -> Scratch:
        """Memory of the adjoint."""
        return Scratch(self)

    def back(
        self, moment: Moment, on_told: Mapping[str, Tensor | None], on_later: Tensor | None, on_past: Array | None
    ) -> tuple[Array, Array | None, Array, Array]:
        """Return what falls on the world's blocks, on actions, on parameters (parameters, vehicles) and on the past.

        ``on_told`` is what falls on ``flowing``, ``on_later`` on the blocks of the world Δt later and ``on_past`` on
        the past (slots · signals, vehicles; newest first); None is nothing.
        """
        bound, room = moment.bound, self.scratch
        assert bound is not None
        asks, tells = bound.laid.back
        on_now, on_action, pointers = self._seeded(moment, on_told, on_later, room)
        on_parameters = np.zeros((len(self.kernel.program.parameters), self.count), self.real)
        before, after = self.recorded.backward
        signals = self.slots * self.kernel.signals
        on_past = np.zeros((signals, self.count), self.real) if on_past is None else on_past
        past = np.empty((signals, self.count), self.real)
        retreat_worlds(
            after.call, tells.filled(moment.now, moment.later, pointers),
            before.call, asks.filled(moment.now, moment.later, pointers), self._places(moment, moment.given),
            bound.strides, *room.work, moment.past, moment.newest, room.ends, room.begins, address(on_past),
            address(past), address(on_parameters), room.inputs_at, *room.loops, moment.at, False, False, 0,
            self.groups,
        )  # fmt: skip
        return on_now, on_action, on_parameters, past

    def _seeded(
        self, moment: Moment, on_told: Mapping[str, Tensor | None], on_later: Tensor | None, room: Scratch
    ) -> tuple[Array, Array | None, dict[str, int]]:
        """Return what falls on blocks and on actions, to be filled, and the addresses of all."""
        assert moment.bound is not None
        layout = moment.bound.laid.layout
        on_now = np.zeros((len(layout.blocks), self.count), self.real)
        on_action = None if moment.action is None else np.zeros(moment.action.shape, self.real)
        seeded, begun = room.zeros if on_later is None else on_later.data_ptr(), address(on_now)
        pointers = {**room.there, **{f"on_{n}": room.zeros if x is None else x.data_ptr() for n, x in on_told.items()}}
        for i, name in enumerate(layout.blocks):
            step = i * self.pitch
            pointers[f"seed_{name}"] = room.zeros if on_later is None else seeded + step
            pointers[f"begin_{name}"] = begun + step
        if on_later is not None and self._carried:
            later = on_later.numpy().reshape(on_now.shape)
            for i in self._carried:
                on_now[i] = later[i]
        pointers |= moment.given
        if on_action is not None:
            pointers["on_action"] = address(on_action)
        return on_now, on_action, pointers


class Scratch:
    """Memory and tables of the adjoint of a plan's steps: what lies between, used again at every step."""

    def __init__(self, plan: Plan) -> None:
        kernel, real = plan.kernel, plan.real
        moving = [_block(n) for n in kernel.program.moving]
        named = [f"{kind}_{n}" for kind in ("end", "carried", "direct") for n in moving]
        shapes = {**dict.fromkeys(named, (plan.count,)), "on_command": (plan.count,), "on_given": (plan.count,)}
        self._made, self.there = _Room(shapes, dict.fromkeys(shapes, real)).take()
        self.on_inputs = np.zeros((len(kernel.numbers), plan.count), real)
        self.inputs_at = address(self.on_inputs)
        self.there |= {f"on_{_plain(n)}": address(x) for n, x in zip(kernel.numbers, self.on_inputs, strict=True)}
        self.ends, self.begins = (np.array([self.there[f"{k}_{n}"] for n in moving]) for k in ("end", "carried"))
        after = plan.recorded.after
        most = max([plan.count, *(plan.rows * math.prod(s) for s in after.shapes.values())])
        self._zeros = np.zeros(most, real)
        self.zeros = address(self._zeros)
        work, past = workspaces(kernel, plan.slots, real)
        self.work = work, past, past.copy()
        self.loops = (
            kernel.measures, kernel.forward(real.name), kernel.looks, kernel.recalls, kernel.backward(real.name),
            kernel.sends, kernel.again, kernel.constants[real.name], plan.extent,
        )  # fmt: skip


class Bound:
    """What parameters give: the addresses of all operands, and which parameters these are."""

    def __init__(
        self, laid: Laid, params: Params, names: tuple[str, ...], arrays: list[Array], places: Array, strides: Array
    ) -> None:
        self.laid = laid
        self.params, self.places, self.strides = params, places, strides
        self._arrays = arrays  # so that their addresses stay theirs
        pairs = [name.split(".", 1) for name in names]
        read = self._read(pairs)
        self._watched = [(params[e], p, params[e][p], params[e][p]._version) for e, p in read]
        self.wanted = [(i, params[e][p]) for i, (e, p) in enumerate(pairs) if params[e][p].requires_grad]
        """Parameters that require a gradient, with their numbers."""
        self._names = [names[i] for i, _ in self.wanted]

    def _read(self, pairs: list[list[str]]) -> list[list[str]]:
        """Return the effects and parameters that steps read, given those of the kernel."""
        return pairs

    def with_values(self, values: Sequence[Tensor]) -> dict[str, dict[str, Tensor]]:
        """Return the parameters with others in place of those that are ``wanted``."""
        params = {effect: dict(own) for effect, own in self.params.items()}
        for name, x in zip(self._names, values, strict=True):
            effect, parameter = name.split(".", 1)
            params[effect][parameter] = x
        return params

    def changed(self) -> bool:
        """Return whether a parameter is another tensor now, or was written to."""
        # A loop: a generator would cost as much again.
        for held, name, x, version in self._watched:  # noqa: SIM110
            if held[name] is not x or x._version != version:
                return True
        return False


def _record(moves: Moves, world: EnvState, kind: tuple[bool, bool], draws: tuple[str, ...]) -> Recorded:
    """Record a step with or without actions, and with or without saying whose count (``kind`` as in ``Plan``)."""
    idle, every = kind
    task = moves.task
    simulator = task.simulator if world.state.lanes is None else between(task.simulator)
    size, count = world.state.speed.shape[-1], len(task.agents)
    # A number of rows that is no other dimension tells rows apart from everything else.
    many = next(p for p in _ROWS if p not in (size, count))
    dtype = world.state.speed.dtype
    sample = examples_of(world, many)
    actions = {} if idle else {"action": torch.zeros(many, count * len(task.commands), dtype=dtype)}
    if not (idle or every):
        actions["live"] = torch.ones(many, count, dtype=torch.bool)
    normals = {name: torch.zeros(many, size, dtype=dtype) for name in draws}
    seen: dict[str, Any] = {}
    slots: dict[str, str] = {}

    def early(**leaves: Tensor) -> dict[str, Tensor]:
        world_now = world_of(leaves, world)
        command, passed, inputs = moves.commanded(world_now, leaves.get("action"), normals or None, leaves.get("live"))
        seen.update(inputs)
        out = {} if command is None or passed is None else {"command": command, "given": passed}
        for effect, value in inputs.items():
            for part, x in ({"": value} if isinstance(value, Tensor) else value._asdict()).items():
                if x is not None and x is normals.get(effect):
                    slots[slot_name(effect, part)] = effect
                elif x is not None:
                    out[_plain(slot_name(effect, part))] = x
        return out

    first = RowFunction(early, {**sample, **actions}, many)
    inside = {effect: _without_lane(value) for effect, value in seen.items() if effect in simulator.by_name}
    kernel = tile_kernel(simulator, Form.of(world.state._replace(lanes=None), inside))
    if isinstance(kernel, str):
        raise Untraceable(kernel)

    def late(**leaves: Tensor) -> dict[str, Tensor]:
        then = world_of({n: x for n, x in leaves.items() if not n.startswith("later_")}, world)
        now, command = world_of(leaves, world, "later_"), leaves.get("command")
        accel = now.state.speed.new_zeros(len(now.state.speed), count) if command is None else command
        return moves.told(then, accel, leaves.get("given"), now, command is not None)

    examples = {**sample, **{f"later_{n}": x.clone() for n, x in sample.items()}}
    if not idle:
        examples |= {n: torch.zeros(many, count, dtype=dtype) for n in _GIVEN}
    last = RowFunction(late, examples, many)
    moving = [_block(n) for n in kernel.program.moving]
    numbers = [_plain(n) for n in kernel.numbers if n not in slots]
    by = [*moving, *(f"later_{n}" for n in moving), *(_GIVEN if not idle else ())]
    flowing = _flowing(late, examples, by)

    def back() -> tuple[RowFunction, RowFunction]:
        late_back = adjoint(late, flowing, by)

        def later_first(**leaves: Tensor) -> dict[str, Tensor]:
            gradients = late_back(**{n: x for n, x in leaves.items() if not n.startswith("seed_")})
            ends = {f"end_{n}": _sum(leaves[f"seed_{n}"], gradients.get(f"later_{n}")) for n in moving}
            ends |= {f"direct_{n}": gradients[n] for n in moving if n in gradients}
            return ends | {f"on_{n}": gradients[n] for n in _GIVEN if n in gradients}

        outputs = {n: x for n, x in late(**examples).items() if n in flowing}
        seeds = {f"on_{n}": torch.zeros_like(x).contiguous() for n, x in outputs.items()}
        seeds |= {f"seed_{n}": sample[n].clone() for n in moving}
        after_back = RowFunction(later_first, {**examples, **seeds}, many, apart=True)
        outs = after_back.outs
        commands = [n for n in _GIVEN if f"on_{n}" in outs]

        def wide(**leaves: Tensor) -> dict[str, Tensor]:
            out = early(**leaves)
            return {n: x if n in _GIVEN else x.expand(many, size) for n, x in out.items()}

        early_back = adjoint(wide, [*numbers, *commands], [*moving, *(() if idle else ("action",))])

        def earlier(**leaves: Tensor) -> dict[str, Tensor]:
            gradients = early_back(**{n: x for n, x in leaves.items() if n.split("_")[0] not in ("carried", "direct")})
            begins = {
                f"begin_{n}": _sum(_sum(leaves[f"carried_{n}"], leaves.get(f"direct_{n}")), gradients.get(n))
                for n in moving
            }
            return begins | ({"on_action": gradients["action"]} if "action" in gradients else {})

        seeds = {f"on_{n}": torch.zeros(many, size, dtype=dtype) for n in numbers}
        seeds |= {f"on_{n}": torch.zeros(many, count, dtype=dtype) for n in commands}
        seeds |= {f"carried_{n}": sample[n].clone() for n in moving}
        seeds |= {f"direct_{n}": sample[n].clone() for n in moving if f"direct_{n}" in outs}
        return RowFunction(earlier, {**sample, **actions, **seeds}, many, apart=True), after_back

    return Recorded(first, kernel, last, seen, slots, many, flowing, back)


def examples_of(world: EnvState, many: int) -> dict[str, Tensor]:
    """Return the leaves of many worlds like the first of these."""
    leaves = {n: x.detach() for n, x in named(world).items()}
    return {n: x[:1].expand(many, *x.shape[1:]).contiguous() for n, x in leaves.items()}


def _without_lane(value: Any) -> Any:
    """Return an input without the lanes of a record: vehicles are put there after the kernel's step."""
    return value._replace(lane=None) if isinstance(value, Record) else value


def _sum(x: Tensor, more: Tensor | None) -> Tensor:
    return x.clone() if more is None else x + more


def _flowing(function: Callable[..., Mapping[str, Tensor]], leaves: Mapping[str, Tensor], by: list[str]) -> list[str]:
    """Return the outputs of a function through which a gradient flows to some of its leaves."""
    with torch.enable_grad():
        out = function(**{n: x.clone().requires_grad_(n in by) for n, x in leaves.items()})
    return [n for n, x in out.items() if x.requires_grad]


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


def world_of(leaves: Mapping[str, Tensor], like: EnvState, prefix: str = "") -> EnvState:
    """Return a world of the leaves that ``named`` gives, memories as in ``like``."""
    own = {n.removeprefix(prefix): x for n, x in leaves.items() if n.startswith(prefix)}
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


def _plain(slot: str) -> str:
    """Return the name of a slot as it stands in a program."""
    return slot.replace(" ", "_")


def address(x: Array | None) -> int:
    """Return where an array begins."""
    assert x is not None
    return x.__array_interface__["data"][0]  # type: ignore[no-any-return]


def _block(state: str) -> str:
    """Return the name of a kernel's state among the blocks of a world."""
    if state == "step":
        return "clock"
    return f"memory_{state.removeprefix('memory of ')}" if state.startswith("memory of ") else f"state_{state}"
