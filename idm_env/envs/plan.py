"""A step of a batch without a graph: what a task says before and after it as compiled loops, its kernel between.

The task's own functions are recorded (``kernels.rows``), so nothing of theirs is written twice. Everything that holds
for many steps is laid out once: two sets of arrays take turns as the state before and after a step.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from idm_env.envs.past import Past
from idm_env.history import PAST
from idm_env.kernels import threads as pool
from idm_env.kernels import tiles
from idm_env.kernels.lanes import part_of, static_of
from idm_env.kernels.operands import Strides, operand, table
from idm_env.kernels.printed import TileKernel, tile_kernel
from idm_env.kernels.rows import RowFunction
from idm_env.kernels.world_loop import advance, workspaces
from idm_env.scalar.record import Form, Untraceable, slot_name
from idm_env.tasks import Task, World
from idm_env.types import Params, State

Array = np.ndarray
Arrays = tuple[dict[str, Array], dict[str, Array]]
Before = Callable[
    [World, Tensor | None, Mapping[str, Tensor] | None, Tensor | None],
    tuple[Tensor | None, Tensor | None, Mapping[str, Any]],
]
"""World, actions, normals, whose actions count → commands, what is let pass of them, and the inputs of the step."""
After = Callable[[World, Tensor, Tensor | None, World, bool], dict[str, Tensor]]
"""World, commands, commands let pass, world Δt later, whether anybody commanded → everything that faces tell."""
_ROWS = (1009, 1013, 1019, 1021, 1031)


class Recorded(NamedTuple):
    """A task's step as it was recorded: functions before and after it, the kernel, and the inputs between.

    ``normals`` are the kernel's slots for what effects draw, and ``many`` the number of rows in the recording.
    """

    before: RowFunction
    kernel: TileKernel
    after: RowFunction
    inputs: Mapping[str, Any]
    normals: Mapping[str, str]
    many: int


class Plan:
    """Steps of ``arrays`` with or without actions (``kind``: nobody acts, all actions count), as laid out.

    Raises:
        Untraceable: For a task or a simulator that cannot be recorded.
    """

    def __init__(
        self,
        task: Task,
        before: Before,
        after: After,
        world: World,
        arrays: Arrays,
        past: Past,
        kind: tuple[bool, bool],
        draws: tuple[str, ...],
    ) -> None:
        made = self._recorded = _record(task, before, after, world, kind, draws)
        self._task, self._world, self._arrays, self._past = task, world, arrays, past
        self._rows, self._size = rows, size = world.state.speed.shape
        kernel, self._real = (
            made.kernel,
            np.dtype(np.float32 if world.state.speed.dtype == torch.float32 else np.float64),
        )
        shapes = made.before.shapes
        self._made = {name: np.empty(rows * math.prod(s), made.before.types[name]) for name, s in shapes.items()}
        self._outs = list(self._made.values())
        self._made |= {name: self._made[other] for name, (other, _) in made.before.same.items()}
        self._answers = [(n, (rows, *s), made.after.types[n]) for n, s in made.after.shapes.items()]
        self._same = [(n, other, (rows, *s)) for n, (other, s) in made.after.same.items()]
        self._constant = {n: np.repeat(x[None], rows, 0) for n, x in made.after.constants.items()}
        self._inputs = [self._input(n) for n in (*kernel.numbers, *kernel.flags)]
        self._slots = slots = past.slots if kernel.signals else 0
        wide = tiles.width(size, slots)
        around = tiles.halo(1, kernel.program.reach)
        self._small = rows * size < 2 * pool.GRAIN
        self._tiles = tiles.tiles(rows, size, wide, around)
        self._extent = np.array((slots, rows, size, wide, around))
        self._work = workspaces(kernel, slots, self._real)
        self._kernel = (
            kernel.measures, kernel.forward(self._real.name), kernel.looks, kernel.recalls,
            kernel.read, kernel.constants[self._real.name], self._extent,
        )  # fmt: skip
        self._asked = [self._needed(made.before.needs, side) for side in (0, 1)]
        self._told = [self._needed(made.after.needs, side) for side in (0, 1)]
        self._given = [
            (made.before.needs.index(n), n == "action") for n in ("action", "live") if n in made.before.needs
        ]
        program = kernel.program
        behind = 2 * len(program.states) + len(program.statics) + len(program.parameters)
        self._normals = {behind + i: made.normals[n] for i, n in enumerate(kernel.numbers) if n in made.normals}
        self._bound: _Bound | None = None

    def _input(self, slot: str) -> tuple[Array, Strides]:
        """Return where the kernel finds an input: an array that ``before`` fills, a constant, or later normals."""
        made, rows, size = self._recorded, self._rows, self._size
        if slot in made.normals:
            return np.empty(0, self._real), (rows * size, size, 1)
        name = slot.replace(" ", "_")
        if name in self._made:
            found = self._made[name]
            flat = found.view(np.uint8) if found.dtype == np.bool_ else found
            return flat, (0, found.size // rows, 0 if found.size < rows * size else 1)
        x = part_of(made.inputs, slot)
        if x.dim() == 2 and x.shape[0] == made.many:
            x = x[:1]
        return operand(x[None], (rows,), size, 1)

    def _needed(self, names: list[str], side: int) -> list[Array]:
        """Return the arrays of names in the recording, with the state before the step on this side."""
        found = []
        for name in names:
            if name in ("action", "live"):
                found.append(np.empty(0, self._real))
            elif name in ("command", "given"):
                found.append(self._made[name])
            else:
                there = 1 - side if name.startswith("later_") else side
                found.append(self._arrays[there][name.removeprefix("later_")])
        return found

    def run(
        self,
        side: int,
        action: Array | None,
        live: Array | None,
        normals: dict[str, Array] | None,
        at: int,
        params: Params,
    ) -> dict[str, Array]:
        """Do one step of the arrays of a side; those of the other one are then the state Δt later."""
        bound = self._bound
        if bound is None or bound.params is not params or bound.changed():
            bound = self._bound = self._bind(params)
        rows, made, asked, task = self._rows, self._recorded, self._asked[side], self._task
        for place, is_action in self._given:
            asked[place] = action if is_action else live  # type: ignore[assignment]
        made.before.run(rows, asked, self._outs)
        if normals is not bound.normals:
            bound.hear(normals, self._normals)
        old, new = self._arrays[side], self._arrays[1 - side]
        if self._slots:
            self._past.make_room()
        call = (self._past.rows, self._past.newest, *self._kernel, at)
        threads = 1 if self._small else pool.count(rows * self._size)
        if threads == 1:
            advance(bound.places[side], bound.strides, *self._work, *call, bound.loaded, 0, self._tiles)
            bound.loaded = self._tiles == 1
        else:
            self._split(bound, side, call, threads)
        if task.simulator.own and np.isnan(new["state_speed"]).any():
            raise Untraceable("an effect returned nan: the step itself tells which")
        if self._slots:
            self._past.newest += 1
        np.add(old["state_step"], 1, out=new["state_step"])
        told = {name: np.empty(shape, kind) for name, shape, kind in self._answers}
        made.after.run(rows, self._told[side], told.values())
        for name, other, shape in self._same:
            told[name] = told[other].reshape(shape)
        for name, value in self._constant.items():
            told[name] = value.copy()
        return told

    def _split(self, bound: _Bound, side: int, call: tuple[Any, ...], threads: int) -> None:
        """Share the tiles among threads, each with a workspace of its own."""

        def part(begin: int, end: int) -> None:
            work = workspaces(self._recorded.kernel, self._slots, self._real)
            advance(bound.places[side], bound.strides, *work, *call, False, begin, end)

        pool.split(part, self._tiles, 1, threads)

    def _bind(self, params: Params) -> _Bound:
        """Lay out what parameters give."""
        kernel, task, state = self._recorded.kernel, self._task, self._world.state
        still = {n: self._arrays[0].get(f"state_{n}") for n in ("length", "present")}
        views = {n: torch.from_numpy(x).view(self._rows, self._size) for n, x in still.items() if x is not None}
        state = state._replace(**views)  # type: ignore[arg-type]
        names = (*kernel.program.statics, *kernel.program.parameters)
        values = [static_of(task.simulator, state, params, n).to(state.speed.dtype) for n in names]
        made = [operand(x, (self._rows,), self._size) for x in values] + self._inputs
        one, other = ([held[_place_of(n)] for n in kernel.program.states] for held in self._arrays)
        rest = [a for a, _ in made]
        places = tuple(np.array([x.ctypes.data for x in (*a, *b, *rest)]) for a, b in ((one, other), (other, one)))
        strides = table([*(s for _, s in made), (0, self._size, 1)])
        return _Bound(params, kernel.program.parameters, [*one, *other, *rest], places, strides)


class _Bound:
    """What parameters give: the addresses of all operands, and which parameters these are."""

    def __init__(
        self, params: Params, names: Sequence[str], arrays: list[Array], places: tuple[Array, ...], strides: Array
    ) -> None:
        self.params, self.places, self.strides = params, places, strides
        self.normals: dict[str, Array] | None = None
        self.loaded = False
        """Whether the workspace holds the operands."""
        self._arrays = arrays  # so that their addresses stay theirs
        pairs = [name.split(".", 1) for name in names]
        self._watched = [(params[e], p, params[e][p], params[e][p]._version) for e, p in pairs]

    def changed(self) -> bool:
        """Return whether a parameter is another tensor now, or was written to."""
        # A loop: a generator would cost as much again.
        for held, name, x, version in self._watched:  # noqa: SIM110
            if held[name] is not x or x._version != version:
                return True
        return False

    def hear(self, normals: dict[str, Array] | None, wanted: Mapping[int, str]) -> None:
        """Take normals from other blocks from now on; ``wanted`` says at which place whose address is."""
        self.normals = normals
        for place, effect in wanted.items():
            for places in self.places:
                places[place] = (normals or {})[effect].ctypes.data


def _record(
    task: Task, before: Before, after: After, world: World, kind: tuple[bool, bool], draws: tuple[str, ...]
) -> Recorded:
    """Record a step with or without actions, and with or without saying whose count (``kind`` as in ``Plan``)."""
    if world.state.links is not None:
        raise Untraceable("vehicles change lanes: the torch path steps several lanes")
    idle, every = kind
    size, count = world.state.speed.shape[-1], len(task.agents)
    # A number of rows that is no other dimension tells rows apart from everything else.
    many = next(p for p in _ROWS if p not in (size, count))
    dtype = world.state.speed.dtype
    sample = {n: x[:1].expand(many, *x.shape[1:]).contiguous() for n, x in named(world).items()}
    given = {} if idle else {"action": torch.zeros(many, count, dtype=dtype)}
    if not (idle or every):
        given["live"] = torch.ones(many, count, dtype=torch.bool)
    normals = {name: torch.zeros(many, size, dtype=dtype) for name in draws}
    seen: dict[str, Any] = {}
    slots: dict[str, str] = {}

    def early(**leaves: Tensor) -> dict[str, Tensor]:
        asked, passed, inputs = before(_world(leaves, world), leaves.get("action"), normals or None, leaves.get("live"))
        seen.update(inputs)
        out = {} if asked is None or passed is None else {"command": asked, "given": passed}
        for effect, value in inputs.items():
            for part, x in ({"": value} if isinstance(value, Tensor) else value._asdict()).items():
                if x is not None and x is normals.get(effect):
                    slots[slot_name(effect, part)] = effect
                elif x is not None:
                    out[slot_name(effect, part).replace(" ", "_")] = x
        return out

    first = RowFunction(early, {**sample, **given}, many)
    kernel = tile_kernel(task.simulator, Form.of(world.state, seen))
    if isinstance(kernel, str):
        raise Untraceable(kernel)

    def late(**leaves: Tensor) -> dict[str, Tensor]:
        then = _world({n: x for n, x in leaves.items() if not n.startswith("later_")}, world)
        now, asked = _world(leaves, world, "later_"), leaves.get("command")
        said = now.state.speed.new_zeros(len(now.state.speed), count) if asked is None else asked
        return after(then, said, leaves.get("given"), now, asked is not None)

    examples = {**sample, **{f"later_{n}": x.clone() for n, x in sample.items()}}
    if not idle:
        examples |= {n: given["action"].clone() for n in ("command", "given")}
    return Recorded(first, kernel, RowFunction(late, examples, many), seen, slots, many)


def named(world: World) -> dict[str, Tensor]:
    """Return the tensors of a world by names that can stand in a program; the past is not among them."""
    state = world.state
    found = {f"state_{n}": x for n, x in zip(State._fields, state, strict=True) if isinstance(x, Tensor)}
    shape = state.speed.shape
    found |= {f"memory_{n}": x.expand(shape) for n, x in state.memory.items() if n != PAST}
    return found | {f"episode_{n}": x for n, x in world.episode.items()}


def _world(leaves: Mapping[str, Tensor], like: World, prefix: str = "") -> World:
    own = {n.removeprefix(prefix): x for n, x in leaves.items() if n.startswith(prefix)}
    fields = {n.removeprefix("state_"): x for n, x in own.items() if n.startswith("state_")}
    episode = {n.removeprefix("episode_"): x for n, x in own.items() if n.startswith("episode_")}
    return World(like.state._replace(**fields), episode)  # type: ignore[arg-type]


def _place_of(state: str) -> str:
    if state == "step":
        return "clock"
    return f"memory_{state.removeprefix('memory of ')}" if state.startswith("memory of ") else f"state_{state}"
