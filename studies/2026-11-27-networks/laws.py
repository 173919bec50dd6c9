"""Laws on random networks: ``python studies/2026-11-27-networks/laws.py [--networks 54 --lanes 1]``.

Networks are netgenerate's, a third with signals everywhere, a third with signals where many roads meet, a sixth each
by priority and right before left; 600 s of traffic that they cannot serve, in rows of other demand, every second
network with the drivers of SUMO's car. After each event ``tests.networks.laws`` looks at every vehicle. A network's
result is a line of ``--out``; those that are there are not done again. Needs SUMO: ``pip install eclipse-sumo``.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

import torch
import tyro

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks.networks import generated, network_of
from idm_env import IDM, Brakes, Simulator
from idm_env.effects import LinkLimit, StopLine
from idm_env.multilane.junctions import counts, travelling
from idm_env.roads import Demand
from tests.networks.laws import broken

SIGNALS, GUESSED = "-j traffic_light", "--tls.guess --tls.guess.threshold 20"
KINDS = SIGNALS, GUESSED, "-j priority", SIGNALS, GUESSED, "-j right_before_left"
CAR: dict[str, float] = {"max_accel": 2.6, "comfort_decel": 4.5, "time_gap": 1.0, "min_gap": 2.5}
SECONDS = 600


def checked(seed: int, rows: int, flow: float, lanes: int) -> dict[str, Any]:
    """Return how many vehicle-steps of a network were looked at, and what was wrong."""
    words = f"--rand --rand.iterations 40 -L {lanes} --no-turnarounds --seed {seed} {KINDS[seed % len(KINDS)]}"
    network, begin = network_of(generated(words)), time.process_time()
    simulator = Simulator(network, (IDM(), StopLine(), LinkLimit(), Brakes()), 0.1)
    params: Any = simulator.defaults(dtype=torch.float32)
    params["idm"] |= {name: torch.tensor(x) for name, x in (CAR.items() if seed % 2 else ())}
    demand = [Demand.by_turns(network, flow, SECONDS, seed=k, shares=(0.25, 0.5, 0.25)) for k in range(rows)]
    before, _ = simulator.rollout(travelling(simulator, demand, params), {}, params, 1, keep=None)
    steps, wrong = 0, list[str]()
    for k in range(2 * SECONDS):
        after, _ = simulator.rollout(before, {}, params, 5, keep=None)
        assert after.present is not None
        steps += 5 * int(after.present.sum())
        wrong += [f"{k / 2:g} s: {line}" for line in broken(simulator, before, after)]
        before = after
    due, inside, left, _ = (int(x.sum()) for x in counts(before))
    seconds = round(time.process_time() - begin, 1)
    sizes = {"links": len(network.names), "signals": len(network.plans), "seconds": seconds}
    return {"network": words, **sizes, "steps": steps, "due": due, "inside": inside, "left": left,
            "broken": len(wrong), "first": wrong[:3]}  # fmt: skip


def main(
    out: Path = Path("laws.jsonl"), networks: int = 54, rows: int = 4, flow: float = 300.0, lanes: int = 1
) -> None:
    """Check networks that the file lacks, and print the sums of all."""
    done = {row["seed"]: row for row in map(json.loads, out.read_text().splitlines())} if out.exists() else {}
    for seed in range(1, networks + 1):
        if seed not in done:
            done[seed] = {"seed": seed, **checked(seed, rows, flow, lanes)}
            with out.open("a") as file:
                file.write(json.dumps(done[seed]) + "\n")
            print(done[seed], flush=True)
    sums = {key: sum(row[key] for row in done.values()) for key in ("steps", "broken", "due", "left", "seconds")}
    print(f"{len(done)} networks, {sum(row['signals'] > 0 for row in done.values())} with signals: {sums}")


if __name__ == "__main__":
    tyro.cli(main)
