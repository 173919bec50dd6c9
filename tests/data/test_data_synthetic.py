"""Synthetic data: reproducible, physical, and moved by exactly the equations that their truth names."""

from __future__ import annotations

import functools

import numpy as np
import polars as pl
import pytest

from idm_env.data import DataError, Trajectories, episodes
from idm_env.data.synthetic import EFFECTS, Truth, generate

SMALL = {"runs": 2, "followers": 3, "seconds": 110.0}


@functools.cache
def without_effect() -> tuple[Trajectories, Truth]:
    return generate(8, **SMALL)


def follower(truth: Truth, number: int = 3, run: str = "1") -> dict[str, np.ndarray]:
    """Motion of one follower, its leader and second leader, with gaps, and its parameters."""
    vehicle = {
        offset: truth.motion.filter((pl.col("run_id") == run) & (pl.col("vehicle_id") == str(number - offset)))
        for offset in range(min(number, 3))
    }
    driver = truth.drivers.filter((pl.col("run_id") == run) & (pl.col("vehicle_id") == str(number))).row(0, named=True)
    x, v, a = (vehicle[0][name].to_numpy() for name in ("position_m", "speed_mps", "accel_mps2"))
    found = {"x": x, "v": v, "a": a, **{k: value for k, value in driver.items() if not k.endswith("_id")}}
    found["t"] = vehicle[0]["time_s"].to_numpy()
    for offset in range(1, len(vehicle)):
        ahead, name = vehicle[offset], str(offset)
        found[f"s{name}"] = (ahead["position_m"] - ahead["length_m"]).to_numpy() - x
        found[f"v{name}"] = ahead["speed_mps"].to_numpy()
        found[f"a{name}"] = ahead["accel_mps2"].to_numpy()
    return found


def idm(f: dict[str, np.ndarray], back: int = 0, gap: str = "s1", lead: str = "v1") -> tuple[np.ndarray, np.ndarray]:
    """Free and interaction part of the equation of discovery, with inputs `back` samples ago."""
    v, s, v1 = (np.concatenate([np.full(back, f[k][0]), f[k][: len(f[k]) - back]]) for k in ("v", gap, lead))
    braking = 2 * np.sqrt(f["max_accel"] * f["comfort_decel"])
    desired = f["min_gap"] + np.maximum(v * f["time_gap"] + v * (v - v1) / braking, 0)
    return f["max_accel"] * (1 - (v / f["desired_speed"]) ** 4), f["max_accel"] * (desired / s) ** 2


def moving(f: dict[str, np.ndarray]) -> np.ndarray:
    return f["v"] > 0.5


def test_same_seed_same_data() -> None:
    (first, truth), (second, other) = (generate(5, ou=0.1, runs=2, seconds=20.0) for _ in range(2))
    assert first.table.equals(second.table) and truth.motion.equals(other.motion)
    assert not generate(6, runs=2, seconds=20.0)[0].table.equals(first.table)


def test_without_effect_the_motion_is_the_idm() -> None:
    _, truth = generate(7, **SMALL)
    f = follower(truth)
    free, interaction = idm(f)
    assert np.abs(f["a"] - (free - interaction))[moving(f)].max() < 1e-9


def test_positions_integrate_speeds_to_second_order() -> None:
    _, truth = generate(7, **SMALL)
    f = follower(truth)
    moved = np.cumsum((f["v"][1:] + f["v"][:-1]) * 0.05)
    assert np.abs(f["x"][1:] - f["x"][0] - moved).max() < 0.02


def test_delay_reacts_to_the_past() -> None:
    _, truth = generate(7, effect="delay", strength=0.5, **SMALL)
    f = follower(truth)
    free, interaction = idm(f, back=5)
    assert np.abs(f["a"] - (free - interaction))[10:][moving(f)[10:]].max() < 1e-6


def test_lag_follows_the_wanted_acceleration() -> None:
    _, truth = generate(7, effect="lag", strength=0.5, **SMALL)
    f = follower(truth)
    free, interaction = idm(f)
    change = np.gradient(f["a"], 0.1)
    keep = moving(f) & np.append(False, moving(f)[:-1])
    keep[:20] = False
    assert np.median(np.abs(0.5 * change - (free - interaction - f["a"]))[keep]) < 0.01


def test_the_second_leader_weighs() -> None:
    _, truth = generate(7, effect="second_leader", strength=0.3, **SMALL)
    f = follower(truth)
    free, first = idm(f)
    f["half"] = f["s2"] / 2
    _, second = idm(f, gap="half", lead="v2")
    assert np.abs(f["a"] - (free - 0.7 * first - 0.3 * second))[moving(f)].max() < 1e-9
    f = follower(truth, number=2)  # it has no second leader, so that the effect is exactly absent
    free, first = idm(f)
    assert np.abs(f["a"] - (free - first))[moving(f)].max() < 1e-9


@pytest.mark.parametrize("name", ["leader_acceleration", "brake_light"])
def test_the_leaders_acceleration_is_fed_forward(name: str) -> None:
    _, truth = generate(7, effect=name, strength=0.4, **SMALL)
    f = follower(truth)
    free, interaction = idm(f)
    lead = f["a1"] if name == "leader_acceleration" else np.minimum(f["a1"], 0)
    keep = moving(f) & (f["v1"] > 0.5)
    assert np.abs(f["a"] - (free - interaction + 0.4 * lead))[keep].max() < 1e-6


@pytest.mark.parametrize("name", ["drag", "asymmetry", "grade", "power_limit"])
def test_what_is_added(name: str) -> None:
    _, truth = generate(7, effect=name, **SMALL)
    f = follower(truth)
    strength = truth.effects[name]
    free, interaction = idm(f)
    base = free - interaction
    waves = 0.6 * np.sin(2 * np.pi * f["x"] / 730) + 0.4 * np.sin(2 * np.pi * f["x"] / 1170 + 1)
    expected = {
        "drag": base - strength * f["v"] ** 2,
        "asymmetry": np.where(base > 0, (1 - strength) * base, (1 + strength) * base),
        "grade": base - 9.81 * np.sin(np.arctan(strength * waves)),
        "power_limit": np.minimum(base, strength / np.maximum(f["v"], 0.1)),
    }[name]
    assert np.abs(f["a"] - expected)[moving(f)].max() < 1e-9


@pytest.mark.parametrize("name", sorted(EFFECTS))
def test_every_effect_moves_the_data_physically(name: str) -> None:
    plain, base = without_effect()
    made, truth = generate(8, effect=name, **SMALL)
    own = truth.motion.filter(pl.col("lane") == 1)
    assert np.isfinite(own.select("position_m", "speed_mps", "accel_mps2").to_numpy()).all()
    assert own["speed_mps"].min() >= 0 and own["accel_mps2"].min() >= -9.01
    assert (made.table["gap_m"].drop_nulls() > 0).all()
    assert truth.effects == {name: EFFECTS[name].middle}
    if name == "gap_bias":
        difference = episodes(made)[0].gap_m[:50] - episodes(plain)[0].gap_m[:50]
        assert abs(np.mean(difference) - 1.5) < 0.05
    else:
        assert np.abs(own["position_m"].to_numpy() - base.motion["position_m"].to_numpy()).max() > 0.1
    followers = {episode.vehicle_id for episode in episodes(made)}
    assert followers == {"2", "3", "4"}


def test_lateral_has_vehicles_beside() -> None:
    made, _ = generate(8, effect="lateral", runs=1, seconds=40.0)
    assert all(episode.adjacent.present.all() for episode in episodes(made))


def test_effects_combine_and_strengths_vary() -> None:
    _, truth = generate(9, effect={"delay": 0.3, "leader_acceleration": 0.4}, runs=1, seconds=10.0)
    assert truth.effects == {"delay": 0.3, "leader_acceleration": 0.4}
    assert generate(9, effect="delay", strength="half", runs=1, seconds=10.0)[1].effects == {"delay": 0.25}


def position_error(made: Trajectories, truth: Truth) -> np.ndarray:
    return (made.table["position_m"] - truth.motion["position_m"]).to_numpy()


def test_noise_is_what_was_asked_for() -> None:
    made, truth = generate(10, noise=0.3, speed_noise=0.1, **SMALL)
    assert abs(np.std(position_error(made, truth)) / 0.3 - 1) < 0.05
    speed_error = (made.table["speed_mps"] - truth.motion["speed_mps"]).to_numpy()
    assert abs(np.std(speed_error) / 0.1 - 1) < 0.05
    made, truth = generate(10, noise=0.0, correlated_noise=0.3, **SMALL)
    error = position_error(made, truth)
    assert abs(np.std(error) / 0.3 - 1) < 0.2 and np.corrcoef(error[1:], error[:-1])[0, 1] > 0.8


def test_drivers_noise_has_its_size_and_memory() -> None:
    _, truth = generate(11, ou=0.2, ou_time=5.0, runs=16, followers=1, seconds=100.0)
    residual = []
    for run in range(1, 17):
        f = follower(truth, number=2, run=str(run))
        free, interaction = idm(f)
        residual.append((f["a"] - free + interaction)[moving(f)])
    pooled = np.concatenate(residual)
    assert abs(np.std(pooled) / 0.2 - 1) < 0.2
    assert np.corrcoef(pooled[10:], pooled[:-10])[0, 1] == pytest.approx(np.exp(-0.2), abs=0.1)


def test_drivers_differ_and_clocks_too() -> None:
    made, truth = generate(12, runs=6, seconds=20.0)
    assert truth.drivers["time_gap"].n_unique() == 18
    starts = made.table.group_by("run_id").agg(pl.col("time_s").min())["time_s"]
    assert starts.n_unique() > 3


def test_unknown_names() -> None:
    with pytest.raises(DataError, match="did you mean 'delay'"):
        generate(0, effect="dealy")
    with pytest.raises(DataError, match="strength = 'strong'"):
        generate(0, effect="delay", strength="strong")


def test_the_slope_can_be_told() -> None:
    made, _ = generate(13, effect="grade", grade_column=True, runs=1, seconds=20.0)
    assert np.abs(episodes(made)[0].columns["grade"]).max() > 0.001
