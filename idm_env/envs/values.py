"""Steps of a batch without a graph: what a task says before and after a step as compiled loops, its kernel between.

The task's own functions are recorded (``kernels.rows``), so nothing of theirs is written twice. Everything that holds
for many steps, arguments of compiled loops included, is laid out once: two sets of arrays take turns as the state
before and after a step.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from idm_env.history import PAST
from idm_env.kernels import lane_loops, tiles
from idm_env.kernels import threads as pool
from idm_env.kernels.lanes import part_of, past_rows, past_tensor, static_of
from idm_env.kernels.operands import FLAGS, OPERANDS, STATES, Strides, filled, operand, table
from idm_env.kernels.printed import TileKernel, tile_kernel
from idm_env.kernels.rows import RowFunction
from idm_env.scalar.record import Form, Untraceable, slot_name
from idm_env.tasks import Task, World
from idm_env.types import Params, State

Array = np.ndarray
Before = Callable[
    [World, Tensor | None, Mapping[str, Tensor] | None], tuple[Tensor | None, Tensor | None, Mapping[str, Any]]
]
"""World, actions and normals → commands, commands as they are let pass, and the inputs of the step."""
After = Callable[[World, Tensor, Tensor | None, World, bool], dict[str, Tensor]]
"""World, commands, commands let pass, world Δt later, whether anybody commanded → everything that faces tell."""


class Values:
    """The worlds of a batch as arrays, and their steps.

    Raises:
        Untraceable: From ``step``, before anything has changed, where the task or its simulator cannot be recorded.
    """

    def __init__(self, task: Task, before: Before, after: After) -> None:
        self.task = task
        self._before, self._after = before, after
        self._plans: dict[bool, _Plan] = {}
        self._key: Any = None
        self.arrays: tuple[dict[str, Array], dict[str, Array]] = ({}, {})
        self.side = 0
        self.world: World | None = None

    def load(self, world: World) -> None:
        """Take over worlds; they are copied."""
        key = (world.state.speed.shape, world.state.speed.dtype, tuple(world.state.memory), tuple(world.episode))
        if key != self._key:
            self._key, self._plans, self.arrays = key, {}, ({}, {})
        self.world = world
        state = world.state
        for name, x in named(world).items():
            self._put(name, x)
        self._put("clock", _clock(state))
        if PAST in state.memory:
            self._put("past", torch.from_numpy(_past(state)))

    def replace(self, rows: Array, fresh: World) -> None:
        """Replace some rows (indices) by the worlds of ``fresh``."""
        held, other = self.arrays[self.side], self.arrays[1 - self.side]
        count = len(held["state_step"])
        for name, x in (*named(fresh).items(), ("clock", _clock(fresh.state))):
            values = x.detach().numpy()
            held[name].reshape(count, *values.shape[1:])[rows] = values
            if other[name] is not held[name] and name not in _DYNAMIC:
                other[name].reshape(count, *values.shape[1:])[rows] = values
        if PAST in fresh.state.memory:
            past = _past(fresh.state).reshape(len(held["past"]), len(rows), -1)
            held["past"].reshape(len(past), count, -1)[:, rows] = past

    def _put(self, name: str, x: Tensor) -> None:
        held, other = self.arrays[self.side], self.arrays[1 - self.side]
        if name in held:
            np.copyto(held[name].reshape(x.shape), x.detach().numpy())
            if other[name] is not held[name] and name not in _DYNAMIC:
                # What no step changes must be the same on both sides.
                np.copyto(other[name], held[name])
            return
        flat = np.array(x.detach().numpy(), order="C")
        held[name] = flat if name == "past" else flat.reshape(-1)
        other[name] = held[name] if name.startswith("episode_") or name == "state_length" else held[name].copy()

    def current(self, own: bool = True) -> World:
        """Return the worlds as tensors of their own, or as views that hold until the next step."""
        assert self.world is not None
        state, held = self.world.state, self.arrays[self.side]
        if own:
            held = {name: x.copy() for name, x in held.items()}
        leaves = {n: torch.from_numpy(held[n]).view(x.shape) for n, x in named(self.world).items()}
        memory = {name: leaves.get(f"memory_{name}", x) for name, x in state.memory.items()}
        if PAST in memory:
            memory[PAST] = past_tensor(held["past"], state.memory[PAST].shape[-2], tuple(state.speed.shape))
        fields = {n.removeprefix("state_"): x for n, x in leaves.items() if n.startswith("state_")}
        episode = {n.removeprefix("episode_"): x for n, x in leaves.items() if n.startswith("episode_")}
        return World(state._replace(**fields, memory=memory), episode)

    def clock(self) -> Tensor:
        """Return the steps of all rows, as they are now."""
        return torch.from_numpy(self.arrays[self.side]["state_step"])

    def step(self, action: Array | None, normals: dict[str, Array] | None, at: int, params: Params) -> dict[str, Array]:
        """Advance all rows; ``normals`` are blocks (steps, rows, vehicles) by effect, ``at`` the step in them."""
        plan = self._plans.get(action is None)
        if plan is None:
            plan = self._plans[action is None] = _Plan(self, action is None, params, tuple(normals or ()))
        told = plan.run(action, normals, at, params)
        self.side = 1 - self.side
        return told


_DYNAMIC = {f"state_{name}" for name in ("position", "speed", "accel", "gap", "step")}


def _clock(state: State) -> Tensor:
    return state.step.to(state.speed.dtype).unsqueeze(-1).expand(state.speed.shape)


def _past(state: State) -> Array:
    past = past_rows(state.memory[PAST], tuple(state.speed.shape))
    return np.tile(past, (math.prod(state.memory[PAST].shape[-2:]) // len(past), 1))


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


class _Plan:
    """What is laid out for steps with a command, or for those without."""

    def __init__(self, values: Values, idle: bool, params: Params, draws: tuple[str, ...]) -> None:
        world = values.world
        assert world is not None
        self.values, self.idle = values, idle
        task, state = values.task, world.state
        self.shape, kind = tuple(state.speed.shape), state.speed.dtype
        self.rows, self.size = self.shape
        self.real = np.dtype(np.float32 if kind == torch.float32 else np.float64)
        # A number of rows that is no other dimension tells rows apart from everything else.
        many = next(p for p in (1009, 1013, 1019, 1021, 1031) if p not in (self.size, len(task.agents)))
        sample = {n: x[:1].expand(many, *x.shape[1:]).contiguous() for n, x in named(world).items()}
        if not idle:
            sample["action"] = torch.zeros(many, len(task.agents), dtype=kind)
        normals = {name: torch.zeros(many, self.size, dtype=kind) for name in draws}
        self.normals_of: dict[str, str] = {}
        inputs = self._record_before(sample, world, normals)
        self.kernel = self._kernel(state, inputs)
        self._record_after(sample, world)
        self._lay_out(inputs, state, many)
        self.params_of: list[tuple[Any, str, Tensor, int]] = []

    # -- recording -------------------------------------------------------------------------------------------------

    def _record_before(self, sample: dict[str, Tensor], world: World, normals: dict[str, Tensor]) -> dict[str, Any]:
        seen: dict[str, Any] = {}

        def before(**leaves: Tensor) -> dict[str, Tensor]:
            command, given, inputs = self.values._before(_world(leaves, world), leaves.get("action"), normals or None)
            seen.update(inputs)
            out = {} if command is None or given is None else {"command": command, "given": given}
            for effect, value in inputs.items():
                for part, x in ({"": value} if isinstance(value, Tensor) else value._asdict()).items():
                    if x is not None and x is normals.get(effect):
                        self.normals_of[slot_name(effect, part)] = effect
                    elif x is not None:
                        out[slot_name(effect, part).replace(" ", "_")] = x
            return out

        self.before = RowFunction(before, sample, len(sample["state_speed"]))
        return seen

    def _record_after(self, sample: dict[str, Tensor], world: World) -> None:
        examples = dict(sample)
        examples |= {f"later_{n}": x.clone() for n, x in sample.items() if n != "action"}
        examples.pop("action", None)
        if not self.idle:
            examples["command"], examples["given"] = sample["action"].clone(), sample["action"].clone()

        def after(**leaves: Tensor) -> dict[str, Tensor]:
            early = {n: x for n, x in leaves.items() if not n.startswith("later_")}
            later = _world(leaves, world, "later_")
            command = leaves.get("command")
            shape = (len(later.state.speed), len(self.values.task.agents))
            said = later.state.speed.new_zeros(shape) if command is None else command
            return self.values._after(_world(early, world), said, leaves.get("given"), later, command is not None)

        self.after = RowFunction(after, examples, len(sample["state_speed"]))

    def _kernel(self, state: State, inputs: Mapping[str, Any]) -> TileKernel:
        kernel = tile_kernel(self.values.task.simulator, Form.of(state, inputs))
        if isinstance(kernel, str):
            raise Untraceable(kernel)
        return kernel

    # -- arrays ----------------------------------------------------------------------------------------------------

    def _lay_out(self, inputs: Mapping[str, Any], state: State, many: int) -> None:
        kernel, values, rows, size = self.kernel, self.values, self.rows, self.size
        self.made = {n: np.empty(rows * math.prod(s), self.before.types[n]) for n, s in self.before.shapes.items()}
        self.outs = list(self.made.values())
        self.made |= {name: self.made[other] for name, (other, _) in self.before.same.items()}
        after = self.after
        self.answers = [(n, (rows, *s), after.types[n]) for n, s in after.shapes.items()]
        self.same = [(n, other, (rows, *s)) for n, (other, s) in after.same.items()]
        self.constant = {n: np.repeat(x[None], rows, 0) for n, x in after.constants.items()}
        self.names = [_place_of(n) for n in kernel.program.states]
        self.numbers = [self._input(inputs, n, many) for n in kernel.numbers]
        self.flags = [self._input(inputs, n, many) for n in kernel.flags]
        self.slots = state.memory[PAST].shape[-2] if kernel.signals else 0
        nothing = np.zeros((1, 1), self.real)
        for held in values.arrays:
            held.setdefault("past", nothing)
        wide = tiles.NARROW if self.slots and size <= tiles.NARROW else tiles.width(size, 1)
        around = tiles.halo(1, kernel.program.reach)
        self.extent = (1, rows, size, wide, around)
        self.tiles = tiles.tiles(rows, size, wide, around)
        self.kept = np.empty((4, 0, 1), self.real)

    def _input(self, inputs: Mapping[str, Any], slot: str, many: int) -> tuple[Array, Strides]:
        """Return where the kernel finds an input: an array that ``before`` fills, a constant, or later the noise."""
        if slot in self.normals_of:
            return np.empty(0, self.real), (self.rows * self.size, self.size, 1)
        name = slot.replace(" ", "_")
        if name in self.made:
            width = self.made[name].size // self.rows
            flat = self.made[name].view(np.uint8) if self.made[name].dtype == np.bool_ else self.made[name]
            return flat, (0, width, 0 if width < self.size else 1)
        x = part_of(inputs, slot)
        if x.dim() == len(self.shape) and x.shape[0] == many:
            x = x[:1]
        return operand(x[None], self.shape[:1], self.size, 1)

    def _fixed(self, params: Params) -> None:
        """Lay out what parameters give, and with it the whole call."""
        program, world = self.kernel.program, self.values.world
        assert world is not None
        still = {n: self.values.arrays[0].get(f"state_{n}") for n in ("length", "present")}
        state = world.state._replace(
            **{n: torch.from_numpy(x).view(self.shape) for n, x in still.items() if x is not None}  # type: ignore[arg-type]
        )
        simulator = self.values.task.simulator
        made = [
            operand(static_of(simulator, state, params, n).to(state.speed.dtype), self.shape[:1], self.size)
            for n in (*program.statics, *program.parameters)
        ]  # fmt: skip
        self.params_of = []
        for name in program.parameters:
            effect, parameter = name.split(".", 1)
            x = params[effect][parameter]
            self.params_of.append((params[effect], parameter, x, x._version))
        made += self.numbers
        every = [*(s for _, s in made), *(s for _, s in self.flags), (0, self.size, 1)]
        self.operands = [a for a, _ in made]
        first = len(made) - len(self.numbers)
        self.normals_at = {
            first + i: self.normals_of[n] for i, n in enumerate(self.kernel.numbers) if n in self.normals_of
        }
        flags = filled([a for a, _ in self.flags], FLAGS)
        kernel, kind = self.kernel, self.real.name
        self.head, self.tail = [], (flags, table(every), kernel.constants[kind])
        for side in (0, 1):
            old, new = self.values.arrays[side], self.values.arrays[1 - side]
            start, ends = (filled([x[n] for n in self.names], STATES) for x in (old, new))
            self.head.append((
                start, ends, old["past"], new["past"],
                self.slots, self.kept, kernel.measures, kernel.forward(kind), kernel.looks, kernel.recalls, kernel.read,
            ))  # fmt: skip
        self.asked = [[self._needed(n, side) for n in self.before.needs] for side in (0, 1)]
        self.told = [[self._needed(n, side) for n in self.after.needs] for side in (0, 1)]
        self.block: Any = None
        self.params = params

    def _needed(self, name: str, side: int) -> Array:
        if name in ("command", "given"):
            return self.made[name]
        if name == "action":
            return np.empty(0, self.real)
        later = name.startswith("later_")
        return self.values.arrays[1 - side if later else side][name.removeprefix("later_")]

    # -- steps -----------------------------------------------------------------------------------------------------

    def run(self, action: Array | None, normals: dict[str, Array] | None, at: int, params: Params) -> dict[str, Array]:
        """Do one step."""
        values, rows = self.values, self.rows
        side = values.side
        if not self.params_of or params is not self.params:
            self._fixed(params)
        for held, name, x, version in self.params_of:
            if held[name] is not x or x._version != version:
                self._fixed(params)
                break
        asked = self.asked[side]
        if action is not None:
            asked = [action if n == "action" else x for n, x in zip(self.before.needs, asked, strict=True)]
        self.before.run(rows, asked, self.outs)
        if normals is not self.block or self.block is None:
            for place, effect in self.normals_at.items():
                self.operands[place] = (normals or {})[effect]
            self.block = normals
            self.call = [(*head, filled(self.operands, OPERANDS), *self.tail) for head in self.head]
        call = self.call[side]
        if rows * self.size < 2 * pool.GRAIN:
            lane_loops.forward(*call, at, *self.extent, 0, self.tiles)
        else:
            pool.split(
                lambda begin, end: lane_loops.forward(*call, at, *self.extent, begin, end),
                self.tiles, 1, pool.count(rows * self.size),
            )  # fmt: skip
        np.add(values.arrays[side]["state_step"], 1, out=values.arrays[1 - side]["state_step"])
        told = {name: np.empty(shape, kind) for name, shape, kind in self.answers}
        self.after.run(rows, self.told[side], [x.reshape(-1) for x in told.values()])
        for name, other, shape in self.same:
            told[name] = told[other].reshape(shape)
        for name, value in self.constant.items():
            told[name] = value.copy()
        return told


def _place_of(state: str) -> str:
    if state == "step":
        return "clock"
    return f"memory_{state.removeprefix('memory of ')}" if state.startswith("memory of ") else f"state_{state}"
