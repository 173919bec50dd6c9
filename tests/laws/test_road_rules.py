"""What a road tells its drivers: absent at its null, the same compiled, and obeyed."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from idm_env.compiled.kernels import dispatch
from idm_env.effects import (
    IDM,
    Brakes,
    Calm,
    Courtesy,
    Destination,
    Effect,
    GapAcceptance,
    LaneClosure,
    MandatoryChange,
    Mobil,
    Signal,
    SpeedLimit,
)
from idm_env.multilane import demand
from idm_env.roads import Lanes, off_ramp
from idm_env.simulator import Simulator
from idm_env.types import State

DTYPE = torch.float64
ROAD = Lanes(3, length=900.0, ends=(off_ramp(0, begin=0.0, end=600.0, leaves=900.0),))
RULES: tuple[Effect, ...] = (
    SpeedLimit(zones=((2.0, 200.0, 500.0, 15.0), (-1.0, 700.0, 900.0, 20.0))),
    LaneClosure(closures=((1.0, 300.0, 450.0, 20.0, 60.0),)),
    Signal(),
    Destination(),
)
Params = dict[str, dict[str, Tensor]]


def begun(*rules: Effect, per_hour: float = 700.0, seconds: float = 60.0) -> tuple[Simulator, State, Params]:
    """Return an empty road for which drivers of different desired speeds wait."""
    simulator = Simulator(ROAD, (IDM(), Mobil(), MandatoryChange(), GapAcceptance(), *rules, Brakes()))
    params = simulator.defaults(dtype=DTYPE)
    trips = demand.trips(dict.fromkeys(range(3), per_hour), seconds, dtype=DTYPE)
    n = len(trips.departs)
    params["idm"]["desired_speed"] = 18.0 + 12.0 * torch.arange(n, dtype=DTYPE).mul(0.618).remainder(1.0)
    if "destination" in params:
        first = torch.arange(n).remainder(3) > 0
        params["destination"] |= {"first": first.to(DTYPE), "last": torch.where(first, 1000.0, 0.0).to(DTYPE)}
        params["destination"]["place"] = torch.full((n,), 600.0, dtype=DTYPE)
    return simulator, demand.waiting(simulator, trips, params), params


def test_rules_at_their_nulls_are_absent_to_the_last_bit() -> None:
    """Every rule at once, beside a simulator that has none."""
    never = LaneClosure(closures=())
    simulator, state, params = begun(SpeedLimit(), never, Signal(), Destination())
    params["speed_limit"]["compliance"] = torch.tensor(0.0, dtype=DTYPE)
    params["signal"]["red"] = torch.tensor(0.0, dtype=DTYPE)
    params["destination"]["place"] = torch.tensor(-1e9, dtype=DTYPE)
    plain, other, own = begun()
    with dispatch.off():
        for _ in range(600):
            state, other = simulator.step(state, {}, params), plain.step(other, {}, own)
    assert torch.equal(state.position, other.position) and torch.equal(state.gap, other.gap)
    assert state.lanes is not None and other.lanes is not None and int(state.lanes.changed.sum()) > 0
    assert all(torch.equal(a, b) for a, b in zip(state.lanes[:7], other.lanes[:7], strict=True))


def test_compiled_rules_are_those_of_the_torch_path() -> None:
    """Decision after decision from the same states: links, and where everybody is."""
    pytest.importorskip("numba")
    simulator, state, params = begun(*RULES)
    params["signal"] |= {"place": torch.tensor(650.0, dtype=DTYPE), "reaction": torch.tensor(1.5, dtype=DTYPE)}
    for _ in range(70):
        with dispatch.off():
            expected, _ = simulator.rollout(state, {}, params, 10, keep=None)
        state, _ = simulator.rollout(state, {}, params, 10, keep=None)
        assert state.lanes is not None and expected.lanes is not None
        assert all(torch.equal(a, b) for a, b in zip(expected.lanes[:7], state.lanes[:7], strict=True))
        assert torch.allclose(expected.position, state.position, rtol=0, atol=1e-9)
    assert int(state.lanes.changed.sum()) > 10


@pytest.mark.parametrize("lane", [0, 1])
def test_a_limit_holds_on_its_lane_and_between_its_places(lane: int) -> None:
    """A vehicle that wants 30 m/s drives 15 m/s there, and 30 m/s on the lane beside."""
    simulator = Simulator(Lanes(2), (IDM(), SpeedLimit(zones=((0.0, 500.0, 2000.0, 15.0),)), Brakes()))
    params = simulator.defaults(dtype=DTYPE)
    params["idm"]["desired_speed"] = torch.tensor(30.0, dtype=DTYPE)
    start = torch.tensor([0.0], dtype=DTYPE)
    _, kept = simulator.rollout(simulator.state(start, start + 30.0, params, lane=lane), {}, params, 1200)
    inside = (kept.position > 1500.0) & (kept.position < 2000.0)
    expected = 15.0 if lane == 0 else 30.0
    assert torch.allclose(kept.speed[inside], torch.tensor(expected, dtype=DTYPE), atol=0.2)
    assert int(inside.sum()) > 100


def test_a_closed_lane_is_left_for_a_time_and_used_again() -> None:
    """While it is closed nobody comes into the stretch who was not there; nobody touches anybody, all get out."""
    simulator, state, params = begun(RULES[1], per_hour=500.0)
    entered, used, gap = 0, 0, 1e9
    inside = torch.zeros_like(state.speed, dtype=torch.bool)
    for _ in range(1800):
        before, state = inside, simulator.step(state, {}, params)
        assert state.lanes is not None and state.present is not None
        there = (state.present > 0) & (state.lanes.lane == 1)
        inside = there & (state.position > 300.0) & (state.position < 450.0)
        time = float(simulator.time(state))
        entered += int((inside & ~before).sum()) if 20.2 < time < 60.0 else 0
        used += int(inside.sum()) if time >= 60.0 else 0
        gap = min(gap, float(state.gap.min()))
    found = demand.counts(simulator, state)
    assert entered == 0 and used > 0 and gap > 0.0
    assert int(found.left) == int(found.due) == 24


def test_a_signal_stops_who_can_stop_and_lets_go_in_green() -> None:
    """Who crosses the line in red would have had to brake harder than b_m when it became red."""
    simulator, state, params = begun(Signal())
    crossed = {True: 0, False: 0}
    for _ in range(1500):
        before, state = state, simulator.step(state, {}, params)
        over = (before.position < 400.0) & (state.position >= 400.0)
        since = float(simulator.time(before)) % 60.0 - 30.0
        crossed[since >= 0.0] += int(over.sum())
        if since > 10.0:  # who could not stop from 30 m/s is over by then
            assert not bool(over.any()), since
    assert crossed[False] > 20 and crossed[True] < 5
    assert bool((state.position[state.present > 0] > 400.0).all()) if state.present is not None else False


def before_a_signal(most_decel: float, cycle: float, red: float) -> tuple[Simulator, Params, Tensor]:
    """Return drivers of every kind, each alone on a road with a signal at 400 m: v0 from 5 to 40 m/s, a, b."""
    simulator = Simulator(Lanes(1), (IDM(), Signal(), Brakes()))
    params = simulator.defaults(dtype=DTYPE)
    grid = torch.cartesian_prod(*(torch.tensor(x, dtype=DTYPE) for x in (
        (5.0, 10.0, 15.0, 20.0, 30.0, 40.0), (0.5, 1.5, 2.6, 4.0), (0.5, 2.0, 4.0, 6.0, 9.0)
    )))  # fmt: skip
    params["idm"] |= dict(zip(("desired_speed", "max_accel", "comfort_decel"), grid.T.unsqueeze(-1), strict=True))
    for name, value in {"place": 400.0, "most_decel": most_decel, "cycle": cycle, "red": red}.items():
        params["signal"][name] = torch.tensor(value, dtype=DTYPE)
    return simulator, params, grid[:, :1]


@pytest.mark.parametrize("most_decel", [0.5, 3.0, 9.0])
def test_who_has_begun_to_stop_at_a_signal_does(most_decel: float) -> None:
    """At a light that is always red every driver who can stop where he begins stands before the line, and stays."""
    simulator, params, speed = before_a_signal(most_decel, 60.0, 60.0)
    start = simulator.state(torch.zeros_like(speed), speed, params, lane=0)
    able = speed.square() <= 2.0 * most_decel * 400.0
    end, kept = simulator.rollout(start, {}, params, 2000)
    stands = (end.speed < 0.05) & (end.position < 400.0) & (end.position > 390.0)
    assert bool((kept.position.amax(0) < 400.0)[able].all()) and bool(stands[able].all())
    assert bool((end.position > 400.0)[~able].all())


def test_nobody_who_could_not_stop_hesitates_before_a_signal() -> None:
    """When it turns red at 10 s those who would have to brake harder than b_m cross at their speed, all others stop."""
    simulator, params, speed = before_a_signal(3.0, 1000.0, 990.0)
    place = 400.0 - 10.0 * speed - torch.linspace(0.5, 300.0, 60, dtype=DTYPE)  # where it turns red
    grid = {name: x.repeat(1, 60).reshape(-1, 1) for name, x in params["idm"].items() if x.dim()}
    params["idm"] |= grid
    position, speed = place.reshape(-1, 1), speed.repeat(1, 60).reshape(-1, 1)
    _, kept = simulator.rollout(simulator.state(position, speed, params, lane=0), {}, params, 600)
    at_red = kept.position[99]
    can = speed.square() <= 2.0 * 3.0 * (400.0 - at_red)
    crosses = kept.position[-1] > 400.0
    assert bool((crosses != can).all()) and 0 < int(can.sum()) < len(can)
    assert bool((kept.speed[99:, ~can] > 0.99 * speed[~can]).all())


def test_drivers_leave_where_they_want_to() -> None:
    """Whose destination is the exit leaves on lane 0, everybody else on the others."""
    simulator, state, params = begun(Destination(), Courtesy(), Calm(), per_hour=500.0)
    for _ in range(1200):
        state = simulator.step(state, {}, params)
    assert state.lanes is not None and state.lanes.trips is not None
    left, exits = state.lanes.trips.left > 0, params["destination"]["last"] == 0.0
    right = (state.lanes.lane == 0) == exits
    # Two drive abreast, each on the lane that the other one wants: not all who let others in do so in time.
    assert int(left.sum()) == 24 and int((left & right).sum()) >= 22


BAD = {
    "speed limit = 0 m/s must be above 0": lambda: SpeedLimit(zones=((0.0, 0.0, 10.0, 0.0),)),
    "must end behind its beginning": lambda: LaneClosure(closures=((0.0, 20.0, 10.0, 0.0, 1.0),)),
    "name one lane, and rise": lambda: LaneClosure(closures=((0.0, 0.0, 10.0, 5.0, 1.0),)),
    "lane = 0.5 must be a whole number": lambda: SpeedLimit(zones=((0.5, 0.0, 10.0, 10.0),)),
    "must give lane, beginning": lambda: SpeedLimit(zones=((0.0, 10.0, 10.0),)),
}


@pytest.mark.parametrize("says", BAD)
def test_rules_that_cannot_be_are_told_in_one_line(says: str) -> None:
    """The value and the rule."""
    with pytest.raises(ValueError, match=says) as error:
        BAD[says]()
    assert "\n" not in str(error.value)
