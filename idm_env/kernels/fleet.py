"""Batches of rings or lanes that are stepped in place: no allocation, no graph, a few microseconds per call.

For environments and searches that need values only. ``rings_step`` is the whole interface in one call::

    fleet = Fleet(simulator, state, params)
    rings_step(fleet)                                        # one step
    rings_step(fleet, 10, {"control": Command(accel, active), "noise": normals})   # ten
    fleet.gap, fleet.speed                                   # numpy, (rows, vehicles), always the present
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from idm_env.kernels import dispatch, lane_loops, tiles
from idm_env.kernels import threads as pool
from idm_env.kernels.equations import Array, constants
from idm_env.kernels.lanes import PARAMETERS
from idm_env.kernels.operands import operand, table
from idm_env.roads import Ring
from idm_env.simulator import Simulator
from idm_env.types import Inputs, Params, State


class Fleet:
    """The state of many rings or lanes in arrays of its own, with everything that a step needs laid out once.

    ``gap``, ``speed``, ``position`` and ``accel`` are numpy arrays ``(rows, vehicles)`` that ``rings_step`` overwrites;
    writing to them between steps (a reset of some rows) is allowed. Effects: IDM and Brakes, and by inputs Control,
    Replay and white Noise. Parameters are those at the time of construction; ``set_params`` replaces them.

    ValueError for a simulator without a kernel, and for rows longer than a tile.
    """

    def __init__(self, simulator: Simulator, state: State, params: Params) -> None:
        why = dispatch.unfit(simulator)
        if why is not None:
            raise ValueError(f"this simulator has no kernel: {why}. Use simulator.step.")
        *batch, size = state.speed.shape
        if size > tiles.TILE:
            raise ValueError(f"rows of {size} vehicles do not fit a tile of {tiles.TILE}. Use simulator.rollout.")
        self.simulator = simulator
        self.batch = tuple(batch)
        self._start = state
        rows = int(np.prod(batch, dtype=np.int64))
        columns = (state.gap, state.speed, state.position, state.accel)
        self._flat = [x.detach().expand(state.speed.shape).contiguous().clone().view(-1).numpy() for x in columns]
        self.gap, self.speed, self.position, self.accel = (x.reshape(rows, size) for x in self._flat)
        self.rows, self.size, self.step = rows, size, 0
        kind = self.speed.dtype
        names = simulator.by_name
        self._constants = constants(simulator.dt, names["brakes"].width, kind)  # type: ignore[attr-defined]
        self._has = (lane_loops.EULER if simulator.integration == "euler" else 0) | (
            lane_loops.RING if isinstance(simulator.road, Ring) else 0
        )
        if state.present is not None:
            self._has |= lane_loops.COMES_AND_GOES
        self._nothing = np.zeros(1, kind)
        self._no_flag = np.zeros(1, np.uint8)
        self._kept = np.zeros((4, 0, 1), kind)
        self.set_params(params)

    def set_params(self, params: Params) -> None:
        """Replace the parameters; they hold from the next step on."""
        state = self._start
        values: list[Tensor] = [params["idm"][name] for name in PARAMETERS]
        values.append(params["brakes"]["max_decel"])
        if "noise" in self.simulator.by_name:
            values.append(params["noise"]["sigma"])
        led = self.simulator.road.leader_present(state.present, state.speed)
        made = [operand(x, self.batch, self.size) for x in (led, *values)]
        made += [(self._nothing, (0, 0, 0))] * (lane_loops.OPERANDS - len(made))
        self._operands = [a for a, _ in made]
        self._strides = table([*(s for _, s in made), (0, 0, 0), (0, 0, 0), (0, self.size, 1)])

    def inputs(self, inputs: Inputs, steps: int) -> tuple[list[Array], list[Array], Array, int]:
        """Return operands, flags, strides and the bits of what is given."""
        operands, strides, has = list(self._operands), self._strides.copy(), self._has
        flags = [self._no_flag, self._no_flag]

        def put(slot: int, tensor: Tensor) -> None:
            operands[slot], strides[slot] = operand(tensor, self.batch, self.size, steps)

        def flag(slot: int, tensor: Tensor) -> None:
            flags[slot], strides[lane_loops.OPERANDS + slot] = operand(tensor, self.batch, self.size, steps)

        if "noise" in inputs:
            has |= lane_loops.NOISE
            put(lane_loops.O_NORMALS, inputs["noise"])
        if "control" in inputs:
            has |= lane_loops.CONTROL
            put(lane_loops.O_COMMAND, inputs["control"].accel)
            flag(lane_loops.F_ACTIVE, inputs["control"].active)
        if "replay" in inputs:
            has |= lane_loops.REPLAY
            for i, column in enumerate(inputs["replay"][:3]):
                put(lane_loops.O_PLACE + i, column)
            flag(lane_loops.F_PLACED, inputs["replay"].active)
        return operands, flags, strides, has

    def state(self) -> State:
        """Return the present as a ``State``, copied."""
        shape = (*self.batch, self.size)
        gap, speed, position, accel = (torch.from_numpy(x.copy()).view(shape) for x in self._flat)
        start = self._start
        return start._replace(gap=gap, speed=speed, position=position, accel=accel, step=start.step + self.step)


def rings_step(fleet: Fleet, steps: int = 1, inputs: Inputs | None = None, *, threads: int | None = None) -> None:
    """Advance a fleet by ``steps``, in place; ``inputs`` as in ``Simulator.rollout``, with a leading time dimension.

    Values are those of ``Simulator.rollout``'s kernel, to the bit. ``threads`` None decides by the size of the work.
    """
    if inputs:
        operands, flags, strides, has = fleet.inputs(inputs, steps)
    else:
        operands, flags = fleet._operands, [fleet._no_flag, fleet._no_flag]
        strides, has = fleet._strides, fleet._has
    gap, speed, position, accel = fleet._flat
    wide = tiles.width(fleet.size, steps)
    count = tiles.tiles(fleet.rows, fleet.size, steps, wide)
    packed = (tuple(operands), tuple(flags), strides, 0, steps, fleet.rows, fleet.size, wide, has, fleet._constants)
    pool.split(
        lambda begin, end: lane_loops.forward(
            gap, speed, position, gap, speed, position, accel, fleet._kept, *packed, begin, end
        ),
        count, 1, pool.count(fleet.rows * fleet.size * steps, threads),
    )  # fmt: skip
    fleet.step += steps


__all__ = ["Fleet", "rings_step"]
