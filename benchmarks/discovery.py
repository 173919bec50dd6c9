"""How often discovery is right: hidden effects of two strengths, no effect, effects outside the catalogue, pairs.

Every set is generated from a fresh seed by idm_env.data.synthetic, whose code shares nothing with the simulator; the
tool sees positions, speeds and lengths only. One line of JSON per set is kept, so that a run goes on where it stopped:

    python -m benchmarks.discovery --sets 2 --clean 100 --jobs 2 --out /tmp/discovery_benchmark.jsonl
    python -m benchmarks.discovery --pictures docs    # those of docs/closing-the-loop.md and its study
"""

from __future__ import annotations

import dataclasses
import os
import time
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any

for variable in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "POLARS_MAX_THREADS"):
    os.environ.setdefault(variable, "1")

import numpy as np  # noqa: E402 (threads are set before numpy starts)

from benchmarks import command, ranked, rows_of  # noqa: E402
from idm_env.jobs.workers import IN_PROCESSES, Workers  # noqa: E402

RESPONSE = {"delay", "lag"}
TRUE = {
    "delay": ("delay", 1.0), "lag": ("lag", 1.0), "second_leader": ("weight", 1.0),
    "leader_acceleration": ("gain", 1.0),
    "brake_light": ("gain", 1.0), "asymmetry": ("strength", 1.0), "power_limit": ("power", 1.0),
    "drag": ("coefficient", 1.0), "speed_dependent_gap": ("extra_gap", 1.0), "memory": ("strength", 1.0),
    "speed_time_gap": ("slope", 1.0), "set_point_asymmetry": ("strength", 1.0), "relaxation": ("strength", 1.0),
    "leader_trend": ("factor", 1.0), "gap_stiffness": ("stiffness", 1.0),
    "follower": ("gain", 1.0), "dead_zone": ("threshold", 1.0), "action_point": ("threshold", 1.0),
    "speed_zone": ("factor", 1.0), "regime_shift": ("strength", 1.0), "lateral": ("gain", 1.0),
    "curve_speed": ("lateral_accel", 1.0),
    # The driver goes by the true gap, which is the measured one less the bias.
    "gap_bias": ("bias", -1.0),
}  # fmt: skip
"""Parameter of each effect that has one number to recover, and the sign between generator and model."""
OUTSIDE = (
    "time_gap over places", "time_gap ramp", "a and b step", "period", "run",
    "speed-dependent T", "closing", "gap", "speed x gap", "closing x gap",
)  # fmt: skip
"""Kinds outside the catalogue, those of ``IN_A_STATE`` last."""
IN_A_STATE = OUTSIDE[5:]
TWO = (
    ("delay", "grade"), ("speed_zone", "leader_acceleration"), ("drag", "regime_shift"), ("memory", "brake_light"),
    ("delay", "leader_acceleration"), ("delay", "second_leader"),
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Job:
    """One set: what is hidden in it."""

    kind: str
    effect: str
    strength: str
    ou: float
    seed: int
    runs: int = 10

    def __str__(self) -> str:
        return self.key

    @property
    def key(self) -> str:
        """What the set is called in the file of results."""
        runs = "" if self.runs == 10 else f"|{self.runs} runs"
        return f"{self.kind}|{self.effect}|{self.strength}|{self.ou}|{self.seed}{runs}"


def jobs(sets: int, clean: int, first: int, few: int = 0) -> list[Job]:
    """Return the sets to run, shuffled, so that an unfinished table is a fair one.

    ``clean`` without an effect of every kind of noise, and ``few`` without one of 4 to 9 runs.
    """
    from idm_env.data.synthetic import EFFECTS

    result = []
    for number in range(sets):
        seed = first + 1000 * number
        for i, effect in enumerate(EFFECTS):
            for j, (strength, ou) in enumerate((("middle", 0.0), ("half", 0.0), ("middle", 0.1), ("half", 0.1))):
                result.append(Job("one", effect, strength, ou, seed + 10 * i + j))
        for part in range(2):
            ou = (0.0, 0.1)[part]
            result += [Job("outside", e, "", ou, seed + 400 + 10 * part + k) for k, e in enumerate(OUTSIDE)]
        result += [Job("two", "+".join(e), "", 0.0, seed + 500 + k) for k, e in enumerate(TWO)]
    for j, ou in enumerate((0.0, 0.1, 0.2)):
        result += [Job("none", "none", "", ou, first + 500_000 + 1000 * j + k) for k in range(clean)]
    result += [
        Job("few", "none", "", (0.0, 0.1, 0.2)[k % 3], first + 600_000 + k, 4 + (k // 3) % 6) for k in range(few)
    ]
    return [result[i] for i in np.random.default_rng(first).permutation(len(result))]


def generated(job: Job) -> tuple[Any, Any]:
    """Return the trajectories of a set and their truth."""
    from idm_env.data import synthetic

    if job.kind == "two":
        effects = {e: synthetic.EFFECTS[e].middle for e in job.effect.split("+")}
        return synthetic.generate(job.seed, effect=effects)
    if job.kind != "outside":
        return synthetic.generate(
            job.seed, effect=job.effect, strength=job.strength or "middle", ou=job.ou, runs=job.runs
        )
    original = synthetic.Platoon
    synthetic.Platoon = outside(original, job.effect)  # type: ignore[attr-defined, assignment, misc]
    try:
        return synthetic.generate(job.seed, ou=job.ou)
    finally:
        synthetic.Platoon = original  # type: ignore[attr-defined]


def longer(kind: str, view: Any, drivers: Any) -> np.ndarray:
    """Return by which share the time gap is longer in a state of the driver: an effect that has no name."""
    closing = view.speed - view.lead_speed
    if kind == "closing":  # counts double above 2 m/s
        twice = np.maximum(closing - 2.0, 0.0) / (2.0 * np.sqrt(drivers.max_accel * drivers.comfort_decel))
        return np.asarray(twice / drivers.time_gap)
    near = 0.5 * np.exp(-(((view.gap - 15.0) / 6.0) ** 2))
    if kind == "gap":
        return np.asarray(near)
    return np.asarray(near * np.clip(view.speed / 10.0 if kind == "speed x gap" else 1.0 + closing, 0.0, 2.0))


def outside(base: type, kind: str) -> type:
    """Return a platoon whose drivers have an effect that the catalogue has no name for."""

    class Outside(base):  # type: ignore[misc,valid-type]
        def _rates(self, k: int, count: int, state: np.ndarray) -> np.ndarray:
            drivers, place, speed = self.drivers, state[0], state[1]
            time = (self.starts + k * self.step)[:, None]
            change = {}
            if kind == "time_gap over places":
                change["time_gap"] = drivers.time_gap * (1 + 0.6 * ((place > 700) & (place < 1000)))
            elif kind == "time_gap ramp":
                change["time_gap"] = drivers.time_gap * (1 + 0.6 * np.clip((time - 20) / 180, 0, 1))
            elif kind == "a and b step":
                factor = np.where(time > 100, 0.6, 1.0)
                change["max_accel"], change["comfort_decel"] = (
                    drivers.max_accel * factor,
                    drivers.comfort_decel * factor,
                )
            elif kind == "speed-dependent T":
                change["time_gap"] = drivers.time_gap * (1 + 0.5 * np.exp(-(((speed - 8) / 3) ** 2)))
            elif kind in IN_A_STATE:
                change["time_gap"] = drivers.time_gap * (1 + longer(kind, self._view(k, state), drivers))
            self.drivers = dataclasses.replace(drivers, **change)
            try:
                rates = super()._rates(k, count, state)
            finally:
                self.drivers = drivers
            if kind == "period":
                rates[1] += np.where(state[1] > 1.0, 0.35 * np.sin(2 * np.pi * time / 20.0), 0.0)
            if kind == "run":  # one run out of five brakes late
                late = (np.arange(len(place)) % 5 == 0)[:, None]
                rates[1] += np.where(late & (rates[1] < -0.3), 0.35 * np.abs(rates[1]), 0.0)
            return rates

    return Outside


def oracle(found: Any, truth: Any) -> float | None:
    """Return the gap RMSE (m) of the model that has the true effects at their true strengths, every run held out once.

    The drivers' own parameters are fitted as they are for the tool's models.
    """
    from idm_env.data import hidden
    from idm_env.discovery import crossed, model as terms

    model, values = terms.Hypothesis(), []
    for name, strength in truth.effects.items():
        if name in ("grade", "speed_profile"):
            place, count = found.records.signals[:, 18], 60
            first, distance = float(place.min()), float(np.ptp(place)) / (count - 1)
            term = terms.unknown_profile(name, first, distance, count, 0.0)
            profile = hidden.slope if name == "grade" else lambda x, by: hidden.dips(x, by) - 1.0
            values += profile(first + distance * np.arange(count), strength).tolist()
        elif name == "curve_speed":
            term = terms.given_profile(found.final.model.catalogue.by_name[name])
            model, values = terms.Hypothesis(model.terms, found.final.model.catalogue), [*values, strength]
        elif name == "speed_zone":
            term = terms.placed("speed_zone", strength, *hidden.ZONE_M)
            values += [strength, *hidden.ZONE_M]
        elif name == "regime_shift":
            term = terms.placed("regime_shift", strength, hidden.SHIFT_TIME_S)
            values += [strength, hidden.SHIFT_TIME_S]
        else:
            term = terms.simple(name)
            times = {
                "memory": [hidden.MEMORY_TIME_S], "relaxation": [hidden.RELAXATION_TIME_S],
                "leader_trend": [hidden.TREND_TIME_S],
            }  # fmt: skip
            values += [TRUE[name][1] * strength, *times.get(name, [])]
        model = model.adding(term)
    fold = crossed.folds_of(found.records.runs, (), 0)
    each = np.tile(values, (1 + int(fold.max()), 1))
    return float(crossed.crossed(found.records, model, each, fold).summary()["gap_rmse_m"])


def measure(job: Job, on_progress: object = None) -> dict[str, Any]:
    """Run the tool on one set and score what it says."""
    from idm_env.discovery import discover

    trajectories, truth = generated(job)
    begin = time.process_time()
    discovery = discover(trajectories, seed=job.seed)
    report = discovery.report
    names = [f["effect"] or f["label"] for f in report["found"]]
    row: dict[str, Any] = dataclasses.asdict(job) | {
        "key": job.key,
        "verdict": report["verdict"],
        "found": names,
        "named": [f["effect"] for f in report["found"] if f["effect"]],
        "equivalent": [f["equivalent"] for f in report["found"]],
        "cpu_s": time.process_time() - begin,
        "before": report["error"]["before"]["gap_rmse_m"],
        "after": report["error"]["after"]["gap_rmse_m"],
        "floor": report["error"]["floor"]["gap_rmse_m"],
        "ahead": report["error"]["before"]["horizon_rmse_m"],
        "ahead_floor": report["error"]["floor"]["horizon_rmse_m"],
        "oracle": oracle(discovery, truth) if truth.effects else None,
        "why": report["reason"],
        "best": next((c["effect"] for c in report["candidates"]), ""),
        "best_gain": next((c["held_out_gain"] for c in report["candidates"]), 0.0),
        "where": [f["where"] for f in report["found"]],
        "rounds": ranked(discovery.rounds),
    }
    if job.kind == "one" and names[:1] == [job.effect] and job.effect in TRUE:
        parameter, sign = TRUE[job.effect]
        got = report["found"][0]["parameters"][parameter]
        true = sign * truth.effects[job.effect]
        # A factor's strength is its distance from 1.
        null = 1.0 if parameter == "factor" else 0.0
        row["parameter_error"] = abs(got["estimate"] - true) / abs(true - null)
        row["covered"] = got["low"] <= true <= got["high"]
    return row


def right(row: dict[str, Any]) -> bool:
    """Tell whether the first name is the right one; delay and lag are one class.

    Where the true model itself gains less than 2 %, none and cannot_tell are right too.
    """
    if not row["found"]:
        faint = row["oracle"] is not None and row["oracle"] > 0.98 * row["before"]
        return bool(faint and row["verdict"] in ("none", "undecided", "cannot_tell"))
    first = row["found"][0]
    return first == row["effect"] or (first in RESPONSE and row["effect"] in RESPONSE)


def share(rows: list[Any]) -> str:
    return f"{100 * np.mean(rows):.0f} % of {len(rows)}" if rows else "–"


def shown(rows: list[dict[str, Any]]) -> str:
    """Return the table of results and the confusion matrix as text."""
    one = [r for r in rows if r["kind"] == "one"]
    groups = defaultdict(list)
    for r in one:
        groups[r["strength"], r["ou"]].append(r)
    clean = [r for r in groups["middle", 0.0] if r["found"] and right(r)]
    lines = ["criterion | result", "--- | ---"]
    for strength, ou, text in (
        ("middle", 0.0, "right name first, middle strength"), ("half", 0.0, "right name first, half strength"),
        ("middle", 0.1, "same, middle strength, OU 0.1"), ("half", 0.1, "same, half strength, OU 0.1"),
    ):  # fmt: skip
        named = [bool(r["found"]) and right(r) for r in groups[strength, ou]]
        lines.append(f"{text} | {share(named)} ({share([right(r) for r in groups[strength, ou]])} with faint ones)")
    for ou in (0.0, 0.1, 0.2):
        none = [
            bool(r["found"]) or r["verdict"] in ("shape", "located")
            for r in rows
            if r["kind"] == "none" and r["ou"] == ou
        ]
        lines.append(f"something found where nothing is, OU {ou:g} | {share(none)}")
    few = [bool(r["found"]) or r["verdict"] in ("shape", "located") for r in rows if r["kind"] == "few"]
    lines.append(f"something found where nothing is, 4 to 9 runs, OU 0 to 0.2 | {share(few)}")
    outside_rows = [r for r in rows if r["kind"] == "outside"]
    lines.append(f"catalogue name for an effect outside it | {share([bool(r['named']) for r in outside_rows])}")
    noticed = [r["verdict"] in ("shape", "located", "unexplained") for r in outside_rows]
    lines.append(f"an effect outside it is noticed | {share(noticed)}")
    unseen = [r["verdict"] == "none" and r["ahead"] > 3.0 * r["ahead_floor"] for r in rows if r["effect"] != "none"]
    lines.append(f"none over an effect and three times the sensors' noise | {share(unseen)}")
    both = [set(r["effect"].split("+")) <= set(r["named"]) for r in rows if r["kind"] == "two"]
    lines.append(f"two effects at once, both named | {share(both)}")
    if clean:
        lines.append(
            f"held-out gap RMSE after / before, median | {np.median([r['after'] / r['before'] for r in clean]):.3f}"
        )
        lines.append(f"held-out gap RMSE after / oracle, median | "
                     f"{np.median([r['after'] / r['oracle'] for r in clean]):.3f}")  # fmt: skip
        lines.append(f"held-out gap RMSE after / noise of measurement, median | "
                     f"{np.median([r['after'] / r['floor'] for r in clean]):.3f}")  # fmt: skip
    for ou in (0.0, 0.1):
        errors = [r["parameter_error"] for r in one if r["ou"] == ou and "parameter_error" in r]
        if errors:
            lines.append(f"parameter error, median, OU {ou:g} | {100 * np.median(errors):.1f} % of {len(errors)}")
    lines.append(f"95 % intervals cover the truth | {share([r['covered'] for r in one if 'covered' in r])}")
    edges = [
        abs(x - true)
        for r in one if r["effect"] == "speed_zone" and r["found"][:1] == ["speed_zone"]
        for x, true in zip(r["where"][0]["interval"], (800.0, 1500.0), strict=True)
    ]  # fmt: skip
    times = [abs(r["where"][0]["interval"][0] - 100.0) for r in one if r["found"][:1] == ["regime_shift"]]
    if edges:
        lines.append(f"place of a zone's edge, median error | {np.median(edges):.1f} m")
    if times:
        lines.append(f"time of a shift, median error | {np.median(times):.2f} s")
    lines.append(f"CPU seconds per set, median | {np.median([r['cpu_s'] for r in rows]):.1f}")
    lines += ["", "hidden | found (sets)", "--- | ---"]
    confusion: dict[str, Counter[str]] = defaultdict(Counter)
    for r in rows:
        label = r["effect"] if r["kind"] not in ("none", "few") else f"none, OU {r['ou']:g}"
        label += ", few runs" if r["kind"] == "few" else ""
        confusion[label]["+".join(r["found"]) or r["verdict"]] += 1
    for effect, counts in confusion.items():
        lines.append(f"{effect} | " + ", ".join(f"{name} {n}" for name, n in counts.most_common()))
    return "\n".join(lines)


def draw(folder: Path) -> None:
    """Draw what one discovery tried, who looks like whom, and gaps before and after."""
    from idm_env.data import synthetic
    from idm_env.discovery import discover, pictures

    discovery = discover(synthetic.generate(3, effect="brake_light", ou=0.05)[0])
    figures = {
        "ranking": pictures.ranking(discovery.rounds[0]), "look_alikes": pictures.look_alikes(discovery),
        "gaps": pictures.gaps(discovery),
    }  # fmt: skip
    for name, figure in figures.items():
        assert figure is not None
        figure.savefig(folder / f"discovery_{name}.png", dpi=90, bbox_inches="tight")


def main(
    sets: int = 1, clean: int = 6, few: int = 0, first_seed: int = 70_000, only: str = "",
    out: Path = Path("discovery_benchmark.jsonl"), pictures: Path | None = None, place: Workers = IN_PROCESSES,
) -> None:  # fmt: skip
    """Run the sets that are not there yet, and print the table.

    Args:
        sets: Sets of every kind with an effect.
        clean: Sets without an effect, of every kind of noise.
        few: Sets without an effect, of 4 to 9 runs.
        first_seed: Of the first set.
        only: Part of the keys of the sets to run, such as 'one|delay'.
        out: File of rows.
        pictures: Draw the pictures of the documents into this folder, no more.
        place: Where sets are worked on.
    """
    if pictures is not None:
        draw(pictures)
        return
    parts = {job.key: job for job in jobs(sets, clean, first_seed, few) if only in job.key}
    print(shown(rows_of(measure, parts, out, place, "key", lambda row: f"{row['verdict']} {row['found']}")))


if __name__ == "__main__":
    command(main)
