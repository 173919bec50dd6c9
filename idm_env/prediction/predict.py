"""Futures of the agents of a scenario: several by fitted drivers on routes, and single ones to compare them with."""

from dataclasses import dataclass, field

import numpy as np

from idm_env.effects import IDM
from idm_env.prediction.drivers import Second, posterior
from idm_env.prediction.free import constant_velocity, free_futures, kept_velocity
from idm_env.prediction.lanes import Route
from idm_env.prediction.mixture import SHARES, Shares, share_of
from idm_env.prediction.rollout import DT, Course, RouteDrivers, RouteLeader, roll
from idm_env.prediction.scene import STEPS, MapScene
from idm_env.prediction.select import select
from idm_env.trajectories import paper

LATERAL_S = 4.0
"""Time in which a vehicle returns to the middle of its lane (s)."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """Futures [F, S, 2] at 10 Hz with confidences [F] of one agent, and their source: ``lane``, ``free`` or a baseline.

    ``parameters`` holds mean and deviation of each of IDM's five after the last second, where a lane tells them.
    """

    agent: int
    futures: np.ndarray
    confidence: np.ndarray
    source: str
    parameters: dict[str, tuple[float, float]] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Mixture:
    """An agent's futures [N, S, 2] and weights [N] of every way, in the order of ``mixture.WAYS``.

    Without lanes the last way is empty. ``parameters`` as in ``Prediction``.
    """

    agent: int
    futures: tuple[np.ndarray, ...]
    weights: tuple[np.ndarray, ...]
    parameters: dict[str, tuple[float, float]]


def mixture(scene: MapScene, index: int) -> Mixture:
    """Return the futures of an agent by all ways. ValueError if it is not valid at the present.

    Everybody may keep the velocity (``kept_velocity``) or the motion, loosely (``free_futures``: driveways, parking,
    what the map lacks). On lanes, the drivers of every route are fitted to the last second (``drivers.posterior``) and
    rolled out.
    """
    agent = scene.valid(index)
    futures = [kept_velocity(agent, scene.present, STEPS), free_futures(agent, scene.present, STEPS)]
    weights = [np.full(len(one), 1.0 / len(one)) for one in futures]
    routes = scene.routes(agent)
    if not routes:
        return Mixture(index, (*futures, np.empty((0, STEPS, 2))), (*weights, np.empty(0)), {})
    around = [scene.leader_motion(index, route) for route in routes]
    seconds = [scene.second(agent, route, past) for route, (past, _) in zip(routes, around, strict=True)]
    drivers = posterior(seconds)
    courses = [
        Course(route, one, future, route.begin)
        for route, (_, future), (one, _) in zip(routes, around, drivers, strict=True)
    ]
    rolled = roll(courses, scene.speed(agent), STEPS, 0.5 * agent.length)
    mass = np.concatenate([route.weight * weight for route, (_, weight) in zip(routes, drivers, strict=True)])
    futures.append(np.concatenate([lifted(route, part[0].T) for route, part in zip(routes, rolled, strict=True)]))
    weights.append(mass / mass.sum())
    parameters = {p.name: _moments(p.name, [one for one, _ in drivers], weights[-1]) for p in IDM.declared}
    return Mixture(index, tuple(futures), tuple(weights), parameters)


def choose_futures(scene: MapScene, ways: Mixture, shares: Shares = SHARES) -> Prediction:
    """Return up to six futures of an agent's mixture, and their confidences, with these shares of the ways.

    Constant velocity is always one of them, so that no agent is predicted worse than by it.
    """
    agent = scene.valid(ways.agent)
    speed, on_lane = scene.speed(agent), len(ways.weights[-1]) > 0
    share = share_of(shares, agent.kind, speed, on_lane)
    weight = np.concatenate([part * one for part, one in zip(share, ways.weights, strict=True)])
    futures, confidence = select(np.concatenate(ways.futures), weight, speed)
    return Prediction(ways.agent, futures, confidence, "lane" if on_lane else "free", ways.parameters)


def predict(scene: MapScene, index: int) -> Prediction:
    """Return up to six futures of an agent. ValueError if it is not valid at the present."""
    return choose_futures(scene, mixture(scene, index))


def _moments(name: str, drivers: list[RouteDrivers], shares: np.ndarray) -> tuple[float, float]:
    """Return mean and deviation of one parameter over weighted drivers."""
    values = getattr(RouteDrivers.joined(drivers), name)
    mean = float((shares * values).sum())
    return mean, float(np.sqrt((shares * (values - mean) ** 2).sum()))


def lifted(route: Route, along: np.ndarray) -> np.ndarray:
    """Return the points [N, S, 2] of arc lengths [N, S], with the lateral distance fading."""
    time = DT * np.arange(1, along.shape[1] + 1)
    return route.lift(along, np.broadcast_to(route.lateral * np.exp(-time / LATERAL_S), along.shape))


def straight_on(scene: MapScene, index: int) -> Prediction:
    """Return the one future at constant velocity."""
    agent = scene.valid(index)
    return Prediction(index, constant_velocity(agent, scene.present, STEPS), np.ones(1), "constant velocity")


def along_lane(scene: MapScene, index: int) -> Prediction:
    """Return the one future at constant speed along the likeliest route; constant velocity off the lanes."""
    agent = scene.valid(index)
    routes = scene.routes(agent)
    if not routes:
        return straight_on(scene, index)
    along = routes[0].begin + scene.speed(agent) * DT * np.arange(1, STEPS + 1)
    return Prediction(index, lifted(routes[0], along[None]), np.ones(1), "lane, constant speed")


def as_published(scene: MapScene, index: int) -> Prediction:
    """Return the paper's one future: five IDM values by its recipe from one second, on the current lane, straight on.

    ``trajectories.paper`` optimises and drives, behind the real leader, which drives by its own fit; stop lines,
    branches and bends are not looked at. Constant velocity off the lanes.
    """
    routes = scene.routes(scene.valid(index))
    if not routes:
        return straight_on(scene, index)
    along = routes[0].begin + published_distance(scene, index, {})
    return Prediction(index, lifted(routes[0], along[None]), np.ones(1), "the paper's recipe")


def published_distance(scene: MapScene, index: int, cache: dict[int, np.ndarray]) -> np.ndarray:
    """Return how far an agent goes by the paper's recipe at every step [S] (m); ``cache`` holds those worked out."""
    if index in cache:
        return cache[index]
    agent = scene.scenario.agents[index]
    speed = scene.speed(agent)
    # entered first: who is not on a lane, and who closes a circle of leaders, goes on at this speed
    cache[index] = speed * DT * np.arange(1, STEPS + 1)
    _fit_as_published(scene, index)
    if (driver := scene.published[index]) is None:
        return cache[index]
    second, future, values = driver
    leader = scene.leader(index, second.route)
    if leader is not None:
        gone = np.concatenate([[0.0], published_distance(scene, leader[0], cache)])
        future = RouteLeader(second.ahead.rear[-1] + gone, np.gradient(gone, DT))
    begin = second.route.begin + second.front
    cache[index] = paper.drive(values, speed, future.rear - begin, future.speed, DT)[1:]
    return cache[index]


def _fit_as_published(scene: MapScene, index: int) -> None:
    """Fit an agent, all that are to be predicted, and their leaders, together: what is done once for a scene."""
    waiting = [] if index in scene.published else [index, *scene.scenario.to_predict]
    seconds: dict[int, tuple[Second, RouteLeader]] = {}
    for each in waiting:
        agent = scene.scenario.agents[each]
        if each in scene.published or each in seconds or not agent.valid[scene.present]:
            continue
        scene.published[each] = None
        for route in scene.routes(agent)[:1]:
            past, future = scene.leader_motion(each, route)
            seconds[each] = scene.second(agent, route, past), future
            leader = scene.leader(each, route)
            waiting += [] if leader is None else [leader[0]]
    followed = [
        paper.Followed(
            second.route.begin + second.front - second.distance_to_present,
            float(second.speeds[0]), second.ahead.rear, second.ahead.speed,
        )
        for second, _ in seconds.values()
    ]  # fmt: skip
    for each, values in zip(seconds, paper.follow(followed, DT) if followed else (), strict=True):
        scene.published[each] = (*seconds[each], values)


METHODS = {
    "drivers on routes": predict,
    "constant velocity": straight_on,
    "lane, constant speed": along_lane,
    "the paper's recipe": as_published,
}
"""Name → function of a scene and an agent's index."""
