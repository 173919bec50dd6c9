"""How drivers behave in a task: its own effects and parameters, changed by keyword or replaced by a saved model."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor

from idm_env import parameters
from idm_env.effects import CarFollowing, Effect
from idm_env.model_file import Model, load_model, make_effects, nested, number
from idm_env.simulator import Integration


@dataclass(frozen=True)
class Behaviour:
    """Effects, the values that differ from their defaults, and how they are integrated.

    ``drivers`` has, of every parameter in which drivers differ (by full name), the value of each of them.
    """

    effects: tuple[Effect, ...]
    parameters: dict[str, dict[str, Any]]
    dt: float
    integration: Integration
    drivers: dict[str, tuple[float, ...]] = field(default_factory=dict)

    def params(self, vehicles: int, dtype: torch.dtype, device: torch.device | str) -> dict[str, dict[str, Tensor]]:
        """Return tensors; a list must have one value per vehicle."""
        values = parameters.defaults(self.effects, dtype=dtype, device=device)
        for effect, part in self.parameters.items():
            for name, value in part.items():
                values.setdefault(effect, {})[name] = _tensor(f"{effect}.{name}", value, vehicles, dtype, device)
        return values


def _tensor(name: str, value: Any, vehicles: int, dtype: torch.dtype, device: torch.device | str) -> Tensor:
    if isinstance(value, Tensor):
        return value.to(device=device, dtype=dtype)
    if isinstance(value, Sequence) and not isinstance(value, str):
        if len(value) != vehicles:
            raise ValueError(f"{name} has {len(value)} values for {vehicles} vehicles: give one or one per vehicle.")
        return torch.tensor([number(name, x) for x in value], dtype=dtype, device=device)
    return torch.tensor(number(name, value), dtype=dtype, device=device)


def behaviour(
    own: tuple[Effect, ...],
    required: tuple[Effect, ...],
    own_parameters: Mapping[str, Mapping[str, Any]],
    effects: str | Sequence[str | Mapping[str, Any] | Effect],
    changes: Mapping[str, Any] | None,
    dt: float | None,
    integration: str | None,
    drivers: str | Path | None = None,
) -> Behaviour:
    """Return the behaviour of a task with keyword changes.

    ``required`` effects are the task's machinery (control, replay, noise). ``effects`` is a list to add to ``own``,
    or the path of a model file, which replaces ``own`` and its parameters and gives dt and integration unless they
    are given; machinery that it does not have keeps its own. So does ``drivers``, the path of a model file with single
    drivers, of whom these are kept.
    ValueError where both are given.
    """
    values, single = own_parameters, dict[str, tuple[float, ...]]()
    if drivers is not None and effects:
        raise ValueError(
            f"drivers = {str(drivers)!r} has effects of its own, and effects = {effects!r} are given as well. Give one."
        )
    if drivers is not None or isinstance(effects, (str, Path)):
        model = load_model(effects if drivers is None else drivers)  # type: ignore[arg-type]
        if drivers is not None:
            single = _single(model, drivers)
        chosen, values = list(model.effects), model.parameters
        dt = model.dt if dt is None else dt
        integration = model.integration if integration is None else integration
    else:
        chosen = list(own)
        for effect in make_effects(effects):
            following = isinstance(effect, CarFollowing)
            chosen = [e for e in chosen if e.name != effect.name and not (following and isinstance(e, CarFollowing))]
            chosen.append(effect)
    names = {e.name for e in chosen}
    machinery = [e for e in required if e.name not in names]
    chosen += machinery
    machines = {e.name: own_parameters[e.name] for e in machinery if e.name in own_parameters}
    all_names = names | {e.name for e in machinery}
    merged = {effect: dict(part) for effect, part in {**machines, **values}.items() if effect in all_names}
    for key, change in nested({} if changes is None else changes).items():
        merged.setdefault(key, {}).update(change)
        single = {full: x for full, x in single.items() if full not in {f"{key}.{name}" for name in change}}
    step, scheme = number("dt", 0.1 if dt is None else dt), "ballistic" if integration is None else integration
    return Behaviour(tuple(chosen), merged, step, cast(Integration, scheme), single)


def _single(model: Model, path: str | Path) -> dict[str, tuple[float, ...]]:
    """Return what the drivers of a model differ in."""
    if not model.drivers:
        raise ValueError(f"{path} has no single drivers to draw. Give a model.yaml of `idm-env fit --by driver`.")
    names = dict.fromkeys((e, n) for layer in model.drivers.values() for e, values in layer.items() for n in values)
    everybody = [model.params(driver, dtype=torch.float64) for driver in model.drivers]
    return {f"{e}.{n}": tuple(float(own[e][n]) for own in everybody) for e, n in names}
