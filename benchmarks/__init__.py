"""Benchmarks: every figure in README and docs comes from one of these commands.

What those share that consist of parts is here: where parts run, and the rows that are done and kept. Importing this
imports no numpy, since some set threads before it starts.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from idm_env.jobs.executor import Executor, Work

P = TypeVar("P")


def add_executor(parser: argparse.ArgumentParser, usual: str = "serial") -> None:
    """Add ``--executor``, ``--jobs`` and ``--ray-address``."""
    from idm_env.jobs.executor import KINDS

    parser.add_argument("--executor", choices=KINDS, default=usual, help="where parts run; no result depends on it")
    parser.add_argument("--jobs", type=int, help="parts that run at a time; default: one per processor")
    parser.add_argument("--ray-address", help="of a Ray cluster, host:port or auto; default: Ray on this machine")


def kept_rows(out: Path, column: str) -> dict[Any, dict[str, Any]]:
    """Return the rows that a file has, a line of JSON each, by one of their columns; none where there is no file."""
    rows = map(json.loads, out.read_text().splitlines()) if out.exists() else ()
    return {row[column]: row for row in rows}


def executor_of(arguments: argparse.Namespace) -> AbstractContextManager[Executor]:
    """Give the executor that the arguments name."""
    from idm_env.jobs.executor import opened

    return opened(arguments.executor, arguments.jobs, arguments.ray_address)


def rows_of(
    work: Work[P, Any], parts: Sequence[P], out: Path, arguments: argparse.Namespace
) -> Iterator[dict[str, Any]]:
    """Give the row of every part when it is done, as ``kept_rows`` will read it; by then it is a line of the file."""
    with executor_of(arguments) as executor, out.open("a") as file:
        for _, row in executor.map(work, parts):
            line = json.dumps(row)
            file.write(line + "\n")
            file.flush()
            yield json.loads(line)


def named_rows(work: Work[P, Any], parts: Mapping[str, P], out: Path, arguments: argparse.Namespace) -> dict[str, Any]:
    """Return what every part gives, by name; each is kept in a file when it is done, and not done again.

    What a part says of itself (``repr``) is kept beside it: where that differs, or is missing, it is done anew.
    """
    done = kept_rows(out, "name")
    todo = [name for name, part in parts.items() if done.get(name, {}).get("part") != repr(part)]
    out.parent.mkdir(parents=True, exist_ok=True)
    with executor_of(arguments) as executor, out.open("a") as file:
        for i, found in executor.map(work, [parts[name] for name in todo]):
            line = json.dumps({"name": todo[i], "part": repr(parts[todo[i]]), "found": found})
            done[todo[i]] = json.loads(line)
            file.write(line + "\n")
            file.flush()
            print(f"{todo[i]}: done, kept in {out}", file=sys.stderr, flush=True)
    return {name: done[name]["found"] for name in parts}
