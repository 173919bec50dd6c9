"""How other car-following laws do on the same data: each alone, calibrated and judged like the completed one."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from idm_env.discovery import judge, search
from idm_env.discovery.compare import compare
from idm_env.discovery.march import Catalogue
from idm_env.discovery.model import Frozen, Model
from idm_env.discovery.records import Records, whole
from idm_env.discovery.solve import Solution, Task, solve
from idm_env.effects import BASES, CarFollowing, base_named


def judged(law: CarFollowing, null: Solution, fit: Records, kept: Records, adapt: bool) -> judge.Judged:
    """Return a law's errors on the runs kept back, with what the null has beside its own law, as it stands there.

    Drivers' spread is estimated on the runs that fit, in free simulation, and is the prior for those kept back. With
    ``adapt`` their parameters come from every other block of time than what is scored; without it groups keep the
    parameters of the runs that fit.
    """
    model, values = Model(null.model.terms, Catalogue(tuple(null.model.named), law, located=False)), null.values
    weak, rows = search.first_prior(law), whole(fit).settled()
    task = Task(rows, None, weak)
    centre = np.tile(weak.centre, (task.groups, 1))
    first = solve(task, Frozen(model, values), centre, np.zeros(0), iterations=15, tolerance=1e-3)
    prior = replace(search.population(first.theta, rows, law), alike_s=null.prior.alike_s)
    own = None if adapt else judge.calibrate(fit, model, values, prior, start=first.theta).theta
    return judge.judge(kept, model, values, prior, own, adapt)


def compared(
    null: Solution, fit: Records, kept: Records, *, adapt: bool, seed: int, on_law: Callable[[int, int, str], None]
) -> list[dict[str, Any]]:
    """Return one row per law, that of the null first: its errors, and how they compare with those of the first.

    ``against`` has for every error the ratio with its 95 % interval and ``better``, ``same`` or ``worse``.
    """
    law = null.model.catalogue.base
    others = [base_named(name) for name in BASES if name != law.kind]
    rows: list[dict[str, Any]] = []
    reference: judge.Judged | None = None
    for i, each in enumerate((law, *others)):
        on_law(i, 1 + len(others), each.title)
        found = judged(each, null, fit, kept, adapt)
        reference = found if reference is None else reference
        rows.append({
            "base": each.kind, "title": each.title or each.kind, "equation": each.equation,
            **{key: _finite(x) for key, x in found.summary().items()},
            "against": {
                key: {
                    "verdict": c.light.value, "ratio": _finite(c.ratio), "low": _finite(c.low), "high": _finite(c.high),
                }
                for key, c in (compare(reference, found, seed).items() if found is not reference else ())
            },
        })  # fmt: skip
    return rows


def _finite(x: float) -> float | None:
    return x if math.isfinite(x) else None
