"""Any environment as a fitting problem: find the driver and effect parameters that reproduce measured drivers."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from idm_env.effects import Replay
from idm_env.parameters import catalogue, constrain, replaced, unconstrain
from idm_env.roads import Lane
from idm_env.simulator import Simulator
from idm_env.tasks import Task
from idm_env.types import Command, Params, Record

if TYPE_CHECKING:
    from idm_env.fitting.fit import Fit

_OTHERS = (Command, Record)
"""What effects take through which a task acts: no driver's, so they are left out of what is fitted, and so is drift."""


class ParameterFitting:
    """The drivers of an environment behind measured leaders: find the parameters that make them drive as measured.

    The model is the environment's: its effects, its time step and every parameter that is not ``free``. Each measured
    driver follows its measured leader from its measured state, and the residual is simulated minus measured gap (m).

    ``parameters()`` are leaf tensors on the real line behind the parameters' bounds, the same ones for good, so that an
    optimiser stays connected; ``mean_squared_error()`` and ``root_mean_squared_error()`` are differentiable in them, or
    in values that are given; ``fit()`` is the foundation's search; ``apply()`` puts the values into the environment.

    Args:
        env: An environment of this package (any face, wrapped or not), or a task.
        trajectories: A file, ``idm_env.data.Trajectories``, or a sequence of ``Episode``.
        free: Full names of the parameters to find; None takes all of the car-following effect.
        by: ``"all"`` for one value for all drivers, ``"driver"``, or a column: one value per group.
        objective: ``"spacing"`` (m), ``"speed"`` (m/s) or ``"both"``.

    Raises:
        ValueError: For parameters that do not exist, or an environment that is none of ours.
        DataError: For trajectories that cannot be used.
    """

    def __init__(
        self,
        env: Any,
        trajectories: Any,
        *,
        free: Sequence[str] | None = None,
        by: str = "all",
        objective: Any = "spacing",
    ) -> None:
        from idm_env.fitting.batch import Batch
        from idm_env.fitting.problem import Problem, group_of

        self.env = env
        task, params = _task_of(env)
        following = next(e for e in task.simulator.effects if e.takes not in _OTHERS and hasattr(e, "driver"))
        self.free = tuple(f"{following.name}.{p.name}" for p in following.parameters) if free is None else tuple(free)
        effects = tuple(e for e in task.simulator.effects if e.takes not in _OTHERS and not e.draws)
        simulator = Simulator(Lane(), (*effects, Replay()), task.simulator.dt, task.simulator.integration)
        self.episodes = _episodes(trajectories, simulator.dt)
        self.by = by
        group, groups = group_of(self.episodes, by)
        self.fixed = _fixed(simulator, params, self.free)
        # One step of the simulation per step of the environment: what is fitted is what will be driven.
        batch = Batch.stack(self.episodes, substeps=1)
        self.problem = Problem(simulator, batch, self.free, (), group, groups, objective=objective, fixed=self.fixed)
        self._declared = {name: catalogue(simulator.effects)[name] for name in self.free}
        self._leaves = {name: torch.zeros(len(groups), dtype=torch.float64, requires_grad=True) for name in self.free}
        self.set_values({name: _value(params, name, self._declared[name].default) for name in self.free})

    # -- the differentiable view ---------------------------------------------------------------------------------

    def parameters(self) -> list[Tensor]:
        """Return the leaf tensors, one per free parameter, on the real line, shape ``(groups,)``: for any optimiser."""
        return list(self._leaves.values())

    def values(self) -> dict[str, Tensor]:
        """Return the free parameters within their bounds, by full name, shape ``(groups,)``, with their graph."""
        return {name: constrain(self._declared[name], leaf) for name, leaf in self._leaves.items()}

    def set_values(self, values: Mapping[str, Any]) -> None:
        """Write free parameters (numbers or one per group) into the leaves, in place; all gradients are cleared.

        ValueError for a parameter that is not free.
        """
        for name in values:
            if name not in self.free:
                raise ValueError(f"parameter '{name}' is not free here. Free: {', '.join(self.free)}.")
        with torch.no_grad():
            for name, value in values.items():
                number = torch.as_tensor(value, dtype=torch.float64)
                self._leaves[name].copy_(unconstrain(self._declared[name], number))
        for leaf in self._leaves.values():
            # A gradient at the old values would move the new ones at an optimiser's next step.
            leaf.grad = None

    def mean_squared_error(self, values: Tensor | np.ndarray | None = None) -> Tensor:
        """Return the mean squared residual (m² for spacing), differentiable in ``parameters()`` or in ``values``.

        ``values`` have shape ``(free,)`` or ``(groups, free)``, ordered as ``free``; None takes those of
        ``parameters()``.
        """
        own = torch.stack(list(self.values().values()), dim=-1) if values is None else torch.as_tensor(values)
        own = own.to(torch.float64).expand(len(self.problem.groups), len(self.free))
        residual = self.problem.residual(self.problem.simulate(self.problem.rows(own, own.new_zeros(0))))
        return residual.square().sum() / self.problem.samples.sum()

    def root_mean_squared_error(self, values: Tensor | np.ndarray | None = None) -> Tensor:
        """Return the square root of ``mean_squared_error`` (m for spacing) of ``values``, shaped as there."""
        # At an error of exactly 0 the root has no gradient.
        return torch.sqrt(self.mean_squared_error(values) + 1e-18)

    @property
    def vehicle_steps(self) -> int:
        """Simulated steps of drivers in one evaluation of the loss, padding included."""
        return self.problem.batch.steps * len(self.problem.batch)

    # -- search and use ------------------------------------------------------------------------------------------

    def fit(self, **options: Any) -> Fit:
        """Search by ``idm_env.fitting`` (its options), write the result into the leaves, and return it."""
        from idm_env.fitting.fit import fit

        own = torch.stack([x.detach() for x in self.values().values()], dim=-1)
        chosen: dict[str, Any] = {"loss": "mse", **options}
        if chosen.get("starts") == 1:
            chosen["start"] = (own, own.new_zeros(0))
        mine: dict[str, Any] = {"by": self.by, "free": self.free, "fixed": self.fixed, "substeps": 1}
        mine |= {"simulator": self.problem.simulator, "objective": self.problem.objective}
        result = fit(self.episodes, **mine, **chosen)
        self.set_values({name: result.own[:, i] for i, name in enumerate(self.free)})
        return result

    def apply(self, group: int = 0) -> None:
        """Put the values of one group into the environment; they hold from its next step on.

        ValueError for an environment without parameters.
        """
        owner = getattr(self.env, "unwrapped", self.env)
        if not hasattr(owner, "params"):
            raise ValueError("this environment has no parameters to set. Wrap a Gymnasium environment of this package.")
        like = owner.task.like(owner.params)
        owner.params = replaced(owner.params, {name: x[group].detach().to(like) for name, x in self.values().items()})

    def model(self, group: int = 0) -> Any:
        """Return the values of one group as an ``idm_env.model_file.Model``, for ``save_model`` and ``effects=``."""
        from idm_env.model_file import Model, numbers

        estimates = {name: float(value[group].detach()) for name, value in self.values().items()}
        simulator = self.problem.simulator
        effects = tuple(e for e in simulator.effects if e.takes not in _OTHERS and not e.draws)
        return Model(effects, numbers({**self.fixed, **estimates}), simulator.dt, simulator.integration)


def _task_of(env: Any) -> tuple[Task, Params]:
    owner = env if isinstance(env, Task) else getattr(env, "unwrapped", env)
    task = owner if isinstance(owner, Task) else getattr(owner, "task", None)
    if not isinstance(task, Task):
        raise ValueError(
            f"{type(env).__name__} is no environment of this package. Make one with gym.make('DiffIDM-v0')."
        )
    params = getattr(owner, "params", None)
    return task, task.params(torch.float64, "cpu") if not isinstance(params, Mapping) else params


def _episodes(trajectories: Any, dt: float) -> list[Any]:
    from idm_env.data import Episode, Trajectories, episodes, load

    if isinstance(trajectories, (str, Path)):
        trajectories = load(trajectories)
    if isinstance(trajectories, Trajectories):
        return list(episodes(trajectories, smooth=True, dt=dt))
    items = list(trajectories)
    if not items or not all(isinstance(e, Episode) for e in items):
        raise ValueError("trajectories must be a file, idm_env.data.Trajectories, or a sequence of episodes.")
    return [dataclasses.replace(e) for e in items]


def _value(params: Params, name: str, default: float) -> float:
    effect, parameter = name.split(".")
    value = params.get(effect, {}).get(parameter)
    return default if value is None else float(torch.as_tensor(value).detach().double().mean())


def _fixed(simulator: Simulator, params: Params, free: Sequence[str]) -> dict[str, float]:
    """Return the environment's values of whatever is not free; where vehicles differ, their mean."""
    declared = catalogue(simulator.effects)
    return {name: _value(params, name, p.default) for name, p in declared.items() if name not in free}
