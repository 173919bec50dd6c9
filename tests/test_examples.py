"""Every example runs to its end; each asserts what it shows."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import warnings
from pathlib import Path

import pytest

EXAMPLES = sorted((Path(__file__).resolve().parents[1] / "examples").glob("*.py"))


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda p: p.stem)
def test_example(path: Path, tmp_path: Path) -> None:
    """Run as a user does, from another folder."""
    if path.stem == "train_rllib" and importlib.util.find_spec("tree") is None:  # dm-tree, which only RLlib needs
        warnings.warn("RLlib pins another gymnasium and has an environment of its own: make rllib", stacklevel=1)
        pytest.skip("make rllib")
    done = subprocess.run([sys.executable, str(path)], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip()
