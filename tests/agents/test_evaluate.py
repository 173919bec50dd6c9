"""The test that judges agents, the classical controllers in it, and pictures."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from PIL import Image

from agents import common, evaluate
from agents.classical import FollowerStopper, PISaturation, Seen, controllers, no_command, seen
from agents.environments import task_of
from agents.evaluate import kinds, solved_at
from agents.policy import Policy
from agents.rollout import Driven, drive, ring_start, uniform_speed
from idm_env.tasks import make_task
from tests.equilibrium import equilibrium_speed

RING: dict[str, Any] = {"task": "ring", "shock": 0.0}
TASK = make_task(**RING)


def test_uniform_speed_is_the_equilibrium_of_equal_drivers():
    start = ring_start(RING, (220.0, 260.0))
    p = start.params["idm"]
    gap = start.world.state.gap.mean(-1)
    assert torch.allclose(uniform_speed(start), equilibrium_speed(gap, dict(p)), atol=1e-4)


def test_uniform_speed_of_unequal_drivers_fills_the_ring():
    time_gap = [1.0 + 0.02 * i for i in range(22)]
    start = ring_start({**RING, "parameters": {"idm": {"time_gap": time_gap}}}, (250.0,))
    v = float(uniform_speed(start))
    gaps = [(2.0 + v * t) / (1.0 - (v / 30.0) ** 4) ** 0.5 for t in time_gap]
    assert sum(gaps) == pytest.approx(250.0 - 22 * 5.0, rel=1e-4)


@pytest.mark.parametrize("controlled", [1, 3])
def test_a_driven_policy_moves_as_pure_steps_do(controlled):
    """Evaluations step as compiled environments do; noise, failsafe and shock are those of the task's own step."""
    keywords = {**RING, "noise": 0.2, "failsafe": 3.0, "shock": 4.0, "shock_after": 2.0, "controlled": controlled}
    start = ring_start(keywords, (220.0, 260.0), 100, draws=(0, 3))

    def act(seen):
        assert seen.shape == (4, 3 * controlled)
        return (seen[:, :controlled] - 0.2).clamp(-1.0, 1.0)

    fast, task, world = drive(start, act, 60), start.task, start.world
    normals = task.normals(start.draw, world.state.step, 60, torch.float32)
    for t in range(60):
        action, before = act(task.observe(world).flatten(1)), world
        command = task.command(action)
        world = task.step(before, command, {name: x[t] for name, x in normals.items()}, start.params)
        for name in ("speed", "accel", "gap"):
            assert torch.allclose(getattr(fast, name)[t], getattr(world.state, name), atol=1e-4)
        assert torch.allclose(fast.action[t], action, atol=1e-5)
        assert torch.allclose(fast.reward[t], task.rewards(before, command, world), atol=1e-5)
    assert float(fast.accel[30, :, start.task.shocked].min()) == pytest.approx(-4.0)  # the shock is among them


def drives(start, speed, gap):
    steps = evaluate.JUDGED + 10
    shape = (steps, len(start.world.state.speed), 22)
    speeds = torch.full(shape, 1.0) * speed
    none = torch.zeros(steps, shape[1], 1)
    return Driven(speeds, torch.zeros(shape), torch.full(shape, gap), none, none)


def test_the_figures_of_the_ring_are_the_worst_of_all_lengths():
    start = ring_start(RING, (220.0, 260.0))
    uniform = uniform_speed(start)
    calm = drives(start, uniform[None, :, None], 4.0)
    found = evaluate.judge_ring(start, calm)
    assert found["passed"] and found["speed_ratio"] == pytest.approx(1.0, rel=1e-4) and found["speed_std"] < 1e-5
    assert found["time_gap"] == pytest.approx(4.0 / float(uniform.max()))
    for share, passed in ((0.975, True), (0.965, False)):
        slow = calm._replace(speed=calm.speed * torch.tensor([share, 1.0])[None, :, None])
        found = evaluate.judge_ring(start, slow)
        assert found["passed"] == passed and found["speed_ratio"] == pytest.approx(share, rel=1e-4)
    for height, passed in ((0.14, True), (0.16, False)):
        waves = calm.speed + torch.tensor([0.0, height])[None, :, None] * (-1.0) ** torch.arange(22)
        found = evaluate.judge_ring(start, calm._replace(speed=waves))
        assert found["passed"] == passed and found["speed_std"] == pytest.approx(height, rel=1e-3)
    close = evaluate.judge_ring(start, calm._replace(gap=calm.gap * 0.9))
    assert not close["passed"] and close["time_gap"] < 0.8
    crash = calm.gap.clone()
    crash[0, 1, 3] = -0.1  # long before the last 100 s
    found = evaluate.judge_ring(start, calm._replace(gap=crash))
    assert not found["passed"] and found["collisions"] == 1


@pytest.mark.parametrize(
    ("passed", "first"),
    [("", None), ("011111", 1), ("11111", 0), ("01111", None), ("111110", None), ("111101111111", 5), ("0000", None)],
)
def test_solved_means_five_in_a_row_and_kept(passed, first):
    assert solved_at([{"passed": x == "1"} for x in passed]) == first


def test_a_better_evaluation_has_a_higher_score():
    row = {"speed_ratio": 0.9, "speed_std": 0.2, "time_gap": 1.0, "collisions": 0}
    better = ({"speed_ratio": 0.95}, {"speed_std": 0.1})
    worse = ({"time_gap": 0.5}, {"collisions": 1})
    assert all(evaluate.score({**row, **x}) > evaluate.score(row) for x in better)
    assert all(evaluate.score({**row, **x}) < evaluate.score(row) for x in worse)
    assert evaluate.score({"reward": 0.3, "speed_ratio": 9.0}) == 0.3


def test_humans_make_waves_and_pi_with_saturation_dissolves_young_ones():
    human = evaluate.evaluate_ring(None, RING, (230.0,), warmup=750)
    calm = evaluate.evaluate_ring(PISaturation(TASK), RING, (230.0,), warmup=750)
    assert not human["passed"] and human["speed_ratio"] < 0.8 and human["speed_std"] > 2.0
    assert calm["passed"] and calm["time_gap"] > 0.8
    assert calm == evaluate.evaluate_ring(PISaturation(TASK), RING, (230.0,), warmup=750)  # repeatable


def test_observations_of_the_ring_are_unpacked():
    start = ring_start(RING, (240.0,))
    view, state = seen(start.task.observe(start.world).flatten(1), start.task), start.world.state
    assert torch.allclose(view.speed, state.speed[:, :1], atol=1e-4)
    assert torch.allclose(view.lead_speed, state.speed[:, -1:], atol=1e-4)
    assert torch.allclose(view.gap, state.gap[:, :1], atol=1e-3)


def view_of(speed, lead_speed, gap):
    return Seen(*(torch.tensor([[float(x)]]) for x in (speed, lead_speed, gap)))


@pytest.mark.parametrize(
    ("speed", "lead", "gap", "command"),
    [
        (5.0, 5.0, 4.0, 0.0),  # too near
        (5.0, 3.0, 5.0, 0.0),  # the first zone grows by Δv²/(2 · 1.5) = 1.33 m
        (2.0, 2.0, 4.875, 1.0),  # half way through the second zone: half of v*
        (2.0, 2.0, 5.625, 3.0),  # half way through the third: between v* = 2 and U = 4
        (5.0, 5.0, 5.25, 4.0),  # v* is at most U
        (1.0, 9.0, 7.0, 4.0),  # free
    ],
)
def test_follower_stopper_in_its_zones(speed, lead, gap, command):
    controller = FollowerStopper(TASK, desired=4.0)
    assert float(controller.wanted(view_of(speed, lead, gap))) == pytest.approx(command, abs=1e-5)


def test_pi_follows_the_mean_of_its_own_speed():
    controller = PISaturation(TASK, seconds=1.0)
    for speed in [2.0] * 10 + [4.0] * 5:
        controller.wanted(view_of(speed, speed, 7.0))
    before = float(controller._command)
    found = controller.wanted(view_of(4.0, 4.0, 7.0))
    # Of the last ten speeds six are 4 m/s; a gap of 7 m adds nothing, α = 1 and β = ½.
    assert float(found) == pytest.approx(0.5 * (4 * 2.0 + 6 * 4.0) / 10 + 0.5 * before, abs=1e-5)


def test_every_controller_is_made_and_commands_within_bounds():
    start = ring_start(RING, (220.0, 270.0))
    observation = start.task.observe(start.world).flatten(1)
    made = controllers(RING, (220.0, 270.0), (0,))
    assert next(iter(made)) == "IDM for all" and made["IDM for all"]() is None
    for name, make in made.items():
        if name != "IDM for all":
            action = make()(observation)
            assert action.shape == (2, 1) and bool((action.abs() <= 1.0).all())


def test_following_is_judged_against_leader_and_human():
    follow = {"task": "follow", "max_command": 3.0}
    human = evaluate.evaluate_follow(None, follow, count=2)
    assert human["collisions"] == 0 and human["litres"] > 0.0 and human["time_gap"] > 0.8
    assert human["leader_litres"] == pytest.approx(human["litres"], rel=0.2)
    stopping = evaluate.evaluate_follow(lambda o: -torch.ones(len(o), 1), follow, count=2)
    assert stopping["reward"] < human["reward"] and stopping["spacing"] > human["spacing"]
    # IDM does not pass: it keeps less than the task's distances.
    assert not human["passed"] and human["reward"] < evaluate.FOLLOW_REWARD


def test_fresh_stretches_are_others(monkeypatch):
    starts = []
    drive = evaluate.drive
    monkeypatch.setattr(evaluate, "drive", lambda start, *rest: starts.append(start) or drive(start, *rest))
    for draws in ((0,), (1, 2)):
        evaluate.evaluate_follow(None, {"task": "follow", "max_command": 3.0, "max_episode_steps": 20}, 3, draws)
    one, two = (start.seeds for start in starts)
    assert (len(one), len(two)) == (3, 6) and not set(one) & set(two) and len(set(two)) == 6


def test_a_task_without_a_test_is_told():
    with pytest.raises(ValueError, match="task 'platoon' has no test of agents"):
        evaluate.as_judged({"task": "platoon"})


def test_agents_are_judged_with_a_shock_that_training_does_not_have():
    guarded = {**RING, "failsafe": 3.0}
    assert evaluate.as_judged(guarded) == {**guarded, "shock": 4.0, "shock_after": 120.0}
    assert evaluate.as_judged({"warmup": 5, "parameters": {"idm.max_accel": 0.8}}, {"parameters": {}}) == {
        "warmup": 5, "parameters": {}, "shock": 4.0, "shock_after": 120.0,
    }  # fmt: skip
    assert evaluate.as_judged({"task": "follow"}) == {"task": "follow", "reward": "source"}
    calm, shocked = (
        evaluate.evaluate_ring(no_command, {**guarded, "shock": x, "shock_after": 120.0}, (260.0,), 750)
        for x in (0.0, 4.0)
    )
    assert calm["passed"] and not shocked["passed"]


def test_held_out_covers_lengths_and_drivers(monkeypatch):
    monkeypatch.setattr(evaluate, "STEPS", 12)
    monkeypatch.setattr(evaluate, "JUDGED", 10)
    found = evaluate.held_out(None, RING)
    assert len(found["lengths"]["ratios"]) == 11
    cases = [name for name in found if name.endswith("20 %")]
    assert len(cases) == 10 and "mixed" in found
    assert found["drivers"]["speed_ratio"] == min(found[name]["speed_ratio"] for name in cases)
    assert found["drivers"]["time_gap"] == min(found[name]["time_gap"] for name in cases)


def test_a_later_take_over_finds_a_deeper_wave_and_a_failsafe_survives_it():
    early, late = (ring_start(RING, (230.0, 260.0), warmup).world.state.speed.std() for warmup in (750, 3000))
    assert late > 1.5 * early

    def reckless(observation):
        return torch.ones(len(observation), 1)

    touched = evaluate.evaluate_ring(reckless, RING, (230.0, 260.0), warmup=3000)
    guarded = evaluate.evaluate_ring(reckless, {**RING, "failsafe": 3.0}, (230.0, 260.0), warmup=3000)
    assert touched["collisions"] == 2 and guarded["collisions"] == 0


def test_doing_nothing_calms_a_young_wave_only():
    """Why agents are judged in a grown one."""
    guarded = {**RING, "failsafe": 3.0}
    young, grown = (evaluate.evaluate_ring(no_command, guarded, warmup=warmup) for warmup in (750, 3000))
    assert young["speed_ratio"] > 0.94 and young["speed_std"] < 0.05
    assert not grown["passed"] and grown["speed_ratio"] < 0.1


def test_draws_differ_and_lengths_stay_together():
    start = ring_start(RING, (220.0, 260.0), 100, draws=(0, 1, 2))
    around = (start.world.state.gap + start.world.state.length).sum(-1)
    assert torch.allclose(around, torch.tensor([220.0] * 3 + [260.0] * 3))
    speed = start.world.state.speed
    assert not torch.equal(speed[0], speed[1]) and not torch.equal(speed[1], speed[2])
    alone = ring_start(RING, (220.0, 260.0), 100, draws=(1,)).world.state.speed
    assert torch.allclose(alone, speed[[1, 4]])


def test_mixed_drivers_are_within_a_fifth_of_the_given_ones():
    drawn = evaluate.mixed({**RING, "parameters": {"idm": {"time_gap": 1.5}}})["parameters"]["idm"]
    time_gap = torch.tensor(drawn["time_gap"]) / 1.5
    assert set(drawn) == {"max_accel", "comfort_decel", "time_gap", "min_gap", "desired_speed"}
    assert len(time_gap) == 22 and 0.8 <= float(time_gap.min()) < 0.9 and 1.1 < float(time_gap.max()) <= 1.2


def test_a_saved_policy_is_evaluated_and_filmed(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(evaluate, "STEPS", 20)
    monkeypatch.setattr(evaluate, "JUDGED", 10)
    common.save(tmp_path / "a.pt", Policy(3, (4,)), "apg", {**RING, "warmup": 5}, {})
    words = [str(tmp_path / "a.pt"), "--video", str(tmp_path / "a.gif"), "--picture", str(tmp_path / "a.png")]
    evaluate.main([*words, "--steps", "12", "--human", "5"])
    printed = capsys.readouterr().out
    assert "human {" in printed and "apg {" in printed
    with Image.open(tmp_path / "a.gif") as film:
        assert film.n_frames == 2 and film.size == (300, 300)  # 1.7 s, a picture a second
        film.seek(1)
        assert (30, 90, 220) in {colour for _, colour in film.convert("RGB").getcolors()}  # the agent's mark survives
    assert (tmp_path / "a.png").stat().st_size > 1000


def test_a_road_of_several_lanes_is_drawn_with_a_panel_for_each(tmp_path, monkeypatch):
    from idm_env.reports import diagrams

    drawn = []
    space_time = diagrams.space_time
    monkeypatch.setattr(diagrams, "space_time", lambda panels, **k: drawn.extend(panels) or space_time(panels, **k))
    policy = Policy(len(task_of({"task": "merge"}).bounds.names), (4,))
    evaluate.picture(tmp_path / "a.png", {"task": "merge"}, policy, 0, 30)
    assert [p.title.split(",")[0] for p in drawn] == ["lane 2", "lane 1", "lane 0"]
    assert any(line.marked for panel in drawn for line in panel.lines) and (tmp_path / "a.png").exists()


def test_a_wrong_file_is_told_in_one_line(tmp_path):
    with pytest.raises(SystemExit, match=r"error: .*none\.pt is not a file"):
        evaluate.main([str(tmp_path / "none.pt")])


def test_a_kind_of_drivers_is_what_its_name_says():
    made = kinds({"task": "ring", "parameters": {"idm": {"time_gap": 1.5}}})
    assert len(made) == 10
    for name, factor in (("time_gap −20 %", 0.8), ("time_gap +20 %", 1.2)):
        start = ring_start(made[name], (230.0,), 5)
        assert float(start.params["idm"]["time_gap"]) == pytest.approx(1.5 * factor)
        assert float(start.params["idm"]["max_accel"]) == 1.0


def test_drivers_are_told_by_dotted_names_and_as_mappings_and_other_effects_stay():
    """With a number or one for each vehicle."""
    dotted = {"task": "ring", "parameters": {"idm.time_gap": 1.5, "noise.sigma": 0.3}}
    as_mapping = {"task": "ring", "parameters": {"idm": {"time_gap": 1.5}, "noise": {"sigma": 0.3}}}
    assert evaluate.drivers_of(dotted) == evaluate.drivers_of(as_mapping)
    assert evaluate.drivers_of(dotted)["time_gap"] == 1.5
    for made in (*kinds(dotted).values(), evaluate.mixed(dotted)):
        assert made["parameters"]["noise"] == {"sigma": 0.3}
    assert kinds(dotted)["time_gap +20 %"] == kinds(as_mapping)["time_gap +20 %"]
    each = {"task": "ring", "parameters": {"idm.time_gap": [1.0] * 11 + [2.0] * 11}}
    assert kinds(each)["time_gap −20 %"]["parameters"]["idm"]["time_gap"] == [0.8] * 11 + [1.6] * 11


def test_a_task_keeps_the_length_of_its_episodes_and_a_test_has_its_own():
    """Agents of a record are those who are there for so long."""
    assert task_of({"task": "follow", "max_episode_steps": 70}).horizon == 70
    assert evaluate.as_judged({"task": "follow", "max_episode_steps": 70}) == {
        "task": "follow",
        "reward": "source",
    }


def test_held_actions_are_judged_over_the_same_time():
    """Human drivers do the same whatever is held."""
    once, held = ({**RING, "hold": hold} for hold in (0.1, 1.0))
    one, other = (evaluate.evaluate_ring(None, e, (230.0,), warmup=750) for e in (once, held))
    assert other["speed_ratio"] == pytest.approx(one["speed_ratio"], rel=0.02)
    assert other["speed_std"] == pytest.approx(one["speed_std"], rel=0.05)
    follow = [evaluate.evaluate_follow(None, {"task": "follow", "hold": hold}, 2) for hold in (0.1, 1.0)]
    assert follow[1]["litres"] == pytest.approx(follow[0]["litres"], rel=0.05)
    assert follow[1]["reward"] == pytest.approx(follow[0]["reward"], rel=0.01)  # a held step pays the mean
