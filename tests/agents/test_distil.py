"""Distillation: what a policy does behind a failsafe, it learns to do without."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch

from agents import apg, common, distil, environments
from agents.policy import Policy

LIMITS = [-4.5, 2.6]


def reckless(folder: Path, environment: dict) -> Path:
    """Keep a policy that always accelerates, as if it had been trained."""
    torch.manual_seed(0)
    policy = Policy(3, (16, 16))
    with torch.no_grad():
        policy.body[-1].bias.fill_(0.3)
    common.save(folder / "teacher.pt", policy, "apg", environment, {"steps": 70, "cpu_seconds": 5.0, "update": 0})
    return folder / "teacher.pt"


@pytest.fixture
def small(quick, tmp_path) -> distil.Arguments:
    teacher = reckless(tmp_path, {**quick["environment"], "failsafe": 3.0})
    environment = {**quick["environment"], "max_command": LIMITS, "max_episode_steps": 300}
    given = {**quick, "environment": environment, "teacher": teacher, "count": 16, "updates": 3}
    return distil.Arguments(**given, steps=150, fits=500)


def crashes(policy: Policy, environment: dict) -> int:
    env = environments.make_env(environment, 16, output="torch")
    observation, found = env.reset(seed=7)[0], 0
    with torch.no_grad():
        for _ in range(150):
            observation, _, crashed, *_ = env.step(policy(observation))
            found += int(crashed.sum())
    return found


def test_a_policy_learns_to_brake_as_its_failsafe_did(small):
    """One that always accelerates crashes where there is no failsafe, and no longer when it was distilled."""
    assert crashes(common.load(small.teacher)[0], small.environment) >= 16
    history = distil.train(small)
    assert crashes(common.load(small.out / "last.pt")[0], small.environment) == 0
    assert [row["updates"] for row in history] == [0, 1, 2, 3]
    # What the teacher has cost counts.
    assert [row["steps"] for row in history] == [70 + 150 * 16 * k for k in range(4)]
    assert history[0]["cpu_seconds"] >= 5.0


def test_labels_are_the_failsafes_in_the_limits_of_the_student(small):
    """Where the teacher's command is cut, the label is the safe command, however hard; else the command itself."""
    teacher, content = common.load(small.teacher)
    guarded = environments.task_of(content["environment"])
    wave = {"start": "wave", "warmup": 0, "warmup_pool": 0}
    env = environments.make_env({**small.environment, **wave}, 16, output="torch")
    env.reset(seed=0)
    seen, wanted = distil.watch(None, teacher, guarded, env, 150)
    assert seen.shape == (150 * 16, 3) and wanted.shape == (150 * 16,)
    command = env.task.command(wanted)
    asked = guarded.command(teacher(seen)).detach().flatten()
    cut = command < asked - 1e-5
    assert 0.1 < cut.float().mean() < 0.99
    assert torch.allclose(command[~cut], asked[~cut], atol=1e-5)
    assert float(command.min()) < -1.5  # beyond what the teacher itself may command


def test_it_resumes_exactly_and_repeats_itself(small, tmp_path):
    small = dataclasses.replace(small, fits=20, steps=30)
    whole = dataclasses.replace(small, out=tmp_path / "whole")
    distil.train(whole)
    for _ in range(3):
        distil.train(dataclasses.replace(small, cpu_seconds=1e-9, resume=(small.out / "last.pt").exists()))
    one, other = (common.load(a.out / "last.pt")[0].state_dict() for a in (whole, small))
    assert all(torch.equal(one[k], other[k]) for k in one)


def test_a_teacher_may_be_a_training_that_comes_first(small, tmp_path):
    file = tmp_path / "first.yaml"
    file.write_text(
        "configures: agent\nagent: apg\nenvironment: {task: ring, vehicles: 8, length: [60.0, 75.0], warmup: 20, "
        "warmup_pool: 8, failsafe: 3.0}\nupdates: 2\ncount: 4\nwindow: 20\nhidden: [8, 8]\nevaluate_every: 1\n"
    )
    small = dataclasses.replace(small, teacher=file, fits=20, steps=30, updates=1)
    trained = small.out / "teacher" / "last.pt"
    apg.train(dataclasses.replace(common.load_agent(file, apg.Arguments, "apg"), out=trained.parent, updates=1))
    history = distil.train(small)
    found = common.load(trained)[1]["training"]
    assert found["update"] == 1  # it was trained to its end
    assert history[0]["steps"] == found["steps"]
    distil.train(dataclasses.replace(small, seed=1))  # another seed has a teacher of its own
    assert common.load(trained)[1]["training"]["arguments"]["seed"] == 1
    file.write_text(file.read_text().replace("window: 20", "window: 10"))
    distil.train(dataclasses.replace(small, seed=1))  # and another file
    assert common.load(trained)[1]["training"]["arguments"]["window"] == 10


def test_what_cannot_teach_is_told_in_one_line(small, quick, tmp_path):
    bare = reckless(tmp_path, quick["environment"])
    with pytest.raises(ValueError, match=r"teacher\.pt was trained without a failsafe"):
        distil.train(dataclasses.replace(small, teacher=bare))
    raw = reckless(tmp_path, {**quick["environment"], "failsafe": 3.0, "observation": "raw"})
    with pytest.raises(ValueError, match="on other observations than this environment's"):
        distil.train(dataclasses.replace(small, teacher=raw))


def test_a_teacher_is_not_overwritten(small):
    teacher = small.teacher.rename(small.teacher.with_name("last.pt"))
    with pytest.raises(SystemExit, match=r"is an input, and .* would overwrite it"):
        distil.main(["--teacher", str(teacher), "--out", str(teacher.parent)])
