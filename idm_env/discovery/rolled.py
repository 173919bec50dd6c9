"""Rollouts of a model among its own kind, before it is written: a platoon whose leader brakes, and a ring."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from idm_env.effects import Replay
from idm_env.effects.idm import equilibrium_gap
from idm_env.model_file import Model
from idm_env.roads import Lane, Ring
from idm_env.types import Record

FOLLOWERS, VEHICLE_M = 50, 5.0
CALM_S, BRAKING, BRAKES_S, PLATOON_S, RING_S = 60.0, 2.0, 3.0, 240.0, 120.0
"""Seconds before the leader brakes; his deceleration (m/s²) and its seconds; lengths of both scenes (s)."""


@dataclass(frozen=True)
class Rolled:
    """Collisions and waves of a model.

    ``amplification`` is how many times as much the speed of the last follower varies as that of the first,
    ``crashed`` the number of followers that touch their leader, ``ring_s`` the time (s) at which vehicles touch on a
    ring, None where they do not, ``wave_mps`` the standard deviation of speeds on the ring at its end.
    """

    amplification: float
    crashed: int
    ring_s: float | None
    wave_mps: float


def roll(model: Model, speed: float) -> Rolled | None:
    """Return waves and collisions of ``FOLLOWERS`` drivers at a speed (m/s); None if effects take measured inputs.

    They begin in IDM's equilibrium with their own parameters, the drivers of the model over and over. The leader keeps
    his speed, brakes, and is as fast again as soon. On the ring they begin standing, at the mean of these gaps, the
    first at half of it.
    """
    if any(e.takes is not None for e in model.effects):
        return None
    names: list[str | None] = [*model.drivers] or [None]
    each = [model.params(names[i % len(names)], dtype=torch.float64) for i in range(FOLLOWERS)]
    params = {e: {n: torch.stack([one[e][n] for one in each]) for n in values} for e, values in each[0].items()}
    lane = model.simulator(Lane()).adding(Replay())
    gaps = equilibrium_gap(lane.base.driver(params[lane.base.name]), torch.tensor(speed, dtype=torch.float64))
    platoon: dict[str, dict[str, Tensor]] = {"replay": {}}
    platoon |= {e: {n: torch.cat((x[:1], x)) for n, x in values.items()} for e, values in params.items()}
    record = _braking(speed, model.dt)
    place = -torch.cat((torch.zeros(1, dtype=torch.float64), (gaps + VEHICLE_M).cumsum(0)))
    begin = lane.state(place, torch.full_like(place, speed), platoon, length=VEHICLE_M, seed=0)
    _, lane_motion = lane.rollout(begin, {"replay": record}, platoon, len(record.speed), seed=0)
    ring, mean = model.simulator(Ring()), float(gaps.mean()) + VEHICLE_M
    place = -mean * torch.arange(FOLLOWERS, dtype=torch.float64)
    place[0] += 0.5 * (mean - VEHICLE_M)
    around = torch.tensor(FOLLOWERS * mean, dtype=torch.float64)
    begin = ring.state(place, torch.zeros_like(place), params, length=VEHICLE_M, circumference=around, seed=0)
    _, motion = ring.rollout(begin, {}, params, round(RING_S / model.dt), seed=0)
    touched = (motion.gap <= 0.0).any(-1).nonzero()
    spread = lane_motion.speed[round(CALM_S / model.dt) :, 1:].std(0, correction=0)
    ring_s = float(touched[0] + 1) * model.dt if len(touched) else None
    crashed = int((lane_motion.gap[:, 1:] <= 0.0).any(0).sum())
    return Rolled(float(spread[-1] / spread[0]), crashed, ring_s, float(motion.speed[-1].std(correction=0)))


def _braking(speed: float, dt: float) -> Record:
    """Return the record of a platoon in which the first vehicle brakes, each (steps, 1 + FOLLOWERS)."""
    time, lasts = dt * np.arange(1, round(PLATOON_S / dt) + 1), min(BRAKES_S, speed / BRAKING)
    corners = CALM_S + lasts * np.arange(3.0)
    its = torch.from_numpy(np.interp(time, corners, [speed, speed - BRAKING * lasts, speed]))
    accel = torch.diff(its, prepend=its[:1]) / dt
    columns = [x[:, None].expand(-1, 1 + FOLLOWERS) for x in (its.cumsum(0) * dt, its, accel)]
    first: Tensor = (torch.arange(1 + FOLLOWERS) == 0).expand_as(columns[0])
    return Record(columns[0], columns[1], columns[2], first)
