"""Vehicles of a network as agents: human traffic without them, laws with them, rows of batches, and faces."""

from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import parallel_api_test

import idm_env  # noqa: F401 (registers the environments)
from idm_env.effects import IDM, Brakes, LinkLimit, StopLine
from idm_env.envs.network_faces import NetworkEnv, NetworkVectorEnv
from idm_env.envs.pettingzoo import parallel_env
from idm_env.multilane.junctions import crossed, journeys_of
from idm_env.roads.network import Network
from idm_env.simulator import Simulator
from idm_env.tasks.junction import FEATURES, JunctionTask
from idm_env.tasks.random import Draw
from idm_env.types import State
from tests.networks import laws

NETWORKS = ("crossing", "roundabout", "figure eight")
SMALL: dict[str, Any] = {"duration": 60.0, "inflow": 600.0, "agents": 4}
EIGHT: dict[str, Any] = {"network": "figure eight", "inflow": 300.0}

ALONE = Network.from_tables({"name": ["a", "b"], "length": [90.0] * 2, "limit": [14.0] * 2}, {"start": [], "end": []})
"""Two links that lead nowhere."""


def vector(count: int = 2, **keywords: Any) -> NetworkVectorEnv:
    """Return a vector as a user makes it."""
    return gymnasium.make_vec("DiffIDM-v0", count, task="junction", **{**SMALL, **keywords})  # type: ignore[return-value]


def of_network(network: str) -> dict[str, Any]:
    """Return the keywords of a network: on the figure eight nobody arrives."""
    return {"network": network} | {k: v for k, v in SMALL.items() if network != "figure eight" or k != "inflow"}


def decided(env: NetworkVectorEnv) -> State:
    """Return the state after the event that is due, which the next step begins with."""
    state = env.worlds.world.state
    state = crossed(env.task.simulator, state, env.task.params)
    return state._replace(step=state.step.reshape(-1)[0])


@pytest.mark.parametrize("network", NETWORKS)
def test_who_does_nothing_is_human_traffic(network: str) -> None:
    """Actions of 0 and above, or none, are the very bits of a simulator that knows no agents."""
    task = JunctionTask(**of_network(network))
    world = first = task.begin(Draw.of(torch.tensor([3, 4]), torch.tensor([0, 0])))
    driven = world
    for k in range(40):
        world, _ = task.step(world, None)
        driven, _ = task.step(driven, np.full((2, 4), k % 2 * 0.7))
    assert (driven.slot >= 0).any()
    simulator = Simulator(task.road, (IDM(), LinkLimit(), StopLine(), Brakes()), 0.1, "ballistic")
    plain, _ = simulator.rollout(first.state, {}, task.params, 400, keep=None)
    for name in ("position", "speed", "gap", "present"):
        assert torch.equal(getattr(plain, name), getattr(world.state, name)), name
        assert torch.equal(getattr(plain, name), getattr(driven.state, name)), name
    assert (plain.speed > 1.0).any()


@pytest.mark.parametrize("network", NETWORKS)
def test_nobody_overlaps_and_no_foes_meet_whatever_agents_do(network: str) -> None:
    circling = {"circling": 20, "inflow": 300.0} if network == "figure eight" else {}
    keywords = {"network": network, "agents": 12, "hold": 0.5, "duration": 120.0, **circling}
    env, random = vector(12, **keywords), np.random.default_rng(1)
    env.reset(seed=1)
    moved, after = 0, decided(env)
    for _ in range(239):
        before = after
        env.step(random.uniform(-1.0, 0.6, env.action_space.shape))
        after = decided(env)
        assert laws.broken(env.task.simulator, before, after) == []
        moved += 5 * int(after.present.sum())
    assert moved > 1e5
    ways = journeys_of(after)
    crossed = env.task.road.move_of[ways.routes.numpy()[ways.route.numpy()]] >= 0
    passed = (np.arange(crossed.shape[-1]) < ways.hop.numpy()[..., None]) & crossed
    assert passed.sum() > 100


def test_a_row_of_a_batch_is_the_single_environment_and_pettingzoo() -> None:
    env, random = vector(3), np.random.default_rng(5)
    actions = random.uniform(-1.0, 1.0, (40, 3, 4)).astype(np.float32)
    env.reset(seed=1)
    rows = [env.step(x) for x in actions]
    for i in range(3):
        one, many = NetworkEnv(task="junction", **SMALL), parallel_env(task="junction", **SMALL)
        one.reset(seed=1 + i)
        many.reset(seed=1 + i)
        for k, (seen, reward, *_, info) in enumerate(rows):
            own, paid, *_, told = one.step(actions[k, i])
            each, shares, *_ = many.step({a: actions[k, i, j : j + 1] for j, a in enumerate(many.agents)})
            np.testing.assert_array_equal(own, seen[i])
            np.testing.assert_array_equal(np.concatenate([*each.values()]), seen[i])
            assert paid == reward[i] == pytest.approx(np.mean([*shares.values()]), abs=1e-12)
            assert told["lost"] == info["lost"][i]


def test_seeds_and_episodes() -> None:
    env = vector(2)
    rows = []
    for seed in (1, 1, None):
        env.reset(seed=seed)
        rows.append(np.stack([env.step(None)[0] for _ in range(40)]))
    assert np.array_equal(rows[0], rows[1])
    assert not np.array_equal(rows[0], rows[2])
    assert not np.array_equal(rows[0][:, 0], rows[0][:, 1])


def test_who_has_left_hands_his_slot_on() -> None:
    """No vehicle has two slots, all that have one are on the network, and what an agent observes is its vehicle's."""
    env = vector(4, shared=True, duration=120.0)
    env.reset(seed=2)
    drivers = set()
    for _ in range(119):
        seen, reward, *_ = env.step(None)
        world = env.worlds.world
        assert ((reward >= 0.0) & (reward <= 1.0)).all()
        for row, slots in enumerate(world.slot):
            on = slots[slots >= 0]
            assert len({*on.tolist()}) == len(on)
            assert (world.state.present[row, on] > 0).all()
            drivers |= {(row, x) for x in on.tolist()}
            mine = seen.reshape(4, 4, -1)[row, slots >= 0]
            limit = env.task.road.limit[world.state.lanes.lane[row, on].numpy()]
            expected = np.clip(world.state.speed[row, on].numpy() / limit, 0.0, 1.0)
            np.testing.assert_allclose(mine[:, FEATURES.index("speed")], expected, rtol=1e-6)
            assert (seen.reshape(4, 4, -1)[row, slots < 0] == 0.0).all()
    assert len(drivers) > 20


def test_an_agent_can_hold_back() -> None:
    """Who brakes all the time stands, and those behind him lose their time: the world's share falls."""
    rewards = {}
    for action in (0.0, -1.0):
        env = vector(4, network="figure eight", inflow=300.0)
        env.reset(seed=1)
        rewards[action] = np.mean([env.step(np.full((4, 4), action))[1] for _ in range(59)])
    assert rewards[-1.0] < rewards[0.0] - 0.1


def test_faces() -> None:
    """Gymnasium's and PettingZoo's own checks, and an agent a row."""
    check_env(gymnasium.make("DiffIDM/Junction-v0", **SMALL).unwrapped, skip_render_check=True)
    parallel_api_test(parallel_env(task="junction", **SMALL), num_cycles=70)
    assert parallel_env(task="junction", max_cycles=7).unwrapped.worlds.task.horizon == 7
    env = vector(3, shared=True, duration=2.0)
    assert env.num_envs == 12
    assert env.single_action_space.shape == (1,)
    env.reset(seed=1)
    env.step(env.action_space.sample())
    assert env.step(env.action_space.sample())[3].all()


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"network": "crossroads.net.xml"}, "crossroads.net.xml"),
        ({"netwrok": "crossing"}, "task 'junction' got an unexpected keyword argument 'netwrok'."),
        ({"agents": 0}, "agents = 0"),
        ({"network": ALONE}, "has no junction. Give one that has."),
        ({"circling": 20}, "circling = 20 changes nothing: inflow or trips arrive on network = 'crossing'. L"),
        ({"network": "figure eight"}, "inflow = 600.0 changes nothing: nobody arrives on network = 'figure eight'."),
        ({**EIGHT, "turns": (0.0, 1.0, 0.0)}, "turns = (0.0, 1.0, 0.0) changes nothing: nobody arrives"),
        ({**EIGHT, "randomise": {"inflow": [1, 2]}}, "randomise = {'inflow': [1, 2]} changes nothing: nobody arrives"),
        ({"agents": 15, **EIGHT}, "agents = 15 must be at most the vehicles, 14."),
        ({"reward": "wait"}, "reward = 'wait' is unknown."),
        ({"turns": (0.0, -1.0, 0.0)}, "must be three numbers from 0 on: left, straight on, right."),
        ({"max_command": -1.0}, "max_command = -1 m/s²"),
        ({"randomise": {"agents": [0, 1]}}, "randomise.'agents' cannot be drawn in task 'junction', where inflow can."),
        ({"network": Network.grid(1, 1), "inflow": -1.0}, "inflow = -1 veh/h"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_told_in_one_line(keywords: dict[str, Any], message: str) -> None:
    with pytest.raises((ValueError, TypeError, OSError)) as error:
        NetworkEnv(task="junction", **{**SMALL, **keywords})
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_actions_that_are_none() -> None:
    env = vector(2)
    env.reset(seed=0)
    for wrong in (np.zeros((2, 3)), np.full((2, 4), np.nan)):
        with pytest.raises(ValueError, match="must be numbers from −1 to 1"):
            env.step(wrong)
