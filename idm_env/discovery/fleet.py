"""Drivers of several kinds in one file: which law each of them follows, told by a column or by their own errors."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations

import numpy as np

from idm_env.discovery import crossed, judge, result
from idm_env.discovery.bases import LEAST, Law, lowers
from idm_env.discovery.calibrate import first_prior
from idm_env.discovery.compare import ERRORS, Comparison, changes, compare
from idm_env.discovery.crossed import in_blocks
from idm_env.discovery.judge import Judged
from idm_env.discovery.model import Hypothesis
from idm_env.discovery.records import windows
from idm_env.discovery.solve import Problem

COLUMNS = ("vehicle_class", "acc_run", "driver", "kind")
"""Columns that may say of what kind a driver is, in the order in which they are asked."""
Among = Callable[[Hypothesis, np.ndarray], Judged]
FEWEST, SHARE = 3, 0.15
"""Least number of drivers of a kind, and least share of all."""


@dataclass(frozen=True, eq=False)
class Kinds:
    """Laws of several kinds of drivers, the errors of every driver with the law of his kind, and with ``one`` for all.

    ``group`` [followers] is the place in ``laws`` of every driver's law. It is told by ``column``, of which ``classes``
    are the values of every group; where that is "", by the errors of half of his time, judged on the other half, and
    ``agreed`` is the number of drivers whose halves say the same.
    """

    laws: Sequence[Law]
    group: np.ndarray
    errors: Judged
    one: Judged
    against: Mapping[str, Comparison]
    column: str = ""
    classes: tuple[tuple[str, ...], ...] = ()
    agreed: int = 0

    @property
    def title(self) -> str:
        """Plain name of all laws together."""
        return "a law for each kind of driver"

    @cached_property
    def counts(self) -> list[int]:
        """Number of drivers of every group."""
        return np.bincount(self.group, minlength=len(self.laws)).tolist()

    @property
    def records(self) -> list[np.ndarray]:
        """Return which records [records] are those of every group."""
        return [self.group[self.errors.follower] == i for i in range(len(self.laws))]


def by_columns(judged: Judged) -> dict[str, np.ndarray]:
    """Return by column the kind [followers] of every driver, of columns that tell it of all and know several kinds."""
    labels = {(e.run_id, e.vehicle_id): e.labels for e in judged.rows.records.episodes}
    columns = {name: [labels[key].get(name) for key in judged.followers] for name in COLUMNS}
    return {name: np.array(kind) for name, kind in columns.items() if None not in kind and len(set(kind)) > 1}


def found(laws: Iterable[Law], one: Judged, among: Among, seed: int) -> Kinds | None:
    """Return the fleet that is better than ``one`` model for all drivers, or None: by a column first, then by errors.

    Every kind is a population of its own, with its law as with the null: laws are compared, and not populations. Whole
    laws count, without strengths of drivers' own.

    Args:
        laws: All laws, that of the null first.
        one: Errors of the model for all.
        among: Judges a model for the drivers of some records [records].
        seed: Of the bootstrap.
    """
    fair = _whole(laws)
    if len(fair) < 2:
        return None
    logs = np.stack([_logs(law.errors) for law in fair])
    of_columns = [(name, kind, _by_kind(logs, kind)) for name, kind in by_columns(fair[0].errors).items()]
    for column, kind, which in (*of_columns, ("", None, _by_errors(logs))):
        each = _sides(fair[0].errors, which, column)
        if len(each) < 2:
            continue
        own = _of_kinds(fair, which, among)
        against = compare(one, own, seed)
        if not (lowers(against) and lowers(compare(_of_kinds(fair, which, among, null=True), own, seed))):
            continue
        sure = (which[0] == which[1]) & np.isin(which[0], each)
        group = np.where(sure, np.searchsorted(each, which[0]), logs.sum(1)[each].argmin(0))
        classes = () if kind is None else tuple(tuple(np.unique(kind[group == g])) for g in range(len(each)))
        return Kinds([fair[i] for i in each], group, own, one, against, column, classes, int(sure.sum()))
    return None


def _by_kind(logs: np.ndarray, kind: np.ndarray) -> np.ndarray:
    """Return the law [halves, followers] of every kind [followers]: the null's, or what errs less by ``LEAST``.

    Every half is predicted by what the other half says. ``logs`` [laws, halves, followers] are logarithms of errors.
    """
    which = np.zeros(logs.shape[1:], int)
    for mine in (kind == name for name in np.unique(kind)):
        left = logs[:, :, mine].mean(2)
        better = (left.min(0) < left[0] + np.log(1.0 - LEAST)) & (mine.sum() >= FEWEST)
        which[:, mine] = np.where(better, left.argmin(0), 0)[::-1, None]
    return which


def _by_errors(logs: np.ndarray) -> np.ndarray:
    """Return laws [halves, followers] by which every half is predicted, told by the other half of the driver's time.

    Of two laws each; those two are taken by which the drivers' errors are least. All have the null's law where that is
    not less by ``LEAST`` than with one law for all.
    """
    which, left = _best_pair(logs)
    return which if left <= logs.mean((1, 2)).min() + np.log(1.0 - LEAST) else np.zeros_like(which)


def _best_pair(logs: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the laws of the two by which drivers err least [halves, followers], and the mean of ``logs`` by these."""
    pairs = [np.array(pair) for pair in combinations(range(len(logs)), 2)]
    which = [pair[logs[pair].argmin(0)][::-1] for pair in pairs]
    left = [float(np.take_along_axis(logs, w[None], 0).mean()) for w in which]
    return which[int(np.argmin(left))], min(left)


def _whole(laws: Iterable[Law]) -> list[Law]:
    return [law for law in laws if not (law.own or law.model.catalogue.without)]


def gain_of(laws: Sequence[Law], values: np.ndarray, two: bool) -> Callable[[Problem], float]:
    """Return a statistic of windows: the fall of log RMSE 5 s ahead by the last law beside the first.

    Of ``two`` laws, one a driver, that beside the best one for all. Every half of a driver's blocks is predicted by
    what the other half says. φ is ``values`` [Q].
    """
    models = [law.model for law in (_whole(laws) if two else laws)]

    def logs(problem: Problem, model: Hypothesis) -> np.ndarray:
        rows, own = problem.rows, replace(problem, prior=first_prior(model.catalogue.own))
        centre, one_fold = np.tile(own.prior.centre, (own.groups, 1)), np.zeros(len(rows.records.runs), int)
        halves = crossed.Halves.split(rows.records, model, values[None], one_fold)
        theta = crossed.whitened(own, halves, model.fixed(values), one_fold, centre)
        square = crossed.predicted(own, halves, theta)[:, -1] ** 2
        half = rows.group + own.groups * (rows.block % 2)
        total, count = (np.bincount(half, x, 2 * own.groups).reshape(2, -1) for x in (square, None))
        return np.asarray(0.5 * np.log((total + 1e-9) / np.maximum(count, 1)))

    def gain(problem: Problem) -> float:
        every = np.stack([logs(problem, model) for model in models])
        mean = every.mean((1, 2))
        return float(mean.min() - _best_pair(every)[1]) if two else float(mean[0] - mean[-1])

    return gain


def _sides(judged: Judged, which: np.ndarray, column: str) -> list[int]:
    """Return the laws that enough drivers follow, in both halves of their time; none where one law is short of them."""
    seen = judged.squares["horizon_rmse_m"][1] > 0
    fewest = FEWEST if column else max(FEWEST, SHARE * len(seen))
    each = np.unique(which)
    enough = [min(int((seen & (half == i)).sum()) for half in which) >= fewest for i in each]
    return each.tolist() if all(enough) and ((which[0] == which[1]) & seen).sum() >= fewest else []


def _of_kinds(laws: Sequence[Law], which: np.ndarray, among: Among, null: bool = False) -> Judged:
    """Return the errors of drivers whose halves follow the laws ``which`` [halves, followers], or the ``null``'s."""
    first = laws[0].errors
    judged: dict[tuple[int, bytes], Judged] = {}
    halves = []
    for half in which:
        gap, speed, ahead, further = (np.zeros_like(x) for x in (first.gap, first.speed, first.ahead, first.further))
        longer = in_blocks(first.rows.records)
        for i in np.unique(half):
            mine = (half == i)[first.follower]
            key = int(i), mine.tobytes()
            if key not in judged:
                judged[key] = among(laws[0 if null else i].model, mine)
            part, rows = judged[key], mine[first.rows.record]
            gap[rows, : part.gap.shape[1]], speed[rows, : part.gap.shape[1]] = part.gap, part.speed
            ahead[mine[first.ahead_record]] = part.ahead
            if longer is not None:
                further[mine[longer.record]] = part.further
        halves.append(replace(first, gap=gap, speed=speed, ahead=ahead, further=further))
    return _mixed(halves)


def _seconds(judged: Judged) -> tuple[np.ndarray, np.ndarray]:
    """Return which samples [R, samples] and windows [W] are in the second half of their driver's blocks."""
    return judge.halves(judged.rows), windows(judged.rows.records).block % 2 == 1


def _logs(judged: Judged) -> np.ndarray:
    """Return the mean over errors of log RMSE [halves, followers] in each half of the drivers' blocks."""
    samples, ahead = _seconds(judged)
    result = []
    for half in (False, True):
        valid = judged.rows.valid & (samples == half)
        soon = judged.ahead[ahead == half], judged.ahead_record[ahead == half]
        part = Judged(replace(judged.rows, valid=valid), judged.gap, judged.speed, *soon)
        squares = [part.squares[key] for key in ERRORS]
        result.append(np.mean([0.5 * np.log((s + 1e-9) / np.maximum(n, 1)) for s, n in squares], axis=0))
    return np.stack(result)


def _mixed(halves: Sequence[Judged]) -> Judged:
    """Return errors of which each half of the drivers' blocks is taken from one of two."""
    first, second = halves
    samples, ahead = _seconds(first)
    longer = in_blocks(first.rows.records)
    further = first.further if longer is None else np.where(longer.block % 2 == 1, second.further, first.further)
    gap, speed = np.where(samples, second.gap, first.gap), np.where(samples, second.speed, first.speed)
    return replace(first, gap=gap, speed=speed, ahead=np.where(ahead, second.ahead, first.ahead), further=further)


def told(fleet: Kinds) -> result.Fleet:
    """Return what a report says of a fleet."""
    drivers = np.array(["/".join(key) for key in fleet.one.followers])
    kinds = []
    for i, law in enumerate(fleet.laws):
        mine = fleet.group == i
        errors, with_one = ({k: _pooled(*s, mine) for k, s in j.squares.items()} for j in (fleet.errors, fleet.one))
        classes = list(fleet.classes[i]) if fleet.column else []
        kinds.append(result.Kind(law.law.kind, law.title, classes, drivers[mine].tolist(), errors, with_one))
    return result.Fleet(fleet.column, kinds, fleet.agreed, changes(fleet.against))


def _pooled(square: np.ndarray, count: np.ndarray, mine: np.ndarray) -> float:
    return float(np.sqrt(square[mine].sum() / max(count[mine].sum(), 1)))
