"""Places in discovery's loop for what has no name: a curve over any feature that changes any number of the driver.

One pair of effects stands for all curves and intervals. Which feature and which numbers is said by weights of 0 and 1,
which are parameters, so that one compiled loop serves every choice.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from torch import Tensor

from idm_env.effects.base import Effect, P
from idm_env.effects.free import FEATURES, DriverCurve, feature_of
from idm_env.effects.places import curve
from idm_env.parameters import Parameter
from idm_env.types import Driver, Scene

TARGETS: dict[str, tuple[str, ...]] = {
    "time_gap": ("time_gap",),
    "desired_speed": ("desired_speed",),
    "max_accel": ("max_accel",),
    "comfort_decel": ("comfort_decel",),
    "accel_and_decel": ("max_accel", "comfort_decel"),
}
"""What a curve may change, and the driver's parameters that this means; ``acceleration`` is added instead."""
CHANGED = ("time_gap", "desired_speed", "max_accel", "comfort_decel")


def _weights(names: tuple[str, ...]) -> tuple[Parameter, ...]:
    return tuple(Parameter(name, "", "1", 0.0, 0.0, 1.0, null=0.0) for name in names)


@dataclass(frozen=True)
class Slot(Effect):
    """A driver whose parameters are multiplied by ``1 + w c``: c a curve at Σ w x over the features x, or the input.

    ``given`` takes c from the input. The weights w are parameters.
    """

    kind: ClassVar[str] = "slot"
    rank: ClassVar[int] = DriverCurve.rank
    declared: ClassVar[tuple[Parameter, ...]] = _weights((*(f"over_{f}" for f in FEATURES), *CHANGED))
    label: str = ""
    given: bool = False
    knots: tuple[float, ...] = (0.0, 1.0)
    values: tuple[float, ...] = (0.0, 0.0)

    @property
    def name(self) -> str:
        """``slot_`` and the label."""
        return f"{self.kind}_{self.label}"

    def value(self, scene: Scene, p: P) -> Tensor:
        """Return c."""
        if self.given:
            given: Tensor = scene.input(self.name)
            return given
        x: Any = 0.0
        for feature in FEATURES:
            x = x + p[f"over_{feature}"] * feature_of(scene, feature, None)
        return curve(x, p, "knot", self.knots, None, self.values)

    def adapt(self, driver: Driver, scene: Scene, p: P) -> Driver:
        """Return the driver with the parameters changed."""
        c = self.value(scene, p)
        return driver._replace(**{n: getattr(driver, n) * (1.0 + p[n] * c) for n in CHANGED})


@dataclass(frozen=True)
class Push(Effect):
    """An added acceleration c, as in ``Slot``."""

    kind: ClassVar[str] = "push"
    declared: ClassVar[tuple[Parameter, ...]] = _weights(tuple(f"over_{f}" for f in FEATURES))
    label: str = ""
    given: bool = False
    knots: tuple[float, ...] = (0.0, 1.0)
    values: tuple[float, ...] = (0.0, 0.0)

    name = Slot.name
    value = Slot.value

    def accelerate(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return c (m/s²)."""
        return self.value(scene, p)
