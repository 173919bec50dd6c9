"""Steps without a graph give what ``Simulator.step`` and rollouts give, in every task."""

from dataclasses import dataclass
from typing import ClassVar

import gymnasium as gym
import numpy as np
import pytest
import torch

import idm_env  # noqa: F401
from idm_env.effects import IDM, Brakes, Control, Effect, Noise, make
from idm_env.kernels import tiles
from idm_env.roads import Lane, Ring
from idm_env.simulator import Simulator
from idm_env.tasks import Draw, make_task
from idm_env.types import Command

pytest.importorskip("numba")
from idm_env.kernels.stepper import Stepper

MOVING = ("position", "speed", "accel", "gap")
TASKS = {
    "ring": {"start": "wave", "warmup": 20, "controlled": 3, "integration": "euler", "noise": 0.2},
    "follow": {"parameters": {"idm.time_gap": [1.0 + 0.05 * i for i in range(7)]}},
    "platoon": {"effects": ["delay", "memory"]},
    "replay": {"controlled": 2, "model": "all"},
}


def same(mine, other, tolerance):
    for name in (*MOVING, "step", "length"):
        a, b = getattr(mine, name), getattr(other, name)
        assert a.shape == b.shape and a.dtype == b.dtype, name
        torch.testing.assert_close(a, b, rtol=tolerance, atol=10 * tolerance, msg=lambda m, n=name: f"{n}: {m}")
    assert mine.memory.keys() == other.memory.keys()
    for name, value in other.memory.items():
        torch.testing.assert_close(mine.memory[name], value.expand_as(mine.memory[name]), rtol=tolerance, atol=1e-3)
    if other.present is not None:
        assert torch.equal(mine.present, other.present)


def equal(mine, other):
    for name in (*MOVING, "step"):
        assert torch.equal(getattr(mine, name), getattr(other, name)), name
    for name, value in other.memory.items():
        assert torch.equal(mine.memory[name], value), name


def timed(value):
    if isinstance(value, torch.Tensor):
        return value[None]
    return type(value)(*(x if x is None else x[None] for x in value))


@pytest.mark.parametrize("name", TASKS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_a_step_is_that_of_the_simulator_and_of_a_rollout(name, dtype):
    task = make_task(name, **TASKS[name])
    params, stepper = task.params(dtype, "cpu"), Stepper(task.simulator)
    draw = Draw.of(torch.arange(3), torch.zeros(3, dtype=torch.int64))
    world = task.reset(draw, params)
    slow, fast = world, world
    seen = []
    for t in range(60):
        normals = {name: x[0] for name, x in task.normals(draw, slow.state.step, 1, dtype).items()}
        command = torch.full((3, len(task.agents)), 0.3 * (t % 3) - 0.3, dtype=dtype)
        inputs = dict(task.inputs(slow, command, normals))
        if name == "replay":  # the made-up scene shows everybody all the time; here they come and go
            there = ((t // 7 + torch.arange(task.vehicles)) % 5 > 0).to(dtype).expand(3, -1)
            inputs["replay"] = inputs["replay"]._replace(present=there)
        state = stepper(fast.state, inputs, params)
        rolled = {effect: timed(value) for effect, value in inputs.items()}
        equal(state, task.simulator.rollout(fast.state, rolled, params, 1, keep=None)[0])
        slow = slow._replace(state=task.simulator.step(slow.state, inputs, params))
        fast = fast._replace(state=state)
        same(state, slow.state, 1e-9 if dtype == torch.float64 else 3e-4)
        seen.append(slow.state.present)
    if name == "replay":
        there = torch.stack(seen) > 0
        assert (there[1:] & ~there[:-1]).any() and (there[:-1] & ~there[1:]).any()  # some come, some go


def rings(dtype, road, rows=70, size=22):
    simulator = Simulator(road, (IDM(), Brakes(), Control(), Noise()))
    params = simulator.defaults(dtype=dtype)
    params["idm"]["time_gap"] = 0.8 + torch.rand(size, dtype=dtype)
    speed = 10 * torch.rand(rows, size, dtype=dtype)
    position = -torch.arange(size, dtype=dtype).expand(rows, size) * 11.0
    around = {"circumference": 11.0 * size} if isinstance(road, Ring) else {}
    return simulator, simulator.state(position, speed, params, **around), params


@pytest.mark.parametrize("road", [Lane(), Ring()])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("rows", "size"), [(700, 22), (2, 2 * tiles.TILE + 77)])
def test_several_steps_at_once_are_a_rollout(road, dtype, rows, size):
    torch.manual_seed(0)
    simulator, state, params = rings(dtype, road, rows, size)
    inputs = {
        "control": Command(torch.randn(9, rows, 1, dtype=dtype), (torch.arange(size) == 0).expand(9, 1, size)),
        "noise": torch.randn(9, rows, size, dtype=dtype),
    }
    last, _ = simulator.rollout(state, inputs, params, 9)
    for threads in (1, 2):
        equal(Stepper(simulator).run(state, inputs, params, 9, threads=threads), last)


@pytest.mark.parametrize("road", [Lane(), Ring()])
def test_memories_and_the_past_are_carried_over_many_calls(road):
    simulator = Simulator(road, (IDM(), Brakes(), make("delay"), make("memory"), make("lag")))
    params = simulator.defaults(dtype=torch.float64)
    params["delay"]["delay"] = torch.linspace(0.0, 1.0, 9, dtype=torch.float64)
    around = {"circumference": 200.0} if isinstance(road, Ring) else {}
    position = -20.0 * torch.arange(9, dtype=torch.float64).expand(4, 9)
    speed = 5.0 + 5.0 * torch.rand(4, 9, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    state = simulator.state(position, speed, params, **around)
    stepper, now, slow = Stepper(simulator), state, state
    for _ in range(50):
        now, slow = stepper(now, {}, params), simulator.step(slow, {}, params)
    equal(now, simulator.rollout(state, {}, params, 50, keep=None)[0])
    same(now, slow, 1e-11)


def test_parameters_states_and_inputs_that_change_are_noticed():
    simulator, state, params = rings(torch.float64, Ring(), rows=3)
    stepper = Stepper(simulator)
    command = Command(torch.zeros(3, 1, dtype=torch.float64), torch.arange(22) == 0)
    inputs = {"control": command, "noise": torch.zeros(3, 22, dtype=torch.float64)}
    speeds = []

    def check(state=state, inputs=inputs):
        mine = stepper(state, inputs, params)
        same(mine, simulator.step(state, inputs, params), 1e-12)
        speeds.append(float(mine.speed[0, 5]))

    check()
    params["idm"]["max_accel"].mul_(2.0)  # in place
    check()
    params["idm"]["max_accel"] = torch.tensor(0.5, dtype=torch.float64)  # another tensor
    check()
    params["idm"]["max_accel"] = torch.rand(3, 1, dtype=torch.float64) + 0.5  # of another shape
    check()
    check(state._replace(speed=state.speed + 1.0))
    check(inputs={**inputs, "noise": inputs["noise"] + 1.0})
    assert len(set(speeds)) == len(speeds)
    params["idm"]["max_accel"] = torch.tensor(1.0, dtype=torch.float64)
    _, wide, _ = rings(torch.float64, Ring(), rows=7)
    row = {"control": Command(torch.zeros(7, 1, dtype=torch.float64), command.active)}
    check(wide, {**row, "noise": torch.zeros(7, 22, dtype=torch.float64)})  # another batch, and back
    check()


def test_a_state_is_not_changed_by_its_step():
    simulator, state, params = rings(torch.float32, Ring(), rows=2)
    simulator = simulator.without("control", "noise")
    before = [getattr(state, n).clone() for n in MOVING]
    stepper = Stepper(simulator)
    first = stepper(state, {}, params)
    kept = first.speed.clone()
    stepper(first, {}, params)
    assert all(torch.equal(getattr(state, n), x) for n, x in zip(MOVING, before, strict=True))
    assert torch.equal(first.speed, kept)


@dataclass(frozen=True)
class Undecided(Effect):
    """An effect that looks at a value."""

    kind: ClassVar[str] = "undecided"

    def accelerate(self, scene, driver, p):
        return scene.speed * 0.0 if float(scene.speed.max()) > 1.0 else scene.speed


def test_without_a_kernel_the_error_names_effect_and_cure():
    simulator, state, params = rings(torch.float64, Ring(), rows=3)
    simulator = simulator.without("control", "noise").adding(Undecided())
    stepper = Stepper(simulator)
    why = r"no kernel: effect 'undecided' uses .*Use simulator.step"
    with pytest.warns(UserWarning, match="effect 'undecided'"), pytest.raises(ValueError, match=why):
        stepper(state, {}, {**params, "undecided": {}})


# -- within environments -----------------------------------------------------------------------------------------


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
        if getattr(env.unwrapped.batch.advance, "__name__", "") == "step":  # bound before
            env.unwrapped.batch.advance = env.unwrapped.task.simulator.step
        for _ in range(5):
            env.step(None)
    env.close()
    return count[0]


def test_environments_step_by_their_kernel_where_nothing_prevents_it(monkeypatch):
    assert steps_of_torch(monkeypatch) == 0
    for effects in (["delay"], [{"effect": "idm", "exponent": 3.0}], [{"effect": "brakes", "sharpness": 1.0}]):
        assert steps_of_torch(monkeypatch, effects=effects) == 0
    assert steps_of_torch(monkeypatch, task="follow") == 0
    assert steps_of_torch(monkeypatch, output="torch") == 5
    monkeypatch.setenv("IDM_ENV_KERNELS", "0")
    assert steps_of_torch(monkeypatch) == 5


def test_an_environment_notices_parameters_that_change():
    env = gym.make("DiffIDM-v0", warmup=1, noise=0.0)
    env.reset(seed=0)
    inner = env.unwrapped
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


def test_numpy_and_torch_output_agree():
    envs = [gym.make("DiffIDM-v0", warmup=50, dtype="float64", output=output) for output in ("numpy", "torch")]
    seen = [env.reset(seed=4)[0] for env in envs]
    for _ in range(100):
        seen = [np.asarray(env.step(np.array([0.1]))[0]) for env in envs]
        np.testing.assert_allclose(seen[0], seen[1], rtol=0, atol=1e-10)
