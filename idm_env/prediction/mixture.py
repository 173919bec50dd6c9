"""How many road users keep their velocity, keep their motion loosely, or drive on a lane: by kind and pace, by counts.

The futures of an agent are a mixture of these ways. A way explains an agent as far as its futures hit the truth (the
benchmark's box), so with p_ic the share of way c's futures that hit agent i and w the shares, the likelihood is
∏ᵢ Σ_c w_c p_ic. Its maximum under a Dirichlet prior of equal shares, worth ``PRIOR_AGENTS``, is found by EM. Agents
that stand are counted apart from those that move, and no kind lends to another.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from idm_env.prediction.metrics import HORIZONS, Case, hits

WAYS = ("keeps", "loose", "lane")
STANDING_MPS = 0.5
"""Slower agents stand (m/s)."""
PRIOR_AGENTS = 2.0
NOT_HIT = 1e-3
"""Chance (per way) that an agent ends where none of its futures does."""

Shares = dict[tuple[str, str], tuple[float, ...]]
"""(kind, pace) → shares of ``WAYS``, which sum to 1."""

SHARES: Shares = {
    ("vehicle", "standing"): (0.838, 0.136, 0.026),  # 64 agents
    ("vehicle", "moving"): (0.086, 0.180, 0.734),  # 18 agents
    ("pedestrian", "standing"): (0.500, 0.500, 0.000),  # 0 agents
    ("pedestrian", "moving"): (0.399, 0.601, 0.000),  # 4 agents
    ("cyclist", "standing"): (0.333, 0.333, 0.333),  # 0 agents
    ("cyclist", "moving"): (0.260, 0.355, 0.385),  # 1 agents
}
"""Fitted by ``python -m benchmarks.prediction FILE… --shares`` to three scenes of the Waymo Open Motion Dataset."""


@dataclass(frozen=True, eq=False)
class Seen:
    """One agent whose future is known: the share [H, 3] of each way's futures that hit it, per known horizon.

    NaN where it has no such futures (no lane).
    """

    kind: str
    pace: str
    hit: np.ndarray


def pace_of(speed: float) -> str:
    """Return ``standing`` or ``moving``."""
    return "standing" if speed < STANDING_MPS else "moving"


def share_of(shares: Shares, kind: str, speed: float, on_lane: bool) -> np.ndarray:
    """Return the shares [3] for an agent at ``speed`` (m/s); off the lanes the others fill the lanes' place.

    Kinds that the table lacks are taken as vehicles.
    """
    pace = pace_of(speed)
    share = np.array(shares.get((kind, pace), shares["vehicle", pace]))
    if not on_lane:
        share[-1] = 0.0
    return np.asarray(share / share.sum())


def score_hits(case: Case, futures: Sequence[np.ndarray], weights: Sequence[np.ndarray]) -> Seen | None:
    """Return how the futures [N, S, 2] of each way, with weights [N], hit the truth of a case; None without a truth."""
    rows = []
    for seconds in HORIZONS:
        reached = [hits(replace(case, futures=one), seconds) if len(one) else None for one in futures]
        if any(hit is not None for hit in reached):
            parts = zip(reached, weights, strict=True)
            rows.append([np.nan if hit is None else float((hit * w).sum() / w.sum()) for hit, w in parts])
    return Seen(case.kind, pace_of(case.speed), np.array(rows)) if rows else None


def fit_shares(agents: Iterable[Seen]) -> Shares:
    """Return the shares of every kind and pace; those of which no agent is seen keep the prior."""
    every = list(agents)
    shares: Shares = {}
    for kind, pace in SHARES:
        prior = np.array([0.5, 0.5, 0.0] if kind == "pedestrian" else [1 / 3, 1 / 3, 1 / 3])
        group = [one.hit for one in every if (one.kind, one.pace) == (kind, pace)]
        shares[kind, pace] = tuple(float(x) for x in _expectation_maximisation(group, prior))
    return shares


def _expectation_maximisation(group: Sequence[np.ndarray], prior: np.ndarray) -> np.ndarray:
    """Return the shares of highest posterior density; every agent counts once, evenly over its horizons."""
    if not group:
        return prior
    chance = np.concatenate(group) + NOT_HIT
    counted = np.concatenate([np.full(len(hit), 1.0 / len(hit)) for hit in group])
    finite = np.isfinite(chance)
    share = prior
    for _ in range(200):
        # what an agent cannot do tells nothing of its share: there it explains as well as the others on average
        mean = (share * np.where(finite, chance, 0.0)).sum(-1) / (share * finite).sum(-1)
        part = share * np.where(finite, chance, mean[:, None])
        part = part / part.sum(-1, keepdims=True)
        share = PRIOR_AGENTS * prior + counted @ part
        share = share / share.sum()
    return np.asarray(share)
