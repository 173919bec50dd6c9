"""What vehicles of one run share: chance is as often beyond a level as the level says."""

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from scipy.stats import norm

from benchmarks import undeclared
from idm_env.discovery import shared
from idm_env.discovery.march import PULSED
from idm_env.discovery.places import Responses, respond
from idm_env.discovery.records import Rows
from idm_env.discovery.shared import after_stops, beyond, past_out, standing_out
from idm_env.discovery.units import Units
from idm_env.effects.free import HISTORY
from tests.discovery.test_replica import fitted_to


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


@pytest.mark.parametrize("of_past", [True, False])
def test_what_followers_do_of_one_past_is_no_cause_of_a_run(of_past: bool) -> None:
    """A time gap that is longer after a stop shows most in run 3, which stopped: three of three were "located"."""
    random, runs, count = np.random.default_rng(2), 10, 33
    run = np.repeat(np.arange(runs), 3 * count)
    since = np.where(np.isin(run, (1, 3, 6)), np.tile(np.arange(count) * 5.0, 3 * runs) % 90.0, 90.0)[:, None]
    change = random.standard_normal((len(PULSED), 1, len(run), 12))
    # Followers of one run have one leader, whose motion makes their responses alike.
    change = np.repeat(change.reshape(len(PULSED), 1, runs, 3, count, 12)[:, :, :, :1], 3, axis=3).reshape(change.shape)
    strength = (
        np.exp(-since / 30.0) if of_past else ((run == 3)[:, None] & (np.tile(np.arange(count), 30) < 8)[:, None])
    )
    residual = 3.0 * change[PULSED.index("time_gap"), 0] * strength + random.standard_normal((len(run), 12))
    coordinates = dict.fromkeys(HISTORY, random.random(since.shape)) | {"time_since_stop": since}
    records = SimpleNamespace(groups=[0])
    rows = cast(Rows, SimpleNamespace(run=run, record=run, group=0 * run, records=records))
    counted, square = Units(np.arange(runs), np.arange(runs)), np.bincount(run, (residual**2).sum(1))
    nothing = np.zeros((len(run), 12, 1))
    part = Responses(rows, counted, change, residual, nothing, np.ones((1, 1, 1)), coordinates, square)
    left = past_out(part)
    before, after = (standing_out(x.reshape(runs, 3, count, 12)[3], np.random.default_rng(0)) for x in (residual, left))
    assert before > 3.0 and (after < 3.0 if of_past else after > 3.0), (before, after)


def test_followers_of_one_stop_are_no_cause_of_a_run() -> None:
    """Time gaps are longer after a stop, and run 5 stops twice: told as "run 5 between 34 and 84 s"."""
    job = undeclared.Job("after a stop", 0.0, 920_000)
    assert shared.find(respond(*fitted_to(undeclared.generated(job))), job.seed) is None


@pytest.mark.parametrize(("stopped", "counts"), [((2, 5), [True, True, False, False]), ((5,), [True] * 4)])
def test_what_comes_after_a_stop_tells_of_a_run_only_where_no_other_stops(
    stopped: tuple[int, ...], counts: list[bool]
) -> None:
    run, since = np.repeat([2, 5], 4), np.tile([99.0, 90.0, 40.0, 0.0], 2)
    rows = cast(Rows, SimpleNamespace(run=run))
    after = after_stops(rows, np.where(np.isin(run, stopped), since, 99.0))
    assert (~after[4:]).tolist() == counts
