"""The test settings themselves: who leaves a file open fails, and nobody else does."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TESTS = """
class Holder:
    pass

def test_cycle(tmp_path):
    holder = Holder()
    holder.itself, holder.file = holder, open(tmp_path / "x", "w")

def test_dropped(tmp_path):
    open(tmp_path / "x", "w")

def test_closed(tmp_path):
    open(tmp_path / "x", "w").close()
"""


def test_a_file_left_open_is_an_error_where_it_arises(tmp_path: Path) -> None:
    """Both where the file is dropped at once and where only the collector of garbage finds it."""
    for name in ("pyproject.toml", "tests/conftest.py"):
        shutil.copy(ROOT / name, tmp_path)
    (tmp_path / "test_leaks.py").write_text(TESTS)
    told = subprocess.run(
        [sys.executable, "-m", "pytest", "-rA", "test_leaks.py"], cwd=tmp_path, capture_output=True, text=True
    ).stdout
    assert "ERROR test_leaks.py::test_cycle" in told
    assert "FAILED test_leaks.py::test_dropped" in told
    assert "PASSED test_leaks.py::test_closed" in told
    assert "ERROR test_leaks.py::test_closed" not in told
