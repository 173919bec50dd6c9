"""Lane changes on an open road with trucks, beside SUMO's LC2013: ``python -m benchmarks.lanes_open``.

Three lanes of 3 km, a fifth of trucks (12 m, 22 to 24 m/s), cars of 27 to 36 m/s, the same departures and drivers in
both. Of 15 minutes the last ten and of the road the middle 2 km count: vehicles per km and lane, changes an hour and km
of road, mean speed. Ours has MOBIL as it comes, and with a bias to the right of 0.2 m/s² (``keep_right``).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from rich.console import Console
from rich.table import Table

from benchmarks import command
from benchmarks.bench.peers import started, straight
from benchmarks.lanes import DRIVER, DT, vehicle_type
from idm_env.effects import IDM, Brakes, Mobil
from idm_env.multilane import demand
from idm_env.roads import Lanes
from idm_env.simulator import Simulator
from idm_env.tasks import trip_table
from idm_env.types import Trips

LANES, LENGTH, FIRST, LAST = 3, 3000.0, 500.0, 2500.0
SECONDS, COUNTED = 900.0, 600.0
FLOWS = (300.0, 700.0, 1100.0, 1500.0)
"""Vehicles an hour and lane."""
TRUCK = 12.0


class Found(NamedTuple):
    """Vehicles per km and lane, changes an hour and km of road, mean speed (m/s)."""

    density: float
    changes: float
    speed: float


def drivers(flow: float) -> tuple[trip_table.TripTable, list[float]]:
    """Return departures and desired speeds (m/s)."""
    columns = trip_table.table(dict.fromkeys(range(LANES), flow), SECONDS, seed=1, speed=22.0, classes={"truck": 0.2})
    table = trip_table.read(columns)
    share = torch.rand(len(table.kind), generator=torch.Generator().manual_seed(2)).tolist()
    return table, [22.0 + 2.0 * x if kind else 27.0 + 9.0 * x for kind, x in zip(table.kind, share, strict=True)]


def ours(flow: float, keep_right: float) -> Found:
    """Return what our road does."""
    table, desired = drivers(flow)
    simulator = Simulator(Lanes(LANES, length=LENGTH), (IDM(), Mobil(), Brakes()), dt=DT)
    params: Any = simulator.defaults()
    params["idm"].update({name: torch.tensor(value) for name, value in DRIVER.items()})
    params["idm"]["desired_speed"] = torch.tensor(desired)
    params["mobil"]["keep_right"] = torch.tensor(keep_right)
    lengths = torch.tensor([TRUCK if kind else 5.0 for kind in table.kind])
    state = demand.waiting(simulator, Trips.from_table(table._asdict()), params, length=lengths)
    counted, count, way = 0, 0, 0.0
    for second in range(int(SECONDS)):
        before, (state, _) = state, simulator.rollout(state, {}, params, round(1.0 / DT), keep=None)
        assert state.lanes is not None and before.lanes is not None and state.present is not None
        inside = (state.present > 0) & (state.position > FIRST) & (state.position < LAST)
        if second >= SECONDS - COUNTED:
            counted += int((inside & (state.lanes.changed > before.lanes.changed)).sum())
            count, way = count + int(inside.sum()), way + float(state.speed[inside].sum())
    return found(counted, count, way)


def found(counted: int, there: int, way: float) -> Found:
    """Return rates from counts of seconds."""
    km = 1e-3 * (LAST - FIRST)
    return Found(there / COUNTED / km / LANES, counted / km / COUNTED * 3600.0, way / max(there, 1))


def sumo(flow: float) -> Found | None:
    """Return what SUMO does with the same departures; None where it is missing."""
    table, desired = drivers(flow)
    parts = ['<route id="r" edges="ab"/>']
    for i, (depart, lane, speed, kind) in enumerate(
        zip(table.depart, table.lane, table.speed, table.kind, strict=True)
    ):
        parts.append(
            vehicle_type(i, desired[i], TRUCK if kind else 5.0)
            + f'<vehicle id="v{i}" type="t{i}" route="r" depart="{depart:.2f}" departLane="{lane}" '
            f'departSpeed="{speed}"/>'
        )
    net = straight(LENGTH, 60.0, lanes=LANES)
    counted, count, way, before = 0, 0, 0.0, dict[str, int]()
    with started(net, f"<routes>{''.join(parts)}</routes>", "--step-method.ballistic") as libsumo:
        if libsumo is None:
            return None
        for second in range(int(SECONDS)):
            for _ in range(round(1.0 / DT)):
                libsumo.simulationStep()
            now = {}
            for name in libsumo.vehicle.getIDList():
                now[name] = libsumo.vehicle.getLaneIndex(name)
                inside = FIRST < libsumo.vehicle.getLanePosition(name) < LAST
                if inside and second >= SECONDS - COUNTED:
                    counted += before.get(name, now[name]) != now[name]
                    count, way = count + 1, way + libsumo.vehicle.getSpeed(name)
            before = now
    return found(counted, count, way)


def main() -> None:
    """Print the table."""
    torch.set_num_threads(1)
    table = Table(title="changes an hour and km, vehicles per km and lane, mean speed (m/s)")
    for head in ("vehicles an hour and lane", "ours", "ours, keep right 0.2", "SUMO LC2013"):
        table.add_column(head)
    for flow in FLOWS:
        rows = ours(flow, 0.0), ours(flow, 0.2), sumo(flow)
        cells = ["not installed" if x is None else f"{x.changes:.0f}, {x.density:.1f}, {x.speed:.1f}" for x in rows]
        table.add_row(f"{flow:.0f}", *cells)
    Console(width=140).print(table)


if __name__ == "__main__":
    command(main)
