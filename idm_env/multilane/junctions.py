"""Vehicles on a network: events every half second, which move them on, let them in, and open gates.

What is decided is discrete and compiled (``compiled.kernels.network_loops``), by one loop for all paths. What that
makes of positions, speeds and gaps is ``crossed``: gradients flow through them, and not through who passes when.

Shapes: what belongs to vehicles is ``[..., n]``, in SI units.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from idm_env.multilane.demand import Counts
from idm_env.roads.journeys import Travelled
from idm_env.roads.merging import on_lanes
from idm_env.roads.network import Network, padded
from idm_env.roads.network_demand import Demand
from idm_env.roads.ways import others
from idm_env.step import CarFollowingStep
from idm_env.types import FAR, Journeys, Params, State, worthwhile

DECIDED = ("route", "hop", "told", "reserved", "entered", "left")
"""What events decide of journeys."""

NEVER = 1 << 30
"""Step at which those are due who never are."""

HALTING = 0.1
"""Speed below which a vehicle stands (m/s), as in SUMO."""

LED, ENTERED, ENTERED_BEHIND = 1, 2, 3
"""What is new of a vehicle: its leader, itself, itself at its leader's speed."""


class Event(NamedTuple):
    """Decisions of an event about every vehicle, ``(..., n)`` each.

    It comes to another link, whose beginning is ``moved`` (m) further on; who it follows, and the way to his link
    (``base``, m); the speed that it is ``entering`` at (m/s), where it must ``stop`` (m) and its ``limit`` (m/s); what
    is ``new``; its part of the state: whole numbers and truth values; and for which vehicle it ``waits`` at a gate.
    """

    new: Tensor
    moved: Tensor
    base: Tensor
    entering: Tensor
    stop: Tensor
    limit: Tensor
    present: Tensor
    link: Tensor
    leader: Tensor
    follower: Tensor
    route: Tensor
    hop: Tensor
    told: Tensor
    reserved: Tensor
    entered: Tensor
    left: Tensor
    waits: Tensor


def guided(stepping: CarFollowingStep) -> dict[str, Any]:
    """Return effects that are guided by events, by the name of what is written; ValueError where none obeys gates."""
    effects: dict[str, Any] = {e.guided: e for e in stepping.effects if e.guided}
    if "stop" not in effects:
        raise ValueError("a network has gates, and no effect obeys them. Add StopLine().")
    return effects


def rules_of(stepping: CarFollowingStep, params: Params) -> tuple[Any, tuple[Tensor, ...]]:
    """Return the effect with the rules at junctions, and T (s), s0 (m), b and a (m/s²) of drivers, ``[..., n]``."""
    driver = stepping.base.driver(dict(params[stepping.base.name]))
    return guided(stepping)["stop"], (driver.time_gap, driver.min_gap, driver.comfort_decel, driver.max_accel)


def every(stepping: CarFollowingStep) -> int:
    """Return the number of steps between two events."""
    return max(1, round(guided(stepping)["stop"].every / stepping.dt))


def crossed(stepping: CarFollowingStep, state: State, params: Params) -> State:
    """Return the state after the event that is due at this step, in the rows where one is.

    ::

        x ← x − L                                      who has come to another link
        v ← v_in, or min(v_in, v_leader)               who enters
        s ← w + x_leader − l_leader − x                who has another leader, w being the way to that one's link
    """
    now = state.step.remainder(every(stepping)) == 0
    if not worthwhile(now):
        return state
    event: Event = stepping.event(state, params, now)
    links = state.lanes
    assert links is not None and links.journeys is not None
    ways = links.journeys._replace(**{k: getattr(event, k) for k in DECIDED})
    links = links._replace(lane=event.link, leader=event.leader, follower=event.follower, journeys=ways)
    view, fresh = Travelled(links, state.position), event.new >= ENTERED
    position = torch.where(fresh, 0.0, state.position - event.moved)
    slow = torch.minimum(event.entering, view.ahead(state.speed))
    speed = torch.where(event.new == ENTERED_BEHIND, slow, torch.where(fresh, event.entering, state.speed))
    speed, accel = (torch.where(event.present > 0, x, 0.0) for x in (speed, torch.where(fresh, 0.0, state.accel)))
    gap = torch.where(event.new >= LED, view.measured(position, state.length, event.base), state.gap)
    gap = torch.where(view.led(gap) > 0, gap, FAR)
    after = state._replace(position=position, speed=speed, gap=gap, accel=accel, present=event.present, lanes=links)
    guidance = {effect.name: getattr(event, what) for what, effect in guided(stepping).items()}
    if set(state.memory) - set(guidance) and worthwhile(fresh):
        memory = stepping.remembered(after, params)
        masks = {k: fresh if x.dim() <= fresh.dim() else fresh[..., None, None] for k, x in state.memory.items()}
        after = after._replace(memory={k: torch.where(masks[k], memory[k], x) for k, x in state.memory.items()})
    return on_lanes(after._replace(memory={**after.memory, **guidance}))


# -- states ----------------------------------------------------------------------------------------------------------


def travelling(
    stepping: CarFollowingStep, demand: Demand | Sequence[Demand], params: Params, *, slots: int | None = None,
    hop: Any = None, position: Any = None, speed: Any = None, dtype: torch.dtype = torch.float32,
) -> State:  # fmt: skip
    """Return a network on which everybody waits for his trip, or is on link ``hop`` of his route at the start.

    Of one demand the state has shape (n,); of several it has a row for each, (rows, n), with ``slots`` for as many
    vehicles (by default for those of the largest). ``hop``, −1 for who waits, ``position`` (m on that link) and
    ``speed`` (m/s) broadcast to that shape.

    ValueError for a demand that does not fit the network or the slots, or a simulator without ``StopLine``.
    """
    network, many = stepping.road, [demand] if isinstance(demand, Demand) else list(demand)
    guided(stepping)
    if not isinstance(network, Network):
        raise ValueError(f"journeys need a network, and the road is {type(network).__name__}.")
    most = max(len(each.route) for each in many)
    n = most if slots is None else slots
    if most > n:
        raise ValueError(f"demand: {most} vehicles for {n} slots. Give as many slots.")
    for each in {id(each): each for each in many}.values():
        each.check(network)
    table, first = padded([row for each in many for row in each.routes.tolist()]), [0, *(len(d.routes) for d in many)]
    offsets = np.cumsum(first)[:-1]

    def column(values: Sequence[Any], spare: float, kind: Any) -> Any:
        rows = [np.pad(np.asarray(x, float), (0, n - len(x)), constant_values=spare) for x in values]
        return np.stack(rows).astype(kind)

    route = column([d.route + o for d, o in zip(many, offsets, strict=True)], 0, np.int32)
    due = column([np.minimum(np.ceil(d.depart / stepping.dt - 1e-6), NEVER) for d in many], NEVER, np.int32)
    hops = np.broadcast_to(np.asarray(-1 if hop is None else hop), route.shape)
    begun = hops >= 0
    values = {"position": 0.0 if position is None else position, "speed": 0.0 if speed is None else speed}
    shape = (n,) if isinstance(demand, Demand) else route.shape

    def tensor(x: Any, kind: torch.dtype = dtype) -> Tensor:
        return torch.as_tensor(x).to(kind).expand(route.shape).reshape(shape)

    lane = table[route, np.maximum(hops, 0)]
    moving = {
        k: tensor(torch.where(torch.as_tensor(begun), torch.as_tensor(x).to(dtype), 0.0)) for k, x in values.items()
    }
    length = tensor(column([d.length for d in many], 5.0, float))
    state = stepping.state(
        moving["position"], moving["speed"], params, length=length, lane=tensor(lane, torch.int64),
        present=tensor(begun),
    )  # fmt: skip
    assert state.lanes is not None
    whole = torch.int32
    due, asks = np.where(begun, 0, due), column([d.speed for d in many], 0.0, float)
    ways = Journeys(
        torch.from_numpy(table), torch.from_numpy(others(network, table)), tensor(route, whole),
        tensor(np.maximum(hops, 0), whole), tensor(0, whole), tensor(0, torch.bool), tensor(due, whole),
        tensor(asks), tensor(np.where(begun, 0, -1), whole),
        tensor(-1, whole), torch.full((*shape[:-1], len(network.plans)), -1, dtype=whole),
    )  # fmt: skip
    return state._replace(lanes=state.lanes._replace(journeys=ways))


def of_kinds(
    params: Params, demand: Demand | Sequence[Demand], slots: int | None = None
) -> dict[str, dict[str, Tensor]]:
    """Return the parameters with those of each vehicle's kind in its slot, ``(n,)`` or ``(rows, n)``.

    ValueError for a parameter that is not among ``params``.
    """
    many = [demand] if isinstance(demand, Demand) else list(demand)
    n = max(len(each.route) for each in many) if slots is None else slots
    full = {effect: dict(values) for effect, values in params.items()}
    for name in sorted({name for each in many for kind in each.kinds for name in kind}):
        effect, _, parameter = name.partition(".")
        if parameter not in full.get(effect, {}):
            raise ValueError(f"demand: kinds have '{name}', and the model has no such parameter.")
        before = full[effect][parameter]
        rows = [_own(each, name, float(before)) + [float(before)] * (n - len(each.route)) for each in many]
        x = torch.tensor(rows, dtype=before.dtype)
        full[effect][parameter] = x[0] if isinstance(demand, Demand) else x
    return full


def _own(demand: Demand, name: str, otherwise: float) -> list[float]:
    values = [float(kind.get(name, otherwise)) for kind in demand.kinds]
    return [values[k] for k in demand.kind]


def showing(state: State, phases: Tensor) -> State:
    """Return the state with these phases of signals, ``(..., signals)``; −1 leaves a signal to its plan."""
    ways = journeys_of(state)
    assert state.lanes is not None
    phases = phases.to(ways.phases.dtype).expand(ways.phases.shape)
    return state._replace(lanes=state.lanes._replace(journeys=ways._replace(phases=phases)))


# -- what can be read --------------------------------------------------------------------------------------------------


def journeys_of(state: State) -> Journeys:
    """Return the journeys ``(..., n)`` in a network's state."""
    assert state.lanes is not None and state.lanes.journeys is not None
    return state.lanes.journeys


def counts(state: State) -> Counts:
    """Return the trips of every row: due by now; of these inside, left, and queued for want of room."""
    ways = journeys_of(state)
    assert state.present is not None
    # Who is due between two events waits for the next one.
    due, inside, left = (ways.due <= state.clock), state.present > 0, ways.left >= 0
    due = due | (ways.entered >= 0)
    return Counts(*(x.sum(-1) for x in (due, inside, left, due & (ways.entered < 0))))


def deadlocked(stepping: CarFollowingStep, state: State, params: Params) -> Tensor:
    """Return how many vehicles of every row wait for one another in a circle, ``(...)``: they will wait for ever.

    A vehicle that stands (below 0.1 m/s) waits for its leader, if that is within s0 + 1 m, or for another one to leave
    the junction or the link behind it, or to go first, or to leave room on the lane beside.
    """
    event: Event = stepping.event(state, params, torch.ones_like(state.step, dtype=torch.bool))
    own = torch.arange(state.speed.shape[-1], device=state.speed.device).expand(state.speed.shape)
    near = (event.new == 0) & (state.gap < rules_of(stepping, params)[1][1] + 1.0)
    then = torch.where(event.waits >= 0, event.waits.long(), torch.where(near, event.leader, own))
    then = torch.where((event.present > 0) & (state.speed < HALTING), then, own)
    after = then
    for _ in range(own.shape[-1].bit_length()):  # where everybody ends who goes on from one to the next
        after = after.gather(-1, after)
    circle = torch.zeros_like(own).scatter(-1, after, 1)
    return (circle * (then != own)).sum(-1)


class LinkCounts(NamedTuple):
    """Numbers of every link, ``(..., links)``: vehicles there, of these below 0.1 m/s, queued before it; speed (m/s).

    The speed is the mean, and of an empty link its limit.
    """

    vehicles: Tensor
    halting: Tensor
    queued: Tensor
    speed: Tensor


def by_link(network: Network, state: State) -> LinkCounts:
    """Return how many vehicles are on every link, stand there, wait to enter it, and how fast they are."""
    here, ways, lanes = state.present, journeys_of(state), state.lanes
    assert here is not None and lanes is not None
    waits = ((ways.due <= state.clock) & (ways.entered < 0)).to(here.dtype)

    def summed(x: Tensor) -> Tensor:
        zero = x.new_zeros((*x.shape[:-1], len(network.names)))
        return zero.scatter_add(-1, lanes.lane, x)

    vehicles, halting, speed = summed(here), summed(here * (state.speed < HALTING)), summed(here * state.speed)
    limit = torch.from_numpy(network.limit.copy()).to(speed.dtype)
    mean = torch.where(vehicles > 0, speed / vehicles.clamp_min(1.0), limit)
    return LinkCounts(vehicles, halting, summed(waits), mean)


def travel_time(stepping: CarFollowingStep, state: State) -> Tensor:
    """Return each vehicle's time from when it was due to when it left, or until now (s); 0 where it is not due yet."""
    ways = journeys_of(state)
    until = torch.where(ways.left >= 0, ways.left, state.clock)
    return ((until - ways.due).clamp_min(0) * stepping.dt).to(state.speed.dtype)
