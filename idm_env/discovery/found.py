"""A finding without a name, as a file with an effect: its equation, its parameters with intervals, its null."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from textwrap import fill
from typing import Any

from idm_env.discovery.march import CURVE
from idm_env.discovery.model import Term
from idm_env.discovery.result import ParameterEstimate
from idm_env.discovery.slots import TARGETS
from idm_env.discovery.words import ALONG, CHANGES
from idm_env.effects.free import FEATURES, PER

_HEAD = '''"""What `idm-env explain` found, and has no name for.

{sentence}

In Python: `Simulator(Lane(), (IDM(), {first}(), Brakes()))`, and of an environment
`effects=[{first}()]`. In a `model.yaml`, with the path from where the command runs:
`effects: [idm, "found_effect.py:{first}", brakes]`.
"""

from dataclasses import dataclass
from typing import ClassVar

from idm_env import Effect, Parameter
from idm_env.effects.free import {imported}
from idm_env.effects.places import interpolate
'''
_CLASS = '''

@dataclass(frozen=True)
class {name}(OverFeature, Effect):
    """{equation}: c is piecewise linear in x, the {noun} ({unit}){ends}.

{intervals}
    """

    kind: ClassVar[str] = "{kind}"
    title: ClassVar[str] = "{title}"
    equation: ClassVar[str] = "{equation}"
    acts_on: ClassVar[str] = "{what}"
    feature: ClassVar[str] = "{feature}"
    knots: ClassVar[tuple[float, ...]] = {knots}
    declared: ClassVar[tuple[Parameter, ...]] = (
{declared}
    )

    def {hook}:
        """Return {returns}."""
        x = self.x_of(scene, driver)
        heights = [
{heights}
        ]
        c = interpolate(x, self.knots, heights){share}
        return {result}
'''

_DEEP: dict[str, Any] = {"initial_indent": 12 * " ", "subsequent_indent": 12 * " "}


def source(terms: Sequence[tuple[Term, Mapping[str, ParameterEstimate]]], sentence: str) -> str:
    """Return the text of a file with one effect for every curve over a state, "" where there is none.

    Args:
        terms: What was added, and the estimates of its parameters by name.
        sentence: What is said of it.
    """
    curves = [(t, p) for t, p in terms if t.located and t.form == CURVE and t.fades]
    if not curves:
        return ""
    classes = [_class(term, parameters) for term, parameters in curves]
    imported = "OverFeature, share_of" if any(t.by for t, _ in curves) else "OverFeature"
    return _HEAD.format(sentence=fill(sentence, 110), first=_name(curves[0][0]), imported=imported) + "".join(classes)


def _name(term: Term) -> str:
    return "".join(word.capitalize() for word in _kind(term).split("_"))


def _kind(term: Term) -> str:
    return f"{term.what}_over_{term.coordinate}" + (f"_by_{term.by}" if term.by else "")


def _class(term: Term, parameters: Mapping[str, ParameterEstimate]) -> str:
    first, distance, count = term.drawn
    unit = term.parameters[0].unit
    declared = [
        f'        Parameter("{p.name}", "{p.symbol}", "{unit}", {parameters[p.name].estimate!r}, {p.low}, {p.high}, '
        "null=0.0),"
        for p in term.parameters
    ]
    intervals = ", ".join(
        f"{p.symbol} {parameters[p.name].low:.3g} to {parameters[p.name].high:.3g}" for p in term.parameters
    )
    intervals = fill(f"95 % intervals: {intervals}.", 110, initial_indent="    ", subsequent_indent="    ")
    inner = ", ".join(("0.0 * x", *(f'p["{p.name}"]' for p in term.parameters), "0.0 * x"))
    ends, share = ", and 0 beyond its ends", ""
    if term.by:
        ends += f", times the {ALONG[term.by]} over {PER[term.by]:g} {FEATURES[term.by]}, −2 to 2"
        share = f' * share_of(scene, driver, "{term.by}")'
    added = term.what == "acceleration"
    knots = tuple(float(f"{first + distance * i:.8g}") for i in range(count))
    changed = ", ".join(f"{n}=driver.{n} * (1.0 + c)" for n in TARGETS.get(term.what, ()))
    return _CLASS.format(
        name=_name(term), equation=CHANGES[term.what][3].replace("k", "c"), noun=ALONG[term.coordinate],
        unit=FEATURES[term.coordinate], ends=ends, share=share, intervals=intervals,
        kind=f"found_{_kind(term)}", title=f"{CHANGES[term.what][2]} by {ALONG[term.coordinate]}",
        what=term.what, knots=knots, declared="\n".join(declared),
        hook="accelerate(self, scene, driver, p)" if added else "adapt(self, driver, scene, p)",
        returns="c (m/s²)" if added else "the driver in force", feature=term.coordinate,
        heights=fill(inner, 110, **_DEEP), result="c" if added else f"driver._replace({changed})",
    )  # fmt: skip
