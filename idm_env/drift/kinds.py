"""What sort of drift it is: every sort estimated on the same records, against drivers who do not drift."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from torch import Tensor

from idm_env.data import Episode
from idm_env.drift.estimate import Estimate, estimate, usual
from idm_env.drift.linear import MeasuredDrivers, stacked
from idm_env.effects import DRIFTS, IDM, Brakes, Effect, Replay
from idm_env.fitting.batch import Batch
from idm_env.fitting.problem import IDM_NAMES
from idm_env.jobs.executor import Executor, Serial
from idm_env.jobs.progress import OnProgress, silent
from idm_env.jobs.storage import Store
from idm_env.parameters import catalogue
from idm_env.roads import Lane
from idm_env.simulator import Simulator

FOUND = 10.0
"""Log-likelihood by which drift must beat white noise alone: e^(−10) for two numbers more; steps are not linear."""
LEAST = 0.1
"""Share of the usual σ below which drift is what smoothing and steps leave, and nobody's."""
PAIR = ("wander", "accel_noise")
"""Drifts that are tried together: one forecasts best at 1 s, the other at 10 s."""
PAIRED = 30.0
"""Log-likelihood by which two processes must beat the better one: a wandering T alone gains up to 28, both 26 to 71."""
APART = 5.0
"""Log-likelihood by which the best sort must beat another to be told from it."""


@dataclass(frozen=True, eq=False)
class Told:
    """Estimates by name of the drift, that without any, and ``one_of``: sorts that the data do not tell apart.

    ``one_of`` is empty for drivers who do not drift. Its first is the likeliest, or what forecasts drivers kept back
    better beyond chance. Sorts that were not estimated (``Estimate.why_not``) are compared with nothing. ``foresees``:
    whether none forecasts no better than it, beyond chance, as far as that was tried.
    """

    steady: Estimate
    found: Mapping[str, Estimate]
    one_of: tuple[str, ...]
    foresees: bool = True

    @property
    def gain(self) -> dict[str, float]:
        """Log-likelihood that every sort gains over drivers who do not drift."""
        return {name: e.log_likelihood - self.steady.log_likelihood for name, e in self.found.items()}

    @property
    def verdict(self) -> str:
        """``none``, ``named``, ``one_of``, or ``cannot_tell``.

        The last where no sort or no steady driver is estimated, or where what is likelier forecasts worse.
        """
        if self.steady.why_not or all(e.why_not for e in self.found.values()) or (self.one_of and not self.foresees):
            return "cannot_tell"
        return "none" if not self.one_of else "named" if len(self.one_of) == 1 else "one_of"


def behind_a_record(dt: float, *drifts: Effect) -> Simulator:
    """Return IDM with drift behind a record."""
    return Simulator(Lane(), (IDM(), *drifts, Replay(), Brakes()), dt=dt, integration="midpoint")


@dataclass(frozen=True, eq=False)
class _Sort:
    """A sort of drift to be estimated: none, one or several processes at once."""

    kinds: tuple[Effect, ...]
    smooth: Batch
    measured: Batch

    def __str__(self) -> str:
        return " and ".join(kind.name for kind in self.kinds) or "no drift"

    @property
    def simulator(self) -> Simulator:
        return behind_a_record(self.smooth.step, *self.kinds)


def _estimated(sort: _Sort, progress: OnProgress) -> dict[str, Tensor]:
    return estimate(sort.simulator, sort.smooth, IDM_NAMES, usual(IDM_NAMES), measured=sort.measured).numbers()


def tell(
    smooth: Sequence[Episode], measured: Sequence[Episode], kinds: Sequence[Effect] = DRIFTS, *,
    store: Store | None = None, executor: Executor | None = None, on_progress: OnProgress = silent,
) -> Told:  # fmt: skip
    """Estimate every sort of drift on episodes, smoothed and as measured, and say which one it is.

    A wandering time gap and noise of the acceleration are tried together, too: two processes are told only where they
    beat the best single one by ``PAIRED``. The search of a sort that comes out less likely than with fewer of its
    processes, or none, went astray: it is not estimated.

    Args:
        smooth: Drivers behind leaders, smoothed.
        measured: The same as measured.
        kinds: Drifting effects.
        store: Keeps every estimate, and has those that an interrupted run left.
        executor: Whoever estimates the sorts, a part each.
        on_progress: Called with the name, done, total and the log-likelihood.
    """
    batch, raw = (stacked(x) for x in (smooth, measured))
    both = tuple(kind for name in PAIR for kind in kinds if kind.name == name)
    each = [(), *((kind,) for kind in kinds), *([both] if len(both) > 1 else [])]
    sorts = [_Sort(processes, batch, raw) for processes in each]
    store = store or Store(None, "", resume=False)
    stored = {s: x for s in sorts if (x := store.get(str(s))) is not None}
    missing = [s for s in sorts if s not in stored]
    for place, numbers in (executor or Serial()).map(_estimated, missing):
        stored[missing[place]] = numbers
        store.put(str(missing[place]), numbers)
        on_progress(str(missing[place]), len(stored), len(sorts), float(numbers["log_likelihood"]))
    drivers = (MeasuredDrivers(s.simulator, batch, raw, IDM_NAMES) for s in sorts)
    first = [Estimate.of_numbers(d, stored[s]) for d, s in zip(drivers, sorts, strict=True)]
    steady, estimates = first[0], {}
    for sort, candidate in zip(sorts[1:], first[1:], strict=True):
        own = set(candidate.drivers.drifts)
        cases = [e.log_likelihood for e in first if set(e.drivers.drifts) < own and not e.why_not]
        estimates[str(sort)] = replace(candidate, nested=max(cases, default=candidate.nested))
    answer = Told(steady, estimates, ())
    order = sorted((n for n in estimates if not estimates[n].why_not), key=lambda name: -answer.gain[name])
    if answer.verdict == "cannot_tell":
        return answer
    singles = [n for n in order if len(estimates[n].drivers.drifts) == 1]
    if singles and answer.gain[order[0]] - answer.gain[singles[0]] < PAIRED:
        order = singles
    best = order[0]
    usual_sigma = {kind.name: catalogue((kind,))[f"{kind.name}.sigma"].default for kind in kinds}
    least = [LEAST * usual_sigma[name] for name in estimates[best].drivers.drifts]
    if answer.gain[best] < FOUND or min(estimates[best].settings.sigma - least) < 0.0:
        return answer
    return Told(steady, estimates, tuple(n for n in order if answer.gain[best] - answer.gain[n] < APART))
