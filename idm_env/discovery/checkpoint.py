"""What an interrupted search keeps: every finished candidate, in one file that is replaced atomically."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

import numpy as np

from idm_env.discovery.records import Records


class Checkpoint:
    """Arrays by key in one npz file; a file of other data or options is refused with ValueError.

    ``path`` None keeps everything in memory only; without ``resume`` an old file is overwritten.
    """

    def __init__(self, path: Path | None, fingerprint: str, resume: bool) -> None:
        self.path = path
        self.content: dict[str, np.ndarray] = {"fingerprint": np.array(fingerprint)}
        if path is None or not resume or not path.exists():
            return
        with np.load(path, allow_pickle=False) as saved:
            content = {name: saved[name] for name in saved.files}
        if str(content["fingerprint"]) != fingerprint:
            raise ValueError(f"{path} was left by a run on other data or options. Leave out --resume to start afresh.")
        self.content = content

    def get(self, key: str) -> dict[str, np.ndarray] | None:
        """Return the arrays kept under a key, or None."""
        start = f"{key}|"
        found = {name[len(start) :]: x for name, x in self.content.items() if name.startswith(start)}
        return found or None

    def put(self, key: str, **arrays: np.ndarray) -> None:
        """Keep arrays under a key, and write the file."""
        self.content |= {f"{key}|{name}": x for name, x in arrays.items()}
        if self.path is None:
            return
        beside = self.path.with_suffix(".part.npz")
        np.savez(beside, **self.content)  # type: ignore[arg-type]
        os.replace(beside, self.path)

    def done(self) -> None:
        """Remove the file: the search has ended."""
        if self.path is not None:
            self.path.unlink(missing_ok=True)


def fingerprint(records: Records, *options: object) -> str:
    """Return a digest of everything that determines a search."""
    digest = hashlib.sha256(repr((records.groups, records.runs, options)).encode())
    digest.update(records.signals.tobytes())
    return digest.hexdigest()
