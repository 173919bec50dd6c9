"""Many small fits at once: parameters and inputs of a simulator by Adam on positions that were observed.

Each vehicle has a lane, values and observations of its own; they share nothing but the loop.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from idm_env.compiled.kernels import descent_loops, tiles
from idm_env.compiled.kernels.lanes import part_of, starts, static_of
from idm_env.compiled.kernels.memory import addresses
from idm_env.compiled.kernels.operands import dense, operand, table
from idm_env.compiled.kernels.printed import tile_kernel
from idm_env.compiled.kernels.tiles import Array
from idm_env.compiled.scalar.record import Form, slot_name
from idm_env.simulator import Simulator
from idm_env.types import Inputs, Params, State
from idm_env.validation import nearest

Bounds = Mapping[str, tuple[float, float]]
"""Lowest and highest value by full name (``idm.time_gap``, ``imagined.gap``); what is not named stays as it is."""


BLOCK = 256
"""Steps between two states of the tape."""


class Observed(NamedTuple):
    """Positions (m) of vehicles by number after so many steps, 0 for the start, and the weights of their errors."""

    step: Array
    vehicle: Array
    position: Array
    weight: Array


class DescentResult(NamedTuple):
    """Values [vehicles] and inputs [steps, vehicles] by full name; motion [steps + 1, vehicles], the start first.

    ``accel`` is the acceleration of the step before, as in a state (m/s²).
    """

    params: dict[str, Array]
    inputs: dict[str, Array]
    position: Array
    speed: Array
    accel: Array


def descend(
    simulator: Simulator, state: State, inputs: Inputs, params: Params, steps: int, observed: Observed, bounds: Bounds,
    *, iterations: int, rates: tuple[float, float],
) -> DescentResult:  # fmt: skip
    """Minimise Σ weight · |position − observed| of a state ``(vehicles, 1)`` in float64, by Adam between bounds.

    The learning rate falls linearly from the first of ``rates`` to the second. ImportError without numba; ValueError
    for effects that cannot be compiled, and for bounds of what nobody reads.
    """
    kernel = tile_kernel(simulator, Form.of(state, inputs))
    if isinstance(kernel, str) or kernel.signals:
        raise ValueError(
            kernel if isinstance(kernel, str) else "an effect looks back in time, and no past is kept here."
        )
    slots = {slot_name(*name.split(".", 1)): name for name in bounds}
    for slot, name in slots.items():
        if name not in kernel.program.parameters and slot not in kernel.numbers:
            raise ValueError(f"bounds of '{name}': no such number is read.{nearest(name, kernel.program.parameters)}")
    program, shape = kernel.program, tuple(state.speed.shape)
    count = shape[0]
    values = np.array([dense(static_of(simulator, state, params, n).double(), shape) for n in program.parameters])
    parts = [dense(part_of(inputs, n)[:steps].double(), (steps, *shape)) for n in kernel.numbers]
    series = np.array(parts).reshape(len(parts), steps * count)
    low, high = _limits(values, [bounds.get(n) for n in program.parameters])
    given_low, given_high = _limits(series, [bounds.get(slots.get(n, "")) for n in kernel.numbers])
    moves = any(n in slots for n in kernel.numbers)
    operands = [operand(static_of(simulator, state, params, n).double(), shape[:-1], 1) for n in program.statics]
    operands += [(x, (0, 1, 1)) for x in values] + [(x, (count, 1, 1)) for x in series]
    operands += [operand(part_of(inputs, n), shape[:-1], 1, steps) for n in kernel.flags]
    blocks = -(-steps // BLOCK)
    tape = np.zeros((blocks + 1, len(program.states), count))
    tape[0] = [dense(x.double(), shape) for x in starts(state, program.states)]
    motion, wide, kind = np.zeros((4, steps, count)), tiles.width(1, 0), "float64"
    descent_loops.descend(
        tape, BLOCK, motion.reshape(-1), *observed, values, np.zeros_like(values), low, high, series,
        np.zeros_like(series if moves else series[:0]), given_low, given_high, kernel.measures, kernel.forward(kind),
        kernel.backward(kind), kernel.looks, kernel.recalls, kernel.sends, kernel.read, kernel.taped, kernel.again,
        addresses([x for x, _ in operands]), table([*(s for _, s in operands), (0, 1, 1)]), kernel.constants[kind],
        steps, count, wide, tiles.tiles(count, 1, wide, 0), iterations, *rates,
    )  # fmt: skip
    first = [dense(x, shape)[None] for x in (state.position, state.speed, state.accel)]
    return DescentResult(
        dict(zip(program.parameters, values, strict=True)),
        {slots[n]: x.reshape(steps, count) for n, x in zip(kernel.numbers, series, strict=True) if n in slots},
        *(np.concatenate((x, y)) for x, y in zip(first, motion[:3], strict=True)),
    )


def _limits(values: Array, bounds: Sequence[tuple[float, float] | None]) -> tuple[Array, Array]:
    """Return lowest and highest values in the shape of ``values``: what has no bounds stays where it is."""
    free = [
        (np.full_like(x, b[0]), np.full_like(x, b[1])) if b else (x, x) for x, b in zip(values, bounds, strict=True)
    ]
    low, high = zip(*free, strict=True) if free else ((), ())
    return np.array(low).reshape(values.shape), np.array(high).reshape(values.shape)
