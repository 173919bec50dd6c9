"""Peak memory of filtering one file of more and more trajectories, each file in a process of its own.

    python -m benchmarks.trajectories_memory [--tracks 500 2000 8000] [--seconds 40]

The tracks enter one after another on four lanes, without leaders in the file, so that these are derived. What is
printed is the largest resident set of the process (``ru_maxrss``), which holds the libraries, some 500 MB, as well.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import polars as pl
from pyarrow import csv, parquet

MEASURED = """
import resource, sys
from idm_env.trajectories.files import filter_file
report = filter_file(sys.argv[1], sys.argv[2], baselines=False)
print(report["tracks"], resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
"""


def write(path: Path, tracks: int, seconds: float) -> None:
    """Write tracks 4 s apart on each of four lanes, 12 ± 3 m/s with 0.2 m of noise, a hundred at a time."""
    rng = np.random.default_rng(0)
    clock = np.arange(0.0, seconds, 0.1)
    writer: csv.CSVWriter | parquet.ParquetWriter | None = None
    for begin in range(0, tracks, 100):
        frames = []
        for i in range(begin, min(begin + 100, tracks)):
            position = 12 * clock + 12 * np.sin(0.25 * clock) + 0.2 * rng.normal(size=len(clock))
            time = np.round(clock + 4 * (i // 4), 1)
            frames.append(pl.DataFrame({"vehicle_id": i, "lane": i % 4, "time_s": time, "position_m": position}))
        table = pl.concat(frames).to_arrow()
        if writer is None:
            kind = csv.CSVWriter if path.suffix == ".csv" else parquet.ParquetWriter
            writer = kind(path, table.schema)
        writer.write_table(table)
    assert writer is not None
    writer.close()


def peak(tracks: int, suffix: str, seconds: float) -> tuple[float, float]:
    """Return the size of the file and the peak of the process that filters it (MB)."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"tracks{suffix}"
        write(path, tracks, seconds)
        command = [sys.executable, "-c", MEASURED, str(path), str(Path(folder) / "out")]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        count, megabytes = done.stdout.split()[-2:]
        assert int(count) == tracks
        return path.stat().st_size / 1e6, float(megabytes)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tracks", type=int, nargs="+", default=[500, 2000, 8000])
    parser.add_argument("--seconds", type=float, default=40.0)
    options = parser.parse_args()
    for suffix in (".csv", ".parquet"):
        for tracks in options.tracks:
            size, megabytes = peak(tracks, suffix, options.seconds)
            rows = tracks * round(10 * options.seconds)
            print(
                f"{suffix:9s} {tracks:6d} tracks {rows:9d} rows {size:7.1f} MB on disk: peak {megabytes:6.0f} MB",
                flush=True,
            )


if __name__ == "__main__":
    main()
