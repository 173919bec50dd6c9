"""The command line as it is typed: in this process, which spares seconds of imports, or in one of its own."""

from __future__ import annotations

import contextlib
import io
import subprocess
import sys

from idm_env.cli import commands as cli

Done = subprocess.CompletedProcess[str]


def typed(*arguments: object) -> Done:
    """Return what a command printed and its exit code; a traceback is a failure of the test."""
    before, said, told = sys.argv, io.StringIO(), io.StringIO()
    sys.argv = ["idm-env", *map(str, arguments)]
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(told):
            cli.run()
    except SystemExit as end:
        return subprocess.CompletedProcess(sys.argv, int(end.code or 0), said.getvalue(), told.getvalue())
    finally:
        sys.argv = before
    raise AssertionError("the command line has no end")


def run(*arguments: object) -> tuple[int, str]:
    """Return the exit code of a command, and what it said beside its results."""
    done = typed(*arguments)
    return done.returncode, done.stderr


def spawned(*arguments: object, **options: object) -> Done:
    """Return the same of a process of its own."""
    command = [sys.executable, "-m", "idm_env", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, **options)  # type: ignore[call-overload, no-any-return]


def refused(*arguments: object) -> str:
    """Return the one line with which a command refuses what it was given."""
    done = typed(*arguments)
    lines = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    assert done.returncode == 1 and len(lines) == 1 and "Traceback" not in done.stderr, done.stderr
    assert len(lines[0]) < 1100
    return lines[0]
