"""Several files are one data set: each is a run, for every command, and one that does not fit is named."""

from __future__ import annotations

from pathlib import Path

import polars as pl
import pytest
import typer

from idm_env.cli import commands as cli
from idm_env.data import DataError, load
from idm_env.data.joined import joined
from tests.commands import refused, run
from tests.data.tables import kinds, platoon

COMMANDS = typer.main.get_command(cli.app).commands  # type: ignore[attr-defined]


def recordings(folder: Path) -> list[Path]:
    """The same three cars twice: with their own run, without one and in feet per second; and other files."""
    folder.mkdir()
    platoon().write_csv(folder / "01.csv")
    mph = platoon().drop("run_id").with_columns(speed_mph=pl.col("speed_mps") / 0.44704).drop("speed_mps")
    mph.write_csv(folder / "02_tracks.csv")
    (folder / "notes.txt").write_text("by hand")
    return [folder / "01.csv", folder / "02_tracks.csv"]


def test_each_file_is_a_run_and_the_rest_is_as_in_one_file(tmp_path: Path) -> None:
    files = recordings(tmp_path / "drives")
    before = [path.read_bytes() for path in files]
    for paths in (files, [tmp_path / "drives"], [tmp_path / "drives" / "*.csv"], [*files, files[0]]):
        found = load(joined(paths))
        assert found.runs() == ["01:a", "02_tracks"]
        assert kinds(found.repairs)["unit converted"] == 1
        alone = [load(path).table for path in files]
        for run_id, table in zip(found.runs(), alone, strict=True):
            rows = found.table.filter(pl.col("run_id") == run_id)
            assert rows["gap_m"].equals(table["gap_m"]) and rows["leader_id"].equals(table["leader_id"])
            assert (rows["speed_mps"] - table["speed_mps"]).abs().max() < 1e-9  # type: ignore[operator]
    assert [path.read_bytes() for path in files] == before
    assert joined([files[0]]) == files[0]


def test_what_does_not_fit_the_others_is_named(tmp_path: Path) -> None:
    one, two = recordings(tmp_path / "drives")
    platoon().drop("leader_id").write_csv(two)
    with pytest.raises(DataError, match=r"02_tracks\.csv lacks the column leader_id of 01\.csv"):
        joined([one, two])
    platoon().drop("vehicle_id").write_csv(two)
    assert "02_tracks.csv: column 'vehicle_id' is missing" in refused("fit", one, two, "--out", tmp_path / "out")
    assert "does not exist" in refused("filter", one, tmp_path / "3.csv", "--out", tmp_path / "out")
    (one.parent / "run.json").write_text("{}")  # of our results
    platoon().write_csv(two)
    assert "lies in --out" in refused("filter", one, two, "--out", one.parent)


def test_every_command_takes_several_files(tmp_path: Path) -> None:
    """``fit``, ``filter`` and the others get them as one path, as these do."""
    files = recordings(tmp_path / "drives")
    code, said = run("plot", *files, "--out", tmp_path / "out.png")
    assert code == 0 and "unit converted 1" in said
    assert "01.csv and 1 more" in refused("explain", *files, "--out", tmp_path / "out")
    assert run("explain", tmp_path / "drives", "--each", "--out", tmp_path / "each")[0] == 0
    assert pl.read_csv(tmp_path / "each" / "sets.csv")["folder"].to_list() == ["01", "02_tracks"]
    takes = {name: {p.name: p.nargs for p in command.params} for name, command in COMMANDS.items()}
    several = {name for name, nargs in takes.items() if -1 in (nargs.get("data"), nargs.get("source"))}
    assert several == {"plot", "filter", "reconstruct", "fit", "explain", "simulate", "drift"}
