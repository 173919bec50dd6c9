"""The default recipe: exact posterior, noise found, bounds exact, simulator in the loop, vehicles apart."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest
import torch

from benchmarks.trajectories import TUNED, truth_errors
from idm_env.effects.idm import gap_for
from idm_env.trajectories.baselines import BASELINES
from idm_env.trajectories.drivers import parameter_rows
from idm_env.trajectories.imagined import CAPABLE, drive
from idm_env.trajectories.noise import fit_noise
from idm_env.trajectories.recipe import Filtered, overlaps, recipe
from idm_env.trajectories.scores import RegularMotion, Tally
from idm_env.trajectories.smoother import (
    SPARSE,
    PositionNoise,
    SmootherOptions,
    TrackObservations,
    log_likelihood,
    smooth,
)
from idm_env.trajectories.spool import read_table
from idm_env.trajectories.tracks import Pieces, TrackPiece, clock_of
from idm_env.types import Driver
from tests.trajectories.tracks import swinging, track_of

PLAIN = SmootherOptions(rounds=1, jerk_degrees=None)


def correlated(rng: np.random.Generator, count: int, sigma: float = 0.28, time: float = 0.28) -> np.ndarray:
    """Ornstein–Uhlenbeck noise every 0.1 s and white noise of 0.1 m, as the raw NGSIM positions have."""
    fade = np.exp(-0.1 / time)
    noise = np.empty(count)
    noise[0] = sigma * rng.normal()
    for k in range(1, count):
        noise[k] = fade * noise[k - 1] + sigma * np.sqrt(1 - fade * fade) * rng.normal()
    return noise + 0.1 * rng.normal(size=count)


def test_without_reweighting_it_is_the_exact_posterior() -> None:
    """Against dense Gaussian algebra on the same model, irregular times and a hole included."""
    noise, dt = PositionNoise(white=0.1, sigma=0.3, time=0.4, jerk=0.5), 0.1
    time = np.array([0.0, 0.1, 0.23, 0.3, 0.4, 0.9, 1.0, 1.15, 1.2])
    data = 10 * time + np.sin(5 * time)
    observed = TrackObservations.on_clock(time, data, dt)
    steps, n = observed.steps, 4
    keep, fade, push, drift = noise.step(dt)
    step = np.array([[1, dt, dt * dt / 2, 0], [0, 1, dt, 0], [0, 0, keep, 0], [0, 0, 0, fade]])
    mean0, spread = observed.start()
    spread[3, 3] = 0.09
    mean, cov = np.zeros(steps * n), np.zeros((steps * n, steps * n))
    mean[:n], cov[:n, :n] = mean0, spread
    for k in range(1, steps):
        now, last = slice(k * n, k * n + n), slice(k * n - n, k * n)
        mean[now] = step @ mean[last]
        cov[now, : k * n] = step @ cov[last, : k * n]
        cov[: k * n, now] = cov[now, : k * n].T
        cov[now, now] = step @ cov[last, last] @ step.T + np.diag([0, 0, push, drift])
    look = np.zeros((len(time), steps * n))
    for o, (at, row) in enumerate(zip(observed.at, observed.look, strict=True)):
        look[o, at * n : at * n + n] = row
    total = look @ cov @ look.T + 0.01 * np.eye(len(time))
    error = observed.value - look @ mean
    posterior = (mean + cov @ look.T @ np.linalg.solve(total, error)).reshape(steps, n)
    found = smooth(observed, noise, PLAIN)
    assert np.allclose(found.position - data[0], posterior[:, 0], atol=1e-6)
    assert np.allclose(found.speed, posterior[:, 1], atol=1e-6)
    assert np.allclose(found.accel, posterior[:, 2], atol=1e-5)
    spread_after = cov - cov @ look.T @ np.linalg.solve(total, look @ cov)
    assert np.allclose(found.sigma[:, 1] ** 2, np.diag(spread_after)[1::n], atol=1e-6)
    exact = -0.5 * (error @ np.linalg.solve(total, error) + np.linalg.slogdet(total)[1] + len(time) * np.log(2 * np.pi))
    assert log_likelihood(observed, noise) == pytest.approx(exact, abs=1e-5)


def test_noise_is_found_from_the_data_alone() -> None:
    rng = np.random.default_rng(0)
    tracks = []
    for _ in range(12):
        motion = swinging(40.0, phase=rng.uniform(0, 6))
        tracks.append((motion.time_s, motion.position_m + correlated(rng, len(motion.time_s))))
    found = fit_noise(tracks, 0.1)
    assert found.white == pytest.approx(0.1, rel=0.3)
    assert found.sigma == pytest.approx(0.28, rel=0.2)
    assert found.time == pytest.approx(0.28, rel=0.4)
    sparse = fit_noise([(time[::20], position[::20]) for time, position in tracks], 0.1)
    assert sparse.sigma == 0.0


@pytest.mark.parametrize("every", [10, 20])
def test_noise_of_sparse_data_is_found_too_and_taken_away(every: int) -> None:
    """Positions of a satellite receiver, 1 m of white noise every 1 or 2 s: taken as exact they would swing wildly."""
    rng = np.random.default_rng(0)
    motions = [swinging(120.0, phase=p) for p in rng.uniform(0, 6, 12)]
    tracks = [track_of(m, rng.normal(size=len(m.time_s)), str(i)) for i, m in enumerate(motions)]
    sparse = [track.part(slice(None, None, every)) for track in tracks]
    noise = fit_noise([(t.time_s, t.position_m) for t in sparse], 0.1)
    assert noise.white == pytest.approx(1.0, rel=0.25)
    errors = [
        f.motion.speed_mps - m.speed_mps for f, m in zip(recipe(sparse, 0.1, noise, SPARSE), motions, strict=True)
    ]
    assert np.sqrt(np.mean(np.concatenate(errors) ** 2)) < 0.6
    clean = fit_noise([(t.time_s, m.position_at(t.time_s)) for t, m in zip(sparse, motions, strict=True)], 0.1)
    assert clean.white < 0.1


def test_every_acceleration_has_its_imagined_gap_and_the_simulator_does_it() -> None:
    accel = swinging(30.0).accel_mps2
    speed = 12.0 + 0.1 * np.concatenate([[0.0], np.cumsum(accel[:-1])])
    position = 100.0 + np.concatenate([[0.0], np.cumsum(0.1 * speed[:-1] + 0.005 * accel[:-1])])
    (driven,) = drive([(position, speed, accel)], 0.1, 5.0, -8.0)
    assert np.allclose(driven.accel, accel, atol=1e-9)
    assert np.allclose(driven.speed, speed, atol=1e-8)
    assert np.allclose(driven.position, position, atol=1e-7)
    assert (driven.gap > 2.0).all() and np.isfinite(driven.gap).all()
    driver = Driver(**{name: torch.tensor(value) for name, value in CAPABLE.items()})
    speed = torch.linspace(0, 40, 50)
    gaps = torch.stack([gap_for(torch.tensor(a), speed, torch.tensor(0.0), driver) for a in (-3.0, 0.0, 2.0)])
    assert (gaps.diff(dim=0) > 0).all()  # braking harder means a nearer leader


def test_distance_that_a_bound_took_is_made_up() -> None:
    """A motion that drifts backwards by 2 m at a standstill and then drives off: no reverse, and nothing is lost."""
    speed = np.concatenate([np.full(200, -0.1), np.minimum(np.arange(400) * 0.1, 5.0)])
    accel = np.append(np.diff(speed) / 0.1, 0.0)
    position = np.concatenate([[0.0], np.cumsum(0.05 * (speed[1:] + speed[:-1]))])
    (driven,) = drive([(position, speed, accel)], 0.1, 5.0, -8.0)
    assert (np.diff(driven.position) >= 0).all() and driven.position[150] < 1e-6
    assert driven.position[-1] == pytest.approx(position[-1], abs=0.01)


def test_bounds_are_exact_whatever_the_data_say() -> None:
    time = np.arange(0, 20.0, 0.1)
    brutal = np.where(time < 10, 30 * time, 300.0)  # from 30 m/s to standstill at once
    (found,) = recipe([track_of(RegularMotion(time, brutal, brutal, brutal))], 0.1, PositionNoise(0.05, 0, 0.3, 300.0))
    motion = found.motion
    assert motion.accel_mps2.min() >= -8.0 - 1e-9 and motion.accel_mps2.max() <= 5.0
    assert motion.speed_mps.min() >= 0.0
    assert (np.diff(motion.position_m) >= 0).all()
    step = 0.1 * motion.speed_mps[:-1] + 0.005 * motion.accel_mps2[:-1]
    assert np.allclose(np.diff(motion.position_m), step, atol=1e-9)  # positions, speeds and accelerations agree


@pytest.mark.parametrize("seconds", [0.1, 0.2, 0.5])
def test_two_three_and_a_few_points(seconds: float) -> None:
    track = track_of(swinging(seconds))
    (found,) = recipe([track], 0.1, PositionNoise(0.05, 0.1, 0.3, 0.3))
    assert np.allclose(found.motion.speed_mps, 12.0, atol=1.0)


def test_a_parked_vehicle_stays_parked() -> None:
    time = np.arange(0, 30.0, 0.1)
    rng = np.random.default_rng(0)
    parked = 50.0 + correlated(rng, len(time))
    (found,) = recipe([track_of(RegularMotion(time, parked, parked, parked))], 0.1, PositionNoise(0.1, 0.28, 0.28, 0.3))
    assert found.motion.speed_mps.min() >= 0.0
    assert found.motion.position_m[-1] - found.motion.position_m[0] < 1.0
    assert found.motion.speed_mps.mean() < 0.1


def test_outliers_do_not_move_it() -> None:
    rng = np.random.default_rng(5)
    motion = swinging(60.0)
    noise = correlated(rng, 601)
    spikes = noise.copy()
    spikes[[100, 250, 251, 400]] += [4.0, -30.0, -30.0, 100.0]
    speeds = [
        recipe([track_of(motion, n)], 0.1, PositionNoise(0.1, 0.28, 0.28, 0.3))[0].motion.speed_mps
        for n in (noise, spikes)
    ]
    assert np.abs(speeds[0] - speeds[1]).max() < 0.5


def platoon(rng: np.random.Generator, spacing: float) -> list[TrackPiece]:
    """A follower that comes up at 5 m/s and then is ``spacing`` (m) behind from one sample to the next."""
    motion = swinging(60.0)
    front = track_of(motion, correlated(rng, 601), "front")
    gap = spacing + np.maximum(0.0, 5.0 * (30.0 - motion.time_s))
    back = front.position_m - 4.5 - gap
    return [front, TrackPiece("0", "back", 0, motion.time_s, back, 4.5, np.full(601, "front"), np.full(601, 1))]


def test_vehicles_do_not_overlap_that_did_not_before() -> None:
    noise = PositionNoise(0.1, 0.28, 0.28, 0.3)
    touching = platoon(np.random.default_rng(1), 0.01)
    alone = [recipe([track], 0.1, noise)[0] for track in touching]
    assert overlaps(alone)[1] > 0  # each by itself they do
    together = recipe(touching, 0.1, noise)
    assert overlaps(together) == (0, 0)
    # across chunks the later one gives way, be it leader or follower
    for first, second in ((0, 1), (1, 0)):
        before = recipe([touching[first]], 0.1, noise)
        after = recipe([touching[second]], 0.1, noise, before=before)
        assert overlaps(after, before)[1] == 0


def test_drivers_are_calibrated_behind_real_leaders_only() -> None:
    rng = np.random.default_rng(2)
    found = recipe(platoon(rng, 15.0), 0.1, PositionNoise(0.1, 0.28, 0.28, 0.3))
    rows = {row["vehicle_id"]: row for row in parameter_rows(found)}
    assert rows["front"]["source"] == "none" and rows["front"]["time_gap"] is None
    assert rows["back"]["source"] == "leader" and 0.1 <= rows["back"]["time_gap"] <= 5.0


def halves(path: object) -> tuple[list[TrackPiece], list[TrackPiece]]:
    tracks = list(Pieces(read_table(path)[0]))  # type: ignore[arg-type]
    names = sorted({t.vehicle_id for t in tracks}, key=int)
    tuned = set(names[::2])
    return [t for t in tracks if t.vehicle_id in tuned], [t for t in tracks if t.vehicle_id not in tuned]


def truths(path: object) -> dict[str, pl.DataFrame]:
    clean = pl.read_parquet(path).with_columns(k=(pl.col("time_s") * 10).round().cast(pl.Int64))  # type: ignore[arg-type]
    return {str(vehicle): part.sort("k") for (vehicle,), part in clean.group_by(["vehicle_id"])}


def truth_of(track: TrackPiece, clean: dict[str, pl.DataFrame]) -> RegularMotion:
    clock = clock_of(track, 0.1)
    rows = pl.DataFrame({"k": np.round(clock * 10).astype(np.int64)}).join(
        clean[track.vehicle_id], on="k", how="left", maintain_order="left"
    )
    return RegularMotion(clock, *(rows[name].to_numpy() for name in ("position_m", "speed_mps", "accel_mps2")))


def test_it_beats_every_tuned_baseline_on_measured_vehicles(measured) -> None:  # type: ignore[no-untyped-def]
    """Baselines are tuned on the truth of every other vehicle; ours sees no truth at all. Scored on the rest."""
    clean = truths(measured("ngsim_i80_lanes.parquet"))
    first, second = halves(measured("ngsim_i80_rawlike.csv.gz"))

    def score(tracks: list[TrackPiece], motions: list[RegularMotion]) -> dict[str, float]:
        tally = Tally()
        for track, motion in zip(tracks, motions, strict=True):
            tally.add(motion, track.time_s, track.position_m)
        pairs = zip(motions, (truth_of(track, clean) for track in tracks), strict=True)
        return tally.row() | truth_errors(pairs)

    noise = fit_noise([(t.time_s, t.position_m) for t in first], 0.1)
    ours: list[Filtered] = recipe(second, 0.1, noise)
    row = score(second, [f.motion for f in ours])
    assert row["implausible_percent"] == 0.0
    assert overlaps(ours)[1] == 0
    for name, smoother in BASELINES.items():
        choices = TUNED[name]
        rows = []
        for choice in choices:
            motions = [smoother(t.time_s, t.position_m, clock_of(t, 0.1), **choice) for t in first[::3]]
            rows.append(score(first[::3], motions))
        for what in ("speed_rmse_mps", "accel_rmse_mps2"):
            # tuned for each figure by itself, which no single smoother could be
            best = choices[min(range(len(rows)), key=lambda i: rows[i][what])]
            motions = [smoother(t.time_s, t.position_m, clock_of(t, 0.1), **best) for t in second]
            assert row[what] < score(second, motions)[what], (name, best, what)
