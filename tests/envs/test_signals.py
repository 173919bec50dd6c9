"""Signals as agents: rules of lights, books of vehicles, rows of batches, and the faces that people bring."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import parallel_api_test

import idm_env  # noqa: F401 (registers the environments)
from idm_env.envs.network_faces import NetworkEnv, NetworkVectorEnv
from idm_env.envs.pettingzoo import parallel_env
from idm_env.multilane.junctions import by_link, counts, journeys_of, travel_time
from idm_env.roads.network import Network
from idm_env.roads.ways import Ways
from tests.envs.test_junction import decided
from tests.networks import laws

SMALL: dict[str, Any] = {"network": "grid 1x2", "inflow": 400.0, "duration": 200.0}


def vector(count: int = 3, **keywords: Any) -> NetworkVectorEnv:
    """Return a vector as a user makes it."""
    return gymnasium.make_vec("DiffIDM-v0", count, task="signals", **{**SMALL, **keywords})  # type: ignore[return-value]


def run(env: NetworkVectorEnv, choose: Any, steps: int = 30, seed: int = 1) -> list[Any]:
    """Return all that is told in some steps of a vector."""
    env.reset(seed=seed)
    return [env.step(choose(k)) for k in range(steps)]


def drawn(env: NetworkVectorEnv, seed: int = 0) -> Any:
    """Return a policy that draws phases."""
    random = np.random.default_rng(seed)
    return lambda k: random.integers(0, 2, (env.num_envs, len(env.task.agents)))


def test_a_row_of_a_batch_is_the_single_environment() -> None:
    env, random = vector(3), np.random.default_rng(5)
    actions = random.integers(0, 2, (30, 3, 2))
    rows = run(env, lambda k: actions[k])
    for i in range(3):
        one = NetworkEnv(**SMALL)
        one.reset(seed=1 + i)
        for k, (seen, reward, _, _, info) in enumerate(rows):
            own, paid, *_, told = one.step(actions[k, i])
            np.testing.assert_array_equal(own, seen[i])
            assert paid == reward[i]
            assert told["lost"] == info["lost"][i]


def test_seeds_and_episodes() -> None:
    """The same seed gives the same bits, and every episode of it is another one."""
    a, b = (run(vector(2), lambda k: None) for _ in range(2))
    assert all(np.array_equal(x[0], y[0]) for x, y in zip(a, b, strict=True))
    env = vector(2)
    first = run(env, lambda k: None, steps=39)[-1][0]
    env.reset()
    for _ in range(39):
        second = env.step(None)[0]
    assert not np.array_equal(first, second)
    assert not np.array_equal(first[0], first[1])


def test_lights_keep_amber_and_least_green() -> None:
    """Whatever is asked for: between two greens is one amber, and no green is shorter than the least."""
    env = vector(1, hold=1.0, amber=1.0, least_green=10.0)
    env.reset(seed=3)
    policy, net = drawn(env, 2), env.task.road
    colours = []
    for k in range(190):
        env.step(policy(k))
        lights = env.worlds.world.state.lanes.journeys.phases[0].numpy()  # type: ignore[union-attr]
        colours.append([net.plans[s].states[lights[s]] for s in env.task.agents])
    assert len({tuple(x) for x in colours}) > 2
    for s in range(len(env.task.agents)):
        shown = [x[s] for x in colours]
        begins = [0, *(k + 1 for k, (a, b) in enumerate(pairwise(shown)) if a != b), len(shown)]
        runs = [(shown[k], end - k) for k, end in pairwise(begins)]
        assert len(runs) > 9
        for state, seconds in runs[1:-1]:
            assert seconds == 1 if "y" in state else seconds >= 10
        assert all(("y" in a) != ("y" in b) for (a, _), (b, _) in pairwise(runs))


def test_all_agents_of_a_grid_see_lanes_and_phases_in_one_order() -> None:
    """Clockwise, so that one policy can serve all: what goes in a phase stands at the same places in each."""
    task = vector(1, network="grid 3x3").task
    net, orders = task.road, set()
    for k, s in enumerate(task.agents):
        goes = [[{state[i] for i in net.index[(net.signal == s) & (net.start == link)]} for link in task.lanes[k]]
                for state in task.phases[s]]  # fmt: skip
        orders.add(str([["r" not in letters for letters in phase] for phase in goes]))
    assert orders == {"[[True, False, True, False], [False, True, False, True]]"}


def test_amber_is_shown_between_two_phases() -> None:
    env = vector(1)
    task = env.task
    for k, s in enumerate(task.agents):
        first, phases = int(task._first[k]), task.phases[s]
        for a, now in enumerate(phases):
            for b, then in enumerate(phases):
                between = task.road.plans[s].states[first + len(phases) * (1 + a) + b]
                for x, y, z in zip(now, then, between, strict=True):
                    assert z == ("y" if x in "Gg" and y not in "Gg" else x)


def test_books_and_lost_time() -> None:
    """Everybody due is inside, waits or has left; lost time is travel time less that of the way at the limits."""
    env = vector(4)
    rows = run(env, drawn(env), steps=39)
    task, state = env.task, env.worlds.world.state  # type: ignore[union-attr]
    told, books = rows[-1][-1], counts(state)
    for name, count in (("inside", books.inside), ("arrived", books.left), ("waiting", books.queued)):
        np.testing.assert_array_equal(told[name], count.numpy())
    assert (told["arrived"] > 0).all()
    from idm_env.tasks.network_task import Here

    free = task.free_time(Here(state, np.arange(state.position.numel()))).reshape(4, -1).sum(1)
    spent = travel_time(task.simulator, state).double().numpy().sum(1)
    lost = sum(row[-1]["lost"] for row in rows)
    np.testing.assert_allclose(lost, spent - free, rtol=1e-5)
    assert (lost > 0).all()


def test_nobody_loses_time_where_nobody_stands_in_his_way() -> None:
    """A single vehicle under a green light loses no more than it takes to come up to speed."""
    env = vector(1, network="grid 1x1", inflow=20.0, turns=(0.0, 1.0, 0.0))
    rows = run(env, lambda k: None, steps=39)
    assert rows[-1][1][0] <= 1.0
    assert rows[0][1][0] == 1.0  # nobody is there yet


def test_observations_are_what_links_hold() -> None:
    env = vector(2, reward="queue")
    rows = run(env, drawn(env), steps=30)
    task, seen = env.task, rows[-1][0].reshape(2, 2, -1)
    on = by_link(task.road, env.worlds.world.state)  # type: ignore[union-attr]
    for k, lanes in enumerate(task.lanes):
        full = task.road.length[lanes] / 7.0
        np.testing.assert_allclose(
            seen[:, k, 3 : 3 + len(lanes)], np.minimum(on.vehicles.numpy()[:, lanes] / full, 1.0), rtol=1e-5
        )
        np.testing.assert_allclose(
            seen[:, k, 7 : 7 + len(lanes)], np.minimum(on.halting.numpy()[:, lanes] / full, 1.0), rtol=1e-5
        )
    assert (rows[-1][1] <= 0.0).all()
    assert (seen[:, :, :2].sum(-1) == 1.0).all()


def test_who_sees_traffic_does_better_than_chance() -> None:
    """Green for where more vehicles are pays more than drawn phases, and than one phase for ever."""
    lost = {}
    for name in ("drawn", "constant", "fuller"):
        env = vector(8, inflow=400.0, duration=400.0)
        seen, _ = env.reset(seed=4)
        policy, total = drawn(env), np.zeros(8)
        masks = np.array([
            [[("G" in _shown(env, s, p, link)) for link in env.task.lanes[k]] for p in range(2)]
            for k, s in enumerate(env.task.agents)
        ])  # fmt: skip
        for k in range(79):
            queues = seen.reshape(8, 2, -1)[:, :, 3:7]
            fuller = np.einsum("bsl,spl->bsp", queues, masks).argmax(-1)
            actions = {"drawn": policy(k), "constant": np.zeros((8, 2), int), "fuller": fuller}[name]
            seen, _, _, _, info = env.step(actions)
            total += info["lost"]
        lost[name] = total.mean()
    assert lost["fuller"] < 0.8 * lost["drawn"]
    assert lost["fuller"] < 0.8 * lost["constant"]


def _shown(env: NetworkVectorEnv, s: int, phase: int, link: int) -> str:
    net = env.task.road
    return "".join(env.task.phases[s][phase][i] for i in net.index[(net.signal == s) & (net.start == link)])


def test_two_lanes_let_twice_as_many_through() -> None:
    """A queue on each lane empties as on one."""
    arrived = []
    for lanes in (1, 2):
        env = vector(2, network=f"grid 1x1x{lanes}", inflow=900.0 * lanes, turns=(0.0, 1.0, 0.0), duration=400.0)
        arrived.append(run(env, lambda k: None, steps=79)[-1][-1]["arrived"].mean())
    assert arrived[0] > 150
    assert arrived[1] == pytest.approx(2.0 * arrived[0], rel=0.03)


def test_each_of_two_lanes_goes_on_and_turns_to_its_side() -> None:
    """Nobody overlaps, meets a foe or runs red; all four ways of an approach are used."""
    keywords = {"inflow": 900.0, "turns": (0.2, 0.6, 0.2), "hold": 0.5, "amber": 0.5}
    env = vector(3, network="grid 1x2x2", duration=200.0, **keywords)
    env.reset(seed=1)
    net, after = env.task.road, decided(env)
    for _ in range(399):
        before = after
        env.step(None)
        after = decided(env)
        assert laws.broken(env.task.simulator, before, after) == []
    ways = journeys_of(after)
    routes = ways.routes.numpy()[ways.route.numpy()]
    passed = net.move_of[routes[(np.arange(routes.shape[-1]) < ways.hop.numpy()[..., None]) & (routes >= 0)]]
    sides, lanes = np.array(Ways(net).sides), np.array([int(name[-1]) for name in net.names])[net.start]
    used = {(lane, side): int((passed == m).sum()) for m, (lane, side) in enumerate(zip(lanes, sides, strict=True))}
    assert used.keys() == {(0, 1), (0, 2), (1, 0), (1, 1)}
    assert min(used.values()) > 0


def test_faces() -> None:
    """Gymnasium's and PettingZoo's own checks, an agent a row, and the end of an episode."""
    check_env(gymnasium.make("DiffIDM/Signals-v0", **SMALL).unwrapped, skip_render_check=True)
    parallel_api_test(parallel_env(task="signals", **SMALL), num_cycles=50)
    env = vector(3, shared=True, duration=10.0)
    assert env.num_envs == 6
    first, _ = env.reset(seed=1)
    assert first.shape == (6, env.task.features)
    env.step(np.zeros(6, int))
    seen, _, terminated, truncated, info = env.step(np.zeros(6, int))
    assert truncated.all()
    assert not terminated.any()
    assert info["final_obs"].shape == seen.shape
    np.testing.assert_array_equal(info["final_info"]["lost"].shape, (6,))


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"network": "grid 5"}, "network = 'grid 5' is neither a file nor a name. Did you mean 'grid 5x5'?"),
        ({"network": "grid 0x5"}, "rows = 0 must be at least 1."),
        ({"network": 5}, "network = 5 must be a name such as 'grid 5x5', the path of a .net.xml, or a Network."),
        ({"network": ""}, "network = '' must be a name"),
        ({"network": "a" * 5000}, "is neither a file nor a name."),
        ({"trips": 5}, "trips = 5 must be the path of a .rou.xml, or None."),
        ({"trips": "\n", "inflow": 300.0}, r"'\n' is no file. Give the path of an XML file of SUMO."),
        ({"turns": None}, "turns = None must be three numbers"),
        ({"turns": (None, 1.0, 1.0)}, "turns = (None, 1.0, 1.0) must be three numbers"),
        ({"turns": (0, 0, 0)}, "turns = (0, 0, 0) must be three numbers"),
        ({"randomise": 0}, "randomise = 0 must be a mapping from names."),
        ({"parameters": {"idm.time_gap": float("nan")}}, "idm.time_gap = nan must be a finite number."),
        ({"parameters": {"idm": {"a": 1}}}, "idm.a"),
        ({"max_episode_steps": 10**400}, "00000 must be at most 17280."),
        ({"max_episode_steps": 5, "hold": "x"}, "hold = 'x' must be a finite number of s."),
        ({"netwrok": "grid 1x1"}, "unexpected keyword argument 'netwrok'. Did you mean 'network'?"),
        ({"amber": 6.0}, "amber = 6 s must be at most hold = 5 s."),
        ({"reward": "wait"}, "reward = 'wait' is unknown."),
        ({"randomise": {"turns": [0, 1]}}, "randomise.'turns' cannot be drawn in task 'signals', where inflow can."),
        ({"inflow": -1.0}, "inflow = -1 veh/h"),
        ({"trips": "a.rou.xml", "inflow": 500.0}, "inflow = 500.0 changes nothing: trips = 'a.rou.xml' are all who"),
        ({"trips": "a.rou.xml", "inflow": 300.0, "randomise": {"inflow": [1, 2]}}, "Leave randomise out."),
        ({"trips": "a.rou.xml", "inflow": 300.0, "turns": (0.0, 1.0, 0.0)}, "are all who arrive. Leave turns out."),
        ({"turns": (0.0, 1.0)}, "must be three numbers from 0 on: left, straight on, right."),
        ({"network": Network.roundabout()}, "has no signal with two phases. Give one that has."),
    ],
)  # fmt: skip
def test_what_cannot_be_is_told_in_one_line(keywords: dict[str, Any], message: str) -> None:
    with pytest.raises((ValueError, TypeError)) as error:
        NetworkEnv(**{**SMALL, **keywords})
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_trips_of_a_file_drive_on_any_network(tmp_path: Path) -> None:
    """On a grid by its name, too; a file of another network's edges is refused."""
    path = tmp_path / "my.rou.xml"
    path.write_text('<routes><flow id="f" from="left0A0" to="B0right0" begin="0" end="60" number="7"/></routes>')
    env = vector(1, trips=path, inflow=300.0)
    env.reset(seed=1)
    info: dict[str, Any] = {}
    for _ in range(39):
        info = env.step(None)[-1]
    assert env.task.vehicles == 7 and info["arrived"] + info["inside"] == 7
    path.write_text(path.read_text().replace("left0A0", "nowhere"))
    with pytest.raises(ValueError, match="edge 'nowhere' has no lane for cars here"):
        vector(1, trips=path, inflow=300.0)


def test_actions_that_are_none() -> None:
    env = vector(2)
    with pytest.raises(RuntimeError, match="Call reset"):
        env.step(None)
    env.reset(seed=0)
    wrong: list[Any] = [np.zeros((2, 3), int), np.zeros((2, 2)), np.full((2, 2), -1), np.zeros(5, int), [[0, 1], [1]]]
    for actions in (*wrong, np.zeros((1, 4), int), 5, "a", [[True, False]] * 2, [[None, 1]] * 2):
        with pytest.raises(
            ValueError, match=r"^actions .* must be phases: whole numbers from 0 on, of shape \(2, 2\)\.$"
        ):
            env.step(actions)
    many = parallel_env(task="signals", **SMALL)
    many.reset(seed=0)
    for given, words in (
        ([0, 1], "actions = .* must be a mapping"),
        ({"A0": [0, 1], "B0": 0}, "no action for agent 'A0'"),
    ):
        with pytest.raises(ValueError, match=words):
            many.step(given)
    with pytest.raises(ValueError, match="shared = 5 must be True or False"):
        vector(2, shared=5)


def test_seeds_of_rows_and_options_that_are_none() -> None:
    """A seed for each row is that row's; a wrong number of seeds, or an option, is told."""
    one, many = vector(2), vector(2)
    first, rows = one.reset(seed=7)[0], [many.reset(seed=seeds)[0] for seeds in ([3, 7], [7, 8])]
    firsts = [[env.step(None)[0] for _ in range(20)][-1] for env in (one, many)]
    np.testing.assert_array_equal(first, rows[1])
    np.testing.assert_array_equal(firsts[0], firsts[1])
    many.reset(seed=[3, 7])
    np.testing.assert_array_equal([many.step(None)[0] for _ in range(20)][-1][1], firsts[0][0])
    with pytest.raises(ValueError, match="must be a number, or one for each of 2 rows"):
        many.reset(seed=[1])
    with pytest.raises(ValueError, match="unknown reset option 'state'"):
        many.reset(options={"state": None})
