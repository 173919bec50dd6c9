"""Printed files and where they lie: named by the digest of their text, so that a text is compiled once and for all."""

from __future__ import annotations

import hashlib
import logging
import os
import sys
import tempfile
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from types import ModuleType

from idm_env import modules


@lru_cache(maxsize=1)
def folder() -> Path:
    """Return the folder of printed files: ``IDM_ENV_CACHE``, or the user's cache, or a temporary one."""
    given = os.environ.get("IDM_ENV_CACHE")
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    for place in (Path(given) if given else None, home / "idm_env"):
        if place is None:
            continue
        try:
            place.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=place):
                return place
        except OSError:
            continue
    return Path(tempfile.mkdtemp(prefix="idm_env_"))


@lru_cache(maxsize=1)
def announce() -> None:
    """Say, once per process, that something is compiled that was not met before."""
    logging.getLogger("idm_env").warning(
        "idm_env compiles what it has not met before: some seconds for each set of effects, once. It is kept in %s.",
        folder(),
    )


def load(name: str, text: str, relies_on: Sequence[Path] = ()) -> ModuleType:
    """Write a text to the folder, unless it is there, and import it.

    ``relies_on`` are files whose compiled functions it calls: numba notices a change of the file that holds a function,
    not of one that it calls, so their text counts too.
    """
    digest = hashlib.sha256(text.encode())
    for path in relies_on:
        digest.update(path.read_bytes())
    module_name = f"idm_env_{name}_{digest.hexdigest()[:16]}"
    if module_name in sys.modules:
        return sys.modules[module_name]
    path = folder() / f"{module_name}.py"
    if not path.exists():
        announce()
        # Beside and then renamed: another process never sees half a file.
        handle, fresh = tempfile.mkstemp(dir=path.parent, suffix=".tmp")
        with os.fdopen(handle, "w", encoding="utf-8") as stream:
            stream.write(text)
        os.replace(fresh, path)
    return modules.run(path, module_name)
