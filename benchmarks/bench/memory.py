"""Memory of a rollout with its gradient: the peak of a process of its own, less what importing takes."""

from __future__ import annotations

import contextlib
import json
import math
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
_STATUS = Path("/proc/self/status")

_CHILD = """
import json, sys
import torch
from benchmarks.bench.memory import forget_peak, high_water
from benchmarks.bench.traffic import LANE, Traffic
torch.set_num_threads(1)
Traffic(LANE).ours(Traffic(LANE).simulator, True, True).run()
forget_peak()
before = high_water()
traffic = Traffic(int(sys.argv[1]))
traffic.ours(traffic.simulator, True, True, int(sys.argv[2])).run()
print(json.dumps(high_water() - before))
"""


def forget_peak() -> None:
    """Let the high water mark start anew from what is resident now: compiling leaves a peak of its own."""
    with contextlib.suppress(OSError):  # not every system lets a process do so
        Path("/proc/self/clear_refs").write_text("5")


def high_water() -> float:
    """Return the largest resident size of this process so far (MB), as Linux tells it."""
    # Not getrusage: its figure survives exec, and so starts from the parent's.
    line = next(x for x in _STATUS.read_text().splitlines() if x.startswith("VmHWM"))
    return int(line.split()[1]) / 1024


def peaks(sizes: Sequence[int], steps: int) -> dict[str, float]:
    """Return peak MB by number of vehicles, parameters, states and gradients included, and the exponent of growth.

    Empty where the operating system does not tell (it is Linux that does). Sizes below 2e5 drown in the interpreter's
    own few megabytes and are left out.
    """
    sizes = sorted(n for n in sizes if n >= 200_000)
    if not sizes or not _STATUS.exists():
        return {}
    by_size: dict[str, float] = {}
    for n in sizes:
        done = subprocess.run(
            [sys.executable, "-c", _CHILD, str(n), str(steps)], check=True, capture_output=True, text=True, cwd=ROOT
        )
        by_size[str(n)] = json.loads(done.stdout.splitlines()[-1])
    low, high = sizes[0], sizes[-1]
    if high > low:
        by_size["exponent"] = math.log(by_size[str(high)] / by_size[str(low)]) / math.log(high / low)
    return by_size
