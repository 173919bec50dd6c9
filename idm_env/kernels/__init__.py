"""Fused CPU kernels for the common simulators, compiled by numba: a second source of ``Simulator.step``'s mathematics.

Values and gradients agree with the torch path to rounding, and parity tests hold both together. Values are the same
bits with and without a graph: which path runs never depends on ``requires_grad``.
Importing this package imports no numba; its modules do. The first rollout of a precision compiles: 10 s of one core
forward and 10 s backward, kept on disk (numba's cache, beside the package or in ``NUMBA_CACHE_DIR``); in later
processes it costs half a second (2 cores, AMD EPYC, AVX-512, November 2026). For those who change a kernel: numba
notices a change of the file that holds a function, not of one that it calls, so delete ``*.nbi`` after editing
``equations.py``.
"""

from __future__ import annotations

from importlib.util import find_spec


def available() -> bool:
    """Return whether numba is installed (``pip install 'idm-env[kernels]'``)."""
    return find_spec("numba") is not None
