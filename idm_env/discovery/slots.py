"""Places in discovery's loop for what has no name: a curve over any feature that changes any number of the driver.

One pair of effects stands for all curves and intervals. Which feature and which numbers is said by parameters, so that
one compiled loop serves every choice.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from idm_env.effects import DriverCurve
from idm_env.effects.base import Effect, P
from idm_env.effects.free import (
    AGO,
    AGO_S,
    CARRIED,
    FEATURES,
    HISTORY,
    NEIGHBOUR,
    PER,
    Now,
    OverFeature,
    change_of,
    feature_of,
    first_history,
    next_history,
    share_of,
)
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
SETS = (("time_gap", "desired_speed"), ("max_accel", "comfort_decel"))
"""Parameters that one slot may change: what a curve leaves alone must not wait for it."""


OVER = Parameter("over", "", "1", 0.0, 0.0, len(FEATURES) - 1.0, role="shape")
"""Which feature a curve runs over: its place in ``FEATURES``."""
BY = Parameter("by", "", "1", 0.0, 0.0, float(len(PER)), role="shape")
"""Which state a curve is proportional to: 1 and its place in ``PER``, 0 for none."""


def _chosen(values: Mapping[str, Tensor], p: P) -> Tensor:
    """Return which of the features' values is meant, 0 for none: the loop need not wait for what does not count."""
    x: Any = 0.0
    for feature, value in values.items():
        x = torch.where(p["over"] == list(FEATURES).index(feature), value, x)
    return x  # type: ignore[no-any-return]


@dataclass(frozen=True)
class _OverAny(OverFeature):
    """Part of an effect that stands over any feature of the scene, or of the ``past``, or is an input (``given``)."""

    label: str = ""
    given: bool = False
    past: bool = False
    knots: tuple[float, ...] = (0.0, 1.0)
    values: tuple[float, ...] = (0.0, 0.0)

    @property
    def remembers(self) -> bool:
        """Whether the features are those of the past."""
        return self.past

    @property
    def needs(self) -> frozenset[str]:
        """All neighbours that features of the past and of neighbours need."""
        return frozenset(NEIGHBOUR.values()) if self.past else frozenset()

    @property
    def looks_back(self) -> float:
        """``AGO_S`` for the past (s)."""
        return AGO_S if self.past else 0.0

    def initial_memory(self, scene: Scene, driver: Driver, p: P) -> Tensor | None:
        """Return the feature where nothing is known of the past."""
        return _chosen(first_history(Now.of(scene)), p) if self.past else None

    def remember(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return the feature one step later."""
        held = dict.fromkeys(CARRIED, scene.memory[self.name])
        return _chosen(next_history(held, scene.dt, Now.of(scene)), p)


def _value(effect: Slot | Push, scene: Scene, driver: Driver, p: P) -> Tensor:
    """Return c."""
    if effect.given:
        return scene.input(effect.name)
    if effect.past:
        x = torch.where(p["over"] == list(FEATURES).index(AGO), change_of(scene), scene.memory[effect.name])
    else:
        now = [f for f in FEATURES if f not in HISTORY]
        x = _chosen({f: feature_of(scene, driver, f, None) for f in now}, p)
    share: Any = 1.0
    for number, state in enumerate(PER, 1):
        share = torch.where(p["by"] == number, share_of(scene, driver, state), share)
    return curve(x, p, "knot", effect.knots, None, effect.values) * share


@dataclass(frozen=True)
class Slot(_OverAny, Effect):  # type: ignore[misc, override]
    """Some parameters of the driver times ``1 + c``: c a curve over one feature, or the input (``given``).

    Which feature and which parameters is said by parameters: ``over``, and 1 for what changes.
    """

    kind: ClassVar[str] = "slot"
    rank: ClassVar[int] = DriverCurve.rank
    targets: tuple[str, ...] = SETS[0]

    @property
    def name(self) -> str:
        """``slot_``, the first parameter that may change, and the label."""
        return f"{self.kind}_{self.targets[0]}_{self.label}"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Which feature, and 1 for each parameter that changes."""
        return (OVER, BY, *(Parameter(name, "", "1", 0.0, 0.0, 1.0, null=0.0) for name in self.targets))

    def adapt(self, driver: Driver, scene: Scene, p: P) -> Driver:
        """Return the driver with the parameters changed."""
        c = _value(self, scene, driver, p)
        now = {n: getattr(driver, n) for n in self.targets}
        return driver._replace(**{n: torch.where(p[n] > 0.0, x * (1.0 + c), x) for n, x in now.items()})


@dataclass(frozen=True)
class Push(_OverAny, Effect):  # type: ignore[misc, override]
    """An added acceleration c, as in ``Slot``."""

    kind: ClassVar[str] = "push"
    declared: ClassVar[tuple[Parameter, ...]] = (OVER, BY)

    @property
    def name(self) -> str:
        """``push_`` and the label."""
        return f"{self.kind}_{self.label}"

    def accelerate(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return c (m/s²)."""
        return _value(self, scene, driver, p)
