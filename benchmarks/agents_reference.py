"""What tests of agents are worth: rows of policies that learn nothing or next to nothing, on rings and behind a leader.

``python benchmarks/agents.py reference`` does what is missing, a family and a ring at a time, and prints the table.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import torch

from agents import apg, common
from agents.evaluate import evaluate_follow
from agents.policy import Policy
from agents.reference import HIDDEN, RANDOM, alone, families, networks, passing, random_policies, singles, tried
from agents.rollout import Act
from benchmarks.agents_tables import Row, environment_of, ring, table

UNTRAINED = range(8)
"""Seeds of policies before any update, and after one."""
MOST = 0.05
"""Share of the random policies above which a task is no test."""
Once = Callable[[Path, Callable[[], Row]], "Row | None"]
"""Folder and what makes its result → the result, kept there; None where another process makes it."""


def tests() -> dict[str, Row]:
    """Return the environments by name: rings behind a failsafe or with real brakes, with a shock or without; follow."""
    guarded = environment_of("ring-apg")
    free = {**guarded, "failsafe": 0.0, "max_command": [-4.5, 2.6]}
    shock = {"shock": 4.0}
    return {
        "failsafe": guarded,
        "failsafe-shock": {**guarded, **shock},
        "brakes": free,
        "brakes-shock": {**free, **shock},
        "follow": environment_of("follow-apg"),
    }


def begun(environment: Row, folder: Path, updates: int) -> list[Policy]:
    """Return the policies of APG's configuration for this task before any update, or after one."""
    made: list[Policy] = []
    root = Path(__file__).resolve().parents[1]
    for seed in UNTRAINED:
        arguments = common.load_agent(root / "configs" / f"{environment['task']}-apg.yaml", apg.Arguments, "apg")
        arguments.environment, arguments.seed, arguments.updates = environment, seed, 1
        arguments.out = folder / f"seed{seed}"
        torch.manual_seed(seed)
        if updates:
            if not (arguments.out / "last.pt").exists():
                apg.train(arguments)
            made.append(common.load(arguments.out / "last.pt")[0])
        else:
            made.append(common.begin(arguments, "apg")[0])
    return made


BEGUN = {"APG before any update": 0, "APG after one update": 1}
SEEDS = [f"seed {seed}" for seed in UNTRAINED]


def on_ring(environment: Row, folder: Path) -> dict[str, Callable[[], Row]]:
    """Return what makes each row of a ring, by name."""
    made: dict[str, Callable[[], Row]] = {
        name: lambda make=make: alone(make, environment) for name, make in singles(environment).items()
    }
    for name, family in families(environment).items():
        made[name] = lambda family=family: tried(family(), environment)
    # Trained on the ring without a shock, as agents are.
    training = {k: v for k, v in environment.items() if k != "shock"}
    for name, updates in BEGUN.items():
        made[name] = lambda updates=updates: tried(networks(begun(training, folder, updates), SEEDS), environment)
    return made


def behind_leader(environment: Row, folder: Path) -> dict[str, Callable[[], Row]]:
    """Return what makes each row behind a recorded leader, by name. Policies begin as clones of IDM there."""

    def judged(acts: Sequence[Act | None], names: Sequence[str] = ()) -> Row:
        names = names or [str(i) for i in range(len(acts))]
        return passing(names, lambda draws, some: [evaluate_follow(acts[i], environment, draws=draws) for i in some])

    made: dict[str, Callable[[], Row]] = {"IDM (a human driver more)": lambda: judged([None], [""])}
    for name, hidden in zip(RANDOM, HIDDEN, strict=True):
        made[name] = lambda hidden=hidden: judged(random_policies(environment, 200, hidden))
    for name, updates in BEGUN.items():
        made[name] = lambda updates=updates: judged(begun(environment, folder, updates), SEEDS)

    def always(action: float) -> Act:
        return lambda observation: observation.new_full((len(observation), 1), action)

    actions = [round(0.1 * i - 1.0, 1) for i in range(21)]
    made["constants"] = lambda: judged([always(x) for x in actions], [f"{x:g} of the range" for x in actions])
    return made


def show(out: Path, names: Sequence[str], once: Once) -> None:
    """Do what is missing, and print the table."""
    columns: dict[str, dict[str, Row | None]] = {}
    for name in names:
        environment, folder = tests()[name], out / "reference" / name
        columns[name] = {}
        # With and without a shock policies are trained alike.
        trained = out / "reference" / name.removesuffix("-shock")
        makers = on_ring if environment["task"] == "ring" else behind_leader
        for i, (row, make) in enumerate(makers(environment, trained / "one_update").items()):
            print(f"{name}: {row}", flush=True)
            columns[name][row] = once(folder / f"row{i}", lambda make=make, row=row: {"row": row, **make()})
    every = dict.fromkeys(row for column in columns.values() for row in column)
    rows = [[row, *(told(columns[n][row]) if row in columns[n] else "" for n in names)] for row in every]
    table(
        ("passed of tried; the best: ratio/std/time gap/collisions, of follow reward/time gap/collisions", *names), rows
    )
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
    figures = row["figures"]
    best = (
        "/".join(ring(figures))
        if "speed_ratio" in figures
        else "{reward:.3f}/{time_gap:.2f}/{collisions}".format(**figures)
    )
    return f"{len(row['passed'])} of {row['tried']}; {best}"
