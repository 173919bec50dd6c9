"""Kernels of recorded simulators: what ``scalar`` prints, joined with a template of loops, compiled and kept.

Everything here is looked up by what shapes a step: road, effects with their static choices, integration, and which
inputs, memories and presence there are.
"""

from __future__ import annotations

import warnings
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import numpy as np

from idm_env.effects.base import Effect
from idm_env.roads import Ring, Road
from idm_env.scalar import library
from idm_env.scalar.program import Program
from idm_env.scalar.record import Form, Untraceable, record
from idm_env.scalar.tiles import TileText
from idm_env.step import Integration, Stepping

HERE = Path(__file__).parent


class TileKernel(NamedTuple):
    """Compiled loops of lanes or rings, the program that they were printed from, and the constants that they take."""

    program: Program
    loops: ModuleType
    constants: tuple[float, ...]
    numbers: tuple[str, ...]
    flags: tuple[str, ...]
    signals: int


def tile_kernel(simulator: Stepping, form: Form) -> TileKernel | str:
    """Return the kernel of a simulator, or why there is none (said once, as a warning, where an effect is why)."""
    try:
        return _tile_kernel(simulator.road, simulator.effects, simulator.dt, simulator.integration, form)
    except TypeError as error:  # an effect with a choice that cannot be hashed
        return f"an effect cannot be a key: {error}"


@lru_cache(maxsize=256)
def _tile_kernel(
    road: Road, effects: tuple[Effect, ...], dt: float, integration: Integration, form: Form
) -> TileKernel | str:
    try:
        recording = record(Stepping(road, effects, dt, integration), form)
    except Untraceable as why:
        warnings.warn(f"no compiled kernel, the torch path runs instead: {why}.", stacklevel=2)
        return str(why)
    program = Program(recording)
    text = TileText(program, ring=isinstance(road, Ring), flags=form.flags)
    module = library.load(
        "tiles",
        library.filled(HERE / "lane_loops.py", text.text()),
        (HERE / "tiles.py", HERE / "prefetch.py"),
    )
    return TileKernel(program, module, tuple(map(float, text.constants.values)), text.numbers, text.flags, text.signals)


@lru_cache(maxsize=512)
def constants(values: tuple[float, ...], kind: type) -> np.ndarray:
    """Return constants in the precision of the state, rounded as torch rounds a Python number that meets a tensor."""
    return np.array(values, dtype=kind)
