"""The columns of a table that no model knows: numbers on the episode's clock, and labels that groups can be made by.

Shapes: a column of one vehicle is ``[samples]``.
"""

import numpy as np
import polars as pl

from idm_env.data.schema import TIDY, of_run
from idm_env.data.trajectories import Trajectories

_KNOWN = {*TIDY, "gap_measured", "step"}


def with_step(trajectories: Trajectories) -> pl.DataFrame:
    """Return the table with the integer column ``step``: equal for all vehicles of a run at the same time."""
    since = pl.col("time_s") - pl.col("time_s").min().over("run_id")
    return trajectories.table.with_columns((since / of_run(trajectories.steps)).round().cast(pl.Int64).alias("step"))


def extra(table: pl.DataFrame) -> tuple[dict[str, np.ndarray], list[str]]:
    """Return the further numeric columns as arrays (NaN where empty), and the names of those that can be labels."""
    others = [name for name in table.columns if name not in _KNOWN]
    numbers = {name: table[name].cast(pl.Float64).to_numpy() for name in others if table[name].dtype.is_numeric()}
    return numbers, [*(name for name in others if not table[name].dtype.is_float()), "lane"]


def of_span(numbers: dict[str, np.ndarray], span: slice) -> dict[str, np.ndarray]:
    """Return the numeric columns of an episode; empty cells take the nearest values, an empty column is absent."""
    parts = {name: filled(values[span]) for name, values in numbers.items()}
    return {name: part for name, part in parts.items() if part is not None}


def filled(values: np.ndarray) -> np.ndarray | None:
    """Return a copy in which NaN takes the nearest finite value, or None if there is none."""
    good = np.flatnonzero(np.isfinite(values))
    if len(good) == 0:
        return None
    return values[good[nearest_of(good, np.arange(len(values)))]]


def nearest_of(times: np.ndarray, ticks: np.ndarray) -> np.ndarray:
    """Return the index in rising ``times`` [samples] of the one nearest to every tick [ticks], the earlier of two."""
    after = np.clip(np.searchsorted(times, ticks), min(1, len(times) - 1), len(times) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(ticks - times[before] <= times[after] - ticks, before, after)


def labels(table: pl.DataFrame, names: list[str], begin: int, end: int) -> dict[str, str]:
    """Return, as text, the columns that hold one value, and no empty cell, from row `begin` to `end`."""
    part = table.select(names).slice(begin, end - begin)
    constant = [name for name in names if part[name][0] is not None and part[name].n_unique() == 1]
    return {name: str(part[name][0]) for name in constant}
