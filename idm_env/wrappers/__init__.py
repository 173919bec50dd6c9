"""Wrappers around the environments: statistics that keep gradients, and parameters to be fitted."""

from idm_env.wrappers.fitting import ParameterFitting as ParameterFitting
from idm_env.wrappers.statistics import (
    VectorNormalizeObservation as VectorNormalizeObservation,
    VectorRecordEpisodeStatistics as VectorRecordEpisodeStatistics,
)
