"""The compiler of the loops: filtering and reconstruction have no other path, and say so where numba is missing."""

from __future__ import annotations

from idm_env.extras import needed

with needed("filtering or reconstruction"):
    import numba  # noqa: F401

from idm_env.kernels.compiler import compiler

compiled = compiler(fastmath={"contract"})
