"""Live benchmarks are commands; rows that are done are kept; what the lanes benchmark does not take."""

from __future__ import annotations

import argparse
import importlib
from pathlib import Path

import pytest

from benchmarks import lanes, named_rows
from idm_env.jobs.progress import OnProgress

COMMANDS = sorted(p.stem for p in (Path(__file__).parents[1] / "benchmarks").glob("*.py") if p.stem != "__init__")


@pytest.mark.parametrize("name", COMMANDS)
def test_every_live_benchmark_is_imported_and_is_a_command(name: str) -> None:
    assert callable(importlib.import_module(f"benchmarks.{name}").main)


def _squared(part: int, on_progress: OnProgress) -> int:
    return part * part


def _refused(part: int, on_progress: OnProgress) -> int:
    raise AssertionError("was done before")


def test_rows_are_kept_and_not_done_again(tmp_path: Path) -> None:
    given = argparse.Namespace(executor="serial", jobs=None, ray_address=None)
    rows = {"two": 2, "three": 3}
    at = tmp_path / "out" / "rows.jsonl"
    for work in (_squared, _refused):
        assert named_rows(work, rows, at, given) == {"two": 4, "three": 9}
    with pytest.raises(AssertionError, match="was done before"):
        named_rows(_refused, {"two": 5}, at, given)  # the same name, other settings
    assert named_rows(_squared, {"two": 5, "three": 3}, at, given) == {"two": 25, "three": 9}
    assert named_rows(_refused, {"two": 5, "three": 3}, at, given) == {"two": 25, "three": 9}
    at.write_text('{"name": "three", "found": 7}\n')  # as files were written before
    assert named_rows(_squared, rows, at, given) == {"two": 4, "three": 9}


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("laws x", "argument steps: 'x' is no number of 1000 or more. Usual is 1e9."),
        ("laws nan", "argument steps: 'nan' is no number of 1000 or more. Usual is 1e9."),
        ("flow fast", "unrecognized arguments: fast"),
        ("speed rings", "(choose from 'rollouts', 'highway')"),
        ("laws 1000 --jobs 2", "unrecognized arguments: --jobs 2"),
        ("merge", "(choose from 'speed', 'flow', 'standing', 'laws')"),
    ],
)
def test_what_would_not_be_heeded_is_refused_in_one_line(
    words: str, says: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["lanes", *words.split()])
    with pytest.raises(SystemExit, match="2"):
        lanes.main()
    assert capsys.readouterr().err.splitlines()[-1].endswith(says)
