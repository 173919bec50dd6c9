"""Where the parts of long work run: here, in processes, or as tasks of a Ray cluster. No result depends on it.

Work is cut into parts beforehand, whoever does them. A part carries all that its result depends on, its seed included,
so that the same part gives the same bytes anywhere, and may be done again after a worker was lost. Large results are
files that a part writes in one piece (``parts.Parts``); what comes back through ``map`` is small.
"""

import abc
import logging
import os
import pickle
import signal
import socket
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cached_property
from typing import Any, Protocol, TypeVar

from idm_env import compat
from idm_env.extras import needed
from idm_env.jobs import trust
from idm_env.jobs.progress import OnProgress, silent

KINDS = ("serial", "processes", "ray")
PER_WORKER = 2
"""Parts in flight per worker: one that is worked on, and one that waits for it."""
PATIENCE = 5.0
"""Seconds in which a cluster has to answer."""
ATTEMPTS = 3
"""How often a part is given to a worker, where workers die of it."""
THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS", "POLARS_MAX_THREADS")

P = TypeVar("P")
R = TypeVar("R")
Work = Callable[[P, OnProgress], R]
"""What is done with a part. Its progress is shown where the part runs in this process, otherwise nowhere."""


class PartsError(ValueError):
    """Parts that could not be done, each with its name and reason; all others were done."""


class Executor(Protocol):
    """Runs parts."""

    def map(
        self, function: Work[P, R], parts: Sequence[P], on_progress: OnProgress = silent
    ) -> Iterator[tuple[int, R]]:
        """Yield (index of the part, result) of every part, in any order; a bounded number is in flight.

        A part that raises does not stop the others.

        Raises:
            PartsError: At the end, if parts failed; it names them as their ``str`` does. A single part's own error
                comes through as it is, and so does an OSError of any part, at once: others would meet it too.
        """
        ...


@contextmanager
def opened(kind: str = "serial", jobs: int | None = None, address: str | None = None) -> Iterator[Executor]:
    """Give an executor while this lasts: ``serial``, ``processes`` (``jobs`` of them) or ``ray`` (at ``address``).

    ``jobs`` is one per processor where it is None; with Ray it bounds how many parts run at a time. Without an
    ``address`` Ray uses RAY_ADDRESS, or begins on this machine, beside whoever runs it here already, and listens on
    127.0.0.1 only. ValueError for other kinds and where no cluster answers, ImportError without ray.
    """
    if kind not in KINDS:
        raise ValueError(f"executor = '{kind}' is unknown. Use one of {', '.join(KINDS)}.")
    if address is not None and kind != "ray":
        raise ValueError(f"ray-address = '{address}' needs the executor ray, not {kind}. Add --executor ray.")
    if kind == "serial":
        yield Serial()
    elif kind == "processes":
        yield Processes(jobs or os.cpu_count() or 1)
    else:
        with _connected(address):
            yield Ray(jobs)


class Serial:
    """One part after the other, in this process."""

    def map(
        self, function: Work[P, R], parts: Sequence[P], on_progress: OnProgress = silent
    ) -> Iterator[tuple[int, R]]:
        """See ``Executor``."""
        if len(parts) == 1:
            yield 0, function(parts[0], on_progress)
            return
        failed: list[tuple[int, str]] = []
        for number, part in enumerate(parts):
            stopped: list[BaseException] = []
            try:
                result = function(part, _heard(on_progress, stopped))
            except OSError:
                raise
            except Exception as error:
                if stopped:  # not the part, but whoever watches
                    raise
                failed.append((number, _reason(error)))
                continue
            yield number, result
        _raise(failed, parts)


# -- what processes and Ray share ------------------------------------------------------------------------------------


class _LostError(Exception):
    """A worker died. ``final``: its part was given to others already, as often as may be."""

    def __init__(self, words: str, final: bool) -> None:
        super().__init__(words)
        self.final = final


class _Workers(abc.ABC):
    """Workers that take parts: ``_submit`` gives a handle, ``_wait`` one that is done, ``_result`` its result."""

    def _dumps(self, content: Any) -> bytes:
        return pickle.dumps(content)

    @abc.abstractmethod
    def _room(self) -> int: ...
    @abc.abstractmethod
    def _submit(self, payload: bytes) -> Any: ...
    @abc.abstractmethod
    def _wait(self, handles: Sequence[Any]) -> Any: ...
    @abc.abstractmethod
    def _result(self, handle: Any) -> tuple[str, Any]: ...
    @abc.abstractmethod
    def _close(self, handles: Sequence[Any]) -> None: ...

    def map(
        self, function: Work[P, R], parts: Sequence[P], on_progress: OnProgress = silent
    ) -> Iterator[tuple[int, R]]:
        """See ``Executor``. A bounded number of parts is in flight.

        Whoever was when a worker died runs again, alone: so a part that kills its workers is told from those beside it.
        """
        waiting, flying = deque(range(len(parts))), dict[Any, int]()
        deaths: dict[int, int] = {}  # of suspects: how many workers died of each
        failed: list[tuple[int, str]] = []
        here = os.getcwd()
        try:
            while waiting or flying:
                while waiting and len(flying) < (1 if deaths else self._room()):
                    number = waiting.popleft()
                    flying[self._submit(self._dumps((here, trust.permission(), function, parts[number])))] = number
                done = self._wait(list(flying))
                number = flying.pop(done)
                try:
                    kind, result = self._result(done)
                except _LostError as lost:
                    if lost.final:
                        failed.append((number, str(lost)))
                        continue
                    again = sorted((number, *flying.values()))
                    flying.clear()
                    for suspect in again:
                        deaths[suspect] = deaths.get(suspect, 0) + (len(again) == 1)
                    if deaths[number] < ATTEMPTS:
                        waiting.extendleft(reversed(again))
                    else:
                        failed.append((number, str(lost)))
                        del deaths[number]
                    continue
                deaths.pop(number, None)
                if kind == "done":
                    yield number, result
                elif kind == "storage" or (len(parts) == 1 and isinstance(result, Exception)):
                    raise result
                else:
                    failed.append((number, _reason(result) if isinstance(result, Exception) else result))
        finally:
            self._close(list(flying))
        _raise(failed, parts)


def _work(payload: bytes) -> tuple[str, Any]:
    """Do one part in a worker; its error is a value, since not every error survives the way back."""
    for name in THREADS:  # before any library starts its threads
        os.environ[name] = "1"
    try:
        here, trusted, function, part = pickle.loads(payload)
        with suppress(OSError):  # relative paths mean the same as where the work was asked for
            os.chdir(here)
        if torch := sys.modules.get("torch"):  # whatever was set when it was imported
            torch.set_num_threads(1)
        with trust.trusting(trusted):
            return "done", function(part, silent)
    except OSError as error:
        return "storage", OSError(*error.args)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # an effect of a user's may call sys.exit()
        try:
            pickle.loads(pickle.dumps(error))
        except Exception:
            return "failed", _reason(error)
        return "failed", error if isinstance(error, Exception) else _reason(error)


def _reason(error: BaseException) -> str:
    words = " ".join(str(error).split())
    return words if isinstance(error, ValueError) and words else f"{type(error).__name__}: {words}".rstrip(": ")


def _raise(failed: list[tuple[int, str]], parts: Sequence[Any]) -> None:
    if not failed:
        return
    failed.sort()
    named = "; ".join(f"{parts[number]}: {reason}" for number, reason in failed[:5])
    more = f"; and {len(failed) - 5} more" if len(failed) > 5 else ""
    raise PartsError(
        f"{len(failed)} of {len(parts)} parts failed ({named}{more}). What the others did is kept: mend the cause and "
        "run again with --resume."
    )


def _heard(on_progress: OnProgress, stopped: list[BaseException]) -> OnProgress:
    def tell(phase: str, done: int, total: int, words: float | str = "") -> None:
        try:
            on_progress(phase, done, total, words)
        except BaseException as error:
            stopped.append(error)
            raise

    return tell


# -- processes -------------------------------------------------------------------------------------------------------


class Processes(_Workers):
    """Processes of this machine, one thread each; where one dies all are set up anew, and their parts done again.

    ValueError for fewer than one process.
    """

    def __init__(self, jobs: int) -> None:
        if jobs < 1:
            raise ValueError(f"jobs = {jobs} is below 1. Give the number of processes.")
        self.jobs = jobs
        self._pool: Any = None

    def _room(self) -> int:
        return PER_WORKER * self.jobs

    def _submit(self, payload: bytes) -> Any:
        import multiprocessing
        from concurrent.futures import ProcessPoolExecutor
        from concurrent.futures.process import BrokenProcessPool

        if self._pool is None:
            # Not forked: threads of torch, numba and polars do not survive a fork.
            context = multiprocessing.get_context("spawn")
            self._pool = ProcessPoolExecutor(self.jobs, mp_context=context, initializer=_begin)
        try:
            return self._pool.submit(_work, payload)
        except BrokenProcessPool:
            self._close()
            return self._submit(payload)

    def _wait(self, handles: Sequence[Any]) -> Any:
        from concurrent.futures import FIRST_COMPLETED, wait

        done = wait(handles, return_when=FIRST_COMPLETED).done
        return next(handle for handle in handles if handle in done)

    def _result(self, handle: Any) -> tuple[str, Any]:
        from concurrent.futures import BrokenExecutor

        try:
            return handle.result()
        except BrokenExecutor:
            self._close()
            raise _LostError(f"the process that worked on it died {ATTEMPTS} times", False) from None

    def _close(self, handles: Sequence[Any] = ()) -> None:
        """End all processes at once: unfinished parts are done again by a later run."""
        if self._pool is None:
            return
        processes = compat.processes_of(self._pool)
        self._pool.shutdown(wait=False, cancel_futures=True)
        for process in processes:
            process.terminate()
        for process in processes:
            process.join()
        self._pool = None


def _begin() -> None:
    """Make a process leave Ctrl-C to the one that asked for the work, and end with it, whatever ended that."""
    import multiprocessing

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()

    def watch() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


# -- Ray -------------------------------------------------------------------------------------------------------------


@contextmanager
def _connected(address: str | None) -> Iterator[None]:
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    # Left to itself Ray joins whatever cluster somebody runs on this machine.
    address = address or os.environ.get("RAY_ADDRESS")
    with compat.ray_at_home() if address is None else compat.ray_elsewhere(round(PATIENCE)):
        with needed("executor = 'ray'"):
            import ray
        ours = not ray.is_initialized()
        if ours:
            more: dict[str, Any] = {"include_dashboard": False} if address is None else {}
            try:
                if address is not None:
                    _answers(address)
                ray.init(address=address or "local", log_to_driver=False, logging_level=logging.ERROR, **more)
            except Exception as error:
                words = " ".join(str(error).split())[:200]
                raise ValueError(
                    f"ray-address = {address!r} cannot be used ({words}). Start a cluster with `ray start --head`."
                ) from None
        try:
            yield
        finally:
            if ours:
                ray.shutdown()


def _answers(address: str) -> None:
    """Raise OSError at once where nobody at ``host:port`` speaks as Ray does, who is asked for minutes otherwise."""
    host, colon, port = address.rpartition("://")[2].rpartition(":")
    if address == "auto":
        return
    if not (host and colon and port.isdecimal() and int(port) < 1 << 16):
        raise OSError("it is not host:port")
    with socket.create_connection((host.strip("[]"), int(port)), timeout=PATIENCE) as line:
        if os.environ.get("RAY_USE_TLS", "0") not in ("", "0"):
            return
        # HTTP/2 begins with SETTINGS (type 4) on either side: RFC 9113, section 3.4.
        line.sendall(b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + b"\0\0\0\4\0\0\0\0\0")
        reply = b""
        while len(reply) < 4 and (more := line.recv(4 - len(reply))):
            reply += more
    if reply[3:] != b"\4":
        raise OSError("what answers there is not Ray")


class Ray(_Workers):
    """Tasks of a Ray cluster, one processor and one thread each; Ray gives a part to another worker if one is lost.

    The cluster may grow and shrink while the work lasts.
    """

    def __init__(self, jobs: int | None = None) -> None:
        import ray

        self.jobs, self._ray = jobs, ray

    @cached_property
    def _task(self) -> Any:
        return self._ray.remote(num_cpus=1, max_retries=ATTEMPTS)(_work)

    def _dumps(self, content: Any) -> bytes:
        from ray import cloudpickle

        return cloudpickle.dumps(content)

    def _room(self) -> int:
        return PER_WORKER * (self.jobs or max(1, int(self._ray.cluster_resources().get("CPU", 1))))

    def _submit(self, payload: bytes) -> Any:
        return self._task.remote(payload)

    def _wait(self, handles: Sequence[Any]) -> Any:
        return self._ray.wait(list(handles), num_returns=1)[0][0]

    def _result(self, handle: Any) -> tuple[str, Any]:
        try:
            return self._ray.get(handle)
        except self._ray.exceptions.RayError as error:
            words = f"the worker or node that worked on it was lost ({type(error).__name__})"
            raise _LostError(words, True) from None

    def _close(self, handles: Sequence[Any]) -> None:
        for handle in handles:
            self._ray.cancel(handle, force=True)
