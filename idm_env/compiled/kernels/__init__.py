"""Compiled CPU kernels: loops without an equation, around phases that ``scalar`` prints from the recorded step.

Values and gradients agree with the torch path to rounding, and laws over all effects hold both together. Values are the
same bits with and without a graph: which path runs never depends on ``requires_grad``. Importing this package imports
no numba; its modules do. Loops compile once per precision, the phases of a new set of effects in one or two seconds of
one core; both are kept on disk, in the folder of ``scalar.library`` or in ``NUMBA_CACHE_DIR``, under names that are
digests of their text, so nothing has to be deleted after an edit.
"""

from __future__ import annotations

import os
import warnings
from functools import cache
from importlib.util import find_spec

SWITCHED_OFF = os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0")


@cache
def available() -> bool:
    """Return whether numba is installed (``pip install 'idm-env[kernels]'``) and may compile; else warn once."""
    if SWITCHED_OFF:
        warnings.warn("no compiled step, the torch path runs instead: NUMBA_DISABLE_JIT is set.", stacklevel=2)
    return not SWITCHED_OFF and find_spec("numba") is not None


def may_run() -> bool:
    """Return whether kernels are available, and not switched off by ``IDM_ENV_KERNELS=0``."""
    return os.environ.get("IDM_ENV_KERNELS", "1") != "0" and available()
