"""What a discovery says, as types: ``report.json`` has their fields as keys; pages and pictures are drawn from them.

A field whose default is None is left out of the file where it is None.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from idm_env.discovery.ladder import Ladder
from idm_env.discovery.rolled import Rolled
from idm_env.discovery.shared import Shared

SCHEMA = 3
Errors = dict[str, float]
"""Errors by the names of ``words.ERRORS``."""


@dataclass(frozen=True)
class ParameterEstimate:
    """A parameter of a finding: its symbol, value with 95 % interval, and unit."""

    symbol: str
    estimate: float
    low: float
    high: float
    unit: str


@dataclass(frozen=True)
class Location:
    """Where a finding acts: over which coordinate, between which values, and the places of a profile's knots."""

    coordinate: str
    interval: tuple[float | None, float | None]
    profile: dict[str, list[float]] | None = None


@dataclass(frozen=True)
class TermFinding:
    """A term that was added, or that came nearest: an effect of the catalogue, or a label without a name.

    ``equivalent`` are candidates that these data do not tell from it, ``rivals`` such that gain no less beyond chance.
    ``chosen_in_folds`` is the share of the folds of cross-fitting without which it would have been chosen, too.
    """

    effect: str | None
    label: str
    title: str
    equation: str
    clause: str
    equivalent: list[str]
    rivals: list[str]
    looks_like: list[str]
    told_by: str
    parameters: dict[str, ParameterEstimate]
    what: str
    where: Location
    p_value: float
    held_out_gain: float
    explained_share: float
    chosen_in_folds: float


@dataclass(frozen=True)
class GivenParameter:
    """A parameter that is part of every model compared."""

    effect: str | None
    parameter: str
    estimate: float
    low: float
    high: float


@dataclass(frozen=True)
class Change:
    """How an error changed on held-out runs, pooled and as the mean of drivers' own ratios, with 95 % intervals.

    ``interval`` is the one that the verdict goes by, in words.
    """

    verdict: str
    ratio: float
    low: float
    high: float
    before: float
    after: float
    unit: str
    drivers_ratio: float
    drivers_low: float
    drivers_high: float
    share_of_drivers_improved: float
    trimmed_before: float
    trimmed_after: float
    interval: str


@dataclass(frozen=True)
class DriverError:
    """A held-out driver's gap RMSE (m)."""

    driver: str
    before_m: float
    after_m: float


@dataclass(frozen=True)
class HeldOutErrors:
    """Errors on held-out runs; ``floor`` is what sensors alone would leave."""

    held_out_runs: list[str]
    held_out_drivers: list[DriverError]
    before: Errors | None
    after: Errors | None
    floor: Errors


@dataclass(frozen=True)
class Nearest:
    """What came nearest where nothing was added."""

    effect: str
    terms: list[TermFinding]
    explained_share: float
    after: Errors
    share_of_drivers_improved: float


@dataclass(frozen=True)
class Candidate:
    """A candidate in one round of the search; in round 0 are those that could not be tested."""

    round: int
    errors: str | None
    effect: str
    named: bool
    p_value: float | None
    held_out_gain: float | None
    interval: tuple[float | None, float | None]
    absorbed_share: float | None
    parameters: dict[str, float]
    units: dict[str, str]
    note: str


@dataclass(frozen=True)
class Excluded:
    """What the data say of the strength of an absent effect."""

    effect: str
    parameter: str
    unit: str
    estimate: float
    low: float
    high: float
    typical: float


@dataclass(frozen=True)
class Spread:
    """A parameter over drivers: median, the range of 80 % of them, and one driver's standard error (median)."""

    median: float
    low: float
    high: float
    standard_error: float


@dataclass(frozen=True)
class Moved:
    """A parameter of the drivers' own, with the null and with the model compared."""

    parameter: str
    before: Spread
    after: Spread


@dataclass(frozen=True)
class DataCard:
    """The data's card: counts of ``Trajectories.summary``, then what the search made of them."""

    source: str
    rows: int
    runs: int
    vehicles: int
    followers: int
    vehicle_seconds: float
    time_steps_s: list[float]
    place: str
    repairs: list[dict[str, Any]]
    by: str
    drivers: int
    records: int
    runs_to_choose_on: int
    smallest_p_value: float
    windows: int
    gap_noise_m: float
    residual_autocorrelation: float
    share_standing: float
    share_free: float
    share_approaching: float
    share_following: float
    at_bounds: dict[str, int]
    horizon_s: float
    lap_m: float | None


@dataclass(frozen=True)
class Weight:
    """Time (s) over which errors count as one beside the population's prior, and the gap RMSE (m) of all tried."""

    alike_s: float
    tried_s: Sequence[float]
    gap_rmse_m: Sequence[float]


@dataclass(frozen=True)
class Ceilings:
    """How much could be explained at all (see ``ceilings``), None where these data do not tell."""

    repeats_share: float | None
    refitted_gap_rmse_m: float | None
    smooth_function_gain: float | None


@dataclass(frozen=True)
class LawErrors:
    """A law alone: its errors, and how they compare with the null's; ``own`` are effects of each driver's strength.

    ``parameters`` is how many each driver has of his own. ``at_bounds`` is how many drivers have one of them at a
    bound, and ``without`` are the parts of the law that it was tried without.
    """

    base: str
    title: str
    equation: str
    own: list[str]
    without: list[str]
    parameters: int
    at_bounds: dict[str, int]
    gap_rmse_m: float
    horizon_rmse_m: float
    speed_rmse_mps: float
    gap_rmse_median_driver_m: float
    against: dict[str, Change]


@dataclass(frozen=True)
class Completed:
    """The law that effects were found on, where that is better than the one asked for, and all errors to the latter's.

    ``against`` compares the law with what was added to it.
    """

    base: str
    title: str
    own: list[str]
    against: dict[str, Change]


@dataclass(frozen=True)
class Kind:
    """Drivers (run/vehicle) who follow one law: its name, the values of the column that tell them, and their errors.

    ``errors`` are theirs with that law, ``with_one`` with the model that is best for all drivers together.
    """

    base: str
    title: str
    classes: list[str]
    drivers: list[str]
    errors: Errors
    with_one: Errors


@dataclass(frozen=True)
class Fleet:
    """Kinds of drivers, told by ``column`` or, where that is "", by their errors, in which halves of time ``agreed``.

    ``against`` are all drivers' errors to those of one model for all.
    """

    column: str
    kinds: list[Kind]
    agreed: int
    against: dict[str, Change]


@dataclass(frozen=True)
class Result:
    """Everything that a discovery says."""

    schema: int
    verdict: str
    reason: str | None
    sentence: str
    details: list[str]
    found: list[TermFinding]
    known: list[GivenParameter]
    helps: dict[str, Change]
    ladder: Ladder | None
    interval: str | None
    models: dict[str, str]
    error: HeldOutErrors
    partial: Nearest | None
    candidates: list[Candidate]
    shared: Shared | None
    excluded: list[Excluded]
    parameters: list[Moved]
    data: DataCard
    seed: int
    versions: Mapping[str, str]
    prior: Weight
    ceilings: Ceilings
    bases: list[LawErrors]
    completed: Completed | None
    fleet: Fleet | None
    rolled: dict[str, Rolled]
