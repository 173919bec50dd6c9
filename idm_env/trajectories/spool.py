"""A file of tracks on disk, sorted into chunks of vehicles, so that memory holds one chunk and never the file.

The file is read in pieces, by the rules of ``data.load``. Its rows are brought together by vehicle, in the order in
which vehicles appear; then by time, on the clock of each run, to find who is ahead.
"""

import shutil
from bisect import bisect_right
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import polars as pl

from idm_env.data import Repair, clean, clock, directions, leaders, plausible, prepare, units
from idm_env.data.errors import Counted, repaired
from idm_env.data.load import batches
from idm_env.data.names import Columns
from idm_env.data.schema import TRACK, of_run
from idm_env.jobs import storage

KEPT = ("run_id", "vehicle_id", "time_s", "position_m", "leader_id", "lane", "length_m", "ring_length_m", "gap_m")
MOST_BUCKETS = 64
BUCKET_ROWS = 400_000
"""Rows of a bucket of times."""
LONGEST_STEP_S = 60.0
"""Sparse tracks have a sample at least so often (s); above, times are in another unit."""


class Reading(NamedTuple):
    """How a file is read: see ``data.load``."""

    layout: str = "auto"
    columns: Columns = None
    ring_length: float | None = None


@dataclass(frozen=True)
class Shelf:
    """Chunks of vehicles on disk, each read by one worker.

    Attributes:
        folder: Where they are.
        borders: First vehicle of every chunk, and the number of vehicles.
    """

    folder: Path
    borders: tuple[int, ...]

    def path(self, number: int) -> Path:
        """Return the file of one chunk."""
        return self.folder / f"chunk-{number:05d}.parquet"

    def table(self, number: int) -> pl.DataFrame:
        """Return the table of one chunk."""
        return pl.read_parquet(self.path(number), glob=False).drop("number")

    def vehicle(self, index: int) -> pl.DataFrame:
        """Return the table of one vehicle."""
        path = self.path(bisect_right(self.borders, index) - 1)
        one = pl.scan_parquet(path, glob=False).filter(pl.col("number") == index)
        return one.drop("number").collect()


class Spool:
    """The vehicles of a file in the order of their appearance, and their rows in chunks under ``folder``.

    Chunks are ``chunk`` vehicles at most and end where a run does, unless it has more than that. DataError for what
    ``data.load`` refuses; but nobody need follow anybody, and samples may be sparse.

    Attributes:
        source: Name of the file.
        vehicles: (run, vehicle) of every vehicle.
        shelf: The chunks.
        repairs: What was repaired.
    """

    def __init__(self, path: str | Path, folder: Path, chunk: int, how: Reading = Reading()) -> None:  # noqa: B008
        self.source = Path(path).name
        self.folder = folder
        self._counted = Counted()
        if folder.exists():
            shutil.rmtree(folder)
        folder.mkdir(parents=True)
        files, index = self._read(path, how)
        self.vehicles: list[tuple[str, str]] = index.select(TRACK).rows()
        self.shelf = Shelf(folder, _borders([run for run, _ in self.vehicles], chunk))
        chunks = pl.Series(self.shelf.borders[1:-1], dtype=pl.UInt32)
        index = index.with_columns(pl.lit(chunks).search_sorted(pl.col("number"), "right").alias("chunk"))
        steps = self._shelve(files, index)
        self._lead(steps, index)
        self.repairs: tuple[Repair, ...] = self._counted.repairs()

    @property
    def chunks(self) -> int:
        """Number of chunks of vehicles."""
        return len(self.shelf.borders) - 1

    def strands(self) -> list[tuple[int, ...]]:
        """Return the chunks that have to be done one after the other, because a run goes on from one to the next."""
        strands: list[list[int]] = []
        for number, begin in enumerate(self.shelf.borders[:-1]):
            goes_on = begin and self.vehicles[begin][0] == self.vehicles[begin - 1][0]
            strands[-1].append(number) if goes_on else strands.append([number])
        return [tuple(strand) for strand in strands]

    def picked(self, indices: Sequence[int]) -> Iterator[pl.DataFrame]:
        """Yield the tables of single vehicles."""
        yield from map(self.shelf.vehicle, indices)

    def _read(self, path: str | Path, how: Reading) -> tuple[list[Path], pl.DataFrame]:
        """Write the pieces of a file and return them, with an index of its vehicles in their order."""
        files: list[Path] = []
        parts: list[pl.DataFrame] = []
        filled = clean.Filled()
        sample: list[pl.DataFrame] = []
        for piece, repairs in batches(path, layout=how.layout, columns=how.columns):
            self._counted.add(repairs)
            usable, repairs = prepare.rows(piece, self.source, how.ring_length, filled)
            self._counted.add(repairs)
            rows = usable.filter(pl.col("position_m").is_not_null())
            lost = usable.height - rows.height
            self._counted.add(repaired("no position", lost, "rows without a position were left out."))
            if rows.height == 0:
                continue
            sample += [rows] if sum(some.height for some in sample) < BUCKET_ROWS else []
            files.append(self.folder / f"raw-{len(files):05d}.parquet")
            rows = rows.select(pl.col(name) for name in KEPT if name in rows.columns)
            storage.write(files[-1], rows.write_parquet)
            parts.append(_indexed(rows))
        filled.check(self.source)
        index = _merged(parts)
        vehicles = directions.against(index.filter(~pl.col("ring")), self.source)
        for file in files if vehicles.height else []:
            storage.write(file, directions.mirrored(pl.read_parquet(file, glob=False), vehicles).write_parquet)
        self._counted.add(directions.repairs(vehicles))
        self._sample = directions.mirrored(pl.concat(sample, how="diagonal_relaxed"), vehicles)
        index = directions.renamed(index, vehicles)
        order = (clean.natural("run_id"), "run_id", "begin", clean.natural("vehicle_id"), "vehicle_id")
        return files, index.sort(*order).with_row_index("number")

    def _shelve(self, files: list[Path], index: pl.DataFrame) -> dict[str, float]:
        """Write the chunks, by the rules for whole vehicles, and return the time step of each run (s)."""
        per_bucket = max(1, -(-self.chunks // MOST_BUCKETS))
        number = index.select(*TRACK, "number", "chunk")
        buckets = self._partition(files, "vehicles", pl.col("chunk") // per_bucket, number)
        paces, twice, unsorted = [], [], int(index["backward"].sum())
        self._jumps = plausible.Jumps()
        for chunk in range(self.chunks):
            parts = buckets.get(chunk // per_bucket, [])
            rows = pl.scan_parquet(parts, glob=False, missing_columns="insert", extra_columns="ignore")
            frame, repairs, moved = clean.ordered(rows.filter(pl.col("chunk") == chunk).collect())
            self._counted.add([repair for repair in repairs if repair.kind != "time not increasing"])
            frame, repairs = prepare.measured(frame, self._jumps)
            frame, lost = clean.without_position(frame)
            repairs += lost
            self._counted.add(repairs)
            paces.append(clock.paces(frame))
            twice.append(moved)
            storage.write(self.shelf.path(chunk), frame.drop("chunk").write_parquet)
        if unsorted:
            text = f"Time runs backward at {unsorted} rows; the rows were sorted by time."
            self._counted.add([Repair("time not increasing", unsorted, text)])
        clean.check_recordings(pl.concat(twice), int(index["rows"].sum()), self.source)
        units.check(clean.ordered(self._sample)[0], self.source, longest_step=LONGEST_STEP_S)
        del self._sample
        self._jumps.check(self.source)
        _remove(part for parts in buckets.values() for part in parts)
        return clock.steps_of(pl.concat(paces), index["run_id"].unique(), self.source)

    def _lead(self, steps: dict[str, float], index: pl.DataFrame) -> None:
        """Give every row its leader: as the file names it, or derived time by time once short holes are filled."""
        starts = dict(index.group_by("run_id").agg(pl.col("begin").min()).rows())
        laned = dict(index.group_by("run_id").agg(pl.col("lane").is_not_null().any()).rows())
        named: list[pl.DataFrame] = []
        files = []
        vehicles, overlaps = self._jumps.vehicles(index), plausible.Overlaps()
        for chunk in range(self.chunks):
            frame = pl.read_parquet(self.shelf.path(chunk), glob=False)
            if "leader_id" in frame.columns:
                frame, counts = leaders.named_leaders(self._jumps.with_leaders(frame), vehicles)
                named.append(counts)
            ticks, _ = clock.regularise(frame, steps, starts, clock.UNSEEN_S)
            files.append(self.folder / f"ticks-{chunk:05d}.parquet")
            storage.write(files[-1], ticks.with_columns(pl.lit(chunk).alias("chunk")).write_parquet)
        if named:
            counts = pl.concat(named).group_by("leader_id", "state").agg(pl.col("len").sum())
            self._counted.add(leaders.named(counts, self.source))
        count = max(1, -(-int(index["rows"].sum()) // BUCKET_ROWS))
        times = self._partition(files, "times", pl.struct("run_id", "step").hash(seed=0) % count)
        files = []
        for bucket, parts in sorted(times.items()):
            frame = pl.read_parquet(parts, glob=False, missing_columns="insert")
            if not named:
                lane = pl.col("run_id").replace_strict(laned, return_dtype=pl.Boolean)
                frame = frame if "lane" in frame.columns else frame.with_columns(pl.lit(None, pl.Int64).alias("lane"))
                frame = leaders.derive(frame.with_columns(leaders.in_lane(lane)))
            headways = leaders.headways(frame, self.source)  # refuses what is the wrong way round
            overlaps.add(leaders.gap_of(headways))
            files.append(self.folder / f"led-{bucket:05d}.parquet")
            storage.write(files[-1], frame.select(*TRACK, "chunk", "step", "leader_id").write_parquet)
            _remove(parts)
        self._counted.add(overlaps.check(self.source, vehicles.height))
        by_chunk = self._partition(files, "led", pl.col("chunk"))
        followers = 0
        for chunk, parts in by_chunk.items():
            ticks = pl.read_parquet(parts, glob=False).sort(*clean.NAMES, "step")
            ticks, repairs = leaders.steady(ticks)
            self._counted.add(repairs)
            followers += ticks.filter(pl.col("leader_id").is_not_null()).select(TRACK).n_unique()
            frame = pl.read_parquet(self.shelf.path(chunk), glob=False).drop("leader_id", "gap_m", strict=False)
            storage.write(self.shelf.path(chunk), _joined(frame, ticks, steps, starts).write_parquet)
            _remove(parts)
        if not named and followers:
            self._counted.add([leaders.derived(followers, any(laned.values()))])

    def _partition(
        self, files: Sequence[Path], name: str, bucket: pl.Expr, index: pl.DataFrame | None = None
    ) -> dict[int, list[Path]]:
        """Bring the rows of files together, a file per bucket and file, and remove them; return the new ones."""
        by_bucket: dict[int, list[Path]] = {}
        for n, path in enumerate(files):
            frame = pl.read_parquet(path, glob=False)
            if index is not None:
                frame = frame.join(index, on=TRACK, how="left", maintain_order="left")
            frame = frame.with_columns(bucket.cast(pl.Int64).alias("bucket"))
            for (key,), part in frame.partition_by("bucket", as_dict=True, include_key=False).items():
                target = self.folder / f"{name}-{key:05d}-{n:05d}.parquet"
                storage.write(target, part.write_parquet)
                by_bucket.setdefault(key, []).append(target)
            path.unlink()
        return by_bucket


def read_table(path: str | Path) -> tuple[pl.DataFrame, tuple[Repair, ...]]:
    """Return a whole file as one table, and its repairs, by the rules of ``Spool``, whose DataErrors it raises."""
    with TemporaryDirectory() as folder:
        spool = Spool(path, Path(folder) / "spool", 200)
        return pl.concat([spool.shelf.table(n) for n in range(spool.chunks)]), spool.repairs


def _joined(
    frame: pl.DataFrame, ticks: pl.DataFrame, steps: dict[str, float], starts: dict[str, float]
) -> pl.DataFrame:
    """Return the rows of a chunk with the leaders at the nearest tick of the clock, "" for none."""
    tick = ((pl.col("time_s") - of_run(starts)) / of_run(steps)).alias("tick")
    frame = frame.with_row_index("row").with_columns(tick).sort("tick")
    ticks = ticks.select(*TRACK, pl.col("leader_id").fill_null(""), pl.col("step").cast(pl.Float64).alias("tick"))
    joined = frame.join_asof(
        ticks.sort("tick"), on="tick", by=TRACK, strategy="nearest", tolerance=1.0, check_sortedness=False
    )
    return joined.sort("row").drop("row", "tick").with_columns(pl.col("leader_id").fill_null(""))


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


def _indexed(piece: pl.DataFrame) -> pl.DataFrame:
    """Return the facts of each vehicle of a piece.

    Its first and last time with the positions there, lane, rows, whether it is on a ring, and how often its time runs
    backward.
    """
    time = pl.col("time_s")
    ring = pl.col("ring_length_m").is_not_null().any() if "ring_length_m" in piece.columns else pl.lit(False)
    facts = {"rows": pl.len().cast(pl.Int64), "first": time.first(), "last": time.last()}
    facts |= {"backward": (time.diff() < 0).sum().cast(pl.Int64), "ring": ring}
    return piece.group_by(TRACK, maintain_order=True).agg(*directions.END, directions.lane_of(piece), **facts)


def _merged(parts: Sequence[pl.DataFrame]) -> pl.DataFrame:
    """Return the facts of each vehicle of the file."""
    c = pl.col
    back = c("backward").sum() + (c("first").shift(-1) < c("last")).sum().cast(pl.Int64)
    ends = c("begin").min(), c("end").max(), c("from").sort_by("begin").first(), c("to").sort_by("end").last()
    others = c("rises").sum(), c("lane").drop_nulls().first(), c("rows").sum(), back, c("ring").any()
    return pl.concat(parts).group_by(TRACK, maintain_order=True).agg(*ends, *others)


def _remove(files: Iterable[Path]) -> None:
    for path in files:
        path.unlink()
