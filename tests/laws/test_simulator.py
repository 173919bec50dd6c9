"""Laws of the step and the rollout, whatever the effects."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st

from idm_env.effects import ALL, BASES, IDM, Brakes, Lag, make
from idm_env.roads import Lane, Ring
from idm_env.simulator import Simulator
from idm_env.types import FAR, Command, Record, State
from tests.laws.members import DTYPE, N, inputs_for, start

EVERYTHING = tuple(
    make(name) for name, cls in ALL.items()
    if name == "idm" or (name not in (*BASES, "replay", "imagined") and cls.hook != "change")
)  # fmt: skip


def test_gradcheck_through_20_steps_of_a_ring_with_all_effects() -> None:
    """All effects at once, in float64, with respect to every parameter that is not a threshold, and the start."""
    simulator = Simulator(Ring(), EVERYTHING)
    params = simulator.defaults(dtype=DTYPE)
    params["delay"]["delay"] = torch.tensor(0.133, dtype=DTYPE)
    params["action_point"]["threshold"] = torch.tensor(0.0, dtype=DTYPE)  # its switching has no derivative
    state = start(simulator, params)
    inputs = inputs_for(simulator, 20, state.speed)
    keys = [(e.name, p.name) for e in simulator.effects for p in e.parameters if e.name != "action_point"]

    def run(position: torch.Tensor, speed: torch.Tensor, *values: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        p = {e: dict(v) for e, v in params.items()}
        for (effect, name), value in zip(keys, values, strict=True):
            p[effect][name] = value
        begin = simulator.state(position, speed, p, accel=state.accel, step=590, circumference=400.0)
        end, _ = simulator.rollout(begin, inputs, p, 20)
        return end.position, end.speed

    leaves = [state.position, state.speed, *(params[e][n] for e, n in keys)]
    assert torch.autograd.gradcheck(run, [x.clone().requires_grad_() for x in leaves], eps=1e-6, atol=1e-5, rtol=1e-3)


def _gradient(dtype: torch.dtype) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(3)
    simulator = Simulator(Lane(), (IDM(), Brakes()))
    lanes, n = 4, 50
    gaps = 8.0 + 20.0 * torch.rand(lanes, n, generator=generator, dtype=DTYPE)
    position = (1000.0 - (gaps + 5.0).cumsum(-1)).to(dtype)
    speed = (5.0 + 10.0 * torch.rand(lanes, n, generator=generator, dtype=DTYPE)).to(dtype)
    params = {
        "idm": {
            name: (value * (0.9 + 0.2 * torch.rand(lanes, n, generator=generator, dtype=DTYPE))).to(dtype)
            for name, value in simulator.defaults(dtype=DTYPE)["idm"].items()
        },
        "brakes": simulator.defaults(dtype=dtype)["brakes"],
    }
    leaves = {"position": position, "speed": speed, **params["idm"]}
    for leaf in leaves.values():
        leaf.requires_grad_()
    end, _ = simulator.rollout(simulator.state(position, speed, params), {}, params, 100)
    (end.speed.square().mean() + (end.gap[:, 1:] / 20.0).square().mean()).backward()
    return {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}


def test_float32_gradients_within_1e_3_of_float64_after_100_steps_in_lanes_of_50() -> None:
    """Carrying the gap as state is what makes this hold; relative to the largest component of each leaf."""
    exact, rough = _gradient(torch.float64), _gradient(torch.float32)
    for name, truth in exact.items():
        error = (rough[name].double() - truth).abs().max() / truth.abs().max()
        assert error < 1e-3, f"{name}: {error:.2e}"


@pytest.mark.parametrize("road", [Lane(), Ring()], ids=["lane", "ring"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_gaps_and_positions_hold_together(road: Lane | Ring, dtype: torch.dtype) -> None:
    """The gap state is what the positions say, after a thousand steps, on the ring too."""
    simulator = Simulator(road, (IDM(), Lag(), Brakes()))
    params = simulator.defaults(dtype=dtype)
    end, _ = simulator.rollout(start(simulator, params, dtype), {}, params, 1000)
    around = 400.0 if isinstance(road, Ring) else None
    expected = road.gaps(end.position.double(), end.length.double(), around)
    torch.testing.assert_close(end.gap.double(), expected, rtol=0, atol=2e-9 if dtype == DTYPE else 3e-2)


def test_a_huge_ring_is_an_open_lane() -> None:
    """With 20 km of road ahead the first vehicle of a ring drives as in a lane."""
    ends = []
    for road, around in ((Lane(), None), (Ring(), 40_000.0)):
        simulator = Simulator(road, (IDM(), Brakes()))
        params = simulator.defaults(dtype=DTYPE)
        position = -25.0 * torch.arange(N, dtype=DTYPE)
        begin = simulator.state(position, torch.full((N,), 10.0, dtype=DTYPE), params, circumference=around)
        ends.append(simulator.rollout(begin, {}, params, 200)[0])
    torch.testing.assert_close(ends[0].position, ends[1].position, rtol=0, atol=2e-3)


@pytest.mark.parametrize("every", [1, 7, 20, 50])
def test_checkpoints_change_memory_not_values(every: int) -> None:
    """Values and gradients are the same bits with and without checkpoints."""
    results = []
    for k in (0, every):
        simulator = Simulator(Ring(), EVERYTHING)
        params = simulator.defaults(dtype=DTYPE)
        time_gap = params["idm"]["time_gap"].requires_grad_()
        state = start(simulator, params)
        inputs = inputs_for(simulator, 20, state.speed)
        end, kept = simulator.rollout(state, inputs, params, 20, checkpoint_every=k)
        end.position.sum().backward()
        results.append((kept.position.detach(), time_gap.grad))
    assert torch.equal(results[0][0], results[1][0])
    torch.testing.assert_close(results[0][1], results[1][1], rtol=1e-12, atol=0)


def test_checkpoints_save_memory() -> None:
    """Fewer saved tensors: counted, not timed."""
    saved = []
    for every in (0, 10):
        simulator = Simulator(Lane(), (IDM(), Brakes()))
        params = simulator.defaults(dtype=DTYPE)
        params["idm"]["time_gap"].requires_grad_()
        sizes: list[int] = []
        with torch.autograd.graph.saved_tensors_hooks(lambda x, s=sizes: s.append(x.numel()) or x, lambda x: x):
            simulator.rollout(start(simulator, params, batch=(50,)), {}, params, 100, checkpoint_every=every)
        saved.append(sum(sizes))
    assert saved[1] < saved[0] / 5


def test_values_are_the_same_bits_with_and_without_a_graph() -> None:
    """Requiring a gradient never changes a number."""
    simulator = Simulator(Ring(), EVERYTHING)
    params = simulator.defaults()
    state = start(simulator, params, torch.float32)
    inputs = inputs_for(simulator, 30, state.speed)
    _, plain = simulator.rollout(state, inputs, params, 30)
    assert plain.position.grad_fn is None
    for values in params.values():
        for value in values.values():
            value.requires_grad_()
    _, graph = simulator.rollout(start(simulator, params, torch.float32), inputs, params, 30)
    assert graph.position.grad_fn is not None
    for a, b in zip(plain, graph, strict=True):
        assert torch.equal(a, b.detach())


def test_a_replayed_vehicle_is_where_its_record_is_and_takes_no_gradient() -> None:
    """Nothing drifts, and the leader's own driver parameters change nothing."""
    simulator = Simulator(Lane(), (IDM(), make("replay"), Brakes()))
    params = {e: {n: v.expand(2).clone() for n, v in p.items()} for e, p in simulator.defaults(dtype=DTYPE).items()}
    time_gap = params["idm"]["time_gap"].requires_grad_()
    steps = 300
    t = 0.1 * torch.arange(steps + 1, dtype=DTYPE)
    lead_speed = 8.0 + 3.0 * torch.sin(0.3 * t)
    lead = 40.0 + torch.cat((torch.zeros(1, dtype=DTYPE), torch.cumulative_trapezoid(lead_speed, dx=0.1)))
    column = torch.zeros(steps, dtype=DTYPE)
    record = Record(
        torch.stack((lead[1:], column), -1),
        torch.stack((lead_speed[1:], column), -1),
        torch.stack((0.9 * torch.cos(0.3 * t[1:]), column), -1),
        torch.tensor([True, False]).expand(steps, 2),
    )
    begin = simulator.state(torch.stack((lead[0], lead[0] - 20)), lead_speed[:1].expand(2), params)
    end, kept = simulator.rollout(begin, {"replay": record}, params, steps)
    assert torch.equal(kept.position[:, 0], lead[1:])
    torch.testing.assert_close(kept.gap[:, 1], kept.position[:, 0] - 5.0 - kept.position[:, 1], rtol=0, atol=1e-9)
    end.position[1].backward()
    assert time_gap.grad is not None and time_gap.grad[0] == 0 and time_gap.grad[1] < 0


def test_a_second_leader_that_appears_is_seen_from_then_on() -> None:
    """Validity may change in time: the gap of a vehicle that gets a leader is built from positions."""
    simulator = Simulator(Lane(), (IDM(), make("replay"), Brakes()))
    params = simulator.defaults(dtype=DTYPE)
    steps = 20
    position = torch.stack((100 + torch.arange(1, steps + 1.0), 60 + torch.arange(1, steps + 1.0)), -1).double()
    present = torch.ones(steps, 2, dtype=DTYPE)
    present[:10, 0] = 0
    record = Record(
        position, torch.full_like(position, 10.0), 0 * position, torch.ones(steps, 2, dtype=torch.bool), present
    )
    begin = simulator.state(
        torch.tensor([100.0, 60.0], dtype=DTYPE),
        torch.full((2,), 10.0, dtype=DTYPE),
        params,
        present=torch.tensor([0.0, 1.0], dtype=DTYPE),
    )
    _, kept = simulator.rollout(begin, {"replay": record}, params, steps)
    assert (kept.gap[:10, 1] == FAR).all()
    torch.testing.assert_close(kept.gap[10:, 1], torch.full((10,), 35.0, dtype=DTYPE))


def test_a_command_drives_only_where_it_is_active_and_within_the_brakes() -> None:
    """Control replaces the driver; the brakes still hold."""
    simulator = Simulator(Lane(), (IDM(), make("control"), Brakes()))
    params = simulator.defaults(dtype=DTYPE)
    state = start(simulator, params)
    active = torch.tensor([False, True, False, True, False])
    command = Command(torch.tensor([9.0, 0.7, 9.0, -50.0, 9.0], dtype=DTYPE), active)
    accel = simulator.acceleration(state, {"control": command}, params)
    plain = simulator.without("control").acceleration(state, {}, params)
    assert torch.equal(accel[~active], plain[~active])
    torch.testing.assert_close(accel[1], torch.tensor(0.7, dtype=DTYPE))
    torch.testing.assert_close(accel[3], torch.tensor(-9.0, dtype=DTYPE))


@settings(max_examples=200)
@given(
    gap=st.floats(-20, 200),
    speed=st.floats(0, 60),
    lead_speed=st.floats(0, 60),
    integration=st.sampled_from(["ballistic", "euler", "midpoint"]),
)
def test_bounds_and_signs_for_any_state(gap: float, speed: float, lead_speed: float, integration: str) -> None:
    """``−b_max ≤ a ≤ a_max``, no reverse, and a larger gap never means less acceleration, overlaps included."""
    simulator = Simulator(Lane(), (IDM(), Brakes()), integration=integration)  # type: ignore[arg-type]
    params = simulator.defaults(dtype=DTYPE)
    behind = torch.tensor(-5.0 - gap, dtype=DTYPE, requires_grad=True)
    position = torch.stack((torch.zeros((), dtype=DTYPE), behind))
    state = simulator.state(position, torch.tensor([lead_speed, speed], dtype=DTYPE), params)
    accel = simulator.acceleration(state, {}, params)[1]
    assert -9.0 - 1e-12 <= accel.item() <= 1.4 + 1e-12
    (by_position,) = torch.autograd.grad(accel, behind)
    assert torch.isfinite(by_position) and by_position <= 0
    end: State = simulator.step(state, {}, params)
    assert (end.speed >= 0).all() and (end.position >= state.position).all()


def test_errors_name_value_rule_and_cure() -> None:
    """One line each."""
    simulator = Simulator(Lane(), (IDM(), make("noise"), Brakes()))
    params = simulator.defaults()
    state = start(simulator, params, torch.float32)
    with pytest.raises(ValueError, match="'noise' takes normals"):
        simulator.rollout(state, {}, params, 3)
    with pytest.raises(ValueError, match="covers 2 steps of 3"):
        simulator.rollout(state, {"noise": torch.zeros(2, N)}, params, 3)
    with pytest.raises(ValueError, match=r"belongs to no effect.*'noise'"):
        simulator.rollout(state, {"nose": torch.zeros(3, N)}, params, 3)
    with pytest.raises(ValueError, match=r"idm.time_gap = 0 s is outside \[0.1, 5\] s"):
        simulator.check({**params, "idm": {**params["idm"], "time_gap": torch.tensor(0.0)}})
    with pytest.raises(ValueError, match=r"unknown parameter 'idm.headway'"):
        simulator.check({**params, "idm": {**params["idm"], "headway": torch.tensor(1.0)}})
    with pytest.raises(ValueError, match=r"'idm.time_gap' is missing"):
        simulator.check({**params, "idm": {k: v for k, v in params["idm"].items() if k != "time_gap"}})
    with pytest.raises(ValueError, match=r"dt = 100 s is outside \(0, 5\] s: no step"):
        Simulator(Lane(), (IDM(), Brakes()), dt=100.0)
    with pytest.raises(ValueError, match=r"dt = 2 s is longer than the shortest time gap, idm.time_gap = 1.5 s.*Take"):
        Simulator(Lane(), (IDM(), Brakes()), dt=2.0).check({e: params[e] for e in ("idm", "brakes")})
    with pytest.raises(ValueError, match="Did you mean 'delay'"):
        make("dely")
    with pytest.raises(ValueError, match=r"no choice 'max_dely'.*'max_delay'"):
        make("delay", max_dely=1.0)
    with pytest.raises(ValueError, match="do not fit a ring of 20 m"):
        Simulator(Ring(20.0), (IDM(), Brakes())).state(torch.zeros(9), torch.zeros(9), params)
    with pytest.raises(ValueError, match="needs its circumference"):
        Simulator(Ring(), (IDM(), Brakes())).state(torch.zeros(2), torch.zeros(2), params)
    with pytest.raises(ValueError, match="must be tensors of one shape"):
        simulator.state(torch.zeros(3), torch.zeros(2), params)
    with pytest.raises(ValueError, match="given twice"):
        simulator.adding(Brakes())
    with pytest.raises(ValueError, match="Did you mean 'noise'"):
        simulator.without("nois")
    with pytest.raises(ValueError, match=r"integration = 'eulr' is unknown. Did you mean 'euler'"):
        Simulator(Lane(), (IDM(),), integration="eulr")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"state": None}, "state = None must be a State"),
        ({"state": (1.0, 2.0)}, r"state = \(1.0, 2.0\) must be a State"),
        ({"inputs": [1]}, r"inputs = \[1\] must be a Mapping"),
        ({"params": None}, "parameters = None must be effect"),
        ({"params": {}}, r"parameter 'idm\.max_accel' is missing"),
        ({"params": {"idm": 1.0}}, "parameters = .* must be effect"),
    ],
    ids=str,
)
def test_what_a_rollout_does_not_take_is_one_line(wrong: dict[str, object], words: str) -> None:
    simulator = Simulator(Lane(), (IDM(), Brakes()))
    params = simulator.defaults()
    state = simulator.state(torch.tensor([30.0, 0.0]), torch.tensor([10.0, 10.0]), params)
    given: dict[str, object] = {"state": state, "inputs": {}, "params": params, **wrong}
    with pytest.raises(ValueError, match=words) as told:
        simulator.rollout(**given, steps=2)  # type: ignore[arg-type]
    assert "\n" not in str(told.value)
    if "params" in wrong:
        with pytest.raises(ValueError, match=words):
            simulator.state(state.position, state.speed, wrong["params"])  # type: ignore[arg-type]


@pytest.mark.parametrize("wrong", [None, [30.0, 0.0], "a", np.array([30.0, 0.0])], ids=str)
def test_a_start_is_made_of_tensors(wrong: object) -> None:
    simulator = Simulator(Lane(), (IDM(), Brakes()))
    with pytest.raises(ValueError, match="must be tensors of one shape"):
        simulator.state(wrong, torch.tensor([10.0, 10.0]), simulator.defaults())  # type: ignore[arg-type]
