"""Shapes over a coordinate, shared by effects that act at a place or time: hats, steps and windows.

Shapes: the result of a coordinate ``[..., n]`` (m or s) is ``[..., n]``, without a unit.
"""

from collections.abc import Mapping
from itertools import pairwise

import torch
from torch import Tensor

from idm_env.validation import shown


def rising(name: str, knots: tuple[float, ...], profile: tuple[float, ...] | None = None) -> None:
    """Raise ValueError for knots that do not rise, or a profile of another length."""
    if len(knots) < 2 or any(b <= a for a, b in pairwise(knots)):
        raise ValueError(f"{name}.knots = {knots} must be at least two rising positions (m).")
    if profile is not None and len(profile) != len(knots):
        raise ValueError(f"{name}.profile has {len(profile)} values for {len(knots)} knots: give one each.")


def on_lap(position: Tensor, period: float | None) -> Tensor:
    """Return the position on a lap of length ``period`` (m), or the position itself on an open road."""
    return position if period is None else torch.remainder(position, period)


def smooth_step(x: Tensor, where: Tensor | float, width: float) -> Tensor:
    """Rise from 0 to 1 around ``where``; ``width`` is the logistic's scale, 12 % to 88 % over 4 widths."""
    return torch.sigmoid((x - where) / width)


def window(x: Tensor, begin: Tensor, end: Tensor, width: float) -> Tensor:
    """1 between ``begin`` and ``end``, 0 outside, with smooth edges so that both can be found by gradients."""
    return smooth_step(x, begin, width) * smooth_step(-x, -end, width)


def interpolate(x: Tensor, knots: tuple[float, ...], values: list[Tensor], period: float | None = None) -> Tensor:
    """Piecewise linear through (knot, value), constant beyond the ends, or periodic.

    ``values`` broadcast against ``x``. The sum runs over hats, so it is linear in the values and has a derivative with
    respect to x between knots. ValueError for knots that do not rise, and for another number of values.
    """
    if len(knots) != len(values) or any(b <= a for a, b in pairwise(knots)):
        raise ValueError(f"{len(values)} heights at knots {shown(knots)}: knots must rise, one for every height.")
    if period is not None:
        first, last = knots[0], knots[-1]
        knots = (last - period, *knots, first + period)
        values = [values[-1], *values, values[0]]
    total = values[0] + torch.zeros_like(x)
    for left, right, before, after in zip(knots[:-1], knots[1:], values[:-1], values[1:], strict=True):
        total = total + ((x - left) / (right - left)).clamp(0.0, 1.0) * (after - before)
    return total


def curve(
    x: Tensor,
    p: Mapping[str, Tensor],
    stem: str,
    knots: tuple[float, ...],
    period: float | None = None,
    values: tuple[float, ...] | None = None,
) -> Tensor:
    """Return the curve through ``values`` at the knots, or through the parameters ``stem_0``, ``stem_1``, ….

    A loop that keeps its curves as tables of numbers hands in parameters with a ``table``, and its place takes the
    knots'.
    """
    table = getattr(p, "table", None)
    if table is not None:
        return table(x)  # type: ignore[no-any-return]
    heights = [p[f"{stem}_{i}"] for i in range(len(knots))] if values is None else [x.new_tensor(v) for v in values]
    return interpolate(x, knots, heights, period)
