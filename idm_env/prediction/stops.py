"""Where a route asks for a stop: stop signs and red lights, as standing leaders at the stop line."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from idm_env.data.scenario import TrafficControl
from idm_env.prediction.lanes import LaneGraph, Route

POST_RIGHT_M = (1.2, 8.0)
"""A sign's post stands this far to the right of the lane that it is for (m): traffic drives on the right here."""
POST_ALONG_M = 8.0
"""… and this near to that lane's end, which is where a junction begins (m)."""
ON_LINE_M = 3.0
"""A signal that names no lane is for the routes that pass within this of its stop point (m)."""
PASSED_M = 1.0
"""A front bumper this far beyond the line has passed it (m)."""
YELLOW_DECEL = 3.0
"""Who would have to brake harder at a yellow light drives on (m/s²)."""


@dataclass(frozen=True)
class Stop:
    """A stop line on a route: its distance ahead of the front bumper (m), and ``sign`` or ``red``."""

    distance: float
    kind: str


class StopLines:
    """The stop lines of a scene: for each lane, what is shown there and where."""

    def __init__(self, graph: LaneGraph, controls: Sequence[TrafficControl]) -> None:
        self._by_lane: dict[int, list[tuple[str, np.ndarray]]] = {}
        self._loose: list[tuple[str, np.ndarray]] = []
        for control in controls:
            if control.shows in ("go", "unknown"):
                continue
            if control.shows == "sign":
                lanes = [lane for lane in control.lanes if lane in graph.lanes]
                for lane in lanes or _lanes_of(graph, control.point):
                    self._by_lane.setdefault(lane, []).append(("sign", graph.lanes[lane].line[-1]))
            elif control.lanes:
                for lane in control.lanes:
                    self._by_lane.setdefault(lane, []).append((control.shows, control.point))
            else:
                self._loose.append((control.shows, control.point))

    def next_stop(self, route: Route, front: float, speed: float) -> Stop | None:
        """Return the next stop line of a route, None if there is none; ``front`` (m) is from centre to bumper."""
        shown = [item for lane in route.chain for item in self._by_lane.get(lane, ())]
        shown += [item for item in self._loose if abs(route.locate(item[1])[1]) < ON_LINE_M]
        stops = []
        for shows, point in shown:
            distance = route.locate(point)[0] - route.begin - front
            hard = speed * speed > 2.0 * YELLOW_DECEL * max(distance, 0.1)
            if distance > -PASSED_M and not (shows == "caution" and hard):
                stops.append(Stop(max(distance, 0.0), "sign" if shows == "sign" else "red"))
        return min(stops, key=lambda stop: stop.distance, default=None)


def _lanes_of(graph: LaneGraph, point: np.ndarray) -> list[int]:
    """Return the lanes that a sign without lanes is for: those that branch at their end, with the post at their right.

    Lanes of several exits lead up to a junction; those inside it have one, and the post of a crossing road may stand
    beside them.
    """
    lanes = []
    for key, lane in graph.lanes.items():
        if len(graph.exits[key]) < 2:
            continue
        direction = lane.line[-1] - lane.line[-2]
        along, left = direction / np.hypot(*direction), np.array([-direction[1], direction[0]]) / np.hypot(*direction)
        apart = point - lane.line[-1]
        if abs(apart @ along) <= POST_ALONG_M and POST_RIGHT_M[0] <= -(apart @ left) <= POST_RIGHT_M[1]:
            lanes.append(key)
    return lanes
