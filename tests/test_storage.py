"""A user's files are never lost or overwritten, and broken ones of ours are one line with a cure."""

from __future__ import annotations

import csv
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
import torch

from idm_env.data import synthetic
from idm_env.discovery.result import Location
from idm_env.fitting import job
from idm_env.fitting.job import fit_file, simulate_file
from idm_env.fitting.options import Options, Source
from idm_env.jobs import storage
from idm_env.jobs.shards import Parts
from idm_env.prediction.files import predict_files
from idm_env.trajectories import files
from tests.commands import refused

NAMES = ("report.json", "table.parquet")


def content(folder: Path) -> dict[str, bytes]:
    """Return every file under a folder with its bytes."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """Two runs of a leader and a follower."""
    path = tmp_path / "data.csv"
    synthetic.generate(2, runs=2, followers=1, seconds=30.0)[0].table.drop("gap_m").write_csv(path)
    return path


def test_a_file_is_replaced_only_by_a_whole_one(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text("old")

    def half(beside: Path) -> None:
        beside.write_text("ha")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        storage.write(path, half)
    assert content(tmp_path) == {"a.json": b"old"}


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), ValueError("… (os error 28)")])
def test_a_full_disk_is_told_as_such_and_leaves_nothing_half(tmp_path: Path, error: Exception) -> None:
    def full(beside: Path) -> None:
        beside.write_text("half")
        raise error

    with pytest.raises(OSError, match=r"a\.json cannot be written: No space left on device\. Free space"):
        storage.write(tmp_path / "a.json", full)
    assert not any(tmp_path.iterdir())


def run(out: Path, text: str = "1", inputs: tuple[Path, ...] = ()) -> None:
    """Write both results."""
    with storage.results(out, NAMES, inputs) as folder:
        for name in NAMES:
            storage.write_text(folder / name, text)


def test_results_of_ours_are_replaced_and_those_of_others_kept(tmp_path: Path) -> None:
    run(tmp_path)
    run(tmp_path, "2")
    assert (tmp_path / "report.json").read_text() == "2"
    (tmp_path / "report.json").write_text("my remarks")
    before = content(tmp_path)
    with pytest.raises(ValueError, match=r"report\.json was changed since idm-env wrote it\. Move it"):
        run(tmp_path, "3")
    assert content(tmp_path) == before
    os.replace(tmp_path / "report.json", tmp_path / "mine.json")
    run(tmp_path, "3")
    assert (tmp_path / "mine.json").read_text() == "my remarks" and (tmp_path / "report.json").read_text() == "3"


@pytest.mark.parametrize("name", [*NAMES, storage.MARK])
def test_a_file_that_is_not_ours_is_never_replaced(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("mine")
    with pytest.raises(ValueError, match=rf"{name}.* (was not written by|is not one of) idm-env"):
        run(tmp_path)
    assert content(tmp_path) == {name: b"mine"}


def test_a_killed_run_may_be_done_again_and_a_failed_one_leaves_no_mark(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), storage.results(tmp_path, NAMES):
        raise ZeroDivisionError
    assert not any(tmp_path.iterdir())
    killed = storage.results(tmp_path, NAMES)
    folder = killed.__enter__()
    (folder / NAMES[0]).write_text("of a run that was killed")
    left = content(folder)
    killed.__exit__(None, None, None)
    shutil.rmtree(tmp_path)
    for name, kept in left.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(kept)
    run(tmp_path)
    assert (tmp_path / NAMES[0]).read_text() == "1"


@pytest.mark.parametrize("how", ["itself", "symbolic link", "hard link", "link as output"])
def test_an_output_that_is_an_input_is_refused_through_links_too(tmp_path: Path, how: str) -> None:
    out = tmp_path / "out"
    run(out)
    output, given = out / "report.json", tmp_path / "given.json"
    if how == "itself":
        given = output
    elif how == "symbolic link":
        given.symlink_to(output)
    elif how == "hard link":
        given.hardlink_to(output)
    else:
        os.replace(output, given)
        output.symlink_to(given)
    before = content(tmp_path)
    with pytest.raises(ValueError, match=r"is an input, and .* would overwrite it"):
        run(out, "2", (given,))
    assert content(tmp_path) == before


def test_fit_and_simulate_refuse_to_overwrite_what_they_read(data: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    fit_file(Source(data), Options(by="all", starts=1, substeps=1), out)
    simulate_file(Source(data), out / "model.yaml", out)
    before = content(out)
    assert set(before) == {*job.FITTED, *job.SIMULATED, storage.MARK}
    for given in (
        lambda: fit_file(Source(data), Options(by="all", model=str(out / "model.yaml")), out),
        lambda: fit_file(Source(out / "parameters.parquet"), Options(), out),
        lambda: simulate_file(Source(out / "simulated.parquet"), out / "model.yaml", out),
    ):
        with pytest.raises(ValueError, match="is an input"):
            given()
    assert content(out) == before


HOLD = """
import os, signal, sys
from pathlib import Path
from idm_env.jobs import storage

with storage.results(sys.argv[1], ["report.json"]):
    print("held", flush=True)
    if sys.stdin.readline().strip() == "die":
        os.kill(os.getpid(), signal.SIGKILL)
"""


def test_one_job_at_a_time_writes_to_a_folder_and_a_dead_one_is_not_in_the_way(tmp_path: Path, monkeypatch) -> None:
    pytest.importorskip("fcntl")
    monkeypatch.setattr(storage, "LOCK_SECONDS", 0.2)
    for end in ("end", "die"):
        other = subprocess.Popen(
            [sys.executable, "-c", HOLD, tmp_path], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        with other:
            assert other.stdin and other.stdout and other.stdout.readline() == "held\n"
            with pytest.raises(ValueError, match=rf"is being written to by process {other.pid} on .*, since .* Wait"):
                run(tmp_path)
            other.stdin.write(f"{end}\n")
        assert (storage.LOCK in content(tmp_path)) == (end == "die")
        run(tmp_path)
        assert set(content(tmp_path)) == {*NAMES, storage.MARK}
        shutil.rmtree(tmp_path)
        tmp_path.mkdir()


def test_a_lock_is_held_once_per_job_and_not_by_another_thread(tmp_path: Path, monkeypatch) -> None:
    from concurrent.futures import ThreadPoolExecutor

    pytest.importorskip("fcntl")
    monkeypatch.setattr(storage, "LOCK_SECONDS", 0.2)
    with storage.results(tmp_path, NAMES):
        run(tmp_path)  # explain writes its report so
        with ThreadPoolExecutor(1) as pool, pytest.raises(ValueError, match=f"written to by process {os.getpid()} on"):
            pool.submit(run, tmp_path).result()
        assert storage.LOCK in content(tmp_path)
    assert storage.LOCK not in content(tmp_path)


def test_a_lock_follows_no_link(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("years of work")
    (tmp_path / storage.LOCK).symlink_to(tmp_path / "thesis.txt")
    with pytest.raises(OSError, match="idm-env-lock"):
        run(tmp_path)
    assert (tmp_path / "thesis.txt").read_text() == "years of work"


@pytest.mark.parametrize("below", [".", "under"])
def test_a_link_to_itself_is_one_line(tmp_path: Path, below: str) -> None:
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    with pytest.raises(ValueError, match=r"loop(/under)? cannot be made \(.*\)\. Give --out another folder\."):
        run(tmp_path / "loop" / below)


def test_formulas_are_escaped_and_numbers_stay_numbers(tmp_path: Path) -> None:
    """A spreadsheet runs what begins with one of = + - @, or with a blank that it leaves out."""
    formulas = ["=1+1", "+1+1", "-2+3", "@SUM(A1)", "\t=1", "\r=1", "=cmd|' /C calc'!A0"]
    harmless = ["a", "", None, "-3", "+4.5", "1e-3", "a=b"]
    table = pl.DataFrame({"x": [*formulas, *harmless], "=y": [-1.5] * 14}).with_columns(
        k=pl.col("x").cast(pl.Categorical)
    )
    storage.write_csv(tmp_path / "a.csv", table.lazy())
    with (tmp_path / "a.csv").open(newline="") as file:
        found = list(csv.DictReader(file))
    wanted = [f"'{text}" for text in formulas] + [text or "" for text in harmless]
    assert [row["x"] for row in found] == [row["k"] for row in found] == wanted
    assert {row["'=y"] for row in found} == {"-1.5"}


# -- unfinished work -------------------------------------------------------------------------------------------------


def test_a_store_keeps_and_is_removed(tmp_path: Path) -> None:
    folder = tmp_path / storage.UNFINISHED / "fit"
    store = storage.Store(folder, "a", False)
    kept = {"x": torch.arange(3.0), "n": [1, {"deep": True}]}
    store.put("round 1/delay", kept)
    again = storage.Store(folder, "a", True)
    found = again.get("round 1/delay")
    assert torch.equal(found["x"], kept["x"]) and found["n"] == kept["n"] and again.get("other") is None
    with pytest.raises(ValueError, match="other data or options"):
        storage.Store(folder, "b", True)
    assert storage.Store(folder, "b", False).get("round 1/delay") is None
    again.remove()
    assert not any(tmp_path.iterdir())


def test_a_folder_that_is_not_ours_is_never_emptied(tmp_path: Path) -> None:
    folder = tmp_path / storage.UNFINISHED / "filter"
    folder.mkdir(parents=True)
    (folder / "thesis.txt").write_text("years of work")
    for mark in (None, "", "{", "{}", '{"written_by": "somebody"}', "[" * 100_000):
        if mark is not None:
            (folder / storage.MARK).write_text(mark)
        for resume in (False, True):
            with pytest.raises(ValueError, match=r"run\.json is broken or missing.* Delete .* to start afresh") as told:
                storage.Store(folder, "a", resume)
            assert "\n" not in str(told.value)
    assert (folder / "thesis.txt").read_text() == "years of work"


@pytest.mark.parametrize("link", ["idm-env-unfinished", "idm-env-unfinished/fit", "idm-env-unfinished/fit/spool"])
def test_what_a_link_leads_to_is_never_emptied(tmp_path: Path, link: str) -> None:
    """Not even where it leads to work that an interrupted run left, of this run or of another."""
    theirs, out = tmp_path / "theirs", tmp_path / "out"
    storage.Store(theirs / "fit", "a run", False).put_json("1", 1)
    storage.Store(out / storage.UNFINISHED / "fit", "a run", False)
    if (out / link).exists():
        shutil.rmtree(out / link)
    (out / link).symlink_to(theirs if link.endswith("unfinished") else theirs / "fit")
    before = content(theirs)
    for resume in (False, True):
        with pytest.raises(ValueError, match="is a link, and what it leads to is nobody's to remove"):
            storage.Store(out / storage.UNFINISHED / "fit", "a run", resume)
    assert content(theirs) == before


def test_a_folder_of_results_is_no_store_to_be_emptied(tmp_path: Path) -> None:
    """Its run.json is ours, too, but bears no fingerprint of a run."""
    with storage.results(tmp_path, NAMES) as folder:
        storage.write_text(folder / NAMES[0], "{}")
    before = content(tmp_path)
    with pytest.raises(ValueError, match=r"run\.json is broken or missing"):
        storage.Store(tmp_path, "a run", False)
    assert content(tmp_path) == before


def test_a_place_that_cannot_be_written_is_told_before_the_work(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    for place in ("file/below.xml", "new/" + 300 * "x"):
        with pytest.raises(ValueError, match=r"cannot be written \(.+\)\. Give --sumo another place\.$"):
            storage.refuse_unwritable(tmp_path / place, "--sumo")
    storage.refuse_unwritable(tmp_path / "new" / "types.xml", "--sumo")
    assert content(tmp_path) == {"file": b"x"} and not (tmp_path / "new").exists()


def test_a_store_that_is_killed_while_it_is_made_or_removed_is_still_ours(tmp_path: Path, monkeypatch) -> None:
    folder = tmp_path / storage.UNFINISHED / "fit"
    folder.mkdir(parents=True)
    (folder / ".run.idm-env-part.json").write_text("{")
    store = storage.Store(folder, "a", True)
    store.put_json("x", 1)

    def killed(*given: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(storage.shutil, "rmtree", killed)
    with pytest.raises(KeyboardInterrupt):
        store.remove()
    monkeypatch.undo()
    assert storage.Store(folder, "b", False).saved_names() == []


def damaged(path: Path) -> dict[str, bytes]:
    """Return a file empty, cut, garbled by one bit, replaced by something else, and hollow."""
    whole = path.read_bytes()
    torch.save({}, path)
    hollow = path.read_bytes()
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 1
    path.write_bytes(whole)
    return {"empty": b"", "cut": whole[:-9], "bit": bytes(flipped), "garbage": b"hello" * 99, "hollow": hollow}


def test_every_broken_file_of_a_store_is_one_line(tmp_path: Path) -> None:
    store = storage.Store(tmp_path / "fit", "a", False)
    store.put("tensors", {"x": torch.zeros(5)})
    store.put_json("plain", {"x": [1, 2, 3]})
    for key, get in (("tensors", store.get), ("plain", store.get_json)):
        path = tmp_path / "fit" / f"{key}.kept"
        for name, broken in damaged(path).items():
            path.write_bytes(broken)
            with pytest.raises(ValueError, match=rf"{key}\.kept is broken .* Leave out --resume") as told:
                get(key)
            assert "\n" not in str(told.value) and "weights_only" not in str(told.value), name


def test_a_broken_table_of_a_finished_part_is_one_line(tmp_path: Path) -> None:
    parts = Parts(tmp_path / "filter", "a", False)
    parts.write(0, "trajectories", pl.DataFrame({"x": range(1000)}))
    parts.finish(0, {"tracks": 3})
    path = parts.path(0, "trajectories")
    again = Parts(tmp_path / "filter", "a", True)
    assert again.done(0) and not again.done(1) and again.summaries() == [{"tracks": 3}]
    for broken in (b"", path.read_bytes()[:-3], b"hello"):
        path.write_bytes(broken)
        with pytest.raises(ValueError, match=r"trajectories\.parquet is broken .* Leave out --resume"):
            again.done(0)
    path.unlink()
    with pytest.raises(ValueError, match="is broken"):
        again.done(0)


def test_what_determines_a_run_is_in_its_fingerprint(tmp_path: Path) -> None:
    file = tmp_path / "model.yaml"
    file.write_text("a")
    first = storage.fingerprint(file, torch.zeros(2), "x")
    assert storage.fingerprint(file, torch.zeros(2), "x") == first
    assert (
        storage.fingerprint(file, torch.ones(2), "x") != first
        and storage.fingerprint(file, torch.zeros(2), "y") != first
    )
    file.write_text("b")
    assert storage.fingerprint(file, torch.zeros(2), "x") != first


# -- commands --------------------------------------------------------------------------------------------------------


def test_filter_keeps_a_user_s_parts_and_refuses_its_own_output_as_input(data: Path, tmp_path: Path) -> None:
    pytest.importorskip("numba", reason="numba is not installed")
    out = tmp_path / "out"
    (out / "parts").mkdir(parents=True)
    (out / "parts" / "thesis.txt").write_text("years of work")
    files.filter_file(data, out, baselines=False)
    assert (out / "parts" / "thesis.txt").read_text() == "years of work" and not (out / storage.UNFINISHED).exists()
    before = content(out)
    with pytest.raises(ValueError, match=r"trajectories\.parquet is an input, and"):
        files.filter_file(out / "trajectories.parquet", out, baselines=False)
    with pytest.raises(ValueError, match=r"report\.json is an input, and"):
        predict_files([out / "report.json"], out)
    assert content(out) == before
    (out / storage.UNFINISHED).mkdir()
    shutil.copy(data, out / storage.UNFINISHED / "mine.csv")
    with pytest.raises(ValueError, match=r"mine\.csv belongs to an interrupted run"):
        files.filter_file(out / storage.UNFINISHED / "mine.csv", out)


def test_predict_that_refuses_deletes_nothing(tmp_path: Path) -> None:
    out = tmp_path / "out"
    (out / "parts").mkdir(parents=True)
    (out / "parts" / "thesis.txt").write_text("years of work")
    (out / "predictions.parquet").write_text("mine")
    (tmp_path / "broken.json").write_text("{")
    before = content(tmp_path)
    with pytest.raises(ValueError, match="was not written by idm-env"):
        predict_files([tmp_path / "broken.json"], out)
    (out / "predictions.parquet").rename(out / "mine.parquet")
    with pytest.raises(ValueError, match="no scenario can be used"):
        predict_files([tmp_path / "broken.json"], out)
    (out / "mine.parquet").rename(out / "predictions.parquet")
    assert content(tmp_path) == before


def test_commands_without_input_keep_what_is_not_theirs(tmp_path: Path) -> None:
    name = "platoon.csv"
    (tmp_path / name).write_text("mine")
    assert f"{name} was not written by idm-env" in refused("demo", "--out", tmp_path)
    assert content(tmp_path) == {name: b"mine"}


def test_a_broken_checkpoint_is_one_line_and_without_resume_a_fit_starts_afresh(data: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"

    def stop(phase: str, done: int, total: int, words: float | str) -> None:
        if done:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit_file(Source(data), Options(by="all", starts=1, substeps=1), out, on_progress=stop)
    folder = out / storage.UNFINISHED / "fit"
    (kept,) = folder.glob("*.kept")
    options = ("--by", "all", "--starts", 1, "--substeps", 1, "--out", out)
    for broken in (b"", b"garbage", kept.read_bytes()[:-5]):
        kept.write_bytes(broken)
        line = refused("fit", data, *options, "--resume")
        assert f"{kept.name} is broken" in line and "Leave out --resume to start afresh" in line
    (folder / storage.MARK).write_text("")
    assert "Delete" in refused("fit", data, *options, "--resume")
    storage._sign(folder, fingerprint="")
    fit_file(Source(data), Options(by="all", starts=1, substeps=1), out)
    assert not (out / storage.UNFINISHED).exists()


def test_explain_and_fit_refuse_inputs_among_their_outputs(data: Path, tmp_path: Path) -> None:
    link = tmp_path / "report.json"
    link.symlink_to(data)
    for command in ("explain", "fit"):
        assert "is an input" in refused(command, data, "--out", tmp_path)
    assert link.is_symlink() and sorted(p.name for p in tmp_path.iterdir()) == ["data.csv", "report.json"]


def test_a_typed_result_is_written_with_its_fields_as_keys() -> None:
    """What has no end in JSON is null; what is not there by default is left out."""
    part = Location("time", (np.float64(3.0), float("inf")))
    assert storage.plain({"a": [part], "b": np.arange(2)}) == {
        "a": [{"coordinate": "time", "interval": [3.0, None]}], "b": [0, 1],
    }  # fmt: skip
    assert storage.plain(replace(part, profile={"position_m": [1.0]}))["profile"] == {"position_m": [1.0]}
