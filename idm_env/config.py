"""YAML files: a model (effects and their parameters) and an environment (the keyword arguments of ``gym.make``).

``model.yaml`` is what a fit saves and what every environment, simulation and fit takes. ``dt`` is in seconds; what
``parameters`` does not name keeps its default; ``drivers`` is optional and says what differs for single drivers::

    {configures: model, schema: 1, dt: 0.1, integration: ballistic,
     effects: [idm, brakes, {effect: delay, max_delay: 2.0}],
     parameters: {idm: {max_accel: 1.2, time_gap: 1.4}, delay: {delay: 0.6}},
     by: driver, drivers: {run1/7: {idm: {time_gap: 1.1}}}, substeps: 4}

An effect that the package has never seen is written as the place of its class, ``my_file.py:MyEffect`` or
``my_package.my_module:MyEffect``; reading such a model runs that file.

``by`` says what the keys of ``drivers`` are, as in ``fit``: ``driver`` (run/vehicle), ``run_id``, ``vehicle_id`` or a
column. ``substeps`` is there where a fit chose another number of simulated steps per sample than the default.

Unknown keys are errors with a suggestion, in one line.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from idm_env import effects as catalogue
from idm_env import parameters
from idm_env.effects import Effect
from idm_env.parameters import nearest
from idm_env.roads import Road
from idm_env.simulator import INTEGRATORS, Integration, Simulator

SCHEMA = 1
"""Version of the layout of ``model.yaml``."""

Numbers = dict[str, dict[str, float]]
"""Effect name → parameter name → number."""

_MODEL_KEYS = ("configures", "schema", "dt", "integration", "effects", "parameters", "by", "drivers", "substeps")


@dataclass(frozen=True)
class Model:
    """Effects with static choices, their parameters as numbers, and how they are integrated.

    ``parameters`` names only what differs from the defaults; ``drivers`` only what differs from ``parameters``.
    ValueError, in one line, for what does not exist or lies outside its bounds.
    """

    effects: tuple[Effect, ...]
    parameters: Numbers = field(default_factory=dict)
    dt: float = 0.1
    integration: Integration = "ballistic"
    drivers: dict[str, Numbers] = field(default_factory=dict)
    by: str = "driver"
    substeps: int | None = None

    def __post_init__(self) -> None:
        if self.integration not in INTEGRATORS:
            raise ValueError(f"integration = '{self.integration}' is unknown.{nearest(self.integration, INTEGRATORS)}")
        if not self.dt > 0.0:
            raise ValueError(f"dt = {self.dt} s must be positive.")
        if self.substeps is not None and (not isinstance(self.substeps, int) or self.substeps < 1):
            raise ValueError(f"substeps = {self.substeps!r} must be a whole number of at least 1.")
        parameters.check(self.effects, self.params(dtype=torch.float64))
        for key in self.drivers:
            try:
                parameters.check(self.effects, self.params(key, dtype=torch.float64))
            except ValueError as error:
                raise ValueError(f"driver '{key}': {error}") from None

    def simulator(self, road: Road) -> Simulator:
        """Return the simulator of this model on a road."""
        return Simulator(road, self.effects, self.dt, self.integration)

    def params(
        self, driver: str | None = None, *, dtype: torch.dtype | None = None, device: torch.device | str | None = None
    ) -> dict[str, dict[str, Tensor]]:
        """Return the parameters as scalar tensors, those of one driver where he is named."""
        if driver is not None and driver not in self.drivers:
            raise ValueError(f"driver '{driver}' is not in this model.{nearest(driver, self.drivers)}")
        values = parameters.defaults(self.effects, dtype=dtype, device=device)
        layers = [self.parameters] + ([] if driver is None else [self.drivers[driver]])
        for layer in layers:
            for effect, numbers in layer.items():
                slot = values.setdefault(effect, {})
                slot.update({n: torch.tensor(float(x), dtype=dtype, device=device) for n, x in numbers.items()})
        return values


def load_model(path: str | Path) -> Model:
    """Return the model of a ``model.yaml``; ValueError, in one line, for everything that does not belong in it."""
    content = _read(path)
    try:
        return _model(content)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _model(content: dict[str, Any]) -> Model:
    _known(content, _MODEL_KEYS, "key")
    if content.get("configures", "model") != "model":
        raise ValueError(f"configures = '{content['configures']}', and a model is wanted. Write 'configures: model'.")
    if content.get("schema", SCHEMA) != SCHEMA:
        raise ValueError(f"schema = {content['schema']} is unknown; this version reads schema {SCHEMA}.")
    if not content.get("effects"):
        raise ValueError("a model needs effects, and none are given. Write 'effects: [idm, brakes]'.")
    return Model(
        effects=make_effects(content["effects"]),
        parameters=numbers(content.get("parameters") or {}),
        dt=number("dt", content.get("dt", 0.1)),
        integration=content.get("integration", "ballistic"),
        drivers={
            str(key): numbers(_mapping(f"drivers.{key}", value))
            for key, value in _mapping("drivers", content.get("drivers") or {}).items()
        },
        by=str(content.get("by", "driver")),
        substeps=content.get("substeps"),
    )


def save_model(path: str | Path, model: Model) -> None:
    """Write a model as ``model.yaml``; ``load_model`` gives the same model back."""
    content: dict[str, Any] = {
        "configures": "model",
        "schema": SCHEMA,
        "dt": model.dt,
        "integration": model.integration,
        "effects": [describe(effect) for effect in model.effects],
        "parameters": {e: {n: float(x) for n, x in values.items()} for e, values in model.parameters.items()},
    }
    if model.substeps is not None:
        content["substeps"] = model.substeps
    if model.drivers:
        content["by"] = model.by
        content["drivers"] = {
            key: {e: {n: float(x) for n, x in values.items()} for e, values in layer.items()}
            for key, layer in model.drivers.items()
        }
    text = _yaml().safe_dump(content, sort_keys=False, allow_unicode=True, default_flow_style=None)
    Path(path).write_text(text, encoding="utf-8")


def load_environment(path: str | Path) -> dict[str, Any]:
    """Return the keyword arguments of an environment's YAML file; it must say ``configures: environment``."""
    content = _read(path)
    if content.pop("configures", None) != "environment":
        raise ValueError(
            f"{path}: no environment is configured here. Write 'configures: environment' in its first line."
        )
    return content


def describe(effect: Effect) -> str | dict[str, Any]:
    """Return an effect as YAML writes it: its name, or a mapping with the static choices that differ from defaults."""
    choices = {}
    for f in dataclasses.fields(effect):
        value = getattr(effect, f.name)
        if value != f.default:
            choices[f.name] = list(value) if isinstance(value, tuple) else value
    name = catalogue.describe(effect)
    return {"effect": name, **choices} if choices else name


def make_effects(descriptions: Iterable[str | Mapping[str, Any] | Effect]) -> tuple[Effect, ...]:
    """Return effects from names, mappings ``{effect: name, choice: value}``, or effects as they are."""
    if isinstance(descriptions, (str, Mapping)) or not isinstance(descriptions, Iterable):
        raise ValueError(f"effects = {descriptions!r} must be a list, such as [idm, brakes].")
    made = []
    for description in descriptions:
        if isinstance(description, Effect):
            made.append(description)
        elif isinstance(description, str):
            made.append(catalogue.make(description))
        elif isinstance(description, Mapping) and "effect" in description:
            choices = {k: v for k, v in description.items() if k != "effect"}
            made.append(catalogue.make(str(description["effect"]), **choices))
        else:
            raise ValueError(f"effect {description!r} must be a name or a mapping with the key 'effect'.")
    return tuple(made)


def numbers(values: Mapping[str, Any]) -> Numbers:
    """Return effect → parameter → number; ``{"idm.time_gap": 1.2}`` and ``{"idm": {"time_gap": 1.2}}`` are the same."""
    return {e: {n: number(f"{e}.{n}", x) for n, x in part.items()} for e, part in nested(values).items()}


def nested(values: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return parameters as effect → parameter → value, from that or from full names with a dot."""
    result: dict[str, dict[str, Any]] = {}
    for key, value in _mapping("parameters", values).items():
        if isinstance(value, Mapping):
            result.setdefault(str(key), {}).update(value)
        elif "." in str(key):
            effect, name = str(key).split(".", 1)
            result.setdefault(effect, {})[name] = value
        else:
            raise ValueError(f"parameters.{key} = {value!r} must be a mapping, such as {{time_gap: 1.2}}.")
    return result


def number(name: str, value: Any) -> float:
    """Return a finite float; YAML reads 1e-3 as text, which is accepted."""
    try:
        result = float(value)
    except (TypeError, ValueError):
        raise ValueError(f"{name} = {value!r} must be a number.") from None
    if isinstance(value, bool) or not math.isfinite(result):
        raise ValueError(f"{name} = {value!r} must be a finite number.")
    return result


def _mapping(name: str, value: Any) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise ValueError(f"{name} = {value!r} must be a mapping.")
    return value


def _known(content: Mapping[str, Any], known: Iterable[str], what: str) -> None:
    for key in content:
        if key not in known:
            raise ValueError(f"unknown {what} '{key}'.{nearest(str(key), known)}")


def _read(path: str | Path) -> dict[str, Any]:
    yaml = _yaml()
    file = Path(path)
    if not file.is_file():
        raise ValueError(f"{path} is not a file. Give the path of a YAML file.")
    try:
        content = yaml.safe_load(file.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is not valid YAML: {' '.join(str(error).split())}") from None
    if not isinstance(content, dict):
        raise ValueError(f"{path} must hold a mapping, one 'key: value' per line.")
    return content


def _yaml() -> Any:
    try:
        import yaml
    except ImportError:
        raise ImportError("YAML files need PyYAML. Install it with: pip install 'idm-env[data]'") from None
    return yaml
