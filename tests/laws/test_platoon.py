"""What keeps a quiet platoon quiet: bounds of gains, and the maximum that physics sets to whatever effects add."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import pytest
import torch
from torch import Tensor

from idm_env.effects import ALL, BASES, IDM, Brakes, CarFollowing, Effect, Traction, make
from idm_env.parameters import Parameter
from idm_env.roads import Lane
from idm_env.simulator import Simulator, Trajectory
from idm_env.types import Adjacent, Command, Driver, Imagined, Params, Record, Scene
from tests.laws.members import DTYPE, MEMBERS, around, label

VEHICLES, STEPS, SPEED = 50, 600, 15.0
MAX_ACCEL = Traction().parameters[0].default
EQUILIBRIUM_GAP = (2.0 + 1.5 * SPEED) / (1.0 - (SPEED / 33.0) ** 4) ** 0.5
# Laws of other authors amplify or collide at some bounds by their equations; what they do at their defaults is tested.
BOUNDED = [e for e in MEMBERS if e.parameters and (isinstance(e, IDM) or not isinstance(e, CarFollowing))]


def quiet(simulator: Simulator, params: Params, steps: int = STEPS, rows: int = 1) -> Trajectory:
    """Fifty vehicles at the equilibrium of default drivers behind a leader who sways by 0.5 m/s, in each row."""
    place = 320.0 - (EQUILIBRIUM_GAP + 5.0) * torch.arange(VEHICLES, dtype=DTYPE)
    shape = (rows, VEHICLES)
    begin = simulator.state(place.expand(shape), torch.full(shape, SPEED, dtype=DTYPE), params)
    time = simulator.dt * torch.arange(1, steps + 1, dtype=DTYPE)[:, None, None]
    all_rows = torch.zeros(steps, *shape, dtype=DTYPE)
    first = (torch.arange(VEHICLES) == 0).expand(steps, *shape)
    sway, often = 0.5, 0.5
    every = {
        "replay": Record(
            all_rows + place[0] + SPEED * time + sway / often * (1.0 - torch.cos(often * time)),
            all_rows + SPEED + sway * torch.sin(often * time),
            all_rows + sway * often * torch.cos(often * time),
            first,
        ),
        "control": Command(all_rows, first),
        "imagined": Imagined(all_rows + EQUILIBRIUM_GAP, all_rows),
        "lateral": Adjacent(all_rows + 5.0, all_rows + SPEED - 0.5, all_rows + 1.0),
    }
    inputs = {name: value for name, value in every.items() if name in simulator.by_name}
    kept: Trajectory = simulator.rollout(begin, inputs, params, steps, seed=1)[1]
    return kept


def behind_a_record(effect: Effect) -> Simulator:
    """Return IDM, Brakes and the effect behind a replayed leader."""
    simulator = around(effect)
    return simulator if "replay" in simulator.by_name else simulator.adding(make("replay"))


@pytest.mark.parametrize("effect", BOUNDED, ids=label)
def test_no_bound_of_any_effect_makes_a_quiet_platoon_collide(effect: Effect) -> None:
    """Nobody overlaps and nobody accelerates as no car can, with every parameter at either bound, a row each."""
    simulator = behind_a_record(effect)
    params = simulator.defaults(dtype=DTYPE)
    bounds = [(p.name, end, getattr(p, end)) for p in effect.parameters for end in ("low", "high")]
    for name, value in params[effect.name].items():
        params[effect.name][name] = value.expand(len(bounds), 1).clone()
    for row, (name, _, value) in enumerate(bounds):
        params[effect.name][name][row] = value
    kept = quiet(simulator, params, rows=len(bounds))
    for row, bound in enumerate(bounds):
        assert kept.gap[:, row, 1:].min() > 0.0, bound
        assert kept.accel[:, row].max() <= MAX_ACCEL, bound
        assert kept.accel[:, row].min() >= -9.0 - 1e-9, bound


@pytest.mark.parametrize("law", BASES)
def test_laws_at_their_defaults_in_a_quiet_platoon(law: str) -> None:
    """None collides but the linear controller, whose measured gains amplify as their transfer function says.

    (0.23 + 0.07 z + 0.1 z²)/(0.3 z³ + z² + 0.323 z + 0.23) at z = 0.5 i has an absolute value of 1.66.
    """
    simulator = behind_a_record(make(law))
    kept = quiet(simulator, simulator.defaults(dtype=DTYPE))
    assert kept.gap[..., 1:3].min() > 0.0
    if law != "constant_time_gap":
        assert kept.gap[..., 1:].min() > 0.0
    else:
        z = 0.5j
        published = abs((0.23 + 0.07 * z + 0.1 * z**2) / (0.3 * z**3 + z**2 + 0.323 * z + 0.23))
        swing = kept.speed[-250:, 0, :3].amax(0) - kept.speed[-250:, 0, :3].amin(0)
        assert float(swing[1] / swing[0]) == pytest.approx(published, rel=0.1)


def test_feeding_the_leader_s_acceleration_forward_does_not_amplify() -> None:
    """String stability at the upper bound of the gain: the last vehicle brakes and accelerates less than the second."""
    simulator = behind_a_record(make("leader_acceleration"))
    params = simulator.defaults(dtype=DTYPE)
    params["leader_acceleration"]["gain"] = torch.tensor(simulator.by_name["leader_acceleration"].parameters[0].high)
    late = quiet(simulator, params, 1500).accel[-500:, 0].abs().amax(0)
    assert late[-1] <= late[1]


@dataclass(frozen=True)
class Push(Effect):
    """A user's own effect, of which the package knows nothing: a constant push."""

    kind: ClassVar[str] = "push"
    declared: ClassVar[tuple[Parameter, ...]] = (Parameter("push", "", "m/s²", 500.0, 0.0, 1e4, null=0.0),)

    def accelerate(self, scene: Scene, driver: Driver, p: dict[str, Tensor]) -> Tensor:
        """Return the push."""
        return p["push"] + 0.0 * scene.speed


@dataclass(frozen=True)
class LatePush(Effect):
    """The same, after all that physics limits."""

    kind: ClassVar[str] = "late_push"
    rank: ClassVar[int] = 80
    declared = Push.declared

    def limit(self, accel: Tensor, scene: Scene, driver: Driver, p: dict[str, Tensor]) -> Tensor:
        """Return the acceleration and the push."""
        return accel + p["push"]


@dataclass(frozen=True)
class EagerIDM(IDM):
    """A user's own law, a subclass of one that keeps its bounds."""

    def accelerate(self, scene: Scene, driver: Driver, p: dict[str, Tensor]) -> Tensor:
        """Return a thousand times IDM."""
        return 1000.0 * super().accelerate(scene, driver, p)


@pytest.mark.parametrize(
    "effects",
    [(IDM(), Push(), Brakes()), (IDM(), Brakes(), LatePush()), (EagerIDM(), Brakes()), (IDM(), Push())],
    ids=["accelerate", "after_the_brakes", "own_law", "without_brakes"],
)
def test_what_a_user_s_effect_adds_is_held_too(effects: tuple[Effect, ...]) -> None:
    """Whatever way it gets into the simulator, and with the parameters of that simulator alone."""
    for simulator in (Simulator(Lane(), effects), Simulator(Lane(), (effects[0],)).adding(*effects[1:])):
        params = simulator.defaults(dtype=DTYPE)
        state = simulator.state(torch.zeros(1, dtype=DTYPE), torch.zeros(1, dtype=DTYPE), params)
        assert simulator.acceleration(state, {}, params).item() == MAX_ACCEL


def test_the_maximum_has_its_own_value_and_its_null() -> None:
    """Named in the list of effects it takes any value; at its null nothing is held."""
    simulator = Simulator(Lane(), (IDM(), Push(), Traction(), Brakes()))
    params = simulator.defaults(dtype=DTYPE)
    state = simulator.state(torch.zeros(1, dtype=DTYPE), torch.zeros(1, dtype=DTYPE), params)
    for value, expected in ((3.0, 3.0), (1e5, 501.4)):
        params["traction"]["max_accel"] = torch.tensor(value, dtype=DTYPE)
        simulator.check(params)
        assert simulator.acceleration(state, {}, params).item() == pytest.approx(expected)


def test_effects_that_cannot_add_need_no_tyres() -> None:
    """IDM, its brakes, commands and records: the step that kernels know is what it was."""
    for name, cls in ALL.items():
        if not cls.adds and cls.hook != "change":
            assert not any(isinstance(e, Traction) for e in around(make(name))._hooks["limit"]) or name == "traction"
    assert {name for name, cls in ALL.items() if cls.adds} >= {"leader_acceleration", "noise", "asymmetry", "curve"}
    assert not any(ALL[name].adds for name in ("idm", "brakes", "control", "replay", "delay"))
