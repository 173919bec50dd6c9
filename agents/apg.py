"""Analytic policy gradient: the return of a window, differentiated through the simulator, is all there is.

``∇_θ (1/W) Σ_t r_t``, r_t = r(s_t, a_t), a_t = π_θ(o_t), s_{t+1} = f(s_t, a_t): the gradient goes through the policy
and through the traffic. After W steps the graph is cut and the episodes go on (truncated back-propagation). W must be
long enough for an action's effect to come round to the vehicle: on a ring of 22 vehicles about a minute. The name is
that of Freeman et al. 2021 (Brax, arXiv 2106.13281).

``python -m agents.apg --config configs/ring-apg.yaml --seed 1``
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from agents import common, environments
from agents.monitor import Monitor
from agents.policy import Driving, Past
from idm_env.envs.vector import DiffIDMVectorEnv
from idm_env.validation import finite, shown


@dataclass
class Arguments(common.Arguments):
    """Arguments of APG.

    Args:
        count: Environments that run together; their episodes begin at different times.
        window: Steps through which gradients go.
        explore: Standard deviation of what is added to the actions of each environment throughout a window, falling
            with the learning rate. Without it a vehicle that stands never feels what driving on is worth.
        start: Checkpoint whose policy training begins with, of the same task and observation; else it is a new one.
            ``hidden``, ``history`` and ``recurrent`` are then that policy's, and nothing is cloned.
        history: Times (s) of running means of what is observed, which the policy sees too (``agents.policy``).
        recurrent: Numbers that a gated recurrent unit of the policy remembers; 0 is none.
    """

    out: Path = Path("runs/apg")
    learning_rate: float = 1e-3
    count: int = 64
    window: int = 600
    explore: float = 0.02
    start: Path | None = None
    history: tuple[float, ...] = ()
    recurrent: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        if any(not finite("history", x, "s") > 0.0 for x in self.history):
            raise ValueError(f"history = {shown(self.history)} must be times above 0 (s).")
        if self.clone and (self.history or self.recurrent):
            raise ValueError(
                f"clone = {self.clone} fits single observations, and a policy with a memory has more to go by. Leave "
                "clone, or history and recurrent, out."
            )


def lost(
    env: DiffIDMVectorEnv, driving: Driving, observation: Tensor, push: Tensor, steps: int
) -> tuple[Tensor, Tensor]:
    """Drive one window; return what is observed after it and minus the mean reward, with its graph."""
    if not driving.policy.remembers:
        window = env.unroll(driving.policy, steps, push)
        return window.observation[-1], -window.reward.mean()
    total = torch.zeros(())
    for _ in range(steps):
        observation, reward, terminated, truncated, _ = env.step(driving(observation) + push)
        driving.begin(terminated | truncated)
        total = total + reward.mean()
    return observation, -total / steps


def train(arguments: Arguments) -> list[dict[str, Any]]:
    """Train a policy; return the evaluations. ValueError and DivergedError say what went wrong, in one line."""
    began = time.process_time()
    torch.manual_seed(arguments.seed)
    task = environments.task_of(arguments.environment)
    times = [seconds / task.step_time for seconds in arguments.history]
    policy, saved = common.begin(arguments, "apg", history=times, recurrent=arguments.recurrent)
    if arguments.start is not None and not saved:
        policy = common.load_for(arguments.start, task)[0]
    done = saved.get("update", -1) + 1
    env = environments.make_env(arguments.trained_in, arguments.count, output="torch")
    env.reset(seed=environments.first_seed(arguments.seed, arguments.count))
    optimiser = torch.optim.Adam(policy.parameters(), lr=arguments.learning_rate)
    if saved:
        optimiser.load_state_dict(saved["optimiser"])
        observation = environments.restore(env, saved["episodes"])
    else:
        observation = environments.desynchronise(env)
    driving = Driving(policy, Past(*saved["past"]) if saved.get("past") else None)
    with Monitor("apg", arguments, began, saved) as monitor:
        if not saved:
            monitor.untrained(policy)
        for update in range(done, arguments.updates):
            rate = common.fall(arguments.learning_rate, update, arguments.updates)
            optimiser.param_groups[0]["lr"] = rate
            env.detach()
            observation = observation.detach()
            # Seeded by the update, so that a resumed training repeats it.
            torch.manual_seed(environments.first_seed(arguments.seed, update))
            share = rate / arguments.learning_rate
            push = arguments.explore * share * torch.randn(arguments.count, len(env.task.agents))
            observation, loss = lost(env, driving, observation, push, arguments.window)
            norm = common.descend(loss, policy.parameters(), optimiser, arguments.clip, update, monitor.last)
            driving.detach()
            training = {
                "optimiser": optimiser.state_dict(), "episodes": environments.snapshot(env),
                "past": None if driving.past is None else list(driving.past),
            }  # fmt: skip
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
