"""The failsafe: whatever agents command, nobody touches; and where there is room, a command is left as it is."""

import gymnasium as gym
import pytest
import torch
from hypothesis import given, settings, strategies as st

import idm_env  # noqa: F401
from idm_env.tasks import Draw, make_task


def start(task, count=2, seed=0):
    params = task.params(torch.float64, "cpu")
    return task.reset(Draw.of(torch.arange(count) + seed, torch.zeros(count, dtype=torch.int64)), params), params


def reckless(task, seed, steps=400):
    """Return the smallest gap where every vehicle brakes or accelerates as hard as it can, at random."""
    world, params = start(task, seed=seed)
    generator = torch.Generator().manual_seed(seed)
    smallest = torch.inf
    with torch.no_grad():
        for step in range(steps):
            if step % 20 == 0:
                command = 9.0 * torch.randint(-1, 2, (2, len(task.agents)), generator=generator).double()
            world = task.step(world, command, None, params)
            smallest = min(smallest, float(world.state.gap.amin()))
    return smallest


TASKS = {
    "ring": {"vehicles": 6, "length": 90.0, "noise": 0.0, "warmup": 0, "controlled": range(6)},
    "platoon": {"vehicles": 6, "controlled": range(1, 6)},
    "follow": {"vehicles": 6, "controlled": range(1, 6)},
}


@pytest.mark.parametrize("integration", ["ballistic", "euler"])
@pytest.mark.parametrize("failsafe_time", [0.0, 1.0])
@pytest.mark.parametrize("name", TASKS)
@settings(max_examples=3)
@given(seed=st.integers(0, 10_000))
def test_nobody_touches_whatever_is_commanded(name, failsafe_time, integration, seed):
    # Brakes reach 9 m/s², and so does the failsafe: no leader brakes harder than it assumes.
    chosen = {**TASKS[name], "controlled": list(TASKS[name]["controlled"]), "max_command": 9.0}
    chosen["integration"] = integration
    assert reckless(make_task(name, **chosen, failsafe=9.0, failsafe_time=failsafe_time), seed) > 0.0
    assert reckless(make_task(name, **chosen), seed) < 0.0


def test_a_vehicle_stops_a_metre_behind_one_that_stands_and_never_brakes_harder_than_planned():
    task = make_task(
        "ring", vehicles=2, length=200.0, noise=0.0, warmup=0, controlled=[0, 1], failsafe=3.0, failsafe_time=0.0
    )
    world, params = start(task, count=1)
    command = torch.tensor([[-1.0, 1.0]], dtype=torch.float64)
    hardest = 0.0
    for _ in range(600):
        world = task.step(world, command, None, params)
        hardest = min(hardest, float(world.state.accel.min()))
    assert float(world.state.gap[0, 1]) == pytest.approx(1.0, abs=1e-3)
    assert hardest == pytest.approx(-3.0, abs=1e-6)


def test_behind_a_leader_of_the_same_speed_it_keeps_its_time():
    task = make_task("platoon", vehicles=2, controlled=1, speed=10.0, disturbance=0.01, max_command=3.0, failsafe=3.0)
    world, params = start(task, count=1)
    for _ in range(600):
        world = task.step(world, torch.ones(1, 1, dtype=torch.float64), None, params)
    assert float(world.state.gap[0, 1]) == pytest.approx(1.0 + 10.0 * (1.0 + task.simulator.dt), rel=0.01)


def test_where_there_is_room_a_command_is_left_as_it_is():
    free, guarded = (make_task("ring", warmup=200, failsafe=b) for b in (0.0, 3.0))
    world, params = start(free)
    command = torch.tensor([[0.3], [-0.7]], dtype=torch.float64)
    normals = {"noise": torch.zeros(2, 22, dtype=torch.float64)}
    assert bool((guarded.safe_command(world) > command).all())
    one, other = (task.step(world, command, normals, params).state for task in (free, guarded))
    assert torch.equal(one.speed, other.speed)


def test_a_vehicle_without_a_leader_commands_freely():
    task = make_task("replay", failsafe=3.0, controlled=1)
    world, _ = start(task, count=1)
    alone = world._replace(state=world.state._replace(present=torch.zeros_like(world.state.speed)))
    alone = alone._replace(state=alone.state._replace(gap=torch.full_like(world.state.gap, 1e6)))
    assert float(task.safe_command(alone).min()) > 1e3


def test_it_has_gradients():
    task = make_task("ring", warmup=200, noise=0.0, failsafe=3.0)
    world, _ = start(task)

    def safe(gap, speed):
        return task.safe_command(world._replace(state=world.state._replace(gap=gap, speed=speed)))

    inputs = world.state.gap.clone().requires_grad_(), world.state.speed.clone().requires_grad_()
    assert torch.autograd.gradcheck(safe, inputs)


def test_every_face_takes_it():
    keywords = {"task": "ring", "vehicles": 5, "length": 60.0, "warmup": 100, "failsafe": 3.0, "dtype": "float64"}
    ends = []
    for output in ("numpy", "torch"):
        env = gym.make("DiffIDM-v0", **keywords, output=output)
        env.reset(seed=3)
        full = env.action_space.high if output == "numpy" else torch.as_tensor(env.action_space.high)
        for _ in range(400):
            *_, terminated, _, _ = env.step(full)
            assert not terminated
        ends.append(env.unwrapped.state.gap)
        env.close()
    torch.testing.assert_close(ends[0], ends[1], rtol=1e-6, atol=1e-6)
    with pytest.raises(ValueError, match="failsafe = -1 m/s² must be at least 0"):
        make_task("ring", failsafe=-1.0)
