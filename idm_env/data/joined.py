"""Several files as one data set: a copy with the rows of all, in which each file is a run, or has runs of its own."""

from collections.abc import Sequence
from pathlib import Path

import polars as pl

from idm_env.data import clean, folder, plain
from idm_env.data.errors import Counted, DataError
from idm_env.data.load import REPAIRS, batches, files_of
from idm_env.data.names import Columns, check_columns


def joined(paths: Sequence[str | Path], *, layout: str = "auto", columns: Columns = None, whole: bool = True) -> Path:
    """Return a file with the rows of several files, folders and patterns; a single file as it is.

    ``whole`` is false for those who read a folder of parquet files by themselves. The run of a file is called after
    it; runs of its own are called ``file:run``. A folder of parquet files is one table, whose runs keep their names.
    The copy lasts as long as the process. It has tidy columns in SI units, and ``load`` tells what was repaired.

    Raises:
        DataError: If there is no file, one of them cannot be read, or only some name leaders.
    """
    path = Path(paths[0])
    partitioned = len(paths) == 1 and folder.is_partitioned(path)
    files = [path] if partitioned else files_of([Path(p) for p in paths])
    if len(files) == 1 and not (partitioned and whole):
        return files[0]
    copies, counted = plain.temporary(), Counted()
    parts: list[Path] = []
    leaders: dict[bool, str] = {}
    for file, name in zip(files, names_of(files), strict=True):
        for frame, repairs in batches(file, layout=layout, columns=columns):
            counted.add(repairs)
            check_columns(frame.columns, file.name)
            leaders[("leader_id" in frame.columns)] = file.name
            rows = frame if partitioned else _with_run(frame, name)
            parts.append(copies / f"{len(parts)}.parquet")
            clean.identifiers(rows, file.name).write_parquet(parts[-1])
    if len(leaders) > 1:
        raise DataError(f"{leaders[False]} lacks the column leader_id of {leaders[True]}; give it to all or none.")
    label = path.name if len(paths) == 1 and path.is_dir() else f"{files[0].name} and {len(files) - 1} more"
    copy = copies / f"{label}.parquet"
    pl.concat([pl.scan_parquet(part, glob=False) for part in parts], how="diagonal_relaxed").sink_parquet(copy)
    for part in parts:
        part.unlink()
    REPAIRS[copy] = counted.repairs()
    return copy


def names_of(files: Sequence[Path]) -> list[str]:
    """Return a name for every file: its own without extension, numbered where that is there twice."""
    names: list[str] = []
    for path in files:
        name = path.name.split(".")[0]
        count = sum(n == name or n.startswith(f"{name}-") for n in names)
        names.append(f"{name}-{count + 1}" if count else name)
    return names


def _with_run(frame: pl.DataFrame, name: str) -> pl.DataFrame:
    """Return a file's rows with its name as run, before a name of their own that is not the reader's."""
    if "run_id" not in frame.columns:
        return frame.with_columns(run_id=pl.lit(name))
    run = pl.col("run_id").cast(pl.String)
    own = run.is_not_null() & ~run.is_in(["", "ngsim", name])
    return frame.with_columns(run_id=pl.when(own).then(pl.format("{}:{}", pl.lit(name), run)).otherwise(pl.lit(name)))
