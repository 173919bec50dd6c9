"""Several data sets: one folder each, one table, and a set that cannot be used costs no other."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import polars as pl
import pytest

from idm_env.data import DataError
from idm_env.data.load import files_of
from idm_env.discovery import sets
from idm_env.jobs.executor import opened


def drives(folder: Path) -> list[Path]:
    """Three files, of which the second is none."""
    folder.mkdir()
    for name in ("a.csv", "b.csv", "c.csv.gz"):
        (folder / name).write_text(name)
    return sorted(folder.iterdir())


def test_folders_and_patterns_are_files_in_order_and_each_once(tmp_path: Path) -> None:
    """A quoted pattern is the same on every shell."""
    files = drives(tmp_path / "drives")
    (tmp_path / "drives" / "notes.txt").write_text("none")
    assert files_of([tmp_path / "drives"]) == files
    assert files_of([tmp_path / "drives" / "*.csv", files[0], files[2]]) == files
    assert files_of([tmp_path / "absent.csv"]) == [tmp_path / "absent.csv"]  # whoever reads it says so
    for nothing in (tmp_path / "drives" / "*.parquet", tmp_path / "empty"):
        (tmp_path / "empty").mkdir(exist_ok=True)
        with pytest.raises(DataError, match="holds no data set"):
            files_of([nothing])


def test_every_set_has_its_row_and_a_resumed_run_does_none_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever one set is stopped by."""
    files = drives(tmp_path / "drives")
    asked: list[str] = []

    def explained(path: Path, out: Path, question: sets.Question, **_: Any) -> tuple[dict[str, Any], tuple[str, ...]]:
        asked.append(path.name)
        if path.name == "b.csv":
            raise DataError("b.csv: no known layout")
        if path.name == "c.csv.gz" and len(asked) == 3:
            raise KeyboardInterrupt
        error = {"before": {"gap_rmse_m": 2.0}, "after": {"gap_rmse_m": 1.0}}
        return {
            "verdict": "named", "sentence": "late", "found": [{"effect": "delay", "label": ""}], "partial": None,
            "error": error,
        }, ()  # fmt: skip

    monkeypatch.setattr(sets, "explain", explained)
    out = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        sets.explain_sets(files, out, sets.Question())
    rows = sets.explain_sets(files, out, sets.Question(), resume=True)
    assert asked == ["a.csv", "b.csv", "c.csv.gz", "c.csv.gz"]
    assert [row["verdict"] for row in rows] == ["named", "not done", "named"]
    table = pl.read_csv(out / "sets.csv")
    assert table["folder"].to_list() == ["a", "b", "c"] and table["gap_rmse_after_m"].to_list() == [1.0, None, 1.0]
    assert "no known layout" in (out / "report.html").read_text()
    with opened("serial") as executor:
        same = sets.explain_sets([files[0], tmp_path / "drives" / "a.csv"], out, sets.Question(), executor=executor)
    assert [row["folder"] for row in same] == ["a", "a-2"]
