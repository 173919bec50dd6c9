"""Every command of README and of docs/ is one, and those of README's blocks run.

``idm-env`` as README's blocks give it runs; everywhere it is read by the command line itself, options and all. Of other
commands the module, its options, the target or the extra must exist.
"""

from __future__ import annotations

import re
import shlex
import signal
from pathlib import Path
from typing import Any

import pytest

from tests.browser import check, there_is_one
from tests.test_docs import DOCUMENTS, ROOT, folder, my_csv

__all__ = ["folder"]  # a fixture

COMMANDS = re.compile(r"^```(?:bash)?\n(.*?)^```$", re.MULTILINE | re.DOTALL)
INLINE = re.compile(r"`((?:python -m |python (?:benchmarks|examples|docs)/|idm-env |make )[^`]+)`")


def commands(path: Path, inline: bool = False) -> list[list[str]]:
    """Return the words of every command line of a document's blocks, without comments; those within sentences too."""
    text = path.read_text(encoding="utf-8")
    without = re.sub(r"^```(?:python|yaml|text|\{).*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)
    lines = [line for block in COMMANDS.findall(without) for line in block.splitlines() if line.strip()]
    if inline:
        lines += [" ".join(line.split()) for line in INLINE.findall(text)]
    return [words for line in lines if (words := shlex.split(line, comments=True))]


def outside(words: list[str]) -> str | None:
    """Return what is wrong with a command other than ``idm-env``: a module, option, target or extra that is none."""
    program = words[0].removeprefix(".venv/bin/")
    if program == "make":
        targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
        return None if words[1].partition("=")[0] in targets else f"no target {words[1]}"
    if program == "pip":
        extras = set(re.findall(r"^(\w+) = \[", (ROOT / "pyproject.toml").read_text(), re.MULTILINE))
        asked = {extra for word in words for found in re.findall(r"\[([\w,]+)\]", word) for extra in found.split(",")}
        return None if asked <= extras else f"no extra {asked - extras}"
    if program != "python":
        return f"unknown program {program}"
    if words[1] == "-m" and words[2] == "pytest":
        missing = [w for w in words[3:] if w.startswith("tests") and not (ROOT / w).exists()]
        return f"no {missing}" if missing else None
    if words[1:3] in (["-m", "pip"], ["-m", "venv"]):
        return outside(words[2:]) if words[2] == "pip" else None
    file = ROOT / (words[2].replace(".", "/") + ".py" if words[1] == "-m" else words[1])
    if not file.exists() and not (file := file.with_suffix("") / "__main__.py").exists():
        return f"no {file}"
    text = "".join(f.read_text() for f in (file, ROOT / "agents" / "common.py", ROOT / "benchmarks" / "__init__.py"))
    options = [w.partition("=")[0].removeprefix("--") for w in words if w.startswith("--")]
    return next(
        (f"no option --{o} of {file.name}" for o in options if o.replace("-", "_") not in text and o not in text), None
    )


def read_as_typed(words: list[str]) -> None:
    """Let the command line read a command of ``idm-env`` without running it; an error if it cannot."""
    from typer.main import get_command

    from idm_env.cli.commands import app

    group: Any = get_command(app)
    command = group.get_command(None, words[1])
    assert command is not None, f"idm-env has no command {words[1]}"
    if words[2:] != ["--help"]:
        command.make_context(words[1], words[2:])


@pytest.mark.parametrize("path", [*DOCUMENTS, ROOT / "CONTRIBUTING.md"], ids=lambda p: f"{p.parent.name}-{p.stem}")
def test_every_command_is_one(path: Path, folder: Path) -> None:
    """Options that were renamed, modules that were moved, targets that are gone."""
    for name in ("my.csv", "sparse.csv", "tired.csv", "scene.json", "fatigue.py", "model.yaml", "FILE"):
        (folder / name).touch()
    (folder / "result").mkdir()
    (folder / "result" / "model.yaml").touch()
    (folder / "drives").mkdir()
    for words in commands(path, inline=True):
        if "…" in " ".join(words) or words[1] == "COMMAND" or words[1].startswith("--"):
            continue
        if words[0].removeprefix(".venv/bin/") == "idm-env":
            read_as_typed(words if len(words) > 2 else [*words, "--help"])
        else:
            assert outside(words) is None, f"{path.name}: {' '.join(words)}: {outside(words)}"


@pytest.mark.slow
def test_the_commands_of_the_readme_run(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One after the other, in a folder that has the files they read, as somebody would type them."""
    from idm_env.cli.commands import app

    usual = signal.getsignal(signal.SIGINT)
    my_csv(folder)
    for words in commands(ROOT / "README.md"):
        if words[0] != "idm-env":
            continue
        assert app(words[1:], standalone_mode=False) in (None, 0), words
    signal.signal(signal.SIGINT, usual)
    pages = {p.parent.name for p in folder.glob("*/report.html")}
    assert pages == {"filtered", "fit", "result", "simulated", "drift"}
    assert (folder / "space-time.png").stat().st_size > 1000
    told = capsys.readouterr()
    assert "Verdict: " in told.out + told.err
    if there_is_one():  # whatever these commands write for people is looked at
        assert check.wrong(sorted(folder.glob("*/report.html"))) == []


def test_a_command_that_is_none_is_seen(folder: Path) -> None:
    """An option, a module, a target, an extra."""
    with pytest.raises(Exception, match="No such option"):
        read_as_typed(["idm-env", "fit", "my.csv", "--heldout", "0.2"])
    for words, told in (
        (["make", "everything"], "target"), (["python", "-m", "agents.none"], "no "),
        (["python", "-m", "agents.apg", "--windo-w", "3"], "option"), (["pip", "install", ".[everything]"], "extra"),
        (["conda", "install"], "program"),
    ):  # fmt: skip
        assert told in str(outside(words))
    (folder / "x.md").write_text(
        "```\nidm-env fit my.csv  # a word\n\nmake demo\n```\nand `make docs`\n```python\nx = 1\n```\n"
    )
    assert commands(folder / "x.md") == [["idm-env", "fit", "my.csv"], ["make", "demo"]]
    assert commands(folder / "x.md", inline=True)[-1] == ["make", "docs"]
