"""What every command refuses it refuses at once: in one line, before torch or numba are imported."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any, get_args

import pytest
import typer

from idm_env.cli import commands as cli, refusals
from idm_env.effects import BASES
from idm_env.fitting.fit import Method
from idm_env.fitting.problem import Loss, Objective
from idm_env.jobs.executor import KINDS
from idm_env.jobs.workers import Kind
from idm_env.step import INTEGRATORS
from idm_env.tasks.replay_lanes import FIRST_LANES
from idm_env.trajectories.chunks import Recipe

COMMANDS = typer.main.get_command(cli.app).commands  # type: ignore[attr-defined]
FILES = ("data", "source", "scenarios")


def test_words_of_options_are_those_of_whoever_uses_them() -> None:
    """They are written down once more, so that nobody has to be imported to refuse another."""
    assert {
        "base": BASES, "executor": KINDS, "first_lane": FIRST_LANES, "integration": tuple(INTEGRATORS),
        "loss": get_args(Loss), "method": get_args(Method), "objective": get_args(Objective),
        "recipe": get_args(Recipe),
    } == refusals.CHOICES  # fmt: skip
    assert get_args(Kind) == KINDS


def refused(name: str, command: Any, folder: Path) -> dict[str, list[str]]:
    """Return what a command refuses: why → the words of the command line."""
    parameters = {p.name: p for p in command.params}
    file = next((p for p in FILES if p in parameters), None)
    kind = "json" if name == "predict" else "csv"
    (folder / "my.csv").write_text("vehicle_id,time_s,position_m\n" + "".join(f"1,{i},{9 * i}\n" for i in range(9)))
    (folder / "broken.csv").write_bytes(bytes(range(256)) * 9)
    (folder / "broken.parquet").write_bytes(b"PAR1 and no more")
    (folder / "broken.json").write_text("{")
    (folder / "short.csv").write_text("vehicle_id,seconds,position_m\n1,2,3\n")

    rows = [f"{v},{i},{9 * (i % 8) + 99 * v}\n" for v in range(5) for i in range(40)]
    (folder / "edges.csv").write_text("".join(["vehicle_id,time_s,position_m\n", *rows]))

    def with_file(given: str, *more: str) -> list[str]:
        where = [] if file is None else [f"--{file}"] if parameters[file].param_type_name == "option" else ["--"]
        flags = [*more, *where, *([] if file is None else [str(folder / given)])]
        return [name, *flags]

    good = "broken.json" if kind == "json" else "my.csv"
    found = {"an option": with_file(good, "--no-such-option")}
    if file is not None:
        found |= {"a missing file": with_file(f"absent.{kind}"), "an unreadable head": with_file(f"broken.{kind}")}
        found["a folder"] = with_file("nothing.csv")
        (folder / "nothing.csv").mkdir(exist_ok=True)
        if kind == "csv":
            found |= {"a broken parquet": with_file("broken.parquet"), "a missing column": with_file("short.csv")}
            found["rows that cannot be"] = with_file("edges.csv")
    for option in (*refusals.CHOICES, "layout"):
        if option in parameters:
            found[f"--{option}"] = with_file(good, f"--{option.replace('_', '-')}", "nonsense")
    for option, value in (("by", "colour"), ("place", "colour"), ("where", "colour=red"), ("held_out", "colour=red")):
        if option in parameters:
            found[f"{option} {value}"] = with_file(good, f"--{option.replace('_', '-')}", value)
    if "model" in parameters:
        option = parameters["model"].param_type_name == "option"
        found["a missing model"] = with_file(good, "--model", "no.yaml") if option else [name, "no.yaml"]
    if "seed" in parameters:
        found["a number"] = with_file(good, "--seed", "-1")
    return found


RUN = """
import json, os, sys
from idm_env.cli import commands as cli
told = []
for words in json.loads(sys.stdin.read()):
    sys.argv = ["idm-env", *words]
    kept, sys.stderr, sys.stdout = (sys.stderr, sys.stdout), *(open("told.txt", "w") for _ in range(2))
    try:
        cli.run()
        code = 0
    except SystemExit as end:
        code = end.code
    sys.stderr.close(); sys.stdout.close()
    sys.stderr, sys.stdout = kept
    told.append([code, open("told.txt").read(), [m for m in ("torch", "numba") if m in sys.modules]])
print(json.dumps(told))
"""


@pytest.mark.parametrize("name", COMMANDS)
def test_a_refusal_imports_neither_torch_nor_numba(name: str, tmp_path: Path) -> None:
    """A missing file, a head that cannot be read, a column, a word, a number or an option that there is not; help."""
    cases = refused(name, COMMANDS[name], tmp_path)
    lines = [*cases.values(), [name, "--help"]]
    done = subprocess.run(
        [sys.executable, "-c", RUN], input=json.dumps(lines), cwd=tmp_path, capture_output=True, text=True, check=True
    )
    *told, helped = json.loads(done.stdout)
    for (why, words), (code, text, imported) in zip(cases.items(), told, strict=True):
        assert code in (1, 2), (why, words, text)
        assert not imported, (why, words, text)
        assert code == 2 or (text.startswith("error: ") and text.count("\n") == 1), (why, words, text)
    assert helped[0] == 0 and not helped[2]


@pytest.mark.parametrize(("vehicles", "cure"), [(60, "add --split-runs"), (4, "record 7 runs or more")])
def test_one_recording_cannot_tell_and_is_told_so_at_once(tmp_path: Path, vehicles: int, cure: str) -> None:
    """With what would help, a report, no model, and neither torch nor numba."""
    rows = [
        f"{v},{v * 8.0 + 0.5 * i},{10.0 * 0.5 * i:.1f},{v - 1 if v else ''}"
        for v in range(vehicles) for i in range(80)
    ]  # fmt: skip
    (tmp_path / "one.csv").write_text("\n".join(["vehicle_id,time_s,position_m,leader_id", *rows]) + "\n")
    out = tmp_path / "out"
    script = f"import sys; sys.argv = ['idm-env', 'explain', 'one.csv', '--out', {str(out)!r}]\n" + ONE
    done = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True)
    assert done.stdout.splitlines()[-1:] == ["0 []"], done.stdout + done.stderr
    assert "Verdict: cannot tell" in done.stderr and cure in done.stderr
    report = json.loads((out / "report.json").read_text(encoding="utf-8"))
    assert report["verdict"] == "cannot_tell" and cure in report["sentence"] and report["models"] == {}
    assert 'class="light "' in (out / "report.html").read_text(encoding="utf-8")
    assert not list(out.glob("*.yaml"))


ONE = """
from idm_env.cli import commands as cli
try:
    cli.run()
except SystemExit as end:
    print(int(end.code or 0), [name for name in ("torch", "numba") if name in sys.modules])
"""
