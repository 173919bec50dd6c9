"""The commands fit and simulate, from a file on disk to a folder of results, and their bad input."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
import torch

from idm_env.data import synthetic
from idm_env.fitting.drivers import failure, over_fitting
from idm_env.fitting.evaluate import Errors
from idm_env.fitting.job import FITTED, fit_file, simulate_file
from idm_env.fitting.options import Options, Source
from idm_env.model_file import load_model
from tests.commands import run, typed


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small generated csv: four runs of two followers, 60 s, on disk as a user has it."""
    path = tmp_path_factory.mktemp("data") / "platoon.csv"
    trajectories, _ = synthetic.generate(1, runs=4, followers=2, seconds=60.0)
    keep = [c for c in trajectories.table.columns if c not in ("gap_m", "gap_measured")]
    trajectories.table.select(keep).write_csv(path)
    return path


def test_fit_writes_parameters_model_and_reports(file: Path, tmp_path: Path) -> None:
    """Everything that the help promises, consistent with one another; the input file is untouched."""
    before = file.read_bytes()
    result = fit_file(Source(file, smooth=True), Options(starts=2, held_out=0.25), tmp_path)
    assert file.read_bytes() == before
    assert {p.name for p in tmp_path.iterdir()} == {*FITTED, "run.json"}
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["fit"]["gap_rmse_m"] == pytest.approx(result["fit"]["gap_rmse_m"])
    assert report["fit"]["gap_rmse_m"] < 0.3
    # Drivers of held-out runs were never fitted: they take the pooled parameters, and do worse.
    assert report["held_out"]["groups_not_fitted"] == 2
    assert report["held_out"]["gap_rmse_m"] > report["fit"]["gap_rmse_m"]
    table = pl.read_parquet(tmp_path / "parameters.parquet")
    assert table.height == 5 * report["fit"]["groups"]
    page = (tmp_path / "report.html").read_text()
    assert page.count("data:image/png;base64,") == 4 and "http" not in page


def test_every_driver_has_a_row_and_bounds_are_counted(file: Path, tmp_path: Path) -> None:
    """One row per driver in drivers.csv and on the page; the shares at bounds are those of the parameters."""
    seen: list[str] = []
    result = fit_file(
        Source(file, smooth=True), Options(starts=1), tmp_path, on_progress=lambda phase, *_: seen.append(phase)
    )
    drivers = pl.read_csv(tmp_path / "drivers.csv", infer_schema=False)
    long = pl.read_parquet(tmp_path / "parameters.parquet")
    names = drivers.select(pl.format("{}/{}", "run_id", "vehicle_id")).to_series()
    assert names.to_list() == long["group"].unique(maintain_order=True).to_list() and drivers.height == 8
    for row in result["bounds"]:
        mine = long.filter(pl.col("parameter") == row["parameter"])
        wanted = [
            f"{value:.4g}" if known or bound else None
            for value, known, bound in mine.select("estimate", "identified", "at_bound").rows()
        ]
        assert [x and f"{float(x):.4g}" for x in drivers[row["parameter"]]] == wanted
        assert max(len(x.strip("0.").replace(".", "")) for x in drivers[row["parameter"]].drop_nulls()) <= 4
        assert row["on_low"] + row["on_high"] == mine["at_bound"].sum()
        on = drivers["bounds"].fill_null("").str.split(" ").list.contains(row["parameter"])
        assert on.to_list() == mine["at_bound"].to_list()
        if mine["at_bound"].sum():
            assert f" {row['symbol']} for {mine['at_bound'].sum()} of 8" in result["at_bounds"]
    assert result["at_bounds"] in (tmp_path / "report.html").read_text()
    drivers = drivers.cast({"gap_rmse_m": pl.Float64, "episodes": pl.Float64})
    rms = (drivers["gap_rmse_m"] * drivers["episodes"]).sum() / drivers["episodes"].sum()
    assert rms == pytest.approx(result["fit"]["gap_rmse_m"], rel=0.3)
    assert seen[0] == "reading" and seen[-1] == "writing"


def row(words: str, on: int, groups: int) -> dict[str, Any]:
    return {"words": words, "on_low": on, "on_high": 0, "groups": groups}


@pytest.mark.parametrize(
    ("on", "groups", "fitted", "held", "by", "words"),
    [
        (37, 64, 2.06, 10.21, "driver",
         "Over-fitting: the gap RMSE is 10.21 m on held-out runs and 2.06 m on the fitted ones, and comfort "
         "deceleration b is on its bound for 37 of 64. Fit one set of parameters to all (--by all), or with a prior "
         "(idm_env.fitting.fit.fit(prior=...))."),
        (3, 64, 2.06, 10.21, "driver", "Over-fitting: the gap RMSE is 10.21 m on held-out runs and 2.06 m"),
        (37, 64, 2.06, None, "driver", "Over-fitting: comfort deceleration b is on its bound for 37 of 64. Fit one"),
        (0, 1, 2.0, 4.0, "all",
         "Over-fitting: the gap RMSE is 4.00 m on held-out runs and 2.00 m on the fitted ones. Fit more runs"),
        (1, 1, 2.0, 2.5, "all", ""),
        (20, 64, 2.0, 2.9, "driver", ""),
    ],
)  # fmt: skip
def test_fit_says_what_over_fitting_shows_and_what_to_do(
    on: int, groups: int, fitted: float, held: float | None, by: str, words: str
) -> None:
    """A held-out error far above the fitted one, or a parameter on its bound for many drivers."""
    rows = [row("time gap T", 0, groups), row("comfort deceleration b", on, groups)]
    found = over_fitting(rows, fitted, held, by)
    assert found.startswith(words) and bool(found) == bool(words)


def test_raw_positions_are_sent_to_filter_and_parts_have_their_name(file: Path, tmp_path: Path) -> None:
    table = pl.read_csv(file).filter(pl.col("run_id") == pl.col("run_id").min())
    noise = pl.Series(np.random.default_rng(0).normal(0.0, 0.2, table.height))
    table.with_columns(pl.col("position_m") + noise).write_csv(tmp_path / "raw.csv")
    table.write_csv(tmp_path / "smooth.csv")
    said = {}
    for name in ("raw", "smooth"):
        options = ("--starts", 1, "--by", "all", "--held-out", 0.5, "--out", tmp_path / name)
        said[name] = typed("fit", tmp_path / f"{name}.csv", *options)
    assert "Positions have noise of 0.2" in said["raw"].stderr and "first idm-env filter" in said["raw"].stderr
    assert "noise" not in said["smooth"].stderr and "drivers" in said["smooth"].stdout
    assert "of held-out drivers: " in (tmp_path / "raw" / "report.html").read_text()


def test_simulate_repeats_what_fit_reported(file: Path, tmp_path: Path) -> None:
    """A saved model rolled out behind the same leaders gives the error of its fit."""
    fitted = fit_file(Source(file, smooth=True), Options(starts=1), tmp_path / "fit")
    model = load_model(tmp_path / "fit" / "model.yaml")
    assert len(model.drivers) == 8 and model.dt == pytest.approx(0.1)
    result = simulate_file(Source(file, smooth=True), tmp_path / "fit" / "model.yaml", tmp_path / "sim")
    assert result["drivers_with_own_parameters"] == 8
    assert result["error"]["gap_rmse_m"] == pytest.approx(fitted["fit"]["gap_rmse_m"], rel=1e-6)
    report = (tmp_path / "sim" / "report.html").read_text()
    assert "gap RMSE (m)" in report and "gap_rmse_m" not in report
    table = pl.read_parquet(tmp_path / "sim" / "simulated.parquet")
    assert table.null_count().sum_horizontal().item() == 0
    difference = table["gap_m"] - table["measured_gap_m"]
    assert (difference**2).mean() ** 0.5 < 0.3


def test_pooled_and_grouped_fits(file: Path, tmp_path: Path) -> None:
    """``all`` gives one set of parameters, a column one per value."""
    pooled = fit_file(Source(file), Options(by="all", starts=1), tmp_path / "all")
    assert pooled["fit"]["groups"] == 1
    by_vehicle = fit_file(Source(file), Options(by="vehicle_id", starts=1), tmp_path / "vehicle")
    assert by_vehicle["fit"]["groups"] == 2
    assert by_vehicle["fit"]["gap_rmse_m"] <= pooled["fit"]["gap_rmse_m"] * 1.001


def test_drivers_are_told_apart_as_they_were_fitted(file: Path, tmp_path: Path) -> None:
    """Runs are runs: a vehicle that happens to be called like a run gets nothing of it."""
    fit_file(Source(file), Options(by="run_id", starts=1, substeps=1), tmp_path / "fit")
    model = tmp_path / "fit" / "model.yaml"
    assert load_model(model).by == "run_id" and load_model(model).substeps == 1
    same = simulate_file(Source(file), model, tmp_path / "same")
    assert same["drivers_with_own_parameters"] == same["data"]["episodes"]
    runs = load_model(model).drivers
    table = pl.read_csv(file, schema_overrides={"run_id": pl.String, "vehicle_id": pl.String, "leader_id": pl.String})
    one = table.filter(pl.col("run_id") == table["run_id"][0])
    names = dict(zip(one["vehicle_id"].unique().sort(), runs, strict=False))
    other = one.with_columns(pl.lit("elsewhere").alias("run_id"), pl.col("vehicle_id", "leader_id").replace(names))
    other.write_csv(tmp_path / "other.csv")
    result = simulate_file(Source(tmp_path / "other.csv"), model, tmp_path / "sim")
    assert result["drivers_with_own_parameters"] == 0


def test_a_model_with_an_effect_and_with_noise_is_simulated(file: Path, tmp_path: Path) -> None:
    """Any effect of the catalogue; noise is drawn by the seed."""
    model = tmp_path / "model.yaml"
    model.write_text(
        "configures: model\nschema: 1\neffects: [idm, brakes, {effect: delay, max_delay: 1.0}, noise]\n"
        "parameters: {delay: {delay: 0.4}, noise: {sigma: 0.3}}\n"
    )
    one, again, other = (
        simulate_file(Source(file), model, tmp_path / str(i), seed=seed)["error"]["gap_rmse_m"]
        for i, seed in enumerate((1, 1, 2))
    )
    assert one == again != other


def test_bad_input_is_one_line(file: Path, tmp_path: Path) -> None:
    """What to fix, without a traceback."""
    with pytest.raises(ValueError, match="is a file"):
        fit_file(Source(file), Options(), file)
    with pytest.raises(ValueError, match="cannot group by 'vehicle'"):
        fit_file(Source(file), Options(by="vehicle"), tmp_path)
    model = tmp_path / "model.yaml"
    model.write_text("configures: model\nschema: 1\neffects: [idm, brakes, dely]\n")
    with pytest.raises(ValueError, match="Did you mean 'delay'"):
        simulate_file(Source(file), model, tmp_path / "sim")
    model.write_text("configures: model\nschema: 1\neffects: [idm, brakes, imagined]\n")
    with pytest.raises(ValueError, match="'imagined' takes an input"):
        simulate_file(Source(file), model, tmp_path / "sim")


def test_simulate_says_what_the_model_was_fitted_on(file: Path, tmp_path: Path) -> None:
    """Fitted, held out, partly one and partly the other, or unknown: in the report and on its page, by content."""
    fit_file(Source(file), Options(starts=1, held_out=0.25), tmp_path / "fit")
    saved = tmp_path / "fit" / "model.yaml"
    model = load_model(saved)
    runs = sorted({key.split("/")[0] for key in model.drivers})
    table = pl.read_csv(file)
    held = next(r for r in table["run_id"].cast(pl.String).unique() if r not in runs)
    pl.read_csv(file).write_parquet(tmp_path / "renamed.parquet")
    own = tmp_path / "own.yaml"
    own.write_text("configures: model\neffects: [idm, brakes]\n")
    for path, where, yaml, count, words in (
        (file, f"run_id={runs[0]}", saved, 2, "m, fitted on these data: not a held-out figure."),
        (file, f"run_id={held}", saved, 0, "m, on data that the model was not fitted on."),
        (
            tmp_path / "renamed.parquet",
            None,
            saved,
            6,
            "in part fitted on these data (6 of 8 episodes): not a held-out",
        ),
        (file, None, own, None, "does not say whether it was fitted on them"),
    ):
        result = simulate_file(Source(path, where=where), yaml, tmp_path / "sim")
        assert result["fitted_on"]["episodes_fitted_on"] == count
        page = (tmp_path / "sim" / "report.html").read_text()
        assert words in page and "<h2>Data</h2>" in page and f"{path.name}: " in page
        if count == 6:
            assert f"On the others it is {result['fitted_on']['gap_rmse_of_others_m']:.2f} m." in page
            assert result["fitted_on"]["gap_rmse_of_others_m"] != pytest.approx(result["error"]["gap_rmse_m"])


def test_a_fit_that_failed_ends_with_code_1_and_without_a_model(file: Path, tmp_path: Path) -> None:
    """Gaps that nobody can have kept: they are drawn anew in every row; a model of before is not left as if it were."""
    out, bad, vtypes = tmp_path / "out", tmp_path / "bad.csv", tmp_path / "vtypes.add.xml"
    options = ("--starts", 1, "--by", "all", "--out", out, "--sumo", vtypes)
    assert run("fit", file, *options)[0] == 0
    assert (out / "model.yaml").exists()
    vtypes.unlink()
    table = pl.read_csv(file)
    drawn = 10 ** pl.Series(np.random.default_rng(0).uniform(-0.5, 1.8, table.height))
    table.with_columns(gap_m=pl.when(pl.col("leader_id").is_not_null()).then(drawn)).write_csv(bad)
    code, said = run("fit", bad, *options)
    (line,) = (line for line in said.splitlines() if line.startswith("error: "))
    assert code == 1 and "8 of 8 stretches collide" in line, said
    assert json.loads((out / "report.json").read_text())["failed"] in line
    assert "The fit failed: " in (out / "report.html").read_text()
    assert not (out / "model.yaml").exists() and not vtypes.exists()


@pytest.mark.parametrize(
    ("on", "rmse", "smallest", "words"),
    [
        (3, 2.5, 0.1, ""),  # all pairs of NGSIM together
        (5, 0.1, 0.1, ""),  # seconds of an even drive
        (3, 6.0, 0.1, "3 of 5 estimates are on bounds"),
        (4, 2.5, 0.1, "4 of 5 estimates are on bounds"),
        (0, 10.1, 0.1, "the gap RMSE is 10.1 m, and the gap 10 m"),
        (0, 2.5, -0.1, "2 of 2 stretches collide"),
    ],
)
def test_what_a_failed_fit_is(on: int, rmse: float, smallest: float, words: str) -> None:
    two = torch.ones(2)
    error = Errors(rmse * two, two, two, smallest * two, 10.0 * two)
    rows = [row(f"parameter {n}", int(n < on), 1) for n in range(5)]
    told = failure(rows, error)
    assert words in told and bool(told) == bool(words)


def test_drivers_of_a_model_are_found_by_their_tracks(file: Path, tmp_path: Path) -> None:
    """In the same traffic under other names; every command says how many it found."""
    fitted = fit_file(Source(file), Options(starts=1), tmp_path / "fit")
    named = pl.read_csv(file).with_columns(pl.format("x{}", "run_id").alias("run_id"))
    named.write_csv(tmp_path / "named.csv")
    done = typed("simulate", tmp_path / "named.csv", "--model", tmp_path / "fit" / "model.yaml", "--out", tmp_path)
    assert "8 of 8 stretches are of its 8 drivers." in done.stderr
    result = json.loads((tmp_path / "report.json").read_text())
    assert result["error"]["gap_rmse_m"] == pytest.approx(fitted["fit"]["gap_rmse_m"], rel=1e-6)
