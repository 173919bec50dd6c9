"""Agents side by side: equal searches, ten seeds of the best, held-out rings and drivers.

    python benchmarks/agents.py reference [--tests failsafe-shock follow] [--out runs/benchmark]
    python benchmarks/agents.py run [--only ring-ppo] [--trial 0] [--seeds 3] [--times 10] [--executor ray]
    python benchmarks/agents.py table [--out runs/benchmark]
    python benchmarks/agents.py picture [--out runs/benchmark]
    python benchmarks/agents.py takeover [--out runs/benchmark]
    python benchmarks/agents.py unshocked [--only ring-brakes-distil]

``reference`` has what learns nothing, ``run`` the searches and the seeds of each best trial (or of the one that is
given, without a search). Every training is one process with one thread and one file of results; what is done is
skipped, what was interrupted goes on from its last checkpoint, what another process works on is left to it, so the
command may be interrupted, repeated, and started several times; ``--executor ray --ray-address HOST:PORT`` trains on a
cluster with shared storage. A training ends with its updates, so that a busy machine does not shorten it, or after 150
CPU seconds; ``--times 10`` gives it ten times as many of both, over which the learning rate falls. CPU seconds are
those of training; evaluations every 3 s are not counted.
"""

from __future__ import annotations

import dataclasses
import fcntl
import json
import os
import shutil
import subprocess
import sys
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

for variable in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "POLARS_MAX_THREADS"):
    os.environ.setdefault(variable, "1")

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks import workers  # noqa: E402 (found by the path above)
from idm_env.config import read_yaml  # noqa: E402
from idm_env.executor import Executor, Serial  # noqa: E402
from idm_env.progress import OnProgress  # noqa: E402

LIMIT = 150.0
"""CPU seconds after which a training ends that has updates left."""
EVERY = 3.0
TESTS = ("failsafe", "failsafe-shock", "brakes", "brakes-shock", "follow")
"""Of the reference rows (``benchmarks.agents_reference.tests``)."""
SEARCH_SEEDS, SEEDS = (100, 101), tuple(range(10))

Options = dict[str, Any]
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
    "ring-brakes-distil": [{"evaluate_every": 0}],
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
        words += ["--evaluate-every", str(EVERY * self.times**0.5)]
        options = dict(self.options)
        teacher = out.parents[3] / f"ring-apg/trial0/seed{self.seed}/training/last.pt"
        # What was begun with a teacher of its own goes on with that.
        begun = (out / "teacher").exists()
        if module == MODULES["distil"] and not begun and (teacher.parents[1] / "result.json").exists():
            options["teacher"] = teacher
        if self.times > 1:
            given = read_yaml(ROOT / "configs" / f"{self.config}.yaml")
            options["updates"] = self.times * options.get("updates", given["updates"])
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
    from idm_env.keep import write_text

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
    from agents.common import load
    from agents.evaluate import as_judged, evaluate, held_out, solved_at
    from agents.rollout import FRESH

    if not (training / "last.pt").exists() or not (training / "best.pt").exists():
        summary = {"solved": False, "ever": False, "spent": 0.0, "error": True}
        return {"error": done.stderr[-2000:], "history": [], "summary": summary}
    policy, content = load(training / "last.pt")
    best, at_best = load(training / "best.pt")
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
    from agents.evaluate import score

    jobs = trials(config)
    found = [perform(job, out) for job in jobs]
    done = [row for row in found if row is not None]
    if len(done) < len(found):
        return -1, done
    ranks: list[tuple[int, float]] = []
    for trial in range(len(SEARCH[config])):
        rows = [row for job, row in zip(jobs, done, strict=True) if job.trial == trial]
        ends = [score(row["last"]) if row["history"] else -1e9 for row in rows]
        ranks.append((sum(row["summary"]["solved"] for row in rows), sum(ends) / max(len(ends), 1)))
    return ranks.index(max(ranks)), done


def run(
    configs: list[str],
    out: Path,
    seeds: int,
    given: int | None = None,
    executor: Executor | None = None,
    times: int = 1,
) -> None:
    """Do every search and the first ``seeds`` seeds of its best trial, or those of a given one without any search.

    ``times`` makes the trainings of these seeds longer, not those of the search.
    """
    executor = executor or Serial()
    searched = [job for config in configs for job in trials(config)] if given is None else []
    deque(executor.map(train, [Training(job, out) for job in searched]), 0)
    wanted = []
    for config in configs:
        trial = chosen(config, out)[0] if given is None else given
        if trial < 0:
            print(f"{config}: another process is still searching.")
            continue
        best = SEARCH[config][trial]
        wanted += [Job(config, trial, best, s, times) for s in SEEDS[:seeds]]
    deque(executor.map(train, [Training(job, out) for job in wanted]), 0)


def main() -> None:
    """Run, or show."""
    import argparse

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["reference", "run", "table", "picture", "takeover", "unshocked"])
    parser.add_argument("--only", nargs="*", default=list(SEARCH))
    parser.add_argument("--tests", nargs="*", default=list(TESTS), choices=TESTS, help="of the reference rows")
    parser.add_argument("--trial", type=int, help="train the seeds of this trial, without a search")
    parser.add_argument("--seeds", type=int, default=len(SEEDS), help="train no more seeds than that")
    parser.add_argument("--times", type=int, default=1, help="train the seeds for so many times the updates")
    parser.add_argument("--out", type=Path, default=Path("runs/benchmark"))
    workers.add(parser)
    options = parser.parse_args()
    if options.what == "table":
        from agents.imitation import default_data
        from benchmarks.agents_tables import show

        show(options.out, SEARCH, SEARCH_SEEDS, SEEDS, default_data())
    elif options.what == "picture":
        from benchmarks.agents_pictures import draw

        draw(options.out, SEEDS, ROOT / "docs" / "agents_survival.png")
    elif options.what == "takeover":
        from benchmarks.agents_tables import takeover_table

        takeover_table(options.out, [c for c in SEARCH if c.startswith("ring")], SEEDS[: options.seeds])
    elif options.what == "unshocked":
        from benchmarks.agents_tables import unshocked_table

        unshocked_table(options.out, [c for c in options.only if c.startswith("ring")], SEEDS[: options.seeds])
    elif options.what == "reference":
        from benchmarks import agents_reference

        agents_reference.show(options.out.resolve(), options.tests, once)
    else:
        with workers.of(options) as executor:
            run(options.only, options.out.resolve(), options.seeds, options.trial, executor, options.times)


if __name__ == "__main__":
    main()
