"""The strength at which an absent effect would have been found, of effects that only just could be."""

from __future__ import annotations

import numpy as np
import pytest

from idm_env.data import synthetic
from idm_env.discovery import discover
from idm_env.discovery.power import WIDTHS, strength_of
from idm_env.discovery.score import half_width

pytestmark = pytest.mark.usefixtures("two_laws")


def test_a_latency_below_one_step_is_nobody_s() -> None:
    """It becomes part of the null, so that it is never found, however sure it is."""
    found = discover(synthetic.generate(6, runs=4, followers=2, seconds=60.0)[0], effects=["lag", "drag"])
    solutions = {s.term.label: s.solution for s in found.rounds[0].scored}
    for name, least in (("lag", found.records.dt), ("drag", 0.0)):
        solution = solutions[name]
        assert solution is not None
        strength = strength_of(solution, found.problem, name)
        assert strength is not None
        (width,) = half_width(solution, found.problem)[solution.model.where(name)]
        assert strength.seen == pytest.approx(least + WIDTHS * width)
        wander = found.problem.noise.wander  # type: ignore[union-attr]
        wide = 0.5 * (strength.high - strength.low)
        assert wide == pytest.approx(np.hypot(width, 1.96 * (0.01 + wander) * strength.typical))
