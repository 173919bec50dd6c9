"""Several lanes with MOBIL: how fast, how often lanes change at which flow, and whether random traffic breaks a law.

``python -m benchmarks.lanes speed [rollouts|highway]`` prints million vehicle updates per CPU second beside SUMO, and
env steps per CPU second of ``highway`` beside HighwayEnv.
``python -m benchmarks.lanes flow`` prints and draws flow and changes over density: ours, SUMO's two models and
HighwayEnv's, with the same IDM. Rings of four lanes; HighwayEnv has none, and drives a stretch of 1.6 km of which the
middle half counts. Its MOBIL, and ours, have politeness 0.2, threshold 0.1 m/s² and safe deceleration 4 m/s²; SUMO's
models have their own parameters. Rows are kept under ``out/``; those that are there are not driven again.
``python -m benchmarks.lanes standing`` prints how long vehicles stand at ends of lanes in the open tasks, and what gets
in and out, with drivers as they come and without gap acceptance, courtesy and zipper.
``python -m benchmarks.lanes laws [vehicle-steps]`` draws worlds (a ring, a lane drop, ramps, each with 2 to 5 lanes;
drivers, politeness and what is safe at random; a tenth of the drivers commanded anywhere at random), runs them as users
do, compiled where they can be, and looks after every step (gaps) and every decision (the rest). What breaks a law is
counted, never corrected.
"""

from __future__ import annotations

import collections
import math
import time
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal, NamedTuple

import gymnasium
import numpy as np
import torch
import tyro
from rich.console import Console
from rich.table import Table
from torch import Tensor

import idm_env  # noqa: F401  (registers the environments)
from benchmarks import command, named_rows, table
from benchmarks.bench.measure import Case, measure, rate, turning
from benchmarks.bench.peers import highway, started
from idm_env.effects import IDM, Brakes, LaneCommand, MandatoryChange, Mobil
from idm_env.jobs import progress, storage
from idm_env.jobs.progress import OnProgress
from idm_env.jobs.workers import HERE, Workers
from idm_env.multilane import demand
from idm_env.reports import page
from idm_env.roads import Lanes, lane_drop, off_ramp, on_ramp
from idm_env.simulator import Simulator
from idm_env.tasks import BottleneckTask, MergeTask
from idm_env.tasks.open_lanes import OpenLanesTask
from idm_env.tasks.random import Draw
from idm_env.types import State

LANES, EACH, DT = 4, 1000, 0.1
MODELS = ("LC2013", "SL2015")
"""Of lane changes, of SUMO."""
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
    assert state.lanes is not None
    return int(state.lanes.changed.sum())


def sumo(
    each: int, per_km: float, seconds: float, model: str = "LC2013", seed: int = 1
) -> tuple[float, float, float] | None:
    """Return mean speed (m/s), changes per vehicle and hour, and million updates per CPU second; None without SUMO.

    ``model`` is SUMO's lane-change model; ``SL2015`` has a lateral resolution of 0.8 m.
    """
    ring = each / LANES / per_km * 1000.0
    routes = _routes(each, ring, min(20.0, 0.5 * (1000.0 / per_km - 7.0)), model)
    options = ["--step-method.ballistic", "--collision.action", "none", "--seed", str(seed)]
    options += ["--lateral-resolution", "0.8"] if model == "SL2015" else []
    with started(_net(ring), routes, *options) as libsumo:
        return None if libsumo is None else _driven(libsumo, seconds)


def _net(ring: float) -> str:
    """Return a net of two edges that lead into each other, without insides of junctions."""
    parts = ['<net version="1.16"><location netOffset="0,0" convBoundary="0,0,1,1" origBoundary="0,0,1,1" '
             'projParameter="!"/>']  # fmt: skip
    for name, begin, end in (("a", "e", "w"), ("b", "w", "e")):
        lanes = "".join(
            f'<lane id="{name}_{k}" index="{k}" speed="60" length="{0.5 * ring:.2f}" width="3.2" '
            f'shape="0,{3 * k} {0.5 * ring:.2f},{3 * k}"/>'
            for k in range(LANES)
        )
        parts.append(f'<edge id="{name}" from="{begin}" to="{end}" priority="1">{lanes}</edge>')
    none = "0" * LANES
    requests = "".join(f'<request index="{k}" response="{none}" foes="{none}" cont="0"/>' for k in range(LANES))
    for name, edge in (("w", "a"), ("e", "b")):
        incoming = " ".join(f"{edge}_{k}" for k in range(LANES))
        parts.append(
            f'<junction id="{name}" type="priority" x="0" y="0" incLanes="{incoming}" intLanes="" '
            f'shape="0,0 0,1 1,1">{requests}</junction>'
        )
    for first, second in (("a", "b"), ("b", "a")):
        parts += [
            f'<connection from="{first}" to="{second}" fromLane="{k}" toLane="{k}" dir="s" state="M"/>'
            for k in range(LANES)
        ]
    return "".join(parts) + "</net>"


def vehicle_type(number: int, top: float, length: float = 5.0, model: str = "LC2013") -> str:
    """Return SUMO's type ``t{number}`` of a vehicle with a desired speed (m/s)."""
    return (
        f'<vType id="t{number}" carFollowModel="IDM" laneChangeModel="{model}" length="{length:g}" '
        f'accel="{DRIVER["max_accel"]}" decel="{DRIVER["comfort_decel"]}" tau="{DRIVER["time_gap"]}" '
        f'minGap="{DRIVER["min_gap"]}" maxSpeed="{top:.3f}" speedFactor="1" speedDev="0"/>'
    )


def _routes(each: int, ring: float, pace: float, model: str) -> str:
    generator = torch.Generator().manual_seed(1)
    desired = (25.0 + 10.0 * torch.rand(each, generator=generator)).tolist()
    types, cars = [], []
    for i, top in enumerate(desired):
        place = (i // LANES) * ring * LANES / each
        edge, position = ("a", place) if place < 0.5 * ring else ("b", place - 0.5 * ring)
        types.append(vehicle_type(i, top, model=model))
        cars.append(
            f'<vehicle id="v{i}" type="t{i}" route="{edge}" depart="0" departLane="{i % LANES}" '
            f'departPos="{position:.2f}" departSpeed="{pace:.2f}" insertionChecks="none"/>'
        )
    loops = f'<route id="a" edges="{"a b " * 300}"/><route id="b" edges="{"b a " * 300}"/>'
    return f"<routes>{loops}{''.join(types)}{''.join(cars)}</routes>"


def _driven(libsumo: Any, seconds: float) -> tuple[float, float, float]:
    """Drive as long before as during what is measured."""
    for _ in range(int(seconds / DT)):
        libsumo.simulationStep()
    names = libsumo.vehicle.getIDList()
    lanes = {name: libsumo.vehicle.getLaneIndex(name) for name in names}
    changes, way, cpu, steps = 0, 0.0, 0.0, int(seconds / DT)
    for k in range(steps):
        begin = time.process_time()
        libsumo.simulationStep()
        cpu += time.process_time() - begin
        if k % 10 == 0:
            for name in names:
                lane = libsumo.vehicle.getLaneIndex(name)
                changes += lane != lanes[name]
                lanes[name] = lane
            way += sum(libsumo.vehicle.getSpeed(name) for name in names) / len(names)
    return way / math.ceil(steps / 10), changes / len(names) / seconds * 3600.0, len(names) * steps / cpu * 1e-6


SIZES = (20_000, 200_000, 2_000_000)


def rollouts(vehicles: int, dtype: torch.dtype) -> tuple[float, float, float]:
    """Return million updates per CPU second forward and forward with backward, and changes per vehicle and hour."""
    simulator, state, params = traffic(max(1, vehicles // EACH), 15.0, dtype)
    state, _ = simulator.rollout(state, {}, params, 300, keep=None)  # in the first 15 s nobody changes lanes
    steps, end = 100, state

    def forward() -> None:
        nonlocal end
        end, _ = simulator.rollout(state, {}, params, steps, keep=None)

    taken = measure({"": Case(forward)}, 2)[""]["cpu_min_ms"] / 1e3
    leaf = params["idm"]["desired_speed"].requires_grad_()

    def both() -> None:
        last, _ = simulator.rollout(state, {}, params, 20, keep=None)
        torch.autograd.grad(last.position.sum(), leaf)

    updates = state.speed.numel() * 1e-6
    rate = (changes(end) - changes(state)) / state.speed.numel() / (steps * simulator.dt) * 3600.0
    return updates * steps / taken, updates * 20e3 / measure({"": Case(both)}, 3)[""]["cpu_min_ms"], rate


def our_highway(vector: int, seconds: float) -> float:
    """Return env steps per CPU second of ``highway`` with 50 vehicles (51 in a single one), random actions."""
    draw = np.random.default_rng(1)
    if vector == 1:
        single = gymnasium.make("DiffIDM-v0", task="highway", vehicles=51, lanes_count=4, warmup=0)
        return rate(turning(single, lambda: draw.uniform(-1, 1, 1).astype(np.float32)), seconds)
    many = gymnasium.make_vec("DiffIDM-v0", num_envs=vector, task="highway", vehicles=50, lanes_count=4, warmup=0)
    block = draw.uniform(-1, 1, (vector, 1)).astype(np.float32)
    many.reset(seed=1)
    return rate(lambda: many.step(block), seconds) * vector


def their_highway(seconds: float) -> float | None:
    """Return env steps per CPU second of HighwayEnv's ``highway-fast-v0`` with 51 vehicles; None without it."""
    env, draw = highway(vehicles_count=50, lanes_count=4), np.random.default_rng(1)
    return None if env is None else rate(turning(env, lambda: int(draw.integers(5))), seconds)


def speed(part: tyro.conf.Positional[Literal["all", "rollouts", "highway"]] = "all") -> None:
    """Print million vehicle updates per CPU second beside SUMO, and env steps of ``highway`` beside HighwayEnv."""
    console = Console()
    if part != "highway":
        peer = sumo(EACH, 15.0, 30.0)
        peer_rate = None if peer is None else peer[2]
        rows_of_table = Table("", "vehicles", "forward", "× SUMO", "forward + backward", "changes /vehicle/h",
                     title="Million updates per CPU second: 4 lanes, MOBIL at 1 Hz, Δt 0.1 s, 15 /km/lane")  # fmt: skip
        for dtype in (torch.float32, torch.float64):
            for size in SIZES:
                forward, both, rate = rollouts(size, dtype)
                ratio = "" if peer_rate is None else f"{forward / peer_rate:.0f}"
                name = str(dtype).removeprefix("torch.")
                rows_of_table.add_row(name, f"{size:,}", f"{forward:.1f}", ratio, f"{both:.1f}", f"{rate:.0f}")
        rows_of_table.add_row("SUMO", f"{EACH:,}", "not installed" if peer is None else f"{peer[2]:.2f}", "1", "", "")
        console.print(rows_of_table)
    if part != "rollouts":
        single, peer_steps, vector = our_highway(1, 3.0), their_highway(8.0), our_highway(1024, 4.0)
        ratio = "" if peer_steps is None else f", {single / peer_steps:.0f} ×"
        rows_of_table = Table("", "env steps per CPU s", title="Task highway, 4 lanes")
        rows_of_table.add_row("vector of 1024, 50 vehicles", f"{vector:,.0f}")
        rows_of_table.add_row("single gym.make, 51 vehicles", f"{single:,.0f}{ratio}")
        other = "not installed" if peer_steps is None else f"{peer_steps:.1f}"
        rows_of_table.add_row("HighwayEnv highway-fast-v0, 51 vehicles", other)
        console.print(rows_of_table)


DENSITIES = (5.0, 10.0, 15.0, 20.0, 30.0, 40.0)
SECONDS = 300.0
KEPT = Path("out/lanes-flow.jsonl")


def our_flow(density: float) -> tuple[float, float]:
    """Return mean speed (m/s) and changes per vehicle and hour, over five minutes after five."""
    steps = int(SECONDS / DT)
    simulator, state, params = traffic(4, density, torch.float64, each=200)
    state, _ = simulator.rollout(state, {}, params, steps, keep=None)
    end, _ = simulator.rollout(state, {}, params, steps, keep=None)
    rate = (changes(end) - changes(state)) / state.speed.numel() / SECONDS * 3600.0
    return float((end.position - state.position).mean()) / SECONDS, rate


def their_flow(density: float, seconds: float = 60.0) -> tuple[float, float] | None:
    """Return the same of HighwayEnv's IDM and MOBIL, over the second half of a minute; None without HighwayEnv."""
    if not find_spec("highway_env"):
        return None
    from highway_env.road.road import Road, RoadNetwork
    from highway_env.vehicle.behavior import IDMVehicle

    stretch, draw = 1600.0, np.random.default_rng(1)
    road = Road(network=RoadNetwork.straight_road_network(LANES, length=6000, speed_limit=60), np_random=draw)
    count, pace = int(density * LANES * stretch / 1000.0), min(20.0, 0.5 * (1000.0 / density - 7.0))
    for i in range(count):
        place = (i // LANES + 0.4 * draw.uniform()) * 1000.0 / density
        car = IDMVehicle.make_on_lane(road, ("0", "1", i % LANES), longitudinal=place, speed=pace)
        car.target_speed = draw.uniform(25.0, 35.0)
        car.COMFORT_ACC_MAX, car.COMFORT_ACC_MIN = DRIVER["max_accel"], -DRIVER["comfort_decel"]
        # Distances are between centres there.
        car.TIME_WANTED, car.DISTANCE_WANTED = DRIVER["time_gap"], DRIVER["min_gap"] + car.LENGTH
        car.POLITENESS, car.LANE_CHANGE_MIN_ACC_GAIN, car.LANE_CHANGE_MAX_BRAKING_IMPOSED = 0.2, 0.1, 4.0
        road.vehicles.append(car)
    order = np.argsort([car.position[0] for car in road.vehicles])
    middle = [road.vehicles[i] for i in order[count // 4 : -count // 4]]
    steps, changed = int(seconds / DT), 0
    half = steps // 2
    for k in range(steps):
        if k == half:
            begin = [car.position[0] for car in middle]
        before = [car.lane_index[2] for car in middle]
        road.act()
        road.step(DT)
        changed += k >= half and sum(car.lane_index[2] != lane for car, lane in zip(middle, before, strict=True))
    way = float(np.mean([car.position[0] - x for car, x in zip(middle, begin, strict=True)]))
    time = (steps - half) * DT
    return way / time, changed / len(middle) / time * 3600.0


class Part(NamedTuple):
    """One simulator at one density (vehicles per km and lane)."""

    who: str
    density: float


WHO = ("idm_env", *(f"SUMO {model}" for model in MODELS), "HighwayEnv")


def drive(part: Part, on_progress: OnProgress) -> tuple[float, float] | None:
    """Return mean speed (m/s) and changes per vehicle and hour; None where the simulator is not installed."""
    who, density = part
    if who == "idm_env":
        return our_flow(density)
    if who == "HighwayEnv":
        return their_flow(density)
    result = sumo(200, density, SECONDS, who.removeprefix("SUMO "))
    return None if result is None else result[:2]


Rows = dict[str, dict[float, tuple[float, float] | None]]


def picture(found: Rows, path: Path) -> None:
    """Draw flow and change rate over density."""
    figure, axes = page.figure(1, 2, size=(9.0, 3.4))
    for name, colour in zip(WHO, ("#1e5adc", "#d1495b", "#e8a33d", "#6a6f78"), strict=True):
        points = [(d, row) for d, row in found[name].items() if row is not None]
        if points:
            densities = [d for d, _ in points]
            axes[0, 0].plot(densities, [v * d * 3.6 for d, (v, _) in points], "o-", ms=4, color=colour, label=name)
            axes[0, 1].plot(densities, [rate for _, (_, rate) in points], "o-", ms=4, color=colour, label=name)
    axes[0, 0].set(xlabel="density (vehicles/km/lane)", ylabel="flow (vehicles/h/lane)", ylim=(0, None))
    axes[0, 1].set(xlabel="density (vehicles/km/lane)", ylabel="changes per vehicle and hour", ylim=(0, None))
    axes[0, 0].legend(frameon=False, fontsize=8)
    for axis in axes[0]:
        axis.grid(alpha=0.25)
    path.parent.mkdir(parents=True, exist_ok=True)
    storage.write(path, lambda file: figure.savefig(file, dpi=110))


def flow(path: Path = Path("out/lanes-flow.png"), place: Workers = HERE) -> None:
    """Print flow (vehicles per hour and lane) and changes per vehicle and hour, and draw them.

    Args:
        path: The picture.
        place: Where simulators run.
    """
    parts = {f"{name} at {density:g} /km/lane": Part(name, density) for name in WHO for density in DENSITIES}
    driven = named_rows(drive, parts, KEPT, place)
    rates: Rows = {name: {d: driven[f"{name} at {d:g} /km/lane"] for d in DENSITIES} for name in WHO}
    rows = []
    for density in DENSITIES:
        cells = (rates[name][density] for name in WHO)
        texts = ("not installed" if x is None else f"{x[0] * density * 3.6:.0f}, {x[1]:.0f}" for x in cells)
        rows.append([f"{density:g}", *texts])
    print(table(("per km and lane", *(f"{name}: flow, changes" for name in WHO)), rows))
    picture(rates, path)
    print(f"Picture: {path}; rows are kept in {KEPT}, remove it to drive them again.")


ROADS = ("ring", "drop", "ramps")
EVERY = 10
Counts = collections.Counter[str]
Params = dict[str, dict[str, Tensor]]


def road_of(kind: str, count: int, ring: float) -> Lanes:
    """Return a road; on those that vehicles enter, the outer lanes end or begin within it."""
    if kind == "ring":
        return Lanes(count, ring=ring)
    if kind == "drop":
        return Lanes(count, length=1000.0, ends=(lane_drop(count - 1, at=600.0),))
    ends = on_ramp(0, begin=200.0, end=500.0, entry=50.0), off_ramp(count - 1, 300.0, 700.0, leaves=800.0)
    return Lanes(count, length=1000.0, ends=ends)


def world(kind: str, seed: int, rows: int, each: int, dtype: torch.dtype) -> tuple[Simulator, State, Params]:
    """Return random traffic: on a ring anywhere, elsewhere an empty road that trips wait for."""
    draw = torch.Generator().manual_seed(seed)
    count = 2 + int(torch.randint(4, (), generator=draw))
    density = 12.0 + 48.0 * float(torch.rand((), generator=draw))  # per km and lane, of a ring
    spacing = 1000.0 / density
    road = road_of(kind, count, -(-each // count) * spacing)  # room for the fullest lane
    simulator = Simulator(road, (IDM(), Mobil(), MandatoryChange(), LaneCommand(), Brakes()), dt=DT)
    params = simulator.defaults(dtype=dtype)

    def between(low: float, high: float, *shape: int) -> Tensor:
        return (low + (high - low) * torch.rand(shape, generator=draw)).to(dtype)

    safe = between(0.5, 6.0)
    for name in ("mobil", "mandatory_change", "lane_command"):
        params[name]["safe_decel"] = safe
    params["mobil"]["politeness"] = between(-0.5, 1.0)
    params["idm"]["time_gap"] = between(0.6, 2.0, rows, each)
    params["idm"]["desired_speed"] = between(12.0, 38.0, rows, each)
    if kind == "ring":
        index = torch.arange(each)
        place = torch.div(index, count, rounding_mode="floor") * spacing + between(0.0, 0.4, rows, each) * spacing
        pace = torch.full_like(place, 6.0)
        return simulator, simulator.state(place.to(dtype), pace, params, lane=index % count, length=4.0), params
    flows = {k: 300.0 + 2200.0 * float(torch.rand((), generator=draw)) for k in range(count - (kind == "ramps"))}
    trips = demand.trips(flows, 3600.0, speed=20.0, slots=each // 3, dtype=dtype)  # fewer find room there
    n = len(trips.departs)  # lanes share the slots, rounded down
    params["idm"] = {name: x[..., :n] if x.dim() else x for name, x in params["idm"].items()}
    return simulator, demand.waiting(simulator, demand.spread(trips, (rows, n)), params), params


def broken(simulator: Simulator, before: State, after: State, kept: Any, params: Params) -> Counts:
    """Return what happened between two decisions, and how often each law was broken."""
    links, was, counts = after.lanes, before.lanes, Counts()
    assert links is not None and was is not None
    own = torch.arange(after.speed.shape[-1])
    on_road = torch.ones_like(after.speed, dtype=torch.bool) if after.present is None else after.present > 0
    # Somebody alone on a ring follows himself, and has the ring as his gap.
    counts["overlaps"] = int(((kept.gap <= 0) & on_road).any(0).sum())
    inverse = (links.follower.gather(-1, links.leader) == own) | (links.leader == own)
    counts["links not inverse"] = int((~inverse & on_road).sum())
    lanes = links.lane.gather(-1, links.leader) == links.lane
    counts["leaders in another lane"] = int((~lanes & on_road).sum())
    fresh = simulator.road.view(after).gaps(after.position, after.length)
    near = on_road & (after.gap < 5e3)
    slack = 1e-6 if after.gap.dtype == torch.float64 else 0.5
    counts["gaps that positions deny"] = int(((after.gap - fresh).abs() > slack)[near].sum())
    stays = on_road if before.present is None else on_road & (before.present > 0)
    if links.trips is not None and was.trips is not None:
        stays = stays & (links.trips.entered == was.trips.entered)
        due, inside, left, queued = demand.counts(simulator, after)
        gone = (links.trips.entered - links.trips.left).sum(-1) != inside
        counts["vehicles lost"] = int(((due != inside + left + queued) | (queued < 0) | gone).sum())
        counts["entered"] = int((links.trips.entered - was.trips.entered).sum())
        counts["left"] = int((links.trips.left - was.trips.left).sum())
    moved = (after.position - before.position)[stays]
    counts["moved too far"] = int(((moved < -1e-3) | (moved > 60.0 * DT * EVERY)).sum())
    for name in ("changed", "refused", "blocked", "unjudged"):
        counts[name] = int((getattr(links, name) - getattr(was, name)).sum())
    unasked = ((links.unjudged - was.unjudged) > 0) & (links.follower != own)
    braking = kept.accel[0].gather(-1, links.follower)
    counts["unjudged who brake harder than is safe"] = int((unasked & (braking < -params["mobil"]["safe_decel"])).sum())
    counts["vehicle-steps"] = EVERY * int(on_road.sum())
    return counts


def driven(kind: str, seed: int, rows: int, each: int, decisions: int) -> Iterator[Counts]:
    """Yield what happened in every decision interval of one world; every other world is in float32."""
    dtype = torch.float64 if seed % 2 else torch.float32
    simulator, state, params = world(kind, seed, rows, each, dtype)
    draw = torch.Generator().manual_seed(seed + 1)
    for _ in range(decisions):
        some = torch.rand(state.speed.shape, generator=draw) < 0.1
        side = torch.randint(-1, 2, state.speed.shape, generator=draw)
        command = torch.where(some, side.to(dtype), torch.nan).expand(EVERY, *state.speed.shape)
        before = state
        state, motion = simulator.rollout(state, {"lane_command": command}, params, EVERY)
        yield broken(simulator, before, state, motion, params)


LAWS = (
    "overlaps", "links not inverse", "leaders in another lane", "gaps that positions deny", "vehicles lost",
    "moved too far",
)  # fmt: skip


def check(
    steps: float, on_progress: OnProgress, *, rows: int = 32, each: int = 400, decisions: int = 300
) -> dict[str, Counts]:
    """Return what happened in at least so many vehicle-steps, a third of them on each kind of road."""
    by_road, seed, share = {kind: Counts() for kind in ROADS}, 0, int(steps / len(ROADS))
    for kind in ROADS:
        while by_road[kind]["vehicle-steps"] < share:
            for counts in driven(kind, seed, rows, each, decisions):
                by_road[kind].update(counts)
                words = (
                    ", ".join(f"{by_road[kind][law]} {law}" for law in LAWS if by_road[kind][law]) or "no law broken"
                )
                on_progress(kind, min(by_road[kind]["vehicle-steps"], share), share, words)
            seed += 1
            by_road[kind]["worlds"] += rows
    return by_road


def counted(found: dict[str, Counts]) -> str:
    """Return the counts as a table."""
    names = list(dict.fromkeys(name for counts in found.values() for name in counts))
    lines = [f"{'':40s}" + "".join(f"{kind:>14s}" for kind in found)]
    lines += [f"{name:40s}" + "".join(f"{counts[name]:14,d}" for counts in found.values()) for name in names]
    return "\n".join(lines)


class Stood(NamedTuple):
    """Of some episodes: the longest stand of any vehicle (s, each), vehicles an hour from lane 0, and out.

    ``hard`` are seconds in which a vehicle brakes by more than 6 m/s², an episode; ``touched`` those with a gap ≤ 0.
    ``emergencies`` are brakings beyond 8 m/s², an hour of each episode, however long one lasts. ``left`` is the least
    time gap (s) that a change left to a follower above 5 m/s, and that of a hundredth of these changes.
    """

    longest: list[float]
    merged: float
    out: float
    hard: float
    touched: float
    emergencies: list[float]
    left: tuple[float, float]


WITHOUT = {"gap_acceptance": "strength", "courtesy": "weight", "mandatory_change": "turns", "calm": "coolness"}
BEFORE: tuple[dict[str, Any], ...] = ({effect: {name: 0.0} for effect, name in WITHOUT.items()}, {})
DEMANDS = {
    "merge 2400 + 500": (MergeTask, {"controlled": 0.1, "inflow": 2400.0, "ramp_inflow": 500.0}),
    "merge 3000 + 800": (MergeTask, {"controlled": 0.1, "inflow": 3000.0, "ramp_inflow": 800.0}),
    "bottleneck 1900": (BottleneckTask, {"controlled": 0.1, "inflow": 1900.0}),
}


def stood(task: OpenLanesTask, rows: int = 8, seconds: int = 600) -> Stood:
    """Drive some episodes of a task with nobody controlled; a vehicle stands below 0.5 m/s."""
    params = task.params(torch.float32, "cpu")
    simulator = task.simulator.without("control")
    state = task.begin(Draw.of(torch.arange(rows), torch.zeros(rows, dtype=torch.int64)), params).state
    now = torch.zeros_like(state.speed)
    longest, merged, hard, touched = now, 0, 0, 0
    brakes, events, left = now > 0, torch.zeros(rows), [torch.zeros(0)]
    for _ in range(seconds):
        before = state
        state, motion = simulator.rollout(state, {}, params, round(1.0 / simulator.dt))
        assert before.lanes and state.lanes and before.lanes.trips and state.lanes.trips and state.present is not None
        same = (state.present > 0) & (state.lanes.trips.entered == before.lanes.trips.entered)
        now = torch.where(same & (state.speed < 0.5), now + 1.0, 0.0)
        longest = torch.maximum(longest, now)
        hard += int((same & (motion.accel < -6.0).any(0)).sum())
        touched += int((same & (motion.gap <= 0.0).any(0)).sum())
        each = torch.cat((brakes.unsqueeze(0), motion.accel < -8.0))
        events += (each[1:] & ~each[:-1] & same).sum((0, -1))
        brakes = each[-1]
        follower = state.lanes.follower
        changed = same & (state.lanes.changed > before.lanes.changed) & (follower != torch.arange(now.shape[-1]))
        gap, speed = (x[0].gather(-1, follower)[changed] for x in (motion.gap, motion.speed))
        left.append((gap / speed)[speed > 5.0])
        merged += int((same & (before.lanes.lane == 0) & (state.lanes.lane != 0)).sum())
    assert state.lanes is not None and state.lanes.trips is not None
    hourly = 3600.0 / seconds / rows
    gaps = torch.cat(left)
    return Stood(
        longest.amax(-1).tolist(),
        merged * hourly,
        float(state.lanes.trips.left.sum()) * hourly,
        hard / rows,
        touched / rows,
        (events * hourly * rows).tolist(),
        (float(gaps.min()), float(gaps.quantile(0.01))),
    )


def standing() -> None:
    """Print how long vehicles stand in the open tasks."""
    head = ("", "drivers", "longest stand in each of 8 × 600 s (s)", "from lane 0, vehicles/h", "out, vehicles/h",
            "hard brakings, s", "touched, s", "beyond 8 m/s², 1/h", "time gap left, s")  # fmt: skip
    rows = []
    for name, (kind, keywords) in DEMANDS.items():
        for drivers, changed in zip(("without", "as they come"), BEFORE, strict=True):
            episodes = stood(kind(parameters=changed, **keywords))
            each = ", ".join(f"{x:.0f}" for x in episodes.longest)
            events = torch.tensor(episodes.emergencies)
            half = 2.365 * float(events.std()) / len(events) ** 0.5  # Student's t of 7 degrees of freedom
            beyond, left = f"{float(events.mean()):.0f} ± {half:.0f}", "{:.2f}, {:.2f}".format(*episodes.left)
            rows.append([name, drivers, each, *(f"{x:.0f}" for x in episodes[1:5]), beyond, left])
    print(table(head, rows))


def laws(steps: tyro.conf.Positional[float] = 1e9) -> None:
    """Print how often random traffic broke a law, and what else it did.

    Args:
        steps: Vehicle-steps, 1000 or more.
    """
    if not 1000.0 <= steps < math.inf:
        raise SystemExit(f"error: {steps:g} vehicle-steps are no number of 1000 or more. Usual is 1e9.")
    with progress.shown(Console(stderr=True)) as on_progress:
        by_road = check(steps, on_progress)
    print(counted(by_road))


main = {"speed": speed, "flow": flow, "standing": standing, "laws": laws}

if __name__ == "__main__":
    torch.set_num_threads(1)
    command(main)
