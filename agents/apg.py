"""Analytic policy gradient: the return of a window, differentiated through the simulator, is all there is.

``∇_θ (1/W) Σ_t r_t``, r_t = r(s_t, a_t), a_t = π_θ(o_t), s_{t+1} = f(s_t, a_t): the gradient goes through the policy
and through the traffic. After W steps the graph is cut and the episodes go on (truncated back-propagation). W must be
long enough for an action's effect to come round to the vehicle: on a ring of 22 vehicles about a minute. The name is
that of Freeman et al. 2021 (Brax, arXiv 2106.13281).

The first updates may be in an easier environment (``first``), such as one with a failsafe. What that failsafe cuts off
a command has no gradient through the traffic, so ``heed`` makes it cost something: then a policy learns to brake by
itself while nothing can happen, and the failsafe can be taken away.

``python -m agents.apg --config configs/ring-apg.yaml --seed 1``
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro
from torch import Tensor

from agents import common, environments
from agents.monitor import Monitor
from idm_env.envs.vector import DiffIDMVectorEnv
from idm_env.tasks import Task


@dataclass
class Arguments(common.Arguments):
    """Arguments of APG.

    Args:
        count: Environments that run together; their episodes begin at different times.
        window: Steps through which gradients go.
        explore: Standard deviation of what is added to the actions of each environment throughout a window, falling
            with the learning rate. Without it a vehicle that stands never feels what driving on is worth.
        first: Keywords of the environment that differ in the first updates; only in YAML.
        first_updates: How many updates these are.
        heed: Reward per step that an agent loses for each m/s² of its command that the failsafe of the first updates
            would cut off, as far as its brakes could do better; it grows to that over the first updates.
    """

    out: Path = Path("runs/apg")
    learning_rate: float = 1e-3
    count: int = 64
    window: int = 600
    explore: float = 0.02
    first: Annotated[dict[str, Any], tyro.conf.Suppress] = field(default_factory=dict)
    first_updates: int = 0
    heed: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.heed < 0.0:
            raise ValueError(f"heed = {self.heed:g} must be at least 0.")
        if self.heed and not {**self.environment, **self.first}.get("failsafe"):
            raise ValueError(
                f"heed = {self.heed:g} is for what a failsafe cuts off, and there is none. Give a failsafe in "
                "'environment' or 'first', or leave heed out."
            )


def stage(arguments: Arguments, update: int) -> dict[str, Any]:
    """Return the keywords of the environment of an update."""
    return {**arguments.environment, **(arguments.first if update < arguments.first_updates else {})}


def beyond(guard: Task, env: DiffIDMVectorEnv, action: Tensor) -> Tensor:
    """Return by how much commands exceed what the failsafe of ``guard`` lets pass (m/s²), ``(n, agents)``.

    Nobody can heed it beyond his brakes. What is safe has no gradient: it is a target.
    """
    world = env.batch.world
    assert world is not None
    safe = guard.safe_command(world).detach().clamp_min(guard.command_limits[0])
    return torch.relu(guard.command(action) - safe)


def train(arguments: Arguments) -> list[dict[str, Any]]:
    """Train a policy; return the evaluations. ValueError and DivergedError say what went wrong, in one line."""
    began = time.process_time()
    torch.manual_seed(arguments.seed)
    policy, saved = common.begin(arguments, "apg")
    done = saved.get("update", -1) + 1
    env = environments.make_env(stage(arguments, done), arguments.count, output="torch")
    env.reset(seed=environments.first_seed(arguments.seed, arguments.count))
    guard = environments.task_of(stage(arguments, -1)) if arguments.heed else None
    optimiser = torch.optim.Adam(policy.parameters(), lr=arguments.learning_rate)
    if saved:
        optimiser.load_state_dict(saved["optimiser"])
        observation = environments.restore(env, saved["episodes"])
    else:
        observation = environments.desynchronise(env)
    with Monitor("apg", arguments, began, saved) as monitor:
        if not saved:
            monitor.untrained(policy)
        for update in range(done, arguments.updates):
            if update == arguments.first_updates > done:
                episodes = environments.snapshot(env)
                env = environments.make_env(stage(arguments, update), arguments.count, output="torch")
                observation = environments.restore(env, episodes)
            rate = common.fall(arguments.learning_rate, update, arguments.updates)
            optimiser.param_groups[0]["lr"] = rate
            env.detach()
            observation, total = observation.detach(), torch.zeros(())
            # Seeded by the update, so that a resumed training repeats it.
            torch.manual_seed(environments.first_seed(arguments.seed, update))
            share = rate / arguments.learning_rate
            # It grows while the failsafe is there: first a vehicle learns to drive, then to brake by itself.
            heed = arguments.heed * min((update + 1) / max(arguments.first_updates, 1), 1.0)
            push = arguments.explore * share * torch.randn(arguments.count, len(env.task.agents))
            for _ in range(arguments.window):
                action = policy(observation) + push
                if guard is not None:
                    total = total - heed * beyond(guard, env, action).mean()
                observation, reward, *_ = env.step(action)
                total = total + reward.mean()
            loss = -total / arguments.window
            norm = common.descend(loss, policy.parameters(), optimiser, arguments.clip, update, monitor.last)
            training = {"optimiser": optimiser.state_dict(), "episodes": environments.snapshot(env)}
            steps = arguments.window * arguments.count
            figures = {"reward": -loss.item(), "norm": norm, "learning_rate": rate}
            if not monitor.after(update, steps, policy, training, figures):
                break
    return monitor.history


def main(argv: Sequence[str] | None = None) -> None:
    """Train as the command line says."""
    common.command_line(train, Arguments, "apg", argv)


if __name__ == "__main__":
    main()
