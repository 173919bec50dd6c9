"""From many weighted futures to six: those that leave the least expected miss and distance, with their chances."""

import numpy as np

from idm_env.prediction.metrics import HORIZONS, MISS_M, at_two_hertz, speed_scale

MOST = 6
MOST_SAMPLES = 320


def select(futures: np.ndarray, weight: np.ndarray, speed: float, most: int = MOST) -> tuple[np.ndarray, np.ndarray]:
    """Return up to six futures [F, S, 2] and their confidences [F] from samples [N, S, 2].

    The first sample is always among them, so that nobody is predicted worse than by it. Then greedy: each choice lowers
    most the expected loss over the samples, were one of them to come true. Half of the loss of a sample is its distance
    d to the nearest choice in units of the benchmark's box, at most 1, so that what is missed anyway does not pull; the
    other half is ``d / (d + c)`` with c the mean distance between samples, so that a choice also comes near what it
    cannot hit.
    """
    if len(futures) > MOST_SAMPLES:
        keep = np.argsort(-np.concatenate([[np.inf], weight[1:]]), kind="stable")[:MOST_SAMPLES]
        futures, weight = futures[keep], weight[keep]
    weight = weight / weight.sum()
    loss = _loss(futures, speed)
    chosen, best = [0], loss[:, 0]
    for _ in range(min(most, len(futures)) - 1):
        gain = (weight[:, None] * np.maximum(best[:, None] - loss, 0.0)).sum(0)
        pick = int(np.argmax(gain))
        if gain[pick] <= 1e-9:
            break
        chosen.append(pick)
        best = np.minimum(best, loss[:, pick])
    return chances(futures, weight, futures[chosen], speed)


def chances(samples: np.ndarray, weight: np.ndarray, chosen: np.ndarray, speed: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the chosen futures [F, S, 2] (m) in the order of their confidence, and the confidences [F].

    ``samples`` [N, S, 2] (m) have the weights [N]; ``speed`` (m/s) sets the size of the box.

    The first is the one likeliest to hit, in the sense of the benchmark's box and on average over its horizons, were
    one of the samples to come true; each next one the likeliest to hit what those before it miss. That is what the
    confidence says, so that confidences compare between agents and what they leave to 1 is the chance of a miss.
    """
    hit = _hits(samples, chosen, speed)
    left = np.broadcast_to(weight, hit.shape[:2]).copy()
    order: list[int] = []
    confidence = []
    for _ in range(len(chosen)):
        mass = np.einsum("hn,hnf->f", left, hit) / len(hit)
        mass[order] = -1.0
        order.append(int(np.argmax(mass)))
        confidence.append(mass[order[-1]])
        left *= 1.0 - hit[:, :, order[-1]]
    return chosen[order], np.array(confidence)


def _hits(samples: np.ndarray, chosen: np.ndarray, speed: float) -> np.ndarray:
    """Return 1.0 where a chosen future ends within the box around a sample, [horizons, N, F]."""
    hits = []
    for seconds in HORIZONS:
        end = min(seconds * 10, samples.shape[1]) - 1
        moved = samples[:, end] - samples[:, max(end - 10, 0)]
        size = np.maximum(np.hypot(*moved.T), 1e-9)[:, None]
        # who has hardly moved in the last second has no direction: the tighter bound holds both ways
        along = np.where(size > 0.3, moved / size, np.array([1.0, 0.0]))
        apart = chosen[None, :, end] - samples[:, None, end]
        ahead = np.einsum("nfd,nd->nf", apart, along)
        left = along[:, :1] * apart[..., 1] - along[:, 1:] * apart[..., 0]
        lateral, longitudinal = (bound * speed_scale(speed) for bound in MISS_M[seconds])
        reach = np.where(size > 0.3, longitudinal, lateral)
        hits.append((np.abs(ahead) <= reach) & (np.abs(left) <= lateral))
    return np.stack(hits).astype(float)


def _loss(futures: np.ndarray, speed: float) -> np.ndarray:
    """Return the loss [N, N] of sample i if future j is chosen."""
    total = np.zeros((len(futures), len(futures)))
    for seconds in HORIZONS:
        steps = at_two_hertz(seconds)[-3:]
        if steps[-1] >= futures.shape[1]:
            continue
        box = MISS_M[seconds][1] * speed_scale(speed)
        points = futures[:, steps]
        distance = np.linalg.norm(points[:, None] - points[None], axis=-1).mean(-1)
        scale = float(distance.mean()) + 1e-6
        total += (0.5 * np.minimum(distance / (1.5 * box), 1.0) + 0.5 * distance / (distance + scale)) / len(HORIZONS)
    return total
