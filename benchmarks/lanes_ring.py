"""Traffic for benchmarks: rings of four lanes, desired speeds that differ, MOBIL once a second."""

from __future__ import annotations

from typing import Any

import torch

from idm_env.effects import IDM, Brakes, Mobil
from idm_env.roads import Lanes
from idm_env.simulator import Simulator
from idm_env.types import State

LANES, EACH, DT = 4, 1000, 0.1
DRIVER = {"max_accel": 1.4, "comfort_decel": 2.0, "time_gap": 1.5, "min_gap": 2.0}


def traffic(rows: int, per_km: float, dtype: torch.dtype, each: int = EACH) -> tuple[Simulator, State, Any]:
    """Return rings of ``each`` vehicles in the order of the road, and their parameters."""
    ring = each / LANES / per_km * 1000.0
    simulator = Simulator(Lanes(LANES, ring=ring), (IDM(), Mobil(), Brakes()), dt=DT)
    generator = torch.Generator().manual_seed(1)
    params = simulator.defaults(dtype=dtype)
    params["idm"].update({name: torch.tensor(value, dtype=dtype) for name, value in DRIVER.items()})
    params["idm"]["desired_speed"] = (25.0 + 10.0 * torch.rand((rows, each), generator=generator)).to(dtype)
    index = torch.arange(each)
    spacing = ring * LANES / each
    # Uneven gaps: evenly spaced traffic sees no lane that is better than its own.
    shift = 0.4 * spacing * torch.rand((rows, each), generator=generator)
    position = (shift - torch.div(index, LANES, rounding_mode="floor") * spacing).to(dtype)
    pace = torch.full_like(position, min(20.0, 0.5 * (1000.0 / per_km - 7.0)))
    return simulator, simulator.state(position, pace, params, lane=index % LANES), params


def changes(state: State) -> int:
    """Return how often lanes have been changed so far."""
    assert state.links is not None
    return int(state.links.changed.sum())
