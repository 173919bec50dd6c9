"""Recordings of environments: a trajectory table that the commands read; simulate, then calibrate.

One row per vehicle that is on the road and Δt, from the beginning of an episode to its end; every episode is a run.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from idm_env.extras import needed
from idm_env.jobs import storage
from idm_env.tasks import Task
from idm_env.types import State
from idm_env.validation import shown

if TYPE_CHECKING:
    import polars as pl


_STATE = {"position": "position_m", "speed": "speed_mps", "accel": "accel_mps2", "length": "length_m", "gap": "gap_m"}
"""Columns of numbers that a state has."""


class Recorder:
    """Rows of the steps since it began; ``table()`` returns them, ``write(path)`` writes ``.parquet`` or ``.csv``.

    Columns are those of ``idm_env.data.schema``: times (s), front bumpers, speeds and accelerations as simulated, in
    double precision, so that they are read back to the bit; gaps (m) to the leader, lanes counted from 0 on the right,
    and ``ring_length_m`` on a ring. ``run_id`` is ``"environment-episode"``, both from 0, whatever the
    seeds. A vehicle is its slot, with ``"_trip_k"`` where vehicles enter and leave; of a recorded one ``vehicle_id`` is
    the record's.
    """

    def __init__(self, task: Task, count: int) -> None:
        self._task, self._over, self._moments = task, np.ones(count, bool), list[dict[str, np.ndarray]]()
        self._runs = np.full(count, -1)

    def begin(self, rows: np.ndarray, state: State) -> None:
        """Take the first rows of episodes that begin in some environments (indices), whatever their seeds."""
        self._over[rows] = False
        self._runs[rows] += 1
        self._take(rows, state)

    def after(self, whole: Any, state: State) -> None:
        """Take the rows of a step of environments that go on; ``whole`` (``idm_env.envs.batch``) tells whose end it is.

        What drives on between its end and its reset is no part of an episode.
        """
        self._take(np.flatnonzero(~self._over), state)
        self._over |= np.asarray(torch.as_tensor(whole.terminated | whole.truncated).cpu())

    def _take(self, rows: np.ndarray, state: State) -> None:
        """Keep the vehicles on the road in some environments (indices)."""
        road, speed, lanes = self._task.road.view(state), state.speed, state.lanes
        slot, around = torch.arange(speed.shape[-1], device=speed.device).expand_as(speed), road.lap(state)
        trip = slot if lanes is None or lanes.trips is None else slot + lanes.trips.entered * speed.shape[-1]
        led = (road.leader_present(state.present, speed) > 0) & (road.ahead(slot) != slot)
        columns = {column: getattr(state, name) for name, column in _STATE.items()}
        columns |= {"vehicle": trip, "leader": torch.where(led, road.ahead(trip), -1), "step": state.step.unsqueeze(-1)}
        columns["run"] = torch.from_numpy(self._runs * len(speed) + np.arange(len(speed))).unsqueeze(-1)
        columns["lane"] = torch.tensor(self._task.lanes) if lanes is None else lanes.lane
        if around is not None:
            columns["ring_length_m"] = around.unsqueeze(-1)
        here = (torch.ones_like(speed) if state.present is None else state.present).cpu().numpy()[rows] > 0
        self._moments.append({n: x.detach().expand_as(speed).cpu().numpy()[rows][here] for n, x in columns.items()})

    def table(self) -> pl.DataFrame:
        """Return the rows by run, vehicle and time. ValueError where no step was taken."""
        with needed("a recording"):
            import polars as pl
        if not self._moments:
            raise ValueError("nothing is recorded yet. Call reset() and step() first.")
        rows = {name: np.concatenate([x[name] for x in self._moments]) for name in self._moments[0]}
        vehicles, count, dt = self._task.vehicles, len(self._over), self._task.simulator.dt
        slots = pl.lit(pl.Series(self._task.vehicle_ids or [str(i) for i in range(vehicles)]))

        def named(code: pl.Expr) -> pl.Expr:
            trip = pl.when(code >= vehicles).then(pl.format("_trip_{}", code // vehicles)).otherwise(pl.lit(""))
            return slots.gather(code.clip(0) % vehicles) + trip

        run, lead, step = pl.col("run"), pl.col("leader"), pl.col("step")
        first, led = step.min().over("run"), lead >= 0
        names = {"run_id": pl.format("{}-{}", run % count, run // count), "vehicle_id": named(pl.col("vehicle"))}
        names |= {"leader_id": pl.when(led).then(named(lead)), "gap_m": pl.when(led).then("gap_m")}
        names["time_s"] = first * dt + (step - first) * dt  # as readers count on from a run's first row
        frame = pl.DataFrame(rows).with_columns(pl.selectors.float().cast(pl.Float64)).with_columns(**names)
        numbers = [name for name in rows if name.endswith(("_m", "_mps", "_mps2"))]
        frame = frame.select("run_id", "vehicle_id", "leader_id", "lane", "time_s", *numbers)
        return frame.sort("run_id", "vehicle_id", "time_s")

    def write(self, path: str | Path) -> None:
        """Write the table as ``.parquet`` or ``.csv``. ValueError for another ending, or where no step was taken."""
        target, table = Path(path), self.table()
        if target.suffix not in (".parquet", ".csv"):
            raise ValueError(f"{shown(str(path))} must end in .parquet or .csv.")
        if target.suffix == ".csv":
            storage.write_csv(target, table)
        else:
            storage.write(target, table.write_parquet)
