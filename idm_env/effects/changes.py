"""Wishes for another lane (hook ``change``): MOBIL, lanes that end, and an agent's command."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from idm_env.effects import references
from idm_env.effects.base import Effect, P
from idm_env.parameters import Parameter
from idm_env.types import Beside, Driver, Scene, Wish

COMMANDED = 1e12
"""Utility of an agent's command (m/s²): more than any driver's, who may think of a place inside another vehicle."""

_BLOCK = 256
"""The fewest slots that decide together."""

_SAFE_DECEL = Parameter("safe_decel", "b_safe", "m/s²", 4.0, 0.5, 9.0, role="threshold")


def margin(side: Beside, here: Beside, safe_decel: Tensor) -> Tensor:
    """Return by how much (m/s²) a change is safe: for the follower there, and for oneself.

    The follower need not brake harder than b_safe; nor need the driver, unless he must do so in his own lane, too.
    """
    follower = torch.where(side.follower.present > 0, side.with_me + safe_decel, safe_decel)
    return torch.minimum(follower, side.wanted - torch.minimum(here.wanted, -safe_decel))


def _lanes(scene: Scene) -> tuple[Beside, Beside, Beside]:
    assert scene.here is not None and scene.left is not None and scene.right is not None
    return scene.here, scene.left, scene.right


@dataclass(frozen=True)
class Mobil(Effect):
    """MOBIL, minimising overall braking induced by lane changes (Kesting, Treiber, Helbing 2007, TRR 1999, 86).

    ::

        utility = ã_c − a_c + p (ã_n − a_n + ã_o − a_o) − Δa_th ± a_bias,    safe where ã_n ≥ −b_safe

    c is the driver, n his follower on the other lane and o the one on his own; a tilde is after the change. ``a_bias``
    is added to the right and taken from the left. Drivers decide every ``every`` seconds: all at once, or, with
    ``stagger``, that many slots at once (at least 256), blocks taking turns a step apart. ValueError for fewer.
    """

    kind: ClassVar[str] = "mobil"
    sources: ClassVar[tuple[str, ...]] = (references.KESTING_2007,)
    declared: ClassVar[tuple[Parameter, ...]] = (
        Parameter("politeness", "p", "1", 0.2, -1.0, 2.0, role="shape"),
        Parameter("threshold", "Δa_th", "m/s²", 0.1, 0.0, 5.0, role="threshold"),
        _SAFE_DECEL,
        Parameter("keep_right", "a_bias", "m/s²", 0.0, -2.0, 2.0, role="shape"),
    )
    every: float = 1.0
    stagger: int = 0

    def __post_init__(self) -> None:
        if not 0.0 < self.every < math.inf:
            raise ValueError(f"mobil: every = {self.every:g} s must be a number above 0.")
        if self.stagger != 0 and self.stagger < _BLOCK:
            raise ValueError(
                f"mobil: stagger = {self.stagger} slots must be 0 (all at once) or at least {_BLOCK}: smaller blocks "
                "touch all of memory at every step."
            )

    @property
    def decides_every(self) -> float:
        """As ``every`` says."""
        return self.every

    @property
    def decides_in_blocks(self) -> int:
        """As ``stagger`` says."""
        return self.stagger

    def change(self, scene: Scene, driver: Driver, p: P) -> Wish:
        """Return the advantage less the threshold, and the follower's margin."""
        here, left, right = _lanes(scene)

        def gain(side: Beside) -> Tensor:
            others = (side.with_me - side.without_me) + (here.without_me - here.with_me)
            change = side.wanted - here.wanted + p["politeness"] * others
            return torch.where(side.exists > 0, change, 0.0) - p["threshold"]

        return Wish(
            gain(left) - p["keep_right"] * left.exists,
            gain(right) + p["keep_right"] * right.exists,
            margin(left, here, p["safe_decel"]),
            margin(right, here, p["safe_decel"]),
        )


@dataclass(frozen=True)
class MandatoryChange(Effect):
    """Away from lanes that end: ``+ A (u_here − u_there)``, urgency ``u = max(0, 1 − d/D)`` at d before an end.

    Strength A (m/s²), reach D (m). What a driver must do is a bias in MOBIL (Kesting, Treiber, Helbing 2007); here it
    grows towards the end.
    """

    kind: ClassVar[str] = "mandatory_change"
    sources: ClassVar[tuple[str, ...]] = (references.KESTING_2007,)
    declared: ClassVar[tuple[Parameter, ...]] = (
        Parameter("strength", "A", "m/s²", 4.0, 0.0, 100.0, role="shape"),
        Parameter("reach", "D", "m", 300.0, 1.0, 5000.0, role="shape"),
        _SAFE_DECEL,
    )

    def change(self, scene: Scene, driver: Driver, p: P) -> Wish:
        """Return how much more urgent it is here than there."""
        here, left, right = _lanes(scene)

        def urgency(lane: Beside) -> Tensor:
            return p["strength"] * torch.relu(1.0 - lane.ends / p["reach"])

        return Wish(
            (urgency(here) - urgency(left)) * left.exists,
            (urgency(here) - urgency(right)) * right.exists,
            margin(left, here, p["safe_decel"]),
            margin(right, here, p["safe_decel"]),
        )


@dataclass(frozen=True)
class LaneCommand(Effect):
    """An agent's wish in place of the driver's: 1 to the left, −1 to the right, 0 to stay; NaN leaves it to the driver.

    Input ``lane_command``: that number for every vehicle. A command counts at the next decision. What is unsafe, or off
    the road, is not done but counted (``links.blocked``), and so is what another claim wins (``links.refused``).
    """

    kind: ClassVar[str] = "lane_command"
    takes: ClassVar[type | None] = Tensor
    declared: ClassVar[tuple[Parameter, ...]] = (_SAFE_DECEL,)

    def change(self, scene: Scene, driver: Driver, p: P) -> Wish:
        """Return a utility that outweighs every driver's."""
        here, left, right = _lanes(scene)
        command: Tensor = scene.input(self.name)
        given = command.isfinite()
        side = torch.where(given, command, 0.0)

        def utility(wanted: Tensor) -> Tensor:
            return torch.where(given, torch.where(wanted > 0, COMMANDED, -COMMANDED), 0.0) + 0.0 * scene.speed

        return Wish(
            utility(side),
            utility(-side),
            margin(left, here, p["safe_decel"]),
            margin(right, here, p["safe_decel"]),
        )
