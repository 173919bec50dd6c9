"""Several lanes with MOBIL: how fast, beside SUMO, and how often lanes change at which flow.

``python -m benchmarks.lanes speed [rollouts|highway]`` prints million vehicle updates per CPU second beside
SUMO, and env steps per CPU second of ``highway`` beside HighwayEnv (``lanes_speed.py``).
``python -m benchmarks.lanes flow`` prints and draws flow and changes over density, beside others (``lanes_flow.py``).
``python -m benchmarks.lanes drop [published]`` prints the outflow of a lane drop, ours or the published one, beside
SUMO's and what is published (``lane_drop.py``).
``python -m benchmarks.lanes merge`` prints and draws outflow over demand at a ramp (``lanes_merge.py``).
``python -m benchmarks.lanes laws [vehicle-steps]`` counts what breaks a law in random traffic (``lanes_laws.py``).
``python -m benchmarks.lanes gradients [scenes]`` tells how good gradients through choices are (``lanes_gradients``).
"""

from __future__ import annotations

import sys

import torch
from rich.console import Console

from benchmarks import lane_drop, lanes_flow, lanes_gradients, lanes_laws, lanes_merge, lanes_speed
from idm_env import progress


def laws(steps: float) -> None:
    """Print how often random traffic broke a law, and what else it did."""
    with progress.shown(Console(stderr=True)) as on_progress:
        found = lanes_laws.check(steps, on_progress)
    print(lanes_laws.table(found))


def main() -> None:
    """Run what is asked for."""
    torch.set_num_threads(1)
    what = sys.argv[1] if len(sys.argv) > 1 else "speed"
    if what == "speed":
        lanes_speed.table(sys.argv[2] if len(sys.argv) > 2 else "rollouts,highway")
    elif what == "flow":
        lanes_flow.table()
    elif what == "drop":
        lane_drop.published() if sys.argv[2:] == ["published"] else lane_drop.main()
    elif what == "merge":
        lanes_merge.table()
    elif what == "laws":
        laws(float(sys.argv[2]) if len(sys.argv) > 2 else 1e9)
    elif what == "gradients":
        with progress.shown(Console(stderr=True)) as on_progress:
            lanes_gradients.table(int(sys.argv[2]) if len(sys.argv) > 2 else 50, on_progress)
    else:
        sys.exit(f"unknown benchmark '{what}'. Take speed, flow, drop, merge, laws or gradients.")


if __name__ == "__main__":
    main()
