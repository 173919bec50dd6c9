"""How the driver's own parameters change: with speed, memory, place and time (hook ``adapt``)."""

from dataclasses import dataclass

import torch
from torch import Tensor

from idm_env.effects.base import Effect, P
from idm_env.effects.places import on_lap, smooth_step, window
from idm_env.effects.references import PUBLICATIONS
from idm_env.parameters import Parameter
from idm_env.types import Driver, Scene


@dataclass(frozen=True)
class SpeedDependentGap(Effect):
    """``s* += s1 √(v/v0)`` (Treiber, Hennecke, Helbing 2000), with √ continued linearly below v/v0 = 10⁻³."""

    kind = "speed_dependent_gap"
    sources = (PUBLICATIONS["treiber_2000"],)
    rank = 4
    title = "speed-dependent gap"
    equation = "s* += s1 √(v/v0)"
    wording = (
        "drivers keep shorter gaps at speed than {law}'s constant time gap",
        "drivers keep longer gaps at speed than {law}'s constant time gap",
    )
    looks_like = ("drag", "time_gap")
    told_by = "following at 5 to 30 m/s by one driver tells the gap from drag"
    acts_on = "desired_gap"
    declared = (Parameter("extra_gap", "s1", "m", 3.0, -10.0, 15.0, null=0.0, starts=(0.5,)),)

    def adapt(self, driver: Driver, scene: Scene, p: P) -> Driver:
        """Return the driver with the longer desired gap."""
        ratio = scene.speed / driver.desired_speed
        root = torch.sqrt(ratio.clamp_min(1e-3)) - torch.relu(1e-3 - ratio) * (1e-3**-0.5)
        return driver._replace(extra_gap=driver.extra_gap + p["extra_gap"] * root)


@dataclass(frozen=True)
class LongMemory(Effect):
    """Drivers in long congestion keep larger gaps: ``T (1 + β (1 − λ))``, ``τ dλ/dt = v/v0 − λ``.

    Source: Treiber and Helbing 2003, Phys. Rev. E 68, 046119. λ starts at v/v0 and is integrated exactly over a step of
    constant v/v0.
    """

    kind = "memory"
    sources = (PUBLICATIONS["treiber_2003"],)
    title = "memory of congestion"
    equation = "T (1 + β (1 − λ)), τ dλ/dt = v/v0 − λ"
    wording = (
        "drivers keep shorter time gaps the longer they have driven slowly, where {law} keeps one",
        "drivers keep longer time gaps the longer they have driven slowly, where {law} keeps one",
    )
    looks_like = ("regime_shift", "time_gap")
    told_by = "runs that begin at different times of the day tell memory from a shift of regime"
    acts_on = "time_gap"
    declared = (
        Parameter("strength", "β", "1", 0.5, -0.9, 3.0, null=0.0, starts=(0.5,)),
        Parameter("memory_time", "τ", "s", 60.0, 5.0, 900.0, role="shape", starts=(30.0, 150.0)),
    )

    def initial_memory(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return λ = v/v0."""
        return scene.speed / driver.desired_speed

    def adapt(self, driver: Driver, scene: Scene, p: P) -> Driver:
        """Return the driver with the time gap in force."""
        return driver._replace(time_gap=driver.time_gap * (1.0 + p["strength"] * (1.0 - scene.memory[self.name])))

    def remember(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Relax λ towards v/v0."""
        level = scene.memory[self.name]
        return level + (scene.speed / driver.desired_speed - level) * -torch.expm1(-scene.dt / p["memory_time"])


@dataclass(frozen=True)
class SpeedZone(Effect):
    """``v0 → f v0`` between x1 and x2, as behind a speed sign; edges are smooth over ``width`` (m).

    Places are in the position's coordinate, on a lap of ``period`` metres where given.
    """

    kind = "speed_zone"
    title = "speed zone"
    equation = "v0 → f v0 between x1 and x2"
    wording = (
        "drivers want to go slower in one stretch of the road, where {law} has one desired speed",
        "drivers want to go faster in one stretch of the road, where {law} has one desired speed",
    )
    looks_like = ("grade", "time_gap over position")
    told_by = "the same place at low and high speed, with and without leader, tells a zone from a grade"
    sought = "interval"
    acts_on = "desired_speed"
    rank = 1
    declared = (
        Parameter("factor", "f", "1", 0.7, 0.2, 2.0, null=1.0),
        Parameter("begin", "x1", "m", 200.0, -1e6, 1e6, role="place"),
        Parameter("end", "x2", "m", 500.0, -1e6, 1e6, role="place"),
    )
    width: float = 5.0
    period: float | None = None

    @classmethod
    def strength_of(cls, change: float) -> float:
        """Return f: the response is that of (v/v0)⁴, whose factor f⁻⁴ is known to all orders."""
        factor = min(max(1.0 - 4.0 * change, 0.3), 100.0) ** -0.25
        return min(max(factor, 0.25), 1.9)

    def adapt(self, driver: Driver, scene: Scene, p: P) -> Driver:
        """Return the driver with the desired speed in force."""
        inside = window(on_lap(scene.position, self.period), p["begin"], p["end"], self.width)
        return driver._replace(desired_speed=driver.desired_speed * (1.0 + (p["factor"] - 1.0) * inside))


@dataclass(frozen=True)
class RegimeShift(Effect):
    """``T → T (1 + k)`` after time t* (rain, darkness); the step is smooth over ``width`` (s)."""

    kind = "regime_shift"
    title = "shift of regime"
    equation = "T → T (1 + k) after t*"
    wording = (
        "drivers keep shorter time gaps from one moment on, where {law} keeps one",
        "drivers keep longer time gaps from one moment on, where {law} keeps one",
    )
    looks_like = ("memory", "time_gap over time")
    told_by = "runs with different clock offsets tell a shift of regime from memory"
    sought = "step"
    acts_on = "time_gap"
    rank = 2
    declared = (
        Parameter("strength", "k", "1", 0.3, -0.8, 3.0, null=0.0),
        Parameter("time", "t*", "s", 60.0, -1e7, 1e7, role="place"),
    )
    width: float = 0.5

    @classmethod
    def strength_of(cls, change: float) -> float:
        """Return k, between what drivers do."""
        return min(max(change, -0.6), 1.5)

    def adapt(self, driver: Driver, scene: Scene, p: P) -> Driver:
        """Return the driver with the time gap in force."""
        after = smooth_step(scene.time, p["time"], self.width)
        return driver._replace(time_gap=driver.time_gap * (1.0 + p["strength"] * after))
