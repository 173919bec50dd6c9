"""One step by a kernel, ``Simulator.advance``, gives what ``Simulator.step`` and rollouts give, in every task."""

import pytest
import torch

from idm_env.compiled.kernels import dispatch
from idm_env.effects import IDM, Brakes, make
from idm_env.roads import Lane, Ring
from idm_env.simulator import Simulator
from idm_env.tasks import Draw, make_task

pytest.importorskip("numba")

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


@pytest.mark.parametrize("name", TASKS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_a_step_is_that_of_the_simulator_and_of_a_rollout(name, dtype):
    task = make_task(name, **TASKS[name])
    params = task.params(dtype, "cpu")
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
        state = task.simulator.advance(fast.state, inputs, params)
        slow = slow._replace(state=task.simulator.step(slow.state, inputs, params))
        fast = fast._replace(state=state)
        same(state, slow.state, 1e-9 if dtype == torch.float64 else 3e-4)
        seen.append(slow.state.present)
    if name == "replay":
        there = torch.stack(seen) > 0
        assert (there[1:] & ~there[:-1]).any() and (there[:-1] & ~there[1:]).any()  # some come, some go


@pytest.mark.parametrize("road", [Lane(), Ring()])
def test_memories_and_the_past_are_carried_over_many_calls(road):
    simulator = Simulator(road, (IDM(), Brakes(), make("delay"), make("memory"), make("lag")))
    params = simulator.defaults(dtype=torch.float64)
    params["delay"]["delay"] = torch.linspace(0.0, 1.0, 9, dtype=torch.float64)
    around = {"circumference": 200.0} if isinstance(road, Ring) else {}
    position = -20.0 * torch.arange(9, dtype=torch.float64).expand(4, 9)
    speed = 5.0 + 5.0 * torch.rand(4, 9, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    state = simulator.state(position, speed, params, **around)
    now, slow = state, state
    assert dispatch.refusal(simulator, state, {}, params) is None
    for _ in range(50):
        now, slow = simulator.advance(now, {}, params), simulator.step(slow, {}, params)
    equal(now, simulator.rollout(state, {}, params, 50, keep=None)[0])
    same(now, slow, 1e-11)


def plain(road=None, dtype=torch.float32, vehicles=6):
    simulator = Simulator(road or Lane(), (IDM(), Brakes()))
    params = simulator.defaults(dtype=dtype)
    position = -20.0 * torch.arange(vehicles, dtype=dtype)
    return simulator, simulator.state(position, torch.full_like(position, 8.0), params), params


def written(state, params):
    params["idm"]["time_gap"] += 0.5


def replaced(state, params):
    params["idm"]["desired_speed"] = torch.full((6,), 12.0)


def differentiated(state, params):
    params["idm"]["time_gap"].requires_grad_()


def with_a_graph(state, params):
    return state._replace(speed=(2.0 * state.speed).requires_grad_())


def of_two_rows(state, params):
    return state._replace(
        **{name: getattr(state, name).repeat(2, 1) for name in (*MOVING, "length")}, step=state.step.repeat(2)
    )


def strided(state, params):
    return state._replace(speed=torch.linspace(3.0, 8.0, 12)[::2])


def of_longer_vehicles(state, params):
    return state._replace(length=state.length + 2.0, gap=state.gap - 2.0)


def half_there(state, params):
    return state._replace(present=torch.tensor([1.0, 1.0, 0.0, 1.0, 0.0, 1.0]))


@pytest.mark.parametrize(
    "change",
    [written, replaced, differentiated, with_a_graph, of_two_rows, strided, of_longer_vehicles, half_there],
    ids=lambda change: change.__name__,
)
def test_what_changes_between_calls_is_seen(change):
    simulator, state, params = plain()
    for _ in range(3):
        state = simulator.advance(state, {}, params)
    state = change(state, params) or state
    for _ in range(2):  # the second call may rest on the first
        mine, other = simulator.advance(state, {}, params), simulator.step(state, {}, params)
        same(mine, other, 1e-6)
        assert mine.speed.requires_grad == other.speed.requires_grad
        with torch.no_grad():
            same(simulator.advance(state, {}, params), other, 1e-6)


def test_a_call_leaves_the_states_of_earlier_calls_alone():
    simulator, state, params = plain()
    kept, copies = [], []
    for _ in range(5):
        state = simulator.advance(state, {}, params)
        kept.append(state)
        copies.append([getattr(state, name).clone() for name in MOVING])
    for one, copy in zip(kept, copies, strict=True):
        assert all(torch.equal(getattr(one, name), x) for name, x in zip(MOVING, copy, strict=True))


def test_a_step_that_is_switched_off_is_not_compiled(monkeypatch):
    simulator, state, params = plain()
    simulator.advance(state, {}, params)
    from idm_env.compiled.kernels import lanes

    monkeypatch.setattr(lanes, "planned", lambda *call: pytest.fail("a compiled step ran"))
    with dispatch.off():
        simulator.advance(state, {}, params)
    monkeypatch.setenv("IDM_ENV_KERNELS", "0")
    simulator.advance(state, {}, params)
