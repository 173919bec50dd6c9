"""Trainings: repeatable, resumable, stopped by NaN with the last good checkpoint, and by their clock."""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import io
import os
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch

from agents import apg, common, environments, ppo, shac
from agents.common import DivergedError
from agents.policy import Policy
from idm_env.envs.window import driver_of
from idm_env.tasks.ring import RingTask
from tests.agents.conftest import PASSED

SMALL = {"count": 4, "window": 20}
AGENTS = {
    "apg": (apg, apg.Arguments, SMALL),
    "shac": (shac, shac.Arguments, {**SMALL, "critic_first": 1, "critic_epochs": 2}),
    "ppo": (ppo, ppo.Arguments, {"count": 4, "n_steps": 16, "batch_size": 32, "n_epochs": 2, "hold": 2}),
    "sac": (ppo, ppo.Arguments, {
        "count": 4, "n_steps": 16, "batch_size": 32, "algorithm": "sac", "learning_starts": 16, "ent_coef": "auto",
    }),
}  # fmt: skip


def weights(path: Path) -> dict[str, torch.Tensor]:
    return torch.load(path, weights_only=True)["policy"]["state"]


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return all(torch.equal(a[k], b[k]) for k in a)


@pytest.mark.parametrize("name", AGENTS)
def test_the_same_seed_gives_the_same_policy_and_another_seed_another(name, quick, tmp_path):
    module, kind, small = AGENTS[name]
    for out, seed in (("a", 1), ("b", 1), ("c", 2)):
        history = module.train(kind(**{**quick, "out": tmp_path / out, "seed": seed, "updates": 2}, **small))
        assert [row["updates"] for row in history] == [0, 1, 2]  # the first is of the policy before any update
    a, b, c = (weights(tmp_path / out / "last.pt") for out in "abc")
    assert same(a, b) and not same(a, c)


@pytest.mark.parametrize("name", AGENTS)
def test_a_resumed_training_goes_on_where_it_was(name, quick):
    module, kind, small = AGENTS[name]
    whole = kind(**quick, **small)
    first = module.train(dataclasses.replace(whole, cpu_seconds=1e-9))
    assert len(first) == 2  # the clock stops it after the first update
    history = module.train(dataclasses.replace(whole, resume=True))
    assert [row["updates"] for row in history] == [0, 1, 2, 3, 4]
    assert [row["steps"] for row in history] == [first[1]["steps"] * k for k in range(5)]
    assert history[2]["cpu_seconds"] > history[1]["cpu_seconds"] == first[1]["cpu_seconds"]
    rows = [(whole.out / "log" / part / "progress.csv").read_text().splitlines() for part in ("", "from1")]
    assert [len(part) - 1 for part in rows] == [2, 3]  # what was logged before stays


def test_evaluations_come_after_so_many_updates_however_long_they_take(quick, monkeypatch):
    """The same rows on every machine, and one after the last update."""
    seconds = iter(range(0, 10_000, 100))
    monkeypatch.setattr("agents.monitor.time.process_time", lambda: float(next(seconds)))
    history = apg.train(apg.Arguments(**{**quick, "updates": 5, "evaluate_every": 2}, **SMALL))
    assert [row["updates"] for row in history] == [0, 2, 4, 5]


def test_starts_of_a_warm_up_pool_differ_by_seed(quick):
    """Two seeds have no start in common; of one seed they are the same, whichever agent trains."""
    starts = []
    for seed in (1, 1, 2):
        env = environments.make_env(apg.Arguments(**quick, seed=seed).trained_in, 16, output="torch")
        env.reset(seed=3)
        starts.append(env.state.speed)
    assert torch.equal(starts[0], starts[1])
    assert not (starts[0][:, None] == starts[2]).all(-1).any()


def test_apg_resumes_exactly(quick, tmp_path):
    whole = apg.Arguments(**quick, **SMALL)
    apg.train(dataclasses.replace(whole, out=tmp_path / "whole"))
    apg.train(dataclasses.replace(whole, cpu_seconds=1e-9))
    apg.train(dataclasses.replace(whole, resume=True))
    assert same(weights(tmp_path / "whole" / "last.pt"), weights(whole.out / "last.pt"))


def test_training_may_begin_with_a_policy_of_another_road(quick, tmp_path):
    """As a shared policy does: alone on a short ring first, then two on a long one; what is resumed goes on."""
    first = apg.Arguments(**quick, **SMALL)
    apg.train(first)
    start = first.out / "last.pt"
    several = {**quick["environment"], "vehicles": 16, "controlled": 2, "length": [120.0, 150.0]}
    given = dataclasses.replace(first, environment=several, start=start, out=tmp_path / "several", learning_rate=1e-12)
    apg.train(dataclasses.replace(given, updates=1))
    begun = weights(given.out / "last.pt")
    assert all(torch.allclose(begun[k], weights(start)[k], atol=1e-9) for k in begun)
    apg.train(dataclasses.replace(given, learning_rate=1e-2, updates=3, resume=True))
    assert not same(begun, weights(given.out / "last.pt"))
    file = tmp_path / "several.yaml"
    file.write_text(f"configures: agent\nagent: apg\nstart: {start}\n")
    assert common.load_agent(file, apg.Arguments, "apg").start == start
    raw = {**quick["environment"], "observation": "raw"}
    with pytest.raises(ValueError, match="on other observations than this environment's"):
        apg.train(dataclasses.replace(given, environment=raw, out=tmp_path / "raw"))


class Planted:
    """Code that unpickling runs."""

    def __init__(self, mark):
        self.mark = mark

    def __reduce__(self):
        return os.system, (f"touch {self.mark}",)


@pytest.mark.parametrize("name", ["ppo", "sac"])
def test_a_broken_file_of_a_learner_is_one_line_and_code_in_it_is_not_run(name, quick, tmp_path):
    module, kind, small = AGENTS[name]
    begun = kind(**quick, **{**small, "cpu_seconds": 1e-9})
    module.train(begun)
    path, mark, planted = begun.out / "learner.pt", tmp_path / "it-ran", io.BytesIO()
    whole = torch.load(path, weights_only=True)
    torch.save(whole | {"returns": Planted(mark)}, planted)
    other = io.BytesIO()
    torch.save(whole | {"parameters": {}}, other)
    files = (
        b"",
        b"garbage",
        path.read_bytes()[:-30],
        pickle.dumps(Planted(mark)),
        planted.getvalue(),
        other.getvalue(),
    )
    for broken in files:
        for kept in ("learner.pt", "model.zip", "returns.pkl", "replay.pkl"):  # the last three were SB3's own
            (begun.out / kept).write_bytes(broken)
        with pytest.raises(ValueError, match=r"learner\.pt is broken .*Leave out --resume") as told:
            module.train(dataclasses.replace(begun, resume=True))
        assert "\n" not in str(told.value) and not mark.exists()
    last = begun.out / "last.pt"
    for broken in files[3:5]:
        last.write_bytes(broken)
        with pytest.raises(ValueError, match=r"last\.pt is not a checkpoint of an agent, or is broken"):
            module.train(dataclasses.replace(begun, resume=True))
        assert not mark.exists()


@pytest.mark.parametrize("name", ["ppo", "sac"])
def test_what_a_learner_keeps_is_all_that_it_had(name, quick):
    """Weights, optimisers' moments, entropy's weight, the deviation of returns, counts and memory, to the last bit."""
    module, kind, small = AGENTS[name]
    arguments = kind(**quick, **{**small, "cpu_seconds": 1e-9})
    module.train(arguments)
    kept = torch.load(arguments.out / "learner.pt", weights_only=True)
    env = ppo.VecNormalize(
        ppo.Desynchronised(environments.make_env(arguments.environment, arguments.count, output="numpy"), 2),
        norm_obs=False,
    )
    model = ppo.make_model(dataclasses.replace(arguments, seed=5), env, common.load(arguments.out / "last.pt")[0])
    ppo.goes_on(model, env, kept)
    again = ppo.learned(model, env)
    assert again["steps"] > 0 and again["updates"] > 0 and str(again) == str(kept)
    for mine, other in zip(leaves(again), leaves(kept), strict=True):
        assert torch.equal(mine, other)


def leaves(part):
    """Return all tensors of nested mappings and lists."""
    if isinstance(part, torch.Tensor):
        return [part]
    inside = part.values() if isinstance(part, dict) else part if isinstance(part, (list, tuple)) else ()
    return [leaf for each in inside for leaf in leaves(each)]


def test_sac_resumes_with_its_memory(quick):
    module, kind, small = AGENTS["sac"]
    whole = kind(**quick, **small)
    first = module.train(dataclasses.replace(whole, cpu_seconds=1e-9))
    before = torch.load(whole.out / "learner.pt", weights_only=True)["memory"]
    module.train(dataclasses.replace(whole, resume=True))
    after = torch.load(whole.out / "learner.pt", weights_only=True)["memory"]
    size = first[-1]["steps"] // small["count"]
    for name, rows in before.items():
        assert len(rows) == size and len(after[name]) == 4 * size and torch.equal(after[name][:size], rows)
    assert not list(whole.out.glob("*.part"))


@pytest.mark.parametrize(
    ("name", "change"),
    [("apg", {"hidden": (4, 4)}), ("ppo", {"gamma": 0.5}), ("ppo", {"environment": {"task": "ring", "vehicles": 9}})],
)
def test_a_training_is_not_resumed_as_another(name, change, quick):
    module, kind, small = AGENTS[name]
    begun = kind(**{**quick, "updates": 1}, **small)
    module.train(begun)
    with pytest.raises(ValueError, match=rf"{next(iter(change))} = .* cannot be resumed: .* was begun with"):
        module.train(dataclasses.replace(begun, **change, resume=True))
    module.train(dataclasses.replace(begun, updates=2, learning_rate=1e-4, resume=True))


def test_what_was_begun_with_an_option_that_is_gone_is_told(quick):
    module, kind, small = AGENTS["apg"]
    begun = kind(**{**quick, "updates": 1}, **small)
    module.train(begun)
    last = begun.out / "last.pt"
    policy, content = common.load(last)
    content["training"]["arguments"]["heed"] = 5.0
    common.save(last, policy, "apg", content["environment"], content["training"])
    with pytest.raises(ValueError, match=r"was begun with heed = 5.0, an option that apg does not have any more"):
        module.train(dataclasses.replace(begun, updates=2, resume=True))


def test_a_model_one_chunk_ahead_of_its_checkpoint_is_resumed(quick):
    module, kind, small = AGENTS["ppo"]
    whole = kind(**quick, **small)
    module.train(dataclasses.replace(whole, updates=1))
    before = (whole.out / "last.pt").read_bytes()
    module.train(dataclasses.replace(whole, updates=2, resume=True))
    (whole.out / "last.pt").write_bytes(before)  # as if killed between the two files
    history = module.train(dataclasses.replace(whole, updates=3, resume=True))
    assert [row["updates"] for row in history] == [0, 1, 3]
    assert history[-1]["steps"] == 3 * small["n_steps"] * small["count"] * small["hold"]


def test_nothing_to_resume_is_told(quick):
    with pytest.raises(ValueError, match=r"last\.pt is not a file"):
        apg.train(apg.Arguments(**quick, **SMALL, resume=True))


def test_resuming_another_agents_or_tasks_training_is_refused(quick):
    apg.train(apg.Arguments(**{**quick, "updates": 1}, **SMALL))
    with pytest.raises(ValueError, match="of agent 'apg', and 'shac' is wanted"):
        shac.train(shac.Arguments(**quick, **SMALL, resume=True))
    other = {**quick, "environment": {"task": "follow", "vehicles": 4}}
    with pytest.raises(ValueError, match="of task 'ring', and 'follow' is wanted"):
        apg.train(apg.Arguments(**other, **SMALL, resume=True))


def raising(error: type[BaseException]):
    def fail(*given: object) -> None:
        raise error

    return fail


def break_losses(monkeypatch, update: int) -> None:
    """Make losses NaN in one update of training."""
    plain = common.descend

    def descend(loss, *given):
        return plain(loss * torch.nan if given[3] == update else loss, *given)

    monkeypatch.setattr(common, "descend", descend)


def break_rewards(monkeypatch) -> None:
    """Make all rewards NaN."""
    plain = RingTask.reward_parts
    monkeypatch.setattr(
        RingTask, "reward_parts", lambda self, *given: {n: x * torch.nan for n, x in plain(self, *given).items()}
    )


@pytest.mark.parametrize("name", AGENTS)
def test_nan_before_the_first_checkpoint_is_told_as_such(name, quick, monkeypatch):
    module, kind, small = AGENTS[name]
    break_rewards(monkeypatch)
    with pytest.raises(
        DivergedError, match=r"update [01]: .* must be finite\. (None was kept yet|The last good)"
    ) as told:
        module.train(kind(**quick, **small))
    assert "\n" not in str(told.value)
    if (quick["out"] / "last.pt").exists():
        policy, _ = common.load(quick["out"] / "last.pt")
        assert all(bool(torch.isfinite(p).all()) for p in policy.parameters())


def test_a_critic_that_diverges_before_the_actor_learns_is_not_kept(quick, monkeypatch):
    module, kind, small = AGENTS["shac"]
    break_losses(monkeypatch, update=1)
    with pytest.raises(DivergedError, match="update 1"):
        module.train(kind(**quick, **{**small, "critic_first": 3}))
    kept = common.load(quick["out"] / "last.pt")[1]["training"]
    assert kept["update"] == 0 and all(bool(torch.isfinite(x).all()) for x in kept["critic"].values())


@pytest.mark.parametrize("way_out", [None, KeyboardInterrupt, OSError])
@pytest.mark.parametrize("name", AGENTS)
def test_the_log_is_closed_on_every_way_out(name, way_out, quick, loggers, monkeypatch):
    module, kind, small = AGENTS[name]
    if way_out is not None:
        monkeypatch.setattr("agents.monitor.common.save", raising(way_out))
    with pytest.raises(way_out) if way_out else contextlib.nullcontext():
        module.train(kind(**{**quick, "updates": 1}, **small))
    assert len(loggers) == 1
    assert all(part.file.closed for part in loggers[0].output_formats)


@pytest.mark.parametrize("name", ["apg", "shac"])
def test_nan_stops_with_update_norm_and_the_last_good_checkpoint(name, quick, monkeypatch):
    module, kind, small = AGENTS[name]
    break_losses(monkeypatch, update=2)
    with pytest.raises(DivergedError, match=r"update 2: loss nan and gradient norm nan.*last\.pt") as told:
        module.train(kind(**quick, **small))
    assert "\n" not in str(told.value)
    policy, content = common.load(quick["out"] / "last.pt")
    assert content["training"]["update"] == 1
    assert all(bool(torch.isfinite(p).all()) for p in policy.parameters())


def test_nan_in_the_weights_of_a_baseline_stops_it(quick):
    arguments = ppo.Arguments(**quick, **AGENTS["ppo"][2])
    env = environments.make_env(arguments.environment, 4, output="numpy")
    policy = Policy(3, arguments.hidden)
    model = ppo.make_model(arguments, ppo.SB3VecEnv(env), policy)
    with torch.no_grad():
        next(iter(model.policy.parameters())).fill_(torch.nan)
    with pytest.raises(DivergedError, match=r"update 7: weights of .* must be finite.*kept"):
        ppo.copy_actor(model, policy, 7, Path("kept"))


@pytest.mark.parametrize("name", ["ppo", "sac"])
def test_the_copied_actor_is_the_baselines(name, quick):
    arguments = ppo.Arguments(**quick, **AGENTS[name][2])
    policy, _ = common.begin(arguments, name, activation="tanh", squash="tanh" if name == "sac" else "clip")
    model = ppo.make_model(
        arguments, ppo.SB3VecEnv(environments.make_env(arguments.environment, 4, output="numpy")), policy
    )
    model.learn(64)
    ppo.copy_actor(model, policy, 0, Path("kept"))
    seen = np.random.default_rng(0).normal(size=(6, 3)).astype(np.float32) * 0.1
    assert np.allclose(policy.predict(seen)[0], model.predict(seen, deterministic=True)[0], atol=1e-6)


def test_a_held_action_earns_the_rewards_of_its_steps_and_none_of_the_next_episode(ring):
    """Against the same vector stepped one by one; episodes of 7 steps end within an action that is held for 3."""
    ring |= {"max_episode_steps": 7, "warmup_pool": 0}
    plain, held = (environments.make_env(ring, 2, output="numpy") for _ in range(2))
    rows = ppo.Desynchronised(held, hold=3)
    rows.seed(5)
    plain.reset(seed=5)
    seen = environments.desynchronise(plain)
    np.testing.assert_array_equal(rows.reset(), seen)
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (5, 2, 1)).astype(np.float32)
    ends = 0
    for action in actions:
        wanted, over, last = np.zeros(2), np.zeros(2, dtype=bool), [None, None]
        for _ in range(3):
            seen, reward, terminated, truncated, info = plain.step(action)
            wanted += np.where(over, 0.0, reward)
            for i in np.flatnonzero((terminated | truncated) & ~over):
                last[i] = info["final_obs"][i]
            over |= terminated | truncated
        observation, reward, done, infos = rows.step(action)
        np.testing.assert_array_equal(observation, seen)
        np.testing.assert_allclose(reward, wanted, rtol=1e-6)
        np.testing.assert_array_equal(done, over)
        for i in range(2):
            assert ("terminal_observation" in infos[i]) == over[i]
            if over[i]:
                np.testing.assert_array_equal(infos[i]["terminal_observation"], last[i])
                assert infos[i]["TimeLimit.truncated"]
        ends += int(over.sum())
    assert ends == 4


def test_the_deviation_of_actions_falls_as_told_and_is_not_learned(quick):
    given = {**AGENTS["ppo"][2], "anneal": True, "log_std_init": -1.0, "log_std_last": -4.0, "learning_rate": 0.1}
    half = ppo.Arguments(**{**quick, "cpu_seconds": 1e-9}, **given)
    ppo.train(half)
    ppo.train(dataclasses.replace(half, cpu_seconds=0.0, resume=True))
    rows = [row for part in ("", "from1") for row in table(quick["out"] / "log" / part / "progress.csv")]
    deviations = [float(row["train/std"]) for row in rows if row["train/std"]]
    assert deviations == pytest.approx(np.exp([-1.0, -2.0, -3.0, -4.0]).tolist(), rel=1e-5)


def table(path: Path) -> list[dict[str, str]]:
    with path.open() as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize("name", ["ppo", "sac"])
def test_a_baseline_begins_as_the_clone(name, quick, monkeypatch):
    """With a learning rate of nothing the last policy is the one that was cloned, not SB3's own first one."""
    clones = []
    plain = common.clone

    def clone(policy, *rest):
        result = plain(policy, *rest)
        clones.append({k: v.clone() for k, v in policy.state_dict().items()})
        return result

    monkeypatch.setattr(common, "clone", clone)
    small = {**AGENTS[name][2], "learning_rate": 1e-12, "clone": 20}
    ppo.train(ppo.Arguments(**{**quick, "updates": 1}, **small))
    last = weights(quick["out"] / "last.pt")
    assert all(torch.allclose(last[k], clones[0][k], atol=1e-6) for k in last)


def test_the_best_checkpoint_has_the_best_score(quick, monkeypatch):
    ratios = iter([0.99, 0.5, 0.9, 0.7, 0.9])  # the untrained policy's own does not count

    def evaluate(policy, environment):
        return {"speed_ratio": next(ratios), "speed_std": 0.1, "time_gap": 1.0, "collisions": 0, "passed": True}

    monkeypatch.setattr("agents.monitor.evaluate", evaluate)
    apg.train(apg.Arguments(**quick, **SMALL))
    content = common.load(quick["out"] / "best.pt")[1]
    assert content["training"]["update"] == 1  # the first of equals


def test_the_command_line_tells_errors_in_one_line(tmp_path):
    bad = tmp_path / "bad.yaml"
    bad.write_text("configures: agent\nagent: apg\nwindw: 3\n")
    with pytest.raises(SystemExit, match=r"error: .*unknown key 'windw'. Did you mean 'window'"):
        apg.main(["--config", str(bad)])


def test_apg_follows_the_gradient_of_the_return(ring):
    """The slope of a window's mean reward along a direction in the weights, against a difference, in float64."""
    torch.manual_seed(0)
    ring |= {"start": "wave", "warmup": 0, "warmup_pool": 0, "dtype": "float64"}
    policy = Policy(3, (6,)).double()
    policy.scale.fill_(0.1)
    with torch.no_grad():
        policy.body[-1].weight.mul_(50.0)
    weights = dict(policy.named_parameters())
    along = {k: torch.randn_like(v) for k, v in weights.items()}

    def mean_reward(shift: torch.Tensor) -> torch.Tensor:
        shifted = {k: v + shift * along[k] for k, v in weights.items()}
        env = environments.make_env(ring, 3, output="torch")
        observation, total = env.reset(seed=0)[0], torch.zeros((), dtype=torch.float64)
        for _ in range(25):
            observation, reward, *_ = env.step(torch.func.functional_call(policy, shifted, (observation,)))
            total = total + reward.mean()
        return total / 25

    shift = torch.zeros((), dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(mean_reward(shift), shift)
    step = torch.tensor(1e-6, dtype=torch.float64)
    difference = (mean_reward(step) - mean_reward(-step)) / (2 * step)
    assert float(slope) == pytest.approx(float(difference.detach()), rel=1e-4) and abs(float(slope)) > 1e-4


# -- the returns of SHAC ---------------------------------------------------------------------------------------------


def test_returns_are_bootstrapped_at_the_end_and_where_episodes_end():
    rewards = torch.tensor([[1.0], [2.0], [3.0]])
    following = torch.tensor([[10.0], [20.0], [30.0]])
    going = shac.Window(rewards, rewards, following, torch.zeros(3, 1, dtype=torch.bool), rewards)
    g, lam = 0.5, 0.25
    third = (1 - g) * 3.0 + g * 30.0
    second = (1 - g) * 2.0 + g * ((1 - lam) * 20.0 + lam * third)
    first = (1 - g) * 1.0 + g * ((1 - lam) * 10.0 + lam * second)
    assert shac.returns(going, g, lam).flatten().tolist() == pytest.approx([first, second, third])
    ended = torch.tensor([[False], [True], [False]])
    cut = dataclasses.replace(going, ended=ended)
    second = (1 - g) * 2.0 + g * 20.0  # nothing of the episode after it
    first = (1 - g) * 1.0 + g * ((1 - lam) * 10.0 + lam * second)
    assert shac.returns(cut, g, lam).flatten().tolist() == pytest.approx([first, second, third])


def test_a_constant_reward_is_its_own_value():
    ones = torch.ones(40, 2)
    window = shac.Window(ones, 3.0 * ones, 3.0 * ones, torch.zeros(40, 2, dtype=torch.bool), ones)
    assert torch.allclose(shac.returns(window, 0.99, 0.9), 3.0 * ones)


class Ends(torch.nn.Module):
    """A value that is 1 plus the scene's own speed, so that its gradient is known."""

    def forward(self, scenes: torch.Tensor) -> torch.Tensor:
        return 1.0 + scenes[..., 0]


def stepwise(env, policy, target, a):
    """Return the gain of a window that is driven step by step, and the scenes before its steps."""
    push, discount, gain, scenes = a.explore * torch.randn(env.num_envs, 1), 1.0, 0.0, []
    for t in range(a.window):
        observation = env.task.observe(env.batch.world).flatten(1)
        scenes.append(policy.scene(observation).detach())
        observation, reward, terminated, truncated, _ = env.step(policy(observation) + push)
        gain = gain + (1.0 - a.gamma) * discount * reward
        ended = terminated | truncated
        discount = discount * a.gamma
        last = torch.ones_like(ended) if t == a.window - 1 else ended
        gain = gain + torch.where(last & ~terminated, discount * target(policy.scene(observation)), 0.0)
        discount = torch.where(ended, 1.0, discount)
        if bool(ended.any()):
            env.reset(options={"reset_mask": ended})
    return gain, torch.stack(scenes)


@pytest.mark.parametrize("controlled", [1, 2])
def test_a_window_of_shac_is_its_steps_one_by_one(ring, controlled):
    """With the same draws; episodes end within the window, some of them in a collision."""
    more = {"vehicles": 10, "controlled": controlled, "length": [80.0, 90.0]} if controlled > 1 else {}
    ring |= {"max_episode_steps": 40, "warmup_pool": 0, "failsafe": 0.0, **more}
    a = shac.Arguments(window=60, gamma=0.9, explore=0.05)
    torch.manual_seed(1)
    policy = shac.Sighted(Policy(3, (4,)), controlled)
    critic = torch.nn.Sequential(torch.nn.Linear(3 * controlled + 4, 4), torch.nn.Tanh(), torch.nn.Linear(4, 1))
    target = torch.nn.Sequential(critic, torch.nn.Flatten(-2))
    with torch.no_grad():
        policy.policy.body[-1].bias.fill_(0.7)  # who drives on so touches somebody
    results = []
    for mode in ("SameStep", "Disabled"):
        env = environments.make_env(shac.with_road(ring), 6, output="torch", autoreset_mode=mode)
        env.reset(seed=0)
        environments.desynchronise(env)
        torch.manual_seed(2)
        if mode == "SameStep":
            window = shac.roll(env, policy, target, a)
            assert bool(window.ended[:-1].any()), "no episode ends within the window"
            seen = env.task.observe(env.batch.world).flatten(1)
            assert driver_of(policy, seen, controlled) is not None, "the policy runs between the steps"
            gain, scenes = window.gain, window.scenes
        else:
            gain, scenes = stepwise(env, policy, target, a)
        results.append((gain, scenes, torch.autograd.grad(gain.sum(), list(policy.parameters()))))
    (gain, scenes, found), (wanted_gain, wanted_scenes, wanted) = results
    torch.testing.assert_close(gain, wanted_gain, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(scenes, wanted_scenes, rtol=1e-4, atol=1e-4)
    for x, y in zip(found, wanted, strict=True):
        torch.testing.assert_close(x, y, rtol=0.0, atol=1e-4 * float(y.abs().max()))


def test_the_critic_sees_the_observation_and_the_road(ring):
    env = environments.make_env(shac.with_road(ring), 3, output="torch")
    observation, state = env.reset(seed=0)[0], env.state
    plain = environments.make_env(ring, 3, output="torch").reset(seed=0)[0]
    columns = []
    for x in (state.speed / 15.0, state.gap.clamp_max(150.0) / 15.0):
        columns += [x.mean(-1), x.std(-1, correction=0)]
    expected = torch.cat((plain, torch.stack(columns, -1)), -1)
    torch.testing.assert_close(shac.Sighted(Policy(3, (4,)), 1).scene(observation), expected, rtol=0.0, atol=1e-3)


def test_the_gain_values_last_scenes_and_cuts_gradients_at_resets(ring):
    """With zero rewards the gain is γ^k V'(last scene) of every episode in the window, truncated ones included."""
    ring |= {"max_episode_steps": 6, "warmup_pool": 0}
    env = environments.make_env(shac.with_road(ring), 2, output="torch")
    env.reset(seed=0)
    a = shac.Arguments(window=8, gamma=0.9, explore=0.0)
    pushes = []

    class Push(torch.nn.Module):
        def forward(self, observation: torch.Tensor) -> torch.Tensor:
            pushes.append(torch.full((2, 1), 0.2, requires_grad=True))
            return pushes[-1]

    plain = env.batch.task.reward_parts
    object.__setattr__(
        env.batch.task, "reward_parts", lambda *x: {name: 0.0 * part for name, part in plain(*x).items()}
    )

    window = shac.roll(env, shac.Sighted(Push(), 1), Ends(), a)
    assert window.ended[:, 0].tolist() == [t == 5 for t in range(8)]
    expected = 0.9**6 * window.following[5] + 0.9**2 * window.following[7]
    assert torch.allclose(window.gain, expected)
    assert not torch.allclose(window.following[5], window.following[7])
    first, last = pushes[-8], pushes[-1]
    before, after = torch.autograd.grad(window.gain.sum(), [first, last], retain_graph=True)
    assert bool((before != 0).all()) and bool((after != 0).all())
    # What came before the reset has no influence on what is observed after it.
    seen = env.task.observe(env.batch.world)
    assert torch.autograd.grad(seen.sum(), first, allow_unused=True)[0] is None


def test_a_collision_is_worth_nothing(ring):
    env = environments.make_env(shac.with_road(ring), 2, output="torch")
    env.reset(seed=0)
    world = env.batch.world
    gap = world.state.gap.clone()
    gap[1, 0] = -1.0
    env.batch.world = world._replace(state=world.state._replace(gap=gap))
    a = shac.Arguments(window=1, gamma=0.9, explore=0.0)
    window = shac.roll(env, shac.Sighted(Policy(3, (4,)), 1), Ends(), a)
    assert window.ended[0].tolist() == [False, True]
    assert float(window.following[0, 0]) > 1.0 and float(window.following[0, 1]) == 0.0


@pytest.mark.parametrize("name", AGENTS)
def test_the_policy_before_any_update_is_judged_and_logged(name, quick, monkeypatch):
    module, kind, small = AGENTS[name]
    small = {**small, "critic_first": 0} if name == "shac" else small
    judged = []

    def evaluate(policy, environment):
        judged.append({k: v.clone() for k, v in policy.state_dict().items()})
        return PASSED

    monkeypatch.setattr("agents.monitor.evaluate", evaluate)
    module.train(kind(**{**quick, "updates": 1}, **small))
    assert len(judged) == 2
    assert not same(judged[0], judged[1])
    rows = (quick["out"] / "log" / "progress.csv").read_text().splitlines()
    names = rows[0].split(",")
    first, second = (dict(zip(names, row.split(","), strict=True)) for row in rows[1:])
    assert (float(first["updates"]), float(second["updates"])) == (0.0, 1.0)
    assert float(first["steps"]) == 0.0
    assert float(first["speed_ratio"]) == 1.0
