"""Car-following laws beside IDM: the base of a simulator is one of these, or ``IDM``.

Each is one term with a driver of its own, so that every other effect acts on it as it does on IDM: what adapts a time
gap, a desired speed or a smallest gap changes what these laws read. All parameters are positive.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from idm_env.effects.base import CarFollowing, P
from idm_env.effects.idm import IDM, OfFiveParameters, interaction
from idm_env.effects.references import PUBLICATIONS
from idm_env.parameters import Parameter
from idm_env.types import Driver, Scene

FIVE = IDM.declared


@dataclass(frozen=True)
class IDMPlus(OfFiveParameters):
    """IDM+ (Schakel, van Arem, Netten 2010, IEEE ITSC, 759): the free and the following term do not add up.

    ::

        A = a min(1 − (v/v0)⁴, 1 − (s*/s)²)

    with IDM's s*. Its equilibrium gap is s0 + v T at every speed below v0, where IDM's is longer.
    """

    kind = "idm_plus"
    sources = (PUBLICATIONS["schakel_2010"],)
    adds = False
    title = "IDM+"
    equation = "a min(1 − (v/v0)⁴, 1 − (s*/s)²)"
    declared = FIVE

    def accelerate(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return A (m/s²)."""
        square = (scene.speed / driver.desired_speed) ** 2
        term = interaction(driver, scene.speed, scene.leader.gap, scene.leader.speed) * scene.leader.present
        return driver.max_accel * (1.0 - torch.maximum(square * square, term))


@dataclass(frozen=True)
class IIDM(OfFiveParameters):
    """The Improved IDM (Treiber and Kesting 2013, Traffic Flow Dynamics, section 11.3.7).

    ::

        v ≤ v0:  A = a (1 − z²)  for z ≥ 1,   A = f (1 − z^(2a/f))  below;   f = a (1 − (v/v0)⁴),  z = s*/s
        v > v0:  A = f + a (1 − z²)  for z ≥ 1,   A = f  below;              f = −b (1 − (v0/v)^(4a/b))

    Its equilibrium gap is s0 + v T at every speed below v0, and no driver above v0 brakes harder than b for that alone.
    """

    kind = "iidm"
    sources = (PUBLICATIONS["treiber_2013"],)
    adds = False
    title = "improved IDM"
    equation = "f (1 − z^(2a/f)) for z = s*/s < 1, a (1 − z²) above; f = a (1 − (v/v0)⁴)"
    declared = FIVE

    def accelerate(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return A (m/s²)."""
        a, b, v0 = driver.max_accel, driver.comfort_decel, driver.desired_speed
        ratio = scene.speed / v0
        square = ratio * ratio
        free = a * (1.0 - square * square).clamp_min(0.0)
        term = interaction(driver, scene.speed, scene.leader.gap, scene.leader.speed)
        # Towards v0 the exponent grows without end and the power is 0: a hundred is as good.
        held = term.clamp(1e-9, 1.0) ** (a / free.clamp_min(0.01 * a)) * scene.leader.present
        braking = a * torch.relu(term - 1.0) * scene.leader.present
        too_fast = b * (1.0 - (1.0 / ratio.clamp_min(1.0)) ** (4.0 * a / b))
        return free * (1.0 - held) - too_fast - braking


@dataclass(frozen=True)
class FVDM(CarFollowing):
    """The Full Velocity Difference Model (Jiang, Wu, Zhu 2001, Phys. Rev. E 64, 017101).

    ::

        A = κ (V(s) − v) + λ (v_l − v),   V(s) = v0 [tanh(x − β) + tanh β] / (1 + tanh β),
        x = (1 + tanh β) (s − s0) / (v0 T)

    V is the published V1 + V2 tanh(C1 s − C2) in other letters, with β = ``offset``: v0 = V1 + V2, tanh β = V1/V2,
    C1 = (1 + tanh β)/(v0 T), C2 = C1 s0 + β. So T is the time gap by which the gap grows with speed where it grows
    least, and s0 the gap at standstill. The difference of speeds counts up to ``reach`` (m), as published, and fades to
    nothing at twice that, where the published term ends at once.
    """

    kind = "fvdm"
    sources = (PUBLICATIONS["jiang_2001"],)
    adds = True  # its answer to an empty road is κ v0, more than tyres hold
    title = "full velocity difference model"
    equation = "κ (V(s) − v) + λ (v_lead − v)"
    declared = (
        Parameter("sensitivity", "κ", "1/s", 0.41, 0.02, 3.0, role="shape"),
        Parameter("speed_gain", "λ", "1/s", 0.5, 0.01, 3.0, role="shape"),
        Parameter("time_gap", "T", "s", 1.0, 0.1, 5.0, role="shape"),
        Parameter("min_gap", "s0", "m", 2.3, 0.1, 10.0, role="shape"),
        Parameter("desired_speed", "v0", "m/s", 33.0, 1.0, 70.0, role="shape"),
    )
    offset: float = 1.2683
    reach: float = 100.0

    def driver(self, p: P) -> Driver:
        """Return T, s0 and v0; a and b, which others may read, are the acceleration on an empty road, κ v0."""
        strongest = p["sensitivity"] * p["desired_speed"]
        return Driver(strongest, strongest, p["time_gap"], p["min_gap"], p["desired_speed"])

    def accelerate(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return A (m/s²)."""
        leader, v0 = scene.leader, driver.desired_speed
        level = math.tanh(self.offset)
        x = (leader.gap - driver.min_gap - driver.extra_gap) * (1.0 + level) / (v0 * driver.time_gap)
        slower = (1.0 - torch.tanh(x - self.offset)) * (1.0 / (1.0 + level)) * leader.present
        near = (2.0 - leader.gap * (1.0 / self.reach)).clamp(0.0, 1.0) * leader.present
        target = p["sensitivity"] * (v0 * (1.0 - slower) - scene.speed)
        return target + p["speed_gain"] * (leader.speed - scene.speed) * near


@dataclass(frozen=True)
class Gipps(CarFollowing):
    """Gipps' model (1981, Transp. Res. B 15, 105): as fast as one would, but never too fast to stop behind the leader.

    ::

        A = (min(v_free, v_safe) − v)/τ,   v_free = v + 2.5 a τ (1 − v/v0) √(0.025 + v/v0),
        v_safe = −b τ + √(b² τ² + b (2 (s − s0) − v τ + v_l²/b̂))

    τ is the reaction time and b̂ the braking that the driver expects of his leader. Ballistic steps of Δt = τ are the
    published model to the letter; shorter steps approach its speeds with the time constant τ instead of reacting τ
    late, which the effect ``delay`` would add. The gap in equilibrium is s0 + 1.5 v τ + v² (1/b − 1/b̂)/2.
    """

    kind = "gipps"
    sources = (PUBLICATIONS["gipps_1981"],)
    adds = False
    title = "Gipps' model"
    equation = "(min(v_free, v_safe) − v)/τ"
    declared = (
        Parameter("max_accel", "a", "m/s²", 1.7, 0.1, 10.0, role="shape"),
        Parameter("comfort_decel", "b", "m/s²", 3.4, 0.2, 10.0, role="shape"),
        Parameter("lead_decel", "b̂", "m/s²", 3.2, 0.2, 10.0, role="shape"),
        Parameter("reaction_time", "τ", "s", 2.0 / 3.0, 0.1, 3.0, role="shape"),
        Parameter("min_gap", "s0", "m", 2.0, 0.1, 10.0, role="shape"),
        Parameter("desired_speed", "v0", "m/s", 33.0, 1.0, 70.0, role="shape"),
    )

    def driver(self, p: P) -> Driver:
        """Return a, b, τ as the time gap, s0 and v0."""
        return Driver(p["max_accel"], p["comfort_decel"], p["reaction_time"], p["min_gap"], p["desired_speed"])

    def accelerate(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return A (m/s²)."""
        v, leader = scene.speed, scene.leader
        tau, b = driver.time_gap, driver.comfort_decel
        ratio = v / driver.desired_speed
        gain = 2.5 * driver.max_accel * (1.0 - ratio) * torch.sqrt(0.025 + ratio)
        room = 2.0 * (leader.gap - driver.min_gap - driver.extra_gap) - v * tau
        square = b * b * tau * tau + b * (room + leader.speed * leader.speed / p["lead_decel"])
        # Below 0 no braking by b is enough: the driver brakes with what the rule gives at its end.
        safe = (torch.sqrt(square.clamp_min(1e-4)) - v) / tau - b
        return gain - torch.relu(gain - safe) * leader.present


@dataclass(frozen=True)
class ConstantTimeGap(OfFiveParameters):
    """A linear controller of the time gap, as adaptive cruise control is usually built, with lag and limits.

    ::

        u = min(k_s (s − s0 − v T) + k_v (v_l − v) + c a_l,  k_0 (v0 − v)),   −b ≤ u ≤ a,   τ dA/dt = u − A

    The law without lag and feed-forward c, and the gains k_s = 0.23 1/s², k_v = 0.07 1/s, T = 1.1 s, are those measured
    on production cars by Milanés and Shladover (2014, Transp. Res. C 48, 285); k_0 = ``cruise_gain`` = 0.4 1/s is of
    the set-speed law of Xiao, Wang and van Arem (2017, Transp. Res. Rec. 2623); a and b as in ISO 15622. From the
    leader to the vehicle speeds go by ``(c z² + k_v z + k_s)/(τ z³ + z² + (k_s T + k_v) z + k_s)``, z being Laplace's.
    """

    kind = "constant_time_gap"
    sources = (PUBLICATIONS["milanes_2014"], PUBLICATIONS["xiao_2017"])
    adds = False
    title = "linear constant time gap"
    equation = "min(k_s (s − s0 − v T) + k_v (v_lead − v) + c a_lead, k_0 (v0 − v)), limited and lagged"
    declared = (
        Parameter("gap_gain", "k_s", "1/s²", 0.23, 0.002, 2.0, role="shape"),
        Parameter("speed_gain", "k_v", "1/s", 0.07, 0.005, 3.0, role="shape"),
        Parameter("feed_forward", "c", "1", 0.1, 0.005, 1.0, role="shape"),
        Parameter("lag", "τ", "s", 0.3, 0.01, 3.0, role="shape"),
        Parameter("max_accel", "a", "m/s²", 2.0, 0.1, 10.0, role="shape"),
        Parameter("comfort_decel", "b", "m/s²", 3.5, 0.1, 10.0, role="shape"),
        Parameter("time_gap", "T", "s", 1.1, 0.1, 5.0, role="shape"),
        Parameter("min_gap", "s0", "m", 4.0, 0.1, 15.0, role="shape"),
        Parameter("desired_speed", "v0", "m/s", 33.0, 1.0, 70.0, role="shape"),
    )
    spared = ("feed_forward", "lag")
    cruise_gain: float = 0.4

    def accelerate(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return A (m/s²)."""
        v, leader = scene.speed, scene.leader
        too_far = leader.gap - driver.min_gap - driver.extra_gap - v * driver.time_gap
        follow = p["gap_gain"] * too_far + p["speed_gain"] * (leader.speed - v) + p["feed_forward"] * leader.accel
        cruise = self.cruise_gain * (driver.desired_speed - v)
        target = cruise - torch.relu(cruise - follow) * leader.present
        target = torch.minimum(torch.maximum(target, -driver.comfort_decel), driver.max_accel)
        # The implicit step of the lag, as in the effect ``lag``.
        return target + (scene.accel - target) * (p["lag"] / (p["lag"] + scene.dt))
