"""A partitioned folder of parquet files, larger than memory: which runs it has, and some of them at a time."""

from dataclasses import dataclass, replace
from pathlib import Path

import polars as pl

from idm_env.data import clean, tidy
from idm_env.data.clean import natural
from idm_env.data.errors import DataError
from idm_env.data.names import Columns, check_columns, renamed
from idm_env.data.trajectories import Trajectories

_FILE = "idm_env_file"


@dataclass(frozen=True)
class FolderSlice:
    """Some whole runs of a folder (all: none named), the files that hold their rows, and how many vehicles."""

    folder: Path
    files: tuple[str, ...]
    runs: tuple[str, ...]
    vehicles: int
    columns: Columns = None

    def __str__(self) -> str:
        if not self.runs:
            return "all runs"
        first, last = self.runs[0], self.runs[-1]
        return f"run {first}" if first == last else f"runs {first} to {last}"

    def trajectories(self, *, ring_length: float | None = None, place: str | None = None) -> Trajectories:
        """Read and check these runs. DataError for rows that cannot be used."""
        try:
            rows = _named(_scan(self.folder, list(self.files)), self.columns, self.folder.name).drop(_FILE)
            table, repairs = tidy.read((rows.filter(_run().is_in(self.runs)) if self.runs else rows).collect())
            source = f"{self.folder.name}, {self}" if self.runs else self.folder.name
            return Trajectories.from_frame(table, source=source, ring_length=ring_length, place=place, repairs=repairs)
        except (pl.exceptions.PolarsError, OSError) as error:
            raise _unreadable(self.folder, error) from error


def shares(folder: Path, vehicles: int, columns: Columns = None) -> list[FolderSlice]:
    """Return the folder's runs, in the order of their names, in shares of about so many ``vehicles``.

    Only the columns of identifiers are read, in pieces. A run is never divided: whoever drives in it may be somebody's
    neighbour.

    Raises:
        DataError: If there is no parquet file, none of them can be read, a column is missing, or a row has no run.
    """
    files = files_of(folder)
    try:
        scan = _named(_scan(folder, files), columns, folder.name)
        names = [name for name in scan.collect_schema().names() if name != _FILE]
        tidy.check(names, folder.name)
        check_columns(tidy.converted(names), folder.name)
        if "run_id" not in names:
            return [FolderSlice(folder, tuple(files), (), 0, columns)]
        scan = scan.filter(pl.col("vehicle_id").is_not_null())
        keys = scan.select(_run().alias("run_id"), "vehicle_id", _FILE).group_by("run_id", _FILE)
        vehicles_of_files = keys.agg(pl.col("vehicle_id").unique()).collect(engine="streaming")
        clean.check_runs(scan.filter(_run().is_null()).select("vehicle_id").head(1).collect(), folder.name)
    except (pl.exceptions.PolarsError, OSError) as error:
        raise _unreadable(folder, error) from error
    number = pl.col("vehicle_id").explode().n_unique().alias("vehicles")
    runs = vehicles_of_files.group_by("run_id").agg(number, pl.col(_FILE).sort())
    cut: list[FolderSlice] = []
    for run, count, where in runs.sort(natural("run_id"), "run_id").select("run_id", "vehicles", _FILE).rows():
        if cut and cut[-1].vehicles + count <= vehicles:
            last = cut.pop()
            both = tuple(sorted({*last.files, *where}))
            cut.append(FolderSlice(folder, both, (*last.runs, run), last.vehicles + count, columns))
        else:
            cut.append(FolderSlice(folder, tuple(where), (run,), count, columns))
    return [replace(cut[0], runs=())] if len(cut) == 1 else cut or [FolderSlice(folder, tuple(files), (), 0, columns)]


def is_partitioned(path: Path) -> bool:
    """Tell whether a path is a folder with parquet files in it or below it: one table, in parts."""
    return path.is_dir() and any(path.rglob("*.parquet"))


def files_of(folder: Path) -> list[str]:
    """Return the parquet files in a folder and below it, in the order of their names. DataError if there is none."""
    files = sorted(str(path) for path in folder.rglob("*.parquet") if not path.name.startswith((".", "_")))
    if not files:
        raise DataError(f"{folder} is a folder without a parquet file; name a file, or a folder of parquet files.")
    return files


def stamp(path: Path) -> Path | list[tuple[str, int, int]]:
    """Return the identity of a file (itself) or of a folder: names, sizes and times of all files in it."""
    if not path.is_dir():
        return path
    files = map(Path, files_of(path))
    return [(str(file.relative_to(path)), file.stat().st_size, file.stat().st_mtime_ns) for file in files]


def partition(folder: Path, file: str) -> dict[str, str]:
    """Return the columns that the names of folders between give: ``run_id=7/rows.parquet`` has run_id 7."""
    between = Path(file).relative_to(folder).parts[:-1]
    return {name: value for name, equals, value in (part.partition("=") for part in between) if equals}


def _scan(folder: Path, files: list[str]) -> pl.LazyFrame:
    hive = any("=" in file.removeprefix(str(folder)) for file in files)
    return pl.scan_parquet(files, glob=False, hive_partitioning=hive, include_file_paths=_FILE)


def _named(scan: pl.LazyFrame, columns: Columns, source: str) -> pl.LazyFrame:
    """Return the rows with the columns that were asked for; DataError as in ``names.renamed``."""
    if columns is None:
        return scan
    sample, _ = renamed(scan.collect_schema().to_frame(), columns, source)
    return scan.map_batches(lambda rows: renamed(rows, columns, source)[0], schema=sample.schema)


def _run() -> pl.Expr:
    return pl.col("run_id").cast(pl.String).str.strip_chars().replace("", None)


def _unreadable(folder: Path, error: Exception) -> DataError:
    reason = str(error).strip().splitlines()[0][:150] if str(error).strip() else type(error).__name__
    return DataError(f"{folder} cannot be read ({reason}); its parquet files must have one set of columns.")
