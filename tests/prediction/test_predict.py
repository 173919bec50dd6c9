"""Predictions: lanes, leaders, drivers, fallbacks, reports; and against single futures on measured scenes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from idm_env.data import DataError
from idm_env.data.womd import Scenario, read_json, scenarios
from idm_env.prediction import drivers as behaviour
from idm_env.prediction.files import case_of, predict_files
from idm_env.prediction.lanes import LaneGraph
from idm_env.prediction.metrics import summary
from idm_env.prediction.predict import METHODS, STEPS, Scene, along_lane, predict, straight_on
from idm_env.prediction.select import select
from tests.prediction import scenes
from tests.prediction.test_womd import write_json


@pytest.fixture
def fork(tmp_path: Path) -> Scenario:
    return read_json(write_json(tmp_path / "fork.json", wanted=[0, 1, 2, 3]))


def test_connections_are_inferred_from_ends_that_meet(fork: Scenario) -> None:
    assert LaneGraph(fork.lanes).exits == {1: (2, 3), 2: (), 3: ()}
    given = [lane.__class__(lane.id, lane.line, exits=(2,) if lane.id == 1 else ()) for lane in fork.lanes]
    assert LaneGraph(given).exits == {1: (2,), 2: (), 3: ()}


def test_routes_follow_every_branch_and_lift_back(fork: Scenario) -> None:
    routes = LaneGraph(fork.lanes).routes(np.array([-40.0, 0.3]), 0.0, 100.0)
    assert len(routes) == 2 and routes[0].weight == pytest.approx(2 * routes[1].weight)
    for route in routes:
        assert route.begin == pytest.approx(80.0, abs=0.1) and route.lateral == pytest.approx(0.3)
        assert np.allclose(route.lift(np.array([route.begin]), np.array([route.lateral])), [[-40.0, 0.3]], atol=1e-6)
    ends = [route.lift(np.array([route.begin + 100.0]), np.zeros(1))[0] for route in routes]
    assert ends[0] == pytest.approx([60.0, 0.0], abs=0.1)
    assert ends[1][0] == pytest.approx(15.0, abs=0.3) and ends[1][1] > 40
    assert LaneGraph(fork.lanes).routes(np.array([-40.0, 0.3]), np.pi, 100.0) == []  # against the traffic
    assert LaneGraph(fork.lanes).routes(np.array([-40.0, 9.0]), 0.0, 100.0) == []  # beside the road


def test_the_bend_is_taken_slowly_and_the_straight_is_not(fork: Scenario) -> None:
    straight, bend = LaneGraph(fork.lanes).routes(np.array([-40.0, 0.0]), 0.0, 100.0)
    drawn = behaviour.prior(12.0, 12.0)
    speeds = {}
    for name, route in (("straight", straight), ("bend", bend)):
        along, speed = behaviour.roll(route, drawn, route.begin, 12.0, behaviour.nobody(STEPS), STEPS, 2.25).numpy()
        going = ~np.isfinite(drawn.stop)
        inside = (along > 124) & (along < 138) & going[None]
        speeds[name] = np.median(speed[inside])
    assert speeds["bend"] < 7.5 < 10.0 < speeds["straight"]  # √(2.5 m/s² · 15 m) = 6.1 m/s


def test_nobody_drives_into_a_standing_leader_or_past_his_own_stop(fork: Scenario) -> None:
    (route, *_) = LaneGraph(fork.lanes).routes(np.array([-40.0, 0.0]), 0.0, 100.0)
    drawn = behaviour.prior(12.0, 13.4)
    wall = behaviour.Ahead(np.full(STEPS + 1, route.begin + 60.0), np.zeros(STEPS + 1))
    along, speed = behaviour.roll(route, drawn, route.begin, 12.0, wall, STEPS, 2.25).numpy()
    assert (along + 2.25 <= route.begin + 60.0).all()
    assert (along - route.begin <= drawn.stop + 1e-6).all()
    assert (speed >= 0).all() and (np.diff(along, axis=0) >= -1e-9).all()
    passed = behaviour.Ahead(wall.rear, wall.speed, passed=1.0)
    free = behaviour.roll(route, drawn, route.begin, 12.0, passed, STEPS, 2.25).numpy()[0]
    assert (free[-1][~np.isfinite(drawn.stop)] > route.begin + 60.0).mean() > 0.8


def test_one_second_of_braking_shifts_the_weight_to_those_who_stop(fork: Scenario) -> None:
    agent = fork.agents[0]
    braking = 10.0 - 2.0 * scenes.TIME[: scenes.PRESENT + 1] - 2.0
    steady = np.full(scenes.PRESENT + 1, 10.0)
    shares = []
    for speeds in (steady, braking):
        velocity = agent.velocity.copy()
        velocity[: scenes.PRESENT + 1, 0] = speeds + (10.0 - speeds[-1])
        changed = agent.__class__(
            agent.id, agent.kind, agent.length, agent.width, agent.position, agent.heading, velocity, agent.valid
        )
        scene = Scene(Scenario("s", (changed,), fork.lanes, (0,)))
        found = predict(scene, 0)
        near = found.futures[:, -1, 0] < -5.0
        shares.append(found.confidence[near].sum())
    assert shares[1] > shares[0] + 0.2


def test_each_kind_gets_its_method_and_six_futures_that_sum_to_one(fork: Scenario) -> None:
    scene = Scene(fork)
    found = [predict(scene, index) for index in range(4)]
    assert [prediction.source for prediction in found] == ["lane", "free", "lane", "free"]
    for prediction in found:
        assert prediction.futures.shape[1:] == (STEPS, 2) and 1 <= len(prediction.futures) <= 6
        assert prediction.confidence.sum() == pytest.approx(1.0)
        assert (np.diff(prediction.confidence) <= 0).all()
    ends = found[0].futures[:, -1]
    assert (ends[:, 1] > 15).any() and (np.abs(ends[:, 1]) < 2).any()  # both branches
    assert set(found[0].parameters) == {"max_accel", "comfort_decel", "time_gap", "min_gap", "desired_speed"}


def test_the_leader_is_who_is_next_on_the_route(fork: Scenario) -> None:
    scene = Scene(fork)
    cyclist = fork.agents[2]
    (route, *_) = scene.routes(cyclist)
    found = scene.leader(2, route)
    assert found is not None and found[0] == 0 and found[1] == pytest.approx(80.0, abs=0.1)
    assert scene.leader(0, scene.routes(fork.agents[0])[0]) is None


def test_selection_covers_groups_in_order_of_their_weight() -> None:
    rng = np.random.default_rng(0)
    centres, share = np.array([[0.0, 0.0], [40.0, 0.0], [0.0, 40.0]]), (0.6, 0.3, 0.1)
    groups, weights = [], []
    for centre, part in zip(centres, share, strict=True):
        line = np.linspace(0, 1, STEPS)[:, None] * centre
        groups.append(line + 0.1 * rng.normal(size=(20, STEPS, 2)))
        weights.append(np.full(20, part / 20))
    futures, confidence = select(np.concatenate(groups), np.concatenate(weights), 10.0, most=3)
    assert np.allclose(futures[:, -1], centres, atol=1.0)
    assert np.allclose(confidence, share, atol=1e-9)


def test_baselines_are_what_they_say(fork: Scenario) -> None:
    scene = Scene(fork)
    still = straight_on(scene, 0).futures[0]
    assert np.allclose(still[-1], [40.0, 0.3])
    lane = along_lane(scene, 0).futures[0]
    assert lane[-1, 0] == pytest.approx(40.0, abs=0.1) and abs(lane[-1, 1]) < 0.1


def test_files_report_and_bad_input(tmp_path: Path) -> None:
    good = write_json(tmp_path / "good.json", wanted=[0, 1])
    bare = write_json(tmp_path / "bare.json", wanted=[0], lanes=False)
    lost = write_json(tmp_path / "lost.json", wanted=[0, 2], invalid=2)
    (tmp_path / "broken.json").write_text("{")
    seen: list[int] = []
    report = predict_files(
        [good, bare, lost, tmp_path / "broken.json"],
        tmp_path / "out",
        on_progress=lambda done, total: seen.append(done),
    )
    assert {p.name for p in (tmp_path / "out").iterdir()} == {
        "predictions.parquet", "parameters.parquet", "report.json", "report.html",
    }  # fmt: skip
    assert report["scenarios"] == 3 and report["agents"] == 4 and seen == [1, 2, 3, 4]
    reasons = " ".join(item["reason"] for item in report["left_out"])
    assert len(report["left_out"]) == 2 and "not valid at the present" in reasons and "cannot be read" in reasons
    assert any("no lanes" in item["note"] for item in report["notes"])
    table = pl.read_parquet(tmp_path / "out" / "predictions.parquet")
    total = table.filter(pl.col("time_s") > 7.99).group_by("agent_id").agg(pl.col("confidence").sum())
    assert table["time_s"].n_unique() == STEPS and set(total["agent_id"]) == {100, 101}
    assert json.loads((tmp_path / "out" / "report.json").read_text())["methods"][1]["method"] == "constant velocity"
    assert (tmp_path / "out" / "report.html").read_text().count("data:image/png") == 4
    with pytest.raises(DataError, match="no scenario can be used"):
        predict_files([tmp_path / "broken.json"], tmp_path / "none")


def test_better_than_all_three_single_futures_on_measured_scenes(measured) -> None:  # type: ignore[no-untyped-def]
    folder = measured("womd_json")
    cases = {name: [] for name in METHODS}
    for path in sorted(folder.glob("*.json.gz")):
        for scenario in scenarios(path):
            scene = Scene(scenario)
            for index in scenario.to_predict:
                for name, method in METHODS.items():
                    cases[name].append(case_of(scenario, method(scene, index)))
    rows = {name: summary(items) for name, items in cases.items()}
    ours = rows.pop("drivers on routes")
    assert ours["agents"] == 12
    for name, row in rows.items():
        for what in ("minADE_3s", "minADE_5s", "minADE_8s", "miss_rate_3s", "miss_rate_5s", "miss_rate_8s"):
            assert ours[what] < row[what], (name, what)
