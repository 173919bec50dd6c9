"""Ready for a device: steps, rollouts and environments ask no tensor for its value, so on a GPU nothing waits.

torch's ``meta`` device is the instrument: its tensors have no values, and whoever asks for one gets an error.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Iterator
from itertools import islice
from typing import Any

import numpy as np
import pytest
import torch
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_leaves

from idm_env import Lane, Lanes, Ring, Simulator
from idm_env.effects import ALL, CarFollowing, Effect, make
from idm_env.envs.vector import DiffIDMVectorEnv
from idm_env.roads import Road
from idm_env.tasks import TASKS
from idm_env.types import constant, mapped
from tests.laws.members import inputs_for

META = torch.device("meta")
ROADS = {"lane": Lane(), "ring": Ring(), "lanes": Lanes(2, length=600.0), "round": Lanes(2, ring=500.0, duration=3.0)}
"""Straight lanes are entered and left, and changes on the round ones take time."""


class NothingBrought(TorchFunctionMode):
    """Refuse tensors that are made of Python's numbers, or come from the CPU: a GPU waits for each such copy."""

    def __torch_function__(self, function: Any, kinds: Any, arguments: Any = (), keywords: Any = None) -> Any:
        """Return what the function returns."""
        name, given = getattr(function, "__name__", ""), tree_leaves((arguments, keywords or {}))
        tensors = [x for x in given if isinstance(x, torch.Tensor)]
        assert name not in ("tensor", "as_tensor", "new_tensor", "from_numpy") or tensors[:1] == given[:1], given
        assert not (name == "__getitem__" and any(isinstance(x, list) for x in arguments[1:])), given
        assert all(x.device == META for x in tensors if x.dim()), f"{name} of tensors on the CPU"
        return function(*arguments, **(keywords or {}))


def there(tree: Any) -> Any:
    return mapped(lambda x: x.to(META), tree)


def together(road: Road) -> Iterator[Simulator]:
    """Yield simulators with up to nine effects each, which have every effect that this road allows among them."""
    left = list(ALL)
    while left:
        found, taken = None, list[Effect]()
        for name in list(left):
            try:
                more = Simulator(road, whole([*taken, make(name)], road))
            except ValueError:  # two laws at once, or an effect for other roads
                continue
            found, taken = more, [*taken, make(name)]
            left.remove(name)
            if len(taken) == 9:
                break
        if found is None:
            return
        yield found


def whole(effects: list[Effect], road: Road) -> tuple[Effect, ...]:
    """Return these effects with what a simulator needs beside them: a law, brakes, and who changes lanes."""
    law = [] if any(isinstance(e, CarFollowing) for e in effects) else [make("idm")]
    brakes = [] if any(e.name == "brakes" for e in effects) else [make("brakes")]
    several = road.outline is not None and not any(e.hook == "change" for e in effects)
    return (*law, *effects, *brakes, *([make("mobil")] if several else []))


@pytest.mark.parametrize("road", ROADS)
def test_no_effect_asks_a_tensor_for_its_value(road):
    """In a step with decisions, and in a rollout."""
    several, tried = ROADS[road].outline is not None, set[type[Effect]]()
    position = -torch.arange(6.0).expand(2, 6) * 30.0 + 300.0
    more: dict[str, Any] = {"lane": torch.arange(6).expand(2, 6) % 2} if several else {}
    more |= {"circumference": 260.0} if road == "ring" else {}
    more |= {"present": torch.ones(2, 6)} if road == "lanes" else {}
    every = road != "round"  # of what is its own a few effects see all
    for simulator in islice(together(ROADS[road]), None if every else 1):
        params = simulator.defaults(dtype=torch.float32)
        state = simulator.state(position, torch.full((2, 6), 10.0), params, **more)
        inputs = inputs_for(simulator, 1, state.speed)
        arguments = there(state), there(inputs), there(params)
        simulator.rollout(*arguments, 1)  # what is made once for a device
        with NothingBrought():
            last, kept = simulator.rollout(*arguments, 1)
        assert last.speed.device == kept.gap.device == META, [e.name for e in simulator.effects]
        tried |= {type(e) for e in simulator.effects}
    assert not every or tried == {e for e in ALL.values() if several or e.hook != "change"}


@pytest.mark.parametrize("task", TASKS)
def test_no_task_asks_a_tensor_for_its_value(task):
    """Actions are held for two steps, and every observation, reward and end is told."""
    env = DiffIDMVectorEnv(2, task=task, output="torch", hold=0.2, **({"warmup": 1} if task == "ring" else {}))
    env.reset(seed=1)
    batch = env.batch
    batch.settings = batch._moves.settings = dataclasses.replace(batch.settings, device=META)
    batch.world, batch.params, batch.now.draw = there(batch.world), there(batch.params), there(batch.now.draw)
    batch.values = batch.now.driven = None
    if batch.counters is not None:
        batch.counters.stops = there(torch.as_tensor(batch.counters.stops))
        batch.counters.begin(np.arange(0), batch.world.state)
    action = torch.zeros(2, env.action_space.shape[-1], device=META)
    batch.step(action)
    with NothingBrought():
        outcome = batch.step(action)
    assert outcome.observation.device == outcome.reward.device == outcome.terminated.device == META


def test_a_constant_outlives_the_transform_in_which_it_was_made():
    """And a recording of torch.compile holds it without a word."""

    def total(x: torch.Tensor) -> torch.Tensor:
        return (constant((3.0, 4.0), torch.float32, torch.device("cpu")) * x).sum()

    assert torch.func.grad(total)(torch.tensor(2.0)) == 7.0
    constant((3.0, 4.0), torch.float32, torch.device("cpu")).untyped_storage()  # raises for one that ended with it
    with torch.inference_mode():
        assert total(torch.tensor(2.0)) == 14.0
    x = torch.tensor(2.0, requires_grad=True)
    total(x).backward()
    assert x.grad == 7.0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert torch.compile(total, fullgraph=True, backend="eager")(torch.tensor(2.0)) == 14.0
