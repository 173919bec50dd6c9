"""Files of text that are no plain csv, as copies that are: other encodings, packings and headers, SUMO's and Vissim's.

SUMO's ``--fcd-output`` and Vissim's vehicle records have positions along an edge or a link, which begin anew on the
next one: each is a run. Positions are of front bumpers (m); SUMO's speeds are in m/s, Vissim's in km/h.
"""

import atexit
import gzip
import re
import shutil
import tempfile
import zipfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from contextvars import ContextVar
from itertools import chain
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import polars as pl

from idm_env.data import ngsim
from idm_env.data.errors import DataError, Repair
from idm_env.data.names import UNITS
from idm_env.data.schema import TIDY
from idm_env.data.sizes import read_whole

ENDINGS = (".txt", ".tsv", ".fzp", ".xml", ".xlsx", ".zip", ".txt.gz", ".xml.gz")
"""Of files that are read by way of a copy, beside those of csv that need one."""
_VISSIM = (
    "SIMSEC=time_s NO=vehicle_id LANE\\LINK\\NO=run_id LANE\\INDEX=lane POS=position_m SPEED=speed_kmh LENGTH=length_m "
    "t=time_s VehNr=vehicle_id Link=run_id Lane=lane x=position_m v=speed_kmh Length=length_m"
)
VISSIM = dict(pair.split("=") for pair in _VISSIM.split())
"""Names of tidy columns for those of Vissim, of today and of old, in the units that no line above the header tells."""
TOLD_UNITS = {"m": "m", "ft": "ft", "km/h": "kmh", "mph": "mph", "m/s": "mps", "ft/s": "fps"}
UNIT_NAMES = {"", "-", *(unit for units in UNITS.values() for unit in units)}
FCD = {"id": "vehicle_id", "pos": "position_m", "speed": "speed_mps", "leaderID": "leader_id", "leaderGap": "gap_m"}
FCD |= {"lane": "lane", "type": "vehicle_class"}
"""Attributes of a vehicle of SUMO's that are read, and their tidy columns."""
SUMO_LENGTHS_M = {"truck": 7.1, "trailer": 16.5, "bus": 12.0, "coach": 14.0, "delivery": 6.5, "motorcycle": 2.2}
SUMO_LENGTHS_M |= {"moped": 2.1, "bicycle": 1.6, "scooter": 1.2}
"""Lengths by vClass where a vType has none; 5 m for others."""
TYPES_READ = 1 << 20
"""Characters of a file of routes in which vTypes are looked for."""
HEAD, TAB, NL = 1 << 16, "\t", "\n"
ON_PART: ContextVar[Callable[[int, int], None] | None] = ContextVar("ON_PART", default=None)
"""Called with how many bytes of a file of XML are read, and of how many."""
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
            with copy.open("w", encoding="utf-8") as file:
                file.writelines(text)
        _copies[key] = copy
    return _copies[key]


def temporary() -> Path:
    """Return a new folder that lasts as long as the process."""
    folder = tempfile.mkdtemp()
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return Path(folder)


def _rewritten(path: Path, files: ExitStack) -> Iterable[str] | None:
    """Return the text of a file as plain csv, in parts; None for a plain file."""
    name = path.name.lower()
    if name.endswith(".xlsx"):
        return _of_sheet(path)
    raw: Any = files.enter_context(path.open("rb"))
    if name.endswith(".zip"):
        archive = files.enter_context(zipfile.ZipFile(raw))
        members = [member for member in archive.namelist() if not member.endswith("/")]
        if len(members) != 1:
            raise DataError(f"{path.name} holds {len(members)} files; unpack it, and name one or its folder.")
        raw, name = files.enter_context(archive.open(members[0])), members[0].lower()
    file: Any = files.enter_context(gzip.GzipFile(fileobj=raw)) if name.endswith(".gz") else raw
    head = file.read(HEAD)
    if head.lstrip()[:1] == b"<" or ".xml" in name:
        return _of_sumo(path, head, file, raw)
    encoding = "utf-16" if head[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8"
    lines = head.decode(encoding, "replace").removeprefix("\ufeff").splitlines()
    first = lines[0] if lines else ""
    cells = re.split(r"[,;\t]|\s+", first.strip())
    numbers = len(cells) > 2 and all(re.fullmatch(r"[+-]?\d*\.?\d+(e[+-]?\d+)?", cell.strip(), re.I) for cell in cells)
    ends = [row[-1:] for row in lines[1:20]]
    trailing = bool(ends) and set(ends) < {",", ";"} and first.count(ends[0]) + 1 == lines[1].count(ends[0])
    odd = first.startswith(("#", "$", "*")) or first.lower().startswith("sep=") or name.endswith(".fzp")
    comma = max(",;\t", key=first.count)
    units = [cell.strip().strip("[]()") for cell in lines[1].split(comma)] if lines[1:] else []
    has_units = sum(map(bool, units)) > 1 and {*units} <= UNIT_NAMES
    odd |= encoding != "utf-8" or path.name.lower().endswith((".zip", ".txt.gz"))
    if not (odd or has_units or numbers or trailing):
        return None
    lines = (head + read_whole(file, path.name)).decode(encoding, "replace").removeprefix("\ufeff").splitlines()
    mark = lines.pop(0)[4:] if first.lower().startswith("sep=") else ""
    if name.endswith(".fzp"):
        return _of_vissim(lines)
    rows = [line for line in lines if line.strip() and not line.startswith(("#", "$", "*"))]
    if numbers and len(cells) not in ngsim.WITHOUT_HEADER:
        shown = ", ".join(cells[:4])
        raise DataError(f"{path.name}: the first line holds numbers, {shown} …: it has no header. Add a line of names.")
    if numbers:
        rows = [" ".join(ngsim.WITHOUT_HEADER[len(cells)]), *rows]
        rows = [",".join(re.split(r"[,;\t]|\s+", row.strip())) for row in rows]
    if has_units:
        pairs = zip(first.split(comma), units, strict=False)
        rows = [comma.join(n if n in TIDY or not unit else f"{n} [{unit}]" for n, unit in pairs), *rows[2:]]
    if trailing:
        rows = [first, *(row[:-1] for row in rows[1:])]
    return (f"{row.replace(mark, TAB) if mark not in ('', ',', ';') else row}\n" for row in rows)


def _of_vissim(lines: list[str]) -> Iterator[str]:
    """Yield Vissim's vehicle record as csv; units are those of the lines above its header, where these tell them."""
    begin = next((i for i, line in enumerate(lines) if line.startswith("$VEHICLE:") or "VehNr;" in line), -1)
    matches = (re.match(r"[* ]*(\S+?)\s*:.*\[(\S+)\]", line) for line in lines[:begin])
    units = {m[1]: TOLD_UNITS[m[2]] for m in matches if m and m[2] in TOLD_UNITS}
    for row in lines[begin:] if begin >= 0 else ():
        cells = [cell.strip() for cell in row.removeprefix("$VEHICLE:").rstrip("; ").split(";")]
        if row is lines[begin]:
            for i, n in enumerate(cells):
                cells[i] = VISSIM.get(n, n)
                cells[i] = f"{cells[i].rpartition('_')[0]}_{units[n]}" if n in units and n in VISSIM else cells[i]
        yield ";".join(cells) + NL if row.strip() else ""


def _of_sheet(path: Path) -> Iterable[str]:
    """Return the first sheet of a workbook as csv. DataError for a broken one, and without a library that reads it."""
    try:
        return [pl.read_excel(path).write_csv()]
    except Exception as error:  # of libraries of their own kinds
        cure = "save the sheet as csv" + (", or pip install fastexcel" if isinstance(error, ImportError) else "")
        raise DataError(f"{path.name} cannot be read as a workbook ({str(error).partition(NL)[0]}); {cure}.") from None


def _of_sumo(path: Path, head: bytes, file: Any, raw: Any) -> Iterator[str]:
    """Yield floating-car data of XML line by line, under the names of SUMO, with the lengths of vehicles' types.

    Attributes are those of the first vehicle. ``raw`` is the packed file, which says how much of it is read.
    """
    on_part, size = ON_PART.get(), path.stat().st_size
    lengths = _lengths(path, head.decode("utf-8", "replace"))
    names: list[str] = []
    time, root = "", ""
    parser: Any = ElementTree.XMLPullParser(("start", "end"))
    try:
        for part in chain([head], iter(lambda: file.read(HEAD), b"")):
            parser.feed(part)
            if on_part is not None:
                on_part(min(raw.tell(), size), size)
            for event, element in parser.read_events():
                root = root or element.tag
                if root != "fcd-export":
                    raise DataError(f"{path.name} is XML of <{root}>; of XML SUMO's --fcd-output is read. Export csv.")
                time = element.get("time", "") if element.tag == "timestep" else time
                if event == "end" and element.tag == "vehicle":
                    if not names:
                        names = [name for name in FCD if name in element.attrib]
                        yield TAB.join(["timestep_time", *(f"vehicle_{n}" for n in names), "vehicle_length"]) + "\n"
                    length = lengths.get(element.get("type", ""), "")
                    yield TAB.join([time, *(element.get(name, "") for name in names), length]) + "\n"
                if event == "end":
                    element.clear()
        parser.close()
    except ElementTree.ParseError as error:
        raise DataError(f"{path.name} is no whole XML ({error}); is it complete?") from None


def _lengths(path: Path, head: str) -> dict[str, str]:
    """Return the lengths (m) of vTypes by name, of the files that the head of SUMO's output names and that are there.

    These are its routes and additional files, looked for beside it.
    """
    lengths: dict[str, str] = {}
    for names in re.findall(r'<(?:route|additional)-files value="([^"]*)"', head):
        for file in (path.parent / name for name in names.split(",")):
            if file.is_file() and file.suffix == ".xml":
                with file.open(encoding="utf-8", errors="replace") as text:
                    tags = re.findall(r"<vType\s[^>]*>", text.read(TYPES_READ))
                for kind in (dict(re.findall(r'(\w+)="([^"]*)"', tag)) for tag in tags):
                    usual = str(SUMO_LENGTHS_M.get(kind.get("vClass", ""), 5.0))
                    lengths[kind.get("id", "")] = kind.get("length", usual)
    return {"DEFAULT_VEHTYPE": "5.0", **lengths} if lengths else {}


def is_sumo(columns: list[str]) -> bool:
    """Say whether the header is that of SUMO's floating-car data."""
    return {"timestep_time", "vehicle_pos", "vehicle_lane"} <= {*columns}


def sumo(table: pl.DataFrame, source: str) -> tuple[pl.DataFrame, list[Repair]]:
    """Return the tidy table of floating-car data: each edge is a run, whose lanes are numbered as in the file.

    A gap below 0 is SUMO's word for nobody ahead.
    """
    table = table.filter(pl.col("vehicle_id").is_not_null() & pl.col("vehicle_lane").is_not_null())
    parts = pl.col("vehicle_lane").cast(pl.String).str.extract_groups(r"^(?<run_id>.*)_(?<lane>\d+)$").struct.unnest()
    names = {f"vehicle_{old}": new for old, new in FCD.items() if old != "lane"} | {"timestep_time": "time_s"}
    names |= {"vehicle_length": "length_m"}
    columns = [pl.col(old).alias(new) for old, new in names.items() if old in table.columns and table[old].count()]
    rows = table.select(parts, *columns)
    if "gap_m" in rows.columns:
        rows = rows.with_columns(pl.when(pl.col("gap_m").cast(pl.Float64) >= 0.0).then("gap_m").alias("gap_m"))
    return rows, []
