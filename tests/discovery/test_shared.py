"""What vehicles of one run share: chance is as often beyond a level as the level says."""

import numpy as np
import pytest
from scipy.stats import norm

from idm_env.discovery.shared import beyond, standing_out


def _runs(number: int, unsteady: float) -> list[np.ndarray]:
    """Residuals of vehicles that know nothing of each other, but are unsteady at the same times."""
    random = np.random.default_rng(3)
    size = np.where(random.random((number, 1, 33, 1)) < 0.3, unsteady, 1.0)
    return list(random.standard_normal((number, 3, 33, 12)) * size)


@pytest.mark.parametrize("unsteady", [1.0, 3.0])
def test_chance_stands_out_no_oftener_than_its_level(unsteady: float) -> None:
    """Windows in which everybody errs three times as much: sums of their products scatter more than turned ones."""
    random = np.random.default_rng(0)
    p = norm.sf([standing_out(table, random) for table in _runs(400, unsteady)])
    for level in (0.2, 0.05, 0.01):
        assert np.mean(p < level) <= level + 2.6 * np.sqrt(level * (1 - level) / len(p))


def test_what_is_shared_stands_out() -> None:
    """A fifth of the time, everybody misses by as much as noise alone does."""
    random = np.random.default_rng(0)
    for table in _runs(20, 3.0):
        table[:, 10:17] += 3.0 * random.choice([-1.0, 1.0], table[:, 10:17].shape[1:])
        assert standing_out(table, random) > 3.5


@pytest.mark.parametrize("of_leader", [True, False])
def test_what_all_answer_to_in_the_leader_is_no_cause_of_a_run(of_leader: bool) -> None:
    """An answer to the leader, who moves most in run 3, goes; a disturbance of that run stays (located: 3.5)."""
    random, runs, count = np.random.default_rng(1), 10, 33
    moves = random.standard_normal((runs, count, 5)) * np.where(np.arange(runs) == 3, 3.0, 1.0)[:, None, None]
    shared = moves @ random.standard_normal((5, 12)) * 0.3 if of_leader else np.zeros((runs, count, 12))
    if not of_leader:
        shared[3, 10:17] = 2.0
    residual = shared[:, None] + random.standard_normal((runs, 3, count, 12))
    features = np.repeat(moves[:, None], 3, axis=1).reshape(-1, 5)
    left = beyond(residual.reshape(-1, 12), features, np.repeat(np.arange(runs), 3 * count)).reshape(residual.shape)
    before, after = (standing_out(table[3], np.random.default_rng(0)) for table in (residual, left))
    assert before > 3.0 and (after < 3.0 if of_leader else after > 3.0)
