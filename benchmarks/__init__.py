"""Benchmarks: every figure in README and docs comes from one of these commands.

What they share is here: how a function becomes a command, the rows that are done and kept, and tables. Importing
this imports no numpy, since some set threads before it starts.
"""

from __future__ import annotations

import inspect
import json
import os
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO, TypeVar

if TYPE_CHECKING:
    from idm_env.jobs.executor import Work
    from idm_env.jobs.workers import Workers

P = TypeVar("P")


DATA = Path(os.environ.get("IDM_ENV_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
"""Folder of the measured files."""


def command(work: Callable[..., None] | Mapping[str, Callable[..., None]]) -> None:
    """Run a function, or one of several by name, as the command line says: parameters are options of the same name."""
    import tyro

    module: Any = inspect.getmodule(work if callable(work) else next(iter(work.values())))
    options: dict[str, Any] = {
        "prog": f"python -m {module.__spec__.name}",
        "description": module.__doc__,
        "config": (tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff),
    }
    tyro.cli(work, **options) if callable(work) else tyro.extras.subcommand_cli_from_dict(dict(work), **options)


def kept_rows(out: Path, column: str) -> dict[Any, dict[str, Any]]:
    """Return the rows that a file has, a line of JSON each, by one of their columns; none where there is no file."""
    rows = map(json.loads, out.read_text().splitlines()) if out.exists() else ()
    return {row[column]: row for row in rows}


def _keep(row: dict[str, Any], file: TextIO) -> dict[str, Any]:
    """Write a row, and return it as ``kept_rows`` will read it."""
    line = json.dumps(row)
    file.write(line + "\n")
    file.flush()
    return json.loads(line)  # type: ignore[no-any-return]


def rows_of(
    work: Work[P, Any], parts: Mapping[str, P], out: Path, place: Workers, column: str, told: Callable[[Any], str]
) -> list[dict[str, Any]]:
    """Return the row of every part; those that a file has under their ``column`` are not done again.

    Each is a line of the file when it is done, and ``told`` on stderr.
    """
    done = kept_rows(out, column)
    missing = [part for name, part in parts.items() if name not in done]
    with place.opened() as executor, out.open("a") as file:
        for number, (_, row) in enumerate(executor.map(work, missing), 1):
            done[row[column]] = row = _keep(row, file)
            print(f"{number}/{len(missing)} {row[column]}: {told(row)}", file=sys.stderr, flush=True)
    return [done[name] for name in parts]


def named_rows(work: Work[P, Any], parts: Mapping[str, P], out: Path, place: Workers) -> dict[str, Any]:
    """Return what every part gives, by name; each is kept in a file when it is done, and not done again.

    What a part says of itself (``repr``) is kept beside it: where that differs, or is missing, it is done anew.
    """
    done = kept_rows(out, "name")
    missing = [name for name, part in parts.items() if done.get(name, {}).get("part") != repr(part)]
    out.parent.mkdir(parents=True, exist_ok=True)
    with place.opened() as executor, out.open("a") as file:
        for i, result in executor.map(work, [parts[name] for name in missing]):
            name = missing[i]
            done[name] = _keep({"name": name, "part": repr(parts[name]), "found": result}, file)
            print(f"{name}: done, kept in {out}", file=sys.stderr, flush=True)
    return {name: done[name]["found"] for name in parts}


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    return "\n".join(f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *rows))


def ranked(rounds: Iterable[Any], most: int = 12) -> list[dict[str, Any]]:
    """Return what every round of a search saw: which won, and its candidates by held-out gain, ``most`` of each kind.

    Kinds are names of the catalogue, and curves, places and times without one. Gains are in log RMSE, of every unit.
    """
    rows = []
    for step in rounds:
        order = step.tested.gain.argsort()[::-1].tolist()
        by_kind = [[i for i in order if (step.scored[i].term.effect is None) is bare][:most] for bare in (False, True)]
        best = [
            {
                "label": (term := step.scored[i].term).label, "effect": term.effect, "coordinate": term.coordinate,
                "curve": term.fades, "past": term.past, "fitted": step.scored[i].solution is not None,
                "p": float(step.tested.p_value[i]), "gain": float(step.tested.gain[i]),
                "gains": [round(float(g), 5) for g in step.scored[i].gains],
            }
            for kind in by_kind for i in kind
        ]  # fmt: skip
        winner = None if step.winner is None else step.scored[step.winner].term.label
        reason = None if step.refusal is None else step.refusal.reason.name
        rows.append({"winner": winner, "refused": reason, "free": step.in_closed_loop, "best": best})
    return rows
