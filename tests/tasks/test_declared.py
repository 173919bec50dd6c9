"""What is observed and rewarded by choice: laws over all features and terms, in every task, and those of one's own."""

import re

import gymnasium as gym
import pytest
import torch

from idm_env.envs.settings import settings
from idm_env.tasks import FEATURES, REWARD_TERMS, TASKS, AgentView, Draw, Feature, RewardTerm, Transition, make_task

ALL_FEATURES = {"features": list(FEATURES), "vehicles": 3}
OWN = """
from idm_env.tasks import Feature, RewardTerm

def approach(view):
    return (view.own(view.state.speed) - view.leader(view.state.speed)) / view.own(view.state.gap).clamp_min(0.1)

rate = Feature("approach", "Δv/s", "1/s", 0.5, -10.0, 10.0, approach)
danger = RewardTerm("danger", "max(0, Δv/s)", "1/s", 0.0, 10.0, lambda step: approach(step.view).relu())
"""


def wild(task, count=200):
    """Worlds in states that no traffic has, with gradients."""
    draw = Draw.of(torch.arange(count), torch.zeros(count, dtype=torch.int64))
    params = task.params(torch.float64, "cpu")
    before = task.begin(draw, params)
    u = draw.uniforms(3, 3 * task.vehicles, torch.float64).view(count, 3, task.vehicles)
    numbers = {"speed": 150.0 * u[:, 0] ** 2, "accel": 60.0 * u[:, 1] - 30.0, "gap": 3e3 * u[:, 2] ** 4 + 1e-3}
    after = before._replace(state=before.state._replace(**numbers))
    return before, task.command(2.0 * u[:, 1, : len(task.agents)] - 1.0), after


def paid(task, *worlds):
    """What a step of Δt without a crash pays."""
    return sum(task.weighted.parts(Transition(task, *worlds)).values())


@pytest.mark.parametrize("task", TASKS)
def test_every_feature_keeps_its_bounds_and_every_term_its_own_in_every_task(task):
    made = make_task(task, controlled=2, observation=ALL_FEATURES)
    before, command, after = wild(made)
    seen = made.observe(after)
    low, high = (torch.tensor(ends, dtype=torch.float64) for ends in made.bounds[1:])
    assert seen.shape == (len(command), 2, 3 * len(FEATURES))
    assert bool(torch.isfinite(seen).all()) and bool(((seen >= low) & (seen <= high)).all())
    for name in REWARD_TERMS:
        for weight in (2.0, -3.0):
            one = make_task(task, controlled=2, reward={name: weight})
            pays = one.held * paid(one, before, command, after)
            assert pays.shape == command.shape
            assert one.reward_range.low <= float(pays.min()) <= float(pays.max()) <= one.reward_range.high
            assert one.reward_range.low <= 0.0 <= one.reward_range.high


@pytest.mark.parametrize("task", ["ring", "follow", "merge"])
def test_gradients_of_features_and_terms_are_differences(task):
    seen, pays = {**ALL_FEATURES, "scaling": "raw"}, dict.fromkeys(REWARD_TERMS, 0.5)
    few = {"vehicles": 12} if task == "merge" else {}
    made = make_task(task, controlled=2, observation=seen, reward=pays, **few)
    before, _, _ = wild(made, 3)
    present = before.state.present
    calm = torch.linspace(0.9, 1.1, before.state.speed.shape[-1], dtype=torch.float64)
    x = torch.stack((12.0 * calm, 0.3 * calm.flip(-1), 18.0 * calm.square())).unsqueeze(1).repeat(1, 3, 1)
    command = torch.full((3, 2), 0.4, dtype=torch.float64)
    if present is not None:
        before = before._replace(state=before.state._replace(present=torch.ones_like(present)))

    def told(x):
        after = before._replace(state=before.state._replace(speed=x[0], accel=x[1], gap=x[2]))
        return made.observe(after), paid(made, before, command, after)

    assert torch.autograd.gradcheck(told, x.requires_grad_(), eps=1e-5, atol=1e-6)


def test_vehicles_ahead_are_those_that_lead():
    task = make_task(
        "ring", controlled=2, observation={"features": ["gap", "lead_speed"], "vehicles": 2, "scaling": "raw"}
    )
    _, _, after = wild(task, 4)
    state = after.state._replace(speed=after.state.speed.clamp_max(90.0), gap=after.state.gap.clamp_max(900.0))
    seen = task.observe(after._replace(state=state))
    for slot, i in enumerate(task.agents):
        expected = [state.gap[:, i], state.speed[:, i - 1], state.gap[:, i - 1], state.speed[:, i - 2]]
        assert torch.equal(seen[:, slot], torch.stack(expected, dim=-1))


def test_terms_make_the_ring_its_own_reward():
    own, made = make_task("ring", reward="flow"), make_task("ring", reward={"speed": 0.2, "effort": -4.0})
    worlds = wild(own)
    assert torch.equal(paid(own, *worlds), paid(made, *worlds))


def test_those_of_a_file_are_run_only_if_it_is_trusted(tmp_path):
    file = tmp_path / "near.py"
    file.write_text(OWN)
    keywords = {
        "observation": {"features": ["speed", f"{file}:rate"]},
        "reward": {f"{file}:danger": -1.0, "speed": 0.2},
    }
    config = tmp_path / "near.yaml"
    config.write_text(
        f"configures: environment\ntask: ring\nobservation: {{features: [speed, '{file}:rate']}}\n"
        f"reward: {{speed: 0.2, '{file}:danger': -1.0}}\n"
    )
    for refused in (lambda: make_task("ring", **keywords), lambda: settings(config=str(config))):
        with pytest.raises(ValueError, match=r"is not run unasked.*--trust") as told:
            refused()
        assert "\n" not in str(told.value)
    env = gym.make("DiffIDM-v0", config=str(config), trusted=True)
    assert env.unwrapped.task.bounds.names == ("speed", "approach")
    env.reset(seed=0)
    assert env.step(env.action_space.sample())[0].shape == (2,)
    assert make_task("ring", **keywords, trusted=True).reward_range.low == -10.0


def test_objects_of_ones_own_and_what_they_must_be():
    wavy = Feature("wave", "", "", 1.0, -1.0, 1.0, lambda view: view.own(view.state.speed).sin())
    bonus = RewardTerm("bonus", "", "", 0.0, 1.0, lambda step: step.command * 0.0 + 1.0)
    task = make_task("follow", observation={"features": [wavy]}, reward={bonus: 0.5})
    worlds = wild(task)
    assert AgentView(task, worlds[0]).state is worlds[0].state and Transition(task, *worlds).view.ahead == 0
    assert task.bounds.names == ("wave",) and bool((paid(task, *worlds) == 0.5).all())
    with pytest.raises(ValueError, match="low below its high"):
        Feature("flat", "", "", 1.0, 1.0, 1.0, wavy.read)
    with pytest.raises(ValueError, match="low below its high"):
        RewardTerm("flat", "", "", 1.0, 1.0, bonus.of)


@pytest.mark.parametrize(
    ("keywords", "said"),
    [
        ({"observation": {"features": ["sped"]}}, "observation.features: 'sped' is unknown. Did you mean 'speed'?"),
        ({"observation": {"features": []}}, "observation.features must be a list of at least one"),
        ({"observation": {"features": "speed"}}, "observation.features must be a list"),
        ({"observation": {"features": ["gap", "gap"]}}, "must name none twice"),
        ({"observation": {"features": ["gap"], "vehicles": 0}}, "observation.vehicles = 0 must be at least 1"),
        ({"observation": {"vehicles": 2}}, "observation.vehicles needs observation.features"),
        ({"observation": {"feature": ["gap"]}}, "observation = 'feature' is unknown. Did you mean 'features'?"),
        ({"observation": {"features": [3]}}, "observation.features: 3 is unknown."),
        ({"reward": {"spead": 1.0}}, "reward: 'spead' is unknown. Did you mean 'speed'?"),
        ({"reward": {"speed": float("nan")}}, "reward.speed = nan must be"),
        ({"reward": {"speed": "much"}}, "reward.speed = 'much' must be"),
        ({"reward": {}}, "reward must give weights of terms"),
        ({"reward": "speed"}, "reward = 'speed' is unknown."),
    ],
)
def test_what_cannot_be_is_told_in_one_line(keywords, said):
    with pytest.raises(ValueError, match=re.escape(said)) as told:
        make_task("ring", **keywords)
    assert "\n" not in str(told.value)
