"""The seam for fast kernels: one function that advances a state, the simulator's own or a fused one."""

from __future__ import annotations

import torch

from idm_env.simulator import Simulator
from idm_env.tasks import Advance


def advance_of(simulator: Simulator, output: str, device: torch.device, dtype: torch.dtype) -> Advance:
    """Return the fastest function that does what ``simulator.step`` does here.

    With torch output it is always ``simulator.step``, so that values are bit-identical with and without a graph.
    """
    return simulator.step
