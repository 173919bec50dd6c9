"""What a discovery concludes: enums that decide; sentences are made from them in ``words``."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

import numpy as np

from idm_env.discovery.compare import Comparison, ErrorChange

LEFT = 0.04
"""Gain in log RMSE of a smooth function of the state above which something is left to explain.

Drivers' own noise of 0.2 m/s² alone comes to 0.01 to 0.03: it has changed the state that the function sees.
"""


class Verdict(str, Enum):
    """What is said of the model on these data."""

    NONE = "none"
    UNDECIDED = "undecided"
    NAMED = "named"
    ONE_OF = "one_of"
    SHAPE = "shape"
    LOCATED = "located"
    UNEXPLAINED = "unexplained"
    CANNOT_TELL = "cannot_tell"


class Reason(str, Enum):
    """Why nothing (more) was added."""

    FEW_RUNS = "few_runs"
    NO_POWER = "no_power"
    NO_GAIN = "no_gain"
    SMALL_SHARE = "small_share"
    SMALL_SIZE = "small_size"
    CLOSED_LOOP = "free_simulation"
    TEST_SET = "lockbox"
    HELD_OUT = "held_out"
    LAW = "law"
    STRUCTURE = "structure"
    TAILS = "tails"


@dataclass(frozen=True)
class Refusal:
    """Why, and the figure that decided: runs left to choose on, the best candidate's share, the least size (m)."""

    reason: Reason
    figure: float = 0.0


HOLDS = 1.05
"""Ratio of the gap's error in free simulation, after / before, up to which an addition holds there.

Beyond chance it may not rise at all; drivers' own noise alone moves it by some percent.
"""


def improves(errors: Mapping[str, Comparison]) -> bool:
    """Tell whether a model may be called better than another.

    An error falls beyond chance and none rises so, be it that of all or the followers' ratios; their geometric mean
    falls; free simulation holds (``HOLDS``); and the median driver's error does not rise beyond chance.

    Args:
        errors: How errors changed where neither model was calibrated.
    """
    outcomes = [c.outcome for c in errors.values()]
    if ErrorChange.WORSE in outcomes or ErrorChange.BETTER not in outcomes:
        return False
    gap = errors.get("gap_rmse_m")
    holds = gap is None or not (gap.ratio > HOLDS or gap.most_worse)
    return holds and mean_ratio(errors) < 1.0


def mean_ratio(errors: Mapping[str, Comparison]) -> float:
    """Return the geometric mean of the ratios of errors, after / before; 1 where there is none."""
    ratios = [c.ratio for c in errors.values() if np.isfinite(c.ratio)]
    return float(np.exp(np.mean(np.log(ratios)))) if ratios else 1.0


def conclude(
    added: bool, named: bool, refusal: Refusal | None, structured: bool, left: np.ndarray, power: bool = True,
    shared: bool = False, apart: bool = True, in_a_state: bool = False, exact: bool = False, alike: bool = False,
) -> Verdict:  # fmt: skip
    """Return the verdict.

    Args:
        added: Whether anything was added to the model and held on the test set.
        named: Whether any of it is an effect of the catalogue.
        refusal: Why nothing was added.
        structured: Whether a candidate was significant at all.
        left: Gains [units] of any smooth function of the state over the null.
        power: Whether what is in the catalogue would have been found, were it there.
        shared: Whether vehicles of one run miss the model alike at one time.
        apart: Whether no other effect of the catalogue did about as well as one that was added.
        in_a_state: Whether all that was added acts in a state of the driver, and nothing at a place or a time.
        exact: Whether the model's errors are too small for anything to be missing.
        alike: Whether noise of drivers was held against the errors, and is not refused: where there is much of it, it
            leaves more than ``LEFT``.
    """
    if exact:
        return Verdict.NONE
    if added:
        if named:
            return Verdict.NAMED if apart else Verdict.ONE_OF
        return Verdict.SHAPE if in_a_state else Verdict.LOCATED
    if refusal is not None and refusal.reason is Reason.LAW:
        return Verdict.UNEXPLAINED
    if shared:
        return Verdict.LOCATED
    if refusal is not None and refusal.reason is Reason.FEW_RUNS:
        return Verdict.CANNOT_TELL
    error = left.std(ddof=1) / np.sqrt(len(left)) if len(left) > 1 else np.inf
    if structured or left.mean() > max(LEFT, 3.0 * error):
        return Verdict.UNDECIDED if alike and not structured else Verdict.UNEXPLAINED
    return Verdict.NONE if power else Verdict.CANNOT_TELL
