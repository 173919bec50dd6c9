"""Drivers who drift: how much and for how long, which of their numbers, and forecasts that follow it."""

from idm_env.extras import needed

with needed("estimating drift"):
    import polars  # noqa: F401
    import scipy  # noqa: F401
