"""A second judgement of measured drivers: own laws, loop, calibration and split; of the package only the loader.

    python -m benchmarks.independent --data ../shared/data [--only AstaZero] [--laws "IDM|linear"] [--other-runs]

Every driver is fitted to windows of 5 s in the first half of his time and judged on windows in the second. His
population and its weight come from drivers of other runs. The equations stand here once more, printed from nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numba
import numpy as np
import polars as pl

from benchmarks import DATA, command, table
from benchmarks.measured import cases
from idm_env.data import Trajectories, load

HORIZON_S, PAUSE_S, SKIPPED_S = 5.0, 5.0, 3.0
"""Length of a prediction; least time between what is fitted and what is judged; left out where a piece begins."""
LEAST_S, PIECE_S = 30.0, 15.0
"""Least time of a driver, and of a piece of it without a hole."""
NAMES = ("v0", "T", "s0", "a", "b", "κ", "τ", "w", "k", "c", "lag")
LOW = np.log([8.0, 0.3, 0.3, 0.2, 0.2, 0.3, 0.7, 0.08, 0.1, 0.005, 0.01])
HIGH = np.log([60.0, 4.0, 8.0, 5.0, 9.0, 3.0, 40.0, 3.0, 12.0, 1.0, 3.0])
USUAL = np.log([33.0, 1.4, 2.5, 1.2, 1.6, 1.0, 5.0, 1.0, 1.0, 0.1, 0.3])
WIDTH, NARROWEST = 0.6, 0.15
"""Width of the first prior of ln θ, and the least width of a population."""
COUNTED = (1.0, 3.0, 10.0, 30.0)
"""So many windows count as one: the weights of the population that are tried."""
IDM, IIDM, LINEAR = 0, 1, 2


class Law(NamedTuple):
    """A law: its number, which of ``NAMES`` are a driver's own, and where the linear law's gains begin."""

    number: int
    own: tuple[int, ...]
    begin: tuple[tuple[int, float], ...] = ()

    @property
    def start(self) -> np.ndarray:
        """Return ln θ of all parameters to begin with; those that are not own stay there."""
        start = USUAL.copy()
        for i, value in self.begin:
            start[i] = np.log(value)
        return start

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of ln θ; the linear law's gains have a unit, and bounds of their own."""
        low, high = LOW.copy(), HIGH.copy()
        if self.number == LINEAR:
            low[[7, 8]], high[[7, 8]] = np.log([0.002, 0.005]), np.log([2.0, 3.0])
        return low, high


FIVE = (0, 1, 2, 3, 4)
GAINS = ((7, 0.1), (8, 0.3))
LAWS = {
    "IDM": Law(IDM, FIVE),
    "IDM, stiffness 0.21 for all": Law(IDM, FIVE, ((7, 0.21),)),
    "IDM, own stiffness": Law(IDM, (*FIVE, 7)),
    "IDM, own trend, stiffness, closing gain": Law(IDM, (*FIVE, 5, 6, 7, 8)),
    "improved IDM": Law(IIDM, FIVE),
    "improved IDM, own trend, stiffness, closing gain": Law(IIDM, (*FIVE, 5, 6, 7, 8)),
    "linear": Law(LINEAR, (*FIVE, 7, 8, 9, 10), GAINS),
    "linear without feed-forward": Law(LINEAR, (*FIVE, 7, 8, 10), (*GAINS, (9, 1e-9))),
    "linear without lag": Law(LINEAR, (*FIVE, 7, 8, 9), (*GAINS, (10, 1e-9))),
    "linear without both": Law(LINEAR, (*FIVE, 7, 8), (*GAINS, (9, 1e-9), (10, 1e-9))),
}


@numba.njit(cache=True, error_model="numpy")
def acceleration(law, s, v, lead, lead_accel, mean, accel, dt, p):  # type: ignore[no-untyped-def]
    """Return A (m/s²) at gap s, speed v and the leader's; ``mean`` is the memory of his speed, ``accel`` the last A."""
    v0, time_gap, s0, a, b, w, k = p[0], p[1], p[2], p[3], p[4], p[7], p[8]
    s = max(s, 0.2)
    if law == 2:
        follow = w * (s - s0 - time_gap * v) + k * (lead - v) + p[9] * lead_accel
        target = min(max(min(follow, 0.4 * (v0 - v)), -b), a)
        return target + (accel - target) * p[10] / (p[10] + dt)
    if p[5] != 1.0:
        time_gap *= p[5] ** min(max((lead - mean) / 3.0, -2.0), 2.0)
    free = 1.0 - (v / v0) ** 4
    softer = min(max(s / ((s0 + v * time_gap) / np.sqrt(max(free, 0.02))), 0.05), 20.0)
    ratio = softer ** (1.0 - w) if w != 1.0 else 1.0
    z = ratio * (s0 + max(0.0, v * time_gap + v * k * (v - lead) / (2.0 * np.sqrt(a * b)))) / s
    if law == 0:
        return max(a * (free - z * z), -9.0)
    if v <= v0:
        f = max(a * free, 0.01 * a)
        return max(a * free * (1.0 - min(z, 1.0) ** (2.0 * a / f)) - a * max(z * z - 1.0, 0.0), -9.0)
    return max(-b * (1.0 - (v0 / v) ** (4.0 * a / b)) - a * max(z * z - 1.0, 0.0), -9.0)


@numba.njit(cache=True, error_model="numpy")
def errors_of(law, gap, speed, lead, lead_accel, starts, steps, dt, pushed, p):  # type: ignore[no-untyped-def]
    """Return errors [W, 4] of windows: speed and gap at half the horizon, and at its end.

    ``pushed`` [W, steps] is an acceleration (m/s²) that is added to the law's: what a process of residuals foresees.
    """
    errors, mean = np.empty((len(starts), 4)), np.empty(len(lead))
    mean[0], decay = lead[0], np.exp(-dt / p[6])
    for i in range(1, len(lead)):
        mean[i] = lead[i - 1] + (mean[i - 1] - lead[i - 1]) * decay
    h = 0.5 * dt
    for i, first in enumerate(starts):
        s, v, m, accel = gap[first], speed[first], mean[first], (speed[first] - speed[first - 3]) / (3.0 * dt)
        for j in range(steps):
            now, after = lead[first + j], lead[first + j + 1]
            for half in range(2):
                begin, middle = now + 0.5 * half * (after - now), now + (0.5 * half + 0.25) * (after - now)
                foot = acceleration(law, s, v, begin, lead_accel[first + j], m, accel, 0.5 * h, p) + pushed[i, j]
                between = max(v + 0.5 * h * foot, 0.0)
                s_between = s + 0.5 * h * (begin - v)
                own = acceleration(law, s_between, between, middle, lead_accel[first + j], m, accel, h, p)
                new = max(v + h * (own + pushed[i, j]), 0.0)
                s += h * (middle - 0.5 * (v + new))
                v, accel = new, own
                m = begin + (m - begin) * np.sqrt(decay)
            if j + 1 == steps // 2 or j + 1 == steps:
                column = 0 if j + 1 < steps else 2
                errors[i, column], errors[i, column + 1] = v - speed[first + j + 1], s - gap[first + j + 1]
    return errors


@dataclass(frozen=True, eq=False)
class Track:
    """A driver of a run: pieces of gap, own speed, leader's speed and acceleration, each [samples]."""

    run: str
    vehicle: str
    car: str
    dt: float
    pieces: tuple[tuple[np.ndarray, ...], ...]

    def windows(self, half: int | None) -> list[np.ndarray]:
        """Return where windows begin in every piece: in the ``half`` 0 or 1 of his time, or in all of it for None."""
        total, before, starts = sum(len(p[0]) for p in self.pieces), 0, []
        length, pause = round(HORIZON_S / self.dt), round(PAUSE_S / self.dt)
        hop = length if total * self.dt > 300.0 else length // 5
        for gap, *_ in self.pieces:
            begin = np.arange(round(SKIPPED_S / self.dt), len(gap) - length - 1, hop)
            if half == 0:
                begin = begin[before + begin + length <= total // 2]
            if half == 1:
                begin = begin[before + begin >= total // 2 + pause]
            starts.append(begin)
            before += len(gap)
        return starts

    def errors(self, law: Law, theta: np.ndarray, starts: list[np.ndarray], pushed: Any = None) -> np.ndarray:
        """Return errors [W, 4] with ln θ [all]; ``pushed`` [W, steps] is added to the acceleration."""
        steps, parts, place = round(HORIZON_S / self.dt), [np.zeros((0, 4))], 0
        p = np.exp(theta)
        for piece, begin in zip(self.pieces, starts, strict=True):
            push = np.zeros((len(begin), steps)) if pushed is None else pushed[place : place + len(begin)]
            place += len(begin)
            if len(begin):
                parts.append(errors_of(law.number, *piece, begin, steps, self.dt, push, p))
        return np.clip(np.nan_to_num(np.concatenate(parts), nan=30.0), -30.0, 30.0)


def tracks_of(trajectories: Trajectories) -> list[Track]:
    """Return drivers of ``LEAST_S`` and more. Slow drift between gap and speeds goes to the leader's speed."""
    table, key = trajectories.table, ["run_id", "vehicle_id"]
    leaders = table.select("run_id", "time_s", pl.col("vehicle_id").alias("leader_id"), pl.col("speed_mps").alias("u"))
    seen = table.filter(pl.col("gap_m").is_not_null()).join(leaders, on=["run_id", "leader_id", "time_s"])
    tracks = []
    for (run, vehicle), part in seen.sort(*key, "time_s").group_by(key, maintain_order=True):
        dt, pieces = trajectories.steps[str(run)], []
        time, gap, speed, lead = (part[n].to_numpy().astype(float) for n in ("time_s", "gap_m", "speed_mps", "u"))
        leader = part["leader_id"].to_numpy()
        is_cut = (np.abs(np.diff(time) - dt) > 0.2 * dt) | (leader[1:] != leader[:-1]) | (np.abs(np.diff(gap)) > 3.0)
        for each in np.split(np.arange(len(time)), np.flatnonzero(is_cut) + 1):
            if len(each) * dt >= PIECE_S:
                pieces.append(_rebuilt(gap[each], speed[each], lead[each], dt))
        if sum(len(p[0]) for p in pieces) * dt >= LEAST_S:
            car = str(part["vehicle_name"][0]) if "vehicle_name" in part.columns else ""
            tracks.append(Track(str(run), str(vehicle), car, dt, tuple(pieces)))
    return tracks


def _rebuilt(gap: np.ndarray, speed: np.ndarray, lead: np.ndarray, dt: float) -> tuple[np.ndarray, ...]:
    opening = lead - speed
    drift = gap - gap[0] - np.append(0.0, np.cumsum(0.5 * dt * (opening[1:] + opening[:-1])))
    reach = round(5.0 / dt)
    wide = np.concatenate([np.full(reach, drift[0]), drift, np.full(reach, drift[-1])])
    smooth = np.convolve(wide, np.full(2 * reach + 1, 1.0 / (2 * reach + 1)), "valid")
    lead = np.maximum(lead + np.gradient(smooth, dt), 0.0)
    near = round(0.4 / dt)
    index = np.arange(len(lead))
    after, before = np.minimum(index + near, len(lead) - 1), np.maximum(index - near, 0)
    return gap, speed, lead, (lead[after] - lead[before]) / (dt * (after - before))


class Population(NamedTuple):
    """Centre and width of ln θ of a law's own parameters, and how many windows count as one."""

    centre: np.ndarray
    width: np.ndarray
    counted: float


def calibrate(
    law: Law, tracks: list[tuple[Track, list[np.ndarray]]], prior: Population, start: np.ndarray, free: Any = None
) -> np.ndarray:
    """Fit ln θ [all] to windows of some tracks by Levenberg–Marquardt; ``free`` are those of ``law.own`` or given."""
    free = list(law.own if free is None else free)
    low, high = (x[free] for x in law.bounds)
    theta = start.copy()
    theta[free] = np.clip(theta[free], low, high)
    damping = 1.0

    def residual(theta: np.ndarray) -> np.ndarray:
        return np.concatenate([track.errors(law, theta, begin) for track, begin in tracks])

    now = residual(theta)
    if not len(now):
        theta[free] = prior.centre
        return theta
    typical = np.maximum(1.48 * np.median(np.abs(now), axis=0), 0.05)
    size = np.sqrt(np.mean(np.minimum(now**2, (6.0 * typical) ** 2), axis=0)) * np.sqrt(prior.counted)

    def cost(theta: np.ndarray, errors: np.ndarray) -> float:
        return float(((errors / size) ** 2).sum() + (((theta[free] - prior.centre) / prior.width) ** 2).sum())

    least = cost(theta, now)
    for _ in range(20):
        slopes = []
        for i, upper in zip(free, high, strict=True):
            moved = theta.copy()
            moved[i] += (step := 1e-3 if theta[i] + 1e-3 < upper else -1e-3)
            slopes.append(((residual(moved) - now) / (step * size)).ravel())
        jacobian, scaled = np.array(slopes), (now / size).ravel()
        matrix = jacobian @ jacobian.T + np.diag(prior.width**-2.0)
        slope = jacobian @ scaled + (theta[free] - prior.centre) / prior.width**2
        for _ in range(5):
            tried = theta.copy()
            change = np.linalg.solve(matrix + damping * np.diag(np.diag(matrix)), -slope)
            tried[free] = np.clip(theta[free] + np.clip(change, -0.7, 0.7), low, high)
            errors = residual(tried)
            if (total := cost(tried, errors)) < least:
                break
            damping *= 4.0
        else:
            break
        gained, theta, now, least, damping = least - total, tried, errors, total, max(damping / 4.0, 1e-4)
        if gained < 1e-4 * least:
            break
    return theta


def judge(law: Law, tracks: list[Track]) -> list[np.ndarray]:
    """Return the gap's errors 5 s ahead of every driver in the second half of his time."""
    halves = [(track.windows(0), track.windows(1)) for track in tracks]
    own, runs = list(law.own), np.array([track.run for track in tracks])
    weak = Population(law.start[own], np.full(len(own), WIDTH), 1.0)
    first = [calibrate(law, [(t, h[0])], weak, law.start) for t, h in zip(tracks, halves, strict=True)]
    singles = np.array(first)[:, own]
    judged: dict[float, list[np.ndarray]] = {}
    for counted in COUNTED:
        judged[counted] = []
        for track, half, start in zip(tracks, halves, first, strict=True):
            others = singles[runs != track.run]
            centre = np.median(others, axis=0)
            width = np.clip(1.4826 * np.median(np.abs(others - centre), axis=0), NARROWEST, WIDTH)
            theta = calibrate(law, [(track, half[0])], Population(centre, width, counted), start)
            judged[counted].append(track.errors(law, theta, half[1])[:, 3])
    squares = {c: np.array([float((e**2).sum()) for e in errors]) for c, errors in judged.items()}
    # The weight for a driver is the one that is best for drivers of other runs.
    best = [min(COUNTED, key=lambda c: squares[c][runs != run].sum()) for run in runs]
    return [judged[c][i] for i, c in enumerate(best)]


def compared(null: list[np.ndarray], errors: list[np.ndarray], runs: list[str], seed: int = 0) -> dict[str, float]:
    """Return the ratio of pooled errors with its 95 % interval by bootstrap of runs, or drivers of few runs."""
    squares = np.array([[(e**2).sum() for e in group] for group in (null, errors)])
    unit = np.unique(runs, return_inverse=True)[1] if len(set(runs)) >= 6 else np.arange(len(runs))
    sums = np.stack([np.bincount(unit, s) for s in squares])
    draws = np.random.default_rng(seed).integers(sums.shape[1], size=(2000, sums.shape[1]))
    ratios = np.sqrt(sums[1][draws].sum(1) / sums[0][draws].sum(1))
    each = np.sqrt(squares[1] / np.maximum(squares[0], 1e-12))[[len(e) > 0 for e in null]]
    low, high = np.quantile(ratios, (0.025, 0.975))
    return {
        "rmse_m": float(np.sqrt(squares[1].sum() / sum(map(len, null)))),
        "ratio": float(np.sqrt(squares[1].sum() / squares[0].sum())),
        "low": float(low),
        "high": float(high),
        "median_driver": float(np.median(each)),
        "better": int((each < 1.0).sum()),
        "drivers": len(each),
    }


def rows(trajectories: Trajectories, laws: dict[str, Law] = LAWS) -> dict[str, dict[str, float]]:
    """Return how every law compares with IDM on drivers with windows in both halves of their time."""
    tracks = [t for t in tracks_of(trajectories) if all(any(len(b) for b in t.windows(half)) for half in (0, 1))]
    runs = [track.run for track in tracks]
    errors = {name: judge(law, tracks) for name, law in laws.items()}
    return {name: {"parameters": len(laws[name].own), **compared(errors["IDM"], x, runs)} for name, x in errors.items()}


BLOCK, PAST, RUNS = 5, 20, 3
"""Samples that a residual is averaged over; residuals that a process looks back on; least runs of a car."""
SECONDS, NOISE = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0), (0.1, 0.3, 0.5, 0.7, 0.9)
"""Lengths (blocks of 0.5 s times two) and shares of white noise that a Gaussian process is tried with."""


@numba.njit(cache=True, error_model="numpy")
def residuals_of(law, gap, speed, lead, lead_accel, dt, p):  # type: ignore[no-untyped-def]
    """Return measured less the law's acceleration (m/s²) between samples of a record."""
    rest, mean, accel, decay = np.zeros(len(gap) - 1), lead[0], 0.0, np.exp(-dt / p[6])
    for i in range(len(gap) - 1):
        own = acceleration(law, gap[i], speed[i], lead[i], lead_accel[i], mean, accel, dt, p)
        accel = (speed[i + 1] - speed[i]) / dt
        rest[i] = accel - own
        mean = lead[i] + (mean - lead[i]) * decay
    return rest


def before(law: Law, track: Track, theta: np.ndarray, starts: list[np.ndarray]) -> np.ndarray:
    """Return the last ``PAST`` residuals before every window [W, PAST], the oldest first; 0 before a piece."""
    rows = []
    for piece, begin in zip(track.pieces, starts, strict=True):
        rest = residuals_of(law.number, *piece, track.dt, np.exp(theta))
        wide = np.append(np.zeros(BLOCK * PAST), rest)
        rows += [wide[i : i + BLOCK * PAST].reshape(PAST, BLOCK).mean(1) for i in begin]
    return np.array(rows).reshape(-1, PAST)


def autoregression(chains: np.ndarray, ahead: int, order: int = 3) -> np.ndarray:
    """Return how AR(3), fitted to chains [N, PAST] of residuals, foresees the next ones [ahead, PAST]."""
    lags = np.stack([chains[:, order - 1 - i : PAST - 1 - i].ravel() for i in range(order)], axis=1)
    carry = np.linalg.lstsq(lags, chains[:, order:].ravel(), rcond=None)[0]
    chain = np.eye(PAST)
    for _ in range(ahead):
        chain = np.vstack([chain, carry @ chain[: -order - 1 : -1]])
    return chain[PAST:]


def gaussian_process(chains: np.ndarray, ahead: int) -> np.ndarray:
    """Return how a Gaussian process (squared exponential, white noise) of highest likelihood foresees [ahead, PAST]."""
    time, best = 0.5 * np.arange(PAST + ahead), (np.inf, np.zeros((ahead, PAST)))
    for length in SECONDS:
        smooth = np.exp(-0.5 * ((time[:, None] - time) / length) ** 2)
        for noise in NOISE:
            past = (1.0 - noise) * smooth[:PAST, :PAST] + noise * np.eye(PAST)
            power = np.mean(chains * np.linalg.solve(past, chains.T).T)
            cost = np.linalg.slogdet(past)[1] + PAST * np.log(power)
            if cost < best[0]:
                best = float(cost), np.linalg.solve(past, (1.0 - noise) * smooth[:PAST, PAST:]).T
    return best[1]


PROCESSES: dict[str, Any] = {"": None, " + AR(3)": autoregression, " + Gaussian process": gaussian_process}


def judged_without(tracks: list[Track], laws: dict[str, Law]) -> dict[str, dict[str, float]]:
    """Return how laws compare with IDM where one run of a car is left out: its other runs tell all but T.

    T is fitted to the first half of the run, and errors 5 s ahead are of the second. Processes of residuals are
    fitted to the other runs, and foresee from those of the last 10 s.
    """
    cars = {car for car in {t.car for t in tracks} if len({t.run for t in tracks if t.car == car}) >= RUNS}
    judged = [t for t in tracks if t.car in cars and all(any(len(b) for b in t.windows(half)) for half in (0, 1))]
    errors: dict[str, list[np.ndarray]] = {name + process: [] for name in laws for process in PROCESSES}
    for track in judged:
        others = [t for t in tracks if t.car == track.car and t.run != track.run]
        parts = [(t, [begin[::2] for begin in t.windows(None)]) for t in others]
        starts = track.windows(1)
        for name, law in laws.items():
            own = list(law.own)
            theta = calibrate(law, parts, Population(law.start[own], np.full(len(own), WIDTH), 1.0), law.start)
            prior = Population(theta[[1]], np.array([0.3]), 3.0)
            theta = calibrate(law, [(track, track.windows(0))], prior, theta, free=[1])
            chains = np.concatenate([before(law, t, theta, begin) for t, begin in parts])
            seen, steps = before(law, track, theta, starts), round(HORIZON_S / track.dt)
            for process, foresee in PROCESSES.items():
                pushed = None
                if foresee is not None:
                    pushed = np.repeat(seen @ foresee(chains, steps // BLOCK).T, BLOCK, axis=1)
                errors[name + process].append(track.errors(law, theta, starts, pushed)[:, 3])
    runs = [track.run for track in judged]
    return {name: compared(errors["IDM"], x, runs) for name, x in errors.items()}


def main(data: Path = DATA, only: str = "", laws: str = "", other_runs: bool = False) -> None:
    """Print how laws compare with IDM, 5 s ahead.

    Args:
        data: Folder of the measured files.
        only: Part of the names of the cases of ``benchmarks.measured``.
        laws: Names of ``LAWS``, by |; IDM is always there.
        other_runs: Leave one run of a car out, where cars have names.
    """
    chosen = {name: law for name, law in LAWS.items() if name == "IDM" or not laws or name in laws.split("|")}
    lines = []
    for case, choice in cases(data).items():
        if only in case:
            trajectories = load(data / choice["file"]).where(choice.get("where", ()))
            judged = judged_without(tracks_of(trajectories), chosen) if other_runs else rows(trajectories, chosen)
            for name, r in judged.items():
                ratio = f"{r['ratio']:.3f} ({r['low']:.3f} … {r['high']:.3f})"
                better = f"{r['better']} of {r['drivers']}"
                lines.append([case, name, f"{r['rmse_m']:.2f}", ratio, f"{r['median_driver']:.3f}", better])
    print(table(("case", "law", "5 s ahead, m", "over IDM's", "median driver", "better"), lines))


if __name__ == "__main__":
    command(main)
