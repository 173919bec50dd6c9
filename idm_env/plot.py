"""Pictures of traffic for teaching, by the name that users import: ``idm_env.plot.fundamental_diagram``."""

from idm_env.reports.plot import animate, edie, fundamental_diagram

__all__ = ["animate", "edie", "fundamental_diagram"]
