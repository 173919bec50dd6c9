"""The tables of ``benchmarks/agents.py``, from its files of results; Markdown on the standard output."""

from __future__ import annotations

import json
import statistics
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

Row = dict[str, Any]


def results(out: Path, config: str) -> list[Row]:
    """Return every result of a configuration, by trial, length of training and seed."""
    found = [json.loads(path.read_text()) for path in (out / config).glob("trial*/seed*/result.json")]
    return sorted(found, key=lambda r: (r["trial"], r.get("times", 1), r["seed"]))


def groups(out: Path, config: str, seeds: Sequence[int]) -> dict[str, list[Row]]:
    """Return the results of a configuration's seeds, by what was trained for how long."""
    found: dict[str, list[Row]] = {}
    for r in results(out, config):
        if r["seed"] in seeds:
            times = r.get("times", 1)
            found.setdefault(f"{r['trial']}" + (f", {times} times" if times > 1 else ""), []).append(r)
    return found


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print a Markdown table."""
    print("\n| " + " | ".join(head) + " |\n|" + " --- |" * len(head))
    for row in rows:
        print("| " + " | ".join(row) + " |")


def spread(values: Sequence[float], form: str) -> str:
    """Return median and range."""
    if not values:
        return "–"
    middle, low, high = (format(x, form) for x in (statistics.median(values), min(values), max(values)))
    return f"{middle} ({low}–{high})"


def ring(r: Row) -> list[str]:
    """Return speed ratio, deviation, time gap and collisions of one evaluation."""
    return [f"{r['speed_ratio']:.3f}", f"{r['speed_std']:.2f}", f"{r['time_gap']:.2f}", str(r["collisions"])]


def search_table(out: Path, configs: Sequence[str], seeds: Sequence[int]) -> None:
    """Print what the trials of each search came to."""
    rows = []
    for config in configs:
        found = [r for r in results(out, config) if r["seed"] in seeds]
        for trial in sorted({r["trial"] for r in found}):
            part = [r for r in found if r["trial"] == trial]
            ends = ["/".join(ring(r["last"])[:2]) for r in part if r["history"]]
            options = ", ".join(f"{k} {v}" for k, v in part[0]["options"].items())
            rows.append([config, str(trial), options, f"{solved(part)} of {len(part)}", ", ".join(ends)])
    table(("agent", "trial", "what it changes", "solved", "last ratio/std of each seed"), rows)


def solved(rows: Sequence[Row]) -> int:
    """Return how many are solved."""
    return sum(r["summary"]["solved"] for r in rows)


def summary_table(out: Path, configs: Sequence[str], seeds: Sequence[int]) -> None:
    """Print one row per agent: how many of its seeds solved the test, and how soon.

    Vehicle-steps are steps of environments times the vehicles in one.
    """
    from agents.environments import task_of

    rows = []
    for config, name, part in ((c, n, p) for c in configs for n, p in groups(out, c, seeds).items()):
        done = [r["summary"] for r in part if r["summary"]["solved"]]
        vehicles = task_of(environment_of(f"{config.split('-')[0]}-apg")).vehicles
        rows.append([
            config, name, f"{len(done)} of {len(part)}", str(sum(r["summary"]["ever"] for r in part)),
            spread([r["summary"]["spent"] for r in part if r["history"]], ".0f"),
            spread([d["cpu_seconds"] for d in done], ".1f"), spread([d["steps"] / 1000 for d in done], ".0f"),
            spread([d["steps"] * vehicles / 1e6 for d in done], ".1f"),
        ])  # fmt: skip
    table(
        ("agent", "trial", "solved", "ever passed", "CPU s trained", "CPU s to solved", "1000 steps to solved",
         "million vehicle-steps to solved"), rows
    )  # fmt: skip


def median_ratio(theirs: Sequence[float], ours: Sequence[float], draws: int = 10_000) -> tuple[float, float, float]:
    """Return the ratio of two medians and its 95 % interval: percentiles of a bootstrap over seeds.

    Seeds that never solve are infinite: later than all others, whenever that would be.
    """
    generator = np.random.default_rng(0)
    drawn = [np.median(generator.choice(x, (draws, len(x))), axis=1) for x in (theirs, ours)]
    with np.errstate(invalid="ignore"):  # infinite over infinite says nothing
        low, high = np.nanquantile(drawn[0] / drawn[1], (0.025, 0.975), method="nearest")
        return float(np.median(theirs) / np.median(ours)), float(low), float(high)


def ratio_line(out: Path, ours: str, theirs: str, seeds: Sequence[int]) -> None:
    """Print how much more another agent needs: the ratio of medians over all seeds, with its interval.

    There is none where half of the seeds do not solve; of those it is only known that they need more than they had.
    """
    one, others = groups(out, ours, seeds), groups(out, theirs, seeds)
    base = [r["summary"] for part in one.values() for r in part]
    for name, part in others.items():
        other = [r["summary"] for r in part]
        for key, what in (("cpu_seconds", "CPU seconds"), ("steps", "environment steps")):
            a, b = ([float(s[key]) if s["solved"] else float("inf") for s in some] for some in (base, other))
            told = f"\n{theirs} ({name}) / {ours}, {what} to solved: "
            if a and np.isfinite([np.median(a), np.median(b)]).all():
                told += "{:.2f} ({:.2f}–{:.2f})".format(*median_ratio(b, a))
            else:
                told += "no ratio"
            print(
                f"{told}; {int(np.isfinite(b).sum())} of {len(b)} and {int(np.isfinite(a).sum())} of {len(a)} solved",
                end="",
            )
            spent = [s["spent"] for s in other if not s["solved"]]
            if a and np.isfinite(np.median(a)) and spent and key == "cpu_seconds":
                print(f"; those not solved had {min(spent) / np.median(a):.0f} times {ours}'s median", end="")
            print(".")


def seed_table(out: Path, configs: Sequence[str], seeds: Sequence[int]) -> None:
    """Print every seed: before any update, last and best checkpoint; the last one on held-out lengths and drivers."""
    rows = []
    for config, name, part in ((c, n, p) for c in configs for n, p in groups(out, c, seeds).items()):
        for r in part:
            if not r["history"]:
                continue
            s, unseen = r["summary"], r["held_out"]
            when = [f"{s['cpu_seconds']:.1f}", f"{s['steps'] // 1000}"] if s["solved"] else ["–", "–"]
            kinds = ("lengths", "drivers", "mixed")
            far = [
                "/".join(ring(unseen[k])[:2]) + (f" {unseen[k]['collisions']} coll." if unseen[k]["collisions"] else "")
                for k in kinds
            ]
            ends = ["/".join(ring(r[k])) for k in ("fresh_last", "fresh_best")]
            before = "/".join(ring(r["untrained"])[:2])
            rows.append([config, name, str(r["seed"]), before, *when, *ends, *far])
    figures = "ratio/std/time gap/collisions"
    table(
        ("agent", "trial", "seed", "before any update", "CPU s", "1000 steps", f"last: {figures}", f"best: {figures}",
         "lengths 200–300 m", "drivers ±20 %, worst", "drivers mixed"), rows,
    )  # fmt: skip


def takeover_table(out: Path, configs: Sequence[str], seeds: Sequence[int]) -> None:
    """Print where the last checkpoints touch somebody, taking over in other traffic, without and with a failsafe.

    A case is: rings with a collision of all rings, and the medians over seeds of worst speed ratio and deviation.
    """
    from agents.classical import controllers
    from agents.common import load
    from agents.evaluate import evaluate_ring, mixed
    from agents.rollout import LENGTHS

    rows, environment, draws = [], environment_of("ring-apg"), (1,)
    # A controller with memory drives one batch once, so it is made anew for every case.
    by_hand = controllers(environment, LENGTHS, draws)
    policies: dict[str, list[Any]] = {name: [by_hand[name]] for name in ("no command", "PI with saturation")}
    for config in configs:
        paths = [(out / config).glob(f"trial*/seed{seed}/training/last.pt") for seed in seeds]
        policies[config] = [lambda path=path: load(path)[0] for found in paths for path in found]
    for name, makers in policies.items():
        for failsafe in (0.0, 3.0):
            own = {**environment, "failsafe": failsafe}
            figures = []
            for case, warmup in ((own, 750), (own, 1750), (own, 3000), (mixed(own), 3000)):
                found = [evaluate_ring(make(), case, warmup=warmup, draws=draws) for make in makers]
                touched, rings = sum(r["collisions"] for r in found), sum(len(r["ratios"]) for r in found)
                ratio, std = (statistics.median(r[k] for r in found) for k in ("speed_ratio", "speed_std"))
                figures.append(f"{touched} of {rings} / {ratio:.3f} / {std:.2f}")
            rows.append([name, str(len(makers)), f"{failsafe:g} m/s²" if failsafe else "none", *figures])
    table(
        ("agent", "seeds", "failsafe", "after 75 s (Flow's)", "after 175 s", "after 300 s (the test)",
         "after 300 s, drivers mixed"), rows,
    )  # fmt: skip


def unshocked_table(out: Path, configs: Sequence[str], seeds: Sequence[int]) -> None:
    """Print what the last checkpoints do on the thirty fresh rings of their test without its shock."""
    from agents.common import load
    from agents.evaluate import as_judged, evaluate
    from agents.rollout import FRESH

    rows = []
    for config in configs:
        for path in (p for seed in seeds for p in sorted((out / config).glob(f"trial*/seed{seed}/training/last.pt"))):
            policy, content = load(path)
            test = as_judged(content["environment"], content["training"]["arguments"]["judged_in"])
            found = evaluate(policy, {**test, "shock": 0.0}, draws=FRESH)
            rows.append([config, *path.parts[-4:-2], *ring(found), "yes" if found["passed"] else "no"])
    table(
        ("agent", "trial", "seed", "worst ratio", "worst deviation", "smallest time gap", "collisions, of 30 rings",
         "passes"), rows,
    )  # fmt: skip


def environment_of(config: str) -> Row:
    """Return the environment of one of APG's configurations; the other agents of a task have the same."""
    from agents import apg
    from agents.common import load_agent

    root = Path(__file__).resolve().parents[1]
    return load_agent(root / "configs" / f"{config}.yaml", apg.Arguments, "apg").environment


def follow_table(out: Path, configs: Sequence[str], leader: Path | None) -> None:
    """Print fuel and energy behind the made-up leader and, where there are, measured ones."""
    from agents.common import load
    from agents.evaluate import evaluate_follow

    plain = environment_of("follow-apg")
    roads: dict[str, Row] = {"made-up": plain}
    if leader is not None and leader.exists():
        roads["I-80"] = {**plain, "leader": str(leader)}
    rows = []
    for name, environment in roads.items():
        human = evaluate_follow(None, environment)
        rows.append(
            [name, "the leader itself", "", "", f"{human['leader_litres']:.2f}", "", f"{human['leader_energy']:.3f}"]
        )
        rows.append([name, "IDM", "", *follow(human)])
        for config in configs:
            for path in sorted((out / config).glob("trial*/seed*/training/last.pt")):
                seed = path.parents[1].name.removeprefix("seed")
                rows.append([name, config, seed, *follow(evaluate_follow(load(path)[0], environment))])
    table(
        ("leader", "vehicle", "seed", "reward per step", "L/100 km", "L/100 km with those behind", "energy (J/kg/m)",
         "smallest time gap (s)", "collisions"), [r + [""] * (9 - len(r)) for r in rows],
    )  # fmt: skip


def follow(r: Row) -> list[str]:
    """Return the figures of one policy in task follow."""
    return [
        f"{r['reward']:.3f}", f"{r['litres']:.2f}", f"{r['litres_behind']:.2f}", f"{r['energy']:.3f}",
        f"{r['time_gap']:.2f}", str(r["collisions"]),
    ]  # fmt: skip


def show(
    out: Path, search: dict[str, list[Row]], search_seeds: Sequence[int], seeds: Sequence[int], data: Path
) -> None:
    """Print everything that there are results for."""
    compared = [c for c, trials in search.items() if len(trials) > 1]
    rings, followers = ([c for c in search if c.startswith(task)] for task in ("ring", "follow"))
    search_table(out, compared, search_seeds)
    for task, configs in (("ring", rings), ("follow", followers)):
        summary_table(out, configs, seeds)
        for other in ("shac", "ppo", "sac"):
            ratio_line(out, f"{task}-apg", f"{task}-{other}", seeds)
    seed_table(out, rings, seeds)
    follow_table(out, followers, data)
