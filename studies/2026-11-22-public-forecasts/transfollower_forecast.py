"""TransFollower's NGSIM test events from the end of 4 s of history on: its IDM, and drivers fitted to that history.

    python -m benchmarks.transfollower_forecast --data ../shared/data

Their models are given 40 steps and scored up to step 150. Both rows begin at the state measured at the end of the
history: their NGSIM IDM as it is, and ours, every driver fitted to his history with their IDM for prior, his time gap
followed and drawn (``benchmarks.opencf_forecast``), the mean of 30 draws. Parameters come from no other event.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from benchmarks.opencf_forecast import DRAWS, forecasts  # first: it sets the threads

import numpy as np  # isort: skip

from benchmarks.public_benchmarks import EVENT_STEPS, NGSIM_IDM, Clip, Event, Lost, events, follow, lost
from idm_env.effects import IDM

HISTORY = 40


def scored(items: list[Event], driven: list[tuple[np.ndarray, np.ndarray]]) -> Lost:
    """Return their error of what was driven after the history, which is cut off."""
    at = HISTORY - 1
    cut = [Event(e.name, *(x[at:] for x in (e.leader, e.leader_speed, e.follower, e.follower_speed))) for e in items]
    return lost(cut, driven)


def main() -> None:
    """Print both rows."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("IDM_ENV_DATA", "../shared/data")))
    found = events(parser.parse_args().data / "transfollower_ngsim_pairs.parquet", "time_s")
    items = [
        Event(e.name, *(x[:EVENT_STEPS] for x in (e.leader, e.leader_speed, e.follower, e.follower_speed)))
        for e in found
    ]
    theirs = follow(items, NGSIM_IDM, (IDM(exponent=None), Clip()), HISTORY - 1)
    ours = forecasts(items, HISTORY - 1, count=DRAWS, prior_idm=NGSIM_IDM, few=False)
    rows = {"their IDM": theirs, "fitted to the history, with drift": [(p.mean(0), v.mean(0)) for p, v in ours]}
    for name, driven in rows.items():
        error = scored(items, driven)
        print(
            f"steps {HISTORY} to {EVENT_STEPS}, {name}: {error.total:.2f} (spacing {error.spacing:.2f} m², "
            f"speed {error.speed:.3f} m²/s²), {error.collisions} collisions"
        )


if __name__ == "__main__":
    main()
