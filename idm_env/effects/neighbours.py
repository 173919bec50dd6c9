"""Reactions to vehicles and signals other than the leader's gap and speed (hook ``accelerate``).

Where the neighbour is missing each of these is exactly absent.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from idm_env.effects.base import Effect, P
from idm_env.effects.idm import SMALLEST_GAP, free_accel, interaction
from idm_env.effects.references import PUBLICATIONS
from idm_env.parameters import Parameter
from idm_env.types import Adjacent, Driver, Scene

STANDSTILL_S = 1.0
"""Nobody brakes for whom he lets in so hard that he would stand sooner than in this time (s)."""


@dataclass(frozen=True)
class SecondLeader(Effect):
    """Anticipation over two leaders: ``(1 − w) (s*₁/s₁)² + w (s*₂/(s₂/2))²`` in place of ``(s*₁/s₁)²``.

    Source: Treiber, Kesting, Helbing 2006, Physica A 360, 71; s₂ is the bumper gap to the second leader (m).
    """

    kind = "second_leader"
    sources = (PUBLICATIONS["treiber_2006"],)
    title = "second leader"
    equation = "(1 − w) (s*₁/s₁)² + w (s*₂/(s₂/2))² in place of (s*₁/s₁)²"
    wording = (
        "drivers go by their own leader even more than {law}, against what the vehicle ahead of it does",
        "drivers look past their leader to the vehicle ahead of it, which {law} does not see",
    )
    looks_like = ("brake_light", "leader_acceleration", "delay")
    told_by = (
        "leaders that brake without their own leaders braking, and the reverse, tell a second leader from brake lights"
    )
    beyond = "second leader"
    declared = (Parameter("weight", "w", "1", 0.3, -0.5, 1.0, null=0.0, starts=(0.1,)),)
    needs = frozenset({"second_leader"})

    def accelerate(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return the difference that the second leader makes (m/s²)."""
        second = scene.second_leader
        assert second is not None
        first_term = interaction(driver, scene.speed, scene.leader.gap, scene.leader.speed)
        second_term = interaction(driver, scene.speed, 0.5 * second.gap, second.speed)
        return driver.max_accel * p["weight"] * second.present * (first_term - second_term)


@dataclass(frozen=True)
class LeaderAcceleration(Effect):
    """Feed-forward of the leader's acceleration, ``+ c a_lead``, as in adaptive and cooperative cruise control.

    It is measured or sent, not perceived: a driver's delay does not hold it up. Down a platoon quick changes are
    multiplied by c from vehicle to vehicle, so that beyond c = ±1 they grow without end: it is not string stable.
    """

    kind = "leader_acceleration"
    title = "leader's acceleration"
    equation = "+ c a_lead"
    wording = (
        "drivers answer their leader's acceleration with the opposite sign, as late ones do",
        "drivers follow their leader's acceleration at once, which {law} does not see",
    )
    looks_like = ("delay", "lag", "brake_light", "second_leader")
    told_by = (
        "leaders that accelerate as sharply as they brake tell it from brake lights, sharp steps of speed from a delay"
    )
    sees_truth = True
    declared = (Parameter("gain", "c", "1", 0.4, -0.95, 0.95, null=0.0, starts=(0.1,)),)

    def accelerate(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return c a_lead (m/s²)."""
        return p["gain"] * scene.leader.accel * scene.leader.present


@dataclass(frozen=True)
class BrakeLight(Effect):
    """Reaction to the leader's braking only, ``+ c min(a_lead, 0)``."""

    kind = "brake_light"
    title = "brake lights"
    equation = "+ c min(a_lead, 0)"
    wording = (
        "drivers brake less than {law} while their leader brakes",
        "drivers brake as soon as their leader does, which {law} does not see",
    )
    looks_like = ("leader_acceleration", "asymmetry", "second_leader")
    told_by = "leaders that accelerate as sharply as they brake tell brake lights from the leader's acceleration"
    declared = (Parameter("gain", "c", "1", 0.5, -1.0, 2.0, null=0.0, starts=(0.1,)),)

    def accelerate(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return c min(a_lead, 0) (m/s²)."""
        return -p["gain"] * torch.relu(-scene.leader.accel) * scene.leader.present


@dataclass(frozen=True)
class Follower(Effect):
    """Pressure from behind: ``+ c a min(((s0 + v T)/s_behind)², cap)``; s_behind is the follower's gap (m)."""

    kind = "follower"
    title = "pressure from behind"
    equation = "+ c a min(((s0 + v T)/s_behind)², 4)"
    wording = (
        "drivers slow down when a vehicle is close behind, which {law} does not see",
        "drivers speed up when a vehicle is close behind, which {law} does not see",
    )
    looks_like = ("time_gap", "max_accel")
    told_by = "followers that come and go behind one driver tell their pressure from a shorter time gap"
    beyond = "vehicle behind"
    declared = (Parameter("gain", "c", "1", 0.15, -0.5, 1.0, null=0.0, starts=(0.03,)),)
    needs = frozenset({"behind"})
    cap: float = 4.0

    def accelerate(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return the push (m/s²)."""
        behind = scene.behind
        assert behind is not None
        ratio = (driver.min_gap + scene.speed * driver.time_gap) / behind.gap.clamp_min(0.1)
        pressure = (ratio * ratio).clamp_max(self.cap)
        return p["gain"] * driver.max_accel * pressure * behind.present


@dataclass(frozen=True)
class Courtesy(Effect):
    """Room for a vehicle that signals beside one: it is followed, too, with a weight; none brakes harder than b for it.

    ::

        − w min(b, v / 1 s + z b, a max(0, (s*_m / s_m)² − (s* / s)²))

    s_m (m) is the gap to a vehicle in a lane beside that wished for this one at the last decision and was not granted
    it, taken to drive on at the speed that it had then. With w = 1 a driver follows whichever is nearer, within b;
    after the gap creation of LMRS (Schakel, Knoop, van Arem 2012). With z = 0 a driver slows down for another,
    but does not stand for him. With z = 1 he does, as at a zipper: behind the end of a lane that is closed, of which
    only the first wants in (``turns`` of ``mandatory_change``). Whom to let in plays no part in his own wishes.
    """

    kind = "courtesy"
    sought = "never"
    sources = (PUBLICATIONS["schakel_2012"],)
    adds = True  # a weight below 0 keeps others out
    title = "courtesy"
    equation = "− w min(b, v / 1 s, a max(0, (s*_m/s_m)² − (s*/s)²))"
    wording = (
        "drivers close up to keep out whoever signals beside them",
        "drivers let in whoever signals beside them, which {law} does not see",
    )
    looks_like = ("second_leader", "lateral", "time_gap")
    told_by = "gaps that open beside a vehicle that wants in, while one's own leader keeps his speed"
    beyond = "vehicle in an adjacent lane"
    declared = (
        Parameter("weight", "w", "1", 0.5, -0.5, 1.0, null=0.0, starts=(0.1,)),
        Parameter("zipper", "z", "1", 0.0, 0.0, 1.0, null=0.0, role="shape"),
    )
    needs = frozenset({"merger"})

    def accelerate(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return the braking for the vehicle that signals (m/s²)."""
        other = scene.merger
        assert other is not None
        own = interaction(driver, scene.speed, scene.leader.gap, scene.leader.speed) * scene.leader.present
        more = torch.relu(interaction(driver, scene.speed, other.gap, other.speed) - own)
        most = torch.minimum(driver.comfort_decel, scene.speed / STANDSTILL_S + p["zipper"] * driver.comfort_decel)
        return -p["weight"] * other.present * torch.minimum(most, driver.max_accel * more)


def constant_acceleration(scene: Scene, driver: Driver) -> Tensor:
    """Return the acceleration that just avoids a crash if the leader keeps his own (m/s²), ``[..., n]``.

    ::

        ã = min(a_l, a);   v² ã / (v_l² − 2 s ã)   where he stops first, ã < 0 and v_l (v − v_l) ≤ −2 s ã,
        else ã − max(0, v − v_l)² / 2s
    """
    speed, lead, gap = scene.speed, scene.leader.speed, scene.leader.gap.clamp_min(SMALLEST_GAP)
    accel = torch.minimum(scene.leader.accel, driver.max_accel)
    stops = (accel < 0) & (lead * (speed - lead) <= -2.0 * gap * accel)
    to_stop = speed * speed * accel / (lead * lead - 2.0 * gap * accel).clamp_min(1e-3)
    return torch.where(stops, to_stop, accel - torch.relu(speed - lead).square() / (2.0 * gap))


@dataclass(frozen=True)
class Calm(Effect):
    """Less braking behind a vehicle that cuts in: no more of IDM's than a leader of constant acceleration requires.

    ::

        + c max(0, a_CAH + b tanh((a_IDM − a_CAH) / b) − a_IDM),   a_CAH as ``constant_acceleration``

    IDM brakes for a gap that is suddenly too close as in an emergency, also behind a leader who drives away. With c
    near 1 drivers let the gap grow slowly again. The ACC model of Kesting, Treiber and Helbing (2010), c = 0.99.
    """

    kind = "calm"
    sought = "never"
    sources = (PUBLICATIONS["kesting_2010"],)
    adds = True
    title = "calm behind who cuts in"
    equation = "+ c max(0, a_CAH + b tanh((a_IDM − a_CAH)/b) − a_IDM)"
    declared = (Parameter("coolness", "c", "1", 0.99, 0.0, 1.0, null=0.0),)

    def accelerate(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return by how much less drivers brake (m/s²)."""
        brake = interaction(driver, scene.speed, scene.leader.gap, scene.leader.speed)
        idm = free_accel(driver, scene.speed) - driver.max_accel * brake
        calm, b = constant_acceleration(scene, driver), driver.comfort_decel
        calm = calm + b * torch.tanh((idm - calm) / b)
        return p["coolness"] * scene.leader.present * torch.relu(calm - idm)


@dataclass(frozen=True)
class Lateral(Effect):
    """Friction with the adjacent lane: ``− c max(v − v_adjacent, 0) exp(−|dx| / reach)``.

    Input ``lateral``: an ``Adjacent(distance, speed, present)`` for every vehicle. ``reach`` in metres.
    """

    kind = "lateral"
    takes = Adjacent
    title = "friction with the adjacent lane"
    equation = "− c max(v − v_adjacent, 0) exp(−|dx| / 25 m)"
    wording = (
        "drivers speed up beside a slower lane, which {law} does not see",
        "drivers slow down beside a slower lane, which {law} does not see",
    )
    looks_like = ("desired_speed", "drag")
    told_by = "free driving beside empty and beside slow lanes tells friction from a lower desired speed"
    beyond = "vehicle in an adjacent lane"
    declared = (Parameter("gain", "c", "1/s", 0.1, -0.5, 1.0, null=0.0, starts=(0.03,)),)
    reach: float = 25.0

    def accelerate(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return the friction (m/s²)."""
        adjacent: Adjacent = scene.input(self.name)
        nearness = torch.exp(-adjacent.distance.abs() / self.reach) * adjacent.present
        return -p["gain"] * torch.relu(scene.speed - adjacent.speed) * nearness
