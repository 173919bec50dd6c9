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
Group = tuple[str, Sequence[str], int]
"""Arrays that lie one after another: what their names begin with, their names, and the bytes of each."""
_ROWS = (1009, 1013, 1019, 1021, 1031)
_GIVEN = ("command", "given")


class Recorded:
    """A task's step as it was recorded: functions ``before`` and ``after`` it, the ``kernel``, and inputs between.

    ``kind`` is as in ``Plan``. ``normals`` are the kernel's slots for what effects draw, ``many`` the number of rows in
    the recording, ``moving`` the leaves that steps change with a derivative, and ``flowing`` what is told and has one.
    """

    def __init__(self, moves: Moves, world: EnvState, kind: tuple[bool, bool], draws: tuple[str, ...]) -> None:
        (idle, every), task = kind, moves.task
        self._moves, self._world, self._count = moves, world, len(task.agents)
        simulator = task.simulator if world.state.lanes is None else between(task.simulator)
        size, dtype = world.state.speed.shape[-1], world.state.speed.dtype
        # A number of rows that is no other dimension tells rows apart from everything else.
        many = self.many = next(p for p in _ROWS if p not in (size, self._count))
        self._sample = examples_of(world, many)
        acts = {} if idle else {"action": torch.zeros(many, self._count * len(task.commands), dtype=dtype)}
        if not (idle or every):
            acts["live"] = torch.ones(many, self._count, dtype=torch.bool)
        self._given = () if idle else _GIVEN
        self._early = {**self._sample, **acts}
        self._drawn = {name: torch.zeros(many, size, dtype=dtype) for name in draws}
        self.inputs: dict[str, Any] = {}
        self.normals: dict[str, str] = {}
        self.before = RowFunction(self._before, self._early, many)
        inside = {effect: _without_lane(value) for effect, value in self.inputs.items() if effect in simulator.by_name}
        kernel = tile_kernel(simulator, Form.of(world.state._replace(lanes=None), inside))
        if isinstance(kernel, str):
            raise Untraceable(kernel)
        self.kernel: TileKernel = kernel
        self._late = {**self._sample, **{f"later_{n}": x.clone() for n, x in self._sample.items()}}
        self._late |= {n: torch.zeros(many, self._count, dtype=dtype) for n in self._given}
        self.after = RowFunction(self._after, self._late, many)
        self.moving = [block_of(n) for n in kernel.program.moving]
        self._by = [*self.moving, *(f"later_{n}" for n in self.moving), *self._given]
        with torch.enable_grad():
            outputs = self._after(**{n: x.clone().requires_grad_(n in self._by) for n, x in self._late.items()})
        self.flowing = [n for n, x in outputs.items() if x.requires_grad]

    def _before(self, **leaves: Tensor) -> dict[str, Tensor]:
        """Return commands and the inputs of a step, and note which are normals."""
        world, normals = world_of(leaves, self._world), self._drawn
        command, passed, inputs = self._moves.commanded(
            world, leaves.get("action"), normals or None, leaves.get("live")
        )
        self.inputs.update(inputs)
        out = {} if command is None or passed is None else {"command": command, "given": passed}
        for effect, value in inputs.items():
            for part, x in ({"": value} if isinstance(value, Tensor) else value._asdict()).items():
                if x is not None and x is normals.get(effect):
                    self.normals[slot_name(effect, part)] = effect
                elif x is not None:
                    out[_plain(slot_name(effect, part))] = x
        return out

    def _after(self, **leaves: Tensor) -> dict[str, Tensor]:
        """Return what is told of a step."""
        then = world_of({n: x for n, x in leaves.items() if not n.startswith("later_")}, self._world)
        now, command = world_of(leaves, self._world, "later_"), leaves.get("command")
        accel = now.state.speed.new_zeros(len(now.state.speed), self._count) if command is None else command
        return self._moves.told(then, accel, leaves.get("given"), now, command is not None)

    @cached_property
    def backward(self) -> tuple[RowFunction, RowFunction]:
        """The adjoints of what comes before and after. Untraceable where torch's derivative cannot be recorded."""
        moving, many, sample = self.moving, self.many, self._sample
        late_back = adjoint(self._after, self.flowing, self._by)

        def later_first(**leaves: Tensor) -> dict[str, Tensor]:
            gradients = late_back(**{n: x for n, x in leaves.items() if not n.startswith("seed_")})
            ends = {f"end_{n}": summed(leaves[f"seed_{n}"], gradients.get(f"later_{n}")) for n in moving}
            ends |= {f"direct_{n}": gradients[n] for n in moving if n in gradients}
            return ends | {f"on_{n}": gradients[n] for n in _GIVEN if n in gradients}

        outputs = {n: x for n, x in self._after(**self._late).items() if n in self.flowing}
        seeds = {f"on_{n}": torch.zeros_like(x).contiguous() for n, x in outputs.items()}
        seeds |= {f"seed_{n}": sample[n].clone() for n in moving}
        after = RowFunction(later_first, {**self._late, **seeds}, many, apart=True)
        numbers = [_plain(n) for n in self.kernel.numbers if n not in self.normals]
        commands = [n for n in _GIVEN if f"on_{n}" in after.outs]
        wide, narrow = (sample[moving[0]].new_zeros(many, n) for n in (sample[moving[0]].shape[-1], self._count))

        def spread(**leaves: Tensor) -> dict[str, Tensor]:
            return {n: x if n in _GIVEN else x.expand(wide.shape) for n, x in self._before(**leaves).items()}

        early_back = adjoint(spread, [*numbers, *commands], [*moving, *(n for n in ("action",) if n in self._early)])

        def earlier(**leaves: Tensor) -> dict[str, Tensor]:
            gradients = early_back(**{n: x for n, x in leaves.items() if n.split("_")[0] not in ("carried", "direct")})
            begins = {
                f"begin_{n}": summed(summed(leaves[f"carried_{n}"], leaves.get(f"direct_{n}")), gradients.get(n))
                for n in moving
            }
            return begins | ({"on_action": gradients["action"]} if "action" in gradients else {})

        seeds = {f"on_{n}": wide.clone() for n in numbers} | {f"on_{n}": narrow.clone() for n in commands}
        seeds |= {f"carried_{n}": sample[n].clone() for n in moving}
        seeds |= {f"direct_{n}": sample[n].clone() for n in moving if f"direct_{n}" in after.outs}
        return RowFunction(earlier, {**self._early, **seeds}, many, apart=True), after


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


class RowTable:
    """The addresses that loops over rows are called with: what stays, groups of arrays, and what is given by name."""

    def __init__(self, loops: RowFunction, still: Mapping[str, Array], groups: Sequence[Group]) -> None:
        still = {**still, **{f"later_{n}": x for n, x in still.items()}}
        self._stays = loops.table(still)
        self._given = {n: loops.place(n) for n in (*loops.needs, *loops.outs) if n not in still}
        self._groups = [self._within(*group) for group in groups]

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


class _Room:
    """Arrays of fixed shapes that are taken together: one piece of memory for each of their types."""

    def __init__(self, shapes: Mapping[str, tuple[int, ...]], types: Mapping[str, Any]) -> None:
        self._sizes: dict[Any, int] = {}
        self._at: list[tuple[str, Any, int, tuple[int, ...]]] = []
        for name, shape in shapes.items():
            kind = np.dtype(types[name])
            begin = self._sizes.get(kind, 0)
            self._at.append((name, kind, begin * kind.itemsize, shape))
            self._sizes[kind] = begin + math.prod(shape)

    @classmethod
    def of(cls, loops: RowFunction, rows: int) -> _Room:
        """Return the arrays of what loops over rows return."""
        return cls({n: (rows, *shape) for n, shape in loops.shapes.items()}, loops.types)

    def take(self, steps: int = 0) -> tuple[dict[str, Array], dict[str, int]]:
        """Return fresh arrays by name, with ``steps`` as their first dimension where there are any; and addresses."""
        own = max(steps, 1)
        memory = {kind: np.empty(size * own, kind) for kind, size in self._sizes.items()}
        first = {kind: address(x) for kind, x in memory.items()}
        arrays, pointers = {}, {}
        for name, kind, begin, shape in self._at:
            arrays[name] = np.ndarray((steps, *shape) if steps else shape, kind, memory[kind], begin * own)
            pointers[name] = first[kind] + begin * own
        return arrays, pointers


class Laid:
    """The tables of a plan for the arrays of one layout."""

    def __init__(self, plan: Plan, layout: Layout) -> None:
        self.layout, self.plan = layout, plan
        self.ask = RowTable(plan.recorded.before, layout.still, plan.lies)
        self.tell = RowTable(plan.recorded.after, layout.still, plan.lies)

    @cached_property
    def back(self) -> tuple[RowTable, RowTable]:
        """The tables of the adjoints of what comes before and after."""
        before, after = self.plan.recorded.backward
        begins, seeds = ((prefix, self.layout.blocks, self.plan.pitch) for prefix in ("begin_", "seed_"))
        still, lies = self.layout.still, self.plan.lies
        return RowTable(before, still, (*lies, begins)), RowTable(after, still, (*lies, seeds))


class Plan:
    """Steps of worlds with or without actions (``kind``: nobody acts, all actions count), as laid out.

    Raises:
        Untraceable: For a task or a simulator that cannot be recorded.
    """

    _drawn_by = 0
    """Bytes from the normals of one step to the next, where the kernel does not count steps."""

    def __init__(
        self, moves: Moves, world: EnvState, layout: Layout, kind: tuple[bool, bool], draws: tuple[str, ...]
    ) -> None:
        self.moves, self.task, self.world, self.layout = moves, moves.task, world, layout
        recorded = self.recorded = Recorded(moves, world, kind, draws)
        self.kernel = kernel = recorded.kernel
        self.rows, self.size = rows, size = world.state.speed.shape
        self.real = real = np.dtype(np.float32 if world.state.speed.dtype == torch.float32 else np.float64)
        self.count = rows * size
        self.pitch = self.count * real.itemsize
        self.lies: tuple[Group, ...] = (("", layout.blocks, self.pitch), ("later_", layout.blocks, self.pitch))
        self.between, self.told = (_Room.of(loops, rows) for loops in (recorded.before, recorded.after))
        self._reused = self.between.take()
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
        self.work = workspaces(kernel, self.slots, real)
        self.loops = (
            kernel.measures, kernel.forward(real.name), kernel.looks, kernel.recalls,
            kernel.read, kernel.constants[real.name], self.extent,
        )  # fmt: skip
        states = [layout.blocks.index(block_of(n)) for n in kernel.program.states]
        self._states = np.array(states, np.int64) * self.pitch
        self._carried = [i for i, n in enumerate(layout.blocks) if i not in states]
        self._bound: Bound | None = None
        self._loaded: Bound | None = None

    def _along(self) -> int:
        """Return how many vehicles the kernel steps in a row."""
        return int(self.size)

    # -- forwards ------------------------------------------------------------------------------------------------

    def of(self, layout: Layout, params: Params) -> Bound:
        """Return what parameters give, laid out once for many steps."""
        bound = self._bound
        if bound is None or layout.version != bound.laid.layout.version:
            bound = self._bound = self._bind(Laid(self, layout), params)
        elif bound.params is not params or bound.changed():
            bound = self._bound = self._bind(bound.laid, params)
        return bound

    def _bind(self, laid: Laid, params: Params) -> Bound:
        """Lay out what parameters give."""
        return Bound(self, laid, params)

    def run(self, moment: Moment, now: Tensor, later: Tensor, tape: bool) -> dict[str, Array]:
        """Do one step from blocks to blocks; return what is told. With ``tape`` what is between is kept for ``back``.

        Untraceable where an effect of the user's own returned NaN; Unordered, nothing changed, where torch must step.
        """
        bound = moment.bound
        assert bound is not None
        moment.now, moment.later = now.data_ptr(), later.data_ptr()
        between, between_at = self.between.take() if tape else self._reused
        clock = np.empty_like(moment.clock)
        moment.held, moment.given = (between, clock), self._given(moment, between_at, clock)
        outputs, where = self.told.take()
        part = self._part(moment, now, later, clock, moment.given | where, tape)
        threads = 1 if self.count < 2 * pool.GRAIN else pool.count(self.count)
        if threads == 1:
            part(0, self.groups, self.work, self._one and self._loaded is bound)
            self._loaded = bound
        else:
            new = self.kernel, self.slots, self.real
            pool.split(lambda begin, end: part(begin, end, workspaces(*new), False), self.groups, 1, threads)
        if self.task.simulator.own and bool(later[bound.laid.layout.blocks.index("state_speed")].isnan().any()):
            raise Untraceable("an effect returned nan: the step itself tells which")
        outputs["clock"] = clock
        for name, other, shape in self._same:
            outputs[name] = outputs[other].reshape(shape)
        for name, value in self.constant.items():
            outputs[name] = value.copy()
        return outputs

    def _given(self, moment: Moment, between_at: Mapping[str, int], clock: Array) -> dict[str, int]:
        """Return the addresses of all that a step is given beside its worlds: its adjoint is given the same."""
        pointers = {**between_at, "state_step": address(moment.clock), "later_state_step": address(clock)}
        if moment.action is not None:
            pointers["action"] = address(moment.action)
        if moment.live is not None:
            pointers["live"] = address(moment.live)
        pointers |= {n: pointers[other] for n, (other, _) in self.recorded.before.same.items()}
        for name, x in (moment.normals or {}).items():
            pointers[name] = address(x) + moment.at * self._drawn_by
        return pointers

    def _part(
        self, moment: Moment, now: Tensor, later: Tensor, clock: Array, pointers: Mapping[str, int], tape: bool
    ) -> Callable[[int, int, Any, bool], None]:
        """Return the function that steps some groups of tiles, in a workspace; ``kept`` as in ``advance``."""
        bound, recorded = moment.bound, self.recorded
        assert bound is not None
        for i in self._carried:
            later[i].copy_(now[i])
        worlds = moment.now, moment.later
        head = (
            recorded.before.call, bound.laid.ask.filled(pointers, *worlds), recorded.after.call,
            bound.laid.tell.filled(pointers, *worlds), moment.clock, clock, self.places_of(bound, pointers, *worlds),
            bound.strides,
        )  # fmt: skip

        def part(begin: int, end: int, work: Any, kept: bool) -> None:
            step_worlds(*head, *work, moment.past, moment.newest, *self.loops, moment.at, kept, begin, end)

        return part

    def places_of(self, bound: Bound, given: Mapping[str, Any], now: Any, later: Any) -> Array:
        """Return the addresses of states now and later and of operands: of one step, or of some, one row each."""
        several, count = isinstance(now, np.ndarray), len(self._states)
        places, states = bound.operands(given, len(now) if several else 0), self._states
        states = states[:, None] if several else states
        places[:count] = states + now
        places[count : 2 * count] = states + later
        return places.T.copy() if several else places

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
        room = self.scratch
        on_now = np.zeros((len(self.layout.blocks), self.count), self.real)
        on_action = None if moment.action is None else np.zeros(moment.action.shape, self.real)
        if on_later is not None and self._carried:
            on_now[self._carried] = on_later.numpy().reshape(on_now.shape)[self._carried]
        pointers = {**room.there, **{f"on_{n}": room.zeros if x is None else x.data_ptr() for n, x in on_told.items()}}
        pointers |= moment.given
        if on_action is not None:
            pointers["on_action"] = address(on_action)
        on_parameters = np.zeros((len(self.kernel.program.parameters), self.count), self.real)
        on_past = np.zeros((self.slots * self.kernel.signals, self.count), self.real) if on_past is None else on_past
        past = np.empty_like(on_past)
        seeds = room.zeros if on_later is None else on_later.data_ptr()
        self._retreat(moment, pointers, seeds, address(on_now), on_parameters, on_past, past)
        return on_now, on_action, on_parameters, past

    def _retreat(
        self, moment: Moment, pointers: dict[str, int], seeds: int, on_now: int, on_parameters: Array, on_past: Array,
        past: Array,
    ) -> None:  # fmt: skip
        """Run the loops of the adjoint, from seeds to what falls on worlds now, both blocks."""
        bound, room, (before, after) = moment.bound, self.scratch, self.recorded.backward
        assert bound is not None
        asks, tells = bound.laid.back
        worlds = moment.now, moment.later
        retreat_worlds(
            after.call, tells.filled(pointers, *worlds, seeds), before.call, asks.filled(pointers, *worlds, on_now),
            self.places_of(bound, moment.given, *worlds), bound.strides, *room.work, moment.past, moment.newest,
            room.ends, room.begins, address(on_past), address(past), address(on_parameters), address(room.on_inputs),
            *room.loops, moment.at, False, False, 0, self.groups,
        )  # fmt: skip


class Scratch:
    """Memory and tables of the adjoint of a plan's steps: what lies between, used again at every step."""

    def __init__(self, plan: Plan) -> None:
        kernel, real, moving = plan.kernel, plan.real, plan.recorded.moving
        named = [f"{kind}_{n}" for kind in ("end", "carried", "direct") for n in moving]
        shapes = {**dict.fromkeys(named, (plan.count,)), "on_command": (plan.count,), "on_given": (plan.count,)}
        self._made, self.there = _Room(shapes, dict.fromkeys(shapes, real)).take()
        self.on_inputs = np.zeros((len(kernel.numbers), plan.count), real)
        self.there |= {f"on_{_plain(n)}": address(x) for n, x in zip(kernel.numbers, self.on_inputs, strict=True)}
        self.ends, self.begins = (np.array([self.there[f"{k}_{n}"] for n in moving]) for k in ("end", "carried"))
        wide = (len(plan.layout.blocks) * plan.size, *(math.prod(s) for s in plan.recorded.after.shapes.values()))
        self._zeros = np.zeros(plan.rows * max(wide), real)
        self.zeros = address(self._zeros)
        work, past = workspaces(kernel, plan.slots, real)
        self.work = work, past, past.copy()
        self.loops = (
            kernel.measures, kernel.forward(real.name), kernel.looks, kernel.recalls, kernel.backward(real.name),
            kernel.sends, kernel.again, kernel.constants[real.name], plan.extent,
        )  # fmt: skip


class Bound:
    """What parameters give: the addresses of all operands, and which parameters these are.

    ``places`` are the addresses of states now and later and of operands; ``given`` says which of these are given with
    every call, and their names.
    """

    def __init__(self, plan: Plan, laid: Laid, params: Params) -> None:
        self.plan, self.laid, self.params = plan, laid, params
        kernel, program = plan.kernel, plan.kernel.program
        self._names, later = program.parameters, [f"later {name}" for name in program.states]
        names = *program.states, *later, *program.statics, *program.parameters, *kernel.numbers, *kernel.flags
        operands = [self._operand(name) for name in names]
        self.given = {i: x for i, (x, _) in enumerate(operands) if isinstance(x, str)}
        # Arrays are kept, so that their addresses stay theirs.
        self._arrays: list[Any] = [None if isinstance(x, str) else x for x, _ in operands]
        self.places = addresses(self._arrays)
        self.strides = table([*(by for _, by in operands[2 * len(later) :]), (0, int(plan.extent[2]), 1)])
        self._watched = [(own, p, x, x._version) for own in params.values() for p, x in own.items()]
        pairs = enumerate(name.split(".", 1) for name in self._names)
        self.wanted = [(i, params[e][p]) for i, (e, p) in pairs if params[e][p].requires_grad]
        """Parameters that require a gradient, with their numbers."""

    def _operand(self, name: str) -> tuple[Array | str | None, Strides]:
        """Return an array or the name of what is given with every call, and its strides; None for states."""
        if name.endswith(" now"):
            return self._input(name)
        states = self.plan.kernel.program.states
        return (None, (0, 0, 0)) if name.removeprefix("later ") in states else self._static(name)

    def _input(self, slot: str) -> tuple[Array | str, Strides]:
        """Return an input, its name where it is given with every call, and its strides."""
        plan, recorded = self.plan, self.plan.recorded
        if slot in recorded.normals:
            return recorded.normals[slot], (plan.rows * plan.size, plan.size, 1)
        name = _plain(slot)
        other, width = recorded.before.same.get(name, (name, recorded.before.shapes.get(name)))
        if width is not None:
            wide = math.prod(width)
            return other, (0, wide, 0 if wide < plan.size else 1)
        x = part_of(recorded.inputs, slot)
        x = x[:1] if x.dim() == 2 and x.shape[0] == recorded.many else x
        return operand(x[None], (plan.rows,), plan.size, 1)

    def _static(self, name: str) -> tuple[Array, Strides]:
        """Return a parameter, or what of the state no step changes, and its strides."""
        plan, state = self.plan, self.plan.world.state
        still = self.laid.layout.still.get(f"state_{name}")
        if still is not None:
            return still, (0, plan.size, 1)
        x = static_of(plan.task.simulator, state, self.params, name)
        return operand(x.to(state.speed.dtype), (plan.rows,), plan.size)

    def operands(self, given: Mapping[str, Any], calls: int = 0) -> Array:
        """Return the addresses by place, of one call, or of some in columns."""
        places = np.repeat(self.places[:, None], calls, 1) if calls else self.places.copy()
        for place, name in self.given.items():
            places[place] = given[name]
        return places

    def with_values(self, values: Sequence[Tensor]) -> dict[str, dict[str, Tensor]]:
        """Return the parameters with others in place of those that are ``wanted``."""
        params = {effect: dict(own) for effect, own in self.params.items()}
        for (i, _), x in zip(self.wanted, values, strict=True):
            effect, parameter = self._names[i].split(".", 1)
            params[effect][parameter] = x
        return params

    def changed(self) -> bool:
        """Return whether a parameter is another tensor now, or was written to."""
        # A loop: a generator would cost as much again.
        for held, name, x, version in self._watched:  # noqa: SIM110
            if held[name] is not x or x._version != version:
                return True
        return False


def examples_of(world: EnvState, many: int) -> dict[str, Tensor]:
    """Return the leaves of many worlds like the first of these."""
    leaves = {n: x.detach() for n, x in named(world).items()}
    return {n: x[:1].expand(many, *x.shape[1:]).contiguous() for n, x in leaves.items()}


def _without_lane(value: Any) -> Any:
    """Return an input without the lanes of a record: vehicles are put there after the kernel's step."""
    return value._replace(lane=None) if isinstance(value, Record) else value


def summed(x: Tensor, more: Tensor | None) -> Tensor:
    """Return a sum, with memory of its own; None is nothing."""
    return x.clone() if more is None else x + more


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


def block_of(state: str) -> str:
    """Return the name of a kernel's state among the blocks of a world."""
    if state == "step":
        return "clock"
    return f"memory_{state.removeprefix('memory of ')}" if state.startswith("memory of ") else f"state_{state}"
