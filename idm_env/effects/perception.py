"""Perceptions of the driver: delayed, blurred, biased or imagined scenes (hook ``perceive``)."""

from dataclasses import dataclass

import torch

from idm_env.effects.base import Effect, P
from idm_env.effects.references import PUBLICATIONS
from idm_env.parameters import Parameter
from idm_env.types import Imagined, Neighbour, Scene


@dataclass(frozen=True)
class Delay(Effect):
    """Reaction delay: the driver reacts to the scene of τ seconds ago (Treiber, Kesting, Helbing 2006, Physica A 360).

    Every input of the driver, his own speed included, is taken at t − τ, by linear interpolation between steps, before
    anything else of perception acts. ``max_delay`` (s) is how far the past is kept and the upper bound of τ: by default
    what a platoon of default drivers (T = 1.5 s) can bear; at 1.1 s they collide without any reason ahead.
    """

    kind = "delay"
    sources = (PUBLICATIONS["treiber_2006"],)
    rank = -10
    title = "reaction delay"
    equation = "all that is seen is taken at t − τ"
    wording = ("", "drivers react later than {law}")
    looks_like = ("lag", "leader_acceleration with the other sign")
    told_by = "sharp braking of leaders (jerk above 3 m/s³) at 10 Hz or more tells delay from lag"
    cancels = ("leader_acceleration", "second_leader")
    latency = True
    acts_on = "response"
    max_delay: float = 1.0

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """τ, between 0 and ``max_delay``."""
        longest = self.max_delay
        return (Parameter("delay", "τ", "s", min(0.5, longest), 0.0, longest, null=0.0, starts=(0.3, 0.8)),)

    @property
    def looks_back(self) -> float:
        """``max_delay`` (s)."""
        return self.max_delay

    def perceive(self, scene: Scene, p: P) -> Scene:
        """Return the scene of τ seconds ago."""
        return scene.past(p["delay"])


@dataclass(frozen=True)
class DeadZone(Effect):
    """Threshold of looming: a closing speed is seen as 0 while ``1.8 |Δv| / s² < θ`` (Wiedemann 1974).

    The step is written ``1 / (1 + (θ/x)^n)`` with x the looming rate and n = ``sharpness``, exactly 1 at θ = 0 and
    differentiable in θ where θ > 0. At θ = 0 the derivative vanishes: search from the ``starts``.
    """

    kind = "dead_zone"
    sources = (PUBLICATIONS["wiedemann_1974"],)
    title = "threshold of looming"
    equation = "Δv is seen as 0 while 1.8 |Δv| / s² < θ"
    wording = ("", "drivers do not notice the small closing speeds that {law} reacts to")
    looks_like = ("comfort_decel", "action_point")
    told_by = "slow approaches at long gaps tell a threshold from softer braking"
    acts_on = "closing_speed"
    declared = (
        Parameter("threshold", "θ", "rad/s", 0.002, 0.0, 0.02, null=0.0, role="threshold", starts=(0.001, 0.004)),
    )
    sharpness: int = 8

    def perceive(self, scene: Scene, p: P) -> Scene:
        """Return the scene with small looming removed."""
        closing = scene.speed - scene.leader.speed
        gap = scene.leader.gap.clamp_min(0.1)
        looming = (1.8 * closing.abs() / (gap * gap)).clamp_min(1e-7)
        seen = 1.0 / (1.0 + (p["threshold"] / looming) ** self.sharpness)
        return scene._replace(leader=scene.leader._replace(speed=scene.leader.speed + (1.0 - seen) * closing))


@dataclass(frozen=True)
class ClosingGain(Effect):
    """A closing speed that counts k times: Δv → k Δv, wherever there is a leader.

    In IDM k² b̃ takes the place of b (b̃ = b/k²), so that within the bounds of b it is b by another name, and no
    candidate; on laws whose answer to the closing speed is no parameter, and beyond the bounds of b, it is a gain of
    its own, as k2 is in linear controllers of production cars (Milanés and Shladover 2014, Transp. Res. C 48, 285).
    """

    kind = "closing_gain"
    sought = "never"
    sources = (PUBLICATIONS["milanes_2014"],)
    title = "gain on the closing speed"
    equation = "Δv is seen as k Δv"
    wording = ("drivers answer to closing speeds less than {law}", "drivers answer to closing speeds more than {law}")
    looks_like = ("comfort_decel",)
    told_by = "nothing within the bounds of b tells it from the comfortable deceleration"
    acts_on = "closing_speed"
    per_driver = True
    declared = (Parameter("gain", "k", "1", 0.5, 0.05, 20.0, null=1.0, starts=(0.7, 1.4)),)

    def perceive(self, scene: Scene, p: P) -> Scene:
        """Return the scene with the leader's speed shifted so that the closing speed counts k times."""
        leader = scene.leader
        closing = (scene.speed - leader.speed) * leader.present
        return scene._replace(leader=leader._replace(speed=leader.speed + (1.0 - p["gain"]) * closing))


@dataclass(frozen=True)
class GapBias(Effect):
    """A gap seen (or measured) as gap + d metres, wherever there is a leader."""

    kind = "gap_bias"
    title = "bias of the gap"
    equation = "gap seen = gap + d"
    wording = (
        "drivers act as if the gap were shorter than it is measured",
        "drivers act as if the gap were longer than it is measured",
    )
    looks_like = ("min_gap",)
    told_by = (
        "gaps measured a second way, or standstill behind a leader with known bumpers, tell a bias from the minimum gap"
    )
    acts_on = "gap"
    declared = (Parameter("bias", "d", "m", 1.0, -5.0, 5.0, null=0.0, starts=(0.2,)),)

    def perceive(self, scene: Scene, p: P) -> Scene:
        """Return the scene with the biased gap."""
        biased = scene.leader.gap + p["bias"] * scene.leader.present
        return scene._replace(leader=scene.leader._replace(gap=biased))


@dataclass(frozen=True)
class ImaginedLeader(Effect):
    """A free gap Δp and closing speed Δv per step in place of the leader's (Son et al. 2024, the paper's filtering).

    Input ``imagined``: an ``Imagined(gap, closing_speed)``. There is always a leader then, be it imagined.
    """

    kind = "imagined"
    takes = Imagined

    def perceive(self, scene: Scene, p: P) -> Scene:
        """Return the scene with the imagined leader."""
        imagined: Imagined = scene.input(self.name)
        speed = scene.speed - imagined.closing_speed
        return scene._replace(
            leader=Neighbour(imagined.gap, speed, torch.zeros_like(speed), torch.ones_like(scene.leader.present))
        )
