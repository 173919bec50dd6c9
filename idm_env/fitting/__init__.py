"""Fits: parameters of a car-following model from trajectories, by gradients through the simulator."""

from idm_env.extras import needed

with needed("a fit"):
    import polars  # noqa: F401
    import scipy  # noqa: F401
