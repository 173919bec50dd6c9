"""Small tables of vehicles for the tests: consistent positions, speeds and leaders, easily spoilt."""

from __future__ import annotations

import numpy as np
import polars as pl


def platoon(vehicles: int = 3, seconds: float = 10.0, dt: float = 0.1, speed: float = 12.0) -> pl.DataFrame:
    """Vehicles 1, 2, … in one lane, 20 m apart, that speed up and slow down together."""
    time = np.arange(round(seconds / dt)) * dt
    parts = []
    for vehicle in range(1, vehicles + 1):
        position = 500.0 - 20.0 * vehicle + speed * time + 2.0 * np.sin(0.5 * time)
        parts.append(
            pl.DataFrame(
                {
                    "run_id": "a",
                    "vehicle_id": vehicle,
                    "leader_id": [vehicle - 1 if vehicle > 1 else None] * len(time),
                    "lane": 1,
                    "time_s": np.round(time, 9),
                    "position_m": position,
                    "speed_mps": speed + np.cos(0.5 * time),
                    "length_m": 4.0,
                },
                schema_overrides={"leader_id": pl.Int64},
            )
        )
    return pl.concat(parts)


def with_value(table: pl.DataFrame, column: str, rows: list[int], value: object) -> pl.DataFrame:
    """The table with `value` in some rows of one column."""
    numbers = pl.int_range(pl.len())
    return table.with_columns(
        pl.when(numbers.is_in(rows)).then(pl.lit(value, table[column].dtype)).otherwise(pl.col(column)).alias(column)
    )


def kinds(repairs: tuple) -> dict[str, int]:
    """Counts by kind of repair."""
    found: dict[str, int] = {}
    for repair in repairs:
        found[repair.kind] = found.get(repair.kind, 0) + repair.count
    return found
