"""Every example runs to its end; each asserts what it shows."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import warnings
from pathlib import Path

import pytest

from tests.test_wheel import LONG

FOLDER = Path(__file__).resolve().parents[1] / "examples"
EXAMPLES = [path for path in sorted(FOLDER.glob("*.py")) if path.stem not in LONG]
"""All but those that tests/test_wheel.py runs, from the wheel."""
NEEDS = {
    "train_rllib": {"tree": "RLlib pins another gymnasium and has an environment of its own: make rllib"},
    "export_minari": {"minari": "minari is not installed (pip install 'minari[create,hdf5]')"},
    "train_approach": {"cma": "cma is not installed (pip install cma)"},
    "train_merge": {"cma": "cma is not installed (pip install cma)"},
    "tune_an_agent": {"ray": "ray is not installed (pip install 'idm-env[ray]')"},
}
"""Modules without which an example is left out, and what to do."""
SHORTER = {"train_approach": ("1", "2"), "train_merge": ("1", "10")}
"""Arguments of an example that takes minutes: turns, and episodes of each."""


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda p: p.stem)
def test_example(path: Path, tmp_path: Path) -> None:
    """Run as a user does, from another folder."""
    for module, why in NEEDS.get(path.stem, {}).items():
        if importlib.util.find_spec(module) is None:
            warnings.warn(f"{path.name} is not run: {why}", stacklevel=1)
            pytest.skip(why)
    done = subprocess.run(
        [sys.executable, str(path), *SHORTER.get(path.stem, ())], capture_output=True, text=True, cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip()
