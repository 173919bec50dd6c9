"""Laws of several lanes over random traffic: links are inverse, nobody overlaps, everybody is accounted for.

``python -m benchmarks.lanes laws [vehicle-steps]`` draws worlds (a ring, a lane drop, ramps, each with 2 to 5 lanes;
drivers, politeness and what is safe at random; a tenth of the drivers commanded anywhere at random), runs them as users
do, compiled where they can be, and looks after every step (gaps) and every decision (the rest). What breaks a law is
counted, never corrected.
"""

from __future__ import annotations

import collections
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from idm_env import population
from idm_env.effects import IDM, Brakes, LaneCommand, MandatoryChange, Mobil
from idm_env.progress import OnProgress
from idm_env.roads import Lanes, lane_drop, off_ramp, on_ramp
from idm_env.simulator import Simulator
from idm_env.types import State

ROADS = ("ring", "drop", "ramps")
DT, EVERY = 0.1, 10
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
    given = population.trips(flows, 3600.0, speed=20.0, slots=each // 3, dtype=dtype)  # fewer find room there
    n = len(given.departs)  # lanes share the slots, rounded down
    params["idm"] = {name: x[..., :n] if x.dim() else x for name, x in params["idm"].items()}
    return simulator, population.waiting(simulator, population.spread(given, (rows, n)), params), params


def broken(simulator: Simulator, before: State, after: State, kept: Any, params: Params) -> Counts:
    """Return what happened between two decisions, and how often each law was broken."""
    links, was, found = after.links, before.links, Counts()
    assert links is not None and was is not None
    own = torch.arange(after.speed.shape[-1])
    there = torch.ones_like(after.speed, dtype=torch.bool) if after.present is None else after.present > 0
    assert before.links is not None
    # Somebody alone on a ring follows himself, and has the ring as his gap.
    found["overlaps"] = int(((kept.gap <= 0) & there).any(0).sum())
    inverse = (links.follower.gather(-1, links.leader) == own) | (links.leader == own)
    found["links not inverse"] = int((~inverse & there).sum())
    lanes = links.lane.gather(-1, links.leader) == links.lane
    found["leaders in another lane"] = int((~lanes & there).sum())
    fresh = simulator.road.view(after).gaps(after.position, after.length)
    near = there & (after.gap < 5e3)
    slack = 1e-6 if after.gap.dtype == torch.float64 else 0.5
    found["gaps that positions deny"] = int(((after.gap - fresh).abs() > slack)[near].sum())
    stays = there if before.present is None else there & (before.present > 0)
    if after.trips is not None and before.trips is not None:
        stays = stays & (after.trips.entered == before.trips.entered)
        due, inside, left, queued = population.counts(simulator, after)
        gone = (after.trips.entered - after.trips.left).sum(-1) != inside
        found["vehicles lost"] = int(((due != inside + left + queued) | (queued < 0) | gone).sum())
        found["entered"] = int((after.trips.entered - before.trips.entered).sum())
        found["left"] = int((after.trips.left - before.trips.left).sum())
    moved = (after.position - before.position)[stays]
    found["moved too far"] = int(((moved < -1e-3) | (moved > 60.0 * DT * EVERY)).sum())
    for name in ("changed", "refused", "blocked", "unjudged"):
        found[name] = int((getattr(links, name) - getattr(was, name)).sum())
    unasked = ((links.unjudged - was.unjudged) > 0) & (links.follower != own)
    braking = kept.accel[0].gather(-1, links.follower)
    found["unjudged who brake harder than is safe"] = int((unasked & (braking < -params["mobil"]["safe_decel"])).sum())
    found["vehicle-steps"] = EVERY * int(there.sum())
    return found


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
        state, kept = simulator.rollout(state, {"lane_command": command}, params, EVERY)
        yield broken(simulator, before, state, kept, params)


LAWS = (
    "overlaps", "links not inverse", "leaders in another lane", "gaps that positions deny", "vehicles lost",
    "moved too far",
)  # fmt: skip


def check(
    steps: float, on_progress: OnProgress, *, rows: int = 32, each: int = 400, decisions: int = 300
) -> dict[str, Counts]:
    """Return what happened in at least so many vehicle-steps, a third of them on each kind of road."""
    found, seed, share = {kind: Counts() for kind in ROADS}, 0, int(steps / len(ROADS))
    for kind in ROADS:
        while found[kind]["vehicle-steps"] < share:
            for counts in driven(kind, seed, rows, each, decisions):
                found[kind].update(counts)
                words = ", ".join(f"{found[kind][law]} {law}" for law in LAWS if found[kind][law]) or "no law broken"
                on_progress(kind, min(found[kind]["vehicle-steps"], share), share, words)
            seed += 1
            found[kind]["worlds"] += rows
    return found


def table(found: dict[str, Counts]) -> str:
    """Return the counts as a table."""
    names = list(dict.fromkeys(name for counts in found.values() for name in counts))
    lines = [f"{'':40s}" + "".join(f"{kind:>14s}" for kind in found)]
    lines += [f"{name:40s}" + "".join(f"{counts[name]:14,d}" for counts in found.values()) for name in names]
    return "\n".join(lines)
