"""The seam for fast kernels: one function that advances a state, the simulator's own or a fused one."""

from __future__ import annotations

import os

import torch

from idm_env import kernels
from idm_env.simulator import Simulator
from idm_env.tasks import Advance


def advance_of(simulator: Simulator, output: str, device: torch.device, dtype: torch.dtype) -> Advance:
    """Return the fastest function that does what ``simulator.step`` does here.

    With torch output it is always ``simulator.step``, so that values are bit-identical with and without a graph. With
    numpy output on the CPU it is fused where a kernel knows the simulator and numba is installed; ``IDM_ENV_KERNELS=0``
    in the environment prevents it.
    """
    if output == "numpy" and device.type == "cpu" and kernels.available() and os.environ.get("IDM_ENV_KERNELS") != "0":
        from idm_env.envs.fused import FusedStep, fits

        if fits(simulator):
            return FusedStep(simulator, dtype)
    return simulator.step
