"""A network as loops over rows: what torch computes, for blocks of rows and layers of any size."""

import ctypes
import weakref

import numpy as np
import pytest
import torch
from torch import nn

pytest.importorskip("numba")

from idm_env.compiled.kernels.rows import RowFunction
from idm_env.envs.window import Driver


def called(loops, rows, arrays):
    """Do the loops at an address, for all rows."""
    table = loops.table(arrays)
    kind = ctypes.CFUNCTYPE(None, ctypes.c_int64, ctypes.c_int64, ctypes.c_void_p)
    kind(loops.call)(0, rows, table.ctypes.data)


class Pair(nn.Module):
    """A policy of two agents, who remember four numbers each; without ``hidden`` they begin at 0."""

    def __init__(self):
        super().__init__()
        self.cell, self.out = nn.GRUCell(3, 4), nn.Linear(4, 1)

    def forward(self, seen, hidden=None):
        given = None if hidden is None else hidden.view(-1, 4)
        later = self.cell(seen.reshape(-1, 3), given)
        action = torch.cat([self.out(later), later], 1)[:, :1].reshape(len(seen), 2)
        return action if hidden is None else (action, later.view(-1, 2, 4))


LAYERS = [nn.Linear(6, 7), nn.Tanh(), nn.Linear(7, 37), nn.ReLU(), nn.Linear(37, 2)]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    ("policy", "memory"),
    [(lambda: nn.Sequential(*LAYERS), None), (Pair, (2, 4)), (Pair, None)],
    ids=["layers", "two agents who remember", "two agents"],
)
def test_values_and_gradients_are_those_of_torch(policy, memory, dtype):
    torch.manual_seed(1)
    policy = policy().to(dtype)
    driver = Driver(policy, 6, 2, dtype, memory)
    weights = {n: x.detach().numpy() for n, x in driver.weights(policy).items()}
    close, shapes = 2e-5 if dtype == torch.float32 else 1e-12, {"seen": (6,), **({"hidden": memory} if memory else {})}
    for rows in (1, 33, 64, 100):
        given = {n: torch.randn(rows, *shape, dtype=dtype).requires_grad_() for n, shape in shapes.items()}
        wanted = policy(*given.values())
        told = {"action": wanted[0], "later": wanted[1]} if memory else {"action": wanted}
        on = {n: torch.randn_like(x) for n, x in told.items()}
        made = {n: torch.zeros_like(x) for n, x in (*told.items(), *((f"to_{n}", x) for n, x in given.items()))}
        arrays = {**weights, "push": np.zeros((rows, 2), str(dtype)[6:])}
        arrays |= {n: x.detach().numpy() for n, x in (*given.items(), *made.items())}
        arrays |= {f"on_{n}": x.numpy() for n, x in on.items()}
        sums = {n: np.zeros(size, str(dtype)[6:]) for n, size in driver.backward.sums.items()}
        called(driver.forward, rows, arrays)
        called(driver.backward, rows, {**arrays, **sums})
        own = torch.autograd.grad(list(told.values()), [*given.values(), *policy.parameters()], list(on.values()))
        for name, x in (*told.items(), *zip((f"to_{n}" for n in given), own, strict=False)):
            torch.testing.assert_close(made[name], x, rtol=close, atol=close)
        for (name, _), x in zip(policy.named_parameters(), own[len(given) :], strict=True):
            if f"to_{driver.names[name]}" not in driver.backward.summed:
                assert not bool(x.any())
                continue
            array, *shape = driver.backward.summed[f"to_{driver.names[name]}"]
            torch.testing.assert_close(torch.from_numpy(sums[array]).as_strided(*shape), x, rtol=close, atol=close)


def test_a_tensor_whose_place_is_noted_lives_while_loops_are_recorded(monkeypatch):
    """Places go by the tensor's id, which another one may have as soon as it is freed."""
    enter, noted = RowFunction._enter, []

    def watched(self, x, place):
        if noted and noted[0][0] is not self:
            noted.clear()
        assert all(each() is not None for _, each in noted)
        enter(self, x, place)
        noted.append((self, weakref.ref(x)))

    monkeypatch.setattr(RowFunction, "_enter", watched)
    policy = nn.Sequential(nn.Linear(3, 7), nn.Tanh(), nn.Linear(7, 37), nn.ReLU(), nn.Linear(37, 2))
    driver = Driver(policy.to(torch.float64), 3, 2, torch.float64)
    assert driver.forward and driver.backward
    assert len(noted) > 10
