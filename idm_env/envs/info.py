"""What infos tell of a step, and how: single environments, vectors as Gymnasium lays them out, and one row of these.

``accel``
    Executed accelerations of the agents (m/s²), shape ``(agents,)``: what drivers' brakes and the failsafe left.
``command``
    Commanded accelerations (m/s²): the clipped action times its ``max_command``; NaN where nobody commands.
    Like ``accel`` 0 where an agent's vehicle is not on the road: who is absent is told nothing of, and pays nothing.
``failsafe``
    Whether the failsafe cut each command (bool).
``crash``, ``crash_reason``
    Whether the episode ended in a crash (bool), and, only then, who touched whom (a text).
``rewards``
    What each term of the reward paid in this step, ``(agents, terms)``: their sum over terms is the reward of an agent.
    ``env.unwrapped.task.reward_names`` are the terms' names; ``crash`` is the price of a crash, where it has one.
``vehicle_id``
    Recorded ids of the agents' vehicles (``Ids``, a tuple of texts), in ``reset`` too; only in tasks that replay a
    recording.
``lane_changes``, ``lane_refusals``
    How often in this episode each agent's vehicle has changed lanes, and how often it wished or was commanded to and
    could not: there was no lane or no safe room, or another claim won. Only in tasks on several lanes.
``present``
    Whether each agent's vehicle is on the road (bool): the mask of the joint face; only in tasks that vehicles enter,
    as all that follows.
``queued``, ``inside``
    How many vehicles wait at the entries for want of room, and how many are on the road.
``outflow``, ``ramp``
    How many vehicles have left the road in this episode, and how many of those who enter on lane 0 have left it.
``standing``, ``co2``
    How many vehicles are below 0.5 m/s now, and what all emit now (g/s, by Kamal's fuel).
``travel``
    Time (s) over the length of the road at the mean speed of now.
``stops``
    How often a vehicle stood (below 0.5 m/s) that had not stood at the decision before, of all in this episode.

``info="none"``, or some of these names, leaves the rest out. With torch output accelerations are tensors, with their
graph.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from idm_env.envs.batch import Batch, Outcome


class Ids(tuple[str, ...]):
    """A tuple of texts that an array of numbers can hold: their UTF-8 codes, ``(texts, longest)``, zeros behind.

    TorchRL keeps infos as tensors, and takes a plain tuple apart.
    """

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        """Return the codes."""
        codes = np.array([text.encode() for text in self])
        return codes.view(np.uint8).reshape(len(self), -1).astype(dtype or np.uint8)


def ids(batch: Batch) -> Ids | None:
    """Return the recorded ids of the agents' vehicles where the infos tell them."""
    names = batch.task.vehicle_ids
    if names is None or "vehicle_id" not in batch.settings.info:
        return None
    return Ids(names[i] for i in batch.task.agents)


def begun(batch: Batch) -> dict[str, Any]:
    """Return the info of the reset of a single environment."""
    names = ids(batch)
    return {} if names is None else {"vehicle_id": names}


def single(batch: Batch, outcome: Outcome) -> dict[str, Any]:
    """Return the info of a step of a single environment."""
    own, details = batch.settings.output == "numpy", outcome.details.items()
    info: dict[str, Any] = {name: value[0].copy() if own else value[0] for name, value in details}
    if "crash" in info:
        info["crash"] = bool(info["crash"].any())
    if info.get("crash"):
        info["crash_reason"] = batch.crash_reason(0)
    return info | begun(batch) if batch.task.vehicle_ids else info


def _out(batch: Batch, value: Any) -> Any:
    return value.detach().cpu().numpy() if batch.settings.output == "numpy" and isinstance(value, Tensor) else value


class Rows:
    """Infos of the rows of a vector: every array beside a mask ``_name`` that says in which rows it holds.

    With torch output numbers and masks are tensors; texts are object arrays always. What holds nowhere is left out.
    """

    def __init__(self, batch: Batch) -> None:
        self.batch = batch
        self._torch, self._ids, names = batch.settings.output == "torch", None, ids(batch)
        if names is not None:
            self._ids = np.empty(batch.count, dtype=object)
            for row in range(batch.count):  # numpy would fill in the codes
                self._ids[row] = names

    def begun(self, rows: np.ndarray) -> dict[str, Any]:
        """Return the info of resets of some rows (bool)."""
        info: dict[str, Any] = {}
        if self._ids is not None and rows.any():
            self._put(info, "vehicle_id", self._ids, rows, bool(rows.all()))
        return info

    def stepped(self, outcome: Outcome, rows: np.ndarray) -> dict[str, Any]:
        """Return the info of a step of some rows (bool); to be called before any row is reset."""
        info: dict[str, Any] = {}
        if not rows.any():
            return info
        every, ended = bool(rows.all()), None
        for name, value in outcome.details.items():
            if name == "crash":
                value = ended = value.any(-1)
            self._put(info, name, _out(self.batch, value), rows, every)
        if ended is not None:
            crashed = (ended.cpu().numpy() if isinstance(ended, Tensor) else ended) & rows
            if crashed.any():
                reasons = np.full(self.batch.count, None, dtype=object)
                for row in np.flatnonzero(crashed):
                    reasons[row] = self.batch.crash_reason(int(row))
                self._put(info, "crash_reason", reasons, crashed, bool(crashed.all()))
        return info

    def _put(self, info: dict[str, Any], name: str, value: Any, rows: np.ndarray, every: bool) -> None:
        mask: Any = torch.from_numpy(rows.copy()) if self._torch else rows.copy()
        if isinstance(value, Tensor):
            mask = mask if value.is_cpu else mask.to(value.device)
            if not every:
                value = torch.where(mask.view(-1, *(1,) * (value.dim() - 1)), value, torch.zeros_like(value))
        else:
            value = value.copy()
            if not every:
                value[~rows] = None if value.dtype == object else 0
        info[name], info[f"_{name}"] = value, mask


def single_infos(info: dict[str, Any], count: int) -> list[dict[str, Any]]:
    """Return the infos of ``count`` environments, without final observations and infos, from those of their vector."""
    names = [n for n in info if not n.startswith(("_", "final_"))]
    every = [n for n in names if info[f"_{n}"].all()]
    columns = (info[n] for n in every)
    infos = [dict(zip(every, cells, strict=True)) for _, *cells in zip(range(count), *columns, strict=True)]
    for name in {*names}.difference(every):
        for i in np.flatnonzero(info[f"_{name}"]).tolist():
            infos[i][name] = info[name][i]
    return infos
