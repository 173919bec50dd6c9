"""Wrappers around the environments: statistics that keep gradients, and parameters to be fitted."""

from __future__ import annotations

from idm_env.wrappers.fitting import ParameterFitting
from idm_env.wrappers.statistics import (
    NormalizeObservation,
    RecordEpisodeStatistics,
    VectorNormalizeObservation,
    VectorRecordEpisodeStatistics,
)

__all__ = [
    "NormalizeObservation",
    "ParameterFitting",
    "RecordEpisodeStatistics",
    "VectorNormalizeObservation",
    "VectorRecordEpisodeStatistics",
]
