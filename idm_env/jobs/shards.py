"""Finished parts of a long run on disk, so that an interrupted run goes on where it was."""

from pathlib import Path
from typing import Any

from idm_env.extras import needed
from idm_env.jobs import storage

with needed("a part of a folder"):
    import polars as pl


class Parts:
    """Numbered parts in a ``Store``: tables as parquet, and a summary that marks a part as done.

    A part may be done more than once, and at the same time: whoever is last leaves the same.

    ValueError for what ``Store`` refuses, and for a table of a finished part that is not what was written.
    """

    def __init__(self, folder: Path, fingerprint: str, resume: bool) -> None:
        self.store = storage.Store(folder, fingerprint, resume)
        self.folder = folder

    def path(self, number: int, name: str) -> Path:
        """Return the file of a part's table."""
        return self.folder / f"{number:06d}.{name}.parquet"

    def write(self, number: int, name: str, table: pl.DataFrame) -> None:
        """Write a table of a part."""
        storage.write(self.path(number, name), table.write_parquet, shared=True)

    def done(self, number: int) -> bool:
        """Tell whether a part is finished, with its tables as they were written.

        ValueError for a table that is not what was written.
        """
        part = self.store.get_json(f"{number:06d}")
        if part is None:
            return False
        for name, digest in part["tables"].items():
            path = self.folder / name
            if not path.is_file() or storage.fingerprint(path) != digest:
                raise ValueError(f"{path} is broken (not what was written). {storage.AFRESH}")
        return True

    def finish(self, number: int, summary: dict[str, Any]) -> None:
        """Mark a part as done, with its summary; its tables must have been written before."""
        tables = {p.name: storage.fingerprint(p) for p in self.folder.glob(f"{number:06d}.*.parquet")}
        self.store.put_json(f"{number:06d}", {"summary": storage.plain(summary), "tables": tables})

    def summaries(self) -> list[dict[str, Any]]:
        """Return the summaries of all parts, in their order."""
        return [self.store.get_json(key)["summary"] for key in self.store.saved_names()]

    def tables(self, name: str) -> list[Path]:
        """Return the files of all parts' tables of a name, in the order of the parts."""
        return sorted(self.folder.glob(f"[0-9]*.{name}.parquet"))

    def join(self, name: str, target: Path) -> None:
        """Write the tables of all parts as one, holding one of them at a time: parquet, or csv with four digits."""
        whole = pl.scan_parquet(self.tables(name), glob=False, missing_columns="insert", extra_columns="ignore")
        if target.suffix == ".csv":
            storage.write_csv(target, whole.with_columns(pl.selectors.float().round_sig_figs(4)))
        else:
            storage.write(target, whole.sink_parquet)

    def remove(self) -> None:
        """Remove the folder: the run has ended."""
        self.store.remove()
