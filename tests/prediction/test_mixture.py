"""Shares of the ways in which agents go on: counted, with a prior, and apart by kind and pace."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.prediction import PRIOR_AGENTS, Seen, fit_shares, score_hits
from idm_env.prediction.metrics import Case
from idm_env.prediction.mixture import pace_of, share_of

STEPS = 80


def agents(count: int, hit: tuple[float, float, float], kind: str = "vehicle", pace: str = "moving") -> list[Seen]:
    return [Seen(kind, pace, np.array([hit] * 3)) for _ in range(count)]


def test_agents_that_only_one_way_explains_are_counted() -> None:
    found = fit_shares(agents(30, (1.0, 0.0, 0.0)) + agents(10, (0.0, 0.0, 1.0)))["vehicle", "moving"]
    total = 40 + PRIOR_AGENTS
    assert found == pytest.approx([(30 + PRIOR_AGENTS / 3) / total, 0.0, (10 + PRIOR_AGENTS / 3) / total], abs=0.03)
    assert sum(found) == pytest.approx(1.0)


def test_a_way_that_hits_twice_as_often_gets_more_than_one_that_hits_less() -> None:
    found = fit_shares(agents(200, (0.8, 0.4, 0.0)))["vehicle", "moving"]
    assert found[0] > 0.95


def test_what_no_way_hits_and_what_nobody_was_seen_to_do_leave_the_prior() -> None:
    found = fit_shares(agents(50, (0.0, 0.0, 0.0)))
    assert found["vehicle", "moving"] == pytest.approx([1 / 3] * 3)
    assert found["cyclist", "moving"] == pytest.approx([1 / 3] * 3)
    assert found["pedestrian", "standing"] == (0.5, 0.5, 0.0)


def test_agents_without_lanes_say_nothing_of_the_lanes() -> None:
    on = agents(40, (0.2, 0.2, 0.8))
    off = agents(40, (0.9, 0.1, np.nan))
    alone, both = fit_shares(on)["vehicle", "moving"], fit_shares(on + off)["vehicle", "moving"]
    assert both[2] == pytest.approx(alone[2], abs=0.03) and both[0] > 2 * both[1]


def test_kinds_and_paces_are_apart() -> None:
    found = fit_shares(agents(20, (1.0, 0.0, 0.0), pace="standing") + agents(20, (0.0, 0.0, 1.0)))
    assert found["vehicle", "standing"][0] > 0.9 and found["vehicle", "moving"][2] > 0.9
    assert (pace_of(0.49), pace_of(0.51)) == ("standing", "moving")


def test_off_the_lanes_the_other_ways_fill_their_place() -> None:
    shares = {("vehicle", "moving"): (0.1, 0.3, 0.6)}
    assert share_of(shares, "vehicle", 5.0, True) == pytest.approx([0.1, 0.3, 0.6])
    assert share_of(shares, "other", 5.0, False) == pytest.approx([0.25, 0.75, 0.0])


def test_what_is_seen_of_an_agent_is_the_weighted_share_that_hits_at_the_known_horizons() -> None:
    line = np.stack([np.linspace(1, 80, STEPS), np.zeros(STEPS)], axis=1)
    valid = np.ones(STEPS, bool)
    valid[60:] = False
    case = Case(line[None], np.ones(1), line, np.zeros(STEPS), valid, 10.0, "straight", "vehicle")
    near, far = line, line + np.array([0.0, 50.0])
    found = score_hits(case, [near[None], np.stack([near, far]), np.empty((0, STEPS, 2))],
                 [np.ones(1), np.array([3.0, 1.0]), np.empty(0)])  # fmt: skip
    assert found is not None and (found.kind, found.pace) == ("vehicle", "moving")
    assert np.array_equal(found.hit, [[1.0, 0.75, np.nan]] * 2, equal_nan=True)
    case.valid[:] = False
    assert score_hits(case, [near[None]], [np.ones(1)]) is None
