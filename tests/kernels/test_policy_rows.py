"""A network as loops over rows: what torch computes, for blocks of rows and layers of any size."""

import ctypes
import itertools

import numpy as np
import pytest
import torch
from torch import nn

pytest.importorskip("numba")

from idm_env.envs.window import Driver


def called(loops, rows, arrays):
    """Do the loops at an address, for all rows."""
    table = loops.table(arrays)
    kind = ctypes.CFUNCTYPE(None, ctypes.c_int64, ctypes.c_int64, ctypes.c_void_p)
    kind(loops.call)(0, rows, table.ctypes.data)


# Views made while eight layers were recorded lost their places to others.
@pytest.mark.parametrize(
    ("dtype", "widths"),
    [(torch.float32, (3, 7, 37, 2)), (torch.float64, (3, 7, 37, 2)), (torch.float64, (3, 32, 5, 8, 10, 8, 32, 2))],
)
def test_values_and_gradients_are_those_of_torch(dtype, widths):
    torch.manual_seed(3)
    made = (nn.Tanh(), nn.ReLU(), nn.ELU(), nn.SiLU())
    layers = [part for a, b in itertools.pairwise(widths) for part in (nn.Linear(a, b), made[b % 4])]
    policy = nn.Sequential(*layers[:-1]).to(dtype)
    driver = Driver(policy, 3, 2, dtype)
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
