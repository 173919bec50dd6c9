"""The smallest strength that would have been found, against what is known exactly and against the test itself."""

from __future__ import annotations

import numpy as np
import pytest

from idm_env.data import episodes, synthetic
from idm_env.discovery import discover
from idm_env.discovery.power import Bar, Planted, strength_of
from idm_env.discovery.score import ALPHA, level, westfall_young
from idm_env.effects import make


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
    """Against the test itself, with the candidate in the list: 8 runs, 30 candidates of chance."""
    random, share, run = np.random.default_rng(3), 0.8, np.arange(8)
    others = 0.003 * random.standard_normal((30, 8))
    wanted = level(others, 0, run, share)
    wrong = 0
    for gain in np.linspace(1e-4, 0.02, 40):
        gains = np.vstack((gain * np.linspace(0.5, 1.5, 8), others))
        p = westfall_young(gains, 0, run).p_value[0] / share
        statistic = np.sqrt(gains[0]).sum() / np.sqrt(gains[0].sum() + 0.003 * 8)
        wrong += (p < ALPHA) != (statistic >= wanted)
    assert wrong <= 2


def test_drivers_with_their_own_drift_not_turned_do_again_what_they_did() -> None:
    """What the benchmark plants into is the measured motion: simulated behind the leader it comes back."""
    from benchmarks import planted as benchmark

    trajectories, _ = synthetic.generate(5, runs=4, followers=2, seconds=60.0, ou=0.1)
    found = discover(trajectories, effects=["lag", "drag"])
    drag = make("drag")
    made = {turned: benchmark.planted(found, (0.0, 0.0), drag, {"coefficient": 0.0}, 0, turned)
            for turned in (False, True)}  # fmt: skip
    errors = []
    for again in made.values():
        pairs = zip(found.records.episodes, episodes(again), strict=True)
        errors.append(np.concatenate([b.speed_mps - a.speed_mps for a, b in pairs]).std())
    assert errors[0] < 0.02 and 0.1 < errors[1] < 1.0
    assert len(made[True].drivers or ()) == len(found.records.episodes)
    slower = benchmark.planted(found, (0.0, 0.0), drag, {"coefficient": 5e-3}, 0, False)
    assert sum(e.speed_mps.mean() for e in episodes(slower)) < sum(e.speed_mps.mean() for e in found.records.episodes)


def test_a_latency_below_one_step_is_nobody_s() -> None:
    """It becomes part of the null, so that it is never found, however sure it is."""
    found = discover(synthetic.generate(6, runs=4, followers=2, seconds=60.0)[0], effects=["lag", "drag"])
    at = next(s for s in found.rounds[0].scored if s.term.label == "lag")
    assert at.solution is not None
    strength = strength_of(at.solution, found.task, "lag", Bar(-np.inf, 0.0, 0))
    assert strength is not None and found.records.dt < strength.seen < 2.0 * found.records.dt
    assert strength.seen > found.records.dt + 0.4 * (strength.high - strength.estimate)
