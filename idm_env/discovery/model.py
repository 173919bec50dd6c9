"""Candidates: which entries of φ an effect has, where its search starts, and the effects that a finding becomes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from itertools import accumulate, product
from typing import Any

import numpy as np

from idm_env import effects as catalogue
from idm_env.discovery import march
from idm_env.discovery.march import Catalogue
from idm_env.discovery.records import Records
from idm_env.effects import Effect
from idm_env.effects.free import HISTORY
from idm_env.parameters import Parameter


@dataclass(frozen=True)
class Term:
    """One effect as discovery varies it: entries of φ with declarations, and the slot of its curve, if it has one.

    ``effect`` is the catalogue's name or None for what is only located; ``what`` and ``coordinate`` say what changes
    and over which coordinate; ``form`` is NONE, CURVE or INTERVAL; ``knots`` (first, distance, count) of a curve.
    ``starts`` are values of all parameters to start a search from; ``made`` is the effect with its static choices. A
    curve that ``fades`` is nothing from a knot's distance beyond its ends on: nobody was seen there. ``by`` a
    state it is proportional to that. Knots that are ``pinned`` stay 0: drivers' own parameters do the same.
    """

    label: str
    effect: str | None
    parameters: tuple[Parameter, ...]
    starts: tuple[tuple[float, ...], ...]
    what: str = ""
    coordinate: str = ""
    form: int = march.NONE
    knots: tuple[float, float, int] = (0.0, 1.0, 2)
    period: float = 0.0
    profile: tuple[float, ...] | None = None
    smoothness: float = 0.0
    made: Effect | None = None
    fades: bool = False
    by: str = ""
    pinned: tuple[int, ...] = ()

    @property
    def name(self) -> str:
        """Name in the catalogue, or the label of what has none."""
        return self.effect or self.label

    @property
    def size(self) -> int:
        """Number of parameters."""
        return len(self.parameters)

    @property
    def located(self) -> bool:
        """Whether this is a curve or an interval without a name, which takes a slot of the loop."""
        return self.effect is None

    @property
    def past(self) -> bool:
        """Whether this is a curve over a feature of the past."""
        return self.located and self.coordinate in HISTORY

    @property
    def cycles(self) -> bool:
        """Whether this is a curve over the phase of a period."""
        return self.located and self.coordinate == "time" and self.period > 0.0

    def entries(self, catalogue: Catalogue, table: str) -> list[int]:
        """Return the places in φ of the parameters; ``table`` is the effect's or the slot's."""
        if self.form == march.NONE or self.profile is not None:
            return [catalogue.index[f"{self.effect}.{p.name}"] for p in self.parameters]
        row = catalogue.table_at(table)
        if self.form == march.INTERVAL:
            return [row + 4, row, row + 1][: self.size]
        return [row + 4 + self.fades + i for i in range(self.size)]

    @property
    def drawn(self) -> tuple[float, float, int]:
        """First knot, distance and count of the curve with the knots at which it has faded."""
        first, distance, count = self.knots
        return (first - distance, distance, count + 2) if self.fades else self.knots


@dataclass(frozen=True)
class Hypothesis:
    """Terms that are in the model, in the order of adding, and the catalogue whose loop rolls it out."""

    terms: tuple[Term, ...] = ()
    catalogue: Catalogue = field(default_factory=march.default_catalogue)
    fixed_phi: np.ndarray | None = None
    """φ that stands [F] or [G, F], so that only the drivers' own parameters are left to fit."""
    entries: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        entries: list[int] = []
        for term, slot in self._slots if self.fixed_phi is None else ():
            entries += term.entries(self.catalogue, slot)
        object.__setattr__(self, "entries", np.array(entries, dtype=np.int64))

    @property
    def _slots(self) -> list[tuple[Term, str]]:
        """Terms with the names of their tables: the effect's, or the slot of one without a name."""
        now, past = ([t for t in self.terms if t.located and t.past is p] for p in (False, True))
        if len(now) > march.SLOTS or len(past) > 1:
            raise ValueError(
                f"a model can have {march.SLOTS} effects without a name and one more over the past, and {len(now)} and "
                f"{len(past)} were given."
            )
        slots = iter(map(str, range(march.SLOTS)))
        return [(t, t.effect or (march.PAST if t.past else next(slots))) for t in self.terms]

    def adding(self, term: Term) -> Hypothesis:
        """Return the model with one term more."""
        return Hypothesis((*self.terms, term), self.catalogue)

    def without(self, index: int) -> Hypothesis:
        """Return the model without a term."""
        return Hypothesis(self.terms[:index] + self.terms[index + 1 :], self.catalogue)

    def fixed(self, values: np.ndarray) -> Hypothesis:
        """Return the model with φ as the values [Q] or [G, Q] of its parameters give it, the same for all copies."""
        return replace(self, fixed_phi=self.phi(values))

    def where(self, label: str) -> slice:
        """Return which entries are those of the term ``label``."""
        index = [t.label for t in self.terms].index(label)
        begin = sum(t.size for t in self.terms[:index])
        return slice(begin, begin + self.terms[index].size)

    @cached_property
    def bare(self) -> Hypothesis:
        """The law alone with a loop of its own, which does not ask for absent effects: half the time of a step."""
        return Hypothesis((), replace(self.catalogue, effects=(), located=False))

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Declarations of all entries."""
        return () if self.fixed_phi is not None else tuple(p for term in self.terms for p in term.parameters)

    @property
    def named(self) -> list[Effect]:
        """Effects of the terms that have a name."""
        return [self.catalogue.by_name[t.effect] for t in self.terms if t.effect is not None]

    @property
    def on(self) -> np.ndarray:
        """Flags [effects] of those that are at work."""
        on = np.zeros(len(self.catalogue.flags), np.int8)
        for term, slot in self._slots:
            name = term.effect or self.catalogue.shape(term.what, term.coordinate, slot)[0]
            on[self.catalogue.flags[name]] = 1
        return on

    @property
    def tables(self) -> np.ndarray:
        """Form, number of knots and place in φ of every table [tables, 3]."""
        tables = np.array([(march.NONE, 2, self.catalogue.table_at(n)) for n in self.catalogue.tables], np.int64)
        for term, slot in self._slots:
            if term.form != march.NONE:
                tables[self.catalogue.tables[slot], :2] = term.form, term.drawn[2]
        return tables

    def phi(self, values: np.ndarray) -> np.ndarray:
        """Return φ from the values of all parameters [..., Q]."""
        values = np.asarray(values, float)
        if self.fixed_phi is not None:
            return np.broadcast_to(self.fixed_phi, (*values.shape[:-1], self.fixed_phi.shape[-1]))
        phi = np.tile(self.catalogue.null, (*values.shape[:-1], 1))
        for term, slot in self._slots:
            if term.form == march.NONE:
                continue
            row = self.catalogue.table_at(slot)
            phi[..., row + 3] = term.period
            if term.form == march.CURVE:
                phi[..., row], phi[..., row + 1] = term.drawn[0], 1.0 / term.drawn[1]
                if term.profile is not None:
                    phi[..., row + 4 : row + 4 + len(term.profile)] = term.profile
            else:
                phi[..., row + 2] = EDGES[term.coordinate]
            if term.located:
                for name, weight in self.catalogue.shape(term.what, term.coordinate, slot, term.by)[1].items():
                    phi[..., self.catalogue.index[name]] = weight
        phi[..., self.entries] = values
        return phi


SPREAD = 0.3
"""Prior width of a curve's knots, in units of what it changes: m/s², or relative."""
STATES = {"speed": 3.0, "gap": 4.0, "closing_speed": 1.0, "lead_accel": 0.4, "relative_gap": 0.2}
STATES |= {"time_since_stop": 10.0, "mean_speed_20s": 3.0, "mean_speed_90s": 3.0}
STATES |= {"braking_15s": 0.4, "lead_braking_15s": 0.4, "own_accel": 0.4, "lead_trend": 1.0, "lead_change_3s": 1.0}
STATES |= {"headway_behind": 0.5, "gap_behind": 4.0, "second_opening": 0.7}
"""Coordinates of the state, with the distance of a curve's knots: it ends where nobody was seen."""
EDGES = {"position": 5.0, "time": 0.5, "speed": 0.5, "gap": 1.0, "closing_speed": 0.2, "lead_accel": 0.1}
"""Half-width over which an interval of a located effect sets in."""


def simple(effect: str | Effect) -> Term:
    """Return the term of an effect that needs no place; one start for every mix of its parameters'."""
    one = catalogue.make(effect) if isinstance(effect, str) else effect
    parameters = tuple(_searched(p) for p in one.parameters)
    starts = tuple(product(*(_starts(p) for p in parameters)))
    period = float(getattr(one, "period", None) or 0.0)
    return Term(one.name, one.name, parameters, starts, what=one.acts_on, coordinate="state", period=period, made=one)


def personal(effect: str | Effect) -> Term:
    """Return the term of an effect whose strengths are each driver's own: its catalogue has them among θ."""
    return replace(simple(effect), parameters=(), starts=((),))


def _starts(p: Parameter) -> tuple[float, ...]:
    """Return where the search of a parameter starts: as declared; a strength else from a quarter of its default."""
    if p.starts or p.role == "threshold":
        return p.starts or (0.5 * p.default, p.default)
    return (p.default if p.null is None else p.null + 0.25 * (p.default - p.null),)


def _searched(p: Parameter) -> Parameter:
    """Return the declaration with the bounds of the search."""
    if p.searched is None:
        return p
    low, high = p.searched
    return replace(p, low=low, high=high, default=min(max(p.default, low), high))


def placed(effect: str | Effect, *values: float, period: float = 0.0) -> Term:
    """Return the term of an effect that acts in one interval of places or from one moment on: strength, then places."""
    one = catalogue.make(effect) if isinstance(effect, str) else effect
    coordinate = {"interval": "position", "step": "time"}[one.sought]
    where: dict[str, Any] = {"what": one.acts_on, "coordinate": coordinate, "period": period}
    return Term(one.name, one.name, one.parameters, (values,), made=one, **where)


def unknown_profile(effect: str | Effect, first: float, distance: float, count: int, period: float) -> Term:
    """Return an effect whose profile over position is not known: one parameter at every knot."""
    one = catalogue.make(effect) if isinstance(effect, str) else effect
    knots = tuple(first + distance * i for i in range(count))
    declared = replace(one, knots=knots).parameters  # type: ignore[call-arg]
    parameters = tuple(replace(p, default=0.0) for p in declared)
    shape: dict[str, Any] = {"what": one.acts_on, "coordinate": "position", "form": march.CURVE, "period": period}
    shape |= {"knots": (first, distance, count), "smoothness": abs(one.strength_of(SPREAD))}
    return Term(one.name, one.name, parameters, ((0.0,) * count,), made=one, **shape)


def known_profile(effect: str | Effect, first: float, distance: float, profile: Sequence[float], period: float) -> Term:
    """Return an effect whose profile over position is known: its parameters are what drivers make of it."""
    places = tuple(first + distance * i for i in range(len(profile)))
    kind = effect if isinstance(effect, str) else effect.kind
    one = catalogue.make(kind, knots=places, profile=tuple(profile))
    starts = tuple(product(*(_starts(p) for p in one.parameters)))
    shape: dict[str, Any] = {"what": "share", "coordinate": "position", "form": march.CURVE, "period": period}
    shape |= {"knots": (first, distance, len(profile)), "profile": tuple(profile)}
    return Term(one.name, one.name, one.parameters, starts, made=one, **shape)


def given_profile(effect: Effect) -> Term:
    """Return the term of an effect that has its profile already."""
    knots, profile = effect.knots, effect.profile  # type: ignore[attr-defined]
    return known_profile(effect, knots[0], knots[1] - knots[0], profile, float(effect.period or 0.0))  # type: ignore[attr-defined]


def known_effect(term: Term) -> Effect:
    """Return the effect of a term whose profile is known."""
    first, distance, count = term.knots
    return _made(term, tuple(float(first + distance * i) for i in range(count)))


def interval(what: str, coordinate: str, begin: float, end: float, amount: float, period: float = 0.0) -> Term:
    """Return an unnamed change of ``what`` inside one interval of a coordinate."""
    unit = "m/s²" if what == "acceleration" else "1"
    size = (-5.0, 5.0) if what == "acceleration" else (-0.9, 3.0)
    along = {"position": "m", "time": "s", "speed": "m/s", "gap": "m"}.get(coordinate, "m/s")
    parameters = (
        Parameter("amount", "k", unit, 0.0, *size, null=0.0),
        Parameter("begin", "x1", along, 0.0, -1e7, 1e7, role="place"),
        Parameter("end", "x2", along, 1.0, -1e7, 1e7, role="place"),
    )
    where: dict[str, Any] = {"what": what, "coordinate": coordinate, "form": march.INTERVAL, "period": period}
    return Term(f"{what} over {coordinate}", None, parameters, ((amount, begin, end),), **where)


def curve(
    what: str, coordinate: str, first: float, distance: float, count: int, period: float = 0.0, label: str = "",
    by: str = "",
) -> Term:  # fmt: skip
    """Return an unnamed piecewise-linear change of ``what`` over a coordinate, proportional to the state ``by``."""
    label = label or f"{what} curve over {coordinate}" + (f" by {by}" if by else "")
    nearest: tuple[int, ...] = ()
    if (what, coordinate, by) == ("time_gap", "closing_speed", ""):
        # A straight line in Δv is another braking b, and without pins only a kink would be known of the curve.
        nearest = tuple(sorted(range(count), key=lambda i: abs(first + distance * i))[:2])
    unit = "m/s²" if what == "acceleration" else "1"
    size = (-5.0, 5.0) if what == "acceleration" else (-0.9, 3.0)
    parameters = tuple(Parameter(f"knot_{i}", f"c{i}", unit, 0.0, *size, null=0.0) for i in range(count))
    where: dict[str, Any] = {"what": what, "coordinate": coordinate, "period": period, "by": by}
    where |= {"form": march.CURVE, "knots": (first, distance, count), "pinned": nearest}
    soft = 0.3 if what == "acceleration" else 0.5
    return Term(label, None, parameters, ((0.0,) * count,), smoothness=soft, fades=coordinate in STATES, **where)


NEIGHBOURS = {"second leader": "second", "vehicle behind": "behind", "vehicle in an adjacent lane": "beside"}
"""Column of the records that says when a neighbour is there."""


def testable(records: Records, effects: Sequence[Effect]) -> dict[str, str]:
    """Return by name which effects cannot be tested, and why: the data do not show them, or no loop can have them."""
    refused = {}
    for effect in effects:
        if effect.beyond in NEIGHBOURS:
            column = march.COLUMNS.index(f"{NEIGHBOURS[effect.beyond]}_present")
            if records.signals[:, column].mean() < 0.02:
                refused[effect.name] = f"no {effect.beyond} is measured"
        if effect.sought == "given" and not any(effect.column in e.columns for e in records.episodes):
            refused[effect.name] = f"the file has no column {effect.column}"
        if effect.sought in ("profile", "interval", "step") and effect.acts_on not in march.PULSED:
            refused[effect.name] = (
                f"an effect that is sought at places or times must say which of {', '.join(march.PULSED)} it changes, "
                f"and acts_on = '{effect.acts_on}'"
            )
        unknown = effect.name not in refused and effect.kind not in catalogue.PACKAGED
        if unknown and (why := march.why_not_recorded(effect, records.dt)):
            refused[effect.name] = why
    return refused


def effects_of(model: Hypothesis, values: np.ndarray) -> tuple[list[Effect], dict[str, dict[str, float]]]:
    """Return the simulator's effects of a model's terms with values [Q], and their parameters as numbers."""
    effects: list[Effect] = []
    numbers: dict[str, dict[str, float]] = {}
    begin = 0
    for term in model.terms:
        mine = np.asarray(values[begin : begin + term.size], float)
        begin += term.size
        for effect, strengths in _effects(term, mine):
            number = 1
            while effect.name in numbers:  # rounds may add one quantity over one coordinate with other knots
                number += 1
                effect = replace(effect, number=number)  # type: ignore[call-arg] # names are twice in curves only
            effects.append(effect)
            numbers[effect.name] = strengths
    return effects, numbers


def _effects(term: Term, values: np.ndarray) -> list[tuple[Effect, dict[str, float]]]:
    names = [p.name for p in term.parameters]
    if term.form == march.NONE:
        assert term.effect is not None
        return [(_made(term), dict(zip(names, map(float, values), strict=True)))]
    period = term.period or None
    if term.form == march.INTERVAL:
        amount, begin, end = values
        edge = EDGES[term.coordinate]
        middle = max(begin + edge, end - edge)
        knots = tuple(float(k) for k in (begin - edge, begin + edge, middle, max(end, begin) + edge))
        knots = tuple(accumulate(knots, lambda before, k: max(k, before + 1e-6)))
        heights = [0.0, amount, amount, 0.0]
    else:
        first, distance, count = term.drawn
        knots = tuple(float(first + distance * i) for i in range(count))
        heights = [0.0, *values, 0.0] if term.fades else list(values)
    if term.effect is not None:
        numbers = values if term.profile is not None else heights
        return [(_made(term, knots), dict(zip(names, map(float, numbers), strict=True)))]
    strengths = {f"knot_{i}": float(h) for i, h in enumerate(heights)}
    if term.what == "acceleration":
        return [(catalogue.Curve(feature=term.coordinate, knots=knots, period=period, by=term.by), strengths)]
    targets = {"accel_and_decel": ("max_accel", "comfort_decel")}.get(term.what, (term.what,))
    return [
        (catalogue.DriverCurve(target=t, feature=term.coordinate, knots=knots, period=period, by=term.by), strengths)  # type: ignore[arg-type]
        for t in targets
    ]


def _made(term: Term, knots: tuple[float, ...] | None = None) -> Effect:
    """Return the effect of a named term: on its lap, and with the knots and the profile of its curve."""
    assert term.made is not None
    choices: dict[str, object] = {}
    if knots is not None:
        choices |= {"knots": knots}
        if any(f.name == "profile" for f in fields(term.made)):
            choices |= {"profile": term.profile}
    if any(f.name == "period" for f in fields(term.made)):
        choices["period"] = term.period or None
    return replace(term.made, **choices)  # type: ignore[arg-type]
