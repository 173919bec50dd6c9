"""Measured traffic: files to checked trajectories, trajectories to episodes of one driver behind one leader."""

import importlib
from typing import TYPE_CHECKING, Any

from idm_env.extras import needed

with needed("a trajectory file"):
    from idm_env.data.episode import Episode as Episode, Episodes as Episodes
    from idm_env.data.episodes import episodes as episodes
    from idm_env.data.errors import DataError as DataError, Repair as Repair
    from idm_env.data.load import load as load
    from idm_env.data.records import VehicleRecord as VehicleRecord
    from idm_env.data.schema import LEADER_LOST_GAP_M as LEADER_LOST_GAP_M
    from idm_env.data.smooth import SmoothMotion as SmoothMotion, noise_sigma as noise_sigma, smooth as smooth
    from idm_env.data.trajectories import Trajectories as Trajectories

if TYPE_CHECKING:
    from idm_env.data import synthetic as synthetic


def __getattr__(name: str) -> Any:
    if name == "synthetic":  # a second of scipy, which those who read files do not wait for
        return importlib.import_module("idm_env.data.synthetic")
    raise AttributeError(f"module 'idm_env.data' has no attribute '{name}'")
