"""Outflow of two lanes and a ramp over demand, with and without drivers who let others in.

``python -m benchmarks.lanes merge``: the road of task ``merge`` (a ramp from 400 to 600 m of 900 m), IDM with noise of
0.2 m/s² at every step of 0.2 s (0.45 m/s² per √s), vehicles that come at random, 4 seeds each. A fifth of the demand is
on the ramp. Demand is held for 20 minutes; outflow is counted in the last ten.
"""

from __future__ import annotations

from pathlib import Path

import torch

from idm_env import keep, population
from idm_env import report as page
from idm_env.effects import IDM, Brakes, Courtesy, MandatoryChange, Mobil, Noise
from idm_env.simulator import Simulator
from idm_env.tasks import MergeTask
from idm_env.types import Trips

DEMANDS = (2400.0, 2800.0, 3200.0, 3400.0, 3600.0, 3800.0, 4000.0, 4400.0, 4800.0)
DRIVER = {"max_accel": 1.5, "comfort_decel": 2.0, "time_gap": 1.2, "min_gap": 2.0, "desired_speed": 30.0}
DT, SEEDS, RAMP, SLOTS = 0.2, 4, 0.2, 250


def outflows(courteous: bool, minutes: int = 20) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return outflow (vehicles/h) in each minute, mean speed at the end of each (m/s), and queues: by demand, seed."""
    effects = (IDM(), Noise(), Mobil(), MandatoryChange(), *([Courtesy()] if courteous else []), Brakes())
    simulator = Simulator(MergeTask().road, effects, dt=DT)
    draw = torch.Generator().manual_seed(1)
    each = [at_random(demand, draw) for demand in DEMANDS for _ in range(SEEDS)]
    given = Trips(*(torch.stack(column) for column in zip(*each, strict=True)))
    params = simulator.defaults(dtype=torch.float32)
    params["idm"].update({name: torch.tensor(value) for name, value in DRIVER.items()})
    params["noise"]["sigma"] = torch.tensor(0.2)
    state = population.waiting(simulator, given, params)
    left, speed = [], []
    for minute in range(minutes):
        before = state
        state, _ = simulator.rollout(state, {}, params, round(60.0 / DT), keep=None, seed=minute)
        assert before.trips is not None and state.trips is not None and state.present is not None
        left.append(60.0 * (state.trips.left - before.trips.left).sum(-1).double())
        speed.append((state.speed * state.present).sum(-1) / state.present.sum(-1).clamp_min(1.0))
    queued = population.counts(simulator, state).queued
    shape = (len(DEMANDS), SEEDS)
    return (
        torch.stack(left, -1).view(*shape, minutes),
        torch.stack(speed, -1).double().view(*shape, minutes),
        queued.view(shape),
    )


def at_random(demand: float, draw: torch.Generator) -> Trips:
    """Return trips that come at random: between two on a lane there are exponentially distributed times."""
    lanes = {0: RAMP * demand, 1: 0.5 * (1.0 - RAMP) * demand, 2: 0.5 * (1.0 - RAMP) * demand}
    even = population.trips(lanes, 3600.0, speed=20.0, slots=SLOTS)
    departs = even.departs.clone()
    for lane in lanes:
        mine = even.lane == lane
        gaps = torch.empty(int(mine.sum())).exponential_(generator=draw)
        departs[mine] = gaps.cumsum(0) / gaps.sum() * even.again[mine]
    return even._replace(departs=departs)


def table(path: Path = Path("out/lanes-merge.png")) -> None:
    """Print outflow and speed over demand, and draw outflow."""
    figure, axes = page.figure(1, 1, size=(5.4, 3.6))
    axes[0, 0].plot(DEMANDS, DEMANDS, "--", color="#9aa0a8", label="all that want to")
    rows = [[f"| {demand:.0f}"] for demand in DEMANDS]
    for courteous, colour, label in ((False, "#d1495b", "nobody lets in"), (True, "#1e5adc", "Courtesy")):
        left, speed, queued = outflows(courteous)
        late = left[..., 10:].mean(-1)
        for k, row in enumerate(rows):
            error = float(late[k].std()) / SEEDS**0.5
            pace, waits = float(speed[k, :, 10:].mean()), float(queued[k].double().mean())
            row.append(f"{float(late[k].mean()):.0f} ± {error:.0f}, {pace:.1f}, {waits:.0f}")
        axes[0, 0].plot(DEMANDS, late.numpy(), "o", ms=3, color=colour, alpha=0.5)
        axes[0, 0].plot(DEMANDS, late.mean(-1).numpy(), "-", color=colour, label=label)
    print("| demand, veh/h | nobody lets in: out (veh/h), speed (m/s), queued | Courtesy |")
    print("| --- | --- | --- |")
    for row in rows:
        print(" | ".join(row) + " |")
    axes[0, 0].set(xlabel="demand (vehicles/h)", ylabel="outflow (vehicles/h)")
    axes[0, 0].legend(frameon=False, fontsize=8)
    axes[0, 0].grid(alpha=0.25)
    path.parent.mkdir(parents=True, exist_ok=True)
    keep.write(path, lambda beside: figure.savefig(beside, dpi=110))
    print(f"Picture: {path}")
