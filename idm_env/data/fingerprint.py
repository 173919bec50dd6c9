"""Marks of fitted drivers: their places at whole seconds, whatever the file is called or how it is cut."""

import re
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
import polars as pl

from idm_env.data.schema import TRACK
from idm_env.data.trajectories import Trajectories

Track = tuple[str, str]

MOST_PLACES = 64
"""Places of a mark; those of a longer drive are 2, 4, … seconds apart."""
NEAR_M, ALIKE = 1.0, 0.9
"""A driver is known whose place is as near (m) at so large a share of the times that a mark and his track share.

Of 222 vehicles of NGSIM's I-80 all are known from the raw positions to the filtered ones and back; of another quarter
of an hour on the same road 4 are taken for one of them."""
_READABLE = re.compile(r"\d+( -?\d+){2,}")


def marks(trajectories: Trajectories, drivers: Iterable[Track]) -> list[str]:
    """Return the marks of tracks, ``every first x x …;run/vehicle``, under their names in the file.

    The places x (m, rounded) are those at every multiple of ``every`` seconds of the file's clock, from ``first`` on.
    """
    lines = []
    for track, time, position in _tracks(trajectories, drivers):
        every = 1
        while time[-1] - time[0] >= every * MOST_PLACES:
            every *= 2
        times = np.arange(np.ceil(time[0] / every), np.floor(time[-1] / every) + 1) * every
        if len(times):
            places = np.round(np.interp(times, time, position)).astype(int)
            text = " ".join(map(str, (every, int(times[0]), *places)))
            lines.append(f"{text};{trajectories.name_of(*track)}")
    return sorted(lines)


def names_by_mark(
    trajectories: Trajectories, drivers: Iterable[Track], old_marks: Iterable[str]
) -> dict[Track, str] | None:
    """Return, by driver, the name of the one of ``old_marks`` that his track has, whatever it is called here.

    Drivers without one are absent. None where no mark can be read: there is none, or another version wrote them.
    """
    times, places, owner = [], [], []
    names: list[str] = []
    for mark, _, name in (text.partition(";") for text in old_marks):
        if not _READABLE.fullmatch(mark):
            continue
        every, first, *values = (int(x) for x in mark.split())
        times.append(first + every * np.arange(len(values)))
        places.append(np.array(values, float))
        owner.append(np.full(len(values), len(names)))
        names.append(name)
    if not names:
        return None
    when, where, index = (np.concatenate(parts) for parts in (times, places, owner))
    order = np.argsort(when, kind="stable")
    when, where, index = when[order], where[order], index[order]
    drivers_seen = {}
    for track, time, position in _tracks(trajectories, drivers):
        part = slice(*np.searchsorted(when, (time[0], time[-1] + 1e-6)))
        near = np.abs(np.interp(when[part], time, position) - where[part]) <= NEAR_M
        shared = np.bincount(index[part], minlength=len(names))
        alike = np.bincount(index[part], near, minlength=len(names))
        same = np.flatnonzero((shared > 1) & (alike >= ALIKE * shared))
        if len(same):
            drivers_seen[track] = names[same[np.argmax(alike[same])]]
    return drivers_seen


def fitted_on(trajectories: Trajectories, drivers: Iterable[Track]) -> dict[str, Any]:
    """Return the entry ``fitted_on`` of ``model.yaml``: the file's name and the marks of its drivers' tracks."""
    return {"source": trajectories.source, "tracks": marks(trajectories, drivers)}


def _tracks(trajectories: Trajectories, drivers: Iterable[Track]) -> Iterator[tuple[Track, np.ndarray, np.ndarray]]:
    """Yield each driver with his times (s) and places (m)."""
    keys = pl.DataFrame(sorted(set(drivers)), schema=dict.fromkeys(TRACK, pl.String), orient="row")
    table = trajectories.table.select(*TRACK, "time_s", "position_m").join(keys, on=TRACK, how="semi")
    for (run, vehicle), part in table.partition_by(TRACK, as_dict=True).items():
        yield (run, vehicle), part["time_s"].to_numpy(), part["position_m"].to_numpy()
