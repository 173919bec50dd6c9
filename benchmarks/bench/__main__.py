"""Speed beside diffidm, SUMO, HighwayEnv and the memory's limit, in one run: ``python -m benchmarks.bench``.

Writes report.html and performance.json. ``--sizes`` are numbers of vehicles, by comma; of ``--rounds`` interleaved ones
minimum and median are told.
"""

from __future__ import annotations

from pathlib import Path

from benchmarks import bench, command
from idm_env.cli import answers
from idm_env.jobs.progress import shown


def main(
    out: Path = Path("out/bench"), sizes: str = "2000,20000,200000,2000000", rounds: int = 5, compiled: bool = True,
    peers: bool = True, verbose: bool = False,
) -> None:  # fmt: skip
    numbers = [int(size) for size in sizes.split(",")]
    with shown(answers.console) as report:
        result = bench.run(
            out, sizes=numbers, rounds=rounds, compiled=compiled, others=peers, on_progress=report,
            say=answers.console.print if verbose else None, verbose=verbose,
        )  # fmt: skip
    for title, rows, _ in bench.tables.of(result)[: len(numbers) + 2]:  # the rest is in the report
        answers.show(title, rows)
    answers.finished(out, bench.tables.absent(result))


if __name__ == "__main__":
    command(main)
