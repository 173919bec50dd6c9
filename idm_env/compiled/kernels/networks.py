"""Networks for the compiled loops: tables, rows of a state, and rollouts from one event to the next.

Without a graph rows run in place (``network_rows``). With one, or where an effect has a past or memory of its own, rows
are laid out as chains and run by the kernel of lanes, an event of ``multilane.junctions`` between two such runs.

Shapes: what belongs to vehicles is ``[..., n]``, in SI units.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from idm_env.compiled.kernels import lanes, network_rows, threads as pool, tiles
from idm_env.compiled.kernels.memory import addresses
from idm_env.compiled.kernels.network_loops import CAR, CIRCLE, GATED, TAG, K, W
from idm_env.compiled.kernels.network_rows import LEADS, LED, Operands
from idm_env.compiled.kernels.operands import operand, table
from idm_env.compiled.kernels.printed import TileKernel, tile_kernel
from idm_env.compiled.kernels.several import _cut, _placed, _row, between
from idm_env.compiled.kernels.tiles import Array
from idm_env.compiled.kernels.workspace import take
from idm_env.compiled.scalar.record import Form
from idm_env.multilane import before
from idm_env.multilane.junctions import DECIDED, Event, every, guided, rules_of
from idm_env.roads.chains import Places
from idm_env.roads.network import Network
from idm_env.types import Inputs, Params, State

if TYPE_CHECKING:
    from idm_env.simulator import Simulator
    from idm_env.step import CarFollowingStep

WIDE = tiles.TILE
"""Places of a tile of a row."""

STATE_CAR, STATE_TAG = CAR.index("limit") + 1, TAG.index("left") + 1
"""How many of the names are state."""

MOVING = ("position", "speed", "accel", "gap")
"""What steps change."""

KINDS = {"reserved": torch.bool} | dict.fromkeys(("link", "leader", "follower"), torch.int64)
"""Whole numbers that a state has in another form."""


@dataclass(frozen=True)
class NetworkRows:
    """A state's rows in the layout of ``network_loops``: cars and tags ``[rows, n, W]``, and tables for events."""

    cars: Array
    tags: Array
    road: Array
    site: Array
    move: Array
    against: Array
    routes: Array
    others: Array
    rules: Array
    drivers: Array
    plans: tuple[Array, ...]
    phases: Array

    @classmethod
    def copied(cls, stepping: CarFollowingStep, state: State, params: Params) -> NetworkRows:
        """Return copies of all that a state says."""
        network, links = stepping.road, state.lanes
        assert isinstance(network, Network) and links is not None and links.journeys is not None
        ways, shape, kind = links.journeys, state.speed.shape, state.speed.detach().numpy().dtype
        rows, n = state.speed.numel() // shape[-1], shape[-1]
        cars, tags = take((rows, n, W), kind), take((rows, n, W), np.dtype(np.int32))
        parts = {"link": links.lane, **ways._asdict(), **links._asdict(), **state._asdict()}
        parts |= dict.fromkeys(("stop", "limit"), state.speed)
        parts |= {what: state.memory[effect.name] for what, effect in guided(stepping).items()}
        for to, names in ((cars, CAR[:STATE_CAR]), (tags, TAG[:STATE_TAG])):
            columns = [operand(parts[k].to(torch.from_numpy(to).dtype), shape[:-1], n) for k in names]
            strides = table([by for _, by in columns])
            network_rows.pack(to.reshape(-1), addresses([x for x, _ in columns]), strides[:, 1], strides[:, 2], rows, n)
        phases = ways.phases.expand(*shape[:-1], len(network.plans)).reshape(rows, -1).contiguous().numpy()
        road, site, move, against, plans = _tables(network, kind)
        rules, drivers = _rules(stepping, params, state)
        routes = ways.routes.contiguous().numpy()
        others = ways.others.contiguous().numpy()
        return cls(cars, tags, road, site, move, against, routes, others, rules, drivers, plans, phases)

    def tables(self) -> tuple[tuple[Any, ...], tuple[Array, ...], Array]:
        """Return the arguments of an event, with room of its own for its findings."""
        links, wide, foes = len(self.site) - 1, self.routes.shape[1], self.against.shape[2]
        sizes = self.cars.shape[1], links, len(self.move), wide, foes, self.drivers.shape[2], self.others.size
        own = (x.copy() for x in (self.road, self.site, self.move))
        tables = sizes, self.cars, self.tags, *own, self.against, self.routes, self.others, self.rules, self.drivers
        return tables, tuple(x.copy() for x in self.plans), self.phases

    def parts(self, names: Sequence[str], shape: torch.Size) -> dict[str, Tensor]:
        """Return some parts of the state, ``(..., n)``, as they are now."""
        out: dict[str, Tensor] = {}
        for source, columns_of in ((self.cars, CAR), (self.tags, TAG)):
            mine = [name for name in names if name in columns_of]
            columns = [np.empty(shape.numel(), source.dtype) for _ in mine]
            which = np.array([columns_of.index(name) for name in mine], np.int64)
            network_rows.unpack(source.reshape(-1), which, addresses(columns), *source.shape[:2])
            out |= {name: torch.from_numpy(x).view(shape) for name, x in zip(mine, columns, strict=True)}
        return {name: x.to(KINDS.get(name, x.dtype)) for name, x in out.items()}


def _tables(network: Network, kind: np.dtype) -> tuple[Any, ...]:
    """Return a network as its loops read it, made once for each precision."""
    tables_by_kind = network.__dict__.setdefault("_tables", {})
    if kind.name in tables_by_kind:
        return tables_by_kind[kind.name]
    links, moves = len(network.names), len(network.start)
    road, site = np.zeros((links, K), kind), np.zeros((links + 1, K), np.int32)
    road[:, 0], road[:, 1] = network.length, network.limit
    gated, open_ways = (np.flatnonzero((network.path[:, 0] >= 0) == x) for x in (True, False))
    road[network.end[open_ways], 4] = 1.0
    site[:, 0], site[:-1, 1], site[:-1, 2] = -1, network.move_of, np.where(network.inner, -1, network.left)
    site[network.start[gated], 0], site[network.path[gated, 0], 0] = GATED, gated
    move = np.zeros((moves, K), np.int32)
    move[:, :4] = np.stack((network.start, network.end, network.signal, network.index), 1)
    for circle in network.circles:
        move[circle, 2] = CIRCLE
    against = np.full((2, moves, max(network.foes.shape[1], network.yields.shape[1])), -1, np.int32)
    against[0, :, : network.foes.shape[1]], against[1, :, : network.yields.shape[1]] = network.foes, network.yields
    shows, first = network.shows
    until = np.concatenate([np.zeros(0), *(np.cumsum(plan.durations) for plan in network.plans)])
    offsets = np.array([plan.offset for plan in network.plans], float)
    plans = shows, first.astype(np.int64), until, offsets, np.zeros(len(offsets), np.int64)
    return tables_by_kind.setdefault(kind.name, (road, site, move, against, plans))


def _rules(stepping: CarFollowingStep, params: Params, state: State) -> tuple[Array, Array]:
    """Return the rules at junctions, and T, s0, b and a: (1, 4, 1) where all have the same, else (rows, 4, n)."""
    stop, drivers = rules_of(stepping, params)
    like = state.speed
    alike = all(x.numel() == 1 for x in drivers)
    full = (
        x.detach().reshape(1, 1) if alike else x.detach().expand(like.shape).reshape(-1, like.shape[-1])
        for x in drivers
    )
    values = torch.stack([x.to(like.dtype) for x in full], 1).numpy()
    rules = stop.most_decel, stop.critical_gap, stop.sight, stop.reach, stop.every, 0.5 / stop.most_decel
    longest = state.length.detach().expand(like.shape).amax(-1).reshape(-1, 1).numpy()
    fixed = np.array([[*rules, 1.5 * stop.every**2 + 0.3]], values.dtype)  # at 3 m/s² at most
    return np.concatenate((fixed.repeat(len(longest), 0), longest + values.dtype.type(7.0)), 1), values


def clocks_of(state: State) -> Array:
    """Return the step of every row."""
    return state.step.expand(state.speed.shape[:-1]).reshape(-1).numpy().astype(np.int64)


def event(stepping: CarFollowingStep, state: State, params: Params, now: Tensor) -> Event:
    """Return the decisions of an event in the rows where it is ``now``, ``(..., n)`` each; elsewhere nothing is new."""
    rows, shape = NetworkRows.copied(stepping, state, params), state.speed.shape
    rows.cars[..., STATE_CAR:], rows.tags[..., STATE_TAG:] = 0, 0
    rows.tags[..., TAG.index("waits")] = -1
    which = np.flatnonzero(now.expand(shape[:-1]).reshape(-1).numpy())
    network_rows.events(which, clocks_of(state), stepping.dt, *rows.tables())
    return Event(**rows.parts(Event._fields, shape))


# -- rollouts --------------------------------------------------------------------------------------------------------


def kernel_of(simulator: Simulator, state: State, inputs: Inputs) -> TileKernel | str:
    """Return the kernel of the steps between two events, or why there is none."""
    if state.lanes is None or state.lanes.journeys is None:
        return "nobody has a route"
    kernel = tile_kernel(between(simulator), Form.of(state._replace(lanes=None), inputs))
    if not isinstance(kernel, str) and "leads" in (*kernel.program.statics, *kernel.program.states):
        return "an effect looks back, and on networks several vehicles may be behind one"
    return kernel


def rollout(
    kernel: TileKernel, simulator: Simulator, state: State, inputs: Inputs, params: Params, steps: int, keep: bool
) -> tuple[State, tuple[Tensor, ...] | None]:
    """Do what ``Simulator.rollout`` does, shapes as there."""
    plain = not keep and not kernel.signals and not kernel.flags and not _differentiated(kernel, state, inputs, params)
    if plain and set(state.memory) <= {effect.name for effect in guided(simulator).values()}:
        return _in_place(kernel, simulator, state, inputs, params, steps), None
    inner, after = between(simulator), every(simulator)
    motions: list[tuple[Tensor, ...]] = []
    done, clocks = 0, clocks_of(state)
    while done < steps:
        state = before(simulator, state, _cut(inputs, done, None), params)
        count = min(int((after - (clocks + done) % after).min()), steps - done)
        places, here = chains_of(simulator, state, params, tiles.halo(count, kernel.program.reach))
        own_inputs = {name: _placed(_cut(x, done, count), places, state, 1) for name, x in inputs.items()}
        end, some = lanes.rollout(
            kernel, inner, _row(state, places), own_inputs, _placed(params, places, state), count, keep=keep
        )

        def in_slots(x: Tensor, old: Tensor, places: Places = places, here: Tensor = here) -> Tensor:
            slots = places.own.expand(*x.shape[: x.dim() - places.own.dim()], *places.own.shape)
            return torch.where(here, x.gather(-1, slots), old)

        if some is not None:
            motions.append(tuple(in_slots(x, getattr(state, n)) for n, x in zip(MOVING, some, strict=True)))
        memory = {n: _memory_back(end.memory[n], x, places, here) for n, x in state.memory.items()}
        moved: dict[str, Any] = {n: in_slots(getattr(end, n), getattr(state, n)) for n in MOVING}
        state = state._replace(**moved, step=end.step, memory=memory)
        done += count
    return state, tuple(torch.cat(column) for column in zip(*motions, strict=True)) if keep else None


def _memory_back(x: Tensor, old: Tensor, places: Places, here: Tensor) -> Tensor:
    """Return a memory, or the past, of those who were laid out in their slots, and the old one of all others."""
    index, mask = places.own, here
    for _ in range(x.dim() - index.dim()):
        index, mask = index.unsqueeze(-1), mask.unsqueeze(-1)
    if x.dim() > places.own.dim():
        dim = -1 - (x.dim() - places.own.dim())
        return torch.where(mask, x.gather(dim, index.expand(*places.own.shape, *x.shape[dim + 1 :])), old)
    return torch.where(mask, x.expand(*index.shape[:-1], x.shape[-1]).gather(-1, index), old)


def _differentiated(kernel: TileKernel, state: State, inputs: Inputs, params: Params) -> bool:
    """Whether a gradient may be asked for."""
    if not torch.is_grad_enabled():
        return False
    sources = [*lanes.starts(state, kernel.program.moving), *(lanes.part_of(inputs, n) for n in kernel.numbers)]
    return any(x.requires_grad for x in (*sources, *(x for each in params.values() for x in each.values())))


def chains_of(simulator: Simulator, state: State, params: Params, halo: int) -> tuple[Places, Tensor]:
    """Return where vehicles lie in rows of chains until the next event, and a mask of these (bool, ``(..., n)``)."""
    assert state.present is not None
    rows = NetworkRows.copied(simulator, state, params)
    count, n, _ = rows.cars.shape
    here, kind, shape = state.present > 0, rows.cars.dtype, state.speed.shape
    wide = 64 + 2 * int(here.sum(-1).max())
    while not network_rows.laid(
        halo, wide, rows.tables()[0], paths := _paths(kind, (count, n), (count, wide), (count, 8))
    ):
        wide *= 2
    slots, led, leads = (torch.from_numpy(x).view(*shape[:-1], wide) for x in (paths[0], *paths[2:4]))
    own = torch.where(here, torch.from_numpy(paths[5]).view(shape), 0)
    return Places(slots, own, led, leads, None), here


def _paths(kind: np.dtype, n: Any, wide: Any, tiles: Any) -> tuple[Array, ...]:
    """Return room for layouts."""
    kinds = np.int64, np.int64, kind, kind, np.uint8, np.int64, np.int64
    return tuple(np.zeros(*each) for each in zip((*(wide,) * 5, n, tiles), kinds, strict=True))


def _in_place(
    kernel: TileKernel, simulator: Simulator, state: State, inputs: Inputs, params: Params, steps: int
) -> State:
    """Return the state after some steps, without a graph."""
    rows = NetworkRows.copied(simulator, state, params)
    count, n, _ = rows.cars.shape
    plan, held = _plan(kernel, simulator, state, inputs, params, steps, rows.cars)
    after, clocks = every(simulator), clocks_of(state)
    halo = tiles.halo(min(after, steps), kernel.program.reach)
    # At worst everybody has copies of his leaders ahead.
    room = -(-n * (halo + 1) // (WIDE - halo)) + 1

    def run(begin: int, end: int) -> None:
        paths = _paths(rows.cars.dtype, n, room * WIDE, room)
        network_rows.run(begin, end, clocks, steps, after, simulator.dt, halo, WIDE, *rows.tables(), paths, plan)

    vehicles = int((rows.cars[..., CAR.index("present")] > 0).sum())
    pool.split(run, count, 1, pool.count(steps * vehicles))
    del held
    links, shape = state.lanes, state.speed.shape
    assert links is not None and links.journeys is not None
    now = rows.parts((*MOVING, *Event._fields[4:-1]), shape)
    ways = links.journeys._replace(**{k: now[k] for k in DECIDED})
    links = links._replace(lane=now["link"], leader=now["leader"], follower=now["follower"], journeys=ways)
    memory = {effect.name: now[what] for what, effect in guided(simulator).items()}
    moved: dict[str, Any] = {k: now[k] for k in (*MOVING, "present")}
    return state._replace(**moved, step=state.step + steps, memory=memory, lanes=links)


def _plan(
    kernel: TileKernel, simulator: Simulator, state: State, inputs: Inputs, params: Params, steps: int, cars: Array
) -> tuple[Operands, list[Array]]:
    """Return the operands of a step, and the arrays to keep alive."""
    program, n, batch, held = kernel.program, state.speed.shape[-1], state.speed.shape[:-1], list[Array]()
    named = {f"memory of {effect.name}": what for what, effect in guided(simulator).items()}
    rows = [CAR.index(named.get(name, name)) if name != "step" else -1 for name in program.states]
    states = np.array([0 if i < 0 else addresses([cars[..., i]])[0] for i in rows], np.int64)
    written = [i for i, name in enumerate(program.states) if name in MOVING]
    places, strides = list[int](), list[tuple[int, int, int]]()
    for name in (*program.statics, *program.parameters, *kernel.numbers):
        if name in ("led", "leads"):
            places.append(LED if name == "led" else LEADS)
            strides.append((0, 0, 0))
            continue
        if name in kernel.numbers:
            array, by = operand(lanes.part_of(inputs, name), batch, n, steps)
        else:
            x = torch.ones(()) if name == "present" else lanes.static_of(between(simulator), state, params, name)
            array, by = operand(x.to(state.speed.dtype), batch, n)
        held.append(array)
        places.append(int(addresses([array])[0]))
        strides.append(by)
    kind = cars.dtype.name
    return Operands(
        states, n * W, kernel.read, np.array(written, np.int64), np.array(places, np.int64), table(strides),
        kernel.measures, kernel.forward(kind), kernel.looks, kernel.recalls, kernel.constants[kind],
    ), held  # fmt: skip
