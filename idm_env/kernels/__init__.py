"""Fused CPU kernels for the common simulators, compiled by numba: a second source of ``Simulator.step``'s mathematics.

Values and gradients agree with the torch path to rounding, and parity tests hold both together. Values are the same
bits with and without a graph: which path runs never depends on ``requires_grad``.
Importing this package imports no numba; its modules do.
"""

from __future__ import annotations

from importlib.util import find_spec


def available() -> bool:
    """Return whether numba is installed (``pip install 'idm-env[kernels]'``)."""
    return find_spec("numba") is not None
