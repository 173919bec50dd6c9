"""The lane and ring kernels against ``Simulator.step``: values and gradients, over layouts, inputs and precisions."""

import pytest
import torch
from hypothesis import given, settings, strategies as st

from idm_env.compiled.kernels import dispatch, lane_loops, lanes, tiles
from idm_env.effects import IDM, Brakes, Control, Noise, Replay, make
from idm_env.roads import Lane, Ring
from idm_env.simulator import Simulator
from idm_env.types import Command, Record

BOUNDS = {
    "max_accel": (0.5, 3.0),
    "comfort_decel": (0.5, 3.0),
    "time_gap": (0.5, 2.5),
    "min_gap": (1.0, 4.0),
    "desired_speed": (10.0, 40.0),
}


class Problem:
    """A simulator with a random state, parameters of mixed shapes and inputs."""

    def __init__(self, seed, batch, size, dtype, road, extra, integration, present, steps):
        self.generator = torch.Generator().manual_seed(seed)
        self.dtype, self.steps = dtype, steps
        shape = (*batch, size)
        effects = tuple({"control": Control, "noise": Noise, "replay": Replay}[name]() for name in extra)
        self.simulator = Simulator(road, (IDM(), Brakes(width=0.3), *effects), 0.1, integration)
        lay = [shape, (size,), (*batch, 1), (), shape]
        self.leaves = {}
        idm = {name: self.draw(name, *bound, lay[i]) for i, (name, bound) in enumerate(BOUNDS.items())}
        self.params = {"idm": idm, "brakes": {"max_decel": self.draw("max_decel", 3, 9, (size,))}}
        for name in extra:
            self.params[name] = {"sigma": self.draw("sigma", 0, 1, ())} if name == "noise" else {}
        gap, speed = self.draw("gap", -0.3, 40, shape), self.draw("speed", 0, 25, shape)
        here = None
        if present:
            here = (torch.rand(shape, generator=self.generator) > 0.2).to(dtype)
        start = -torch.arange(size, dtype=dtype) * 30.0
        free = {"circumference": 30.0 * size} if isinstance(road, Ring) else {}
        state = self.simulator.state(start.expand(shape).clone(), speed, self.params, present=here, **free)
        led = self.simulator.road.leader_present(here, speed) > 0
        self.state = state._replace(
            gap=torch.where(led, gap, state.gap), position=self.leaf("position", state.position)
        )
        self.inputs = self.make_inputs(extra, shape)

    def leaf(self, name, value):
        self.leaves[name] = value.detach().clone().requires_grad_()
        return self.leaves[name]

    def draw(self, name, low, high, shape):
        return self.leaf(name, low + (high - low) * torch.rand(shape, generator=self.generator, dtype=self.dtype))

    def make_inputs(self, extra, shape):
        inputs, time = {}, (self.steps + 2, *shape)
        if "noise" in extra:
            inputs["noise"] = self.leaf("normals", torch.randn(time, generator=self.generator, dtype=self.dtype))
        if "control" in extra:
            narrow = (self.steps + 2, *shape[:-1], 1)
            active = torch.rand(shape[-1], generator=self.generator) > 0.5
            inputs["control"] = Command(self.draw("command", -3, 2, narrow), active.expand(time))
        if "replay" in extra:
            columns = [self.draw(name, *bound, time) for name, *bound in (("p", 0, 30), ("v", 0, 20), ("a", -1, 1))]
            active = torch.rand(time[1:], generator=self.generator) > 0.6
            inputs["replay"] = Record(*columns, active.expand(time))
        return inputs

    def run(self, **options):
        last, kept = self.simulator.rollout(self.state, self.inputs, self.params, self.steps, **options)
        return (last.gap, last.speed, last.position, last.accel, *(kept or ()))

    def gradients(self, outputs):
        generator = torch.Generator().manual_seed(1)
        total = sum((x * torch.randn(x.shape, generator=generator, dtype=self.dtype)).sum() for x in outputs)
        found = torch.autograd.grad(total, list(self.leaves.values()), retain_graph=True, allow_unused=True)
        return dict(zip(self.leaves, found, strict=True))


def close(name, mine, other, dtype, loose=1.0):
    if mine is None or other is None:
        present = mine if other is None else other
        assert present is None or not present.any(), name
        return
    assert mine.shape == other.shape, name
    mine, other = mine.detach(), other.detach()
    scale = other.abs().max().clamp_min(1.0)
    assert float((mine - other).abs().max() / scale) < loose * (3e-4 if dtype == torch.float32 else 1e-11), name


PROGRAMS = [
    # road, inputs, integration, vehicles that are absent, precision: each costs seconds to compile, so these are few
    (Lane(), [], "ballistic", False, torch.float64),
    (Lane(), ["control", "noise", "replay"], "ballistic", True, torch.float64),
    (Lane(), ["control", "noise"], "euler", True, torch.float32),
    (Lane(), ["replay"], "midpoint", False, torch.float32),
    (Ring(), ["control"], "ballistic", False, torch.float32),
    (Ring(), ["noise", "replay"], "euler", False, torch.float64),
    (Ring(), ["control", "noise"], "midpoint", False, torch.float64),
]


def build(program, **others):
    road, extra, integration, present, dtype = program
    return Problem(dtype=dtype, road=road, extra=extra, integration=integration, present=present, **others)


problems = st.builds(
    build,
    st.sampled_from(PROGRAMS),
    seed=st.integers(0, 2**31),
    batch=st.sampled_from([(), (1,), (3,), (2, 3), (90,)]),
    size=st.sampled_from([1, 2, 22, 50]),
    steps=st.sampled_from([1, 5, 19]),
)


def compare(problem, **options):
    assert dispatch.refusal(problem.simulator, problem.state, problem.inputs, problem.params) is None
    mine = problem.run(**options)
    with dispatch.off():
        theirs = problem.run(**options)
    assert len(mine) == len(theirs)
    for name, a, b in zip(["gap", "speed", "position", "accel", "p", "v", "a", "s"], mine, theirs, strict=False):
        close(name, a, b, problem.dtype)
    ours, autograds = problem.gradients(mine), problem.gradients(theirs)
    for name in ours:
        close(name, ours[name], autograds[name], problem.dtype, 4.0)


@settings(max_examples=60)
@given(problem=problems)
def test_values_and_gradients_are_those_of_the_steps(problem):
    compare(problem)


@pytest.mark.parametrize("program", PROGRAMS, ids=lambda p: f"{type(p[0]).__name__}-{'+'.join(p[1])}-{p[2]}")
@pytest.mark.parametrize("steps", [1, 2, 18])
def test_rows_longer_than_a_tile_are_cut_without_a_seam(program, steps):
    compare(build(program, seed=5, batch=(2,), size=2 * tiles.TILE + 77, steps=steps))


@pytest.mark.parametrize("road", [Lane(), Ring()])
@pytest.mark.parametrize("steps", [1, 18])
def test_halos_are_as_wide_as_effects_look_far(road, steps):
    """Second leaders, followers and the past, in rows that are cut."""
    effects = [make(name) for name in ("second_leader", "follower", "delay", "memory")]
    problem = Problem(12, (1,), tiles.TILE + 90, torch.float64, road, [], "ballistic", False, steps)
    simulator = problem.simulator.adding(*effects)
    params = {**simulator.defaults(dtype=torch.float64), **problem.params}
    for name in ("delay", "memory"):
        params[name] = {k: problem.leaf(f"{name}.{k}", v) for k, v in params[name].items()}
    lap = {"circumference": 30.0 * (tiles.TILE + 90)} if isinstance(road, Ring) else {}
    start = problem.state
    problem.state = simulator.state(start.position, problem.leaf("start", start.speed), params, **lap)
    problem.simulator, problem.params = simulator, params
    compare(problem)


@pytest.mark.parametrize("options", [{"checkpoint_every": 3}, {"keep": None}, {"keep": None, "checkpoint_every": 30}])
def test_options_change_nothing_but_memory(options):
    compare(build(PROGRAMS[5], seed=6, batch=(4,), size=22, steps=40), **options)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("size", [47, 2003])
def test_values_do_not_depend_on_how_many_rows_there_are(size, dtype):
    """Large arrays are written past the caches, in whole lines wherever rows begin."""
    rows = -(-(lane_loops.LARGE // torch.finfo(dtype).bits * 8 + 1) // size)
    generator = torch.Generator().manual_seed(size)

    def draw(low, high):
        return low + (high - low) * torch.rand(rows, size, generator=generator, dtype=dtype)

    simulator = Simulator(Lane(), (IDM(), Brakes()), 0.1)
    idm = {name: draw(*bound) for name, bound in BOUNDS.items()}
    params = {"idm": idm, "brakes": {"max_decel": draw(3, 9)}}
    state = simulator.state(-torch.arange(size, dtype=dtype) * 30.0 + draw(0, 20), draw(0, 25), params)
    last, _ = simulator.rollout(state, {}, params, 2, keep=None)
    for part in (slice(0, 3), slice(rows // 2, rows // 2 + 3), slice(rows - 3, rows)):
        cut = state._replace(**{n: getattr(state, n)[part] for n in ("position", "speed", "accel", "gap", "length")})
        few, _ = simulator.rollout(cut, {}, {e: {n: x[part] for n, x in p.items()} for e, p in params.items()}, 2)
        for name in ("position", "speed", "accel", "gap"):
            assert torch.equal(getattr(last, name)[part], getattr(few, name)), name


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_values_do_not_depend_on_graph_or_threads(threads, monkeypatch):
    problem = build(PROGRAMS[4], seed=7, batch=(4000,), size=22, steps=9)
    arguments = (problem.simulator, problem.state, problem.inputs, problem.params)
    kernel = dispatch.found(*arguments)
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    _, graph = lanes.rollout(kernel, *arguments, 9)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 1)
    with torch.no_grad():
        _, plain = lanes.rollout(kernel, *arguments, 9)
    assert graph[1].requires_grad and not plain[1].requires_grad
    for a, b in zip(graph, plain, strict=True):
        assert torch.equal(a, b)


def test_second_derivatives_come_from_the_torch_path():
    problem = Problem(8, (2,), 3, torch.float64, Lane(), [], "ballistic", False, 4)
    time_gap = problem.leaves["time_gap"]
    (first,) = torch.autograd.grad(problem.run()[1].square().sum(), time_gap, create_graph=True)
    (second,) = torch.autograd.grad(first.sum(), time_gap)
    with dispatch.off():
        (first,) = torch.autograd.grad(problem.run()[1].square().sum(), time_gap, create_graph=True)
        (other,) = torch.autograd.grad(first.sum(), time_gap)
    assert other.any()
    close("second", second, other, torch.float64)


def test_forward_mode_takes_the_torch_path():
    problem = Problem(9, (), 3, torch.float64, Lane(), [], "ballistic", False, 4)
    params = {e: {k: v.detach() for k, v in p.items()} for e, p in problem.params.items()}
    state = problem.simulator.state(problem.state.position.detach(), problem.state.speed.detach(), params)

    def last_speed(v0):
        changed = {**params, "idm": {**params["idm"], "desired_speed": v0}}
        return problem.simulator.rollout(state, {}, changed, 4)[0].speed

    forward = torch.func.jacfwd(last_speed)(params["idm"]["desired_speed"])
    backward = torch.autograd.functional.jacobian(last_speed, params["idm"]["desired_speed"])
    assert backward.any()
    torch.testing.assert_close(forward, backward)


def test_memory_of_results_is_never_handed_out_twice():
    problem = Problem(10, (9000,), 40, torch.float32, Lane(), [], "ballistic", False, 1)
    with torch.no_grad():
        first = problem.run(keep=None)
        copies = [x.clone() for x in first]
        problem.state = problem.state._replace(speed=problem.state.speed + 1.0)
        second = problem.run(keep=None)
    assert not torch.equal(first[1], second[1])
    assert all(torch.equal(a, b) for a, b in zip(first, copies, strict=True))


def test_switches_and_misfits_take_the_torch_path(monkeypatch):
    problem = Problem(11, (2,), 4, torch.float32, Lane(), [], "ballistic", False, 2)
    arguments = (problem.simulator, problem.state, problem.inputs, problem.params)
    assert dispatch.refusal(*arguments) is None
    with dispatch.off("because"):
        assert dispatch.refusal(*arguments) == "because"
    doubled = {**problem.params, "brakes": {"max_decel": torch.tensor(9.0, dtype=torch.float64)}}
    assert "float64" in dispatch.refusal(*arguments[:3], doubled)
    wide = {**problem.params, "brakes": {"max_decel": torch.ones(5, 2, 4)}}
    assert "enlarges" in dispatch.refusal(*arguments[:3], wide)
    monkeypatch.setenv("IDM_ENV_KERNELS", "0")
    assert "IDM_ENV_KERNELS" in dispatch.refusal(*arguments)
    monkeypatch.undo()
    monkeypatch.setattr(dispatch, "available", lambda: False)
    assert "pip install" in dispatch.refusal(*arguments)
