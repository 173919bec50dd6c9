"""Limits of the vehicle: asymmetry, action points, power, lag, brakes and tyres (hook ``limit``, chained by rank)."""

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

from idm_env.effects.base import Effect, P
from idm_env.effects.idm import soft_floor
from idm_env.effects.references import PUBLICATIONS
from idm_env.parameters import Parameter
from idm_env.types import Driver, Scene


@dataclass(frozen=True)
class Asymmetry(Effect):
    """Weaker acceleration than braking: ``a > 0: (1 − k) a``, ``a < 0: (1 + k) a`` (Newell; Laval and Leclercq)."""

    kind = "asymmetry"
    sources = (PUBLICATIONS["newell_1965"], PUBLICATIONS["laval_2010"])
    title = "asymmetry"
    equation = "a > 0: (1 − k) a, a < 0: (1 + k) a"
    wording = (
        "drivers accelerate harder and brake softer than {law}",
        "drivers accelerate softer and brake harder than {law}",
    )
    looks_like = ("brake_light", "max_accel and comfort_decel together")
    told_by = (
        "accelerating and braking on a free road, where no leader sets the pace, tells asymmetry from brake lights"
    )
    rank = 10
    declared = (Parameter("strength", "k", "1", 0.3, -0.9, 0.9, null=0.0, starts=(0.05,)),)

    def limit(self, accel: Tensor, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return ``a − k |a|``."""
        return accel - p["strength"] * accel.abs()


@dataclass(frozen=True)
class ActionPoint(Effect):
    """Acceleration is held until it differs from the wanted one by Δa (Treiber and Kesting 2018, Transp. Res. B 117).

    Δa has no gradient: search from the ``starts``.
    """

    kind = "action_point"
    sources = (PUBLICATIONS["treiber_2018"],)
    adds = False
    title = "action points"
    equation = "a is held until the wanted one differs by Δa"
    wording = (
        "",
        "drivers hold an acceleration until a clearly different one is wanted, where {law} adjusts all the time",
    )
    looks_like = ("lag", "leader_acceleration")
    told_by = (
        "accelerations measured at 10 Hz or more (steps, and stretches without change) tell action points from lag"
    )
    acts_on = "response"
    wind_up_s = 2.0
    rank = 30
    declared = (Parameter("threshold", "Δa", "m/s²", 0.3, 0.0, 2.0, null=0.0, role="threshold", starts=(0.15, 0.4)),)

    def limit(self, accel: Tensor, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return the held acceleration, or the wanted one where it differs enough."""
        return torch.where((accel - scene.accel).abs() >= p["threshold"], accel, scene.accel)


@dataclass(frozen=True)
class PowerLimit(Effect):
    """``a ≤ (P/m) / v`` with specific power P/m (W/kg); absent at its null, a power that no car has."""

    kind = "power_limit"
    adds = False
    title = "power limit"
    equation = "a ≤ (P/m) / v"
    wording = ("vehicles accelerate less at high speed than {law}, as an engine's power allows", "")
    looks_like = ("drag", "desired_speed")
    told_by = "free starts from standstill to above 25 m/s tell power from drag and v0"
    rank = 40
    sees_truth = True
    declared = (
        Parameter(
            "power", "P/m", "W/kg", 15.0, 2.0, 100.0, 1e5, role="threshold", starts=(10.0, 18.0), searched=(2.0, 60.0)
        ),
    )

    def limit(self, accel: Tensor, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return the smaller of the wanted acceleration and the engine's (m/s²)."""
        return torch.minimum(accel, p["power"] / scene.speed.clamp_min(0.1))


@dataclass(frozen=True)
class Lag(Effect):
    """Powertrain lag ``τ dA/dt = a − A``, implicit: ``A' = (τ A + Δt a)/(τ + Δt)``, with a derivative at τ = 0.

    A is the acceleration of the step before.
    """

    kind = "lag"
    adds = False
    title = "response lag"
    equation = "τ dA/dt = a − A"
    wording = ("", "vehicles take longer than {law} to reach the acceleration that is wanted")
    looks_like = ("delay", "leader_acceleration with the other sign", "action_point")
    told_by = "sharp braking of leaders (jerk above 3 m/s³) at 10 Hz or more tells lag from delay"
    latency = True
    acts_on = "response"
    wind_up_s = 2.0
    rank = 50
    sees_truth = True
    declared = (Parameter("lag", "τ", "s", 0.5, 0.0, 3.0, null=0.0, starts=(0.3, 0.8), searched=(0.0, 2.0)),)

    def limit(self, accel: Tensor, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return the lagged acceleration."""
        # The same fraction, written so that τ = 0 returns `accel` to the last bit.
        return accel + (scene.accel - accel) * (p["lag"] / (p["lag"] + scene.dt))


@dataclass(frozen=True)
class Brakes(Effect):
    """No harder braking than b_max, and never a reverse: ``a* = lb + f(a − lb)``.

    ``f(x) = 0`` for x ≤ 0, ``x² (2w − x)/w²`` up to w, then ``x``: exact beyond w = ``width`` (m/s²), C¹, and never
    above x, so that nobody creeps. Below the floor its gradient is zero. With Euler steps the floor is
    ``lb = max(−v/Δt, −b_max)``; a ballistic step stops the car inside the step, so lb = −b_max.

    ``sharpness`` (s²/m) instead gives the published floor ``lb + softplus(sharpness (a − lb))/sharpness``, 1 being the
    paper's; it lifts every acceleration and lets a vehicle creep towards a parked leader.
    """

    kind = "brakes"
    adds = False
    rank = 60
    sees_truth = True
    declared = (Parameter("max_decel", "b_max", "m/s²", 9.0, 1.0, 15.0, role="shape"),)
    width: float = 0.1
    sharpness: float | None = None

    def limit(self, accel: Tensor, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return the acceleration that the brakes allow."""
        floor = -p["max_decel"]
        if scene.euler:
            floor = torch.maximum(-scene.speed / scene.dt, floor)
        if self.sharpness is not None:
            return soft_floor(accel, floor, self.sharpness)
        above = torch.relu(accel - floor)
        part = above.clamp_max(self.width)
        return floor + part * part * (2.0 * self.width - part) * (1.0 / self.width**2) + (above - part)


@dataclass(frozen=True)
class Traction(Effect):
    """Tyres hold no more than ``a ≤ μ g``, whatever was added: the last word on every acceleration.

    The default is a friction coefficient of about 1, dry asphalt (Rajamani 2012, Vehicle Dynamics and Control, ch. 13).
    A simulator with an effect that can add to what the driver wants has this one without being told; it is named to
    give another maximum, or its null to be rid of it. Below the maximum it changes no bit; above, its gradient is zero.
    """

    kind = "traction"
    sources = (PUBLICATIONS["rajamani_2012"],)
    rank = 90
    sees_truth = True
    adds = False
    declared = (Parameter("max_accel", "μ g", "m/s²", 10.0, 1.0, 15.0, null=1e5, role="threshold"),)

    def limit(self, accel: Tensor, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return the acceleration that the tyres allow."""
        return accel.clamp_max(p["max_accel"])  # type: ignore[arg-type]


def unspoken(effects: Iterable[Effect]) -> tuple[Effect, ...]:
    """Return the physics that these effects need and do not name: tyres, where something adds accelerations."""
    effects = tuple(effects)
    named = any(isinstance(effect, Traction) for effect in effects)
    return (Traction(),) if not named and any(effect.adds for effect in effects) else ()
