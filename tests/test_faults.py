"""Whatever ends a command, the next run ends as if nothing had been: laws over all commands."""

from __future__ import annotations

import csv
import inspect
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import polars as pl
import pytest

from idm_env.cli.commands import app
from idm_env.data import synthetic
from idm_env.jobs import storage
from idm_env.roads import Network
from tests.faults import Disturbed
from tests.networks.written import write_net
from tests.prediction.test_womd import write_json

pytest.importorskip("numba")
pytest.importorskip("fcntl")

OUT = "o[red]t"
"""Read as markup this is another folder."""
COMMANDS = {
    "fit": ("=a.csv", "--starts", 1, "--substeps", 1),
    "explain": ("=a.csv", "b.csv", "--effects", "delay", "--by", "all"),
    "demo": ("--data", "b.csv"),
    "simulate": ("=a.csv", "--base", "idm"),
    "drift": ("=a.csv", "--min-seconds", 5),
    "plot": ("=a.csv", "--html"),
    "filter": ("=a.csv",),
    "reconstruct": ("=a.csv",),
    "predict": ("scene.json",),
    "network": ("my.net.xml", "my.rou.xml", "--seconds", 10),
}
SIGNATURES = {
    c.name or c.callback.__name__: inspect.signature(c.callback) for c in app.registered_commands if c.callback
}
RESUMED = [name for name in COMMANDS if "resume" in SIGNATURES[name].parameters]


@pytest.fixture(scope="module")
def disturbed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Disturbed]:
    """A folder with data in which texts look like formulas, and a program that runs commands there."""
    folder = tmp_path_factory.mktemp("faults") / "work"
    folder.mkdir()
    table = synthetic.generate(2, runs=2, followers=1, seconds=12.0)[0].table.drop("gap_m")
    texts = [(sign + pl.col(name).cast(pl.String) + "x").alias(name) for sign, name in
             (("=", "vehicle_id"), ("=", "leader_id"), ("-", "run_id"))]  # fmt: skip
    table.with_columns(texts).write_csv(folder / "=a.csv")
    table.write_csv(folder / "b.csv")
    write_json(folder / "scene.json")
    write_net(folder / "my.net.xml", Network.crossing())
    flow = '<flow id="=a" from="left0A0" to="A0right0" begin="0" end="9" period="3"/>'
    (folder / "my.rou.xml").write_text(f"<routes>{flow}</routes>")
    made = Disturbed(folder)
    yield made
    made.close()


def arguments(name: str, out: str = OUT) -> tuple[object, ...]:
    """Return the command and its arguments."""
    return (name, *COMMANDS[name], "--out", f"{out}/picture.png" if name == "plot" else out)


def content(folder: Path) -> dict[str, bytes]:
    """Return every file with its bytes; that a report was resumed may be told in it."""
    found = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            told = path.read_bytes()
            found[str(path.relative_to(folder))] = (
                told if path.suffix == ".parquet" else told.replace(b" --resume", b"")
            )
    return {k: re.sub(rb"[0-9a-f]{64}", b"", v) if k.endswith(storage.MARK) else v for k, v in found.items()}


def test_all_commands_that_write_are_here() -> None:
    assert {name for name, known in SIGNATURES.items() if "out" in known.parameters} == {*COMMANDS}


@pytest.mark.parametrize("name", COMMANDS)
def test_the_next_run_ends_as_if_nothing_had_been(disturbed: Disturbed, name: str) -> None:
    """After kills at an early, a middle and the last moment, a full disk, and one that takes 200 bytes of a file."""
    out, asked = disturbed.folder / OUT, arguments(name)
    shutil.rmtree(out, ignore_errors=True)
    status, moments, told = disturbed.run(*asked)
    assert status == 0, told
    assert str(out) in told  # brackets are no markup
    undisturbed = content(out)
    for path in out.rglob("*.csv"):
        with path.open(newline="", encoding="utf-8") as file:
            assert not [cell for row in csv.reader(file) for cell in row if cell[:1] in ("=", "@") or cell[:2] == "-1x"]
    shutil.rmtree(out)

    def killed(at: int | str, *more: str) -> None:
        status, _, told = disturbed.run(*asked, *more, at=at)
        assert status == -9, told

    killed(moments // 2)
    if name != "plot":
        killed(f"{OUT}/{storage.LOCK}")  # nothing is missing but that the lock is taken away
        assert content(out) | {storage.LOCK: b""} == undisturbed | {storage.LOCK: b""}
    killed(moments // 2)
    resumed = ("--resume",) if name in RESUMED else ()
    killed(3, *resumed)
    for how, at in (("full", 3), ("limit", 200)):
        status, _, told = disturbed.run(*asked, *resumed, at=at, how=how)
        lines = [line for line in told.splitlines() if line.startswith("error: ")]
        assert status == 1 and len(lines) == 1 and "Traceback" not in told, told
        assert "No space left on device" in lines[0] or "File too large" in lines[0]
    status, _, told = disturbed.run(*asked, *resumed)
    assert status == 0 and content(out) == undisturbed, told


@pytest.mark.parametrize("name", COMMANDS)
def test_a_folder_that_cannot_be_used_is_one_line(disturbed: Disturbed, name: str) -> None:
    """A link to itself, and a folder to which another job writes (a picture is one file, written in one piece)."""
    loop, held = disturbed.folder / "loop", disturbed.folder / "held"
    if not loop.is_symlink():
        loop.symlink_to(loop)
    with storage.hold_folder(held):
        for out, rule in (("loop/under", "loop"), ("held", "held is being written to by process")):
            if name == "plot" and out == "held":
                continue
            status, _, told = disturbed.run(*arguments(name, out))
            assert status == 1 and told.startswith("error: ") and told.count("\n") == 1 and rule in told, told
