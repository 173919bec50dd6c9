"""The published recipe written directly with the published layer, torch autograd and torch's Adam: the reference."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from diffidm import IDMLayer

from idm_env.trajectories import paper
from idm_env.trajectories.tracks import TrackPiece, clock_of

FLOOR = torch.tensor(-paper.MAX_DECEL, dtype=torch.float64)
Inputs = Callable[[int, torch.Tensor, torch.Tensor], tuple[torch.Tensor, torch.Tensor]]
"""Gap and closing speed at a step, from position and speed."""


def rolled(values: torch.Tensor, speed0: torch.Tensor, ahead: Inputs, dt: float, steps: int) -> torch.Tensor:
    """Return positions [K, N] from 0 of values [N, 5]."""
    x, v = torch.zeros_like(speed0), speed0
    kept = []
    for k in range(steps):
        kept.append(x)
        gap, closing = ahead(k, x, v)
        a = IDMLayer.apply(
            values[:, 0], FLOOR, values[:, 1], v, values[:, 4], gap, closing, values[:, 3], values[:, 2],
            torch.tensor(dt),
        )  # fmt: skip
        x, v = x + v * dt, v + a * dt
    return torch.stack(kept)


def descended(
    free: list[torch.Tensor], loss: Callable[[], torch.Tensor], bounds: list[tuple[torch.Tensor, torch.Tensor]],
    iterations: int,
) -> None:  # fmt: skip
    """Minimise in place by torch's Adam, back between the bounds after every step."""
    optimiser = torch.optim.Adam(free, lr=paper.RATES[0])
    schedule = torch.optim.lr_scheduler.LinearLR(optimiser, 1.0, paper.RATES[1] / paper.RATES[0], iterations)
    for _ in range(iterations):
        optimiser.zero_grad()
        loss().backward()
        optimiser.step()
        schedule.step()
        with torch.no_grad():
            for x, (low, high) in zip(free, bounds, strict=True):
                x.copy_(torch.minimum(torch.maximum(x, low), high))


def five(count: int) -> tuple[torch.Tensor, tuple[torch.Tensor, torch.Tensor]]:
    """Return the start of the five values [N, 5], and their bounds."""
    values = torch.as_tensor(paper.START).repeat(count, 1).requires_grad_()
    return values, (torch.as_tensor(paper.LOW), torch.as_tensor(paper.HIGH))


def limits(bounds: tuple[float, float]) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.tensor(bounds[0], dtype=torch.float64), torch.tensor(bounds[1], dtype=torch.float64)


def direct(tracks: list[TrackPiece], dt: float, iterations: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return positions [K, N] relative to the first point, values [N, 5] and imagined gaps [K, N] of equal tracks."""
    clock = clock_of(tracks[0], dt)
    count, steps = len(tracks), len(clock)
    at = torch.as_tensor(np.round((tracks[0].time_s - clock[0]) / dt).astype(int))
    data = torch.as_tensor(np.stack([t.position_m - t.position_m[0] for t in tracks], axis=1))
    speed0 = (data[1] / (tracks[0].time_s[1] - tracks[0].time_s[0])).clamp_min(0.0)
    values, between = five(count)
    gap = torch.full((steps, count), 10.0, dtype=torch.float64).requires_grad_()
    closing = torch.zeros(steps, count, dtype=torch.float64).requires_grad_()

    def roll() -> torch.Tensor:
        # unbound once: indexing step by step would make the backward pass quadratic in time
        gaps, closings = gap.unbind(0), closing.unbind(0)
        return rolled(values, speed0, lambda k, x, v: (gaps[k], closings[k]), dt, steps)

    # the sum over tracks of each track's mean error: tracks do not share anything
    def loss() -> torch.Tensor:
        return (roll()[at] - data).abs().mean(0).sum()

    bounds = [between, limits(paper.GAP_BOUNDS), limits(paper.CLOSING_BOUNDS)]
    descended([values, gap, closing], loss, bounds, iterations)
    with torch.no_grad():
        return roll(), values.detach(), gap.detach()


def behind(
    position: np.ndarray, speed0: float, rear: np.ndarray, pace: np.ndarray, dt: float, iterations: int
) -> np.ndarray:
    """Return the five values fitted to positions [K] behind a real leader."""
    values, between = five(1)
    data, start = torch.as_tensor(position - position[0]), torch.tensor([speed0], dtype=torch.float64)
    ends, paces = torch.as_tensor(rear - position[0]), torch.as_tensor(pace)

    def ahead(k: int, x: torch.Tensor, v: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return (ends[k] - x).clamp_min(paper.NEAREST_M), v - paces[k]

    def loss() -> torch.Tensor:
        return (rolled(values, start, ahead, dt, len(data))[:, 0] - data).abs().mean()

    descended([values], loss, [between], iterations)
    return values.detach()[0].numpy()
