"""Small synthetic records, made once."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from idm_env.data import episodes, synthetic
from idm_env.discovery.records import Records, gather


@pytest.fixture(scope="session", autouse=True)
def one_thread() -> None:
    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def platoon() -> Records:
    """Three runs with four followers each, 60 s, vehicles in the lane beside."""
    trajectories, _ = synthetic.generate(11, runs=3, followers=4, seconds=60.0, effect="lateral")
    found = [e for e in episodes(trajectories, smooth=True) if len(e) > 500]
    assert len(found) > 6 and np.mean([e.adjacent.present.mean() for e in found]) > 0.9
    return gather(found)
