"""The policy of all agents: one small network, if asked for with a memory of what it has seen."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

ACTIVATIONS: dict[str, type[nn.Module]] = {"tanh": nn.Tanh, "relu": nn.ReLU}


class Past(NamedTuple):
    """What a policy remembers: running means ``(n, agents, times, features)`` and the state of its cell.

    ``new`` (bool, ``(n,)``) marks rows whose episode begins: what they remember is not used.
    """

    means: Tensor
    hidden: Tensor
    new: Tensor


class Policy(nn.Module):
    """``action = squash(W φ(… φ(W₁ x)))``: one small network, the same for every agent of an environment.

    ``x = (o − m)/s``, followed by what the policy remembers, if it does: for every time τ of ``history`` (steps) the
    running mean ``m_τ ← m_τ + (1 − e^(−1/τ)) (x − m_τ)``, which begins at the first x of an episode; and the state of a
    gated recurrent unit (Cho et al. 2014, arXiv 1406.1078) of ``recurrent`` numbers, which begins at 0.
    ``observation`` has shape ``(…, agents · features)``, actions ``(…, agents)`` in [−1, 1]. ``squash`` is ``tanh`` or
    ``clip``. The normalisation m, s is fixed: that of human drivers.
    """

    mean: Tensor
    scale: Tensor
    rates: Tensor

    def __init__(
        self,
        features: int,
        hidden: Sequence[int] = (32, 32),
        activation: str = "tanh",
        squash: str = "tanh",
        history: Sequence[float] = (),
        recurrent: int = 0,
    ) -> None:
        super().__init__()
        self.made = {
            "features": features, "hidden": list(hidden), "activation": activation, "squash": squash,
            "history": list(history), "recurrent": recurrent,
        }  # fmt: skip
        self.register_buffer("mean", torch.zeros(features))
        self.register_buffer("scale", torch.ones(features))
        rates = [[-np.expm1(-1.0 / steps)] for steps in history]
        self.register_buffer("rates", torch.tensor(rates, dtype=torch.float32).view(-1, 1), persistent=False)
        self.cell = nn.GRUCell(features, recurrent) if recurrent else None
        widths = [features * (1 + len(rates)) + recurrent, *hidden]
        layers: list[nn.Module] = []
        for before, after in itertools.pairwise(widths):
            layers += [nn.Linear(before, after), ACTIVATIONS[activation]()]
        self.body = nn.Sequential(*layers, nn.Linear(widths[-1], 1))
        last = self.body[-1]
        assert isinstance(last, nn.Linear)
        with torch.no_grad():
            # A policy begins by commanding almost nothing.
            last.weight.mul_(0.01)
            last.bias.zero_()

    def starts_with(self, action: float) -> None:
        """Begin by an action that is almost the same whatever is observed: that of the driver, where a task has one."""
        last = self.body[-1]
        assert isinstance(last, nn.Linear)
        inner = min(action, 0.99)
        with torch.no_grad():
            last.bias.fill_(math.atanh(inner) if self.made["squash"] == "tanh" else inner)

    @property
    def remembers(self) -> bool:
        """Whether an action depends on more than one observation."""
        return bool(self.made["history"] or self.made["recurrent"])

    def forward(self, observation: Tensor) -> Tensor:
        """Return the actions, those at the beginning of an episode if the policy remembers."""
        return self.step(observation, None)[0]

    def step(self, observation: Tensor, past: Past | None) -> tuple[Tensor, Past | None]:
        """Return the actions, and what is remembered of this step; ``past`` None begins all episodes."""
        seen = (observation.unflatten(-1, (-1, len(self.mean))) - self.mean) / self.scale
        if self.remembers:
            past = self._remembered(seen, past)
            action = self.body(torch.cat([seen, past.means.flatten(-2), past.hidden], -1))
        else:
            action = self.body(seen)
        action = action.squeeze(-1)
        return (torch.tanh(action) if self.made["squash"] == "tanh" else action.clamp(-1.0, 1.0)), past

    def _remembered(self, seen: Tensor, past: Past | None) -> Past:
        """Return what is remembered of ``(…, agents, features)``, this step included."""
        now = seen.unsqueeze(-2)
        means, hidden = now.expand(*seen.shape[:-1], len(self.rates), -1), seen.new_zeros(())
        if past is not None:
            means = torch.where(past.new[..., None, None, None], means, past.means)
            hidden = torch.where(past.new[..., None, None], hidden, past.hidden)
        means = means + self.rates * (now - means)
        if self.cell is None:
            hidden = seen[..., :0]
        else:
            hidden = hidden.expand(*seen.shape[:-1], self.cell.hidden_size)
            hidden = self.cell(seen.flatten(0, -2), hidden.flatten(0, -2)).view_as(hidden)
        return Past(means, hidden, torch.zeros(seen.shape[:-2], dtype=torch.bool))

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[np.ndarray, Any]:
        """Return actions as Stable-Baselines3's ``predict`` does: arrays, and the state for the next call.

        ``episode_start`` (bool, one per environment) says where an episode begins.
        """
        with torch.no_grad():
            seen = torch.as_tensor(np.asarray(observation), dtype=torch.float32)
            if isinstance(state, Past) and episode_start is not None:
                state = state._replace(new=torch.as_tensor(np.asarray(episode_start)).view_as(state.new))
            action, state = self.step(seen, state)
            return action.numpy().astype(np.float32), state


class Driving:
    """A policy at the wheel: from observations to actions, step by step, with what it remembers in ``past``."""

    def __init__(self, policy: Policy, past: Past | None = None) -> None:
        self.policy, self.past = policy, past

    def __call__(self, observation: Tensor) -> Tensor:
        """Return the actions of a step."""
        action, self.past = self.policy.step(observation, self.past)
        return action

    def begin(self, ended: Tensor) -> None:
        """Forget what was seen in the episodes that have ended (bool, ``(n,)``)."""
        if self.past is not None:
            self.past = self.past._replace(new=ended)

    def detach(self) -> None:
        """Cut the graph behind what is remembered."""
        if self.past is not None:
            self.past = Past(*(x.detach() for x in self.past))
