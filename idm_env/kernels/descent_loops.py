"""Adam through a whole rollout, compiled: run, compare, carry the adjoint back, step; no equation stands here."""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

import numpy as np

from idm_env.kernels.lane_adjoint import backward
from idm_env.kernels.lane_loops import MOVING, forward
from idm_env.kernels.tiles import exact


@exact
def seed(seeds, position, step, vehicle, target, weight, count):
    """Fill the adjoints of positions (steps, vehicles) for the weighted absolute errors of what was observed."""
    for o in range(len(step)):
        if step[o]:
            seeds[(step[o] - 1) * count + vehicle[o]] = 0.0
    for o in range(len(step)):
        if step[o]:
            at = (step[o] - 1) * count + vehicle[o]
            seeds[at] += weight[o] * np.sign(position[at] - target[o])


@exact
def adam(value, gradient, mean, square, low, high, rate, turn):
    """Take step ``turn`` of Adam (Kingma and Ba 2015; β 0.9 and 0.999, ε 1e-8), then go back between the bounds."""
    first, second = 1.0 - 0.9 ** (turn + 1), 1.0 - 0.999 ** (turn + 1)
    for i in range(value.shape[0]):
        for j in range(value.shape[1]):
            g = gradient[i, j]
            mean[i, j] += 0.1 * (g - mean[i, j])
            square[i, j] += 0.001 * (g * g - square[i, j])
            moved = value[i, j] - rate * (mean[i, j] / first) / (np.sqrt(square[i, j] / second) + 1e-8)
            value[i, j] = min(max(moved, low[i, j]), high[i, j])


@exact
def descend(
    start, ends, nothing, kept, seeds, step, vehicle, target, weight, values, on_values, low, high, given, on_given,
    given_low, given_high, measures, phases, back, looks, recalls, sends, read, taped, again, operands, strides, k,
    steps, rows, size, wide, around, tiles, iterations, rate_first, rate_last,
):  # fmt: skip
    """Move ``values`` (parameters, vehicles) and ``given`` (inputs, steps · vehicles), which ``operands`` point at.

    The last run fills ``kept``. Where ``given`` has no gradient (``on_given`` is empty) it stays as it is.
    """
    count, moves = rows * size, len(on_given) > 0
    mean, square = np.zeros_like(values), np.zeros_like(values)
    given_mean, given_square = np.zeros_like(on_given), np.zeros_like(on_given)
    no_seeds = np.zeros((max(measures[MOVING], 1), 3), np.int64)
    none = np.zeros(max(measures[MOVING], 1), np.int64)
    for turn in range(iterations + 1):
        forward(
            start, ends, nothing.ctypes.data, False, nothing.ctypes.data, 0, kept.ctypes.data, steps, measures, phases,
            looks, recalls, read, operands, strides, k, 0, steps, rows, size, wide, around, 0, tiles,
        )  # fmt: skip
        if turn == iterations:
            return
        seed(seeds, kept, step, vehicle, target, weight, count)
        backward(
            start, nothing.ctypes.data, False, 0, seeds.ctypes.data, steps, none, no_seeds, none, nothing.ctypes.data,
            nothing.ctypes.data, on_values.ctypes.data, True, on_given.ctypes.data, steps * moves, measures, phases,
            looks, recalls, back, sends, taped, again, operands, strides, k, 0, steps, rows, size, wide, around, 0,
            tiles,
        )  # fmt: skip
        rate = rate_first + (rate_last - rate_first) * turn / iterations
        adam(values, on_values, mean, square, low, high, rate, turn)
        if moves:
            adam(given, on_given, given_mean, given_square, given_low, given_high, rate, turn)
