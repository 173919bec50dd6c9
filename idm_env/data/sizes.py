"""Readers that refuse a file which memory does not hold, whatever it is packed in.

A trailer of gzip tells a size modulo 2³² of its last member only, so bytes are counted as they are unpacked.
"""

import gzip
import os
from pathlib import Path
from typing import IO, cast

import polars as pl

from idm_env.data.errors import DataError

SHARE = 8
"""Tables take up to sixteen times their text; a file beyond one part in so many of free memory is refused."""


def available() -> int:
    """Return the free memory (bytes) as Linux tells it; of other systems all memory."""
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        return 1024 * next(int(line.split()[1]) for line in lines if line.startswith("MemAvailable:"))
    except (OSError, StopIteration):
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") if hasattr(os, "sysconf") else 1 << 40


def unpacked(path: Path) -> IO[bytes]:
    """Return a file opened for reading, by its ending as gzip."""
    return cast(IO[bytes], gzip.open(path)) if path.name.lower().endswith(".gz") else path.open("rb")


def read_whole(file: IO[bytes], source: str) -> bytes:
    """Return the rest of a file. DataError before more is read than memory holds as a table."""
    parts, size = [], 0
    while part := file.read(1 << 20):
        parts.append(part)
        size += len(part)
        refuse_size(size, source)
    return b"".join(parts)


def read_parquet(path: Path, rows: int | None) -> pl.DataFrame:
    """Return the table of a parquet file, or its first rows. DataError, unread, for one that memory does not hold."""
    table = pl.scan_parquet(path.absolute(), n_rows=rows, glob=False)  # polars takes a leading ~ for a home
    cells = table.select(pl.len()).collect().item() * len(table.collect_schema())
    refuse_size(8 * cells, path.name)
    return table.collect()


def refuse_size(size: int, source: str) -> None:
    """Raise DataError for more bytes of text or cells than tables may be made of."""
    if size > (most := available() // SHARE):
        raise DataError(
            f"{source} holds {size / 1e9:.2g} GB or more, unpacked, and free memory is enough for tables of at most "
            f"{most / 1e9:.2g} GB. Split it by runs into several files, or free memory."
        )
