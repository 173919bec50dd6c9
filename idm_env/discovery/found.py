"""A finding without a name, as a file with an effect: its equation, its parameters with intervals, its null."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from textwrap import fill
from typing import Any

from idm_env.discovery.march import CURVE
from idm_env.discovery.model import Term
from idm_env.discovery.result import ParameterEstimate
from idm_env.discovery.slots import TARGETS
from idm_env.discovery.words import ALONG, CHANGES, noun_of
from idm_env.effects.free import FEATURES, PER


def source(terms: Sequence[tuple[Term, Mapping[str, ParameterEstimate]]], sentence: str) -> str:
    """Return the text of a file with one effect for every curve over a state or a phase, "" where there is none.

    Args:
        terms: What was added, and the estimates of its parameters by name.
        sentence: What is said of it.
    """
    curves = [(t, p) for t, p in terms if t.located and t.form == CURVE and (t.fades or t.cycles)]
    if not curves:
        return ""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    template = Path(__file__).with_name("found.jinja")
    loader = FileSystemLoader(template.parent)
    environment = Environment(loader=loader, undefined=StrictUndefined, keep_trailing_newline=True, trim_blocks=True)
    environment.filters["fill"] = lambda text, by: fill(text, 110, initial_indent=by * " ", subsequent_indent=by * " ")
    classes = [_class(term, parameters) for term, parameters in curves]
    return environment.get_template(template.name).render(sentence=sentence, classes=classes)


def _kind(term: Term) -> str:
    return f"{term.what}_over_{'phase' if term.cycles else term.coordinate}" + (f"_by_{term.by}" if term.by else "")


def _class(term: Term, estimates: Mapping[str, ParameterEstimate]) -> dict[str, Any]:
    """Return the names and values of a curve that the template takes."""
    first, distance, count = term.drawn
    end = ["0.0 * x"] * term.fades
    heights = ", ".join((*end, *(f'p["{p.name}"]' for p in term.parameters), *end))
    factors = ", ".join(f"{n}=driver.{n} * (1.0 + c)" for n in TARGETS.get(term.what, ()))
    name = "".join(word.capitalize() for word in _kind(term).split("_"))
    own = {"term": term, "name": name, "kind": _kind(term), "estimates": estimates, "heights": heights}
    own |= {"changed": CHANGES[term.what], "along": ALONG, "noun": noun_of(term), "units": FEATURES, "per": PER}
    return own | {"factors": factors, "knots": tuple(float(f"{first + distance * i:.8g}") for i in range(count))}
