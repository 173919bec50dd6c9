"""The benchmark of agents skips what is done and leaves what another process works on; its tables say what was run."""

from __future__ import annotations

import fcntl
import json
import pickle
import shutil
import subprocess
from contextlib import nullcontext
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

from idm_env.jobs.progress import silent
from idm_env.tasks import make_task

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def benchmark(monkeypatch) -> ModuleType:
    """The script, with a training that only leaves a mark."""
    import importlib

    monkeypatch.syspath_prepend(str(ROOT))
    module = importlib.import_module("benchmarks.agents")
    trained = []

    def outcome(training, done, unseen):
        return {"summary": {"solved": True}, "history": [{"passed": True}], "last": LAST, "error": ""}

    def run(command, **keywords):
        trained.append(command)
        return subprocess.CompletedProcess(command, 0, "", "")

    monkeypatch.setattr(module, "outcome", outcome)
    monkeypatch.setattr(module.subprocess, "run", run)
    module.trained = trained
    return module


LAST = {"speed_ratio": 1.0, "speed_std": 0.1, "time_gap": 1.0, "collisions": 0, "passed": True}


def test_every_trial_is_trained_once(benchmark, tmp_path):
    benchmark.run(["ring-apg"], tmp_path, 3)
    assert len(benchmark.trained) == 5 * 2 + 3
    seeds = [int(c[c.index("--seed") + 1]) for c in benchmark.trained]
    assert seeds == [100, 101] * 5 + [0, 1, 2]
    benchmark.run(["ring-apg"], tmp_path, 4)
    assert len(benchmark.trained) == 5 * 2 + 4


def test_a_policy_is_distilled_from_the_same_seeds_teacher_where_there_is_one(benchmark, tmp_path):
    """Else the configuration's teacher is trained first."""
    benchmark.run(["ring-brakes-distil"], tmp_path, 1)
    benchmark.run(["ring-apg"], tmp_path, 2, trial=0)
    benchmark.run(["ring-brakes-distil"], tmp_path, 2)
    first, second = (c for c in benchmark.trained if "agents.distil" in c)
    assert "--teacher" not in first
    job = benchmark.Job("ring-brakes-distil", 0, {}, 1)
    begun = tmp_path / job.name / "training"
    assert "--teacher" in job.command(begun)
    (begun / "teacher").mkdir(parents=True)
    assert "--teacher" not in job.command(begun)  # it goes on with its own
    teacher = tmp_path / "ring-apg" / "trial0" / "seed1" / "training" / "last.pt"
    assert second[second.index("--teacher") + 1] == str(teacher)


def test_trainings_are_parts_of_an_executor(benchmark, tmp_path):
    """All trials of all searches at once, then all seeds: so many workers as there are have something to do."""
    given = []

    class Recording:
        def map(self, function, parts, on_progress=silent):
            given.append([str(part) for part in pickle.loads(pickle.dumps(parts))])
            yield from ((i, function(part, silent)) for i, part in enumerate(parts))

    place = SimpleNamespace(opened=lambda: nullcontext(Recording()))
    benchmark.run(["ring-apg", "ring-shac", "ring-ppo"], tmp_path, 2, place=place)
    searches, seeds = given
    assert len(searches) == len(set(searches)) == 2 * 5 * 2 and not any("shac" in name for name in searches)
    assert len(seeds) == 3 * 2 and len(benchmark.trained) == 26


def test_what_another_process_works_on_is_left_to_it(benchmark, tmp_path):
    job = benchmark.Job("ring-apg", 0, {}, 1)
    folder = tmp_path / job.name
    folder.mkdir(parents=True)
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        # A lock belongs to the open file, so this stands for another process.
        assert benchmark.perform(job, tmp_path) is None and not benchmark.trained
    assert benchmark.perform(job, tmp_path)["summary"]["solved"]
    assert json.loads((folder / "result.json").read_text())["seed"] == 1


def test_searches_of_the_compared_are_equal_and_options_exist(benchmark):
    compared = ("ring-apg", "ring-ppo", "ring-sac")
    assert {len(benchmark.SEARCH[c]) for c in compared} == {5}
    from agents import apg, distil, ppo, shac

    kinds = {"apg": apg.Arguments, "ppo": ppo.Arguments, "sac": ppo.Arguments, "shac": shac.Arguments}
    kinds["distil"] = distil.Arguments
    for config, trials in benchmark.SEARCH.items():
        assert (ROOT / "configs" / f"{config}.yaml").exists()
        for options in trials:
            names = {name.removeprefix("no_") for name in options}
            assert names <= set(kinds[config.split("-")[-1]].__dataclass_fields__)


def test_take_overs_are_judged_without_and_with_a_failsafe(benchmark, tmp_path, monkeypatch, capsys):
    from agents.common import save
    from agents.policy import Policy

    environment_of, judged = benchmark.environment_of, []

    def judge(act, environment, warmup, draws):
        drawn = isinstance(environment["parameters"]["idm"]["time_gap"], list)
        name = getattr(act, "__name__", type(act).__name__)
        judged.append((name, environment["failsafe"], drawn, warmup))
        return {**LAST, "collisions": int(not environment["failsafe"]), "ratios": [1.0] * 6}

    monkeypatch.setattr(benchmark, "evaluate_ring", judge)
    save(tmp_path / "ring-apg/trial2/seed1/training/last.pt", Policy(3), "apg", environment_of("ring-apg"), {})
    benchmark.takeover(["ring-apg"], tmp_path, 2)
    cases = [(False, 750), (False, 1750), (False, 3000), (True, 3000)]
    names = ("no_command", "PISaturation", "Policy")
    assert judged == [(name, b, *case) for name in names for b in (0.0, 3.0) for case in cases]
    assert "| ring-apg | 1 | none | 1 of 6 / 1.000 / 0.10 |" in capsys.readouterr().out


def test_the_seeds_of_a_given_trial_need_no_search(benchmark, tmp_path):
    benchmark.run(["ring-apg"], tmp_path, 2, trial=3)
    options = [c[c.index("--window") + 1] for c in benchmark.trained]
    assert options == ["300", "300"]


def test_reference_rows_are_made_once_and_say_what_a_test_is_worth(benchmark, tmp_path, monkeypatch, capsys):
    made = []

    def makers(environment, folder):
        def row(name, passed):
            made.append((name, environment.get("shock", 0.0)))
            return {"tried": 10, "six": len(passed), "passed": passed, "best": "b", "figures": LAST}

        easy = ["1", "2"] if not environment.get("shock") else []
        return {name: lambda name=name: row(name, easy) for name in ("constants", *benchmark.RANDOM)}

    monkeypatch.setattr(benchmark, "on_ring", makers)
    for _ in range(2):
        benchmark.reference(("failsafe", "failsafe-shock"), tmp_path)
    assert len(made) == 6 and {shock for _, shock in made} == {0.0, 4.0}
    printed = capsys.readouterr().out
    assert "| constants | 2 of 10; 1.000/0.10/1.00/0 | 0 of 10; 1.000/0.10/1.00/0 |" in printed
    assert "failsafe: 4 of 20 random policies pass, so it is no test." in printed
    assert "failsafe-shock: 0 of 20 random policies pass, so it is a test." in printed
    assert set(benchmark.TESTS) == set(benchmark.environments())


def test_the_reference_ring_with_a_shock_is_the_one_that_agents_are_judged_on(benchmark):
    from agents.evaluate import as_judged

    made = benchmark.environments()
    assert {**made["failsafe-shock"], **as_judged(made["failsafe"])} == made["failsafe-shock"]
    assert made["failsafe-long"]["shock_after"] == 120.0


def test_networks_of_a_reference_row_train_where_nobody_brakes(benchmark, monkeypatch, tmp_path):
    trained = []
    monkeypatch.setattr(benchmark, "begun", lambda environment, folder, updates: trained.append(environment))
    monkeypatch.setattr(benchmark, "networks", lambda policies, names: None)
    monkeypatch.setattr(benchmark, "tried", lambda family, environment: {})
    makers = benchmark.on_ring(benchmark.environments()["brakes-shock"], tmp_path)
    for name in benchmark.BEGUN:
        makers[name]()
    assert trained and all(make_task(**environment).shock == 0.0 for environment in trained)


def test_what_passes_behind_a_leader_is_asked_again_on_fresh_stretches(benchmark, monkeypatch):
    from agents import evaluate
    from agents.policy import Policy

    asked = []

    def judge(act, environment, draws=(0,)):
        asked.append(tuple(draws))
        reward = 0.7 if act is None else 0.9
        return {"reward": reward, "time_gap": 1.0, "collisions": 0, "passed": reward >= evaluate.FOLLOW_REWARD}

    monkeypatch.setattr(benchmark, "evaluate_follow", judge)
    monkeypatch.setattr(benchmark, "random_policies", lambda environment, count, hidden: [Policy(3)] * 2)
    rows = benchmark.behind_leader(benchmark.environments()["follow"], Path())
    alone = rows["IDM (a human driver more)"]()
    assert (alone["tried"], alone["passed"]) == (1, [])
    assert rows["random networks"]()["passed"] == ["0", "1"] and asked == [(0,)] * 3 + [(1, 2, 3, 4, 5)] * 2
    assert rows["constants"]()["tried"] == 21


def test_the_trial_that_solves_most_is_drawn_or_that_of_most_seeds_the_soonest_or_longest(benchmark, tmp_path):
    shown = benchmark.shown
    for trial, seed, spent in ((0, 0, 40.0), (1, 0, 90.0), (1, 1, 0.0), (2, 0, 10.0), (2, 1, 20.0)):
        folder = tmp_path / "ring-ppo" / f"trial{trial}" / f"seed{seed}"
        folder.mkdir(parents=True)
        summary = {"spent": spent, "solved": False}
        row = {"trial": trial, "seed": seed, "summary": summary, "history": [LAST] if spent else []}
        (folder / "result.json").write_text(json.dumps(row))

    def drawn():
        return [(r["trial"], r["seed"]) for r in shown(tmp_path, "ring-ppo", range(10))]

    assert drawn() == [(2, 0), (2, 1)]  # most seeds, failures not counted
    shutil.rmtree(tmp_path / "ring-ppo/trial2")
    assert drawn() == [(1, 0)]  # the longest
    assert shown(tmp_path, "ring-sac", range(10)) == []
    for trial, seconds in ((0, 30.0), (1, 20.0)):
        summary = {"spent": 50.0, "solved": True, "cpu_seconds": seconds}
        row = {"trial": trial, "seed": 0, "summary": summary, "history": [LAST]}
        (tmp_path / f"ring-ppo/trial{trial}/seed0/result.json").write_text(json.dumps(row))
        assert drawn() == [(trial, 0)]  # it solves it, and then sooner


def test_the_share_not_solved_yet_counts_those_that_never_solve(benchmark):
    import matplotlib.pyplot as plt

    rows = [{"summary": {"solved": s < 9.0, "cpu_seconds": s, "spent": 20.0}} for s in (2.0, 4.0, 9.0, 9.0)]
    _, axes = plt.subplots()
    benchmark.curve(axes, rows, "X", "red")
    line = axes.lines[0]
    assert list(zip(line.get_xdata(), line.get_ydata(), strict=True)) == [(1, 1), (2, 0.75), (4, 0.5), (20, 0.5)]
    assert line.get_label() == "X: 2 of 4 seeds"


def test_longer_trainings_have_as_many_times_the_updates_and_a_place_of_their_own(benchmark, tmp_path):
    benchmark.run(["ring-ppo", "ring-apg"], tmp_path, 1, trial=4, times=3)
    given = [dict(zip(c[3::2], c[4::2], strict=False)) for c in benchmark.trained]
    assert [g["--updates"] for g in given] == ["180", "132"]  # three times those of trial 4
    assert {g["--cpu-seconds"] for g in given} == {str(3 * benchmark.LIMIT)}
    assert (tmp_path / "ring-ppo/trial4x3/seed0/result.json").exists()
    benchmark.run(["follow-apg"], tmp_path, 1, times=2)
    assert benchmark.trained[-1][-1] == "68"  # twice those of its file


def test_an_interrupted_training_is_resumed(benchmark, tmp_path):
    job = benchmark.Job("ring-apg", 0, {}, 1)
    training = tmp_path / job.name / "training"
    training.mkdir(parents=True)
    (training / "last.pt").touch()
    benchmark.perform(job, tmp_path)
    benchmark.perform(benchmark.Job("ring-apg", 0, {}, 2), tmp_path)
    assert ["--resume" in command for command in benchmark.trained] == [True, False]


def test_a_ratio_of_medians_has_an_interval_and_counts_those_that_never_solve(benchmark):
    far, median_ratio = float("inf"), benchmark.median_ratio
    assert median_ratio([20.0], [10.0, 10.0]) == (2.0, 2.0, 2.0)
    # The median of two seeds is that of the pairs 1 1, 1 3, 3 1, 3 3: each a quarter.
    assert median_ratio([1.0, 3.0], [1.0]) == (2.0, 1.0, 3.0)
    assert median_ratio([1.0, 2.0, far], [1.0]) == (2.0, 1.0, far)
    assert median_ratio([far, far, 2.0], [1.0])[0] == far


def test_what_never_solved_is_told_with_what_it_had(benchmark, tmp_path, capsys):
    def result(config, seed, solved, times=1):
        summary = {"solved": solved, "spent": 40.0 * times, "cpu_seconds": 20.0 + seed, "steps": 1000}
        folder = tmp_path / config / f"trial0x{times}" / f"seed{seed}"
        folder.mkdir(parents=True)
        row = {"trial": 0, "times": times, "seed": seed, "summary": summary}
        (folder / "result.json").write_text(json.dumps(row))

    for seed in range(3):
        result("ring-apg", seed, True)
        result("ring-ppo", seed, False, times=5)
    result("ring-sac", 0, True)
    benchmark.ratio_line(tmp_path, "ring-apg", "ring-ppo", range(10))
    benchmark.ratio_line(tmp_path, "ring-apg", "ring-sac", range(10))
    told = capsys.readouterr().out
    assert "ring-ppo (0, 5 times) / ring-apg, CPU seconds to solved: no ratio; 0 of 3 and 3 of 3 solved; " in told
    assert "those not solved had 10 times ring-apg's median." in told
    assert "ring-sac (0) / ring-apg, CPU seconds to solved: 0.95 (0.91–1.00); 1 of 1 and 3 of 3 solved." in told
