"""The benchmark's metrics on cases that can be checked by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from idm_env.prediction.metrics import (
    SHAPES,
    Case,
    Score,
    at_two_hertz,
    average_precision,
    displacement,
    hits,
    intervals,
    score,
    shape_of,
    speed_scale,
    summary,
)

STEPS = 80
LINE = np.stack([np.linspace(1, 80, STEPS), np.zeros(STEPS)], axis=1)


def case(
    *shifts: tuple[float, float], confidence: list[float] | None = None, heading: float = 0.0, speed: float = 11.0
) -> Case:
    futures = np.stack([LINE + np.array(shift) for shift in shifts])
    weights = np.array(confidence) if confidence else np.full(len(shifts), 1 / len(shifts))
    return Case(futures, weights, LINE, np.full(STEPS, heading), np.ones(STEPS, bool), speed, "straight", "vehicle")


def test_samples_are_taken_at_two_hertz() -> None:
    assert at_two_hertz(3).tolist() == [4, 9, 14, 19, 24, 29]
    assert len(at_two_hertz(8)) == 16 and at_two_hertz(8)[-1] == 79


def test_distances_are_those_of_the_best_future() -> None:
    row = summary([score(case((3.0, 4.0), (0.0, 2.0)))])
    assert row["minADE_3s"] == row["minADE_8s"] == row["minFDE_5s"] == pytest.approx(2.0)


@pytest.mark.parametrize(("speed", "scale"), [(0.0, 0.5), (1.4, 0.5), (6.2, 0.75), (11.0, 1.0), (30.0, 1.0)])
def test_boxes_grow_with_the_speed(speed: float, scale: float) -> None:
    assert speed_scale(speed) == pytest.approx(scale)


@pytest.mark.parametrize(("seconds", "lateral", "longitudinal"), [(3, 1.0, 2.0), (5, 1.8, 3.6), (8, 3.0, 6.0)])
def test_a_hit_is_inside_the_box_along_the_true_heading(seconds: int, lateral: float, longitudinal: float) -> None:
    near = 0.01
    inside = case((longitudinal - near, lateral - near), (longitudinal + near, 0.0), (0.0, lateral + near))
    found = hits(inside, seconds)
    assert found is not None and found.tolist() == [True, False, False]
    turned = case((0.0, longitudinal - near), (longitudinal - near, 0.0), heading=np.pi / 2)
    found = hits(turned, seconds)
    assert found is not None and found.tolist() == [True, False]
    slow = case((0.5 * longitudinal + near, 0.0), (0.5 * longitudinal - near, 0.0), speed=1.0)
    found = hits(slow, seconds)
    assert found is not None and found.tolist() == [False, True]


def test_what_has_no_truth_does_not_count() -> None:
    lost = case((0.0, 0.0))
    lost.valid[40:] = False
    assert hits(lost, 8) is None and hits(lost, 3) is not None
    mean, end = displacement(lost, 8)
    assert mean.tolist() == [0.0] and np.isnan(end).all()
    row = summary([score(lost), score(case((9.0, 0.0)))])
    assert row["miss_rate_8s"] == 1.0 and row["miss_rate_3s"] == 0.5


def precision_of(scores: list[Score]) -> float:
    return float(average_precision(scores, 3, np.ones((1, len(scores))))[0])


def test_average_precision_by_hand() -> None:
    good = case((0.0, 0.0), (50.0, 0.0), confidence=[0.9, 0.1])
    late = case((50.0, 0.0), (0.0, 0.0), confidence=[0.8, 0.2])
    # in order of confidence: hit, miss, hit, miss; recall ½ at precision 1, recall 1 at precision 2/3
    assert precision_of([score(good), score(late)]) == pytest.approx(0.5 + 0.5 * 2 / 3)
    twice = case((0.0, 0.0), (0.1, 0.0), confidence=[0.6, 0.4])  # the second hit is a false positive
    assert precision_of([score(twice)]) == 1.0
    assert precision_of([score(case((50.0, 0.0)))]) == 0.0


def test_equal_confidences_do_not_depend_on_the_order_of_agents() -> None:
    """As in the benchmark's own code, false positives come first among equals."""
    hit, miss = score(case((0.0, 0.0))), score(case((50.0, 0.0)))
    for order in ([hit, miss, miss], [miss, miss, hit]):
        assert precision_of(order) == pytest.approx(1 / 3 * 1 / 3)


def test_right_u_turns_count_with_right_turns() -> None:
    """As in the benchmark's own code, so that one agent is not an eighth of the mean."""
    hit, miss = score(case((0.0, 0.0))), score(case((50.0, 0.0)))
    scores = [replace(hit, shape="right"), replace(miss, shape="right U-turn"), replace(miss, shape="straight")]
    assert summary(scores)["mAP_3s"] == pytest.approx((1 / 2 * 1 / 2 + 0.0) / 2)


def path(turn: float, length: float = 40.0) -> tuple[np.ndarray, np.ndarray]:
    heading = np.linspace(0.0, turn, 81)
    step = length / 80 * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    return np.cumsum(step, axis=0) - step[0], heading


@pytest.mark.parametrize(
    ("turn", "length", "shape"),
    [
        (0.0, 40.0, "straight"), (0.0, 1.0, "stationary"), (0.5, 40.0, "straight left"),
        (-0.5, 40.0, "straight right"), (1.6, 40.0, "left"), (-1.6, 40.0, "right"), (4.5, 80.0, "left U-turn"),
        (-4.5, 80.0, "right U-turn"),
    ],
)  # fmt: skip
def test_the_eight_shapes(turn: float, length: float, shape: str) -> None:
    position, heading = path(turn, length)
    if "U-turn" in shape:
        heading = np.clip(heading, -3.0, 3.0)
        position = position - np.linspace(0, 12, 81)[:, None] * [1.0, 0.0]
    speed = np.full(81, length / 8)
    assert shape in SHAPES
    assert shape_of(position, heading, speed, np.ones(81, bool)) == shape


def test_intervals_hold_the_figure_and_are_those_of_agents_or_scenes() -> None:
    rng = np.random.default_rng(0)
    scores = [
        Score("vehicle", "straight", [0.7, 0.3], [x, 2 * x, 3 * x], [x, x, None], [[x < 1, False], [True, False], None])
        for x in rng.exponential(1.0, 60)
    ]
    row = summary(scores)
    found = intervals(scores, ["one"] * len(scores))
    for name in ("minADE_3s", "minADE_8s", "minFDE_5s", "miss_rate_3s", "mAP_3s"):
        low, high = found[name]
        assert low < row[name] < high, name
    assert np.isnan(found["minFDE_8s"]).all() and np.isnan(found["mAP_8s"]).all()
    assert found["miss_rate_5s"] == (0.0, 0.0)
    width = found["minADE_3s"][1] - found["minADE_3s"][0]
    assert width == pytest.approx(4 * np.std([s.ade[0] for s in scores]) / np.sqrt(60), rel=0.3)
    # Agents of a scene that are all alike are one: with whole scenes drawn, the interval is as of 12 agents.
    alike = [s for s in scores[:12] for _ in range(5)]
    by_scene = intervals(alike, [str(i) for i in range(12) for _ in range(5)])["minADE_3s"]
    by_agent = intervals(alike, ["one"] * 60)["minADE_3s"]
    assert by_scene[1] - by_scene[0] > 1.5 * (by_agent[1] - by_agent[0])
    assert np.isnan(intervals(scores[:1], ["one"])["minADE_3s"]).all()


def test_a_bootstrap_draws_the_measure_of_the_summary() -> None:
    """Right U-turns are right turns there, too, and among equals false positives come first: all draws give it."""
    hit, miss = score(case((0.0, 0.0))), score(case((50.0, 0.0)))
    turns = [replace(hit, shape="right"), replace(miss, shape="right U-turn")]
    alike = [each for _ in range(12) for each in turns]
    low, high = intervals(alike, [str(i) for i in range(12) for _ in turns])["mAP_3s"]
    assert (low, high, summary(alike)["mAP_3s"]) == pytest.approx((1 / 4,) * 3)


def test_a_weight_counts_as_so_many_agents() -> None:
    rng = np.random.default_rng(1)
    confidence, hit = rng.dirichlet(np.ones(4), 40).tolist(), (rng.random((40, 4)) < 0.3).tolist()
    scores = [Score("vehicle", "left", c, [1.0] * 3, [1.0] * 3, [h] * 3) for c, h in zip(confidence, hit, strict=True)]
    weights = np.tile([2.0, 0.0], 20)[None]
    assert average_precision(scores, 3, weights)[0] == pytest.approx(precision_of(scores[::2] * 2), abs=1e-12)
