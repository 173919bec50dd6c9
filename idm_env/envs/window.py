"""A window of an environment in one call: policy and steps compiled together, one node of autograd for all of it.

Shapes: a window has time first: ``[steps, rows, …]``.
"""

from __future__ import annotations

import weakref
from collections.abc import Mapping
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from idm_env.envs.policy_call import NO_NUMBERS, policy_outputs
from idm_env.envs.transition import CompiledTransition, Tables
from idm_env.envs.values import token_like
from idm_env.envs.worlds import Array, address
from idm_env.kernels import threads as pool
from idm_env.kernels.policy_rows import PolicyRows
from idm_env.kernels.rows import RowFunction, adjoint
from idm_env.kernels.sameness import digest
from idm_env.kernels.window_loop import AHEAD, BLOCK, window, window_back
from idm_env.scalar.record import Untraceable

if TYPE_CHECKING:
    from idm_env.envs.batch import Batch
    from idm_env.envs.values import Values

_FEW, _MANY, _MOST = 3, 1009, 8
"""Rows of a policy's recording to compare, to print (no other dimension), and how many prints of one are kept."""


class Driver:
    """A policy as compiled loops: what it does, and the vector-Jacobian product of that.

    ``memory`` is the shape of what it remembers of an environment, None where it remembers nothing.

    Raises:
        Untraceable: For a policy of other operations than those of small networks.
        ValueError: For one that does not take these observations, or gives no actions.
    """

    def __init__(
        self, policy: nn.Module, rows: int, width: int, actions: int, dtype: torch.dtype,
        memory: tuple[int, ...] | None = None,
    ) -> None:  # fmt: skip
        recording = _Recording(policy, width, actions, dtype, memory)
        with torch.no_grad():
            policy_outputs(
                policy, {n: torch.zeros(rows, *s, dtype=dtype) for n, s in recording.shapes.items()}, actions
            )
        self.names = recording.names
        inputs = recording.inputs(_MANY)
        shared = list(recording.sample)
        try:
            self.forward: PolicyRows = PolicyRows(recording.act, inputs, _MANY, shared)
        except RuntimeError as error:  # it takes as many rows as there are environments, no more
            raise Untraceable(str(error)) from error
        self._pulled, self._inputs, self._shared = recording.pulled, recording.seeded(inputs), shared

    @cached_property
    def backward(self) -> PolicyRows:
        """The vector-Jacobian product of the recorded policy."""
        return PolicyRows(self._pulled, self._inputs, _MANY, self._shared)

    def weights(self, policy: nn.Module) -> dict[str, Tensor]:
        """Return the policy's weights and buffers as they are now, by their short names."""
        own = _own(policy)
        return {short: own[n] for n, short in self.names.items()}


def _own(policy: nn.Module) -> dict[str, Tensor]:
    return {**dict(policy.named_parameters()), **dict(policy.named_buffers())}


class _Recording:
    """A policy as a function of its weights and its inputs, to be recorded; and its adjoint."""

    def __init__(
        self, policy: nn.Module, width: int, actions: int, dtype: torch.dtype, memory: tuple[int, ...] | None
    ) -> None:
        own = _own(policy)
        if any(x.dtype != dtype or not x.is_contiguous() for x in own.values()):
            raise Untraceable("a policy in another precision than the environment")
        names = self.names = dict(zip(own, (f"w{i}" for i in range(len(own))), strict=True))
        learned = [names[n] for n, _ in policy.named_parameters()]
        self.sample = {names[n]: x.detach().clone() for n, x in own.items()}
        self.dtype, self.actions = dtype, actions
        shapes = self.shapes = {"seen": (width,), **({} if memory is None else {"hidden": memory})}

        def act(**given: Tensor) -> dict[str, Tensor]:
            weights = {n: given[short] for n, short in names.items()}
            done = torch.func.functional_call(policy, weights, tuple(given[n] for n in shapes))
            action, *later = (done,) if memory is None else done
            return {"action": action + given["push"], **dict(zip(["later"], later, strict=False))}

        back = adjoint(act, ["action"] if memory is None else ["action", "later"], [*shapes, *learned])

        def pulled(**given: Tensor) -> dict[str, Tensor]:
            return {f"to_{n}": x for n, x in back(**given).items()}

        self.act, self.pulled = act, pulled

    def inputs(self, rows: int) -> dict[str, Tensor]:
        """Return examples of the policy's inputs."""
        shapes = {**self.shapes, "push": (self.actions,)}
        return {n: torch.zeros(rows, *shape, dtype=self.dtype) for n, shape in shapes.items()} | self.sample

    def seeded(self, inputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return examples of its adjoint's inputs."""
        with torch.no_grad():
            return {**inputs, **{f"on_{n}": torch.zeros_like(x) for n, x in self.act(**inputs).items()}}

    def digest(self) -> bytes:
        """Return the digest of all operations of the policy as it is now, of its adjoint, too."""
        inputs, graph = self.inputs(_FEW), torch.is_grad_enabled()
        forwards = digest(self.act, inputs, PolicyRows.simpler, gradients=graph)
        return forwards + (digest(self.pulled, self.seeded(inputs), PolicyRows.simpler) if graph else b"")


_DRIVERS: weakref.WeakKeyDictionary[nn.Module, dict[Any, Driver | None]] = weakref.WeakKeyDictionary()


def driver_of(policy: Any, seen: Tensor, actions: int, hidden: Tensor | None = None) -> Driver | None:
    """Return a policy as compiled loops; None where it runs by torch between the steps.

    It is recorded at every window, and loops are printed where none are the same. One that does something else at
    every call, or so often something new that printing would take longer, runs between the steps.
    """
    if not isinstance(policy, nn.Module):
        return None
    drivers, (rows, width), dtype = _DRIVERS.setdefault(policy, {}), seen.shape, seen.dtype
    memory = None if hidden is None else tuple(hidden.shape[1:])
    own = tuple((n, x.shape, x.dtype, x.stride()) for n, x in _own(policy).items())
    graph = torch.is_grad_enabled()
    form = (width, actions, dtype, memory, graph, own)
    if form in drivers:
        return None
    try:
        key = (form, _Recording(policy, width, actions, dtype, memory).digest())
        if key in drivers:
            return drivers[key]
        while len(drivers) >= _MOST:
            del drivers[next(iter(drivers))]
        drivers[key] = None
        driver = Driver(policy, rows, width, actions, dtype, memory)
        if graph:
            _ = driver.backward
        if _Recording(policy, width, actions, dtype, memory).digest() != key[1]:
            drivers[form] = None  # it changes by being called
            return None
        drivers[key] = driver
    except Untraceable:
        return None
    except Exception:  # a policy may raise anything at inputs that it does not take: between the steps that is told
        return None
    return driver


class _Segment(NamedTuple):
    """Steps ``first`` to ``last`` between two resets, or two blocks of normals: what held for them."""

    first: int
    last: int
    bound: Tables
    given: dict[str, Any]


def _each(x: Array, part: slice) -> Array:
    """Return the addresses of what an array holds for some steps."""
    return address(x) + np.arange(part.start, part.stop, dtype=np.int64) * (x.nbytes // len(x))


def _columns(loops: RowFunction, pointers: Mapping[str, Any], part: slice) -> Array:
    """Return tables of the loops of a policy, one for each step."""
    columns = np.empty((part.stop - part.start, len(loops.table({}))), np.int64)
    columns[:] = loops.table({})
    for name in (*loops.needs, *loops.outs, *getattr(loops, "sums", ())):
        columns[:, loops.place(name)] = pointers[name]
    return columns


class Tape:
    """What a window keeps: worlds before and after every step, and what was seen, remembered, done and returned.

    Everything else is computed once more backwards.
    """

    def __init__(
        self, plan: CompiledTransition, bound: Tables, driver: Driver, steps: int, blocks: Tensor, seen: Tensor,
        hidden: Tensor, push: Tensor,
    ) -> None:  # fmt: skip
        self.plan, self.driver, self.steps = plan, driver, steps
        rows, kind = plan.rows, plan.real
        self.worlds = torch.from_numpy(np.empty((steps, *blocks.shape), kind))  # numpy asks for large pages
        self.held: list[Any] = [blocks, push]
        self.outputs = bound.room.take(steps)
        self.seen = np.empty((steps + 1, seen.numel()), kind)
        self.seen[0] = seen.reshape(-1).numpy()
        self.hidden = np.empty((steps + 1, hidden.numel()), kind)
        self.hidden[0] = hidden.reshape(-1).numpy()
        self.final = self.outputs["observation"].reshape(steps, -1)
        self.push = push.numpy()
        self.action = np.empty((steps, push.numel()), kind)
        self.later = self.worlds.data_ptr() + np.arange(steps, dtype=np.int64) * blocks.numel() * blocks.element_size()
        self.now = np.concatenate(([blocks.data_ptr()], self.later[:-1]))
        self.clocks = np.empty((steps + 1, rows), np.int64)
        self.ends, self.cuts = (self.outputs[f"whole_{n}"].reshape(steps, rows) for n in ("terminated", "truncated"))
        self.segments: list[_Segment] = []
        self._blocks = -(-rows // BLOCK)
        self._threads = 1 if plan.count * AHEAD < 2 * pool.GRAIN else pool.count(plan.count * AHEAD)

    def given(self, part: slice, batch: Batch, values: Values) -> dict[str, Any]:
        """Return the addresses of what steps are given beside their worlds."""
        plan, past, count = self.plan, values.past, np.arange(part.stop - part.start, dtype=np.int64)
        _, normals = batch.ahead()
        self.held += [normals, past.numbers]
        pointers: dict[str, Any] = {
            f"normal_{n}": address(x) + (batch.used + count) * plan.pitch for n, x in (normals or {}).items()
        }
        if past.slots:
            pointers["past"] = address(past.numbers) + (past.newest - count) * plan.slot
            pointers["then_past"] = pointers["past"] - plan.slot
        return pointers | {"action": _each(self.action, part), "state_step": _each(self.clocks, part)}

    def run(self, batch: Batch, values: Values, weights: Mapping[str, Array]) -> None:
        """Do all steps; episodes that end begin anew."""
        plan, done = self.plan, 0
        self.clocks[0] = values.clock().numpy()
        while done < self.steps:
            ahead = batch.ahead()[0]
            part = slice(
                done, min(self.steps, done + ahead, done + (values.past.room() if values.past.slots else ahead))
            )
            bound = plan.of(values.layout, batch.episode_params())
            pointers, worlds = self.given(part, batch, values), (self.now[part], self.later[part])
            to = (
                pointers
                | {n: _each(x, part) for n, x in self.outputs.items()}
                | {"clock": _each(self.clocks[1:], part)}
            )
            own = {"seen": _each(self.seen, part), "push": address(self.push), "action": pointers["action"]}
            own |= {"hidden": _each(self.hidden, part), "later": _each(self.hidden[1:], part)}
            own |= {n: address(x) for n, x in weights.items()}
            tables = _columns(self.driver.forward, own, part), bound.ahead.filled(to, *worlds)
            count = self._ahead(bound, *tables, part)
            self.segments.append(_Segment(done, done + count, bound, {n: x[:count] for n, x in pointers.items()}))
            batch.used += count
            values.past.newest -= count if values.past.slots else 0
            done += count
            values.arrive(self.worlds[done - 1], self.clocks[done].copy())
            over = np.flatnonzero(self.ends[done - 1] | self.cuts[done - 1])
            batch.saw(torch.from_numpy(self.outputs["observation"][done - 1].copy()))
            if len(over):
                fresh = batch.reset(over)
                batch.settle()
                self.seen[done] = fresh.reshape(-1).numpy()  # type: ignore[union-attr]
                self.hidden[done].reshape(plan.rows, -1)[over] = 0.0
                self.held.append(values.blocks)
                if done < self.steps:
                    self.now[done] = values.blocks.data_ptr()
                self.clocks[done] = values.clock().numpy()

    def _ahead(self, bound: Tables, acts: Array, asks: Array, part: slice) -> int:
        """Do some steps of all blocks, or until somebody's episode is over; return how many."""
        done, last, plan = 0, part.stop - part.start, self.plan
        arrays = self.seen[part.start :], self.final[part], self.ends[part], self.cuts[part]
        loops = self.driver.forward.call, acts, bound.recorded.forward.call, asks, plan.rows
        while done < last:
            stops, until = list[int](), last if self._blocks == 1 else min(done + AHEAD, last)

            def some(begin: int, end: int, first: int = done, last: int = until, stops: list[int] = stops) -> None:
                stops.append(window(*loops, begin, end, first, last, *arrays))

            pool.split(some, self._blocks, 1, self._threads)
            done = min(stops)
            if done < until or (self.ends[part.start + done - 1] | self.cuts[part.start + done - 1]).any():
                break
        return done

    def back(
        self, weights: Mapping[str, Array], on_seen: Array, on_last: Array, on_action: Array, on_reward: Array,
        on_worlds: Array, on_past: Array, on_hidden: Array,
    ) -> tuple[Array, Array, Array, Array, dict[str, Array]]:  # fmt: skip
        """Return what falls on first worlds, the past then, parameters, actions (every step), and sums of weights."""
        plan, driver, steps = self.plan, self.driver, self.steps
        two, pasts = np.zeros((2, *on_worlds.shape), plan.real), np.zeros((2, *on_past.shape), plan.real)
        two[steps % 2], pasts[steps % 2] = on_worlds, on_past
        parameters, each = np.zeros((2, len(self.segments[0].bound.wanted), plan.count), plan.real)
        acted = np.zeros_like(self.action)
        on_observation, looked = np.zeros((2, self.seen.shape[1]), plan.real)
        total, recalled, on_later = on_seen[steps].copy(), on_hidden.copy(), np.empty_like(on_hidden)
        threads = min(self._threads, self._blocks)
        sums = [{n: np.zeros(size, plan.real) for n, size in driver.backward.sums.items()} for _ in range(threads)]
        remembers = "to_hidden" in driver.backward.outs
        for segment in reversed(self.segments):
            part, recorded = slice(segment.first, segment.last), segment.bound.recorded
            side = np.arange(part.start, part.stop) % 2
            falls = {f"on_{n}": address(plan.zeros) for n in recorded.flowing} | segment.given
            falls |= {"on_observation": address(on_observation), "on_whole_reward": _each(on_reward, part)}
            falls |= {"to_action": _each(acted, part)}
            falls |= {"on_past": address(pasts[0]) + (1 - side) * pasts[0].nbytes}
            falls |= {"to_past": address(pasts[0]) + side * pasts[0].nbytes}
            begins, seeds = (address(two) + k * two[0].nbytes for k in (side, 1 - side))
            worlds = self.now[part], seeds, begins, np.full(len(side), address(each))
            asks = segment.bound.back.filled(falls, *worlds)
            see = {"seen": _each(self.seen, part), "push": address(self.push), "on_action": falls["to_action"]}
            see |= {n: address(x) for n, x in weights.items()} | {"to_seen": address(looked)}
            see |= {"hidden": _each(self.hidden, part), "on_later": address(on_later), "to_hidden": address(recalled)}
            shared = recorded.backward.call, asks, plan.rows, plan.size
            arrays = (
                segment.first % 2, segment.last - segment.first, self.ends[part], self.cuts[part], two, pasts,
                on_seen[part], on_last[part], on_action[part], acted[part], on_observation, looked, total, recalled,
                on_later, remembers, each, parameters,
            )  # fmt: skip
            some = partial(_rows_back, driver.backward, list(sums), see, part, shared, arrays)
            pool.split(some, self._blocks, 1, threads)
        summed = {n: sum((x[n] for x in sums[1:]), sums[0][n]) for n in sums[0]}
        return two[0], pasts[0], parameters, acted, {**summed, "seen": total, "hidden": recalled}


def _rows_back(
    loops: PolicyRows, free: list[Any], see: Mapping[str, Any], part: slice, shared: Any, arrays: Any, *span: int
) -> None:
    """Go back over a span of blocks with sums that no other thread has taken."""
    own = {n: address(x) for n, x in free.pop().items()}
    window_back(loops.call, _columns(loops, {**see, **own}, part), *shared, *span, *arrays)


class _Window(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, tape: Tape, batch: Batch, values: Values, names: tuple[str, ...], blocks: Tensor,
        token: Tensor | None, seen: Tensor, hidden: Tensor, push: Tensor, *given: Tensor,
    ) -> tuple[Tensor | None, ...]:  # fmt: skip
        weights = {n: x.detach().numpy() for n, x in zip(names, given, strict=False)}
        tape.run(batch, values, weights)
        for name, x in (("actions", tape.action), ("hidden numbers", tape.hidden)):
            if not np.isfinite(x).all():
                raise ValueError(NO_NUMBERS.format(name))
        rows, steps = tape.plan.rows, tape.steps
        parameters = [x for _, x in tape.segments[0].bound.wanted]
        ctx.tape, ctx.names, ctx.shapes = tape, names, [x.shape for x in parameters]
        ctx.save_for_backward(blocks, seen, hidden, push, *given)
        ctx.set_materialize_grads(False)
        shaped = (steps, rows, -1)
        return (
            values.blocks.clone(), None if token is None else token_like(token),
            torch.from_numpy(tape.seen).view(steps + 1, rows, -1), torch.from_numpy(tape.action).view(shaped),
            torch.from_numpy(tape.outputs["whole_reward"]).view(steps, rows), torch.from_numpy(tape.final).view(shaped),
            torch.from_numpy(tape.hidden[-1]).view(hidden.shape),
        )  # fmt: skip

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *on: Tensor | None) -> Any:  # type: ignore[override]
        tape, plan = ctx.tape, ctx.tape.plan
        blocks, seen, hidden, push, *tensors = ctx.saved_tensors
        weights = {n: x.detach().numpy() for n, x in zip(ctx.names, tensors, strict=False)}

        def dense(x: Tensor | None, *shape: int) -> Array:
            return np.zeros(shape, plan.real) if x is None else np.ascontiguousarray(x.numpy()).reshape(shape)

        steps, wide, acts = tape.steps, tape.seen.shape[1], tape.action.shape[1]
        on_now, on_past, on_parameters, acted, sums = tape.back(
            weights, dense(on[2], steps + 1, wide), dense(on[5], steps, wide), dense(on[3], steps, acts),
            dense(on[4], steps, plan.rows), dense(on[0], len(blocks), plan.count),
            dense(on[1], *(plan.past_shape or (plan.rows, 1, 1, 1))),
            dense(on[6], hidden.numel()),
        )  # fmt: skip
        gradients: list[Tensor | None] = [torch.from_numpy(on_now).view(blocks.shape)]
        gradients.append(torch.from_numpy(on_past) if plan.past_shape else None)
        gradients.append(torch.from_numpy(sums["seen"]).view(seen.shape))
        gradients.append(torch.from_numpy(sums["hidden"]).view(hidden.shape))
        gradients.append(torch.from_numpy(acted.sum(0)).view(push.shape))
        summed = tape.driver.backward.summed
        for name, x in zip(ctx.names, tensors, strict=False):
            if f"to_{name}" not in summed:
                gradients.append(None)
                continue
            array, shape, strides, offset = summed[f"to_{name}"]
            gradients.append(torch.from_numpy(sums[array]).as_strided(shape, strides, offset).reshape(x.shape))
        for (i, x), shape in zip(tape.segments[0].bound.wanted, ctx.shapes, strict=True):
            gradients.append(torch.from_numpy(on_parameters[i]).view(blocks.shape[1:]).sum_to_size(shape).to(x.dtype))
        return (None,) * 4 + tuple(gradients)


def compiled(
    batch: Batch, values: Values, policy: Any, steps: int, push: Tensor, hidden: Tensor | None
) -> tuple[Any, ...] | None:
    """Return the fields of a window whose policy runs inside the loops, or None where it cannot."""
    seen = batch.seen()
    driver = driver_of(policy, seen, push.shape[-1], hidden)
    if driver is None:
        return None
    plan = values.plan((False, True), batch.task.simulator.draws, steps)
    first = values.blocks
    begun = seen.new_zeros(len(seen), 0) if hidden is None else hidden
    bound = plan.of(values.layout, batch.episode_params())
    tape = Tape(plan, bound, driver, steps, first.detach(), seen.detach(), begun.detach(), push.detach())
    token = values.token_of(plan)
    weights = driver.weights(policy)
    tensors = (*weights.values(), *(x for _, x in bound.wanted))
    mark = batch.mark()
    try:
        out = _Window.apply(tape, batch, values, tuple(weights), first, token, seen, begun, push, *tensors)
    except BaseException:
        batch.back_to(mark)
        raise
    values.arrive(out[0], values.clock().numpy(), out[1])
    rows = plan.rows
    batch.saw(out[2][-1].view(rows, len(batch.task.agents), -1))
    ends, cuts = (torch.from_numpy(x.copy()) for x in (tape.ends, tape.cuts))
    return (out[2], out[3], out[4], ends, cuts, out[5], None if hidden is None else out[6])
