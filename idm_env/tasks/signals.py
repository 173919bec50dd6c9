"""Task ``signals``: an agent at every signal of a network chooses which phase is green.

Every ``hold`` seconds an agent names a phase. Where it is another one than now, and may be so yet, whoever loses his
green is shown amber, then the new phase begins. An agent observes what those of sumo-rl do (Alegre 2019,
github.com/LucasAlegre/sumo-rl): its phase (one of P), whether it may change, and of each lane that leads to it how
densely it is filled and how much of it stands.

Shapes: B worlds, N vehicles, L links, S agents, F features of the widest agent; what an agent has less is 0.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch

from idm_env.effects import IDM, Brakes, Effect, LinkLimit, StopLine
from idm_env.multilane.junctions import HALTING, NEVER, journeys_of, of_kinds, showing, travelling
from idm_env.roads.network import Array, Network, padded
from idm_env.roads.network_demand import Demand
from idm_env.roads.ways import Ways, keyed
from idm_env.simulator import Simulator
from idm_env.tasks.behaviour import Behaviour, behaviour
from idm_env.tasks.checks import Range, in_ranges, two_ends
from idm_env.tasks.random import Draw
from idm_env.types import Journeys, State, mapped
from idm_env.validation import one_of, shown

REWARDS = ("unit", "delay", "queue", "pressure")
_ROUTES = 256
"""Routes from each entry, drawn once, among which every vehicle chooses."""


class World(NamedTuple):
    """Traffic, and of each agent the phase and for how long (s) since the change to it began ``(B, S)``."""

    state: State
    phase: Array
    since: Array


class SignalStep(NamedTuple):
    """Rewards of a step (B, S), and for each world (B) the time lost in it (s) and numbers of vehicles after it.

    ``lost`` is the time of all vehicles, those who wait to enter included, less what their way takes at the limits.
    """

    reward: Array
    lost: Array
    inside: Array
    waiting: Array
    halting: Array
    arrived: Array


@dataclass(frozen=True, eq=False, kw_only=True)
class SignalsTask:
    """Signals of a network as agents.

    Args:
        network: ``"grid 5x5"`` (rows × columns), a SUMO ``.net.xml``, or a ``Network``.
        trips: A SUMO ``.rou.xml`` of that network's edges, or None: vehicles arrive at random where links begin.
        inflow: Vehicles per hour and entry where there are no ``trips``.
        turns: Shares of those who turn left, go on and turn right. On one lane few who wait for a gap to turn left stop
            all behind them.
        duration: Length of an episode (s).
        hold: Time for which a phase is kept at least, and between two decisions (s).
        least_green: Least time of green (s).
        amber: Time of amber before another phase begins (s).
        effects: Effects to add to the drivers' own, as for every task.
        parameters: What differs from the drivers' parameters, as for every task.
        dt: Time step (s); None: 0.1, or a model's own.
        randomise: What every episode draws anew: ``{"inflow": [300, 700]}``.
        reward: ``"unit"``: the share of their time that vehicles on the links before an agent did not lose, 0 to 1;
            ``"delay"``: minus the time that they lost (s); ``"queue"``: minus how many stand; ``"pressure"``: how many
            are on the links behind, less those before.

    Raises:
        ValueError: In one line, with value, rule and cure.
    """

    network: str | Path | Network = "grid 5x5"
    trips: str | Path | None = None
    inflow: float = 300.0
    turns: tuple[float, float, float] = (0.0, 0.8, 0.2)
    duration: float = 900.0
    hold: float = 5.0
    least_green: float = 10.0
    amber: float = 3.0
    effects: str | Sequence[str | Mapping[str, Any] | Effect] = ()
    parameters: Mapping[str, Any] | None = None
    dt: float | None = None
    randomise: Mapping[str, Any] | None = None
    reward: str = "unit"

    name: ClassVar[str] = "signals"
    ranges: ClassVar[Mapping[str, Range]] = {
        "inflow": Range(0.0, 3600.0, "veh/h"),
        "duration": Range(1.0, 86_400.0, "s"),
        "hold": Range(0.5, 600.0, "s"),
        "least_green": Range(0.0, 600.0, "s"),
        "amber": Range(0.0, 60.0, "s"),
        "dt": Range(1e-3, 1.0, "s"),
    }

    def __post_init__(self) -> None:
        in_ranges(self)
        one_of("reward", self.reward, REWARDS)
        if self.amber > self.hold:
            raise ValueError(f"amber = {self.amber:g} s must be at most hold = {self.hold:g} s.")
        for name in {*(self.randomise or {})} - {"inflow"}:
            raise ValueError(f"randomise.{shown(name)} cannot be drawn in task 'signals', where inflow can.")
        if self.trips is not None and (self.randomise or self.inflow != SignalsTask.inflow):
            raise ValueError(f"trips = {shown(self.trips)} are all who arrive. Leave out inflow and randomise.")
        if not self.agents:
            raise ValueError(f"network = {shown(self.network)} has no signal with two phases. Give one that has.")
        _ = self.simulator, self.inflows

    # -- static facts ------------------------------------------------------------------------------------------------

    @cached_property
    def _read(self) -> tuple[Network, Demand | None]:
        network = self.network
        if not isinstance(network, Network):
            words = str(network).split()
            sides = words[1].split("x") if len(words) == 2 else []
            if words[:1] != ["grid"]:
                network = Network.from_sumo(network)
            elif len(sides) == 2 and all(side.isdecimal() and 0 < int(side) < 100 for side in sides):
                network = Network.grid(int(sides[0]), int(sides[1]))
            else:
                raise ValueError(f"network = {shown(network)} must be such as 'grid 5x5', 1 to 99 each way.")
        return network, None if self.trips is None else Demand.from_sumo(network, self.trips, end=self.duration)

    @cached_property
    def phases(self) -> tuple[tuple[str, ...], ...]:
        """Of each signal the states of its plan among which an agent chooses: green for somebody, amber for nobody."""
        return tuple(
            tuple(dict.fromkeys(x for x in plan.states if {*x} & {*"Gg"} and not {*x} & {*"yY"}))
            for plan in self._read[0].plans
        )

    @cached_property
    def agents(self) -> tuple[int, ...]:
        """The signals that are agents: those with two phases at least."""
        return tuple(s for s, phases in enumerate(self.phases) if len(phases) > 1)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The agents' names."""
        return tuple(self._read[0].plans[s].name for s in self.agents)

    @cached_property
    def counts(self) -> Array:
        """Number of phases of each agent (S)."""
        return np.array([len(self.phases[s]) for s in self.agents])

    @cached_property
    def road(self) -> Network:
        """The network, whose plans have the agents' phases and the ambers between them beside their own."""
        plans = list(self._read[0].plans)
        for s in self.agents:
            more = tuple(_amber(a, b) for a in self.phases[s] for b in self.phases[s])
            more = (*self.phases[s], *more)
            # Of no duration: the plan itself never shows them.
            plans[s] = plans[s]._replace(
                states=(*plans[s].states, *more), durations=(*plans[s].durations, *[0.0] * len(more))
            )
        return replace(self._read[0], plans=tuple(plans))

    @cached_property
    def _first(self) -> Array:
        """Row of each agent's first phase among the states of its plan (S)."""
        return np.array([len(self._read[0].plans[s].states) for s in self.agents])

    @cached_property
    def lanes(self) -> tuple[Array, ...]:
        """The links that lead to each agent, in the order of their letters: a phase's string says which of them go."""
        net, moves = self.road, (np.flatnonzero(self.road.signal == s) for s in self.agents)
        return tuple(np.array(list(dict.fromkeys(net.start[m[np.argsort(net.index[m])]].tolist()))) for m in moves)

    @cached_property
    def _of_link(self) -> tuple[Array, Array]:
        """The agent before which, and behind which, a link lies (L); S for none."""
        net, before, behind = self.road, *(np.full(len(self.road.names), len(self.agents)) for _ in range(2))
        for k, s in enumerate(self.agents):
            moves = net.signal == s
            inner = net.path[moves]
            before[np.concatenate((net.start[moves], inner[inner >= 0]))] = k
            behind[net.end[moves]] = k
        return before, behind

    @cached_property
    def behaviour(self) -> Behaviour:
        """The drivers, who know limits and lines."""
        own = (IDM(), LinkLimit(), StopLine(), Brakes())
        return behaviour(own, (), {}, self.effects, self.parameters, self.dt, None)

    @cached_property
    def simulator(self) -> Simulator:
        """The simulator of this task."""
        return Simulator(self.road, self.behaviour.effects, self.behaviour.dt, self.behaviour.integration)

    @cached_property
    def params(self) -> dict[str, dict[str, torch.Tensor]]:
        """The parameters of all drivers."""
        values = of_kinds(self.behaviour.params(self.vehicles, torch.float32, "cpu"), self._demand)
        self.simulator.check(values)
        return values

    @property
    def horizon(self) -> int:
        """Steps of an episode."""
        return max(1, round(self.duration / self.hold))

    @cached_property
    def inflows(self) -> tuple[float, float]:
        """Least and most inflow of an episode (vehicles per hour and entry)."""
        low, high = two_ends("randomise.inflow", (self.randomise or {}).get("inflow", (self.inflow,) * 2))
        for end in (low, high):
            self.ranges["inflow"].check("randomise.inflow", end)
        return low, high

    @cached_property
    def vehicles(self) -> int:
        """Slots: as many as arrive at most, but for once in 10⁹ episodes."""
        if self._read[1] is not None:
            return len(self._read[1].route)
        mean = self.inflows[1] * self.duration / 3600.0 * len(self.entries)
        return math.ceil(mean + 6.0 * math.sqrt(mean)) + 1

    @cached_property
    def _ways(self) -> Ways:
        return Ways(self.road)

    @property
    def entries(self) -> list[int]:
        """Links at which vehicles arrive."""
        return list(self._ways.entries.values())

    @cached_property
    def _demand(self) -> Demand:
        """The demand of a file, or slots for arrivals, and the routes among which each chooses."""
        if self._read[1] is not None:
            return self._read[1]
        # As many routes of every entry as of any other: whoever arrives takes one of all.
        routes = [
            self._ways.draw_route(link, self.turns, random)
            for edge, link in self._ways.entries.items()
            for random in [keyed(0, edge)]
            for _ in range(_ROUTES)
        ]
        return Demand(padded(routes), np.zeros(self.vehicles), np.zeros(self.vehicles))

    @cached_property
    def _free_times(self) -> tuple[Array, Array]:
        """Time at the limits before each link of a route, and on all of it (s): ``(R, H)`` and ``(R,)``."""
        routes, net = self._demand.routes, self.road
        each = np.where(routes >= 0, (net.length / net.limit)[routes], 0.0)
        total = each.cumsum(1)
        return total - each, total[:, -1]

    @property
    def features(self) -> int:
        """Length of the widest agent's observation."""
        return int(self.counts.max()) + 1 + 2 * max(map(len, self.lanes))

    # -- pure functions ----------------------------------------------------------------------------------------------

    def begin(self, draw: Draw) -> World:
        """Return worlds at the beginning of an episode: empty, with everybody's departure drawn."""
        rows, agents, journeys = len(draw.key), len(self.agents), journeys_of(self._empty)

        def of_row(x: torch.Tensor) -> torch.Tensor:
            return x.expand(rows, *x.shape).clone()

        plain, lanes = self._empty._replace(lanes=None), self._empty.lanes
        assert lanes is not None
        links = mapped(of_row, lanes._replace(journeys=None))
        ways = Journeys(journeys.routes, *map(of_row, journeys[1:]))
        if self._read[1] is None:
            route, due = self._arrivals(draw)
            links = links._replace(lane=journeys.routes[:, 0][route.long()].long())
            ways = ways._replace(route=route, due=due)
        state = mapped(of_row, plain)._replace(lanes=links._replace(journeys=ways))
        return World(state, np.zeros((rows, agents), np.int64), np.full((rows, agents), math.inf))

    def _arrivals(self, draw: Draw) -> tuple[torch.Tensor, torch.Tensor]:
        """Return of each vehicle which route it takes, and at which step it is due (B, N): a Poisson process."""
        share, gap, choice = (
            draw.stream(f"signals.{what}").uniforms(0, n, torch.float64)
            for what, n in (("inflow", 1), ("gap", self.vehicles), ("route", self.vehicles))
        )
        low, high = self.inflows
        rate = (low + (high - low) * share) * len(self.entries) / 3600.0
        due = (-gap.log()).cumsum(1) / (rate.clamp_min(1e-9) * self.simulator.dt)
        return (choice * len(self._demand.routes)).int(), due.ceil().clamp_max(NEVER).int()

    @cached_property
    def _empty(self) -> State:
        """One world in which everybody waits."""
        return travelling(self.simulator, self._demand, self.params)

    def step(self, world: World, actions: Array | None) -> tuple[World, SignalStep]:
        """Return worlds ``hold`` seconds later, and the outcome; ``actions`` (B, S) are phases.

        None leaves signals to their plans. A phase that an agent has not, or may not change to yet, keeps the present.
        """
        first, dt = world, self.simulator.dt
        held, yellow = round(self.hold / dt), round(self.amber / dt)
        if actions is None:
            world = self._drive(world, np.full_like(world.phase, -1), held)
            return world, self._outcome(first, world)
        changes = (actions != world.phase) & (actions < self.counts) & self.may_change(world)
        then = np.where(changes, actions, world.phase)
        if changes.any():
            between = self._first + np.where(changes, self.counts * (1 + world.phase) + then, then)
            world = self._drive(world, between, yellow)
            held -= yellow
        world = self._drive(world, self._first + then, held)
        world = world._replace(phase=then, since=np.where(changes, 0.0, world.since) + self.hold)
        return world, self._outcome(first, world)

    def may_change(self, world: World) -> Array:
        """Return whether each agent's phase has been green for long enough ``(B, S)``."""
        return world.since >= self.least_green + self.amber

    def _drive(self, world: World, phases: Array, steps: int) -> World:
        """Return worlds some Δt later, in which agents show these phases of their plans (−1: what the plan says)."""
        if steps == 0:
            return world
        every = torch.full((len(phases), len(self.road.plans)), -1)
        every[:, list(self.agents)] = torch.as_tensor(phases)
        state, _ = self.simulator.rollout(showing(world.state, every), {}, self.params, steps, keep=None)
        return world._replace(state=state)

    def observe(self, world: World) -> Array:
        """Return observations ``(B, S, F)``: phase, leave to change it, then density and queue of lanes (0 to 1).

        A lane is full at a vehicle for every 7 m, its length and the room to the next.
        """
        rows, agents = world.phase.shape
        seen = np.zeros((rows, agents, self.features), np.float32)
        most, full = int(self.counts.max()), np.maximum(self.road.length / 7.0, 1.0)
        here = _Here(world.state, np.flatnonzero(_present(world.state).numpy()))
        links = np.arange(n := len(full))
        density, queue = (np.minimum(here.sums(x, links, n) / full, 1.0) for x in (here.inside, here.halting))
        seen[np.arange(rows)[:, None], np.arange(agents), world.phase] = 1.0
        seen[:, :, most] = self.may_change(world)
        widest = (self.features - most - 1) // 2
        for k, lanes in enumerate(self.lanes):
            seen[:, k, most + 1 : most + 1 + len(lanes)] = density[:, lanes]
            seen[:, k, most + 1 + widest : most + 1 + widest + len(lanes)] = queue[:, lanes]
        return seen

    def _free_time(self, here: _Here) -> Array:
        """Return the time that vehicles' ways so far take at the limits (s)."""
        before, total = self._free_times
        time = before[here.route, here.hop] + here.position / self.road.limit[here.link]
        return np.where(here.left, total[here.route], np.where(here.inside, time, 0.0))

    def _outcome(self, first: World, last: World) -> SignalStep:
        """Return the outcome of a step; a vehicle's lost time counts for the agent before which it was at first."""
        begin, end = (int(world.state.step.reshape(-1)[0]) for world in (first, last))
        ways, agents = journeys_of(first.state), len(self.agents)
        # Who is due, and had not left: the rest has nothing to tell.
        some = np.flatnonzero(((ways.due <= end) & (ways.left < 0)).numpy())
        then, now = (_Here(world.state, some) for world in (first, last))
        taken = self.simulator.dt * (np.where(now.left, now.leaves, end) - np.maximum(now.due, begin))
        lost = taken - (self._free_time(now) - self._free_time(then))
        waits = ~(now.inside | now.left)
        before, behind = self._of_link
        delays = then.sums(lost, before, agents + 1)[:, :agents]
        if self.reward == "unit":
            time = then.sums(taken, before, agents + 1)[:, :agents]
            reward = np.clip(1.0 - delays / np.maximum(time, 1e-9), 0.0, 1.0)
        elif self.reward == "delay":
            reward = -delays
        elif self.reward == "queue":
            reward = -now.sums(now.halting, before, agents + 1)[:, :agents]
        else:
            reward = (now.sums(now.inside, behind, agents + 1) - now.sums(now.inside, before, agents + 1))[:, :agents]
        whole = np.zeros_like(before)
        lost, inside, waiting, halting = (now.sums(x, whole, 1)[:, 0] for x in (lost, now.inside, waits, now.halting))
        return SignalStep(reward, lost, inside, waiting, halting, (journeys_of(last.state).left >= 0).sum(-1).numpy())


class _Here:
    """Links, routes and places of some vehicles, given by their index among those of all worlds."""

    def __init__(self, state: State, some: Array) -> None:
        (self.rows, n), journeys = state.position.shape, journeys_of(state)
        assert state.lanes is not None
        own = (state.lanes.lane, *(getattr(journeys, k) for k in ("route", "hop", "due", "left")), *state[:2])
        self.link, self.route, self.hop, self.due, self.leaves, self.position, speed = (
            x.reshape(-1).numpy()[some] for x in own
        )
        self.row, self.inside = some // n, _present(state).reshape(-1).numpy()[some]
        self.left, self.halting = self.leaves >= 0, self.inside & (speed < HALTING)

    def sums(self, weight: Array, group: Array, groups: int) -> Array:
        """Return the sums of weights over the vehicles on links of one group ``(B, groups)``."""
        cells = group[self.link] + groups * self.row
        return np.bincount(cells, weight, self.rows * groups).reshape(self.rows, groups)


def _present(state: State) -> torch.Tensor:
    """Return a mask of the vehicles on the network (bool)."""
    assert state.present is not None
    return state.present > 0


def _amber(now: str, then: str) -> str:
    """Return the state between two phases: amber in place of a green that ends, else the present letters."""
    return "".join("y" if a in "Gg" and b not in "Gg" else a for a, b in zip(now, then, strict=True))
