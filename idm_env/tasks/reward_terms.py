"""Reward terms: a catalogue that is open, and rewards as weighted sums of them.

A term is a function of a step of Δt, with its unit and bounds. A reward is ``Σ weight · term``, averaged over the time
for which an action is held, so that its bounds do not depend on ``hold``. Every task declares rewards by name, of which
``"unit"`` lies in [0, 1]; ``reward={"speed": 0.2, "effort": -4.0}`` is another one: names of ``REWARD_TERMS``, or
``"my_file.py:my_term"``.

Shapes: the value of a term is ``(..., agents)``, or ``(..., 1)`` where it is the same for all.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from idm_env import metrics
from idm_env.tasks import features
from idm_env.tasks.features import AgentView
from idm_env.tasks.types import Agents, EnvState, RewardRange
from idm_env.validation import finite, one_of


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
        shared: Whether it is paid to agents that are not on the road, too.
    """

    name: str
    symbol: str
    unit: str
    low: float
    high: float
    of: Callable[[Transition], Tensor]
    shared: bool = False

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


def ease(step: Transition) -> Tensor:
    """Return ``1 − (u/u_max)²``, u_max the hardest command: 1 without a command."""
    low, high = step.task.command_limits
    return 1.0 - (step.command / max(-low, high)).square()


def headway(step: Transition) -> Tensor:
    """Return 1 from 7 m and 1 s to 60 m, 0 below 6 m or 0.8 s and above 120 m, linear between."""
    gap, speed = features.gap(step.view), features.speed(step.view)
    near, short, far = gap - 6.0, (metrics.time_gap(gap, speed) - 0.8) / 0.2, (120.0 - gap) / 60.0
    return torch.minimum(torch.minimum(near, short), far).clamp(0.0, 1.0)


def headway_penalty(gap: Tensor, speed: Tensor) -> Tensor:
    """Return 0 … 1, elementwise: how far a gap (m) is below 7 m, above 120 m, or a time gap below 1 s.

    The source (Lichtlé et al. 2022) takes 1 at any violation. Here it rises over 1 m, 10 m and 0.2 s, so that it has a
    gradient; a deeper violation counts 1 as in the source.
    """
    near, far, short = 7.0 - gap, (gap - 120.0) / 10.0, (1.0 - metrics.time_gap(gap, speed)) / 0.2
    return torch.maximum(torch.maximum(near, far), short).clamp(0.0, 1.0)


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


def conflict(step: Transition) -> Tensor:
    """Return ``max(0, 1 − TTC/4 s)``, TTC that of ``metrics.time_to_collision``.

    4 s is the usual threshold of a conflict: M. M. Minderhoud, P. H. L. Bovy 2001, Accid. Anal. Prev. 33(1), 89.
    """
    return torch.relu(1.0 - features.time_to_collision(step.view) / 4.0)


def drac(step: Transition) -> Tensor:
    """Return the deceleration (m/s²) that avoids a crash (``metrics.drac``)."""
    return features.drac(step.view)


REWARD_TERMS: dict[str, RewardTerm] = {
    each.name: each
    for each in (
        RewardTerm("speed", "⟨v⟩", "m/s", 0.0, 40.0, speed),
        RewardTerm("own_speed", "v", "m/s", 0.0, 40.0, own_speed),
        RewardTerm("effort", "|u|", "m/s²", 0.0, 10.0, effort),
        RewardTerm("effort_squared", "u²", "m²/s⁴", 0.0, 100.0, effort_squared),
        RewardTerm("ease", "1 − (u/u_max)²", "", 0.0, 1.0, ease),
        RewardTerm("headway", "h", "", 0.0, 1.0, headway),
        RewardTerm("jerk", "|ΔA|/Δt", "m/s³", 0.0, 100.0, jerk),
        RewardTerm("fuel", "⟨F⟩", "mL/s", 0.0, 10.0, fuel),
        RewardTerm("co2", "⟨CO₂⟩", "g/s", 0.0, 25.0, co2),
        RewardTerm("lag", "v_lead − v", "m/s", -20.0, 20.0, lag),
        RewardTerm("conflict", "max(0, 1 − TTC/4 s)", "", 0.0, 1.0, conflict),
        RewardTerm("drac", "DRAC", "m/s²", 0.0, 10.0, drac),
        RewardTerm("tailgating", "max(0, 1 − T/1 s)", "", 0.0, 1.0, tailgating),
    )
}


@dataclass(frozen=True)
class Weighted:
    """A reward: ``Σ weight · term``, each term within its bounds; a Δt pays ``1/held`` of it."""

    terms: tuple[tuple[RewardTerm, float], ...]
    held: int = 1

    @property
    def reward_range(self) -> RewardRange:
        """The lowest (at most 0) and the highest (at least 0) reward of a held step."""
        ends = [sorted((weight * term.low, weight * term.high)) for term, weight in self.terms]
        # Of weights that sum to 1 the floating-point sum need not.
        low, high = (round(sum(x), 9) for x in zip(*ends, strict=True))
        return RewardRange(min(0.0, low), max(0.0, high))

    def parts(self, step: Transition) -> dict[str, Tensor]:
        """Return what each term pays for a Δt, ``(…, agents)``; one that is not shared 0 to those off the road."""
        none, parts = torch.zeros_like(step.command), {}
        for term, weight in self.terms:
            value = none + weight / self.held * term.of(step).clamp(term.low, term.high)
            parts[term.name] = value if term.shared else step.task.there(step.after.state, value)
        return parts


def weighted(
    reward: Any, named: Mapping[str, Mapping[RewardTerm, float]], read: Callable[[Any, str], Any], held: int
) -> Weighted:
    """Return the reward that ``reward`` asks for: one of ``named``, of which None is the first, or weights of terms.

    ``read`` returns the term of an entry.

    Raises:
        ValueError: In one line, for an unknown name, no terms, two of one name, and a weight that is not finite.
    """
    if reward is None or isinstance(reward, str):
        name = next(iter(named)) if reward is None else one_of("reward", reward, named)
        return Weighted(tuple(named[name].items()), held)
    if not isinstance(reward, Mapping) or not reward:
        raise ValueError(
            'reward must give weights of terms, such as {"speed": 0.2, "effort": -4.0}, or be one of '
            f"{', '.join(named)}."
        )
    terms = tuple((read(name, "reward"), finite(f"reward.{name}", w)) for name, w in reward.items())
    names = [term.name for term, _ in terms]
    if len(set(names)) < len(names):
        raise ValueError(f"reward names the terms {', '.join(names)}: give each once.")
    if not any(weight for _, weight in terms):
        raise ValueError(f"reward gives no term a weight: {', '.join(names)} are all 0. Give one a weight.")
    return Weighted(terms, held)
