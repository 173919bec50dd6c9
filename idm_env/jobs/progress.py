"""How long work says how far it is: one protocol, and the face that a terminal or a log shows of it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console

OnProgress = Callable[[str, int, int, "float | str"], None]
"""Called with the phase, how much of it is done, of how much (0: not known), and a word or a residual."""

LOG_SECONDS = 10.0
"""Where nobody watches, a line at most so often (s)."""


def silent(phase: str, done: int, total: int, words: float | str = "") -> None:
    """Show nothing."""


@contextmanager
def shown(console: Console) -> Iterator[OnProgress]:
    """Show a bar per phase with the time that remains, from the first moment; in a log, now and then a line.

    Phases of unknown length move without a bar's end and leave no trace. A phase ends where the next one begins.
    """
    face: Any = _Bars(console) if console.is_terminal else _Lines(console)
    face.begin()
    try:
        yield face.report
        face.end()
    finally:
        face.stop()


class _Bars:
    """Bars on a terminal."""

    def __init__(self, console: Console) -> None:
        from rich import progress as rich

        texts = ("{task.description:<14}", "{task.fields[words]}")
        phase, words = (rich.TextColumn(text, markup=False) for text in texts)
        times = rich.TimeElapsedColumn(), rich.TextColumn("left"), rich.TimeRemainingColumn()
        columns = phase, rich.BarColumn(bar_width=24), rich.MofNCompleteColumn(), *times, words
        self._bars = rich.Progress(*columns, console=console, speed_estimate_period=600.0)
        self._tasks: dict[str, Any] = {}
        self._running = ""

    def begin(self) -> None:
        self._bars.start()
        self.report("starting", 0, 0, "")

    def report(self, phase: str, done: int, total: int, words: float | str = "") -> None:
        if phase != self._running:
            self.end()
            self._running = phase
        if phase not in self._tasks:
            self._tasks[phase] = self._bars.add_task(phase, total=total or None, words="")
        task = self._tasks[phase]
        self._bars.update(task, completed=done, total=total or None, words=_words(words), visible=True)
        self._bars.start_task(task)

    def end(self) -> None:
        """End the running phase: its line stays with the count, or goes where its length was not known."""
        if self._running:
            task = self._tasks[self._running]
            done = self._bars.tasks[self._bars.task_ids.index(task)]
            if done.total is None:
                self._bars.update(task, visible=False)
            else:
                self._bars.update(task, total=done.completed)
                self._bars.stop_task(task)
            self._running = ""

    def stop(self) -> None:
        self._bars.stop()


class _Lines:
    """Lines in a log: at most one in ``LOG_SECONDS``, and one at the end of a phase."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._phase = ""
        self._counts = (0, 0)
        self._began = self._line = time.monotonic()

    def begin(self) -> None:
        """Say nothing yet: the first line of a log that ends at once is its error."""

    def report(self, phase: str, done: int, total: int, words: float | str = "") -> None:
        now = time.monotonic()
        if phase != self._phase:
            self.end()
            self._phase, self._began, self._line = phase, now, now
        self._counts = (done, total)
        if total and 0 < done < total and now - self._line >= LOG_SECONDS:
            self._line = now
            left = _clock((now - self._began) * (total - done) / done)
            self._console.print(
                f"{phase} {done}/{total}, {left} left {_words(words)}".rstrip(), soft_wrap=True, markup=False
            )

    def end(self) -> None:
        done, total = self._counts
        if self._phase and total:
            took = _clock(time.monotonic() - self._began)
            self._console.print(f"{self._phase} {done}/{total} in {took}", soft_wrap=True, markup=False)
        self._phase, self._counts = "", (0, 0)

    def stop(self) -> None:
        """Nothing is left to clear."""


def _words(value: float | str) -> str:
    return value if isinstance(value, str) else f"residual {value:.3f}"


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02d}:{rest:02d}"
