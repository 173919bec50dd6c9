"""How other car-following laws do on the same data: each alone, calibrated and judged like the completed one.

One of them is there once more, with the strengths of effects that are each driver's own.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

from idm_env.discovery import model as terms
from idm_env.discovery.compare import Comparison, ErrorChange, changes, compare
from idm_env.discovery.judge import Judged
from idm_env.discovery.march import Catalogue
from idm_env.discovery.model import Hypothesis
from idm_env.discovery.result import LawErrors
from idm_env.discovery.verdict import improves, mean_ratio
from idm_env.effects import ALL, BASES, CarFollowing, base_named, make

OnLaw = Callable[[int, int, str], None]
"""Called with how many laws are done, of how many, and the name of the last."""
LEAST = 0.03
"""Least fall of the geometric mean of the errors for which a law is named first: it is chosen among several."""


class Law(NamedTuple):
    """A law alone: its model, its errors where it was not calibrated, and how these compare with the null's."""

    law: CarFollowing
    model: Hypothesis
    errors: Judged
    against: dict[str, Comparison]

    @property
    def own(self) -> tuple[str, ...]:
        """Effects whose strengths are each driver's own."""
        return self.model.catalogue.personal

    @property
    def parameters(self) -> int:
        """Number of parameters that every driver has of his own."""
        return len(self.model.catalogue.own) - len(self.model.catalogue.without)

    @property
    def at_bounds(self) -> dict[str, int]:
        """How many drivers have each of these parameters at a bound, in a half of their time; none if not judged."""
        return {} if self.errors.theta is None else self.model.catalogue.at_bounds(self.errors.theta)

    @property
    def title(self) -> str:
        """Plain name."""
        title = self.law.title or self.law.kind
        if self.model.catalogue.without:
            return f"{title} without {' and '.join(self.model.catalogue.without).replace('_', ' ')}"
        return f"{title} with own strengths" if self.own else title

    @property
    def horizon_change(self) -> ErrorChange:
        """How it predicts 5 s ahead beside the null."""
        return self.against["horizon_rmse_m"].outcome

    @property
    def is_better(self) -> bool:
        """Whether it holds as an addition must, and all errors are lower by ``LEAST`` on the whole.

        With more parameters of the drivers' own it must predict 5 s ahead better beyond chance, by the pooled error: in
        closed loop, and in the mean driver, these may only spread a driver's noise over more of them.
        """
        return (not self.own or self.against["horizon_rmse_m"].high < 1.0) and lowers(self.against)

    @property
    def mean_ratio(self) -> float:
        """Geometric mean of the ratios of errors to those of the null; 1 for the null."""
        return mean_ratio(self.against)


def lowers(against: Mapping[str, Comparison]) -> bool:
    """Tell whether errors hold as those of an addition must, and are lower by ``LEAST`` on the whole."""
    return improves(against) and mean_ratio(against) < 1.0 - LEAST


def compared(
    null: Hypothesis, first: Judged, judged: Callable[[Hypothesis], Judged], seed: int, on_law: OnLaw
) -> list[Law]:
    """Return all laws, that of the null first.

    Args:
        null: The law that is completed, with what is known beside it.
        first: Its errors.
        judged: Calibrates and judges a model, as the null was.
        seed: Of the bootstrap.
        on_law: Called before each with its number, how many there are, and its title.
    """
    own, named = null.catalogue.base, tuple(null.named)
    laws = [Law(own, null, first, {})]

    def add(model: Hypothesis) -> None:
        law = model.catalogue.base
        on_law(len(laws), len(laws) + 1, law.title)
        errors = judged(model)
        laws.append(Law(law, model, errors, compare(first, errors, seed)))

    for name in BASES:
        if name != own.kind:
            add(Hypothesis(null.terms, Catalogue(named, base_named(name), located=False)))
    # Whether a part of a law does the work, or all of it, is told beside it.
    for each in laws[1:]:
        for name in each.law.spared if each.horizon_change is ErrorChange.BETTER or each.is_better else ():
            add(Hypothesis(null.terms, replace(each.model.catalogue, without=(name,))))
    # A better law comes first: what it lacks is sought, before anything is put down to its drivers. Else the best of
    # those with the null's parameters is treated as the null is, if it is no worse, and all where that helps.
    alike = [] if best_of(laws).against else [each for each in laws[1:] if each.law.declared == own.declared]
    add(personal(null, own))
    for i, each in enumerate(sorted(alike, key=lambda law: law.mean_ratio)):
        if best_of(laws).against or (i == 0 and each.horizon_change is not ErrorChange.WORSE):
            add(personal(null, each.law))
    return laws


def personal(null: Hypothesis, law: CarFollowing) -> Hypothesis:
    """Return a law in the null's place, with all effects whose strengths may be each driver's own."""
    named = {e.name for e in null.named}
    effects = tuple(make(name) for name, cls in ALL.items() if cls.per_driver and name not in named)
    own = Catalogue((*null.named, *effects), law, located=False, personal=tuple(e.name for e in effects))
    return Hypothesis((*null.terms, *(terms.personal(e) for e in effects)), own)


def best_of(laws: Iterable[Law]) -> Law:
    """Return the law that predicts best of those that are better than the null, or the null."""
    first, *others = laws
    return min((law for law in others if law.is_better), key=lambda law: law.mean_ratio, default=first)


def rows(laws: Iterable[Law]) -> list[LawErrors]:
    """Return the rows of a report's table of laws."""
    rows = []
    for each in laws:
        names = each.law.kind, each.title, each.law.equation, list(each.own), list(each.model.catalogue.without)
        bounds = {name: n for name, n in each.at_bounds.items() if n}
        errors: Any = each.errors.summary()
        rows.append(LawErrors(*names, each.parameters, bounds, **errors, against=changes(each.against)))
    return rows
