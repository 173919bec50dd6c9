"""Tasks ``merge`` and ``bottleneck``: nobody is lost, agents may be away, faces agree, gradients are right."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
import torch

import idm_env  # noqa: F401
from benchmarks import lanes
from idm_env import backends
from idm_env.compiled.kernels import dispatch
from idm_env.envs.pettingzoo import parallel_env
from idm_env.multilane import demand
from idm_env.tasks import BottleneckTask, Draw, MergeTask, make_task

OPEN = ("merge", "bottleneck", "open_highway", "approach")


@pytest.mark.parametrize("name", OPEN)
def test_whoever_is_due_is_inside_left_or_queued_for_a_minute(name: str) -> None:
    """With agents who brake at random; vehicles leave, and lanes that end are left by all but a few."""
    task = make_task(name, vehicles=40, controlled=3, failsafe=3.0)
    params = task.params(torch.float64, "cpu")
    draw = Draw.of(torch.arange(2), torch.zeros(2, dtype=torch.int64))
    world = task.reset(draw, params)
    assert world.state.present is not None and 0 < world.state.present.sum() < 80
    generator = torch.Generator().manual_seed(3)
    with torch.no_grad():
        for _ in range(600):
            push = 0.5 * torch.rand((2, 3), generator=generator, dtype=torch.float64) - 0.25
            world = task.step(world, task.command(push), None, params)
            found = demand.counts(task.simulator, world.state)
            assert torch.equal(found.due, found.inside + found.left + found.queued) and (found.queued >= 0).all()
            assert not task.crashed(world).any()
            seen, there = task.observe(world), task.pick(world.state.present)
            assert (seen[there <= 0] == 0).all()
            assert torch.equal(seen[..., task.bounds.names.index("present")], there)
    assert (found.left > 5).all()


def test_faces_drive_the_same_traffic() -> None:
    """Single, vector and PettingZoo, lanes commanded."""
    choices = {"task": "bottleneck", "vehicles": 40, "controlled": [0], "lane_commands": True}
    action = np.array([0.1, 1.0], np.float32)
    single = gym.make("DiffIDM-v0", **choices)
    vector = gym.make_vec("DiffIDM-v0", num_envs=2, **choices)
    each = parallel_env(**choices)
    single.reset(seed=4)
    vector.reset(seed=[4, 9])
    each.reset(seed=4)
    (agent,) = each.agents
    for _ in range(12):
        one, reward = single.step(action)[:2]
        many, rewards = vector.step(np.stack([action, action]))[:2]
        own = each.step({agent: action})
        np.testing.assert_array_equal(one, many[0])
        np.testing.assert_array_equal(one, own[0][agent])
        assert reward == pytest.approx(float(rewards[0])) == pytest.approx(own[1][agent])
    assert not np.array_equal(many[0], many[1])


def test_infos_tell_an_inflow_beyond_capacity() -> None:
    """The queue grows, and is said; beyond the slots of the task, too."""
    env = gym.make("DiffIDM-v0", task="bottleneck", inflow=9000.0, vehicles=40, controlled=[0], warmup=20)
    env.reset(seed=1)
    queues = [env.step(np.zeros(1, np.float32))[-1]["queued"].tolist() for _ in range(301)]
    assert queues[300][0] > queues[150][0] > queues[0][0] >= 0 and queues[300][0] > 5


RECKLESS = {
    "task": "bottleneck", "inflow": 400.0, "vehicles": 8, "controlled": [0], "max_command": 3.0,
    "lane_commands": True, "added": False, "hold": 0.1,
}  # fmt: skip


def on_lane_0(**choices: object) -> gym.Env:
    """Return an environment whose agent has entered, and is put on lane 0, which ends at 400 m."""
    env = gym.make("DiffIDM-v0", **{**RECKLESS, **choices})
    env.reset(seed=1)
    while not (state := env.unwrapped.state).present[0, 0]:  # type: ignore[attr-defined]
        env.step(None)
    lane = state.lanes.lane.clone()
    lane[0, 0] = 0
    env.reset(options={"state": state._replace(lanes=state.lanes._replace(lane=lane))})
    return env


def test_an_agent_that_drives_over_the_end_of_its_lane_has_crashed() -> None:
    """The end of a lane is a standing leader that nobody may pass."""
    env = on_lane_0()
    for step in range(400):  # noqa: B007
        _, reward, terminated, _, info = env.step(np.array([1.0, 0.0], np.float32))
        if terminated:
            break
    assert terminated and reward < 10 / 11 and 50 < step < 350
    seconds = 0.1 * float(env.unwrapped.state.step)  # type: ignore[attr-defined]
    said = f"vehicle 0 (an agent) drove over the end of lane 0 after {seconds:.1f} s"
    assert info["crash_reason"] == said


@pytest.mark.parametrize(("choices", "place"), [({"failsafe": 3.0}, 399.0), ({"careful": True}, None)])
def test_behind_a_failsafe_or_a_careful_driver_an_agent_stops_before_its_lane_ends(
    choices: dict[str, object], place: float | None
) -> None:
    """It always accelerates and never leaves its lane, on which nobody is ahead of it."""
    env = on_lane_0(**choices)
    for _ in range(600):
        _, _, terminated, _, _ = env.step(np.array([1.0, 0.0], np.float32))
        assert not terminated
    state = env.unwrapped.state  # type: ignore[attr-defined]
    assert state.lanes.lane[0, 0] == 0 and float(state.speed[0, 0]) < 0.3
    assert 395.0 < float(state.position[0, 0]) < 400.0
    if place is not None:
        assert float(state.position[0, 0]) == pytest.approx(place, abs=0.01)


@pytest.mark.parametrize(("careful", "counts"), [(False, (1.0, 0.0, -1.0)), (True, (0.0, 0.0, -1.0))])
def test_an_added_command_counts_beside_the_driver(careful: bool, counts: tuple[float, ...]) -> None:
    """Zeros are human driving to the last bit; of a careful agent what is above them counts for nothing."""
    task = make_task("merge", vehicles=40, controlled=0.5, added=True, careful=careful, max_command=0.5)
    params = task.params(torch.float64, "cpu")
    world = task.reset(Draw.of(torch.arange(2), torch.zeros(2, dtype=torch.int64)), params)
    assert world.state.present is not None
    there = task.pick(world.state.present)
    human = task.step(world, None, None, params)
    for action, counted in zip((1.0, 0.0, -1.0), counts, strict=True):
        after = task.step(world, task.command(torch.full_like(there, action)), None, params)
        more = task.pick(after.state.accel) - task.pick(human.state.accel)
        torch.testing.assert_close(more, 0.5 * counted * there, rtol=0, atol=1e-12 if counted else 0)
    assert task.as_driver == 0.0
    with pytest.raises(ValueError, match="failsafe = 3 judges whole commands"):
        make_task("merge", added=True, failsafe=3.0)


@pytest.mark.parametrize(("name", "effects"), [("merge", []), ("bottleneck", []), ("merge", ["courtesy"])])
def test_behind_a_failsafe_nobody_crashes_whatever_agents_command(name: str, effects: list[str]) -> None:
    """Among drivers who cut in, or let in, and where lanes end."""
    task = make_task(name, effects=effects, vehicles=40, controlled=0.25, failsafe=3.0, max_command=[-4.5, 2.6])
    params = task.params(torch.float64, "cpu")
    world = task.reset(Draw.of(torch.arange(3), torch.zeros(3, dtype=torch.int64)), params)
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for step in range(600):
            if step % 20 == 0:
                action = 4.0 * torch.rand((3, len(task.agents)), generator=generator, dtype=torch.float64) - 1.0
            world = task.step(world, task.command(action), None, params)
            assert not task.crashed(world).any()


@pytest.mark.parametrize("name", OPEN)
def test_the_first_form_is_one_ego_that_enters_again(name: str) -> None:
    """One action, about 20 numbers, zeros are human driving, and it is away for less than a tenth of the time."""
    given = {"task": name, "max_episode_steps": 150, "observation": "raw"}
    human, zero = (gym.make("DiffIDM-v0", **given) for _ in range(2))
    assert zero.action_space.shape == (1,) and 20 <= zero.observation_space.shape[0] <= 25
    human.reset(seed=1)
    zero.reset(seed=1)
    there, places = [], []
    for _ in range(150):
        seen, reward, *_, info = zero.step(np.zeros(1, np.float32))
        other, paid, *_ = human.step(None)
        np.testing.assert_array_equal(seen, other)
        assert reward == paid and 0.0 <= reward <= 1.0 and bool(info["present"][0]) == (reward > 0.0)
        there.append(info["present"][0])
        places += [seen[zero.unwrapped.task.bounds.names.index("position")]] * int(there[-1])  # type: ignore[attr-defined]
    trips = zero.unwrapped.state.lanes.trips  # type: ignore[attr-defined]
    assert np.mean(there) > 0.9 and int(trips.entered[0, 0]) >= 2 and int((np.diff(places) < -300.0).sum()) >= 1
    assert int(info["queued"][0]) < 10
    if name == "merge":
        assert trips.lane[0, 0] == 0


@pytest.mark.parametrize("name", OPEN)
def test_the_sum_of_all_rewards_is_the_total_delay(name: str) -> None:
    """Time in a queue, and of every trip its time less its way over its driver's v0, reckoned from positions."""
    more = {"reward": "delay", "controlled": 0.3, "careful": True, "added": False}
    more |= {"fuel_weight": 0.0} if name == "approach" else {}
    env = gym.make("DiffIDM-v0", task=name, dtype="float64", hold=0.1, max_episode_steps=400, **more)
    env.reset(seed=2)
    task, dt = env.unwrapped.task, 0.1  # type: ignore[attr-defined]
    free = task.params(torch.float64, "cpu")["idm"]["desired_speed"]
    total = delay = 0.0
    for k in range(400):
        before = env.unwrapped.state  # type: ignore[attr-defined]
        _, reward, _, truncated, info = env.step(np.full(len(task.agents), (-1.0) ** (k // 10), np.float32))
        state = env.unwrapped.state  # type: ignore[attr-defined]
        total += float(reward)
        same = (state.present > 0) & (before.present > 0) & (state.lanes.trips.entered == before.lanes.trips.entered)
        fresh = (state.lanes.trips.entered > before.lanes.trips.entered) & (state.present > 0)
        begins = task.road.at_lane(state.lanes.lane, state.position, "begins")
        way = torch.where(same, state.position - before.position, torch.where(fresh, state.position - begins, 0.0))
        inside = (same | fresh).sum() + info["queued"][0]
        delay += float(dt * inside - (way / free).sum())
    assert truncated and total < -10.0
    assert -total == pytest.approx(delay, rel=0.005)
    assert set(info) >= {"present", "outflow", "ramp", "standing", "co2"} and info["present"].shape == (
        len(task.agents),
    )


def test_gradients_of_the_reward_are_finite_differences() -> None:
    """Through entries, changes and lanes that end, choices frozen."""
    task = make_task("merge", vehicles=30, controlled=[3], careful=False)
    params = task.params(torch.float64, "cpu")
    world = task.reset(Draw.of(torch.arange(1), torch.zeros(1, dtype=torch.int64)), params)

    def total(push: torch.Tensor) -> torch.Tensor:
        now, rewards = world, []
        for _ in range(60):
            after = task.step(now, task.command(push.view(1, 1)), None, params)
            rewards.append(task.rewards(now, push.view(1, 1), after))
            now = after
        return torch.stack(rewards).sum()

    push = torch.tensor(-0.3, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(total(push), push)
    h = 1e-5
    expected = (total(push.detach() + h) - total(push.detach() - h)) / (2 * h)
    torch.testing.assert_close(slope, expected, rtol=1e-5, atol=1e-8)


def test_bad_choices_are_one_line() -> None:
    """An inflow of none."""
    with pytest.raises(ValueError, match="ramp_inflow = 0"):
        make_task("merge", ramp_inflow=0.0)
    with pytest.raises(ValueError, match="entry_speed = 0"):
        make_task("bottleneck", entry_speed=0.0)


OUT = {"merge 2400 + 500": 2750.0, "merge 3000 + 800": 3035.0, "bottleneck 1900": 1600.0}
"""Vehicles an hour: at least 95 % of what came out while drivers braked as in an emergency."""


@pytest.mark.parametrize(("name", "least"), [("merge 2400 + 500", 450.0), ("merge 3000 + 800", 500.0),
                                             ("bottleneck 1900", 0.0)])  # fmt: skip
def test_nobody_stands_for_ever_where_a_lane_ends(name: str, least: float) -> None:
    """No vehicle stands for more than a minute, and the ramp gets in, in eight episodes of ten minutes."""
    pytest.importorskip("numba")
    kind, given = lanes.DEMANDS[name]
    found = lanes.stood(kind(**given))
    assert max(found.longest) <= 60.0 and found.merged >= least and found.touched == 0.0
    # Nobody brakes as in an emergency for whom he lets in, or is left less than 0.4 s (and above 5 m/s s0/2).
    assert sum(found.emergencies) / 8 <= 5.0 and found.left[0] > 0.4
    assert found.out >= OUT[name]


def test_without_them_drivers_are_as_they_were() -> None:
    """Gap acceptance, courtesy and turns at their nulls leave no trace: a road on which many stand, to the last bit."""
    task = MergeTask(parameters=lanes.BEFORE[0], inflow=3000.0, ramp_inflow=800.0)
    params = task.params(torch.float64, "cpu")
    world = task.begin(Draw.of(torch.arange(2), torch.zeros(2, dtype=torch.int64)), params)
    full = task.simulator.without("control")
    bare = full.without("gap_acceptance", "courtesy", "calm")
    state, memory = world.state, {n: x for n, x in world.state.memory.items() if n in bare.by_name}
    with backends.off():
        one, kept = full.rollout(state, {}, params, 300)
        other, told = bare.rollout(state._replace(memory=memory), {}, params, 300)
    assert one.lanes is not None and other.lanes is not None and int(one.lanes.changed.sum()) > 10
    for a, b in zip((*kept, *one.lanes[:7]), (*told, *other.lanes[:7]), strict=True):
        assert torch.equal(a, b)


def test_compiled_decisions_accept_the_gaps_that_the_step_does() -> None:
    """A jam before a lane drop: memory of waiting, closer gaps, turns and zippers, on both paths."""
    pytest.importorskip("numba")
    task = BottleneckTask(inflow=3000.0, vehicles=40)
    params = task.params(torch.float64, "cpu")
    state = task.begin(Draw.of(torch.arange(1), torch.zeros(1, dtype=torch.int64)), params).state
    simulator = task.simulator.without("control")
    assert dispatch.refusal(simulator, state, {}, params) is None
    state, _ = simulator.rollout(state, {}, params, 300, keep=None)
    assert float(state.memory["gap_acceptance"].max()) > 0.5
    compiled, kept = simulator.rollout(state, {}, params, 200)
    with backends.off():
        plain, told = simulator.rollout(state, {}, params, 200)
    assert compiled.lanes is not None and plain.lanes is not None and state.lanes is not None
    assert int((compiled.lanes.changed - state.lanes.changed).sum()) > 3
    assert torch.equal(compiled.lanes.lane, plain.lanes.lane)
    torch.testing.assert_close(kept.position, told.position, rtol=0, atol=1e-6)
    for name, x in plain.memory.items():
        torch.testing.assert_close(compiled.memory[name], x, rtol=0, atol=1e-6)
