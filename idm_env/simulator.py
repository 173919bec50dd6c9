"""A simulator: one pure step (``step.py``), and that step repeated, by compiled kernels wherever these know it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from idm_env import parameters
from idm_env.kernels import dispatch
from idm_env.step import INTEGRATORS, Integration, Stepping, ballistic, euler, half_ahead, normals
from idm_env.types import Inputs, Params, State


class Trajectory(NamedTuple):
    """What a rollout keeps of every step, time first: position (m), speed (m/s), acceleration (m/s²), gap (m)."""

    position: Tensor
    speed: Tensor
    accel: Tensor
    gap: Tensor


def _kept(state: State) -> Trajectory:
    return Trajectory(state.position, state.speed, state.accel, state.gap)


@dataclass(frozen=True)
class Simulator(Stepping):
    """A road, a tuple of effects and a time step (s): the static half of a traffic model.

    One step is: scene of the road → perceive → adapt → Σ accelerate → limit → integrate → place → gaps; ``Stepping``
    says more. ``rollout`` repeats it.
    """

    kernels: ClassVar[bool] = True
    """Whether a kernel may stand in for repeated steps."""

    def compile(self, *, backend: str = "inductor", dynamic: bool | None = False) -> Simulator:
        """Return this simulator with a compiled step; where nothing can compile it, with one warning, as it is."""
        from idm_env.compiled import Compiled

        return Compiled(self.road, self.effects, self.dt, self.integration, backend, dynamic)

    def _covered(self, inputs: Inputs, steps: int) -> None:
        undrawn = next((name for name in self.draws if name not in inputs), None)
        if undrawn is not None:
            raise ValueError(
                f"effect '{undrawn}' takes normals, and none were given. Draw them with seed=…, or pass "
                f"inputs={{'{undrawn}': …}}."
            )
        for name, value in inputs.items():
            if name not in self.by_name:
                raise ValueError(f"input '{name}' belongs to no effect.{parameters.nearest(name, self.by_name)}")
            have = min(len(x) for x in _leaves(value) if x is not None)
            if have < steps:
                raise ValueError(f"input '{name}' covers {have} steps of {steps}. Its first dimension is time.")

    def slices(self, inputs: Inputs, steps: int) -> list[dict[str, Any]]:
        """Return the inputs of each step, from inputs with a leading time dimension.

        ValueError for inputs that are too short or belong to no effect.
        """
        self._covered(inputs, steps)
        unbound = {name: _unbind(value) for name, value in inputs.items()}
        return [{name: value[t] for name, value in unbound.items()} for t in range(steps)]

    def drawn(self, like: Tensor, inputs: Inputs, steps: int, seed: int) -> dict[str, Any]:
        """Return ``inputs`` and, for every effect that draws and is not among them, normals of that many steps.

        ``like`` has the shape ``(…, vehicles)``. The same seed gives the same normals, whatever else is simulated.
        """
        missing = (name for name in self.draws if name not in inputs)
        return {**inputs, **{name: normals(name, seed, like, steps) for name in missing}}

    def rollout(
        self,
        state: State,
        inputs: Inputs,
        params: Params,
        steps: int,
        *,
        checkpoint_every: int = 0,
        keep: Callable[[State], tuple[Tensor, ...]] | None = _kept,
        seed: int | None = None,
    ) -> tuple[State, Any]:
        """Repeat ``step``; return the last state and what ``keep`` takes of every state after a step, time first.

        ``keep`` None keeps nothing, and None is returned in its place. Where a compiled kernel knows this simulator it
        runs instead of ``step`` (``kernels.dispatch`` says when). Second derivatives of a
        kernel's rollout are recomputed on the torch path; inside ``kernels.dispatch.off()`` everything is.

        ``inputs`` carry a leading time dimension of at least ``steps``. ``checkpoint_every`` k > 0 saves the graph's
        tensors only every k steps and recomputes the rest in the backward pass: memory over ``steps / k + k`` steps
        instead of ``steps``, for about one more forward pass. ``seed`` draws the normals that no input
        gives (``drawn``). ValueError for inputs that are too short or of no effect.
        """
        if seed is not None:
            inputs = self.drawn(state.speed, inputs, steps, seed)
        if steps > 0 and keep in (_kept, None):
            self._covered(inputs, steps)
            fast = dispatch.rollout(self, state, inputs, params, steps, checkpoint_every, keep is not None)
            if fast is not None:
                last, kept_of_all = fast
                return last, None if kept_of_all is None else Trajectory(*kept_of_all)
        slices = self.slices(inputs, steps)

        def run(state: State, begin: int, end: int) -> tuple[State, list[tuple[Tensor, ...]]]:
            kept = []
            for t in range(begin, end):
                state = self.step(state, slices[t], params)
                kept.append(() if keep is None else keep(state))
            return state, kept

        kept: list[tuple[Tensor, ...]] = []
        stride = checkpoint_every or max(steps, 1)
        for begin in range(0, steps, stride):
            end = min(begin + stride, steps)
            if checkpoint_every:
                state, part = checkpoint(run, state, begin, end, use_reentrant=False, preserve_rng_state=False)
            else:
                state, part = run(state, begin, end)
            kept += part
        if not kept:
            raise ValueError(f"steps = {steps}: a rollout needs at least one step.")
        if keep is None:
            return state, None
        columns = (torch.stack(column) for column in zip(*kept, strict=True))
        first = kept[0]
        return state, type(first)(*columns) if hasattr(first, "_fields") else tuple(columns)


def _leaves(value: Any) -> Iterable[Any]:
    return (value,) if isinstance(value, Tensor) else value


def stacked(values: Sequence[Any]) -> Any:
    """Return inputs of single steps as one input with a leading time dimension."""
    if isinstance(values[0], Tensor):
        return torch.stack(tuple(values))
    columns = zip(*values, strict=True)
    return type(values[0])(*(None if column[0] is None else torch.stack(column) for column in columns))


def _unbind(value: Any) -> list[Any]:
    """Split an input along time into one value per step, keeping its tuple type."""
    if isinstance(value, Tensor):
        return list(value.unbind(0))
    length = min(len(x) for x in value if x is not None)
    columns = [[None] * length if x is None else x.unbind(0)[:length] for x in value]
    return [type(value)(*row) for row in zip(*columns, strict=True)]


__all__ = ["INTEGRATORS", "Integration", "Simulator", "Trajectory", "ballistic", "euler", "half_ahead", "stacked"]
