"""Several agents with one policy on longer rings: from 22 to 440 vehicles, 2 to 20 % of them controlled.

    python -m benchmarks.agents_shared [--checkpoints runs/benchmark/ring-apg/trial0/seed*/training/last.pt …]
        [--out runs/shared]

Judged as one agent is: rings of 10 to 12.3 m per vehicle, five fresh draws of each of six lengths, a human who brakes
with 4 m/s² for 2 s two minutes after the take-over. Policies of one agent among 22 drive as they are. Beside them: IDM
for all, oracles that are told each ring's uniform speed, and, with 5 of 110, what has learned nothing: constants,
FollowerStopper, PI with saturation and random networks. What is done is kept.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from agents import common
from agents.classical import FollowerStopper, PISaturation, constant, seen
from agents.environments import task_of
from agents.evaluate import evaluate_ring, judged_rings
from agents.policy import Policy
from agents.reference import random_policies, told
from agents.rollout import FRESH, Act, Start, uniform_speed
from benchmarks.agents import once
from benchmarks.agents_tables import environment_of, ring, table

Row = dict[str, Any]
RINGS = ((22, 1), (110, 2), (110, 5), (110, 11), (110, 22), (440, 20))
"""Vehicles, and how many of them agents drive."""
NETWORKS = 10


def environment(vehicles: int, agents: int) -> Row:
    """Return the keywords of a ring with a shock."""
    longer = vehicles / 22
    length = [220.0 * longer, 270.0 * longer]
    return {**environment_of("ring-apg"), "vehicles": vehicles, "length": length, "controlled": agents, "shock": 4.0}


@dataclass
class Oracle:
    """Several agents that are told the uniform speed U of their ring: ``k (f U − v)`` behind Krauß's safe speed.

    Args:
        start: The worlds that they drive, once.
        first: f at the beginning.
        last: f in the end.
        after: Time (s) at which f begins to grow to ``last``, over a minute.
        gain: k (1/s).
    """

    start: Start
    first: float
    last: float
    after: float = 0.0
    gain: float = 0.1
    _steps: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        self._uniform = uniform_speed(self.start).unsqueeze(-1)

    def __call__(self, observation: Tensor) -> Tensor:
        """Return the actions of all agents."""
        task = self.start.task
        seconds, self._steps = self._steps * task.simulator.dt, self._steps + 1
        grown = min(max((seconds - self.after) / 60.0, 0.0), 1.0)
        share = self.first + (self.last - self.first) * grown
        view = seen(observation, task.vehicle_length, task.scales)
        return task.action(told(task, view, self._uniform, torch.tensor(self.gain), torch.tensor(share)))


ORACLES: dict[str, tuple[float, float, float]] = {
    "oracle: 1.0 U": (1.0, 1.0, 0.0),
    "oracle: 0.8 U": (0.8, 0.8, 0.0),
    "oracle: 0.5 U for 120 s, then up to 0.95 U": (0.5, 0.95, 120.0),
}
"""What oracles do with the uniform speed U that they are told: ``first``, ``last`` and ``after`` of each."""


def oracle(name: str, environment: Row) -> Oracle:
    """Return an oracle that has not driven yet, for the fresh rings."""
    return Oracle(judged_rings(environment, draws=FRESH), *ORACLES[name])


def stopper(environment: Row) -> Act:
    """Return FollowerStopper, told 0.8 of the uniform speed of each ring."""
    start = judged_rings(environment, draws=FRESH)
    return FollowerStopper(start.task, desired=0.8 * uniform_speed(start).unsqueeze(-1))


@lru_cache(maxsize=1)
def _networks(environment: str) -> list[Policy]:
    return random_policies(json.loads(environment), NETWORKS, (32, 32))


def network(number: int, environment: Row) -> Act:
    """Return one of the random networks of ``agents.reference``, all made at once."""
    return _networks(json.dumps(environment))[number]


UNTAUGHT: dict[str, Callable[[Row], Act | None]] = {
    **{
        f"always {accel:g} m/s²": lambda environment, accel=accel: constant(accel, task_of(environment))
        for accel in (0.0, 0.025, 0.05, 0.3)
    },
    "FollowerStopper, told 0.8 U": stopper,
    "PI with saturation": lambda environment: PISaturation(task_of(environment)),
    **{f"random network {i}": partial(network, i) for i in range(NETWORKS)},
}
"""What has learned nothing, judged with 5 of 110."""


def main() -> None:
    """Judge what is missing, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--checkpoints", nargs="*", type=Path, default=[])
    parser.add_argument("--out", type=Path, default=Path("runs/shared"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    made: dict[str, Callable[[Row], Act | None]] = {"IDM for all": lambda environment: None}
    for name in ORACLES:
        made[name] = lambda environment, name=name: oracle(name, environment)
    for path in options.checkpoints:
        made["/".join(path.parts[-5:-2])] = lambda environment, path=path: common.load(path, "ring")[0]
    rows = []
    for vehicles, agents in RINGS:
        for name, make in {**made, **(UNTAUGHT if (vehicles, agents) == (110, 5) else {})}.items():
            if name == "IDM for all" and (vehicles, agents) in ((110, 5), (110, 11), (110, 22)):
                continue  # nobody is controlled: the ring with two agents has the row

            def judge(make: Callable[[Row], Act | None] = make, vehicles: int = vehicles, agents: int = agents) -> Row:
                chosen = environment(vehicles, agents)
                return evaluate_ring(make(chosen), chosen, draws=FRESH)

            found = once(
                options.out / f"{vehicles}-{agents}" / name.replace("/", "-").replace(" ", "-").replace(":", ""), judge
            )
            if found is not None:
                share = "" if name == "IDM for all" else f"{agents} ({100.0 * agents / vehicles:.1f} %)"
                passed = "yes" if found["passed"] else "no"
                rows.append([str(vehicles), share, name, *ring(found), passed])
                print(*rows[-1], sep=" | ", flush=True)
    table(
        ("vehicles", "controlled", "policy", "worst speed ratio", "worst deviation (m/s)", "smallest time gap (s)",
         "collisions, of 30 rings", "passes"), rows,
    )  # fmt: skip


if __name__ == "__main__":
    main()
