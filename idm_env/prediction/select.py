"""From many weighted futures to six: those that leave the least expected miss and distance."""

from __future__ import annotations

import numpy as np

from idm_env.prediction.metrics import HORIZONS, MISS_M, at_two_hertz, speed_scale

MOST = 6
MOST_SAMPLES = 320


def select(
    futures: np.ndarray, weight: np.ndarray, speed: float, most: int = MOST
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return up to six futures [F, S, 2] and their confidences [F], which sum to 1, from samples [N, S, 2].

    Greedy: each choice lowers most the expected loss over the samples, were one of them to come true. Half of the loss
    of a sample is its distance d to the nearest choice in units of the benchmark's box, at most 1, so that what is
    missed anyway does not pull; the other half is ``d / (d + c)`` with c the mean distance between samples, so that a
    choice also comes near what it cannot hit. A confidence is the weight of the samples that a choice is nearest to.
    """
    if len(futures) > MOST_SAMPLES:
        keep = np.argsort(-weight, kind="stable")[:MOST_SAMPLES]
        futures, weight = futures[keep], weight[keep]
    weight = weight / weight.sum()
    loss = _loss(futures, speed)
    best = np.ones(len(futures))
    chosen: list[int] = []
    for _ in range(min(most, len(futures))):
        gain = (weight[:, None] * np.maximum(best[:, None] - loss, 0.0)).sum(0)
        pick = int(np.argmax(gain))
        if gain[pick] <= 1e-9:
            break
        chosen.append(pick)
        best = np.minimum(best, loss[:, pick])
    chosen = chosen or [int(np.argmax(weight))]
    nearest = np.argmin(loss[:, chosen], axis=1)
    confidence = np.bincount(nearest, weight, minlength=len(chosen))
    order = np.argsort(-confidence, kind="stable")
    return futures[np.array(chosen)[order]], confidence[order]


def _loss(futures: np.ndarray, speed: float) -> np.ndarray:
    """Return the loss [N, N] of sample i if future j is chosen."""
    total = np.zeros((len(futures), len(futures)))
    for seconds in HORIZONS:
        at = at_two_hertz(seconds)[-3:]
        if at[-1] >= futures.shape[1]:
            continue
        box = MISS_M[seconds][1] * speed_scale(speed)
        points = futures[:, at]
        distance = np.linalg.norm(points[:, None] - points[None], axis=-1).mean(-1)
        scale = float(distance.mean()) + 1e-6
        total += (0.5 * np.minimum(distance / (1.5 * box), 1.0) + 0.5 * distance / (distance + scale)) / len(HORIZONS)
    return total
