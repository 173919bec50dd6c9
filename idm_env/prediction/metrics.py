"""Metrics of motion prediction as the Waymo Open Motion Dataset defines them (Ettinger et al. 2021, section 5).

Predictions and truth are compared at 2 Hz. At a horizon T: minADE is the smallest mean distance up to T over the
futures of an agent, minFDE the smallest distance at T; an agent is missed where no future ends within a box around
the truth, along its heading and across it, whose size grows with T and with the initial speed. mAP is the mean over
shapes of trajectories of the area under the interpolated precision-recall curve, where a future that hits is a true
positive, only one per agent, and all others are false positives. Of the eight shapes right turns and right U-turns are
one, and among equal confidences false positives come first, as in the benchmark's own code (``motion_metrics.cc``).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

HORIZONS = (3, 5, 8)
MISS_M = {3: (1.0, 2.0), 5: (1.8, 3.6), 8: (3.0, 6.0)}
"""Horizon (s) → lateral and longitudinal bound (m) at 11 m/s and above."""
SLOW, FAST = 1.4, 11.0
"""Speeds (m/s) between which the bounds grow from half to full."""
RATE, PER_SECOND = 10, 2
MEASURES = ("minADE", "minFDE", "miss_rate", "mAP")
DRAWS = 200
"""Of the bootstrap."""
ENOUGH_SCENES = 10
"""From so many scenes on, intervals draw whole scenes."""
SHAPES = ("stationary", "straight", "straight left", "straight right", "left", "left U-turn", "right", "right U-turn")


@dataclass(frozen=True, eq=False)
class Case:
    """One agent: futures [F, S, 2] with confidences [F], truth [S, 2], headings [S] and validity [S] at 10 Hz.

    ``speed`` (m/s) is that of the present; ``shape`` one of ``SHAPES``; ``kind`` the type of the agent.
    """

    futures: np.ndarray
    confidence: np.ndarray
    truth: np.ndarray
    heading: np.ndarray
    valid: np.ndarray
    speed: float
    shape: str
    kind: str


def speed_scale(speed: float) -> float:
    """Return ½ up to 1.4 m/s, 1 from 11 m/s on, and the straight line between."""
    return float(np.clip(0.5 + 0.5 * (speed - SLOW) / (FAST - SLOW), 0.5, 1.0))


def at_two_hertz(seconds: int) -> np.ndarray:
    """Return the indices, at 10 Hz from the first future step on, of the samples up to ``seconds``."""
    return np.arange(1, seconds * PER_SECOND + 1) * (RATE // PER_SECOND) - 1


def displacement(case: Case, seconds: int) -> tuple[np.ndarray, np.ndarray]:
    """Return mean distance up to a horizon and distance at it, of every future [F] (m); NaN where no truth is."""
    steps = at_two_hertz(seconds)
    steps = steps[steps < len(case.truth)]
    distance = np.linalg.norm(case.futures[:, steps] - case.truth[steps], axis=-1)
    valid = case.valid[steps]
    count = len(case.futures)
    mean = distance[:, valid].mean(1) if valid.any() else np.full(count, np.nan)
    return mean, distance[:, -1] if len(steps) == seconds * PER_SECOND and valid[-1] else np.full(count, np.nan)


def hits(case: Case, seconds: int) -> np.ndarray | None:
    """Return which futures end within the box around the truth [F]; None where there is no truth at the horizon."""
    step = seconds * 10 - 1
    if step >= len(case.truth) or not case.valid[step]:
        return None
    apart = case.futures[:, step] - case.truth[step]
    c, s = np.cos(case.heading[step]), np.sin(case.heading[step])
    along, across = apart @ np.array([c, s]), apart @ np.array([-s, c])
    lateral, longitudinal = (bound * speed_scale(case.speed) for bound in MISS_M[seconds])
    return np.asarray((np.abs(across) <= lateral) & (np.abs(along) <= longitudinal))


def shape_of(position: np.ndarray, heading: np.ndarray, speed: np.ndarray, valid: np.ndarray) -> str:
    """Return the shape of a true trajectory from its present (index 0) to its last valid step."""
    steps = np.flatnonzero(valid)
    if len(steps) == 0 or steps[-1] == 0:
        return "stationary"
    last = steps[-1]
    apart = position[last] - position[0]
    turn = float((heading[last] - heading[0] + np.pi) % (2 * np.pi) - np.pi)
    c, s = np.cos(heading[0]), np.sin(heading[0])
    ahead, left = float(apart @ np.array([c, s])), float(apart @ np.array([-s, c]))
    if max(speed[0], speed[last]) < 2.0 and np.hypot(ahead, left) < 5.0:
        return "stationary"
    if abs(turn) < np.pi / 6:
        if abs(left) < 5.0:
            return "straight"
        return "straight right" if left < 0 else "straight left"
    if turn < -np.pi / 6 and left < 0:
        return "right U-turn" if ahead < -5.0 else "right"
    return "left U-turn" if ahead < -5.0 else "left"


@dataclass(frozen=True)
class Score:
    """Score of a case: per horizon minADE and minFDE (m, None without truth) and which futures hit (or None)."""

    kind: str
    shape: str
    confidence: list[float]
    ade: list[float | None]
    fde: list[float | None]
    hit: list[list[bool] | None]


def score(case: Case) -> Score:
    """Return the score of one case."""
    both = [displacement(case, seconds) for seconds in HORIZONS]
    best = [[float(x.min()) if np.isfinite(x).any() else None for x in column] for column in zip(*both, strict=True)]
    reached = [hits(case, seconds) for seconds in HORIZONS]
    by_horizon = [None if hit is None else [bool(x) for x in hit] for hit in reached]
    return Score(case.kind, case.shape, [float(x) for x in case.confidence], best[0], best[1], by_horizon)


def summary(scores: Sequence[Score]) -> dict[str, float | int]:
    """Return agents and, per horizon, minADE and minFDE (m), miss rate and mAP; NaN where there is no truth."""
    measures = {name: float(values[0]) for name, values in _measures(scores, np.ones((1, len(scores)))).items()}
    for name in MEASURES:
        horizons = [measures[f"{name}_{seconds}s"] for seconds in HORIZONS]
        measures[name] = float(_means(horizons, np.ones((1, len(HORIZONS))))[0])
    return {"agents": len(scores), **measures}


def intervals(scores: Sequence[Score], scenes: Sequence[str]) -> dict[str, tuple[float, float]]:
    """Return 95 % bootstrap intervals of the measures of ``summary`` at each horizon, by name such as ``minADE_8s``.

    Whole scenes are drawn where there are at least ``ENOUGH_SCENES``, since agents of a scene are alike, else agents.
    NaN where there is no truth, or a single agent.
    """
    names = np.unique(np.asarray(scenes), return_inverse=True)[1] if len(scenes) else np.zeros(0, int)
    unit = names if len(np.unique(names)) >= ENOUGH_SCENES else np.arange(len(scores))
    count = len(np.unique(unit))
    generator = np.random.default_rng(0)
    counts = [np.bincount(generator.integers(count, size=count), minlength=count) for _ in range(DRAWS)]
    weights = np.stack(counts)[:, unit].astype(float) if count > 1 else np.zeros((0, len(scores)))
    return {name: _interval(values) for name, values in _measures(scores, weights).items()}


def _measures(scores: Sequence[Score], weights: np.ndarray) -> dict[str, np.ndarray]:
    """Return every measure at every horizon under every row of weights [draws, agents]."""
    shapes = [item.shape.replace("right U-turn", "right") for item in scores]
    measures = dict[str, np.ndarray]()
    for i, seconds in enumerate(HORIZONS):
        missed = [None if (h := item.hit[i]) is None else float(not any(h)) for item in scores]
        columns = [item.ade[i] for item in scores], [item.fde[i] for item in scores], missed
        by_shape = []
        for shape in sorted(set(shapes)):
            own = [n for n, other in enumerate(shapes) if other == shape]
            by_shape.append(average_precision([scores[n] for n in own], seconds, weights[:, own]))
        precisions = np.ma.masked_invalid(np.reshape(by_shape, (len(by_shape), len(weights))))
        values = [*(_means(column, weights) for column in columns), precisions.mean(0).filled(np.nan)]
        measures |= {f"{name}_{seconds}s": value for name, value in zip(MEASURES, values, strict=True)}
    return measures


def average_precision(scores: Sequence[Score], seconds: int, weights: np.ndarray) -> np.ndarray:
    """Return the area under the interpolated precision-recall curve under every row of weights [draws, agents].

    NaN where no agent with truth has a weight.
    """
    agents, confidence, correct = list[int](), list[float](), list[bool]()
    for n, item in enumerate(scores):
        hit = item.hit[HORIZONS.index(seconds)] or []
        # of several futures that hit, only the most confident is a true positive
        first = next((i for i in np.argsort(-np.array(item.confidence), kind="stable") if hit and hit[i]), None)
        agents += [n] * len(hit)
        confidence += item.confidence[: len(hit)]
        correct += [i == first for i in range(len(hit))]
    order = np.lexsort((np.array(correct), -np.array(confidence)))
    index, true = np.array(agents, int)[order], np.array(correct, bool)[order]
    areas = np.full(len(weights), np.nan)
    for draw, weight in enumerate(weights):
        every, total = weight[index], weight[np.unique(index)].sum()
        if total > 0:
            hits, futures = np.cumsum(every * true), np.cumsum(every)
            precision = np.divide(hits, futures, out=np.zeros_like(hits), where=futures > 0)
            best = np.maximum.accumulate(precision[::-1])[::-1]
            areas[draw] = np.sum(np.diff(np.concatenate([[0.0], hits / total])) * best)
    return areas


def _means(values: Sequence[float | None], weights: np.ndarray) -> np.ndarray:
    """Return the mean of known values under every row of weights [draws, agents]."""
    numbers = np.array([np.nan if v is None else v for v in values], float)
    finite = np.isfinite(numbers)
    total = weights[:, finite].sum(1)
    return np.divide(weights[:, finite] @ numbers[finite], total, out=np.full(len(weights), np.nan), where=total > 0)


def _interval(values: np.ndarray) -> tuple[float, float]:
    finite = values[np.isfinite(values)]
    if len(finite) < 2:
        return float("nan"), float("nan")
    low, high = np.percentile(finite, [2.5, 97.5])
    return float(low), float(high)
