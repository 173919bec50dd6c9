"""What tasks on a network share: the network, who arrives and how he drives, and what a step cost everybody.

Shapes: B worlds, N vehicles, L links, R routes of at most H links, S agents.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from numbers import Real
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch

from idm_env.effects import IDM, Brakes, Effect, LinkLimit, StopLine
from idm_env.multilane.junctions import HALTING, NEVER, journeys_of, of_kinds, travelling
from idm_env.roads.network import Array, Network, padded
from idm_env.roads.network_demand import Demand, without_turns_back
from idm_env.roads.ways import Ways, keyed
from idm_env.simulator import Simulator
from idm_env.tasks.behaviour import Behaviour, behaviour
from idm_env.tasks.checks import Range, by_name, in_ranges, span
from idm_env.tasks.random import Draw
from idm_env.types import Journeys, State, mapped
from idm_env.validation import nearest, one_of, shown

_ROUTES = 256
"""Routes from each entry, drawn once, among which every vehicle chooses."""
NAMED: dict[str, Callable[[], Network]] = {"roundabout": Network.roundabout, "figure eight": Network.figure_eight}
"""Networks by name, beside grids and ``"crossing"``, a grid of one."""


class NetworkStep(NamedTuple):
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
class NetworkTask:
    """Static choices that all tasks on a network have; docs are those of the tasks."""

    network: str | Path | Network = "grid 5x5"
    trips: str | Path | None = None
    inflow: float = 300.0
    turns: tuple[float, float, float] = (0.0, 0.8, 0.2)
    duration: float = 900.0
    hold: float = 5.0
    effects: str | Sequence[str | Mapping[str, Any] | Effect] = ()
    parameters: Mapping[str, Any] | None = None
    dt: float | None = None
    randomise: Mapping[str, Any] | None = None
    reward: str = "unit"

    name: ClassVar[str]
    rewards: ClassVar[tuple[str, ...]]
    """Names of rewards."""
    machinery: ClassVar[tuple[Effect, ...]] = ()
    """Effects through which agents act."""
    control: ClassVar[str]
    """What rules at junctions of networks by name."""
    actions: ClassVar[str]
    """What actions are."""
    counts: ClassVar[Array | None] = None
    """Number of actions of each agent (S); None for one number from −1 to 1."""
    ranges: ClassVar[Mapping[str, Range]] = {
        "inflow": Range(0.0, 3600.0, "veh/h"),
        "duration": Range(1.0, 86_400.0, "s"),
        "hold": Range(0.5, 600.0, "s"),
        "dt": Range(1e-3, 1.0, "s"),
    }

    def __post_init__(self) -> None:
        for name, kinds, rule in (
            ("network", (str, os.PathLike, Network), "a name such as 'grid 5x5', the path of a .net.xml, or a Network"),
            ("trips", (str, os.PathLike, type(None)), "the path of a .rou.xml, or None"),
        ):
            if not isinstance(value := getattr(self, name), kinds) or value == "":
                raise ValueError(f"{name} = {shown(value)} must be {rule}.")
        in_ranges(self)
        one_of("reward", self.reward, self.rewards)
        turns = [x for x in self.turns if isinstance(x, Real)] if isinstance(self.turns, Sequence) else []
        if len(turns) != 3 or len(self.turns) != 3 or not (min(turns) >= 0.0 and 0.0 < sum(turns) < 1e9):
            raise ValueError(f"turns = {shown(self.turns)} must be three numbers from 0 on: left, straight on, right.")
        for name in {*by_name("randomise", {} if self.randomise is None else self.randomise)} - {"inflow"}:
            raise ValueError(f"randomise.{shown(name)} cannot be drawn in task '{self.name}', where inflow can.")
        if self.trips is not None:
            self.leave_out(f"trips = {shown(self.trips)} are all who arrive", "inflow", "turns", "randomise")

    def leave_out(self, reason: str, *names: str) -> None:
        """Raise ValueError for options that change nothing, and are not what they are by default."""
        for name in names:
            if (value := getattr(self, name)) != getattr(type(self), name) and value != {}:
                raise ValueError(f"{name} = {shown(value)} changes nothing: {reason}. Leave {name} out.")

    # -- static facts ------------------------------------------------------------------------------------------------

    @cached_property
    def _read(self) -> tuple[Network, Demand | None]:
        network = self.network
        if not isinstance(network, Network):
            name = "grid 1x1" if network == "crossing" else str(network)
            if name in NAMED:
                network = NAMED[name]()
            elif size := re.fullmatch(r"grid (\d+)x(\d+)(?:x(\d+))?", name):
                rows, columns, lanes = (int(x or 1) for x in size.groups())
                network = Network.grid(rows, columns, lanes=lanes, control=self.control)
            elif os.path.isfile(name):
                network = Network.from_sumo(name)
            else:
                near = nearest(name, ("crossing", *NAMED, "grid 5x5"))
                raise ValueError(f"network = {shown(name)} is neither a file nor a name.{near}")
        return network, None if self.trips is None else Demand.from_sumo(network, self.trips, end=self.duration)

    @property
    def road(self) -> Network:
        """The network."""
        return self._read[0]

    @cached_property
    def behaviour(self) -> Behaviour:
        """The drivers, who know limits and lines."""
        own = (IDM(), LinkLimit(), StopLine(), Brakes())
        return behaviour(own, self.machinery, {}, self.effects, self.parameters, self.dt, None)

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
        inflow, limits = (self.randomise or {}).get("inflow", self.inflow), NetworkTask.ranges["inflow"]
        return span("randomise.inflow", inflow, limits.low, limits.unit, limits.high)

    @cached_property
    def vehicles(self) -> int:
        """Slots: as many as arrive at most, but for once in 10⁹ episodes."""
        if self._read[1] is not None:
            return len(self._read[1].route)
        mean = self.inflows[1] * self.duration / 3600.0 * len(self._ways.entries)
        return math.ceil(mean + 6.0 * math.sqrt(mean)) + 1

    @cached_property
    def _ways(self) -> Ways:
        return Ways(without_turns_back(self.road))

    @property
    def is_closed(self) -> bool:
        """Whether vehicles only go round."""
        return not (self.trips or self._ways.entries)

    @cached_property
    def _demand(self) -> Demand:
        """The demand of a file, or slots for arrivals, and the routes among which each chooses."""
        if self._read[1] is not None:
            return self._read[1]
        # As many routes of every entry as of any other: whoever arrives takes one of all.
        random = {edge: keyed(0, edge) for edge in self._ways.entries}
        routes = [self._ways.draw_route(edge, self.turns, x) for edge, x in random.items() for _ in range(_ROUTES)]
        return Demand(padded(routes), np.zeros(self.vehicles), np.zeros(self.vehicles))

    @cached_property
    def _free_times(self) -> tuple[Array, Array]:
        """Time at the limits before each link of a route, and on all of it (s): ``(R, H)`` and ``(R,)``."""
        each = self.road.times(self._demand.routes)
        total = each.cumsum(1)
        return total - each, total[:, -1]

    # -- pure functions ----------------------------------------------------------------------------------------------

    def check_actions(self, actions: Any, shape: tuple[int, ...]) -> Array:
        """Return actions as an array of this shape. ValueError for another shape or type."""
        try:
            array = np.asarray(actions)
        except ValueError:  # rows of several lengths
            array = np.array(None)
        if array.shape != shape or not self.are_actions(array):
            raise ValueError(f"actions {shown(actions)} must be {self.actions}, of shape {shape}.")
        return array

    def are_actions(self, array: Array) -> bool:
        """Return whether all of an array, of any type, are actions."""
        raise NotImplementedError

    def begin_state(self, draw: Draw) -> State:
        """Return worlds at the beginning of an episode: empty, with everybody's departure drawn."""
        rows, journeys = len(draw.key), journeys_of(self._empty)

        def of_row(x: torch.Tensor) -> torch.Tensor:
            return x.expand(rows, *x.shape).clone()

        plain, lanes = self._empty._replace(lanes=None), self._empty.lanes
        assert lanes is not None
        links = mapped(of_row, lanes._replace(journeys=None))
        ways = Journeys(*journeys[:2], *map(of_row, journeys[2:]))
        if self._read[1] is None:
            route, due = self._arrivals(draw)
            links = links._replace(lane=journeys.routes[:, 0][route.long()].long())
            ways = ways._replace(route=route, due=due)
        return mapped(of_row, plain)._replace(lanes=links._replace(journeys=ways))

    def _arrivals(self, draw: Draw) -> tuple[torch.Tensor, torch.Tensor]:
        """Return of each vehicle which route it takes, and at which step it is due (B, N): a Poisson process."""
        sizes = {"inflow": 1, "gap": self.vehicles, "route": self.vehicles}
        share, gap, choice = (draw.stream(f"{self.name}.{k}").uniforms(0, n, torch.float64) for k, n in sizes.items())
        (low, high), entries = self.inflows, len(self._ways.entries)
        # Those who go round enter as soon as there is room.
        rate = torch.ones_like(share) if self.is_closed else (low + (high - low) * share) * entries / 3600.0
        due = (-gap.log()).cumsum(1) / (rate.clamp_min(1e-9) * self.simulator.dt)
        return (choice * len(self._demand.routes)).int(), due.ceil().clamp_max(NEVER).int()

    @cached_property
    def _empty(self) -> State:
        """One world in which everybody waits."""
        return travelling(self.simulator, self._demand, self.params)

    def free_time(self, here: Here) -> Array:
        """Return the time that vehicles' ways so far take at the limits (s)."""
        before, total = self._free_times
        time = before[here.route, here.hop] + here.position / self.road.limit[here.link]
        return np.where(here.left, total[here.route], np.where(here.inside, time, 0.0))

    def tally(self, first: State, last: State) -> tuple[Here, Here, Array, Array, NetworkStep]:
        """Return vehicles that were due, then and now, time taken and lost by each (s), and a step without rewards."""
        begin, end = (int(state.step.reshape(-1)[0]) for state in (first, last))
        ways = journeys_of(first)
        # Who is due, and had not left: the rest has nothing to tell.
        some = np.flatnonzero(((ways.due <= end) & (ways.left < 0)).numpy())
        then, now = (Here(state, some) for state in (first, last))
        taken = self.simulator.dt * (np.where(now.left, now.leaves, end) - np.maximum(now.due, begin))
        lost = taken - (self.free_time(now) - self.free_time(then))
        whole, waits = np.zeros(len(self.road.names), np.int64), ~(now.inside | now.left)
        figures = [now.sums(x, whole, 1)[:, 0] for x in (lost, now.inside, waits, now.halting)]
        step = NetworkStep._make([taken, *figures, (journeys_of(last).left >= 0).sum(-1).numpy()])
        return then, now, taken, lost, step


class Here:
    """Links, routes and places of some vehicles, given by their index among those of all worlds."""

    def __init__(self, state: State, some: Array) -> None:
        (self.rows, n), journeys, self.some = state.position.shape, journeys_of(state), some
        assert state.lanes is not None
        own = (state.lanes.lane, *(getattr(journeys, k) for k in ("route", "hop", "due", "left")), *state[:2])
        self.link, self.route, self.hop, self.due, self.leaves, self.position, speed = (
            x.reshape(-1).numpy()[some] for x in own
        )
        self.row, self.inside = some // n, present_in(state).reshape(-1).numpy()[some]
        self.left, self.halting = self.leaves >= 0, self.inside & (speed < HALTING)

    def sums(self, weight: Array, group: Array, groups: int) -> Array:
        """Return the sums of weights over the vehicles on links of one group ``(B, groups)``."""
        cells = group[self.link] + groups * self.row
        return np.bincount(cells, weight, self.rows * groups).reshape(self.rows, groups)


def present_in(state: State) -> torch.Tensor:
    """Return a mask of the vehicles on the network (bool)."""
    assert state.present is not None
    return state.present > 0
