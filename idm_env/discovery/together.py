"""Terms that show in free simulation: added one by one by held-out score, all fitted at once, and taken back again."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from idm_env.discovery import closed_loop, judge, model as terms
from idm_env.discovery.closed_loop import ClosedLoopFit
from idm_env.discovery.model import Term
from idm_env.discovery.score import ALPHA, CLOSED_LOOP_SHARE, Tested, at_level, interval_of, westfall_young
from idm_env.discovery.search import Scored, Search
from idm_env.discovery.solve import Solution
from idm_env.discovery.verdict import Reason, Refusal
from idm_env.effects import ALL

LEAST_GAIN = 0.01
"""Least gain in the logarithm of the gap's error in free simulation, on stretches and runs that nothing has seen."""
MOST_TERMS = 5
TRIED = 2
"""How many of the best candidates of a step are fitted, until one holds."""
SAME = 0.15


@dataclass(eq=False)
class Step:
    """One step forward: every candidate, its test, and which was added; ``equivalent`` did about as well.

    ``refusal`` says why nothing was added.
    """

    scored: list[Scored]
    tested: Tested
    winner: int | None = None
    equivalent: list[int] = field(default_factory=list)
    refusal: Refusal | None = None


@dataclass(frozen=True, eq=False)
class Joined:
    """Terms fitted at once in free simulation: their solution, estimates with intervals [Q, 3], and gains [units]."""

    solution: Solution
    intervals: np.ndarray
    gains: np.ndarray


def untried(searching: Search, at: ClosedLoopFit) -> list[Term]:
    """Return every candidate without a place that the model has not."""
    have = {t.effect for t in at.model.terms}
    late = any(ALL[name].latency for name in have if name is not None)
    effects = [searching.base.catalogue.by_name[n] for n in searching.names if n not in have]
    return [terms.simple(e) for e in effects if e.sought == "anywhere" and not (late and ALL[e.name].latency)]


def grow(searching: Search, start: ClosedLoopFit, base: int, seed: int) -> tuple[Joined | None, list[Step]]:
    """Return the terms beyond the first ``base`` that hold together in free simulation, or None, and every step.

    Args:
        searching: Candidates and units of the test.
        start: The model so far.
        base: Number of terms that belong to the null.
        seed: Of the signs.
    """
    fit, solution, records = start, None, start.problem.rows.records
    steps, least = list[Step](), judge.least_m(records)
    while len(fit.model.terms) - base < MOST_TERMS:
        step, grown = _forward(searching, fit, seed)
        steps.append(step)
        if grown is None:
            break
        after = closed_loop.evaluate(records, grown.model, grown.values, fit.problem.prior, grown.theta)
        moved = after.linear.residual - fit.linear.residual
        late = is_too_short(grown, grown.model.terms[-1:], records.dt)
        if late or float(np.sqrt(np.mean(moved[after.problem.rows.valid] ** 2))) < least:
            step.winner, step.refusal = None, Refusal(Reason.SMALL_SIZE, least)
            break
        solution, fit = grown, after
    solution = solution and _backward(start, solution, base)
    if solution is None or len(solution.model.terms) == base:
        return None, steps
    return Joined(solution, interval_of(solution, start.problem), closed_loop.gains(start, solution)), steps


def _forward(searching: Search, fit: ClosedLoopFit, seed: int) -> tuple[Step, Solution | None]:
    candidates = untried(searching, fit)
    if not candidates:
        return Step([], Tested(np.zeros(0), np.zeros(0), np.zeros((0, 2)))), None
    gains, starts = zip(*(closed_loop.linear_screen(fit, term) for term in candidates), strict=True)
    scored = [Scored(term, None, gain) for term, gain in zip(candidates, gains, strict=True)]

    def test() -> Tested:
        return at_level(westfall_young(np.array([s.gains for s in scored]), seed, fit.units.run), CLOSED_LOOP_SHARE)

    tested = first = test()
    for i in [i for i in np.argsort(-first.gain) if first.p_value[i] < ALPHA and first.gain[i] >= LEAST_GAIN][:TRIED]:
        fitted = closed_loop.joint(fit, fit.model.adding(candidates[i]), np.append(fit.values, starts[i]))
        scored[i] = Scored(candidates[i], fitted, closed_loop.gains(fit, fitted))
        tested = test()
        if tested.p_value[i] < ALPHA and tested.gain[i] >= LEAST_GAIN:
            alike = (first.p_value < ALPHA) & (first.gain >= (1.0 - SAME) * first.gain[i])
            same = [j for j in np.flatnonzero(alike).tolist() if j != i]
            return Step(scored, tested, int(i), same), fitted
    return Step(scored, tested), None


def _backward(start: ClosedLoopFit, solution: Solution, base: int) -> Solution:
    """Take back terms whose interval contains their null once all are in, or that the held-out score does not miss."""
    while len(solution.model.terms) > base:
        intervals, gain = interval_of(solution, start.problem), float(closed_loop.gains(start, solution).mean())
        added = range(base, len(solution.model.terms))
        losses = {index: 0.0 for index in added if contains_null(solution, intervals, index)}
        if not losses:
            losses = {i: gain - float(closed_loop.gains(start, _without(start, solution, i)).mean()) for i in added}
        index = min(losses, key=lambda i: losses[i])
        if losses[index] >= 0.5 * LEAST_GAIN:
            break
        solution = _without(start, solution, index)
    return solution


def _without(start: ClosedLoopFit, solution: Solution, index: int) -> Solution:
    gone = solution.model.where(solution.model.terms[index].label)
    fit = replace(start, theta=solution.theta)
    return closed_loop.joint(fit, solution.model.without(index), np.delete(solution.values, gone))


def is_too_short(solution: Solution, added: Sequence[Term], dt: float) -> bool:
    """Tell whether any of the terms ``added`` is a latency below half a step (s)."""
    late = [t for t in added if t.effect is not None and ALL[t.effect].latency]
    return any(abs(float(solution.values[solution.model.where(t.label)][0])) < 0.5 * dt for t in late)


def contains_null(solution: Solution, intervals: np.ndarray, index: int) -> bool:
    """Tell whether the interval of a term's strength, in ``intervals`` [Q, 3], contains its null; a curve has none."""
    term = solution.model.terms[index]
    strengths = [(p, i) for i, p in enumerate(term.parameters) if p.role == "strength" and p.null is not None]
    if len(strengths) != 1:
        return False
    parameter, entry = strengths[0]
    _, low, high = intervals[solution.model.where(term.label)][entry]
    return bool(low <= parameter.null <= high)
