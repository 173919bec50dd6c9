"""Is an error on held-out runs better, the same or worse, and how sure is that: bootstrap over followers or runs."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

import numpy as np
from scipy.stats import binomtest, t as student

from idm_env.discovery.judge import Judged
from idm_env.discovery.result import Change

DRAWS = 2000
RUNS = 6
"""Held-out runs from which whole runs are drawn; of fewer, the followers within them."""
TRIMMED = 0.1
"""Share of followers that a trimmed error leaves out."""
ERRORS = ("gap_rmse_m", "horizon_rmse_m", "speed_rmse_mps")
"""Errors that are compared: the gap in free simulation, the gap 5 s ahead, and the speed in free simulation."""


class ErrorChange(str, Enum):
    """What the interval of an error's ratio says."""

    BETTER = "better"
    SAME = "same"
    WORSE = "worse"


@dataclass(frozen=True)
class Comparison:
    """One error before and after; ``ratio`` is after / before, with its 95 % interval from ``low`` to ``high``.

    ``driver`` is the geometric mean of the followers' own ratios, in which a hopeless follower counts as one, with its
    95 % interval; ``improved`` is the share of followers whose error falls (a tie counts half), and ``followers`` their
    number.
    """

    before: float
    after: float
    ratio: float
    low: float
    high: float
    improved: float = float("nan")
    followers: int = 0
    driver: tuple[float, float, float] = (float("nan"), float("-inf"), float("inf"))

    trimmed: tuple[float, float] = (float("nan"), float("nan"))
    """Both errors without the tenth of followers that err most in both models together."""

    @property
    def outcome(self) -> ErrorChange:
        """``worse`` where an interval lies above 1, of the pooled errors or of the followers' ratios.

        ``better`` where one lies below, and the pooled error does not rise.
        """
        if self.low > 1.0 or self.driver[1] > 1.0:
            return ErrorChange.WORSE
        below = self.ratio < 1.0 and (self.high < 1.0 or self.driver[2] < 1.0)
        return ErrorChange.BETTER if below else ErrorChange.SAME

    @property
    def interval(self) -> str:
        """The 95 % interval that the outcome goes by, in words: the pooled one, or that of the mean driver."""
        if not np.isfinite(self.high):
            return "–"
        if self.outcome is ErrorChange.SAME or not self.low <= 1.0 <= self.high:
            return f"{percent(self.low)} to {percent(self.high)}"
        mean, low, high = map(percent, self.driver)
        return f"mean driver {mean}, {low} to {high}"

    @property
    def most_worse(self) -> bool:
        """Whether the error of the median follower rises beyond chance (sign test, 5 %)."""
        if not self.followers or not np.isfinite(self.improved):
            return False
        better = round(self.improved * self.followers)
        return bool(binomtest(better, self.followers, alternative="less").pvalue < 0.05)


def compare(before: Judged, after: Judged, seed: int = 0, among: np.ndarray | bool = True) -> dict[str, Comparison]:
    """Return how every error of ``ERRORS`` changed, on the same followers and samples; ``among`` followers [F]."""
    runs = np.array([run for run, _ in before.followers])
    result = {}
    for key in ERRORS:
        (was, count), (now, _) = before.squares[key], after.squares[key]
        seen = (count > 0) & among
        result[key] = compared(was[seen], now[seen], count[seen], runs[seen], seed)
    return result


def changes(errors: Mapping[str, Comparison]) -> dict[str, Change]:
    """Return how errors changed, as a report has it."""
    return {
        key: Change(
            c.outcome.value, c.ratio, c.low, c.high, c.before, c.after, "m/s" if key.endswith("mps") else "m",
            *c.driver, c.improved, *c.trimmed, c.interval,
        ) for key, c in errors.items()
    }  # fmt: skip


def percent(ratio: float) -> str:
    """Return the change that a ratio means, with its sign, in percent."""
    return f"{100.0 * (ratio - 1.0):+.1f}\N{NO-BREAK SPACE}%".replace("-", "−")


def compared(was: np.ndarray, now: np.ndarray, samples: np.ndarray, runs: np.ndarray, seed: int) -> Comparison:
    """Compare sums of squares of followers [F] over their samples [F], in runs [F]."""
    errors = [_rmse(x, samples) for x in (was, now)]
    change = 0.5 * np.log(now.sum() / was.sum()) if len(samples) and was.sum() > 0 else float("nan")
    width = _width(was, now, runs, seed) if np.isfinite(change) else float("inf")
    improved = float(((now < was) + 0.5 * (now == was)).mean()) if len(was) else float("nan")
    ratio, low, high = (float(np.exp(x)) for x in (change, change - width, change + width))
    best = np.argsort((was + now) / samples)[: len(was) - int(TRIMMED * len(was))]
    trimmed = (_rmse(was[best], samples[best]), _rmse(now[best], samples[best]))
    return Comparison(errors[0], errors[1], ratio, low, high, improved, len(was), _of_drivers(was, now, runs), trimmed)


def _rmse(squares: np.ndarray, samples: np.ndarray) -> float:
    return float(np.sqrt(squares.sum() / samples.sum())) if len(samples) else float("nan")


def _of_drivers(was: np.ndarray, now: np.ndarray, runs: np.ndarray) -> tuple[float, float, float]:
    """Return the geometric mean of followers' ratios and its 95 % interval.

    Student's t over what ``sampling`` draws. Deviations of followers of one run, which depend on each other, are
    added before they are squared.
    """
    seen = (was > 0.0) & (now > 0.0)
    if not seen.any():
        return float("nan"), 0.0, float("inf")
    change = 0.5 * np.log(now[seen] / was[seen])
    strata, freedom = sampling(runs[seen])
    mean = float(change.mean())
    off = [np.array([(change[unit] - mean).sum() for unit in stratum]) for stratum in strata]
    units = sum(len(s) for s in strata)
    error = np.sqrt(sum(float((x**2).sum()) for x in off) * units / max(freedom, 1)) / len(change)
    width = float(student.ppf(0.975, freedom) * error) if freedom >= 1 else float("inf")
    middle, low, high = (float(np.exp(x)) for x in (mean, mean - width, mean + width))
    return middle, low, high


def _width(was: np.ndarray, now: np.ndarray, runs: np.ndarray, seed: int) -> float:
    """Return half the 95 % interval of the logarithm of the ratio of two RMSEs.

    The standard error is that of ``DRAWS`` bootstrap samples, widened for the few units that they are drawn from, with
    Student's t: percentiles of so few draws are too narrow.
    """
    strata, freedom = sampling(runs)
    if freedom < 1:
        return float("inf")
    random = np.random.default_rng(seed)
    totals = np.zeros((2, DRAWS))
    units = sum(len(s) for s in strata)
    for stratum in strata:
        weights = random.multinomial(len(stratum), np.full(len(stratum), 1.0 / len(stratum)), size=DRAWS)
        for total, squares in zip(totals, (was, now), strict=True):
            total += weights @ np.array([squares[unit].sum() for unit in stratum])
    with np.errstate(divide="ignore", invalid="ignore"):
        changes = 0.5 * np.log(totals[1] / totals[0])
    changes = changes[np.isfinite(changes)]
    if len(changes) < DRAWS // 2:
        return float("inf")
    return float(student.ppf(0.975, freedom) * changes.std(ddof=1) * np.sqrt(units / freedom))


def sampling(runs: np.ndarray) -> tuple[list[list[np.ndarray]], int]:
    """Return what is drawn of followers in ``runs`` [F]: strata of units of their numbers, and the degrees of freedom.

    Whole runs, because followers of one run share leader, road and weather, where there are at least ``RUNS``; else
    followers within their runs, or followers alone where runs have hardly more than one.
    """
    of_run = [np.flatnonzero(runs == run) for run in np.unique(runs)]
    if len(of_run) >= RUNS:
        return [of_run], len(of_run) - 1
    if len(runs) - len(of_run) >= 2:
        return [[np.array([i]) for i in run] for run in of_run], len(runs) - len(of_run)
    return [[np.array([i]) for i in range(len(runs))]], len(runs) - 1
