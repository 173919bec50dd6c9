"""Known drift is found again, and forecasts of drivers who drift are honest about it."""

from __future__ import annotations

import math
import pathlib
from dataclasses import replace
from typing import Any

import numpy as np
import polars as pl
import pytest
import torch

pytest.importorskip("numba")

from idm_env.data import Episode, Trajectories, episodes
from idm_env.drift import forecast, held_out, kinds
from idm_env.drift.estimate import Estimate, estimate, usual
from idm_env.drift.job import _sorts, drift_file, model_of, sentence, tables
from idm_env.drift.kinds import Told, tell
from idm_env.effects import DRIFTS, IDM, AccelNoise, Brakes, Delay, Effect, PerceptionNoise, Replay, Wander
from idm_env.fitting.batch import Batch
from idm_env.fitting.options import Source
from idm_env.fitting.problem import IDM_NAMES
from idm_env.model_file import load_model
from idm_env.roads import Lane
from idm_env.simulator import Simulator
from idm_env.types import Record

DRIVERS, SECONDS, DT = 30, 90.0, 0.2
TRUE = {
    "idm.max_accel": 1.4,
    "idm.comfort_decel": 2.0,
    "idm.time_gap": 1.3,
    "idm.min_gap": 2.0,
    "idm.desired_speed": 30.0,
}
GAP_NOISE, SPEED_NOISE = 0.05, 0.05


def behind_a_record(*drifts: Effect) -> Simulator:
    return Simulator(Lane(), (IDM(), *drifts, Replay(), Brakes()), dt=DT, integration="midpoint")


def driven(drift: Effect, sigma: float, memory_time: float, *noise: Effect) -> Trajectories:
    """Return drivers of one kind behind leaders who never stop changing their speed, gap and speed with noise."""
    simulator, random = behind_a_record(drift, *noise), np.random.default_rng(1)
    params = simulator.defaults(dtype=torch.float64)
    params["idm"] |= {n.removeprefix("idm."): torch.tensor(x, dtype=torch.float64) for n, x in TRUE.items()}
    params[drift.name] = {"sigma": torch.tensor(sigma).double(), "memory_time": torch.tensor(memory_time).double()}
    for effect in noise:
        params[effect.name] = {"sigma": torch.tensor(0.25).double(), "memory_time": torch.tensor(1.5).double()}
    steps = round(SECONDS / DT)
    time, phase = DT * np.arange(steps + 1)[:, None], random.uniform(0.0, 6.0, (2, DRIVERS))
    lead_speed = 12.0 + 3.0 * np.sin(time / 7.0 + phase[0]) + 2.0 * np.sin(time / 3.1 + phase[1])
    lead_accel = 3.0 / 7.0 * np.cos(time / 7.0 + phase[0]) + 2.0 / 3.1 * np.cos(time / 3.1 + phase[1])
    lead = np.cumsum(DT * (lead_speed - 0.5 * DT * lead_accel), 0)
    both = (torch.tensor(np.stack((x, np.zeros_like(x)), -1)) for x in (lead, lead_speed, lead_accel))
    record = Record(*(x[1:] for x in both), torch.tensor([True, False]).expand(steps, DRIVERS, 2))
    position = torch.tensor(np.stack((lead[0], lead[0] - 25.0), -1))
    speed = torch.tensor(np.stack((lead_speed[0],) * 2, -1))
    accel = torch.tensor(np.stack((lead_accel[0], 0.0 * lead_accel[0]), -1))
    start = simulator.state(position, speed, params, accel=accel, seed=2)
    _, kept = simulator.rollout(start, {"replay": record}, params, steps, seed=3)
    tables = []
    for i in range(DRIVERS):
        for vehicle in (0, 1):
            noisy = vehicle * random.normal(size=(2, steps))
            own = kept.speed[:, i, vehicle].numpy() + SPEED_NOISE * noisy[1]
            columns = {"time_s": time[1:, 0], "position_m": kept.position[:, i, vehicle].numpy(), "speed_mps": own}
            gap = kept.gap[:, i, 1].numpy() + GAP_NOISE * noisy[0]
            columns["gap_m"] = gap if vehicle else np.full(steps, np.nan)
            ids = {"run_id": f"{i:02d}", "vehicle_id": vehicle, "leader_id": 0 if vehicle else -1, "length_m": 5.0}
            tables.append(pl.DataFrame(columns).with_columns(pl.lit(x).alias(n) for n, x in ids.items()))
    table = pl.concat(tables).with_columns(
        pl.col("leader_id").replace(-1, None), pl.col("gap_m").fill_nan(None)
    )  # fmt: skip
    return Trajectories.from_frame(table, source="made up")


def both(made: Trajectories) -> tuple[list[Episode], list[Episode]]:
    """Return episodes, smoothed and as measured."""
    return list(episodes(made, smooth=True)), list(episodes(made))


def estimated(drift: Effect, sigma: float, memory_time: float, known: bool) -> Estimate:
    smooth, raw = (Batch.stack(x, substeps=1) for x in both(driven(drift, sigma, memory_time)))
    theta, spread = (np.log([TRUE[n] for n in IDM_NAMES]), 0.0) if known else (usual(IDM_NAMES), 0.3)
    return estimate(behind_a_record(drift), smooth, IDM_NAMES, theta, spread=spread, measured=raw)


@pytest.mark.parametrize("known", [True, False], ids=["known drivers", "unknown drivers"])
@pytest.mark.parametrize(("drift", "sigma", "memory_time"), [(Wander(), 0.2, 8.0), (AccelNoise(), 0.3, 3.0)], ids=str)
def test_drift_is_found_again(drift: Effect, sigma: float, memory_time: float, known: bool) -> None:
    """σ, τ and the noise of measurement, within four of their standard errors, which are small.

    Also of drivers of whom no more is known than what is usual: with parameters of calibrations σ came out twice as
    large.
    """
    found = estimated(drift, sigma, memory_time, known)
    true = (sigma, memory_time, GAP_NOISE, SPEED_NOISE)
    for row, error, value in zip(found.table(), found.log_error, true, strict=False):
        assert abs(math.log(row["estimate"] / value)) < 4.0 * error + 0.03, row
        assert error < 0.25, row


@pytest.mark.parametrize(
    ("drift", "sigma", "verdict"), [(Wander(), 0.25, "named"), (AccelNoise(), 0.2, "named"), (Wander(), 0.0, "none")]
)
def test_sorts_of_drift_are_told_apart(drift: Effect, sigma: float, verdict: str) -> None:
    """A wandering time gap, a wandering acceleration, and nothing at all, of a third of the drivers."""
    smooth, raw = (x[::3] for x in both(driven(drift, sigma, 8.0)))
    told = tell(smooth, raw, (Wander(), AccelNoise()))
    assert told.verdict == verdict
    assert told.one_of == ((drift.name,) if sigma else ())


def test_two_processes_at_once_are_told_where_both_are_there() -> None:
    smooth, raw = (x[::2] for x in both(driven(Wander(), 0.3, 12.0, AccelNoise())))
    told = tell(smooth, raw, (Wander(), AccelNoise()))
    assert told.one_of == ("wander and accel_noise",) and told.verdict == "named"
    pair = told.found[told.one_of[0]]
    assert told.gain[told.one_of[0]] > max(told.gain["wander"], told.gain["accel_noise"]) + kinds.PAIRED
    assert np.all(np.abs(np.log(pair.settings.sigma / [0.3, 0.25])) < 0.6), pair.settings
    model = model_of(pair)
    assert [e.name for e in model.effects] == ["idm", "wander", "accel_noise", "brakes"]
    words = sentence(told)
    assert "(wander), sigma" in words and "(accel_noise), sigma" in words and words.count("tau") == 2
    assert words_of_the_first(words) <= 30
    row = _sorts(told)[0]
    assert row["sigma"] == pair.settings.sigma.tolist() and row["tau_s"] == pair.settings.memory_time.tolist()
    shown = tables({"kept_back": {"drivers": 0, "scores": []}, "sorts": [row]})
    assert [r["sigma"] for r in shown.values() for r in r] == [", ".join(f"{x:.4g}" for x in pair.settings.sigma)]


def test_a_step_between_samples_is_the_drivers_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a step of 0.4 s leaves of finer ones was told as a second process, by 70."""
    monkeypatch.setattr(f"{__name__}.DT", 0.1)
    smooth, raw = (list(episodes(driven(Wander(), 0.3, 12.0), smooth=x, dt=0.4))[::3] for x in (True, False))
    told = tell(smooth, raw, (Wander(), AccelNoise()))
    assert told.one_of == ("wander",), told.gain
    rows = told.found["wander"].table()
    assert rows[0]["low"] < 0.3 < rows[0]["high"] and rows[1]["low"] < 12.0 < rows[1]["high"]


def words_of_the_first(text: str) -> int:
    """Return the number of words of the first sentence."""
    return len(text.split(". ")[0].split())


def test_the_model_of_a_file_drifts(tmp_path) -> None:
    """report.json says what drifts, model.yaml has it with every driver's own parameters."""
    file = tmp_path / "made.csv"
    table = driven(Wander(), 0.25, 8.0).table
    table.filter(pl.col("run_id").cast(pl.Int64) < 4).select(
        "run_id", "vehicle_id", "leader_id", "time_s", "position_m", "speed_mps", "length_m", "gap_m"
    ).write_csv(file)
    report = drift_file(Source(file), tmp_path / "out")
    model = load_model(tmp_path / "out" / "model.yaml")
    assert report["one_of"][0] in {e.name for e in model.effects} and len(model.drivers) == 4
    assert report["data"]["dt"] == pytest.approx(0.4), "thinned to the multiple of the file's step nearest to 0.5 s"
    assert report["one_of"][0] in report["sentence"] and "tau" in report["sentence"]
    rows = {r["sort"]: r for r in report["sorts"]}
    assert model.parameters["wander"]["sigma"] == pytest.approx(rows["wander"]["sigma"])


def written(folder: pathlib.Path) -> pathlib.Path:
    """Write drivers whose time gap wanders, and return the file."""
    file = folder / "made.csv"
    names = ("run_id", "vehicle_id", "leader_id", "time_s", "position_m", "speed_mps", "length_m", "gap_m")
    driven(Wander(), 0.25, 8.0).table.select(names).write_csv(file)
    return file


def test_drivers_kept_back_are_foreseen_and_an_interrupted_run_goes_on(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Forecasts with the true drift beat those without, in bands that hold; a resumed run writes the same report."""
    file = written(tmp_path)
    whole = drift_file(Source(file), tmp_path / "whole")
    rows = {(row["model"], row["ahead_s"]): row for row in whole["kept_back"]["scores"]}
    assert whole["kept_back"]["drivers"] == DRIVERS // 4 and whole["data"]["taken"] == DRIVERS - DRIVERS // 4
    told, steady = rows["wander", 10.0], rows["no drift", 10.0]
    assert told["gap_crps_m"] < 0.9 * steady["gap_crps_m"] and 80.0 < told["in_90_percent"] < 98.0
    first = whole["one_of"][0]
    assert f"{rows[first, 10.0]['gap_crps_m']:.2f} m with {first}; " in whole["sentence"]

    out, estimates = tmp_path / "out", []

    def interrupted(*given: Any, **more: Any) -> Estimate:
        if len(estimates) == 2:
            raise KeyboardInterrupt
        estimates.append(estimate(*given, **more))
        return estimates[-1]

    monkeypatch.setattr(kinds, "estimate", interrupted)
    with pytest.raises(KeyboardInterrupt):
        drift_file(Source(file), out)
    monkeypatch.setattr(kinds, "estimate", lambda *given, **more: estimates.append(None) or estimate(*given, **more))
    resumed = drift_file(Source(file), out, resume=True)
    assert len(estimates) == 2 + len(DRIFTS) and {**resumed, "command": ""} == {**whole, "command": ""}
    assert (out / "model.yaml").read_bytes() == (tmp_path / "whole" / "model.yaml").read_bytes()


def test_what_is_not_finite_or_at_a_limit_is_not_estimated(monkeypatch: pytest.MonkeyPatch) -> None:
    """A likelihood that is not finite sorts nothing: it once turned gains of thousands into no drift."""
    smooth, raw = (x[:3] for x in both(driven(Wander(), 0.25, 8.0)))
    one = tell(smooth, raw, (Wander(),))
    steady, right = one.steady, one.found["wander"]
    for broken, why in (
        (replace(right, log_likelihood=math.nan), "not finite"),
        (replace(right, log_likelihood=math.inf), "not finite"),
        (
            replace(right, settings=replace(right.settings, memory_time=np.array([300.0]))),
            "slower than these records tell",
        ),
    ):
        assert why in broken.why_not and not right.why_not
        answers = iter((steady, broken, right))
        monkeypatch.setattr(kinds, "estimate", lambda *_, answers=answers, **__: next(answers))
        told = tell(smooth, raw, (PerceptionNoise(), Wander()))
        assert told.one_of == ("wander",), "the other sort stands"
        rows = _sorts(told)
        assert rows[-1]["log_likelihood"] is None and why in rows[-1]["note"] and not rows[0]["note"]
        alone = replace(told, found={"accel_noise": broken}, one_of=())
        assert alone.verdict == "cannot_tell" and why in sentence(alone)
    assert replace(one, steady=replace(steady, log_likelihood=math.nan)).verdict == "cannot_tell"
    astray = replace(right, log_likelihood=steady.log_likelihood - 4000.0)
    answers = iter((steady, astray, right))
    monkeypatch.setattr(kinds, "estimate", lambda *_, **__: next(answers))
    found = tell(smooth, raw, (PerceptionNoise(), Wander())).found
    assert "went astray" in found["perception_noise"].why_not and "4000 higher" in found["perception_noise"].why_not
    assert not found["wander"].why_not
    still = replace(astray, settings=replace(right.settings, sigma=np.array([0.0015])), nested=steady.log_likelihood)
    assert not still.why_not, "a drift of nothing is none"
    vague = replace(right, log_error=np.where([n.endswith("memory_time") for n in right.names], 20.0, right.log_error))
    told = sentence(replace(one, found={"wander": vague}, one_of=("wander",)))
    assert "s (these data do not tell it)" in told and " to " in told and "e+" not in told


@pytest.fixture(scope="module")
def told_of_five() -> Told:
    """Return what is told of five drivers whose time gap wanders."""
    smooth, raw = (x[:5] for x in both(driven(Wander(), 0.25, 8.0)))
    return tell(smooth, raw, (Wander(), AccelNoise()))


@pytest.mark.parametrize(
    ("better", "first"),
    [
        ({}, "wander"),
        ({("accel_noise", 10.0): 0.99}, "wander"),
        ({("accel_noise", 10.0): 0.5, ("accel_noise", 1.0): 4.0}, "wander"),
        ({("accel_noise", x): 0.5 for x in held_out.HORIZONS_S}, "accel_noise"),
        ({("no drift", x): 0.5 for x in held_out.HORIZONS_S}, "no drift"),
    ],
    ids=["alike", "by a hair", "far ahead only", "another", "none"],
)
def test_headline_and_model_are_the_likeliest_unless_another_forecasts_better(
    better: dict[tuple[str, float], float], first: str, told_of_five: Told, tmp_path: pathlib.Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """``better``: by how much the errors of a model are those of the others, at a horizon. One rule makes both."""
    drivers = np.random.default_rng(0).uniform(0.9, 1.1, 7)

    def scores(estimates: dict[str, Estimate], *_: Any) -> list[dict[str, Any]]:
        rows = []
        for name in estimates:
            own = drivers * np.random.default_rng(len(name)).uniform(0.95, 1.05, 7)
            for x in held_out.HORIZONS_S:
                errors = (x * better.get((name, x), 1.0) * own).tolist()
                rows.append({"model": name, "ahead_s": x, "gap_crps_m": np.mean(errors), "crps_by_driver_m": errors})
        return [x | {"in_90_percent": 90.0, "widening": 1.0, "widened_90_percent": 90.0} for x in rows]

    monkeypatch.setattr(held_out, "scores", scores)
    monkeypatch.setattr("idm_env.drift.job.tell", lambda *_, **__: told_of_five)
    assert told_of_five.one_of[0] == "wander"
    report = drift_file(Source(written(tmp_path)), tmp_path / "out", drivers=9)
    effects = [e.name for e in load_model(tmp_path / "out" / "model.yaml").effects]
    assert effects == ["idm", *([first] if first != "no drift" else []), "brakes"]
    assert report["sentence"].startswith(f"{first.capitalize()}: ") and words_of_the_first(report["sentence"]) <= 30
    assert (report["verdict"] == "cannot_tell") is (first == "no drift")
    assert first == "no drift" or report["one_of"][0] == first
    assert ("Drivers drift: " in report["sentence"]) is (first != "no drift")
    assert ("and worse in forecasts: " in report["sentence"]) is (first == "no drift")


@pytest.mark.parametrize("narrow", [(), (1.0,), (1.0, 5.0)], ids=str)
def test_bands_that_are_too_narrow_are_told_at_every_horizon(narrow: tuple[float, ...]) -> None:
    """Below 85 % at a horizon, it is said with the factor there, and that sigma is not widened by it."""
    rows = [
        {"model": model, "ahead_s": x, "gap_crps_m": x, "crps_by_driver_m": [x, x],
         "in_90_percent": 84.0 if x in narrow else 86.0, "widening": 1.0 + x / 10.0}
        for model in ("wander", "no drift") for x in held_out.HORIZONS_S
    ]  # fmt: skip
    told = held_out.sentence(rows, "wander")
    assert ("Sigma in model.yaml is not widened" in told) is bool(narrow)
    if narrow:
        places, factors = (" and ".join(x) for x in ([f"{x:g}" for x in narrow], [f"{1 + x / 10:.2f}" for x in narrow]))
        assert f"too narrow {places} s ahead: {factors} times as wide they hold 90 %" in told
    assert "1.00, 5.00 and 10.00 m with wander" in told and words_of_the_first(told) <= 30


@pytest.mark.parametrize("wide", [1.0, 1.6])
def test_bands_are_widened_by_the_other_drivers(
    wide: float, told_of_five: Told, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Truths are ``wide`` times as far apart as draws with the noise of measurement: that factor makes bands hold."""
    smooth, raw = both(driven(Wander(), 0.25, 8.0))
    random, noise = np.random.default_rng(3), told_of_five.steady.settings.noise[0]

    def drawn(
        drivers: Any, settings: Any, theta: Any, levels: Any, starts: list[tuple[int, int]], seconds: float,
        count: int, seed: int,
    ) -> np.ndarray:  # fmt: skip
        truth = np.array([[raw[r].gap_m[t + 1 + k] for r, t in starts] for k in range(round(seconds / DT))])[:, None]
        centre = truth + wide * math.hypot(1.0, 0.3) * noise * random.standard_normal(truth.shape)
        return centre + 0.3 * noise * random.standard_normal((len(truth), count, len(starts)))

    monkeypatch.setattr(forecast, "draw_gaps", drawn)
    for row in held_out.scores({"no drift": told_of_five.steady}, smooth, raw):
        assert row["widening"] == pytest.approx(wide, rel=0.2)
        assert row["in_90_percent"] == pytest.approx(90.0 if wide == 1.0 else 69.6, abs=6.0)
        assert row["widened_90_percent"] == pytest.approx(90.0, abs=2.0)
        assert len(row["crps_by_driver_m"]) == DRIVERS


def test_scores_of_a_known_normal() -> None:
    """CRPS of N(0, 1) at 0 is (√2 − 1)/√π; bands hold their share; one draw is a point forecast."""
    draws = np.random.default_rng(0).normal(size=(4000, 50))
    zero = np.zeros(50)
    assert forecast.crps(draws, zero).mean() == pytest.approx((math.sqrt(2.0) - 1.0) / math.sqrt(math.pi), rel=0.01)
    assert forecast.crps(draws[:1], zero) == pytest.approx(np.abs(draws[0]))
    truth = np.random.default_rng(1).normal(size=50_000)
    far = forecast.half_widths(np.random.default_rng(2).normal(size=(300, 50_000)), truth, 0.9)
    assert (far <= 1.0).mean() == pytest.approx(0.9, abs=0.01)
    assert np.quantile(far, 0.5) == pytest.approx(0.6745 / 1.6449, rel=0.02)


def test_a_driver_who_looks_back_is_refused() -> None:
    """A step about a path has no past."""
    smooth, _ = both(driven(Wander(), 0.1, 5.0))
    batch = Batch.stack(smooth[:1], substeps=1)
    with pytest.raises(ValueError, match="'delay' looks back"):
        estimate(behind_a_record(Delay()), batch, IDM_NAMES, np.zeros((1, 5)))
