"""What is compiled is kept: printed texts and machine code, in a folder that nobody else may write to.

Texts are run from memory, and written for those who want to read them. Machine code is taken only as it was written,
by its digest; what is damaged is removed and compiled again. Where no folder can be used nothing is kept.
"""

from __future__ import annotations

import hashlib
import logging
import os
import stat
import sys
import tempfile
from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import TypeVar

from idm_env.jobs import import_file

Loaded = TypeVar("Loaded")
_log = logging.getLogger("idm_env")
_SEAL = hashlib.sha256().digest_size


def folder(*variables: str) -> Path | None:
    """Return the first folder that serves: of those variables, of ``IDM_ENV_CACHE``, the user's cache; or None.

    A folder serves if it can be written to, and by nobody else: what lies there is run.
    """
    named = [Path(os.environ[name]) for name in (*variables, "IDM_ENV_CACHE") if os.environ.get(name)]
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser())
    return next(filter(None, map(_serving, (*named, home / "idm_env"))), None)


@lru_cache(maxsize=16)
def _serving(place: Path) -> Path | None:
    try:
        for each in (*reversed(place.parents), place):
            if not each.is_dir():
                each.mkdir(mode=0o700, exist_ok=True)  # Path.mkdir makes parents as the umask says
        with tempfile.TemporaryFile(dir=place):
            directory = place.resolve()
        reason = exposed(directory)
    except (OSError, RuntimeError):  # a link to itself is a RuntimeError before Python 3.13
        return None
    if reason is not None:
        _log.warning("idm_env leaves the cache %s alone, since what lies there is run: %s", place, reason)
    return directory if reason is None else None


def exposed(place: Path) -> str | None:
    """Return who else may write to a folder, or put another in its place, with the cure; None where nobody may.

    As ssh judges its own files: it and all above it belong to the user or to root, and group and others may not write,
    save where what is there can be removed only by its owner (``/tmp``).
    """
    if not hasattr(os, "getuid"):
        return None
    for each in (place, *place.parents):
        status = each.stat()
        if status.st_uid not in (0, os.getuid()):
            return f"{each} belongs to user {status.st_uid}. Set IDM_ENV_CACHE to a folder of your own."
        if status.st_mode & (stat.S_IWGRP | stat.S_IWOTH) and (each == place or not status.st_mode & stat.S_ISVTX):
            return f"others may write to {each} (mode {status.st_mode & 0o777:o}). Run: chmod go-w {each}"
    return None


@lru_cache(maxsize=1)
def announce() -> None:
    """Say, once per process, that something is compiled that was not met before."""
    place = folder("NUMBA_CACHE_DIR")
    _log.warning(
        "idm_env compiles what it has not met before: some seconds for each set of effects, once. %s",
        f"It is kept in {place}." if place else "Nothing can be kept: set IDM_ENV_CACHE to a folder of your own.",
    )


def _write(path: Path, content: bytes) -> None:
    """Write a file in one piece; one that cannot be written (a full disk) is compiled anew next time."""
    fresh = None
    try:
        # Beside and then renamed: another process never sees half a file.
        handle, fresh = tempfile.mkstemp(dir=path.parent, suffix=".tmp")
        with os.fdopen(handle, "wb") as stream:
            stream.write(content)
        os.replace(fresh, path)
    except OSError:
        if fresh is not None:
            with suppress(OSError):
                os.unlink(fresh)


class MachineCode:
    """Machine code by name, each in a file that begins with its digest: in ``NUMBA_CACHE_DIR``, or beside the texts."""

    def path(self, name: str) -> Path | None:
        """Return the file of a name, None where nothing is kept."""
        place = folder("NUMBA_CACHE_DIR")
        return None if place is None else place / f"{name}.nbc"

    def load(self, name: str, reader: Callable[[bytes], Loaded]) -> Loaded | None:
        """Return what ``reader`` makes of a content; None and a line for a ValueError: it is not what was written."""
        path = self.path(name)
        try:
            sealed = path.read_bytes() if path is not None else None
        except OSError:
            sealed = None
        if path is None or sealed is None:
            announce()
            return None
        try:
            if hashlib.sha256(sealed[_SEAL:]).digest() != sealed[:_SEAL]:
                raise ValueError(f"its {len(sealed)} bytes are not what was written")
            return reader(sealed[_SEAL:])
        except Exception as error:
            _log.warning("%s is damaged (%s): removed, and compiled again.", path, " ".join(str(error).split())[:80])
            with suppress(OSError):
                path.unlink()
            return None

    def save(self, name: str, content: bytes) -> None:
        """Keep a content."""
        path = self.path(name)
        if path is not None:
            _write(path, hashlib.sha256(content).digest() + content)


def load(name: str, text: str) -> ModuleType:
    """Run a printed text as a module, whose name has the digest of the text, and write it where it may be read."""
    module_name = f"idm_env_{name}_{hashlib.sha256(text.encode()).hexdigest()[:16]}"
    if module_name in sys.modules:
        return sys.modules[module_name]
    place, content = folder(), text.encode()
    path = (place or Path()) / f"{module_name}.py"
    if place is not None:
        try:
            same = path.read_bytes() == content
        except OSError:
            same = None
        if same is False:
            _log.warning("%s is damaged (not what was printed): written again.", path)
        if not same:
            _write(path, content)
    return import_file.run(path, module_name, text)
