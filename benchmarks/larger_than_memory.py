"""Drivers without number, calibrated in bounded memory: a folder of generated platoons, fitted some runs at a time.

    python -m benchmarks.larger_than_memory --drivers 100000 --folder /tmp/drives --executor processes --jobs 2

The folder is made once, in files of about 2000 drivers. Printed: CPU seconds and the most memory of any process of the
fit, and the digest of the files that no executor may change. Records are short (15 s), one start, one simulated
step per sample: what is measured is the way of the data, not the quality of the fit.
"""

from __future__ import annotations

import hashlib
import resource
import time
from pathlib import Path

from benchmarks import command
from idm_env.data import synthetic
from idm_env.fitting.job import fit_file
from idm_env.fitting.options import Options, Source
from idm_env.jobs.workers import HERE, Workers

FOLLOWERS, RUNS = 10, 200
SECONDS = 15.0
FILES = ("parameters.parquet", "drivers.csv", "model.yaml")


def make(folder: Path, drivers: int) -> int:
    """Write platoons of ten followers until there are ``drivers``; return how many there are."""
    folder.mkdir(parents=True, exist_ok=True)
    count = -(-drivers // (FOLLOWERS * RUNS))
    for number in range(count):
        path = folder / f"{number:05d}.parquet"
        if not path.exists():
            trajectories, _ = synthetic.generate(number, runs=RUNS, followers=FOLLOWERS, seconds=SECONDS)
            run = trajectories.table["run_id"].cast(int) + number * RUNS
            trajectories.table.drop("gap_m", "gap_measured").with_columns(run.alias("run_id")).write_parquet(path)
    return count * FOLLOWERS * RUNS


def megabytes(who: int) -> float:
    """Return the most memory of a process so far."""
    return resource.getrusage(who).ru_maxrss / 1024


def main(
    drivers: int = 20_000, folder: Path = Path("out/drives"), out: Path = Path("out/drives-fit"), place: Workers = HERE
) -> None:
    """Make, fit, print."""
    drivers = make(folder, drivers)
    size = sum(path.stat().st_size for path in folder.glob("*.parquet"))
    print(f"{drivers} drivers in {size / 1e6:.0f} MB of parquet", flush=True)
    before, begin = resource.getrusage(resource.RUSAGE_SELF), time.perf_counter()
    with place.opened() as executor:
        options = Options(starts=1, substeps=1)
        report = fit_file(Source(folder), options, out, executor=executor)
    wall = time.perf_counter() - begin
    mine, children = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    cpu = mine.ru_utime + mine.ru_stime - before.ru_utime - before.ru_stime + children.ru_utime + children.ru_stime
    digest = hashlib.sha256(b"".join((out / name).read_bytes() for name in FILES)).hexdigest()[:12]
    print(
        f"{place.executor}: {report['fit']['groups']} fitted, {cpu:.0f} CPU s (Ray's workers not counted), "
        f"{wall:.0f} s of wall time, at most {megabytes(resource.RUSAGE_SELF):.0f} MB here and "
        f"{megabytes(resource.RUSAGE_CHILDREN):.0f} MB in a worker; digest {digest}"
    )


if __name__ == "__main__":
    command(main)
