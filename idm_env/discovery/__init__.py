"""Finds the effect that a model lacks: residual → ranked candidates → corrected model → error before and after.

Needs the extras ``data`` and ``kernels``.
"""

from idm_env.extras import needed

with needed("explaining"):
    from idm_env.discovery.discover import discover
    from idm_env.discovery.finish import Discovery
    from idm_env.discovery.write import write_report

__all__ = ["Discovery", "discover", "write_report"]
