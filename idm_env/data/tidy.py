"""Reader of tables that are tidy already: csv, csv.gz or parquet with the columns of `idm_env.data.schema`."""

import polars as pl

from idm_env.data.errors import DataError, Repair, listed
from idm_env.data.names import SHORT, UNITS, guessed

_OTHER = {name: {u: x for u, x in units.items() if x != 1.0 and u.isalpha()} for name, units in UNITS.items()}
NAMED: dict[str, tuple[tuple[str, float], ...]] = {
    name: tuple((f"{stem}_{u}", x) for u, x in _OTHER[name].items()) for stem, name in SHORT.items() if name in UNITS
}
"""Columns that name another unit, such as ``position_ft``, and what they are multiplied by."""
_OTHER_UNITS = {other for others in NAMED.values() for other, _ in others}


def matches(columns: list[str]) -> bool:
    """Say whether the header is that of a tidy table; also true for one with a column missing, to name it."""
    return bool(({"time_s", "position_m", "speed_mps", "run_id"} | _OTHER_UNITS) & set(columns))


def check(columns: list[str], source: str) -> None:
    """Raise DataError if the header is that of no tidy table."""
    if matches(columns):
        return
    if source.lower().endswith("meta.csv"):
        raise DataError(f"{source} describes recordings or tracks, and has none. Name the file of tracks beside it.")
    raise DataError(
        f"{source}: no known layout has the columns {listed(columns, 8)}; a tidy table needs vehicle_id, time_s and "
        f"position_m. Name them: {guessed(columns)}"
    )


def converted(columns: list[str]) -> list[str]:
    """Return the names that a table has after ``read``."""
    names = {other: name for name, others in NAMED.items() for other, _ in others if name not in columns}
    return [names.get(name, name) for name in columns]


def read(frame: pl.DataFrame) -> tuple[pl.DataFrame, list[Repair]]:
    """Return the frame with columns that name another unit (``position_ft``, ``speed_kmh``, …) converted to SI."""
    repairs = []
    for name, others in NAMED.items():
        for other, factor in others:
            if name not in frame.columns and other in frame.columns:
                values = pl.col(other).cast(pl.Float64, strict=False) * factor
                frame = frame.with_columns(values.alias(name)).drop(other)
                repairs.append(Repair("unit converted", 1, f"{other} was converted to {name} (× {factor:.6g})."))
    return frame, repairs
