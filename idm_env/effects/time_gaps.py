"""How a driver's desired gap varies: with speed, what the leader does and did, habit, the gap (hook ``adapt``)."""

from dataclasses import dataclass

import torch
from torch import Tensor

from idm_env.effects.base import Effect, P
from idm_env.effects.idm import SMALLEST_GAP, equilibrium_gap
from idm_env.effects.references import PUBLICATIONS
from idm_env.parameters import Parameter
from idm_env.types import Driver, Scene


@dataclass(frozen=True)
class SpeedTimeGap(Effect):
    """A time gap linear in speed: ``T → T max(1 + k (v/v_r − 1), 0.1)``, T being the time gap at v_r = ``reference``.

    Range policies that are quadratic in speed, s = A + T v + G v², are of this kind (Zhou and Peng 2005, IEEE Trans.
    Intell. Transp. Syst. 6, 229). ``reference`` in m/s.
    """

    kind = "speed_time_gap"
    sources = (PUBLICATIONS["zhou_2005"],)
    rank = 2
    title = "speed-dependent time gap"
    equation = "T → T (1 + k (v / (20 m/s) − 1))"
    wording = (
        "drivers keep shorter time gaps the faster they go, where {law} keeps one",
        "drivers keep longer time gaps the faster they go, where {law} keeps one",
    )
    looks_like = ("speed_dependent_gap", "drag", "min_gap and time_gap together")
    told_by = "following at 5 to 35 m/s by one driver tells a line over speed from a root and from drag"
    acts_on = "time_gap"
    declared = (Parameter("slope", "k", "1", -0.3, -0.95, 2.0, null=0.0, starts=(0.1,)),)
    reference: float = 20.0

    def adapt(self, driver: Driver, scene: Scene, p: P) -> Driver:
        """Return the driver with the time gap of this speed."""
        factor = 1.0 + p["slope"] * (scene.speed * (1.0 / self.reference) - 1.0)
        return driver._replace(time_gap=driver.time_gap * factor.clamp_min(0.1))


@dataclass(frozen=True)
class SetPointAsymmetry(Effect):
    """Another time gap behind an accelerating leader than behind a braking one: ``T → T (1 + k a_l/√(a_l² + w²))``.

    The fraction is a smooth sign of the leader's acceleration a_l, with w = ``width`` (m/s²). Trajectories of drivers
    and controllers run in loops through the plane of speed and gap: two branches, one for accelerating and one for
    braking traffic (Newell 1965 for traffic; Yeo and Skabardonis 2009 in measured platoons).
    """

    kind = "set_point_asymmetry"
    sources = (PUBLICATIONS["newell_1965"], PUBLICATIONS["yeo_2009"])
    rank = 2
    title = "asymmetric time gap"
    equation = "T → T (1 + k a_lead / √(a_lead² + 0.09 m²/s⁴))"
    wording = (
        "drivers keep shorter time gaps behind accelerating leaders than behind braking ones, where {law} keeps one",
        "drivers keep longer time gaps behind accelerating leaders than behind braking ones, where {law} keeps one",
    )
    looks_like = ("leader_acceleration", "asymmetry", "brake_light")
    told_by = (
        "leaders that accelerate or brake gently for 10 s and longer tell a time gap, which saturates and lasts, from "
        "answers to the acceleration"
    )
    acts_on = "time_gap"
    declared = (Parameter("strength", "k", "1", 0.15, -0.8, 0.8, null=0.0, starts=(0.05,)),)
    width: float = 0.3

    def adapt(self, driver: Driver, scene: Scene, p: P) -> Driver:
        """Return the driver with the time gap of this branch."""
        accel = scene.leader.accel
        sign = accel / torch.sqrt(accel * accel + self.width**2) * scene.leader.present
        return driver._replace(time_gap=driver.time_gap * (1.0 + p["strength"] * sign))


@dataclass(frozen=True)
class Relaxation(Effect):
    """Drivers accept the gap that they have had in the last seconds, and only slowly return to their own.

    ::

        T → T (1 + β (m − 1)),   τ dm/dt = q − m,   q = s √(1 − (v/v0)⁴) / (s0 + v T)

    m is the memory of q, the gap relative to the one that an IDM driver keeps in equilibrium, between 0.2 and 2 and 1
    where nobody is ahead; it starts at q. Whoever has another gap than he wants, after a cut-in or because he is that
    kind of day, so starts from the time gap of that gap and returns with the time constant τ / (1 − β): the relaxation
    that Laval and Leclercq (2008, Transp. Res. B 42, 511) put after lane changes, here for whatever brought it about.
    """

    kind = "relaxation"
    sources = (PUBLICATIONS["laval_2008"],)
    rank = 2
    title = "relaxation of the time gap"
    equation = "T → T (1 + β (m − 1)), τ dm/dt = s √(1 − (v/v0)⁴) / (s0 + v T) − m"
    wording = (
        "",
        "drivers accept the time gap that they have had for a while and return to their own slowly, where {law} goes "
        "back to it at once",
    )
    looks_like = ("memory", "regime_shift", "max_accel")
    told_by = "gaps that a cut-in or a hard brake left far from the usual one, followed for a minute"
    acts_on = "time_gap"
    declared = (
        Parameter("strength", "β", "1", 0.5, 0.0, 0.95, null=0.0, starts=(0.3,)),
        Parameter("memory_time", "τ", "s", 15.0, 2.0, 200.0, role="shape", starts=(8.0, 30.0)),
    )

    def _relative_gap(self, scene: Scene, driver: Driver, time_gap: Tensor) -> Tensor:
        """Return q: the gap relative to that of an equilibrium with ``time_gap``."""
        ratio = scene.speed / driver.desired_speed
        square = ratio * ratio
        free = torch.sqrt((1.0 - square * square).clamp_min(0.1))
        desired = driver.min_gap + scene.speed * time_gap + driver.extra_gap
        ratio = (scene.leader.gap * free / desired.clamp_min(0.1)).clamp(0.2, 2.0)
        return 1.0 + (ratio - 1.0) * scene.leader.present

    def initial_memory(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return m = q."""
        return self._relative_gap(scene, driver, driver.time_gap)

    def adapt(self, driver: Driver, scene: Scene, p: P) -> Driver:
        """Return the driver with the time gap in force."""
        return driver._replace(time_gap=driver.time_gap * (1.0 + p["strength"] * (scene.memory[self.name] - 1.0)))

    def remember(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Relax m towards q, counted from the time gap that the driver would keep without this memory."""
        level = scene.memory[self.name]
        own = driver.time_gap / (1.0 + p["strength"] * (level - 1.0))
        return level + (self._relative_gap(scene, driver, own) - level) * -torch.expm1(-scene.dt / p["memory_time"])


@dataclass(frozen=True)
class LeaderTrend(Effect):
    """Another time gap behind a leader who has become faster than behind one who has become slower: ``T → T κ^x``.

    ::

        x = (v_l − m)/(3 m/s) between −2 and 2,   τ dm/dt = v_l − m

    m is the memory of the leader's speed v_l, and starts at it. A response to the leader's past: the two branches of
    ``SetPointAsymmetry`` as a matter of degree, which are left again with the time constant τ. Drivers in phases of
    acceleration, braking and coasting keep different time gaps (Zhang and Kim 2005, Transp. Res. B 39, 385).
    """

    kind = "leader_trend"
    sources = (PUBLICATIONS["zhang_2005"], PUBLICATIONS["yeo_2009"])
    rank = 2
    title = "time gap by the leader's trend"
    equation = "T → T κ^x, x = (v_lead − m) / (3 m/s), τ dm/dt = v_lead − m"
    wording = (
        "drivers keep shorter time gaps behind a leader who has become faster than behind one who has become slower, "
        "where {law} keeps one",
        "drivers keep longer time gaps behind a leader who has become faster than behind one who has become slower, "
        "where {law} keeps one",
    )
    looks_like = ("set_point_asymmetry", "leader_acceleration", "relaxation")
    told_by = (
        "leaders that change their speed within 5 s and then hold it for half a minute tell a time gap that comes back "
        "from answers to the acceleration, which end with it"
    )
    acts_on = "time_gap"
    per_driver = True
    declared = (
        Parameter("factor", "κ", "1", 0.8, 0.2, 5.0, null=1.0, starts=(0.9,)),
        Parameter("memory_time", "τ", "s", 5.0, 0.5, 60.0, role="shape", starts=(3.0, 10.0)),
    )

    def initial_memory(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return m = v_l."""
        return scene.leader.speed

    def adapt(self, driver: Driver, scene: Scene, p: P) -> Driver:
        """Return the driver with the time gap in force."""
        change = (scene.leader.speed - scene.memory[self.name]) * (1.0 / 3.0)
        trend = change.clamp(-2.0, 2.0) * scene.leader.present
        return driver._replace(time_gap=driver.time_gap * p["factor"] ** trend)

    def remember(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Relax m towards the leader's speed."""
        level = scene.memory[self.name]
        return level + (scene.leader.speed - level) * -torch.expm1(-scene.dt / p["memory_time"])


@dataclass(frozen=True)
class GapStiffness(Effect):
    """A pull back to one's own gap that is softer or stiffer than IDM's: in ``s*/s`` the gap s counts as s_e (s/s_e)^w.

    ::

        s0, T, extra_gap → r times as much,   b → b / r²,   r = (s / s_e)^(1 − w),   s_e = (s0 + v T)/√(1 − (v/v0)⁴)

    so that all of s* is r times as large, and w counts how hard a driver pulls back to the gap of his equilibrium s_e,
    which stays where it is: the acceleration changes with ln s by 2 w a (s*/s)². s/s_e counts between 1/20 and 20. IDM
    ties this stiffness to a and T; in linear controllers of production cars it is a gain of its own, k1 (Milanés and
    Shladover 2014, Transp. Res. C 48, 285).
    """

    kind = "gap_stiffness"
    sources = (PUBLICATIONS["milanes_2014"],)
    rank = 3
    title = "stiffness of the pull to one's own gap"
    equation = "s* → s* (s/s_e)^(1 − w), s_e = (s0 + v T)/√(1 − (v/v0)⁴)"
    wording = (
        "drivers pull back to their own gap less hard than {law}",
        "drivers pull back to their own gap harder than {law}",
    )
    looks_like = ("relaxation", "max_accel", "comfort_decel")
    told_by = "gaps far from the usual one at steady speeds, closing and opening, tell it from a and b"
    acts_on = "time_gap"
    per_driver = True
    declared = (Parameter("stiffness", "w", "1", 0.5, 0.05, 4.0, null=1.0, starts=(0.7, 1.4)),)

    def adapt(self, driver: Driver, scene: Scene, p: P) -> Driver:
        """Return the driver whose desired gap has moved towards the gap that he has."""
        own = equilibrium_gap(driver, scene.speed)
        ratio = (scene.leader.gap.clamp_min(SMALLEST_GAP) / own).clamp(0.05, 20.0)
        scale = 1.0 + (ratio ** (1.0 - p["stiffness"]) - 1.0) * scene.leader.present
        return driver._replace(
            min_gap=driver.min_gap * scale,
            time_gap=driver.time_gap * scale,
            extra_gap=driver.extra_gap * scale,
            comfort_decel=driver.comfort_decel / (scale * scale),
        )
