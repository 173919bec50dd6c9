"""Driver parameters from filtered tracks: the calibration of ``fitting.fit`` behind the real, filtered leaders."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from idm_env.data import Episode, VehicleRecord
from idm_env.data.records import FAR_M
from idm_env.data.schema import spans
from idm_env.effects import IDM
from idm_env.fitting.fit import Fit, fit
from idm_env.fitting.options import Options
from idm_env.trajectories.recipe import Filtered

SHORTEST_S = 10.0
"""Shorter stretches behind one leader say too little about a driver (s)."""
FARTHEST_M = 100.0
"""A leader farther away than this is not followed (m)."""


def episode_of(filtered: Filtered, leaders: dict[tuple[str, str], list[Filtered]]) -> Episode | None:
    """Return the longest stretch behind one filtered leader as an episode, None if there is none of 10 s."""
    longest: tuple[int, int, Filtered] | None = None
    clock = filtered.motion.time_s
    dt = float(clock[1] - clock[0]) if len(clock) > 1 else 0.1
    near = np.isfinite(filtered.gap) & (filtered.gap > 0) & (filtered.gap < FARTHEST_M)
    for begin, end in spans(filtered.leader[1:] == filtered.leader[:-1], near & (filtered.leader != "")):
        for lead in leaders.get((filtered.track.run_id, str(filtered.leader[begin])), ()):
            first, last = lead.motion.time_s[[0, -1]]
            inside = clock[begin] >= first - 1e-9 and clock[end - 1] <= last + 1e-9
            if inside and (longest is None or end - begin > longest[1] - longest[0]):
                longest = begin, end, lead
    if longest is None or (longest[1] - longest[0]) * dt < SHORTEST_S:
        return None
    begin, end, lead = longest
    part = slice(begin, end)
    time = clock[part]
    position, speed = filtered.motion.position_m[part], filtered.motion.speed_mps[part]
    length = lead.track.length_m
    nobody = np.zeros(end - begin, bool)
    speeds, accels = (np.interp(time, lead.motion.time_s, x) for x in (lead.motion.speed_mps, lead.motion.accel_mps2))
    ahead = VehicleRecord(position + filtered.gap[part] + length, speeds, accels, length, ~nobody)
    far = [VehicleRecord(position + away, speed, np.zeros(end - begin), 4.5, nobody) for away in (FAR_M, -FAR_M, FAR_M)]
    track = filtered.track
    names = track.run_id, track.vehicle_id, str(filtered.leader[begin]), track.key
    own = time, position, speed, filtered.gap[part]
    return Episode(*names, dt, *own, track.length_m, ahead, far[0], far[1], far[2], position, {}, {})


def fit_drivers(
    filtered: Sequence[Filtered], before: Sequence[Filtered] = (), model: str | None = None, *, iterations: int = 15
) -> tuple[Fit | None, list[Episode]]:
    """Calibrate IDM for every track that follows a leader for at least 10 s; None where nobody does.

    ``model`` is a model.yaml whose effects stay as they are.
    """
    leaders: dict[tuple[str, str], list[Filtered]] = {}
    for f in (*filtered, *before):
        leaders.setdefault((f.track.run_id, f.track.vehicle_id), []).append(f)
    episodes = [e for e in (episode_of(f, leaders) for f in filtered) if e is not None]
    if not episodes:
        return None, []
    simulator, fixed = Options(model=model).simulator()
    result = fit(episodes, by="driver", simulator=simulator, fixed=fixed, loss="mse", starts=1, iterations=iterations)
    return result, episodes


def parameter_rows(
    filtered: Sequence[Filtered], before: Sequence[Filtered] = (), model: str | None = None
) -> list[dict[str, Any]]:
    """Return one row per track: the five parameters, their standard errors, and whether the data tell them.

    ``source`` is ``leader`` for a calibration behind the real leader; ``none`` marks a track that follows nobody for
    10 s: its parameters are empty, since an imagined leader explains any motion at any parameters.
    """
    result, _ = fit_drivers(filtered, before, model)
    values: dict[str, dict[str, Any]] = {}
    for row in result.table() if result is not None else ():
        name = row["parameter"].rpartition(".")[2]
        own = values.setdefault(row["group"], {"source": "leader"})
        own |= {name: row["estimate"], f"{name}_error": row["standard_error"], f"{name}_identified": row["identified"]}
    blank = {"": None, "_error": None, "_identified": False}
    empty = {"source": "none", **{p.name + end: x for p in IDM.declared for end, x in blank.items()}}
    tracks = [f.track for f in filtered]
    names = [{"run_id": t.run_id, "vehicle_id": t.vehicle_id, "piece": t.piece} for t in tracks]
    return [own | values.get(f"{t.run_id}/{t.vehicle_id}", empty) for own, t in zip(names, tracks, strict=True)]
