"""A crash is worse than any survival: the law of rewards, what it takes to keep it, and the words for a crash.

A step's reward without a crash is in a task's ``reward_range``, [low, high] with low ≤ 0 ≤ high. The step in which a
vehicle touches another pays ``−crash_cost`` instead, ``N (high − low) + 1`` by default, N being the most steps of an
episode. So the return of an episode that ends in a crash, less than ``N high − crash_cost < N low``, lies below that of
every episode that does not; and from any moment on, with any discount, going on pays more than crashing.

It is a large number beside the rewards of a step, and must be: the returns of survivals alone may differ by as much.
Algorithms that learn values should normalise rewards (``VecNormalize``), or take a smaller ``crash_cost`` of their own.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from idm_env.tasks.types import NOBODY, RewardRange


def lawful_cost(pay: RewardRange, steps: int) -> float:
    """Return the cost that makes a crash worse than any survival of at most ``steps`` steps."""
    return steps * (pay.high - pay.low) + 1.0


def floored(reward: Tensor, knee: float, low: float) -> Tensor:
    """Return rewards that never fall to ``low``, unchanged above ``knee``: C¹, and with a gradient everywhere.

    ``r`` for r ≥ knee, else ``knee − x/(1 + x/(knee − low))`` with x = knee − r.
    """
    below = torch.relu(knee - reward)
    return reward.clamp_min(knee) - below / (1.0 + below / (knee - low))


def contact(
    ids: Sequence[str], agents: Sequence[int], vehicle: int, gap: float, seconds: float, leader: int | None = None
) -> str:
    """Return in words that a vehicle touched its leader, the one before it where nobody is named."""
    if leader is None:
        leader = vehicle - 1 if vehicle else len(ids) - 1
    names = [
        ("its leader" if ids[i] == NOBODY else f"vehicle {ids[i]}") + (" (an agent)" if i in agents else "")
        for i in (vehicle, leader)
    ]
    return f"{names[0]} touched {names[1]} after {seconds:.1f} s (gap {gap:.2f} m)"
