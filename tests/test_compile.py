"""Simulator.compile(): the same values and gradients, for every effect; a warning where nothing can compile."""

import warnings

import pytest
import torch

from idm_env.compiled.kernels import dispatch
from idm_env.effects import ALL, BASES, IDM, Brakes, Curve, DriverCurve, make
from idm_env.roads import Lane, Ring
from idm_env.simulator import Simulator
from idm_env.types import Adjacent, Command, Imagined, Record

SHAPE = (3, 4)


@pytest.fixture(autouse=True)
def fresh():
    torch._dynamo.reset()
    yield
    torch._dynamo.reset()


def problem(simulator, dtype=torch.float64):
    params = simulator.defaults(dtype=dtype)
    for values in params.values():
        for value in values.values():
            value.requires_grad_()
    position = torch.tensor([90.0, 62.0, 33.0, 5.0], dtype=dtype).expand(SHAPE).clone()
    speed = torch.tensor([9.0, 11.0, 13.0, 14.0], dtype=dtype).expand(SHAPE).clone()
    around = {"circumference": 130.0} if isinstance(simulator.road, Ring) else {}
    state = simulator.state(position, speed, params, **around)
    ones = torch.ones(SHAPE, dtype=dtype)
    active = torch.tensor([False, True, False, False]).expand(SHAPE)
    every = {
        "control": Command(-ones, active),
        "replay": Record(position + 1.0, 10.0 * ones, 0.0 * ones, active),
        **dict.fromkeys(simulator.draws, 0.5 * ones),
        "imagined": Imagined(20.0 * ones, 1.0 * ones),
        "lateral": Adjacent(8.0 * ones, 9.0 * ones, ones),
    }
    return state, {k: v for k, v in every.items() if k in simulator.by_name}, params


def gradients(step, state, inputs, params):
    after = step(step(state, inputs, params), inputs, params)
    leaves = [v for values in params.values() for v in values.values()]
    total = after.speed.square().sum() + after.gap.clamp_max(500.0).square().sum()
    return after, torch.autograd.grad(total, leaves, retain_graph=True, allow_unused=True)


def compare(simulator, tolerance=1e-9, dtype=torch.float64, **choices):
    state, inputs, params = problem(simulator, dtype)
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        mine, ours = gradients(simulator.compile(**choices).step, state, inputs, params)
    other, theirs = gradients(simulator.step, state, inputs, params)
    for a, b in zip(mine[:4], other[:4], strict=True):
        torch.testing.assert_close(a, b, rtol=tolerance, atol=tolerance)
    for a, b in zip(ours, theirs, strict=True):
        assert (a is None) == (b is None)
        if a is not None:
            torch.testing.assert_close(a, b, rtol=tolerance, atol=tolerance)


MANY = [kind for kind, cls in ALL.items() if kind not in (*BASES, "brakes") and cls.hook != "change"]
GROUPS = [tuple(MANY[i::6]) for i in range(6)]
"""A graph costs two seconds and a further effect in it a tenth of that."""


def effect(kind):
    choices = {"feature": "speed", "knots": (0.0, 10.0, 20.0)} if ALL[kind] in (Curve, DriverCurve) else {}
    return make(kind, **choices)


@pytest.mark.parametrize("group", range(len(GROUPS)), ids=lambda i: "-".join(GROUPS[i]))
def test_every_effect_is_in_one_graph(group):
    road = Ring() if group % 2 else Lane()
    compare(Simulator(road, (IDM(), Brakes(), *(effect(kind) for kind in GROUPS[group]))), backend="aot_eager")


@pytest.mark.parametrize("law", [law for law in BASES if law != "idm"])
def test_every_law_is_one_graph(law):
    compare(Simulator(Lane(), (make(law), Brakes())), backend="aot_eager")


@pytest.mark.slow
def test_inductor_gives_the_same():
    many = ("drag", "second_leader", "speed_dependent_gap", "memory", "lag", "control", "noise")
    compare(Simulator(Ring(), (IDM(), Brakes(), *(make(kind) for kind in many))))


def test_compiled_rollouts_say_so_and_repeat_the_step():
    simulator = Simulator(Lane(), (IDM(), Brakes()))
    compiled = simulator.compile(backend="aot_eager")
    state, _, params = problem(simulator)
    assert "compiled" in dispatch.refusal(compiled, state, {}, params)
    assert compiled.adding(make("drag")).backend == "aot_eager"
    with dispatch.off():
        last, kept = simulator.rollout(state, {}, params, 3)
    mine, ours = compiled.rollout(state, {}, params, 3)
    torch.testing.assert_close(mine.speed, last.speed)
    torch.testing.assert_close(ours.gap, kept.gap)


def test_without_a_compiler_one_warning_and_the_same_values():
    simulator = Simulator(Lane(), (IDM(), Brakes()))
    compiled = simulator.compile()
    state, _, params = problem(simulator)
    missing = torch._inductor.config.patch({"cpp.cxx": ("no-such-compiler",), "fx_graph_cache": False})
    with missing, pytest.warns(RuntimeWarning, match=r"runs uncompiled.*C\+\+ compiler") as caught:
        first = compiled.step(state, {}, params)
        second = compiled.step(first, {}, params)
    assert len([w for w in caught if issubclass(w.category, RuntimeWarning)]) == 1
    assert torch.equal(second.speed, simulator.step(simulator.step(state, {}, params), {}, params).speed)


def test_more_shapes_than_torch_compiles_are_stepped_uncompiled_with_one_warning():
    simulator = Simulator(Lane(), (IDM(), Brakes()))
    compiled, params = simulator.compile(backend="eager"), simulator.defaults()
    with pytest.warns(RuntimeWarning, match="dynamic=True") as caught:
        for n in range(2, 14):
            state = simulator.state(-30.0 * torch.arange(n), torch.full((n,), 10.0), params)
            after = compiled.step(state, {}, params)
            torch.testing.assert_close(after.speed, simulator.step(state, {}, params).speed)
    assert len(caught) == 1
