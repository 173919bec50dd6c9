"""Rules of networks: limits of links, and lines at which one stops (``multilane.junctions`` tells drivers of both)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from idm_env.effects.base import Effect, P
from idm_env.effects.road_rules import before_obstacle
from idm_env.parameters import Parameter
from idm_env.types import FAR, Driver, Scene
from idm_env.validation import in_interval

OPEN = 1e6
"""Place of a line that is not closed (m)."""


@dataclass(frozen=True)
class LinkLimit(Effect):
    """Speed limits of a network's links: ``v0 → min(v0, f v_lim)``, v_lim that of the link on which a driver is.

    f is how much of a limit he drives. On any other road nothing is limited.
    """

    kind = "link_limit"
    adds = False
    guided = "limit"
    acts_on = "desired_speed"
    title = "limits of links"
    equation = "v0 → min(v0, f v_lim)"
    rank = 2
    declared = (Parameter("factor", "f", "1", 1.0, 0.2, 3.0, role="shape"),)

    def adapt(self, driver: Driver, scene: Scene, p: P) -> Driver:
        """Return the driver with the desired speed that is left."""
        limit = p["factor"] * scene.memory[self.name]
        return driver._replace(desired_speed=torch.minimum(driver.desired_speed, limit))

    def initial_memory(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return no limit: events write those of links (m/s)."""
        return torch.full_like(scene.speed, FAR)


@dataclass(frozen=True)
class StopLine(Effect):
    """A line that is closed, at which one stops: somebody stands there, and the stronger *interaction* counts.

    ::

        A += −a max(0, (s*/s)²_line − (s*/s)²_leader)

    Where his next line is, and whether it is closed to him, a driver on a network is told ``every`` so many seconds
    (``multilane.junctions``): it is his memory (m on his link). It is closed for red and amber, if he can stop, ``v² ≤
    2 b_m s_line``, and did not wait there for a gap in green; while a foe is inside or has reserved, and will not
    have left before one must stop; without room behind the junction; and to drivers who yield while they are more than
    ``sight`` (m) away, or somebody with priority arrives within t_c (``critical_gap``, s): SUMO's 1 s beyond the time
    that a left turn takes from a stand.
    Lines and leaders are looked for within ``reach`` (m), or v²/2b_m if that is more.
    """

    kind = "stop_line"
    adds = False
    guided = "stop"
    title = "stop lines"
    equation = "A += −a max(0, (s*/s)²_line − (s*/s)²_leader)"
    most_decel: float = 3.0
    critical_gap: float = 5.5
    sight: float = 4.5
    reach: float = 150.0
    every: float = 0.5

    def __post_init__(self) -> None:
        for name, high in (("most_decel", 9.0), ("critical_gap", 60.0), ("sight", 1e3), ("reach", 1e3), ("every", 1.0)):
            in_interval(f"effect 'stop_line': {name}", getattr(self, name), 0.01, high)

    def line(self, scene: Scene, p: P) -> Tensor:
        """Return how far it is to the line where one stops (m), FAR for those who do not."""
        way = scene.memory[self.name] - scene.position
        return torch.where(way >= 0.0, way, FAR)

    def accelerate(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return the deceleration for a standing obstacle at the line (m/s²)."""
        return before_obstacle(self.line(scene, p), scene, driver)

    def initial_memory(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return a line that nobody reaches."""
        return torch.full_like(scene.speed, OPEN)
