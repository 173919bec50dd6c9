"""Prediction of road users over the next seconds, by drivers of the simulator on the lanes ahead of them."""

from idm_env.extras import needed

with needed("prediction"):
    import polars  # noqa: F401
    import scipy  # noqa: F401
