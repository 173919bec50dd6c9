"""How fast drivers want to go at a place: a profile that the traffic shows, and bends that are measured (``adapt``)."""

from dataclasses import dataclass

import torch
from torch import Tensor

from idm_env.effects.base import Effect, P
from idm_env.effects.places import curve, on_lap, rising
from idm_env.effects.references import PUBLICATIONS
from idm_env.parameters import Parameter
from idm_env.types import Driver, Scene


@dataclass(frozen=True)
class SpeedProfile(Effect):
    """``v0 → v0 max(1 + c(x), 0.1)``, c piecewise linear over ``knots`` (m) and free at each of them.

    Several bends, crossings or signs on one road, where ``speed_zone`` is one stretch of it. On a lap of ``period``
    metres where given.
    """

    kind = "speed_profile"
    title = "desired speed by place"
    equation = "v0 → v0 (1 + c(x))"
    wording = (
        "drivers want to go slower at some places of the road, where {law} has one desired speed",
        "drivers want to go faster at some places of the road than at others, where {law} has one desired speed",
    )
    looks_like = ("speed_zone", "grade", "time_gap over position")
    told_by = "the same place at low and high speed: a slope acts always, a desired speed on those near it"
    sought = "profile"
    acts_on = "desired_speed"
    rank = 1
    knots: tuple[float, ...] = (0.0, 250.0, 500.0, 750.0, 1000.0)
    period: float | None = None

    def __post_init__(self) -> None:
        rising(self.kind, self.knots)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """One relative change per knot."""
        return tuple(
            Parameter(f"change_{i}", f"c{i}", "1", 0.2 * (-1) ** (i + 1), -0.85, 1.0, null=0.0)
            for i in range(len(self.knots))
        )

    @classmethod
    def strength_of(cls, change: float) -> float:
        """Return c: the response is that of (v/v0)⁴, whose factor (1 + c)⁻⁴ is known to all orders."""
        factor = min(max(1.0 - 4.0 * change, 0.3), 100.0) ** -0.25
        return min(max(factor - 1.0, -0.7), 0.3)

    def adapt(self, driver: Driver, scene: Scene, p: P) -> Driver:
        """Return the driver with the desired speed of this place."""
        change = curve(on_lap(scene.position, self.period), p, "change", self.knots, self.period)
        return driver._replace(desired_speed=driver.desired_speed * (1.0 + change).clamp_min(0.1))


@dataclass(frozen=True)
class CurveSpeed(Effect):
    """No faster through a bend than a lateral acceleration allows: ``v0 → min(v0, √(a_lat / |κ(x)|))``.

    κ (1/m, of either sign) is measured: ``profile`` at ``knots`` (m), piecewise linear between them, on a lap of
    ``period`` metres where given. Drivers keep 1.8 to 4 m/s² (Reymond, Kemeny, Droulez, Berthoz 2001, Human Factors
    43(3), 483). Absent at its null, a lateral acceleration that no tyre holds.
    """

    kind = "curve_speed"
    sources = (PUBLICATIONS["reymond_2001"],)
    title = "speed in bends"
    equation = "v0 → min(v0, √(a_lat / |κ(x)|))"
    wording = (
        "drivers go through bends no faster than a lateral acceleration allows, where {law} has one desired speed",
        "",
    )
    looks_like = ("speed_profile", "speed_zone", "grade")
    told_by = "bends of several radii: one lateral acceleration fits all of them, a zone each its own"
    sought = "given"
    column = "curvature"
    acts_on = "desired_speed"
    rank = 1
    declared = (
        Parameter("lateral_accel", "a_lat", "m/s²", 2.5, 0.2, 15.0, null=1e6, role="threshold", starts=(1.5, 3.0, 5.0)),
    )
    knots: tuple[float, ...] = (0.0, 250.0, 500.0, 750.0, 1000.0)
    profile: tuple[float, ...] = (0.0, 0.1, -0.06, 0.03, 0.0)
    period: float | None = None

    def __post_init__(self) -> None:
        rising(self.kind, self.knots, self.profile)

    def adapt(self, driver: Driver, scene: Scene, p: P) -> Driver:
        """Return the driver with the desired speed that the bend leaves."""
        place = on_lap(scene.position, self.period)
        bend: Tensor = curve(place, p, "curvature", self.knots, self.period, self.profile).abs()
        most = torch.sqrt(p["lateral_accel"] / bend.clamp_min(1e-6))
        return driver._replace(desired_speed=torch.minimum(driver.desired_speed, most))
