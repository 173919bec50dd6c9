"""Speed of copies of a grid with signals: ``python studies/2026-11-27-networks/speed.py [--copies 64 --side 5]``.

Prints vehicle updates and simulated seconds per CPU second, on one thread, the best and the median of some runs of
900 s each. Vehicles are counted after every 100 s.
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

os.environ.setdefault("NUMBA_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import numpy as np  # noqa: E402 (threads are set before numba starts)
import torch  # noqa: E402
import tyro  # noqa: E402

from benchmarks.networks import head, simulator  # noqa: E402
from idm_env.multilane import junctions  # noqa: E402
from idm_env.roads import Demand, Network  # noqa: E402

STEPS = 1000


def main(copies: int = 64, side: int = 5, runs: int = 3, flows: tuple[float, ...] = (300.0, 500.0, 700.0)) -> None:
    """Print a row for every flow (vehicles per hour at each entry, no left turns)."""
    torch.set_num_threads(1)
    network = Network.grid(side, side)
    cars, params = simulator(network)
    head(f"{copies} copies of a grid of {side} x {side}")
    for flow in flows:
        demand = [Demand.by_turns(network, flow, 900.0, seed=k, shares=(0.0, 0.8, 0.2)) for k in range(copies)]
        updates, seconds = list[float](), list[float]()
        for _ in range(runs):
            state, count, spent = junctions.travelling(cars, demand, params), 0.0, 0.0
            state, _ = cars.rollout(state, {}, params, 10, keep=None)
            for _ in range(9):
                begin = time.process_time()
                state, _ = cars.rollout(state, {}, params, STEPS, keep=None)
                spent += time.process_time() - begin
                assert state.present is not None
                count += float((state.present > 0).sum()) * STEPS
            updates.append(count / spent / 1e6)
            seconds.append(copies * 9 * STEPS * cars.dt / spent)
        print(
            f"{flow:g} veh/h: {max(updates):.1f} (median {np.median(updates):.1f}) million vehicle updates, "
            f"{max(seconds):.0f} (median {np.median(seconds):.0f}) simulated s per CPU s",
            flush=True,
        )


if __name__ == "__main__":
    tyro.cli(main)
