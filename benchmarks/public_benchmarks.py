"""Published car-following benchmarks by their own rules, driven by this package's step.

OpenCF: their three IDM baselines are simulated with their parameters and compared with the trajectories that they
submitted. Its truth is hidden, so their errors are not computed here. TransFollower: its IDM for NGSIM is simulated on
its NGSIM test events and scored by its rule; the reference figures are those that its own code gives on this file.

    python -m benchmarks.public_benchmarks --data ../shared/data
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import polars as pl
import torch
from torch import Tensor

from benchmarks import DATA, command
from idm_env.effects import IDM, Replay
from idm_env.effects.base import Effect, P
from idm_env.roads import Lane
from idm_env.simulator import Simulator
from idm_env.types import Driver, Record, Scene

DT = 0.1
FIRST = 29
"""OpenCF: the last step at which the follower is known; its future begins at 3.0 s."""
BASELINES = ("IDM_RMSE_s", "IDM_RMSE_v", "IDM_RMSE_a")
NGSIM_IDM = (35.845, 1.0542, 0.86319, 0.19651, 1.40378, 1.46541)
"""TransFollower's NGSIM IDM: v0, T, a, b, s0, δ."""
EVENT_STEPS = 150
"""TransFollower scores models on this many first steps of an event."""
STEP_LOST = 100.0
"""TransFollower: what every step costs that is lost to a collision."""
NAMES = ("desired_speed", "time_gap", "max_accel", "comfort_decel", "min_gap", "exponent")


@dataclass(frozen=True)
class RawIDM(IDM):
    """OpenCF's IDM: ``A = a [1 − (v/v0)^δ − (s*/s)²]``, ``s* = s0 + v T + v Δv / (2 √(a b))`` without a floor (m).

    s* may be negative, and its square pushes back then; s is taken as 0.1 m at least.
    """

    def accelerate(self, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return A (m/s²)."""
        brake = 2.0 * torch.sqrt(driver.max_accel * driver.comfort_decel)
        gap = driver.min_gap + scene.speed * (driver.time_gap + (scene.speed - scene.leader.speed) / brake)
        free = (scene.speed / driver.desired_speed) ** p["exponent"]
        term = (gap / scene.leader.gap.clamp_min(0.1)) ** 2 * scene.leader.present
        return driver.max_accel * (1.0 - free - term)


@dataclass(frozen=True)
class Clip(Effect):
    """Acceleration within [``low``, ``high``] (m/s²), and just a halt where the speed would fall below 0.

    With it the ballistic step is the trapezoidal rule ``x += (v + v') Δt / 2`` also in the step of a halt.
    """

    kind: ClassVar[str] = "clip"
    sees_truth: ClassVar[bool] = True
    rank: ClassVar[int] = 100
    low: float = -np.inf
    high: float = np.inf

    def limit(self, accel: Tensor, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return the clipped acceleration."""
        return torch.maximum(accel.clamp(self.low, self.high), -scene.speed / scene.dt)


@dataclass(frozen=True, eq=False)
class Event:
    """A leader and a follower at 10 Hz: positions [T] (m) and speeds [T] (m/s); gaps are differences of positions.

    The follower's may be shorter than the leader's.
    """

    name: str
    leader: np.ndarray
    leader_speed: np.ndarray
    follower: np.ndarray
    follower_speed: np.ndarray


def events(path: Path, order: str) -> list[Event]:
    """Return the events of a tidy file with vehicle 1 ahead of vehicle 2, sorted by the column ``order``."""
    result = []
    for (name,), rows in pl.read_parquet(path).sort("run_id", order).group_by("run_id", maintain_order=True):
        parts = [rows.filter(pl.col("vehicle_id") == k) for k in (1, 2)]
        columns = [part[column].cast(pl.Float64).to_numpy() for part in parts for column in ("position_m", "speed_mps")]
        result.append(Event(str(name), *columns))
    return result


def follow(
    items: Sequence[Event], values: Sequence[float], effects: tuple[Effect, ...], first: int
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Drive all followers behind their measured leaders from step ``first`` on; return positions and speeds after it.

    ``values`` are those of ``NAMES``; ``effects`` the car-following effect and its limits.
    """
    most = max(len(one.leader) for one in items)
    ahead = torch.as_tensor(np.stack([np.pad(e.leader, (0, most - len(e.leader)), mode="edge") for e in items], 1))
    pace = torch.as_tensor(np.stack([np.pad(e.leader_speed, (0, most - len(e.leader)), mode="edge") for e in items], 1))
    own = torch.tensor([one.follower[first] for one in items], dtype=torch.float64)
    speed = torch.tensor([one.follower_speed[first] for one in items], dtype=torch.float64)
    sim = Simulator(Lane(), (*effects, Replay()), dt=DT)
    params = sim.defaults(dtype=torch.float64)
    idm = {name: torch.tensor(value, dtype=torch.float64) for name, value in zip(NAMES, values, strict=True)}
    params = params | {"idm": idm}
    state = sim.state(
        torch.stack([ahead[first], own], -1), torch.stack([pace[first], speed], -1), params, length=0.0
    )  # fmt: skip
    active, nothing, steps = torch.tensor([True, False]), torch.zeros_like(own), []
    with torch.no_grad():
        for k in range(first + 1, most):
            place, speeds = torch.stack([ahead[k], nothing], -1), torch.stack([pace[k], nothing], -1)
            state = sim.step(state, {"replay": Record(place, speeds, torch.zeros_like(speeds), active)}, params)
            steps.append(torch.stack([state.position[:, 1], state.speed[:, 1]]))
    path = torch.stack(steps).numpy()
    return [
        (path[: len(e.leader) - first - 1, 0, i], path[: len(e.leader) - first - 1, 1, i]) for i, e in enumerate(items)
    ]


def opencf(folder: Path) -> dict[str, float]:
    """Return, for every published IDM, the largest difference of a position from what they submitted (m)."""
    pairs = events(folder / "opencf_test_pairs.parquet", "step")
    values = json.loads((folder / "opencf_published.json").read_text())["parameters"]
    table = pl.read_parquet(folder / "opencf_published_outputs.parquet").sort("run_id", "step")
    largest = {}
    for name in BASELINES:
        ours = follow(pairs, values[name], (RawIDM(exponent=None), Clip(-10.0, 5.0)), FIRST)
        theirs = table[f"{name}_position_m"].to_numpy()
        largest[name] = float(np.abs(np.concatenate([position for position, _ in ours]) - theirs).max())
    return largest


@dataclass(frozen=True)
class Lost:
    """TransFollower's error: mean over events of squared errors of spacing (m²) and speed (m²/s²), with collisions.

    The first state, which is given, counts among the steps. A collision (gap below 0) ends an event, and every step
    that it loses costs ``STEP_LOST``.
    """

    spacing: float
    speed: float
    collisions: int
    total: float


def lost(items: Sequence[Event], driven: Sequence[tuple[np.ndarray, np.ndarray]]) -> Lost:
    """Return TransFollower's error of positions and speeds driven from the first state of every event on."""
    rows = []
    for event, (position, speed) in zip(items, driven, strict=True):
        hit = np.flatnonzero(event.leader[1:] - position < 0.0)
        end = 1 + int(hit[0]) if len(hit) else len(event.leader)
        apart = np.concatenate([event.follower[:1], position])[:end] - event.follower[:end]
        faster = np.concatenate([event.follower_speed[:1], speed])[:end] - event.follower_speed[:end]
        rows.append([np.mean(apart**2), np.mean(faster**2), len(hit) > 0, STEP_LOST * (len(event.leader) - end)])
    spacing, pace, _, cost = (float(x) for x in np.mean(rows, axis=0))
    return Lost(spacing, pace, sum(bool(row[2]) for row in rows), spacing + pace + cost)


def transfollower(folder: Path, values: Sequence[float] = NGSIM_IDM, most: int | None = None) -> Lost:
    """Return the error of IDM with these values on the NGSIM test events, whole or their first ``most`` steps."""
    items = [
        Event(e.name, *(x[:most] for x in (e.leader, e.leader_speed, e.follower, e.follower_speed)))
        for e in events(folder / "transfollower_ngsim_pairs.parquet", "time_s")
    ]
    return lost(items, follow(items, values, (IDM(exponent=None), Clip()), 0))


def main(data: Path = DATA) -> None:
    """Print both benchmarks."""
    for name, apart in opencf(data).items():
        print(f"OpenCF {name}: at most {apart:.1e} m from what was submitted, 500 pairs")
    for title, most in (("whole events", None), (f"first {EVENT_STEPS} steps", EVENT_STEPS)):
        error = transfollower(data, most=most)
        print(
            f"TransFollower NGSIM, its IDM, {title}: {error.total:.2f} (spacing {error.spacing:.2f} m², "
            f"speed {error.speed:.3f} m²/s²), {error.collisions} collisions"
        )


if __name__ == "__main__":
    command(main)
