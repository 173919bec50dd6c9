"""Rules of the road: speed limits, closed lanes, signals, and the lanes on which drivers leave."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from idm_env.effects.base import Effect, P
from idm_env.effects.idm import interaction
from idm_env.effects.references import PUBLICATIONS
from idm_env.parameters import Parameter
from idm_env.types import FAR, Driver, Mark, Scene, Wish

EVERY_LANE = -1
"""Stands for all lanes of a road."""
_PER_LANE = 300.0
"""Way (m) that a driver allows for each lane that he has to change; LMRS has 295."""


def _rows(kind: str, rows: Sequence[Sequence[float]], names: Sequence[str]) -> None:
    """Raise ValueError for rows of another length, of no numbers, without a lane, or that end before they begin."""
    for row in rows:
        if len(row) != len(names) or any(math.isnan(x) for x in row):
            raise ValueError(f"{kind}: {tuple(row)} must give {', '.join(names)}.")
        if row[0] != int(row[0]) or row[0] < EVERY_LANE:
            raise ValueError(f"{kind}: lane = {row[0]:g} must be a whole number from 0 on, or {EVERY_LANE} for all.")
        if not row[1] < row[2]:
            raise ValueError(f"{kind} from {row[1]:g} m to {row[2]:g} m must end behind its beginning.")


def _is_on(scene: Scene, lane: float) -> Tensor:
    """Return a mask of the vehicles on a lane (bool, ``[..., n]``)."""
    assert scene.lane is not None
    return (scene.lane - lane).abs() < (0.5 if lane != EVERY_LANE else math.inf)


def before_obstacle(room: Tensor, scene: Scene, driver: Driver) -> Tensor:
    """Return the further IDM deceleration for a standing obstacle ``room`` metres ahead ``[..., n]`` (m/s², ≤ 0)."""
    leader = interaction(driver, scene.speed, scene.leader.gap, scene.leader.speed) * scene.leader.present
    more = torch.relu(interaction(driver, scene.speed, room, torch.zeros_like(room)) - leader)
    return torch.where(room < FAR, -driver.max_accel * more, 0.0)


@dataclass(frozen=True)
class SpeedLimit(Effect):
    """Speed limits by lane and place: ``v0 → v0 + c (min(v0, v_lim) − v0)`` between two places of a lane.

    ``zones`` are rows of lane (−1: all), beginning (m), end (m) and limit v_lim (m/s); where several hold, the lowest
    does. c is the share of the difference that drivers obey, 0 nobody.

    ValueError for a limit of 0 or below, or a zone that ends before it begins.
    """

    kind = "speed_limit"
    needs = frozenset({"lane"})
    acts_on = "desired_speed"
    title = "speed limits"
    equation = "v0 → v0 + c (min(v0, v_lim) − v0)"
    rank = 2
    declared = (Parameter("compliance", "c", "1", 1.0, 0.0, 1.0, null=0.0, role="shape"),)
    zones: tuple[tuple[float, ...], ...] = ((-1.0, 100.0, 1000.0, 8.0),)

    def __post_init__(self) -> None:
        _rows("speed limit", self.zones, ("lane", "beginning (m)", "end (m)", "limit (m/s)"))
        for zone in self.zones:
            if not 0.0 < zone[3] < math.inf:
                raise ValueError(f"speed limit = {zone[3]:g} m/s must be above 0. Close the lane to keep it empty.")

    def adapt(self, driver: Driver, scene: Scene, p: P) -> Driver:
        """Return the driver with the desired speed that is left."""
        speed = driver.desired_speed
        for lane, begin, end, limit in self.zones:
            here = _is_on(scene, lane) & (scene.position >= begin) & (scene.position < end)
            speed = torch.where(here, torch.clamp(speed, max=limit), speed)
        return driver._replace(desired_speed=driver.desired_speed + p["compliance"] * (speed - driver.desired_speed))


@dataclass(frozen=True)
class LaneClosure(Effect):
    """Lanes that are closed over a stretch, for a time: somebody stands at the beginning, and nobody changes in.

    ``closures`` are rows of lane, beginning (m), end (m), and from when until when (s). Who is in the stretch when it
    closes drives on; from before it one has to change, as from a lane that ends, or brakes as ``Signal`` says. Without
    rows it is absent.
    """

    kind = "lane_closure"
    needs = frozenset({"lane"})
    adds = False
    title = "closed lanes"
    closures: tuple[tuple[float, ...], ...] = ((0.0, 400.0, 600.0, 0.0, 600.0),)

    def __post_init__(self) -> None:
        _rows("closure", self.closures, ("lane", "beginning (m)", "end (m)", "since (s)", "until (s)"))
        for row in self.closures:
            if row[0] == EVERY_LANE or not row[3] < row[4]:
                raise ValueError(
                    f"closure of lane {row[0]:g} from {row[3]:g} s to {row[4]:g} s: name one lane, and rise."
                )

    def room(self, scene: Scene, p: P) -> Tensor:
        """Return how far it is to the beginning of a stretch ahead; 0 in a stretch."""
        return self._room(scene, 0.0)

    def marks(self, time: float, p: P) -> tuple[Mark, ...]:
        """Return the stretches that are closed at this time (s)."""
        rows = (row for row in self.closures if row[3] <= time < row[4])
        return tuple(Mark(int(lane), begin, end, True) for lane, begin, end, _, _ in rows)

    def _room(self, scene: Scene, inside: float) -> Tensor:
        room = torch.full_like(scene.position, FAR)
        for lane, begin, end, since, until in self.closures:
            now = _is_on(scene, lane) & (scene.time >= since) & (scene.time < until)
            ahead, between = scene.position <= begin, scene.position < end
            way = torch.where(ahead, begin - scene.position, torch.where(between, room * 0.0 + inside, FAR))
            room = torch.where(now, torch.minimum(room, way), room)
        return room

    def accelerate(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return the deceleration for a standing obstacle where the lane is closed (m/s²)."""
        return before_obstacle(self._room(scene, FAR), scene, driver)


@dataclass(frozen=True)
class Signal(Effect):
    """A signal with a fixed cycle, on all lanes: red in the last r seconds of each cycle of C seconds.

    ::

        red where (t − φ) mod C ≥ C − r;   who is before the line x_s and can stop, v² ≤ 2 b_m (x_s − x), stops there:
        A += −a max(0, (s*/s)²_line − (s*/s)²_leader),   that of somebody who stands at the line

    Amber is in b_m: who would have to brake harder drives on. Who has begun to stop does so until it has been green for
    ρ, his reaction, however late he brakes: that is his memory, 1 or 0. Absent at r = 0.
    """

    kind = "signal"
    adds = False
    title = "signal"
    equation = "red where (t − φ) mod C ≥ C − r"
    declared = (
        Parameter("place", "x_s", "m", 400.0, -1e6, 1e6, role="place"),
        Parameter("cycle", "C", "s", 60.0, 1.0, 3600.0, role="shape"),
        Parameter("red", "r", "s", 30.0, 0.0, 3600.0, null=0.0, role="threshold", most="cycle"),
        Parameter("offset", "φ", "s", 0.0, -3600.0, 3600.0, role="shape"),
        Parameter("most_decel", "b_m", "m/s²", 3.0, 0.5, 9.0, role="threshold"),
        Parameter("reaction", "ρ", "s", 0.0, 0.0, 10.0, null=0.0, role="threshold"),
    )

    @staticmethod
    def phase(time: Tensor, p: P) -> tuple[Tensor, Tensor]:
        """Return the time since it became green (s), and whether it is red."""
        since = torch.remainder(time - p["offset"], p["cycle"])
        return since, since >= p["cycle"] - p["red"]

    def marks(self, time: float, p: P) -> tuple[Mark, ...]:
        """Return its line, where there is a red at all."""
        place, red = float(p["place"]), bool(self.phase(torch.tensor(time), p)[1])
        return (Mark(None, place, place, red),) if p["red"] > 0 else ()

    def _stops(self, scene: Scene, p: P) -> Tensor:
        """Return a mask of the vehicles that stop at the line (bool, ``[..., n]``)."""
        since, red = self.phase(scene.time, p)
        way = p["place"] - scene.position
        can = scene.speed * scene.speed <= 2.0 * p["most_decel"] * way
        goes_on = (scene.memory[self.name] > 0.5) & (red | (since < p["reaction"]))
        return (way >= 0) & (goes_on | (red & can))

    def accelerate(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return the deceleration for a standing obstacle at the line while it is red (m/s²)."""
        return before_obstacle(torch.where(self._stops(scene, p), p["place"] - scene.position, FAR), scene, driver)

    def initial_memory(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return 0: nobody has begun to stop."""
        return torch.zeros_like(scene.speed)

    def remember(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return 1 for drivers that stop, otherwise 0."""
        return torch.where(self._stops(scene, p), 1.0, 0.0).to(scene.speed.dtype)


@dataclass(frozen=True)
class Destination(Effect):
    """Where a driver must be to leave as he wants: on lanes ``first`` to ``last`` before a place x_d.

    A lane that is n lanes away goes on for him as far as ``x_d − (n − 1) · 300 m``, so he leaves it as one that
    ends (``MandatoryChange``, ``GapAcceptance``), but does not stand there: who has missed his exit drives on. Within D
    before that he does not change to where it goes on less far. After the route incentive of LMRS (Schakel, Knoop, van
    Arem 2012). Absent where the place is behind everybody.
    """

    kind = "destination"
    sources = (PUBLICATIONS["schakel_2012"],)
    needs = frozenset({"lane"})
    declared = (
        Parameter("first", "k_1", "1", 0.0, 0.0, 1000.0, role="shape"),
        Parameter("last", "k_2", "1", 1000.0, 0.0, 1000.0, role="shape"),
        Parameter("place", "x_d", "m", 1000.0, -1e9, 1e6, null=-1e9, role="place"),
        Parameter("reach", "D", "m", 1000.0, 1.0, 1e5, role="shape"),
    )

    def room(self, scene: Scene, p: P) -> Tensor:
        """Return the distance to the last place to change (m) for drivers on a wrong lane, otherwise FAR."""
        assert scene.lane is not None
        away = torch.relu(p["first"] - scene.lane) + torch.relu(scene.lane - p["last"])
        way = torch.clamp(p["place"] - _PER_LANE * (away - 1.0) - scene.position, min=1.0)
        return torch.where((away > 0.5) & (scene.position < p["place"]), way, FAR)

    def change(self, scene: Scene, driver: Driver, p: P) -> Wish:
        """Return no wish of its own, and no margin for changes away from where the driver wants to be."""
        lane = scene.lane
        assert lane is not None
        none, own = torch.zeros_like(scene.speed), self.room(scene, p)

        def margin(step: float) -> Tensor:
            other = self.room(scene._replace(lane=lane + step), p)
            return torch.where((other < own) & (other < p["reach"]), none - FAR, none + FAR)

        return Wish(none, none, margin(1.0), margin(-1.0))
