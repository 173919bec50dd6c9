"""A network as loops over rows: what torch computes, for blocks of rows and layers of any size."""

import ctypes
import weakref

import numpy as np
import pytest
import torch
from torch import nn

pytest.importorskip("numba")

from idm_env.envs.window import Driver
from idm_env.kernels.rows import RowFunction


def called(loops, rows, arrays):
    """Do the loops at an address, for all rows."""
    table = loops.table(arrays)
    kind = ctypes.CFUNCTYPE(None, ctypes.c_int64, ctypes.c_int64, ctypes.c_void_p)
    kind(loops.call)(0, rows, table.ctypes.data)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_values_and_gradients_are_those_of_torch(dtype):
    torch.manual_seed(1)
    policy = nn.Sequential(nn.Linear(3, 7), nn.Tanh(), nn.Linear(7, 37), nn.ReLU(), nn.Linear(37, 2)).to(dtype)
    driver = Driver(policy, 2, 3, 2, dtype)
    weights = {n: x.detach().numpy() for n, x in driver.weights(policy).items()}
    close = 2e-5 if dtype == torch.float32 else 1e-12
    for rows in (1, 33, 64, 100):
        seen, on_action = torch.randn(rows, 3, dtype=dtype).requires_grad_(), torch.randn(rows, 2, dtype=dtype)
        made = {n: torch.zeros(rows, wide, dtype=dtype) for n, wide in (("action", 2), ("to_seen", 3))}
        arrays = {**weights, "seen": seen.detach().numpy(), "push": np.zeros((rows, 2), str(dtype)[6:])}
        arrays |= {"on_action": on_action.numpy(), **{n: x.numpy() for n, x in made.items()}}
        sums = {n: np.zeros(size, str(dtype)[6:]) for n, size in driver.backward.sums.items()}
        called(driver.forward, rows, arrays)
        called(driver.backward, rows, {**arrays, **sums})
        wanted = policy(seen)
        torch.testing.assert_close(made["action"], wanted, rtol=close, atol=close)
        own = torch.autograd.grad(wanted, [seen, *policy.parameters()], on_action)
        torch.testing.assert_close(made["to_seen"], own[0], rtol=close, atol=close)
        for (name, _), x in zip(policy.named_parameters(), own[1:], strict=True):
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
    Driver(policy.to(torch.float64), 2, 3, 2, torch.float64)
    assert len(noted) > 10
