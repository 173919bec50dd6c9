"""Environments with numpy output step in compiled loops: single = row of a vector = the torch path, over all tasks."""

import copy

import gymnasium as gym
import numpy as np
import pytest
import torch

import idm_env  # noqa: F401
from idm_env import backends
from idm_env.compiled.kernels.rows import RowFunction
from idm_env.compiled.scalar.record import Untraceable
from idm_env.envs.batch import Batch
from idm_env.envs.settings import settings
from idm_env.envs.values import Values
from idm_env.simulator import Simulator
from tests.envs.test_step_gradients import CASES as LANES, DECLARED, WEIGHTS

pytest.importorskip("numba")


CASES = [
    ("ring", {"start": "wave", "warmup": 20}),
    (
        "ring",
        {
            "warmup": 5,
            "reward": "flow",
            "controlled": 3,
            "failsafe": 3.0,
            "integration": "euler",
        },
    ),
    ("ring", {"warmup": 5, "controlled": 2, "shock": 4.0, "shock_after": [0.5, 3.0], "max_command": [-4.5, 2.6]}),
    ("ring", {"warmup": 5, "effects": ["delay", "memory"], "parameters": {"idm.time_gap": 1.3}}),
    ("follow", {"max_episode_steps": 25, "fuel_model": "circles"}),
    ("platoon", {"controlled": 2, "noise": 0.1, "observation": DECLARED, "reward": WEIGHTS}),
    ("replay", {"controlled": 2, "model": "all", "max_episode_steps": 20}),
    ("replay", {"reward": "source", "failsafe": 4.0}),
    LANES["highway"],
    ("bottleneck", {"vehicles": 20, "integration": "euler", "max_episode_steps": 33, "added": True, "careful": False}),
    ("open_highway", {"vehicles": 12, "lanes_count": 2, "length": 150.0, "max_episode_steps": 33}),
]


def _same(ours, theirs):
    if isinstance(theirs, torch.Tensor):
        theirs = theirs.detach().numpy()
    if isinstance(theirs, np.ndarray) and theirs.dtype != object:
        np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-9)
    else:
        assert np.array_equal(ours, theirs)


INFOS = [*((*case, "all") for case in CASES), *((*CASES[i], "none") for i in (0, 4, 6))]
"""All cases with infos; one of each kind without: every pair is compiled anew."""


@pytest.mark.parametrize(("task", "keywords", "info"), INFOS)
def test_a_single_environment_is_a_row_of_a_vector_and_the_torch_path(task, keywords, info):
    made = {"task": task, "dtype": "float64", "info": info, **keywords}
    single = [gym.make("DiffIDM-v0", output=o, **made) for o in ("numpy", "torch")]
    single[1].unwrapped.batch.values = None
    vector = gym.make_vec("DiffIDM-v0", num_envs=3, autoreset_mode="SameStep", **made)
    rows, _ = vector.reset(seed=4)
    for env in single:
        _same(env.reset(seed=4)[0], rows[0])
    actions = np.random.default_rng(0).uniform(-1.3, 1.3, (40, 3, *single[0].action_space.shape))
    for t, action in enumerate(actions):
        nobody = info == "all" and t % 7 == 3
        ours, theirs = (env.step(None if nobody else action[0]) for env in single)
        rows, rewards, ended, cut, infos = vector.step(None if nobody else action)
        for a, b in zip(ours[:4], theirs[:4], strict=True):
            _same(a, b)
        assert set(ours[4]) == set(theirs[4])
        for name, value in theirs[4].items():
            _same(ours[4][name], value)
        assert (rewards[0], ended[0], cut[0]) == pytest.approx(ours[1:4], rel=1e-12)
        last = infos["final_obs"][0] if ours[2] or ours[3] else rows[0]
        _same(last, ours[0])
        if ours[2] or ours[3]:
            _same(single[0].reset()[0], rows[0])
            single[1].reset()
    compiled = single[0].unwrapped.batch.values is not None
    assert compiled, "the torch path ran"
    _same(single[0].unwrapped.state.gap, single[1].unwrapped.state.gap)
    _same(vector.unwrapped.state.speed[:1], single[1].unwrapped.state.speed)


@pytest.mark.parametrize(("task", "keywords"), [CASES[1], CASES[2], CASES[6]])
def test_vehicles_whose_agents_left_go_back_to_their_drivers(task, keywords):
    made = settings(task=task, dtype="float64", **keywords)
    ours, theirs = Batch(made, 2), Batch(made, 2)
    theirs.values = None
    for batch in (ours, theirs):
        batch.seed([0, 1], [5, 6])
        batch.reset()
    draw = np.random.default_rng(0)
    for _ in range(12):
        shape = (2, len(made.task.agents))
        action, live = draw.uniform(-1.3, 1.3, shape), torch.as_tensor(draw.random(shape) < 0.6)
        mine, torchs = (batch.step(action, live) for batch in (ours, theirs))
        for a, b in zip((*mine[:4], *mine.whole), (*torchs[:4], *torchs.whole), strict=True):
            _same(a, b)
        assert set(mine.details) == set(torchs.details) and not mine.details["command"][~live.numpy()].any()
        for name, value in torchs.details.items():
            _same(mine.details[name], value)
    assert ours.values is not None, "the torch path ran"


def steps_of_torch(monkeypatch, **keywords):
    """Return how often an environment calls ``Simulator.step`` in five steps."""
    env = gym.make("DiffIDM-v0", warmup=0, **keywords)
    env.reset(seed=0)
    count, step = [0], Simulator.step

    def counted(self, *arguments):
        count[0] += 1
        return step(self, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr(Simulator, "step", counted)
        for _ in range(5):
            env.step(None)
    return count[0]


def test_environments_step_by_their_kernel_where_nothing_prevents_it(monkeypatch):
    assert steps_of_torch(monkeypatch) == 0
    for effects in (["delay"], [{"effect": "idm", "exponent": 3.0}], [{"effect": "brakes", "sharpness": 1.0}]):
        assert steps_of_torch(monkeypatch, effects=effects) == 0
    assert steps_of_torch(monkeypatch, output="torch") == 0
    monkeypatch.setenv("IDM_ENV_KERNELS", "0")
    assert steps_of_torch(monkeypatch) == 5


def test_what_was_told_and_shown_before_does_not_change_with_the_next_step():
    env = gym.make_vec("DiffIDM-v0", num_envs=2, warmup=3)
    env.reset(seed=0)
    action = np.ones((2, 1), np.float32)
    first, state = env.step(action), env.unwrapped.state
    kept = [np.array(x) for x in (*first[:2], first[4]["accel"], first[4]["command"], state.position, state.step)]
    env.step(-action)
    now = (*first[:2], first[4]["accel"], first[4]["command"], state.position, state.step)
    for before, after in zip(kept, now, strict=True):
        np.testing.assert_array_equal(before, after)


@pytest.mark.parametrize("output", ["torch", "numpy"])
def test_actions_may_lie_in_any_order(output):
    """A transposed array has its numbers column by column."""
    column_by_column = torch.rand(2, 5, generator=torch.Generator().manual_seed(0)).T
    found = []
    for action in (column_by_column, column_by_column.contiguous()):
        env = gym.make_vec("DiffIDM-v0", num_envs=5, task="ring", controlled=2, warmup=0, output=output)
        env.reset(seed=0)
        given = action.requires_grad_() if output == "torch" else action.numpy()
        told = [env.step(given) for _ in range(3)][-1]
        if output == "torch":
            told[1].sum().backward()
            found.append((told[0].detach(), given.grad))
        else:
            found.append(tuple(map(torch.as_tensor, told[:2])))
    assert all(torch.equal(x, y) for x, y in zip(*found, strict=True))


def test_parameters_and_states_that_change_are_noticed():
    env = gym.make("DiffIDM-v0", warmup=1, noise=0.0)
    env.reset(seed=0)
    inner = env.unwrapped
    env.step(None)
    state = inner.state

    def next_speed():
        inner.batch.world = inner.batch.world._replace(state=state)
        env.step(None)
        return float(inner.state.speed[0, 5])

    before = next_speed()
    inner.params["idm"]["max_accel"].mul_(2.0)
    written = next_speed()
    inner.params["idm"]["max_accel"] = torch.tensor(0.5)
    assert len({before, written, next_speed()}) == 3


def test_it_can_be_switched_off(monkeypatch):
    def values(**keywords):
        return isinstance(gym.make("DiffIDM-v0", warmup=1, **keywords).unwrapped.batch.values, Values)

    assert values() and values(output="torch")
    with backends.off():
        assert not values() and not values(output="torch")
    monkeypatch.setenv("IDM_ENV_KERNELS", "0")
    assert not values() and not values(output="torch")


@pytest.mark.parametrize(
    "function",
    [lambda x: {"y": x - x.mean(0, keepdim=True)}, lambda x: {"y": torch.sort(x).values}, lambda x: {"y": x.mean()}],
)
def test_a_function_that_mixes_rows_or_is_not_known_is_refused(function):
    with pytest.raises(Untraceable):
        RowFunction(function, {"x": torch.rand(101, 4)}, 101)


def test_several_lanes_are_compiled_from_the_first_step():
    """So is what a copy of an environment does."""
    task, keywords = LANES["highway"]
    ours, theirs = (gym.make("DiffIDM-v0", task=task, dtype="float64", **keywords) for _ in range(2))
    theirs.unwrapped.batch.values = None
    for env in (ours, theirs):
        env.reset(seed=2)
    action = np.full(ours.action_space.shape, 0.3)
    for step in range(6):
        if step == 3:
            ours = copy.deepcopy(ours)
        for told in zip(ours.step(action)[:4], theirs.step(action)[:4], strict=True):
            _same(*told)
        assert ours.unwrapped.batch.now.loaded


def test_what_several_lanes_do_not_compile_is_said_with_its_reason():
    """At the first step, in one line."""
    env = gym.make("DiffIDM-v0", task="highway", vehicles=8, hold=0.1, effects=["delay"])
    env.reset(seed=1)
    with pytest.warns(UserWarning, match="torch path runs instead: an effect looks back, where vehicles change lanes"):
        env.step(None)
