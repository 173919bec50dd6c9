"""The calibration that a discovery starts from: IDM by exact gradients through the simulator, in free simulation."""

from __future__ import annotations

from typing import Any

import numpy as np

from idm_env.data.episode import windows
from idm_env.discovery.records import Records
from idm_env.discovery.solve import BOUNDS, NAMES
from idm_env.fitting.evaluate import errors
from idm_env.fitting.fit import fit
from idm_env.progress import OnProgress, silent

LONGEST_S = 180.0
"""Longer episodes are simulated in windows of this length, each from its own measured state."""


def calibrate(
    records: Records, by: str, centre: np.ndarray, on_progress: OnProgress = silent
) -> tuple[np.ndarray, dict[str, Any]]:
    """Calibrate IDM to these records and return log θ [groups, 5], and what a report says of it.

    Free simulation behind the replayed measured leader, Levenberg–Marquardt on the spacing with forward-mode Jacobians
    of the simulator (``idm_env.fitting``). Groups without a record here keep ``centre`` [5].
    """
    items = windows(records.episodes, LONGEST_S)
    found = fit(items, by=by, loss="mse", starts=1, iterations=25, substeps=1, on_progress=on_progress)
    error, _ = errors(found.problem, found.own, found.shared)
    order = [found.names.index(f"idm.{name}") for name in NAMES]
    own = np.log(found.own.numpy()[:, order])
    group_of = {episode.key: g for episode, g in zip(items, found.problem.group.tolist(), strict=True)}
    theta = np.tile(centre, (len(records.groups), 1))
    for record, episode in enumerate(records.episodes):
        theta[records.group[record]] = own[group_of[episode.key]]
    standard = found.uncertainty.standard_error.median(0).values.numpy()[order]
    told = {
        "method": "Levenberg-Marquardt with forward-mode Jacobians of the simulator, spacing, free simulation",
        **error.summary(),
        "converged": int(found.converged.sum()),
        "groups": len(found.problem.groups),
        "median": dict(zip(NAMES, np.exp(np.median(own, axis=0)).tolist(), strict=True)),
        "median_standard_error": dict(zip(NAMES, standard.tolist(), strict=True)),
    }
    return np.clip(theta, BOUNDS[:, 0], BOUNDS[:, 1]), told
