"""YAML files: a model (effects and their parameters) and an environment (the keyword arguments of ``gym.make``).

``model.yaml`` is what a fit saves and what every environment, simulation and fit takes. ``dt`` is in seconds; what
``parameters`` does not name keeps its default; ``drivers`` is optional and says what differs for single drivers::

    {configures: model, schema: 1, dt: 0.1, integration: ballistic,
     effects: [idm, brakes, {effect: delay, max_delay: 2.0}],
     parameters: {idm: {max_accel: 1.2, time_gap: 1.4}, delay: {delay: 0.6}},
     by: driver, drivers: {run1/7: {idm: {time_gap: 1.1}}}, substeps: 4}

An effect that the package has never seen is written as the place of its class, ``my_file.py:MyEffect`` or
``my_package.my_module:MyEffect``. That is code of whoever wrote the YAML file. It is free where this process has
imported it already. Otherwise it is run only if ``trusted``, inside ``idm_env.jobs.trust.trusting()``, or with
IDM_ENV_TRUST=1.

``by`` says what the keys of ``drivers`` are, as in ``fit``: ``driver`` (run/vehicle), ``run_id``, ``vehicle_id`` or a
column. ``substeps`` is there where a fit chose another number of simulated steps per sample than the default.
``fitted_on`` holds the name of the file and the places and times of all who were fitted, so that ``simulate``
can tell a fitted from a held-out figure.

Unknown keys are errors with a suggestion, in one line.
"""

import dataclasses
import logging
import math
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from idm_env import effects as catalogue, parameters
from idm_env.effects import CarFollowing, Effect
from idm_env.extras import needed
from idm_env.jobs import trust
from idm_env.jobs.storage import write_text
from idm_env.roads import Lanes, Road
from idm_env.simulator import INTEGRATORS, Integration, Simulator
from idm_env.validation import nearest, one_of, shown, whole

SCHEMA = 1
"""Version of the layout of ``model.yaml``."""

MOST_BYTES, DEEPEST, LONGEST = 20_000_000, 20, 500
"""Bytes of a YAML file, nesting in it, and characters of a plain value (without quotes)."""

Numbers = dict[str, dict[str, float]]
"""Effect name → parameter name → number."""


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
    fitted_on: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        one_of("integration", self.integration, INTEGRATORS)
        if any(isinstance(effect, CarFollowing) for effect in self.effects):
            Simulator(Lanes(2), self.effects, self.dt, self.integration)  # its rules on effects and dt
        elif not self.dt > 0.0:
            raise ValueError(f"dt = {self.dt} s must be positive.")
        if self.substeps is not None:
            whole("substeps", self.substeps, 1, 1000)
        parameters.check(self.effects, self.params(dtype=torch.float64))
        for key in self.drivers:
            try:
                parameters.check(self.effects, self.params(key, dtype=torch.float64))
            except ValueError as error:
                raise ValueError(f"driver {shown(key)}: {error}") from None

    def simulator(self, road: Road) -> Simulator:
        """Return the simulator of this model on a road."""
        return Simulator(road, self.effects, self.dt, self.integration)

    def params(
        self, driver: str | None = None, *, dtype: torch.dtype | None = None, device: torch.device | str | None = None
    ) -> dict[str, dict[str, Tensor]]:
        """Return the parameters as tensors of shape ``()``, those of one driver where he is named.

        ValueError for a driver who is not in the model.
        """
        if driver is not None and driver not in self.drivers:
            raise ValueError(f"driver {shown(driver)} is not in this model.{nearest(driver, self.drivers)}")
        values = parameters.defaults(self.effects, dtype=dtype, device=device)
        layers = [self.parameters] + ([] if driver is None else [self.drivers[driver]])
        for layer in layers:
            for effect, numbers in layer.items():
                slot = values.setdefault(effect, {})
                slot.update({n: torch.tensor(float(x), dtype=dtype, device=device) for n, x in numbers.items()})
        return values


def load_model(path: str | Path, *, trusted: bool = False) -> Model:
    """Return the model of a ``model.yaml``; ValueError, in one line, for everything that does not belong in it.

    ``trusted``: code that the file names is run; otherwise it is such an error.
    """
    with trust.trusting(trusted):
        content = read_yaml(path)
        try:
            return _model(content)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None


def _model(content: dict[str, Any]) -> Model:
    _check_keys(content, ("configures", "schema", *(field.name for field in dataclasses.fields(Model))), "key")
    if content.get("configures", "model") != "model":
        raise ValueError(f"configures = {shown(content['configures'])}, not a model. Write 'configures: model'.")
    if content.get("schema", SCHEMA) != SCHEMA:
        raise ValueError(f"schema = {shown(content['schema'])} is unknown; this version reads schema {SCHEMA}.")
    if not content.get("effects"):
        raise ValueError("a model needs effects, and none are given. Write 'effects: [idm, brakes]'.")
    effects, values = make_effects(content["effects"]), numbers(content.get("parameters") or {})
    dt, integration = number("dt", content.get("dt", 0.1)), content.get("integration", "ballistic")
    layers = _mapping("drivers", content.get("drivers") or {}).items()
    drivers = {str(key): numbers(_mapping(f"drivers.{shown(key)}", value)) for key, value in layers}
    by, fitted_on = _text("by", content.get("by", "driver")), _fitted_on(content.get("fitted_on") or {})
    return Model(effects, values, dt, integration, drivers, by, content.get("substeps"), fitted_on)


def _fitted_on(value: Any) -> dict[str, Any]:
    _check_keys(_mapping("fitted_on", value), ("source", "tracks"), "key of fitted_on")
    tracks = value.get("tracks", [])
    if not isinstance(tracks, list):
        raise ValueError("fitted_on.tracks must be a list of marks, as fit writes it. Remove fitted_on if in doubt.")
    return {"source": str(value.get("source", "")), "tracks": [str(track) for track in tracks]} if value else {}


def save_model(path: str | Path, model: Model) -> None:
    """Write a model as ``model.yaml``; ``load_model`` gives the same model back."""

    def floats(layer: Numbers) -> Numbers:
        return {e: {n: float(x) for n, x in values.items()} for e, values in layer.items()}

    content: dict[str, Any] = {"configures": "model", "schema": SCHEMA, "dt": model.dt}
    content |= {"integration": model.integration, "effects": [describe(effect) for effect in model.effects]}
    content["parameters"] = floats(model.parameters)
    if model.substeps is not None:
        content["substeps"] = model.substeps
    if model.drivers:
        content |= {"by": model.by, "drivers": {key: floats(layer) for key, layer in model.drivers.items()}}
    if model.fitted_on:
        content["fitted_on"] = model.fitted_on
    text = _yaml().safe_dump(content, sort_keys=False, allow_unicode=True, default_flow_style=None)
    write_text(Path(path), text)


def load_environment(path: str | Path, *, trusted: bool = False) -> dict[str, Any]:
    """Return the keyword arguments of an environment's YAML file; it must say ``configures: environment``.

    ValueError, in one line, for what is none, and for code that the file names, unless it is ``trusted``.
    """
    with trust.trusting(trusted):
        content = read_yaml(path)
    if content.pop("configures", None) != "environment":
        raise ValueError(f"{path}: no environment is configured here. Write 'configures: environment' first.")
    return {str(key): value for key, value in content.items()}


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
    """Return effects from names, mappings ``{effect: name, choice: value}``, or effects as they are.

    ValueError for anything else.
    """
    if (
        isinstance(descriptions, (str, Mapping))
        or not isinstance(descriptions, Iterable)
        or hasattr(descriptions, "ndim")
    ):
        raise ValueError(f"effects = {shown(descriptions)} must be a list, such as [idm, brakes].")
    effects = []
    for description in descriptions:
        if isinstance(description, Effect):
            effects.append(description)
        elif isinstance(description, str):
            effects.append(catalogue.make(description))
        elif isinstance(description, Mapping) and "effect" in description:
            choices = {str(k): v for k, v in description.items() if k != "effect"}
            try:
                effects.append(catalogue.make(_text("effect", description["effect"]), **choices))
            except (TypeError, ArithmeticError) as error:
                raise ValueError(f"effect {shown(description)} has a choice of a wrong type ({error}).") from None
        else:
            raise ValueError(f"effect {shown(description)} must be a name or a mapping with the key 'effect'.")
    return tuple(effects)


def numbers(values: Mapping[str, Any], of: str = "") -> Numbers:
    """Return effect → parameter → number; ``{"idm.time_gap": 1.2}`` and ``{"idm": {"time_gap": 1.2}}`` are the same.

    ``of`` is the key that errors name.
    """
    parts, prefix = nested(values, of or "parameters"), f"{of}." if of else ""
    return {e: {n: number(f"{prefix}{e}.{n}", x) for n, x in part.items()} for e, part in parts.items()}


def nested(values: Mapping[str, Any], of: str = "parameters") -> dict[str, dict[str, Any]]:
    """Return parameters as effect → parameter → value, from that or from full names with a dot; ``of`` is the key.

    ValueError for anything else, and for a parameter given twice.
    """
    result: dict[str, dict[str, Any]] = {}
    for key, value in _mapping(of, values).items():
        if isinstance(value, Mapping):
            part, effect = {str(name): x for name, x in value.items()}, str(key)
        elif "." in str(key):
            effect, name = str(key).split(".", 1)
            part = {name: value}
        else:
            raise ValueError(f"{of}.{shown(key)} = {shown(value)} must be a mapping, such as {{time_gap: 1.2}}.")
        for name in part:
            if name in result.get(effect, {}):
                raise ValueError(f"parameter {shown(f'{effect}.{name}')} is given twice. Remove one of them.")
        result.setdefault(effect, {}).update(part)
    return result


def number(name: str, value: Any) -> float:
    """Return a finite float; YAML reads 1e-3 as text, which is accepted. ValueError for anything else."""
    try:
        result = float(value)
    except (TypeError, ValueError):
        raise ValueError(f"{name} = {shown(value)} must be a number.") from None
    except OverflowError:  # a whole number beyond 1e308
        result = math.inf
    if isinstance(value, bool) or not math.isfinite(result):
        raise ValueError(f"{name} = {shown(value)} must be a finite number.")
    return result


def _mapping(name: str, value: Any) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise ValueError(f"{name} = {shown(value)} must be a mapping.")
    return value


def _text(name: str, value: Any) -> str:
    if not isinstance(value, str):
        raise ValueError(f"{name} = {shown(value)} must be a text.")
    return value


def _check_keys(content: Mapping[str, Any], names: Iterable[str], what: str) -> None:
    for key in content:
        if key not in names:
            raise ValueError(f"unknown {what} {shown(key)}.{nearest(str(key), names)}")


def read_yaml(path: str | Path) -> dict[str, Any]:
    """Return the mapping of a YAML file; ValueError, in one line, for everything else, whatever its bytes."""
    yaml = _yaml()
    if not isinstance(path, str | Path) or not os.path.isfile(path):
        raise ValueError(f"{' '.join(str(path).split())[:200]} is not a file. Give the path of a YAML file.")
    file = Path(path)
    if file.stat().st_size > MOST_BYTES:
        raise ValueError(f"{path} has {file.stat().st_size} bytes, and {MOST_BYTES} are the most. Is it a YAML file?")
    try:
        text = file.read_text(encoding="utf-8")
        loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
        _harmless(yaml, text, loader)
        content = yaml.load(text, loader)
    except (yaml.YAMLError, ValueError, TypeError, AttributeError, LookupError, ArithmeticError) as error:
        # What stands for no value of its kind, such as 2001-99-99 for a day, is not always a YAMLError.
        raise ValueError(f"{path} is not valid YAML: {' '.join(str(error).split())[:200]}") from None
    if not isinstance(content, dict):
        raise ValueError(f"{path} must hold a mapping, one 'key: value' per line.")
    check_places(path, content)
    return content


def check_places(path: str | Path, content: Mapping[Any, Any]) -> None:
    """Raise ValueError, in one line, where what a file says names code to run, unless it is trusted; else say so.

    Whoever reads a file of others, of whatever layout, calls this first. Every list under a key ``effects`` counts.
    """
    waiting: list[Any] = [content]
    while waiting:
        part = waiting.pop()
        if not isinstance(part, Mapping):
            waiting += part if isinstance(part, (list, tuple)) else ()
            continue
        waiting += (value for key, value in part.items() if key != "drivers")  # whose keys are names of drivers
        if "trusted" in part:
            raise ValueError(f"{path}: trusted = {shown(part['trusted'])} is not for a file to say. Say it yourself.")
        effects = part.get("effects")
        listed = isinstance(effects, Iterable) and not isinstance(effects, (str, Mapping))
        for one in effects if listed else ():  # type: ignore[union-attr]
            where = one.get("effect") if isinstance(one, Mapping) else one
            if not isinstance(where, str) or ":" not in where or catalogue.module_at(place := where.rpartition(":")[0]):
                continue
            if not trust.permission():
                raise ValueError(
                    f"{path}: effect {shown(where)} is code of {shown(place)}, which is not run unasked. Read it, then "
                    f"give --trust, trusted=True in Python, or {trust.VARIABLE}=1."
                )
            logging.getLogger("idm_env").warning("runs %s, which %s names.", place, path)
            try:
                catalogue.named(where)
            except ValueError as error:
                raise ValueError(f"{path}: {error}") from None


def _harmless(yaml: Any, text: str, loader: Any) -> None:
    """Raise ValueError for what makes a small file grow (aliases, deep nesting, long numbers) and for bad keys."""
    keys: list[set[str] | None] = []  # of every open collection; None for a list
    waits: list[bool] = []  # whether the next node in it is a key
    top = ""  # the last key of the whole; those below ``drivers`` are identifiers of a user's file, whatever they hold
    for event in yaml.parse(text, loader):
        line = f"line {event.start_mark.line + 1}"
        if isinstance(event, yaml.AliasEvent):
            raise ValueError(f"{line}: aliases (*) are not taken; write the value out.")
        if isinstance(event, yaml.CollectionEndEvent):
            keys.pop(), waits.pop()
            continue
        if not isinstance(event, yaml.NodeEvent):
            continue
        siblings = keys[-1] if keys and waits[-1] else None
        if keys:
            waits[-1] = not waits[-1]
        if isinstance(event, yaml.CollectionStartEvent):
            keys.append(set() if isinstance(event, yaml.MappingStartEvent) else None)
            waits.append(True)
            if len(keys) > DEEPEST:
                raise ValueError(f"{line}: nested deeper than {DEEPEST}.")
        elif event.style is None and len(event.value) > LONGEST:
            raise ValueError(f"{line}: a value of {len(event.value)} characters; quote it.")
        elif siblings is not None and not event.value.isprintable() and (len(keys), top) != (2, "drivers"):
            raise ValueError(f"{line}: key {shown(event.value)} must be printable: errors name it. Rename it.")
        elif siblings is not None and event.value in siblings:
            raise ValueError(f"{line}: key {shown(event.value)} is there twice. Remove one of them.")
        elif siblings is not None:
            siblings.add(event.value)
            top = event.value if len(keys) == 1 else top


def _yaml() -> Any:
    with needed("a YAML file"):
        import yaml
    return yaml
