"""What data say of the strength of an absent effect, and whether most usual ones would have been found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from idm_env.discovery.score import ALPHA, SYSTEMATIC, Tested, half_width
from idm_env.discovery.solve import Problem, Solution
from idm_env.effects import ALL
from idm_env.parameters import Parameter

WIDTHS = 2.9
"""Half-widths of a 95 % interval at which a strength is taken to be found four times in five: 1 + 0.84/1.96 for one
candidate, and twice that for a whole list of them, held-out gains and the test set."""
BIAS = 1.0
"""Share of the usual strength by which an absent one is off for every m/s that drivers' noise moves the speed.

Noise passes for a weaker pull: of clean sets with 0.1 and 0.2 m/s² stiffness is off by 0.14 and 0.36 of it.
"""


@dataclass(frozen=True)
class Strength:
    """What data say of an absent effect's strength: estimate, its 95 % interval, and what would have been found.

    ``seen`` is ``WIDTHS`` half-widths; ``typical`` is the distance of the catalogue's default from the null. Of an
    unknown profile, with a strength at each of its ``knots``, ``estimate`` is that furthest from the null, with the
    interval of all.
    """

    parameter: Parameter
    estimate: float
    low: float
    high: float
    seen: float
    typical: float
    knots: int = 1


def strength_of(solution: Solution, problem: Problem, label: str) -> Strength | None:
    """Return the strength of a term that has one, or only such, else None."""
    where = solution.model.where(label)
    parameters = solution.model.parameters[where]
    strengths = [i for i, p in enumerate(parameters) if p.null is not None and p.role == "strength"]
    if not strengths or 1 < len(strengths) < len(parameters):
        return None
    entries = where.start + np.array(strengths)
    estimate, p = solution.values[entries], parameters[strengths[0]]
    assert p.null is not None
    term = next(t for t in solution.model.terms if t.label == label)
    typical = abs(p.default - p.null) if len(strengths) == 1 else term.smoothness
    width = half_width(solution, problem)[entries]
    # What averages do not remove is there without the effect, too.
    wander = 0.0 if problem.noise is None else problem.noise.wander
    wide = np.hypot(width, 1.96 * (SYSTEMATIC + BIAS * wander) * typical)
    furthest = float(estimate[np.abs(estimate - p.null).argmax()])
    low, high = float((estimate - wide).min()), float((estimate + wide).max())
    seen = WIDTHS * float(np.median(width))
    if term.effect is not None and ALL[term.effect].latency:
        # A latency that comes out below one step of the data becomes part of the null.
        seen += problem.rows.records.dt
    return Strength(p, furthest, low, high, seen, typical, len(strengths))


PROMISING = 0.02
"""Mean gain in log RMSE on held-out units that is no sign of nothing, significant or not."""


def powerful(strengths: Sequence[Strength], tested: Tested, smallest: float) -> bool:
    """Tell whether most effects of the catalogue would have been found at their typical strengths.

    Not where units are so few that their ``smallest`` p-value leaves no room, or a gain is large without being beyond
    chance.
    """
    seen = bool(strengths) and float(np.mean([s.seen <= s.typical for s in strengths])) >= 0.5
    return seen and smallest <= 0.4 * ALPHA and bool(tested.gain.max(initial=0.0) < PROMISING)
