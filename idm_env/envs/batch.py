"""A batch of environments of one task, in torch: what every face wraps, and the only place where gradients are cut.

Gradients are cut in three ways, all here: an episode begins from constants (the warm-up builds no graph), a reset
replaces the rows that ended, so that nothing flows back into another episode, and ``detach`` cuts the whole batch for
truncated back-propagation.

Shapes: rows are environments: states ``[rows, n]``, actions ``[rows, agents, …]``; indices of rows are ``[k]``.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar, cast

import numpy as np
import torch
from torch import Tensor

from idm_env.compiled.kernels import dispatch
from idm_env.compiled.scalar.record import Unordered, Untraceable
from idm_env.envs.beginnings import Beginnings
from idm_env.envs.cuda_graph import Replayed
from idm_env.envs.given import checked
from idm_env.envs.moves import Moves
from idm_env.envs.recording import Recorder
from idm_env.envs.settings import INFO, Settings
from idm_env.jobs.storage import lacks_memory
from idm_env.tasks import Draw, EnvState
from idm_env.types import Params, State, mapped, worthwhile
from idm_env.validation import whole

if TYPE_CHECKING:
    from idm_env.envs.values import Values

Act = TypeVar("Act", bound=Callable[..., Any])
_LARGEST_POOL = 100_000
_POOL_STREAM = 2
_NORMALS_AT_ONCE = 1 << 14
_WINDOW = 1 << 20
"""Most normals that are drawn ahead of steps one by one, and of a window."""


class Whole(NamedTuple):
    """Of whole environments, ``(n,)``: mean reward, terminated with the first agent, truncated with the last.

    Tensors, or arrays with numpy output.
    """

    reward: Any
    terminated: Any
    truncated: Any


class Outcome(NamedTuple):
    """What a step gives: observations ``(n, agents, features)``, the others ``(n, agents)``, by name in ``details``.

    Tensors, or arrays with numpy output, which hold until the next step.
    """

    observation: Any
    reward: Any
    terminated: Any
    truncated: Any
    whole: Whole
    details: Mapping[str, Any]

    @classmethod
    def of(cls, told: Mapping[str, Any]) -> Outcome:
        """Return what ``Batch.told`` tells, sorted."""
        rest = {name: told[key] for name, key in _details_in(tuple(told))}
        whole = Whole(told["whole_reward"], told["whole_terminated"], told["whole_truncated"])
        return cls(told["observation"], told["reward"], told["terminated"], told["truncated"], whole, rest)


def _some(mask: Any) -> bool:
    """Return whether any is true, of an array or a tensor (``types.worthwhile``)."""
    return worthwhile(mask) if isinstance(mask, Tensor) else bool(mask.any())


def _held(before: Outcome, after: Outcome, over: Any) -> Outcome:
    """Return what two steps under one action give: sums of rewards, the rest of the second; where over of the first."""

    def kept(x: Any, y: Any) -> Any:
        mask = over.reshape(-1, *(1,) * (x.ndim - 1))
        return torch.where(mask, x, y) if isinstance(x, Tensor) else np.where(mask, x, y)

    both = before.whole.reward + after.whole.reward
    total = after._replace(reward=before.reward + after.reward, whole=after.whole._replace(reward=both))
    if "rewards" in after.details:
        parts = before.details["rewards"] + after.details["rewards"]
        total = total._replace(details={**after.details, "rewards": parts})
    if not _some(over):
        return total
    details = {name: kept(x, total.details[name]) for name, x in before.details.items()}
    seen, reward, ended, cut = map(kept, before[:4], total[:4])
    return Outcome(seen, reward, ended, cut, Whole(*map(kept, before.whole, total.whole)), details)


def _summed(rows: Mapping[str, np.ndarray], steps: int) -> dict[str, np.ndarray]:
    """Return outputs of steps under one action, from those of each of them ``[steps, rows, …]``, as ``_held``."""
    paid = {n: rows[n][:steps] for n in ("reward", "whole_reward", "info_rewards") if n in rows}
    # One after the other: a sum goes in pairs.
    sums = {n: np.add.accumulate(x, dtype=x.dtype)[-1] for n, x in paid.items()}
    return {n: x[steps - 1] for n, x in rows.items()} | sums


@functools.lru_cache(32)
def _details_in(names: tuple[str, ...]) -> tuple[tuple[str, str], ...]:
    """Return the names of infos that are among those of outputs, each with the output's."""
    return tuple((name, f"info_{name}") for name in INFO if f"info_{name}" in names)


def in_memory(act: Act) -> Act:
    """Return a method whose lack of memory is a MemoryError of one line, with the sizes of the batch and the cure."""

    @functools.wraps(act)
    def call(batch: Batch, *arguments: Any, **options: Any) -> Any:
        try:
            return act(batch, *arguments, **options)
        except (MemoryError, RuntimeError) as error:
            if not lacks_memory(error):
                raise
            cure = "Take fewer of either, or fewer steps between two calls of detach()."
            sizes = f"num_envs = {batch.count} of {batch.task.vehicles} vehicles"
            raise MemoryError(f"{sizes} need more memory than {batch.settings.device} has. {cure}") from None

    return cast(Act, call)


@dataclass
class Present:
    """The present of a batch: all that its steps change, and ``back_to`` restores."""

    world: EnvState | None = None
    """The worlds, or None where ``Batch.values`` has them, that is where they are ``loaded``."""
    loaded: bool = False
    seen: Any = None
    on_road: Any = None
    """What is observed, and which agents are on the road, as the last step told it."""
    outputs: Mapping[str, Any] | None = None
    outcome: Any = None
    """All that it told, and the same sorted: compiled loops fill the same arrays again and again."""
    draw: Draw | None = None
    driven: Params | None = None
    """Random numbers and parameters of these episodes."""
    pool: EnvState | None = None
    block: dict[str, Tensor] | None = None
    drawn: dict[str, np.ndarray] = field(default_factory=dict)
    drawn_steps: int = 0
    used: int = 0
    """Normals of ``drawn_steps`` steps, as tensors and as arrays, of which so many are ``used``."""


class Batch:
    """``count`` environments that step together; row i draws what a single environment with its seed draws."""

    def __init__(self, settings: Settings, count: int) -> None:
        self.settings = settings
        self.task = settings.task
        self.count = count
        self.params: Params = self.task.params(settings.dtype, settings.device)
        self.limit = settings.limit
        self.seeds = np.zeros(count, dtype=np.int64)
        self.episodes = np.full(count, -1, dtype=np.int64)
        self.now = Present()
        self._moves = Moves(settings)
        self._on_gpu = settings.device.type == "cuda"
        self.values: Values | None = self._compiled()
        """The worlds as compiled loops step them, None where torch does."""
        self._step = Replayed(self._stepped) if self._on_gpu else self._stepped
        self._reasons: dict[int, str] = {}
        self.counters = self.task.counters(count, settings.device, settings.info)
        self.recording: Recorder | None = None
        self._beginnings = Beginnings(self._begin, count)
        self._beginner = settings.task
        self._ahead = max(1, (_WINDOW if self._on_gpu else _NORMALS_AT_ONCE) // (count * self.task.vehicles))

    def _compiled(self) -> Values | None:
        """Return what steps in compiled loops, where that can be."""
        settings = self.settings
        if settings.device.type != "cpu" or dispatch.surroundings() is not None:
            return None
        from idm_env.envs.values import Values

        return Values(self._moves, graph=settings.output == "torch")

    @property
    def begun(self) -> bool:
        """Whether there was a reset."""
        return self.now.loaded or self.now.world is not None

    @property
    def world(self) -> EnvState | None:
        """The worlds as they are now, or None before the first reset."""
        if self.now.world is None and self.now.loaded and self.values is not None:
            self.now.world = self.values.current()
        return self.now.world

    @world.setter
    def world(self, world: EnvState | None) -> None:
        self.now.world, self.now.loaded, self.now.on_road = world, False, None

    def glance(self) -> EnvState:
        """Return the worlds as they are now, for reading only and until the next step."""
        if self.now.world is None and self.now.loaded and self.values is not None:
            return self.values.glance()
        assert self.now.world is not None
        return self.now.world

    # -- beginnings ----------------------------------------------------------------------------------------------

    def seed(self, rows: Sequence[int] | np.ndarray, seeds: Sequence[int]) -> None:
        """Give rows new seeds; their next episode is the first of that seed."""
        # Seeds beyond 63 bits are folded: Gymnasium allows any whole number.
        self.seeds[rows] = [whole("seed", s, 0) & ((1 << 63) - 1) for s in seeds]
        self.episodes[rows] = -1
        self._beginnings.forget()

    @in_memory
    def reset(self, rows: np.ndarray | None = None, state: State | None = None) -> Tensor | np.ndarray:
        """Begin a new episode in all or in some rows (indices); return the observations of all of them.

        ``state`` replaces what would be drawn, with its graph. Everything else begins from constants. ValueError, with
        nothing begun, for a state that does not fit (``idm_env.envs.given``).
        """
        every = rows is None or len(rows) == self.count
        index = np.arange(self.count) if rows is None else rows
        draw = self._draws(index, self.episodes[index] + 1)
        if state is not None:
            state = self._given(state, draw)
        self.episodes[index] += 1
        fresh, self.now.driven = self._beginnings.take(index, self.episodes), None
        if state is not None:
            fresh = fresh._replace(state=state)
        seen = self._took(index, fresh, draw, every)
        for book in (self.counters, self.recording):
            if book is not None:
                book.begin(index, self.glance().state)
        return seen

    def _took(self, index: np.ndarray, fresh: EnvState, draw: Draw, every: bool) -> Tensor | np.ndarray:
        """Put new worlds into some rows, or all; return the observations of all of them."""
        if every or not self.begun or self.now.draw is None:
            self.world, self.now.draw = fresh, draw
        elif self.values is not None and self.now.loaded and self.now.seen is not None:
            self.values.replace(index, fresh)
            self.now.draw = Draw(self.now.draw.key.index_put((torch.as_tensor(index),), draw.key))
            self.now.world = self.now.block = self.now.on_road = None
            # Only these rows look anew.
            seen = self.task.observe(fresh)
            if isinstance(self.now.seen, Tensor):
                self.now.seen = self.now.seen.index_copy(0, torch.as_tensor(index), seen)
                return self.now.seen.clone()
            self.now.seen[index] = seen.detach().numpy()
            return self.now.seen  # type: ignore[no-any-return]
        else:
            where = torch.as_tensor(index, device=self.settings.device)
            self.world = mapped(lambda old, new: old.index_put((where,), new), self.world, fresh)
            self.now.draw = Draw(self.now.draw.key.index_put((where,), draw.key))
        self.now.block = None
        assert self.world is not None
        return self.task.observe(self.world).clone()

    def _draws(self, rows: np.ndarray, episodes: np.ndarray) -> Draw:
        return Draw.of(*(torch.as_tensor(x, device=self.settings.device) for x in (self.seeds[rows], episodes)))

    def choose(self, choices: Mapping[str, Any]) -> None:
        """Begin episodes from now on with these of ``task.begins_with``; ValueError, nothing changed, for bad ones."""
        if choices:
            task = self._beginner
            others = {name: x for name, x in (task.randomise or {}).items() if name not in choices}
            self._beginner = replace(task, randomise=others or None, **choices)
            self.now.pool = None
            self._beginnings.forget()

    @torch.no_grad()
    def _begin(self, rows: np.ndarray, episodes: np.ndarray) -> EnvState:
        draw = self._draws(rows, episodes)
        if not self.task.warmup_pool:
            return self._beginner.reset(draw, self.params)
        if self.now.pool is None:
            seeds = torch.arange(self.task.warmup_pool, device=self.settings.device)
            seeds = seeds + _LARGEST_POOL * self.task.warmup_pool_seed
            self.now.pool = self._beginner.reset(Draw.of(seeds, torch.full_like(seeds, -1)), self.params)
        picked = (draw.uniforms(_POOL_STREAM, 1, torch.float64).squeeze(-1) * self.task.warmup_pool).long()
        return mapped(lambda pooled: pooled[picked], self.now.pool)

    @torch.no_grad()
    def _like(self, draw: Draw) -> State:
        """Return the state with which the task would begin, before any warm-up."""
        return self.task.begin(draw, self.task.episode_params(self.task.who(draw), self.params)).state

    def _given(self, state: Any, draw: Draw) -> State:
        return checked(state, self._like(draw), self.task.road)

    def set_params(self, params: Params) -> None:
        """Replace the parameters (tensors, which may require grad); they hold from the next step on."""
        self.task.simulator.check(params)
        self.params, self.now.driven = params, None
        self.now.pool = None
        self._beginnings.forget()

    # -- steps ---------------------------------------------------------------------------------------------------

    def _normals(self, clock: Callable[[], Tensor]) -> dict[str, Tensor] | None:
        """Return the normals of a block of steps, drawn ahead where the batch is small; ``_used − 1`` is this step."""
        if not self.task.simulator.draws:
            return None
        self._fill(clock, self._ahead)
        self.now.used += 1
        return self.now.block

    def _fill(self, clock: Callable[[], Tensor], steps: int) -> None:
        """See that normals of at least one step are drawn that were not used."""
        if self.now.block is None or self.now.used >= self.now.drawn_steps:
            assert self.now.draw is not None
            self.now.block = self.task.normals(self.now.draw, clock(), steps, self.settings.dtype)
            self.now.used, self.now.drawn_steps = 0, steps
            if self.values is not None:
                self.now.drawn = {name: x.numpy().reshape(-1) for name, x in self.now.block.items()}

    def _clock(self) -> Tensor:
        """Return the steps of all rows, where compiled loops have them."""
        assert self.values is not None
        return torch.from_numpy(self.values.now.clock)

    def ahead(self) -> tuple[int, dict[str, np.ndarray] | None]:
        """Return for how many steps normals are there, and these; ``used`` counts those that are gone."""
        if not self.task.simulator.draws:
            return 64, None
        self._fill(self._clock, max(self._ahead, min(64, _WINDOW // (self.count * self.task.vehicles)) or 1))
        return self.now.drawn_steps - self.now.used, self.now.drawn

    def episode_params(self) -> Params:
        """Return the parameters of steps in these episodes."""
        if self.now.driven is None:
            self.now.driven = self.task.episode_params(self.glance().episode, self.params)
        return self.now.driven

    def seen(self) -> Tensor:
        """Return what is observed now, shape ``(n, agents · features)``, with its graph."""
        if self.now.loaded and isinstance(self.now.seen, Tensor):
            return self.now.seen.reshape(self.count, -1)
        assert self.world is not None
        return self.task.observe(self.world).reshape(self.count, -1)

    def saw(self, seen: Tensor) -> None:
        """Note what is observed now, after steps that were done elsewhere."""
        self.now.world, self.now.loaded, self.now.seen = None, True, seen.view(self.count, len(self.task.agents), -1)
        self.now.on_road = None

    def on_road(self) -> Tensor:
        """Return which agents' vehicles are on the road ``(n, agents)``."""
        if self.now.on_road is not None:
            return torch.as_tensor(self.now.on_road)
        every = torch.ones(self.count, len(self.task.agents), dtype=torch.bool, device=self.settings.device)
        return self.task.there(self.glance().state, every)

    def settle(self) -> None:
        """See that the present worlds lie where compiled loops step them."""
        if self.now.world is not None and not self.now.loaded and self.values is not None:
            self.values.load(self.now.world)
            self.saw(self.task.observe(self.now.world))

    def mark(self) -> tuple[Any, ...]:
        """Return what ``back_to`` goes back to."""
        assert self.values is not None
        return replace(self.now), self.episodes.copy(), self.values.mark()

    def back_to(self, mark: tuple[Any, ...]) -> None:
        """Undo steps, and resets within them."""
        assert self.values is not None
        self.now, self.episodes = replace(mark[0]), mark[1].copy()
        self.values.back_to(mark[2])
        self._beginnings.forget()

    @in_memory
    def step(self, action: Tensor | np.ndarray | None, live: Tensor | None = None) -> Outcome:
        """Advance every row; ``action`` has shape ``(n, agents)``, None leaves everybody to the drivers.

        It is a tensor, or an array of the simulation's precision with numpy output.

        ``live`` (bool, ``(n, agents)``) leaves only single agents' vehicles to their drivers, and drops their commands.

        An action is held for ``task.held`` steps of Δt; rewards are summed. A row that ends before them tells of its
        end; until it is reset it drives on unseen. Whoever enters meanwhile is commanded from the next action on.
        """
        self._reasons = {}
        if self.task.journeys > 0 and action is not None:
            on_road = self.on_road()
            live = on_road if live is None else live & on_road
        held = self.task.held
        outcome, done = self._once(action, live, held == 1, held)
        for left in reversed(range(held - done)):
            over = outcome.whole.terminated | outcome.whole.truncated
            if not _some(~over):
                break
            before = outcome if self.settings.output == "torch" else copy.deepcopy(outcome)
            outcome = _held(before, self._once(action, live, not left or _some(over))[0], over)
        if self.counters is None or "stops" not in self.settings.info:
            return outcome
        self.counters.decided(self.glance().state)
        stops: Any = torch.as_tensor(self.counters.stops[:, None][:, [0] * len(self.task.agents)])
        stops = stops if self.settings.output == "torch" else stops.cpu().numpy()
        return outcome._replace(details={**outcome.details, "stops": stops})

    def crash_reason(self, row: int, agent: int | None = None) -> str:
        """Return how a row has crashed in this step, or one of its agents."""
        return self._reasons.get(row) or self.task.crash_reason(self.glance(), row, agent)

    def _once(self, action: Any, live: Tensor | None, observed: bool, steps: int = 1) -> tuple[Outcome, int]:
        """Advance every row by Δt, or by some of ``steps`` at once, and say how many.

        Observations need not be read where nobody decides next. Several are done at most until somebody has ended.
        """
        watched = self.recording is not None or (self.counters is not None and bool(self.counters.loops))
        stepped = None
        if self.values is not None and not self.task.simulator.untried:
            stepped = self._step_values(
                action, live, observed, 1 if watched or self.settings.output == "torch" else steps
            )
        if stepped is None:
            with torch.no_grad() if self.settings.output == "numpy" else contextlib.nullcontext():
                stepped = self._step_torch(action, live, observed), 1
        outputs, done = stepped
        outcome = self.now.outcome if outputs is self.now.outputs else Outcome.of(outputs)
        if self.settings.output == "numpy":
            self.now.outputs, self.now.outcome = outputs, outcome
        if self.counters is not None and self.counters.loops:
            self.counters.after(self.glance().state)
        if self.recording is not None:
            self.recording.after(outcome.whole, self.glance().state)
        reasons = self.task.held > 1 and self.count > 1 and "crash" in outcome.details
        if reasons and self.settings.device.type == "cpu":  # elsewhere it is told from the worlds where the action ends
            for row in np.flatnonzero(np.asarray(outcome.terminated.any(-1))).tolist():
                self._reasons[row] = self.crash_reason(row)
        return outcome, done

    def _step_torch(self, action: Tensor | np.ndarray | None, live: Tensor | None, observed: bool) -> dict[str, Any]:
        if isinstance(action, np.ndarray):
            action = torch.as_tensor(action, device=self.settings.device)
        before = self.world
        assert before is not None
        block = self._normals(lambda: before.state.step)
        normals = None if block is None else {name: x[self.now.used - 1] for name, x in block.items()}
        step = self._stepped if self.task.simulator.untried else self._step
        driven = self.task.episode_params(before.episode, self.params)
        self.world, outputs = step(before, action, live, normals, driven, observed)
        return {n: x.cpu().numpy() for n, x in outputs.items()} if self.settings.output == "numpy" else outputs

    def _stepped(self, *arguments: Any) -> tuple[EnvState, dict[str, Tensor]]:
        """Return worlds Δt later and what is told of them (``Moves.step``)."""
        world, outputs = self._moves.step(*arguments)
        # What a task tells may be a part of its state: whoever is told gets numbers of his own.
        return world, {name: x.clone() for name, x in outputs.items()}

    def _step_values(
        self, action: Any, live: Tensor | None, observed: bool, steps: int
    ) -> tuple[dict[str, Any], int] | None:
        """Return the outputs of steps by compiled loops, and their number; None, with nothing changed, without loops.

        Of several rewards are summed, and the rest is that of the last one.
        """
        values, world = self.values, self.now.world
        assert values is not None
        if self.settings.output == "torch" and dispatch.surroundings() is not None:
            self.now.world, self.now.loaded = self.world, False
            return None
        used, block = self.now.used, self.now.block
        try:
            if world is not None and not self.now.loaded:
                values.load(world)
            who = None if live is None else live.numpy().reshape(-1)
            if steps > 1:
                left, noise = self.ahead()
                rows = values.hold(action, who, noise, self.now.used, self.episode_params(), steps, left)
                outputs, steps = _summed(*rows), rows[1]
                self.now.used += steps
            else:
                noise = None if self._normals(self._clock) is None else self.now.drawn
                outputs = values.step(action, who, noise, max(self.now.used - 1, 0), self.episode_params(), observed)
        except Untraceable as why:
            self.now.world, self.now.loaded = self.world, False
            self.now.used, self.now.block = used, block
            if not isinstance(why, Unordered):
                # Where an effect is why it was said before (``kernels.printed``); NaN the step itself tells.
                if self.settings.output == "torch" or self.task.road.outline is not None:
                    warnings.warn(f"no compiled step, the torch path runs instead: {why}.", stacklevel=4)
                self.values = None
            return None
        # What is told as a tensor is written to by whom it pleases.
        seen, self.now.on_road = outputs["observation"], outputs.get("on_road")
        self.now.world, self.now.loaded, self.now.seen = None, True, seen.clone() if isinstance(seen, Tensor) else seen
        return outputs, steps

    def detach(self) -> None:
        """Cut the graph behind the present state, for truncated back-propagation."""
        if isinstance(self.now.seen, Tensor):
            self.now.seen = self.now.seen.detach()
        if self.now.world is None and self.now.loaded and self.values is not None:
            self.values.detach()
            return
        if self.world is not None:
            self.world = mapped(lambda x: x.detach(), self.world)

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the graph: a copy, or what is pickled, goes on from the present worlds."""
        world = self.world
        cut = None if world is None else mapped(lambda x: x.detach(), world)
        return {
            **self.__dict__,
            "now": replace(self.now, world=cut, loaded=False, seen=None, driven=None, outputs=None),
            "values": None,
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take over everything, with loops of its own."""
        self.__dict__.update(state)
        self.values = self._compiled()
