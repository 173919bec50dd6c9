"""The commands filter, reconstruct and predict as a user runs them: output, progress, one line for what is wrong."""

from __future__ import annotations

import json
from pathlib import Path

import polars as pl
import pytest

from tests.commands import typed
from tests.prediction import scenes
from tests.prediction.test_womd import write_json
from tests.trajectories.test_files import OUTPUT, lane

pytest.importorskip("numba", reason="numba is not installed")


def methods(out: Path) -> list[str]:
    return [row["method"] for row in json.loads((out / "report.json").read_text())["methods"]]


def test_filter_and_its_ablation(tmp_path: Path) -> None:
    path = lane(tmp_path / "lane.csv", vehicles=3, seconds=15.0)
    done = typed("filter", path, "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert {p.name for p in (tmp_path / "out").iterdir()} == OUTPUT
    assert "3/3" in done.stderr + done.stdout  # the progress at its end
    assert "Data: repaired: length assumed 3, leaders derived 2." in done.stderr.splitlines()
    named = methods(tmp_path / "out")
    assert named[0] == "simulator, imagined leader" and {"linear", "Savitzky–Golay", "bounded spline"} <= set(named)
    assert "Driver parameters" in (tmp_path / "out" / "report.html").read_text()
    fixed = typed("filter", path, "--out", tmp_path / "fixed", "--fixed-parameters")
    assert fixed.returncode == 0, fixed.stderr
    assert pl.read_parquet(tmp_path / "fixed" / "parameters.parquet").is_empty()
    assert "Driver parameters" not in (tmp_path / "fixed" / "report.html").read_text()
    paper = typed("filter", path, "--out", tmp_path / "paper", "--recipe", "paper")
    assert paper.returncode == 0 and methods(tmp_path / "paper")[0] == "the paper's recipe"


def test_reconstruct_with_holes_and_missing_rows(tmp_path: Path) -> None:
    path = lane(tmp_path / "sparse.csv", vehicles=2, seconds=60.0, every=20)
    pl.read_csv(path).filter(pl.int_range(pl.len()) % 5 != 3).write_csv(path)
    done = typed("reconstruct", path, "--dt", 0.2, "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    table = pl.read_parquet(tmp_path / "out" / "trajectories.parquet")
    steps = table.group_by("vehicle_id").agg(pl.col("time_s").diff().drop_nulls().round(6).unique())
    assert steps["time_s"].to_list() == [[0.2], [0.2]] and table["piece"].unique().to_list() == [0]


def test_predict_does_the_whole_records_of_a_truncated_file(tmp_path: Path) -> None:
    pytest.importorskip("idm_env.data.womd_record")
    pytest.importorskip("google.protobuf", reason="protobuf is not installed")
    record = scenes.frame(scenes.as_record([0]))
    (tmp_path / "cut.tfrecord").write_bytes(record + record[:-9])
    files = tmp_path / "cut.tfrecord", write_json(tmp_path / "old.json"), tmp_path / "missing.json"
    done = typed("predict", *files, "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert "Data: 2 bad files: cut.tfrecord, missing.json." in done.stderr.splitlines()
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["scenarios"] == 2 and report["agents"] == 5
    reasons = [item["reason"] for item in report["left_out"]]
    assert len(reasons) == 2 and "truncated in record 1" in reasons[0] and "does not exist" in reasons[1]
    assert "truncated in record 1" in (tmp_path / "out" / "report.html").read_text()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("filter", "missing.csv"), "missing.csv does not exist"),
        (("filter", "lane.csv", "--recipe", "papers"), "--recipe = 'papers' is unknown. Did you mean 'paper'?"),
        (("reconstruct", "lane.csv", "--dt", "9"), "--dt = 9 s is outside [0.01, 2] s"),
        (("predict", "broken.json"), "broken.json cannot be read (Expecting property name"),
    ],
)
def test_what_is_wrong_is_one_line(tmp_path: Path, arguments: tuple[str, ...], words: str) -> None:
    lane(tmp_path / "lane.csv", vehicles=1, seconds=5.0)
    (tmp_path / "broken.json").write_text("{")
    name, file, *more = arguments
    done = typed(name, tmp_path / file, *more, "--out", tmp_path / "out")
    assert done.returncode == 1 and not (tmp_path / "out" / "idm-env-unfinished").exists()
    (line,) = [line for line in done.stderr.strip().splitlines() if line.startswith("error:")]
    assert words in line
