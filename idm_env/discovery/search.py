"""One round of the search: the null, every candidate fitted behind it, and what each gains on held-out runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np

from idm_env.discovery import calibrate, judge, model as terms, noise as noises, places
from idm_env.discovery.calibrate import population
from idm_env.discovery.closed_loop import ClosedLoopFit
from idm_env.discovery.march import PULSED
from idm_env.discovery.model import Hypothesis, Term
from idm_env.discovery.score import held_out, log_gain
from idm_env.discovery.solve import Linear, Problem, Solution, finish, projected, solve
from idm_env.discovery.units import Units, units
from idm_env.effects import Effect
from idm_env.effects.base import Sought
from idm_env.effects.free import PER
from idm_env.jobs.progress import OnProgress

FAINT = 0.002
"""Share of the squared error, at best on the very data, below which a candidate is fitted in one step only."""
NEAR, RACED = 0.3, 3
"""Starts whose share is that near the best one's are fitted, so many at most; so are candidates to the end."""
WORTH = 0.01
"""Linear gain in log RMSE from which a located candidate is worth a nested fit, or ``NEAR`` that of the best name."""


@dataclass(frozen=True, eq=False)
class Scored:
    """A candidate: its best solution, or None where only its linear response was scored, and gains [units]."""

    term: Term
    solution: Solution | None
    gains: np.ndarray
    honest: np.ndarray | None = None


@dataclass(eq=False)
class Search:
    """The state of a search on the validation runs."""

    problem: Problem
    names: Sequence[str]
    located: bool
    on_progress: OnProgress
    base: Hypothesis = field(default_factory=Hypothesis)
    calibrations: dict[tuple[int, bytes, bytes | None], ClosedLoopFit] = field(default_factory=dict)
    """What ``calibrated`` has said, by model (held here, so that its id stays its), φ and log θ to begin with."""
    squares: dict[Solution, np.ndarray] = field(default_factory=dict)
    """What ``closed_loop_squares`` has said."""
    unplaced: dict[str, str] = field(default_factory=dict)
    """Effects that were sought at places or times and had none to be tried at, and why."""

    @property
    def units(self) -> Units:
        """What a test counts."""
        return units(self.problem.rows.records)

    def null(self, model: Hypothesis, theta: np.ndarray, values: np.ndarray) -> Solution:
        """Fit a null and its noise in turn until both stand, from log θ [G, P] and φ [Q]; updates ``problem``."""
        solution = solve(self.problem, model, theta, values)
        for _ in range(3):
            self.problem = self._renoised(solution)
            solution = solve(self.problem, model, solution.theta, solution.values, iterations=6)
        return solution

    def weighed(self, now: Solution) -> tuple[ClosedLoopFit, Solution]:
        """Evaluate a model of windows in free simulation of the validation runs; return that, and it with that prior.

        In windows its drivers stay as they are. The weight of the prior becomes that of the problem.
        """
        fit = self.calibrated(now.model, now.values, now.theta)
        prior = fit.problem.prior
        mine = replace(self.problem.prior, error_correlation_s=prior.error_correlation_s)
        self.problem = replace(self.problem, prior=mine)
        return fit, replace(now, prior=prior)

    def calibrated(self, model: Hypothesis, values: np.ndarray, start: np.ndarray | None = None) -> ClosedLoopFit:
        """Return a model with values [Q] calibrated on the validation runs, done once for one ``start`` [G, P]."""
        key = (id(model), values.tobytes(), None if start is None else start.tobytes())
        if key not in self.calibrations:
            self.calibrations[key] = calibrate.calibrate(self.problem.rows.records, model, values, start)
        return self.calibrations[key]

    def closed_loop_squares(self, now: Solution) -> np.ndarray:
        """Return squared gap errors (m²) of closed-loop simulation of the validation runs [units]."""
        if now not in self.squares:
            self.squares[now] = judge.closed_loop_squares(self.problem.rows.records, now)
        return self.squares[now]

    def _renoised(self, solution: Solution) -> Problem:
        errors = self.problem.errors(solution.theta[None], solution.model, solution.values[None])[0]
        noise = noises.estimate(errors, self.problem.rows.joined)
        prior = population(solution.theta, self.problem.rows, solution.model.catalogue.own)
        prior = replace(prior, error_correlation_s=self.problem.prior.error_correlation_s)
        return replace(self.problem, noise=noise, prior=prior)

    def round(self, solution: Solution, number: int, first: bool = True) -> list[Scored]:
        """Score every candidate on top of ``solution``.

        Shapes are sought in the ``first`` round only: beside an effect, a curve is what that one lacks of the true one.
        Beside a shape only surfaces over its state and another are tried.
        """
        if not first and (shape := solution.model.terms[-1]).fades:
            self.on_progress(f"round {number}", 0, 1, f"{shape.label} by another state")
            before = held_out(self.problem, solution)
            responses = places.respond(self.problem, solution)
            others = [state for state in PER if state != shape.coordinate]
            # With the shape, a surface over both.
            by = [terms.curve(shape.what, shape.coordinate, *shape.knots, by=state) for state in others]
            return self._curves(solution, responses, before, by)
        have = {t.label for t in solution.model.terms}
        before = held_out(self.problem, solution)
        untried = [terms.simple(e) for e in self._sought("anywhere") if e.name not in have]
        untried += [terms.given_profile(e) for e in self._sought("given") if e.name not in have]
        scored: list[Scored] = []
        responses = places.respond(self.problem, solution)
        promises = [(t, self._promise(solution, t)) for t in untried]
        # What promises most comes first: all others need not be fitted to the end where they stay far behind it.
        for i, (term, promise) in enumerate(sorted(promises, key=lambda pair: -pair[1][0].max())):
            self.on_progress(f"round {number}", i, len(untried) + 1, term.label)
            scored.append(self._nested(solution, term, before, worth=_worth(scored), promise=promise))
        self.on_progress(f"round {number}", len(untried), len(untried) + 1, "places, times and shapes")
        scored += self._places(solution, responses, before, first, max(_worth(scored), WORTH))
        return scored

    def again(self, solution: Solution, best: Scored, scored: list[Scored]) -> tuple[Solution, list[Scored]]:
        """Judge the leading candidates once more, all by the noise that the best one leaves."""
        assert best.solution is not None
        self.problem = self._renoised(best.solution)
        null = solve(self.problem, solution.model, solution.theta, solution.values, iterations=8)
        before = held_out(self.problem, null)
        highest = best.gains.mean()
        result = []
        for s in scored:
            if s.solution is None or s.gains.mean() < 0.3 * highest:
                result.append(s)
                continue
            fresh = solve(self.problem, s.solution.model, s.solution.theta, s.solution.values, iterations=10)
            gains = log_gain(before, held_out(self.problem, fresh))
            result.append(Scored(s.term, fresh, gains if s.honest is None else np.where(s.honest, gains, s.gains)))
        return null, result

    def pair(self, solution: Solution, names: tuple[str, str], before: np.ndarray, number: int) -> Scored:
        """Score two effects of the catalogue at once, against squares ``before`` [units]; the second gives the name."""
        first, second = (terms.simple(self.base.catalogue.by_name[n]) for n in names)
        self.on_progress(f"round {number}", 0, 1, f"{first.label} + {second.label}")
        model = solution.model.adding(first).adding(second)
        # Strong starts, fitted whatever they promise: along the direction in which they cancel weak ones see nothing to
        # improve, and a strong one makes errors larger at first.
        starts = [np.concatenate([solution.values, a, [0.3]]) for a in first.starts]
        best = min((solve(self.problem, model, solution.theta, s, iterations=5) for s in starts), key=lambda s: s.cost)
        best = solve(self.problem, model, best.theta, best.values)
        return Scored(second, best, log_gain(before, held_out(self.problem, best)))

    def _nested(
        self,
        solution: Solution,
        term: Term,
        before: np.ndarray,
        starts: Sequence[np.ndarray] | None = None,
        worth: float = 0.0,
        promise: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> Scored:
        """Score a term by a fit, which goes no further where even on the very data it gains less than ``worth``.

        ``promise`` is that of these ``starts``, where it has been looked at.
        """
        model = solution.model.adding(term)
        starts = starts or [np.append(solution.values, s) for s in term.starts]
        share, scaled = promise or self._promise(solution, term, starts)
        # Chance alone lowers the error by the number of parameters over that of the errors.
        if share.max() < FAINT + term.size / solution.linear.residual.size:
            best = solve(self.problem, model, solution.theta, scaled[share.argmax()], iterations=1)
        else:
            promising = [starts[i] for i in np.argsort(-share)[:RACED] if share[i] >= NEAR * share.max()]
            first = [solve(self.problem, model, solution.theta, s, iterations=5) for s in promising]
            best = min(first, key=lambda s: s.cost)
            if 0.5 * np.log(solution.cost / best.cost) >= worth:
                best = solve(self.problem, model, best.theta, best.values, iterations=8)
        # What gains too little on the very data gains no more without a run.
        able = 0.5 * np.log(solution.cost / best.cost) >= max(worth, WORTH)
        return Scored(term, best, log_gain(before, held_out(self.problem, best, exact=able)))

    def _promise(
        self, solution: Solution, term: Term, begin: Sequence[np.ndarray] | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return by which share every start [S, Q] lowers the squared error [S], and the starts scaled to do so.

        A start's response, after θ has followed it, is scaled by one number, which scales strengths.
        """
        problem, linear, model = self.problem, solution.linear, solution.model.adding(term)
        starts = np.array(begin or [np.append(solution.values, s) for s in term.starts])
        residual = problem.residual(problem.errors(np.repeat(solution.theta[None], len(starts), axis=0), model, starts))
        responses = np.concatenate([linear.jacobian[: linear.own], residual - linear.residual])
        tried = Linear(linear.residual, responses, linear.own)
        moved = projected(finish(problem, model, solution.theta, starts[0], tried, 0.0))
        square = np.einsum("rms,rms->s", moved, moved) + 1e-9
        push = np.einsum("rms,rm->s", moved, linear.residual)
        strengths = [p for p in term.parameters if p.role == "strength"]
        both_ways = bool(strengths) and all(p.null is not None and p.low < p.null < p.high for p in strengths)
        scale = np.clip(-push / square, -4.0 if both_ways else 0.0, 4.0)
        share = -(2.0 * scale * push + scale**2 * square) / (linear.residual**2).sum()
        scaled = starts.copy()
        for i, p in enumerate(term.parameters, start=starts.shape[1] - term.size):
            if p.role == "strength" and p.null is not None:
                scaled[:, i] = np.clip(p.null + scale * (starts[:, i] - p.null), p.low, p.high)
        return share, scaled

    def _sought(self, what: Sought) -> list[Effect]:
        effects = [self.base.catalogue.by_name[n] for n in self.names]
        return [e for e in effects if e.sought == what]

    def _curves(
        self, solution: Solution, responses: places.Responses, before: np.ndarray, curves: Sequence[Term],
        worth: float = WORTH,
    ) -> list[Scored]:  # fmt: skip
        """Score curves by their linear response, and those that promise most, and ``worth``, by a fit."""
        have, result = {t.label: t for t in solution.model.terms}, []
        past = any(t.past for t in have.values())  # of which there is one in a model
        screened = [(t, *_line(responses, t)) for t in curves if t.label not in have and not (past and t.past)]
        # A straight line has no end where a run is far from it: a loss beyond the largest gain tells nothing.
        promises = [float(np.where(gains < -gains.max(), 0.0, gains).mean()) for *_, gains in screened]
        for i, number in enumerate(np.argsort(np.negative(promises), kind="stable")):
            term, start, gains = screened[number]
            faint = promises[number] < max(worth, NEAR * max(promises)) and (
                term.effect is None or term.what != "acceleration" or worth > WORTH
            )
            if faint or i >= RACED:
                result.append(Scored(term, None, gains))
                continue
            low, high = term.parameters[0].low, term.parameters[0].high
            begin = start if term.made is None else np.array([term.made.strength_of(float(x)) for x in start])
            starts = [np.append(solution.values, np.clip(begin, 0.9 * low, 0.9 * high))]
            result.append(self._nested(solution, term, before, starts))
        return result

    # -- where and when ----------------------------------------------------------------------------------------------

    def _places(
        self, solution: Solution, responses: places.Responses, before: np.ndarray, first: bool,
        worth: float,
    ) -> list[Scored]:  # fmt: skip
        have = {t.label for t in solution.model.terms}
        period = self.problem.rows.records.period
        result: list[Scored] = []

        def interval_of(what: str, coordinate: str, open_end: bool = False, named: Effect | None = None) -> None:
            width = {"position": 20.0, "time": 2.0}[coordinate]
            shortest = {"position": 2, "time": 3}[coordinate]
            interval = places.scan(responses, what, coordinate, width, open_end=open_end, shortest=shortest)
            if interval is None:
                if named is not None:
                    self.unplaced[named.name] = f"no {coordinate} in these data is covered for long enough to be tried"
                return
            term = _interval_term(what, coordinate, interval, open_end, named, period)
            if term.label in have:
                return
            if interval.gains.mean() < worth and (named is None or worth > WORTH):
                result.append(Scored(term, None, interval.gains))
                return
            starts = [np.append(solution.values, s) for s in _around(term, interval, open_end)]
            one = self._nested(solution, term, before, starts)
            # Runs that chose another place than all together are judged by what they would have gained there.
            gains = np.where(interval.stable, one.gains, interval.gains)
            result.append(Scored(term, one.solution, gains, interval.stable))

        def curve_of(*curves: Term) -> None:
            result.extend(self._curves(solution, responses, before, curves, worth))

        position = _knots(responses.coordinates["position"], 80.0, 48, period)
        for effect in self._sought("profile"):
            curve_of(terms.unknown_profile(effect, *position, period))
        for effect in self._sought("interval"):
            interval_of(effect.acts_on, "position", named=effect)
        for effect in self._sought("step"):
            interval_of(effect.acts_on, "time", open_end=True, named=effect)
        if not self.located:
            return result
        for what in ("time_gap", "accel_and_decel", "acceleration"):
            interval_of(what, "position")
        for what in PULSED:
            interval_of(what, "time")
        for what in ("desired_speed", "accel_and_decel", "acceleration"):
            interval_of(what, "time", open_end=True)
        coarse = _knots(responses.coordinates["position"], 150.0, 30, period)
        curve_of(terms.curve("time_gap", "position", *coarse, period))
        time = responses.coordinates["time"]
        ramp = (float(time.min()), float(np.ptp(time)) + 1e-6, 2)
        curve_of(terms.curve("time_gap", "time", *ramp, label="time_gap ramp"))
        curve_of(terms.curve("acceleration", "time", *_knots(time, 8.0, 24)))
        if first:
            seen = {c: responses.coordinates[c] for c in terms.STATES}
            knots = {c: _knots(x, terms.STATES[c], 16) for c, x in seen.items() if np.ptp(x) > 0.0}
            shapes = [terms.curve(what, c, *knots[c]) for what, c in product(PULSED, knots)]
            # Each kind has as many fits as the best names: what is told by a name has been held against both.
            for past in (False, True):
                curve_of(*(t for t in shapes if t.past is past))
        what, cycle, gains = places.best_period(responses)
        term = terms.curve(what, "time", 0.0, cycle / 8, 8, cycle, label=f"{what} over phase")
        if term.label not in have:
            if gains.mean() < worth:
                result.append(Scored(term, None, gains))
            else:
                start = np.append(solution.values, np.zeros(8))
                one = self._nested(solution, term, before, [start])
                result.append(Scored(term, one.solution, np.minimum(one.gains, gains + 0.5 * np.abs(gains))))
        return result


def _worth(scored: Sequence[Scored]) -> float:
    """Return the gain in log RMSE below which a candidate stays far behind the best of those found."""
    return NEAR * max((float(s.gains.mean()) for s in scored), default=0.0)


def _line(responses: places.Responses, term: Term) -> tuple[np.ndarray, np.ndarray]:
    """Return a curve's knots by its linear response, and honest gains of units."""
    basis = places.hats(responses.coordinates[term.coordinate], *term.knots, term.period)
    if term.by:
        basis = basis * np.clip(responses.coordinates[term.by] / PER[term.by], -2.0, 2.0)[..., None]
    spread = term.smoothness if term.made is None else terms.SPREAD
    return places.linear_curve(responses, term.what, basis, spread)[:2]


def _interval_term(
    what: str, coordinate: str, interval: places.Found, open_end: bool, named: Effect | None, period: float
) -> Term:
    if named is not None:
        strength = named.strength_of(interval.amount)
        if open_end:
            return terms.placed(named, strength, interval.begin)
        return terms.placed(named, strength, interval.begin, interval.end, period=period)
    limit = 3.0 if what == "acceleration" else 0.6
    amount = float(np.clip(interval.amount, -limit, limit))
    term = terms.interval(what, coordinate, interval.begin, 1e6 if open_end else interval.end, amount,
                          period if coordinate == "position" else 0.0)  # fmt: skip
    return replace(term, label=f"{what} step in {coordinate}") if open_end else term


def _around(term: Term, interval: places.Found, open_end: bool) -> list[np.ndarray]:
    """Return starts of an interval: with the edges found, and with each a bin before and after.

    An edge that is off by a bin may not reach the right one: in between, every driver's own parameters make up for it.
    """
    start, shifts = np.array(term.starts[0]), (0.0, -interval.width, interval.width)
    ends = (0.0,) if open_end else shifts
    moved = [(0.0, a, b)[: term.size] for a in shifts for b in ends]
    return [start + m for m in moved]


def _knots(values: np.ndarray, distance: float, most: int, period: float = 0.0) -> tuple[float, float, int]:
    if period > 0.0:
        count = int(np.clip(round(period / distance), 4, most))
        return 0.0, period / count, count
    low, high = float(np.quantile(values, 0.002)), float(np.quantile(values, 0.998))
    count = int(np.clip(np.ceil((high - low) / distance) + 1, 3, most))
    return low, max((high - low) / (count - 1), 1e-6), count


def starting_values(model: Hypothesis) -> np.ndarray:
    """Return φ [Q] to begin with: the first start of every term."""
    return np.concatenate([np.zeros(0), *(np.array(t.starts[0]) for t in model.terms)])
