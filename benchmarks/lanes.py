"""Several lanes with MOBIL: how fast, beside SUMO, and how often lanes change at which flow.

``python -m benchmarks.lanes speed [rollouts|highway]`` prints million vehicle updates per CPU second beside
SUMO, and env steps per CPU second of ``highway`` beside HighwayEnv (``lanes_speed.py``).
``python -m benchmarks.lanes flow`` prints and draws flow and changes over density, beside others (``lanes_flow.py``).
``python -m benchmarks.lanes drop [published|behaviours]`` prints the outflow of a lane drop, ours or the published one,
beside SUMO's and what is published, or with one behaviour changed at a time (``lane_drop.py``).
``python -m benchmarks.lanes merge`` prints and draws outflow over demand at a ramp (``lanes_merge.py``).
``python -m benchmarks.lanes capacity`` prints and draws flow before and after a breakdown at a ramp, beside SUMO's
(``lanes_capacity.py``).
``python -m benchmarks.lanes laws [vehicle-steps]`` counts what breaks a law in random traffic (``lanes_laws.py``).

Flow, drop and capacity keep their rows under ``out/``, do not drive again what has not changed in their lists of rows
(after another change remove the file), and take ``--executor``, ``--jobs`` and ``--ray-address``.
"""

from __future__ import annotations

import argparse
import math

import torch
from rich.console import Console

from benchmarks import (
    lane_drop,
    lanes_capacity,
    lanes_flow,
    lanes_laws,
    lanes_merge,
    lanes_speed,
    workers,
)
from idm_env import progress


def laws(steps: float) -> None:
    """Print how often random traffic broke a law, and what else it did."""
    with progress.shown(Console(stderr=True)) as on_progress:
        found = lanes_laws.check(steps, on_progress)
    print(lanes_laws.table(found))


WORDS = {"speed": ("rollouts", "highway"), "drop": ("published", "behaviours"), "flow": (), "merge": (), "capacity": ()}
NUMBERS = {"laws": (1000.0, 1e9)}
"""Which words may follow; or the least number that may and the usual one."""
IN_PARTS = ("flow", "drop", "capacity")


def _checked(parser: argparse.ArgumentParser, given: argparse.Namespace) -> None:
    """Raise where something was asked for that would not be heeded."""
    what, more = given.what, given.more
    if what not in IN_PARTS and (given.executor, given.jobs, given.ray_address) != ("serial", None, None):
        parser.error(f"'{what}' runs in one piece: leave out --executor, --jobs and --ray-address.")
    if more is None:
        return
    if what in WORDS and more not in WORDS[what]:
        cure = f"Take {' or '.join(WORDS[what])}, or leave it out." if WORDS[what] else "Leave it out."
        parser.error(f"'{what} {more}': '{more}' is unknown. {cure}")
    if what in NUMBERS:
        least, usual = NUMBERS[what]
        try:
            number = float(more)
        except ValueError:
            number = math.nan
        if not least <= number < math.inf:
            parser.error(f"'{what} {more}': '{more}' is no number of {least:g} or more. Usual is {what} {usual:g}.")


def main() -> None:
    """Run what is asked for."""
    torch.set_num_threads(1)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="?", default="speed", choices=(*WORDS, *NUMBERS))
    parser.add_argument("more", nargs="?", help="what of it, or how much")
    workers.add(parser)
    arguments = parser.parse_args()
    _checked(parser, arguments)
    more = arguments.more
    if arguments.what == "speed":
        lanes_speed.table(more or "rollouts,highway")
    elif arguments.what == "flow":
        lanes_flow.table(arguments)
    elif arguments.what == "drop":
        drops = {None: lane_drop.main, "published": lane_drop.published, "behaviours": lane_drop.behaviours}
        drops[more](arguments)
    elif arguments.what == "merge":
        lanes_merge.table()
    elif arguments.what == "capacity":
        lanes_capacity.table(arguments)
    else:
        laws(float(more or NUMBERS["laws"][1]))


if __name__ == "__main__":
    main()
