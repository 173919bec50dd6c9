"""What is added to the model, and why not more: rounds of the whole list, pairs that cancel, and taking back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.stats import ttest_1samp

from idm_env.discovery import closed_loop, judge, places, together
from idm_env.discovery.march import CURVE
from idm_env.discovery.model import Hypothesis, Term
from idm_env.discovery.power import PROMISING
from idm_env.discovery.records import whole
from idm_env.discovery.score import (
    ALPHA,
    CLOSED_LOOP_SHARE,
    Tested,
    at_level,
    held_out,
    interval_of,
    log_gain,
    westfall_young,
)
from idm_env.discovery.search import Scored, Search
from idm_env.discovery.solve import Solution, solve
from idm_env.discovery.units import MANY_RUNS, smallest_p, units
from idm_env.discovery.verdict import Reason, Refusal
from idm_env.effects import ALL

LEAST_GAIN = 0.005
"""Least gain in the logarithm of the whitened 5 s prediction error, on held-out runs."""
NAMED_GAIN = 0.02
"""Least such gain of what is added: time gaps that wander make others gain 0.015; 45 true effects gained 0.043."""
LEAST_SHARE = 0.5
FEWEST_RUNS = 3
"""To choose on: of fewer, what is left when one is left out is a single run."""
MOST_ROUNDS = 3
SAME = 0.15
"""Candidates whose gain is within this share of the best one's are told apart by nothing but their names."""
SHOWN = 0.1
"""Share of the largest gain of a unit from which on another one shows the effect, too."""
SPANS = 5
"""Knots from which on a curve has in it what an interval would say; a ramp has not."""
AT_FLOOR = 1.15
"""A corrected model whose free simulation errs by no more times the noise of measurement lacks nothing worth a name.

With the right effect in the model, generated sets without drivers' noise come to 1.00 to 1.08.
"""


@dataclass(eq=False)
class Round(together.Step):
    """What one round of the search saw, for the report; ``left`` [units] is the gain of any smooth function."""

    left: np.ndarray = field(default_factory=lambda: np.zeros(0))
    partner: int | None = None
    share: float = float("nan")
    partial: int | None = None
    in_closed_loop: bool = False
    """Whether gains are those of free simulation, and not of predictions in windows."""
    run: np.ndarray = field(default_factory=lambda: np.zeros(0, int))
    """Run of every unit [units] that gains are of: free simulation counts followers where windows count runs."""

    @property
    def smooth_gain(self) -> float:
        """Gain in log RMSE of the best smooth function of the state that was tried, every shape among them."""
        shapes = (float(s.gains.mean()) for s in self.scored if s.term.fades)
        return max(0.0, float(self.left.mean()), *shapes)

    def chosen_in(self, winner: int, fold: np.ndarray) -> float:
        """Return the share of folds without whose runs it, or what is ``equivalent``, gains most; ``fold`` [runs].

        Where that is 1, the errors of cross-fitting are those of a choice made anew without every fold. A candidate of
        the catalogue goes before what is only located, as in the choice itself.
        """
        gains, fold = np.array([s.gains for s in self.scored]), fold[self.run]
        named = np.array([s.term.effect is not None for s in self.scored])
        able = np.array([self.in_closed_loop or s.solution is not None for s in self.scored])
        alike = [winner, *self.equivalent]
        times = []
        for k in np.unique(fold):
            mean = np.where(able, gains[:, fold != k].mean(1), -np.inf)
            of_name = np.where(named, mean, -np.inf)
            first = (of_name if of_name.max() >= (1.0 - SAME) * mean.max() else mean).argmax()
            times.append(first in alike)
        return float(np.mean(times))

    @property
    def leading(self) -> Term | None:
        """The candidate that gained most of those that gained enough, beyond chance; None where that is of no size."""
        if self.refusal is not None and self.refusal.reason is Reason.SMALL_SIZE:
            return None
        least = together.LEAST_GAIN if self.in_closed_loop else LEAST_GAIN
        able = np.flatnonzero((self.tested.p_value < ALPHA) & (self.tested.gain >= least))
        return self.scored[able[self.tested.gain[able].argmax()]].term if len(able) else None


@dataclass(frozen=True, eq=False)
class Decided:
    """Result of the search: null model, models after each accepted term, all candidates by round, joined terms.

    ``null_in_closed_loop`` is IDM in free simulation, before anything was added.

    ``joined`` are terms that hold together in free simulation, beside what predictions in windows tell.
    """

    null: Solution
    steps: list[Solution]
    rounds: list[Round]
    joined: together.Joined | None
    null_in_closed_loop: closed_loop.ClosedLoopFit


def decide(searching: Search, null: Solution, seed: int) -> Decided:
    """Decide what is added to the null, on the validation runs.

    A latency shorter than a step of the data becomes part of the null: it is how they were integrated or recorded.
    """
    fit, null = searching.weighed(null)
    null, steps, rounds = _rounds(searching, null, seed)
    if len(steps) == len(rounds) - 1 and not (steps and _is_shape(steps[-1])):
        pair = _pairs(searching, steps[-1] if steps else null, rounds[-1], seed)
        if pair is not None:
            rounds.append(pair)
            chosen = pair.scored[0].solution
            assert chosen is not None
            steps.append(searching.null(chosen.model, chosen.theta, chosen.values))
    if steps:
        steps[-1] = searching.weighed(_delete(searching, steps[-1], len(null.model.terms)))[1]
    return Decided(null, steps, rounds, _joined(searching, null, steps, rounds, seed), fit)


def _joined(
    searching: Search, null: Solution, steps: list[Solution], rounds: list[Round], seed: int
) -> together.Joined | None:
    """Search terms by closed-loop score on top of the last model; append tested candidates to ``rounds``."""
    now, last = steps[-1] if steps else null, rounds[-1]
    few = last.refusal is not None and last.refusal.reason is Reason.FEW_RUNS
    if few or (steps and (_is_shape(now) or _at_floor(searching, now))):
        return None
    joined, forward = together.grow(searching, searching.weighed(now)[0], len(null.model.terms), seed)
    run = units(searching.problem.rows.records, MANY_RUNS).run
    rounds += [Round(**vars(step), in_closed_loop=True, run=run) for step in forward if step.scored]
    return joined


def _rounds(searching: Search, null: Solution, seed: int) -> tuple[Solution, list[Solution], list[Round]]:
    now = null
    steps: list[Solution] = []
    rounds: list[Round] = []
    last: Round | None = None
    for number in range(1, MOST_ROUNDS + 2):
        # Beside a surface nothing more is sought.
        if len(steps) == MOST_ROUNDS or (steps and (now.model.terms[-1].by or _at_floor(searching, now))):
            break
        scored = searching.round(now, number, not steps)
        scored = [s for s in scored if not _same_class(s.term, now.model)]
        if not scored and last is not None:
            # The only candidate was a latency below a step, which is the null's now and leads nothing.
            tested = replace(last.tested, p_value=np.ones(len(last.scored)))
            rounds.append(
                replace(last, tested=tested, winner=None, equivalent=[], partial=None, refusal=Refusal(Reason.NO_GAIN))
            )
        if not scored and rounds:
            break
        if not scored:
            raise ValueError(f"{', '.join(searching.names)}: no place or time in these data is long enough to try.")
        tested = _tested(searching, scored, seed)
        order = np.argsort(-tested.gain)
        fitted = [i for i in order if scored[i].solution is not None and tested.p_value[i] < 2 * ALPHA]
        if fitted and tested.gain[fitted[0]] > 0.3 * LEAST_GAIN:
            now, scored = searching.again(now, scored[fitted[0]], scored)
            tested = _tested(searching, scored, seed)
        left = judge.ceiling(places.respond(searching.problem, now))
        this = Round(scored, tested, left=left, run=searching.units.run)
        rounds.append(this)
        _choose(searching, now, this)
        if this.winner is None:
            break
        chosen = scored[this.winner].solution
        assert chosen is not None
        now = searching.weighed(searching.null(chosen.model, chosen.theta, chosen.values))[1]
        if not steps and _is_a_step(now, searching.problem.rows.records.dt):
            null, last = now, rounds.pop()
        else:
            steps.append(now)
    return null, steps, rounds


def _tested(searching: Search, scored: Sequence[Scored], seed: int) -> Tested:
    """Test candidates in windows, at their share of the level."""
    return at_level(
        westfall_young(np.array([s.gains for s in scored]), seed, searching.units.run), 1.0 - CLOSED_LOOP_SHARE
    )


def _is_shape(now: Solution) -> bool:
    """Tell whether the last term is a curve over a state: beside it a name explains the curve's corners."""
    return now.model.terms[-1].fades


def _is_a_step(now: Solution, dt: float) -> bool:
    """Tell whether the last term is a latency below one step."""
    return _late(now.model.terms[-1].effect) and abs(float(now.values[-1])) < dt


def _at_floor(searching: Search, now: Solution) -> bool:
    """Tell whether only the noise of measurement is left; what smoothing does at sharp bends would be named next."""
    records = searching.problem.rows.records
    square = searching.closed_loop_squares(now).sum() / len(whole(records).valid.nonzero()[0])
    return bool(square <= (AT_FLOOR * judge.floor(records)["gap_rmse_m"]) ** 2)


def _pairs(searching: Search, now: Solution, last: Round, seed: int) -> Round | None:
    """Return a round in which both of a pair that cancels were added at once, if that passes as a winner must.

    Tested with the whole list of the round that had no winner, as candidates more.
    """
    have = {t.label for t in now.model.terms}
    left = [n for n in searching.names if n not in have]
    late = any(_late(t.effect) for t in now.model.terms)
    pairs = [
        (name, other) for name in left for other in ALL[name].cancels
        if other in left and not (late and (_late(name) or _late(other)))
    ]  # fmt: skip
    if not pairs or (last.refusal is not None and last.refusal.reason is Reason.FEW_RUNS):
        return None
    number = len(have) + 1
    before = held_out(searching.problem, now)
    scored = [searching.pair(now, pair, before, number) for pair in pairs]
    tested = _tested(searching, (*last.scored, *scored), seed)
    mine = Tested(*(x[len(last.scored) :] for x in (tested.p_value, tested.gain, tested.interval)))
    this = Round(scored, mine, left=last.left, run=searching.units.run)
    _choose(searching, now, this)
    if this.winner is None:
        return None
    solution = scored[this.winner].solution
    assert solution is not None
    both = [Scored(term, solution, scored[this.winner].gains) for term in solution.model.terms[-2:]]
    twice = Tested(*(np.repeat(x[[this.winner]], 2, axis=0) for x in (mine.p_value, mine.gain, mine.interval)))
    return Round(both, twice, 0, left=this.left, partner=1, share=this.share, run=this.run)


def _same_class(term: Term, model: Hypothesis) -> bool:
    """Tell whether the model has an effect already that only sharp inputs tell from this one, or a curve that spans it.

    A curve with many knots over a coordinate contains other changes of the same quantity over it: these are its error.
    """
    fine = [t for t in model.terms if t.form == CURVE and t.knots[2] >= SPANS]
    if not term.by and any((t.what, t.coordinate) == (term.what, term.coordinate) for t in fine):
        return True
    return _late(term.effect) and any(_late(t.effect) and t.effect != term.effect for t in model.terms)


def _is_small(searching: Search, now: Solution, chosen: Solution) -> bool:
    """Tell whether an addition has no practical size.

    A latency is below half a step, or predictions 5 s ahead move by less than ``judge.least_m`` (RMS). A latency that
    comes first is not refused: below a step it becomes part of the null.
    """
    problem, added = searching.problem, chosen.model.terms[len(now.model.terms) :]
    first = len(added) == 1 and now.model.terms == searching.base.terms
    if first and _is_a_step(chosen, problem.rows.records.dt):
        return False
    if together.is_too_short(chosen, added, problem.rows.records.dt):
        return True
    before, after = (problem.errors(s.theta[None], s.model, s.values[None])[0][:, -1] for s in (now, chosen))
    return bool(np.sqrt(np.mean((after - before) ** 2)) < judge.least_m(problem.rows.records))


def _late(name: str | None) -> bool:
    """Tell whether an effect is a latency."""
    return name is not None and ALL[name].latency


def _choose(searching: Search, now: Solution, this: Round) -> None:
    """Set the winner of a round, or say why there is none."""
    run = searching.units.run
    runs = len(np.unique(run))
    if runs < FEWEST_RUNS or smallest_p(run) >= ALPHA * (1.0 - CLOSED_LOOP_SHARE):
        this.refusal = Refusal(Reason.FEW_RUNS, figure=runs)
        return
    tested, scored = this.tested, this.scored
    fitted = [i for i, s in enumerate(scored) if s.solution is not None]
    able = [i for i in fitted if tested.p_value[i] < ALPHA and tested.gain[i] >= NAMED_GAIN]
    able = able or [i for i in fitted if scored[i].term.past and shows_in_few(scored[i].gains)]
    if not able:
        this.refusal = Refusal(Reason.NO_GAIN)
        return
    best = max(able, key=lambda i: tested.gain[i])
    same = [i for i in able if tested.gain[i] >= (1.0 - SAME) * tested.gain[best]]
    same += [
        i for i in able
        if i not in same and _late(scored[i].term.effect) and _late(scored[best].term.effect)
        and tested.gain[i] >= 0.7 * tested.gain[best]
    ]  # fmt: skip
    named = [i for i in same if scored[i].term.effect is not None]
    # What has a name goes before what is only located, where both explain the same.
    winner = max(named, key=lambda i: tested.gain[i]) if named else best
    chosen = scored[winner].solution
    assert chosen is not None
    this.partial = winner
    if _is_small(searching, now, chosen):
        this.refusal = Refusal(Reason.SMALL_SIZE, judge.least_m(searching.problem.rows.records))
        return
    after = judge.ceiling(places.respond(searching.problem, chosen))
    gained, rest = float(tested.gain[winner]), max(float(after.mean()), 0.0)
    explained = 1.0 - np.exp(-2 * gained)
    this.share = float(explained / max(explained + np.exp(-2 * gained) * (1.0 - np.exp(-2 * rest)), 1e-12))
    if this.share < LEAST_SHARE:
        this.refusal = Refusal(Reason.SMALL_SHARE, figure=this.share)
        return
    if not _closed_loop_holds(searching, now, chosen):
        this.refusal = Refusal(Reason.CLOSED_LOOP)
        return
    this.winner = winner
    this.equivalent = [i for i in same if i != winner]


def shows_in_few(gains: np.ndarray) -> bool:
    """Tell whether gains [units] are large, and of one sign wherever the effect can show.

    A run without a stop says nothing of what follows one: its sign is chance, and few others can have no small p.
    """
    shown = gains[np.abs(gains) > SHOWN * np.abs(gains).max()]
    return bool(gains.mean() >= PROMISING and len(shown) >= FEWEST_RUNS and (shown > 0.0).all())


def _closed_loop_holds(searching: Search, now: Solution, chosen: Solution) -> bool:
    """Tell whether free simulation of the validation runs gets no worse: by 2 % at most, or not beyond chance.

    Drivers' own noise adds up in free simulation: with 0.1 m/s² of it, right findings can miss the 2 %.
    """
    before, after = (searching.closed_loop_squares(s) for s in (now, chosen))
    if after.sum() <= 1.02**2 * before.sum():
        return True
    return bool(ttest_1samp(log_gain(after, before), 0.0, alternative="greater").pvalue > ALPHA)


def _delete(searching: Search, final: Solution, base: int) -> Solution:
    """Take back added terms whose interval contains their null, or whose loss costs less than an addition gains.

    As long as another is left: one alone was tested against none, and stays.
    """
    while len(final.model.terms) > base + 1:
        now, intervals = held_out(searching.problem, final), interval_of(final, searching.problem)
        losses = []
        for index in range(base, len(final.model.terms)):
            keep = np.delete(final.values, final.model.where(final.model.terms[index].label))
            less = solve(searching.problem, final.model.without(index), final.theta, keep)
            loss = float(log_gain(held_out(searching.problem, less), now).mean())
            losses.append((min(loss, 0.0) if together.contains_null(final, intervals, index) else loss, index, less))
        loss, _, less = min(losses, key=lambda x: x[0])
        if loss >= LEAST_GAIN:
            break
        final = less
    return final
