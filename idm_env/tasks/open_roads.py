"""Tasks ``open_highway``, ``merge`` and ``bottleneck``: roads that traffic flows through."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import torch
from torch import Tensor

from idm_env.effects import Destination, Effect
from idm_env.roads import End, Lanes, lane_drop, on_ramp
from idm_env.tasks.checks import FLOW, Range, span
from idm_env.tasks.open_lanes import OpenLanesTask
from idm_env.tasks.trip_table import SECOND, spread


@dataclass(frozen=True, eq=False, kw_only=True)
class OpenHighwayTask(OpenLanesTask):
    """Several lanes, none of which ends, with vehicles that come and go; PPO beats humans, a constant beats PPO.

    With a ramp lane 0 is that of the ramps, and the others are the road's. The on-ramp begins 300 m before one may
    leave it, and ends where one may not; the off-ramp is left 200 m behind that.

    Args:
        lanes_count: Number of lanes, ramps not counted.
        length: Length of the road (m).
        inflow: Vehicles an hour on all lanes together.
        on_ramp: Where one may merge from the on-ramp: ``[begin, end]`` (m); None is no such ramp.
        off_ramp: Where one may change to the off-ramp: ``[begin, end]`` (m), behind the on-ramp.
        ramp_inflow: Vehicles an hour on the on-ramp.
        exits_share: Share of drivers who leave by the off-ramp; of a table those whose destination is ``exit``.
    """

    name: ClassVar[str] = "open_highway"
    most_filled: ClassVar[float] = math.inf

    ranges: ClassVar[Mapping[str, Range]] = {
        "lanes_count": Range(2, 100, whole=True),
        "length": Range(100.0, 1e6, "m"),
        "ramp_inflow": FLOW,
        "exits_share": Range(0.0, 1.0),
    }

    can_draw: ClassVar[tuple[str, ...]] = ("inflow", "ramp_inflow")
    begins_with: ClassVar[tuple[str, ...]] = ("inflow", "ramp_inflow")

    lanes_count: int = 4
    length: float = 1000.0
    inflow: float = 5000.0
    on_ramp: Sequence[float] | None = None
    off_ramp: Sequence[float] | None = None
    ramp_inflow: float = 500.0
    exits_share: float = 0.15

    @cached_property
    def _ramps(self) -> tuple[tuple[float, float] | None, tuple[float, float] | None]:
        on, off = (
            None if x is None else span(name, x, 0.0, "m", self.length)
            for name, x in (("on_ramp", self.on_ramp), ("off_ramp", self.off_ramp))
        )
        for name, ends in (("on_ramp", on), ("off_ramp", off)):
            if ends and not ends[0] < ends[1]:
                raise ValueError(f"{name} = {list(ends)} must be [begin, end] (m), one behind the other.")
        if on and off and off[0] <= on[1]:
            raise ValueError(f"off_ramp = {list(off)} must begin behind the end of the on-ramp at {on[1]:g} m.")
        return on, off

    @cached_property
    def road(self) -> Lanes:  # type: ignore[override]
        """The road."""
        on, off = self._ramps
        ends: tuple[End, ...] = ()
        if off:
            leaves = min(off[1] + 200.0, float(self.length))
            begin = max(on[0] - 300.0, 0.0) if on else off[0]
            ends = (End(0, begin, leaves, closed=False, opens=on[0] if on else off[0], closes=off[1]),)
        elif on:
            ends = (on_ramp(0, *on, entry=max(on[0] - 300.0, 0.0)),)
        return Lanes(self.lanes_count + bool(ends), length=float(self.length), ends=ends)

    @cached_property
    def rules(self) -> tuple[Effect, ...]:
        """What the road tells its drivers."""
        return (*super().rules, Destination()) if self._ramps[1] else super().rules

    @property
    def closed(self) -> Sequence[Mapping[str, Any]]:
        """As they are given; between the ramps there is no lane 0."""
        on, off = self._ramps
        return (*self.closures, {"lane": 0, "begin": on[1], "end": off[0]}) if on and off else self.closures

    @property
    def exits(self) -> Mapping[str, float]:  # type: ignore[override]
        """The off-ramp."""
        off = self._ramps[1]
        return {"exit": off[1]} if off else {}

    def params(self, dtype: torch.dtype, device: torch.device | str) -> dict[str, dict[str, Tensor]]:
        """Return checked parameters as tensors, with who wants to leave by the off-ramp."""
        values, off = super().params(dtype, device), self._ramps[1]
        if not off:
            return values
        evenly = tuple(spread("exits_share", {"exit": self.exits_share}, self.vehicles, SECOND))
        places = evenly if self.table is None else self.table.destination
        leaves = torch.tensor([x == "exit" for x in places], device=device)
        first, last = torch.where(leaves, 0.0, 1.0), torch.where(leaves, 0.0, 1000.0)
        own = {"first": first, "last": last, "place": torch.full((self.vehicles,), off[1], device=device)}
        mine = {name: x.to(dtype) for name, x in own.items()}
        return {**values, "destination": {**values["destination"], **mine}}

    @property
    def ramp(self) -> int | None:  # type: ignore[override]
        """The on-ramp's lane."""
        return 0 if self._ramps[0] else None

    @property
    def inflows(self) -> Mapping[int, float]:
        """The same for each lane, and the on-ramp's."""
        first = self.road.count - self.lanes_count
        own = dict.fromkeys(range(first, self.road.count), self.inflow / self.lanes_count)
        return {0: self.ramp_inflow, **own} if self._ramps[0] else own


@dataclass(frozen=True, eq=False, kw_only=True)
class MergeTask(OpenHighwayTask):
    """A demonstration: two lanes, and a ramp on their right from which one must merge within 200 m; it begins at 100 m.

    It is ``open_highway`` with other defaults, and takes its keywords.
    """

    name: ClassVar[str] = "merge"
    most_filled: ClassVar[float] = 350.0

    lanes_count: int = 2
    length: float = 900.0
    inflow: float = 3000.0
    on_ramp: Sequence[float] | None = (400.0, 600.0)
    ramp_inflow: float = 800.0


@dataclass(frozen=True, eq=False, kw_only=True)
class BottleneckTask(OpenLanesTask):
    """Four lanes; the outer two end at 400 m, the left one of the others at 600 m: 4 → 2 → 1.

    PPO gets ahead of human drivers here, by a fifth of what a planner gains. After the bottleneck of Flow (Vinitsky et
    al. 2018, CoRL, "Benchmarks for reinforcement learning in mixed-autonomy traffic").

    Args:
        inflow: Vehicles an hour on all lanes together.
    """

    name: ClassVar[str] = "bottleneck"

    inflow: float = 1900.0

    @cached_property
    def road(self) -> Lanes:  # type: ignore[override]
        """The road, 800 m long."""
        return Lanes(4, length=800.0, ends=(lane_drop(0, at=400.0), lane_drop(3, at=400.0), lane_drop(2, at=600.0)))

    @property
    def inflows(self) -> Mapping[int, float]:
        """A quarter for each lane."""
        return dict.fromkeys(range(4), 0.25 * self.inflow)
