"""Words of tasks: what a step carries over, how episodes end, and what agents see.

Shapes: what belongs to agents is ``(…, agents)``, what belongs to vehicles ``[..., n]``.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

from torch import Tensor

from idm_env.roads import Road
from idm_env.types import State

Maybe = Tensor | None
Normals = Mapping[str, Tensor] | None
"""Standard normals of a step, by the effect that draws them."""
NOBODY = "—"
"""Id of a slot in which no recorded vehicle is."""


class EnvState(NamedTuple):
    """Everything that a step carries over: the state of the traffic, and what is constant in an episode.

    Every tensor has the environments as its first dimension.
    """

    state: State
    episode: Mapping[str, Tensor]


class Agents(Protocol):
    """What a feature and a reward term may ask of a task: whose vehicles agents control, and on which road."""

    @property
    def road(self) -> Road:
        """The road."""

    @property
    def simulator(self) -> Any:
        """The simulator, with its ``dt`` (s)."""

    @property
    def agents(self) -> tuple[int, ...]:
        """Indices of the controlled vehicles."""

    @property
    def command_limits(self) -> tuple[float, float]:
        """The accelerations (m/s²) that actions of −1 and 1 command."""

    def pick(self, x: Tensor) -> Tensor:
        """Return what belongs to the controlled vehicles, ``(…, agents)``."""

    def pick_leader(self, state: State, x: Tensor, nobody: float | None = None) -> Tensor:
        """Return what belongs to their leaders, where there is none their own or ``nobody``."""

    def there(self, state: State, x: Tensor) -> Tensor:
        """Return ``x``, 0 for agents that are not on the road."""


class Ended(NamedTuple):
    """Which agents have come to an end of their own, and which are cut off; bool, shape ``(…, agents)``."""

    terminated: Tensor
    truncated: Tensor


class Bounds(NamedTuple):
    """Names of what one agent observes, with the lowest and the highest value of each, as it is observed."""

    names: tuple[str, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]


class RewardRange(NamedTuple):
    """The lowest and the highest reward that a step without a crash can give."""

    low: float
    high: float
