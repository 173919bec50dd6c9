"""Chances of going left, staying and going right, for whatever does more than freeze choices (``decisions=``).

A side with a margin of safety m (m/s²) is open with the chance s(m/τ), and among staying (U = 0) and the sides that
are open the chances are a logit of a driver's utilities U (m/s²), both with a temperature τ (m/s²)::

    P ∝ e^{U/τ},   s(x) = x² (3 − 2x) on [0, 1], 0 below, 1 above

What is unsafe has no chance, and chances are smooth in everything that drivers see. As τ → 0 they become the hard
choice.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from idm_env.roads.beside import Preference
from idm_env.types import Choices, Wish

Decisions = Literal["pathwise", "surrogate", "score", "soft"]
DECISIONS: tuple[Decisions, ...] = ("pathwise", "surrogate", "score", "soft")
NOISE = "decisions"
"""The input of ``score``: a standard normal per vehicle and step."""
_NEVER = -1e30


def settled(lane: Tensor, count: int, like: Tensor) -> Choices:
    """Return the choices of vehicles that are on one lane each, and have chosen nothing yet."""
    on = torch.nn.functional.one_hot(lane, count).to(like.dtype)
    return Choices(on, torch.zeros_like(on[..., 0]))


def chances(wish: Wish, left: Tensor, right: Tensor, temperature: float) -> Tensor:
    """Return the chances of left, staying and right, stacked; ``left`` and ``right`` (bool) say if there is a lane."""
    none = torch.zeros_like(wish.left)
    logits = torch.stack((wish.left, none, wish.right)) / temperature
    never = torch.full_like(logits[0], _NEVER)
    free = [_gate(margin / temperature) * there for margin, there in zip(wish[2:4], (left, right), strict=True)]
    both = logits.softmax(0)
    one = torch.stack((logits[0], none, never)).softmax(0), torch.stack((never, none, logits[2])).softmax(0)
    alone = torch.stack((none, none + 1.0, none))
    return free[0] * (free[1] * both + (1.0 - free[1]) * one[0]) + (1.0 - free[0]) * (
        free[1] * one[1] + (1.0 - free[1]) * alone
    )


def _gate(x: Tensor) -> Tensor:
    """Return ``s(x)``."""
    x = x.clamp(0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


def drawn(
    wish: Wish, left: Tensor, right: Tensor, temperature: float, normal: Tensor, signals: Tensor
) -> tuple[Preference, Tensor]:
    """Return choices that are drawn by their chances, and the logarithms of these chances.

    Claims are of equal utility: which of two is granted must not depend on what chances depend on.
    """
    to_left, stay, to_right = chances(wish, left, right, temperature)
    uniform = torch.special.ndtr(normal)
    lefts, rights = uniform < to_left.detach(), uniform > 1.0 - to_right.detach()
    picked = torch.where(lefts, to_left, torch.where(rights, to_right, stay))
    wants = lefts | rights
    blocked = ~wants & (torch.maximum(wish.left, wish.right) > 0)
    tiny = torch.finfo(picked.dtype).tiny
    return Preference(torch.ones_like(stay.detach()), lefts, wants, blocked, signals), picked.clamp_min(tiny).log()
