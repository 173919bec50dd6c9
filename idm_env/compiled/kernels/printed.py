"""Kernels of recorded simulators: phases that ``scalar`` prints, compiled, and where the loops find everything.

Everything here is looked up by what shapes a step: road, effects with their static choices, integration, and which
inputs, memories and presence there are.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import cached_property, lru_cache
from typing import Any, TypeVar

import numpy as np

from idm_env.compiled.kernels.reads import Reads
from idm_env.compiled.kernels.tiles import ROW, Array
from idm_env.compiled.scalar import library
from idm_env.compiled.scalar.program import PHASES, Program
from idm_env.compiled.scalar.record import Form, Untraceable, record
from idm_env.compiled.scalar.source import row
from idm_env.compiled.scalar.tiles import TileText
from idm_env.effects.base import Effect
from idm_env.roads import Lane, Ring, Road
from idm_env.roads.chains import Chains
from idm_env.step import CarFollowingStep, Integration

Made = TypeVar("Made")

HEADER = '''"""{title}

Printed by idm_env from one recorded step; see idm_env/compiled/scalar. Delete at will: it is printed again when needed.
"""

import numpy as np
from numba import carray, types

from idm_env.compiled.kernels.emitted import emitted
from idm_env.compiled.kernels.functions import exp_{kind} as exp, log1p_{kind} as log1p
from idm_env.compiled.kernels.functions import sigmoid_{kind} as sigmoid, tanh_{kind} as tanh

ROW = {row}
SIZE = (1 << 40,)
REAL = types.CPointer(types.{kind})
SIGNATURE = types.void(REAL, types.int64, REAL)
exact = emitted(SIGNATURE)
swift = emitted(SIGNATURE, fastmath={{"contract"}})

'''

MEASURES: tuple[str, ...] = ("rows", "ring", "states", "moving", "statics", "parameters", "hoists", "numbers", "flags")
MEASURES += ("signals", "state_rows", "on_rows", "static_rows", "gradient_rows", "input_rows", "on_input_rows")
MEASURES += ("scratch", "seeded", "on_gap", "on_speed", "on_position", "on_accel", "gap", "speed", "position", "accel")
MEASURES += ("signal_rows", "on_signal_rows")
"""What loops are told, in this order: counts, then rows as first indices in the workspace."""


class TileKernel:
    """The phases of one simulator on lanes or rings, compiled when first asked for, and the plan of their workspace.

    ``measures`` are the numbers of ``MEASURES``; ``read``, ``taped`` and ``again`` are states (see ``TileText`` and
    ``Program``); ``looks`` and ``sends`` are the copies between neighbours, phase after phase;
    ``recalls`` what is fetched from the past: (row of how long ago, signal, row to fill, row of its adjoint).
    """

    def __init__(self, program: Program, text: TileText, title: str) -> None:
        self.program = program
        self.numbers, self.flags, self.signals = text.numbers, text.flags, text.signals
        self._title = title
        self._forward = text.text(backward=False)
        self._text = text
        self.measures = _measures(text)
        self.read = np.array(text.indices(text.read), np.int64)
        self.looks = _flat(text.looks(), ("static", *PHASES))
        recalls = []
        for r in program.recalls:
            ago, to, on = (text.at(name) * ROW for name in (f"AGO_{r.ago}", row(r.slot), f"ON_{row(r.slot)}"))
            recalls.append((ago, r.signal, to, on))
        self.recalls = np.array(recalls, np.int64).reshape(-1, 4)

    @cached_property
    def _backward(self) -> tuple[str, tuple[str, ...]]:
        return self._text.text(backward=True)

    @cached_property
    def constants(self) -> dict[str, Array]:
        """Constants by precision, rounded as torch rounds a Python number that meets a tensor."""
        assert self._backward
        values = [float(x) for x in self._text.constants.values]
        return {kind: np.array(values, kind) for kind in ("float32", "float64")}

    @cached_property
    def taped(self) -> Array:
        """States that the adjoint reads."""
        return np.array(self._text.indices(self.program.needed_backward), np.int64)

    @cached_property
    def again(self) -> Array:
        """States from which those can be computed once more."""
        return np.array(self._text.indices(self.program.needed_again), np.int64)

    @cached_property
    def sends(self) -> Array:
        """Adjoints to send to neighbours: (phase, shift, row sent, row of the adjoint it adds to)."""
        return _flat(self._text.sends(), ("hoist", *PHASES))

    def forward(self, kind: str) -> Array:
        """Return the addresses of hoist and the phases in a precision, 0 for what there is not."""
        return self._addresses(kind, self._forward, ("hoist", *PHASES))

    def backward(self, kind: str) -> Array:
        """Return the addresses of their adjoints."""
        return self._addresses(kind, self._backward, ("hoist_back", *(f"{phase}_back" for phase in PHASES)))

    def _addresses(self, kind: str, printed: tuple[str, tuple[str, ...]], names: tuple[str, ...]) -> Array:
        return _compiled(self._title, kind, printed, names)


@lru_cache(maxsize=512)
def _compiled(title: str, kind: str, printed: tuple[str, tuple[str, ...]], names: tuple[str, ...]) -> Array:
    text, phases = printed
    module = library.load("phases", HEADER.format(title=title, row=ROW, kind=kind) + text)
    return np.array([getattr(module, n).address if n in phases else 0 for n in names], np.int64)


def _measures(text: TileText) -> Array:
    p = text.program
    counts = {"rows": text.rows, "ring": text.ring, "states": len(p.states), "moving": len(p.moving)}
    counts |= {"statics": len(p.statics), "parameters": len(p.parameters), "hoists": len(p.hoist)}
    counts |= {"numbers": len(text.numbers), "flags": len(text.flags), "signals": text.signals}
    numbers = []
    for name in MEASURES:
        if name in counts:
            numbers.append(int(counts[name]))
        elif name.endswith("_rows"):
            numbers.append(text.group(name.removesuffix("_rows").upper()) * ROW)
        else:
            numbers.append(text.at(name.upper()) * ROW)
    return np.array(numbers, np.int64)


def _flat(moves: dict[str, list[tuple[int, int, int]]], order: tuple[str, ...]) -> Array:
    """Return moves as rows (place of the phase in the order, direction, index, index)."""
    rows = [
        (order.index(phase), step, to * ROW, source * ROW)
        for phase in order
        for step, to, source in moves.get(phase, ())
    ]
    return np.array(rows, np.int64).reshape(-1, 4)


def printed(
    make: Callable[[CarFollowingStep, Form], Made], simulator: CarFollowingStep, form: Form, otherwise: str
) -> Made | str:
    """Return what is printed from a simulator, kept for the next one like it; or why there is nothing.

    Where an effect is why, a warning says so once, and what happens ``otherwise``.
    """
    effects = simulator.effects
    try:
        read = _version(effects) if simulator.own else 0
        return _printed(make, simulator.road, effects, simulator.dt, simulator.integration, form, otherwise, read)
    except TypeError as error:  # an effect with a choice that cannot be hashed
        return f"an effect cannot be a key: {error}"


_READS: dict[tuple[Effect, ...], tuple[Reads, int]] = {}


def _version(effects: tuple[Effect, ...]) -> int:
    """Return how often something that effects of one's own read beside their arguments has become another one."""
    reads, version = _READS.get(effects, (None, -1))
    if reads is None or reads.changed():
        _READS[effects] = Reads((), effects), version + 1
    return _READS[effects][1]


@lru_cache(maxsize=512)
def _printed(
    make: Callable[[CarFollowingStep, Form], Any], road: Road, effects: tuple[Effect, ...], dt: float,
    integration: Integration, form: Form, otherwise: str, read: int,
) -> Any:  # fmt: skip
    try:
        return make(CarFollowingStep(road, effects, dt, integration), form)
    except Untraceable as why:
        warnings.warn(f"{otherwise}: {why}.", stacklevel=3)
        return str(why)


def tile_kernel(simulator: CarFollowingStep, form: Form) -> TileKernel | str:
    """Return the kernel of a simulator, or why there is none."""
    if type(simulator.road) not in (Lane, Ring, Chains):
        return f"the road is {type(simulator.road).__name__}; kernels know Lane, Ring and Lanes"
    return printed(_tile_kernel, simulator, form, "no compiled kernel, the torch path runs instead")


def _tile_kernel(simulator: CarFollowingStep, form: Form) -> TileKernel:
    program = Program(record(simulator, form))
    road, names = type(simulator.road).__name__.lower(), ", ".join(e.name for e in simulator.effects)
    title = f"One step of {names} on a {road}, {simulator.integration}."
    return TileKernel(program, TileText(program, ring=simulator.road.around, flags=form.flags), title)
