"""Kernels are compiled afresh where their source has changed: numba looks at one file's date, not at what it calls."""

import hashlib
import os
import tempfile
from pathlib import Path

import pytest

pytest.importorskip("numba")
import numba

_sources = sorted((Path(__file__).parents[2] / "idm_env" / "kernels").glob("*.py"))
_digest = hashlib.sha256(b"".join(p.read_bytes() for p in _sources)).hexdigest()[:16]
numba.config.CACHE_DIR = os.path.join(tempfile.gettempdir(), f"idm_env-kernels-{_digest}")
