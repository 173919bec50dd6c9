"""Scenarios, whatever file they come from: agents over time, lanes, stop signs and signals."""

from dataclasses import dataclass, field

import numpy as np

from idm_env.data.errors import DataError

PRESENT = 10
"""Step of the present where a file does not say: 11 steps of history, then the future."""


@dataclass(frozen=True, eq=False)
class Agent:
    """One agent; arrays are [T] or [T, 2], in m, rad and m/s, and mean nothing where ``valid`` is False."""

    id: int
    kind: str
    length: float
    width: float
    position: np.ndarray
    heading: np.ndarray
    velocity: np.ndarray
    valid: np.ndarray


@dataclass(frozen=True, eq=False)
class MapLane:
    """A lane's centre line [M, 2] in the direction of travel.

    ``exits`` are identifiers of the lanes that follow, None where the file does not tell them; ``speed_limit`` in m/s,
    NaN where unknown; ``bike`` marks lanes for bicycles.
    """

    id: int
    line: np.ndarray
    exits: tuple[int, ...] | None = None
    speed_limit: float = float("nan")
    bike: bool = False


@dataclass(frozen=True, eq=False)
class TrafficControl:
    """A stop sign or a signal at ``point`` [2]: what it shows at the present step, and the lanes that it is for.

    ``shows`` is ``sign``, or a signal's ``stop``, ``caution``, ``go`` or ``unknown``; a flashing stop is a sign, a
    flashing caution is go. ``lanes`` is empty where the file does not tell them (signs in JSON).
    """

    shows: str
    point: np.ndarray
    lanes: tuple[int, ...] = ()


SHOWN = ("unknown", "stop", "caution", "go", "stop", "caution", "go", "sign", "go")
"""What the states 0 to 8 of a signal in the official files mean here."""


@dataclass(frozen=True, eq=False)
class Scenario:
    """A scene: who, where and on which lanes. ``present`` is the step up to which the past is known."""

    id: str
    agents: tuple[Agent, ...]
    lanes: tuple[MapLane, ...]
    to_predict: tuple[int, ...]
    present: int = PRESENT
    controls: tuple[TrafficControl, ...] = ()
    notes: tuple[str, ...] = field(default=())


def check_scenario(agents: tuple[Agent, ...], targets: tuple[int, ...], present: int, source: str) -> None:
    """Raise DataError for tracks to predict that do not exist, and for a scenario that ends before its present."""
    wrong = [i for i in targets if not 0 <= i < len(agents)]
    if wrong:
        raise DataError(f"{source}: track_index {wrong[0]} to predict is outside the {len(agents)} agents.")
    if len(agents[0].valid) <= present:
        raise DataError(f"{source}: {len(agents[0].valid)} steps end before the present step {present}.")
