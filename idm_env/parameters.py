"""Parameters: declared once beside the equation, used by defaults, sampling, bounds, checks and tables.

A ``Parameter`` says what a number means and where it may lie. Everything else here turns a tuple of effects into
tensors (``defaults``, ``sample``, ``null``), moves tensors in and out of their bounds (``constrain``,
``unconstrain``) or says in one line what is wrong with them (``check``).

Shapes: every parameter is a scalar ``[]`` or one number per vehicle ``[..., n]``, in the unit it declares.
"""

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal, Protocol, TypeVar

import torch
from torch import Tensor
from torch.distributions import biject_to, constraints
from torch.distributions.transforms import Transform

from idm_env.types import Params
from idm_env.validation import (
    at_least as at_least,
    nearest as nearest,
    one_of as one_of,
    shown as shown,
    whole as whole,
)

Role = Literal["strength", "shape", "threshold", "place"]
V = TypeVar("V")


@dataclass(frozen=True)
class Parameter:
    """One number of an effect.

    ``null`` is the value at which the effect is absent (None where the effect is never absent). ``role`` says how it
    is found: a *strength* has a gradient at its null; a *shape* matters only once the strength does; a *threshold* or
    a *place* has to be searched, from ``starts`` where given. ``searched`` are bounds of the search for a missing
    effect, where these are other than (low, high): wider than plausible, narrower than where IDM would collide.
    ``most`` names another parameter of the effect, in the same unit, that it does not exceed.
    """

    name: str
    symbol: str
    unit: str
    default: float
    low: float
    high: float
    null: float | None = None
    role: Role = "strength"
    starts: tuple[float, ...] = ()
    searched: tuple[float, float] | None = None
    most: str = ""

    def __post_init__(self) -> None:
        if not self.low < self.high or not self.low <= self.default <= self.high:
            raise ValueError(f"parameter '{self.name}': default {self.default} is outside [{self.low}, {self.high}].")
        if not re.fullmatch(r"[\w -]+", self.name):
            raise ValueError(f"parameter {self.name!r}: a name has letters, digits, spaces, '_' and '-'.")
        inside = self.null is None or self.low <= self.null <= self.high
        if not inside and not (self.role == "threshold" and math.isfinite(self.null or 0.0)):
            raise ValueError(
                f"parameter '{self.name}': null {self.null} is outside [{self.low}, {self.high}], as only that of a "
                "threshold may be, which is absent far beyond its bounds."
            )

    @property
    def words(self) -> str:
        """Its name and symbol as a sentence has them: "comfort deceleration b"."""
        name = self.name.replace("_", " ").replace("accel", "acceleration").replace("decel", "deceleration")
        return f"{name} {self.symbol}"

    def transform(self) -> Transform:
        """Bijection from the real line onto the open interval (low, high)."""
        return biject_to(constraints.interval(self.low, self.high))


class HasParameters(Protocol):
    """Anything with a name and parameters: an effect."""

    @property
    def name(self) -> str:
        """Key of the effect in ``Params``."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Declared parameters."""


def catalogue(effects: Iterable[HasParameters]) -> dict[str, Parameter]:
    """Return every parameter of ``effects`` by its full name, ``effect.parameter``."""
    return {f"{effect.name}.{p.name}": p for effect in effects for p in effect.parameters}


def defaults(
    effects: Iterable[HasParameters], *, dtype: torch.dtype | None = None, device: torch.device | str | None = None
) -> dict[str, dict[str, Tensor]]:
    """Return the default of every parameter as a scalar tensor."""
    return {
        e.name: {p.name: torch.tensor(p.default, dtype=dtype, device=device) for p in e.parameters} for e in effects
    }


def constrain(parameter: Parameter, free: Tensor) -> Tensor:
    """Map the real line onto the parameter's bounds."""
    return parameter.transform()(free)


def unconstrain(parameter: Parameter, value: Tensor, margin: float = 1e-4) -> Tensor:
    """Map a value within bounds to the real line; one at a bound is first moved inside by ``margin`` of the range."""
    inside = margin * (parameter.high - parameter.low)
    return parameter.transform().inv(value.clamp(parameter.low + inside, parameter.high - inside))


def refuse_incomplete(effects: Iterable[HasParameters], params: Params) -> None:
    """Raise ValueError, in one line, for parameters that are no mapping of effects, and for missing ones."""
    if not isinstance(params, Mapping) or not all(isinstance(part, Mapping) for part in params.values()):
        raise ValueError(f"parameters = {shown(params)} must be effect → name → tensor, as simulator.defaults() gives.")
    missing = next(
        (f"{e.name}.{p.name}" for e in effects for p in e.parameters if p.name not in params.get(e.name, ())), ""
    )
    if missing:
        raise ValueError(f"parameter '{missing}' is missing. Start from simulator.defaults() and change what differs.")


def check(effects: Iterable[HasParameters], params: Params) -> None:
    """Raise ValueError, in one line, for unknown, missing, non-finite or out-of-range parameters.

    A parameter's null is always accepted, also where it lies outside the bounds of the search.
    """
    effects = tuple(effects)
    declared, names = catalogue(effects), {e.name for e in effects}
    refuse_incomplete((), params)
    for effect, values in params.items():
        if effect not in names:
            raise ValueError(f"unknown effect {shown(effect)} in parameters.{nearest(effect, names)}")
        for full in (f"{effect}.{name}" for name in values):
            if full not in declared:
                raise ValueError(f"unknown parameter {shown(full)}.{nearest(full, declared)}")
    refuse_incomplete(effects, params)
    for full, p in declared.items():
        effect, name = full.split(".")
        value = torch.as_tensor(params[effect][name]).detach()
        # Bounds are compared in float32 too, where 0.1 is not 0.1: a relative tolerance keeps a bound itself legal.
        slack = 1e-6 * max(abs(p.low), abs(p.high))
        bad = ~((value >= p.low - slack) & (value <= p.high + slack))
        if p.null is not None:
            bad &= value != p.null
        if bool(bad.any()):
            worst = float(value[bad].reshape(-1)[0])
            unit = "" if p.unit == "1" else f" {p.unit}"
            raise ValueError(f"{full} = {worst:g}{unit} is outside [{p.low:g}, {p.high:g}]{unit}.")
        if p.most and bool((value > (1.0 + 1e-6) * torch.as_tensor(params[effect][p.most]).detach()).any()):
            raise ValueError(
                f"{full} = {float(value.max()):g} {p.unit} must not exceed {effect}.{p.most} = "
                f"{float(torch.as_tensor(params[effect][p.most]).min()):g} {p.unit}."
            )


def replaced(params: Mapping[str, Mapping[str, V]], values: Mapping[str, V]) -> dict[str, dict[str, V]]:
    """Return parameters with some of them, by full names such as ``idm.time_gap``, replaced."""
    changed = {effect: dict(own) for effect, own in params.items()}
    for full, value in values.items():
        effect, name = full.split(".")
        changed.setdefault(effect, {})[name] = value
    return changed


def table(effects: Iterable[HasParameters]) -> list[dict[str, object]]:
    """Return one row per parameter for docs and reports."""
    columns = ("symbol", "unit", "default", "low", "high", "null", "role")
    return [{"parameter": full, **{n: getattr(p, n) for n in columns}} for full, p in catalogue(effects).items()]
