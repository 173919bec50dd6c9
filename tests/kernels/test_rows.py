"""What rows record is what torch does: whole vectors or not, single operations, a whole step on several lanes."""

from __future__ import annotations

import ctypes

import numpy as np
import pytest
import torch

pytest.importorskip("numba")

from idm_env import IDM, Lanes, Simulator
from idm_env.compiled.kernels.rows import RowFunction, adjoint
from idm_env.effects import Mobil, make
from idm_env.envs.worlds import named, world_of
from idm_env.multilane.demand import trips, waiting
from idm_env.roads.layout import lane_drop
from idm_env.tasks import EnvState

ROWS, MANY = 3, 1009


def called(loops, arrays, rows=ROWS):
    """Return the outputs of some rows."""
    out = {n: np.empty((rows, *shape), loops.types[n]) for n, shape in loops.shapes.items()}
    table = loops.table(arrays | out)
    ctypes.CFUNCTYPE(None, ctypes.c_int64, ctypes.c_int64, ctypes.c_void_p)(loops.call)(0, rows, table.ctypes.data)
    return out


@pytest.mark.parametrize("size", [3, 8, 22])
def test_rows_of_any_length_and_their_adjoint_are_torchs(size):
    def around(x):
        ahead = torch.cat((x[:, -1:], x[:, :-1]), dim=-1)
        return {
            "y": torch.where(ahead > x, ahead / x, x * x - ahead),
            "total": (x[:, 1:] * x[:, :-1]).sum(-1),
            "soft": x.sigmoid(),
        }

    torch.manual_seed(size)
    x = torch.rand(MANY, size, dtype=torch.float64) + 0.5
    seeds = {f"on_{n}": torch.rand_like(v) for n, v in around(x).items()}
    back = adjoint(around, ["y", "total", "soft"], ["x"])

    def pulled(**leaves):
        return {"to_x": back(**leaves)["x"]}

    for function, inputs in ((around, {"x": x}), (pulled, {"x": x, **seeds})):
        out = called(RowFunction(function, inputs, MANY), {n: v.numpy() for n, v in inputs.items()}, MANY)
        for name, expected in function(**inputs).items():
            # Of sums that cancel the last bit is left.
            np.testing.assert_allclose(out[name], expected.numpy(), rtol=1e-14, atol=1e-15)


def test_searches_rolls_and_reductions_by_index():
    def function(keys, values, slots):
        here = torch.searchsorted(keys, values), torch.searchsorted(keys, values, right=True)
        least = torch.full_like(values, 9.0).scatter_reduce(-1, slots, values, "amin")
        most = slots.new_full(slots.shape, -9).scatter_reduce(-1, slots, here[0], "amax")
        rolled = values.roll(1, -1), values.roll(-2, -1)
        return dict(zip("abcdef", (*here, least, most, *rolled), strict=True))

    def inputs(rows):
        draw = torch.Generator().manual_seed(3)
        keys = torch.randint(0, 6, (rows, 7), generator=draw).double().sort().values  # with equal ones among them
        values = torch.randint(-1, 7, (rows, 5), generator=draw).double()
        return {"keys": keys, "values": values, "slots": torch.randint(0, 5, (rows, 5), generator=draw)}

    given = inputs(ROWS)
    out = called(RowFunction(function, inputs(MANY), MANY), {n: x.numpy() for n, x in given.items()})
    for name, x in function(**given).items():
        assert np.array_equal(out[name], x.numpy()), name


def test_what_is_computed_twice_is_computed_once_unless_it_is_written_to():
    """The same operation of the same numbers has one result; copies that are changed are apart."""

    def function(x):
        twice = x.exp() + x.exp(), x.exp() + x.roll(1, -1).exp()
        doubled = x.clone().mul_(2.0)
        return {"a": twice[0], "b": twice[1], "c": doubled, "d": x.clone().add_(doubled), "e": x.clone()}

    x = torch.rand(MANY, 9, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    loops = RowFunction(function, {"x": x}, MANY)
    out = called(loops, {"x": x.numpy()})
    for name, expected in function(x).items():
        np.testing.assert_allclose(out[name], expected[:ROWS].numpy(), rtol=1e-15)
    assert sum(key[0] == "exp" for key in loops._results) == 2


def test_operations_of_simpler_ones_are_torchs_in_place_too():
    def function(x, low):
        which = torch.tensor([2, 0, 2])
        parts = (
            x.clamp(0.25, 0.75),
            x.clamp_min(low),
            x.clamp_max(0.5),
            x.clone().clamp_(0.25),
            x.clone().clamp_max_(low),
        )
        parts += x.masked_fill(x > low, -1.0), x.clone().masked_fill_(x < low, 2.0), torch.stack((x, low), 1)[:, 1]
        parts += (
            torch.zeros_like(x).index_add(1, which, x[:, :3]),
            torch.ops.aten.select_backward(x[:, 0], x.shape, 1, -2),
        )
        return dict(zip("abcdefghij", parts, strict=True))

    both = torch.rand(2, MANY, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    x, low = (each.clone() for each in both)
    out = called(RowFunction(function, {"x": x, "low": low}, MANY), {"x": x.numpy(), "low": low.numpy()})
    for name, expected in function(x, low).items():
        assert np.array_equal(out[name], expected[:ROWS].numpy()), name


def test_infinity_is_looked_for_in_numbers_of_their_own_kind():
    """It was looked for in truth values, among which there is none."""
    numbers = torch.tensor([[0.0, torch.inf, 1.0, -torch.inf, 2.0]]).expand(MANY, -1).contiguous()
    out = called(RowFunction(lambda x: {"y": x.isinf()}, {"x": numbers}, MANY), {"x": numbers.numpy()})
    assert out["y"].tolist() == [[False, True, False, True, False]] * ROWS


def test_a_whole_step_on_several_lanes_is_one_function_of_rows():
    """Vehicles enter, change lanes and leave; a recording asks nobody whether they do."""
    road = Lanes(2, length=150.0, ends=(lane_drop(0, at=110.0),))
    simulator = Simulator(road, (IDM(), make("mandatory_change"), Mobil(every=0.5)), dt=0.5)
    params = simulator.defaults(dtype=torch.float64)
    schedule = trips({0: 1500.0, 1: 900.0}, 12.0, slots=6, dtype=torch.float64)
    schedule = type(schedule)(*(x.expand(ROWS, -1).contiguous() for x in schedule))
    state = waiting(simulator, schedule, params)
    speeds = torch.linspace(14.0, 20.0, ROWS, dtype=torch.float64).unsqueeze(-1)
    assert state.lanes is not None
    state = state._replace(
        step=torch.zeros(ROWS, dtype=torch.int64), length=torch.full_like(state.speed, 5.0),
        lanes=state.lanes._replace(trips=schedule._replace(speed=speeds.expand(schedule.speed.shape).contiguous())),
    )  # fmt: skip
    world = EnvState(state, {})

    def step(**leaves):
        after = EnvState(simulator.step(world_of(leaves, world).state, {}, params), {})
        return {f"then_{n}": x for n, x in named(after).items()}

    many = {n: x[:1].expand(MANY, *x.shape[1:]).contiguous() for n, x in named(world).items()}
    loops = RowFunction(step, many, MANY)
    leaves = {n: x.contiguous() for n, x in named(world).items()}
    for _ in range(40):
        out, after = called(loops, {n: x.numpy() for n, x in leaves.items()}), step(**leaves)
        for name, x in after.items():
            assert np.array_equal(out[name].reshape(x.shape), x.numpy()), name
        leaves = {n: after[f"then_{n}"].contiguous() for n in leaves}
    assert all(int(leaves[n].sum()) > ROWS for n in ("links_changed", "trips_entered", "trips_left"))


def test_what_is_seldom_read_is_filled_where_it_is_asked_for_or_where_a_row_ends():
    """And what was written to in place is read as it was then."""

    def function(x, looks):
        kept, once = x.clone(), x * 2.0
        doubled = kept.exp()
        kept += once
        return {"ends": kept.sum(-1) > 5.0, "sum": kept, "seen": once.sin(), "then": doubled.cos()}

    x = torch.tensor([[0.1, 0.2], [0.3, 0.1], [2.0, 1.0]], dtype=torch.float64)
    looks = torch.tensor([False, True, False])
    samples = {"x": x[:1].expand(MANY, 2).contiguous(), "looks": looks[:1].expand(MANY).contiguous()}
    loops = RowFunction(function, samples, MANY, seldom=("seen", "then"), when=("looks", "ends"))
    out = {n: np.full((ROWS, *shape), -7, loops.types[n]) for n, shape in loops.shapes.items()}
    loops.run(0, ROWS, loops.table({"x": x.numpy(), "looks": looks.numpy()} | out).ctypes.data)
    for name, expected in function(x, looks).items():
        filled = [False, True, True] if name in ("seen", "then") else [True] * 3
        np.testing.assert_allclose(out[name][filled], expected.numpy()[filled], rtol=1e-14)
        assert (out[name][~np.array(filled)] == -7).all()
