"""Filtering in parts: whoever does them, the trajectories are the same bytes; chunks end where runs do."""

from __future__ import annotations

from pathlib import Path

import polars as pl
import pytest

from idm_env.jobs.executor import opened
from idm_env.trajectories import files
from idm_env.trajectories.spool import Spool, _borders
from tests.trajectories.test_files import lane

WRITTEN = ("trajectories.parquet", "parameters.parquet")


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three runs of two vehicles, and one of five, whose chunks have to wait for each other."""
    folder = tmp_path_factory.mktemp("runs")
    tables = []
    for run, vehicles in enumerate((2, 2, 5, 2)):
        lane(folder / "lane.csv", vehicles=vehicles, seconds=12.0)
        tables.append(pl.read_csv(folder / "lane.csv").with_columns(pl.lit(run).alias("run_id")))
    pl.concat(tables).write_parquet(folder / "runs.parquet")
    return folder / "runs.parquet"


def test_chunks_end_where_runs_do_unless_a_run_is_longer(runs: Path, tmp_path: Path) -> None:
    """And what belongs to one run is one strand."""
    assert _borders(["a", "a", "b", "b", "c"], 4) == (0, 4, 5)
    assert _borders(["a", "b", "b", "b", "c"], 2) == (0, 1, 3, 5)
    assert _borders(["a"] * 5, 2) == (0, 2, 4, 5)
    spool = Spool(runs, tmp_path / "spool", 2)
    assert spool.shelf.borders == (0, 2, 4, 6, 8, 9, 11)
    assert spool.strands() == [(0,), (1,), (2, 3, 4), (5,)]
    assert [spool.shelf.table(n)["vehicle_id"].n_unique() for n in range(6)] == [2, 2, 2, 2, 1, 2]


def test_processes_and_folders_give_the_bytes_of_one_process_and_file(runs: Path, tmp_path: Path) -> None:
    """Runs in any order, each read from wherever its rows lie."""
    files.filter_file(runs, tmp_path / "serial", baselines=False, chunk=2)
    whole = [(tmp_path / "serial" / name).read_bytes() for name in WRITTEN]
    with opened("processes", 2) as executor:
        files.filter_file(runs, tmp_path / "processes", baselines=False, chunk=2, executor=executor)
    assert [(tmp_path / "processes" / name).read_bytes() for name in WRITTEN] == whole
    (tmp_path / "folder").mkdir()
    table = pl.read_parquet(runs)
    for number, part in enumerate(table.iter_slices(1 + table.height // 3)):
        part.write_parquet(tmp_path / "folder" / f"{number}.parquet")
    files.filter_file(tmp_path / "folder", tmp_path / "out", baselines=False, chunk=2)
    assert [(tmp_path / "out" / name).read_bytes() for name in WRITTEN] == whole
