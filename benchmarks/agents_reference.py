"""What tests of agents are worth: rows of policies that learn nothing or next to nothing, on four rings.

``python benchmarks/agents.py reference`` does what is missing, a family and a ring at a time, and prints the table.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import torch

from agents import apg, common
from agents.common import Policy
from agents.reference import RANDOM, Family, alone, families, networks, singles, tried
from benchmarks.agents_tables import Row, environment_of, ring, table

UNTRAINED = range(8)
"""Seeds of policies before any update, and after one."""
MOST = 0.05
"""Share of the random policies above which a task is no test."""
Once = Callable[[Path, Callable[[], Row]], "Row | None"]
"""Folder and what makes its result → the result, kept there; None where another process makes it."""


def rings() -> dict[str, Row]:
    """Return the environments by name: behind a failsafe and with real brakes, without and with a shock."""
    guarded = environment_of("ring-apg")
    free = {**guarded, "failsafe": 0.0, "max_command": [-4.5, 2.6]}
    shock = {"shock": 4.0}
    return {
        "failsafe": guarded,
        "failsafe-shock": {**guarded, **shock},
        "brakes": free,
        "brakes-shock": {**free, **shock},
    }


def begun(environment: Row, folder: Path, updates: int) -> Family:
    """Return the policies of ``configs/ring-apg.yaml`` before any update, or after one."""
    made: list[Policy] = []
    root = Path(__file__).resolve().parents[1]
    for seed in UNTRAINED:
        arguments = common.load_agent(root / "configs" / "ring-apg.yaml", apg.Arguments, "apg")
        arguments.environment, arguments.seed, arguments.updates = environment, seed, 1
        arguments.out = folder / f"seed{seed}"
        torch.manual_seed(seed)
        if updates:
            if not (arguments.out / "last.pt").exists():
                apg.train(arguments)
            made.append(common.load(arguments.out / "last.pt")[0])
        else:
            made.append(common.begin(arguments, "apg")[0])
    return networks(made, [f"seed {seed}" for seed in UNTRAINED])


def makers(environment: Row, folder: Path) -> dict[str, Callable[[], Row]]:
    """Return what makes each row of a ring, by name."""
    made: dict[str, Callable[[], Row]] = {
        name: lambda make=make: alone(make, environment) for name, make in singles(environment).items()
    }
    for name, family in families(environment).items():
        made[name] = lambda family=family: tried(family(), environment)
    # Trained on the ring without a shock, as agents are.
    training = {k: v for k, v in environment.items() if k != "shock"}
    for updates, name in ((0, "APG before any update"), (1, "APG after one update")):
        made[name] = lambda updates=updates: tried(begun(training, folder / "one_update", updates), environment)
    return made


def show(out: Path, names: Sequence[str], once: Once) -> None:
    """Do what is missing, and print the table."""
    columns: dict[str, dict[str, Row | None]] = {}
    for name in names:
        environment, folder = rings()[name], out / "reference" / name
        columns[name] = {}
        # With and without a shock policies are trained alike.
        trained = out / "reference" / name.removesuffix("-shock")
        for i, (row, make) in enumerate(makers(environment, trained).items()):
            print(f"{name}: {row}", flush=True)
            columns[name][row] = once(folder / f"row{i}", lambda make=make, row=row: {"row": row, **make()})
    rows = [[row, *(told(columns[n][row]) for n in names)] for row in next(iter(columns.values()))]
    table(("passed of tried; the best: ratio/std/time gap/collisions", *names), rows)
    for name in names:
        found = [columns[name][row] for row in RANDOM]
        done = [r for r in found if r is not None]
        if len(done) == len(found):
            passed, all_of = sum(len(r["passed"]) for r in done), sum(r["tried"] for r in done)
            verdict = "a test" if passed <= MOST * all_of else "no test"
            print(f"\n{name}: {passed} of {all_of} random policies pass, so it is {verdict}.")
        for row, r in columns[name].items():
            if r is not None and any(r["passed"]):
                print(f"{name}, passed by {row}: {json.dumps(r['passed'][:12], ensure_ascii=False)}")


def told(row: Row | None) -> str:
    """Return a cell."""
    if row is None:
        return "another process works on it"
    return f"{len(row['passed'])} of {row['tried']}; {'/'.join(ring(row['figures']))}"
