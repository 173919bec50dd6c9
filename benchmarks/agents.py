"""Agents side by side: equal searches, ten seeds of the best, held-out rings and drivers.

    python -m benchmarks.agents reference [--tests failsafe-shock follow] [--out runs/benchmark]
    python -m benchmarks.agents run [--only ring-ppo] [--trial 0] [--seeds 3] [--times 10] [--executor ray]
    python -m benchmarks.agents table [--out runs/benchmark]
    python -m benchmarks.agents picture [--out runs/benchmark]
    python -m benchmarks.agents takeover [--out runs/benchmark]
    python -m benchmarks.agents shocks [--only ring-brakes-distil]

``reference`` has what learns nothing, ``run`` the searches and the seeds of each best trial (or of the one that is
given, without a search). Every training is one process with one thread and one file of results; what is done is
skipped, what was interrupted goes on from its last checkpoint, what another process works on is left to it, so the
command may be interrupted, repeated, and started several times; ``--executor ray --ray-address HOST:PORT`` trains on a
cluster with shared storage. A training ends with its updates, so that a busy machine does not shorten it, or after 150
CPU seconds; ``--times 10`` gives it ten times as many of both, over which the learning rate falls. CPU seconds are
those of training; evaluations, every so many updates as the configuration says, are not counted.

Of the picture: for each task and agent the share of seeds that have not solved it yet, against the CPU seconds of
training (Kaplan and Meier 1958); a seed that never solves counts as long as it was trained. Of an agent's trials that
one is shown which solves most seeds, of equals the one with most of them, of these the one that solves soonest, or was
trained longest.
"""

from __future__ import annotations

import dataclasses
import fcntl
import json
import os
import shutil
import statistics
import subprocess
import sys
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

for variable in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "POLARS_MAX_THREADS"):
    os.environ.setdefault(variable, "1")

import matplotlib.pyplot as plt  # noqa: E402 (threads are set before numpy starts)
import numpy as np  # noqa: E402
import torch  # noqa: E402
from matplotlib.axes import Axes  # noqa: E402
from scipy.stats import CensoredData, ecdf  # noqa: E402

from agents import apg, common  # noqa: E402
from agents.classical import controllers  # noqa: E402
from agents.environments import task_of  # noqa: E402
from agents.evaluate import (  # noqa: E402
    as_judged,
    evaluate,
    evaluate_follow,
    evaluate_ring,
    held_out,
    mixed,
    score,
    solved_at,
)  # fmt: skip
from agents.imitation import default_data  # noqa: E402
from agents.policy import Policy  # noqa: E402
from agents.reference import (  # noqa: E402
    HIDDEN,
    RANDOM,
    alone,
    families,
    networks,
    passing,
    random_policies,
    singles,
    tried,
)  # fmt: skip
from agents.rollout import FRESH, LENGTHS, Act  # noqa: E402
from benchmarks import command, table  # noqa: E402
from idm_env.jobs.progress import OnProgress  # noqa: E402
from idm_env.jobs.storage import write_text  # noqa: E402
from idm_env.jobs.workers import HERE, Workers  # noqa: E402
from idm_env.model_file import read_yaml  # noqa: E402

ROOT = Path(__file__).resolve().parents[1]
LIMIT = 150.0
"""CPU seconds after which a training ends that has updates left."""
SHOCKS: dict[str, dict[str, Any]] = {
    "": {"shock": 0.0},
    "-shock": {"shock": 4.0, "shock_after": 120.0},
    "-two-shocks": {"shock": 5.0, "shock_after": [60.0, 120.0]},
    "-long": {"shock": 4.0, "shock_after": 120.0, "vehicles": 44, "length": [440.0, 540.0]},
}
"""What the human opposite does, by how the names of tests end: nothing, brake once, harder and twice, or once on a ring
of 44, where one vehicle has twice as many humans to calm."""
TESTS = (*(ring + shock for ring in ("failsafe", "brakes") for shock in SHOCKS), "follow")
"""Of the reference rows (``tests``)."""
SEARCH_SEEDS, SEEDS = (100, 101), tuple(range(10))
OUT = Path("runs/benchmark")

Options = dict[str, Any]
Row = dict[str, Any]
EVERY_STEP: Options = {
    "hold": 1, "count": 64, "n_steps": 300, "batch_size": 4800, "gamma": 0.999, "gae_lambda": 0.95,
    "no_anneal": True, "updates": 88,
}  # fmt: skip
"""PPO that decides every 0.1 s and learns the deviation of its actions."""
SEARCH: dict[str, list[Options]] = {
    "ring-apg": [
        {"learning_rate": 3e-3},
        {"learning_rate": 1e-3},
        {"learning_rate": 5e-3},
        {"learning_rate": 3e-3, "window": 300, "updates": 60},
        {"learning_rate": 3e-3, "count": 32, "updates": 44},
    ],
    "ring-ppo": [
        {**EVERY_STEP, "learning_rate": 1e-3},
        {**EVERY_STEP, "learning_rate": 3e-3},
        {},
        {"gae_lambda": 0.98},
        {"hold": 20, "n_steps": 50, "batch_size": 1600, "gamma": 0.98},
    ],
    "ring-sac": [
        {"learning_rate": 1e-3},
        {"learning_rate": 1e-3, "gamma": 0.99},
        {"learning_rate": 3e-4, "gamma": 0.999, "batch_size": 1024, "updates": 55},
        {"learning_rate": 1e-3, "count": 16, "n_steps": 400, "learning_starts": 1600, "updates": 24},
        {"learning_rate": 1e-3, "ent_coef": "0.002", "gradient_steps": 2, "updates": 48},
    ],
    "ring-shac": [{}],
    "ring-brakes-distil": [{}],
    "follow-apg": [{}],
    "follow-ppo": [{}],
    "follow-sac": [{}],
    "follow-shac": [{}],
}
"""Trials of each algorithm: five where searches are equal; what one does not name is as in its configuration file."""
MODULES = {
    "apg": "agents.apg",
    "ppo": "agents.ppo",
    "sac": "agents.ppo",
    "shac": "agents.shac",
    "distil": "agents.distil",
}


@dataclasses.dataclass(frozen=True)
class Job:
    """One training: a configuration, the number of its trial, what the trial changes, a seed, and how much longer."""

    config: str
    trial: int
    options: Options
    seed: int
    times: int = 1

    @property
    def name(self) -> str:
        """The folder of its results."""
        longer = f"x{self.times}" if self.times > 1 else ""
        return f"{self.config}/trial{self.trial}{longer}/seed{self.seed}"

    def command(self, out: Path) -> list[str]:
        """Return the command that trains."""
        module = MODULES[self.config.split("-")[-1]]
        words = [sys.executable, "-m", module, "--config", f"configs/{self.config}.yaml", "--seed", str(self.seed)]
        words += ["--out", str(out), "--cpu-seconds", str(LIMIT * self.times)]
        options = dict(self.options)
        teacher = out.parents[3] / f"ring-apg/trial0/seed{self.seed}/training/last.pt"
        # What was begun with a teacher of its own goes on with that.
        begun = (out / "teacher").exists()
        if module == MODULES["distil"] and not begun and (teacher.parents[1] / "result.json").exists():
            options["teacher"] = teacher
        if self.times > 1:
            settings = read_yaml(ROOT / "configs" / f"{self.config}.yaml")
            options["updates"] = self.times * options.get("updates", settings["updates"])
        for key, value in options.items():
            option = "--" + key.replace("_", "-")
            words += [option] if value is True else [option, str(value)]
        return words


@dataclasses.dataclass(frozen=True)
class Training:
    """A job, and the folder of all results: a part for an executor."""

    job: Job
    out: Path

    def __str__(self) -> str:
        return self.job.name


def once(folder: Path, make: Callable[[], dict[str, Any]]) -> dict[str, Any] | None:
    """Return the result of a folder, made now if it is not there; None where another process works on it."""
    result = folder / "result.json"
    folder.mkdir(parents=True, exist_ok=True)
    # The lock goes with its process: whatever was interrupted is begun again.
    with (folder / "lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return None
        if not result.exists():
            write_text(result, json.dumps(make(), indent=1))
    content: dict[str, Any] = json.loads(result.read_text())
    return content


def perform(job: Job, out: Path) -> dict[str, Any] | None:
    """Return the results of a job, trained now if they are not there; None where another process works on it."""
    training = out / job.name / "training"

    def make() -> dict[str, Any]:
        command = job.command(training)
        if (training / "last.pt").exists():
            command.append("--resume")
        else:
            shutil.rmtree(training, ignore_errors=True)
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
        row = {**dataclasses.asdict(job), **outcome(training, done, unseen=job.seed in SEEDS)}
        print(f"{job.name}: {json.dumps(row['summary'])}", flush=True)
        return row

    return once(out / job.name, make)


def outcome(training: Path, done: subprocess.CompletedProcess[str], unseen: bool) -> dict[str, Any]:
    """Return what a training came to: evaluations, last and best checkpoint, the last one on held-out traffic too."""
    if not (training / "last.pt").exists() or not (training / "best.pt").exists():
        summary = {"solved": False, "ever": False, "first": None, "spent": 0.0, "error": True}
        return {"error": done.stderr[-2000:], "history": [], "summary": summary}
    policy, content = common.load(training / "last.pt")
    best, at_best = common.load(training / "best.pt")
    environment = as_judged(content["environment"], content["training"]["arguments"]["judged_in"])
    history = content["training"]["history"]
    # The first evaluation is of the policy before any update: it solves nothing, whatever it passes.
    untrained, history = history[0], history[1:]
    # What ended before its time has solved nothing.
    first = solved_at(history) if done.returncode == 0 else None
    # A last policy must pass on fresh draws too.
    fresh = evaluate(policy, environment, draws=FRESH)
    if not fresh["passed"]:
        first = None
    summary = {
        "solved": first is not None,
        "cpu_seconds": None if first is None else history[first]["cpu_seconds"],
        "steps": None if first is None else history[first]["steps"],
        "ever": any(row["passed"] for row in history),
        "first": next((row["cpu_seconds"] for row in history if row["passed"]), None),
        "untrained": untrained["passed"],
        "spent": history[-1]["cpu_seconds"] if history else 0.0,
        "error": done.returncode != 0,
    }
    result = {
        "error": done.stderr[-2000:] if done.returncode else "",
        "summary": summary,
        "untrained": untrained,
        "history": history,
        "last": history[-1],
        "best": at_best["training"]["history"][-1],
        "fresh_last": fresh,
    }
    if unseen:
        result["fresh_best"] = evaluate(best, environment, draws=FRESH)
    if unseen and content["task"] == "ring":
        result["held_out"] = held_out(policy, environment)
    return result


def train(part: Training, on_progress: OnProgress) -> None:
    """Do what is missing of a job; its result is a file."""
    perform(part.job, part.out)


def trials(config: str) -> list[Job]:
    """Return the jobs of a search; none where there is nothing to choose from."""
    if len(SEARCH[config]) == 1:
        return []
    return [Job(config, trial, options, seed) for trial, options in enumerate(SEARCH[config]) for seed in SEARCH_SEEDS]


def chosen(config: str, out: Path) -> tuple[int, list[dict[str, Any]]]:
    """Return the best trial of a search (-1 while it is not finished) and the results of all its runs.

    The best has most seeds solved, then the highest mean score of the last evaluation.
    """
    jobs = trials(config)
    results_of_jobs = [perform(job, out) for job in jobs]
    done = [row for row in results_of_jobs if row is not None]
    if len(done) < len(results_of_jobs):
        return -1, done
    ranks: list[tuple[int, float]] = []
    for trial in range(len(SEARCH[config])):
        rows = [row for job, row in zip(jobs, done, strict=True) if job.trial == trial]
        ends = [score(row["last"]) if row["history"] else -1e9 for row in rows]
        ranks.append((sum(row["summary"]["solved"] for row in rows), sum(ends) / max(len(ends), 1)))
    return ranks.index(max(ranks)), done


def run(
    only: Sequence[str] = tuple(SEARCH), out: Path = OUT, seeds: int = len(SEEDS), trial: int | None = None,
    times: int = 1, place: Workers = HERE,
) -> None:  # fmt: skip
    """Do every search, and train the first seeds of its best trial.

    Args:
        only: Configurations, such as ring-ppo.
        out: Folder of all results.
        seeds: Train no more seeds than that.
        trial: Train the seeds of this trial, without a search.
        times: Train the seeds for so many times the updates; searches are not longer.
        place: Where trainings run.
    """
    out = out.resolve()
    searched = [job for config in only for job in trials(config)] if trial is None else []
    with place.opened() as executor:
        deque(executor.map(train, [Training(job, out) for job in searched]), 0)
        jobs = []
        for config in only:
            best = chosen(config, out)[0] if trial is None else trial
            if best < 0:
                print(f"{config}: another process is still searching.")
                continue
            jobs += [Job(config, best, SEARCH[config][best], s, times) for s in SEEDS[:seeds]]
        deque(executor.map(train, [Training(job, out) for job in jobs]), 0)


def results(out: Path, config: str) -> list[Row]:
    """Return every result of a configuration, by trial, length of training and seed."""
    rows = [json.loads(path.read_text()) for path in (out / config).glob("trial*/seed*/result.json")]
    return sorted(rows, key=lambda r: (r["trial"], r.get("times", 1), r["seed"]))


def groups(out: Path, config: str, seeds: Sequence[int]) -> dict[str, list[Row]]:
    """Return the results of a configuration's seeds, by what was trained for how long."""
    by_name: dict[str, list[Row]] = {}
    for r in results(out, config):
        if r["seed"] in seeds:
            times = r.get("times", 1)
            by_name.setdefault(f"{r['trial']}" + (f", {times} times" if times > 1 else ""), []).append(r)
    return by_name


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
        results_of_seeds = [r for r in results(out, config) if r["seed"] in seeds]
        for trial in sorted({r["trial"] for r in results_of_seeds}):
            part = [r for r in results_of_seeds if r["trial"] == trial]
            ends = ["/".join(ring(r["last"])[:2]) for r in part if r["history"]]
            options = ", ".join(f"{k} {v}" for k, v in part[0]["options"].items())
            rows.append([config, str(trial), options, f"{solved(part)} of {len(part)}", ", ".join(ends)])
    print("\n" + table(("agent", "trial", "what it changes", "solved", "last ratio/std of each seed"), rows))


def solved(rows: Sequence[Row]) -> int:
    """Return how many are solved."""
    return sum(r["summary"]["solved"] for r in rows)


def summary_table(out: Path, configs: Sequence[str], seeds: Sequence[int]) -> None:
    """Print one row per agent: how many of its seeds solved the test, and how soon.

    Vehicle-steps are steps of environments times the vehicles in one.
    """
    rows = []
    for config, name, part in ((c, n, p) for c in configs for n, p in groups(out, c, seeds).items()):
        done = [r["summary"] for r in part if r["summary"]["solved"]]
        vehicles = task_of(environment_of(f"{config.split('-')[0]}-apg")).vehicles
        passed = [r["summary"]["first"] for r in part if r["summary"]["first"] is not None]
        rows.append([
            config, name, f"{len(done)} of {len(part)}", str(len(passed)), spread(passed, ".1f"),
            spread([r["summary"]["spent"] for r in part if r["history"]], ".0f"),
            spread([d["cpu_seconds"] for d in done], ".1f"), spread([d["steps"] / 1000 for d in done], ".0f"),
            spread([d["steps"] * vehicles / 1e6 for d in done], ".1f"),
        ])  # fmt: skip
    print("\n" + table(
        ("agent", "trial", "solved", "ever passed", "CPU s to first pass", "CPU s trained", "CPU s to solved",
         "1000 steps to solved", "million vehicle-steps to solved"), rows
    ))  # fmt: skip


def median_ratio(theirs: Sequence[float], ours: Sequence[float], draws: int = 10_000) -> tuple[float, float, float]:
    """Return the ratio of two medians and its 95 % interval: percentiles of a bootstrap over seeds.

    Seeds that never solve are infinite: later than all others, whenever that would be.
    """
    generator = np.random.default_rng(0)
    medians = [np.median(generator.choice(x, (draws, len(x))), axis=1) for x in (theirs, ours)]
    with np.errstate(invalid="ignore"):  # infinite over infinite says nothing
        low, high = np.nanquantile(medians[0] / medians[1], (0.025, 0.975), method="nearest")
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
            words = f"\n{theirs} ({name}) / {ours}, {what} to solved: "
            if a and np.isfinite([np.median(a), np.median(b)]).all():
                words += "{:.2f} ({:.2f}–{:.2f})".format(*median_ratio(b, a))
            else:
                words += "no ratio"
            print(
                f"{words}; {int(np.isfinite(b).sum())} of {len(b)} and {int(np.isfinite(a).sum())} of {len(a)} solved",
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
    print("\n" + table(
        ("agent", "trial", "seed", "before any update", "CPU s", "1000 steps", f"last: {figures}", f"best: {figures}",
         "lengths 200–300 m", "drivers ±20 %, worst", "drivers mixed"), rows,
    ))  # fmt: skip


def checkpoints(out: Path, config: str, seeds: int) -> list[Path]:
    """Return the last checkpoints of a configuration's first seeds."""
    return [p for seed in SEEDS[:seeds] for p in sorted((out / config).glob(f"trial*/seed{seed}/training/last.pt"))]


RINGS, FOLLOWERS = (tuple(c for c in SEARCH if c.startswith(task)) for task in ("ring", "follow"))


def takeover(only: Sequence[str] = RINGS, out: Path = OUT, seeds: int = len(SEEDS)) -> None:
    """Print where the last checkpoints touch somebody, taking over in other traffic, without and with a failsafe.

    A case is: rings with a collision of all rings, and the medians over seeds of worst speed ratio and deviation.
    """
    rows, environment, draws = [], environment_of("ring-apg"), (1,)
    # A controller with memory drives one batch once, so it is made anew for every case.
    by_hand = controllers(environment, LENGTHS, draws)
    policies: dict[str, list[Any]] = {name: [by_hand[name]] for name in ("no command", "PI with saturation")}
    for config in only:
        policies[config] = [lambda path=path: common.load(path)[0] for path in checkpoints(out, config, seeds)]
    for name, makers in policies.items():
        for failsafe in (0.0, 3.0):
            own = {**environment, "failsafe": failsafe}
            figures = []
            for case, warmup in ((own, 750), (own, 1750), (own, 3000), (mixed(own), 3000)):
                judgements = [evaluate_ring(make(), case, warmup=warmup, draws=draws) for make in makers]
                touched, rings = sum(r["collisions"] for r in judgements), sum(len(r["ratios"]) for r in judgements)
                ratio, std = (statistics.median(r[k] for r in judgements) for k in ("speed_ratio", "speed_std"))
                figures.append(f"{touched} of {rings} / {ratio:.3f} / {std:.2f}")
            rows.append([name, str(len(makers)), f"{failsafe:g} m/s²" if failsafe else "none", *figures])
    print("\n" + table(
        ("agent", "seeds", "failsafe", "after 75 s (Flow's)", "after 175 s", "after 300 s (the test)",
         "after 300 s, drivers mixed"), rows,
    ))  # fmt: skip


def shocks(only: Sequence[str] = RINGS, out: Path = OUT, seeds: int = len(SEEDS)) -> None:
    """Print what the last checkpoints do on the thirty fresh rings of their test, by its shocks."""
    rows = []
    for config in only:
        for path in checkpoints(out, config, seeds):
            policy, content = common.load(path)
            test = as_judged(content["environment"], content["training"]["arguments"]["judged_in"])
            judgements = [evaluate(policy, {**test, **shock}, draws=FRESH) for shock in SHOCKS.values()]
            figures = ["/".join(ring(x)) + (", passes" if x["passed"] else "") for x in judgements]
            rows.append([config, *path.parts[-4:-2], *figures])
    print("\n" + table(("agent", "trial", "seed", *(name or "no shock" for name in SHOCKS)), rows))


def environment_of(config: str) -> Row:
    """Return the environment of one of APG's configurations; the other agents of a task have the same."""
    return common.load_agent(ROOT / "configs" / f"{config}.yaml", apg.Arguments, "apg").environment


def follow_table(out: Path, configs: Sequence[str], leader: Path | None) -> None:
    """Print fuel and energy behind the made-up leader and, where there are, measured ones."""
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
            for path in checkpoints(out, config, len(SEEDS)):
                seed = path.parents[1].name.removeprefix("seed")
                rows.append([name, config, seed, *follow(evaluate_follow(common.load(path)[0], environment))])
    print("\n" + table(
        ("leader", "vehicle", "seed", "reward per step", "L/100 km", "L/100 km with those behind", "energy (J/kg/m)",
         "smallest time gap (s)", "collisions"), [r + [""] * (9 - len(r)) for r in rows],
    ))  # fmt: skip


def follow(r: Row) -> list[str]:
    """Return the figures of one policy in task follow."""
    return [
        f"{r['reward']:.3f}", f"{r['litres']:.2f}", f"{r['litres_behind']:.2f}", f"{r['energy']:.3f}",
        f"{r['time_gap']:.2f}", str(r["collisions"]),
    ]  # fmt: skip


def tables(out: Path = OUT) -> None:
    """Print everything that there are results for."""
    search_table(out, [c for c, trials in SEARCH.items() if len(trials) > 1], SEARCH_SEEDS)
    for task, configs in (("ring", RINGS), ("follow", FOLLOWERS)):
        summary_table(out, configs, SEEDS)
        for other in ("shac", "ppo", "sac"):
            ratio_line(out, f"{task}-apg", f"{task}-{other}", SEEDS)
    seed_table(out, RINGS, SEEDS)
    follow_table(out, FOLLOWERS, default_data())


UNTRAINED = range(8)
"""Seeds of policies before any update, and after one."""
MOST = 0.05
"""Share of the random policies above which a task is no test."""


def environments() -> dict[str, Row]:
    """Return the environments by name: rings behind a failsafe or with real brakes, with a shock or without; follow."""
    guarded = environment_of("ring-apg")
    free = {**guarded, "failsafe": 0.0, "max_command": [-4.5, 2.6]}
    rings = {"failsafe": guarded, "brakes": free}
    by_name = {ring + name: {**own, **shock} for ring, own in rings.items() for name, shock in SHOCKS.items()}
    return {**by_name, "follow": environment_of("follow-apg")}


def begun(environment: Row, folder: Path, updates: int) -> list[Policy]:
    """Return the policies of APG's configuration for this task before any update, or after one."""
    policies: list[Policy] = []
    for seed in UNTRAINED:
        arguments = common.load_agent(ROOT / "configs" / f"{environment['task']}-apg.yaml", apg.Arguments, "apg")
        arguments.environment, arguments.seed, arguments.updates = environment, seed, 1
        arguments.out = folder / f"seed{seed}"
        torch.manual_seed(seed)
        if updates:
            if not (arguments.out / "last.pt").exists():
                apg.train(arguments)
            policies.append(common.load(arguments.out / "last.pt")[0])
        else:
            policies.append(common.begin(arguments, "apg")[0])
    return policies


BEGUN = {"APG before any update": 0, "APG after one update": 1}
UNTRAINED_NAMES = [f"seed {seed}" for seed in UNTRAINED]


def on_ring(environment: Row, folder: Path) -> dict[str, Callable[[], Row]]:
    """Return what makes each row of a ring, by name."""
    makers: dict[str, Callable[[], Row]] = {
        name: lambda make=make: alone(make, environment) for name, make in singles(environment).items()
    }
    for name, family in families(environment).items():
        makers[name] = lambda family=family: tried(family(), environment)
    # Trained on the ring without a shock, as agents are.
    training = {**{k: v for k, v in environment.items() if not k.startswith("shock")}, "shock": 0.0}
    for name, updates in BEGUN.items():
        makers[name] = lambda updates=updates: tried(
            networks(begun(training, folder, updates), UNTRAINED_NAMES), environment
        )
    return makers


def behind_leader(environment: Row, folder: Path) -> dict[str, Callable[[], Row]]:
    """Return what makes each row behind a recorded leader, by name. Policies begin as clones of IDM there."""

    def judged(acts: Sequence[Act | None], names: Sequence[str] = ()) -> Row:
        names = names or [str(i) for i in range(len(acts))]
        return passing(names, lambda draws, some: [evaluate_follow(acts[i], environment, draws=draws) for i in some])

    makers: dict[str, Callable[[], Row]] = {"IDM (a human driver more)": lambda: judged([None], [""])}
    for name, hidden in zip(RANDOM, HIDDEN, strict=True):
        makers[name] = lambda hidden=hidden: judged(random_policies(environment, 200, hidden))
    for name, updates in BEGUN.items():
        makers[name] = lambda updates=updates: judged(begun(environment, folder, updates), UNTRAINED_NAMES)

    def always(action: float) -> Act:
        return lambda observation: observation.new_full((len(observation), 1), action)

    actions = [round(0.1 * i - 1.0, 1) for i in range(21)]
    makers["constants"] = lambda: judged([always(x) for x in actions], [f"{x:g} of the range" for x in actions])
    return makers


def reference(tests: Sequence[Literal[TESTS]] = TESTS, out: Path = OUT) -> None:
    """Drive what learns nothing where that is not done yet, and print the table.

    Args:
        tests: By the names of their environments.
        out: Folder of all results.
    """
    out = out.resolve()
    columns: dict[str, dict[str, Row | None]] = {}
    for name in tests:
        environment, folder = environments()[name], out / "reference" / name
        columns[name] = {}
        # With and without a shock policies are trained alike.
        trained = out / "reference" / name.split("-")[0]
        makers = on_ring if environment["task"] == "ring" else behind_leader
        for i, (row, make) in enumerate(makers(environment, trained / "one_update").items()):
            print(f"{name}: {row}", flush=True)
            columns[name][row] = once(folder / f"row{i}", lambda make=make, row=row: {"row": row, **make()})
    every = dict.fromkeys(row for column in columns.values() for row in column)
    rows = [[row, *(told(columns[n][row]) if row in columns[n] else "" for n in tests)] for row in every]
    print(
        "\n"
        + table(
            ("passed of tried; the best: ratio/std/time gap/collisions, of follow reward/time gap/collisions", *tests),
            rows,
        )
    )
    for name in tests:
        cells = [columns[name][row] for row in RANDOM]
        done = [r for r in cells if r is not None]
        if len(done) == len(cells):
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


AGENTS = {"apg": "#1e5adc", "shac": "#1a7850", "ppo": "#b2182b", "sac": "#ef8a62"}
TASKS = {"ring": "ring with a shock", "follow": "behind a recorded leader"}


def shown(out: Path, config: str, seeds: Sequence[int]) -> list[Row]:
    """Return the results, without failures, of the trial that is shown."""
    parts = [[r for r in part if r["history"]] for part in groups(out, config, seeds).values()]

    def rank(part: Sequence[Row]) -> tuple[int, int, float]:
        summaries = [r["summary"] for r in part]
        took = [s["cpu_seconds"] for s in summaries if s["solved"]]
        spent = max((s["spent"] for s in summaries), default=0.0)
        return len(took), len(part), -statistics.median(took) if took else spent

    return max(parts, key=rank, default=[])


def curve(axes: Axes, rows: Sequence[Row], name: str, colour: str) -> None:
    """Draw the share of seeds that are not solved yet."""
    summaries = [r["summary"] for r in rows]
    solved = [s["cpu_seconds"] for s in summaries if s["solved"]]
    spent = [s["spent"] for s in summaries if not s["solved"]]
    left = ecdf(CensoredData(uncensored=solved, right=spent)).sf
    x, y = [1.0, *left.quantiles], [1.0, *left.probabilities]
    axes.step(x, y, where="post", color=colour, label=f"{name}: {len(solved)} of {len(rows)} seeds")
    axes.plot(spent, left.evaluate(spent), "|", color=colour, markersize=10)


def picture(
    out: Path = OUT, path: Path = ROOT / "studies" / "2026-11-26-agents-measured" / "agents_survival.png"
) -> None:
    """Draw the picture, a panel per task."""
    figure, panels = plt.subplots(1, len(TASKS), figsize=(10, 3.6), sharey=True, layout="constrained")
    for axes, (task, title) in zip(panels, TASKS.items(), strict=True):
        for agent, colour in AGENTS.items():
            rows = shown(out, f"{task}-{agent}", SEEDS)
            if rows:
                curve(axes, rows, agent.upper(), colour)
        axes.set(title=title, xscale="log", xlabel="CPU seconds of training", ylim=(-0.03, 1.4))
        axes.set_yticks([0.0, 0.2, 0.4, 0.6, 0.8, 1.0])
        axes.legend(frameon=False, loc="upper left")  # above all curves
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel("share of seeds not solved yet")
    figure.savefig(path, dpi=110)
    print(path)


main = {
    "reference": reference, "run": run, "table": tables, "picture": picture, "takeover": takeover, "shocks": shocks,
}  # fmt: skip

if __name__ == "__main__":
    command(main)
