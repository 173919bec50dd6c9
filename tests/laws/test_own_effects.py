"""An effect of one's own that does what it must not is told by its name, on every path, once it does it."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch

import idm_env  # noqa: F401  (registers the environments)
from idm_env import backends
from idm_env.compiled.scalar.graph import Graph
from idm_env.compiled.scalar.straight import constant_text
from idm_env.data import episodes, synthetic
from idm_env.discovery.discover import discover
from idm_env.effects import IDM, Brakes, CarFollowing, Effect, Mobil, Replay
from idm_env.effects.watched import RETURNS
from idm_env.fitting.evaluate import errors
from idm_env.fitting.fit import fit
from idm_env.fitting.job import problem_of
from idm_env.model_file import Model
from idm_env.parameters import Parameter
from idm_env.roads import Lane, Lanes
from idm_env.simulator import Simulator
from idm_env.types import Wish

DTYPE = torch.float64
LATE = 1.05
"""When effects begin to do what they must not (s): not at the first step, which is tried."""


PATHS = {"compiled": contextlib.nullcontext, "torch": backends.off, "lanes": contextlib.nullcontext}


def own(
    hook: str, method: Callable[..., Any], back: float = 0.0, base: type[Effect] = Effect, **others: Callable[..., Any]
) -> Effect:
    """Return an effect of one's own whose hook is ``method`` (without its ``self``), and ``others`` beside it."""
    methods = {name: lambda self, *given, f=f: f(*given) for name, f in {hook: method, **others}.items()}
    body = {"kind": "mine", **methods, "looks_back": property(lambda self: back), "__module__": "somebody"}
    return dataclass(frozen=True)(type("Mine", (base,), body))()


def late(scene: Any, value: float) -> Any:
    return torch.where(scene.time > LATE, value, 0.0) + 0.0 * scene.speed


def halved(scene: Any, driver: Any, p: Any) -> Any:
    speed = scene.speed
    speed *= 0.5
    return 0.0 * speed


def nan_wish(scene: Any, driver: Any, p: Any) -> Wish:
    none = 0.0 * scene.speed
    return Wish(late(scene, math.nan), none, none + 1.0, none + 1.0)


CASES = {
    "nan": (own("accelerate", lambda s, d, p: late(s, math.nan)), r"accelerate returned nan for vehicle 0 at 1.1 s"),
    # The law of max(NaN, x) of compiled loops would lose it.
    "nan in a limit": (
        own("limit", lambda a, s, d, p: a + late(s, math.nan)), r"limit returned nan for vehicle 0 at 1.1 s",
    ),
    "nan perceived": (
        own("perceive", lambda s, p: s._replace(speed=s.speed + late(s, math.nan))),
        r"perceive returned speed nan for vehicle 0 at 1.1 s",
    ),
    "a driver's nan": (
        own("adapt", lambda d, s, p: d._replace(time_gap=d.time_gap + late(s, math.nan))),
        r"adapt returned time_gap nan for vehicle 0 at 1.1 s",
    ),
    "a nan constant": (own("accelerate", lambda s, d, p: s.speed * math.nan), r"accelerate returned nan for vehicle 0"),
    "another shape": (own("accelerate", lambda s, d, p: torch.zeros(7)), r"returned a tensor of shape \(7,\)"),
    "a shape that torch refuses": (own("accelerate", lambda s, d, p: s.speed + torch.zeros(7)), "accelerate fails"),
    "nan remembered": (
        own("accelerate", lambda s, d, p: 0.0 * s.memory["mine"], remember=lambda s, d, p: late(s, math.nan),
            initial_memory=lambda s, d, p: 0.0 * s.speed), r"Mine.remember returned nan for vehicle 0 at 1.1 s",
    ),
    "nothing": (own("accelerate", lambda s, d, p: None), r"accelerate returned NoneType, and it must return Tensor"),
    "another kind": (own("adapt", lambda d, s, p: s), r"adapt returned Scene, and it must return Driver"),
    "in place": (own("accelerate", lambda s, d, p: 0.0 * s.speed.mul_(0.5)), r"changes scene.speed in place"),
    "augmented": (own("accelerate", halved), r"changes scene.speed in place"),
    "in place of a neighbour": (
        own("accelerate", lambda s, d, p: 0.0 * s.leader.gap.clamp_(max=5.0)), r"changes scene.leader.gap in place",
    ),
    "too far back": (
        own("accelerate", lambda s, d, p: 0.0 * s.past(torch.tensor(5.0)).speed, 0.5), r"looks 5 s back.* is 0.5 s",
    ),
    "too far back, late": (
        own("accelerate", lambda s, d, p: 0.0 * s.past(0.2 + late(s, 5.0)).speed, 0.5), r"looks 5.2 s back.* is 0.5 s",
    ),
}  # fmt: skip


def road_of(effect: Effect, lanes: bool) -> tuple[Simulator, Any, Any]:
    simulator = Simulator(Lanes(2), (IDM(), Mobil(), effect, Brakes())) if lanes else Simulator(
        Lane(), (IDM(), effect, Brakes())
    )  # fmt: skip
    params = simulator.defaults(dtype=DTYPE)
    position = torch.tensor([60.0, 30.0, 0.0], dtype=DTYPE)
    speed = torch.full_like(position, 10.0)
    return simulator, simulator.state(position, speed, params, lane=0 if lanes else None), params


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("name", CASES)
def test_what_an_effect_must_not_do_is_told_in_one_line(name: str, path: str) -> None:
    effect, told = CASES[name]
    simulator, state, params = road_of(effect, path == "lanes")
    with (
        pytest.raises(ValueError, match=told) as caught,
        PATHS[path](),
    ):
        simulator.rollout(state, {}, params, 40)
    assert str(caught.value).startswith("effect 'mine': ") and "\n" not in str(caught.value)


def ill(hook: str) -> Effect:
    """Return an effect of which one method returns NaN, late where it is given a scene."""
    plain: dict[str, Any] = {"accelerate": lambda s, d, p: 0.0 * s.speed}
    nan: dict[str, Callable[..., Any]] = {
        "perceive": lambda s, p: s._replace(speed=s.speed + late(s, math.nan)),
        "adapt": lambda d, s, p: d._replace(desired_speed=d.desired_speed + late(s, math.nan)),
        "accelerate": lambda s, d, p: late(s, math.nan),
        "limit": lambda a, s, d, p: a + late(s, math.nan),
        "place": lambda m, s, p: m._replace(speed=m.speed + late(s, math.nan)),
        "change": nan_wish,
        "driver": lambda p: IDM().driver({**p, "time_gap": p["time_gap"] * math.nan}),
        "remember": lambda s, d, p: late(s, math.nan),
        "initial_memory": lambda s, d, p: s.speed * math.nan,
        "room": lambda s, p: late(s, math.nan),
    }
    if hook in ("remember", "initial_memory"):
        return own(hook, nan[hook], **{"initial_memory": lambda s, d, p: 0.0 * s.speed, hook: nan[hook]}, **plain)
    wish = {"change": lambda s, d, p: Wish(*[0.0 * s.speed + x for x in (0.0, 0.0, 1.0, 1.0)])}
    return own(hook, nan[hook], base=IDM if hook == "driver" else Effect, **(wish if hook == "room" else {}))


@pytest.mark.parametrize("hook", RETURNS)
def test_nan_of_any_hook_is_told_by_its_class_and_cured(hook: str) -> None:
    """By a step; where a file of trajectories is simulated, too (``fit`` and ``simulate`` of the command line)."""
    effect, lanes = ill(hook), hook in ("change", "room")
    others = () if hook == "driver" else (IDM(),)
    cure = (
        r"nan( for vehicle \d( at [\d.]+ s)?)?\. Keep what it divides by, and takes roots or logarithms of, above 0\.$"
    )
    with (
        pytest.raises(ValueError, match=rf"^effect 'mine': Mine\.{hook} returned \w* ?{cure}"),
        backends.off(),
    ):
        simulator = Simulator(Lanes(2) if lanes else Lane(), (*others, effect, Brakes()))
        params = simulator.defaults(dtype=DTYPE)
        position = torch.tensor([60.0, 30.0, 0.0], dtype=DTYPE)
        state = simulator.state(position, torch.full_like(position, 10.0), params, lane=0 if lanes else None)
        simulator.rollout(state, {}, params, 40)


@pytest.mark.parametrize("work", ["fit", "simulate", "explain"])
def test_nan_is_told_behind_measured_leaders(work: str) -> None:
    """Not as a matrix of numpy's or an axis of a picture's that does not work."""
    trajectories = synthetic.generate(1, runs=2, followers=1, seconds=20.0)[0]
    items = episodes(trajectories)
    law = own("accelerate", lambda s, d, p: late(s, math.nan), base=IDM)
    with pytest.raises(ValueError, match=r"^effect 'mine': Mine\.accelerate returned nan for vehicle 0 at "):
        if work == "fit":
            fit(items, simulator=Simulator(Lane(), (law, Brakes(), Replay())), starts=2)
        elif work == "explain":
            discover(trajectories, base=law)
        else:
            problem, own_values, _ = problem_of(Model((law, Brakes())), items)
            errors(problem, own_values, own_values[0, :0])


@pytest.mark.parametrize("name", ["looks_back", "decides_every", "decides_in_blocks"])
def test_what_an_effect_says_of_itself_is_a_number(name: str) -> None:
    for value in (math.nan, math.inf, -1.0, "a", None, 1e300):
        effect = own("accelerate", lambda s, d, p: s.accel)
        setattr(type(effect), name, property(lambda self, value=value: value))
        with pytest.raises(ValueError, match=rf"^effect 'mine': Mine\.{name} = [^\n]* must be "):
            Simulator(Lane(), (IDM(), effect))


@pytest.mark.parametrize("path", ["lanes", "torch"])
def test_a_wish_that_is_nan_is_told(path: str) -> None:
    """Comparisons with NaN are false: nobody would ever change lanes, and nobody would know why."""
    effect = own("change", nan_wish)
    simulator, state, params = road_of(effect, True)
    with (
        pytest.raises(ValueError, match="change returned left nan"),
        PATHS[path](),
    ):
        simulator.rollout(state, {}, params, 40)


def test_an_environment_tells_nan_at_the_step_that_has_it() -> None:
    effect = own("accelerate", lambda s, d, p: late(s, math.nan))
    env = gymnasium.make("DiffIDM-v0", task="ring", effects=(effect,), warmup=0)
    env.reset(seed=1)
    for _ in range(11):
        observation, *_ = env.step(np.zeros(env.action_space.shape, np.float32))
        assert np.isfinite(observation).all()
    with pytest.raises(ValueError, match=r"^effect 'mine': Mine.accelerate returned nan for vehicle 0 at 1.1 s"):
        env.step(np.zeros(env.action_space.shape, np.float32))


def test_nan_of_what_is_given_is_not_the_effects_fault() -> None:
    """A rollout from a state with NaN is what it was."""
    simulator, state, params = road_of(own("accelerate", lambda s, d, p: 0.1 * s.speed), False)
    state = state._replace(speed=state.speed * torch.tensor([1.0, math.nan, 1.0], dtype=DTYPE))
    last, _ = simulator.rollout(state, {}, params, 3)
    assert bool(last.speed.isnan().any())


CLASSES: dict[str, tuple[type, dict[str, Any], str]] = {
    "a newline in its kind": (Effect, {"kind": "a\nb"}, r"kind = 'a\\nb' names files"),
    "a dot": (Effect, {"kind": "a.b"}, r"kind = 'a.b' names files"),
    "a slash": (Effect, {"kind": "../a"}, r"kind = '../a' names files"),
    "unknown needs": (Effect, {"kind": "a", "needs": frozenset({"leader"})}, r"needs = \['leader'\] is unknown"),
    "a law without an equation": (CarFollowing, {"kind": "a", "driver": lambda self, p: None}, "has no equation"),
    "a law with an equation alone": (CarFollowing, {"kind": "a", "accelerate": lambda *_: None}, "driver; no param"),
    "a law with a name alone": (CarFollowing, {"kind": "a"}, "equation: override accelerate; no driver"),
}


@pytest.mark.parametrize("name", CLASSES)
def test_a_class_that_cannot_work_is_refused_where_it_is_written(name: str) -> None:
    base, body, told = CLASSES[name]
    hook = {"accelerate": lambda self, scene, driver, p: scene.accel} if base is Effect else {}
    with pytest.raises(TypeError, match=told) as caught:
        type("Mine", (base,), {**hook, **body, "__module__": "somebody"})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("null", [-0.1, 1.1, math.nan, math.inf])
def test_a_null_outside_the_bounds_is_refused(null: float) -> None:
    """Only a threshold is absent beyond its bounds: a power of 10⁵ W/kg limits nobody."""
    with pytest.raises(ValueError, match="parameter 'gain': null"):
        Parameter("gain", "g", "1", 0.5, 0.0, 1.0, null=null)
    if math.isfinite(null):
        Parameter("gain", "g", "1", 0.5, 0.0, 1.0, null=null, role="threshold")


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_constants_that_are_no_numbers_are_printed_as_such(value: float) -> None:
    """``nan`` is no name in a printed file."""
    assert np.array_equal(eval(constant_text(Graph().constant(value).label)), value, equal_nan=True)
