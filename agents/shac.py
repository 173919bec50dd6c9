"""Short-horizon actor-critic: gradients through windows too short for the task, and a learned value of where they end.

After Xu, Makoviychuk, Narang, Ramos, Matusik, Garg, Macklin 2022, "Accelerated policy learning with parallel
differentiable simulation", ICLR (arXiv 2204.07137). With windows of h steps, ``t`` within one,

* actor: maximise ``(1 − γ) Σ_{t<h} γ^t r_t + γ^h V'(s_h)``, differentiated through traffic and policy;
* critic: ``V(s_t)`` → TD(λ) returns of the window, bootstrapped with a target critic V' that follows V slowly.

Values are ``(1 − γ)`` times returns: an average reward. The critic sees the whole road, which only training needs; the
policy sees its observation. Where an episode ends within a window the gradient is cut and, if it was cut off rather
than terminated, its last scene is valued, never the new episode's first.

``python -m agents.shac --config configs/ring-shac.yaml --seed 1``
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from agents import common, environments
from agents.monitor import Monitor
from idm_env.envs.vector import DiffIDMVectorEnv
from idm_env.tasks.features import AgentView, Feature, ObservedFeature


@dataclass
class Arguments(common.Arguments):
    """Arguments of SHAC.

    Args:
        count: Environments that run together; their episodes begin at different times.
        window: Steps through which gradients go.
        gamma: Discount per step.
        lam: Of the TD(λ) returns.
        critic_rate: Learning rate of the critic.
        critic_epochs: Passes over a window's samples.
        critic_hidden: Widths of the critic's hidden layers.
        follow: Share of the critic that the target critic keeps of itself in an update.
        critic_first: Windows in which only the critic learns.
        explore: Standard deviation of what is added to the actions of each environment throughout a window. Without it
            the critic never sees what a little more or less gap is worth.
    """

    out: Path = Path("runs/shac")
    updates: int = 400
    evaluate_every: int = 10
    learning_rate: float = 1e-3
    count: int = 64
    window: int = 64
    gamma: float = 0.998
    lam: float = 0.95
    critic_rate: float = 2e-3
    critic_epochs: int = 16
    critic_hidden: tuple[int, ...] = (64, 64)
    follow: float = 0.8
    critic_first: int = 5
    explore: float = 0.02


_FAR = 150.0
"""Gap (m) beyond which a free road is no wider to the critic."""


def _speeds(view: AgentView) -> Tensor:
    return view.state.speed


def _gaps(view: AgentView) -> Tensor:
    return view.state.gap.clamp_max(_FAR)


def _mean(column: Callable[[AgentView], Tensor], view: AgentView) -> Tensor:
    return view.mean(column(view))


def _deviation(column: Callable[[AgentView], Tensor], view: AgentView) -> Tensor:
    x = column(view)
    return (view.mean((x - x.mean(-1, keepdim=True)).square()) + 2.25e-4).sqrt()


ROAD = tuple(
    Feature(f"{what}_of_all_{name}", symbol, unit, 15.0, -1e4, 1e4, partial(how, of))
    for name, unit, of in (("speeds", "m/s", _speeds), ("gaps", "m", _gaps))
    for what, symbol, how in (("mean", "⟨x⟩", _mean), ("deviation", "σ(x)", _deviation))
)
"""What the critic sees of the road: mean and deviation of all speeds (15 m/s) and gaps (15 m, at most 150 m)."""


def _ahead(each: ObservedFeature, view: AgentView) -> Tensor:
    # One view for all of the agent itself, so that what they share is worked out once.
    return each.feature.read(AgentView(view.task, view.world, each.ahead) if each.ahead else view)


def with_road(environment: Mapping[str, Any]) -> dict[str, Any]:
    """Return the environment in which every agent observes what it did, and ``ROAD`` behind that."""
    task = environments.task_of(environment)
    own = [replace(each.feature, name=each.name, read=partial(_ahead, each)) for each in task.observed]
    return {**environment, "observation": {"features": [*own, *ROAD], "scaling": task.scaling}}


class Sighted(nn.Module):
    """A policy among observations that have ``ROAD`` behind them, which it does not look at."""

    def __init__(self, policy: nn.Module, agents: int) -> None:
        super().__init__()
        self.policy, self.agents = policy, agents

    def own(self, observation: Tensor) -> Tensor:
        """Return what the policy observes."""
        return observation.unflatten(-1, (self.agents, -1))[..., : -len(ROAD)].flatten(-2)

    def forward(self, observation: Tensor) -> Tensor:
        """Return the policy's actions."""
        action: Tensor = self.policy(self.own(observation))
        return action

    def scene(self, observation: Tensor) -> Tensor:
        """Return what the critic sees: what all agents observe, and the road once."""
        return torch.cat((self.own(observation), observation[..., -len(ROAD) :]), dim=-1)


class Critic(nn.Module):
    """The value of scenes: a smooth network, over inputs in the fixed normalisation of human driving."""

    mean: Tensor
    scale: Tensor

    def __init__(self, scenes: Tensor, hidden: Sequence[int]) -> None:
        super().__init__()
        self.register_buffer("mean", scenes.mean(0))
        self.register_buffer("scale", scenes.std(0).clamp_min(1e-3))
        widths = [scenes.shape[-1], *hidden]
        layers: list[nn.Module] = []
        for before, after in itertools.pairwise(widths):
            layers += [nn.Linear(before, after), nn.Tanh()]
        self.body = nn.Sequential(*layers, nn.Linear(widths[-1], 1))

    def forward(self, scenes: Tensor) -> Tensor:
        """Return the values, without the last dimension."""
        value: Tensor = self.body((scenes - self.mean) / self.scale).squeeze(-1)
        return value


def human_scenes(environment: Mapping[str, Any], seed: int, count: int = 16, steps: int = 1500) -> Tensor:
    """Return what the critic sees, every tenth Δt or decision after it, while human drivers keep the wheel."""
    env = environments.make_env(with_road(environment), count, output="numpy")
    seen = [env.reset(seed=seed)[0]]
    held = env.task.held
    for step in range(0, steps, held):
        observation = env.step(None)[0]
        if step % 10 < held:
            seen.append(observation)
    return Sighted(nn.Identity(), len(env.task.agents)).scene(torch.as_tensor(np.concatenate(seen)))


@dataclass
class Window:
    """What a window leaves, ``(h, n)``: scenes, rewards, values of what follows and ends; and the actor's gain (n,)."""

    scenes: Tensor
    rewards: Tensor
    following: Tensor
    ended: Tensor
    gain: Tensor


def roll(env: DiffIDMVectorEnv, sighted: Sighted, target: nn.Module, a: Arguments) -> Window:
    """Drive one window and return it, its gain with the graph; ``env`` is one of ``with_road``."""
    push = a.explore * torch.randn(env.num_envs, 1)
    unrolled = env.unroll(sighted, a.window, push)
    ended = unrolled.terminated | unrolled.truncated
    value = torch.where(unrolled.terminated, 0.0, target(sighted.scene(unrolled.final)))
    # How many steps of its episode have gone before, within the window.
    step = torch.arange(a.window).unsqueeze(-1)
    begun = torch.where(ended, step + 1, 0).cummax(0).values.roll(1, 0)
    begun[0] = 0
    discount = a.gamma ** (step - begun).to(unrolled.reward.dtype)
    last = ended | (step == a.window - 1)
    gains = (1.0 - a.gamma) * discount * unrolled.reward + torch.where(last, a.gamma * discount * value, 0.0)
    scenes = sighted.scene(unrolled.observation[:-1]).detach()
    return Window(scenes, unrolled.reward.detach(), value.detach(), ended, gains.sum(0))


def returns(window: Window, gamma: float, lam: float) -> Tensor:
    """Return the TD(λ) returns ``G_t = (1−γ) r_t + γ ((1−λ) V'_{t+1} + λ G_{t+1})``, times (1 − γ) as values are.

    At the end of the window, and where an episode ends, ``G_{t+1}`` is V' of what follows (0 after a collision).
    """
    result = torch.empty_like(window.rewards)
    after = window.following[-1]
    for t in reversed(range(len(result))):
        onward = torch.where(window.ended[t], window.following[t], (1.0 - lam) * window.following[t] + lam * after)
        after = (1.0 - gamma) * window.rewards[t] + gamma * onward
        result[t] = after
    return result


def learn_values(
    critic: nn.Module, optimiser: torch.optim.Optimizer, window: Window, a: Arguments, update: int, kept: Path
) -> float:
    """Fit the critic to a window's returns; return the last mean squared error. DivergedError as ``descend``."""
    scenes, targets = window.scenes.flatten(0, 1), returns(window, a.gamma, a.lam).flatten()
    error = torch.zeros(())
    for _ in range(a.critic_epochs):
        for part in torch.randperm(len(targets)).chunk(4):
            error = (critic(scenes[part]) - targets[part]).square().mean()
            common.descend(error, critic.parameters(), optimiser, a.clip, update, kept)
    return float(error.detach())


def train(a: Arguments) -> list[dict[str, Any]]:
    """Train a policy; return the evaluations. ValueError and DivergedError say what went wrong, in one line."""
    began = time.process_time()
    torch.manual_seed(a.seed)
    env = environments.make_env(with_road(a.trained_in), a.count, output="torch")
    env.reset(seed=environments.first_seed(a.seed, a.count))
    policy, saved = common.begin(a, "shac")
    sighted = Sighted(policy, len(env.task.agents))
    _ = environments.restore(env, saved["episodes"]) if saved else environments.desynchronise(env)
    critic = Critic(human_scenes(a.trained_in, environments.first_seed(a.seed, 0)), a.critic_hidden)
    target = deepcopy(critic)
    target.requires_grad_(False)
    actor_steps = torch.optim.Adam(policy.parameters(), lr=a.learning_rate)
    critic_steps = torch.optim.Adam(critic.parameters(), lr=a.critic_rate)
    parts: dict[str, Any] = {
        "critic": critic,
        "target": target,
        "actor_steps": actor_steps,
        "critic_steps": critic_steps,
    }
    for name, part in parts.items():
        if saved:
            part.load_state_dict(saved[name])
    with Monitor("shac", a, began, saved) as monitor:
        if not saved:
            monitor.untrained(policy)
        for update in range(saved.get("update", -1) + 1, a.updates):
            rate = common.fall(a.learning_rate, update, a.updates)
            actor_steps.param_groups[0]["lr"] = rate
            env.detach()
            window = roll(env, sighted, target, a)
            # The gain of a window is a few steps' share of an average reward: per step it has the size of a reward.
            loss = -window.gain.mean() / ((1.0 - a.gamma) * a.window)
            norm = 0.0
            if update >= a.critic_first:
                norm = common.descend(loss, policy.parameters(), actor_steps, a.clip, update, monitor.last)
            error = learn_values(critic, critic_steps, window, a, update, monitor.last)
            with torch.no_grad():
                for mine, theirs in zip(target.parameters(), critic.parameters(), strict=True):
                    mine.lerp_(theirs, 1.0 - a.follow)
            training = {name: part.state_dict() for name, part in parts.items()}
            training["episodes"] = environments.snapshot(env)
            reward = float(window.rewards.mean())
            figures = {"reward": reward, "value_error": error, "norm": norm, "learning_rate": rate}
            if not monitor.after(update, a.window * a.count, policy, training, figures):
                break
    return monitor.history


def main(argv: Sequence[str] | None = None) -> None:
    """Train as the command line says."""
    common.command_line(train, Arguments, "shac", argv)


if __name__ == "__main__":
    main()
