"""What agents can be rewarded for: declared terms, in a catalogue that is open.

A term is a function of a step; it says its unit and its bounds, from which follows what a crash must cost. Tasks have
rewards of their own, and ``reward={"speed": 0.2, "effort": -4.0}`` is ``Σ weight · term`` in their place: names of
``REWARD_TERMS``, or ``"my_file.py:my_term"``.

Shapes: the value of a term is ``(..., agents)``, or ``(..., 1)`` where it is the same for all.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from idm_env import metrics
from idm_env.tasks import features
from idm_env.tasks.features import AgentView
from idm_env.tasks.types import Agents, EnvState, RewardRange
from idm_env.validation import finite


@dataclass(frozen=True)
class Transition:
    """One step: what was commanded (m/s², ``(…, agents)``, as given), and the worlds before and after it."""

    task: Agents
    before: EnvState
    command: Tensor
    after: EnvState

    @property
    def view(self) -> AgentView:
        """The traffic after the step as the agents see it."""
        return AgentView(self.task, self.after)


@dataclass(frozen=True)
class RewardTerm:
    """One term of a reward.

    Args:
        name: Name of the term.
        symbol: As in equations.
        unit: SI unit, empty for numbers without one.
        low: Lowest value; lower ones are clipped, without a gradient.
        high: Highest value.
        of: Its value in a step, ``(…, agents)`` or ``(…, 1)`` where it is the same for all.
    """

    name: str
    symbol: str
    unit: str
    low: float
    high: float
    of: Callable[[Transition], Tensor]

    def __post_init__(self) -> None:
        if not (self.low < self.high and callable(self.of)):
            raise ValueError(
                f"reward term '{self.name}' (from {self.low:g} to {self.high:g}) needs a low below its high, and a "
                "function of a step."
            )


def speed(step: Transition) -> Tensor:
    """Return the mean speed of all vehicles on the road (m/s)."""
    return features.mean_speed(step.view)


def own_speed(step: Transition) -> Tensor:
    """Return v (m/s)."""
    return features.speed(step.view)


def effort(step: Transition) -> Tensor:
    """Return |u| (m/s²), u the command as it was given."""
    return step.command.abs()


def effort_squared(step: Transition) -> Tensor:
    """Return u² (m²/s⁴)."""
    return step.command * step.command


def jerk(step: Transition) -> Tensor:
    """Return ``|A − A_before|/Δt`` (m/s³)."""
    change = step.after.state.accel - step.before.state.accel
    return step.view.own(change).abs() / step.task.simulator.dt


def fuel(step: Transition) -> Tensor:
    """Return the mean fuel rate of all vehicles on the road (mL/s, ``metrics.kamal_fuel``)."""
    state = step.after.state
    return step.view.mean(metrics.fuel(state.speed, state.accel))


def co2(step: Transition) -> Tensor:
    """Return the mean emission of CO₂ of all vehicles on the road (g/s): of the gasoline in ``fuel``."""
    return metrics.CO2 * fuel(step)


def lag(step: Transition) -> Tensor:
    """Return ``v_lead − v`` (m/s): over an episode the ground that an agent has lost."""
    return features.relative_speed(step.view)


def tailgating(step: Transition) -> Tensor:
    """Return ``max(0, 1 − time gap/1 s)``."""
    return torch.relu(1.0 - features.time_gap(step.view))


REWARD_TERMS: dict[str, RewardTerm] = {
    each.name: each
    for each in (
        RewardTerm("speed", "⟨v⟩", "m/s", 0.0, 40.0, speed),
        RewardTerm("own_speed", "v", "m/s", 0.0, 40.0, own_speed),
        RewardTerm("effort", "|u|", "m/s²", 0.0, 10.0, effort),
        RewardTerm("effort_squared", "u²", "m²/s⁴", 0.0, 100.0, effort_squared),
        RewardTerm("jerk", "|ΔA|/Δt", "m/s³", 0.0, 100.0, jerk),
        RewardTerm("fuel", "⟨F⟩", "mL/s", 0.0, 10.0, fuel),
        RewardTerm("co2", "⟨CO₂⟩", "g/s", 0.0, 25.0, co2),
        RewardTerm("lag", "v_lead − v", "m/s", -20.0, 20.0, lag),
        RewardTerm("tailgating", "max(0, 1 − T/1 s)", "", 0.0, 1.0, tailgating),
    )
}


@dataclass(frozen=True)
class Weighted:
    """A reward of one's own: ``Σ weight · term``."""

    terms: tuple[tuple[RewardTerm, float], ...]

    @property
    def reward_range(self) -> RewardRange:
        """The lowest (at most 0) and the highest (at least 0) sum."""
        ends = [sorted((weight * term.low, weight * term.high)) for term, weight in self.terms]
        return RewardRange(min(0.0, sum(low for low, _ in ends)), max(0.0, sum(high for _, high in ends)))

    def __call__(self, step: Transition) -> Tensor:
        """Return the reward of a step, ``(…, agents)``; 0 for agents that are not on the road."""
        total = torch.zeros_like(step.command)
        for term, weight in self.terms:
            total = total + weight * term.of(step).clamp(term.low, term.high)
        return step.task.there(step.after.state, total)


def weighted(reward: Any, read: Callable[[Any, str], Any]) -> Weighted | None:
    """Return what ``reward`` asks for, None for the task's own; ``read`` returns the term of an entry.

    ValueError, in one line, for what is no mapping of terms to finite weights.
    """
    if reward is None:
        return None
    if not isinstance(reward, Mapping) or not reward:
        raise ValueError('reward must give weights of terms, such as {"speed": 0.2, "effort": -4.0}.')
    return Weighted(tuple((read(name, "reward"), finite(f"reward.{name}", w)) for name, w in reward.items()))
