"""A law over all commands that read trajectories and all bad files: one error, word for word, or one reading."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import polars as pl
import pytest
import typer

from idm_env.cli import commands as cli
from idm_env.data import Trajectories
from idm_env.trajectories import files
from idm_env.trajectories.spool import Spool
from tests.commands import run
from tests.data import bad

NO_TRAJECTORIES = {"effects", "doctor", "predict", "network"}
MORE = {"simulate": ("--base", "idm"), "fit --lane-changes": ("--lane-changes",)}
COMMANDS = sorted(
    {typer.main.get_command_name(c.name or c.callback.__name__) for c in cli.app.registered_commands if c.callback}
    - NO_TRAJECTORIES | {"fit --lane-changes"}
)  # fmt: skip
BUILT = typer.main.get_command(cli.app)  # takes longer than most readings: once for all
TRACKS = {"filter", "reconstruct"}


class ReadIt(BaseException):
    """What a command has read, at the place where it would begin to work."""


@pytest.fixture
def read(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Callable[..., object]]:
    """A function of a command and a file: the one line with which it is refused, or what was read."""
    checked = Trajectories.from_frame.__func__  # type: ignore[attr-defined]

    have: list[Trajectories | Spool] = []
    results: dict[str, Trajectories | ValueError] = {}

    def stop(cls: type, frame: pl.DataFrame, **options: object) -> None:
        # What is the same table and the same options is checked once.
        key = f"{frame.schema} {frame.hash_rows().sum()} {frame.height} {options}"
        if key not in results:
            try:
                results[key] = checked(cls, frame, **options)
            except (ValueError, pl.exceptions.PolarsError) as error:
                results[key] = error
        if isinstance(found := results[key], Exception):
            raise found
        have.append(found)
        raise ReadIt

    def stop_tracks(spool: Spool, *others: object) -> None:
        have.append(spool)
        raise ReadIt

    monkeypatch.setattr(Trajectories, "from_frame", classmethod(stop))
    monkeypatch.setattr(cli, "app", BUILT)
    monkeypatch.setattr(files, "_plan", stop_tracks)
    monkeypatch.setattr(files, "_compile", lambda: None)

    def told(command: str, path: Path, *more: object) -> object:
        given = ("--data", path) if command == "demo" else (path,)
        name, *flags = command.split()
        out = tmp_path / "a.png" if command == "plot" else tmp_path / "out"
        have.clear()
        code, words = run(name, *given, *flags, *MORE.get(name, ()), *more, "--out", out)
        if have:
            return tracks(have[0])
        lines = [line for line in words.splitlines() if line.startswith("error: ")]
        assert code == 1 and len(lines) == 1 and "Traceback" not in words, words
        return lines[0]

    yield told


def tracks(found: Trajectories | Spool) -> dict[tuple[str, str], dict[float, tuple[float, str, int | None]]]:
    """Position, leader and lane by run, vehicle and time, as they were measured."""
    if isinstance(found, Trajectories):
        table = found.table.with_columns(pl.col("leader_id").fill_null(""))
    else:
        table = pl.concat([found.shelf.table(n) for n in range(found.chunks)])
    names = ["run_id", "vehicle_id", "time_s", "position_m", "leader_id"]
    read: dict[tuple[str, str], dict[float, tuple[float, str, int | None]]] = {}
    for run_id, vehicle, time, position, leader in table.select(names).rows():
        read.setdefault((run_id, vehicle), {})[round(time, 6)] = (position, leader, None)
    return read


def alike(one: object, other: object) -> None:
    """Two errors are the same words. Two readings are the same vehicles, with positions and leaders at common times."""
    if isinstance(one, str) or isinstance(other, str):
        assert one == other
        return
    assert isinstance(one, dict) and isinstance(other, dict)
    assert set(one) == set(other)
    for key in one:
        (here, there) = (np.array(sorted(one[key])), np.array(sorted(other[key])))
        assert abs(here[0] - there[0]) < 0.15 and abs(here[-1] - there[-1]) < 0.15, key
        common = sorted(set(one[key]) & set(other[key]))
        clock = np.array(sorted(one[key]))
        at = [other[key][t][0] for t in there]
        inside = (clock >= there[0]) & (clock <= there[-1])
        assert np.allclose(np.interp(clock, there, at)[inside], [one[key][t][0] for t in clock[inside]], atol=0.05), key
        assert [one[key][t][1] for t in common] == [other[key][t][1] for t in common], key


def written(table: pl.DataFrame, folder: Path) -> Path:
    """As csv where it can be, else as parquet."""
    path = folder / "table.csv"
    if any(kind.is_nested() for kind in table.dtypes):
        path = folder / "table.parquet"
        table.write_parquet(path)
    else:
        table.write_csv(path)
    return path


def judged(read: Callable[[str, Path], object], path: Path, expected: str, commands: list[str]) -> None:
    found = {command: read(command, path) for command in commands}
    for told in found.values():
        if expected == bad.READ:
            assert isinstance(told, dict), told
        else:
            assert isinstance(told, str) and expected in told, told
        alike(found[commands[0]], told)


@pytest.mark.parametrize("name", bad.TABLES)
def test_all_commands_read_or_refuse_a_table_alike(
    name: str, read: Callable[[str, Path], object], tmp_path: Path
) -> None:
    table, expected = bad.TABLES[name]
    judged(read, written(table, tmp_path), expected, COMMANDS)


@pytest.mark.parametrize("name", bad.FILES)
def test_all_commands_refuse_a_file_alike(name: str, read: Callable[[str, Path], object], tmp_path: Path) -> None:
    file, write, expected = bad.FILES[name]
    write(tmp_path / file)
    judged(read, tmp_path / file, expected, COMMANDS)


@pytest.mark.parametrize("name", bad.FOLLOWED)
def test_commands_that_need_followers_say_so_alike(
    name: str, read: Callable[[str, Path], object], tmp_path: Path
) -> None:
    table, expected = bad.FOLLOWED[name]
    path = written(table, tmp_path)
    judged(read, path, expected, [command for command in COMMANDS if command not in TRACKS])
    judged(read, path, bad.READ, sorted(TRACKS))


FOLDERS = ["fit", "filter", "reconstruct"]


@pytest.mark.parametrize("name", [*bad.TABLES][::3])
def test_a_folder_is_read_or_refused_as_its_file_is(
    name: str, read: Callable[[str, Path], object], tmp_path: Path
) -> None:
    """In two parts and an empty one, in any order of rows: every third table, as all are read by the code above."""
    table, expected = bad.TABLES[name]
    folder = tmp_path / "table"
    folder.mkdir()
    table.head(table.height // 2).write_parquet(folder / "1.parquet")
    table.clear().write_parquet(folder / "2.parquet")
    table.slice(table.height // 2).write_parquet(folder / "3.parquet")
    judged(lambda *given: named(read(*given), "1.parquet", "table"), folder, expected, FOLDERS)


def named(told: object, part: str, folder: str) -> object:
    """An error that names the part of a folder, as of the folder."""
    return told.replace(f"error: {part}:", f"error: {folder}:") if isinstance(told, str) else told
