"""Episodes as arrays: every sample once and in order, and the layouts of fits and of discovery show the same."""

from __future__ import annotations

import numpy as np
import pytest

from idm_env.data import DataError, Episode, episodes, synthetic
from idm_env.data.samples import VEHICLES, Samples
from idm_env.discovery.march import COLUMNS
from idm_env.discovery.records import gather
from idm_env.fitting.batch import Batch


@pytest.fixture(scope="module")
def items() -> list[Episode]:
    """Return episodes of three lengths."""
    trajectories, _ = synthetic.generate(7, runs=3, followers=2, seconds=40.0)
    whole = list(episodes(trajectories, max_gap=None, smooth=True))
    return [e.part(0, len(e) - 30 * k) for k, e in enumerate(whole[:3])]


def test_every_episode_is_there_in_order_with_everybody_around(items: list[Episode]) -> None:
    samples = Samples.from_episodes(items)
    for r, episode in enumerate(items):
        here = slice(samples.bounds[r], samples.bounds[r + 1])
        assert np.array_equal(samples.gap[here], episode.gap_m) and np.array_equal(samples.time[here], episode.time_s)
        for i, name in enumerate(VEHICLES):
            record = getattr(episode, name)
            assert np.array_equal(samples.position[here, i], record.position_m)
            assert np.array_equal(samples.accel[here, i], record.accel_mps2)
            assert samples.length[r, i] == record.length_m


def test_a_batch_and_the_records_of_discovery_show_the_same_samples(items: list[Episode]) -> None:
    batch, records = Batch.stack(items, substeps=2), gather(items)
    for r, episode in enumerate(items):
        measured = batch.valid[:, r] > 0
        flat = slice(records.first[r], records.bounds[r + 1])
        assert int(measured.sum()) == len(episode) == flat.stop - flat.start
        assert np.array_equal(batch.speed[measured, r].numpy(), records.speed[flat])
        assert np.allclose(batch.gap[measured, r].numpy(), records.gap[flat], atol=1e-9)
        leader = batch.all_speed[::2, r, VEHICLES.index("leader")][measured].numpy()
        assert np.array_equal(leader, records.signals[flat, COLUMNS.index("lead_speed")])
    assert (batch.speed[~(batch.valid[:, 2] > 0), 2] == batch.speed[len(items[2]) - 1, 2]).all()


def test_no_episode_is_an_error() -> None:
    with pytest.raises(DataError, match="no episode"):
        Samples.from_episodes([])
