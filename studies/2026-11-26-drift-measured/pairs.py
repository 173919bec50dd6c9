"""How often two processes are told: drivers whose time gap wanders, with noise of the acceleration and without.

    python studies/2026-11-26-drift-measured/pairs.py [FIRST] [SETS] [DRIVERS]

Sets are those of ``benchmarks.drift_sets``, made in steps of 0.1 s and read every 0.5 s, as a file of 10 Hz is.
"""

import sys
import time

import numpy as np
import torch

from benchmarks import drift_sets
from idm_env.data import episodes
from idm_env.drift.kinds import behind_a_record, tell
from idm_env.effects import AccelNoise, Wander

SIGMA, MEMORY_S = 0.2, 3.0
"""Noise of the acceleration, where there is some."""


def noisy(dt, *drifts):
    """Return drivers behind a record who have noise of the acceleration besides."""
    simulator = behind_a_record(dt, *drifts, AccelNoise())
    defaults = simulator.defaults
    own = {"sigma": torch.tensor(SIGMA).double(), "memory_time": torch.tensor(MEMORY_S).double()}
    object.__setattr__(simulator, "defaults", lambda **more: {**defaults(**more), "accel_noise": own})
    return simulator


def main(first=1, sets=10, drivers=20):
    drift_sets.DT = 0.1
    for seed in range(first, first + sets):
        for hidden, made_by in (("wander", behind_a_record), ("wander and accel_noise", noisy)):
            drift_sets.behind_a_record, begin = made_by, time.process_time()
            made = drift_sets.made(seed, Wander(), 0.25, 15.0, drivers)
            told = tell(*(list(episodes(made, smooth=x, dt=0.5)) for x in (True, False)), (Wander(), AccelNoise()))
            gain = told.gain["wander and accel_noise"] - max(told.gain["wander"], told.gain["accel_noise"])
            wander = told.found["wander"].settings
            print(f"{seed} {drivers} drivers, {hidden}: told {' or '.join(told.one_of)}; the pair gains {gain:.1f};",
                  f"T alone: sigma {wander.sigma[0]:.2f}, tau {wander.memory_time[0]:.1f} s;",
                  f"{time.process_time() - begin:.0f} CPU s", flush=True)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
