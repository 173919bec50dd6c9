"""Small synthetic records, made once."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest
import torch

from idm_env.data import episodes, hidden, synthetic
from idm_env.discovery import bases
from idm_env.discovery.records import Records, gather


@pytest.fixture(scope="session", autouse=True)
def one_thread() -> None:
    torch.set_num_threads(1)


@pytest.fixture(scope="module")
def two_laws() -> Iterator[None]:
    """Compare IDM with its improved form alone: half of a search goes into laws, of which test_bases.py is."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(bases, "BASES", ("idm", "iidm"))
        yield


Mixing = Callable[[np.ndarray], None]


@pytest.fixture
def kinds(monkeypatch: pytest.MonkeyPatch) -> Mixing:
    """Return what makes drivers of ``synthetic``, where [runs, followers] says so, linear controllers."""
    idm = hidden.desired_accel

    def of(linear: np.ndarray) -> None:
        def accel(view, seen, drivers, on):  # type: ignore[no-untyped-def]
            gap, speed, lead_speed = seen
            time_gap, top = hidden._adapted(view, drivers, on)
            follow = 0.3 * (gap - drivers.min_gap - speed * time_gap) + 0.6 * (lead_speed - speed)
            wanted = np.minimum(follow, 0.4 * (top - speed))
            law = np.clip(wanted, -2.0 * drivers.comfort_decel, drivers.max_accel)
            return np.where(linear, law, idm(view, seen, drivers, on))

        monkeypatch.setattr(hidden, "desired_accel", accel)

    return of


@pytest.fixture(scope="session")
def platoon() -> Records:
    """Three runs with four followers each, 60 s, vehicles in the lane beside."""
    trajectories, _ = synthetic.generate(11, runs=3, followers=4, seconds=60.0, effect="lateral")
    found = [e for e in episodes(trajectories, smooth=True) if len(e) > 500]
    assert len(found) > 6 and np.mean([e.adjacent.present.mean() for e in found]) > 0.9
    return gather(found)
