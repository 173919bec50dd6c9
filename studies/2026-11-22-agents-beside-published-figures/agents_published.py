"""Published figures of agents in traffic beside ours, with what differs between the tasks: one table.

    python -m benchmarks.agents_published [--checkpoints runs/benchmark/ring-apg/trial0/seed*/training/last.pt …]
        [--lanes runs/lanes] [--out runs/published]

Published are thresholds of Flow's benchmarks (Vinitsky et al. 2018, CoRL, "Benchmarks for reinforcement learning in
mixed-autonomy traffic"), and human drivers → agents of Yan, Kreidieh, Vinitsky, Bayen and Wu 2022 ("Unified automatic
control of vehicular systems with reinforcement learning", IEEE T-ASE, arXiv 2208.00268). Ours are rings of 22 with
these checkpoints, what ``benchmarks.agents_lanes --out runs/lanes --train 30`` has trained, and the lane drop of
``benchmarks.lanes drop published``, whose file of rows is shared. What is done is kept.
"""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch

from agents import common
from agents.evaluate import STEPS, as_judged, judge_ring, judged_rings
from agents.rollout import FRESH, Act, drive, uniform_speed
from benchmarks import agents_lanes, lane_drop, workers
from benchmarks.agents import once
from benchmarks.agents_tables import environment_of, table

Row = dict[str, Any]
LENGTHS = (230.0, 240.0, 250.0, 260.0, 270.0)
HEAD = ("task", "published", "ours: human drivers", "ours: agents", "what differs")
RINGS = {230.0: "2.6 → 3.4", 270.0: "4.0 → 5.2"}
"""Mean speeds (m/s) with human drivers and with one agent among 22, at both ends of the range of lengths."""
DIFFERS = "there SUMO, ± 0.5 m/s² and a take-over after 100 s; here ± 1 m/s² behind a failsafe, after 300 s"
ONE_LANE = "there one lane of 2000 an hour"
LANES = (
    ("merge", "speed", "Flow's merge, threshold 13.0 m/s", f"{ONE_LANE} and a ramp of 100; here two of 2400, and 500"),
    (
        "merge, 3000 + 800 an hour", "outflow", "on-ramp, about 1500 → 1675 an hour",
        f"{ONE_LANE} and a ramp of 300 that join as a zipper; here two lanes, and nobody lets in",
    ),
    ("merge, 3000 + 800 an hour, drivers let in", "outflow", "the same", "the same, but drivers let in"),
    (
        "bottleneck, 1900 an hour", "outflow", "Flow's bottleneck0, threshold 1167 an hour",
        "there nobody changes lanes, and agents command speeds of stretches; here nobody lets in",
    ),
    (
        "bottleneck, 1900 an hour, drivers let in", "outflow", "Flow's bottleneck1, threshold 1258 an hour",
        "there SUMO's lane changes, and agents command speeds of stretches",
    ),
    (
        "bottleneck", "outflow", "Flow's bottleneck2, threshold 2134 an hour",
        "there 8 → 4 → 2 lanes and 3800 an hour, here 4 → 2 → 1 and 2600",
    ),
)  # fmt: skip
"""Task of ours, which of its figures, what is published, and what differs."""


def speeds(act: Act | None, environment: Mapping[str, Any]) -> Row:
    """Return mean speeds of all vehicles in the last 100 s (m/s) on rings of each length, and collisions."""
    start = judged_rings(environment, LENGTHS, draws=FRESH)
    found = judge_ring(start, drive(start, act, STEPS))
    speed = torch.tensor(found["ratios"]) * uniform_speed(start)
    return {"speeds": speed.view(len(LENGTHS), -1).mean(-1).tolist(), "collisions": found["collisions"]}


def _driven(path: Path, environment: Mapping[str, Any]) -> Row:
    return speeds(common.load(path, "ring")[0], environment)


def ring_rows(out: Path, checkpoints: Sequence[Path]) -> list[list[str]]:
    """Return a row for every length, without and with the human who brakes."""
    calm = environment_of("ring-apg")
    rows = []
    for name, environment in (("", calm), (", a human brakes", as_judged(calm))):
        kept = out / f"ring{name.replace(', ', '-').replace(' ', '-')}"
        human = once(kept / "human", partial(speeds, None, environment))
        agents = [once(kept / "-".join(path.parts[-4:-2]), partial(_driven, path, environment)) for path in checkpoints]
        done = [r for r in agents if r is not None]
        for i, length in enumerate(LENGTHS):
            each = [r["speeds"][i] for r in done]
            told = f"{statistics.median(each):.2f} ({min(each):.2f}–{max(each):.2f})" if each else "–"
            differs = "as above" if i else "the shock is ours" if name else DIFFERS
            rows.append([
                f"ring of {length:.0f} m, m/s{name}", RINGS.get(length, "between these") if not name else "–",
                f"{human['speeds'][i]:.2f}" if human else "–", told, differs,
            ])  # fmt: skip
    return rows


def lane_rows(out: Path) -> list[list[str]]:
    """Return the rows of tasks on several lanes: means over eight episodes with their range."""
    paths = sorted((out / "trained").glob("*/apg-seed*/last.pt"))
    rows = []
    for name, figure, published, differs in LANES:
        found = agents_lanes.figures(out, name, paths, ("idm",))
        told = {kind: ", ".join(_of(r, figure) for r in family.values()) for kind, family in found.items()}
        agents = "; ".join(text for kind, text in told.items() if kind != "idm")
        rows.append([f"`{name}`", published, told["idm"], agents or "–", differs])
    return rows


def _of(r: Row, figure: str) -> str:
    if figure == "speed":
        return f"{r['speed']:.1f} m/s"
    return f"{r['outflow']:.0f} ({min(r['outflows']):.0f}–{max(r['outflows']):.0f}) an hour"


def drop_rows(arguments: argparse.Namespace) -> list[list[str]]:
    """Return the lane drop of 2600 an hour as it stands, and its variants."""
    found = workers.named(lane_drop.drive, lane_drop.on_the_published_road(), lane_drop.KEPT, arguments)
    rows = []
    for i, label in enumerate(lane_drop.LABELS):
        human, controller = (
            "; ".join(
                f"{found[f'short, {name}, derived {derived}'][i][0]:.0f} ± "
                f"{found[f'short, {name}, derived {derived}'][i][1]:.0f}"
                for name in ("nobody lets in", "courtesy")
            )
            for derived in (False, True)
        )
        differs = "both a derived controller, not learned; there a zipper, here lane changes: it lets go 10 m before"
        rows.append([
            f"lane drop, {label.replace('_', ' ')}", "{:.0f} → {:.0f}".format(*lane_drop.PUBLISHED[label]),
            human, controller, differs if not i else "as above",
        ])  # fmt: skip
    return [*rows, ["lane drop, five further variants", "not in the text that we have", "–", "–", "–"]]


def main() -> None:
    """Drive what is missing, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--checkpoints", nargs="*", type=Path, default=[], help="agents of the ring")
    parser.add_argument("--lanes", type=Path, default=Path("runs/lanes"), help="of benchmarks.agents_lanes")
    parser.add_argument("--out", type=Path, default=Path("runs/published"))
    workers.add(parser)
    options = parser.parse_args()
    torch.set_num_threads(1)
    table(HEAD, [*ring_rows(options.out, options.checkpoints), *lane_rows(options.lanes), *drop_rows(options)])


if __name__ == "__main__":
    main()
