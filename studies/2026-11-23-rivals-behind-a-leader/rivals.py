"""Forecasts of one driver behind his leader, on runs kept back: drift, and what others put beside IDM.

    python studies/2026-11-23-rivals-behind-a-leader/rivals.py --data ../shared/data [--file NAME] [--draws 60]

Pairs by the split of ``explain`` (a quarter of the runs kept back, seed 0). Drivers of these runs are
calibrated on every other block of time, as ``explain`` does, with the population of the other runs as prior. Forecasts
begin every 5 s in the blocks between, from the measured state, behind the leader as recorded. IDM and every row below
it have the same calibrations. σ, τ and all else come from runs that are not kept back. A forecast of 10 or 30 s may end
in a block that calibrated the driver, for all rows alike.
"""

from __future__ import annotations

import argparse
import copy
import dataclasses
import itertools
import os
import pathlib
import re
import sys
import time
from typing import Any, ClassVar

for variable in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "POLARS_MAX_THREADS"):
    os.environ.setdefault(variable, "1")

import numpy as np  # noqa: E402 (threads are set before numpy starts)
import torch  # noqa: E402
from torch import Tensor  # noqa: E402
from scipy.stats import energy_distance  # noqa: E402

from idm_env.data import Episode, episodes, load  # noqa: E402
from idm_env.drift import forecast  # noqa: E402
from idm_env.drift.estimate import Estimate, estimate, usual  # noqa: E402
from idm_env.drift.linear import MeasuredDrivers, Path  # noqa: E402
from idm_env.effects import IDM, AccelNoise, Brakes, Effect, Noise, Replay, Wander  # noqa: E402
from idm_env.effects.base import P  # noqa: E402
from idm_env.fitting.batch import Batch  # noqa: E402
from idm_env.fitting.fit import fit  # noqa: E402
from idm_env.fitting.prior import Prior  # noqa: E402
from idm_env.fitting.problem import IDM_NAMES  # noqa: E402
from idm_env.roads import Lane  # noqa: E402
from idm_env.simulator import Simulator  # noqa: E402
from idm_env.types import Driver, Scene  # noqa: E402

HORIZONS = (1.0, 5.0, 10.0, 30.0)
EVERY_S, FIRST_S = 5.0, 5.0
STEP_S = 0.5
"""Records are thinned to this step: errors of a model of drivers are no noise that is new ten times a second."""
NOISE_M = 13.0
"""Weight of the prior: errors of 3 m that stay alike for 10 s, every half second."""
THINNED = 3
"""Every so manieth driver to fit tells of drift."""
ORDER, RESIDUAL_S = 3, 0.5
MODELS: dict[str, tuple[Effect, ...]] = {
    "wander": (Wander(), Noise()),
    "wander, accel_noise": (Wander(), AccelNoise(), Noise()),
}
KNOWN = (0.0, 0.1, 0.3)
"""How well a calibration may be said to know the logarithms of a driver's parameters."""
CHOSEN = {"wander": (0.5, 0.3), "wander, accel_noise": (2.0, 1.0)}
"""By ``--choose``: the least CRPS 10 s ahead of those whose 90 % band covers 88 to 92 %, and drivers known for sure.

For a time gap alone none does: 93, 95 and 82 %. Its noise is that of the nearest."""
NOISES = ((0.5, 0.3), (1.0, 0.5), (2.0, 1.0))
"""What a filter may take for noise of gap (m) and speed (m/s): what drivers do beside any model of them is among it."""


def simulator(dt: float, *drifts: Effect) -> Simulator:
    """Return IDM behind a record with drift."""
    return Simulator(Lane(), (IDM(), *drifts, Replay(), Brakes()), dt=dt, integration="midpoint")


def split(found: list[Episode]) -> tuple[list[Episode], list[Episode]]:
    """Return the episodes of the runs to fit and of the runs kept back, as ``explain`` with seed 0 draws them."""
    runs = list(dict.fromkeys(e.run_id for e in found))
    order = np.random.default_rng(0).permutation(len(runs))
    kept = {runs[i] for i in order[: round(0.25 * len(runs))]}
    return [e for e in found if e.run_id not in kept], [e for e in found if e.run_id in kept]


def thinned(e: Episode) -> Episode:
    """Return an episode with fewer samples."""
    at = slice(None, None, round(STEP_S / e.dt))

    def few(x: Any) -> Any:
        if isinstance(x, np.ndarray):
            return x[at]
        if isinstance(x, dict):
            return {name: few(y) for name, y in x.items()}
        if dataclasses.is_dataclass(x):
            return dataclasses.replace(x, **{f.name: few(getattr(x, f.name)) for f in dataclasses.fields(x)})  # type: ignore[type-var]
        return x

    return dataclasses.replace(few(e), dt=STEP_S)


def block_s(e: Episode) -> float:
    """Return the length of the blocks of time, of which every other one calibrates."""
    return float(np.clip(len(e) * e.dt / 4.0, 5.0, 30.0))


def even(e: Episode) -> list[Episode]:
    """Return the blocks of an episode that calibrate."""
    size = round(block_s(e) / e.dt)
    return [e.part(i, min(i + size + 1, len(e))) for i in range(0, len(e) - 1, 2 * size) if len(e) - i > 4]


def calibrated(items: list[Episode], own: list[Episode], centre: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Return log θ [rows, 5] of the drivers of ``items``, calibrated on ``own`` with a prior."""
    groups = len({(e.run_id, e.vehicle_id) for e in own})
    prior = Prior(torch.tensor(np.exp(centre)).expand(groups, -1), torch.tensor(spread).expand(groups, -1), NOISE_M)
    found = fit(own, by="driver", loss="mse", starts=1, iterations=25, substeps=1, prior=prior)
    at = {name: i for i, name in enumerate(found.problem.groups)}
    return np.log(np.stack([found.own.numpy()[at[f"{e.run_id}/{e.vehicle_id}"]] for e in items]))


def starts_of(items: list[Episode]) -> list[tuple[int, int]]:
    """Return (row, sample) of every forecast: every 5 s in the blocks that calibrate nothing."""
    found = []
    for r, e in enumerate(items):
        for t in np.arange(FIRST_S, (len(e) - 1) * e.dt - 5.0, EVERY_S):
            if int(t // block_s(e)) % 2 == 1:
                found.append((r, round(t / e.dt)))
    return found


class Rows:
    """Forecasts of one sort at every horizon, scored."""

    def __init__(self, items: list[Episode], starts: list[tuple[int, int]]) -> None:
        self.items, self.starts = items, starts
        self.lines: list[tuple[str, float, int, list[float]]] = []
        self.distances: list[tuple[str, list[float]]] = []
        self.base: dict[float, tuple[float, float]] = {}

    def truth(self, horizon: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return which starts have a truth so far ahead, and gap and speed there."""
        at = [t + round(horizon / self.items[r].dt) for r, t in self.starts]
        there = np.array([t < len(self.items[r]) for (r, _), t in zip(self.starts, at, strict=True)])
        known = [(self.items[r], t) for (r, _), t, y in zip(self.starts, at, there, strict=True) if y]
        pairs = [(e.gap_m[t], e.speed_mps[t]) for e, t in known]
        gap, speed = np.array(pairs).T
        return there, gap, speed

    def score(self, name: str, gap: np.ndarray, speed: np.ndarray) -> None:
        """Score draws [steps, n, starts]; one draw is a point forecast."""
        self.distances.append((name, self._distances(gap, speed)))
        for horizon in HORIZONS:
            there, true_gap, true_speed = self.truth(horizon)
            step = round(horizon / self.items[0].dt) - 1
            s, v = gap[step][:, there], speed[step][:, there]
            ok = np.isfinite(s).all(0)
            s, v, true_gap, true_speed = s[:, ok], v[:, ok], true_gap[ok], true_speed[ok]
            rmse = float(np.sqrt(np.mean((s.mean(0) - true_gap) ** 2)))
            score = float(forecast.crps(s, true_gap).mean())
            base = self.base.setdefault(horizon, (score, rmse))
            numbers = [rmse, rmse / base[1], score, score / base[0], float(forecast.crps(v, true_speed).mean())]
            if len(s) > 1:
                for share in (0.5, 0.9):
                    inside, width = forecast.covers(s, true_gap, share)
                    numbers += [100.0 * float(inside.mean()), float(width.mean())]
                numbers += [float(forecast.log_score(x, y).mean()) for x, y in ((s, true_gap), (v, true_speed))]
            self.lines.append((name, horizon, int(ok.sum()), numbers))

    def _distances(self, gap: np.ndarray, speed: np.ndarray) -> list[float]:
        """Return how far distributions over all steps are from the measured: time gap, acceleration and jerk.

        Energy distances (Székely and Rizzo 2013) in units of the measured standard deviation: 0 are the same ones.
        """
        there = np.zeros((len(gap), len(self.starts)), bool)
        truth = np.full((2, len(gap) + 1, len(self.starts)), np.nan)
        for i, (r, t) in enumerate(self.starts):
            e = self.items[r].part(t, min(t + len(gap) + 1, len(self.items[r])))
            there[: len(e) - 1, i] = True
            truth[:, : len(e), i] = e.gap_m, e.speed_mps
        first = np.broadcast_to(truth[1, :1], (1, *speed.shape[1:]))
        told = _quantities(gap, np.concatenate([first, speed]), self.items[0].dt)
        true = _quantities(truth[0, 1:, None], truth[1][:, None], self.items[0].dt)
        found = []
        for x, y in zip(told, true, strict=True):
            ok = np.broadcast_to(there[-len(x) :, None], x.shape) & np.isfinite(x)
            x, y = x[ok], y[:, 0][there[-len(y) :] & np.isfinite(y[:, 0])]
            scale = y.std()
            found.append(float(energy_distance(x / scale, y / scale)))
        return found

    def table(self) -> str:
        """Return the table, by horizon."""
        lines = [
            "ahead s | forecast | n | gap RMSE m | after/before | gap CRPS m | after/before | speed CRPS m/s | "
            "50 % covers %, m wide | 90 % covers %, m wide | log score gap, speed",
            "--- | --- | --- | --- | --- | --- | --- | --- | --- | --- | ---",
        ]
        for horizon in HORIZONS:
            for name, at, n, x in self.lines:
                if at == horizon:
                    text = f"{at:g} | {name} | {n} | {x[0]:.2f} | {x[1]:.2f} | {x[2]:.2f} | {x[3]:.2f} | {x[4]:.3f} | "
                    if len(x) > 5:
                        text += f"{x[5]:.0f}, {x[6]:.1f} | {x[7]:.0f}, {x[8]:.1f} | {x[9]:.2f}, {x[10]:.2f}"
                    else:
                        text += "– | – | –"
                    lines.append(text)
        lines += [
            "",
            "free simulation of 30 s | energy distance: time gap | acceleration | jerk",
            "--- | --- | --- | ---",
        ]
        lines += [f"{name} | " + " | ".join(f"{d:.3f}" for d in x) for name, x in self.distances]
        return "\n".join(lines)


def _quantities(gap: np.ndarray, speed: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return time gaps (s), where anybody moves, accelerations and jerks of gaps [T, ...] and speeds [T + 1, ...]."""
    accel = np.diff(speed, axis=0) / dt
    time_gap = np.where(speed[1:] > 1.0, gap / np.maximum(speed[1:], 1.0), np.nan)
    return time_gap, accel, np.diff(accel, axis=0) / dt


def residuals(drivers: MeasuredDrivers, theta: np.ndarray) -> np.ndarray:
    """Return what IDM lacks of the recorded acceleration (m/s²) [T − 1, rows]."""
    batch = drivers.batch
    linear = drivers.linearise(Path.at(drivers, theta))
    return (batch.speed.numpy()[1:] - linear.to[..., 1]) / batch.dt


def autoregression(drivers: MeasuredDrivers, theta: np.ndarray) -> np.ndarray:
    """Return the coefficients of AR(k) on residuals of ``RESIDUAL_S`` s, by least squares over all drivers."""
    stride = round(RESIDUAL_S / drivers.batch.dt)
    left, right = [], []
    for r, x in enumerate(residuals(drivers, theta).T):
        y = _means(x[: len(drivers.batch.episodes[r]) - 1], stride)
        left += [y[i - ORDER : i][::-1] for i in range(ORDER, len(y))]
        right += list(y[ORDER:])
    return np.linalg.lstsq(np.array(left), np.array(right), rcond=None)[0]


def _means(x: np.ndarray, stride: int) -> np.ndarray:
    return x[: len(x) // stride * stride].reshape(-1, stride).mean(1)


def going_on(
    past: np.ndarray, starts: list[tuple[int, int]], coefficients: np.ndarray, dt: float, steps: int
) -> np.ndarray:
    """Return residuals [steps, starts] as an AR(k) goes on from the ``past`` [T − 1, rows] of drivers."""
    stride = round(RESIDUAL_S / dt)
    ahead = np.zeros((steps, len(starts)))
    for i, (r, t) in enumerate(starts):
        known = list(_means(past[t % stride : t, r], stride))
        while len(known) < ORDER:
            known.insert(0, 0.0)
        for j in range(0, steps, stride):
            known.append(float(coefficients @ known[: -ORDER - 1 : -1]))
            ahead[j : j + stride, i] = known[-1]
    return ahead


def by_residual(
    drivers: MeasuredDrivers, theta: np.ndarray, starts: list[tuple[int, int]], ahead: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the forecasts [steps, 1, starts] of a driver's law with residuals ``ahead`` (m/s²) [steps, starts]."""
    items, dt, steps = drivers.batch.episodes, drivers.batch.dt, len(ahead)
    model = simulator(dt, Noise())
    made = Batch.of([items[r].part(t, t + steps + 1) for r, t in starts], substeps=1)
    params = drivers.params(torch.tensor(theta[[r for r, _ in starts]]))
    params["noise"] = {"sigma": torch.ones((), dtype=torch.float64)}
    inputs = dict(made.inputs(model))
    inputs["noise"] = torch.tensor(ahead[: made.steps]).unsqueeze(-1).expand(made.steps, len(starts), 2)
    _, kept = model.rollout(made.start(model, params), inputs, params, made.steps)
    gap, speed = (np.full((steps, 1, len(starts)), np.nan) for _ in range(2))
    gap[: made.steps, 0], speed[: made.steps, 0] = kept.gap[..., 1].numpy(), kept.speed[..., 1].numpy()
    return gap, speed


FEATURES = ("v", "s", "dv", "al", "a")
"""Speed over 10 m/s, logarithm of the gap over 15 m, closing speed, the leader's acceleration, what IDM wants."""
DEGREE, SEEDS, WIDTH, EPOCHS = 3, 3, 16, 400
LARGEST = 2.0
"""No residual of a learned model is larger (m/s²): outside of its data it would drive as it likes."""
THRESHOLDS = (0.01, 0.02, 0.04, 0.08, 0.16, 0.32, 0.64)
SPARE = (1.0, 1.05)
"""The sparsest polynomial is taken whose squared error on drivers that it was not fitted to is so many times the least."""


def features(speed: Tensor, gap: Tensor, closing: Tensor, leader: Tensor, wanted: Tensor) -> Tensor:
    """Return what a residual may depend on [..., 5]; without dimension, or in m/s and m/s²."""
    logarithm = torch.log(gap.clamp_min(0.5) / 15.0)
    return torch.stack((speed / 10.0, logarithm, closing, leader, wanted.clamp(-4.0, 3.0)), -1)


@dataclasses.dataclass(frozen=True)
class Learned(Effect):
    """What a function of the scene adds to IDM's acceleration."""

    kind: ClassVar[str] = "learned"
    rank: ClassVar[int] = -10
    function: Any = None

    def limit(self, accel: Tensor, scene: Scene, driver: Driver, p: P) -> Tensor:
        """Return the acceleration with the residual."""
        x = features(
            scene.speed, scene.leader.gap, scene.speed - scene.leader.speed, scene.leader.accel, accel
        )  # fmt: skip
        return accel + self.function(x).to(accel.dtype).clamp(-LARGEST, LARGEST) * scene.leader.present


def samples(drivers: MeasuredDrivers, theta: np.ndarray) -> tuple[Tensor, Tensor, np.ndarray]:
    """Return features [n, 5], what IDM lacks (m/s²) [n] and the driver [n] of every measured sample."""
    batch = drivers.batch
    lacking = residuals(drivers, theta)
    rows, x = [], []
    for r, e in enumerate(batch.episodes):
        n = len(e) - 1
        lead, accel = e.leader.speed_mps, e.leader.accel_mps2[:n]
        wanted = np.diff(e.speed_mps[: n + 1]) / e.dt - lacking[:n, r]
        columns = (e.speed_mps[:n], e.gap_m[:n], e.speed_mps[:n] - lead[:n], accel, wanted)
        x.append(features(*(torch.tensor(np.ascontiguousarray(c)) for c in columns)))
        rows.append(np.full(n, r))
    y = torch.cat([torch.tensor(lacking[: len(k), r]) for r, k in enumerate(rows)])
    x, who = torch.cat(x), np.concatenate(rows)
    fine = torch.isfinite(y) & torch.isfinite(x).all(-1)
    return x[fine], y[fine].clamp(-3.0, 3.0), who[fine.numpy()]


def powers() -> list[tuple[int, ...]]:
    """Return the exponents of every monomial of the library."""
    return [k for k in itertools.product(range(DEGREE + 1), repeat=len(FEATURES)) if sum(k) <= DEGREE]


def library(x: Tensor) -> Tensor:
    """Return every monomial of the features [..., 56]."""
    return torch.stack([torch.prod(x ** torch.tensor(k, dtype=x.dtype), -1) for k in powers()], -1)


def sparse(x: Tensor, y: Tensor, who: np.ndarray, spare: float) -> tuple[Any, str]:
    """Return a sparse polynomial of the features (sequentially thresholded least squares), and its formula.

    Brunton, Proctor and Kutz 2016. The threshold, in units of the residual's standard deviation per standard deviation
    of the monomial, is the largest whose error is ``spare`` times the least on every fourth of the drivers to fit.
    """
    a, kept = library(x).numpy(), who % 4 == 0
    scale, out = a.std(0) + (a.std(0) == 0.0), y.numpy()
    def fitted(rows: np.ndarray, threshold: float) -> np.ndarray:
        used = np.ones(a.shape[1], bool)
        for _ in range(10):
            w = np.zeros(a.shape[1])
            w[used] = np.linalg.lstsq(a[rows][:, used] / scale[used], out[rows], rcond=None)[0]
            used = np.abs(w) > threshold * out.std()
        return np.where(used, w, 0.0) / scale
    errors = [float(np.mean((a[kept] @ fitted(~kept, t) - out[kept]) ** 2)) for t in THRESHOLDS]
    threshold = max(t for t, error in zip(THRESHOLDS, errors) if error <= spare * min(errors))
    w = fitted(np.ones(len(out), bool), threshold)
    words = ["".join(f" {n}" + (f"^{e}" if e > 1 else "") for n, e in zip(FEATURES, k) if e) for k in powers()]
    formula = " ".join(f"{c:+.3f}{name}" for c, name in zip(w, words) if c)
    weights = torch.tensor(w)
    return lambda z: library(z.double()) @ weights, formula


def net(x: Tensor, y: Tensor, who: np.ndarray) -> Any:
    """Return the mean of small nets, each as it was when it served best the drivers that it was not trained on."""
    kept = torch.tensor(who % 4 == 0)
    centre, spread = x.mean(0), x.std(0)
    nets = []
    for seed in range(SEEDS):
        torch.manual_seed(seed)
        own = torch.nn.Sequential(
            torch.nn.Linear(len(FEATURES), WIDTH), torch.nn.Tanh(), torch.nn.Linear(WIDTH, WIDTH), torch.nn.Tanh(),
            torch.nn.Linear(WIDTH, 1),
        ).double()  # fmt: skip
        optimiser, best = torch.optim.Adam(own.parameters(), lr=1e-2), (float("inf"), copy.deepcopy(own))
        for _ in range(EPOCHS):
            optimiser.zero_grad()
            error = own((x - centre) / spread)[:, 0] - y
            error[~kept].square().mean().backward()
            now = float(error[kept].square().mean().detach())
            best = (now, copy.deepcopy(own)) if now < best[0] else best
            optimiser.step()
        nets.append(best[1])
    return lambda z: torch.stack([own((z.double() - centre) / spread)[..., 0] for own in nets]).mean(0)


def by_learned(
    drivers: MeasuredDrivers, theta: np.ndarray, starts: list[tuple[int, int]], steps: int, function: Any
) -> tuple[np.ndarray, np.ndarray]:
    """Return the forecasts [steps, 1, starts] of IDM with a learned residual, in closed loop."""
    items, dt = drivers.batch.episodes, drivers.batch.dt
    model = simulator(dt, Learned(function=function))
    made = Batch.of([items[r].part(t, t + steps + 1) for r, t in starts], substeps=1)
    params = {**model.defaults(dtype=torch.float64), **drivers.params(torch.tensor(theta[[r for r, _ in starts]]))}
    with torch.no_grad():
        _, kept = model.rollout(made.start(model, params), made.inputs(model), params, made.steps)
    gap, speed = (np.full((steps, 1, len(starts)), np.nan) for _ in range(2))
    gap[: made.steps, 0], speed[: made.steps, 0] = kept.gap[..., 1].numpy(), kept.speed[..., 1].numpy()
    return gap, speed


def persistent(
    drivers: MeasuredDrivers, nothing: Estimate, theta: np.ndarray, starts: list[tuple[int, int]], gap: np.ndarray,
    speed: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return IDM's forecasts plus the error of its last forecast over the same time; without one, as they are."""
    gap, speed = gap.copy(), speed.copy()
    zero = still_levels(drivers)
    for horizon in HORIZONS:
        steps = round(horizon / drivers.batch.dt)
        able = [i for i, (_, t) in enumerate(starts) if t >= steps]
        earlier = [(starts[i][0], starts[i][1] - steps) for i in able]
        s, v = forecast.drawn(drivers, nothing.settings, theta, zero, earlier, horizon, 1)
        for n, i in enumerate(able):
            r, t = starts[i]
            gap[steps - 1, 0, i] += drivers.batch.episodes[r].gap_m[t] - s[-1, 0, n]
            speed[steps - 1, 0, i] += drivers.batch.episodes[r].speed_mps[t] - v[-1, 0, n]
    return gap, speed


def still_levels(drivers: MeasuredDrivers) -> tuple[np.ndarray, np.ndarray]:
    """Return levels of drivers who do not drift, known for sure."""
    k = drivers.levels
    return np.zeros((*drivers.batch.gap.shape, k)), np.zeros((*drivers.batch.gap.shape, k, k))


def table(path: pathlib.Path, draws: int, choose: bool, noises: dict[str, tuple[float, float]]) -> str:
    """Return the table of a file; with ``choose`` of drivers to fit, for every noise, instead of those kept back."""
    begin = time.perf_counter()

    def say(text: str) -> None:
        print(f"{time.perf_counter() - begin:6.0f} s  {text}", file=sys.stderr, flush=True)

    found = list(episodes(load(path), min_seconds=12.0))
    found = [thinned(e) for e in found]
    train, kept = split(found)
    dt = found[0].dt
    centre, spread = np.log([1.2, 1.5, 1.4, 2.2, 30.0]), np.full(5, 0.3)
    if choose:
        kept = train[1::THINNED]
    train = train[::THINNED]
    theta = calibrated(train, train, centre, spread)
    centre, spread = np.median(theta, 0), np.maximum(theta.std(0), 0.1)
    mine = calibrated(kept, [b for e in kept for b in even(e)], centre, spread)
    say(f"population {np.exp(centre).round(2)}, spread {spread.round(2)}")
    batch, starts = Batch.of(kept, substeps=1), starts_of(kept)
    training = Batch.of(train, substeps=1)
    rows = Rows(kept, starts)
    plain = MeasuredDrivers(simulator(dt), batch, batch, IDM_NAMES)
    nothing = estimate(plain.simulator, training, IDM_NAMES, theta, spread=0.0, rounds=1)
    ahead = forecast.drawn(plain, nothing.settings, mine, still_levels(plain), starts, HORIZONS[-1], 1)
    rows.score("IDM", *ahead)
    steps = np.full((round(HORIZONS[-1] / dt), 1, 1), 1.0)
    rows.score(
        "gap and speed stay", *(steps * np.array([x(kept[r])[t] for r, t in starts])
                                for x in (lambda e: e.gap_m, lambda e: e.speed_mps)),
    )  # fmt: skip
    rows.score("IDM + last error", *persistent(plain, nothing, mine, starts, *ahead))
    trained = MeasuredDrivers(simulator(dt), training, training, IDM_NAMES)
    past, count = residuals(plain, mine), round(HORIZONS[-1] / dt)
    on = going_on(past, starts, autoregression(trained, theta), dt, count)
    rows.score(f"IDM + AR({ORDER})", *by_residual(plain, mine, starts, on))
    x, y, who = samples(trained, theta)
    polynomials = {formula: learned for learned, formula in (sparse(x, y, who, spare) for spare in SPARE)}
    for formula, learned in polynomials.items():
        terms = len(re.findall(r"[+-]\d", formula))
        say(f"{terms} terms: {formula}")
        rows.score(f"IDM + polynomial of {terms} terms", *by_learned(plain, mine, starts, count, learned))
    rows.score("IDM + small net", *by_learned(plain, mine, starts, count, net(x, y, who)))
    say("learned")
    for name, drifts in MODELS.items():
        for noise in NOISES if choose else (noises[name],):
            label = f"{name}, noise {noise[0]:g} m, {noise[1]:g} m/s"
            model = simulator(dt, *drifts)
            estimated = estimate(model, training, IDM_NAMES, usual(IDM_NAMES), noise=noise, rounds=3)
            numbers = (f"{r['name']} {r['estimate']:.3g} ({r['low']:.3g} … {r['high']:.3g})" for r in estimated.table())
            say(f"{label}: {', '.join(numbers)}")
            drivers = MeasuredDrivers(model, batch, batch, IDM_NAMES)
            for known in KNOWN if choose else KNOWN[:1]:
                settings = dataclasses.replace(estimated.settings, spread=np.full(len(IDM_NAMES), known))
                levels = forecast.followed(drivers, settings, mine)
                ahead = forecast.drawn(drivers, settings, mine, levels, starts, HORIZONS[-1], draws)
                rows.score(f"{label}, drivers within {known:g}", *ahead)
    return f"{len(kept)} drivers, {len(starts)} forecasts\n{rows.table()}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--data", type=pathlib.Path, default=pathlib.Path(os.environ.get("IDM_ENV_DATA", "../shared/data"))
    )
    parser.add_argument("--file", default="ngsim_i80_pairs.parquet")
    parser.add_argument("--draws", type=int, default=60)
    parser.add_argument("--choose", action="store_true", help="score every noise on drivers to fit, to choose one")
    arguments = parser.parse_args()
    print(table(arguments.data / arguments.file, arguments.draws, arguments.choose, CHOSEN))


if __name__ == "__main__":
    main()
