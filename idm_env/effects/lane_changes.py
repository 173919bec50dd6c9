"""Wishes for another lane (hook ``change``): MOBIL, lanes that end, and an agent's command."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from idm_env.effects.base import Effect, P
from idm_env.effects.idm import interaction
from idm_env.effects.references import PUBLICATIONS
from idm_env.parameters import Parameter
from idm_env.types import Beside, Driver, Scene, Wish

COMMANDED = 1e12
"""Utility of an agent's command (m/s²): more than any driver's, who may think of a place inside another vehicle."""

STANDS = 1.0
"""Below this speed (m/s) a driver waits."""

QUEUES = 3.0
"""Behind somebody below this speed (m/s) a driver queues."""

_CRAWLS = 2.0
"""Below this speed (m/s) nobody brakes for long, however hard."""

_BLOCK = 256
"""The fewest slots that decide together."""

_SAFE_DECEL = Parameter("safe_decel", "b_safe", "m/s²", 4.0, 0.5, 9.0, role="threshold")


def margin(side: Beside, here: Beside, safe_decel: Tensor) -> Tensor:
    """Return by how much (m/s²) a change is safe: for the follower there, and for oneself; shape ``(…, vehicles)``.

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

    kind = "mobil"
    sources = (PUBLICATIONS["kesting_2007"],)
    declared = (
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
    grows towards the end. ``turns`` z makes a zipper: whoever queues in his lane, at most 20 m behind somebody below
    3 m/s, feels an urgency of ``(1 − z) u`` until he is the first at the end; 0 is nobody waiting for his turn.
    """

    kind = "mandatory_change"
    sources = (PUBLICATIONS["kesting_2007"],)
    declared = (
        Parameter("strength", "A", "m/s²", 4.0, 0.0, 100.0, role="shape"),
        Parameter("reach", "D", "m", 300.0, 1.0, 5000.0, role="shape"),
        _SAFE_DECEL,
        Parameter("turns", "z", "1", 0.0, 0.0, 1.0, null=0.0, role="shape"),
    )

    def change(self, scene: Scene, driver: Driver, p: P) -> Wish:
        """Return how much more urgent it is here than there."""
        here, left, right = _lanes(scene)

        queues = (here.leader.gap < here.ends) & (here.leader.speed < QUEUES) & (here.leader.gap < 20.0)
        turn = torch.where(queues, 1.0 - p["turns"], 1.0)

        def urgency(lane: Beside) -> Tensor:
            return p["strength"] * torch.relu(1.0 - lane.ends / p["reach"]) * turn

        return Wish(
            (urgency(here) - urgency(left)) * left.exists,
            (urgency(here) - urgency(right)) * right.exists,
            margin(left, here, p["safe_decel"]),
            margin(right, here, p["safe_decel"]),
        )


@dataclass(frozen=True)
class GapAcceptance(Effect):
    """Gaps that drivers accept near the end of a lane, and where they have waited: closer ones, and harder braking.

    ::

        d = c (u + (1 − u) m) where u > 0,   u = max(0, u_here − u_there),   u_x = max(0, 1 − x/D)
        T_d = T (1 − γ d),   s0_d = s0 (1 − d),   b_d = b_safe + d (b_most − b_safe),   safe where A_d ≥ −b_d
        τ dm/dt = [v < 1 m/s] − m,   utility → (1 − d) · (sum over effects) + d · (largest of one effect)

        and above 2 m/s A ≥ −b_h;   for every change s ≥ v T_min + s0 (0.1 + 0.4 min(1, v / 5 m/s))

    u says how near the end x of the lane is, m how long the driver has stood. A_d is what the follower there would
    want, and the driver himself, with T_d and s0_d in IDM's ``a (s*/s)²``; A is what they will do. After the desire of
    LMRS: with it the accepted headway shrinks, the accepted deceleration grows, and voluntary reasons count less
    (Schakel, Knoop, van Arem 2012). A gap accepted so counts as safe whatever other effects say, but none below the
    last line, where v and s are the follower's and the driver's own. Absent at c = 0.
    """

    kind = "gap_acceptance"
    sources = (PUBLICATIONS["schakel_2012"],)
    declared = (
        Parameter("strength", "c", "1", 1.0, 0.0, 1.0, null=0.0),
        Parameter("reach", "D", "m", 300.0, 1.0, 5000.0, role="shape"),
        Parameter("closer", "γ", "1", 0.8, 0.0, 0.9, role="shape"),
        _SAFE_DECEL,
        Parameter("most_decel", "b_most", "m/s²", 9.0, 0.5, 9.0, role="shape"),
        Parameter("patience", "τ", "s", 10.0, 1.0, 300.0, role="shape"),
        Parameter("hardest", "b_h", "m/s²", 7.5, 0.5, 1e6, role="threshold"),
        Parameter("least_time_gap", "T_min", "s", 0.4, 0.0, 5.0, role="threshold"),
    )

    def initial_memory(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return m = 0."""
        return torch.zeros_like(scene.speed)

    def remember(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return m after a step, by its exact law."""
        level = scene.memory[self.name]
        stands = torch.where(scene.speed < STANDS, 1.0, 0.0)
        return level + (stands - level) * -torch.expm1(-scene.dt / p["patience"])

    def change(self, scene: Scene, driver: Driver, p: P) -> Wish:
        """Return no utility, and safety margins that relax with the urgency of a change (m/s²)."""
        here, left, right = _lanes(scene)
        none = torch.zeros_like(scene.speed)

        def near(lane: Beside) -> Tensor:
            return torch.relu(1.0 - lane.ends / p["reach"])

        def wished(side: Beside) -> Tensor:
            must = torch.relu(near(here) - near(side)) * side.exists
            return p["strength"] * torch.where(must > 0, must + (1.0 - must) * scene.memory[self.name], 0.0)

        def despite(side: Beside, desire: Tensor) -> Tensor:
            closer = driver._replace(
                time_gap=driver.time_gap * (1.0 - p["closer"] * desire), min_gap=driver.min_gap * (1.0 - desire)
            )
            most = p["safe_decel"] + desire * torch.relu(p["most_decel"] - p["safe_decel"])

            def eased(accel: Tensor, speed: Tensor, gap: Tensor, lead_speed: Tensor) -> Tensor:
                less = interaction(driver, speed, gap, lead_speed) - interaction(closer, speed, gap, lead_speed)
                return accel + driver.max_accel * less

            own = eased(side.wanted, scene.speed, side.leader.gap, side.leader.speed)
            other = eased(side.with_me, side.follower.speed, side.follower.gap, scene.speed)
            other = torch.minimum(other + most, side.with_me + hardest(side.follower.speed))
            follower = torch.where(side.follower.present > 0, other, most)
            own = torch.minimum(
                own - torch.minimum(here.wanted, -most), side.wanted - torch.minimum(here.wanted, -hardest(scene.speed))
            )
            safe = torch.minimum(torch.minimum(follower, own), room(side))
            return torch.where(desire > 0, safe, -COMMANDED)

        def hardest(speed: Tensor) -> Tensor:
            return torch.where(speed > _CRAWLS, p["hardest"], COMMANDED)

        def room(side: Beside) -> Tensor:
            """Return by how much both gaps exceed the least that anybody accepts, as a margin."""
            pairs = ((side.follower, side.follower.speed), (side.leader, scene.speed))
            more = (torch.where(other.present > 0, other.gap - least(speed), COMMANDED) for other, speed in pairs)
            return torch.where(p["strength"] > 0, torch.minimum(*more), COMMANDED)

        def least(speed: Tensor) -> Tensor:
            share = 0.1 + 0.4 * (speed / 5.0).clamp_max(1.0)
            return p["least_time_gap"] * speed + driver.min_gap * share

        desires = wished(left), wished(right)
        accepted = despite(left, desires[0]), despite(right, desires[1])
        return Wish(none, none, room(left), room(right), None, None, *accepted, *desires)


@dataclass(frozen=True)
class LaneCommand(Effect):
    """An agent's wish in place of the driver's: 1 to the left, −1 to the right, 0 to stay; NaN leaves it to the driver.

    Input ``lane_command``: that number for every vehicle. A command counts at the next decision. What is unsafe, or off
    the road, is not done but counted (``lanes.blocked``), and so is what another claim wins (``lanes.refused``).
    """

    kind = "lane_command"
    takes = Tensor
    declared = (_SAFE_DECEL,)

    def change(self, scene: Scene, driver: Driver, p: P) -> Wish:
        """Return a utility that outweighs every driver's."""
        here, left, right = _lanes(scene)
        command: Tensor = scene.input(self.name)
        active = command.isfinite()
        side = torch.where(active, command, 0.0)

        def utility(direction: Tensor) -> Tensor:
            return torch.where(active, torch.where(direction > 0, COMMANDED, -COMMANDED), 0.0) + 0.0 * scene.speed

        return Wish(
            utility(side), utility(-side), margin(left, here, p["safe_decel"]), margin(right, here, p["safe_decel"])
        )
