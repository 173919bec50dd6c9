"""Clocks of recorders, one in each car, that are apart: found and put together.

Where a car measures its gap, the rate of that gap is the difference of both speeds at one time: a leader's clock that
is ahead by δ shows as the shift at which they agree best, and how drivers answer is not asked. Gaps from positions
agree with speeds at any shift. There a driver's acceleration is linear in the terms of IDM, with any parameters, at the
time at which his leader's record is right. A car whose clock is off shifts the one behind by as much as it shifts
itself, the other way: shifts of neighbours are opposite and of both signs. Shifts of one sign are delays, or foresight.
What a second leader foretells is a shift, too, unless it is among the terms.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import polars as pl

from idm_env.data import DataError, Episode, Trajectories, episodes
from idm_env.data.errors import repaired
from idm_env.data.schema import TRACK

SHIFTS = np.linspace(-1.2, 1.2, 25)
"""Shifts that are tried (s)."""
HALF_S, SHORTEST_S, MOST_DRIVERS = 0.5, 30.0, 60
"""Speeds change over twice the first (s); drivers of fewer seconds, and runs of more drivers, are not looked at."""
LEAST_PAIRS, OPPOSITE, LASTING, LEAST_SPREAD_S, ONE_PAIR_S = 8, -0.2, 0.75, 0.08, 0.05
"""Neighbours, their correlation, that of both halves of records, and the spread (s), from which clocks are apart.

Shifts of the same two cars that differ by less than the last (s) from run to run are one."""


def on_one_clock(trajectories: Trajectories) -> Trajectories:
    """Return trajectories whose recorders have one clock in each run: the same ones where nothing shows another.

    Times are shifted and put on the run's clock again. The counted repair says by how much clocks were apart.
    """
    if not (offsets := clock_offsets(trajectories)):
        return trajectories
    shifts = pl.DataFrame([(*track, x) for track, x in offsets.items()], [*TRACK, "offset"], orient="row")
    table = trajectories.table.join(shifts, on=TRACK, how="left", maintain_order="left")
    gap = pl.when(pl.col("gap_measured")).then("gap_m").alias("gap_m")
    table = table.with_columns(gap, pl.col("time_s") - pl.col("offset").fill_null(0.0))
    shifted = Trajectories.from_frame(table.drop("gap_measured", "offset"), source=trajectories.source)
    ways = "how drivers answer their leaders (a delay that all share looks alike)", "rates of measured gaps"
    by = ways[trajectories.table["gap_measured"].any()]
    words = f"recorders have clocks up to {np.ptp([0.0, *offsets.values()]):.1f} s apart, by {by}; times were shifted."
    repairs = (*trajectories.repairs, *repaired("clocks apart", len(offsets), words))
    return replace(trajectories, table=shifted.table, steps=shifted.steps, repairs=repairs)


@np.errstate(invalid="ignore", divide="ignore")  # where all is equal nothing correlates, and nothing is shifted
def clock_offsets(trajectories: Trajectories) -> dict[tuple[str, str], float]:
    """Return by (run, vehicle) how far clocks are ahead of that of the first car of a platoon (s); nothing for one."""
    counts = pl.DataFrame(trajectories.followers(), schema=TRACK, orient="row")["run_id"].value_counts()
    few = counts.filter(pl.col("count") <= MOST_DRIVERS).sort("run_id")
    some = few.filter(pl.col("count").cum_sum() <= MOST_DRIVERS)["run_id"].to_list()
    measured = bool(trajectories.table["gap_measured"].any())
    of_shifts: Callable[[Episode, np.ndarray], np.ndarray] = _rate_errors if measured else _response_errors
    items = _long_episodes(trajectories, some, not measured)
    by_track = {(e.run_id, e.vehicle_id): i for i, e in enumerate(items)}
    ahead = [(i, by_track[e.run_id, e.leader_id]) for i, e in enumerate(items) if (e.run_id, e.leader_id) in by_track]
    if len(ahead) < LEAST_PAIRS or items[0].dt > HALF_S:
        return {}
    i, j = np.array(ahead).T
    whole, first, last = np.array([[_shift(e, p, of_shifts) for p in _parts(e)] for e in items]).T
    opposite, lasting = np.corrcoef(whole[i], whole[j])[0, 1], np.corrcoef(first, last)[0, 1]
    if min(whole.max(), -whole.min(), whole.std()) < LEAST_SPREAD_S or opposite > OPPOSITE or lasting < LASTING:
        return {}
    if not measured:  # what a second leader foretells moves answers, and no rates
        second = np.array([_shift(e, _parts(e)[0], partial(_response_errors, second=True)) for e in items])
        if np.corrcoef(second[i], second[j])[0, 1] > 0.0 or second.std() < 0.5 * whole.std():
            return {}
    items = _long_episodes(trajectories, few["run_id"].to_list(), not measured)
    single = [_shift(e, _parts(e)[0], of_shifts) for e in items]
    shifts = {(e.run_id, e.vehicle_id): (e.leader_id, _usual(items, single, e)) for e in items}
    return {track: _offset(shifts, *track) for track in shifts}


def _long_episodes(trajectories: Trajectories, runs: list[str], smooth: bool) -> list[Episode]:
    """Return the drivers of some runs who follow long enough."""
    try:
        some = episodes(trajectories.of_runs(runs), smooth=smooth) if runs else ()
        return [e for e in some if e.seconds >= SHORTEST_S]
    except DataError:
        return []


def _usual(items: list[Episode], shifts: list[float], episode: Episode) -> float:
    """Return the shift (s) of a driver [episodes]: where those of the same two cars agree over runs their median."""
    pair = episode.vehicle_id, episode.leader_id
    alike = np.array([s for e, s in zip(items, shifts, strict=True) if (e.vehicle_id, e.leader_id) == pair])
    middle = float(np.median(alike))
    return middle if np.median(abs(alike - middle)) < ONE_PAIR_S else shifts[items.index(episode)]


def _offset(shifts: dict[tuple[str, str], tuple[str, float]], run: str, vehicle: str, most: int = 20) -> float:
    """Return the sum of the shifts from the first car of a platoon on (s), less what the clock is ahead of it."""
    if (run, vehicle) not in shifts or not most:
        return 0.0
    leader, shift = shifts[run, vehicle]
    return _offset(shifts, run, leader, most - 1) - shift


def _parts(episode: Episode) -> list[np.ndarray]:
    """Return which samples [T] are of the whole record and of its halves."""
    first = np.arange(len(episode)) < len(episode) // 2
    return [np.ones(len(episode), bool), first, ~first]


def _shift(e: Episode, part: np.ndarray, of_shifts: Callable[[Episode, np.ndarray], np.ndarray]) -> float:
    """Return the shift of the leader's record (s) at which an error is least, by parabola."""
    errors = of_shifts(e, part)
    k = min(max(int(errors.argmin()), 1), len(SHIFTS) - 2)
    a, b, c = errors[k - 1 : k + 2]
    move = np.clip(0.5 * (a - c) / (a - 2 * b + c), -1, 1) if a - 2 * b + c > 0 else 0.0
    return float(SHIFTS[k] + move * (SHIFTS[1] - SHIFTS[0]))


def _inner(e: Episode, part: np.ndarray) -> tuple[int, np.ndarray, np.ndarray]:
    """Return half a difference's samples, times (s), and which moving samples of ``part`` [T] all shifts have."""
    time, edge = np.arange(len(e)) * e.dt, HALF_S + e.dt + SHIFTS[-1]
    use = part & (e.speed_mps > 0.5) & (time >= edge) & (time < time[-1] - edge)
    return max(1, round(HALF_S / e.dt)), time, use


def _rate_errors(e: Episode, part: np.ndarray) -> np.ndarray:
    """Return by shift the mean square of the measured gap's rate less the difference of speeds (m²/s²)."""
    k, time, use = _inner(e, part)
    rate = (np.roll(e.gap_m, -k) - np.roll(e.gap_m, k)) / (2 * k * e.dt)
    left = rate - np.interp(time + SHIFTS[:, None], time, e.leader.speed_mps) + e.speed_mps
    return np.asarray((left[:, use] ** 2).sum(1) / max(int(use.sum()), 1))


def _response_errors(e: Episode, part: np.ndarray, second: bool = False) -> np.ndarray:
    """Return by shift the mean square of residual accelerations (m²/s⁴), at the samples of ``part`` [T]."""
    (k, time, use), v = _inner(e, part), e.speed_mps
    accel, own = (np.roll(v, -k) - np.roll(v, k))[use] / (2 * k * e.dt), v[use] / 10.0
    then, terms = time[use] + SHIFTS[:, None], [np.ones(len(accel)), own**4]
    for other in (e.leader, e.second_leader) if second and e.second_leader.present.all() else (e.leader,):
        place, speed = (np.interp(then, time, x) for x in (other.position_m, other.speed_mps))
        gap, closing = np.maximum(place - other.length_m - e.position_m[use], 1.0) / 10.0, v[use] - speed
        terms += [x / gap**2 for x in (1.0, own, own**2, own * closing, own**2 * closing, (own * closing) ** 2)]
    if len(accel) <= 4 * len(terms):
        return np.zeros(len(SHIFTS))
    # The last number of a triangle is what its other columns leave of the last one.
    each = np.stack([np.broadcast_to(x, then.shape) for x in (*terms, accel)], axis=-1)
    return np.asarray(np.asarray(np.linalg.qr(each, mode="r"))[:, -1, -1] ** 2 / len(accel))
