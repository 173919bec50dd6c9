"""A file of tracks on disk, sorted into buckets of vehicles, so that memory holds one chunk and never the file.

The file is read in pieces. Where leaders must be derived from lanes, its rows are first brought together by time; then
they are brought together by vehicle, in the order in which vehicles appear.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import polars as pl

from idm_env import keep
from idm_env.data import DataError, Repair, directions
from idm_env.data.clean import check_columns, identifiers, natural, numbers
from idm_env.data.load import batches
from idm_env.data.speeds import length_assumed
from idm_env.trajectories.tracks import Table, check_units, has_length, prepared, with_leaders

KEPT = ("run_id", "vehicle_id", "time_s", "position_m", "leader_id", "lane", "length_m", "ring_length_m")
MOST_BUCKETS = 64
BUCKET_ROWS = 400_000
"""Rows of a bucket of times."""
KEY = ["run_id", "vehicle_id"]


@dataclass
class Counted:
    """Repairs by kind and wording, added up over the pieces of a file."""

    found: dict[tuple[str, str], int]

    def add(self, repairs: Sequence[Repair]) -> None:
        """Count repairs; a number at the beginning of a text is added up."""
        for repair in repairs:
            text = repair.text.removeprefix(f"{repair.count} ")
            key = repair.kind, ("# " if text != repair.text else "") + text
            again = key in self.found and not text.startswith("#") and text == repair.text
            self.found[key] = repair.count if again else self.found.get(key, 0) + repair.count

    def repairs(self) -> tuple[Repair, ...]:
        """Return the repairs with their sums."""
        return tuple(
            Repair(kind, count, text.replace("# ", f"{count} ", 1)) for (kind, text), count in self.found.items()
        )


class Spool:
    """The vehicles of a file in the order of their appearance, and their rows in buckets under ``folder``.

    Attributes:
        source: Name of the file.
        vehicles: (run, vehicle) of every vehicle.
    """

    def __init__(self, path: str | Path, folder: Path, layout: str, chunk: int) -> None:
        self.source = Path(path).name
        self.folder, self.chunk = folder, chunk
        self._counted = Counted({})
        if folder.exists():
            shutil.rmtree(folder)
        folder.mkdir(parents=True)
        raw, index = self._read(path, layout)
        self.vehicles: list[tuple[str, str]] = index.select(KEY).rows()
        self._per_bucket = max(1, -(-self.chunks // MOST_BUCKETS))
        self._distribute(self._led(raw, index), index)

    @property
    def chunks(self) -> int:
        """Number of chunks of vehicles."""
        return -(-len(self.vehicles) // self.chunk)

    @property
    def repairs(self) -> tuple[Repair, ...]:
        """What was repaired so far; repeats of a time are counted as chunks are read."""
        return self._counted.repairs()

    def table(self, number: int, *, counting: bool = True) -> Table:
        """Return the table of one chunk."""
        first = number * self.chunk
        return self._table(range(first, min(first + self.chunk, len(self.vehicles))), counting)

    def picked(self, indices: Sequence[int]) -> Iterator[Table]:
        """Yield the tables of single vehicles."""
        for index in indices:
            yield self._table(range(index, index + 1), False)

    def _table(self, vehicles: range, counting: bool) -> Table:
        bucket = vehicles.start // self.chunk // self._per_bucket
        files = sorted(self.folder.glob(f"vehicles-{bucket:03d}-*.parquet"))
        inside = pl.col("number").is_between(vehicles.start, vehicles.stop - 1)
        frame = pl.scan_parquet(files, missing_columns="insert").filter(inside).collect()
        frame, repairs = prepared(frame.sort("number", maintain_order=True).drop("number"))
        if counting:
            self._counted.add(repairs)
        return Table(frame, (), self.source)

    def _read(self, path: str | Path, layout: str) -> tuple[list[Path], pl.DataFrame]:
        """Write the pieces of a file and return them, with an index of its vehicles in their order."""
        files: list[Path] = []
        index: pl.DataFrame | None = None
        lost = 0
        for piece, repairs in batches(path, layout=layout):
            self._counted.add(repairs)
            check_columns(piece, self.source)
            piece, repairs = numbers(identifiers(piece, self.source), self.source)
            self._counted.add(repairs)
            whole = piece.filter(pl.all_horizontal(pl.col(*KEY, "time_s").is_not_null()))
            self._counted.add(_lost("no time", piece.height - whole.height, "rows without a vehicle or a time"))
            kept = whole.filter(pl.col("position_m").is_not_null())
            self._counted.add(_lost("no position", whole.height - kept.height, "rows without a position"))
            lost += piece.height - kept.height
            if kept.height == 0:
                continue
            if not files:
                check_units(kept, self.source)
            files.append(self.folder / f"raw-{len(files):05d}.parquet")
            kept = kept.select(pl.col(name) for name in KEPT if name in kept.columns)
            # derived leaders wait for _led: the vehicle ahead may be in another piece
            waits = "leader_id" not in kept.columns and "lane" in kept.columns
            keep.write(files[-1], (kept if waits else with_leaders(kept)).write_parquet)
            index = _indexed(index, kept)
        if index is None:
            raise DataError(
                f"{self.source}: none of {lost} rows has a vehicle_id, a time_s and a position_m; fill those columns "
                "(position_m in metres)."
            )
        backward = int(index["backward"].sum())
        if backward:
            text = f"{backward} rows are earlier than the row before them of their vehicle; rows were sorted by time."
            self._counted.add([Repair("time not increasing", backward, text)])
        self._counted.add(length_assumed(int(index["known"].not_().sum())))
        index = self._one_way(files, index)
        order = (natural("run_id"), "run_id", "begin", natural("vehicle_id"), "vehicle_id")
        return files, index.sort(*order).with_row_index("number")

    def _one_way(self, files: list[Path], index: pl.DataFrame) -> pl.DataFrame:
        """Mirror vehicles that drive against the others, in the pieces; return the index with their new runs."""
        vehicles = directions.against(index.filter(~pl.col("ring")))
        for path in files if vehicles.height else []:
            keep.write(path, directions.mirrored(pl.read_parquet(path), vehicles).write_parquet)
        self._counted.add(directions.repairs(vehicles))
        return directions.renamed(index, vehicles)

    def _led(self, raw: list[Path], index: pl.DataFrame) -> list[Path]:
        """Return files whose rows have leaders: the pieces themselves, or what is derived from lanes time by time."""
        columns = pl.scan_parquet(raw, missing_columns="insert").collect_schema().names()
        if "leader_id" in columns:
            return raw
        count = max(1, -(-int(index["rows"].sum()) // BUCKET_ROWS))
        bucket = pl.struct("run_id", "time_s").hash(seed=0) % count
        parts = self._partition(raw, pl.lit(0) if count == 1 else bucket, "times")
        led = []
        for number in range(count):
            files = sorted(parts.glob(f"times-{number:03d}-*.parquet"))
            if not files:
                continue
            frame, repairs = prepared(pl.read_parquet(files, missing_columns="insert"))
            self._counted.add(repairs)
            led.append(self.folder / f"led-{number:05d}.parquet")
            keep.write(led[-1], with_leaders(frame).write_parquet)
            _remove(files)
        return led

    def _distribute(self, files: list[Path], index: pl.DataFrame) -> None:
        """Bring the rows together by buckets of vehicles."""
        self._partition(files, pl.col("number") // (self.chunk * self._per_bucket), "vehicles", index)

    def _partition(
        self, files: list[Path], bucket: pl.Expr, name: str, index: pl.DataFrame | None = None
    ) -> Path:  # fmt: skip
        """Write the rows of every file to one file per bucket, and remove it."""
        for n, path in enumerate(files):
            frame = pl.read_parquet(path)
            if index is not None:
                frame = frame.join(index.select(*KEY, "number"), on=KEY, how="left", maintain_order="left")
            frame = frame.with_columns(bucket.cast(pl.Int64).alias("bucket"))
            for (key,), part in frame.partition_by("bucket", as_dict=True, include_key=False).items():
                keep.write(self.folder / f"{name}-{key:03d}-{n:05d}.parquet", part.write_parquet)
            path.unlink()
        return self.folder


def _indexed(index: pl.DataFrame | None, piece: pl.DataFrame) -> pl.DataFrame:
    """Return what is known per vehicle, one piece further.

    Its first and last time with the positions there, lane, rows, whether a length is known, whether it is on a ring,
    and how often its time runs backward.
    """
    time = pl.col("time_s")
    ring = pl.col("ring_length_m").is_not_null().any() if "ring_length_m" in piece.columns else pl.lit(False)
    new = piece.group_by(KEY, maintain_order=True).agg(
        *directions.END, directions.lane_of(piece), pl.len().cast(pl.Int64).alias("rows"), time.first().alias("first"),
        time.last().alias("last"), (time.diff() < 0).sum().cast(pl.Int64).alias("backward"), has_length(piece),
        ring.alias("ring"),
    )  # fmt: skip
    if index is None:
        return new
    both = pl.concat([index, new])
    return both.group_by(KEY, maintain_order=True).agg(
        pl.col("from").sort_by("begin").first(), pl.col("to").sort_by("end").last(), pl.col("begin").min(),
        pl.col("end").max(), pl.col("lane").first(), pl.col("rows").sum(), pl.col("first").first(),
        pl.col("last").last(),
        pl.col("backward").sum() + (pl.col("first").shift(-1) < pl.col("last")).sum().cast(pl.Int64),
        pl.col("known").any(), pl.col("ring").any(),
    ).select(index.columns)  # fmt: skip


def _lost(kind: str, count: int, what: str) -> list[Repair]:
    return [Repair(kind, count, f"{count} {what} were left out.")] if count else []


def _remove(files: Sequence[Path]) -> None:
    for path in files:
        path.unlink()
