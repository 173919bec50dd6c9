"""Commands that are killed, or meet a full disk, at a moment of one's choice: a program that ``Disturbed`` talks to.

A moment is a change of a file in the folder of the command: it is about to be opened for writing, renamed, removed or
made. All modules are imported once; each run is a fork, before any thread of a library has begun.
"""

from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
CHANGES = {"os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.truncate"}
MODULES = (
    "idm_env.cli.commands", "idm_env.fitting.job", "idm_env.fitting.lane_changes", "idm_env.discovery.sets",
    "idm_env.drift.job", "idm_env.trajectories.files", "idm_env.prediction.files",
    "idm_env.reports.diagrams",
    "idm_env.compiled.kernels.dispatch", "idm_env.compiled.kernels.drivers",
    "idm_env.model_file",
)  # fmt: skip


class Disturbed:
    """Runs of commands in a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._program = subprocess.Popen(
            [sys.executable, __file__, folder], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def run(self, *arguments: object, at: int | str = 0, how: str = "kill") -> tuple[int, int, str]:
        """Return exit status (−9: killed), number of moments, and what was written to standard error.

        ``how``: ``kill`` at a moment, or where a file of that name is removed, and a file that is about to be renamed
        is left half; ``full``: nothing can be written from that moment on; ``limit``: no file of more than so many
        bytes.
        """
        assert self._program.stdin and self._program.stdout
        asked = {"arguments": [str(each) for each in arguments], "at": at, "how": how}
        self._program.stdin.write(json.dumps(asked) + "\n")
        self._program.stdin.flush()
        status, moments, told = json.loads(self._program.stdout.readline())
        return status, moments, told

    def close(self) -> None:
        """End the program."""
        with self._program:
            pass


def _disturb(folder: str, at: Any, how: str) -> list[int]:
    """Count moments, and do at one of them what is to be done."""
    count = [0]
    if how == "limit" and at:
        import resource

        resource.setrlimit(resource.RLIMIT_FSIZE, (at, at))

    def hook(event: str, given: tuple[Any, ...]) -> None:
        if event == "open":
            if not (isinstance(given[2], int) and given[2] & WRITES):
                return
        elif event not in CHANGES:
            return
        within = event in ("os.remove", "os.rmdir") and given[-1] != -1
        if not (isinstance(given[0], (str, bytes, os.PathLike)) and (within or _in(given[0], folder))):
            return
        count[0] += 1
        named = event == "os.remove" and isinstance(at, str) and os.path.abspath(os.fsdecode(given[0])).endswith(at)
        if how == "kill" and (count[0] == at or named):
            if event == "os.rename":
                os.truncate(given[0], os.path.getsize(given[0]) // 2)
            os.kill(os.getpid(), signal.SIGKILL)
        if how == "full" and at and count[0] >= at and event in ("open", "os.mkdir", "os.rename"):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), os.fsdecode(given[0]))

    sys.addaudithook(hook)
    return count


def _in(path: Any, folder: str) -> bool:
    return os.path.abspath(os.fsdecode(path)).startswith(folder + os.sep)


def _child(asked: dict[str, Any], folder: str, answer: int) -> None:
    from idm_env.cli.commands import run

    told = os.open(os.path.join(os.path.dirname(folder), "told.txt"), os.O_RDWR | os.O_CREAT | os.O_TRUNC)
    os.dup2(os.open(os.devnull, os.O_RDWR), 1)
    os.dup2(told, 2)
    sys.argv = ["idm-env", *asked["arguments"]]
    count, status = _disturb(folder, asked["at"], asked["how"]), 0
    try:
        run()
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else 1
    except BaseException:
        import traceback

        traceback.print_exc()
        status = 99
    sys.stderr.flush()
    os.write(answer, str(count[0]).encode())
    os._exit(status)


def main(folder: str) -> None:
    """Answer each line of standard input with a line: status, moments, what was told."""
    import importlib

    for name in MODULES:
        importlib.import_module(name)
    import torch

    from idm_env.jobs import storage

    torch.set_num_threads(1)
    time.perf_counter = time.process_time = float  # reports tell how long their methods took
    storage.LOCK_SECONDS = 0.0
    os.chdir(folder)
    for line in sys.stdin:
        read, write = os.pipe()
        process = os.fork()
        if not process:
            with suppress(BaseException):
                _child(json.loads(line), folder, write)
            os._exit(98)
        os.close(write)
        _, status = os.waitpid(process, 0)
        moments = int(os.read(read, 99) or 0)
        os.close(read)
        told = Path(folder).parent.joinpath("told.txt").read_text()
        print(json.dumps([os.waitstatus_to_exitcode(status), moments, told]), flush=True)


if __name__ == "__main__":
    main(sys.argv[1])
