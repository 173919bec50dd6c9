"""Where numba is not installed: filtering says so in one line, prediction runs by torch."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from idm_env.prediction.predict import METHODS
from tests.prediction.test_womd import write_json
from tests.trajectories.test_files import lane

ABSENT = """
import sys, importlib.util as u
sys.modules["numba"] = None
real = u.find_spec
u.find_spec = lambda name, *more: None if name == "numba" else real(name, *more)
sys.argv = ["idm-env", *sys.argv[1:]]
from idm_env.cli.commands import run
run()
"""


def command(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", ABSENT, *map(str, arguments)], capture_output=True, text=True, check=False
    )  # fmt: skip


@pytest.mark.parametrize(
    ("name", "work"),
    [
        ("filter", "filtering or reconstruction"), ("reconstruct", "filtering or reconstruction"),
        ("drift", "estimating drift"),
    ],
)  # fmt: skip
def test_a_command_names_itself_and_the_extra(tmp_path: Path, name: str, work: str) -> None:
    done = command(name, lane(tmp_path / "lane.csv", vehicles=3, seconds=30.0), "--out", tmp_path / "out")
    assert done.returncode == 1
    line = done.stderr.strip().splitlines()[-1]
    assert line == f"error: {work} needs numba. Install it with: pip install 'idm-env[kernels]'"
    assert not (tmp_path / "out").exists()


def test_prediction_goes_on_by_torch(tmp_path: Path) -> None:
    pytest.importorskip("google.protobuf", reason="protobuf is not installed")
    done = command("predict", write_json(tmp_path / "fork.json", wanted=[0, 1]), "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    rows = json.loads((tmp_path / "out" / "report.json").read_text())["methods"]
    assert [row["method"] for row in rows] == list(METHODS)
