"""Files of text that are no plain csv, as copies that are: other encodings, packings and headers, SUMO's and Vissim's.

SUMO's ``--fcd-output`` and Vissim's vehicle records have positions along an edge or a link, which begin anew on the
next one: each is a run. Positions are of front bumpers (m); SUMO's speeds are in m/s, Vissim's in km/h.
"""

from __future__ import annotations

import atexit
import gzip
import io
import re
import shutil
import tempfile
import zipfile
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import polars as pl

from idm_env.data import ngsim
from idm_env.data.errors import DataError

ENDINGS = (".txt", ".tsv", ".fzp", ".xml", ".zip", ".txt.gz", ".xml.gz")
"""Of files that are read by way of a copy, beside those of csv that need one."""
_VISSIM = (
    "SIMSEC=time_s NO=vehicle_id LANE\\LINK\\NO=run_id LANE\\INDEX=lane POS=position_m SPEED=speed_kmh LENGTH=length_m"
)
VISSIM = dict(pair.split("=") for pair in _VISSIM.split())
"""Names of tidy columns for those of Vissim."""
FCD = ("id", "pos", "lane", "speed", "leaderID", "type")
"""Attributes of a vehicle of SUMO's that are read."""
HEAD = 1 << 16
_copies: dict[tuple[str, int, int], Path] = {}
"""Copies by file, size and time, until the process ends."""


def plain(path: Path) -> Path:
    """Return a file that is plain csv: the given one, or a copy under its name. DataError for a missing header."""
    about = path.stat()
    key = str(path.absolute()), about.st_size, about.st_mtime_ns
    if key not in _copies:
        with ExitStack() as files:
            text = _rewritten(path, files)
        if text is None:
            return path
        copy = temporary() / (path.name if path.name.lower().endswith(".csv") else f"{path.name}.csv")
        copy.write_text(text, encoding="utf-8")
        _copies[key] = copy
    return _copies[key]


def temporary() -> Path:
    """Return a new folder that lasts as long as the process."""
    folder = tempfile.mkdtemp()
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return Path(folder)


def _rewritten(path: Path, files: ExitStack) -> str | None:
    """Return the text of a file as plain csv; None for a plain file."""
    name = path.name.lower()
    raw: Any = files.enter_context(path.open("rb"))
    if name.endswith(".zip"):
        archive = files.enter_context(zipfile.ZipFile(raw))
        members = [member for member in archive.namelist() if not member.endswith("/")]
        if len(members) != 1:
            raise DataError(f"{path.name} holds {len(members)} files; unpack it, and name one or its folder.")
        raw, name = files.enter_context(archive.open(members[0])), members[0].lower()
    file = files.enter_context(gzip.GzipFile(fileobj=raw)) if name.endswith(".gz") else raw
    head = file.read(HEAD)
    if head.lstrip()[:1] == b"<" or ".xml" in name:
        return _of_sumo(path, io.BytesIO(head + file.read()))
    encoding = "utf-16" if head[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8"
    lines = head.decode(encoding, "replace").removeprefix("\ufeff").splitlines()
    first = lines[0] if lines else ""
    cells = re.split(r"[,;\t]|\s+", first.strip())
    numbers = len(cells) > 2 and all(re.fullmatch(r"[+-]?\d*\.?\d+(e[+-]?\d+)?", cell.strip(), re.I) for cell in cells)
    ends = [row[-1:] for row in lines[1:20]]
    trailing = bool(ends) and set(ends) < {",", ";"} and first.count(ends[0]) + 1 == lines[1].count(ends[0])
    odd = first.startswith(("#", "$", "*")) or first.lower().startswith("sep=")
    if not (odd or numbers or trailing or encoding != "utf-8" or path.name.lower().endswith((".zip", ".txt.gz"))):
        return None
    lines = (head + file.read()).decode(encoding, "replace").removeprefix("\ufeff").splitlines()
    mark = lines.pop(0)[4:] if first.lower().startswith("sep=") else ""
    header = next((line for line in lines if line.startswith("$VEHICLE:")), None)
    rows = [line for line in lines if line.strip() and not line.startswith(("#", "$", "*"))]
    if header is not None:
        return "\n".join([";".join(VISSIM.get(n, n) for n in header.partition(":")[2].split(";")), *rows]) + "\n"
    if numbers and len(cells) not in ngsim.WITHOUT_HEADER:
        shown = ", ".join(cells[:4])
        raise DataError(f"{path.name}: the first line holds numbers, {shown} …: it has no header. Add a line of names.")
    if numbers:
        rows = [
            ",".join(re.split(r"[,;\t]|\s+", row.strip()))
            for row in (" ".join(ngsim.WITHOUT_HEADER[len(cells)]), *rows)
        ]
    if trailing:
        rows = [first, *(row[:-1] for row in rows[1:])]
    return "\n".join(row.replace(mark, "\t") if mark not in ("", ",", ";") else row for row in rows) + "\n"


def _of_sumo(path: Path, file: io.BytesIO) -> str:
    """Return floating-car data of XML as csv, under the names of SUMO."""
    rows: list[list[str | None]] = []
    time, root = "", ""
    try:
        for event, element in ElementTree.iterparse(file, ("start", "end")):
            root = root or element.tag
            time = element.get("time", "") if element.tag == "timestep" else time
            if event == "end" and element.tag == "vehicle":
                rows.append([time, *map(element.get, FCD)])
            if event == "end":
                element.clear()
    except ElementTree.ParseError as error:
        raise DataError(f"{path.name} is no whole XML ({error}); is it complete?") from None
    if root != "fcd-export":
        raise DataError(f"{path.name} is XML of <{root}>; of SUMO's files that of --fcd-output is read.")
    table = pl.DataFrame(rows, ["timestep_time", *(f"vehicle_{name}" for name in FCD)], orient="row")
    return table.select(column for column in table if column.null_count() < table.height).write_csv()


def sumo(table: pl.DataFrame) -> pl.DataFrame:
    """Return the tidy table of floating-car data: each edge is a run, whose lanes are numbered as in the file."""
    table = table.filter(pl.col("vehicle_id").is_not_null() & pl.col("vehicle_lane").is_not_null())
    parts = pl.col("vehicle_lane").cast(pl.String).str.extract_groups(r"^(?<run_id>.*)_(?<lane>\d+)$").struct.unnest()
    names = {"timestep_time": "time_s", "vehicle_pos": "position_m", "vehicle_speed": "speed_mps"}
    names |= {"vehicle_leaderID": "leader_id", "vehicle_type": "vehicle_class", "vehicle_id": "vehicle_id"}
    return table.select(parts, *(pl.col(old).alias(new) for old, new in names.items() if old in table.columns))
