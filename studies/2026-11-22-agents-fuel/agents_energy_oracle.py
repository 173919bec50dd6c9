"""How much fuel can be saved behind measured leaders at all: a vehicle that knows everything its leader will do.

    python -m benchmarks.agents_energy_oracle [--steps 500] [--data ngsim_i80_pairs.parquet]

The scene is that of ``benchmarks.agents_energy``. For every held-out leader and each model of fuel the speeds of
vehicle 1 are sought that let it and the ten behind it burn least in as much time, by gradients through the simulator.
What ends with a record is not charged: who has to accelerate only afterwards has saved that. Beside it a driver who
sees no more than others: IDM with the parameters that save most behind the training pairs' leaders.
"""

from __future__ import annotations

import argparse
import itertools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from agents import common
from agents.imitation import default_data
from benchmarks.agents_energy import BEHIND, Platoon, judged, pairs, parameters, told
from benchmarks.agents_tables import table
from idm_env import metrics
from idm_env.data import Episode, episodes
from idm_env.types import Params

Row = dict[str, Any]
KNOT, SLACK, FARTHEST, NEAREST, SHORTEST = 10, 0.02, 120.0, 2.0, 0.8
"""Steps between speeds that are sought; how far the way of all may differ; the gap's bounds (m), the time gap's (s)."""
SMOOTHED = 200
"""Steps to either side over which the second start averages calibrated IDM's speeds."""

GRID = {"time_gap": (1.0, 1.4, 1.8), "max_accel": (0.2, 0.3, 0.4, 0.55, 0.7, 1.0), "comfort_decel": (0.2, 0.6, 2.0)}
"""Parameters of IDM that are tried for vehicle 1."""


def starts(run: Row, first: Tensor) -> list[Tensor]:
    """Return speeds to start from at every knot after the first: those of a run, and its speeds averaged."""
    speed = torch.cat((first, run["speed"][..., 0]))
    ends = (x.expand(SMOOTHED, -1) for x in (speed[:1], speed[-1:]))
    padded = next(ends), speed, next(ends)
    averaged = torch.nn.functional.avg_pool1d(torch.cat(padded).T, 2 * SMOOTHED + 1, 1).T
    growing = (torch.arange(len(speed)) / SMOOTHED).clamp_max(1.0).unsqueeze(-1)
    knots = (torch.arange(1, math.ceil((len(speed) - 1) / KNOT) + 1) * KNOT).clamp_max(len(speed) - 1)
    return [x[knots] for x in (speed, speed.lerp(averaged, growing.double()))]


class Scales:
    """What a plan is measured by: fuel and way of the reference, and the gaps that it must keep."""

    def __init__(self, reference: Row, model: str) -> None:
        self.model, self.valid = model, reference["valid"]
        self.weight = self.valid.unsqueeze(-1).double()
        self.way, self.litres = self._of(reference)
        self.gap = reference["gap"][..., 0]

    def _of(self, run: Row) -> tuple[Tensor, Tensor]:
        way = (run["speed"] * self.weight).sum((0, 2))
        rate = metrics.fuel(run["speed"], run["accel"], self.model)
        return way, 100.0 * (rate * self.weight).sum((0, 2)) / way

    def weighed(self, run: Row) -> tuple[Tensor, Tensor, Tensor]:
        """Return, per leader, fuel over the reference's, what violations cost, and whether the plan is admissible."""
        way, litres = self._of(run)
        own, gap = run["speed"][..., 0], run["gap"][..., 0]
        late = (way / self.way - 1.0).abs()
        # Sought with a margin, so that a plan at the edge is admissible.
        safe = torch.minimum((SHORTEST * own).clamp_min(NEAREST), self.gap)
        near = torch.relu(safe + 0.1 - gap) * self.valid
        far = torch.relu(gap - (FARTHEST - 0.5)) * self.valid
        off = torch.relu(late - (SLACK - 5e-4))
        cost = 3e-4 * (near.square() + far.square()).sum(0) + 0.02 * near.amax(0) + 2000.0 * off.square() + 2.0 * off
        touched = torch.where(self.valid.unsqueeze(-1), run["gap"], torch.inf).amin((0, 2)) <= 0.0
        fits = (near.amax(0) <= 0.1) & (far.amax(0) <= 0.5) & (late <= SLACK) & ~touched
        return litres / self.litres, cost, fits


def planned(items: Sequence[Episode], params: Params, model: str, steps: int, reference: Row) -> Row:
    """Return the run in which vehicle 1 knows its leader's future and all eleven burn least by a model of fuel.

    Its speeds at every second are sought by Adam from those of the reference (a run of calibrated IDM), and from those
    averaged; of each leader the best admissible plan is kept. Admissible: all eleven together come as far as the
    reference's, within 2 %; the gap is at most 120 m, and at least 2 m and 0.8 s or what the reference has where that
    is less; nobody touches. Where no plan is admissible the reference stays.
    """
    platoon, scales = Platoon(items, params, "agent"), Scales(reference, model)
    first = platoon.state.speed[None, :, 1]
    best = torch.ones(len(items), dtype=torch.float64)
    found = dict(reference)
    for start in starts(reference, first):
        speed = start.clone().requires_grad_(True)
        optimiser = torch.optim.Adam([speed])
        for step in range(steps):
            optimiser.param_groups[0]["lr"] = common.fall(0.1, step, steps, 0.02)
            change = torch.cat((first, speed.clamp_min(0.0))).diff(dim=0) / (KNOT * platoon.simulator.dt)
            run = platoon.rolled(change.repeat_interleave(KNOT, 0)[: platoon.steps])
            litres, cost, fits = scales.weighed(run)
            with torch.no_grad():
                better = fits & (litres < best)
                best = torch.where(better, litres, best)
                for name in ("speed", "accel", "gap"):
                    found[name] = torch.where(better.unsqueeze(-1), run[name], found[name])
            optimiser.zero_grad()
            (litres + cost).sum().backward()
            optimiser.step()
    return found


def driving(items: Sequence[Episode], params: Params, change: Mapping[str, float]) -> Row:
    """Return the run in which vehicle 1 is IDM with other parameters than those behind it."""
    platoon = Platoon(items, params, "idm")
    own = {name: x.repeat(BEHIND + 2) for name, x in params["idm"].items()}
    for name, x in change.items():
        own[name][1] = x
    platoon.params = {**platoon.params, "idm": own}
    return platoon.rolled()


@torch.no_grad()
def thriftiest(items: Sequence[Episode], params: Params) -> dict[str, float]:
    """Return the IDM parameters of vehicle 1 that save most (mean of both models) of ``GRID``, as fast within 2 %."""
    base = judged(Platoon(items, params, "idm").rolled())
    best: dict[str, float] = {}
    most = -math.inf
    for values in itertools.product(*GRID.values()):
        change = dict(zip(GRID, values, strict=True))
        r = judged(driving(items, params, change))
        off = abs(float(r["speed"].mean() / base["speed"].mean()) - 1.0)
        saved = sum(float((1.0 - r[model] / base[model]).median()) for model in metrics.FUELS)
        if off <= SLACK and r["farthest"] <= FARTHEST and not r["collisions"] and saved > most:
            most, best = saved, change
    return best


def main() -> None:
    """Seek plans for every leader and both models of fuel, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--model", choices=metrics.FUELS, help="only plans for this model of fuel")
    parser.add_argument("--data", type=Path, default=default_data())
    options = parser.parse_args()
    torch.set_num_threads(1)
    training, items, idm = pairs(options.data)
    params = parameters(idm)
    with torch.no_grad():
        recorded, reference = (Platoon(items, params, kind).rolled() for kind in ("recorded", "idm"))
    base = judged(recorded)
    rows = [told("calibrated IDM", judged(reference), base)]
    change = thriftiest(list(episodes(training, max_gap=None, smooth=True)), params)
    rows.append(told(f"IDM, {change}", judged(driving(items, params, change)), base))
    print(*rows[-1], sep=" | ", flush=True)
    for model in [options.model] if options.model else metrics.FUELS:
        plan = judged(planned(items, params, model, options.steps, reference))
        rows.append(told(f"told the future, least by {model}", plan, base))
        saved = (100.0 * (1.0 - plan[model] / base[model])).tolist()
        print(f"{model}, leader by leader (%):", " ".join(f"{x:.1f}" for x in saved), flush=True)
    head = [f"L/100 km by {model}; saved, leaders" for model in metrics.FUELS]
    table(("vehicle 1", *head, "mean speed", "gaps of vehicle 1 (m)", f"collisions, of {len(items)}"), rows)


if __name__ == "__main__":
    main()
