"""How many road users keep their velocity, keep their motion loosely, or drive on a lane: by kind and pace, by counts.

The futures of an agent are a mixture of these ways. A way explains an agent as far as its futures hit the truth (the
benchmark's box), so with p_ic the share of way c's futures that hit agent i and w the shares, the likelihood is
∏ᵢ Σ_c w_c p_ic. Its maximum under a Dirichlet prior of equal shares, worth two agents, is found by EM
(``benchmarks/prediction.py``). Agents that stand are counted apart from those that move, and no kind lends to another.
"""

import numpy as np

WAYS = ("keeps", "loose", "lane")
STANDING_MPS = 0.5
"""Slower agents stand (m/s)."""

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
