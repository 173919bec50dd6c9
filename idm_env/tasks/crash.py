"""What a crash costs, and the words for it.

The step in which a vehicle touches another ends the episode and pays nothing. Rewards in [0, 1] need no more: what is
in store is never negative, so no crash pays, from wherever one is, with any discount. With γ < 1 a crash then costs at
most 1/(1 − γ), 100 at γ = 0.99.

Rewards that can be negative are a reason to crash. Under one in [low, high] with low < 0 a crash pays ``−crash_cost``,
``N (high − low) + 1`` by default, N being the most steps of an episode: its return, less than ``N low``, lies below
that of every survival. Algorithms that learn values should then normalise rewards (``VecNormalize``).
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from idm_env.tasks.types import NOBODY, RewardRange


def lawful_cost(pay: RewardRange, steps: int) -> float:
    """Return the least price that makes a crash worse than any survival of at most ``steps`` steps; 0 in [0, 1]."""
    return steps * (pay.high - pay.low) + 1.0 if pay.low < 0.0 else 0.0


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
