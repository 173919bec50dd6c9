"""The calibration that a discovery starts from: a law by exact gradients through the simulator, in free simulation."""

from __future__ import annotations

from typing import Any

import numpy as np

from idm_env.data.episode import windows
from idm_env.discovery.march import BASE, Catalogue
from idm_env.discovery.records import Records
from idm_env.effects import CarFollowing
from idm_env.fitting.evaluate import errors
from idm_env.fitting.fit import base_simulator, fit, own_names
from idm_env.progress import OnProgress, silent

LONGEST_S = 180.0
"""Longer episodes are simulated in windows of this length, each from its own measured state."""


def calibrate(
    records: Records, by: str, centre: np.ndarray, base: CarFollowing = BASE, on_progress: OnProgress = silent
) -> tuple[np.ndarray, dict[str, Any]]:
    """Calibrate a law to these records and return log θ [groups, P], and what a report says of it.

    Free simulation behind the replayed measured leader, Levenberg–Marquardt on the spacing with forward-mode Jacobians
    of the simulator (``idm_env.fitting``). Groups without a record here keep ``centre`` [P].
    """
    items = windows(records.episodes, LONGEST_S)
    simulator = base_simulator(base=base)
    names = [p.name for p in base.declared]
    found = fit(
        items, by=by, simulator=simulator, loss="mse", starts=1, iterations=25, substeps=1, on_progress=on_progress
    )
    error, _ = errors(found.problem, found.own, found.shared)
    assert found.names == own_names(simulator)
    own = np.log(found.own.numpy())
    group_of = {episode.key: g for episode, g in zip(items, found.problem.group.tolist(), strict=True)}
    theta = np.tile(centre, (len(records.groups), 1))
    for record, episode in enumerate(records.episodes):
        theta[records.group[record]] = own[group_of[episode.key]]
    standard = found.uncertainty.standard_error.median(0).values.numpy()
    told = {
        "method": "Levenberg-Marquardt with forward-mode Jacobians of the simulator, spacing, free simulation",
        **error.summary(),
        "converged": int(found.converged.sum()),
        "groups": len(found.problem.groups),
        "median": dict(zip(names, np.exp(np.median(own, axis=0)).tolist(), strict=True)),
        "median_standard_error": dict(zip(names, standard.tolist(), strict=True)),
    }
    low, high = Catalogue((), base).bounds.T
    return np.clip(theta, low, high), told
