"""Task ``approach``: eco-driving over the last 500 m before a signal, among drivers who come in platoons."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from typing import ClassVar

import torch
from torch import Tensor

from idm_env.effects import IDM, Brakes, Effect, Signal
from idm_env.metrics import fuel
from idm_env.roads import Lanes
from idm_env.tasks.base import EnvState
from idm_env.tasks.checks import Range, in_ranges
from idm_env.tasks.features import AgentView, Feature, part
from idm_env.tasks.open_lanes import OpenLanesTask
from idm_env.tasks.random import Draw
from idm_env.tasks.reward_terms import RewardTerm, Transition
from idm_env.types import Params, State, Trips

LINE, LENGTH = 500.0, 600.0
"""Place of the signal, and where vehicles leave (m)."""
_MOST_FUEL = 10.0
"""A vehicle burns no more than this (mL/s)."""
_SAID = ("offset", "cycle", "red")


def _line(view: AgentView) -> Tensor:
    """Return how far it is to the signal (m), 0 behind it."""
    return view.own((LINE - view.state.position).clamp_min(0.0))


def _signal(view: AgentView) -> tuple[Tensor, Tensor]:
    """Return 1 where it is red, and the time to the next change (s)."""
    signal = {name: view.world.episode[f"signal_{name}"] for name in _SAID}
    since, red = Signal.phase(view.task.simulator.time(view.state), signal)
    until = torch.where(red, signal["cycle"] - since, signal["cycle"] - signal["red"] - since)
    return view.own(red.to(since.dtype)), view.own(until)


def _pace(step: Transition) -> Tensor:
    """Return ``min(v/v0, 1)``, the agent's own."""
    return step.view.own((step.after.state.speed / step.after.episode["free_speed"]).clamp_max(1.0))


def _economy(step: Transition) -> Tensor:
    """Return ``1 − F/F_max``, F the agent's own fuel rate, F_max = 4 mL/s."""
    return 1.0 - step.view.own(fuel(step.after.state.speed, step.after.state.accel)) / 4.0


@dataclass(frozen=True, eq=False, kw_only=True)
class ApproachTask(OpenLanesTask):
    """A demonstration: the last 500 m before a signal with a fixed cycle, driven again and again.

    Vehicles come in platoons, as from a signal upstream with the same cycle. Episodes begin at any phase of it. Who is
    first in a queue starts 1 s late. A queue of 20 leaves at 1860 vehicles an hour and lane with 2.1 s of start-up lost
    time (usual by the Highway Capacity Manual: 1800 to 1900, and 2 s). After the tasks of eco-driving at signals of
    IntersectionZoo (Jayawardana et al. 2024, arXiv 2410.15221), on one approach. Who comes, goes and acts is as in the
    other open tasks. ``randomise={"signal.cycle": [40, 80], "signal.red": [10, 40]}`` draws a plan for every episode,
    while platoons come with the ``cycle`` of the keyword.

    Observation: as there; before the nearest vehicles the way to the signal (m), 1 if it is red, and the time to its
    next change (s). Reward, per agent: ``0.5 min(v/v0, 1) + 0.5 (1 − F/F_max)``, F its fuel rate (Kamal's), F_max = 4
    mL/s. ``reward="delay"``: minus the delay of all in this step, and minus what all burn (mL) times ``fuel_weight``:
    ``−t (Σ (1 − min(v/v0, 1)) + queued + w Σ F)``.

    Args:
        lanes_count: Number of lanes, from 1 to 3.
        inflow: Vehicles an hour on all lanes together.
        cycle: Time from one green to the next (s).
        green: Time of a cycle for which it is green (s).
        platoon: Share of a cycle in which vehicles come; 1 is no platoons.
        fuel_weight: What a millilitre costs (vehicle-seconds).
    """

    name: ClassVar[str] = "approach"
    ranges: ClassVar[Mapping[str, Range]] = {
        "lanes_count": Range(1, 3, whole=True),
        "cycle": Range(10.0, 600.0, "s"),
        "green": Range(1.0, 600.0, "s"),
        "platoon": Range(0.1, 1.0),
        "fuel_weight": Range(0.0, 1e3, "vehicle-seconds"),
    }

    entry_speed: float = 14.0
    lanes_count: int = 2
    inflow: float = 1200.0
    cycle: float = 60.0
    green: float = 30.0
    platoon: float = 0.5
    fuel_weight: float = 0.6

    def __post_init__(self) -> None:
        in_ranges(self)
        if self.green > self.cycle:
            raise ValueError(f"green = {self.green:g} s must not exceed the cycle of {self.cycle:g} s.")
        super().__post_init__()

    @property
    def own_effects(self) -> tuple[Effect, ...]:  # type: ignore[override]
        """Those of the open tasks; on one lane nobody changes."""
        return super().own_effects if self.lanes_count > 1 else (IDM(), Brakes())

    @property
    def own_parameters(self) -> Mapping[str, Mapping[str, float]]:  # type: ignore[override]
        """Drivers of a town, v0, T and s0 near Treiber and Kesting's (2013, table 11.2), and the signal."""
        usual = super().own_parameters
        signal = {"place": LINE, "cycle": self.cycle, "red": self.cycle - self.green, "reaction": 1.0}
        drivers = {**usual["idm"], "desired_speed": 15.0, "time_gap": 1.05, "max_accel": 2.0}
        return {**usual, "idm": drivers, "signal": signal}

    @cached_property
    def road(self) -> Lanes:  # type: ignore[override]
        """The road."""
        return Lanes(self.lanes_count, length=LENGTH)

    @cached_property
    def rules(self) -> tuple[Effect, ...]:
        """What the road tells its drivers."""
        return (*super().rules, Signal())

    @cached_property
    def _ranges(self) -> dict[str, tuple[float, float]]:
        return {"signal.offset": (0.0, self.cycle), **super()._ranges}

    def params(self, dtype: torch.dtype, device: torch.device | str) -> dict[str, dict[str, Tensor]]:
        """Return checked parameters as tensors; ValueError for a signal elsewhere, as observations count from it."""
        values = super().params(dtype, device)
        if bool((values["signal"]["place"] != LINE).any()):
            raise ValueError(f"signal.place must be {LINE:g} m in task '{self.name}'. Leave it out.")
        return values

    @property
    def inflows(self) -> Mapping[int, float]:
        """The same for each lane."""
        return dict.fromkeys(range(self.lanes_count), self.inflow / self.lanes_count)

    def _trips(self, draw: Draw, dtype: torch.dtype) -> Trips:
        """Return trips of which those of a cycle come in its first part, at a rhythm that every later trip keeps."""
        trips = super()._trips(draw, dtype)
        if self.table is not None:
            return trips
        first = self.filled / self.entry_speed  # so long before an episode the first platoon begins
        begun = ((trips.departs + first) / self.cycle).floor() * self.cycle
        departs = begun + self.platoon * (trips.departs + first - begun) - first
        return trips._replace(departs=departs, again=(trips.again / self.cycle).ceil() * self.cycle)

    def begin(self, draw: Draw, params: Params) -> EnvState:
        """As in the other open tasks, with what the signal does in these episodes."""
        world = super().begin(draw, params)
        speed = world.state.speed
        own = {f"signal_{name}": params["signal"][name].detach().to(speed.dtype) for name in _SAID}
        signal = {name: x.expand_as(speed).contiguous() for name, x in own.items()}
        return world._replace(episode={**world.episode, **signal})

    @property
    def features_of_self(self) -> tuple[Feature, ...]:
        """As in the other open tasks; then the signal."""
        return (
            *super().features_of_self,
            Feature("line", "", "m", 100.0, 0.0, LINE, _line),
            Feature("red", "", "", 1.0, 0.0, 1.0, partial(part, _signal, 0)),
            Feature("until", "", "s", 10.0, 0.0, 3600.0, partial(part, _signal, 1)),
        )

    @property
    def own_rewards(self) -> Mapping[str, Mapping[RewardTerm, float]]:
        """As in the other open tasks; ``unit`` and ``delay`` are of fuel, too."""
        pace = RewardTerm("pace", "min(v/v0, 1)", "", 0.0, 1.0, _pace)
        economy = RewardTerm("economy", "1 − F/F_max", "", 0.0, 1.0, _economy)
        return {**super().own_rewards, "unit": {pace: 0.5, economy: 0.5}}

    @property
    def _most(self) -> float:  # type: ignore[override]
        """As in the other open tasks, with fuel."""
        return super()._most * (1.0 + self.fuel_weight * _MOST_FUEL)

    def burnt(self, state: State) -> Tensor:
        """Return what all on the road burn (mL/s)."""
        assert state.present is not None
        return (fuel(state.speed, state.accel).clamp(0.0, _MOST_FUEL) * state.present).sum(-1)

    def delay(self, world: EnvState) -> Tensor:
        """Return how many vehicles' time is lost, fuel reckoned as time."""
        return super().delay(world) + self.fuel_weight * self.burnt(world.state)


__all__ = ["LINE", "ApproachTask"]
