"""The test over the whole list: how often it errs where nothing is, and what it sees that Student's t does not."""

import numpy as np

from idm_env.discovery.score import rivals, westfall_young


def test_it_seldom_finds_what_is_not_there() -> None:
    random = np.random.default_rng(0)
    found = 0
    for number in range(300):
        # Candidates whose gains have very different scales, and heavy tails.
        gains = random.standard_t(3, (30, 8)) * 10.0 ** random.uniform(-4, -1, (30, 1))
        found += bool((westfall_young(gains, number).p_value < 0.05).any())
    assert found / 300 < 0.08


def test_one_strong_run_neither_decides_nor_hides() -> None:
    random = np.random.default_rng(1)
    nothing = 0.001 * random.standard_normal((30, 8))
    strong = np.array([[0.35, 0.19, 0.06, 0.0, 0.0, 0.17, 0.05, 0.02]])
    assert westfall_young(np.concatenate([nothing, strong])).p_value[-1] < 0.05
    alone = np.array([[0.5, 0.001, -0.002, 0.001, -0.001, 0.002, -0.001, -0.001]])
    assert westfall_young(np.concatenate([nothing, alone])).p_value[-1] > 0.05


def test_the_smallest_p_value_is_two_to_the_minus_runs() -> None:
    for runs in (3, 5, 8):
        assert westfall_young(np.full((1, runs), 0.1)).p_value[0] == 2.0**-runs


def test_a_tiny_gain_in_all_runs_is_weighed_down() -> None:
    random = np.random.default_rng(2)
    others = 0.02 * random.standard_normal((30, 8))
    assert westfall_young(np.concatenate([others, np.full((1, 8), 1e-6)])).p_value[-1] > 0.5


def test_a_rival_gains_beyond_chance_and_not_less_than_the_winner() -> None:
    random, run = np.random.default_rng(3), np.repeat(np.arange(8), 3)
    common = 0.1 * random.random(24)
    winner, near, half = (share + common + 0.01 * random.standard_normal(24) for share in (0.2, 0.2, 0.1))
    chance, wide = (spread * random.standard_normal(24) for spread in (0.01, 1.0))
    gains = np.stack([half, chance, winner, near, wide])
    assert rivals(gains, 2, run) == [3]
    assert rivals(gains[:, :3], 2, run[:3]) == []  # of a single run nothing is beyond chance
