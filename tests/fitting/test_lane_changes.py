"""Lane changes: drawn decisions give their parameters back, and so do the simulator's own."""

from __future__ import annotations

import json
from pathlib import Path

import polars as pl
import pytest
import torch

from idm_env.data import DataError, Trajectories
from idm_env.effects import IDM, Brakes, Mobil
from idm_env.fitting.discrete_choice import CONSTANT_RATE, GAP_ACCEPTANCE, UtilityLogit, fit_choice
from idm_env.fitting.lane_changes import ChangeOptions, fit_lane_changes, lane_changes
from idm_env.fitting.lane_decisions import LEFT, RIGHT, Decisions, recorded_decisions
from idm_env.fitting.options import Source
from idm_env.jobs.storage import plain
from idm_env.model_file import load_model
from idm_env.roads import Lanes
from idm_env.simulator import Simulator

DTYPE = torch.float64
FREE = ("mobil.politeness", "mobil.threshold", "mobil.safe_decel", "mobil.keep_right")
TRUTH = {
    "politeness": 0.4, "threshold": 0.3, "safe_decel": 3.0, "keep_right": 0.25, "temperature": 0.4, "attention": 0.7,
    "lapse": 0.01,
}  # fmt: skip


def simulator(road: Lanes) -> Simulator:
    return Simulator(road, (IDM(), Mobil(), Brakes()))


PARAMS = simulator(Lanes(3)).defaults(dtype=DTYPE)


def snapshots(runs: int, seed: int = 0, vehicles: int = 180) -> pl.DataFrame:
    """Return traffic on three lanes at two times, a second apart, a run each; nobody changes, lane 1 is on the left."""
    generator = torch.Generator().manual_seed(seed)
    rows = []
    for run in range(runs):
        u = torch.rand((3, vehicles), generator=generator, dtype=DTYPE)
        lane = torch.arange(vehicles) % 3
        position = 22.0 * torch.div(torch.arange(vehicles), 3, rounding_mode="floor") + 14.0 * u[0]
        speed = 8.0 + 12.0 * u[1]
        rows += [
            (str(run), i, t, float(position[i] + t * speed[i]), float(speed[i]), 5.0, 3 - int(lane[i]))
            for t in (0.0, 1.0) for i in range(vehicles)
        ]  # fmt: skip
    names = ("run_id", "vehicle_id", "time_s", "position_m", "speed_mps", "length_m", "lane")
    return pl.DataFrame(rows, schema=names, orient="row")


def moved(table: pl.DataFrame, vehicles: list[str], step: list[int]) -> Trajectories:
    """Return the table with other lanes at the second time, by ``"run/vehicle"``."""
    change = pl.DataFrame({"key": vehicles, "by": step})
    keyed = table.with_columns(key=pl.col("run_id") + "/" + pl.col("vehicle_id").cast(pl.String))
    joined = keyed.join(change, on="key", how="left", maintain_order="left")
    lane = pl.when(pl.col("time_s") > 0.5).then(pl.col("lane") - pl.col("by").fill_null(0)).otherwise(pl.col("lane"))
    return Trajectories.from_frame(joined.with_columns(lane=lane).drop("key", "by"), source="drawn")


def drawn(runs: int, seed: int = 0) -> Trajectories:
    """Return snapshots in which drivers choose by TRUTH, the law written out here."""
    table = snapshots(runs, seed)
    seen = recorded_decisions(Trajectories.from_frame(table), simulator, lambda _: PARAMS)
    scene, t = seen.scene, TRUTH
    weights = [torch.ones(len(seen), dtype=DTYPE)]
    for side, possible, bias in ((scene.left, seen.possible[:, 0], -1.0), (scene.right, seen.possible[:, 1], 1.0)):
        here = scene.here
        others = side.with_me - side.without_me + here.without_me - here.with_me
        h = side.wanted - here.wanted + t["politeness"] * others - t["threshold"] + bias * t["keep_right"]
        m = torch.where(side.follower.present > 0, side.with_me, 0.0) + t["safe_decel"]
        m = torch.minimum(m, side.wanted - here.wanted.clamp_max(-t["safe_decel"]))
        safe = 1.0 / (1.0 + torch.exp((-m / t["temperature"]).clamp_max(500.0)))
        weights.append(possible * torch.exp((h / t["temperature"]).clamp_max(500.0)) * safe)
    q = torch.stack(weights, -1)
    q = q / q.sum(-1, keepdim=True)
    sides = t["lapse"] / 2 * seen.possible + (1 - t["lapse"]) * t["attention"] * q[:, 1:]
    u = torch.rand(len(seen), generator=torch.Generator().manual_seed(seed + 1), dtype=DTYPE)
    left, right = u < sides[:, 0], (u >= sides[:, 0]) & (u < sides.sum(-1))
    by = left.long() - right.long()
    return moved(table, [seen.vehicles[int(v)] for v in seen.vehicle], by.tolist())


@pytest.fixture(scope="module")
def decisions() -> Decisions:
    return recorded_decisions(drawn(60), simulator, lambda _: PARAMS)


def test_drawn_decisions_give_their_parameters_back(decisions: Decisions) -> None:
    """All seven within three standard errors, which are small against the bounds; others explain less."""
    found = fit_choice(UtilityLogit(simulator(Lanes(3)), FREE), decisions)
    rows = {str(row["parameter"]): row for row in found.table()}
    assert list(rows) == list(TRUTH)
    for name, truth in TRUTH.items():
        row = rows[name]
        assert abs(row["estimate"] - truth) < 3.0 * row["standard_error"], (name, row)
        assert row["identified"] and row["standard_error"] < 0.3 * max(1.0, truth), (name, row)
    for other in (CONSTANT_RATE, GAP_ACCEPTANCE):
        assert fit_choice(other, decisions).log_likelihood < found.log_likelihood - 100.0


def test_the_sides_are_those_of_the_file(decisions: Decisions) -> None:
    """Lane 1 of the file is the left one: nobody on it goes further to the left."""
    table = drawn(4)
    for first, none in (("left", 0), ("right", 1)):
        seen = recorded_decisions(table, simulator, lambda _: PARAMS, first_lane=first)
        on_first = torch.tensor([int(seen.vehicles[int(v)].split("/")[1]) % 3 == 2 for v in seen.vehicle])
        assert not seen.possible[on_first, none].any() and seen.possible[on_first, 1 - none].any()
    assert (decisions.chosen == LEFT).any() and (decisions.chosen == RIGHT).any()


DESIRED = torch.linspace(12.0, 30.0, 60, dtype=DTYPE)[torch.arange(60) * 7 % 60]


def driven(seconds: int = 60) -> Trajectories:
    """Return a ring of three lanes as a file, on which drivers change by MOBIL's defaults."""
    made = simulator(Lanes(3, ring=900.0))
    generator = torch.Generator().manual_seed(4)
    place = torch.arange(60)
    params = made.defaults(dtype=DTYPE)
    params["idm"]["desired_speed"] = DESIRED
    position = torch.div(place, 3, rounding_mode="floor") * 45.0 + 35.0 * torch.rand(60, generator=generator).double()
    speed = 6.0 + 10.0 * torch.rand(60, generator=generator).double()
    state = made.state(position, speed, params, lane=place % 3)
    rows = []
    for step in range(10 * seconds):
        assert state.lanes is not None
        numbers = zip(state.position.tolist(), state.speed.tolist(), state.lanes.lane.tolist(), strict=True)
        rows += [("a", i, step / 10, x % 900.0, v, 5.0, 3 - k, 900.0) for i, (x, v, k) in enumerate(numbers)]
        state = made.step(state, {}, params)
    names = ("run_id", "vehicle_id", "time_s", "position_m", "speed_mps", "length_m", "lane", "ring_length_m")
    return Trajectories.from_frame(pl.DataFrame(rows, schema=names, orient="row"), source="ring")


def test_the_simulators_own_changes_are_seen_when_they_were_decided() -> None:
    """Of recorded MOBIL drivers nearly every decision is told from the state before it: none is a second late."""
    each = [{**PARAMS, "idm": {**PARAMS["idm"], "desired_speed": v}} for v in DESIRED]
    seen = recorded_decisions(driven(), simulator, lambda vehicle: each[int(vehicle.removeprefix("a/"))])
    model = UtilityLogit(simulator(Lanes(3)), FREE)
    # The defaults of MOBIL, hardly any temperature, full attention, and a lapse for what other claims win.
    theta = torch.tensor([0.2, 0.1, 4.0, 0.0, 0.01, 1.0, 1e-3], dtype=DTYPE)
    likely = model.each(theta, seen)
    changed = seen.chosen > 0
    assert seen.changes > 20
    assert (likely[changed] > -1.0).double().mean() > 0.9
    assert (likely[~changed] > -0.1).double().mean() > 0.98


def test_the_command_fits_judges_and_writes(tmp_path: Path) -> None:
    """Held-out drivers are told better than by a constant rate, expected changes are observed ones, files are whole."""
    table = drawn(24, seed=3)
    path = tmp_path / "lanes.parquet"
    table.table.select("run_id", "vehicle_id", "time_s", "position_m", "speed_mps", "length_m", "lane").write_parquet(
        path
    )
    out = tmp_path / "out"
    result = fit_lane_changes(Source(path), ChangeOptions(), out)
    assert "MOBIL is better than constant rate" in result["sentence"]
    told = {row["model"]: row for row in result["models"]}
    assert told["constant rate"]["mobil_gains"] > 0 > told["mobil"]["held_out"] > told["constant rate"]["held_out"]
    observed = result["decisions"]["changes"]
    assert told["mobil"]["expected_changes"] == pytest.approx(observed, rel=0.15)
    assert sum(row["observed"] for row in result["calibration"]) == observed
    assert json.loads((out / "report.json").read_text())["parameters"] == plain(result["parameters"])
    model = load_model(out / "model.yaml")
    estimate = {row["parameter"]: row["estimate"] for row in result["parameters"]}
    assert model.parameters["mobil"]["politeness"] == pytest.approx(estimate["politeness"])
    assert {"idm", "mobil", "brakes"} == {effect.name for effect in model.effects}
    assert "<img" in (out / "report.html").read_text()


def test_bad_files_end_in_one_line() -> None:
    """Without lanes, with one lane only, and where nobody changes."""
    table = snapshots(2)
    one = table.filter(pl.col("vehicle_id") % 3 == 0)
    for bad, words in (
        (table.drop("lane"), "is a lane missing"),
        (one.drop("lane"), "no column 'lane'"),
        (one.with_columns(lane=pl.lit(1)), "no driver has a lane beside"),
        (table, "nobody changes lanes"),
    ):
        with pytest.raises(DataError, match=words):
            lane_changes(Trajectories.from_frame(bad, source="file"))
