"""What a model was fitted on: a digest of every driver's track, whatever the file is called or how it is cut."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from typing import Any

import numpy as np
import polars as pl

from idm_env.data.schema import TRACK
from idm_env.data.trajectories import Trajectories

Track = tuple[str, str]


def fingerprints(trajectories: Trajectories, drivers: Iterable[Track]) -> dict[Track, str]:
    """Return, by (run_id, vehicle_id), the digest of a track: times since its first sample (ms) and positions (mm)."""
    wanted = pl.DataFrame(sorted(set(drivers)), schema=dict.fromkeys(TRACK, pl.String), orient="row")
    table = trajectories.table.select(*TRACK, "time_s", "position_m").join(wanted, on=TRACK, how="semi")
    found = {}
    for (run, vehicle), part in table.partition_by(TRACK, as_dict=True).items():
        time, position = part["time_s"].to_numpy(), part["position_m"].to_numpy()
        whole = np.round(np.stack((time - time[0], position)) * 1000.0).astype("<i8")
        found[run, vehicle] = hashlib.sha256(whole.tobytes()).hexdigest()[:12]
    return found


def fitted_on(trajectories: Trajectories, drivers: Iterable[Track]) -> dict[str, Any]:
    """Return what ``model.yaml`` says of the data of a fit: the file's name and the digests of its drivers' tracks."""
    return {"source": trajectories.source, "tracks": sorted(set(fingerprints(trajectories, drivers).values()))}
