"""Infos: what was commanded, what became of it, crashes and why, and recorded ids, in every face."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode

import idm_env  # noqa: F401
from idm_env.envs.pettingzoo import parallel_env
from idm_env.envs.sb3 import SB3VecEnv

CRASHES = {"task": "ring", "vehicles": 4, "length": [26.0, 30.0], "warmup": 3, "max_command": 5.0}


def drive(env, action, steps=100):
    env.reset(seed=0)
    for _ in range(steps):
        *_, terminated, truncated, info = env.step(np.asarray(action, np.float32))
        if terminated or truncated:
            break
    return info


def test_commanded_and_executed_acceleration():
    env = gym.make("DiffIDM-v0", warmup=100, max_command=2.0)
    env.reset(seed=0)
    speed = float(env.unwrapped.state.speed[0, 0])
    info = env.step(np.array([0.5], np.float32))[-1]
    assert info["command"] == pytest.approx([1.0])
    assert info["accel"] == pytest.approx([(float(env.unwrapped.state.speed[0, 0]) - speed) / 0.1], abs=1e-4)
    assert info["failsafe"].tolist() == [False]
    assert info["crash"] is False
    assert "crash_reason" not in info
    # A standing vehicle cannot brake, and nobody commands where the drivers keep the wheel.
    for _ in range(60):
        info = env.step(-np.ones(1, np.float32))[-1]
    assert info["command"] == pytest.approx([-2.0])
    assert info["accel"] == pytest.approx([0.0], abs=1e-6)
    assert np.isnan(env.step(None)[-1]["command"]).all()


def test_the_failsafe_says_where_it_acts():
    env = gym.make("DiffIDM-v0", warmup=50, failsafe=3.0, controlled=2)
    env.reset(seed=0)
    info = env.step(np.array([1.0, -1.0], np.float32))[-1]
    for _ in range(200):
        info = env.step(np.array([1.0, -1.0], np.float32))[-1]
        if info["failsafe"][0]:
            break
    assert info["failsafe"].tolist() == [True, False]
    assert info["accel"][0] < info["command"][0]


def test_a_crash_says_who_touched_whom():
    info = drive(gym.make("DiffIDM-v0", **CRASHES), [1.0])
    assert info["crash"] is True
    assert info["crash_reason"].startswith("vehicle 0 (an agent) touched vehicle 3 after ")
    gap = float(info["crash_reason"].split("gap ")[1].split(" m")[0])
    assert -2.0 < gap <= 0.0


def test_recorded_ids():
    env = gym.make("DiffIDM-v0", task="replay", controlled=["2", "4"])
    assert env.reset(seed=0)[1]["vehicle_id"] == ("made-up/2", "made-up/4")
    info = drive(env, [1.0, 0.0], 300)
    assert info["vehicle_id"] == ("made-up/2", "made-up/4")
    assert info["crash_reason"].startswith("vehicle made-up/2 (an agent) touched vehicle made-up/1 after ")
    vector = gym.make_vec("DiffIDM-v0", num_envs=3, task="replay", controlled=["2", "4"])
    assert vector.reset(seed=0)[1]["vehicle_id"].tolist() == [("made-up/2", "made-up/4")] * 3


def test_pettingzoo_tells_each_agent_its_own():
    env = parallel_env(task="replay", controlled=["2", "4"])
    _, infos = env.reset(seed=0)
    assert {a: i["vehicle_id"] for a, i in infos.items()} == {"vehicle_2": "made-up/2", "vehicle_4": "made-up/4"}
    reasons = {}
    for _ in range(300):
        actions = {a: np.full(1, 1.0 if a == "vehicle_4" else 0.1, np.float32) for a in env.agents}
        _, _, terminated, _, infos = env.step(actions)
        for agent, info in infos.items():
            assert info["command"] == pytest.approx(3.0 * float(actions[agent][0]))
            assert isinstance(info["accel"], float)
            assert info["crash"] is terminated[agent]
            if info["crash"]:
                reasons[agent] = info["crash_reason"]
        if not env.agents:
            break
    assert reasons["vehicle_4"].startswith("vehicle made-up/4 (an agent) touched vehicle made-up/3")


CASES = [CRASHES, {"task": "replay", "controlled": 2, "max_command": 6.0}, {"warmup": 3, "failsafe": 3.0}]


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_vectors_lay_infos_out_as_gymnasium_does(mode, case):
    keywords = {**case, "dtype": "float64", "max_episode_steps": 25}
    ours = gym.make_vec("DiffIDM-v0", num_envs=3, autoreset_mode=mode, **keywords)
    theirs = gym.vector.SyncVectorEnv(
        [lambda: gym.make("DiffIDM-v0", **keywords)] * 3, autoreset_mode=AutoresetMode(mode)
    )
    same(ours.reset(seed=1)[1], theirs.reset(seed=1)[1])
    generator, ends = np.random.default_rng(0), 0
    for _ in range(90):
        action = generator.uniform(-0.5, 1.0, (3, case.get("controlled", 1)))
        a, b = ours.step(action), theirs.step(action)
        same(a[-1], b[-1])
        ends += int((a[2] | a[3]).sum())
    assert ends > 3


def same(a, b):
    assert a.keys() == b.keys()
    for name, value in a.items():
        if isinstance(value, dict):
            same(value, b[name])
        elif value.dtype == object:
            assert [str(x) for x in value] == [str(x) for x in b[name]]
        else:
            assert value.dtype == b[name].dtype
            np.testing.assert_allclose(value, b[name], rtol=0, atol=1e-9)


def test_only_what_is_asked_is_told():
    vector = gym.make_vec("DiffIDM-v0", num_envs=2, warmup=3, info="crash")
    vector.reset(seed=0)
    assert set(vector.step(np.zeros((2, 1)))[-1]) == {"crash", "_crash"}
    silent = gym.make("DiffIDM-v0", warmup=3, info="none")
    silent.reset(seed=0)
    assert silent.step(np.zeros(1))[-1] == {}
    with pytest.raises(ValueError, match="Did you mean 'command'"):
        gym.make("DiffIDM-v0", info=["comand"])


def test_torch_accelerations_carry_their_graph():
    env = gym.make("DiffIDM-v0", warmup=50, output="torch", max_command=2.0)
    env.reset(seed=0)
    action = torch.tensor([0.1], requires_grad=True)
    info = env.step(action)[-1]
    info["accel"].sum().backward()
    assert float(action.grad) == pytest.approx(2.0, rel=1e-4)
    vector = gym.make_vec("DiffIDM-v0", num_envs=3, output="torch", autoreset_mode="SameStep", **CRASHES)
    vector.reset(seed=0)
    for _ in range(100):
        info = vector.step(torch.tensor([[1.0], [-1.0], [0.5]]))[-1]
        if "final_info" in info:
            break
    assert info["final_info"]["crash"].tolist() == info["_final_info"].tolist()
    assert isinstance(info["accel"], torch.Tensor)
    assert isinstance(info["_accel"], torch.Tensor)


@pytest.mark.parametrize("mode", ["SameStep", "Disabled"])
def test_sb3_gets_one_dict_per_environment(mode):
    env = SB3VecEnv(gym.make_vec("DiffIDM-v0", num_envs=2, autoreset_mode=mode, **CRASHES))
    env.reset()
    for _ in range(100):
        *_, done, infos = env.step(np.array([[1.0], [-0.1]], np.float32))
        if done[0]:
            break
    assert infos[0]["crash"]
    assert "touched" in infos[0]["crash_reason"]
    assert infos[0]["command"] == pytest.approx([5.0])
    assert infos[1]["command"] == pytest.approx([-0.5])
    assert not infos[1]["crash"]
