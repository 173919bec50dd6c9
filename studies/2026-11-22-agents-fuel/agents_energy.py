"""Fuel behind measured leaders that training has not seen: a vehicle and the ten that follow it, by two models of fuel.

    python -m benchmarks.agents_energy [--seeds 3] [--updates 30] [--fuel-weight 1] [--out runs/energy]
        [--data ngsim_i80_pairs.parquet]

Vehicle 1 drives behind each held-out leader of the I-80 pairs, from where the recorded follower was; ten vehicles with
IDM calibrated on the training pairs drive behind it, from equilibrium. Vehicle 1 is the recorded follower itself,
another calibrated IDM, one whose time gap wanders as that of the training pairs' drivers does (the mean of ten draws),
or an agent of task ``follow``, trained by gradients behind the training pairs' leaders. What is there is kept.
"""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from agents import apg, common
from agents.environments import task_of
from agents.imitation import default_data, observe
from agents.rollout import Act
from benchmarks.agents import once
from benchmarks.agents_tables import table
from benchmarks.agents_transfer import wandering
from idm_env import metrics
from idm_env.data import Episode, Trajectories, episodes, load
from idm_env.data.samples import VEHICLES
from idm_env.effects import Control, Wander
from idm_env.effects.idm import equilibrium_gap
from idm_env.fitting.batch import Batch
from idm_env.fitting.fit import base_simulator, fit
from idm_env.types import Command, Params, Record, State

Row = dict[str, Any]
BEHIND, LENGTH, WINDOW, DRAWS = 10, 5.0, 600, 10
"""Vehicles behind vehicle 1, their length (m), steps of the stretches that agents are trained on, draws of drift."""


class Platoon:
    """Vehicle 1 and those behind it in their queue behind every leader, as they begin; nobody has moved yet.

    ``kind`` is recorded, idm, drift or agent: who drives vehicle 1. With drift its time gap wanders, as the parameters
    of ``Wander`` say.
    """

    def __init__(self, items: Sequence[Episode], params: Params, kind: str) -> None:
        batch, vehicles = Batch.of(items, substeps=1), BEHIND + 2
        simulator = base_simulator(items[0].dt)
        added = {"agent": Control(), "drift": Wander()}.get(kind)
        self.simulator = simulator if added is None else simulator.adding(added)
        self.params: Params = {**self.simulator.defaults(dtype=torch.float64), **params}
        motions = (batch.position, batch.all_speed, batch.accel)
        lead, own = ([x[..., VEHICLES.index(who)] for x in motions] for who in ("leader", "driver"))
        speed = torch.stack([lead[1][0], *[own[1][0]] * (BEHIND + 1)], -1)
        length = torch.tensor([[e.leader.length_m, *[LENGTH] * (BEHIND + 1)] for e in items], dtype=torch.float64)
        gaps = equilibrium_gap(self.simulator.base.driver(self.params["idm"]), speed[:, 2:])
        position = torch.cat((lead[0][0, :, None], own[0][0, :, None] - torch.cat(
            (torch.zeros(len(items), 1), (gaps + LENGTH).cumsum(-1)), -1)), -1)  # fmt: skip
        self.state = self.simulator.state(position, speed, self.params, length=length)
        self.active = torch.arange(vehicles) == 1
        if kind == "drift":
            wander = self.params["wander"]
            self.params = {**self.params, "wander": {**wander, "sigma": wander["sigma"] * self.active}}
        self.valid = batch.valid[1:] > 0
        # The record of every step's end, time first.
        columns = (torch.stack([a[1:], *[b[1:]] * (BEHIND + 1)], -1) for a, b in zip(lead, own, strict=True))
        self.record = Record(*columns, torch.arange(vehicles) < (2 if kind == "recorded" else 1))

    @property
    def steps(self) -> int:
        """Steps of the longest record."""
        return len(self.valid)

    def drifted(self, seed: int) -> Row:
        """Return what ``driven`` does, vehicle 1 drifting as the seed says, from where it is in the long run."""
        generator = torch.Generator().manual_seed(seed)
        first, *normals = torch.randn(self.steps + 1, *self.state.speed.shape, generator=generator, dtype=torch.float64)
        memory = {**self.state.memory, "wander": first}
        return self._kept(self.state._replace(memory=memory), {"wander": torch.stack(normals)})

    def rolled(self, command: Tensor | None = None) -> Row:
        """Return what ``driven`` does, vehicle 1 commanded throughout ``(steps, leaders)`` (m/s²)."""
        if command is None:
            return self._kept(self.state, {})
        everybody = command.unsqueeze(-1).expand(-1, -1, BEHIND + 2)
        return self._kept(self.state, {"control": Command(everybody, self.active.expand(self.steps, 1, -1))})

    def _kept(self, state: State, more: Mapping[str, Any]) -> Row:
        active = self.record.active.expand(self.steps, -1)
        inputs: dict[str, Any] = {"replay": self.record._replace(active=active.unsqueeze(1)), **more}
        _, kept = self.simulator.rollout(state, inputs, self.params, self.steps)
        found = {"speed": kept.speed, "accel": kept.accel, "gap": kept.gap}
        return {**{name: x[..., 1:] for name, x in found.items()}, "valid": self.valid}


@torch.no_grad()
def driven(items: Sequence[Episode], params: Params, kind: str, act: Act | None, limits: tuple[float, float]) -> Row:
    """Return speeds, accelerations and gaps of vehicle 1 and those behind it, ``(steps, leaders, vehicles)``.

    ``kind`` as for ``Platoon``; beyond the end of a record, which ``valid`` tells, nothing is judged.
    """
    platoon = Platoon(items, params, kind)
    if act is None:
        return platoon.rolled()
    state, kept = platoon.state, []
    for t in range(platoon.steps):
        seen = observe(state.speed[:, 1], state.speed[:, 0], state.gap[:, 1]).float()
        action = act(seen).clamp(-1.0, 1.0).double()
        command = torch.where(action < 0.0, -action * limits[0], action * limits[1])
        now = platoon.record
        inputs = {
            "replay": now._replace(position=now.position[t], speed=now.speed[t], accel=now.accel[t]),
            "control": Command(command.expand(-1, BEHIND + 2), platoon.active),
        }
        state = platoon.simulator.step(state, inputs, platoon.params)
        kept.append(tuple(x[:, 1:] for x in (state.speed, state.accel, state.gap)))
    v, a, gap = (torch.stack(column) for column in zip(*kept, strict=True))
    return {"speed": v, "accel": a, "gap": gap, "valid": platoon.valid}


def judged(run: Row) -> Row:
    """Return the figures of every leader: litres per 100 km of all eleven by both models, mean speed, gaps."""
    weight = run["valid"].unsqueeze(-1).double()
    way = (run["speed"] * weight).sum((0, 2))
    litres = {
        model: (100.0 * (metrics.fuel(run["speed"], run["accel"], model) * weight).sum((0, 2)) / way)
        for model in metrics.FUELS
    }
    gap = torch.where(run["valid"], run["gap"][..., 0], torch.nan)
    touched = (torch.where(weight > 0, run["gap"], torch.inf).amin((0, 2)) <= 0.0).sum()
    return {
        **litres,
        "speed": way / weight.sum((0, 2)) / (BEHIND + 1),
        "farthest": float(np.nanmax(gap.numpy())),
        "nearest": float(np.nanmin(gap.numpy())),
        "collisions": int(touched),
    }


def pairs(data: Path) -> tuple[Trajectories, list[Episode], dict[str, float]]:
    """Return the training pairs, the held-out episodes, and IDM calibrated on the former."""
    training, test = load(data).where("in_manifest=true").split("split=test")
    found = fit(episodes(training, max_gap=None), by="all")
    idm = {name.removeprefix("idm."): float(x) for name, x in zip(found.names, found.values()[0], strict=True)}
    print("IDM, calibrated on the training pairs:", {name: round(x, 3) for name, x in idm.items()})
    return training, list(episodes(test, max_gap=None, smooth=True)), idm


def parameters(idm: Mapping[str, float]) -> Params:
    """Return them as tensors."""
    return {"idm": {name: torch.tensor(x, dtype=torch.float64) for name, x in idm.items()}}


def environment_of(training: Path, idm: Row, weight: float, lag: float = 0.0) -> Row:
    """Return the keywords of task ``follow`` behind the training pairs' leaders, with weights of fuel and lag."""
    return {
        "task": "follow", "leader": str(training), "vehicles": BEHIND + 2, "max_command": 3.0, "crash_cost": 50.0,
        "max_episode_steps": WINDOW, "parameters": {"idm": idm}, "fuel_weight": weight,
        "lag_weight": lag,
    }  # fmt: skip


def drifting(items: Sequence[Episode], params: Params, draws: int = DRAWS) -> Row:
    """Return the figures of a vehicle 1 that drifts: means over draws, the worst of its gaps, all collisions."""
    platoon = Platoon(items, params, "drift")
    rows = [judged(platoon.drifted(seed)) for seed in range(draws)]
    means = {name: torch.stack([r[name] for r in rows]).mean(0) for name in (*metrics.FUELS, "speed")}
    return {
        **means, "farthest": max(r["farthest"] for r in rows), "nearest": min(r["nearest"] for r in rows),
        "collisions": sum(r["collisions"] for r in rows),
    }  # fmt: skip


def told(name: str, r: Row, base: Row) -> list[str]:
    """Return the cells of a row: pooled means, the median saving over leaders, and how many leaders save."""
    cells = [name]
    for model in metrics.FUELS:
        saved = [100.0 * (1.0 - float(x) / float(y)) for x, y in zip(r[model], base[model], strict=True)]
        better = sum(x > 0.0 for x in saved)
        cells.append(f"{float(r[model].mean()):.2f}; {statistics.median(saved):+.1f} %, {better} of {len(saved)}")
    slower = 100.0 * (float(r["speed"].mean()) / float(base["speed"].mean()) - 1.0)
    return [*cells, f"{slower:+.1f} %", f"{r['nearest']:.1f}–{r['farthest']:.1f}", str(r["collisions"])]


def main() -> None:
    """Train what is missing, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--updates", type=int, default=30)
    parser.add_argument("--fuel-weight", type=float, default=0.1, help="reward per US gallon per hour in training")
    parser.add_argument(
        "--lag-weight", type=float, default=0.0, help="reward per m/s that it is slower than its leader"
    )
    parser.add_argument("--out", type=Path, default=Path("runs/energy"))
    parser.add_argument("--data", type=Path, default=default_data())
    options = parser.parse_args()
    torch.set_num_threads(1)
    options.out.mkdir(parents=True, exist_ok=True)
    training, items, idm = pairs(options.data)
    leaders = options.out / "training.parquet"
    training.table.write_parquet(leaders)
    environment = environment_of(leaders, idm, options.fuel_weight, options.lag_weight)
    params = parameters(idm)
    limits = task_of(environment).command_limits
    base = judged(driven(items, params, "recorded", None, limits))
    rows = [told("recorded follower", base, base)]
    rows.append(told("calibrated IDM", judged(driven(items, params, "idm", None, limits)), base))
    drift = once(options.out / "drift", lambda: wandering(training))
    if drift is not None:
        wander = {name: torch.tensor(x, dtype=torch.float64) for name, x in drift.items()}
        own = {**params, "wander": wander}
        name = f"IDM with drift (σ {drift['sigma']:.2f}, τ {drift['memory_time']:.0f} s), {DRAWS} draws"
        rows.append(told(name, drifting(items, own), base))
        print(*rows[-1], sep=" | ", flush=True)
    for seed in range(options.seeds):
        folder = options.out / f"fuel{options.fuel_weight:g}-lag{options.lag_weight:g}" / f"seed{seed}"
        arguments = apg.Arguments(
            environment=environment, out=folder, seed=seed, updates=options.updates, count=16, window=WINDOW,
            clone=500, learning_rate=1e-2, evaluate_every=1e9,
        )  # fmt: skip
        policy = common.load(common.completed(apg.train, arguments), "follow")[0]
        rows.append(
            told(
                f"agent, fuel {options.fuel_weight:g}, lag {options.lag_weight:g}, seed {seed}",
                judged(driven(items, params, "agent", policy, limits)),
                base,
            )
        )
        print(*rows[-1], sep=" | ", flush=True)
    head = [f"L/100 km by {model}; saved, leaders" for model in metrics.FUELS]
    table(("vehicle 1", *head, "mean speed", "gaps of vehicle 1 (m)", f"collisions, of {len(items)}"), rows)


if __name__ == "__main__":
    main()
