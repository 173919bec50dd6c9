"""The Intelligent Driver Model, with its bounds kept exactly, and in the published smooth form.

Shapes: everything is elementwise over vehicles, ``[..., n]``, in SI units.
"""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import softplus

from idm_env.effects.base import CarFollowing, P
from idm_env.effects.references import PUBLICATIONS
from idm_env.parameters import Parameter
from idm_env.types import FAR, Driver, Scene

SMALLEST_GAP = 0.1
"""Below this gap (m) the inverse square is continued by its tangent, so overlaps push back, finitely."""


def desired_gap(driver: Driver, speed: Tensor, closing_speed: Tensor) -> Tensor:
    """``s* = s0 + max(0, v T + v Δv / (2 √(a b))) + extra_gap`` (m): the interaction is floored, not all of s*."""
    brake = 2.0 * torch.sqrt(driver.max_accel * driver.comfort_decel)
    dynamic = speed * (driver.time_gap + closing_speed / brake)
    return driver.min_gap + torch.relu(dynamic) + driver.extra_gap


def inverse_square(gap: Tensor) -> Tensor:
    """``1 / s²`` for s ≥ SMALLEST_GAP, its tangent below: finite, C¹, and rising through 0 and into overlaps."""
    safe = gap.clamp_min(SMALLEST_GAP)
    below = torch.relu(SMALLEST_GAP - gap)
    return 1.0 / (safe * safe) + below * (2.0 / SMALLEST_GAP**3)


def interaction(driver: Driver, speed: Tensor, gap: Tensor, lead_speed: Tensor) -> Tensor:
    """``(s* / s)²`` (dimensionless), the interaction term of IDM."""
    desired = desired_gap(driver, speed, speed - lead_speed)
    return desired * desired * inverse_square(gap)


def soft_floor(x: Tensor, floor: Tensor | float, sharpness: float) -> Tensor:
    """``floor + softplus(sharpness (x − floor)) / sharpness``; with sharpness 1 the paper's soft_min_clamp."""
    return floor + softplus(sharpness * (x - floor), threshold=20.0) / sharpness


def free_accel(driver: Driver, speed: Tensor) -> Tensor:
    """Return the acceleration of IDM drivers without a leader: ``a [1 − (v/v0)⁴]`` (m/s²)."""
    square = (speed / driver.desired_speed).square()
    return driver.max_accel * (1.0 - square * square)


def gap_for(accel: Tensor, speed: Tensor, closing_speed: Tensor, driver: Driver) -> Tensor:
    """Return the gap (m) at which IDM accelerates so: ``s = s* / √(1 − (v/v0)⁴ − A/a)``, at most FAR.

    Where IDM accelerates so at no gap, because what is under the root is not positive, that is 10⁶ s*, and at most FAR.
    """
    desired = desired_gap(driver, speed, closing_speed)
    square = (speed / driver.desired_speed).square()
    left = 1.0 - square * square - accel / driver.max_accel
    return (desired / torch.sqrt(left.clamp_min(1e-12))).clamp_max(FAR)


def equilibrium_gap(driver: Driver, speed: Tensor) -> Tensor:
    """Return the gap at which IDM drivers keep a speed (m): ``(s0 + v T)/√(1 − (v/v0)⁴)``, v at most 0.95 v0."""
    ratio = (speed / driver.desired_speed).clamp(0.0, 0.95)
    return (driver.min_gap + speed * driver.time_gap) / torch.sqrt(1.0 - ratio**4)


class OfFiveParameters(CarFollowing):
    """A car-following law whose parameters hold the five of a driver by their names."""

    def driver(self, p: P) -> Driver:
        """Return the five parameters as they stand."""
        return Driver(p["max_accel"], p["comfort_decel"], p["time_gap"], p["min_gap"], p["desired_speed"])


@dataclass(frozen=True)
class IDM(OfFiveParameters):
    """Intelligent Driver Model (Treiber, Hennecke, Helbing 2000, Phys. Rev. E 62, 1805).

    ::

        A = a [1 − (v/v0)^δ − (s*/s)²],   s* = s0 + max(0, v T + v Δv / (2 √(a b)))

    The term never exceeds a. Static choices: ``exponent`` δ (None makes it a parameter; a power by ``pow`` costs far
    more than the default's two multiplications), and ``sharpness``: None is the exact form above; a number gives the
    published smooth form, in which all of s* is floored by softplus of that sharpness and 1/s² is taken as it stands
    (so gap 0 is a division by zero there and an overlap looks like a gap: use it to reproduce, not to drive).
    """

    kind = "idm"
    sources = (PUBLICATIONS["treiber_2000"],)
    adds = False
    title = "IDM"
    equation = "a [1 − (v/v0)⁴ − (s*/s)²]"
    declared = (
        Parameter("max_accel", "a", "m/s²", 1.4, 0.1, 10.0, role="shape"),
        Parameter("comfort_decel", "b", "m/s²", 2.0, 0.1, 10.0, role="shape"),
        Parameter("time_gap", "T", "s", 1.5, 0.1, 5.0, role="shape"),
        Parameter("min_gap", "s0", "m", 2.0, 0.1, 10.0, role="shape"),
        Parameter("desired_speed", "v0", "m/s", 33.0, 1.0, 70.0, role="shape"),
    )
    exponent: float | None = 4.0
    sharpness: float | None = None

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The five of the literature, and δ where it is free."""
        free = (Parameter("exponent", "δ", "1", 4.0, 1.0, 12.0, role="shape"),)
        return self.declared + (free if self.exponent is None else ())

    def accelerate(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return A (m/s²)."""
        ratio = scene.speed / driver.desired_speed
        if self.exponent == 4.0:
            square = ratio * ratio
            free = square * square
        else:
            free = ratio ** (p["exponent"] if self.exponent is None else self.exponent)
        if self.sharpness is None:
            term = interaction(driver, scene.speed, scene.leader.gap, scene.leader.speed)
        else:
            brake = 2.0 * torch.sqrt(driver.max_accel * driver.comfort_decel)
            closing = scene.speed - scene.leader.speed
            desired = driver.min_gap + scene.speed * driver.time_gap + scene.speed * closing / brake + driver.extra_gap
            term = (soft_floor(desired, 0.0, self.sharpness) / scene.leader.gap) ** 2
        return driver.max_accel * (1.0 - free - term * scene.leader.present)
