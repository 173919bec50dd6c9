"""The worlds of a batch as arrays that compiled loops step (``transition.py``), with a graph where one is asked for.

A step is one node of autograd: its forward pass and its vector-Jacobian product are the plan's. Between steps the graph
goes through the blocks of the world, one tensor, and a token that stands for the past.

Shapes: worlds are blocks ``[rows · vehicles]`` of every leaf, what is told has rows first: ``[rows, …]``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from idm_env.compiled.kernels.operands import gradients
from idm_env.compiled.kernels.reads import Reads
from idm_env.compiled.scalar.record import Unordered, Untraceable
from idm_env.delay_buffer import PAST
from idm_env.envs.lane_transition import LaneTransition
from idm_env.envs.moves import Moves
from idm_env.envs.past import Past
from idm_env.envs.transition import CompiledTransition, Tables
from idm_env.envs.worlds import WHOLE, Array, Frame, Layout, Moment, named, world_of
from idm_env.tasks import EnvState
from idm_env.types import Params, mapped

_WORTHWHILE = 64
"""Steps by torch that take as long as to record a step anew."""


class Values:
    """The worlds of a batch as arrays, and their steps.

    ``graph`` says that steps may have a graph; then nothing that a step has read is written to later. ``whole`` are
    whole numbers ``(WHOLE, rows · vehicles)`` of all rows, as they are now, on a road of several lanes.

    Raises:
        Untraceable: From ``load`` and ``step``, before anything has changed, where the task, its simulator or what
            carries a graph cannot be recorded.
    """

    def __init__(self, moves: Moves, *, graph: bool) -> None:
        self._moves, self._graph = moves, graph
        self._plans: dict[tuple[bool, bool], CompiledTransition] = {}
        self._reads: Reads | None = None
        self._steady = _WORTHWHILE
        self._key: Any = None
        self.layout = Layout((), {}, 0)
        self.now: Frame
        self._spare: Frame
        self._wholes: dict[int, Array] = {}
        self._token: Tensor | None = None
        self.past: Past
        self._world: EnvState

    # -- worlds --------------------------------------------------------------------------------------------------

    def load(self, world: EnvState) -> None:
        """Take over worlds; they are copied, with the graph of what steps change.

        Untraceable where something carries a graph that no step changes.
        """
        leaves = named(world)
        key = (world.state.speed.shape, world.state.speed.dtype, tuple(world.state.memory), tuple(world.episode))
        blocks = tuple(n for n in leaves if n in _DYNAMIC or n.startswith("memory_"))
        fixed = next((n for n, x in leaves.items() if x.requires_grad and n not in blocks), None)
        if fixed is not None:
            raise Untraceable(f"{fixed.replace('_', '.', 1)} carries a graph")
        self._world, stays = mapped(lambda x: x.detach(), world), key == self._key and not self._graph
        still = {n: np.array(x.numpy(), order="C").reshape(-1) for n, x in leaves.items() if n not in blocks}
        clock, whole = still.pop("state_step"), [still.pop(n) for n in WHOLE if n in still]
        old = self.layout.still
        if still.keys() != old.keys() or not all(np.array_equal(x, old[n]) for n, x in still.items()):
            self.layout = Layout(blocks, still, self.layout.version + 1)
        now = Frame(_block(world, blocks), clock, np.stack(whole) if whole else None)
        if stays:
            self.now.take(now)
        else:
            empty = torch.empty_like(now.blocks), clock.copy(), None if now.whole is None else now.whole.copy()
            self.now, self._spare, self._wholes = now, Frame(*empty), {}
        if key != self._key:
            self._key, self._plans = key, {}
        self.past = Past(world.state, writes_once=self._graph)
        self.past.load(world.state)
        past = world.state.memory.get(PAST)
        self._token = None
        if past is not None and past.requires_grad:
            self._token = _Enter.apply(past, tuple(world.state.speed.shape))

    def replace(self, rows: Array, fresh: EnvState) -> None:
        """Replace some rows (indices) by the worlds of ``fresh``, with their graph; that of the rows before is cut."""
        index, blocks = torch.from_numpy(np.asarray(rows)), _block(fresh, self.layout.blocks)
        leaves, now = {n: x.detach().numpy() for n, x in named(fresh).items()}, self.now
        if self._graph:
            whole = None if now.whole is None else now.whole.copy()
            self.now = now = Frame(now.blocks.index_copy(1, index, blocks), now.clock.copy(), whole)
            self.past = self.past.copy()
            if self._token is not None:
                self._token = _Forget.apply(self._token, index)
        else:
            now.blocks[:, index] = blocks
        now.clock[rows] = leaves["state_step"]
        self.past.replace(rows, fresh.state)
        for name, held in zip([n for n in WHOLE if n in leaves], () if now.whole is None else now.whole, strict=True):
            held.reshape(len(now.clock), -1)[rows] = leaves[name]
        for name, held in self.layout.still.items():
            values = leaves[name]
            old = held.reshape(len(now.clock), *values.shape[1:])
            if np.array_equal(old[rows], values):
                continue
            if self._graph:
                # What earlier steps have read stays as it was.
                old = old.copy()
                still = {**self.layout.still, name: old.reshape(-1)}
                self.layout = self.layout._replace(still=still, version=self.layout.version + 1)
            old[rows] = values

    def current(self) -> EnvState:
        """Return the worlds as tensors of their own."""
        now, layout = self.now, self.layout._replace(still={n: x.copy() for n, x in self.layout.still.items()})
        past = self.past.tensor() if self.past.slots else None
        if past is not None and self._token is not None:
            past = _Leave.apply(self._token, past)
        whole, blocks = None if now.whole is None else now.whole.copy(), now.blocks
        return _world(self._world, layout, blocks if self._graph else blocks.clone(), now.clock.copy(), past, whole)

    def glance(self) -> EnvState:
        """Return the worlds as views until the next step, without graph and past: the same until then."""
        now = self.now
        if now.views[0] is not self.layout or now.views[1] is not now.whole:
            world = _world(self._world, self.layout, now.blocks.detach(), now.clock, None, now.whole)
            now.views = self.layout, now.whole, world
        return now.views[2]  # type: ignore[no-any-return]

    def detach(self) -> None:
        """Cut the graph behind the worlds."""
        self.now, self._token = Frame(self.now.blocks.detach(), self.now.clock, self.now.whole), None

    # -- steps ---------------------------------------------------------------------------------------------------

    def step(
        self, action: Array | Tensor | None, live: Array | None, normals: Mapping[str, Array] | None, at: int,
        params: Params, looks: bool = True,
    ) -> dict[str, Any]:  # fmt: skip
        """Advance all rows; ``normals`` are blocks (steps, rows · vehicles) by effect, ``at`` the step in them.

        Unless anybody ``looks``, observations and most infos are told only of rows whose episodes end. ``live`` says
        whose actions count (all, where it is None). Arrays are told; tensors where there may be a graph.
        """
        plan, past = self.plan((action is None, live is None), tuple(normals or ())), self.past
        bound, now, stays = plan.of(self.layout, params), self.now, not self._graph
        if past.slots:
            past.room()
        act, who = plan.placed(action, live) if stays else (_in_rows(action), live)
        later = self._spare if stays else Frame(torch.empty_like(now.blocks), np.empty_like(now.clock))
        lanes = bound, now.whole, None, later.whole, int(not looks)
        moment, token = Moment(now.clock, act, who, normals, at, past.numbers, past.newest, *lanes), None
        if not stays and torch.is_grad_enabled() and self._differentiated(action, bound):
            outputs, token = self._noted(plan, moment, later, action)
        else:
            outputs = plan.run(moment, now, later, stays)
            if not stays:
                outputs = {n: torch.from_numpy(x.copy()) for n, x in outputs.items()}
        whole = None if moment.crossing is None else moment.crossing.later[0]
        if stays and whole is now.whole:
            now.whole = later.whole
        later.whole = whole
        self.now, self._spare, self._token = later, now if stays else self._spare, token
        if past.slots:
            past.newest -= 1
        return outputs

    def hold(
        self, action: Array | Tensor | None, live: Array | None, normals: Mapping[str, Array] | None, at: int,
        params: Params, steps: int, most: int,
    ) -> tuple[dict[str, Array], int]:  # fmt: skip
        """Advance all rows under one action by ``steps`` at once, or until somebody's episode is over; no graph.

        As ``step``, at ``most`` so many, and somebody looks after the last; returns what is told after each of them
        ``[steps, rows, …]``, until the next call, and how many were done: at least one.
        """
        plan, past = self.plan((action is None, live is None), tuple(normals or ())), self.past
        bound, (act, who), looks = plan.of(self.layout, params), plan.placed(action, live), steps - 1
        steps = min(steps, most, past.room()) if past.slots else min(steps, most)
        (worlds, clocks, outputs, _), done, whole = bound.together, 0, list[Array | None]()
        now, later = self.now, self._spare
        while done < steps:
            count = min(steps - done, 1 + plan.until(now.clock + 1))
            # Any of them may be the last one that counts.
            own = None if now.whole is None else self._wholes.setdefault(done, np.empty_like(now.whole))
            lanes = bound, now.whole, None, own, looks - done
            moment = Moment(now.clock, act, who, normals, at + done, past.numbers, past.newest - done, *lanes)
            plan.run_together(moment, now, done, count)
            whole += [None] * count if moment.crossing is None else moment.crossing.later
            done += count
            now = Frame(worlds[done - 1], clocks[done - 1], whole[-1])
        over = (outputs["whole_terminated"] | outputs["whole_truncated"])[:steps].any(1)
        done = int(over.argmax()) + 1 if over.any() else steps
        plan.refuse_nan(worlds[:done])
        later.take(Frame(worlds[done - 1], clocks[done - 1], whole[done - 1]))
        self.now, self._spare, self._token = later, self.now, None
        past.newest -= done if past.slots else 0
        return outputs, done

    def arrive(self, blocks: Tensor, clock: Array, token: Tensor | None = None, whole: Array | None = None) -> None:
        """Go on from other worlds of the same episodes; whole numbers stay, where there are no others."""
        self.now, self._token = Frame(blocks, clock, self.now.whole if whole is None else whole), token

    def token_of(self, plan: CompiledTransition) -> Tensor | None:
        """Return the token that stands for the past, if there is one."""
        if self._token is None and self.past.slots:
            return self.now.blocks.new_zeros(1).expand(plan.past_shape)
        return self._token

    def mark(self) -> tuple[Any, ...]:
        """Return what ``back_to`` goes back to."""
        return self.now, self._token, self.layout, self.past, self.past.numbers, self.past.newest

    def back_to(self, mark: tuple[Any, ...]) -> None:
        """Go back to the worlds as they were: steps have written nothing that these read."""
        self.now, self._token, self.layout, self.past, self.past.numbers, self.past.newest = mark

    def plan(self, kind: tuple[bool, bool], draws: tuple[str, ...], steps: int = 1) -> CompiledTransition:
        """Return the transition of a kind, made once; ``steps`` is how many of them are to be done.

        It is made anew where functions of one's own read something else now (``kernels.reads``). Unordered, nothing
        changed, where that has not stayed for as many steps as are worth it.
        """
        if self._reads is None or self._reads.changed():
            self._steady = _WORTHWHILE if self._reads is None else 0
            self._plans, task = {}, self._moves.task
            functions = *(x.feature.read for x in task.observed), *(term.of for term, _ in task.weighted.terms)
            self._reads = Reads(functions, (task, task.road, *task.simulator.effects))
        plan = self._plans.get(kind)
        if plan is None:
            self._steady += steps
            if self._steady < _WORTHWHILE:
                raise Unordered("a function of one's own reads something else now")
            world = self.glance()
            make = CompiledTransition if world.state.lanes is None else LaneTransition
            plan = make(self._moves, world, self.layout, kind, draws)
            plan.reads, plan.graph = self._reads, self._graph
            self._plans[kind] = plan
        return plan

    def _differentiated(self, action: Any, bound: Tables) -> bool:
        sources = [self.now.blocks, action] if isinstance(action, Tensor) else [self.now.blocks]
        return self._token is not None or bool(bound.wanted) or any(x.requires_grad for x in sources)

    def _noted(
        self, plan: CompiledTransition, moment: Moment, later: Frame, action: Any
    ) -> tuple[dict[str, Any], Tensor | None]:
        """Do a step as a node of autograd; return what is told, and the token that stands for the past then."""
        outputs: dict[str, Any] = {}
        parameters = [x for _, x in moment.bound.wanted]
        out = _Step.apply(plan, moment, later, outputs, self.now.blocks, action, self.token_of(plan), *parameters)
        later.blocks = out[0]
        outputs.update(zip(moment.bound.recorded.flowing, out[2:], strict=True))
        return outputs, out[1] if self.past.slots else None


class _Step(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, plan: CompiledTransition, moment: Moment, later: Frame, told: dict[str, Any], blocks: Tensor,
        action: Tensor | None, token: Tensor | None, *wanted: Tensor,
    ) -> tuple[Tensor | None, ...]:  # fmt: skip
        arrays = plan.run(moment, Frame(blocks, moment.clock), later, stays=False)
        told.update({n: torch.from_numpy(x.copy()) for n, x in arrays.items()})
        ctx.plan, ctx.moment = plan, moment
        ctx.save_for_backward(blocks, later.blocks, action, token, *wanted)
        ctx.set_materialize_grads(False)
        past = None if token is None else token_like(token)
        return (later.blocks, past, *(told[n] for n in moment.bound.recorded.flowing))

    @staticmethod
    def backward(ctx: Any, on_later: Tensor | None, on_past: Tensor | None, *on_told: Tensor | None) -> Any:  # type: ignore[override]
        plan, moment = ctx.plan, ctx.moment
        blocks, _, action, token, *parameters = ctx.saved_tensors
        if torch.is_grad_enabled():
            return (None,) * 4 + _twice(ctx, blocks, action, token, parameters, (on_later, on_past, *on_told))
        names = moment.bound.recorded.flowing
        seeds = {n: None if x is None else x.contiguous() for n, x in zip(names, on_told, strict=True)}
        later = None if on_later is None else on_later.contiguous()
        past = None if on_past is None else on_past.contiguous().numpy()
        on_now, on_action, on_parameters, before = plan.back(moment, seeds, later, past)
        shape = blocks.shape
        slopes = [torch.from_numpy(on_now).view(shape), None if on_action is None else torch.from_numpy(on_action)]
        slopes.append(None if token is None else torch.from_numpy(before))
        for i, x in moment.bound.wanted:
            slopes.append(torch.from_numpy(on_parameters[i]).view(shape[1:]).sum_to_size(x.shape).to(x.dtype))
        return (None,) * 4 + tuple(slopes)


def _twice(
    ctx: Any, blocks: Tensor, action: Tensor | None, token: Tensor | None, parameters: Sequence[Tensor],
    seeds: Sequence[Tensor | None],
) -> tuple[Tensor | None, ...]:  # fmt: skip
    """Return gradients with a graph of their own, for second derivatives: the step is done again by torch."""
    plan, moment, shape = ctx.plan, ctx.moment, tuple(blocks.shape[1:])
    layout, recorded = moment.bound.layout, moment.bound.recorded
    past = None
    if plan.past_shape:
        recent = moment.past[:, moment.newest : moment.newest + plan.past_shape[1]]
        past = torch.from_numpy(recent.copy()).movedim(-1, 1)
        past = past if token is None else _Leave.apply(token, past)
    world = _world(plan.world, layout, blocks, moment.clock, past, moment.whole)
    live = None if moment.live is None else torch.from_numpy(moment.live).view(shape[0], -1)
    normals = {n: torch.from_numpy(x).view(-1, *shape)[moment.at] for n, x in (moment.normals or {}).items()} or None
    after, outcome = plan.moves.step(world, action, live, normals, moment.bound.with_values(parameters))
    last = after.state.memory.get(PAST)
    outputs = [_block(after, layout.blocks), None if last is None else last.movedim(1, -1)]
    outputs += [outcome[n] for n in recorded.flowing]
    return gradients(outputs, seeds, (blocks, action, token, *parameters))


def _world(
    like: EnvState, layout: Layout, blocks: Tensor, clock: Array, past: Tensor | None, whole: Array | None = None
) -> EnvState:
    """Return worlds as tensors that share the memory given, and that of the layout."""
    shapes, leaves = named(like), dict(zip(layout.blocks, blocks, strict=True))
    leaves |= {n: torch.from_numpy(x).view(shapes[n].shape) for n, x in layout.still.items()}
    leaves["state_step"] = torch.from_numpy(clock).view(like.state.step.shape)
    if whole is not None:
        leaves |= dict(zip(WHOLE, torch.from_numpy(whole).view(-1, *like.state.speed.shape), strict=False))
    state, episode = world_of(leaves, like)
    return EnvState(state if past is None else state._replace(memory={**state.memory, PAST: past}), episode)


def _in_rows(action: Array | Tensor | None) -> Array | None:
    """Return an action as an array that loops read row after row."""
    return None if action is None else torch.as_tensor(action).detach().contiguous().numpy()


def _block(world: EnvState, names: Sequence[str]) -> Tensor:
    """Return what steps change of worlds as one tensor, with its graph."""
    state, leaves = world.state, named(world)
    return torch.stack([leaves[n].to(state.speed.dtype).expand(state.speed.shape) for n in names])


def token_like(token: Tensor) -> Tensor:
    """Return a token of the same shape: nobody reads it, so it has one number."""
    return token.new_zeros(1).expand(token.shape)


class _Enter(torch.autograd.Function):
    """From a past to the token that stands for it, ``(rows, slots, signals, n)``: its gradient is that of the past."""

    @staticmethod
    def forward(ctx: Any, past: Tensor, shape: tuple[int, ...]) -> Tensor:
        ctx.shape = past.shape
        return past.new_zeros(1).expand(shape[0], *past.shape[-2:], shape[1])

    @staticmethod
    def backward(ctx: Any, on_token: Tensor) -> Any:  # type: ignore[override]
        return on_token.movedim(-1, 1).sum_to_size(ctx.shape), None


class _Leave(torch.autograd.Function):
    """From a token to the past that it stands for."""

    @staticmethod
    def forward(ctx: Any, token: Tensor, past: Tensor) -> Tensor:
        return past.clone()

    @staticmethod
    def backward(ctx: Any, on_past: Tensor) -> Any:  # type: ignore[override]
        return on_past.movedim(1, -1), None


class _Forget(torch.autograd.Function):
    """A token after some rows began anew: nothing flows back into what they were."""

    @staticmethod
    def forward(ctx: Any, token: Tensor, rows: Tensor) -> Tensor:
        ctx.rows = rows
        return token_like(token)

    @staticmethod
    def backward(ctx: Any, on_token: Tensor) -> Any:  # type: ignore[override]
        return on_token.index_fill(0, ctx.rows, 0.0), None


_DYNAMIC = {f"state_{name}" for name in ("position", "speed", "accel", "gap", "present")}
