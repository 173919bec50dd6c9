"""Fits in parts: whoever does them, and whatever becomes of workers, the files are the same bytes."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import polars as pl
import pytest
import torch

from idm_env.data import DataError, synthetic
from idm_env.fitting import pictures, pieces
from idm_env.fitting.job import fit_file, simulate_file
from idm_env.fitting.options import Options, Source
from idm_env.jobs import storage
from idm_env.jobs.executor import PartsError, opened
from idm_env.reports import page

FILES = ("parameters.parquet", "drivers.csv", "model.yaml")
"""What no executor may change a byte of; the reports have the command in them."""
SOURCE = {"min_seconds": 5.0}
OPTIONS = Options(starts=2, substeps=1)


@pytest.fixture(autouse=True, scope="module")
def no_pictures() -> Iterator[None]:
    """Pictures take most of the time of so small a fit, and test_job looks at them."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("examples", "residuals", "parameters"):
            patch.setattr(pictures, name, lambda *_: page.Block("text", "a picture"))
        patch.setattr(pictures, "space_time", lambda *_: [])
        yield


@pytest.fixture(scope="module")
def table() -> pl.DataFrame:
    """Six generated runs of two followers, 20 s."""
    made, _ = synthetic.generate(5, runs=6, followers=2, seconds=12.0)
    return made.table.drop("gap_m", "gap_measured")


@pytest.fixture(scope="module")
def folder(table: pl.DataFrame, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The runs as a folder of parquet files whose borders are not those of the runs."""
    path = tmp_path_factory.mktemp("data") / "drive"
    path.mkdir()
    for number, rows in enumerate(table.iter_slices(1 + table.height // 4)):
        rows.write_parquet(path / f"{number}.parquet")
    return path


def content(out: Path) -> dict[str, bytes]:
    """Return the bytes of what was fitted."""
    return {name: (out / name).read_bytes() for name in FILES}


def fitted(path: Path, out: Path, kind: str = "serial", **more: Any) -> dict[str, bytes]:
    """Fit in parts of four drivers; a folder is cut by vehicles, leaders among them."""
    with opened(kind, 2) as executor:
        fit_file(Source(path, **SOURCE), OPTIONS, out, part=6 if path.is_dir() else 4, executor=executor, **more)
    assert {p.name for p in out.iterdir()} == {*FILES, "report.json", "report.html", "run.json"}
    return content(out)


@pytest.fixture(scope="module")
def whole(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The folder fitted undisturbed, one part after the other, with two threads."""
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        return fitted(folder, tmp_path_factory.mktemp("whole"))
    finally:
        torch.set_num_threads(threads)


def test_processes_give_the_bytes_of_one_process(folder: Path, whole: dict[str, bytes], tmp_path: Path) -> None:
    """With one thread each, and parts done in any order."""
    assert fitted(folder, tmp_path, "processes") == whole


def test_a_folder_is_fitted_as_the_file_of_all_its_rows(
    table: pl.DataFrame, folder: Path, whole: dict[str, bytes], tmp_path: Path
) -> None:
    """Runs are cut alike, wherever their rows lie; hive folders, too."""
    table.write_parquet(tmp_path / "drive.parquet")
    assert fitted(tmp_path / "drive.parquet", tmp_path / "file")["drivers.csv"] == whole["drivers.csv"]
    for (run,), rows in table.partition_by("run_id", as_dict=True, include_key=False).items():
        (tmp_path / "hive" / f"run_id={run}").mkdir(parents=True)
        rows.write_parquet(tmp_path / "hive" / f"run_id={run}" / "rows.parquet")
    assert fitted(tmp_path / "hive", tmp_path / "other")["drivers.csv"] == whole["drivers.csv"]
    report = json.loads((tmp_path / "other" / "report.json").read_text())
    assert report["data"]["runs"] == 6 and report["data"]["followers"] == 12 and report["fit"]["groups"] == 12
    seen = simulate_file(
        Source(tmp_path / "drive.parquet", **SOURCE), tmp_path / "other" / "model.yaml", tmp_path / "s"
    )
    assert "fitted on these data" in seen["fitted_on"]["words"] and seen["drivers_with_own_parameters"] == 12


def test_a_part_that_raises_is_named_and_the_run_goes_on_from_the_others(
    folder: Path, whole: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing is done twice."""
    done: list[str] = []
    fit = pieces.fit

    def broken(items: Any, **options: Any) -> Any:
        done.append(items[0].run_id)
        if any(e.run_id == "3" and e.vehicle_id == "3" for e in items) and len(done) < 4:
            raise ZeroDivisionError("driver 3/3")
        return fit(items, **options)

    monkeypatch.setattr(pieces, "fit", broken)
    told = r"1 of 3 parts failed \(runs 3 to 4: ZeroDivisionError: driver 3/3\)"
    with pytest.raises(PartsError, match=told):
        fitted(folder, tmp_path)
    assert done == ["1", "3", "5"] and (tmp_path / storage.UNFINISHED / "fit-parts").exists()
    assert fitted(folder, tmp_path, resume=True) == whole
    assert done == ["1", "3", "5", "3"]


def test_storage_that_fills_up_ends_the_run_and_a_resumed_one_is_the_same(
    folder: Path, whole: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Half a file never counts."""
    write = pl.DataFrame.write_parquet
    written: list[Path] = []

    def full(frame: pl.DataFrame, path: Path, **more: Any) -> None:
        written.append(path)
        write(frame, path, **more)
        if len(written) == 5:
            path.write_bytes(path.read_bytes()[:100])
            raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(pl.DataFrame, "write_parquet", full)
        with pytest.raises(OSError, match=r"cannot be written: No space left on device\. Free space"):
            fitted(folder, tmp_path)
    assert not list(tmp_path.rglob("*idm-env-part*"))
    assert fitted(folder, tmp_path, resume=True) == whole


def test_a_share_that_cannot_be_read_is_left_out_and_told(table: pl.DataFrame, tmp_path: Path) -> None:
    """Feet in two runs do not cost the others."""
    feet = pl.when(pl.col("run_id").is_in(["3", "4"])).then(pl.col("length_m") * 3.281).otherwise(pl.col("length_m"))
    (tmp_path / "drive").mkdir()
    table.with_columns(feet).write_parquet(tmp_path / "drive" / "a.parquet")
    result = fit_file(Source(tmp_path / "drive", **SOURCE), OPTIONS, tmp_path / "out", part=6)
    assert result["fit"]["groups"] == 8
    assert any("runs 3 to 4" in text and "feet" in text for text in result["data"]["left_out"])


def test_what_a_folder_cannot_give_is_one_line(folder: Path, tmp_path: Path) -> None:
    """Other groups than drivers, runs held out, and folders without files or columns."""
    for options, told in (
        (dataclasses.replace(OPTIONS, by="all"), "by = 'all' needs all rows at once"),
        (dataclasses.replace(OPTIONS, held_out=0.25), "Keep a file back"),
    ):
        with pytest.raises(ValueError, match=told):
            fit_file(Source(folder), options, tmp_path / "out")
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match="without a parquet file"):
        fit_file(Source(tmp_path / "empty"), OPTIONS, tmp_path / "out")
    pl.DataFrame({"vehicle_id": [1], "time_s": [0.0], "speed_mps": [0.0]}).write_parquet(tmp_path / "empty/a.parquet")
    with pytest.raises(DataError, match="column 'position_m' is missing"):
        fit_file(Source(tmp_path / "empty"), OPTIONS, tmp_path / "out")
