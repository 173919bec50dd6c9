"""Futures of the agents of a scenario: several by drivers on routes, and the single ones to compare them with."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from idm_env.data.womd import Agent, Scenario
from idm_env.effects import IDM
from idm_env.prediction import drivers as behaviour
from idm_env.prediction.drivers import DT, Ahead, Drivers, nobody
from idm_env.prediction.free import constant_velocity, free_futures, motion_now
from idm_env.prediction.lanes import LaneGraph, Route, turn
from idm_env.prediction.select import select

SECONDS = 8
STEPS = SECONDS * 10
OFF_LANE = 0.1
"""Share of the futures of a vehicle on a lane that leave the lanes: driveways, parking, what the map lacks."""
LATERAL_S = 4.0
"""Time in which a vehicle returns to the middle of its lane (s)."""
STANDING_MPS = 0.5
"""Slower vehicles stand (m/s)."""
LEAST_ROUTE = 0.02
"""Routes that are less plausible than this share of the best are not followed."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """Futures [F, S, 2] at 10 Hz with confidences [F] of one agent, and by what: ``lane``, ``free`` or a baseline.

    ``parameters`` holds mean and deviation of each of IDM's five after the last second, where a lane tells them.
    """

    agent: int
    futures: np.ndarray
    confidence: np.ndarray
    source: str
    parameters: dict[str, tuple[float, float]] = field(default_factory=dict)


class Scene:
    """A scenario with its lane graph, and the motions of leaders once they have been worked out."""

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        self.present = scenario.present
        self._travelled: dict[int, np.ndarray] = {}

    @cached_property
    def graph(self) -> LaneGraph:
        """The lanes."""
        return LaneGraph(self.scenario.lanes)

    def routes(self, agent: Agent) -> list[Route]:
        """Return the routes of an agent that travels on lanes; none for pedestrians."""
        if agent.kind not in ("vehicle", "cyclist"):
            return []
        speed = float(np.hypot(*agent.velocity[self.present]))
        reach = max(40.0, SECONDS * speed + 0.5 * 1.5 * SECONDS**2)
        heading = float(agent.heading[self.present])
        bike = agent.kind == "cyclist"
        found = self.graph.routes(agent.position[self.present], heading, reach, bike=bike)
        return [route for route in found if route.weight >= LEAST_ROUTE * found[0].weight]

    def leader(self, index: int, route: Route) -> tuple[int, float, float] | None:
        """Return who is next ahead on a route, arc length and lateral distance of its centre (m), or None.

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
            beside = along - route.begin < 0.5 * (me.length + agent.length)
            apart_across = abs(lateral) > 0.5 * (me.width + agent.width)
            crosses = agent.kind != "pedestrian" and off > np.pi / 3
            if beside or apart_across or crosses:
                continue
            if best is None or along < best[1]:
                best = other, along, lateral
        return best

    def ahead(self, index: int, route: Route, depth: int = 0) -> tuple[Ahead, Ahead]:
        """Return the vehicle ahead over the last second and over the future, by its own predicted motion."""
        found = self.leader(index, route)
        if found is None:
            return nobody(self.present), nobody(STEPS)
        other, along, lateral = found
        agent = self.scenario.agents[other]
        rear = along - 0.5 * agent.length
        travelled = self.travelled(other, depth + 1)
        speed = np.gradient(np.concatenate([[0.0], travelled]), DT)
        past = self.speeds(agent)
        back = np.concatenate([np.cumsum(past[::-1])[::-1][1:] * DT, [0.0]])
        share = behaviour.passing(lateral) if past[-1] < STANDING_MPS else 0.0
        future = Ahead(rear + np.concatenate([[0.0], travelled]), np.maximum(speed, 0.0), share)
        return Ahead(rear - back, past, share), future

    def speeds(self, agent: Agent) -> np.ndarray:
        """Return speeds from the first step to the present; what is not valid takes the nearest that is."""
        speed = np.hypot(*agent.velocity[: self.present + 1].T)
        known = np.flatnonzero(agent.valid[: self.present + 1])
        return np.asarray(np.interp(np.arange(self.present + 1), known, speed[known]))

    def travelled(self, index: int, depth: int) -> np.ndarray:
        """Return how far an agent will have gone at every step [S] (m): the middle driver on its likeliest route."""
        if index not in self._travelled:
            agent = self.scenario.agents[index]
            speed, _, accel, _ = motion_now(agent, self.present)
            routes = self.routes(agent) if depth < 4 else []
            if routes and speed > 0.3:
                # entered first, so that a circle of leaders ends
                self._travelled[index] = speed * DT * np.arange(1, STEPS + 1)
                future = self.ahead(index, routes[0], depth)[1]
                one = _middle(speed, routes[0].limit)
                rolled = behaviour.roll(routes[0], one, routes[0].begin, speed, future, STEPS, 0.5 * agent.length)
                self._travelled[index] = rolled[0, :, 0].numpy() - routes[0].begin
            else:
                time = DT * np.arange(1, STEPS + 1)
                fading = np.maximum(speed + min(accel, 0.0) * np.minimum(time, 1.0), 0.0)
                self._travelled[index] = np.cumsum(fading) * DT
        return self._travelled[index]


def _middle(speed: float, limit: float) -> Drivers:
    """Return the one driver of the prior's medians who keeps about his speed."""
    one = np.ones(1)
    known = limit if np.isfinite(limit) else behaviour.URBAN_LIMIT
    wanted = 0.5 * (max(speed, 1.0) + known)
    return Drivers(1.6 * one, 2.0 * one, 1.3 * one, 2.0 * one, wanted * one, 2.5 * one, np.inf * one, 0.5 * one)


def predict(scene: Scene, index: int) -> Prediction:
    """Return up to six futures of an agent. ValueError if it is not valid at the present."""
    agent = _valid(scene, index)
    speed = float(np.hypot(*agent.velocity[scene.present]))
    loose = free_futures(agent, scene.present, STEPS)
    samples, weights = [loose], [np.full(len(loose), 1.0 / len(loose))]
    routes = scene.routes(agent)
    parameters: dict[str, tuple[float, float]] = {}
    if routes:
        weights[0] = weights[0] * OFF_LANE
        on_lane = [_on_route(scene, index, route) for route in routes]
        evidence = sum(float(weight.sum()) for _, weight, _ in on_lane)
        samples += [futures for futures, _, _ in on_lane]
        weights += [weight / evidence * (1.0 - OFF_LANE) for _, weight, _ in on_lane]
        drawn = [(one, weight / evidence) for _, weight, one in on_lane]
        parameters = {p.name: _moments(p.name, drawn) for p in IDM.declared}
    futures, confidence = select(np.concatenate(samples), np.concatenate(weights), speed)
    return Prediction(index, futures, confidence, "lane" if routes else "free", parameters)


def _moments(name: str, drawn: list[tuple[Drivers, np.ndarray]]) -> tuple[float, float]:
    """Return mean and deviation of one parameter over weighted drivers."""
    values = np.concatenate([getattr(one, name) for one, _ in drawn])
    weight = np.concatenate([weight for _, weight in drawn])
    mean = float((weight * values).sum())
    return mean, float(np.sqrt((weight * (values - mean) ** 2).sum()))


def _valid(scene: Scene, index: int) -> Agent:
    agent = scene.scenario.agents[index]
    if not agent.valid[scene.present]:
        raise ValueError(f"agent {agent.id} is not valid at the present step, so there is nothing to predict it from.")
    return agent


def _on_route(scene: Scene, index: int, route: Route) -> tuple[np.ndarray, np.ndarray, Drivers]:
    """Return futures [N, S, 2] of the prior's drivers on a route, their weights by the last second, and the drivers."""
    agent = scene.scenario.agents[index]
    speed = float(np.hypot(*agent.velocity[scene.present]))
    drawn = behaviour.prior(speed, route.limit)
    past, future = scene.ahead(index, route)
    score = _score(scene, agent, route, drawn, past)
    rolled = behaviour.roll(route, drawn, route.begin, speed, future, STEPS, 0.5 * agent.length).numpy()
    weight = route.weight * np.exp(score) / len(score)
    return _lifted(route, rolled[0].T), weight + 1e-300, drawn


def _lifted(route: Route, along: np.ndarray) -> np.ndarray:
    """Return the points [N, S, 2] of arc lengths [N, S], with the lateral distance fading."""
    time = DT * np.arange(1, along.shape[1] + 1)
    return route.lift(along, np.broadcast_to(route.lateral * np.exp(-time / LATERAL_S), along.shape))


def _score(scene: Scene, agent: Agent, route: Route, drawn: Drivers, past: Ahead) -> np.ndarray:
    """Return the log-likelihood of each driver for the last second; 0 where fewer than four steps are known."""
    known = np.flatnonzero(agent.valid[: scene.present + 1])
    known = known[known >= scene.present - 10]
    if len(known) < 4:
        return np.zeros(len(drawn.stop))
    first = int(known[0])
    speeds = scene.speeds(agent)
    gone = float(speeds[first:-1].sum() * DT)
    earlier = replace(drawn, stop=drawn.stop + gone)
    span = Ahead(past.rear[first:], past.speed[first:], past.passed)
    steps = scene.present - first
    rolled = behaviour.roll(route, earlier, route.begin - gone, float(speeds[first]), span, steps, 0.5 * agent.length)
    valid = agent.valid[first + 1 : scene.present + 1]
    return behaviour.likelihood(rolled[1].numpy(), speeds[first + 1 :], valid)


# -- what it is compared with ------------------------------------------------------------------------------------------


def straight_on(scene: Scene, index: int) -> Prediction:
    """Return the one future at constant velocity."""
    agent = _valid(scene, index)
    return Prediction(index, constant_velocity(agent, scene.present, STEPS), np.ones(1), "constant velocity")


def along_lane(scene: Scene, index: int) -> Prediction:
    """Return the one future at constant speed along the likeliest route; constant velocity off the lanes."""
    agent = _valid(scene, index)
    routes = scene.routes(agent)
    if not routes:
        return straight_on(scene, index)
    speed = float(np.hypot(*agent.velocity[scene.present]))
    along = routes[0].begin + speed * DT * np.arange(1, STEPS + 1)
    return Prediction(index, _lifted(routes[0], along[None]), np.ones(1), "lane, constant speed")


def as_published(scene: Scene, index: int) -> Prediction:
    """Return the paper's one future: IDM fitted to one second, on the current lane, straight on.

    The five parameters are those, of a wide search within the paper's bounds, that drive the last second best; the
    leader goes on at its present speed. Constant velocity off the lanes.
    """
    agent = _valid(scene, index)
    routes = scene.routes(agent)
    if not routes:
        return straight_on(scene, index)
    route = routes[0]
    speed = float(np.hypot(*agent.velocity[scene.present]))
    drawn = _published()
    past, _ = scene.ahead(index, route)
    score = _score(scene, agent, route, drawn, past)
    constant = Ahead(past.rear[-1] + past.speed[-1] * DT * np.arange(STEPS + 1), np.full(STEPS + 1, past.speed[-1]))
    best = int(np.argmax(score))
    one = Drivers(*(getattr(drawn, name)[best : best + 1] for name in Drivers.__dataclass_fields__))
    rolled = behaviour.roll(route, one, route.begin, speed, constant, STEPS, 0.5 * agent.length).numpy()
    return Prediction(index, _lifted(route, rolled[0].T), np.ones(1), "the paper's recipe")


def _published() -> Drivers:
    """Return drivers spread over the paper's bounds of the five, without bends and without stops."""
    u = behaviour._quantiles()
    low, high = np.array([5.0, 0.1, 0.1, 1.0, 20.0]), np.array([10.0, 5.0, 5.0, 10.0, 60.0])
    a, b, time_gap, min_gap, v0 = (low + (high - low) * u[:, :5]).T
    return Drivers(a, b, time_gap, min_gap, v0, np.full(len(u), 1e6), np.full(len(u), np.inf), np.ones(len(u)))


METHODS = {
    "drivers on routes": predict,
    "constant velocity": straight_on,
    "lane, constant speed": along_lane,
    "the paper's recipe": as_published,
}
"""Name → function of a scene and an agent's index."""
