"""First sentences of verdicts: 30 words at most, before equation and numbers; figures are made up."""

from __future__ import annotations

import re
from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest

from idm_env.discovery import model as terms, words
from idm_env.discovery.bases import Law, personal
from idm_env.discovery.compare import ERRORS, Comparison
from idm_env.discovery.march import Catalogue
from idm_env.discovery.model import Hypothesis, Term
from idm_env.discovery.score import Contrast
from idm_env.discovery.shared import Shared
from idm_env.discovery.verdict import Reason, Refusal, Verdict
from idm_env.effects import ALL, BASES, CANDIDATES, base_named
from idm_env.effects.free import PER

LONGEST = max((ALL[name].title for name in BASES), key=lambda title: len(title.split()))
INTERVAL, PLACE = (-0.314, -0.425, -0.213), (200.0, 190.0, 210.0)
BETTER, SAME, WORSE, HIGHER = (
    Comparison(1.0, ratio, ratio, low, high)
    for ratio, low, high in ((0.9, 0.85, 0.95), (0.99, 0.94, 1.04), (1.1, 1.05, 1.15), (1.08, 0.9, 1.2))
)


def first_of(text: str) -> str:
    return re.split(r"(?<=[.:]) (?=[A-Z])", text)[0]


def assert_short(text: str) -> None:
    """A first sentence has 30 words at most and no equation or estimate."""
    first = first_of(text)
    assert len(first.split()) <= 30 and not re.search("→|c = |k = |, with", first), first


def assert_clause(term: Term, clause: str) -> None:
    """Beside the first sentence, the second has equation and estimates."""
    text = words.headline(Verdict.NAMED, [clause], None, "", {})
    assert_short(text)
    equation = ALL[term.effect].equation if term.effect else words.CHANGES[term.what][3]
    assert f"{equation}, with " in text[len(first_of(text)) :], text


@pytest.mark.parametrize("reason", [*Reason])
@pytest.mark.parametrize("concluded", [Verdict.NONE, Verdict.CANNOT_TELL, Verdict.UNEXPLAINED])
def test_why_nothing_was_added_is_short(concluded: Verdict, reason: Reason) -> None:
    tried = "stiffness of the pull to one's own gap"
    assert_short(words.headline(concluded, [], Refusal(reason, 0.25), tried, {}))


@pytest.mark.parametrize("three", [(WORSE, WORSE, WORSE), (HIGHER, BETTER, SAME), (SAME, SAME, SAME)])
def test_what_errors_refuse_is_short(three: tuple[Comparison, ...]) -> None:
    tried, errors = "stiffness of the pull to one's own gap and leader's trend", dict(zip(ERRORS, three, strict=True))
    assert_short(words.headline(Verdict.UNEXPLAINED, [], Refusal(Reason.HELD_OUT), tried, errors))


@pytest.mark.parametrize("said", [Verdict.NONE, Verdict.UNDECIDED, Verdict.UNEXPLAINED])
def test_what_noise_explains_is_short(said: Verdict) -> None:
    ladder = SimpleNamespace(unsteady=(0.21, 4.2), few=(), tails=None)
    text = words.beside_noise(said, LONGEST, 4.41, 0.12, ladder)  # type: ignore[arg-type]
    assert len(first_of(text).split()) <= 30, text


@pytest.mark.parametrize("laws", [2, 3, 6])
@pytest.mark.parametrize("classes", [(), ("Tesla Model 3", "Tesla Model X", "Jaguar I Pace")], ids=["none", "three"])
def test_the_laws_of_several_kinds_are_short(classes: tuple[str, ...], laws: int) -> None:
    """However many laws and classes there are; every driver is counted."""
    title, counts, column = SimpleNamespace(title=LONGEST), [10 * n + 1 for n in range(laws)], "vehicle_name"
    fleet = SimpleNamespace(
        laws=[title] * laws, counts=counts, group=range(sum(counts)), against=dict.fromkeys(ERRORS, BETTER),
        classes=[classes] * laws if classes else [], column=column if classes else "",
    )  # fmt: skip
    text = words.fleet_first(fleet)  # type: ignore[arg-type]
    assert_short(text)
    assert text.count("Jaguar") == (laws if classes else 0)
    assert sum(map(int, re.findall(r"(\d+) (?:of|by)", first_of(text)))) == sum(counts)


@pytest.mark.parametrize("name", CANDIDATES)
def test_a_named_effect_is_short(name: str) -> None:
    cls = ALL[name]
    term = {
        "interval": lambda: terms.placed(name, 0.5, 100.0, 200.0),
        "step": lambda: terms.placed(name, 0.5, 100.0),
        "profile": lambda: terms.unknown_profile(name, 0.0, 100.0, 7, 0.0),
        "given": lambda: terms.given_profile(cls()),
    }.get(cls.sought, lambda: terms.simple(name))()
    for law, strength in product(("IDM", LONGEST), (INTERVAL, (9.12, 8.34, 9.87))):
        assert_clause(term, words.clause(term, [strength, *[PLACE] * (term.size - 1)], law=law))


@pytest.mark.parametrize("coordinate", words.ALONG)
def test_a_shape_is_short(coordinate: str) -> None:
    """A curve over a state, the past, a place or a time; and a surface over two states."""
    states = [by for by in PER if coordinate in PER and by != coordinate]
    for what, by in product(words.CHANGES, ["", *states]):
        term = terms.curve(what, coordinate, -12.5, terms.STATES.get(coordinate, 12.5), 6, by=by)
        for contrast in (Contrast(1, 4, 0.314, 0.213, 0.425), None):
            assert_clause(term, words.clause(term, [INTERVAL] * term.size, contrast))


@pytest.mark.parametrize("what", words.CHANGES)
def test_a_phase_is_short(what: str) -> None:
    term = terms.curve(what, "time", 0.0, 12.5, 8, 100.0, label=f"{what} over phase")
    for contrast in (Contrast(1, 4, 0.314, 0.213, 0.425), None):
        assert_clause(term, words.clause(term, [INTERVAL] * term.size, contrast))


@pytest.mark.parametrize("what", words.CHANGES)
@pytest.mark.parametrize(("coordinate", "end"), [("position", 1000.0), ("time", 260.0), ("time", 1e6)])
def test_an_event_is_short(what: str, coordinate: str, end: float) -> None:
    term = terms.interval(what, coordinate, 200.0, end, 0.3)
    for amount in (INTERVAL, (0.3, 0.2, 0.4)):
        assert_clause(term, words.clause(term, [amount, PLACE, (end,) * 3]))
    assert_clause(term, words.clause(terms.curve(what, coordinate, 0.0, 500.0, 2), [INTERVAL] * 2))


def test_an_event_of_one_run_is_short() -> None:
    assert_short(words.common(Shared("a7", 126.0, 166.0, -0.314, 3, 0.001)))


@pytest.mark.parametrize("base", BASES)
def test_another_law_is_short(base: str) -> None:
    law, against = base_named(base), dict(zip(ERRORS, (SAME, BETTER, SAME), strict=True))
    for without in ((), law.spared[:1]):
        model = Hypothesis((), Catalogue((), law, located=False, without=without))
        text = words.law_first(Law(law, model, None, against), LONGEST)  # type: ignore[arg-type]
        assert_short(text)
        assert len(first_of(text).split()) < 20 and "95 %" not in first_of(text), text


@pytest.mark.parametrize("factor", [0.7, 1.3])
@pytest.mark.parametrize("name", [name for name, cls in ALL.items() if cls.per_driver])
def test_a_law_with_own_strengths_is_short(name: str, factor: float) -> None:
    law, against = base_named("idm"), dict(zip(ERRORS, (SAME, BETTER, SAME), strict=True))
    model = personal(Hypothesis((), Catalogue((), law, located=False)), law)
    own = Law(law, model, None, against)  # type: ignore[arg-type]
    values = [(p.null or p.default) * (factor if kind == name else 1.0) for kind, p in model.catalogue.of_driver]
    drivers = SimpleNamespace(model=model, theta=np.log(values) + np.zeros((5, 1)), row_group=np.arange(5))
    for null in ("IDM", LONGEST):
        text = words.law_first(own, null, drivers)  # type: ignore[arg-type]
        assert_short(text)
        wording = ALL[name].wording[factor > 1.0].replace("{law}", null)
        assert first_of(text)[1:] == f"{wording[1:]}." and "The median driver has " in text
