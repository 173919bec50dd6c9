"""Parts: the same bytes from one process and from several, nothing lost, nothing doubled, what fails is named."""

from __future__ import annotations

import errno
import os
import pickle
import signal
import socket
import subprocess
import sys
import threading
import time
import types
from dataclasses import dataclass
from pathlib import Path

import pytest

from idm_env.jobs import executor
from idm_env.jobs.progress import OnProgress


@dataclass(frozen=True)
class Part:
    """A number, a folder to leave marks in, and what is to go wrong."""

    number: int
    folder: Path
    wrong: str = ""

    def __str__(self) -> str:
        return f"driver {self.number}"


def square(part: Part, on_progress: OnProgress) -> int:
    """Square a number, unless something goes wrong; every attempt leaves a mark."""
    marks = len(list(part.folder.glob(f"{part.number}-*")))
    (part.folder / f"{part.number}-{marks}").touch()
    on_progress("square", part.number, 10)
    if part.wrong == "raise":
        raise ZeroDivisionError("no gap")
    if part.wrong == "exit":
        sys.exit(0)
    if part.wrong == "full":
        raise OSError(errno.ENOSPC, "No space left on device")
    if part.wrong == "always dies" or (part.wrong == "dies once" and marks == 0):
        os.kill(os.getpid(), signal.SIGKILL)
    return part.number**2


def threads(part: Part, on_progress: OnProgress) -> tuple[int, int, int]:
    """Return how many threads torch and polars take."""
    import polars as pl
    import torch

    return torch.get_num_threads(), pl.thread_pool_size(), os.getpid()


@pytest.mark.parametrize("kind", ["serial", "processes"])
def test_every_part_is_done_once_and_the_one_that_raises_is_named(kind: str, tmp_path: Path) -> None:
    """The others are not stopped by it."""
    parts = [Part(i, tmp_path, "raise" if i == 3 else "") for i in range(6)]
    found = {}
    with (
        executor.opened(kind, 2) as run,
        pytest.raises(
            executor.PartsError, match=r"1 of 6 parts failed \(driver 3: ZeroDivisionError: no gap\).*--resume"
        ),
    ):
        for number, result in run.map(square, parts):
            assert number not in found
            found[number] = result
    assert found == {i: i**2 for i in range(6) if i != 3}
    assert sorted(p.name for p in tmp_path.iterdir()) == [f"{i}-0" for i in range(6)]


def test_a_part_that_ends_its_worker_is_named(tmp_path: Path) -> None:
    """An effect of a user's that calls sys.exit(0) ends neither the worker nor whoever asked."""
    payload = pickle.dumps((os.getcwd(), False, square, Part(3, tmp_path, "exit")))
    assert executor._work(payload) == ("failed", "SystemExit: 0")


def test_dead_processes_are_replaced_and_a_part_that_kills_them_is_told_from_the_others(tmp_path: Path) -> None:
    """Whoever was beside it is done all the same; the one workers die of is given up after three of them."""
    wrong = {1: "dies once", 4: "always dies"}
    parts = [Part(i, tmp_path, wrong.get(i, "")) for i in range(6)]
    found = {}
    with (
        executor.opened("processes", 2) as run,
        pytest.raises(executor.PartsError, match=r"1 of 6 parts failed \(driver 4: the process .* died 3 times\)"),
    ):
        found.update(run.map(square, parts))
    assert found == {i: i**2 for i in range(6) if i != 4}


@pytest.mark.parametrize("kind", ["serial", "processes"])
def test_full_storage_ends_the_work_at_once(kind: str, tmp_path: Path) -> None:
    """All others would meet it too."""
    parts = [Part(i, tmp_path, "full" if i == 0 else "") for i in range(40)]
    with executor.opened(kind, 1) as run, pytest.raises(OSError, match="No space left"):
        list(run.map(square, parts))
    assert len(list(tmp_path.iterdir())) < 40


def test_workers_have_one_thread_and_are_other_processes(tmp_path: Path) -> None:
    """So many workers do not fight for processors."""
    with executor.opened("processes", 1) as run:
        ((_, (torch_threads, polars_threads, process)),) = run.map(threads, [Part(0, tmp_path)])
    assert (torch_threads, polars_threads) == (1, 1) and process != os.getpid()


def test_processes_end_with_whoever_asked_for_them(tmp_path: Path) -> None:
    """Also where that was killed: no orphan goes on."""
    code = (
        "from pathlib import Path; from idm_env.jobs import executor; from tests.test_executor import sleep, Part\n"
        f"if __name__ == '__main__':\n    with executor.opened('processes', 1) as run:\n"
        f"        list(run.map(sleep, [Part(0, Path({str(tmp_path)!r})), Part(1, Path({str(tmp_path)!r}))]))\n"
    )
    script = tmp_path / "script.py"
    script.write_text(code)
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).resolve().parents[1])}
    asked = subprocess.Popen([sys.executable, str(script)], env=environment)
    until = time.monotonic() + 60
    while not (marks := list(tmp_path.glob("sleeps-*"))) and time.monotonic() < until:
        time.sleep(0.05)
    worker = int(marks[0].name.removeprefix("sleeps-"))
    asked.kill()
    asked.wait()
    while Path(f"/proc/{worker}").exists() and time.monotonic() < until:
        time.sleep(0.05)
    assert not Path(f"/proc/{worker}").exists()


def sleep(part: Part, on_progress: OnProgress) -> None:
    """Leave the process's number, and sleep."""
    (part.folder / f"sleeps-{os.getpid()}").touch()
    time.sleep(120)


def test_one_part_alone_raises_its_own_error_and_whoever_watches_may_stop(tmp_path: Path) -> None:
    """A single file's fault is told as ever; an error of the face is none of a part."""
    with executor.opened() as run, pytest.raises(ZeroDivisionError):
        list(run.map(square, [Part(0, tmp_path, "raise")]))

    def stop(phase: str, done: int, total: int, words: float | str = "") -> None:
        raise LookupError

    with executor.opened() as run, pytest.raises(LookupError):
        list(run.map(square, [Part(i, tmp_path) for i in range(3)], stop))


def test_ray_joins_no_cluster_that_nobody_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """Somebody else's, on the same machine, sees other files; RAY_ADDRESS names one, and so does an address."""
    begun: list[str] = []
    fake = types.ModuleType("ray")
    fake.is_initialized = lambda: False  # type: ignore[attr-defined]
    fake.init = lambda address, **more: begun.append(address)  # type: ignore[attr-defined]
    fake.shutdown = lambda: begun.append("over")  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "ray", fake)
    monkeypatch.setattr(executor, "_answers", lambda address: None)
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    for named, variable in ((None, None), (None, "10.0.0.1:6379"), ("10.0.0.2:6379", "10.0.0.1:6379")):
        if variable:
            monkeypatch.setenv("RAY_ADDRESS", variable)
        with executor.opened("ray", address=named):
            pass
    assert begun == ["local", "over", "10.0.0.1:6379", "over", "10.0.0.2:6379", "over"]


@pytest.mark.parametrize(
    "kind", ["nobody", "silent", "http", "closing", "no port", "letters", "too high", "no such host"]
)
@pytest.mark.parametrize("scheme", ["", "ray://"])
def test_an_address_of_no_cluster_is_one_line_before_ray_is_asked(
    kind: str, scheme: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ray itself asks for minutes."""
    fake = types.ModuleType("ray")
    fake.is_initialized = lambda: False  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "ray", fake)  # without init: to ask it is an error of another text
    monkeypatch.setattr(executor, "PATIENCE", 0.3)
    monkeypatch.delenv("RAY_USE_TLS", raising=False)
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]

        def answer() -> None:
            line, _ = server.accept()
            with line:
                if kind == "http":
                    line.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n")
                if kind == "silent":
                    line.recv(1 << 16), line.recv(1 << 16)

        if kind in ("silent", "http", "closing"):
            threading.Thread(target=answer, daemon=True).start()
        elif kind == "nobody":
            server.close()
        host = {"no port": "127.0.0.1", "letters": "127.0.0.1:abc", "too high": "127.0.0.1:70000",
                "no such host": "no-such-host.invalid:6379"}.get(kind, f"127.0.0.1:{port}")  # fmt: skip
        told = r"ray-address = '.*' cannot be used \(.*\)\. Start a cluster with `ray start --head`\."
        with pytest.raises(ValueError, match=told) as error, executor.opened("ray", address=scheme + host):
            pass
    assert "\n" not in str(error.value) and "attribute" not in str(error.value)


def test_bad_choices_are_one_line() -> None:
    """What may be chosen, and what goes together."""
    for kind, jobs, address, told in (
        ("threads", None, None, "executor = 'threads' is unknown. Use one of serial, processes, ray."),
        ("serial", None, "10.0.0.1:6379", "Add --executor ray"),
    ):
        with pytest.raises(ValueError, match=told), executor.opened(kind, jobs, address):
            pass
