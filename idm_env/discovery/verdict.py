"""What a discovery concludes: enums that decide; sentences are made from them in ``words``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

import numpy as np

from idm_env.discovery.compare import Comparison, Light

LEFT = 0.04
"""Gain in log RMSE of a smooth function of the state above which something is left to explain.

Drivers' own noise of 0.2 m/s² alone comes to 0.01 to 0.03: it has changed the state that the function sees.
"""


class Verdict(str, Enum):
    """What is said of the model on these data."""

    NONE = "none"
    NAMED = "named"
    LOCATED = "located"
    UNEXPLAINED = "unexplained"
    CANNOT_TELL = "cannot_tell"


class Reason(str, Enum):
    """Why nothing (more) was added."""

    FEW_RUNS = "few_runs"
    NO_GAIN = "no_gain"
    SMALL_SHARE = "small_share"
    FREE_SIMULATION = "free_simulation"
    LOCKBOX = "lockbox"
    HELD_OUT = "held_out"


@dataclass(frozen=True)
class Refusal:
    """Why, and the figure that decided: runs left to choose on, or the share that the best candidate explains."""

    reason: Reason
    figure: float = float("nan")


def improves(errors: Mapping[str, Comparison]) -> bool:
    """Tell whether a model may be called better: not if every error rises, or one is worse and none better."""
    lights = {c.light for c in errors.values()}
    falls = any(c.ratio < 1.0 for c in errors.values())
    return falls and (Light.WORSE not in lights or Light.BETTER in lights)


def conclude(added: bool, named: bool, refusal: Refusal | None, structured: bool, left: np.ndarray) -> Verdict:
    """Return the verdict.

    Args:
        added: Whether anything was added to the model and held on the runs kept back.
        named: Whether any of it is an effect of the catalogue.
        refusal: Why nothing was added.
        structured: Whether a candidate was significant at all.
        left: Gains [runs] of any smooth function of the state over the null.
    """
    if added:
        return Verdict.NAMED if named else Verdict.LOCATED
    if refusal is not None and refusal.reason is Reason.FEW_RUNS:
        return Verdict.CANNOT_TELL
    error = left.std(ddof=1) / np.sqrt(len(left)) if len(left) > 1 else np.inf
    return Verdict.UNEXPLAINED if structured or left.mean() > max(LEFT, 3.0 * error) else Verdict.NONE
