"""The published recipe written directly with the published layer, torch autograd and torch's Adam: the reference."""

from __future__ import annotations

import numpy as np
import torch
from diffidm import IDMLayer

from idm_env.trajectories import paper
from idm_env.trajectories.recipe import clock_of
from idm_env.trajectories.tracks import Track


def direct(tracks: list[Track], dt: float, iterations: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return positions [K, N] relative to the first point, values [N, 5] and imagined gaps [K, N] of equal tracks."""
    clock = clock_of(tracks[0], dt)
    count, steps = len(tracks), len(clock)
    at = torch.as_tensor(np.round((tracks[0].time_s - clock[0]) / dt).astype(int))
    data = torch.as_tensor(np.stack([t.position_m - t.position_m[0] for t in tracks], axis=1))
    speed0 = (data[1] / (tracks[0].time_s[1] - tracks[0].time_s[0])).clamp_min(0.0)
    low, high = torch.as_tensor(paper.LOW), torch.as_tensor(paper.HIGH)
    values = torch.as_tensor(paper.START).repeat(count, 1).requires_grad_()
    gap = torch.full((steps, count), 10.0, dtype=torch.float64).requires_grad_()
    closing = torch.zeros(steps, count, dtype=torch.float64).requires_grad_()
    optimiser = torch.optim.Adam([values, gap, closing], lr=paper.RATES[0])
    schedule = torch.optim.lr_scheduler.LinearLR(optimiser, 1.0, paper.RATES[1] / paper.RATES[0], iterations)
    floor = torch.tensor(-paper.MAX_DECEL, dtype=torch.float64)

    def roll() -> torch.Tensor:
        x, v = torch.zeros(count, dtype=torch.float64), speed0
        kept = []
        # unbound once: indexing step by step would make the backward pass quadratic in time
        gaps, closings = gap.unbind(0), closing.unbind(0)
        for k in range(steps):
            kept.append(x)
            a = IDMLayer.apply(
                values[:, 0], floor, values[:, 1], v, values[:, 4], gaps[k], closings[k], values[:, 3], values[:, 2],
                torch.tensor(dt),
            )  # fmt: skip
            x, v = x + v * dt, v + a * dt
        return torch.stack(kept)

    for _ in range(iterations):
        optimiser.zero_grad()
        # the sum over tracks of each track's mean error: tracks do not share anything
        (roll()[at] - data).abs().mean(0).sum().backward()
        optimiser.step()
        schedule.step()
        with torch.no_grad():
            values.copy_(torch.minimum(torch.maximum(values, low), high))
            gap.clamp_(*paper.GAP_BOUNDS)
            closing.clamp_(*paper.CLOSING_BOUNDS)
    with torch.no_grad():
        return roll(), values.detach(), gap.detach()
