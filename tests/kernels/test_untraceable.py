"""Effects that cannot be recorded, and machines without numba: the torch path runs, and says why once."""

import subprocess
import sys
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import pytest
import torch

from idm_env.compiled.kernels import dispatch
from idm_env.effects import IDM, Brakes, Effect
from idm_env.parameters import Parameter
from idm_env.roads import Lane
from idm_env.simulator import Simulator

STRENGTH = (Parameter("strength", "k", "m/s²", 0.3, -2.0, 2.0, null=0.0),)


@dataclass(frozen=True)
class Branching(Effect):
    """A Python ``if`` on a tensor."""

    kind: ClassVar[str] = "branching"
    declared: ClassVar[tuple[Parameter, ...]] = STRENGTH

    def accelerate(self, scene, driver, p):
        if (scene.speed > 5.0).any():
            return p["strength"] * torch.ones_like(scene.speed)
        return torch.zeros_like(scene.speed)


@dataclass(frozen=True)
class Deciding(Effect):
    """A Python ``if`` on a comparison."""

    kind: ClassVar[str] = "deciding"
    declared: ClassVar[tuple[Parameter, ...]] = STRENGTH

    def accelerate(self, scene, driver, p):
        return p["strength"] * scene.speed if p["strength"] > 0.0 else 0.0 * scene.speed


@dataclass(frozen=True)
class Unknown(Effect):
    """A function of torch that no kernel knows."""

    kind: ClassVar[str] = "unknown"
    declared: ClassVar[tuple[Parameter, ...]] = STRENGTH

    def accelerate(self, scene, driver, p):
        return p["strength"] * torch.erf(scene.speed - 10.0)


@dataclass(frozen=True)
class Leaf(Effect):
    """The value of a tensor."""

    kind: ClassVar[str] = "reading"
    declared: ClassVar[tuple[Parameter, ...]] = STRENGTH

    def accelerate(self, scene, driver, p):
        return p["strength"] * scene.speed * p["strength"].item()


@dataclass(frozen=True)
class Averaging(Effect):
    """Looks at all vehicles at once, which one recorded vehicle cannot stand for."""

    kind: ClassVar[str] = "averaging"
    declared: ClassVar[tuple[Parameter, ...]] = STRENGTH

    def accelerate(self, scene, driver, p):
        return p["strength"] * (scene.speed.mean(-1, keepdim=True) - scene.speed)


@dataclass(frozen=True)
class Profiled(Effect):
    """A tensor of its own, one number per vehicle."""

    kind: ClassVar[str] = "profiled"
    declared: ClassVar[tuple[Parameter, ...]] = STRENGTH

    def accelerate(self, scene, driver, p):
        return p["strength"] * torch.linspace(-1.0, 1.0, scene.speed.shape[-1], dtype=scene.speed.dtype)


CASES = [
    (Branching(), "Tensor.any"),
    (Deciding(), "Python `if`"),
    (Unknown(), "torch.erf"),
    (Leaf(), "the value of a tensor"),
    (Averaging(), "Tensor.mean"),
    (Profiled(), ""),
]


def run(simulator):
    params = simulator.defaults(dtype=torch.float64)
    name = simulator.effects[-1].name
    strength = params[name]["strength"].requires_grad_()
    position = -20.0 * torch.arange(5, dtype=torch.float64)
    state = simulator.state(position, torch.linspace(8, 12, 5, dtype=torch.float64), params)
    last, kept = simulator.rollout(state, {}, params, 10)
    (gradient,) = torch.autograd.grad(kept.position.sum(), strength)
    return last.position.detach(), gradient


@pytest.mark.parametrize(("effect", "function"), CASES, ids=lambda x: getattr(x, "kind", None) or "")
def test_the_torch_path_runs_with_one_warning_that_names_effect_and_function(effect, function):
    pytest.importorskip("numba")
    simulator = Simulator(Lane(), (IDM(), Brakes(), effect))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        position, gradient = run(simulator)
        again, _ = run(Simulator(Lane(), (IDM(), Brakes(), effect)))
    assert [w.category for w in caught] == [UserWarning]
    message = str(caught[0].message)
    assert f"effect '{effect.kind}'" in message and function in message and "\n" not in message
    with dispatch.off():
        expected, wanted = run(simulator)
    assert torch.equal(position, expected) and torch.equal(again, expected) and torch.equal(gradient, wanted)
    assert gradient != 0.0


def test_an_effect_whose_choices_cannot_be_a_key_runs_too():
    """Kernels are looked up by effects; a list among the choices cannot be."""
    pytest.importorskip("numba")

    @dataclass(frozen=True)
    class Listed(Effect):
        kind: ClassVar[str] = "listed"
        declared: ClassVar[tuple[Parameter, ...]] = STRENGTH
        weights: list[float]

        def accelerate(self, scene, driver, p):
            return p["strength"] * sum(self.weights) * torch.ones_like(scene.speed)

    simulator = Simulator(Lane(), (IDM(), Brakes(), Listed([0.5, 0.25])))
    position, _ = run(simulator)
    with dispatch.off():
        assert torch.equal(position, run(simulator)[0])


PROGRAM = """
import sys, warnings
if {blocked}:
    sys.modules["numba"] = sys.modules["llvmlite"] = None
warnings.simplefilter("error")
import gymnasium, torch, idm_env
from idm_env.effects import IDM, Brakes, make
from idm_env.compiled.kernels import dispatch
from idm_env.roads import Lane, Ring

for road in (Lane(), Ring(120.0)):
    simulator = idm_env.Simulator(road, (IDM(), Brakes(), make("delay"), make("memory")))
    params = simulator.defaults(dtype=torch.float64)
    params["idm"]["time_gap"].requires_grad_()
    state = simulator.state(-20.0 * torch.arange(5.0).double(), torch.full((5,), 8.0).double(), params)
    assert {why!r} in dispatch.refusal(simulator, state, {{}}, params)
    last, kept = simulator.rollout(state, {{}}, params, 30)
    kept.position.sum().backward()
    assert params["idm"]["time_gap"].grad != 0.0
for task in ("ring", "follow", "platoon", "replay"):
    env = gymnasium.make("DiffIDM-v0", task=task)
    env.reset(seed=0)
    for _ in range(3):
        env.step(env.action_space.sample())
    env.close()
if {blocked}:
    assert sys.modules["numba"] is None
else:
    assert "numba" not in sys.modules
"""


@pytest.mark.parametrize(("blocked", "why"), [(True, "numba is not installed"), (False, "IDM_ENV_KERNELS=0")])
def test_without_numba_everything_works(blocked, why, monkeypatch):
    """Not installed, or switched off: no kernel, no warning, and numba is not even imported."""
    if not blocked:
        monkeypatch.setenv("IDM_ENV_KERNELS", "0")
    root = str(Path(__file__).resolve().parents[2])
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM.format(blocked=blocked, why=why)], capture_output=True, text=True, cwd=root
    )
    assert done.returncode == 0, done.stderr
