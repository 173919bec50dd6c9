"""Traffic on networks, beside SUMO: ``python -m benchmarks.networks travel``, ``saturation`` or ``control``.

The same network, vehicles, routes, departures and IDM in both, 0.1 s, ballistic, nobody is teleported. SUMO's tools:
``pip install eclipse-sumo libsumo``. A travel time is from when a vehicle is due to when it has left: what it waits at
its entry is in it. Machine and date stand above each table.
"""

from __future__ import annotations

import subprocess
import tempfile
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from benchmarks import command, table
from benchmarks.bench.measure import machine
from benchmarks.bench.peers import started
from benchmarks.lanes import DRIVER, DT, vehicle_type
from idm_env.effects import IDM, Brakes
from idm_env.effects.network_rules import LinkLimit, StopLine
from idm_env.multilane import junctions
from idm_env.roads.network import Network, padded
from idm_env.roads.network_demand import Demand
from idm_env.roads.ways import Ways
from idm_env.simulator import Simulator

TOP = 33.0
"""Desired speed where no limit is below it (m/s)."""
GRID = "--grid --grid.number 5 --grid.length 200 --grid.attach-length 200 -j traffic_light -L 1 --no-turnarounds"
RANDOM = "--rand --rand.iterations 40 -L 1 --no-turnarounds --tls.guess --tls.guess.threshold 20 --seed {seed}"
SECONDS = 900.0
LATEST = 3 * SECONDS
"""Whoever has not left by then is counted until then (s)."""


class Trips(NamedTuple):
    """Travel times of all vehicles (s), and how many of them have arrived."""

    seconds: np.ndarray
    arrived: int


def generated(words: str) -> str:
    """Return the network that netgenerate makes; ModuleNotFoundError says how to install it."""
    try:
        home = Path(import_module("sumo").SUMO_HOME)
    except ModuleNotFoundError:
        raise ModuleNotFoundError("SUMO is not installed: pip install eclipse-sumo libsumo") from None
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder, "my.net.xml")
        tool = [str(home / "bin" / "netgenerate"), *words.split(), "-o", str(out)]
        subprocess.run(tool, check=True, capture_output=True)
        return out.read_text()


def network_of(text: str) -> Network:
    """Return the network of a file's text."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "my.net.xml")
        path.write_text(text)
        return Network.from_sumo(path)


def routes_xml(network: Network, demand: Demand) -> str:
    """Return a demand as SUMO's vehicles of one type, at the limit when they enter."""
    rows = []
    for i, (route, depart) in enumerate(zip(demand.route, demand.depart, strict=True)):
        links = [network.edge[k] for k in demand.routes[route] if k >= 0 and not network.inner[k]]
        edges = " ".join(edge for edge, before in zip(links, ["", *links], strict=False) if edge != before)
        rows.append(
            f'<vehicle id="{i}" type="t0" depart="{depart:.2f}" departSpeed="max" departPos="0" departLane="best">'
            f'<route edges="{edges}"/></vehicle>'
        )
    return f"<routes>{vehicle_type(0, TOP)}{''.join(rows)}</routes>"


def simulator(network: Network, **rules: float) -> tuple[Simulator, Any]:
    """Return our simulator, and its parameters: at amber SUMO's drivers stop where their own b is enough."""
    rules = {"most_decel": DRIVER["comfort_decel"], **rules}
    cars = Simulator(network, (IDM(), StopLine(**rules), LinkLimit(), Brakes()), dt=DT)
    params: Any = cars.defaults()
    numbers = {**DRIVER, "desired_speed": TOP}
    params["idm"].update({name: torch.tensor(value) for name, value in numbers.items()})
    return cars, params


class MaxPressure:
    """Signals that serve the phase with the most vehicles before its moves less those behind them (Varaiya 2013).

    Asked every second; a green lasts ``least`` (s) at least, and between two there is the plan's amber.
    """

    def __init__(self, network: Network, least: float) -> None:
        self.network, self.least = network, least
        self.phase = [0] * len(network.plans)
        self.since = [0.0] * len(network.plans)

    def phases(self, vehicles: np.ndarray, now: float) -> list[int]:
        """Return the phase of every signal, by the vehicles on each link ``(links,)``."""
        for s, plan in enumerate(self.network.plans):
            moves = np.flatnonzero(self.network.signal == s)
            pressure = vehicles[self.network.start[moves]] - vehicles[self.network.end[moves]]
            opens = [np.array([state[self.network.index[m]] in "Gg" for m in moves]) for state in plan.states]
            best = int(np.argmax([pressure[x].sum() if x.any() else -np.inf for x in opens]))
            p, lasted = self.phase[s], now - self.since[s]
            if (opens[p].any() and lasted >= self.least and best != p) or (
                not opens[p].any() and lasted >= plan.durations[p]
            ):
                self.phase[s], self.since[s] = (p + 1) % len(plan.states), now
        return self.phase


def ours(network: Network, demand: Demand, control: MaxPressure | None = None) -> Trips:
    """Return the travel times of our vehicles; signals have their plans, or are controlled."""
    cars, params = simulator(network)
    state = junctions.travelling(cars, demand, params)
    every = 60.0 if control is None else 1.0
    for k in range(round(LATEST / every)):
        if control is not None:
            vehicles = junctions.by_link(network, state).vehicles.numpy()
            state = junctions.showing(state, torch.tensor(control.phases(vehicles, k * every)))
        state, _ = cars.rollout(state, {}, params, round(every / DT), keep=None)
        arrived = int(junctions.counts(state).left)
        if arrived == len(demand.route):
            break
    return Trips(junctions.travel_time(cars, state).double().numpy(), arrived)


def sumos(text: str, network: Network, demand: Demand, control: MaxPressure | None = None) -> Trips:
    """Return the travel times of SUMO's vehicles."""
    seconds = LATEST - demand.depart
    arrived, links = 0, [k for k in range(len(network.names)) if not network.inner[k]]
    vehicles = np.zeros(len(network.names))
    with started(text, routes_xml(network, demand), "--step-method.ballistic", "--collision.action", "none") as libsumo:
        for step in range(round(LATEST / DT)):
            if control is not None and step % 10 == 0:
                vehicles[links] = [libsumo.lane.getLastStepVehicleNumber(network.names[k]) for k in links]
                for plan, phase in zip(network.plans, control.phases(vehicles, step * DT), strict=True):
                    libsumo.trafficlight.setRedYellowGreenState(plan.name, plan.states[phase])
            libsumo.simulationStep()
            for name in libsumo.simulation.getArrivedIDList():
                seconds[int(name)] = (step + 1) * DT - demand.depart[int(name)]
                arrived += 1
            if arrived == len(seconds):
                break
    return Trips(seconds, arrived)


def head(title: str) -> None:
    """Print what a table is of, the machine and the date."""
    about = machine()
    print(f"\n{title} ({about['processor']}, {about['cores']} cores, {about['date']})\n", flush=True)


def travel(seeds: int = 3, shorter: bool = False) -> None:
    """Mean travel times on a grid with signals, without and with left turns, and on random networks."""
    grid = generated(GRID)
    flows = (200.0, 300.0, 400.0, 500.0, 600.0), (100.0, 150.0, 200.0, 250.0, 300.0), (100.0, 200.0, 300.0)
    cases = [("grid, no left turns", grid, (0.0, 0.8, 0.2), flows[0])]
    cases += [("grid, 20 % left", grid, (0.2, 0.6, 0.2), flows[1])]
    double = generated(GRID.replace("-L 1", "-L 2"))
    cases += [("two lanes, no left turns", double, (0.0, 0.8, 0.2), (300.0, 600.0, 900.0))]
    cases += [("two lanes, 20 % left", double, (0.2, 0.6, 0.2), (200.0, 400.0, 600.0))]
    cases += [
        (f"random {k}", generated(RANDOM.format(seed=k)), (0.25, 0.5, 0.25), flows[2]) for k in range(1, 1 + seeds)
    ]
    head("Mean travel time (s)")
    rows = []
    for name, text, shares, each in cases:
        network = network_of(text)
        for flow in each[:2] if shorter else each:
            demand = Demand.by_turns(network, flow, SECONDS, seed=1, shares=shares)
            a, b = ours(network, demand), sumos(text, network, demand)
            share = 100.0 * (a.seconds.mean() / b.seconds.mean() - 1.0)
            n = len(demand.route)
            cells = f"{a.seconds.mean():.1f}", f"{b.seconds.mean():.1f}", f"{share:+.1f} %"
            rows.append((name, f"{flow:.0f}", *cells, f"{a.arrived} / {b.arrived} of {n}"))
            print(rows[-1], flush=True)
    titles = ("network", "vehicles/h an entry", "ours", "SUMO", "difference", "arrived")
    print(table(titles, rows))


def saturation(greens: tuple[float, ...] = (3.0, 5.0, 8.0, 12.0, 20.0, 42.0)) -> None:
    """Vehicles that pass in one green, of a queue that does not end."""
    text = generated("--grid --grid.number 1 --grid.attach-length 1000 -j traffic_light -L 1 --no-turnarounds")
    head("Vehicles in a green")
    rows = []
    for green in greens:
        # The first phase is that of the streets from south to north.
        cycle, plan = f'duration="{90.0 - green:g}"', text.replace('duration="42"', f'duration="{green:g}"', 1)
        network = network_of(timed := plan.replace('duration="42"', cycle, 1))
        route = Ways(network).route_along(["bottom0A0", "A0top0"], "saturation")
        n = round(LATEST / 1.5)
        demand = Demand(padded([route]), np.zeros(n, int), 1.5 * np.arange(n))
        counts = []
        for trips in (ours(network, demand), sumos(timed, network, demand)):
            arrived = demand.depart + trips.seconds
            counts.append(((arrived >= 960.0) & (arrived < 960.0 + 12 * 96.0)).sum() / 12.0)
        rows.append(
            (f"{green:g}", f"{counts[0]:.2f}", f"{counts[1]:.2f}", f"{100.0 * (counts[0] / counts[1] - 1.0):+.1f} %")
        )
    print(table(("green (s)", "ours", "SUMO", "difference"), rows))


def control(flow: float = 250.0, left: float = 0.1, seed: int = 1) -> None:
    """Mean delay with signals by the clock and by max pressure, of a grid with a share of left turns."""
    text = generated(GRID)
    network = network_of(text)
    demand = Demand.by_turns(network, flow, SECONDS, seed=seed, shares=(left, 0.8 - left, 0.2))
    free = network.times(demand.routes).sum(1)
    head(f"Delay per vehicle (s), {flow:g} vehicles/h an entry, {left:.0%} of turns left")
    rows = []
    for name, least in (("by the clock", None), *((f"max pressure, least green {g} s", float(g)) for g in (5, 10, 15))):
        controls = [None if least is None else MaxPressure(network, least) for _ in range(2)]
        both = ours(network, demand, controls[0]), sumos(text, network, demand, controls[1])
        a, b = (float((trips.seconds - free[demand.route]).mean()) for trips in both)
        rows.append((name, f"{a:.1f}", f"{b:.1f}", f"{100.0 * (a / b - 1.0):+.1f} %"))
        print(rows[-1], flush=True)
    print(table(("signals", "ours", "SUMO", "difference"), rows))


main = {"travel": travel, "saturation": saturation, "control": control}
"""Its tables."""

if __name__ == "__main__":
    command(main)
