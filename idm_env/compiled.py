"""A simulator whose step inductor has compiled: for any effects, with gradients, on the CPU and on a GPU.

The step is compiled, not the rollout: a rollout's graph grows with its length, and so would the time to compile it.
The first call of a shape takes 17 s forward and 9 s backward where nothing is cached, 8 s and 1 s where inductor's
cache on disk is warm (2 cores, AMD EPYC, November 2026). Where no compiler is found the step runs as it is, after one
warning.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import torch

from idm_env.simulator import Simulator
from idm_env.types import Inputs, Params, State


@dataclass(frozen=True)
class Compiled(Simulator):
    """As ``Simulator``; ``step`` is compiled when it is first called, once per shape, dtype and device.

    ``backend`` is that of ``torch.compile``; ``dynamic`` True compiles once for all batch sizes, a little slower each.
    Rollouts repeat the compiled step and use no other kernel.
    """

    kernels: ClassVar[bool] = False

    backend: str = "inductor"
    dynamic: bool | None = False

    @cached_property
    def _compiled(self) -> Callable[[State, Inputs, Params], State]:
        plain = Simulator(self.road, self.effects, self.dt, self.integration)
        # Filled here, because the tracer does not enter the lock of a cached property.
        _ = plain.by_name, plain._following, plain._hooks, plain._needs, plain._unspoken
        made: Callable[[State, Inputs, Params], State] = torch.compile(
            plain.step, backend=self.backend, dynamic=self.dynamic, fullgraph=True
        )
        return made

    def step(self, state: State, inputs: Inputs, params: Params) -> State:
        """Return the state Δt later, as ``Simulator.step`` to rounding."""
        if "failed" in self.__dict__:
            return super().step(state, inputs, params)
        try:
            return self._compiled(state, inputs, params)
        except torch._dynamo.exc.TorchDynamoException as error:
            self.__dict__["failed"] = True
            first = str(error).strip().splitlines()[0]
            warnings.warn(
                f"the step runs uncompiled, because torch.compile failed: {first} If no C++ compiler is "
                "installed, g++, clang or MSVC cures it (triton for a GPU).",
                RuntimeWarning,
                stacklevel=2,
            )
            return super().step(state, inputs, params)
