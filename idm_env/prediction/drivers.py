"""Drivers on a route: hypotheses of their intentions, each fitted to the last second by the project's ``fit``.

One second barely identifies five parameters. So each hypothesis (goes for the limit, keeps the speed, stops somewhere,
stays) brings a log-normal prior of urban driving; ``fit`` behind the real leader finds the posterior's mode and
covariance, from which drivers are drawn, and the evidence of the second tells how likely the hypothesis is. What the
second does not tell stays as spread in the futures.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.stats import norm

from idm_env.data import Episode, VehicleRecord as Recorded
from idm_env.fitting.fit import fit
from idm_env.fitting.prior import Prior
from idm_env.fitting.solver import normal
from idm_env.prediction.free import quantiles
from idm_env.prediction.lanes import Route
from idm_env.prediction.mixture import STANDING_MPS
from idm_env.prediction.rollout import DT, RouteDrivers, RouteLeader, bend_speed
from idm_env.prediction.stops import Stop

URBAN_LIMIT = 13.4
"""Speed limit where the map tells none (m/s): 30 miles per hour."""
CENTRE = {"max_accel": 1.6, "comfort_decel": 2.0, "time_gap": 1.3, "min_gap": 2.0}
DEVIATION = {"max_accel": 0.4, "comfort_decel": 0.3, "time_gap": 0.3, "min_gap": 0.3}
"""Medians (SI) and log-deviations of urban drivers; the desired speed's are those of the hypothesis."""
LATERAL_MPS2, LATERAL_DEVIATION = 2.5, 0.4
"""Lateral acceleration that is accepted in bends: median (m/s²) and log-deviation."""
SURPRISE = 0.25
"""Share of drivers who are about to stop for something that is not on the map (a crossing, a turn, a parking space)."""
CRUISING = 0.25
"""Share of drivers who already go at the speed that they want."""
STAYING = 0.4
"""Share of standing vehicles on a lane that stay for the time being: parked, loading, waiting."""
OBEYING = {"sign": 0.8, "red": 0.9}
"""Share of drivers who stop at a stop line that the map or a signal tells."""
WAIT_S, WAIT_DEVIATION = 1.0, 0.8
"""Time at a stop sign from the halt on: median (s) and log-deviation."""
LONGEST_RED_S = 16.0
"""A red light ends at some time up to this from now (s)."""
SPEED_SIGMA = 0.4
"""How far an observed speed may be from a driver's (m/s): tracking noise, and driving that IDM does not have."""
INDEPENDENT = 2.0
"""One second of correlated residuals is worth this many independent ones."""
SURPRISES = 8
DRAWS = {"limit": 48, "cruise": 24, "surprise": 4, "line": 32, "stays": 8}
"""Drivers drawn of each hypothesis."""
NAMES = (*CENTRE, "desired_speed")


@dataclass(frozen=True)
class DriverHypothesis:
    """A hypothesis of a driver's intention: its prior share, the speed wanted, and where it stops.

    ``speed`` and ``deviation`` are median (m/s) and log-deviation of the speed wanted here and now; ``bend`` tells that
    it is a bend's and says nothing of the speed wanted behind it. ``stop`` is a distance from the front bumper (m).
    """

    kind: str
    share: float
    speed: float
    deviation: float
    bend: bool
    stop: float = np.inf


@dataclass(frozen=True, eq=False)
class Second:
    """The last second of an agent on one of its routes: speeds [T] (m/s), what was ahead, and the distance driven.

    ``ahead`` is on the same T samples, relative to the route's arc length. ``stop`` is the stop line ahead.
    """

    route: Route
    speeds: np.ndarray
    ahead: RouteLeader
    front: float
    stop: Stop | None

    @property
    def distance_to_present(self) -> np.ndarray:
        """Distance to the present at every sample (m), falling to 0."""
        mean = 0.5 * (self.speeds[1:] + self.speeds[:-1]) * DT
        return np.asarray(np.concatenate([np.cumsum(mean[::-1])[::-1], [0.0]]))


def hypotheses(second: Second) -> list[DriverHypothesis]:
    """Return the hypotheses of a driver on this route; their shares sum to 1."""
    route, speed = second.route, float(second.speeds[-1])
    limit = route.limit if np.isfinite(route.limit) else URBAN_LIMIT
    bends = bend_speed(route, np.array([LATERAL_MPS2]), np.array([CENTRE["comfort_decel"]]))[0]
    bend = float(np.interp(route.begin, route.length, bends))
    obeying = OBEYING[second.stop.kind] if second.stop is not None else 0.0
    staying = STAYING * (1.0 - obeying) if speed < STANDING_MPS else 0.0
    rest = 1.0 - obeying - staying
    here = (bend, 0.25, True) if bend < limit else (limit, 0.2, False)
    cases = [
        DriverHypothesis("limit", rest * (1.0 - CRUISING - SURPRISE), *here),
        DriverHypothesis("cruise", rest * CRUISING, max(speed, 0.5), 0.07, False),
    ]
    nearest = speed * speed / (2 * 3.5) + 2.0
    reach = max(60.0 - nearest, 10.0)
    for k in range(SURPRISES):
        stop = nearest + (k + 0.5) / SURPRISES * reach
        cases.append(DriverHypothesis("surprise", rest * SURPRISE / SURPRISES, *here, stop=stop))
    if staying:
        cases.append(DriverHypothesis("stays", staying, *here, stop=CENTRE["min_gap"]))
    if second.stop is not None:
        # who halts at a line has its front there, so that the leader stands the smallest gap beyond it
        cases.append(DriverHypothesis("line", obeying, *here, stop=second.stop.distance + CENTRE["min_gap"]))
    return cases


def posterior(seconds: Sequence[Second]) -> list[tuple[RouteDrivers, np.ndarray]]:
    """Return, for every route, N drivers drawn around the fits of its hypotheses, and their weights [N].

    Weights are share × evidence / number drawn, with the evidence by Laplace's method: what the mode costs, and how
    much narrower than the prior the posterior is.
    """
    cases = [(second, h) for second in seconds for h in hypotheses(second)]
    log_mode, spread, evidence = _fitted(cases)
    evidence = evidence - evidence.max()
    draws: list[tuple[RouteDrivers, np.ndarray]] = []
    for second in seconds:
        parts = [_draw(h, second, log_mode[i], spread[i], evidence[i]) for i, (s, h) in enumerate(cases) if s is second]
        draws.append((RouteDrivers.joined([one for one, _ in parts]), np.concatenate([weight for _, weight in parts])))
    return draws


def _fitted(cases: Sequence[tuple[Second, DriverHypothesis]]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return log-modes [G, 5], factors L of their covariances L Lᵀ [G, 5, 5], and log-evidences [G] of all cases."""
    centre = torch.tensor([[*CENTRE.values(), h.speed] for _, h in cases], dtype=torch.float64)
    deviation = torch.tensor([[*DEVIATION.values(), h.deviation] for _, h in cases], dtype=torch.float64)
    samples = len(cases[0][0].speeds) - 1
    if samples < 3:
        # too short to tell anything: the prior itself
        return centre.log().numpy(), torch.diag_embed(deviation).numpy(), np.zeros(len(cases))
    noise = SPEED_SIGMA * np.sqrt(samples / INDEPENDENT)
    episodes = [_episode(i, second, h) for i, (second, h) in enumerate(cases)]
    result = fit(
        episodes, objective="speed", loss="mse", prior=Prior(centre, deviation, noise), iterations=12, substeps=1
    )
    own = result.own
    covariance = result.uncertainty.covariance / (own[:, :, None] * own[:, None, :])
    factor = torch.linalg.cholesky(covariance + 1e-10 * torch.eye(len(NAMES), dtype=torch.float64))
    cost = normal(result.problem, own[None], result.shared[None]).cost[0]
    narrower = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1) - deviation.log().sum(-1)
    return own.log().numpy(), factor.numpy(), (-0.5 * cost / noise**2 + narrower).numpy()


def _episode(number: int, second: Second, h: DriverHypothesis) -> Episode:
    """Return the second as an episode behind the real leader, or behind the hypothesis' stop if that is nearer."""
    count = len(second.speeds)
    position = second.route.begin + second.front - second.distance_to_present
    stop = second.route.begin + second.front + h.stop
    nearer = stop < second.ahead.rear
    rear = np.minimum(second.ahead.rear, stop)
    # an overlap is taken as bumper to bumper
    rear = rear + max(0.2 - float((rear - position).min()), 0.0)
    pace, everywhere = np.where(nearer, 0.0, second.ahead.speed), np.ones(count, bool)
    leader = Recorded(rear, pace, np.zeros(count), 0.0, everywhere)
    nobody = Recorded(position + 1e3, second.speeds, np.zeros(count), 0.0, ~everywhere)
    name, own = str(number), (DT * np.arange(count), position, second.speeds, rear - position)
    around = leader, nobody, nobody, nobody
    return Episode("", name, "", name, DT, *own, 2 * second.front, *around, position, {}, {})


def _draw(
    h: DriverHypothesis, second: Second, log_mode: np.ndarray, factor: np.ndarray, evidence: float
) -> tuple[RouteDrivers, np.ndarray]:
    """Return drivers around one fit, and their weights."""
    count = DRAWS[h.kind]
    u = quantiles(count, 10, 0)
    values = np.exp(log_mode + norm.ppf(u[:, :5]) @ factor.T)
    desired, lateral = values[:, 4], LATERAL_MPS2 * np.exp(LATERAL_DEVIATION * norm.ppf(u[:, 5]))
    if h.bend:
        # the speed in the bend tells which lateral acceleration is accepted; the one wanted behind it is unknown
        limit = second.route.limit if np.isfinite(second.route.limit) else URBAN_LIMIT
        desired, lateral = limit * np.exp(0.2 * norm.ppf(u[:, 5])), LATERAL_MPS2 * (desired / h.speed) ** 2
    spread = (u[:, 6] - 0.5) * max(60.0 / SURPRISES, 1.0) if h.kind == "surprise" else 0.0
    wait, opens = np.full(count, np.inf), np.full(count, np.inf)
    if h.kind == "line" and second.stop is not None and second.stop.kind == "sign":
        wait = WAIT_S * np.exp(WAIT_DEVIATION * norm.ppf(u[:, 7]))
    elif h.kind == "line":
        opens = LONGEST_RED_S * u[:, 7]
    stop = np.maximum(np.full(count, h.stop) + spread, 0.5)
    a, b, time_gap, min_gap = np.maximum(values[:, :4].T, 0.05)
    drivers = RouteDrivers(a, b, time_gap, min_gap, desired, lateral, stop, wait, opens, u[:, 9])
    return drivers, np.full(count, h.share / count * np.exp(evidence))


def middle(speed: float, limit: float, stop: Stop | None) -> RouteDrivers:
    """Return the one driver of the prior's medians who keeps about his speed and stops where he must."""
    limit = limit if np.isfinite(limit) else URBAN_LIMIT
    halts = stop.distance + CENTRE["min_gap"] if stop is not None else np.inf
    wait = WAIT_S if stop is not None and stop.kind == "sign" else np.inf
    opens = 0.5 * LONGEST_RED_S if stop is not None and stop.kind == "red" else np.inf
    desired = 0.5 * (max(speed, 1.0) + limit)
    values = {**CENTRE, "desired_speed": desired, "lateral": LATERAL_MPS2, "stop": halts, "wait": wait, "opens": opens}
    return RouteDrivers(**{name: np.array([value]) for name, value in values.items()}, passing=np.array([0.5]))


def passing(lateral: float) -> float:
    """Return the share of drivers who go around a standing vehicle: 0.2 in the middle of the lane, 0.9 from 1.2 m on.

    Whether it waits or is parked is not known; the farther from the middle, the likelier it is parked.
    """
    return float(np.interp(abs(lateral), [0.4, 1.2], [0.2, 0.9]))
