"""The compiler of the loops: filtering and reconstruction have no other path, and say so where numba is missing."""

from __future__ import annotations

try:
    import numba
except ImportError:
    raise ImportError(
        "filtering, reconstruction and the paper's recipe are compiled loops and need numba. Install it with: "
        "pip install 'idm-env[kernels]'"
    ) from None

compiled = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
