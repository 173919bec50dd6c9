"""What a decision about lanes takes by torch's own operations, beside compiled rollouts: ``python gate.py [VEHICLES]``."""

import sys
import time

import torch
from torch.utils._python_dispatch import TorchDispatchMode

from idm_env import Lanes, Simulator
from idm_env.effects import make
from idm_env.multilane import before


class Counted(TorchDispatchMode):
    """Counts operations."""

    count = 0

    def __torch_dispatch__(self, function, kinds, arguments=(), keywords=None):
        self.count += 1
        return function(*arguments, **(keywords or {}))


def milliseconds(run, rounds=5):
    """Return the CPU time of the fastest of some calls, after one that compiles."""
    run()
    times = []
    for _ in range(rounds):
        begin = time.process_time()
        run()
        times.append(1e3 * (time.process_time() - begin))
    return min(times)


torch.set_num_threads(1)
n = int(sys.argv[1]) if len(sys.argv) > 1 else 200_000
simulator = Simulator(Lanes(3), (make("idm"), make("mobil"), make("brakes")), dt=0.1)
params = simulator.defaults(dtype=torch.float32)
speed = 15.0 + 3.0 * torch.rand(n, generator=torch.Generator().manual_seed(0))
start = simulator.state(-12.0 * torch.arange(n, dtype=torch.float32), speed, params, lane=torch.arange(n) % 3)
with torch.no_grad(), Counted() as counted:
    before(simulator, start, {}, params)
with torch.no_grad():
    by_torch = milliseconds(lambda: before(simulator, start, {}, params))
    whole = milliseconds(lambda: simulator.rollout(start, {}, params, 100), 3)
print(f"{n} vehicles: a decision of {counted.count} operations takes {by_torch:.0f} ms by torch")
print(
    f"compiled: {100 * n / whole / 1e3:.0f} M updates per CPU second; at 80 M ten steps and a decision take {n / 8e3:.0f} ms"
)
