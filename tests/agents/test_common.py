"""What agents share: arguments, policies, checkpoints, updates, and episodes that go on where they were."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from agents import apg, classical, common, distil, environments, evaluate, imitation, ppo, shac
from agents.common import DivergedError
from agents.policy import Policy

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
KINDS = {module.__name__.split(".")[-1]: module.Arguments for module in (apg, shac, ppo, imitation, distil)}
AGENTS = sorted(p for p in CONFIGS.glob("*-*.yaml"))


def kind_of(path: Path) -> str:
    return next(line.split(":")[1].strip() for line in path.read_text().splitlines() if line.startswith("agent:"))


@pytest.mark.parametrize("path", AGENTS, ids=lambda p: p.stem)
def test_every_configuration_is_read_and_makes_its_task(path):
    agent = kind_of(path)
    found = common.load_agent(path, KINDS[agent], agent)
    task = environments.task_of(found.environment)
    assert task.name == path.stem.split("-")[0].replace("i80", "follow")
    assert isinstance(found.learning_rate, float)  # YAML reads 1e-3 as text


def write(path: Path, text: str) -> Path:
    path.write_text("configures: agent\nagent: apg\n" + text)
    return path


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("windw: 3", "unknown key 'windw'. Did you mean 'window'?"),
        ("window: many", "window = 'many' must be a number"),
        ("resume: 1", "resume = 1 must be true or false"),
        ("seed: true", "seed = True must be no bool"),
        ("environment: ring", "environment = 'ring' must be a mapping"),
        ("environment: {config: nowhere.yaml}", "nowhere.yaml is not a file"),
        ("environment: {config: 5}", "environment.config = 5"),
        ("hidden: 5", "hidden = 5 must be a list, such as [32, 32]"),
        ("hidden: '32'", "hidden = '32' must be a list"),
        ("hidden: [8, x]", "hidden[1] = 'x' must be a number"),
        ("out: 5", "out = 5 must be a path"),
        ("updates: 1.7", "updates = 1.7 must be a whole number"),
        ("count: 0", "count = 0 must be at least 1"),
        ("window: -5", "window = -5 must be at least 1"),
        ("hidden: [8, -3]", "hidden = (8, -3) must be at least 1"),
        ("log: cvs", "log = 'cvs' is unknown. Did you mean 'csv'?"),
        ("environment: {task: ring, dtype: float64}", "dtype = 'float64': agents learn in float32"),
    ],
)
def test_a_bad_configuration_is_told_in_one_line(tmp_path, text, words):
    with pytest.raises(ValueError) as told:
        common.load_agent(write(tmp_path / "a.yaml", text), apg.Arguments, "apg")
    assert words in str(told.value) and "\n" not in str(told.value)


def test_a_file_of_something_else_is_refused(tmp_path):
    with pytest.raises(ValueError, match="no agent is configured here"):
        common.load_agent(CONFIGS / "ring.yaml", apg.Arguments, "apg")
    with pytest.raises(ValueError, match="not a file for shac"):
        common.load_agent(CONFIGS / "ring-apg.yaml", shac.Arguments, "shac")
    with pytest.raises(ValueError, match=r"no\.yaml is not a file"):
        common.load_agent(tmp_path / "no.yaml", apg.Arguments, "apg")


def test_the_command_line_wins_over_the_file(tmp_path):
    file = write(tmp_path / "a.yaml", "window: 7\nseed: 3\nenvironment: {task: ring, length: 230}\nhidden: [5]")
    found = common.parse(apg.Arguments, "apg", ["--config", str(file), "--seed", "4"])
    assert (found.window, found.seed, found.environment["length"], found.hidden) == (7, 4, 230, (5,))


def test_an_unknown_keyword_of_the_environment_is_told(quick):
    quick["environment"]["lenght"] = 100
    with pytest.raises(ValueError, match="Did you mean 'length'"):
        apg.train(apg.Arguments(**quick))


@pytest.mark.parametrize("squash", ["tanh", "clip"])
def test_policy_predicts_as_stable_baselines3_does(squash):
    torch.manual_seed(0)
    policy = Policy(3, (8,), squash=squash)
    with torch.no_grad():
        policy.body[-1].weight.mul_(1e4)
    seen = np.random.default_rng(0).normal(size=(5, 6)).astype(np.float32)  # two agents
    action, state = policy.predict(seen, state="kept", deterministic=True)
    assert action.shape == (5, 2) and action.dtype == np.float32 and state == "kept"
    assert np.abs(action).max() <= 1.0
    assert np.allclose(action[:, 1], policy.predict(seen[:, 3:])[0][:, 0])  # every agent has the same network
    assert np.allclose(policy.predict(seen[0])[0], action[0])


def test_checkpoint_gives_back_the_policy(tmp_path, ring):
    policy = Policy(3, (4,), activation="relu")
    policy.mean.fill_(0.5)
    common.save(tmp_path / "a.pt", policy, "apg", ring, {"update": 3})
    again, content = common.load(tmp_path / "a.pt", "ring", "apg")
    seen = torch.randn(4, 3)
    assert torch.equal(policy(seen), again(seen)) and content["training"]["update"] == 3


def test_checkpoints_of_another_task_agent_version_or_kind_are_refused(tmp_path, ring):
    path = tmp_path / "a.pt"
    common.save(path, Policy(3), "apg", ring, {})
    with pytest.raises(ValueError, match="of task 'ring', and 'follow' is wanted"):
        common.load(path, "follow")
    with pytest.raises(ValueError, match="of agent 'apg', and 'shac' is wanted"):
        common.load(path, "ring", "shac")
    content = torch.load(path, weights_only=True)
    for key, value, words in (
        ("schema", 99, "layout 99; this version reads layout 2"),
        (
            "features",
            ["speed", "gap"],
            "on observations speed / 5, gap / 1; task 'ring' now gives speed / 5, relative_speed / 1, headway / 10",
        ),
        ("scales", [15.0, 15.0, 270.0], "on observations speed / 15, relative_speed / 15, headway / 270; task"),
    ):
        torch.save({**content, key: value}, path)
        with pytest.raises(ValueError, match=words):
            common.load(path)
    path.write_text("no checkpoint")
    with pytest.raises(ValueError, match="is not a checkpoint"):
        common.load(path)
    with pytest.raises(ValueError, match="is not a file"):
        common.load(tmp_path / "none.pt")


def test_the_norm_of_a_step_is_clipped():
    weight = torch.nn.Parameter(torch.tensor([3.0, 4.0]))
    step = torch.optim.SGD([weight], lr=1.0)
    norm = common.descend((weight * weight).sum() * 5.0, [weight], step, 1.0, 0, Path("kept"))
    assert norm == pytest.approx(50.0)
    assert torch.allclose(weight.detach(), torch.tensor([3.0 - 0.6, 4.0 - 0.8]))


@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_a_loss_that_is_not_finite_stops_before_the_step(bad):
    weight = torch.nn.Parameter(torch.ones(2))
    step = torch.optim.Adam([weight])
    with pytest.raises(DivergedError, match=r"update 12: loss (nan|inf).*gradient norm.*last\.pt"):
        common.descend((weight * bad).sum(), [weight], step, 1.0, 12, Path("last.pt"))
    assert torch.equal(weight.detach(), torch.ones(2))


def test_the_learning_rate_falls_with_the_count_of_updates():
    rates = [common.fall(2.0, i, 11) for i in range(11)]
    assert rates[0] == 2.0 and rates[-1] == pytest.approx(0.2) and rates[5] == pytest.approx(1.1)
    assert rates == sorted(rates, reverse=True)


def driven(env, steps):
    seen = []
    for i in range(steps):
        observation, reward, *_ = env.step(torch.full((env.num_envs, 1), 0.1 * (i % 3)))
        seen.append(torch.cat((observation, reward.unsqueeze(-1)), -1))
    return torch.stack(seen)


def both(ring):
    return [ring, {"task": "follow", "vehicles": 4, "max_episode_steps": 60}]


def test_episodes_end_one_after_the_other(ring):
    for keywords in both(ring):
        env = environments.make_env(keywords, 6, output="torch")
        env.reset(seed=0)
        plain = env.state
        environments.desynchronise(env)
        assert torch.equal(env.state.position, plain.position)
        ends = []
        for t in range(60):
            _, _, terminated, truncated, _ = env.step(torch.zeros(6, 1))
            assert not terminated.any()
            ends += [t + 1] * int(truncated.sum())
        assert ends == [10, 20, 30, 40, 50, 60]


def test_the_record_does_not_jump_when_clocks_are_set_apart():
    env = environments.make_env({"task": "follow", "vehicles": 4, "max_episode_steps": 60}, 6, output="torch")
    env.reset(seed=0)
    environments.desynchronise(env)
    before = env.state
    env.step(torch.zeros(6, 1))
    moved = (env.state.position - before.position)[:, 0]
    assert torch.allclose(moved, 0.1 * before.speed[:, 0], atol=0.05)


def test_restored_episodes_go_on_exactly(ring):
    for keywords in both({**ring, "effects": ["delay"]}):
        env = environments.make_env(keywords, 5, output="torch")
        env.reset(seed=3)
        environments.desynchronise(env)
        driven(env, 25)
        saved, wanted = environments.snapshot(env), driven(env, 70)
        other = environments.make_env(keywords, 5, output="torch")
        observation = environments.restore(other, saved)
        assert torch.equal(observation, environments.restore(env, saved))
        assert torch.equal(driven(other, 70), wanted)


def test_cloning_learns_what_humans_do(ring):
    torch.manual_seed(0)
    seen, actions = environments.human_driving({**ring, "noise": 0.0}, 5, count=8, steps=200)
    assert len(seen) == len(actions) <= 8 * 200 and float(actions.std()) > 0.0
    policy = Policy(3, (16, 16))
    policy.mean.copy_(seen.mean(0))
    policy.scale.copy_(seen.std(0))
    assert common.clone(policy, seen, actions, 300) < 0.1 * float(actions.var())


@pytest.mark.parametrize(
    ("module", "arguments", "words"),
    [
        (ppo, ["--config", "CONFIG", "--algorithm", "ppo"], "this is not a file for ppo"),
        (apg, ["--out", "FILE", "--updates", "1"], "File exists"),
        (classical, ["--config", "nowhere.yaml"], "nowhere.yaml is not a file"),
        (evaluate, ["nowhere.pt"], "nowhere.pt is not a file"),
        (evaluate, ["nowhere.pt", "--steps", "0"], "steps = 0 must be at least 1"),
    ],
)
def test_the_command_line_tells_in_one_line(module, arguments, words, tmp_path):
    file = tmp_path / "file"
    file.write_text("")
    given = {"CONFIG": str(CONFIGS / "ring-apg.yaml"), "FILE": str(file)}
    with pytest.raises(SystemExit) as told:
        module.main([given.get(word, word) for word in arguments])
    assert words in str(told.value) and "\n" not in str(told.value)


def test_a_training_overwrites_neither_its_configuration_nor_what_no_agent_wrote(tmp_path):
    config = tmp_path / "agent.yaml"
    config.write_text("configures: agent\nagent: apg\n")
    (tmp_path / "run").mkdir()
    last = tmp_path / "run" / "last.pt"
    last.symlink_to(config)
    given = ["--config", str(config), "--out", str(tmp_path / "run")]
    with pytest.raises(ValueError, match="is an input, and"):
        common.parse(apg.Arguments, "apg", given)
    last.unlink()
    last.write_text("mine")
    with pytest.raises(ValueError, match="is not a checkpoint of an agent, or is broken"):
        common.parse(apg.Arguments, "apg", given)
    assert last.read_text() == "mine" and config.read_text().startswith("configures")


def test_an_interruption_says_how_to_go_on(capsys):
    def train(arguments):
        raise KeyboardInterrupt

    with pytest.raises(SystemExit) as told:
        common.command_line(train, apg.Arguments, "apg", [])
    assert told.value.code == 130 and "--resume" in capsys.readouterr().err
