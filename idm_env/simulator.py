"""A simulator: one pure step (``step.py``), and that step repeated, or a kernel in its place (``backends.py``)."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from idm_env import backends, compat, parameters
from idm_env.multilane import before
from idm_env.step import INTEGRATORS, CarFollowingStep, Integration, normals
from idm_env.types import Inputs, Params, State, mapped


class Trajectory(NamedTuple):
    """Samples of every step of a rollout, time first: position (m), speed (m/s), acceleration (m/s²), gap (m)."""

    position: Tensor
    speed: Tensor
    accel: Tensor
    gap: Tensor


def _trajectory(state: State) -> Trajectory:
    return Trajectory(state.position, state.speed, state.accel, state.gap)


@dataclass(frozen=True)
class Simulator(CarFollowingStep):
    """A road, a tuple of effects and a time step (s): the static half of a traffic model.

    ``CarFollowingStep`` says what happens in one step. ``rollout`` repeats it.
    """

    kernels: ClassVar[bool] = True
    """Whether a kernel may stand in for repeated steps."""

    def step(self, state: State, inputs: Inputs, params: Params) -> State:
        """Return the state Δt later. Pure: the same arguments give the same result, with or without a graph.

        Where a road has several lanes, vehicles enter, leave and change lanes first (``multilane.before``); then all
        drive on (``CarFollowingStep.step``). ``inputs`` maps effect names to what they take at this step, ``params``
        effect and parameter names to tensors that broadcast against ``(..., vehicles)``.
        """
        return super().step(before(self, state, inputs, params), inputs, params)

    def event(self, state: State, params: Params, now: Tensor) -> Any:
        """Return the decisions of an event on a network, in the rows where it is ``now`` (bool, ``(...)``)."""
        return backends.function("idm_env.compiled.kernels.networks:event")(self, state, params, now)

    def compile(self, *, backend: str = "inductor", dynamic: bool | None = False) -> Simulator:
        """Return this simulator with a compiled step; where nothing can compile it, with one warning, as it is."""
        own = {field.name: getattr(self, field.name) for field in fields(self)}
        return Compiled(**{**own, "backend": backend, "dynamic": dynamic})

    def _covered(self, inputs: Inputs, steps: int) -> None:
        for name, value in inputs.items():
            if name not in self.by_name:
                raise ValueError(f"input '{name}' belongs to no effect.{parameters.nearest(name, self.by_name)}")
            have = min(len(x) for x in ((value,) if isinstance(value, Tensor) else value) if x is not None)
            if have < steps:
                raise ValueError(f"input '{name}' covers {have} steps of {steps}. Its first dimension is time.")
        if undrawn := [name for name in self.draws if name not in inputs]:
            cure = f"Draw them with seed=…, or pass inputs={{'{undrawn[0]}': …}}."
            raise ValueError(f"effect '{undrawn[0]}' takes normals, and none were given. {cure}")

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
        return {**inputs, **{n: normals(n, seed, like, steps) for n in self.draws if n not in inputs}}

    def rollout(
        self,
        state: State,
        inputs: Inputs,
        params: Params,
        steps: int,
        *,
        checkpoint_every: int = 0,
        keep: Callable[[State], tuple[Tensor, ...]] | None = _trajectory,
        seed: int | None = None,
    ) -> tuple[State, Any]:
        """Repeat ``step``; return the last state and the samples that ``keep`` takes of every state, time first.

        ``keep`` None keeps nothing, and None is returned in its place. Where a compiled kernel knows this simulator it
        runs instead of ``step`` (``kernels.dispatch`` says when). Second derivatives of a
        kernel's rollout are recomputed on the torch path; inside ``backends.off()`` everything is.

        The state has the shape ``(…, vehicles)``, what is kept ``(steps, …, vehicles)``.
        ``inputs`` carry a leading time dimension of at least ``steps``. ``checkpoint_every`` k > 0 saves the graph's
        tensors only every k steps and recomputes the rest in the backward pass: memory over ``steps / k + k`` steps
        instead of ``steps``, for about one more forward pass. ``seed`` draws the normals that no input
        gives (``drawn``). ValueError for inputs that are too short or of no effect.
        """
        parameters.whole("steps", steps, 1)
        for name, value, kind in (("state", state, State), ("inputs", inputs, Mapping)):
            if not isinstance(value, kind):
                raise ValueError(f"{name} = {parameters.shown(value)} must be a {kind.__name__}.")
        parameters.refuse_incomplete(self.effects, params)
        if seed is not None:
            inputs = self.drawn(state.speed, inputs, steps, seed)
        if keep in (_trajectory, None):
            self._covered(inputs, steps)
            self.tried(state, inputs, params)
            fast = backends.rollout(self, state, inputs, params, steps, checkpoint_every, keep is not None)
            # NaN that an effect of one's own has made is told by the step itself.
            if fast is not None and not (self.own and bool(fast[0].speed.isnan().any())):
                return fast[0], None if fast[1] is None else Trajectory(*fast[1])
        slices = self.slices(inputs, steps)

        def run(state: State, begin: int, end: int) -> tuple[State, list[tuple[Tensor, ...]]]:
            samples = []
            for t in range(begin, end):
                state = self.step(state, slices[t], params)
                samples.append(() if keep is None else keep(state))
            return state, samples

        samples: list[tuple[Tensor, ...]] = []
        stride = checkpoint_every or max(steps, 1)
        for begin in range(0, steps, stride):
            end = min(begin + stride, steps)
            if checkpoint_every:
                state, part = checkpoint(run, state, begin, end, use_reentrant=False, preserve_rng_state=False)
            else:
                state, part = run(state, begin, end)
            samples += part
        if keep is None:
            return state, None
        columns = (torch.stack(column) for column in zip(*samples, strict=True))
        return state, type(samples[0])(*columns) if hasattr(samples[0], "_fields") else tuple(columns)

    @property
    def untried(self) -> bool:
        """Whether effects of the user's own are still to be tried."""
        return self.own and "_tried" not in self.__dict__

    def tried(self, state: State, inputs: Inputs, params: Params) -> None:
        """Do one step on copies where effects of one's own are at work, once: compiled steps do not watch them.

        ``inputs`` as in ``rollout``. ValueError names an effect that does what it must not (``effects/watched.py``).
        """
        if not self.untried:
            return
        # A step at which lanes are decided about.
        state = state._replace(step=state.step - state.step.remainder(self.decides_after))
        with torch.inference_mode(False), torch.no_grad():
            numbers = {e: {n: torch.as_tensor(x) for n, x in values.items()} for e, values in params.items()}
            copied, inputs_now, values = (
                mapped(lambda x: x.detach().clone(), each) for each in (state, self.slices(inputs, 1)[0], numbers)
            )
            Simulator.step(self, copied, inputs_now, values)  # type: ignore[arg-type]
        self.__dict__["_tried"] = True

    def advance(self, state: State, inputs: Inputs, params: Params) -> State:
        """Return the state Δt later, as ``step`` does, by a rollout of one step."""
        return self.rollout(state, {n: stacked([x]) for n, x in inputs.items()}, params, 1, keep=None)[0]


@dataclass(frozen=True)
class Compiled(Simulator):
    """As ``Simulator``, for any effects, with gradients, on the CPU and on a GPU; ``step`` is compiled by inductor.

    It is compiled when it is first called, once per shape, dtype and device. The step, not the rollout: a rollout's
    graph grows with its length, and so would the time to compile it. The first call of a shape takes 17 s forward and
    9 s backward where nothing is cached, 8 s and 1 s where inductor's cache on disk is warm (2 cores, AMD EPYC,
    November 2026). Where no compiler is found the step runs as it is, after one warning.

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
        return torch.compile(plain.step, backend=self.backend, dynamic=self.dynamic, fullgraph=True)

    def step(self, state: State, inputs: Inputs, params: Params) -> State:
        """Return the state Δt later, as ``Simulator.step`` to rounding."""
        if "failed" in self.__dict__:
            return super().step(state, inputs, params)
        try:
            after = self._compiled(state, inputs, params)
            return super().step(state, inputs, params) if self.own and bool(after.speed.isnan().any()) else after
        except compat.compile_error() as error:
            self.__dict__["failed"] = True
            first = str(error).strip().splitlines()[0]
            warnings.warn(
                f"the step runs uncompiled, because torch.compile failed: {first} If no C++ compiler is "
                "installed, g++, clang or MSVC cures it (triton for a GPU); after many shapes, dynamic=True.",
                RuntimeWarning,
                stacklevel=2,
            )
            return super().step(state, inputs, params)


def stacked(values: Sequence[Any]) -> Any:
    """Return inputs of single steps as one input with a leading time dimension."""
    return mapped(lambda *steps: torch.stack(steps), *values)


def _unbind(value: Any) -> list[Any]:
    """Split an input along time into one value per step, keeping its tuple type."""
    if isinstance(value, Tensor):
        return list(value.unbind(0))
    length = min(len(x) for x in value if x is not None)
    columns = [[None] * length if x is None else x.unbind(0)[:length] for x in value]
    return [type(value)(*row) for row in zip(*columns, strict=True)]


__all__ = ["INTEGRATORS", "Compiled", "Integration", "Simulator", "Trajectory", "stacked"]
