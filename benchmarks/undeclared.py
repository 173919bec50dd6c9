"""What discovery says of effects that its catalogue lacks, and of sets in which nothing is missing.

    python -m benchmarks.undeclared --sets 2 --clean 3 --out undeclared.jsonl [--executor processes]

Ten kinds, six of which act through the past or through who stands behind, without drivers' noise and with 0.1 m/s² of
it; clean sets are without noise, with two amounts of it, with a time gap that wanders, and with noise that grows with
speed. Generators share nothing with the simulator. One line of JSON per set is kept, so that a run goes on.
"""

from __future__ import annotations

import dataclasses
import os
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

for variable in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "POLARS_MAX_THREADS"):
    os.environ.setdefault(variable, "1")

import numpy as np  # noqa: E402 (threads are set before numpy starts)

from benchmarks import command, ranked, rows_of, table  # noqa: E402
from idm_env.jobs.workers import IN_PROCESSES, Workers  # noqa: E402

KINDS: dict[str, tuple[str, ...]] = {
    "after a stop": ("time_since_stop",),
    "after hard braking": ("braking_15s", "lead_braking_15s"),
    "mean speed of 90 s": ("mean_speed_90s", "mean_speed_20s", "speed"),
    "leader of 3 s ago": ("lead_change_3s", "lead_trend"),
    "acceleration limited in its rate": ("own_accel",),
    "follower close behind": ("gap_behind", "headway_behind"),
    "desired speed with the clock": ("time", "period"),
    "T longer near 8 m/s": ("speed",),
    "closing counts twice": ("closing_speed",),
    "T longer near 15 m": ("gap", "relative_gap"),
}
"""Kinds by the coordinates over which each may rightly be told."""
CLEAN = {"OU 0": 0.0, "OU 0.1": 0.1, "OU 0.2": 0.2, "wander": 0.0, "noise by speed": 0.0}
"""Sets without an effect, by their drivers' noise (m/s²)."""
STOP_S, SHY_S, LONG_S, AGO_S, CYCLE_S = 40.0, 15.0, 90.0, 3.0, 120.0
JERK = 0.4
"""Rise of the acceleration (m/s³) at most."""


@dataclasses.dataclass(frozen=True)
class Job:
    """One set: what is hidden in it, and its drivers' noise (m/s²)."""

    kind: str
    ou: float
    seed: int

    @property
    def key(self) -> str:
        """What the set is called in the file of results."""
        return f"{self.kind}|{self.ou}|{self.seed}"


def platoon_with(base: type, kind: str, seed: int) -> type:
    """Return a platoon whose drivers have an effect of a ``kind``, through a memory of their own where it has one."""

    class Undeclared(base):  # type: ignore[misc,valid-type]
        def run(self) -> Any:
            shape = self.drivers.time_gap.shape
            self.since, self.hardest, self.level = np.full(shape, 1e3), np.zeros(shape), np.zeros(shape)
            self.leads = np.full((round(AGO_S / self.step) + 1, *shape), np.nan)
            random = np.random.default_rng(seed)
            if kind == "wander":
                keep = np.exp(-self.step / 20.0)
                steps = np.sqrt(1.0 - keep**2) * random.standard_normal((len(self.leader.position), *shape))
                for k in range(1, len(steps)):
                    steps[k] += keep * steps[k - 1]
                self.wandering = np.exp(0.12 * steps)
            if kind == "noise by speed":
                from idm_env.data import scripted

                size = (len(self.leader.position), *shape)
                self.noise = scripted.ornstein_uhlenbeck(random, size, 0.2, 5.0, self.step)
            self.level = np.broadcast_to(self.leader.speed[0][:, None], shape).copy()
            return super().run()

        def _recall(self, k: int, view: Any) -> None:
            """Take one step of what drivers remember."""
            self.since = np.where(view.speed < 0.5, 0.0, self.since + self.step)
            self.hardest = np.maximum(-self._held, self.hardest * np.exp(-self.step / SHY_S))
            self.level = self.level + (view.speed - self.level) * self.step / LONG_S
            self.leads[k % len(self.leads)] = view.lead_speed

        def _rates(self, k: int, last: int, state: np.ndarray) -> np.ndarray:
            drivers, view, noise = self.drivers, self._view(k, state), self.noise
            if k == last:
                self._recall(k, view)
            near = lambda x, middle, wide: np.exp(-(((x - middle) / wide) ** 2))  # noqa: E731
            longer = {
                "after a stop": lambda: 0.8 * np.exp(-self.since / STOP_S),
                "after hard braking": lambda: 0.6 * np.clip(self.hardest / 2.0, 0.0, 1.5),
                "mean speed of 90 s": lambda: np.clip(1.0 - self.level / 12.0, -0.6, 0.8),
                "follower close behind": lambda: -0.5 * np.nan_to_num(near(view.gap_behind, 5.0, 10.0)),
                "T longer near 8 m/s": lambda: 0.5 * near(view.speed, 8.0, 3.0),
                "closing counts twice": lambda: (
                    np.maximum(view.speed - view.lead_speed - 2.0, 0.0)
                    / (2.0 * drivers.time_gap * np.sqrt(drivers.max_accel * drivers.comfort_decel))
                ),
                "T longer near 15 m": lambda: 0.5 * near(view.gap, 15.0, 6.0),
                "wander": lambda: self.wandering[last] - 1.0,
            }.get(kind, lambda: 0.0)()
            desired = drivers.desired_speed
            if kind == "desired speed with the clock":
                time_s = (self.starts + k * self.step)[:, None]
                desired = desired * (0.75 + 0.25 * np.cos(2.0 * np.pi * time_s / CYCLE_S))
            self.drivers = dataclasses.replace(
                drivers, time_gap=drivers.time_gap * (1.0 + longer), desired_speed=desired
            )
            if kind == "noise by speed":
                self.noise = noise * (np.maximum(view.speed, 0.0) / 15.0)[None]
            try:
                rates = super()._rates(k, last, state)
            finally:
                self.drivers, self.noise = drivers, noise
            if kind == "leader of 3 s ago":
                late = np.nan_to_num(self.leads[(k + 1) % len(self.leads)] - view.lead_speed)
                rates[1] += np.where(view.speed > 1.0, np.clip(0.1 * late, -0.3, 0.3), 0.0)
            if kind == "acceleration limited in its rate":
                rates[1] = np.minimum(rates[1], self._held + JERK * self.step)
            return rates

    return Undeclared


def generated(job: Job) -> Any:
    """Return the trajectories of a set."""
    from idm_env.data import synthetic

    original = synthetic.Platoon
    synthetic.Platoon = platoon_with(original, job.kind, job.seed)  # type: ignore[attr-defined, assignment, misc]
    try:
        return synthetic.generate(job.seed, ou=job.ou)[0]
    finally:
        synthetic.Platoon = original  # type: ignore[attr-defined]


def left_by_noise(job: Job) -> dict[str, float]:
    """Return IDM's errors on the same drivers, with their noise and no effect.

    A right model leaves about as much of the set with its effect.
    """
    from idm_env.discovery import crossed
    from idm_env.discovery.discover import prepare
    from idm_env.discovery.model import Hypothesis

    records = prepare(generated(dataclasses.replace(job, kind="none")), "driver")
    fold = crossed.folds_of(records.runs, (), job.seed)
    return crossed.crossed(records, Hypothesis(), np.zeros((int(fold.max()) + 1, 0)), fold).summary()


def measure(job: Job, on_progress: object = None) -> dict[str, Any]:
    """Return what the tool says of one set."""
    from idm_env.discovery import discover

    trajectories, begin = generated(job), time.process_time()
    discovery = discover(trajectories, seed=job.seed)
    report = discovery.report
    spent = time.process_time() - begin  # of the tool: what noise alone leaves is worked out below
    before, after, floor = (report["error"][name] for name in ("before", "after", "floor"))
    return dataclasses.asdict(job) | {
        "key": job.key,
        "verdict": report["verdict"],
        "why": report["reason"],
        "sentence": report["sentence"],
        "found": [f["effect"] or f["label"] for f in report["found"]],
        "named": [f["effect"] for f in report["found"] if f["effect"]],
        "over": [f["where"]["coordinate"] for f in report["found"]],
        "before": before["gap_rmse_m"],
        "after": after["gap_rmse_m"],
        "ahead_after": after["horizon_rmse_m"],
        "noise": left_by_noise(job) if job.kind in KINDS else before,
        "ahead": before["horizon_rmse_m"],
        "ahead_floor": floor["horizon_rmse_m"],
        "excluded": [_holds(e) for e in report["excluded"]],
        "cpu_s": spent,
        "rounds": ranked(discovery.rounds),
    }


def _holds(excluded: dict[str, Any]) -> bool:
    """Tell whether the interval of an effect's strength holds its null: where nothing is missing, it must."""
    from idm_env.effects import make

    null = next(p.null for p in make(excluded["effect"]).parameters if p.name == excluded["parameter"])
    return bool(excluded["low"] <= (null or 0.0) <= excluded["high"])


def over_its_own(row: dict[str, Any]) -> bool:
    """Tell whether what was found stands over a coordinate through which the effect acts."""
    return row["verdict"] == "shape" and set(row["over"]) <= set(KINDS[row["kind"]])


def shown(rows: list[dict[str, Any]]) -> str:
    """Return both tables: by kind of effect, and of clean sets."""

    def share(answers: list[bool]) -> str:
        return f"{sum(answers)} of {len(answers)}" if answers else "–"

    by_kind = defaultdict(list)
    for row in rows:
        by_kind[row["kind"], row["ou"]].append(row)
    lines = []
    for kind in KINDS:
        for ou in (0.0, 0.1):
            sets = by_kind[kind, ou]
            own = [
                (r["after"] / r["before"], r["noise"]["gap_rmse_m"] / r["before"],
                 r["ahead_after"] / r["ahead"], r["noise"]["horizon_rmse_m"] / r["ahead"])
                for r in sets if over_its_own(r)
            ]  # fmt: skip
            lines.append([
                kind, f"{ou:g}", share([r["verdict"] in ("shape", "unexplained") for r in sets]),
                share([over_its_own(r) for r in sets]),
                *("{:.2f} ({:.2f})|{:.2f} ({:.2f})".format(*np.median(own, axis=0)) if own else "–|–").split("|"),
                share([bool(r["named"]) for r in sets]),
                share([r["verdict"] == "located" for r in sets]), share([r["verdict"] == "undecided" for r in sets]),
                share([r["verdict"] == "none" for r in sets]),
                f"{np.median([r['cpu_s'] for r in sets]):.0f}" if sets else "–",
            ])  # fmt: skip
    head = ("kind", "OU", "noticed", "over its coordinate", "gap after / before there (noise alone)",
            "5 s ahead (noise alone)", "catalogue name", "located", "undecided", "none", "CPU s")  # fmt: skip
    clean = [
        [
            kind, share([bool(r["found"]) or r["verdict"] in ("shape", "located") for r in sets]),
            share([r["verdict"] == "unexplained" for r in sets]), share([r["verdict"] == "undecided" for r in sets]),
            share([r["verdict"] == "none" and r["ahead"] > 3.0 * r["ahead_floor"] for r in sets]),
            share([holds for r in sets for holds in r["excluded"]]),
            f"{np.median([r['cpu_s'] for r in sets]):.0f}" if sets else "–",
        ]
        for kind, sets in ((kind, by_kind[kind, ou]) for kind, ou in CLEAN.items())
    ]  # fmt: skip
    names = ("clean", "found", "unexplained", "undecided", "none over 3 × sensors", "strengths excluded rightly",
             "CPU s")  # fmt: skip
    return f"{table(head, lines)}\n\n{table(names, clean)}"


def main(
    sets: int = 1, clean: int = 2, first_seed: int = 390_000, only: str = "",
    out: Path = Path("undeclared.jsonl"), place: Workers = IN_PROCESSES,
) -> None:  # fmt: skip
    """Run the sets that are not there yet, and print the tables.

    Args:
        sets: Sets of every kind and noise.
        clean: Sets without an effect of every noise.
        first_seed: Of the first set.
        only: Part of the keys of the sets to run.
        out: File of rows.
        place: Where sets are worked on.
    """
    hidden = [
        Job(kind, ou, first_seed + 100 * n + 10 * i + j)
        for n in range(sets) for i, kind in enumerate(KINDS) for j, ou in enumerate((0.0, 0.1))
    ]  # fmt: skip
    nothing = [
        Job(kind, ou, first_seed + 50_000 + 100 * i + n) for i, (kind, ou) in enumerate(CLEAN.items())
        for n in range(clean)
    ]  # fmt: skip
    jobs = [*hidden, *nothing]
    order = np.random.default_rng(first_seed).permutation(len(jobs))
    parts = {jobs[i].key: jobs[i] for i in order if only in jobs[i].key}
    print(shown(rows_of(measure, parts, out, place, "key", lambda row: f"{row['verdict']} {row['found']}")))


if __name__ == "__main__":
    command(main)
