"""Several agents with one policy on longer rings: from 22 to 440 vehicles, 2 to 20 % of them controlled.

    python -m benchmarks.agents_shared [--checkpoints runs/benchmark/ring-apg/trial0/seed*/training/last.pt …]
        [--out runs/shared]

Judged as one agent is: rings of 10 to 12.3 m per vehicle, five fresh draws of each of six lengths, a human who brakes
with 4 m/s² for 2 s two minutes after the take-over. Policies of one agent among 22 drive as they are. What is done is
kept.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import torch

from agents import common
from agents.evaluate import evaluate_ring
from agents.rollout import FRESH
from benchmarks.agents import once
from benchmarks.agents_tables import environment_of, ring, table

Row = dict[str, Any]
RINGS = ((22, 1), (110, 2), (110, 5), (110, 11), (110, 22), (440, 20))
"""Vehicles, and how many of them agents drive."""


def environment(vehicles: int, agents: int) -> Row:
    """Return the keywords of a ring with a shock."""
    longer = vehicles / 22
    length = [220.0 * longer, 270.0 * longer]
    return {**environment_of("ring-apg"), "vehicles": vehicles, "length": length, "controlled": agents, "shock": 4.0}


def main() -> None:
    """Judge what is missing, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--checkpoints", nargs="*", type=Path, default=[])
    parser.add_argument("--out", type=Path, default=Path("runs/shared"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    policies: dict[str, Path | None] = {"IDM for all": None}
    for path in options.checkpoints:
        policies["/".join(path.parts[-5:-2])] = path
    rows = []
    for vehicles, agents in RINGS:
        for name, path in policies.items():
            if path is None and (vehicles, agents) in ((110, 5), (110, 11), (110, 22)):
                continue  # nobody is controlled: the ring with two agents has the row

            def judge(path: Path | None = path, vehicles: int = vehicles, agents: int = agents) -> Row:
                act = None if path is None else common.load(path, "ring")[0]
                return evaluate_ring(act, environment(vehicles, agents), draws=FRESH)

            found = once(options.out / f"{vehicles}-{agents}" / name.replace("/", "-").replace(" ", "-"), judge)
            if found is not None:
                share = "" if path is None else f"{agents} ({100.0 * agents / vehicles:.1f} %)"
                passed = "yes" if found["passed"] else "no"
                rows.append([str(vehicles), share, name, *ring(found), passed])
                print(*rows[-1], sep=" | ", flush=True)
    table(
        ("vehicles", "controlled", "policy", "worst speed ratio", "worst deviation (m/s)", "smallest time gap (s)",
         "collisions, of 30 rings", "passes"), rows,
    )  # fmt: skip


if __name__ == "__main__":
    main()
