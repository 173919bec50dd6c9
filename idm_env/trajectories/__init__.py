"""Filtering and reconstruction: measured positions to physical trajectories, by the simulator and its imagined inputs.

The step from positions to accelerations is a fit of the inputs that the model does not explain: an imagined leader's
gap and closing speed at every step, smooth in time, under the vehicle's exact bounds.
"""

from idm_env.extras import needed

with needed("filtering or reconstruction"):
    import polars  # noqa: F401
    import scipy  # noqa: F401
