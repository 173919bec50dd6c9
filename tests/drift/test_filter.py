"""The filter against the same Gaussian written out in full."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("numba")

from idm_env.compiled.records import filter_loops as loops

SAMPLES, ROWS, K = 7, 2, 2
D = 2 + K


def problem() -> dict[str, np.ndarray]:
    """Return affine steps, measurements and settings of two drivers, of whom the second has a shorter record."""
    random = np.random.default_rng(0)

    def draw(*shape: int) -> np.ndarray:
        return random.normal(size=shape)

    steps = (SAMPLES - 1, ROWS, 2)
    return {
        "length": np.array([SAMPLES, SAMPLES - 2]),
        "measured_gap": draw(SAMPLES, ROWS), "measured_speed": draw(SAMPLES, ROWS),
        "to": draw(*steps), "by_state": draw(*steps, 2), "by_level": draw(*steps, K),
        "gap": draw(SAMPLES, ROWS), "speed": draw(SAMPLES, ROWS), "level": draw(SAMPLES, ROWS, K),
        "decay": np.array([0.9, 0.5]), "sigma": np.array([0.4, 0.7]), "noise": np.array([0.3, 0.2]), "jitter": 0.05,
    }  # fmt: skip


def written_out(q: dict, r: int) -> tuple[float, np.ndarray]:
    """Return log-likelihood and smoothed means of a driver, from the joint normal of all states and measurements."""
    count = int(q["length"][r])
    first = 2 + K
    # Every state is affine in independent normals: those of the beginning, then (levels, jitter) of every step.
    size = first + (count - 1) * (K + 1)
    deviation = np.concatenate((q["noise"], q["sigma"]))
    mean, factor = np.zeros((count, D)), np.zeros((count, D, size))
    mean[0] = [q["measured_gap"][0, r], q["measured_speed"][0, r], *np.zeros(K)]
    factor[0, :, :first] = np.diag(deviation)
    for t in range(count - 1):
        at = first + t * (K + 1)
        m, f = mean[t].copy(), factor[t].copy()
        m[2 : 2 + K] *= q["decay"]
        f[2 : 2 + K] *= q["decay"][:, None]
        for j in range(K):
            f[2 + j, at + j] += q["sigma"][j] * np.sqrt(1.0 - q["decay"][j] ** 2)
        slopes = np.concatenate((q["by_state"][t, r], q["by_level"][t, r]), 1)
        base = np.array([q["gap"][t, r], q["speed"][t, r], *q["level"][t + 1, r]])
        mean[t + 1], factor[t + 1] = m, f
        mean[t + 1, :2] = q["to"][t, r] + slopes @ (m - base)
        factor[t + 1, :2] = slopes @ f
        factor[t + 1, 1, at + K] += np.sqrt(q["jitter"])
    seen = factor[1:, :2].reshape(-1, size)
    measured = np.stack((q["measured_gap"][1:count, r], q["measured_speed"][1:count, r]), -1).ravel()
    covariance = seen @ seen.T + np.diag(np.tile(q["noise"] ** 2, count - 1))
    rest = measured - mean[1:, :2].ravel()
    _, log_det = np.linalg.slogdet(covariance)
    value = -0.5 * (rest @ np.linalg.solve(covariance, rest) + log_det + len(rest) * np.log(2.0 * np.pi))
    return float(value), mean + factor @ seen.T @ np.linalg.solve(covariance, rest)


def test_likelihood_and_smoothed_means_are_those_of_the_joint_normal() -> None:
    """Two drivers, two levels, records of unequal length."""
    q = problem()
    found = loops.likelihood(**q, skip=0)
    _, _, means = loops.smooth(**q)
    for r in range(ROWS):
        value, expected = written_out(q, r)
        assert found[r] == pytest.approx(value, rel=1e-9)
        np.testing.assert_allclose(means[: q["length"][r], r], expected, rtol=1e-8, atol=1e-9)
