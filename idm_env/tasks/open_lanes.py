"""Tasks ``open_highway``, ``merge``, ``bottleneck``: traffic flows in, changes lanes, some of which end, and leaves."""

from __future__ import annotations

import abc
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import torch
from torch import Tensor

from idm_env.effects import IDM, Brakes, Courtesy, Effect, GapAcceptance, MandatoryChange, Mobil
from idm_env.multilane import demand
from idm_env.roads import Lanes, lane_drop, on_ramp
from idm_env.tasks.base import World
from idm_env.tasks.checks import Range, at_least
from idm_env.tasks.lanes import FASTEST, LanesTask
from idm_env.tasks.random import Draw
from idm_env.types import Params, State, Trips

_PLACE_STREAM = 37
_FLOW = Range(0.0, 1e5, "vehicles an hour")
_SIGHT = 500.0
"""How far ahead an agent sees that its lane ends (m)."""


@dataclass(frozen=True, eq=False, kw_only=True)
class OpenLanesTask(LanesTask):
    """Trips begin evenly in time, lane by lane, and slots make them again and again, so that an episode has no end.

    An episode begins with free traffic up to ``filled``, where lanes are still all there; the first slots are in front.
    Whoever finds no room at his entry waits and is counted (``multilane.demand.counts``). Agents act as ``LanesTask``
    says; while an agent's vehicle waits or has left, it stands still, its observation and infos are zeros, and its
    command does and costs nothing: its reward is what the traffic earns.

    Drivers let in whoever signals, accept closer gaps near the end of a lane and where they have stood
    (``GapAcceptance``), and take turns at an end as at a zipper (``Courtesy``, ``MandatoryChange``).

    Observation, per agent: own speed, lane, 1 if it is on the road, how far its lane goes on (m, at most 500); then the
    nearest vehicles as in ``highway``. Reward, per agent: ``V/40 − 0.1 (u/u_max)²``, V the sum of the speeds of all on
    the road over the number of these and of those queued: keeping others out pays nothing. Terminated where vehicles
    touch, or an agent drives over the end of a lane, which pays ``−crash_cost`` instead (``idm_env.tasks.crash``). Cut
    off after 3000 steps.
    """

    own_effects: ClassVar[tuple[Effect, ...]] = (
        IDM(), Mobil(), MandatoryChange(), GapAcceptance(), Courtesy(), Brakes(),
    )  # fmt: skip
    own_parameters: ClassVar = {
        "idm": {"max_accel": 1.5, "comfort_decel": 2.0, "time_gap": 1.2, "min_gap": 2.0, "desired_speed": 30.0},
        "mandatory_change": {"turns": 1.0},
        "courtesy": {"weight": 1.0, "zipper": 1.0},
    }

    ranges: ClassVar[Mapping[str, Range]] = {"entry_speed": Range(1.0, 70.0, "m/s"), "inflow": _FLOW}

    vehicles: int = 80
    controlled: int | float | str | Sequence[int] = (4,)
    entry_speed: float = 20.0

    def __post_init__(self) -> None:
        super().__post_init__()
        flows = self.inflows
        total = sum(flows.values())
        for lane, flow in flows.items():
            at_least(f"inflow of lane {lane}", flow, 1.0, "vehicles an hour")
            if self.vehicles * flow < total:
                raise ValueError(
                    f"vehicles = {self.vehicles} leaves none for lane {lane}, where {flow:g} of {total:g} vehicles an "
                    f"hour enter. Take at least {math.ceil(total / flow)}, or a less uneven inflow."
                )

    @property
    @abc.abstractmethod
    def inflows(self) -> Mapping[int, float]:
        """Vehicles an hour that want to enter each lane."""

    @property
    @abc.abstractmethod
    def filled(self) -> float:
        """Up to where vehicles are when an episode begins (m)."""

    def _trips(self, draw: Draw, dtype: torch.dtype) -> Trips:
        """Return trips, of which the first ones began before the episode did; each up to a quarter aside in time."""
        flows, total = self.inflows, sum(self.inflows.values())
        counts = {k: max(1, round(self.vehicles * flow / total)) for k, flow in flows.items()}
        departs, again, lane = demand.evenly(flows, counts, first=0)
        by_time = sorted(range(len(departs)), key=lambda i: departs[i])[: self.vehicles]
        while len(by_time) < self.vehicles:  # shares that are rounded down leave a slot to spare: it never drives
            by_time.append(-1)
        columns = [[*x, y] for x, y in ((departs, math.inf), (again, math.inf), (lane, 0))]
        device = draw.key.device
        first, more, at = (torch.tensor([c[i] for i in by_time], dtype=torch.float64, device=device) for c in columns)
        interval = torch.tensor([3600.0 / flows.get(int(k), math.inf) for k in at], dtype=torch.float64, device=device)
        aside = 0.5 * (draw.uniforms(_PLACE_STREAM, self.vehicles, torch.float64) - 0.5)
        shape = tuple(aside.shape)
        departs_at = first + interval * (aside + 0.25) - self.filled / self.entry_speed
        none = torch.zeros(shape, dtype=torch.int64, device=device)
        return Trips(
            departs_at.to(dtype), more.to(dtype).expand(shape), at.long().expand(shape),
            torch.full(shape, self.entry_speed, dtype=dtype, device=device), none, none.clone(),
        )  # fmt: skip

    def begin(self, draw: Draw, params: Params) -> World:
        """Return free traffic up to ``filled``, and everybody else waiting."""
        like = self.like(params)
        trips = self._trips(draw, like.dtype)
        inside = trips.departs < 0
        begins = self.road.at_lane(trips.lane, trips.departs, "begins")
        place = torch.where(inside, begins - trips.departs * self.entry_speed, begins)
        inside = inside & (place < self.filled)
        state = self.simulator.state(
            torch.where(inside, place, begins), trips.speed, params, length=self.vehicle_length,
            present=inside.to(like.dtype), lane=trips.lane,
            step=torch.full((len(place),), -self.warmup, device=like.device),
        )  # fmt: skip
        return World(state._replace(trips=trips._replace(entered=inside.long())), {})

    @property
    def own_features(self) -> tuple[tuple[str, float, float, float], ...]:
        """As in ``LanesTask``, and whether one is on the road, and how far one's lane goes on."""
        return (*super().own_features, ("present", 1.0, 0.0, 1.0), ("ends", 100.0, 0.0, _SIGHT))

    def seen_of_self(self, state: State) -> list[Tensor]:
        """Return ``own_features``."""
        assert state.links is not None and state.present is not None
        ends = (self.road.closed_at(state.links.lane, state.position) - state.position).clamp(0.0, _SIGHT)
        return [*super().seen_of_self(state), self.pick(state.present), self.pick(ends)]

    def told(self, world: World) -> dict[str, Tensor]:
        """As in ``LanesTask``, and how many wait at the entries: a queue that grows is an inflow beyond capacity."""
        queued = demand.counts(self.simulator, world.state).queued
        return {**super().told(world), "queued": queued.unsqueeze(-1).expand(-1, len(self.agents)).contiguous()}

    def earned(self, before: World, command: Tensor, after: World) -> Tensor:
        """Return ``V/40 − 0.1 (u/u_max)²``."""
        state = after.state
        assert state.present is not None
        found = demand.counts(self.simulator, state)
        pace = (state.speed.clamp_max(FASTEST) * state.present).sum(-1) / (found.inside + found.queued).clamp_min(1)
        hardest = max(abs(limit) for limit in self.command_limits)
        return pace.unsqueeze(-1) / FASTEST - 0.1 * (command / hardest).square().clamp_max(1.0)

    def crashed(self, world: World) -> Tensor:
        """Return whose episodes end in a crash: of all, where vehicles touch or one drives over the end of its lane."""
        crashed = super().crashed(world)
        return crashed | self._over(world.state).any(-1, keepdim=True).expand_as(crashed)

    def _over(self, state: State) -> Tensor:
        """Return which vehicles have driven over the end of their lane (bool)."""
        assert state.links is not None and state.present is not None
        return (state.position > self.road.closed_at(state.links.lane, state.position)) & (state.present > 0)

    def crash_reason(self, world: World, row: int, agent: int | None = None) -> str:
        """As ``Task`` says; or who has driven over the end of which lane, where nobody has touched anybody."""
        state, over = world.state, self._over(world.state)[row]
        if float(state.gap[row].min()) <= 0.0 or not bool(over.any()):
            return super().crash_reason(world, row, agent)
        vehicle = int(over.int().argmax())
        assert state.links is not None
        who = f"vehicle {vehicle}" + (" (an agent)" if vehicle in self.agents else "")
        seconds = float(state.step[row]) * self.simulator.dt
        return f"{who} drove over the end of lane {int(state.links.lane[row, vehicle])} after {seconds:.1f} s"


@dataclass(frozen=True, eq=False, kw_only=True)
class OpenHighwayTask(OpenLanesTask):
    """Several lanes, none of which ends: ``highway`` with vehicles that come and go, as in HighwayEnv's.

    Args:
        lanes_count: Number of lanes.
        length: Length of the road (m).
        inflow: Vehicles an hour on all lanes together.
    """

    name: ClassVar[str] = "open_highway"

    ranges: ClassVar[Mapping[str, Range]] = {
        "lanes_count": Range(2, 100, whole=True),
        "length": Range(100.0, 1e6, "m"),
    }

    lanes_count: int = 4
    length: float = 1000.0
    inflow: float = 5000.0

    @cached_property
    def road(self) -> Lanes:  # type: ignore[override]
        """The road."""
        return Lanes(self.lanes_count, length=float(self.length))

    @property
    def inflows(self) -> Mapping[int, float]:
        """The same for each lane."""
        return dict.fromkeys(range(self.lanes_count), self.inflow / self.lanes_count)

    @property
    def filled(self) -> float:
        """Half of the road."""
        return 0.5 * self.length


@dataclass(frozen=True, eq=False, kw_only=True)
class MergeTask(OpenLanesTask):
    """Two lanes, and a ramp on their right from which one must merge within 200 m; it begins at 100 m.

    Args:
        inflow: Vehicles an hour on the two lanes together.
        ramp_inflow: Vehicles an hour on the ramp.
    """

    name: ClassVar[str] = "merge"
    ranges: ClassVar[Mapping[str, Range]] = {"ramp_inflow": _FLOW}

    inflow: float = 2400.0
    ramp_inflow: float = 500.0

    @cached_property
    def road(self) -> Lanes:  # type: ignore[override]
        """Two lanes of 900 m, and the ramp, which is lane 0."""
        return Lanes(3, length=900.0, ends=(on_ramp(0, begin=400.0, end=600.0, entry=100.0),))

    @property
    def inflows(self) -> Mapping[int, float]:
        """The ramp's, and half of the other for each lane."""
        return {0: self.ramp_inflow, 1: 0.5 * self.inflow, 2: 0.5 * self.inflow}

    @property
    def filled(self) -> float:
        """Up to where vehicles are when an episode begins (m)."""
        return 350.0


@dataclass(frozen=True, eq=False, kw_only=True)
class BottleneckTask(OpenLanesTask):
    """Four lanes, of which the outer two end at 400 m and the left one of the others at 600 m: 4 → 2 → 1.

    After the bottleneck of Flow (Vinitsky et al. 2018, CoRL, "Benchmarks for reinforcement learning in mixed-autonomy
    traffic").

    Args:
        inflow: Vehicles an hour on all lanes together.
    """

    name: ClassVar[str] = "bottleneck"

    inflow: float = 2600.0

    @cached_property
    def road(self) -> Lanes:  # type: ignore[override]
        """The road, 800 m long."""
        return Lanes(4, length=800.0, ends=(lane_drop(0, at=400.0), lane_drop(3, at=400.0), lane_drop(2, at=600.0)))

    @property
    def inflows(self) -> Mapping[int, float]:
        """A quarter for each lane."""
        return dict.fromkeys(range(4), 0.25 * self.inflow)

    @property
    def filled(self) -> float:
        """Up to where vehicles are when an episode begins (m)."""
        return 300.0
