"""One fused step for environments without records: IDM, brakes, noise and commands on a ring or in a lane.

The values are those of ``Simulator.step`` to rounding (the equations are ``idm_env.kernels``'s, and a test
compares), and a row does not depend on how many others there are; but a step costs tens of microseconds instead of
two hundred. It builds no graph: environments with torch output never use it. Needs numba: ``pip install
'idm-env[kernels]'``.
"""

# mypy: disable-error-code="no-untyped-def"
from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from idm_env.effects import Brakes
from idm_env.kernels.equations import brake, constants, exact, follow, integrate, inverses, unpack
from idm_env.roads import Ring
from idm_env.simulator import Simulator
from idm_env.types import Inputs, Params, State

_IDM = ("max_accel", "comfort_decel", "time_gap", "min_gap", "desired_speed")


@exact
def _advance(position, speed, gap, p, normals, command, active, ring, euler, c, out):
    """Write position, speed, acceleration and gap after one step into ``out`` (4, rows, vehicles)."""
    k = unpack(c)
    rows, size = speed.shape
    several = p.shape[1] > 1
    moved = np.empty(size, speed.dtype)
    ahead = np.empty(size, speed.dtype)
    wanted = np.empty(size, speed.dtype)
    led = np.ones(size, speed.dtype)
    if not ring:
        led[0] = k.zero
    for row in range(rows):
        q = row if several else 0
        ahead[1:] = speed[row, : size - 1]
        ahead[0] = speed[row, size - 1] if ring else speed[row, 0]
        for i in range(size):
            wanted[i] = follow(
                gap[row, i], speed[row, i], ahead[i], led[i],
                p[0, q, i], p[7, q, i], p[2, q, i], p[3, q, i], p[8, q, i], k,
            ) + p[6, q, i] * normals[row, i]  # fmt: skip
        for i in range(size):
            if active[row, i]:
                wanted[i] = command[row, i]
        for i in range(size):
            accel = brake(wanted[i], speed[row, i], p[5, q, i], euler, k)
            way, after, felt = integrate(speed[row, i], accel, euler, k)
            moved[i] = way
            out[0, row, i] = position[row, i] + way
            out[1, row, i] = after
            out[2, row, i] = felt
        out[3, row, 0] = gap[row, 0] + (moved[size - 1] - moved[0]) if ring else gap[row, 0]
        for i in range(1, size):
            out[3, row, i] = gap[row, i] + (moved[i - 1] - moved[i])


@exact
def _run(start, p, normals, steps, ring, euler, c, out):
    """Repeat ``_advance`` without any command; ``normals`` (steps, rows, vehicles) or no steps at all."""
    _, rows, size = start.shape
    command = np.zeros((rows, size), start.dtype)
    active = np.zeros((rows, size), np.bool_)
    none = np.zeros((rows, size), start.dtype)
    here = start.copy()
    for t in range(steps):
        noise = normals[t] if normals.shape[0] > 0 else none
        _advance(here[0], here[1], here[3], p, noise, command, active, ring, euler, c, out)
        here[:] = out


@exact
def _prepare(p, c):
    """Fill rows 7 and 8 with ``1/(2√(ab))`` and ``1/v0``."""
    k = unpack(c)
    for row in range(p.shape[1]):
        for i in range(p.shape[2]):
            p[7, row, i], p[8, row, i] = inverses(p[0, row, i], p[1, row, i], p[4, row, i], k)


class FusedStep:
    """``advance(state, inputs, params)`` for simulators of IDM, Brakes, and perhaps Control and white Noise.

    Parameters are packed into one array, anew whenever a tensor of theirs is another or has been written to.
    """

    def __init__(self, simulator: Simulator, dtype: torch.dtype) -> None:
        brakes = simulator.by_name["brakes"]
        assert isinstance(brakes, Brakes)
        self._kind = np.dtype(np.float64 if dtype == torch.float64 else np.float32)
        self._constants = constants(simulator.dt, brakes.width, self._kind)
        self._ring = isinstance(simulator.road, Ring)
        self._euler = simulator.integration == "euler"
        self._noisy = "noise" in simulator.by_name
        self._packed_of: list[tuple[Tensor, int]] = []
        self._packed = np.zeros((9, 1, 0), self._kind)

    def __call__(self, state: State, inputs: Inputs, params: Params) -> State:
        """Return the state Δt later."""
        shape = state.speed.shape
        command, active = inputs["control"]
        normals = inputs.get("noise")
        out = np.empty((4, *shape), self._kind)
        _advance(
            np.ascontiguousarray(state.position.numpy()),
            np.ascontiguousarray(state.speed.numpy()),
            np.ascontiguousarray(state.gap.numpy()),
            self._pack(params, shape),
            np.zeros(shape, self._kind) if normals is None else np.ascontiguousarray(normals.numpy()),
            np.broadcast_to(command.numpy(), shape),
            np.broadcast_to(active.numpy(), shape),
            self._ring,
            self._euler,
            self._constants,
            out,
        )
        return _state(state, out, 1)

    def run(self, state: State, normals: Tensor | None, params: Params, steps: int) -> State:
        """Return the state after steps in which nobody is commanded; ``normals`` has a leading time dimension."""
        shape = state.speed.shape
        start = np.stack([x.numpy() for x in (state.position, state.speed, state.accel, state.gap)])
        noise = np.zeros((0, *shape), self._kind) if normals is None else np.ascontiguousarray(normals.numpy())
        out = start.copy()
        _run(start, self._pack(params, shape), noise, steps, self._ring, self._euler, self._constants, out)
        return _state(state, out, steps)

    def _pack(self, params: Params, shape: torch.Size) -> np.ndarray:
        """Return nine rows of parameters, (9, 1 or rows, vehicles)."""
        values = [params["idm"][name] for name in _IDM]
        values.append(params["brakes"]["max_decel"])
        if self._noisy:
            values.append(params["noise"]["sigma"])
        known = self._packed_of
        same = len(known) == len(values) and all(
            a is b and version == a._version for a, (b, version) in zip(values, known, strict=True)
        )
        rows = shape[0] if any(x.dim() > 1 and x.shape[0] > 1 for x in values) else 1
        if not same or self._packed.shape[1:] != (rows, shape[1]):
            self._packed = np.zeros((9, rows, shape[1]), self._kind)
            for slot, value in zip(self._packed, values, strict=False):
                slot[:] = value.detach().numpy()
            _prepare(self._packed, self._constants)
            self._packed_of = [(x, x._version) for x in values]
        return self._packed


def _state(state: State, out: np.ndarray, steps: int) -> State:
    position, speed, accel, gap = torch.from_numpy(out).unbind(0)
    return state._replace(position=position, speed=speed, accel=accel, gap=gap, step=state.step + steps)


def fits(simulator: Simulator) -> bool:
    """Return whether ``FusedStep`` does what this simulator's ``step`` does."""
    from idm_env.kernels.dispatch import unfit

    return unfit(simulator) is None and "replay" not in simulator.by_name and simulator.integration != "midpoint"
