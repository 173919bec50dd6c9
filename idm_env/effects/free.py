"""Curves over a feature of the scene: what to add when nothing in the catalogue has a name for it."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import ClassVar, Literal

from torch import Tensor

from idm_env.effects.base import Effect, P
from idm_env.effects.places import along, curve
from idm_env.parameters import Parameter, nearest
from idm_env.types import Driver, Scene

FEATURES: dict[str, str] = {
    "position": "m",
    "time": "s",
    "speed": "m/s",
    "gap": "m",
    "closing_speed": "m/s",
    "lead_accel": "m/s²",
    "relative_gap": "1",
}
"""Features that a curve can run over, with their units."""
PER: dict[str, float] = {"speed": 15.0, "gap": 20.0, "closing_speed": 2.0, "lead_accel": 1.0, "relative_gap": 1.0}
"""What a curve may be proportional to: states, and how much of each counts as one, up to twice as much."""
FREE = 3.0
"""Relative gap from which on a driver is free: a larger one is not told from it."""

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
    return along(values[feature], period)


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
class Curve(Effect):
    """An added acceleration ``+ Σ c_k hat_k(x)``, piecewise linear in one feature x of the scene, free at its knots.

    ``by`` another state it is proportional to that (``share_of``): with a curve without, a surface over two states.
    ``number`` tells curves of one quantity over one feature apart, such as those with other knots.
    """

    kind: ClassVar[str] = "curve"
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
        x = feature_of(scene, driver, self.feature, self.period)
        c = curve(x, p, "knot", self.knots, self.period)
        return c * share_of(scene, driver, self.by) if self.by else c


@dataclass(frozen=True)
class DriverCurve(Effect):
    """One driver parameter times ``1 + Σ c_k hat_k(x)`` over one feature x: T(x), v0(t) and their kin.

    ``by`` and ``number`` are those of ``Curve``.
    """

    kind: ClassVar[str] = "driver_curve"
    rank: ClassVar[int] = 3
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
        x = feature_of(scene, driver, self.feature, self.period)
        change = curve(x, p, "knot", self.knots, self.period)
        change = change * share_of(scene, driver, self.by) if self.by else change
        return driver._replace(**{self.target: getattr(driver, self.target) * (1.0 + change)})
