"""The imagined leader: which gap makes a driver do what a trajectory shows, and the simulator driven by it.

IDM's acceleration falls strictly with 1/s², so at given parameters, speed and closing speed one gap belongs to every
acceleration below ``a [1 − (v/v0)⁴]``. Fitting accelerations or imagined gaps is therefore the same problem, and what
comes out is always the simulator's own rollout, whose bounds are exact.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from idm_env.effects import IDM, Brakes, ImaginedLeader
from idm_env.effects.idm import free_accel, gap_for
from idm_env.roads import Lane
from idm_env.simulator import Simulator
from idm_env.types import Driver, Imagined

CAPABLE = {"max_accel": 5.0, "comfort_decel": 2.0, "time_gap": 1.5, "min_gap": 2.0, "desired_speed": 70.0}
"""The vehicle whose imagined leader is sought: its free acceleration and top speed are what no car exceeds."""
FLOOR_WIDTH = 0.1
"""Accelerations stay this far above the brakes' floor, where it is exactly the identity (m/s²)."""

CATCH_UP = (0.25, 1.0)
"""Acceleration per metre (1/s²) and per m/s (1/s) that a vehicle is behind its wanted motion: critical, in 2 s."""
HURRY_MPS2 = 1.0
"""No catching up is faster than this (m/s²)."""


def simulator(dt: float) -> Simulator:
    """Return IDM behind an imagined leader, with exact brakes, in ballistic steps of ``dt`` (s)."""
    return Simulator(Lane(), (IDM(), ImaginedLeader(), Brakes(width=FLOOR_WIDTH)), dt=dt)


@dataclass(frozen=True, eq=False)
class Driven:
    """The simulator's motion, per track: position (m), speed (m/s), acceleration (m/s²), imagined gap (m), each [K].

    The acceleration of the last step is that which would follow.
    """

    position: np.ndarray
    speed: np.ndarray
    accel: np.ndarray
    gap: np.ndarray


def drive(
    motions: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]], dt: float, highest: float, lowest: float
) -> list[Driven]:
    """Drive every track through the simulator by the imagined gaps that its wanted motion asks for.

    ``motions`` are positions (m), speeds (m/s) and accelerations (m/s²), each [K], of ballistic steps. A gap is found
    at the speed that the simulator has at that step, so nothing but the bounds changes an acceleration: it never
    exceeds ``highest`` nor what the engine gives at that speed, never falls below ``lowest``, and the vehicle never
    reverses. Where a bound did change it, the lost distance is made up gently (``CATCH_UP``).
    """
    sim = simulator(dt)
    steps = max(len(a) for _, _, a in motions)
    goal = torch.zeros(3, steps, len(motions), 1, dtype=torch.float64)
    for i, columns in enumerate(motions):
        for c, values in enumerate(columns):
            goal[c, : len(values), i, 0] = torch.as_tensor(values)
    params = sim.defaults(dtype=torch.float64)
    params["idm"] = {name: torch.tensor(value, dtype=torch.float64) for name, value in CAPABLE.items()}
    params["brakes"]["max_decel"] = torch.tensor(-lowest + FLOOR_WIDTH, dtype=torch.float64)
    driver = Driver(**params["idm"])
    origin = goal[0, 0].clone()
    goal[0] -= origin
    state = sim.state(torch.zeros_like(origin), goal[1, 0].clamp_min(0.0), params)
    still = torch.zeros_like(origin)
    driven = torch.empty(4, steps, len(motions), dtype=torch.float64)
    with torch.no_grad():
        for k in range(steps):
            behind = CATCH_UP[0] * (goal[0, k] - state.position) + CATCH_UP[1] * (goal[1, k] - state.speed)
            engine = free_accel(driver, state.speed) - 1e-6
            accel = goal[2, k] + behind.clamp(-HURRY_MPS2, HURRY_MPS2)
            accel = torch.minimum(accel.clamp(lowest, highest), engine)
            gap = gap_for(accel, state.speed, still, driver)
            driven[0, k], driven[1, k], driven[3, k] = (x[:, 0] for x in (state.position + origin, state.speed, gap))
            state = sim.step(state, {"imagined": Imagined(gap, still)}, params)
            driven[2, k] = state.accel[:, 0]
    arrays = driven.numpy()
    return [Driven(*(column[: len(a), i].copy() for column in arrays)) for i, (_, _, a) in enumerate(motions)]
