"""Data with a known truth: platoons of heterogeneous drivers, hidden effects, drivers' and measurement noise."""

from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np
import polars as pl

from idm_env.data import hidden, scripted
from idm_env.data.errors import DataError, nearest
from idm_env.data.hidden import EFFECTS, Drivers
from idm_env.data.platoon import Platoon, PlatoonMotion
from idm_env.data.trajectories import Trajectories

__all__ = ["EFFECTS", "Truth", "generate"]

SUBSTEPS = 4
LATEST_START_S = 40.0
NOISE_MEMORY_S = 1.0
_MEDIANS = {"time_gap": 1.3, "min_gap": 2.2, "max_accel": 1.4, "comfort_decel": 1.8, "desired_speed": 32.0}


@dataclass(frozen=True)
class Truth:
    """The truth behind generated data, which a fitted model is to find.

    Attributes:
        effects: Strength by name of the effects at work; empty if none.
        drivers: One row per follower: run_id, vehicle_id and the five parameters of `idm_env.data.hidden.Drivers`.
        motion: The table without noise: run_id, vehicle_id, time_s, position_m, speed_mps, accel_mps2.
        noise: Standard deviation of the white noise of positions in m.
        ou: Standard deviation of the drivers' Ornstein-Uhlenbeck acceleration in m/s².
    """

    effects: dict[str, float]
    drivers: pl.DataFrame
    motion: pl.DataFrame
    noise: float
    ou: float


def generate(
    seed: int,
    *,
    runs: int = 10,
    followers: int = 3,
    seconds: float = 180.0,
    effect: str | Mapping[str, float] | None = None,
    strength: str | float = "middle",
    noise: float = 0.05,
    correlated_noise: float = 0.0,
    speed_noise: float = 0.02,
    ou: float = 0.0,
    ou_time: float = 5.0,
    spread: float = 0.2,
    gap_column: bool = False,
    grade_column: bool = False,
    laps: bool = False,
    dt: float = 0.1,
) -> tuple[Trajectories, Truth]:
    """Return platoons that look measured, and the truth about them; the same seed gives the same data.

    Args:
        seed: Of everything random.
        runs: Number of runs.
        followers: Number of followers behind each leader.
        seconds: Duration of a run.
        effect: A name of `EFFECTS`, a mapping from names to strengths, or None. With ``curve_speed`` the table has a
            column curvature (1/m).
        strength: ``"middle"``, ``"half"``, or the value itself, where `effect` is a name.
        noise: White noise of every measured position (and gap), standard deviation in m.
        correlated_noise: Further noise of positions with a memory of 1 s, standard deviation in m.
        speed_noise: White noise of measured speeds in m/s.
        ou: Standard deviation of the drivers' random acceleration, an Ornstein-Uhlenbeck process, in m/s².
        ou_time: Its memory in s.
        spread: Log-standard deviation of the drivers' parameters, half of it for the desired speed.
        gap_column: Whether the table has a measured gap_m.
        grade_column: Whether the table tells the slope of the road.
        laps: Whether leaders drive laps and brake for the same bends every time; the place is column track_s_m.
        dt: Time step of the table in s.

    Raises:
        DataError: For an unknown effect or strength.
    """
    random = np.random.default_rng(seed)
    on = _effects(effect, strength)
    step = dt / SUBSTEPS
    steps = round(seconds / dt) * SUBSTEPS + 1
    shape = (runs, followers)
    drivers = _drivers(random, shape, spread)
    script = scripted.lapping if laps else scripted.leaders
    leader = script(random, runs, steps, step, 0.8 * drivers.desired_speed.min())
    queue = scripted.adjacent_queue(leader) if "lateral" in on else None
    lengths = random.uniform(4.0, 5.2, (runs, 1 + followers))
    starts = dt * random.integers(0, round(LATEST_START_S / dt), runs)
    unrest = scripted.ornstein_uhlenbeck(random, (steps, *shape), ou, ou_time, step)
    platoon = Platoon(leader, queue, drivers, lengths, starts, step, on, unrest)
    truth = Truth(on, _driver_table(drivers), _motion_table(platoon, platoon.run(), dt), noise, ou)
    table = _measured(random, truth, noise, correlated_noise, speed_noise, dt)
    if gap_column or "gap_bias" in on:
        table = _with_gap(random, truth, table, noise, on.get("gap_bias", 0.0))
    if laps:
        table = table.with_columns(track_s_m=pl.col("position_m") % scripted.LAP_M)
    if "curve_speed" in on:
        bends = hidden.curvature(truth.motion["position_m"].to_numpy())
        table = table.with_columns(pl.Series("curvature", bends))
    if grade_column:
        slopes = hidden.slope(truth.motion["position_m"].to_numpy(), on.get("grade", 0.0))
        table = table.with_columns(pl.Series("grade", slopes))
    return Trajectories.from_frame(table, source=f"synthetic data, seed {seed}"), truth


def _effects(effect: str | Mapping[str, float] | None, strength: str | float) -> dict[str, float]:
    if effect is None or effect == "none":
        return {}
    names = [effect] if isinstance(effect, str) else list(effect)
    for name in names:
        if name not in EFFECTS:
            guess = nearest(name, EFFECTS)
            cure = f"did you mean {guess!r}?" if guess else ", ".join(EFFECTS)
            raise DataError(f"effect = {name!r} is unknown; {cure}")
    if not isinstance(effect, str):
        return {name: float(value) for name, value in effect.items()}
    if isinstance(strength, str):
        if strength not in ("middle", "half"):
            raise DataError(f"strength = {strength!r} is unknown; use 'middle', 'half' or a number.")
        return {effect: getattr(EFFECTS[effect], strength)}
    return {effect: float(strength)}


def _drivers(random: np.random.Generator, shape: tuple[int, int], spread: float) -> Drivers:
    def draw(name: str) -> np.ndarray:
        deviation = spread / 2 if name == "desired_speed" else spread
        return _MEDIANS[name] * np.exp(deviation * np.clip(random.standard_normal(shape), -2, 2))

    return Drivers(**{field.name: draw(field.name) for field in fields(Drivers)})


def _motion_table(platoon: Platoon, motion: PlatoonMotion, dt: float) -> pl.DataFrame:
    every = slice(None, None, SUBSTEPS)
    groups = [(platoon.leader, 1), (motion, 1)] + ([(platoon.beside, 2)] if platoon.beside else [])
    parts, first = [], 1
    for group, lane in groups:
        arrays = [np.atleast_3d(getattr(group, name)[every]) for name in ("position", "speed", "accel")]
        steps, runs, vehicles = arrays[0].shape
        length = platoon.lengths[:, :1] if group is platoon.leader else platoon.lengths[:, 1:]
        length = length if lane == 1 else np.full((runs, vehicles), 4.5)
        number = np.arange(first, first + vehicles)
        first += vehicles
        grid = {
            "run_id": np.arange(runs)[None, :, None] + 1,
            "vehicle_id": number[None, None, :],
            "leader_id": np.where((number > 1) & (lane == 1), number - 1, 0)[None, None, :],
            "lane": np.array(lane),
            "time_s": np.round(platoon.starts[None, :, None] + dt * np.arange(steps)[:, None, None], 9),
            **dict(zip(("position_m", "speed_mps", "accel_mps2"), arrays, strict=True)),
            "length_m": length[None],
        }
        parts.append(pl.DataFrame({k: np.broadcast_to(v, arrays[0].shape).ravel() for k, v in grid.items()}))
    table = pl.concat(parts).sort("run_id", "vehicle_id", "time_s")
    return table.with_columns(pl.col("run_id", "vehicle_id", "leader_id").cast(pl.String))


def _driver_table(drivers: Drivers) -> pl.DataFrame:
    runs, followers = drivers.time_gap.shape
    run, vehicle = np.repeat(np.arange(1, runs + 1), followers), np.tile(np.arange(2, followers + 2), runs)
    values = {field.name: getattr(drivers, field.name).ravel() for field in fields(Drivers)}
    return pl.DataFrame({"run_id": run.astype(str), "vehicle_id": vehicle.astype(str), **values})


def _measured(
    random: np.random.Generator, truth: Truth, noise: float, correlated: float, speed_noise: float, dt: float
) -> pl.DataFrame:
    table = truth.motion
    slow = scripted.ornstein_uhlenbeck(random, (table.height,), correlated, NOISE_MEMORY_S, dt)
    position = table["position_m"].to_numpy() + noise * random.standard_normal(table.height) + slow
    speed = table["speed_mps"].to_numpy() + speed_noise * random.standard_normal(table.height)
    return table.drop("accel_mps2").with_columns(pl.Series("position_m", position), pl.Series("speed_mps", speed))


def _with_gap(
    random: np.random.Generator, truth: Truth, table: pl.DataFrame, noise: float, bias: float
) -> pl.DataFrame:
    lead = truth.motion.select("run_id", "time_s", leader_id="vehicle_id", front="position_m", lead_length="length_m")
    true = truth.motion.join(lead, on=["run_id", "time_s", "leader_id"], how="left", maintain_order="left")
    gap = (true["front"] - true["lead_length"] - true["position_m"]).to_numpy()
    measured = gap + bias + noise * random.standard_normal(len(gap))
    return table.with_columns(pl.Series("gap_m", measured, nan_to_null=True))
