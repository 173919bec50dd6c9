"""Metrics of trajectories: the paper's three.

Shapes: everything of a trajectory is ``[samples]``, in SI units.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import polars as pl

IMPLAUSIBLE_MPS2 = 10.0
"""No road vehicle accelerates or brakes harder (m/s²): the paper's bound."""


@dataclass(frozen=True, eq=False)
class RegularMotion:
    """A trajectory on a regular clock: arrays [K] of time (s), position (m), speed (m/s) and acceleration (m/s²)."""

    time_s: np.ndarray
    position_m: np.ndarray
    speed_mps: np.ndarray
    accel_mps2: np.ndarray

    @classmethod
    def from_table(cls, table: pl.DataFrame) -> RegularMotion:
        """Return the motion that rows of a written table [rows] tell."""
        return cls(*(table[each.name].to_numpy() for each in fields(cls)))

    def position_at(self, time_s: np.ndarray) -> np.ndarray:
        """Return the positions (m) at other times (s), by linear interpolation between samples."""
        return np.interp(time_s, self.time_s, self.position_m)


def from_positions(time_s: np.ndarray, position_m: np.ndarray) -> RegularMotion:
    """Return the motion of positions on a regular clock: speed and acceleration are central differences.

    ValueError for a single position.
    """
    if len(time_s) < 2:
        raise ValueError(f"{len(time_s)} position has no speed. Give at least two.")
    speed = np.gradient(position_m, time_s)
    return RegularMotion(time_s, position_m, speed, np.gradient(speed, time_s))


def position_error_rate(motion: RegularMotion, time_s: np.ndarray, position_m: np.ndarray) -> float:
    """Return the paper's average positional error rate: mean |p − data| over the trajectory's length (1).

    NaN for a track that does not move.
    """
    length = float(np.abs(np.diff(position_m)).sum())
    error = float(np.abs(motion.position_at(time_s) - position_m).mean())
    return error / length if length > 0 else float("nan")


def implausible(motion: RegularMotion) -> bool:
    """Tell whether any |acceleration| exceeds 10 m/s²."""
    return bool((np.abs(motion.accel_mps2) > IMPLAUSIBLE_MPS2).any())


@dataclass
class Tally:
    """Sums over trajectories, from which the row of a table is made; merging chunks is adding."""

    tracks: int = 0
    moving: int = 0
    rate: float = 0.0
    samples: int = 0
    accel: float = 0.0
    accel_square: float = 0.0
    implausible: int = 0
    seconds: float = 0.0

    def add(self, motion: RegularMotion, time_s: np.ndarray, position_m: np.ndarray) -> None:
        """Count one trajectory against its data."""
        rate = position_error_rate(motion, time_s, position_m)
        self.tracks += 1
        if np.isfinite(rate):
            self.moving += 1
            self.rate += rate
        size = np.abs(motion.accel_mps2)
        self.samples += len(size)
        self.accel += float(size.sum())
        self.accel_square += float((size * size).sum())
        self.implausible += implausible(motion)

    def merge(self, other: Tally) -> None:
        """Add another tally, of another chunk."""
        for name, value in vars(other).items():
            setattr(self, name, getattr(self, name) + value)

    def row(self) -> dict[str, float | int]:
        """Return the row of a report."""
        mean = self.accel / self.samples if self.samples else float("nan")
        spread = max(self.accel_square / self.samples - mean * mean, 0.0) ** 0.5 if self.samples else float("nan")
        return {
            "trajectories": self.tracks,
            "position_error_rate_percent": 100.0 * self.rate / self.moving if self.moving else float("nan"),
            "accel_mean_mps2": mean,
            "accel_std_mps2": spread,
            "implausible_percent": 100.0 * self.implausible / self.tracks if self.tracks else float("nan"),
            "milliseconds_per_trajectory": 1e3 * self.seconds / self.tracks if self.tracks else float("nan"),
        }
