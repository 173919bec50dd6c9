"""Compiled loops are never those of another day."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("numba")

PACKAGE = Path(__file__).parents[2] / "idm_env"
PROBE = """
from idm_env.kernels import caller
print(caller.twice(3))
"""
CALLER = """
from idm_env.kernels.callee import value
from idm_env.kernels.tiles import exact


@exact
def twice(x):
    return 2 * value(x)
"""
CALLEE = """
from idm_env.kernels.tiles import exact


@exact
def value(x):
    return x + {added}
"""


def test_a_change_in_a_function_that_a_loop_calls_is_noticed(tmp_path):
    """Numba itself looks only at the file of the outermost function."""
    copy = tmp_path / "idm_env"
    shutil.copytree(PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    (copy / "kernels" / "caller.py").write_text(CALLER)
    callee = copy / "kernels" / "callee.py"
    environment = {**os.environ, "PYTHONPATH": str(tmp_path), "IDM_ENV_CACHE": str(tmp_path / "cache")}
    environment.pop("NUMBA_CACHE_DIR", None)

    def run():
        done = subprocess.run(
            [sys.executable, "-c", PROBE], env=environment, cwd=tmp_path, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
        return int(done.stdout)

    callee.write_text(CALLEE.format(added=1))
    assert run() == 8
    compiled = sorted((tmp_path / "cache").rglob("*.nbc"))
    assert run() == 8
    assert compiled and sorted((tmp_path / "cache").rglob("*.nbc")) == compiled  # used again
    callee.write_text(CALLEE.format(added=100))
    assert run() == 206
