"""Recorded decisions about lanes: what every driver saw, and whether he changed, once every decision."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import polars as pl
import torch
from torch import Tensor

from idm_env.data import DataError, Repair, Trajectories
from idm_env.multilane.incentives import lane_scene
from idm_env.roads import End, Lanes
from idm_env.roads.linked import Linked
from idm_env.simulator import Simulator
from idm_env.types import Params, Scene, mapped

LEFT, RIGHT = 1, 2
"""What a driver chose, beside 0: to stay."""
ROWS = 400_000
"""Times × vehicles of which scenes are made at a time."""


@dataclass(frozen=True)
class Decisions:
    """Choices of N drivers at recorded states, and their alternatives: the scene and all else are [N].

    ``scene`` has ``here``, ``left`` and ``right``, hypothetical accelerations answered by the simulator's own effects;
    ``params`` are the parameters of the driver who decides. ``possible`` [N, 2] is where there is a lane and room to
    the left and right; ``chosen`` is 0 (stay), LEFT or RIGHT. ``vehicle`` is an index of ``vehicles``.
    """

    scene: Scene
    params: Params
    possible: Tensor
    chosen: Tensor
    vehicle: Tensor
    vehicles: tuple[str, ...]
    left_out: tuple[Repair, ...]

    def __len__(self) -> int:
        return len(self.chosen)

    @property
    def changes(self) -> int:
        """How many of them were changes."""
        return int((self.chosen > 0).sum())

    def select(self, mask: Tensor) -> Decisions:
        """Return the decisions at a mask [N]."""
        each = {name: _picked(getattr(self, name), mask) for name in ("scene", "params", "chosen", "vehicle")}
        return replace(self, possible=self.possible[mask], **each)


@dataclass(frozen=True)
class _Run:
    """The vehicles of one run on the clock of decisions: [times, vehicles], NaN (lane −1) where one is not there.

    ``lane`` is at the decision, 0 on the right; ``before`` and ``after`` are those that a driver has decided for when
    the decision begins, and a decision later.
    """

    position: np.ndarray
    speed: np.ndarray
    accel: np.ndarray
    length: np.ndarray
    lane: np.ndarray
    before: np.ndarray
    after: np.ndarray
    count: int
    ring: float | None


def recorded_decisions(
    trajectories: Trajectories,
    simulator: Callable[[Lanes], Simulator],
    params_of: Callable[[str], Params],
    *,
    every: float = 1.0,
    ahead: float = 0.0,
    first_lane: str = "left",
) -> Decisions:
    """Return the decisions of all drivers of a file whose lanes have numbers.

    Every ``every`` seconds a driver stays, or his lane is another one a decision later. Decisions are taken ``ahead``
    seconds before the file's lane number changes; in between he decides nothing. ``first_lane`` says whether the lane
    with the lowest number is on the left, as in NGSIM, or on the right. A lane is taken to exist from where to where
    somebody drives on it. ``simulator`` makes the simulator of a road, ``params_of`` the parameters of a vehicle, which
    is named ``"run/vehicle"``.

    DataError for a file without lanes, or with one only.
    """
    table = trajectories.table
    if "lane" not in table.columns or table["lane"].is_null().all():
        raise DataError(f"{trajectories.source}: no column 'lane'. Lane changes need the lane of every row.")
    if first_lane not in ("left", "right"):
        raise DataError(f"first_lane = {first_lane!r} must be 'left' or 'right'.")
    drivers_taken = None if trajectories.drivers is None else {f"{r}/{v}" for r, v in trajectories.drivers}
    names: list[str] = []
    parts: list[tuple[Scene, Params, Tensor, Tensor, Tensor]] = []
    lost = {"without a lane": int(table["lane"].null_count()), "several lanes at once": 0, "beside another vehicle": 0}
    for run in trajectories.runs():
        rows = table.filter((pl.col("run_id") == run) & pl.col("lane").is_not_null())
        if rows.height == 0:
            continue
        clocked, ids = _on_clock(rows, trajectories.steps[run], every, ahead, first_lane)
        mine = np.array([drivers_taken is None or f"{run}/{v}" in drivers_taken for v in ids])
        drivers = [params_of(f"{run}/{v}") for v in ids]
        if clocked.count > 1:
            sim, each = simulator(_road(clocked)), max(1, ROWS // len(ids))
            for begin in range(0, len(clocked.position), each):
                parts += _decided(clocked, slice(begin, begin + each), mine, sim, drivers, len(names), lost)
        names += [f"{run}/{v}" for v in ids]
    if not any(len(part[-1]) for part in parts):
        raise DataError(f"{trajectories.source}: no driver has a lane beside his own. Lane changes need several lanes.")
    left_out = [Repair(kind, n, _WORDS[kind].format(n=n)) for kind, n in lost.items() if n]
    scene, params, possible, chosen, vehicle = mapped(lambda *columns: torch.cat(columns), *parts)
    return Decisions(scene, params, possible, chosen, vehicle, tuple(names), tuple(left_out))


_WORDS = {
    "without a lane": "{n} rows without a lane were left out.",
    "several lanes at once": "{n} decisions in which a vehicle crosses several lanes count as a change by one.",
    "beside another vehicle": "{n} changes that begin beside another vehicle, by the file, were left out.",
}


def _on_clock(rows: pl.DataFrame, dt: float, every: float, ahead: float, first_lane: str) -> tuple[_Run, list[str]]:
    """Return the vehicles of a run on the clock of decisions."""
    stride, early = max(1, round(every / dt)), round(ahead / dt)
    time = rows["time_s"].to_numpy()
    step = np.round((time - time.min()) / dt).astype(int)
    ids = rows["vehicle_id"].unique(maintain_order=True).to_list()
    index = {v: i for i, v in enumerate(ids)}
    cell = step, np.array([index[v] for v in rows["vehicle_id"].to_list()])
    shape = (int(step.max()) + 1, len(ids))
    numbers = np.unique(rows["lane"].to_numpy())
    rank = np.searchsorted(numbers, rows["lane"].to_numpy())
    lane = np.full(shape, -1)
    lane[cell] = len(numbers) - 1 - rank if first_lane == "left" else rank

    def column(name: str) -> np.ndarray:
        values = np.full(shape, np.nan)
        values[cell] = rows[name].to_numpy().astype(float)
        return values

    position, speed, length = column("position_m"), column("speed_mps"), column("length_m")
    accel = np.zeros(shape)
    accel[1:-1] = (speed[2:] - speed[:-2]) / (2.0 * dt)
    # Without a row at a decision's end, or where a decision would show in the file, nobody knows what was decided.
    last = shape[0] - 1 - stride - early
    begin = np.arange(0, max(last + 1, 0), stride)
    rings = rows["ring_length_m"].drop_nulls() if "ring_length_m" in rows.columns else rows["lane"].head(0)
    motion = position[begin], np.clip(speed[begin], 0.0, None), np.nan_to_num(accel[begin]), length[begin]
    lanes = lane[begin], lane[begin + early], lane[begin + early + stride]
    return _Run(*motion, *lanes, len(numbers), float(rings[0]) if len(rings) else None), ids


def _road(run: _Run) -> Lanes:
    """Return the road of a run: a lane exists from where to where somebody is on it, or is to be a decision later."""
    if run.ring is not None:
        return Lanes(run.count, ring=run.ring)
    rear, front = run.position - run.length, run.position
    ends = []
    for k in range(run.count):
        on = (run.lane == k) | ((run.after == k) & (run.lane >= 0))
        if on.any():
            low, high = float(np.nanmin(rear[on])), float(np.nanmax(front[on])) + 1.0
            ends.append(End(k, begin=low, end=1e9, closed=False, opens=low, closes=high))
    return Lanes(run.count, ends=tuple(ends))


def _decided(
    run: _Run, times: slice, mine: np.ndarray, sim: Simulator, params: list[Params], first: int, lost: dict[str, int]
) -> list[tuple[Scene, Params, Tensor, Tensor, Tensor]]:
    """Return scene, parameters, possible sides, choices and vehicles of some times of a run."""
    valid = np.isfinite(run.position[times]) & np.isfinite(run.speed[times]) & (run.lane[times] >= 0)
    if not valid.any():
        return []
    # Slots are those who are there at one time: of a long record these are few.
    slot = np.argsort(~valid, axis=1, kind="stable")[:, : int(valid.sum(1).max())]

    def cut(x: np.ndarray, fill: float = 0.0) -> Tensor:
        return torch.as_tensor(np.take_along_axis(np.where(valid, x[times], fill), slot, 1))

    present = torch.as_tensor(np.take_along_axis(valid, slot, 1))
    lane, before, after = (cut(x).long() for x in (run.lane, run.before, run.after))
    own = _of_slots(params, torch.as_tensor(slot))
    more: Any = {"length": cut(run.length, 1.0), "accel": cut(run.accel), "present": present.double()}
    state = sim.state(cut(run.position), cut(run.speed), own, lane=lane, step=torch.arange(len(slot)), **more)
    view = sim.road.view(state)
    assert isinstance(view, Linked)
    with torch.no_grad():
        order = view.order(state.present)
        sides = view.side(order, 1, state), view.side(order, -1, state)
        scene = lane_scene(sim, view, sides, state, {}, own)
    possible = torch.stack([side.exists & (side.gap > 0) & (side.back_gap > 0) for side in sides], -1)
    # A driver has decided already where the lane he is in is not the one that he decided for.
    decides = present & torch.as_tensor(mine)[torch.as_tensor(slot)] & (before == lane) & (after >= 0)
    way = torch.where(decides, after - lane, 0)
    lost["several lanes at once"] += int((way.abs() > 1).sum())
    chosen = torch.where(way > 0, LEFT, torch.where(way < 0, RIGHT, 0))
    could = torch.where(chosen > 0, possible.gather(-1, (chosen - 1).clamp_min(0).unsqueeze(-1)).squeeze(-1), True)
    lost["beside another vehicle"] += int((~could).sum())
    keep = decides & could & possible.any(-1)
    vehicle = torch.as_tensor(slot) + first
    return [(_picked(scene, keep), _picked(own, keep), possible[keep], chosen[keep], vehicle[keep])]


def _of_slots(params: list[Params], slot: Tensor) -> dict[str, dict[str, Tensor]]:
    """Return parameters [times, slots] of the vehicles in these slots."""
    distinct = {id(p): p for p in params}
    place = {key: i for i, key in enumerate(distinct)}
    which = torch.tensor([place[id(p)] for p in params])[slot]
    return {
        effect: {name: torch.stack([p[effect][name] for p in distinct.values()])[which] for name in values}
        for effect, values in params[0].items()
    }


def _picked(tree: Any, mask: Tensor) -> Any:
    """Return the marked elements of every tensor."""
    return mapped(lambda x: x.expand(mask.shape)[mask], tree)


__all__ = ["LEFT", "RIGHT", "Decisions", "recorded_decisions"]
