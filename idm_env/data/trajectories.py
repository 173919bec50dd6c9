"""Measured vehicles as one tidy table that has been checked, repaired and counted."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import reduce

import numpy as np
import polars as pl

from idm_env.data import schema
from idm_env.data.errors import DataError, Repair, listed, refuse_missing
from idm_env.data.prepare import prepare

__all__ = ["Repair", "Trajectories"]


@dataclass(frozen=True)
class Trajectories:
    """Vehicles over time, one row each, sorted by run_id, vehicle_id, time_s; see `idm_env.data.schema`.

    Attributes:
        table: The tidy table in SI units, with gap_m wherever a leader is present at that time and ``gap_measured``.
        repairs: What was changed or left out on the way, each counted.
        source: Name for messages, such as the file's name.
        steps: Time step of each run in s.
        place: Column that says where on the road a vehicle is, for places such as hills.
        drivers: If given, only these (run_id, vehicle_id) are drivers to fit; all others are still neighbours.
        recordings: The run of the file, by run_id, of runs that were cut from it.
    """

    table: pl.DataFrame
    repairs: tuple[Repair, ...]
    source: str
    steps: dict[str, float]
    place: str = "position_m"
    drivers: frozenset[tuple[str, str]] | None = None
    recordings: dict[str, str] = field(default_factory=dict)

    @classmethod
    def from_frame(
        cls,
        frame: pl.DataFrame,
        *,
        source: str = "table",
        ring_length: float | None = None,
        place: str | None = None,
        repairs: Iterable[Repair] = (),
    ) -> Trajectories:
        """Return checked trajectories from a tidy table; `frame` itself is not changed.

        Args:
            frame: Columns vehicle_id, time_s, position_m at least; see `idm_env.data.schema.TIDY`.
            source: Name for messages.
            ring_length: Length of a closed road in m; also taken from a column ``ring_length_m``.
            place: Column with the coordinate of places; position_m if None.
            repairs: What a reader of the file has already repaired.

        Raises:
            DataError: For a table that cannot be used, in one line.
        """
        table, steps, done = prepare(frame, source, ring_length)
        place = place or "position_m"
        refuse_missing([place], table.columns, source)
        if not table[place].dtype.is_numeric():
            raise DataError(f"{source}: place column {place!r} holds text; a place is a number in metres.")
        return cls(table, (*repairs, *done), source, steps, place)

    def runs(self) -> list[str]:
        """Return the identifiers of the runs, in order."""
        return self.table["run_id"].unique(maintain_order=True).to_list()

    def where(self, condition: str | Sequence[str]) -> Trajectories:
        """Return the part for which ``"column=value"`` holds, or for which several such conditions all hold.

        A column that is constant in a run selects runs; one that is constant for a vehicle selects drivers, whose
        neighbours stay in the table.

        Raises:
            DataError: If the condition has another form, the column is missing or varies along a track, or none fits.
        """
        if not isinstance(condition, str):
            return reduce(Trajectories.where, condition, self)
        column, value = parted(condition)
        refuse_missing([column], self.table.columns, self.source)
        text = pl.col(column).cast(pl.String).str.to_lowercase().fill_null("")
        tracks = self.table.group_by(schema.TRACK, maintain_order=True).agg(
            pl.col(column).n_unique().alias("values"), text.first().alias("value")
        )
        if (tracks["values"] > 1).any():
            raise DataError(f"{self.source}: {column!r} changes along a track; a split needs one value per vehicle.")
        chosen = tracks.filter(pl.col("value") == value.lower())
        if chosen.height == 0:
            has = listed(tracks["value"].unique())
            raise DataError(f"{self.source}: no vehicle has {column} = {value!r}; it has {has}.")
        per_run = tracks.group_by("run_id").agg(pl.col("value").n_unique())["value"]
        if (per_run == 1).all():
            return self.of_runs(chosen["run_id"].unique().to_list())
        return self._of_drivers(chosen.select(schema.TRACK).rows())

    def split(self, held_out: str | float = 0.25, *, seed: int = 0) -> tuple[Trajectories, Trajectories]:
        """Return (trajectories to fit, trajectories held out).

        Args:
            held_out: ``"column=value"`` names the held-out part; a fraction in (0, 1) draws that share of the runs,
                or of the drivers where there are fewer than two runs.
            seed: Of the draw, which is the same on every machine.

        Raises:
            DataError: If one of the parts would be empty.
        """
        if isinstance(held_out, str) and "=" in held_out:
            test = self.where(held_out)
            return self._others(test), test
        try:
            fraction = float(held_out)
        except ValueError:
            raise DataError(f"held_out = {held_out!r} is neither column=value nor a fraction such as 0.25.") from None
        if not 0.0 < fraction < 1.0:
            raise DataError(f"held_out = {fraction:g} is outside (0, 1); give the share of runs to hold out.")
        runs = self.runs()
        items: list = runs if len(runs) > 1 else self.followers()
        if len(items) < 2:
            raise DataError(f"{self.source}: one driver only, and nothing can be held out; give more drivers or runs.")
        count = min(max(1, round(fraction * len(items))), len(items) - 1)
        order = np.random.default_rng(seed).permutation(len(items))
        test_items, fit_items = ([items[i] for i in sorted(part)] for part in (order[:count], order[count:]))
        make = self.of_runs if len(runs) > 1 else self._of_drivers
        return make(fit_items), make(test_items)

    def followers(self) -> list[tuple[str, str]]:
        """Return (run_id, vehicle_id) of every vehicle that has a leader at some time and is a driver to fit."""
        followers = self.table.filter(pl.col("leader_id").is_not_null())
        rows = followers.select(schema.TRACK).unique(maintain_order=True).rows()
        return [row for row in rows if self.drivers is None or row in self.drivers]

    def name_of(self, run: str, vehicle: str) -> str:
        """Return ``run/vehicle`` as the file has them."""
        return f"{self.recordings.get(run, run)}/{vehicle}"

    def summary(self) -> dict[str, object]:
        """Return counts for a report: rows, runs, vehicles, followers, seconds, steps and repairs."""
        seconds = sum(rows * self.steps[run] for run, rows in self.table.group_by("run_id").len().rows())
        return {
            "source": self.source,
            "rows": self.table.height,
            "runs": len(self.runs()),
            "vehicles": self.table.select(schema.TRACK).n_unique(),
            "followers": len(self.followers()),
            "vehicle_seconds": round(seconds, 1),
            "time_steps_s": sorted(set(self.steps.values())),
            "place": self.place,
            "repairs": [{"kind": r.kind, "count": r.count, "text": r.text} for r in self.repairs],
        }

    def of_runs(self, runs: list[str]) -> Trajectories:
        """Return the part that is of these runs."""
        table = self.table.filter(pl.col("run_id").is_in(runs))
        return replace(self, table=table, steps={run: self.steps[run] for run in runs})

    def _of_drivers(self, drivers: list[tuple[str, str]]) -> Trajectories:
        runs = {run for run, _ in drivers}
        return replace(self.of_runs([run for run in self.runs() if run in runs]), drivers=frozenset(drivers))

    def _others(self, other: Trajectories) -> Trajectories:
        if other.drivers is not None:
            rest: list = [driver for driver in self.followers() if driver not in other.drivers]
            make = self._of_drivers
        else:
            runs = set(other.runs())
            rest = [run for run in self.runs() if run not in runs]
            make = self.of_runs  # type: ignore[assignment]
        if not rest:
            raise DataError(f"{self.source}: everything would be held out and nothing is left to fit; hold out less.")
        return make(rest)


def parted(condition: str) -> tuple[str, str]:
    """Return column and value of ``column=value``. DataError for any other form."""
    column, equals, value = (part.strip() for part in condition.partition("="))
    if not equals or not column:
        raise DataError(f"{condition!r} is no condition; write it as column=value, such as split=test.")
    return column, value
