"""Physics of the road and the air: slopes and drag (hook ``accelerate``, seeing the true scene)."""

from dataclasses import dataclass

import torch
from torch import Tensor

from idm_env.effects.base import Effect, P
from idm_env.effects.places import curve, on_lap, rising
from idm_env.parameters import Parameter
from idm_env.types import Driver, Scene

GRAVITY = 9.81
"""Standard gravity, rounded (m/s²)."""


@dataclass(frozen=True)
class Grade(Effect):
    """Gravity on a slope: ``− share · g sin(arctan(slope(x)))``, slope (rise over run) piecewise linear over ``knots``.

    With ``profile`` (one slope per knot) the road is known, and ``share`` is the parameter: 1 is gravity
    uncompensated, 0 a driver or controller who compensates it all. Without it every knot's slope is a parameter and
    the profile is found from the traffic. ``knots`` are positions (m), on a lap of ``period`` metres where given.
    """

    kind = "grade"
    title = "slope of the road"
    equation = "− g sin(arctan(slope(x)))"
    wording = (
        "vehicles go faster uphill and slower downhill, which {law} does not know",
        "vehicles are held back uphill and pushed on downhill, which {law} does not know",
    )
    looks_like = ("speed_zone", "time_gap over position")
    told_by = "the same place at low and high speed, with and without leader, tells a grade from a speed zone"
    sought = "profile"
    column = "grade"
    sees_truth = True
    knots: tuple[float, ...] = (0.0, 250.0, 500.0, 750.0, 1000.0)
    profile: tuple[float, ...] | None = None
    period: float | None = None

    def __post_init__(self) -> None:
        rising(self.kind, self.knots, self.profile)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The share of a known profile, or the slope at every knot."""
        if self.profile is not None:
            return (Parameter("share", "", "1", 1.0, -2.0, 3.0, null=0.0, starts=(0.2,)),)
        return tuple(
            Parameter(f"slope_{i}", f"θ{i}", "1", 0.02 * (-1) ** i, -0.2, 0.2, null=0.0) for i in range(len(self.knots))
        )

    @classmethod
    def strength_of(cls, change: float) -> float:
        """Return the slope that pulls by ``change`` (m/s²)."""
        return change / -GRAVITY

    def accelerate(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return gravity's part (m/s²)."""
        slope = curve(on_lap(scene.position, self.period), p, "slope", self.knots, self.period, self.profile)
        pull = -GRAVITY * slope / torch.sqrt(1.0 + slope * slope)
        return pull if self.profile is None else p["share"] * pull


@dataclass(frozen=True)
class Drag(Effect):
    """Air drag ``− c v²`` beyond what the driver compensates; c = ρ c_w A / (2 m), 2e-4 to 8e-4 1/m for cars."""

    kind = "drag"
    title = "drag"
    equation = "− c v²"
    wording = (
        "vehicles are pushed on by the square of their speed, beyond {law}",
        "vehicles are held back by the square of their speed, beyond {law}",
    )
    looks_like = ("speed_dependent_gap", "power_limit", "desired_speed")
    told_by = "free starts from standstill to above 25 m/s tell drag from v0 and power"
    sees_truth = True
    declared = (Parameter("coefficient", "c", "1/m", 4e-4, -2e-3, 5e-3, null=0.0, starts=(1e-4,)),)

    def accelerate(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return the drag (m/s²)."""
        return -p["coefficient"] * scene.speed * scene.speed
