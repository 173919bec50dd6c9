"""What tasks share where traffic flows in, changes lanes, some of which may end, and leaves."""

from __future__ import annotations

import abc
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, ClassVar

import torch
from torch import Tensor

from idm_env import effects as laws
from idm_env.metrics import CO2, fuel
from idm_env.multilane import demand
from idm_env.roads import Lanes
from idm_env.tasks.base import EnvState
from idm_env.tasks.checks import FLOW, Range, entry
from idm_env.tasks.counters import Counters
from idm_env.tasks.features import FEATURES, AgentView, Feature, feature, part
from idm_env.tasks.lanes import FASTEST, PACE, LanesTask
from idm_env.tasks.random import Draw
from idm_env.tasks.reward_terms import RewardTerm, Transition
from idm_env.tasks.said_roads import STANDS, DriverClass, Loop, classes_of, loops_of, rules_of, with_classes
from idm_env.tasks.starting_places import with_room
from idm_env.tasks.trip_table import KEYS, TripTable, read, spread, table as made
from idm_env.types import ENTRY_SPEED, Params, State, Trips
from idm_env.validation import at_least, nearest, shown

_PLACE_STREAM = 37
_SIGHT = 500.0
"""How far ahead an agent sees that a lane ends (m)."""


def _present(view: AgentView) -> Tensor:
    """Return 1 for agents on the road, 0 for others."""
    present = view.state.present
    assert present is not None
    return view.own(present)


def _ends(view: AgentView) -> Tensor:
    """Return how far the lane goes on (m), as far as it is seen."""
    state, road = view.state, view.task.road
    assert state.lanes is not None and isinstance(road, Lanes)
    return view.own((road.closed_at(state.lanes.lane, state.position) - state.position).clamp(0.0, _SIGHT))


def _next(view: AgentView) -> tuple[Tensor, Tensor]:
    """Return how far it is to the next end of any lane (m), as far as it is seen, and how many lanes to the left."""
    state, task, road = view.state, view.task, view.task.road
    assert state.lanes is not None and isinstance(road, Lanes)
    own, lane = task.pick(state.position), task.pick(state.lanes.lane)
    next_end, left = torch.full_like(own, _SIGHT), torch.zeros_like(own)
    for end in road.ends:
        way = end.end - own
        nearer = end.closed & (way >= 0.0) & (way < next_end)
        next_end = torch.where(nearer, way, next_end)
        left = torch.where(nearer, (end.lane - lane).to(own.dtype), left)
    return task.there(state, next_end), task.there(state, left)


@dataclass(frozen=True, eq=False, kw_only=True)
class OpenLanesTask(LanesTask):
    """Vehicles enter, lane by lane, and leave at the end; a share of those who enter are agents.

    Headways at the entries are random: half of the mean, and an exponential half. Slots make their trips again and
    again in that order, so arrivals repeat after ``vehicles / inflow``. An episode begins with free traffic up to
    ``filled``. Whoever finds no room there, or at his entry, waits and is counted (``multilane.demand.counts``).

    One vehicle is the agent (``controlled=1``): it is on the road when an episode begins, and enters again as soon as
    it has left. Where there is an on-ramp it enters there, the first time within 3 s. Its commands are accelerations,
    held for 1 s, and are added to what its driver would do: zeros are human driving.
    ``controlled=0.1, careful=True, added=False, reward="traffic"`` is the joint form: agents are the vehicles of slots,
    and a command counts only as far as the driver himself would go, so that none makes a crash. The joint face tells by
    ``info["present"]`` who is there; with PettingZoo every trip is an agent of its own. While an agent's vehicle waits
    or has left, its observation and infos are zeros, and its command does nothing.

    Drivers let in whoever signals, accept closer gaps near the end of a lane and where they have stood
    (``GapAcceptance``), stay calm where somebody cuts in (``Calm``), and take turns at an end as at a zipper
    (``Courtesy``, ``MandatoryChange``).

    Observation, per agent: own speed, lane, the leader's relative speed and gap, 1 if it is on the road, how far its
    lane goes on (m, at most 500), its place (m), how far it is to the next end of any lane (m, at most 500) and how
    many lanes to the left that is; then the nearest vehicles as in ``highway``.
    Reward, per agent: as in ``highway``, ``0.9 v/40 + 0.1 (1 − (u/u_max)²)``, 0 while it is away. The same for all
    agents is ``reward="traffic"``: ``Σ min(v/v0, 1)/(n + queued)``, the mean of speeds over desired ones, of all on the
    road and, as 0, of those who wait. ``reward="delay"``: minus the delay of all in this step (vehicle-seconds), ``−t
    (Σ (1 − min(v/v0, 1)) + queued)``, so that its sum is the total delay against free travel at every driver's v0.
    Terminated where vehicles touch, or an agent drives over the end of a lane. Cut off after 600 s.

    Args:
        entry_speed: Speed at which vehicles ask to enter (m/s).
        careful: Whether a command counts only as far as the driver himself would go: ``min(command, driver)``.
        added: Whether commands are added to what the driver would do: zeros are then human driving, and a new policy
            is a driver. With ``careful`` only those below 0 count. None: unless a ``failsafe`` judges whole commands.
        classes: Drivers who are not as all others: ``{"truck": {"share": 0.2, "length": 12.0, "parameters":
            {"idm.desired_speed": 24.0}}}``, shares of those who enter, length in metres.
        trips: Who departs when, in place of the inflow: a table, rows or a CSV file with the columns of
            ``idm_env.tasks.trip_table``, or what its ``table`` takes: ``{"per_hour": {1: 1500, 2: [[0, 800], [300,
            1600]]}, "seconds": 600, "classes": {"truck": 0.2}}``. The same in every episode; ``vehicles`` is then its
            number of rows, and nobody is on the road when an episode begins.
        limits: Speed limits: ``[{"speed": 25.0, "begin": 0.0, "end": 500.0, "lane": 1}]`` (m/s, m); without a lane on
            all of them.
        closures: Closed lanes: ``[{"lane": 1, "begin": 300.0, "end": 500.0, "since": 60.0, "until": 240.0}]`` (m, s).
        detectors: Loops across a lane: ``[{"lane": 1, "place": 350.0, "every": 30.0, "name": "upstream"}]`` (m, s; 30 s
            and a name of its place where it has none). An environment's ``detectors`` are rows of what each tells.
    """

    own_effects: ClassVar[tuple[laws.Effect, ...]] = (
        laws.IDM(), laws.Calm(), laws.Mobil(), laws.MandatoryChange(), laws.GapAcceptance(), laws.Courtesy(),
        laws.Brakes(),
    )  # fmt: skip
    own_parameters: ClassVar = {
        "idm": {"max_accel": 1.5, "comfort_decel": 2.0, "time_gap": 1.2, "min_gap": 2.0, "desired_speed": 30.0},
        "mandatory_change": {"reach": 400.0, "turns": 1.0},
        "courtesy": {"weight": 1.0, "zipper": 1.0},
    }

    usual_hold: ClassVar[float | None] = 1.0
    can_draw: ClassVar[tuple[str, ...]] = ("inflow",)
    begins_with: ClassVar[tuple[str, ...]] = ("inflow",)
    most_filled: ClassVar[float] = 300.0
    ramp: ClassVar[int | None] = None
    """The lane whose demand is ``ramp_inflow``."""
    exits: ClassVar[Mapping[str, float]] = {}
    """Names of destinations beside the end of the road, and up to where one must have changed for them (m)."""
    ranges: ClassVar[Mapping[str, Range]] = {"entry_speed": Range(1.0, 70.0, "m/s"), "inflow": FLOW}

    vehicles: int = 120
    controlled: int | float | str | Sequence[int] = 1
    seen: int = 3
    max_command: float | Sequence[float] = 2.0
    entry_speed: float = ENTRY_SPEED
    careful: bool = False
    added: bool | None = None
    classes: Mapping[str, Any] | None = None
    trips: Any = None
    limits: Sequence[Mapping[str, Any]] = ()
    closures: Sequence[Mapping[str, Any]] = ()
    detectors: Sequence[Mapping[str, Any]] = ()

    def __post_init__(self) -> None:
        if self.table is not None:
            object.__setattr__(self, "vehicles", len(self.table.depart))
        if self.added is None:
            object.__setattr__(self, "added", not self.failsafe)
        super().__post_init__()
        _ = self.loops, self.kinds
        if self.added and self.failsafe:
            raise ValueError(
                f"failsafe = {self.failsafe:g} judges whole commands, and added = True gives parts. Leave one out."
            )
        if self.table is not None:
            self._check_table(self.table)
            return
        flows = self.inflows
        for lane, flow in flows.items():
            at_least(f"inflow of lane {lane}", flow, 1.0, "vehicles an hour")
        total = sum(flows.values())
        # Who enters slowly goes on faster.
        free = (self.road.length or 0) / max(self.entry_speed, type(self).entry_speed)
        round_trip = 3600.0 * self.vehicles / (total * self._busiest)
        for lane, flow in flows.items():
            if self.vehicles * flow < total:
                raise ValueError(
                    f"vehicles = {self.vehicles} leaves none for lane {lane}, where {flow:g} of {total:g} vehicles an "
                    f"hour enter. Take at least {math.ceil(total / flow)}, or a less uneven inflow."
                )
        # Who says how many vehicles there are may let them queue.
        if (self._demands or self.vehicles == type(self).vehicles) and round_trip < free:
            raise ValueError(
                f"vehicles = {self.vehicles} makes a demand of {total * self._busiest:g} vehicles an hour impossible: "
                f"every {round_trip:.0f} s each would enter anew, and the road takes {free:.0f} s. Take at least "
                f"{math.ceil(total * self._busiest * free / 3600.0)}."
            )

    @property
    @abc.abstractmethod
    def inflows(self) -> Mapping[int, float]:
        """Vehicles an hour that want to enter each lane."""

    @property
    def filled(self) -> float:
        """Up to where vehicles are when an episode begins (m)."""
        return min(self.most_filled, 0.5 * (self.road.length or 0.0))

    def _check_table(self, table: TripTable) -> None:
        """Raise ValueError for trips of this task that nobody could make."""
        horizon = self.steps * self.simulator.dt
        for i, (depart, lane, destination) in enumerate(zip(table.depart, table.lane, table.destination, strict=True)):
            where = f"trips: row {i}, in the order of departure,"
            if depart > horizon:
                raise ValueError(f"{where} departs at {depart:g} s, after the end of the episode at {horizon:g} s.")
            if lane >= self.road.count:
                raise ValueError(f"{where} enters on lane {lane}: this road has lanes 0 to {self.road.count - 1}.")
            if destination and destination not in self.exits:
                raise ValueError(f"{where} has destination {shown(destination)}.{nearest(destination, self.exits)}")
            begin = float(self.road.at_lane(torch.tensor(lane), torch.zeros(()), "begins"))
            if destination and self.exits[destination] <= begin:
                raise ValueError(
                    f"{where} has destination {shown(destination)} at {self.exits[destination]:g} m, behind the entry "
                    f"of lane {lane} at {begin:g} m. Enter before it, or leave the destination out."
                )

    @cached_property
    def table(self) -> TripTable | None:
        """The trips that are given, None for those at random."""
        if self.trips is None:
            return None
        if isinstance(self.trips, Mapping) and "per_hour" in self.trips:
            return read(made(**entry("trips", self.trips, KEYS)))
        return read(self.trips)

    @property
    def ego(self) -> bool:  # type: ignore[override]
        """Whether the only agent is one that enters again as soon as it has left: ``controlled=1``."""
        return self.table is None and self.controlled == 1 and isinstance(self.controlled, int)

    @cached_property
    def _classes(self) -> dict[str, DriverClass]:
        return classes_of(self.classes, self.vehicle_length)

    @cached_property
    def kinds(self) -> tuple[str, ...]:
        """The class of every slot's driver, '' for a plain one."""
        if self.table is None:
            return tuple(spread("classes", {name: x.share for name, x in self._classes.items()}, self.vehicles))
        for kind in self.table.kind:
            if kind and kind not in self._classes:
                raise ValueError(f"trips: class {shown(kind)} is unknown.{nearest(kind, self._classes)}")
        return self.table.kind

    @cached_property
    def rules(self) -> tuple[laws.Effect, ...]:
        """What the road tells its drivers."""
        return rules_of(self.limits, self.closed, self.road)

    @cached_property
    def loops(self) -> tuple[Loop, ...]:
        """The detectors."""
        return loops_of(self.detectors, self.road, self.simulator.dt)

    @property
    def closed(self) -> Sequence[Mapping[str, Any]]:
        """The lanes that are closed, as ``closures`` says them."""
        return self.closures

    def params(self, dtype: torch.dtype, device: torch.device | str) -> dict[str, dict[str, Tensor]]:
        """Return checked parameters as tensors, those of classes in the slots of theirs."""
        values = super().params(dtype, device)
        if not self._classes:
            return values
        base = self.simulator.base.name
        factors = {f"{base}.desired_speed": self.spread_factor(dtype, device)} if self.spread else {}
        values = with_classes(values, self.kinds, self._classes, factors)
        self.simulator.check(values)
        return values

    @property
    def as_driver(self) -> float:  # type: ignore[override]
        """A careful command of the driver's own maximum, which never holds him back; 0 where it is added to his."""
        most = self.params(torch.float64, "cpu")[self.simulator.base.name].get("max_accel")
        is_whole = self.careful and not self.added
        return min(1.0, float(most.max()) / self.command_limits[1]) if is_whole and most is not None else 0.0

    @property
    def usual_steps(self) -> int:
        """Those of 600 s."""
        return round(600.0 / self._behaviour.dt)

    @property
    def machinery(self) -> tuple[laws.Effect, ...]:  # type: ignore[override]
        """Effects through which agents act."""
        return (laws.Control(careful=self.careful, added=bool(self.added)), *super().machinery[1:], *self.rules)

    @cached_property
    def _slots(self) -> tuple[tuple[float, float], ...]:
        """Lane and mean headway (s) of every slot."""
        flows, total = self.inflows, sum(self.inflows.values())
        counts = {k: max(1, round(self.vehicles * flow / total)) for k, flow in flows.items()}
        slots = sorted((3600.0 / flows[k] * i, k) for k, count in counts.items() for i in range(count))
        driving = [(float(k), 3600.0 / flows[k]) for _, k in slots[: self.vehicles]]
        # Shares that are rounded down leave a slot to spare: it never drives.
        return (*driving, *[(0.0, math.inf)] * (self.vehicles - len(driving)))

    @property
    def _busiest(self) -> float:
        """By how much the highest demand that may be drawn exceeds that of the keywords."""
        return max([1.0, *(high / getattr(self, name) for name, (_, high) in self._demands.items())])

    def _demand(self, draw: Draw, lane: int) -> Tensor:
        """Return the demand of a lane in each episode over that of the keywords, ``(environments, 1)``."""
        name = "ramp_inflow" if lane == self.ramp else "inflow"
        low, high = self._demands.get(name, (1.0, 1.0))
        share = draw.stream(f"demand {name}").uniforms(0, 1, torch.float64)
        return (low + (high - low) * share) / (getattr(self, name) if name in self._demands else 1.0)

    def _trips(self, draw: Draw, dtype: torch.dtype) -> Trips:
        """Return trips at random headways, of which the first began before the episode did, in the order of time."""
        device = draw.key.device
        if self.table is not None:
            trips = Trips.from_table(self.table._asdict(), dtype)
            return Trips(*(x.to(device).expand(len(draw.key), -1).contiguous() for x in trips))
        lane, mean = (torch.tensor(x, dtype=torch.float64, device=device) for x in zip(*self._slots, strict=True))
        some = mean.isfinite()
        shape = (len(draw.key), self.vehicles)
        headway = torch.where(some, mean, 0.0) * 0.5 * (
            1.0 - draw.uniforms(_PLACE_STREAM, self.vehicles, torch.float64).log()
        )  # fmt: skip
        departs, again = (torch.full(shape, torch.inf, dtype=torch.float64, device=device) for _ in range(2))
        for k in sorted(self.inflows):
            mine = torch.nonzero(some & (lane == k)).squeeze(-1)
            times = headway[:, mine].cumsum(-1)
            cycles = mean[mine[0]] * len(mine) / self._demand(draw, k)
            departs[:, mine] = times * (cycles / times[:, -1:])
            again[:, mine] = cycles
        order = departs.argsort(dim=-1, stable=True)
        none = torch.zeros(shape, dtype=torch.int64, device=device)
        again, lane = again.gather(-1, order), lane.long().expand(shape).gather(-1, order)
        if self.ego:
            again[:, 0], lane[:, 0] = 0.0, lane[:, 0] if self.ramp is None else self.ramp
        return Trips(
            (departs.gather(-1, order) - self.filled / self.entry_speed).to(dtype), again.to(dtype), lane,
            torch.full(shape, self.entry_speed, dtype=dtype, device=device), none, none.clone(),
        )  # fmt: skip

    def begin(self, draw: Draw, params: Params) -> EnvState:
        """Return free traffic up to ``filled``, and everybody else, and whoever has no room, waiting."""
        like = self.like(params)
        trips = self._trips(draw, like.dtype)
        begins = self.road.at_lane(trips.lane, trips.departs, "begins")
        place = begins - trips.departs * self.entry_speed
        inside = (trips.departs < 0) & (place < self.filled)
        length = self.constant("lengths", self._lengths, like.device, like.dtype)
        driver = self.simulator.base.driver(dict(params[self.simulator.base.name]))
        place = with_room(place, inside, trips.lane, length, trips.speed, driver, self._open_until(trips.lane, begins))
        inside = inside & (place >= begins)
        state = self.simulator.state(
            torch.where(inside, place, begins), trips.speed, params, length=length,
            present=inside.to(like.dtype), lane=trips.lane,
            step=torch.full((len(place),), -self.warmup, device=like.device),
        )  # fmt: skip
        assert state.lanes is not None
        free = driver.desired_speed.detach()
        return EnvState(
            state._replace(lanes=state.lanes._replace(trips=trips._replace(entered=inside.long()))),
            {"free_speed": free.to(place.dtype).expand_as(place).contiguous()},
        )

    def _open_until(self, lane: Tensor, like: Tensor) -> Tensor:
        """Return up to where one can drive on a lane when an episode begins (m)."""
        ends = self.road.closed_at(lane, like)
        rows = (row for rule in self.rules if isinstance(rule, laws.LaneClosure) for row in rule.closures)
        for k, begin, _, since, until in rows:
            if since <= 0.0 < until:
                ends = torch.where(lane == int(k), ends.clamp_max(begin), ends)
        return ends

    def _lengths(self) -> list[float]:
        return [self._classes[kind].length if kind else self.vehicle_length for kind in self.kinds]

    @property
    def features_of_self(self) -> tuple[Feature, ...]:
        """As in ``LanesTask``; who is there, where, and how far it is to the end of one's lane and of any."""
        last = float(max(self.road.count - 1, 1))
        return (
            *super().features_of_self,
            feature("relative_speed", 10.0, -FASTEST, FASTEST),
            FEATURES["gap"],
            Feature("present", "", "", 1.0, 0.0, 1.0, _present),
            Feature("ends", "", "m", 100.0, 0.0, _SIGHT, _ends),
            feature("position", 100.0, 0.0, 1e6),
            Feature("next_end", "", "m", 100.0, 0.0, _SIGHT, partial(part, _next, 0)),
            Feature("next_left", "", "lanes", 1.0, -last, last, partial(part, _next, 1)),
        )

    def counters(self, rows: int, device: torch.device, info: Collection[str]) -> Counters | None:
        """Return the counters of stops and detectors, None where neither is asked for."""
        return Counters(self.loops, self.simulator.dt, rows, device) if self.loops or "stops" in info else None

    def info(self, world: EnvState) -> dict[str, Tensor]:
        """As in ``LanesTask``, and of all traffic what became of trips, who stands and what is burnt, now or so far.

        ``present``: agents that are there; ``queued``: vehicles that wait at the entries, a queue that grows is an
        inflow beyond capacity; ``inside``; ``outflow``: vehicles that have left; ``ramp``: of those who enter on lane 0
        how many have left it; ``standing``: vehicles below 0.5 m/s; ``co2``: g/s of all on the road (Kamal's fuel);
        ``travel``: time (s) over the length of the road at the mean speed of now, at least 0.5 m/s.
        """
        state = world.state
        assert state.present is not None and state.lanes is not None and state.lanes.trips is not None
        counts, present, trips = demand.counts(self.simulator, state), state.present > 0, state.lanes.trips
        from_ramp = trips.lane == 0
        still = from_ramp & present & (state.lanes.lane == 0)
        every = {
            "queued": counts.queued, "inside": counts.inside, "outflow": counts.left,
            "ramp": (torch.where(from_ramp, trips.entered, 0) - still.long()).sum(-1),
            "standing": (present & (state.speed < STANDS)).sum(-1),
            "co2": CO2 * torch.where(present, fuel(state.speed, state.accel), 0.0).sum(-1),
        }  # fmt: skip
        speeds = torch.where(present, state.speed, 0.0).sum(-1) / counts.inside.clamp_min(1)
        every["travel"] = (self.road.length or 0.0) / speeds.clamp_min(STANDS)
        own = {**super().info(world), "present": self.pick(present)}
        return own | {n: x.unsqueeze(-1).expand(-1, len(self.agents)).contiguous() for n, x in every.items()}

    @property
    def journeys(self) -> int:  # type: ignore[override]
        """One that began before the episode, one that is due at once, and one for every time that a slot's are due."""
        if self.table is not None:
            return 1
        cycle = min(sum(mean for k, mean in self._slots if k == lane) for lane in self.inflows) / self._busiest
        return 2 + math.ceil((self.steps * self.simulator.dt + self.filled / self.entry_speed) / cycle)

    @cached_property
    def _most(self) -> float:
        """No more trips are due in an episode."""
        if self.table is not None:
            return float(self.vehicles)
        seconds = (self.steps + 10) * self.simulator.dt + self.filled / self.entry_speed
        return 2.0 * self.vehicles + self._busiest * sum(self.inflows.values()) * seconds / 3600.0

    @property
    def own_rewards(self) -> Mapping[str, Mapping[RewardTerm, float]]:
        """``unit`` is the agent's own, ``traffic`` and ``delay`` are all traffic's."""
        traffic = RewardTerm("traffic", "Σ min(v/v0, 1)/(n + queued)", "", 0.0, 1.0, self._traffic, shared=True)
        delay = RewardTerm("delay", "Σ (1 − min(v/v0, 1)) + queued", "vehicles", 0.0, self._most, self._delay, True)
        return {"unit": PACE, "traffic": {traffic: 1.0}, "delay": {delay: -self.step_time}}

    def _traffic(self, step: Transition) -> Tensor:
        """Return ``Σ min(v/v0, 1)/(n + queued)``: the mean of speeds over desired ones, 0 in a queue."""
        state = step.after.state
        assert state.present is not None
        due = state.present.sum(-1) + demand.counts(self.simulator, state).queued
        return 1.0 - (self.lost(step.after) / due.clamp_min(1.0)).unsqueeze(-1)

    def _delay(self, step: Transition) -> Tensor:
        """Return the delay of a moment (vehicles)."""
        return self.delay(step.after).unsqueeze(-1)

    def lost(self, world: EnvState) -> Tensor:
        """Return how many vehicles' time is lost: ``Σ (1 − min(v/v0, 1))`` of those on the road, and all in a queue."""
        state = world.state
        assert state.present is not None
        lost = 1.0 - (state.speed / world.episode["free_speed"]).clamp_max(1.0)
        return (lost * state.present).sum(-1) + demand.counts(self.simulator, state).queued

    def delay(self, world: EnvState) -> Tensor:
        """Return the delay of a moment (vehicles)."""
        return self.lost(world)

    def crashed(self, world: EnvState) -> Tensor:
        """Return whose episodes end in a crash: of all, where vehicles touch or one drives over the end of its lane."""
        crashed = super().crashed(world)
        return crashed | self._over(world.state).any(-1, keepdim=True).expand_as(crashed)

    def _over(self, state: State) -> Tensor:
        """Return which vehicles have driven over the end of their lane (bool)."""
        assert state.lanes is not None and state.present is not None
        return (state.position > self.road.closed_at(state.lanes.lane, state.position)) & (state.present > 0)

    def crash_reason(self, world: EnvState, row: int, agent: int | None = None) -> str:
        """As ``Task`` says; or who has driven over the end of which lane, where nobody has touched anybody."""
        state, over = world.state, self._over(world.state)[row]
        if float(state.gap[row].min()) <= 0.0 or not bool(over.any()):
            return super().crash_reason(world, row, agent)
        vehicle = int(over.int().argmax())
        assert state.lanes is not None
        who = f"vehicle {vehicle}" + (" (an agent)" if vehicle in self.agents else "")
        seconds = float(state.step[row]) * self.simulator.dt
        return f"{who} drove over the end of lane {int(state.lanes.lane[row, vehicle])} after {seconds:.1f} s"
