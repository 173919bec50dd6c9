"""Adam through a whole rollout, compiled: run, compare, carry the adjoint back, step; no equation stands here."""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

import numpy as np

from idm_env.compiled.kernels.lane_adjoint import backward
from idm_env.compiled.kernels.lane_loops import MOVING, forward
from idm_env.compiled.kernels.tiles import exact


@exact
def seed(seeds, position, step, vehicle, target, weight, count):
    """Fill the adjoints of positions (steps, vehicles) for the weighted absolute errors of what was observed."""
    for o in range(len(step)):
        if step[o]:
            seeds[(step[o] - 1) * count + vehicle[o]] = 0.0
    for o in range(len(step)):
        if step[o]:
            cell = (step[o] - 1) * count + vehicle[o]
            seeds[cell] += weight[o] * np.sign(position[cell] - target[o])


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
def rows_of(places, table, which, count):
    """Fill the addresses of the rows (states, vehicles) of one of several tables that lie behind one another."""
    for i in range(len(places)):
        places[i] = table.ctypes.data + (which * len(places) + i) * count * table.itemsize


@exact
def descend(
    tape, block, kept, step, vehicle, target, weight, values, on_values, low, high, given, on_given, given_low,
    given_high, measures, phases, back, looks, recalls, sends, read, taped, again, operands, strides, k, steps, count,
    wide, tiles, iterations, rate_first, rate_last,
):  # fmt: skip
    """Move ``values`` (parameters, vehicles) and ``given`` (inputs, steps · vehicles), which ``operands`` point at.

    ``tape`` (blocks + 1, states, vehicles) holds the start and gets the states after every ``block`` steps. The last
    run fills ``kept``. Where ``given`` has no gradient (``on_given`` is empty) it stays as it is.
    """
    over, nothing = steps * (len(on_given) > 0), np.zeros(1)
    mean, square = np.zeros_like(values), np.zeros_like(values)
    given_mean, given_square = np.zeros_like(on_given), np.zeros_like(on_given)
    seeds = np.zeros(4 * steps * count)
    begins, ends = np.zeros(tape.shape[1], np.int64), np.zeros(tape.shape[1], np.int64)
    on = np.zeros((2, measures[MOVING], count))
    on_ends, on_begins = np.zeros(measures[MOVING], np.int64), np.zeros(measures[MOVING], np.int64)
    on_strides = np.ones((measures[MOVING], 3), np.int64)
    none, blocks = nothing.ctypes.data, len(tape) - 1
    for turn in range(iterations + 1):
        for b in range(blocks):
            rows_of(begins, tape, b, count)
            rows_of(ends, tape, b + 1, count)
            forward(
                begins, ends, none, False, none, 0, kept.ctypes.data, steps, measures, phases, looks, recalls, read,
                operands, strides, k, b * block, min(block, steps - b * block), count, 1, wide, 0, 0, tiles,
            )  # fmt: skip
        if turn == iterations:
            return
        seed(seeds, kept, step, vehicle, target, weight, count)
        for b in range(blocks - 1, -1, -1):
            rows_of(begins, tape, b, count)
            if b + 1 < blocks:
                rows_of(on_ends, on, (b + 1) % 2, count)
            else:
                on_ends[:] = 0
            rows_of(on_begins, on, b % 2, count)
            backward(
                begins, none, False, 0, seeds.ctypes.data, steps, on_ends, on_strides, on_begins, none, none,
                on_values.ctypes.data, b + 1 == blocks, on_given.ctypes.data, over, measures, phases, looks, recalls,
                back, sends, taped, again, operands, strides, k, b * block, min(block, steps - b * block), count, 1,
                wide, 0, 0, tiles,
            )  # fmt: skip
        rate = rate_first + (rate_last - rate_first) * turn / iterations
        adam(values, on_values, mean, square, low, high, rate, turn)
        if over:
            adam(given, on_given, given_mean, given_square, given_low, given_high, rate, turn)
