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
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from agents import common, environments
from agents.monitor import Monitor
from idm_env.envs.vector import DiffIDMVectorEnv


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


def scene(env: DiffIDMVectorEnv, observation: Tensor) -> Tensor:
    """Return what the critic sees: the observation, and mean and deviation of all speeds (15 m/s) and gaps (15 m)."""
    state = env.state
    columns = []
    for x in (state.speed / 15.0, state.gap.clamp_max(150.0) / 15.0):
        mean = x.mean(-1, keepdim=True)
        columns += [mean, ((x - mean).square().mean(-1, keepdim=True) + 1e-6).sqrt()]
    return torch.cat((observation, *columns), dim=-1)


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
    """Return what the critic sees, every tenth step, while human drivers keep the wheel."""
    env = environments.make_env(environment, count, output="numpy")
    seen = [scene(env, torch.as_tensor(env.reset(seed=seed)[0]))]
    for step in range(steps):
        observation = env.step(None)[0]
        if step % 10 == 0:
            seen.append(scene(env, torch.as_tensor(observation)))
    return torch.cat(seen)


@dataclass
class Window:
    """What a window leaves, ``(h, n)``: scenes, rewards, values of what follows and ends; and the actor's gain (n,)."""

    scenes: Tensor
    rewards: Tensor
    following: Tensor
    ended: Tensor
    gain: Tensor


def roll(
    env: DiffIDMVectorEnv, policy: nn.Module, target: nn.Module, observation: Tensor, a: Arguments
) -> tuple[Tensor, Window]:
    """Drive one window; return the observation after it and the window, its gain with the graph."""
    n = env.num_envs
    discount, gain = torch.ones(n), torch.zeros(n)
    push = a.explore * torch.randn(n, 1)
    kept: list[tuple[Tensor, ...]] = []
    for t in range(a.window):
        before = scene(env, observation).detach()
        observation, reward, terminated, truncated, _ = env.step(policy(observation) + push)
        gain = gain + (1.0 - a.gamma) * discount * reward
        ended = terminated | truncated
        value = torch.where(terminated, 0.0, target(scene(env, observation)))
        discount = discount * a.gamma
        last = torch.ones_like(ended) if t == a.window - 1 else ended
        gain = gain + torch.where(last, discount * value, 0.0)
        discount = torch.where(ended, 1.0, discount)
        kept.append((before, reward.detach(), value.detach(), ended))
        if bool(ended.any()):
            observation = env.reset(options={"reset_mask": ended})[0]
    scenes, rewards, following, ends = (torch.stack(column) for column in zip(*kept, strict=True))
    return observation, Window(scenes, rewards, following, ends, gain)


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
    scenes, wanted = window.scenes.flatten(0, 1), returns(window, a.gamma, a.lam).flatten()
    error = torch.zeros(())
    for _ in range(a.critic_epochs):
        for part in torch.randperm(len(wanted)).chunk(4):
            error = (critic(scenes[part]) - wanted[part]).square().mean()
            common.descend(error, critic.parameters(), optimiser, a.clip, update, kept)
    return float(error.detach())


def train(a: Arguments) -> list[dict[str, Any]]:
    """Train a policy; return the evaluations. ValueError and DivergedError say what went wrong, in one line."""
    began = time.process_time()
    torch.manual_seed(a.seed)
    env = environments.make_env(a.trained_in, a.count, output="torch", autoreset_mode="Disabled")
    env.reset(seed=environments.first_seed(a.seed, a.count))
    policy, saved = common.begin(a, "shac")
    observation = environments.restore(env, saved["episodes"]) if saved else environments.desynchronise(env)
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
            observation, window = roll(env, policy, target, observation.detach(), a)
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
