"""Finished parts of a long run on disk, so that an interrupted run goes on where it was."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import polars as pl

from idm_env.data import DataError
from idm_env.report import write_json


class Parts:
    """Numbered parts in ``out/parts``: tables as parquet, and a JSON file that marks a part as done.

    The folder belongs to one run, told by a fingerprint of its data and settings; without ``resume`` it is emptied.
    DataError if ``resume`` finds the parts of another run.
    """

    def __init__(self, out: Path, fingerprint: str, resume: bool) -> None:
        self.folder = out / "parts"
        mark = self.folder / "run.json"
        if self.folder.exists() and resume and mark.exists():
            if json.loads(mark.read_text())["fingerprint"] != fingerprint:
                raise DataError(
                    f"{self.folder} was left by a run on other data or settings; leave out resume to start afresh."
                )
            return
        if self.folder.exists():
            shutil.rmtree(self.folder)
        self.folder.mkdir(parents=True)
        write_json(mark, {"fingerprint": fingerprint})

    def path(self, number: int, name: str) -> Path:
        """Return the file of a part's table."""
        return self.folder / f"{number:06d}.{name}.parquet"

    def done(self, number: int) -> bool:
        """Tell whether a part is finished."""
        return (self.folder / f"{number:06d}.json").exists()

    def finish(self, number: int, summary: dict[str, Any]) -> None:
        """Mark a part as done, with what is to be remembered of it; its tables must have been written before."""
        write_json(self.folder / f"{number:06d}.json", summary)

    def summaries(self) -> list[dict[str, Any]]:
        """Return what is remembered of all parts, in their order."""
        return [json.loads(p.read_text()) for p in sorted(self.folder.glob("[0-9]*.json"))]

    def join(self, name: str, target: Path) -> None:
        """Write the tables of all parts as one, without holding them in memory."""
        paths = sorted(self.folder.glob(f"[0-9]*.{name}.parquet"))
        pl.scan_parquet(paths, missing_columns="insert", extra_columns="ignore").sink_parquet(target)

    def remove(self) -> None:
        """Remove the folder: the run has ended."""
        shutil.rmtree(self.folder)
