"""A file of tracks on disk, sorted into buckets of vehicles, so that memory holds one chunk and never the file.

The file is read in pieces. Where leaders must be derived from lanes, its rows are first brought together by time; then
they are brought together by vehicle, in the order in which vehicles appear.
"""

from __future__ import annotations

import shutil
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import polars as pl

from idm_env import keep
from idm_env.data import DataError, Repair, directions
from idm_env.data.clean import check_columns, identifiers, natural, numbers
from idm_env.data.errors import Counted
from idm_env.data.load import batches
from idm_env.data.speeds import length_assumed
from idm_env.trajectories.tracks import Table, check_units, has_length, prepared, with_leaders

KEPT = ("run_id", "vehicle_id", "time_s", "position_m", "leader_id", "lane", "length_m", "ring_length_m")
MOST_BUCKETS = 64
BUCKET_ROWS = 400_000
"""Rows of a bucket of times."""
KEY = ["run_id", "vehicle_id"]


@dataclass(frozen=True)
class Shelf:
    """Chunks of vehicles on disk, to be read by whoever works on them: their borders, and who is of the chunk's run.

    Attributes:
        source: Name of the file.
        folder: Where the buckets are.
        borders: First vehicle of every chunk, and the number of vehicles.
        per_bucket: Chunks in a bucket.
    """

    source: str
    folder: Path
    borders: tuple[int, ...]
    per_bucket: int

    def table(self, number: int) -> Table:
        """Return the table of one chunk, with what was repaired."""
        return self.part(number, range(self.borders[number], self.borders[number + 1]))

    def part(self, number: int, vehicles: range) -> Table:
        """Return the table of some vehicles of a chunk."""
        files = sorted(self.folder.glob(f"vehicles-{number // self.per_bucket:03d}-*.parquet"))
        inside = pl.col("number").is_between(vehicles.start, vehicles.stop - 1)
        frame = pl.scan_parquet(files, glob=False, missing_columns="insert").filter(inside).collect()
        frame, repairs = prepared(frame.sort("number", maintain_order=True).drop("number"))
        return Table(frame, tuple(repairs), self.source)


class Spool:
    """The vehicles of a file in the order of their appearance, and their rows in buckets under ``folder``.

    Chunks are ``chunk`` vehicles at most and end where a run does, unless it has more than that.

    Attributes:
        source: Name of the file.
        vehicles: (run, vehicle) of every vehicle.
        shelf: The chunks.
    """

    def __init__(self, path: str | Path, folder: Path, layout: str, chunk: int) -> None:
        self.source = Path(path).name
        self.folder = folder
        self._counted = Counted()
        if folder.exists():
            shutil.rmtree(folder)
        folder.mkdir(parents=True)
        raw, index = self._read(path, layout)
        self.vehicles: list[tuple[str, str]] = index.select(KEY).rows()
        borders = _borders([run for run, _ in self.vehicles], chunk)
        self.shelf = Shelf(self.source, folder, borders, max(1, -(-(len(borders) - 1) // MOST_BUCKETS)))
        self._distribute(self._led(raw, index), index)

    @property
    def chunks(self) -> int:
        """Number of chunks of vehicles."""
        return len(self.shelf.borders) - 1

    @property
    def repairs(self) -> tuple[Repair, ...]:
        """What was repaired when the file was spooled, and what was counted since."""
        return self._counted.repairs()

    def count(self, repairs: Sequence[Repair]) -> None:
        """Count what was repaired in a chunk."""
        self._counted.add(repairs)

    def strands(self) -> list[tuple[int, ...]]:
        """Return the chunks that have to be done one after the other, because a run goes on from one to the next."""
        found: list[list[int]] = []
        for number, begin in enumerate(self.shelf.borders[:-1]):
            goes_on = begin and self.vehicles[begin][0] == self.vehicles[begin - 1][0]
            found[-1].append(number) if goes_on else found.append([number])
        return [tuple(strand) for strand in found]

    def picked(self, indices: Sequence[int]) -> Iterator[Table]:
        """Yield the tables of single vehicles."""
        for index in indices:
            number = bisect_right(self.shelf.borders, index) - 1
            yield self.shelf.part(number, range(index, index + 1))

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
            keep.write(path, directions.mirrored(pl.read_parquet(path, glob=False), vehicles).write_parquet)
        self._counted.add(directions.repairs(vehicles))
        return directions.renamed(index, vehicles)

    def _led(self, raw: list[Path], index: pl.DataFrame) -> list[Path]:
        """Return files whose rows have leaders: the pieces themselves, or what is derived from lanes time by time."""
        columns = pl.scan_parquet(raw, glob=False, missing_columns="insert").collect_schema().names()
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
            frame, repairs = prepared(pl.read_parquet(files, glob=False, missing_columns="insert"))
            self._counted.add(repairs)
            led.append(self.folder / f"led-{number:05d}.parquet")
            keep.write(led[-1], with_leaders(frame).write_parquet)
            _remove(files)
        return led

    def _distribute(self, files: list[Path], index: pl.DataFrame) -> None:
        """Bring the rows together by buckets of vehicles."""
        firsts = self.shelf.borders[: -1 : self.shelf.per_bucket]
        self._partition(
            files, pl.lit(pl.Series(firsts)).search_sorted(pl.col("number"), "right") - 1, "vehicles", index
        )

    def _partition(
        self, files: list[Path], bucket: pl.Expr, name: str, index: pl.DataFrame | None = None
    ) -> Path:  # fmt: skip
        """Write the rows of every file to one file per bucket, and remove it."""
        for n, path in enumerate(files):
            frame = pl.read_parquet(path, glob=False)
            if index is not None:
                frame = frame.join(index.select(*KEY, "number"), on=KEY, how="left", maintain_order="left")
            frame = frame.with_columns(bucket.cast(pl.Int64).alias("bucket"))
            for (key,), part in frame.partition_by("bucket", as_dict=True, include_key=False).items():
                keep.write(self.folder / f"{name}-{key:03d}-{n:05d}.parquet", part.write_parquet)
            path.unlink()
        return self.folder


def _borders(runs: Sequence[str], chunk: int) -> tuple[int, ...]:
    """Return where chunks of at most ``chunk`` vehicles begin, and the end; runs that fit are not divided."""
    borders, begin = [0], 0
    for index in range(1, len(runs) + 1):
        if index < len(runs) and runs[index] == runs[begin]:
            continue
        if index - borders[-1] > chunk and begin > borders[-1]:
            borders.append(begin)
        while index - borders[-1] > chunk:
            borders.append(borders[-1] + chunk)
        begin = index
    return (*borders, len(runs))


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
