"""Progress from the first moment, with the time that remains, by one protocol."""

from __future__ import annotations

import inspect
import io
from pathlib import Path

import pytest
from rich.console import Console

import idm_env
from idm_env.cli import commands as cli
from idm_env.jobs import progress


def console(*, terminal: bool) -> tuple[Console, io.StringIO]:
    written = io.StringIO()
    return Console(file=written, force_terminal=terminal, width=120), written


def test_a_terminal_shows_something_before_anything_is_imported() -> None:
    shown, written = console(terminal=True)
    with progress.shown(shown):
        assert "starting" in written.getvalue()


def test_a_bar_tells_what_is_done_and_what_is_left() -> None:
    shown, written = console(terminal=True)
    with progress.shown(shown) as report:
        report("reading", 0, 0, "a.csv")
        report("fit", 1, 4, 0.5)
        report("fit", 2, 4, 0.25)
        report("[red]", 1, 1, "a[1].csv")
    text = written.getvalue()
    assert "2/2" in text and "residual 0.250" in text and "left" in text
    assert "[red]" in text and "a[1].csv" in text  # a user's names are no markup
    assert "reading" not in text.splitlines()[-1]


def test_a_log_gets_a_line_now_and_then_and_one_at_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    shown, written = console(terminal=False)
    with progress.shown(shown) as report:
        for done in range(1, 101):
            now[0] += 0.5
            report("predict", done, 100, "x.json")
    lines = written.getvalue().splitlines()
    assert lines[0] == "predict 21/100, 0:00:38 left x.json"
    assert lines[-1] == "predict 100/100 in 0:00:50" and len(lines) == 5


def test_a_log_that_ends_in_an_error_holds_the_error_alone() -> None:
    shown, written = console(terminal=False)
    with pytest.raises(ValueError, match="bad"), progress.shown(shown) as report:
        report("reading", 0, 0, "a.csv")
        raise ValueError("bad")
    assert written.getvalue() == ""


def test_there_is_one_protocol() -> None:
    """Whatever takes long takes ``on_progress: OnProgress | None``, and no module declares another."""
    from benchmarks import bench
    from idm_env.discovery.discover import discover
    from idm_env.fitting.fit import fit
    from idm_env.fitting.job import fit_file, simulate_file
    from idm_env.prediction.files import predict_files
    from idm_env.trajectories.files import filter_file

    for long in (fit, fit_file, simulate_file, discover, filter_file, predict_files, bench.run):
        kind = inspect.signature(long).parameters["on_progress"].annotation
        assert kind in ("OnProgress | None", progress.OnProgress | None), long
    package = Path(idm_env.__file__).parent
    assert [p.name for p in package.rglob("*.py") if "\nOnProgress =" in p.read_text()] == ["progress.py"]


def test_whoever_shows_progress_takes_ctrl_c_over_once_its_modules_are_imported() -> None:
    """Until then Ctrl-C ends the process at once; forgotten, it would lose what is done."""
    shows = [f for f in vars(cli).values() if inspect.isfunction(f) and "shown(console)" in inspect.getsource(f)]
    assert len(shows) >= 8
    for command in shows:
        assert "_work_begins()" in inspect.getsource(command), command


@pytest.mark.parametrize("watched", [True, False])
def test_ctrl_c_while_modules_are_imported_shows_the_cursor_again(
    watched: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Bars hide it, and nothing but this runs after them."""
    said: list[bytes] = []
    codes: list[int] = []
    monkeypatch.setattr(idm_env.cli.os, "isatty", lambda to: watched)
    monkeypatch.setattr(idm_env.cli.os, "write", lambda to, words: said.append(words))
    monkeypatch.setattr(idm_env.cli.os, "_exit", codes.append)
    idm_env.cli.end_at_once(2, None)
    assert codes == [130] and said == [(b"\x1b[?25h" if watched else b"") + b"interrupted.\n"]
