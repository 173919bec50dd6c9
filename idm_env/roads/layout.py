"""How several lanes lie: where each begins and ends, and where one may be entered and left sideways.

Shapes: what belongs to vehicles is ``[..., n]``, places are in m.
"""

from dataclasses import dataclass
from typing import Literal, get_args

from torch import Tensor

from idm_env.roads.adjacent import is_open_beside
from idm_env.types import constant
from idm_env.validation import at_least, one_of, whole

ENDLESS = 1e9
"""Where a lane ends that does not (m): finite, as all that vehicles see."""


Where = Literal["begins", "opens", "closes", "stops", "leaves"]
WHERE: tuple[Where, ...] = get_args(Where)


@dataclass(frozen=True)
class End:
    """Where one lane begins and ends (m), and where it may be entered and left sideways; made by the three below.

    At a ``closed`` end stands a virtual leader; from an open one vehicles leave the road. Sideways a lane is open for
    front bumpers from ``opens`` to ``closes``.
    """

    lane: int
    begin: float = -ENDLESS
    end: float = ENDLESS
    closed: bool = True
    opens: float = -ENDLESS
    closes: float = ENDLESS


def lane_drop(lane: int, at: float) -> End:
    """Return the end of a lane that stops at ``at`` (m): whoever is on it must change, or stands there."""
    return End(lane, end=at, closes=at)


def on_ramp(lane: int, begin: float, end: float, entry: float = -ENDLESS) -> End:
    """Return a ramp from ``entry`` on, from which one may merge between ``begin`` and ``end`` (m), where it stops."""
    return End(lane, begin=entry, end=end, opens=begin, closes=end)


def off_ramp(lane: int, begin: float, end: float, leaves: float) -> End:
    """Return a ramp that one may enter between ``begin`` and ``end``, and on which vehicles leave at ``leaves`` (m)."""
    return End(lane, begin=begin, end=leaves, closed=False, opens=begin, closes=end)


@dataclass(frozen=True)
class LaneLayout:
    """The places of ``count`` lanes, as ``Lanes`` says; ValueError for a lane or a ramp that cannot be."""

    count: int = 2
    length: float | None = None
    ring: float | None = None
    ends: tuple[End, ...] = ()
    handed: Literal["left", "right"] = "left"
    duration: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "ends", tuple(self.ends))
        whole("Lanes: count", self.count, 1)
        if self.length is not None and self.ring is not None:
            raise ValueError(f"Lanes: length = {self.length} m and ring = {self.ring} m: a road is one of them.")
        for name, size in (("length", self.length), ("ring", self.ring)):
            if size is not None:
                at_least(f"Lanes: {name}", size, 1.0, "m", ENDLESS)
        at_least("Lanes: duration", self.duration, 0.0, "s", ENDLESS)
        one_of("Lanes: handed", self.handed, ("left", "right"))
        if self.ring is not None and self.ends:
            raise ValueError("Lanes: a ring has no ends. Give a length, or leave the ends out.")
        self._check_ends()

    def _check_ends(self) -> None:
        seen = set()
        for end in self.ends:
            if not 0 <= end.lane < self.count:
                raise ValueError(f"lane {end.lane} does not exist: this road has lanes 0 to {self.count - 1}.")
            if end.lane in seen:
                raise ValueError(f"lane {end.lane} has two ends. Give one for each lane.")
            seen.add(end.lane)
            if end.closed and end.end <= (begin := max(end.begin, 0.0)):
                raise ValueError(f"lane {end.lane} ends at {end.end:g} m, and begins at {begin:g} m: end it later.")
            last = ENDLESS if self.length is None else self.length
            if not end.begin <= max(end.opens, end.begin) < end.closes <= end.end <= last:
                raise ValueError(
                    f"lane {end.lane} opens at {end.opens:g} m, closes at {end.closes:g} m and ends at {end.end:g} m: "
                    f"these must rise, and lie on the road of {last:g} m."
                )

        if sum(end.closed for end in self.ends) == self.count:
            raise ValueError("all lanes of this road end. Leave one that goes on.")

    def table(self, name: Where) -> tuple[float, ...]:
        """Return a place of every lane (m): where one enters it, may change to or from it, must stop, or leaves."""
        none = {"begins": 0.0, "opens": -ENDLESS, "leaves": self.length or ENDLESS}
        values = [none.get(name, ENDLESS)] * self.count
        for end in self.ends:
            if name == "begins":
                values[end.lane] = max(end.begin, 0.0)
            elif name == "opens" or name == "closes":
                values[end.lane] = getattr(end, name)
            elif end.closed == (name == "stops"):
                values[end.lane] = end.end
        return tuple(values)

    def at_lane(self, lane: Tensor, like: Tensor, name: Where) -> Tensor:
        """Return, for each vehicle, a number of its lane."""
        return constant(self.table(name), like.dtype, like.device)[lane]

    def closed_at(self, lane: Tensor, like: Tensor) -> Tensor:
        """Return where a virtual leader stands on each vehicle's lane (m), ``ENDLESS`` where none does."""
        return self.at_lane(lane, like, "stops")

    def left_at(self, lane: Tensor, like: Tensor) -> Tensor:
        """Return where vehicles leave the road (m)."""
        return self.at_lane(lane, like, "leaves")

    @property
    def closed(self) -> bool:
        """Whether a lane of this road ends."""
        return any(end.closed for end in self.ends)

    @property
    def leaving(self) -> bool:
        """Whether vehicles leave this road."""
        return self.length is not None or any(not end.closed for end in self.ends)

    def open_between(self, lane: Tensor, to: Tensor, position: Tensor, length: Tensor) -> Tensor:
        """Return whether a vehicle may change from a lane to one beside it here (bool); ``to`` may not exist."""
        open_here = (to >= 0) & (to < self.count)
        if not self.ends:
            return open_here
        for each in (lane, to.clamp(0, self.count - 1)):
            opens, closes = (self.at_lane(each, position, name) for name in ("opens", "closes"))
            open_here = open_here & is_open_beside(position, length, opens, closes)
        return open_here
