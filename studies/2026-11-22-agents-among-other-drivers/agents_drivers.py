"""Policies of the ring among other drivers: among whom they pass, and what in their training makes the difference.

    python -m benchmarks.agents_drivers [--only "usual drivers" …] [--seeds 2] [--reference runs/benchmark]
        [--model model.yaml] [--out runs/drivers] [--executor processes --jobs 4]

One APG policy per variant and seed is trained behind the failsafe; the variants change one thing at a time. All are
judged with the shock: on the thirty fresh rings of the test, among ten kinds of drivers (one parameter of all of them
20 % lower or higher), on lengths of 200–300 m and among drivers mixed from ±20 %; and among the ten kinds without a
shock. ``--model`` also judges them among the single drivers of a file, on rings of 280–380 m. What is done is kept; a
training that was cut off goes on.

Beside them stand IDM, and those policies of ``python benchmarks/agents.py reference --tests failsafe-shock`` that pass
the test itself, among them the oracle that is told each ring's uniform speed.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from agents import apg, common
from agents.evaluate import TEST, as_judged, evaluate_ring, held_out, kinds, worst
from agents.reference import families, judge
from agents.rollout import FRESH, Act
from benchmarks import workers
from benchmarks.agents import once
from benchmarks.agents_tables import Row, environment_of, ring, table
from benchmarks.agents_transfer import LONGER
from idm_env.progress import OnProgress

SHOCK = TEST["ring"]
SLOWER: Row = {"parameters": {"idm": {"max_accel": 0.8}}}
RANGES = {"max_accel": [0.75, 1.25], "time_gap": [0.75, 1.25], "min_gap": [1.5, 2.5], "comfort_decel": [1.1, 1.9]}
"""A quarter more and less: the kinds that judge lie within."""
DRAWN: Row = {"randomise": {"idm": RANGES}, **SHOCK}
MEANS, CELL, LONG = {"history": (5.0, 30.0)}, {"recurrent": 16}, {"window": 1200, "updates": 48}
VARIANTS: dict[str, tuple[Row, Row]] = {
    "usual drivers": ({}, {}),
    "maximum acceleration 0.8 m/s²": (SLOWER, {}),
    "maximum acceleration 0.8 m/s², shocks": ({**SLOWER, **SHOCK}, {}),
    "drawn drivers, shocks": (DRAWN, {}),
    "drawn drivers, shocks, running means": (DRAWN, MEANS),
    "drawn drivers, shocks, recurrent unit": (DRAWN, CELL),
    "drawn drivers, shocks, windows of 120 s": (DRAWN, LONG),
    "drawn drivers, shocks, running means, windows of 120 s": (DRAWN, {**MEANS, **LONG}),
    "drawn drivers, shocks, recurrent unit, windows of 120 s": (DRAWN, {**CELL, **LONG}),
    "drawn drivers, shocks, running means, windows of 120 s, twice the updates": (
        DRAWN, {**MEANS, **LONG, "updates": 96},
    ),
}  # fmt: skip
"""Keywords of the environment, and options of APG, that differ from ``configs/ring-apg.yaml``."""
HEAD = (
    "trained among", "seed", "CPU s", "thirty fresh rings", "kinds passed, of 10", "worst kind", "200–300 m", "mixed",
    "without a shock: kinds passed", "worst kind",
)  # fmt: skip


def tested() -> Row:
    """Return the environment of the test."""
    return as_judged(environment_of("ring-apg"))


def judged(act: Act | None) -> Row:
    """Return all figures of a policy."""
    test = tested()
    calm = {name: evaluate_ring(act, {**among, "shock": 0.0}, draws=(1,)) for name, among in kinds(test).items()}
    return {"fresh": evaluate_ring(act, test, draws=FRESH), "shock": held_out(act, test), "calm": calm}


@dataclass(frozen=True)
class Part:
    """One variant with one seed, and the folder of all: a part for an executor."""

    variant: str
    seed: int
    out: Path

    def __str__(self) -> str:
        return f"{self.variant}/seed{self.seed}"

    @property
    def folder(self) -> Path:
        """Where it is kept."""
        return self.out / self.variant.replace("/", "-").replace(" ", "-").replace(",", "") / f"seed{self.seed}"


def train(part: Part, on_progress: OnProgress) -> Row | None:
    """Return the figures of a part, trained and judged now if they are not there; None: another process does it."""
    torch.set_num_threads(1)

    def make() -> Row:
        root = Path(__file__).resolve().parents[1]
        given = common.load_agent(root / "configs/ring-apg.yaml", apg.Arguments, "apg")
        changed, options = VARIANTS[part.variant]
        given = dataclasses.replace(
            given, environment={**given.environment, **changed}, seed=part.seed, out=part.folder / "training", **options
        )
        policy, content = common.load(common.completed(apg.train, given))
        return {"cpu_seconds": content["training"]["cpu_seconds"], **judged(policy)}

    return once(part.folder, make)


def passers(reference: Path, out: Path) -> dict[str, Row]:
    """Return, by family, the figures of the reference policies that pass the test: each among every kind of drivers."""
    test, found = tested(), dict[str, Row]()
    made = families(test)
    for path in sorted((reference / "reference" / "failsafe-shock").glob("row*/result.json")):
        row = json.loads(path.read_text())
        if row["row"] not in made or not row["passed"]:
            continue

        def figures(row: Row = row) -> Row:
            family, passed = made[row["row"]](), row["passed"]
            chosen = [family.names.index(x) for x in passed]
            columns = [judge(family, among, (1,), chosen) for among in kinds(test).values()]
            return {"of": row["tried"], "kinds": {x: [c[i] for c in columns] for i, x in enumerate(passed)}}

        done = once(out / "reference" / row["row"].replace(" ", "-"), figures)
        if done is not None:
            found[row["row"]] = done
    return found


def short(row: Row) -> str:
    """Return ratio and deviation."""
    return "/".join(ring(row)[:2])


def cells(row: Row) -> list[str]:
    """Return the figures of one policy as cells."""
    among = [x for name, x in row["shock"].items() if "20 %" in name]
    calm = list(row["calm"].values())
    return [
        short(row["fresh"]), str(sum(x["passed"] for x in among)),
        *(short(row["shock"][name]) for name in ("drivers", "lengths", "mixed")),
        str(sum(x["passed"] for x in calm)), short(worst(calm)),
    ]  # fmt: skip


def main() -> None:
    """Do what is missing, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", default=list(VARIANTS), choices=VARIANTS, help="variants")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--reference", type=Path, default=Path("runs/benchmark"), help="folder of the reference rows")
    parser.add_argument("--model", type=Path, help="single drivers among whom policies are judged, too")
    parser.add_argument("--out", type=Path, default=Path("runs/drivers"))
    workers.add(parser)
    options = parser.parse_args()
    torch.set_num_threads(1)
    out = options.out.resolve()
    parts = [Part(name, seed, out) for name in options.only for seed in range(options.seeds)]
    human = once(out / "IDM", lambda: judged(None))
    rows = {-1: [] if human is None else ["IDM for all", "", "", *cells(human)]}
    with workers.of(options) as executor:
        for i, found in executor.map(train, parts):
            if found is not None:
                rows[i] = [parts[i].variant, str(parts[i].seed), f"{found['cpu_seconds']:.0f}", *cells(found)]
    table(HEAD, [rows[i] for i in sorted(rows) if rows[i]])
    table(
        ("reference policies that pass the test", "of", "kinds passed, of 10", "worst kind"),
        [
            [f"{family}: {name}", str(found["of"]), str(sum(x["passed"] for x in figures)), short(worst(figures))]
            for family, found in passers(options.reference, out).items()
            for name, figures in found["kinds"].items()
        ],
    )
    if options.model is not None:
        measured_table(parts, options.model.resolve(), out)


def measured_table(parts: Sequence[Part], model: Path, out: Path) -> None:
    """Judge everything among the single drivers of a model, without a shock, and print it."""
    among = {**environment_of("ring-apg"), "drivers": str(model)}
    rows = []
    for part in [None, *parts]:
        folder = (out / "IDM" if part is None else part.folder) / f"among-{model.parent.name}-{model.stem}"
        act = None if part is None else common.load(part.folder / "training" / "last.pt")[0]
        found = once(folder, lambda act=act: evaluate_ring(act, among, LONGER, draws=FRESH))
        if found is not None:
            name = ["human drivers", ""] if part is None else [part.variant, str(part.seed)]
            rows.append([*name, *ring(found)])
    table(("among single drivers", "seed", "worst ratio", "worst deviation", "smallest time gap", "collisions"), rows)


if __name__ == "__main__":
    main()
