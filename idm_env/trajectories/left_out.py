"""How good a reconstruction is on points of the user's own file that it was not given."""

from typing import Any

import numpy as np

from idm_env.trajectories import paper
from idm_env.trajectories.baselines import BASELINES
from idm_env.trajectories.chunks import OURS, FilePlan, FilterSettings
from idm_env.trajectories.recipe import recipe
from idm_env.trajectories.scores import RegularMotion
from idm_env.trajectories.spool import Spool
from idm_env.trajectories.tracks import Pieces, TrackPiece, clock_of

VEHICLES = 120
"""Vehicles that are scored, at most, in blocks that follow one another so that leaders are among them."""
BLOCKS = 4


def thinned(track: TrackPiece) -> tuple[TrackPiece, np.ndarray]:
    """Return a track without every second point, and the indices [n] of the points left out; both ends stay."""
    out = np.arange(1, len(track) - 1, 2)
    return track.part(np.setdiff1d(np.arange(len(track)), out)), out


def score(spool: Spool, plan: FilePlan, settings: FilterSettings) -> list[dict[str, Any]]:
    """Return one row per method, ours first: errors (m) at every second point of some tracks, left out.

    Tracks of fewer than five points are not scored; no row if there is no other.
    """
    tables = spool.picked(_sample_vehicles(len(spool.vehicles)))
    tracks = [t for table in tables for t in Pieces(table, None) if len(t) >= 5]
    if not tracks:
        return []
    halves, out = zip(*(thinned(track) for track in tracks), strict=True)
    if plan.noise is None:
        ours = [f.motion for f in paper.imitate(halves, plan.dt, fixed_parameters=settings.fixed_parameters)]
    else:
        ours = [f.motion for f in recipe(list(halves), plan.dt, plan.noise, plan.options)]
    motions = {OURS[settings.recipe]: ours}
    for name, smoother in BASELINES.items() if settings.baselines else ():
        motions[name] = [smoother(t.time_s, t.position_m, clock_of(t, plan.dt)) for t in halves]
    spacing = float(np.median(np.concatenate([np.diff(t.time_s) for t in halves])))
    return [_row(name, motion, tracks, out, spacing) for name, motion in motions.items()]


def _sample_vehicles(count: int) -> list[int]:
    if count <= VEHICLES:
        return list(range(count))
    size = VEHICLES // BLOCKS
    begins = np.linspace(0, count - size, BLOCKS).round().astype(int)
    return sorted({int(b) + i for b in begins for i in range(size)})


def _row(
    name: str, motions: list[RegularMotion], tracks: list[TrackPiece], out: tuple[np.ndarray, ...], spacing: float
) -> dict[str, Any]:
    triples = zip(motions, tracks, out, strict=True)
    apart = np.concatenate([motion.position_at(track.time_s[i]) - track.position_m[i] for motion, track, i in triples])
    size = np.abs(apart)
    row = {"method": name, "tracks": len(tracks), "points": len(apart), "spacing_s": spacing}
    row |= {"rmse_m": float(np.sqrt(np.mean(apart**2))), "mae_m": float(size.mean())}
    return row | {"p95_m": float(np.percentile(size, 95)), "bias_m": float(apart.mean())}
