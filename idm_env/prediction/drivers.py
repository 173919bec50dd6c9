"""Drivers on routes: prior, likelihood of one second of history, and rollouts of eight seconds, all by the simulator.

One second barely identifies five parameters. So drivers are drawn from a prior of urban driving and weighted by how
well they drive the history; what the second does not tell stays as spread in the futures.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from scipy.stats import norm, qmc
from torch import Tensor

from idm_env.effects import IDM, Brakes, Replay
from idm_env.prediction.lanes import Route
from idm_env.roads import Lane as Road
from idm_env.simulator import Simulator
from idm_env.types import Record

DRAWS = 128
DT = 0.1
URBAN_LIMIT = 13.4
"""Speed limit where the map tells none (m/s): 30 miles per hour."""
STOPPING = 0.25
"""Share of drivers who are about to stop for something that is not on the map (a signal, a crossing, a turn)."""
CRUISING = 0.25
"""Share of drivers who already go at the speed that they want."""
SPEED_SIGMA = 0.4
"""How far an observed speed may be from a driver's (m/s): tracking noise, and driving that IDM does not have."""
INDEPENDENT = 3.0
"""One second of correlated residuals is worth this many independent ones."""
FAR_AWAY_M = 500.0


@dataclass(frozen=True, eq=False)
class Drivers:
    """Drivers [N]: IDM's five, lateral acceleration accepted in bends (m/s²), distance to a stop (m, inf for none).

    ``passing`` in [0, 1] decides who goes around a standing vehicle: those below the share that does.
    """

    max_accel: np.ndarray
    comfort_decel: np.ndarray
    time_gap: np.ndarray
    min_gap: np.ndarray
    desired_speed: np.ndarray
    lateral: np.ndarray
    stop: np.ndarray
    passing: np.ndarray


@lru_cache(maxsize=1)
def _quantiles() -> np.ndarray:
    """Return evenly spread points [DRAWS, 10] of the unit cube, the same at every call."""
    return np.asarray(qmc.Sobol(10, seed=0).random(DRAWS))


def prior(speed: float, limit: float) -> Drivers:
    """Return drivers of urban traffic; medians a 1.6, b 2 m/s², T 1.3 s, s0 2 m, v0 the limit ± 20 %, bends 2.5 m/s².

    Some want the speed that they have; some stop, at the earliest where 3.5 m/s² suffices and at most 60 m ahead.
    """
    u = _quantiles()

    def lognormal(column: int, median: float, spread: float) -> np.ndarray:
        return np.asarray(median * np.exp(spread * norm.ppf(np.clip(u[:, column], 1e-3, 1 - 1e-3))))

    limit = limit if np.isfinite(limit) else URBAN_LIMIT
    wanted = lognormal(4, limit, 0.2)
    wanted = np.where(u[:, 7] < CRUISING, np.maximum(speed, 0.5) * (0.9 + 0.2 * u[:, 8]), wanted)
    nearest = speed * speed / (2 * 3.5) + 2.0
    stop = np.where(u[:, 7] > 1.0 - STOPPING, nearest + u[:, 6] * max(60.0 - nearest, 10.0), np.inf)
    return Drivers(
        lognormal(0, 1.6, 0.4), lognormal(1, 2.0, 0.3), lognormal(2, 1.3, 0.3), lognormal(3, 2.0, 0.3), wanted,
        lognormal(5, 2.5, 0.4), stop, u[:, 9],
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Ahead:
    """The vehicle ahead on a route: rear bumper (m of arc length) and speed (m/s) per step [S + 1].

    ``passed`` is the share of drivers who go around it, which only standing vehicles are.
    """

    rear: np.ndarray
    speed: np.ndarray
    passed: float = 0.0


def passing(lateral: float) -> float:
    """Return the share of drivers who go around a standing vehicle: 0.2 in the middle of the lane, 0.9 from 1.2 m on.

    Whether it waits or is parked is not known; the farther from the middle, the likelier it is parked.
    """
    return float(np.interp(abs(lateral), [0.4, 1.2], [0.2, 0.9]))


def nobody(steps: int) -> Ahead:
    """Return what stands for an empty road ahead: something that is far away and keeps away."""
    return Ahead(np.full(steps + 1, 1e5), np.full(steps + 1, 30.0))


def bend_speed(route: Route, lateral: np.ndarray, comfort: np.ndarray) -> np.ndarray:
    """Return the speed [N, M] from which every bend ahead can be taken: √(v_bend² + 2 b d), at every metre (m/s)."""
    bend = np.sqrt(lateral[:, None] / np.maximum(np.abs(route.curvature), 1e-4))
    step = float(route.length[1] - route.length[0])
    speed = np.minimum(bend, 60.0)
    for k in range(speed.shape[1] - 2, -1, -1):
        speed[:, k] = np.minimum(speed[:, k], np.sqrt(speed[:, k + 1] ** 2 + 2 * comfort * step))
    return speed


def roll(route: Route, drivers: Drivers, start: float, speed: float, ahead: Ahead, steps: int, front: float) -> Tensor:
    """Drive all drivers [N] from arc length ``start`` (m, centre) and ``speed``; return arc length and speed [2, S, N].

    ``front`` (m) is from the centre to the front bumper. Speeds wanted fall before bends; the leader, or a stop if it
    is nearer, is replayed.
    """
    count = len(drivers.stop)
    sim = Simulator(Road(), (IDM(), Replay(), Brakes()), dt=DT)
    params = sim.defaults(dtype=torch.float64)
    names = ("max_accel", "comfort_decel", "time_gap", "min_gap")
    idm = {name: torch.as_tensor(getattr(drivers, name))[:, None] for name in names}
    stop = (start + front + drivers.stop)[None, :]
    empty = nobody(steps)
    passes = (drivers.passing < ahead.passed)[None, :]
    rear_ahead = np.where(passes, empty.rear[:, None], ahead.rear[:, None])
    nearer = stop < rear_ahead
    rear = torch.as_tensor(np.where(nearer, stop, rear_ahead))
    speed_ahead = np.where(passes, empty.speed[:, None], ahead.speed[:, None])
    lead_speed = torch.as_tensor(np.where(nearer, 0.0, speed_ahead))
    limits = torch.as_tensor(bend_speed(route, drivers.lateral, drivers.comfort_decel))
    wanted = torch.as_tensor(drivers.desired_speed)
    # an overlap at the start is taken as bumper to bumper
    own = torch.minimum(torch.full((count,), start + front, dtype=torch.float64), rear[0] - 0.2)
    shift = start + front - own
    state = sim.state(
        torch.stack([rear[0], own], dim=-1), torch.stack([lead_speed[0], torch.full_like(own, speed)], dim=-1),
        params | {"idm": {**params["idm"], **idm}}, length=torch.tensor([0.0, 2 * front], dtype=torch.float64),
    )  # fmt: skip
    active = torch.tensor([True, False]).expand(count, 2)
    spacing = float(route.length[1] - route.length[0])
    kept = torch.empty(2, steps, count, dtype=torch.float64)
    rows = torch.arange(count)
    with torch.no_grad():
        for k in range(steps):
            at = ((state.position[:, 1] - front) / spacing).round().long().clamp(0, limits.shape[1] - 1)
            now = state.speed[:, 1]
            # IDM brakes without measure above its desired speed: there it is kept to comfortable braking
            gentle = now / (1.0 + idm["comfort_decel"][:, 0] / idm["max_accel"][:, 0]) ** 0.25
            target = torch.maximum(torch.minimum(wanted, limits[rows, at]), gentle).clamp_min(0.5)
            step_params = params | {"idm": {**idm, "desired_speed": target[:, None]}}
            place = torch.stack([rear[k + 1], torch.zeros_like(own)], dim=-1)
            pace = torch.stack([lead_speed[k + 1], torch.zeros_like(own)], dim=-1)
            record = Record(place, pace, torch.zeros_like(pace), active)
            state = sim.step(state, {"replay": record}, step_params)
            kept[0, k], kept[1, k] = state.position[:, 1] - front + shift, state.speed[:, 1]
    return kept


def likelihood(simulated: np.ndarray, observed: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Return log-likelihoods [N] of observed speeds [S] under simulated ones [S, N]."""
    if not valid.any():
        return np.zeros(simulated.shape[1])
    square = ((simulated[valid] - observed[valid, None]) / SPEED_SIGMA) ** 2
    return np.asarray(-0.5 * INDEPENDENT * square.mean(0))
