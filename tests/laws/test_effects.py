"""Laws that every effect obeys."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable

import pytest
import torch

from idm_env.effects import ALL, BASES, CANDIDATES, IDM, Brakes, CarFollowing, Effect, make
from idm_env.roads import Lane, Lanes, Ring, Road
from idm_env.simulator import Simulator
from idm_env.types import Scene
from tests.laws.members import DTYPE, MEMBERS, N, around, at_null, inputs_for, label, signalled, start, with_leaves

everything = pytest.mark.parametrize("effect", MEMBERS, ids=label)
NULLABLE = [e for e in MEMBERS if any(p.null is not None for p in e.parameters)]
nullable = pytest.mark.parametrize("effect", NULLABLE, ids=label)


@everything
def test_declares_one_hook_a_docstring_with_an_equation_or_source_and_parameters_within_bounds(effect: Effect) -> None:
    """Whoever reads an effect finds what it is."""
    assert effect.kind in ALL and type(effect) is ALL[effect.kind]
    assert inspect.getdoc(type(effect))
    assert len({p.name for p in effect.parameters}) == len(effect.parameters)
    assert make(effect.kind, **dataclasses.asdict(effect)) == effect
    hash(effect)


def test_the_catalogue_of_candidates_is_all_nullable() -> None:
    """A candidate without a null could not be scored at it."""
    for name in CANDIDATES:
        assert any(p.null is not None for p in make(name).parameters), name


@pytest.mark.parametrize("name", CANDIDATES)
def test_what_discovery_has_to_know_of_a_candidate_stands_in_its_class(name: str) -> None:
    """Otherwise reports fall silent, or another file has to know effects by name."""
    effect = make(name)
    cls = type(effect)
    assert cls.title and cls.equation and cls.told_by and cls.looks_like
    strength = next(p for p in effect.parameters if p.null is not None)
    low, high = strength.searched or (strength.low, strength.high)
    # A clause for every side of the null that a search can reach, and for no other.
    assert [bool(text) for text in cls.wording] == [low < strength.null, high > strength.null]  # type: ignore[operator]
    known = {*CANDIDATES, *(p.name for p in IDM.declared)}
    assert {item.split()[0] for item in cls.looks_like} <= known - {name}
    assert set(cls.cancels) <= set(CANDIDATES) - {name}
    assert bool(cls.column) <= (cls.sought in ("profile", "given"))
    if cls.sought in ("anywhere", "given"):
        for p in effect.parameters:
            least, most = p.searched or (p.low, p.high)
            assert p.starts and all(least < start < most for start in p.starts), p.name


@nullable
@pytest.mark.parametrize("road", [Lane(), Ring()], ids=["lane", "ring"])
@pytest.mark.parametrize("integration", ["ballistic", "euler", "midpoint"])
def test_null_is_absent(effect: Effect, road: Lane | Ring, integration: str) -> None:
    """At its null an effect leaves no trace, to the last bit."""
    with_it = around(effect, road, integration=integration)
    without = with_it.without(effect.name)
    params = at_null(with_it.effects)
    inputs = inputs_for(with_it, 30, torch.zeros(N, dtype=DTYPE))
    _, one = with_it.rollout(start(with_it, params), inputs, params, 30)
    _, other = without.rollout(start(without, params), {}, params, 30)
    for a, b in zip(one, other, strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize(
    "effect", [e for e in NULLABLE if any(p.role == "strength" and p.null is not None for p in e.parameters)], ids=label
)
def test_a_strength_has_a_gradient_at_its_null(effect: Effect) -> None:
    """What has no gradient at its null can never be found there: such parameters must say so by their role."""
    simulator = around(effect)
    params, leaves = with_leaves(at_null(simulator.effects), effect.name)
    inputs = inputs_for(simulator, 40, torch.zeros(N, dtype=DTYPE))
    _, kept = simulator.rollout(start(simulator, params), inputs, params, 40)
    kept.position[-1].square().sum().backward()
    # A knot of a curve matters only where the platoon drives; one that does is enough.
    strengths = [p for p in effect.parameters if p.role == "strength" and p.null is not None]
    gradients = {p.name: leaves[p.name].grad for p in strengths}
    assert all(g is None or torch.isfinite(g) for g in gradients.values())
    found = [name for name, g in gradients.items() if g is not None and g != 0]
    if effect.kind in ("curve", "driver_curve", "grade", "speed_profile"):
        assert found
    else:
        assert found == [p.name for p in strengths]


@nullable
def test_an_effect_at_its_default_does_something(effect: Effect) -> None:
    """Otherwise a candidate would be tested that cannot change anything."""
    simulator = around(effect)
    inputs = inputs_for(simulator, 60, torch.zeros(N, dtype=DTYPE))
    ends = []
    for params in (simulator.defaults(dtype=DTYPE), at_null(simulator.effects)):
        if effect.kind in ("power_limit", "traction"):  # what a car can is more than these drivers want
            (p,) = effect.parameters
            params[effect.name][p.name] = torch.tensor(p.null if ends else p.low, dtype=DTYPE)
            params["idm"]["desired_speed"] = torch.tensor(60.0, dtype=DTYPE)
        ends.append(simulator.rollout(start(simulator, params), inputs, params, 60)[0].position)
    assert (ends[0] - ends[1]).abs().max() > 1e-4


@everything
def test_gradcheck_in_parameters_positions_and_speeds(effect: Effect) -> None:
    """Analytic gradients are those of finite differences, in float64, over three steps."""
    simulator = around(effect)
    params = simulator.defaults(dtype=DTYPE)
    if effect.kind == "delay":  # away from a multiple of Δt, where interpolation has a kink
        params["delay"]["delay"] = torch.tensor(0.133, dtype=DTYPE)
    state = start(simulator, params)
    inputs = inputs_for(simulator, 3, state.speed)
    names = list(params[effect.name])
    free = [p for p in effect.parameters if p.role != "threshold" or effect.kind != "action_point"]
    free_names = [p.name for p in free]

    def run(position: torch.Tensor, speed: torch.Tensor, *values: torch.Tensor) -> tuple[torch.Tensor, ...]:
        changed = {**params[effect.name], **dict(zip(free_names, values, strict=True))}
        p = {**params, effect.name: changed}
        begin = simulator.state(position, speed, p, accel=state.accel, step=590)
        return tuple(simulator.rollout(begin, inputs, p, 3)[1])

    leaves = [state.position, state.speed, *(params[effect.name][n] for n in names if n in free_names)]
    assert torch.autograd.gradcheck(run, [x.clone().requires_grad_() for x in leaves], eps=1e-6, atol=1e-6)


@pytest.mark.parametrize(
    "effect", [e for e in MEMBERS if e.parameters and e.kind != "action_point" and e.hook != "change"], ids=label
)
def test_forward_mode_equals_reverse_mode(effect: Effect) -> None:
    """Jacobian-vector products, on which fitting and discovery stand, agree with back-propagation."""
    simulator = around(effect)
    params = simulator.defaults(dtype=DTYPE)
    names = list(params[effect.name])
    inputs = inputs_for(simulator, 20, torch.zeros(N, dtype=DTYPE))

    def run(*values: torch.Tensor) -> torch.Tensor:
        p = {**params, effect.name: dict(zip(names, values, strict=True))}
        return simulator.rollout(start(simulator, p), inputs, p, 20)[1].position.sum()

    values = tuple(params[effect.name].values())
    reverse = torch.autograd.grad(run(*(v.requires_grad_() for v in values)), values, allow_unused=True)
    for i, expected in enumerate(reverse):
        tangents = tuple(torch.ones_like(v) if j == i else torch.zeros_like(v) for j, v in enumerate(values))
        _, got = torch.func.jvp(run, tuple(v.detach() for v in values), tangents)
        torch.testing.assert_close(got, torch.zeros_like(got) if expected is None else expected, rtol=1e-9, atol=1e-9)


@everything
def test_a_batch_is_a_loop(effect: Effect) -> None:
    """Rows of a batch do not see each other."""
    simulator = around(effect)
    params = simulator.defaults(dtype=DTYPE)
    batch = start(simulator, params, batch=(3,))
    inputs = inputs_for(simulator, 25, batch.speed)
    _, together = simulator.rollout(batch, inputs, params, 25)
    for row in range(3):
        alone = simulator.state(batch.position[row], batch.speed[row], params, accel=batch.accel[row], step=590)
        alone = signalled(alone)
        mine = {
            name: value[:, row] if isinstance(value, torch.Tensor)
            else type(value)(*(None if x is None else x[:, row] for x in value))
            for name, value in inputs.items()
        }  # fmt: skip
        _, single = simulator.rollout(alone, mine, params, 25)
        for a, b in zip(together, single, strict=True):
            torch.testing.assert_close(a[:, row], b, rtol=1e-12, atol=1e-12)


@everything
def test_finite_for_overlaps_standstill_and_empty_roads(effect: Effect) -> None:
    """No NaN and no infinity in values and gradients, where the published form has both."""
    if getattr(effect, "sharpness", None) is not None and effect.kind in ("idm", "brakes"):
        pytest.skip("the published form, kept to be reproduced")
    simulator = around(effect)
    params = simulator.defaults(dtype=DTYPE)
    position = torch.tensor([100.0, 95.0, 90.5, 86.5, 70.0], dtype=DTYPE, requires_grad=True)
    speed = torch.tensor([0.0, 0.0, 3.0, 40.0, 0.0], dtype=DTYPE, requires_grad=True)
    state = simulator.state(position, speed, params)
    end, kept = simulator.rollout(state, inputs_for(simulator, 20, speed), params, 20)
    assert all(torch.isfinite(x).all() for x in kept)
    assert (kept.speed >= 0).all()
    for x in torch.autograd.grad(end.position.sum() + end.speed.sum(), (position, speed)):
        assert torch.isfinite(x).all()


@pytest.mark.parametrize(
    "name", ["second_leader", "leader_acceleration", "brake_light", "follower", "gap_bias", "dead_zone", "delay"]
)
def test_without_neighbours_an_effect_of_neighbours_is_exactly_absent(name: str) -> None:
    """A lone vehicle behaves as if the effect did not exist."""
    simulator = around(make(name))
    params = simulator.defaults(dtype=DTYPE)
    if name == "delay":
        params["delay"]["delay"] = torch.tensor(0.0, dtype=DTYPE)
    alone = torch.tensor([250.0], dtype=DTYPE), torch.tensor([10.0], dtype=DTYPE)
    bare = simulator.without(name)
    _, one = simulator.rollout(simulator.state(*alone, params), {}, params, 50)
    _, other = bare.rollout(bare.state(*alone, params), {}, params, 50)
    assert torch.equal(one.position, other.position)


@pytest.mark.parametrize("name", [name for name, cls in ALL.items() if cls.hook == "change"])
@pytest.mark.parametrize("road", [Lane(), Ring(), Lanes(1)], ids=["lane", "ring", "lanes"])
def test_on_one_lane_effects_that_change_lanes_are_refused(name: str, road: Road) -> None:
    """There is nowhere to go."""
    with pytest.raises(ValueError, match=f"effect '{name}' changes lanes: this road has one"):
        around(make(name), road)


def test_absent_vehicles_leave_no_trace() -> None:
    """A padded row equals the row without padding, also for effects of second leaders and followers."""
    effects = (IDM(), make("second_leader"), make("follower"), make("leader_acceleration"), Brakes())
    simulator = Simulator(Lane(), effects)
    params = simulator.defaults(dtype=DTYPE)
    position = torch.tensor([500.0, 300.0, 280.0, 262.0, 100.0], dtype=DTYPE)
    speed = torch.tensor([3.0, 9.0, 10.0, 11.0, 30.0], dtype=DTYPE)
    present = torch.tensor([0.0, 1.0, 1.0, 1.0, 0.0], dtype=DTYPE)
    padded = simulator.state(position, speed, params, present=present)
    bare = simulator.state(position[1:4], speed[1:4], params)
    _, one = simulator.rollout(padded, {}, params, 50)
    _, other = simulator.rollout(bare, {}, params, 50)
    for a, b in zip(one, other, strict=True):
        assert torch.equal(a[:, 1:4], b)


def test_every_step_shape_survives_parameters_per_vehicle() -> None:
    """Parameters may be scalars, per vehicle or per batch row."""
    simulator = Simulator(Lane(), (IDM(), make("delay"), make("memory"), Brakes()))
    params = simulator.defaults(dtype=DTYPE)
    state = start(simulator, params, batch=(2,))
    _, scalar = simulator.rollout(state, {}, params, 10)
    wide = {e: {n: v.expand(2, 1) for n, v in values.items()} for e, values in params.items()}
    _, per_row = simulator.rollout(start(simulator, wide, batch=(2,)), {}, wide, 10)
    full = {e: {n: v.expand(2, N) for n, v in values.items()} for e, values in params.items()}
    _, per_vehicle = simulator.rollout(start(simulator, full, batch=(2,)), {}, full, 10)
    for other in (per_row, per_vehicle):
        torch.testing.assert_close(scalar.position, other.position, rtol=0, atol=0)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (lambda: Simulator(Ring, (IDM(),)), "road: ABCMeta is no road"),  # type: ignore[arg-type]
        (lambda: Simulator(Lane(), IDM), "effects: type is no effect"),  # type: ignore[arg-type]
        (lambda: Simulator(Lane(), (IDM(), "brakes")), "effects: str is no effect"),  # type: ignore[arg-type]
        (lambda: Simulator(Lane(), (IDM(),), dt="0.1"), "dt = '0.1' must be a finite number"),  # type: ignore[arg-type]
        (lambda: Ring("230"), "circumference = '230' must be a finite number"),  # type: ignore[arg-type]
        (lambda: Ring(-1.0), "circumference = -1 m must be at least 1"),
        (lambda: Lanes(2, length=[3]), "length = .3. must be a finite number"),  # type: ignore[arg-type]
        (lambda: Lanes(2, ring=True), "ring = True must be a finite number"),
        (lambda: Lanes(2.0), "count = 2.0 must be a whole number"),  # type: ignore[arg-type]
    ],
)
def test_what_a_simulator_is_not_made_of_is_one_line(wrong: Callable[[], object], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        wrong()


def test_two_hooks_or_none_are_refused() -> None:
    """The rule of one hook is enforced where the class is written."""
    with pytest.raises(TypeError, match="override exactly one"):

        class Nothing(Effect):
            kind = "nothing"

    with pytest.raises(TypeError, match="override exactly one"):

        class Both(Effect):
            kind = "both"

            def perceive(self, scene: Scene, p: dict) -> Scene:
                return scene

            def accelerate(self, scene, driver, p):  # type: ignore[no-untyped-def]
                return scene.accel


def test_car_following_is_the_only_effect_with_a_driver() -> None:
    """Exactly one car-following effect per simulator, or an error that says so."""
    assert list(BASES) == [name for name, cls in ALL.items() if issubclass(cls, CarFollowing)]
    assert not set(BASES) & set(CANDIDATES)
    with pytest.raises(ValueError, match="exactly one car-following effect"):
        Simulator(Lane(), (IDM(), make("iidm"), Brakes()))
    with pytest.raises(ValueError, match="exactly one car-following effect, got none"):
        Simulator(Lane(), (Brakes(),))
