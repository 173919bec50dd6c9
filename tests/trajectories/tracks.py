"""Small tracks for tests."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import polars as pl

from idm_env.data import Repair
from idm_env.trajectories.scores import RegularMotion
from idm_env.trajectories.spool import read_table
from idm_env.trajectories.tracks import TrackPiece


def swinging(seconds: float = 60.0, dt: float = 0.1, phase: float = 0.0) -> RegularMotion:
    """A speed that swings by 3 m/s about 12 m/s, once in 25 s."""
    clock = dt * np.arange(round(seconds / dt) + 1)
    w = 2 * np.pi / 25
    swing = w * clock + phase
    return RegularMotion(
        clock, 12 * clock - 3 / w * (np.cos(swing) - np.cos(phase)), 12 + 3 * np.sin(swing), 3 * w * np.cos(swing)
    )


def track_of(
    motion: RegularMotion, noise: np.ndarray | float = 0.0, name: str = "a", leader: str = "", lane: int = -1
) -> TrackPiece:
    """A track that shows a motion with noise (m)."""
    count = len(motion.time_s)
    return TrackPiece(
        "0", name, 0, motion.time_s, motion.position_m + noise, 4.5, np.full(count, leader), np.full(count, lane)
    )


def read_frame(frame: pl.DataFrame) -> pl.DataFrame:
    """Return a table as filter reads it from a file."""
    return read_repaired(frame)[0]


def read_repaired(frame: pl.DataFrame) -> tuple[pl.DataFrame, tuple[Repair, ...]]:
    """Return a table as filter reads it from a file, and what was repaired."""
    with TemporaryDirectory() as folder:
        frame.write_parquet(Path(folder) / "table.parquet")
        return read_table(Path(folder) / "table.parquet")
