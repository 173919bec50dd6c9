"""Curves over a feature of the scene: what to add when nothing in the catalogue has a name for it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from idm_env.effects.base import Effect, P
from idm_env.effects.places import curve, on_lap
from idm_env.parameters import Parameter, nearest
from idm_env.types import Driver, Scene

CARRIED: dict[str, str] = {
    "time_since_stop": "s",
    "mean_speed_20s": "m/s",
    "mean_speed_90s": "m/s",
    "braking_15s": "m/s²",
    "lead_braking_15s": "m/s²",
    "own_accel": "m/s²",
    "lead_trend": "m/s",
    "headway_behind": "s",
    "gap_behind": "m",
    "second_opening": "m/s",
}
"""Numbers that a driver carries along (``next_history``), with their units."""
AGO, AGO_S = "lead_change_3s", 3.0
"""The feature that looks back, and how far (s)."""
HISTORY: dict[str, str] = {**CARRIED, AGO: "m/s"}
"""Features of the past and of neighbours beyond the leader, with their units."""
NEIGHBOUR = {"headway_behind": "behind", "gap_behind": "behind", "second_opening": "second_leader"}
"""Whom a feature needs to see beside the leader."""
FEATURES: dict[str, str] = {
    "position": "m",
    "time": "s",
    "speed": "m/s",
    "gap": "m",
    "closing_speed": "m/s",
    "lead_accel": "m/s²",
    "relative_gap": "1",
    **HISTORY,
}
"""Features that a curve can run over, with their units: those of the scene first."""
PER: dict[str, float] = {"speed": 15.0, "gap": 20.0, "closing_speed": 2.0, "lead_accel": 1.0, "relative_gap": 1.0}
"""What a curve may be proportional to: states, and how much of each counts as one, up to twice as much."""
FREE = 3.0
"""Relative gap from which on a driver is free: a larger one is not told from it."""
STOPPED, LONG_AGO = 0.5, 90.0
"""Speed (m/s) up to which a driver stands, and time (s) after which a stop is forgotten, or was never seen."""

Target = Literal["time_gap", "desired_speed", "max_accel", "comfort_decel", "min_gap"]


def feature_of(scene: Scene, driver: Driver, feature: str, period: float | None) -> Tensor:
    """Return a feature of the scene, in the unit of ``FEATURES``, shape ``(…, vehicles)``; ``period`` has that unit.

    The relative gap is ``min(s / (s0 + T v), 3)``.
    """
    desired = driver.min_gap + driver.extra_gap + driver.time_gap * scene.speed
    values = {
        "position": scene.position,
        "time": scene.time,
        "speed": scene.speed,
        "gap": scene.leader.gap,
        "closing_speed": scene.speed - scene.leader.speed,
        "lead_accel": scene.leader.accel,
        "relative_gap": (scene.leader.gap / desired).clamp(0.0, FREE),
    }
    return on_lap(values[feature], period)


class Now(NamedTuple):
    """What ``CARRIED`` features are made of, shape ``(…, vehicles)``: accelerations, and neighbours that are seen.

    ``headway`` is the follower's gap over his speed (at least 1.5 m/s), 5 s at most and where there is none, ``behind``
    his gap, 40 m likewise; ``opening`` is the second leader's speed less that of the leader (m/s), 0 where none is.
    """

    speed: Tensor
    accel: Tensor
    lead_accel: Tensor
    headway: Any
    behind: Any
    opening: Any

    @classmethod
    def of(cls, scene: Scene) -> Now:
        """Return the numbers of a scene."""
        second, behind, lead = scene.second_leader, scene.behind, scene.leader
        room: tuple[Any, Any] = None, None
        if behind is not None:
            room = room_behind(behind.gap, behind.speed, behind.present)
        opening = None if second is None else (second.speed - lead.speed) * second.present
        return cls(scene.speed, scene.accel, lead.accel, *room, opening)


def room_behind(gap: Tensor, speed: Tensor, present: Tensor) -> tuple[Tensor, Tensor]:
    """Return the time gap of the vehicle behind (s), 5 at most, and its gap (m), 40 at most: ``(…, vehicles)``."""
    follows = present > 0.0
    time_gap = (gap / speed.clamp_min(1.5)).clamp(0.0, 5.0)
    return torch.where(follows, time_gap, 5.0), torch.where(follows, gap.clamp(0.0, 40.0), 40.0)


def first_history(now: Now) -> dict[str, Any]:
    """Return the features of ``CARRIED``, shape ``(…, vehicles)``, where nothing is known of the past.

    There was no stop, one speed, and no other braking.
    """
    since, still = torch.where(now.speed > STOPPED, LONG_AGO, 0.0 * now.speed), 0.0 * now.lead_accel
    braking = torch.relu(-now.accel), torch.relu(-now.lead_accel)
    values = (since, now.speed, now.speed, *braking, now.accel, still, now.headway, now.behind, now.opening)
    return dict(zip(CARRIED, values, strict=True))


def next_history(held: Mapping[str, Tensor], dt: float, now: Now) -> dict[str, Any]:
    """Return the features of ``CARRIED`` one step later, shape ``(…, vehicles)``, from those ``held`` and the present.

    Time grows by Δt to ``LONG_AGO`` and is 0 while the driver stands; a mean over τ is ``(τ m + Δt x) / (τ + Δt)``, of
    the own acceleration with τ = 1 s; the hardest braking ``max(−a, m τ / (τ + Δt))`` fades, τ = 15 s, and so does the
    leader's change of speed, ``(m + Δt a_lead) τ / (τ + Δt)`` with τ = 5 s.
    """
    values: dict[str, Callable[[Any], Any]] = {
        "time_since_stop": lambda m: torch.where(now.speed > STOPPED, (m + dt).clamp(0.0, LONG_AGO), 0.0 * m),
        "mean_speed_20s": lambda m: m + (now.speed - m) * (dt / (20.0 + dt)),
        "mean_speed_90s": lambda m: m + (now.speed - m) * (dt / (90.0 + dt)),
        "braking_15s": lambda m: torch.maximum(-now.accel, m * (15.0 / (15.0 + dt))),
        "lead_braking_15s": lambda m: torch.maximum(-now.lead_accel, m * (15.0 / (15.0 + dt))),
        "own_accel": lambda m: m + (now.accel - m) * (dt / (1.0 + dt)),
        "lead_trend": lambda m: (m + now.lead_accel * dt) * (5.0 / (5.0 + dt)),
        "headway_behind": lambda m: now.headway,
        "gap_behind": lambda m: now.behind,
        "second_opening": lambda m: now.opening,
    }
    return {name: values[name](m) for name, m in held.items()}


def change_of(scene: Scene) -> Tensor:
    """Return the leader's speed less that of ``AGO_S`` ago (m/s), shape ``(…, vehicles)``."""
    return scene.leader.speed - scene.past(torch.full_like(scene.speed, AGO_S)).leader.speed


class OverFeature:
    """Part of an effect that stands over one ``feature``; one that is carried along is a memory ``(…, vehicles)``."""

    feature: str
    name: Any

    @property
    def remembers(self) -> bool:
        """Whether the feature is carried along."""
        return self.feature in CARRIED

    @property
    def needs(self) -> frozenset[str]:
        """The neighbour that the feature needs, if any."""
        return frozenset(n for f, n in NEIGHBOUR.items() if f == self.feature)

    @property
    def looks_back(self) -> float:
        """``AGO_S`` of the feature that looks back, else 0 (s)."""
        return AGO_S if self.feature == AGO else 0.0

    @property
    def wind_up_s(self) -> float:
        """The whole record, for a feature that is carried along."""
        return math.inf if self.remembers else Effect.wind_up_s

    def x_of(self, scene: Scene, driver: Driver, period: float | None = None) -> Tensor:
        """Return the feature now, in the unit of ``FEATURES``."""
        if self.feature == AGO:
            return change_of(scene)
        return scene.memory[self.name] if self.remembers else feature_of(scene, driver, self.feature, period)

    def initial_memory(self, scene: Scene, driver: Driver, p: P) -> Tensor | None:
        """Return the feature where nothing is known of the past."""
        first: Tensor | None = first_history(Now.of(scene))[self.feature] if self.remembers else None
        return first

    def remember(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return the feature one step later."""
        held = {self.feature: scene.memory[self.name]}
        later: Tensor = next_history(held, scene.dt, Now.of(scene))[self.feature]
        return later


def share_of(scene: Scene, driver: Driver, state: str) -> Tensor:
    """Return by how much a curve counts in a state of ``PER``, shape ``(…, vehicles)``: ``x / per``, from −2 to 2."""
    return (feature_of(scene, driver, state, None) / PER[state]).clamp(-2.0, 2.0)


def _ending(by: str, number: int) -> str:
    return (f"_by_{by}" if by else "") + (f"_{number}" if number > 1 else "")


def _check(name: str, feature: str, knots: tuple[float, ...], by: str) -> None:
    if by and by not in PER:
        raise ValueError(f"{name}.by = '{by}' is no state of the driver.{nearest(by, PER)}")
    if feature not in FEATURES:
        raise ValueError(f"{name}.feature = '{feature}' is not a feature of the scene.{nearest(feature, FEATURES)}")
    if len(knots) < 2 or any(b <= a for a, b in pairwise(knots)):
        raise ValueError(f"{name}.knots = {knots} must be at least two rising values ({FEATURES[feature]}).")


@dataclass(frozen=True)
class Curve(OverFeature, Effect):  # type: ignore[misc, override]
    """An added acceleration ``+ Σ c_k hat_k(x)``, piecewise linear in one feature x of the scene, free at its knots.

    ``by`` another state it is proportional to that (``share_of``): with a curve without, a surface over two states.
    ``number`` tells curves of one quantity over one feature apart, such as those with other knots.
    """

    kind = "curve"
    feature: str = "speed"
    knots: tuple[float, ...] = (0.0, 10.0, 20.0, 30.0)
    period: float | None = None
    by: str = ""
    number: int = 1

    def __post_init__(self) -> None:
        _check("curve", self.feature, self.knots, self.by)

    @property
    def name(self) -> str:
        """``curve_over_`` and the feature, so that several curves fit into one simulator; ``_by_`` and the state."""
        return f"curve_over_{self.feature}" + _ending(self.by, self.number)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """One acceleration per knot."""
        return tuple(
            Parameter(f"knot_{i}", f"c{i}", "m/s²", 0.1 * (-1) ** i, -5.0, 5.0, null=0.0)
            for i in range(len(self.knots))
        )

    def accelerate(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return the curve's acceleration (m/s²)."""
        x = self.x_of(scene, driver, self.period)
        c = curve(x, p, "knot", self.knots, self.period)
        return c * share_of(scene, driver, self.by) if self.by else c


@dataclass(frozen=True)
class DriverCurve(OverFeature, Effect):  # type: ignore[misc, override]
    """One driver parameter times ``1 + Σ c_k hat_k(x)`` over one feature x: T(x), v0(t) and their kin.

    ``by`` and ``number`` are those of ``Curve``.
    """

    kind = "driver_curve"
    rank = 3
    target: Target = "time_gap"
    feature: str = "position"
    knots: tuple[float, ...] = (0.0, 500.0, 1000.0)
    period: float | None = None
    by: str = ""
    number: int = 1

    def __post_init__(self) -> None:
        _check("driver_curve", self.feature, self.knots, self.by)
        if self.target not in Driver._fields:
            raise ValueError(f"driver_curve.target = '{self.target}' is unknown.{nearest(self.target, Driver._fields)}")

    @property
    def name(self) -> str:
        """The target, ``_over_`` and the feature, ``_by_`` and the state."""
        return f"{self.target}_over_{self.feature}" + _ending(self.by, self.number)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """One relative change per knot."""
        return tuple(
            Parameter(f"knot_{i}", f"c{i}", "1", 0.1 * (-1) ** i, -0.9, 3.0, null=0.0) for i in range(len(self.knots))
        )

    def adapt(self, driver: Driver, scene: Scene, p: P) -> Driver:
        """Return the driver with the target parameter changed."""
        x = self.x_of(scene, driver, self.period)
        change = curve(x, p, "knot", self.knots, self.period)
        change = change * share_of(scene, driver, self.by) if self.by else change
        return driver._replace(**{self.target: getattr(driver, self.target) * (1.0 + change)})
