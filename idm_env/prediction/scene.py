"""A scenario as drivers see it: their routes, the leaders on them, stop lines, and the leaders' futures."""

from dataclasses import replace
from functools import cached_property

import numpy as np

from idm_env.data.scenario import Agent, Scenario
from idm_env.prediction.drivers import Second, middle, passing
from idm_env.prediction.free import motion_now
from idm_env.prediction.lanes import LaneGraph, Route, turn
from idm_env.prediction.mixture import STANDING_MPS
from idm_env.prediction.rollout import DT, Course, RouteLeader, nobody, roll
from idm_env.prediction.stops import StopLines

SECONDS = 8
STEPS = SECONDS * 10
LEAST_ROUTE = 0.02
"""Routes that are less plausible than this share of the best are not followed."""
YAW_SIGMA = 0.2
"""How far a yaw rate may be from that of the route just ahead (rad/s)."""
DEEPEST = 4
"""A leader's leader's … leader is worked out down to here; the next one goes on as it does."""


def _turning_alike(route: Route, speed: float, turning: float) -> float:
    """Return how well a yaw rate (rad/s) fits the route over the next second: a normal density, 1 at its best."""
    near = route.begin + np.linspace(0.0, max(speed, 1.0), 5)
    expected = speed * float(np.interp(near, route.length, route.curvature).mean())
    return float(np.exp(-0.5 * ((turning - expected) / YAW_SIGMA) ** 2))


class MapScene:
    """A scenario with its lane graph, and the motions of leaders once they have been worked out."""

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        self.present = scenario.present
        self._travelled: dict[int, np.ndarray] = {}
        self.published: dict[int, tuple[Second, RouteLeader, np.ndarray] | None] = {}
        """Drivers by the paper's recipe, once fitted: last second, leader's future, five values; None off the lanes."""

    @cached_property
    def graph(self) -> LaneGraph:
        """The lanes."""
        return LaneGraph(self.scenario.lanes)

    @cached_property
    def lines(self) -> StopLines:
        """The stop lines, as they are at the present."""
        return StopLines(self.graph, self.scenario.controls)

    def valid(self, index: int) -> Agent:
        """Return an agent. ValueError if it is not valid at the present."""
        agent = self.scenario.agents[index]
        if not agent.valid[self.present]:
            raise ValueError(f"agent {agent.id} is not valid at the present step, so nothing can be predicted from it.")
        return agent

    def speed(self, agent: Agent) -> float:
        """Return the present speed (m/s)."""
        return float(np.hypot(*agent.velocity[self.present]))

    def routes(self, agent: Agent) -> list[Route]:
        """Return the routes of an agent that travels on lanes; none for pedestrians."""
        if agent.kind not in ("vehicle", "cyclist"):
            return []
        reach = max(40.0, SECONDS * self.speed(agent) + 0.5 * 1.5 * SECONDS**2)
        heading = float(agent.heading[self.present])
        bike = agent.kind == "cyclist"
        routes = self.graph.routes(agent.position[self.present], heading, reach, bike=bike)
        _, _, _, turning = motion_now(agent, self.present)
        routes = [replace(r, weight=r.weight * _turning_alike(r, self.speed(agent), turning)) for r in routes]
        routes.sort(key=lambda route: -route.weight)
        return [route for route in routes if route.weight >= LEAST_ROUTE * routes[0].weight]

    def leader(self, index: int, route: Route) -> tuple[int, float, float] | None:
        """Return the next vehicle ahead on a route, arc length and lateral distance of its centre (m), or None.

        Ahead is whose body reaches into the width of one's own, is not beside one, and does not cross the route.
        """
        me, best = self.scenario.agents[index], None
        for other, agent in enumerate(self.scenario.agents):
            if other == index or not agent.valid[self.present]:
                continue
            apart = agent.position[self.present] - me.position[self.present]
            if np.hypot(*apart) > 100.0:
                continue
            along, lateral, heading = route.locate(agent.position[self.present])
            off = abs(float(turn(heading - agent.heading[self.present])))
            alongside = along - route.begin < 0.5 * (me.length + agent.length)
            apart_across = abs(lateral) > 0.5 * (me.width + agent.width)
            crosses = agent.kind != "pedestrian" and off > np.pi / 3
            if alongside or apart_across or crosses:
                continue
            if best is None or along < best[1]:
                best = other, along, lateral
        return best

    def leader_motion(self, index: int, route: Route, depth: int = 0) -> tuple[RouteLeader, RouteLeader]:
        """Return the vehicle ahead over the last second and over the future, by its own predicted motion."""
        leader = self.leader(index, route)
        if leader is None:
            return nobody(self.present), nobody(STEPS)
        other, along, lateral = leader
        agent = self.scenario.agents[other]
        travelled = self.travelled(other, depth + 1)
        speed = np.gradient(np.concatenate([[0.0], travelled]), DT)
        past = self.past(agent, along - 0.5 * agent.length)
        share = passing(lateral) if past.speed[-1] < STANDING_MPS else 0.0
        future = RouteLeader(past.rear[-1] + np.concatenate([[0.0], travelled]), np.maximum(speed, 0.0), share)
        return RouteLeader(past.rear, past.speed, share), future

    def past(self, agent: Agent, rear: float) -> RouteLeader:
        """Return where an agent's rear has been that is at arc length ``rear`` (m) now."""
        speed = self.speeds(agent)
        back = np.concatenate([np.cumsum(speed[::-1])[::-1][1:] * DT, [0.0]])
        return RouteLeader(rear - back, speed)

    def speeds(self, agent: Agent) -> np.ndarray:
        """Return speeds (m/s) [present + 1] from the first step on; what is not valid takes the nearest that is."""
        speed = np.hypot(*agent.velocity[: self.present + 1].T)
        valid = np.flatnonzero(agent.valid[: self.present + 1])
        return np.asarray(np.interp(np.arange(self.present + 1), valid, speed[valid]))

    def second(self, agent: Agent, route: Route, past: RouteLeader) -> Second:
        """Return the last second of an agent on a route, from where it has been valid without a break."""
        valid = agent.valid[max(self.present - 10, 0) : self.present + 1]
        broken = np.flatnonzero(~valid)
        first = self.present - len(valid) + 1 + (int(broken[-1]) + 1 if len(broken) else 0)
        front = 0.5 * agent.length
        stop = self.lines.next_stop(route, front, self.speed(agent))
        ahead = RouteLeader(past.rear[first:], past.speed[first:], past.passed)
        return Second(route, self.speeds(agent)[first:], ahead, front, stop)

    def travelled(self, index: int, depth: int) -> np.ndarray:
        """Return how far an agent will have gone at every step [S] (m): the middle driver on its likeliest route."""
        if index not in self._travelled:
            agent = self.scenario.agents[index]
            speed, _, accel, _ = motion_now(agent, self.present)
            routes = self.routes(agent) if depth < DEEPEST else []
            if routes and speed > 0.3:
                # entered first, so that a circle of leaders ends
                self._travelled[index] = speed * DT * np.arange(1, STEPS + 1)
                route, front = routes[0], 0.5 * agent.length
                one = middle(speed, route.limit, self.lines.next_stop(route, front, speed))
                course = Course(route, one, self.leader_motion(index, route, depth)[1], route.begin)
                (rolled,) = roll([course], speed, STEPS, front)
                self._travelled[index] = rolled[0, :, 0] - route.begin
            else:
                time = DT * np.arange(1, STEPS + 1)
                fading = np.maximum(speed + min(accel, 0.0) * np.minimum(time, 1.0), 0.0)
                self._travelled[index] = np.cumsum(fading) * DT
        return self._travelled[index]
