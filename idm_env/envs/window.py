"""A window of an environment in one call: policy and steps compiled together, one node of autograd for all of it.

Shapes: a window has time first: ``[steps, rows, …]``.
"""

from __future__ import annotations

import weakref
from collections.abc import Mapping, Sequence
from functools import cached_property, partial, reduce
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from idm_env.compiled.kernels import threads as pool
from idm_env.compiled.kernels.policy_rows import PolicyRows
from idm_env.compiled.kernels.rows import RowFunction, adjoint
from idm_env.compiled.kernels.sameness import digest
from idm_env.compiled.kernels.window_loop import AHEAD, BLOCK, window, window_back
from idm_env.compiled.scalar.record import Untraceable
from idm_env.envs.policy_call import NO_NUMBERS, policy_outputs
from idm_env.envs.transition import CompiledTransition, Tables
from idm_env.envs.values import token_like
from idm_env.envs.worlds import Array, Moment, address, row_addresses

if TYPE_CHECKING:
    from idm_env.envs.batch import Batch
    from idm_env.envs.values import Values

_FEW, _MANY, _MOST = 3, 1009, 8
"""Rows of a policy's recording to compare, to print (no other dimension), and how many prints of one are kept."""


_PARTS = 8
"""Parts of a large window, each with its own sum of the weights' gradients: bits do not depend on threads."""


class Driver:
    """A policy as a function of its weights and its inputs, and as compiled loops: what it does, and the adjoint.

    ``memory`` is the shape of what it remembers of an environment, None where it remembers nothing.

    Raises:
        Untraceable: For a policy of other operations than those of small networks.
    """

    def __init__(
        self, policy: nn.Module, width: int, actions: int, dtype: torch.dtype, memory: tuple[int, ...] | None = None
    ) -> None:
        own = _own(policy)
        if any(x.dtype != dtype or not x.is_contiguous() for x in own.values()):
            raise Untraceable("a policy in another precision than the environment")
        names = self.names = dict(zip(own, (f"w{i}" for i in range(len(own))), strict=True))
        learned = [names[n] for n, _ in policy.named_parameters()]
        self._sample = {names[n]: x.detach().clone() for n, x in own.items()}
        self._dtype, self._actions = dtype, actions
        shapes = self._shapes = {"seen": (width,), **({} if memory is None else {"hidden": memory})}

        def act(**given: Tensor) -> dict[str, Tensor]:
            weights = {n: given[short] for n, short in names.items()}
            done = torch.func.functional_call(policy, weights, tuple(given[n] for n in shapes))
            action, *later = (done,) if memory is None else done
            return {"action": action + given["push"], **dict(zip(["later"], later, strict=False))}

        back = adjoint(act, ["action"] if memory is None else ["action", "later"], [*shapes, *learned])

        def pulled(**given: Tensor) -> dict[str, Tensor]:
            return {f"to_{n}": x for n, x in back(**given).items()}

        self._act, self._pulled = act, pulled

    def check(self, policy: nn.Module, rows: int) -> None:
        """Call the policy once; ValueError for one that does not take these observations, or gives no actions."""
        blank = {n: torch.zeros(rows, *shape, dtype=self._dtype) for n, shape in self._shapes.items()}
        with torch.no_grad():
            policy_outputs(policy, blank, self._actions)

    def _inputs(self, rows: int) -> dict[str, Tensor]:
        shapes = {**self._shapes, "push": (self._actions,)}
        return {n: torch.zeros(rows, *shape, dtype=self._dtype) for n, shape in shapes.items()} | self._sample

    def _seeded(self, rows: int) -> dict[str, Tensor]:
        """Return examples of the adjoint's inputs."""
        inputs = self._inputs(rows)
        with torch.no_grad():
            return {**inputs, **{f"on_{n}": torch.zeros_like(x) for n, x in self._act(**inputs).items()}}

    @cached_property
    def forward(self) -> PolicyRows:
        """The loops of the policy. Untraceable also for one that takes as many rows as there are environments only."""
        try:
            return PolicyRows(self._act, self._inputs(_MANY), _MANY, list(self._sample))
        except RuntimeError as error:
            raise Untraceable(str(error)) from error

    @cached_property
    def backward(self) -> PolicyRows:
        """The vector-Jacobian product of the recorded policy."""
        return PolicyRows(self._pulled, self._seeded(_MANY), _MANY, list(self._sample))

    def weights(self, policy: nn.Module) -> dict[str, Tensor]:
        """Return the policy's weights and buffers as they are now, by their short names."""
        own = _own(policy)
        return {short: own[n] for n, short in self.names.items()}

    def digest(self) -> bytes:
        """Return the digest of all operations of the policy as it is now, of its adjoint, too."""
        graph = torch.is_grad_enabled()
        forwards = digest(self._act, self._inputs(_FEW), PolicyRows.simpler, gradients=graph)
        return forwards + (digest(self._pulled, self._seeded(_FEW), PolicyRows.simpler) if graph else b"")


def _own(policy: nn.Module) -> dict[str, Tensor]:
    return {**dict(policy.named_parameters()), **dict(policy.named_buffers())}


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
        driver = Driver(policy, width, actions, dtype, memory)
        key = (form, driver.digest())
        if key in drivers:
            return drivers[key]
        while len(drivers) >= _MOST:
            del drivers[next(iter(drivers))]
        drivers[key] = None
        driver.check(policy, rows)
        _ = driver.forward, graph and driver.backward
        if driver.digest() != key[1]:
            drivers[form] = None  # it changes by being called
            return None
        drivers[key] = driver
    except Untraceable:
        return None
    except Exception:  # a policy may raise anything at inputs that it does not take: between the steps that is told
        return None
    return driver


class _Segment(NamedTuple):
    """Steps ``first`` to ``last`` of which only the first may change lanes, or be behind a reset: what held for them.

    ``begins`` is where worlds begin from which steps are computed.
    """

    first: int
    last: int
    moment: Moment
    begins: tuple[Array, ...]
    pointers: dict[str, Array]


def _columns(loops: RowFunction, pointers: Mapping[str, Any], steps: int) -> Array:
    """Return tables of the loops of a policy, one for each step."""
    columns = np.tile(loops.table({}), (steps, 1))
    for name in (*loops.needs, *loops.outs, *getattr(loops, "sums", ())):
        columns[:, loops.place(name)] = pointers[name]
    return columns


class Tape:
    """The memory of a window: worlds, observations, hidden numbers, actions and outputs of every Δt.

    Everything else is computed once more backwards. Each of ``actions`` is held for ``held`` steps of Δt.
    """

    def __init__(
        self, plan: CompiledTransition, bound: Tables, driver: Driver, actions: int, blocks: Tensor, seen: Tensor,
        hidden: Tensor, push: Tensor,
    ) -> None:  # fmt: skip
        held = self.held = plan.task.held
        self.plan, self.driver, self.actions, self.steps = plan, driver, actions, actions * held
        rows, kind, steps = plan.rows, plan.real, self.steps
        self.worlds = torch.from_numpy(np.empty((steps, *blocks.shape), kind))  # numpy asks for large pages
        self.held_memory: list[Any] = [blocks, push]
        self.outputs = bound.room.take(steps)
        self.seen = np.empty((actions + 1, seen.numel()), kind)
        self.seen[0] = seen.reshape(-1).numpy()
        self.hidden = np.empty((actions + 1, hidden.numel()), kind)
        self.hidden[0] = hidden.reshape(-1).numpy()
        self.final = self.outputs["observation"].reshape(steps, -1)
        self.push = push.numpy()
        self.action = np.empty((actions, push.numel()), kind)
        self.later = self.worlds.data_ptr() + np.arange(steps, dtype=np.int64) * blocks.numel() * blocks.element_size()
        self.now = np.concatenate(([blocks.data_ptr()], self.later[:-1]))
        self.clocks = np.empty((steps + 1, rows), np.int64)
        self.on_road = np.empty((steps + 1, rows * len(plan.task.agents)), np.bool_)
        self.ends, self.cuts = (self.outputs[f"whole_{n}"].reshape(steps, rows) for n in ("terminated", "truncated"))
        self.segments: list[_Segment] = []
        self._blocks = -(-rows // BLOCK)
        some = plan.count * AHEAD >= 2 * pool.GRAIN
        self._threads = pool.count(plan.count * AHEAD) if some else 1
        self._parts = min(self._blocks, _PARTS) if some else 1

    def run(self, batch: Batch, values: Values, weights: Mapping[str, Array]) -> None:
        """Do all steps; episodes that end begin anew with the next action."""
        plan, held, done = self.plan, self.held, 0
        decides = {"seen": self.seen, "hidden": self.hidden, "later": self.hidden[1:]}
        self.clocks[0] = values.now.clock
        self.on_road[0] = batch.on_road().reshape(-1)
        while done < self.steps:
            ahead = min(batch.ahead()[0], 1 + plan.until(self.clocks[done] + 1))
            ahead = min(ahead, values.past.room()) if values.past.slots else ahead
            # Whoever ends begins anew after the action.
            ahead = min(ahead, held - done % held) if done % held else ahead
            part = slice(done, min(self.steps, done + ahead))
            steps = np.arange(part.start, part.stop, dtype=np.int64)
            bound, decided, (_, normals) = plan.of(values.layout, batch.episode_params()), steps // held, batch.ahead()
            past, clock, now = values.past, self.clocks[done], done // held
            here = clock, self.action[now], self.on_road[now * held], normals, batch.now.used, past.numbers, past.newest
            moment = Moment(*here, bound, values.now.whole, looks=(held - 1 - done) % held)
            self.held_memory += [normals, past.numbers]
            pointers = plan.moving(moment, steps - done) | {"state_step": row_addresses(self.clocks, steps)}
            pointers |= {"live": row_addresses(self.on_road, decided * held)}
            pointers |= {"action": row_addresses(self.action, decided)}
            own: dict[str, Any] = {n: row_addresses(x, decided) for n, x in decides.items()}
            own |= {n: address(x) for n, x in weights.items()} | {"push": address(self.push)} | pointers
            acts = _columns(self.driver.forward, own, len(steps))
            if done % held == 0 and plan.until(moment.clock) == 0:
                self.driver.forward.run(0, plan.rows, address(acts))
            worlds = plan.columns(moment, values.now, self.now[part], self.later[part])
            to = pointers | {n: row_addresses(x, steps) for n, x in self.outputs.items()}
            to |= {"clock": row_addresses(self.clocks[1:], steps), "on_road": row_addresses(self.on_road[1:], steps)}
            count = self._ahead(bound, acts, bound.ahead.filled(to, *worlds), part)
            self.segments.append(_Segment(done, done + count, moment, worlds[: len(plan.before)], pointers))
            batch.now.used += count
            values.past.newest -= count if values.past.slots else 0
            done += count
            whole = moment.crossing.later[count - 1] if moment.crossing else None
            values.arrive(self.worlds[done - 1], self.clocks[done].copy(), whole=whole)
            batch.saw(torch.from_numpy(self.outputs["observation"][done - 1].copy()))
            if done % held == 0:
                self._reset(batch, values, done)
        self._count()

    def _reset(self, batch: Batch, values: Values, done: int) -> None:
        """Begin anew where an episode has ended within the last action."""
        last = slice(done - self.held, done)
        over = np.flatnonzero((self.ends[last] | self.cuts[last]).any(0))
        if len(over):
            fresh = batch.reset(over)
            batch.settle()
            action = done // self.held
            self.seen[action] = fresh.reshape(-1).numpy()  # type: ignore[union-attr]
            self.hidden[action].reshape(self.plan.rows, -1)[over] = 0.0
            self.held_memory.append(values.now.blocks)
            if done < self.steps:
                self.now[done] = values.now.blocks.data_ptr()
            self.clocks[done] = values.now.clock
            self.on_road[done] = batch.on_road().reshape(-1)

    def _ahead(self, bound: Tables, acts: Array, asks: Array, part: slice) -> int:
        """Do some steps of all blocks, or until somebody's episode is over; return how many."""
        done, last, held, (action, odd) = 0, part.stop - part.start, self.held, divmod(part.start, self.held)
        arrays = self.seen[action:], self.final[part], self.ends[part], self.cuts[part]
        loops = self.driver.forward.call, acts, bound.recorded.forward.call, asks, self.plan.rows, held, odd
        while done < last:
            whole_actions = (odd + done + max(AHEAD, held)) // held * held - odd
            stops, until = list[int](), last if self._blocks == 1 else min(whole_actions, last)

            def some(begin: int, end: int, first: int = done, last: int = until, stops: list[int] = stops) -> None:
                stops.append(window(*loops, begin, end, first, last, *arrays))

            pool.split(some, self._blocks, 1, self._threads)
            done = min(stops)
            recent = slice((part.start + done - 1) // held * held, part.start + done)
            if done < until or (self.ends[recent] | self.cuts[recent]).any():
                break
        return done

    def _count(self) -> None:
        """Say whose episode has ended since an action began, which steps count, and the last one that does.

        Steps after the end of an episode, until the next action, do not count.
        """
        over = (self.ends | self.cuts).reshape(self.actions, self.held, -1)
        over = np.logical_or.accumulate(over, axis=1)
        self.over, self.counts = over.reshape(self.steps, -1), np.ones_like(over)
        self.counts[:, 1:] = ~over[:, :-1]
        self.tells = np.arange(self.actions)[:, None] * self.held + self.counts.sum(1) - 1

    def last(self, name: str) -> Array:
        """Return an output of the last step of every action that counts: ``(actions, rows, …)``."""
        x, rows = self.outputs[name], np.arange(self.plan.rows)
        return x.reshape(self.steps, len(rows), -1)[self.tells, rows]

    def reward(self) -> Array:
        """Return the sum of the rewards of every action ``(actions, rows)``."""
        parts = self.outputs["whole_reward"].reshape(self.counts.shape)
        return reduce(np.add, (parts * self.counts).swapaxes(0, 1))

    def back(
        self, weights: Mapping[str, Array], on_seen: Array, on_final: Array, on_action: Array, on_reward: Array,
        on_worlds: Array, on_past: Array, on_hidden: Array,
    ) -> tuple[Array, Array, Array, Array, dict[str, Array]]:  # fmt: skip
        """Return what falls on first worlds, the past then, parameters, actions, and sums of weights."""
        plan, driver, steps, held = self.plan, self.driver, self.steps, self.held
        two, pasts = np.zeros((2, *on_worlds.shape), plan.real), np.zeros((2, *on_past.shape), plan.real)
        two[steps % 2], pasts[steps % 2] = on_worlds, on_past
        mid = np.empty((len(plan.worlds) - 1, *on_worlds.shape), plan.real)
        parameters, each = np.zeros((2, len(self.segments[0].moment.bound.wanted), plan.count), plan.real)
        acted, done = np.zeros_like(self.action), np.zeros(self.action.shape[1], plan.real)
        on_observation, looked = np.zeros((2, self.seen.shape[1]), plan.real)
        on_last = on_final if held == 1 else np.zeros(self.final.shape, plan.real)
        if held > 1:
            rows = np.arange(plan.rows)
            on_last.reshape(steps, plan.rows, -1)[self.tells, rows] = on_final.reshape(self.actions, plan.rows, -1)
        on_reward = (on_reward[:, None] * self.counts).reshape(steps, -1)
        total, recalled, on_later = on_seen[-1].copy(), on_hidden.copy(), np.empty_like(on_hidden)
        sums = [{n: np.zeros(k, plan.real) for n, k in driver.backward.sums.items()} for _ in range(self._parts)]
        remembers = "to_hidden" in driver.backward.outs
        for first, last, moment, before, pointers in reversed(self.segments):
            recorded, numbers = moment.bound.recorded, np.arange(first, last)
            side = numbers % 2
            falls: dict[str, Any] = {f"on_{n}": address(plan.zeros) for n in recorded.flowing}
            falls |= {n: x[: last - first] for n, x in pointers.items()}
            falls |= {"on_observation": address(on_observation), "on_whole_reward": row_addresses(on_reward, numbers)}
            falls |= {"to_action": address(done)}
            falls |= {"on_past": address(pasts[0]) + (1 - side) * pasts[0].nbytes}
            falls |= {"to_past": address(pasts[0]) + side * pasts[0].nbytes}
            begins, seeds = (address(two) + k * two[0].nbytes for k in (side, 1 - side))
            constant = (np.full(len(side), address(x)) for x in (*mid, each))
            asks = moment.bound.back.filled(falls, *(x[: last - first] for x in before), seeds, begins, *constant)
            see = {"seen": row_addresses(self.seen, numbers // held), "push": address(self.push)}
            see |= {"hidden": row_addresses(self.hidden, numbers // held)}
            see |= {"on_action": row_addresses(acted, numbers // held)}
            see |= {n: address(x) for n, x in weights.items()} | {"to_seen": address(looked)}
            see |= {"on_later": address(on_later), "to_hidden": address(recalled)}
            shared = recorded.backward.call, asks, plan.rows, plan.size, held
            part = first, last - first, self.over[first:last], two, mid, pasts, on_seen, on_last[first:last]
            policy = on_action, acted, done, on_observation, looked, total, recalled, on_later, remembers
            arrays = (*part, *policy, each, parameters)
            some = partial(_parts_back, driver.backward, sums, see, (shared, arrays, self._blocks))
            pool.split(some, self._parts, 1, self._threads)
            if len(mid):
                two[first % 2] = plan.first(moment, (two[first % 2], *mid), parameters)
        summed = {n: sum((x[n] for x in sums[1:]), sums[0][n]) for n in sums[0]}
        return two[0], pasts[0], parameters, acted, {**summed, "seen": total, "hidden": recalled}


def _parts_back(loops: PolicyRows, sums: Sequence[Any], see: Mapping[str, Any], laid: Any, *span: int) -> None:
    """Go back over a span of parts of the blocks, each with sums of its own."""
    shared, arrays, blocks = laid
    acts = _columns(loops, {**see, **dict.fromkeys(sums[0], 0)}, arrays[1])
    for part in range(*span):
        for name, x in sums[part].items():
            acts[:, loops.place(name)] = address(x)
        begin, end = (blocks * k // len(sums) for k in (part, part + 1))
        window_back(loops.call, acts, *shared, begin, end, *arrays)


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
        rows, actions = tape.plan.rows, tape.actions
        parameters = [x for _, x in tape.segments[0].moment.bound.wanted]
        ctx.tape, ctx.names, ctx.shapes = tape, names, [x.shape for x in parameters]
        ctx.save_for_backward(blocks, seen, hidden, push, *given)
        ctx.set_materialize_grads(False)
        seen, action = torch.from_numpy(tape.seen), torch.from_numpy(tape.action).view(actions, rows, -1)
        reward, last, hidden_last = map(torch.from_numpy, (tape.reward(), tape.last("observation"), tape.hidden[-1]))
        after = values.now.blocks.clone(), None if token is None else token_like(token)
        return (*after, seen.view(actions + 1, rows, -1), action, reward, last, hidden_last.view(hidden.shape))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *on: Tensor | None) -> Any:  # type: ignore[override]
        tape, plan = ctx.tape, ctx.tape.plan
        blocks, seen, hidden, push, *tensors = ctx.saved_tensors
        weights = {n: x.detach().numpy() for n, x in zip(ctx.names, tensors, strict=False)}

        def dense(x: Tensor | None, *shape: int) -> Array:
            return np.zeros(shape, plan.real) if x is None else np.ascontiguousarray(x.numpy()).reshape(shape)

        actions, wide, acts = tape.actions, tape.seen.shape[1], tape.action.shape[1]
        on_steps = dense(on[2], actions + 1, wide), dense(on[5], actions, wide), dense(on[3], actions, acts)
        on_worlds = dense(on[4], actions, plan.rows), dense(on[0], len(blocks), plan.count)
        on_ends = dense(on[1], *(plan.past_shape or (plan.rows, 1, 1, 1))), dense(on[6], hidden.numel())
        on_now, on_past, on_parameters, acted, sums = tape.back(weights, *on_steps, *on_worlds, *on_ends)
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
        for (i, x), shape in zip(tape.segments[0].moment.bound.wanted, ctx.shapes, strict=True):
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
    plan = values.plan((False, not batch.task.journeys), batch.task.simulator.draws, steps)
    first = values.now.blocks
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
    values.arrive(out[0], values.now.clock, out[1])
    batch.saw(out[2][-1])
    ends, cuts = (torch.from_numpy(tape.last(f"whole_{n}")[..., 0]) for n in ("terminated", "truncated"))
    return (out[2], out[3], out[4], ends, cuts, out[5], None if hidden is None else out[6])
