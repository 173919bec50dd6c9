"""Live benchmarks are commands; rows that are done are kept; what the lanes benchmark does not take."""

from __future__ import annotations

import importlib
import math
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from benchmarks import command, kept_rows, lane_planner, lane_search, lane_tasks, lanes, named_rows, tasks
from benchmarks.bench.search import cross_entropy
from idm_env.jobs.progress import OnProgress
from idm_env.jobs.workers import Workers
from idm_env.tasks import make_task

COMMANDS = sorted(p.stem for p in (Path(__file__).parents[1] / "benchmarks").glob("*.py") if p.stem != "__init__")


@pytest.mark.parametrize("name", COMMANDS)
def test_every_live_benchmark_is_a_command_that_says_its_options(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", [name, "--help"])
    with pytest.raises(SystemExit, match="0"):
        command(importlib.import_module(f"benchmarks.{name}").main)
    assert capsys.readouterr().out.startswith(f"usage: python -m benchmarks.{name} ")


def test_a_cross_entropy_search_finds_the_least_cost_within_its_ends() -> None:
    """Of a parabola; beyond an end it is the end, and with no generation the mean it began with."""
    drawn: list[np.ndarray] = []

    def costs(numbers: np.ndarray, generation: int) -> np.ndarray:
        assert generation == len(drawn)
        drawn.append(numbers)
        return ((numbers - np.array([1.5, 9.0])) ** 2).sum(1)

    options = {"rows": 40, "keep": 8, "floor": 0.1, "ends": (-3.0, 3.0), "with_mean": True}
    mean, best, _ = cross_entropy(costs, np.zeros(2), np.ones(2), generations=25, **options)
    np.testing.assert_allclose(mean, [1.5, 3.0], atol=0.1)
    assert best.shape == (8, 2) and len(drawn) == 25
    assert max(np.abs(numbers).max() for numbers in drawn) == 3.0
    np.testing.assert_array_equal(drawn[0][0], [0.0, 0.0])
    np.testing.assert_array_equal(cross_entropy(costs, np.ones(2), 1.0, generations=0, **options)[0], [1.0, 1.0])


def _squared(part: int, on_progress: OnProgress) -> int:
    return part * part


def _refused(part: int, on_progress: OnProgress) -> int:
    raise AssertionError("was done before")


def test_rows_are_kept_and_not_done_again(tmp_path: Path) -> None:
    given = Workers()
    rows = {"two": 2, "three": 3}
    at = tmp_path / "out" / "rows.jsonl"
    for work in (_squared, _refused):
        assert named_rows(work, rows, at, given) == {"two": 4, "three": 9}
    with pytest.raises(AssertionError, match="was done before"):
        named_rows(_refused, {"two": 5}, at, given)  # the same name, other settings
    assert named_rows(_squared, {"two": 5, "three": 3}, at, given) == {"two": 25, "three": 9}
    assert named_rows(_refused, {"two": 5, "three": 3}, at, given) == {"two": 25, "three": 9}
    at.write_text('{"name": "three", "found": 7}\n')  # as files were written before
    assert named_rows(_squared, rows, at, given) == {"two": 4, "three": 9}


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("laws x", "could not convert string to float: 'x'"),
        ("laws nan", "error: nan vehicle-steps are no number of 1000 or more. Usual is 1e9."),
        ("flow fast", "Unrecognized options: fast"),
        ("speed rings", "Expected one of ('all', 'rollouts', 'highway')."),
        ("laws 1000 --jobs 2", "--jobs (applied to python -m benchmarks.lanes laws)"),
        ("merge", "Available subcommands: speed, flow, standing, laws"),
    ],
)
def test_what_would_not_be_heeded_is_refused(
    words: str, says: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["lanes", *words.split()])
    with pytest.raises(SystemExit) as end:
        command(lanes.main)
    printed = "".join(c for c in capsys.readouterr().err if c not in "│╭╮╰╯─") + str(end.value)
    assert says in " ".join(printed.split())


def seen_of(task, speeds, lanes_, places):
    """Return what agents see of themselves, all of them on the road."""
    names = task.bounds.names
    seen = torch.zeros(1, len(task.agents), len(names))
    for name, values in (("speed", speeds), ("lane", lanes_), ("position", places), ("present", [1.0] * len(speeds))):
        i = names.index(name)
        seen[0, : len(values), i] = torch.tensor(values) / task.scales[i]
    return seen.flatten(1)


def test_rules_by_lane_and_place_hold_agents_to_a_speed_before_a_place():
    task = make_task("merge", vehicles=8, controlled=3)
    rules = torch.tensor([[[10.0, 300.0], [40.0, 300.0], [21.0, 300.0]]])
    act = lane_tasks.by_place(task, rules, 1)
    assert act(seen_of(task, [20.0] * 3, [0.0, 1.0, 2.0], [200.0] * 3)).tolist() == [[-1.0, 1.0, 0.25]]
    assert act(seen_of(task, [20.0] * 3, [0.0, 1.0, 2.0], [400.0] * 3)).tolist() == [[1.0, 1.0, 1.0]]


def test_a_signal_holds_the_first_of_the_ramp_until_the_next_may_go():
    """At 800 vehicles an hour that is 4.5 s after the last; nobody else is held."""
    task = make_task("merge", vehicles=3, controlled="all", inflow=2000.0, ramp_inflow=1000.0)
    signal = lane_tasks.Alinea(task)
    assert signal(seen_of(task, [10.0, 10.0, 30.0], [0.0, 0.0, 1.0], [345.0, 300.0, 300.0])).min() == 1.0
    held = []
    for second in range(6):
        action = signal(seen_of(task, [10.0, 4.0, 30.0], [0.0, 0.0, 1.0], [360.0 + second, 346.0, 300.0]))
        assert action[0, 0] == action[0, 2] == 1.0
        held.append(bool(action[0, 1] < 0.0))
    assert held == [True] * 4 + [False] * 2


def test_a_driver_of_human_numbers_adds_nothing_and_one_on_each_lane_is_asked():
    """Of two drivers in two episodes each: the first is human, the second brakes on lane 1 only."""
    log = torch.tensor(lane_search.HUMAN).log().repeat(2, 3, 1)
    log[1, 1, 0] = math.log(20.0)
    seen = torch.tensor([[28.0, 28.0, 60.0, 0.0], [28.0, 28.0, 60.0, 1.0], [28.0, 28.0, 60.0, 2.0]])
    action = lane_search.Drivers(log, 2.0, 2)(seen.reshape(1, 12).expand(4, -1))
    braking = 1.5 * ((28.0 / 30.0) ** 4 - (28.0 / 20.0) ** 4) / 2.0
    expected = torch.tensor([[0.0, 0.0, 0.0], [0.0, max(braking, -1.0), 0.0]]).repeat_interleave(2, 0)
    torch.testing.assert_close(action.detach(), expected)


def test_each_way_to_find_drivers_leaves_a_row_that_is_not_made_again(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr("agents.evaluate.STEPS_OF_LANES", 100)
    monkeypatch.setitem(lane_search.DEMANDS, "small", {"task": "merge", "vehicles": 30})
    for name, value in {"GENERATIONS": 2, "DRIVERS": 3, "EPISODES": 1, "UPDATES": 2, "ROWS": 2, "WINDOW": 5}.items():
        monkeypatch.setattr(lane_search, name, value)
    monkeypatch.setattr(lane_search, "ROUNDS", ((3, 1), (2, 1)))
    monkeypatch.setattr(lane_search, "JUDGED_ON", 2)
    for how in lane_search.NETWORKS:
        name, small = f"merge-{how}.yaml", {"count": 2, "n_steps": 3, "batch_size": 18, "window": 3, "updates": 4}
        given = yaml.safe_load((lane_search.CONFIGS / name).read_text())
        (tmp_path / name).write_text(yaml.safe_dump({k: small.get(k, x) for k, x in given.items()}))
    (tmp_path / "merge.yaml").write_text("{configures: environment, task: merge}")
    monkeypatch.setattr(lane_search, "CONFIGS", tmp_path)
    for _ in range(2):
        lane_search.main("small", seeds=1, budget=0.5, out=tmp_path / "rows.jsonl")
        printed = capsys.readouterr().out
        assert all(how in printed for how in ("humans", *lane_search.FOUND_BY, *lane_search.NETWORKS))
    rows = kept_rows(tmp_path / "rows.jsonl", "name")
    assert len(rows) == len((tmp_path / "rows.jsonl").read_text().splitlines()) == 6
    for how, count in (("random search", 1), ("evolution", 3), ("gradients", 3)):
        found = torch.tensor(rows[f"small, 0.3, {how}, 0"]["found"]["numbers"])
        assert found.shape == (1, count, 5) and bool((found != torch.tensor(lane_search.HUMAN)).any())
    humans = rows["small, 0.3, humans, 0"]["found"]["found"]["rewards"]
    for how in lane_search.NETWORKS:
        found = rows[f"small, 0.3, {how}, 0"]["found"]
        assert found["found"]["rewards"] != humans and 0.0 < found["seconds"] < 47.5


def test_a_search_keeps_what_is_best_on_other_episodes(monkeypatch):
    monkeypatch.setattr("agents.evaluate.STEPS_OF_LANES", 300)
    given = {"task": "bottleneck", "inflow": 720.0, "vehicles": 24, "controlled": 0.5}
    best = lane_tasks.searched(given, torch.tensor([-1.0, 1.0, 0.0, -0.5, -2.0]), lane_tasks.constants)
    assert best.tolist() == [1.0]


@pytest.mark.parametrize("noise", [0.0, 0.2])
def test_a_planner_foresees_what_happens_but_for_noise(noise, monkeypatch):
    monkeypatch.setattr(lane_planner, "AHEAD", 4)
    batch = lane_planner.episodes_of("merge 3000 + 800", noise, [7, 8])
    copies = lane_planner.episodes_of("merge 3000 + 800", noise, range(2 * 5 * 2))
    lane_planner.drive(batch, torch.tensor([0, 1]), 3)
    foreseen = lane_planner.foresee(batch, copies, lane_planner.OTHER_NOISE)
    assert torch.equal(foreseen, lane_planner.foresee(batch, copies, lane_planner.OTHER_NOISE))
    happens, _ = lane_planner.drive(batch, torch.tensor([0, 3]), 4)
    assert torch.equal(foreseen[[0, 1], [0, 3]], happens) == (noise == 0.0)
    assert bool((foreseen[:, 0] > foreseen[:, 3]).all())  # at first to hold agents back costs


def test_a_planner_that_must_save_more_commands_less_and_each_row_is_of_the_same_episodes(monkeypatch):
    for name, value in {"SECONDS": 8, "EVERY": 4, "AHEAD": 4, "WORTH": 1e6}.items():
        monkeypatch.setattr(lane_planner, name, value)
    monkeypatch.setattr(lane_planner, "RULES", (lane_planner.RULES[3], lane_planner.RULES[0]))
    rows = lane_planner.rows_of("merge 3000 + 800", 0.0, [7, 8], 1)
    assert rows["planner"][2].tolist() == [[1, 1], [1, 1]] == rows["another's plan"][2].tolist()
    assert rows["planner, seldom"][2].tolist() == [[0, 0], [0, 0]]
    assert torch.equal(rows["planner, seldom"][0], rows["humans"][0])
    assert bool((rows["planner"][0] > rows["humans"][0]).all())


@pytest.mark.parametrize("task", tasks.OPEN)
def test_a_planner_that_only_knows_human_driving_drives_as_humans_do(task, monkeypatch):
    """Its copies leave no trace in the world."""
    monkeypatch.setattr(tasks, "AHEAD", 20)
    monkeypatch.setitem(tasks.GIVEN, task, {**tasks.GIVEN.get(task, {}), "max_episode_steps": 40})
    human, _ = tasks.returns(task, None, [0, 1])
    monkeypatch.setattr(tasks, "PLANS", (0.0,))
    assert tasks.planner(task, [0, 1])[0] == pytest.approx(human, rel=1e-6)
