"""Rollouts that judge: the worlds in which evaluations begin, a policy driven through them, and what is recorded."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import torch
from torch import Tensor

from agents.environments import task_of
from agents.policy import Driving, Policy
from idm_env.effects.idm import equilibrium_gap
from idm_env.envs.batch import Batch
from idm_env.envs.settings import settings
from idm_env.simulator import stacked
from idm_env.tasks import Draw, EnvState, Task
from idm_env.types import Params, mapped

LENGTHS = (220.0, 230.0, 240.0, 250.0, 260.0, 270.0)
UNSEEN = tuple(float(x) for x in range(200, 301, 10))
WARMUP = 3000
"""Steps of human driving before the take-over: the wave has grown by then. A vehicle that keeps its speed, with no
command at all, dissolves the young wave that is there after 750 steps."""
SEED = 1 << 40
"""Of evaluations; training uses smaller seeds."""
FRESH = range(1, 6)
"""Draws of noise and starts on which agents are reported; draw 0 is the one that chooses checkpoints and trials."""

Act = Callable[[Tensor], Tensor]
"""Observations ``(n, agents · features)`` to actions ``(n, agents)``."""


class Driven(NamedTuple):
    """What an evaluation keeps of every step, ``(steps, n, vehicles)``, and the actions ``(steps, n, agents)``."""

    speed: Tensor
    accel: Tensor
    gap: Tensor
    action: Tensor
    reward: Tensor


class Start(NamedTuple):
    """A task with the worlds in which its evaluation begins."""

    task: Task
    world: EnvState
    seeds: tuple[int, ...]
    params: Params

    @property
    def draw(self) -> Draw:
        """Where the noise of each row comes from: that of an environment of its seed, in its first episode."""
        return Draw.of(torch.tensor(self.seeds), torch.zeros(len(self.seeds), dtype=torch.int64))


def begun(act: Act | None) -> Act | None:
    """Return what acts at the beginning of a rollout: a policy with nothing remembered, others as they are."""
    return Driving(act) if isinstance(act, Policy) else act


def held_moments(start: Start, act: Act | None, steps: int) -> Iterator[tuple[EnvState, Tensor | None, EnvState]]:
    """Roll a policy out with its actions held; yield, of every Δt, the worlds of its decision and after it, and action.

    Without a failsafe, which looks at every Δt, and drivers' noise what lies between two decisions is one compiled
    rollout; of the worlds in between what ``Trajectory`` keeps is theirs, and the rest that of the end.
    """
    task, world, _, params = start
    act, draw = begun(act), start.draw
    with torch.no_grad():
        for done in range(0, steps, task.held):
            before = world
            assert world.state.present is not None
            action = None if act is None else act(task.observe(world).flatten(1))
            command = None if action is None else task.command(action)
            live = task.pick(world.state.present) > 0
            count = min(task.held, steps - done)
            if task.failsafe or task.simulator.draws:
                normals = task.normals(draw, world.state.step, count, world.state.speed.dtype)
                for t in range(count):
                    now = {name: x[t] for name, x in normals.items()}
                    limited = None if command is None else task.limit(world, command)
                    inputs = task.with_lane_commands(task.inputs(world, limited, now, live), action, live)
                    driven = task.episode_params(world.episode, params)
                    world = world._replace(state=task.simulator.advance(world.state, inputs, driven))
                    yield before, action, world
                continue
            inputs = task.with_lane_commands(task.inputs(world, command, None, live), action, live)
            repeated: dict[str, Any] = {name: _repeated(x, count) for name, x in inputs.items()}
            driven = task.episode_params(world.episode, params)
            state, trajectory = task.simulator.rollout(world.state, repeated, driven, count)
            for t in range(count):
                motion: dict[str, Any] = {name: x[t] for name, x in trajectory._asdict().items()}
                world = before._replace(state=state._replace(**motion, step=before.state.step + t + 1))
                yield before, action, world
            world = before._replace(state=state)


def _repeated(x: Any, count: int) -> Any:
    """Return an input of one step for so many steps."""
    return stacked([x] * count)


def drive(start: Start, act: Act | None, steps: int) -> Driven:
    """Roll a policy out from given worlds as environments do, compiled, and keep every step.

    Rows go on after an end, as if nothing had happened.
    """
    task, rows = start.task, len(start.world.state.speed)
    batch = Batch(settings(task=task, info="none"), rows)
    batch.seed(range(rows), start.seeds)
    batch.reset()
    batch.world, act = start.world, begun(act)
    seen = task.observe(start.world).flatten(1)
    none = torch.zeros(rows, len(task.agents))
    columns: list[tuple[Tensor, ...]] = []
    with torch.no_grad():
        for _ in range(steps):
            action = None if act is None else act(seen)
            outcome = batch.step(None if action is None else action.numpy())
            state = batch.glance().state
            # What is glanced at holds until the next step.
            moved = (state.speed.clone(), state.accel.clone(), state.gap.clone())
            columns.append((*moved, none if action is None else action, torch.tensor(outcome.reward)))
            seen = torch.tensor(outcome.observation).flatten(1)
    return Driven(*(torch.stack(column) for column in zip(*columns, strict=True)))


@lru_cache(maxsize=64)
def _ring_start(environment: str, lengths: tuple[float, ...], warmup: int, draws: tuple[int, ...]) -> Start:
    """Return one ring of every draw and length after its warm-up; the environment's keywords come as JSON."""
    chosen = {**json.loads(environment), "warmup_pool": 0, "start": "uniform", "warmup": warmup}
    task = task_of({**chosen, "length": [min(lengths), max(lengths)]})
    params = task.params(torch.float32, "cpu")
    seeds, worlds = [], []
    for i, length in enumerate(lengths):
        own = [SEED + 1000 * k + i for k in draws]
        draw = Draw.of(torch.tensor(own), torch.zeros(len(own), dtype=torch.int64))
        worlds.append(task_of({**chosen, "length": length}).reset(draw, params))
        seeds += own
    return Start(task, mapped(lambda *x: torch.cat(x), *worlds), tuple(seeds), params)


def ring_start(
    environment: Mapping[str, Any],
    lengths: Sequence[float] = LENGTHS,
    warmup: int = WARMUP,
    draws: Sequence[int] = (0,),
) -> Start:
    """Return one ring of every length and draw after its warm-up, the draws of a length together."""
    return _ring_start(json.dumps(dict(environment), sort_keys=True), tuple(lengths), warmup, tuple(draws))


def uniform_speed(start: Start) -> Tensor:
    """Return the speed (m/s) at which all vehicles of each ring, as human drivers, keep their gaps for ever.

    Solves ``Σ (s0 + v T)/√(1 − (v/v0)^4) = L − Σ l`` by bisection; drivers may differ.
    """
    p = start.task.episode_params(start.world.episode, start.params)["idm"]
    driver = start.task.simulator.base.driver(dict(p))
    free = start.world.state.gap.sum(-1)
    low, high = torch.zeros_like(free), torch.full_like(free, 0.95) * p["desired_speed"].min()
    for _ in range(60):
        v = (0.5 * (low + high)).unsqueeze(-1)
        gaps = equilibrium_gap(driver, v)
        fits = gaps.expand_as(start.world.state.gap).sum(-1) < free
        middle = v.squeeze(-1)
        low, high = torch.where(fits, middle, low), torch.where(fits, high, middle)
    return 0.5 * (low + high)


@lru_cache(maxsize=8)
def _episodes_start(environment: str, count: int, times: int, draws: tuple[int, ...]) -> Start:
    task = task_of(json.loads(environment))
    params = task.params(torch.float32, "cpu")
    seeds = tuple(SEED + 1000 * k + i for k in draws for i in range(count)) * times
    draw = Draw.of(torch.tensor(seeds), torch.zeros(len(seeds), dtype=torch.int64))
    return Start(task, task.reset(draw, params), seeds, params)


def episodes_start(environment: Mapping[str, Any], count: int, times: int = 1, draws: Sequence[int] = (0,)) -> Start:
    """Return ``count`` episodes of a task and draw as they begin, of seeds unused in training, ``times`` over."""
    return _episodes_start(json.dumps(dict(environment), sort_keys=True), count, times, tuple(draws))
