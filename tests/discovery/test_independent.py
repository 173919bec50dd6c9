"""``benchmarks.independent``: its laws, written once more, predict as the package's do."""

import numpy as np
import pytest

from benchmarks.independent import LAWS, tracks_of
from idm_env.data import synthetic
from idm_env.discovery import bases, march
from idm_env.discovery.calibrate import first_prior
from idm_env.discovery.discover import prepare
from idm_env.discovery.model import Hypothesis
from idm_env.discovery.records import windows
from idm_env.discovery.solve import Problem
from idm_env.effects import base_named

SET = {"v0": 30.0, "T": 1.3, "s0": 2.4, "a": 1.1, "b": 1.7, "κ": 0.8, "τ": 6.0, "w": 0.6, "k": 1.4}
NULL = Hypothesis((), march.Catalogue((), located=False))
ENTRIES = {"max_accel": "a", "comfort_decel": "b", "time_gap": "T", "min_gap": "s0", "desired_speed": "v0"}
ENTRIES |= {"stiffness": "w", "gain": "k", "factor": "κ", "memory_time": "τ"}


@pytest.mark.parametrize(("law", "kind"), [("IDM", "idm"), ("improved IDM", "iidm")])
def test_a_law_written_once_more_predicts_as_the_package(law: str, kind: str) -> None:
    """Errors 5 s ahead of drivers with own gains differ by integrators and smoothers of the leader."""
    made, _ = synthetic.generate(90210, runs=1, followers=2, seconds=90.0, noise=0.0, speed_noise=0.0)
    records = prepare(made, "driver")
    rows, model = windows(records), bases.personal(NULL, base_named(kind))
    theta = np.log([[[SET[ENTRIES[p.name]] for p in model.catalogue.own]] * len(records.groups)])
    problem = Problem(rows, None, first_prior(model.catalogue.own))
    expected = problem.errors(theta, model, np.zeros((1, 0)))[0][:, -1]
    own = np.log([SET.get(name, 1.0) for name in ("v0", "T", "s0", "a", "b", "κ", "τ", "w", "k", "c", "lag")])
    tracks = {(t.run, t.vehicle): t for t in tracks_of(made)}
    errors = []
    for number, episode in enumerate(records.episodes):
        begin = rows.start[rows.record == number] - records.first[number]
        track = tracks[episode.run_id, episode.vehicle_id]
        errors.append(track.errors(LAWS[f"{law}, own trend, stiffness, closing gain"], own, [begin])[:, 3])
    size = np.sqrt(np.mean(expected**2))
    assert size > 0.3 and np.sqrt(np.mean((np.concatenate(errors) - expected) ** 2)) < 0.1 * size
