"""The calibration behind filtered tracks takes the effects of a corrected model."""

from __future__ import annotations

from pathlib import Path

import polars as pl

from idm_env.data import synthetic
from idm_env.effects import IDM, Brakes, make
from idm_env.model_file import Model, save_model
from idm_env.trajectories.files import filter_file


def test_a_known_delay_lets_the_parameters_be_told_better(tmp_path: Path) -> None:
    data, _ = synthetic.generate(22, runs=2, followers=2, seconds=60.0, effect="delay")
    columns = ("run_id", "vehicle_id", "time_s", "position_m", "length_m", "leader_id")
    data.table.select(columns).write_csv(tmp_path / "tracks.csv")
    effects = (IDM(), make("delay"), Brakes())
    save_model(tmp_path / "model.yaml", Model(effects=effects, parameters={"delay": {"delay": 0.5}}))
    errors = []
    for model in (None, str(tmp_path / "model.yaml")):
        filter_file(tmp_path / "tracks.csv", tmp_path / "out", model=model, baselines=False)
        rows = pl.read_parquet(tmp_path / "out" / "parameters.parquet").filter(pl.col("source") == "leader")
        errors.append(rows["max_accel_error"].median())
    assert errors[1] < 0.3 * errors[0]
