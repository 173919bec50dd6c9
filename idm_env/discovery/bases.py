"""How other car-following laws do on the same data: each alone, calibrated and judged like the completed one."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

from idm_env.discovery.compare import Comparison, Light, compare
from idm_env.discovery.judge import Judged
from idm_env.discovery.march import Catalogue
from idm_env.discovery.model import Model
from idm_env.discovery.solve import Solution
from idm_env.discovery.verdict import mean_ratio
from idm_env.effects import BASES, CarFollowing, base_named


class Law(NamedTuple):
    """A law alone: drivers' parameters, its errors on runs kept back, and how these compare with the null's."""

    law: CarFollowing
    solution: Solution
    errors: Judged
    against: dict[str, Comparison]

    @property
    def is_better(self) -> bool:
        """Whether an error is lower beyond chance and none higher, and they are lower on the whole."""
        lights = [c.light for c in self.against.values()]
        return Light.BETTER in lights and Light.WORSE not in lights and self.mean_ratio < 1.0

    @property
    def mean_ratio(self) -> float:
        """Geometric mean of the ratios of errors to those of the null; 1 for the null."""
        return mean_ratio(self.against)


def compared(
    null: Model, first: tuple[Solution, Judged], judged: Callable[[Model], tuple[Solution, Judged]], seed: int,
    on_law: Callable[[int, int, str], None],
) -> list[Law]:  # fmt: skip
    """Return all laws, that of the null first.

    Args:
        null: The law that is completed, with what is known beside it.
        first: What ``judged`` says of it.
        judged: Calibrates and judges a model.
        seed: Of the bootstrap.
        on_law: Called before each with its number, how many there are, and its title.
    """
    own = null.catalogue.base
    laws = [Law(own, *first, {})]
    others = [base_named(name) for name in BASES if name != own.kind]
    for i, law in enumerate(others):
        on_law(1 + i, 1 + len(others), law.title)
        found = judged(Model(null.terms, Catalogue(tuple(null.named), law, located=False)))
        laws.append(Law(law, *found, compare(first[1], found[1], seed)))
    return laws


def best_of(laws: Iterable[Law]) -> Law:
    """Return the law that predicts best of those that are better than the null, or the null."""
    first, *others = laws
    return min((law for law in others if law.is_better), key=lambda law: law.mean_ratio, default=first)


def rows(laws: Iterable[Law]) -> list[dict[str, Any]]:
    """Return what a report says of laws: errors, and ``against`` the first the ratio, its interval, and a word."""
    return [
        {
            "base": each.law.kind, "title": each.law.title or each.law.kind, "equation": each.law.equation,
            **{key: _finite(x) for key, x in each.errors.summary().items()},
            "against": {
                key: {
                    "verdict": c.light.value, "ratio": _finite(c.ratio), "low": _finite(c.low), "high": _finite(c.high),
                }
                for key, c in each.against.items()
            },
        }
        for each in laws
    ]  # fmt: skip


def _finite(x: float) -> float | None:
    return x if math.isfinite(x) else None
