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
from idm_env.drift.job import _sorts, drift_file, model_of, sentence
from idm_env.drift.kinds import tell
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
    smooth, raw = (x[::3] for x in both(driven(Wander(), 0.3, 12.0, AccelNoise())))
    told = tell(smooth, raw, (Wander(), AccelNoise()))
    assert told.one_of == ("wander and accel_noise",) and told.verdict == "named"
    pair = told.found[told.one_of[0]]
    assert told.gain[told.one_of[0]] > max(told.gain["wander"], told.gain["accel_noise"]) + kinds.FOUND
    assert np.all(np.abs(np.log(pair.settings.sigma / [0.3, 0.25])) < 0.6), pair.settings
    model = model_of(pair)
    assert [e.name for e in model.effects] == ["idm", "wander", "accel_noise", "brakes"]
    words = sentence(told)
    assert "(wander), sigma" in words and "(accel_noise), sigma" in words and words.count("tau") == 2


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
    assert f"{told['gap_crps_m']:.2f} m with wander" in whole["sentence"]

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


def test_drift_that_forecasts_worse_than_none_is_not_said_to_be_there(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is likelier on drivers it was estimated on, and foresees others worse, is told as that, and not as found."""
    file, scores = written(tmp_path), held_out.scores

    def worse(*given: Any, **more: Any) -> list[dict[str, Any]]:
        return [
            {**x, "gap_crps_m": x["gap_crps_m"] * (1 + 9 * (x["model"] != "no drift"))} for x in scores(*given, **more)
        ]

    monkeypatch.setattr(held_out, "scores", worse)
    monkeypatch.setattr("idm_env.drift.kinds.DRIFTS", (Wander(),))
    report = drift_file(Source(file), tmp_path / "out", drivers=9)
    assert report["verdict"] == "cannot_tell" and "Drivers drift" not in report["sentence"]
    assert report["sentence"].startswith("No drift forecasts best") and "worse in forecasts: " in report["sentence"]


@pytest.mark.parametrize(("wide", "narrow"), [(1.0, False), (1.6, True)])
def test_bands_that_are_too_narrow_are_told_with_their_widening(wide: float, narrow: bool) -> None:
    """Truths are ``wide`` times as far apart as the draws: that is the factor, and the words come with it."""
    random = np.random.default_rng(3)
    draws, truth = random.standard_normal((2000, 4000)), wide * random.standard_normal(4000)
    factor = forecast.widening(draws, truth, 0.9)
    assert factor == pytest.approx(wide, rel=0.05)
    held = 100.0 * float(forecast.covers(draws, truth, 0.9)[0].mean())
    row = {"model": "wander", "ahead_s": 10.0, "gap_crps_m": 1.0, "in_90_percent": held, "widening": factor}
    told = held_out.sentence([row, {**row, "model": "no drift", "gap_crps_m": 2.0}], "wander", 5)[1]
    assert (f"too narrow: {factor:.2f} times as wide it holds 90 %" in told) is narrow


def test_scores_of_a_known_normal() -> None:
    """CRPS of N(0, 1) at 0 is (√2 − 1)/√π; bands hold their share; one draw is a point forecast."""
    draws = np.random.default_rng(0).normal(size=(4000, 50))
    zero = np.zeros(50)
    assert forecast.crps(draws, zero).mean() == pytest.approx((math.sqrt(2.0) - 1.0) / math.sqrt(math.pi), rel=0.01)
    assert forecast.crps(draws[:1], zero) == pytest.approx(np.abs(draws[0]))
    truth = np.random.default_rng(1).normal(size=50_000)
    inside, width = forecast.covers(np.random.default_rng(2).normal(size=(300, 50_000)), truth, 0.9)
    assert inside.mean() == pytest.approx(0.9, abs=0.01)
    assert width.mean() == pytest.approx(2.0 * 1.6449, rel=0.02)


def test_a_driver_who_looks_back_is_refused() -> None:
    """A step about a path has no past."""
    smooth, _ = both(driven(Wander(), 0.1, 5.0))
    batch = Batch.stack(smooth[:1], substeps=1)
    with pytest.raises(ValueError, match="'delay' looks back"):
        estimate(behind_a_record(Delay()), batch, IDM_NAMES, np.zeros((1, 5)))
