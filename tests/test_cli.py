"""The command line as a user meets it: help, exit codes, one-line errors, interruption and resume."""

from __future__ import annotations

import dataclasses
import html
import inspect
import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import get_args, get_type_hints

import numpy as np
import polars as pl
import pytest
from typer.models import CommandInfo

from idm_env.cli.commands import app
from idm_env.cli.options import FileOptions, JobOptions, SharedOptions, SourceOptions, TrackOptions, args_of
from idm_env.data import synthetic
from idm_env.jobs import storage
from tests.commands import spawned, typed


@pytest.fixture(scope="module")
def frame() -> pl.DataFrame:
    """Two runs of a leader and a follower, 30 s, with gaps by position."""
    trajectories, _ = synthetic.generate(2, runs=2, followers=1, seconds=30.0)
    return trajectories.table.select(
        "run_id", "vehicle_id", "leader_id", "time_s", "position_m", "speed_mps", "length_m"
    )


def test_help_teaches() -> None:
    """What a file needs, what to type first, and every command."""
    done = spawned("--help")
    assert done.returncode == 0
    for word in ("vehicle_id", "position_m", "idm-env demo", "fit", "explain", "simulate", "--resume"):
        assert word in done.stdout
    for command in ("fit", "explain", "simulate"):
        assert "--out" in typed(command, "--help").stdout


def bad_files(frame: pl.DataFrame) -> dict[str, tuple[Callable[[Path], None], str]]:
    """Return bad inputs by name: how to write one, and what the error must say."""
    follower = pl.col("leader_id").is_not_null()
    return {
        "missing column": (lambda p: frame.drop("position_m").with_columns(positon_m=1.0).write_csv(p), "position_m"),
        "empty": (lambda p: p.write_text(""), "empty"),
        "header only": (lambda p: frame.head(0).write_csv(p), "no rows|empty"),
        "only leaders": (lambda p: frame.filter(~follower).with_columns(leader_id=None).write_csv(p), "follow|leader"),
        "text": (lambda p: p.write_text("hello\nworld\n"), "column"),
        "km/h": (
            lambda p: frame.with_columns(pl.col("speed_mps") * 3.6).write_csv(p), "km/h",
        ),
        "feet": (lambda p: frame.with_columns(pl.col("length_m") * 3.28, pl.col("position_m") * 3.28,
                 pl.col("speed_mps") * 3.28).write_csv(p), "feet"),
        "short": (lambda p: frame.filter(pl.col("time_s") < 3 + pl.min("time_s").over("run_id")).write_csv(p), "5 s"),
        "no time": (lambda p: frame.with_columns(time_s=float("nan")).write_csv(p), "time_s"),
    }  # fmt: skip


@pytest.mark.parametrize(
    "name", ["missing column", "empty", "header only", "only leaders", "text", "km/h", "feet", "short", "no time"]
)
def test_bad_input_is_one_line_and_exit_code_1(frame: pl.DataFrame, tmp_path: Path, name: str) -> None:
    """No traceback, no NaN result, no silent drop."""
    write, words = bad_files(frame)[name]
    path = tmp_path / "data.csv"
    write(path)
    done = typed("fit", path, "--out", tmp_path / "out")
    assert done.returncode == 1, done.stderr
    lines = done.stderr.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith("error: ")
    assert any(word in lines[0] for word in words.split("|")), lines[0]
    assert not (tmp_path / "out" / "report.json").exists()


@pytest.mark.parametrize("words", [["--help"], ["fit", "--help"], ["effects"]])
def test_who_reads_no_further_is_told_nothing(words: list[str]) -> None:
    """As ``idm-env --help | head -1`` with a reader that has gone: no advice to mend a file."""
    command = [sys.executable, "-m", "idm_env", *words]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as running:
        assert running.stdout is not None and running.stderr is not None
        running.stdout.close()
        assert running.stderr.read() == ""


def test_options_that_go_together_are_in_every_command_of_their_kind() -> None:
    """Work of parts can be done by others and taken up again, one run can, too; files cut by rows have any layout."""
    commands = {c.name or c.callback.__name__: set(inspect.signature(c.callback).parameters)
                for c in app.registered_commands if c.callback}  # fmt: skip
    job = {"out", "resume", "executor", "jobs", "ray_address"}
    file = {field.name for field in dataclasses.fields(FileOptions)}
    assert (
        {name for name, options in commands.items() if options & job - {"out", "resume"}}
        == {name for name, options in commands.items() if job <= options}
        == {name for name, options in commands.items() if "resume" in options} - {"network"}
        == {"fit", "explain", "filter", "reconstruct", "predict", "drift"}
    )
    assert {name for name, options in commands.items() if file <= options} == {"fit", "explain", "simulate", "drift"}


@pytest.mark.parametrize("command", app.registered_commands, ids=lambda c: c.callback.__name__)
def test_every_option_means_something_and_nothing_else_is_described(command: CommandInfo) -> None:
    """What a docstring forgets has an empty help, and what it names beside would be read by nobody."""
    assert command.callback is not None
    hints = get_type_hints(command.callback, include_extras=True)
    said = {name: get_args(hint)[1].help for name, hint in hints.items() if get_args(hint)}
    assert all(said.values()), said
    own = args_of(inspect.unwrap(command.callback))
    assert own.items() <= said.items() and "Args:" not in (command.callback.__doc__ or "")


def test_what_several_commands_have_is_described_where_it_is_used() -> None:
    """A field of a group is described by it or by all groups' page; that page describes what two commands have."""
    named = Counter(
        name for c in app.registered_commands if c.callback for name in inspect.signature(c.callback).parameters
    )
    assert all(named[name] > 1 for name in args_of(SharedOptions))
    for group in (FileOptions, SourceOptions, TrackOptions, JobOptions):
        assert args_of(group).keys() <= {field.name for field in dataclasses.fields(group)}


def test_bad_paths_and_options(frame: pl.DataFrame, tmp_path: Path) -> None:
    """A missing file, a corrupt parquet, a misspelled column and a wrong share."""
    good = tmp_path / "good.csv"
    frame.write_csv(good)
    broken = tmp_path / "broken.parquet"
    broken.write_bytes(b"PAR1 not really")
    for arguments, words in (
        (("fit", tmp_path / "none.csv"), "none.csv"),
        (("fit", broken), "broken.parquet"),
        (("fit", good, "--by", "vehicle_nam"), "cannot group by"),
        (("fit", good, "--by", "drivr"), "Use driver, all, or one of run_id"),
        (("fit", good, "--held-out", "half"), "--held-out"),
        (("fit", good, "--objective", "speeed"), "Did you mean 'speed'"),
        (("fit", good, "--method", "newton"), "lm"),
        (("simulate", good, "--model", tmp_path / "none.yaml"), "none.yaml"),
        (("fit", good, "--out", good), "is a file"),
        (("fit", good, "--ahead", 1), "--ahead is for --lane-changes"),
        (("fit", good, "--lane-changes", "--starts", 2), "--starts says nothing with --lane-changes"),
        (("fit", good, "--lane-changes"), "Lane changes need the lane of every row"),
    ):
        options = () if "--out" in arguments else ("--out", tmp_path / "out")
        done = typed(*arguments, *options)
        assert done.returncode == 1, (arguments, done.stderr)
        assert len(done.stderr.strip().splitlines()) == 1 and words in done.stderr, done.stderr
    assert typed("fit").returncode == 2
    assert typed("fitt", good).returncode == 2


def test_bad_rows_are_repaired_and_counted(frame: pl.DataFrame, tmp_path: Path) -> None:
    """NaN and duplicated rows do not stop a fit, and the report says how many there were."""
    position = frame["position_m"].to_numpy().copy()
    position[[50, 400]] = np.nan
    dirty = frame.with_columns(pl.Series("position_m", position))
    path = tmp_path / "dirty.csv"
    pl.concat([dirty, dirty[100:110]]).write_csv(path)
    done = typed("fit", path, "--by", "all", "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "out" / "report.html").read_text()
    assert "10 rows repeat" in page, page[-800:]
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("Data: ")]
    assert "duplicated time 10" in line and line.removeprefix("Data: ") in page
    assert any(line.startswith(("On its bound: ", "No parameter is on a bound.")) for line in done.stderr.splitlines())


def test_two_conditions_both_hold(tmp_path: Path) -> None:
    """Each condition narrows what the others left."""
    made, _ = synthetic.generate(3, runs=3, followers=2, seconds=30.0)
    site, weather = ({"1": a, "2": b, "3": c} for a, b, c in (("a", "a", "b"), ("dry", "wet", "wet")))
    run = pl.col("run_id")
    table = made.table.with_columns(run.replace_strict(site).alias("site"), run.replace_strict(weather).alias("sky"))
    path = tmp_path / "two.parquet"
    table.write_parquet(path)
    out = tmp_path / "out"
    done = typed("fit", path, "--where", "site=a", "--where", "sky=wet", "--starts", "1", "--out", out)
    assert done.returncode == 0, done.stderr
    assert json.loads((out / "report.json").read_text())["fit"]["episodes"] == 2


def test_killed_and_resumed_gives_the_same_result(tmp_path: Path) -> None:
    """SIGINT ends with code 130 and a hint; SIGKILL leaves a checkpoint; --resume ends as an undisturbed run does."""
    path = tmp_path / "good.csv"
    synthetic.generate(2, runs=2, followers=2, seconds=60.0)[0].table.drop("gap_m").write_csv(path)
    options = ("--method", "adam", "--out")
    assert typed("fit", path, *options, tmp_path / "whole").returncode == 0
    for number in (signal.SIGINT, signal.SIGKILL):
        out = tmp_path / number.name
        running = subprocess.Popen(
            [sys.executable, "-m", "idm_env", "fit", str(path), *options, str(out)], stderr=subprocess.PIPE, text=True
        )
        deadline = time.monotonic() + 120
        kept = out / storage.UNFINISHED / "fit" / "adam.kept"
        while not kept.exists() and running.poll() is None and time.monotonic() < deadline:
            time.sleep(0.01)
        os.kill(running.pid, number)
        _, words = running.communicate(timeout=60)
        if number == signal.SIGINT:
            assert running.returncode == 130 and "--resume" in words
        assert kept.exists()
        assert typed("fit", path, *options, out, "--resume").returncode == 0
        whole, resumed = (pl.read_parquet(folder / "parameters.parquet") for folder in (tmp_path / "whole", out))
        assert whole.equals(resumed)


def same_numbers(text: str, other: str) -> bool:
    """Return whether two texts differ by 3 % in their numbers at most."""
    words, numbers = zip(*((re.split(r"[\d.]*\d", x), re.findall(r"[\d.]*\d", x)) for x in (text, other)), strict=True)
    return words[0] == words[1] and np.allclose(
        [float(x) for x in numbers[0]], [float(x) for x in numbers[1]], rtol=0.03
    )


def test_the_demo_finds_what_its_generator_hid(tmp_path: Path) -> None:
    """The README's main job, from the command to a report: the hidden delay is named, and the held-out error falls."""
    done = typed("demo", "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    assert "report.html" in done.stderr.replace("\n", "")
    columns = pl.read_csv(tmp_path / "platoon.csv").columns
    assert "delay" not in " ".join(columns) and "gap_m" not in columns
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["verdict"] == "named" and report["found"][0]["effect"] == "delay"
    assert report["found"][0]["parameters"]["delay"]["estimate"] == pytest.approx(0.5, abs=0.05)
    before, after = (report["error"][when]["gap_rmse_m"] for when in ("before", "after"))
    assert after < 0.4 * before
    assert any(line.startswith("Data: ") for line in done.stderr.splitlines())
    page = (tmp_path / "report.html").read_text()
    assert page.count("data:image") >= 5 and 'src="http' not in page
    verdict = next(line for line in done.stderr.splitlines() if line.startswith("Verdict"))
    for shown in ("README.md", "docs/index.md"):  # what they show is this run, but for rounding on other machines
        text = " ".join((Path(__file__).parents[1] / shown).read_text(encoding="utf-8").split())
        printed = re.search(r"Verdict: named.*?\]\.", text)
        assert printed is not None and same_numbers(printed[0], verdict)
        falls = re.search(r"falls from [\d.]+ to [\d.]+ m", text)
        assert shown != "README.md" or (falls and same_numbers(falls[0], f"falls from {before} to {after} m"))
    again = typed("simulate", tmp_path / "platoon.csv", "--model", tmp_path / "model.yaml", "--out", tmp_path / "again")
    assert again.returncode == 0, again.stderr


def test_plot_and_effects(frame: pl.DataFrame, tmp_path: Path) -> None:
    """A picture of a file and of a rollout, and the catalogue."""
    path = tmp_path / "good.csv"
    frame.write_csv(path)
    ring = Path(__file__).resolve().parents[1] / "configs" / "ring.yaml"
    for source, options in ((path, ()), (ring, ("--seconds", "20"))):
        picture = tmp_path / f"{source.stem}.png"
        done = typed("plot", source, "--out", picture, "--html", *options)
        assert done.returncode == 0, done.stderr
        page = picture.with_suffix(".html")
        text = page.read_text()
        assert "http" not in text and ('"marked": true' if source is ring else '"marked": false') in text
        assert picture.read_bytes().startswith(b"\x89PNG")
        assert typed("plot", source, "--out", picture, "--html", *options).returncode == 0  # its own page is replaced
    page.write_text("mine")
    done = typed("plot", path, "--out", tmp_path / f"{ring.stem}.png", "--html")
    assert done.returncode == 1 and "was not written by idm-env plot" in done.stderr and page.read_text() == "mine"
    listed = spawned("effects", env={**os.environ, "COLUMNS": "200"})
    assert "second_leader.weight" in listed.stdout


def test_explain_reads_effects_from_files(frame: pl.DataFrame, tmp_path: Path) -> None:
    """A class that is not there is one line; one that is there is tried: two runs are too few to decide."""
    path, example = tmp_path / "data.csv", Path(__file__).parents[1] / "examples" / "add_an_effect.py"
    frame.write_csv(path)
    done = typed("explain", path, "--effects", f"{example}:Nobody", "--out", tmp_path / "out")
    assert done.returncode == 1 and "no class Nobody of effects. It has: Fatigue." in " ".join(done.stderr.split())
    done = typed("explain", path, "--effects", f"{example}:Fatigue", "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert [c["effect"] for c in report["candidates"]] == ["fatigue"] and "only" not in report["candidates"][0]["note"]


@pytest.mark.parametrize(
    ("words", "following"),
    [
        ("fit DATA --where run_id=1 --starts 1 --substeps 1", "explain DATA --where run_id=1"),
        ("drift DATA", "simulate DATA --model OUT/model.yaml"),
        ("simulate DATA --base idm", "drift DATA"),
        ("filter DATA", "fit OUT/trajectories.parquet"),
        ("explain DATA --where run_id=1", "plot DATA --where run_id=1"),  # one recording: there is no model
    ],
)
def test_every_report_and_terminal_end_with_the_next_command(
    words: str, following: str, frame: pl.DataFrame, tmp_path: Path
) -> None:
    data, out = tmp_path / "my file.csv", tmp_path / "a b"
    frame.write_csv(data)
    where = {"DATA": shlex.quote(str(data)), "OUT": shlex.quote(str(out))}
    typed_words, wanted = (re.sub("DATA|OUT", lambda m: where[m[0]], text) for text in (words, following))
    done = typed(*shlex.split(typed_words), "--out", out)
    last = done.stderr.strip().splitlines()[-1]
    assert done.returncode == 0 and last == f"Next: idm-env {wanted}"
    assert f"<pre>idm-env {wanted}</pre>" in html.unescape((out / "report.html").read_text())
