"""The seam for fast kernels: one function that advances a state, the simulator's own or a fused one."""

from __future__ import annotations

import os

import torch

from idm_env import kernels
from idm_env.simulator import Simulator
from idm_env.tasks import Advance


def stepper_of(simulator: Simulator, device: torch.device) -> Stepper | None:
    """Return the kernel of this simulator, or None where there is none for it here.

    ``IDM_ENV_KERNELS=0`` in the environment prevents it.
    """
    if device.type != "cpu" or dispatch.surroundings() is not None or not simulator.kernels:
        return None
    from idm_env.kernels.stepper import Stepper

    return Stepper(simulator)
