"""The smallest strength that would have been found, against what is known exactly and against the test itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from idm_env.data import synthetic
from idm_env.discovery import discover
from idm_env.discovery.model import SPREAD
from idm_env.discovery.power import CLOSE, Bar, Planted, reach, strength_of
from idm_env.discovery.score import ALPHA, FAINT, level, westfall_young
from idm_env.effects import ALL, make


def planted(units: int, curvature: float, pull: float, bar: Bar, sizes: int = 1) -> Planted:
    """Return units of one strength: each with this curvature, and errors that pull by ``pull`` in some direction."""
    run = np.repeat(np.arange(units // sizes), sizes)
    return Planted.made(
        np.full((units, 1, 1), curvature), np.full((units, 1), pull), np.full(units, 100.0), run, np.ones(1),
        np.zeros((1, 1)), bar,
    )  # fmt: skip


@pytest.mark.parametrize("gain", [0.005, 0.05])
def test_without_errors_that_pull_the_least_gain_alone_decides(gain: float) -> None:
    """Strength s explains s² M of s² M + square: the gain is ½ log(1 + s² M / square)."""
    made = planted(8, 4.0, 0.0, Bar(-np.inf, gain, 2))
    exact = np.sqrt((np.exp(2.0 * gain) - 1.0) * 100.0 / 4.0)
    assert made.share(0.999 * exact) == 0.0 and made.share(1.001 * exact) == 1.0
    assert exact <= made.smallest(1.0) <= 1.06 * exact


def test_more_noise_fewer_units_and_a_higher_bar_hide_more() -> None:
    usual, bar = 1.0, Bar(1.0, 0.005, 2)
    base = planted(8, 4.0, 2.0, bar).smallest(usual)
    assert planted(8, 4.0, 6.0, bar).smallest(usual) > 1.5 * base
    assert planted(4, 4.0, 6.0, bar).smallest(usual) > planted(16, 4.0, 6.0, bar).smallest(usual)
    assert planted(8, 4.0, 2.0, Bar(2.0, 0.005, 2)).smallest(usual) > base
    assert planted(8, 4.0, 2.0, Bar(9.0, 0.005, 2)).smallest(usual) == np.inf  # no statistic of 8 units is as high


def test_the_level_is_where_a_further_candidate_becomes_significant() -> None:
    """Against the test itself, with the candidate in the list: 8 runs, 30 candidates of chance.

    Of gains g shape the statistic t is g A² = t² (g B + 8 FAINT), with A the sum of shape's roots and B that of shape.
    """
    share, run, shape = 0.8, np.arange(8), np.linspace(0.5, 1.5, 8)
    for seed in range(5):
        others = 0.003 * np.random.default_rng(seed + 1).standard_normal((30, 8))
        wanted = level(others, 0, run, share)
        for statistic, significant in ((wanted - 1e-6, False), (wanted + 1e-6, True)):
            gain = statistic**2 * FAINT * 8 / (np.sqrt(shape).sum() ** 2 - statistic**2 * shape.sum())
            p = westfall_young(np.vstack((gain * shape, others)), 0, run).p_value[0] / share
            assert (p < ALPHA) == significant


def test_a_latency_below_one_step_is_nobody_s() -> None:
    """It becomes part of the null, so that it is never found, however sure it is."""
    found = discover(synthetic.generate(6, runs=4, followers=2, seconds=60.0)[0], effects=["lag", "drag"])
    at = next(s for s in found.rounds[0].scored if s.term.label == "lag")
    assert at.solution is not None
    strength = strength_of(at.solution, found.problem, "lag", Bar(-np.inf, 0.0, 0))
    assert strength is not None and found.records.dt < strength.seen < 2.0 * found.records.dt
    assert strength.seen > found.records.dt + 0.4 * (strength.high - strength.estimate)
    # Where the search goes to half of what a higher bar asks for, no strength would have been found.
    bar = Bar(-np.inf, 1.0, 0)
    strength = strength_of(at.solution, found.problem, "lag", bar)
    assert strength is not None and 3.0 * found.records.dt < strength.seen < strength.parameter.high
    model = at.solution.model
    for share, seen in ((1.2, strength.seen), (0.5, np.inf)):
        shorter = replace(strength.parameter, default=0.1, high=share * strength.seen)
        lag = replace(model.terms[-1], parameters=(shorter,))
        within = replace(at.solution, model=replace(model, terms=(*model.terms[:-1], lag)))
        told = strength_of(within, found.problem, "lag", bar)
        assert told is not None and told.seen == pytest.approx(seen, rel=CLOSE - 1.0)


def test_no_strength_beyond_its_bounds_would_have_been_found() -> None:
    """Towards the default, to which strengths are planted; a wave has both signs. What is usual is always in reach."""
    weight, zone = make("second_leader").parameters[0], make("speed_zone").parameters[0]
    assert (weight.low, weight.high) == (-0.5, 1.0) and zone.null == 1.0
    assert reach(weight, False) == 1.0 and reach(weight, True) == 0.5
    assert reach(zone, False) == 1.0 - zone.low and zone.default < 1.0
    slower = replace(weight, default=-0.2)
    assert reach(slower, False) == 0.5
    for effect in map(make, ALL):
        strengths = [p for p in effect.parameters if p.role == "strength" and p.null is not None]
        if effect.sought == "profile":
            assert abs(effect.strength_of(SPREAD)) <= reach(strengths[0], True)
        assert all(abs(p.default - (p.null or 0.0)) <= reach(p, False) for p in strengths)
