"""Compiled loops are never those of another day."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("numba")

from idm_env.data import synthetic

PACKAGE = Path(__file__).parents[2] / "idm_env"
PROBE = """
from idm_env.compiled.kernels import caller
print(caller.twice(3))
"""
CALLER = """
from idm_env.compiled.kernels.callee import value
from idm_env.compiled.kernels.tiles import exact


@exact
def twice(x):
    return 2 * value(x)
"""
CALLEE = """
from idm_env.compiled.kernels.compiler import apart, compiler


@{how}
def value(x):
    return x + {added}
"""


@pytest.mark.parametrize("how", ["compiler()", "apart"])
def test_a_change_in_a_function_that_a_loop_calls_is_noticed(tmp_path, how):
    """Numba itself looks only at the file of the outermost function. Code optimised less than usual is other code."""
    copy = tmp_path / "idm_env"
    shutil.copytree(PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    (copy / "compiled" / "kernels" / "caller.py").write_text(CALLER)
    callee = copy / "compiled" / "kernels" / "callee.py"
    environment = {**os.environ, "PYTHONPATH": str(tmp_path), "IDM_ENV_CACHE": str(tmp_path / "cache")}
    environment.pop("NUMBA_CACHE_DIR", None)

    def run():
        done = subprocess.run(
            [sys.executable, "-c", PROBE], env=environment, cwd=tmp_path, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
        return int(done.stdout)

    callee.write_text(CALLEE.format(added=1, how=how))
    assert run() == 8
    compiled = sorted((tmp_path / "cache").rglob("*.nbc"))
    assert run() == 8
    assert compiled and sorted((tmp_path / "cache").rglob("*.nbc")) == compiled  # used again
    environment["NUMBA_OPT"] = "0"
    assert run() == 8 and set((tmp_path / "cache").rglob("*.nbc")) > set(compiled)
    callee.write_text(CALLEE.format(added=100, how=how))
    assert run() == 206


def test_a_command_runs_on_a_damaged_cache_and_heals_it(tmp_path):
    """Each kind of file, damaged in each way: cut, empty, zeros."""
    table = synthetic.generate(2, runs=2, followers=1, seconds=20.0)[0].table
    table.drop("gap_m").write_csv(tmp_path / "data.csv")
    cache = tmp_path / "cache"
    environment = {**os.environ, "IDM_ENV_CACHE": str(cache)}
    environment.pop("NUMBA_CACHE_DIR", None)

    def run():
        command = [sys.executable, "-m", "idm_env", "simulate", tmp_path / "data.csv", "--base", "idm"]
        done = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return done.stderr, (tmp_path / "out" / "simulate" / "report.json").read_bytes()

    _, report = run()
    damaged = []
    for kind in ("py", "nbc"):
        files = sorted(cache.glob(f"*.{kind}"))
        assert len(files) >= (1 if kind == "py" else 3)
        for number, path in enumerate(files):
            kept = path.read_bytes()
            path.write_bytes((kept[: len(kept) // 2], b"", bytes(len(kept)))[number % 3])
            damaged.append(path)
    told, again = run()
    assert again == report and "Traceback" not in told
    assert all(path.stat().st_size and not path.read_bytes().startswith(bytes(99)) for path in damaged)
    lines = [line for line in told.splitlines() if "is damaged (" in line]
    assert lines and all(line.count(str(cache)) == 1 for line in lines)
