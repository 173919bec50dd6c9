"""Read a file of measured vehicles, whatever its layout, into checked trajectories."""

import glob
import io
import re
import zipfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import polars as pl

from idm_env.data import drones, folder, ngsim, openacc, pair, plain, tidy, ultra_av
from idm_env.data.errors import DataError, Repair, listed, nearest, refuse_missing
from idm_env.data.names import Columns, check_columns, renamed, unread
from idm_env.data.schema import TIDY
from idm_env.data.sizes import read_parquet, read_whole, unpacked
from idm_env.data.trajectories import Trajectories, parted

LAYOUTS = ("auto", "tidy", "ngsim", "openacc", "ultra_av", "highd", "exid", *drones.FILES)
TABLES: dict[str, tuple[Callable[[list[str]], bool], Callable[[pl.DataFrame, str], drones.Read]]] = {
    "ultra_av": (ultra_av.matches, ultra_av.read),
    "ngsim": (ngsim.matches, ngsim.read),
    "highd": (drones.is_highd, drones.highd),
    "exid": (drones.is_exid, drones.exid),
    "sumo": (plain.is_sumo, plain.sumo),
}
"""Layouts of tables with names of their own: how a header is recognised, and who reads it."""
EXTENSIONS = (".csv", ".csv.gz", ".parquet", *plain.ENDINGS)
CURES = {".mat": "in MATLAB, writetable saves csv", ".gpx": "give the way along the road, as csv"}
CURES |= dict.fromkeys((".xls", ".ods"), "save the sheet as csv")
CURES |= dict.fromkeys((".mf4", ".mdf", ".blf", ".asc", ".bag", ".mcap"), "export its signals as csv, as asammdf does")
CURES |= dict.fromkeys((".h5", ".hdf5", ".pkl", ".feather", ".npz", ".zarr"), "in Python, pandas saves csv and parquet")
"""What makes a file that is not read one that is, by its extension."""
BATCH_BYTES, BATCH_ROWS = 16_000_000, 200_000
"""Text and rows that ``batches`` holds at a time."""
HEAD_ROWS = 100
"""Rows that ``refuse_head`` reads."""
REPAIRS: dict[Path, tuple[Repair, ...]] = {}
"""Repairs of files that were joined, by their copy."""
_HELD: dict[tuple[object, ...], Trajectories] = {}
"""What ``hold`` read, until it is asked for."""
_MISSING = ["", "NA", "N/A", "NaN", "nan", "null", "None"]
_LONGEST = 10_000_000  # characters of a line; a vehicle of pNEUMA's, who has one, takes a tenth
_UNREADABLE = (pl.exceptions.PolarsError, pl.exceptions.PanicException, OSError, EOFError, UnicodeError, ValueError)


def load(
    path: str | Path,
    *,
    ring_length: float | None = None,
    place: str | None = None,
    layout: str = "auto",
    columns: Columns = None,
) -> Trajectories:
    """Return the trajectories of a file; the file itself is only read.

    Args:
        path: A csv, csv.gz or parquet file: a tidy table, an NGSIM file or an OpenACC file.
        ring_length: Length in m of a closed road, on which a leader may be behind.
        place: Column with the coordinate of places (hills, zones), such as ``"track_s_m"``; position_m if None.
        layout: ``"tidy"``, ``"ngsim"``, ``"openacc"``, ``"highd"``, ``"exid"``, ``"pneuma"``, ``"i24"``,
            ``"ultra_av"``, or ``"auto"`` to tell by the file.
        columns: Names of the file's columns where they are not tidy, with their units: ``"time_s=t,vehicle_id=car,
            position_m=x[ft]"``, or a mapping. The layout is then a tidy one.

    Raises:
        DataError: If the file cannot be read or used; one line that names the value, the rule and the cure.
    """
    path = Path(path)
    if (held := _HELD.pop(_key(path, ring_length, place, layout, columns), None)) is not None:
        return held
    frame, repairs = read(path, layout=layout, columns=columns)
    if any(repair.kind == drones.NO_LEADERS for repair in repairs):
        raise DataError(f"{path.name}: pNEUMA has no leaders, so that nobody follows anybody; filter takes it.")
    try:
        return Trajectories.from_frame(frame, source=path.name, ring_length=ring_length, place=place, repairs=repairs)
    except pl.exceptions.PolarsError as error:
        # Types that no rule foresaw, such as lists in a parquet column, or one name twice.
        raise _unreadable(path, error) from error


def hold(path: Path, **options: Any) -> None:
    """Read a file as ``load`` does, whose DataErrors it raises, and keep it for the next one with these options."""
    trajectories = load(path, **options)
    _HELD.clear()
    _HELD[_key(path, *(options[name] for name in ("ring_length", "place", "layout", "columns")))] = trajectories


def _key(path: Path, *options: object) -> tuple[object, ...]:
    """Return all that the trajectories of a file depend on."""
    about = path.stat() if path.exists() else None
    return str(path), about and (about.st_size, about.st_mtime_ns), *map(str, options)


def files_of(paths: Sequence[Path]) -> list[Path]:
    """Return the files that paths, folders and patterns such as ``drives/*.csv`` name, in order, each once.

    A ``.txt`` beside other data in a folder is taken for notes, and so is highD's ``…Meta.csv``. DataError for a folder
    or a pattern without a file.
    """
    files: list[Path] = []
    for path in paths:
        if path.is_dir():
            some = sorted(p for p in path.iterdir() if p.name.lower().endswith(EXTENSIONS) and p.is_file())
            some = [p for p in some if not p.name.lower().endswith((".txt", "meta.csv"))] or some
        elif path.exists() or not glob.has_magic(str(path)):
            some = [path]
        else:
            some = sorted(Path(p) for p in glob.glob(str(path), recursive=True))
        if not some:
            raise DataError(f"{path} holds no data set; name files that end in {', '.join(EXTENSIONS)}.")
        files += some
    return list(dict.fromkeys(files))


def refuse_head(
    path: Path, layout: str, conditions: Iterable[str], place: str | None, by: str | None, columns: Columns = None
) -> None:
    """Raise DataError for refusals of ``load`` in the first rows of a file, and for columns that it has not.

    ``conditions`` are of the form ``column=value``; ``by`` is a column that tells groups apart. Of layouts that are no
    table only the path is looked at.
    """
    named = [column for column, _ in map(parted, conditions)]
    if _own_reader(path, _layout(layout, columns)):
        return
    frame, _ = read(path, layout=layout, columns=columns, rows=HEAD_ROWS)
    check_columns(frame.columns, path.name)
    has = dict.fromkeys((*frame.columns, *TIDY))
    refuse_missing([*named, *([] if place is None else [place])], has, path.name)
    if by is not None and by not in has:
        guess = nearest(by, has)
        cure = f"Did you mean {guess!r}?" if guess else f"Use driver, all, or one of {listed(frame.columns)}."
        raise DataError(f"cannot group by {by!r}: no such column. {cure}")


def read(
    path: str | Path, *, layout: str = "auto", columns: Columns = None, rows: int | None = None
) -> tuple[pl.DataFrame, list[Repair]]:
    """Return the tidy frame of a file, in SI units and not checked yet, and the repairs of its reader.

    ``rows`` are read at most, where it is a table.

    Raises:
        DataError: If the file cannot be read or its layout is unknown.
    """
    path, layout = Path(path), _layout(layout, columns)
    path = _plain(path)
    if own := _own_reader(path, layout):
        return own(path)
    extension, lines, written = _checked(path)
    above = openacc.header_line(lines)
    try:
        if layout == "openacc" or (layout == "auto" and above is not None):
            above = openacc.HEADER_LINES if above is None else above
            table = _once(_table(path, extension, written, above, rows), path.name)
            return openacc.read(table, lines[:above], path.name.split(".")[0], path.name)
        frame, repairs = _plain_layout(_table(path, extension, written, 0, rows), layout, path.name, columns)
        return frame, [*REPAIRS.get(path, ()), *repairs]
    except pl.exceptions.PolarsError as error:
        raise _unreadable(path, error) from error


def batches(
    path: str | Path, *, layout: str = "auto", columns: Columns = None
) -> Iterator[tuple[pl.DataFrame, list[Repair]]]:
    """Yield what ``read`` returns piece by piece, so that a file of any size needs little memory.

    Of a folder of parquet files, one after the other; ``name=value`` in the names of folders below it is a column.
    Files whose rows explain each other come as one piece: OpenACC, NGSIM of several places or periods, and drones'.
    """
    path, layout = Path(path), _layout(layout, columns)
    if path.is_dir():
        for file in folder.files_of(path):
            labels = [pl.lit(value).alias(name) for name, value in folder.partition(path, file).items()]
            for frame, repairs in batches(file, layout=layout, columns=columns):
                yield frame.with_columns(labels), repairs
        return
    path = _plain(path)
    if own := _own_reader(path, layout):
        yield own(path)
        return
    extension, lines, written = _checked(path)
    if layout == "openacc" or (layout == "auto" and openacc.header_line(lines) is not None):
        yield read(path, layout=layout)
        return
    try:
        for number, table in enumerate(_pieces(path, extension, written)):
            names = [name.strip().lower() for name in table.columns]
            explain_each_other = ngsim.matches(names) and ("location" in names or "frame_id" not in names)
            by_frame = drones.is_highd(table.columns) or drones.is_exid(table.columns)
            whole = columns is None and (explain_each_other or by_frame)
            if number == 0 and (whole or pair.matches(columns)):
                yield read(path, layout=layout, columns=columns)
                return
            frame, repairs = _plain_layout(table, layout, path.name, columns)
            yield frame, [*(() if number else REPAIRS.get(path, ())), *repairs]
    except pl.exceptions.PolarsError as error:
        raise _unreadable(path, error) from error


def _layout(layout: str, columns: Columns) -> str:
    """Return the layout to read, which is tidy where columns are named. DataError for an unknown one."""
    if layout not in LAYOUTS:
        raise DataError(f"layout = {layout!r} is unknown; use one of {', '.join(LAYOUTS)}.")
    if columns is not None and layout not in ("auto", "tidy"):
        raise DataError(f"columns are named, and layout = {layout!r} has its own. Leave one of them out.")
    return layout if columns is None else "tidy"


def _pieces(path: Path, extension: str, written: dict[str, Any]) -> Iterator[pl.DataFrame]:
    """Yield the table of a file in pieces, at least one."""
    try:
        if extension == ".parquet":
            from pyarrow import parquet

            with parquet.ParquetFile(path) as file:
                empty = pl.DataFrame(pl.from_arrow(file.schema_arrow.empty_table()))
                has_rows = False
                for piece in file.iter_batches(BATCH_ROWS):
                    has_rows = True
                    yield pl.DataFrame(pl.from_arrow(piece))
                if not has_rows:
                    yield empty
            return
        with unpacked(path) as file:
            head = file.readline()
            rows = file.readlines(BATCH_BYTES)
            while True:
                text = io.BytesIO(head + b"".join(rows))
                yield pl.read_csv(text, infer_schema_length=None, null_values=_MISSING, glob=False, **written)
                rows = file.readlines(BATCH_BYTES)
                if not rows:
                    return
    except _UNREADABLE as error:
        raise _unreadable(path, error) from None


def _own_reader(path: Path, layout: str) -> Callable[[Path], tuple[pl.DataFrame, list[Repair]]] | None:
    """Return the reader of a layout that is no table, by its name or by how the file begins; None for tables."""
    if layout in drones.FILES or (layout == "auto" and path.name.lower().endswith(".json")):
        if not path.is_file():
            raise DataError(f"{path} does not exist; check the path.")
        return drones.FILES[layout if layout in drones.FILES else "i24"]
    if layout == "auto" and path.is_file() and path.name.lower().endswith(".csv"):
        first = _first_lines(path, 1)[0].replace(" ", "")
        if first.startswith("track_id;type;"):
            return drones.pneuma
    return None


def _plain_layout(
    table: pl.DataFrame, layout: str, source: str, columns: Columns = None
) -> tuple[pl.DataFrame, list[Repair]]:
    table = _once(table, source)
    if columns is not None:
        table, named = (pair.read if pair.matches(columns) else renamed)(table, columns, source)
        frame, repairs = tidy.read(table)
        return frame, [*named, *repairs]
    for name, (matches, reader) in TABLES.items():
        if layout == name or (layout == "auto" and matches(table.columns)):
            return reader(table, source)
    if layout == "auto":
        tidy.check(table.columns, source)
    frame, repairs = tidy.read(table)
    return frame, [*repairs, *unread(frame.columns)]


def _once(table: pl.DataFrame, source: str) -> pl.DataFrame:
    """Return the table with names without blanks around them, or raise DataError where one is there twice."""
    names = [name.strip() for name in table.columns]
    # polars numbers the repeats of a csv's columns: x, x_duplicated_0
    plain = [re.sub(r"_duplicated_\d+$", "", name).strip() for name in names]
    for name, base in zip(names, plain, strict=True):
        if names.count(name) > 1 or (name != base and base in names):
            raise DataError(f"{source}: column {base!r} is there twice; remove or rename one of them.")
    return table.rename(dict(zip(table.columns, names, strict=True)))


def _checked(path: Path) -> tuple[str, list[str], dict[str, Any]]:
    """Return the file's extension, its first lines of text, and how its cells are written, as polars is told it.

    Cells are separated by commas, or by semicolons or tabs, whose decimals may have commas. DataError for no readable
    file of a known kind.
    """
    if path.is_dir():
        raise DataError(f"{path} is a directory; name one file in it ({', '.join(EXTENSIONS)}).")
    if not path.exists():
        raise DataError(f"{path} does not exist; check the path.")
    extension = next((ending for ending in EXTENSIONS if path.name.lower().endswith(ending)), None)
    if extension is None:
        cure = CURES.get(path.suffix.lower(), "save it as csv")
        raise DataError(f"{path.name} has an unknown extension; {cure}. Read: {', '.join(EXTENSIONS)}.")
    if path.stat().st_size == 0:
        raise DataError(f"{path.name} is empty (0 bytes); it needs a header and rows.")
    if extension == ".parquet":
        return extension, [], {}
    lines = _first_lines(path, openacc.SEARCHED_LINES)
    mark = max(",;\t", key=lines[0].count)
    rows = "".join(lines[1:])
    comma = mark != "," and bool(re.search(r"\d,\d", rows)) and not re.search(r"\d\.\d", rows)
    return extension, lines, {"separator": mark, "decimal_comma": comma}


def _plain(path: Path) -> Path:
    """Return the path of a plain copy of a text file; other files unchanged."""
    if path.name.lower().endswith((".parquet", ".json")) or not path.is_file() or not path.stat().st_size:
        return path
    try:
        return plain.plain(path) if path.name.lower().endswith(EXTENSIONS) else path
    except (*_UNREADABLE, zipfile.BadZipFile) as error:
        raise _unreadable(path, error) from None


def _first_lines(path: Path, count: int) -> list[str]:
    try:
        with io.TextIOWrapper(unpacked(path), encoding="utf-8", errors="replace") as file:
            lines = [file.readline(_LONGEST) for _ in range(count)]
    except _UNREADABLE as error:
        raise _unreadable(path, error) from None
    if max(map(len, lines)) == _LONGEST:
        raise DataError(f"{path.name} has a line of more than {_LONGEST} characters; it is no table of rows.")
    return lines


def _table(path: Path, extension: str, written: dict[str, Any], skip: int = 0, rows: int | None = None) -> pl.DataFrame:
    try:
        if extension == ".parquet":
            return read_parquet(path, rows)
        if rows is not None:
            whole = "".join(_first_lines(path, skip + 1 + rows)).encode()
        else:
            with unpacked(path) as file:
                whole = read_whole(file, path.name)
        return pl.read_csv(whole, skip_rows=skip, infer_schema_length=None, null_values=_MISSING, glob=False, **written)
    except _UNREADABLE as error:
        raise _unreadable(path, error) from None


def _odd_line(path: Path) -> str:
    """Return in words the first line of a text with more cells than its header, or an open quote; "" of none."""
    with path.open(encoding="utf-8", errors="replace") as file:
        header = file.readline()
        mark = max(",;\t", key=header.count)
        cells = header.count(mark) + 1
        for number, line in enumerate(file, 2):
            shown = line.strip()[:60]
            if line.count('"') % 2:
                return f"line {number} has a quote that does not end: {shown}"
            if '"' not in line and line.count(mark) >= cells:
                return f"line {number} has {line.count(mark) + 1} cells, and the header {cells}: {shown}"
    return ""


def _unreadable(path: Path, error: BaseException) -> DataError:
    """Return the error in one line; of packed files, two libraries would say the same fault in two ways."""
    if isinstance(error, DataError):
        return error
    packed = next((kind for kind in ("parquet", "gz") if path.name.lower().endswith(f".{kind}")), None)
    reason = str(error).strip().splitlines()[0][:150] if str(error).strip() else type(error).__name__
    if packed and not getattr(error, "errno", None):
        reason = f"as {packed}"
    elif isinstance(error, pl.exceptions.ComputeError) and (line := _odd_line(path)):
        return DataError(f"{path.name}: {line}. Mend that line, or delete the lines above the header.")
    return DataError(f"{path.name} cannot be read ({reason}); is it complete and what its extension says?")
