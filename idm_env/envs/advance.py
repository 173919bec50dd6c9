"""The seam for kernels: one function that advances a state, the simulator's own or its kernel."""

from __future__ import annotations

import torch

from idm_env.kernels import dispatch
from idm_env.simulator import Simulator
from idm_env.tasks import Advance
from idm_env.types import Inputs, Params, State


def advance_of(simulator: Simulator, output: str, device: torch.device) -> Advance:
    """Return the fastest function that does what ``simulator.step`` does here.

    With torch output it is always ``simulator.step``, so that values are bit-identical with and without a graph. With
    numpy output on the CPU it is the simulator's kernel where there is one; ``IDM_ENV_KERNELS=0`` in the environment
    prevents it.
    """
    if output != "numpy" or device.type != "cpu" or dispatch.surroundings() is not None:
        return simulator.step
    return Kernel(simulator)


class Kernel:
    """A simulator's kernel where there is one for what is given, else its own step."""

    def __init__(self, simulator: Simulator) -> None:
        from idm_env.kernels.stepper import Stepper

        self.simulator = simulator
        self._stepper = Stepper(simulator)

    def __reduce__(self) -> tuple[type[Kernel], tuple[Simulator]]:
        # Compiled code stays here; a copy in another process finds its own.
        return Kernel, (self.simulator,)

    def __call__(self, state: State, inputs: Inputs, params: Params) -> State:
        """Return the state Δt later."""
        fits = not isinstance(self._stepper.kernel(state, inputs), str)
        return (self._stepper if fits else self.simulator.step)(state, inputs, params)
