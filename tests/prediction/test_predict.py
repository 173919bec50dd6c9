"""Predictions: lanes, leaders, drivers, fallbacks, reports; and against single futures on measured scenes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from benchmarks import prediction as benchmark
from idm_env.data import DataError
from idm_env.data.scenario import Scenario, TrafficControl
from idm_env.data.womd import read_json, scenarios
from idm_env.jobs.storage import UNFINISHED
from idm_env.prediction.drivers import Second, hypotheses, middle, posterior
from idm_env.prediction.files import OURS, case_of, predict_files
from idm_env.prediction.lanes import LaneGraph, Route
from idm_env.prediction.metrics import score, summary
from idm_env.prediction.mixture import SHARES
from idm_env.prediction.predict import (
    METHODS,
    along_lane,
    as_published,
    predict,
    published_distance,
    straight_on,
)  # fmt: skip
from idm_env.prediction.rollout import Course, RouteDrivers, RouteLeader, nobody, roll
from idm_env.prediction.scene import STEPS, MapScene
from idm_env.prediction.select import chances, select
from idm_env.prediction.stops import Stop, StopLines
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


def second_of(route: Route, speeds: np.ndarray, ahead: RouteLeader | None = None, stop: Stop | None = None) -> Second:
    """A last second at these speeds (m/s), 11 samples, behind nobody unless told."""
    return Second(route, speeds, ahead or nobody(len(speeds) - 1), 2.25, stop)


def drawn_at(route: Route, speed: float) -> RouteDrivers:
    return posterior([second_of(route, np.full(11, speed))])[0][0]


def test_the_bend_is_taken_slowly_and_the_straight_is_not(fork: Scenario) -> None:
    straight, bend = LaneGraph(fork.lanes).routes(np.array([-40.0, 0.0]), 0.0, 100.0)
    courses = [Course(route, drawn_at(route, 12.0), nobody(STEPS), route.begin) for route in (straight, bend)]
    medians = []
    for course, (along, speed) in zip(courses, roll(courses, 12.0, STEPS, 2.25), strict=True):
        going = ~np.isfinite(course.drivers.stop)
        medians.append(np.median(speed[(along > 124) & (along < 138) & going[None]]))
    assert medians[1] < 7.5 < 10.0 < medians[0]  # √(2.5 m/s² · 15 m) = 6.1 m/s


def test_courses_rolled_together_are_those_rolled_alone(fork: Scenario) -> None:
    routes = LaneGraph(fork.lanes).routes(np.array([-40.0, 0.0]), 0.0, 100.0)
    courses = [Course(route, drawn_at(route, 9.0), nobody(STEPS), route.begin) for route in routes]
    together = roll(courses, 9.0, STEPS, 2.25)
    for course, both in zip(courses, together, strict=True):
        assert np.allclose(roll([course], 9.0, STEPS, 2.25)[0], both, atol=1e-9)


def test_nobody_drives_into_a_standing_leader_or_past_his_own_stop(fork: Scenario) -> None:
    (route, *_) = LaneGraph(fork.lanes).routes(np.array([-40.0, 0.0]), 0.0, 100.0)
    drawn = drawn_at(route, 12.0)
    wall = RouteLeader(np.full(STEPS + 1, route.begin + 60.0), np.zeros(STEPS + 1))
    ((along, speed),) = roll([Course(route, drawn, wall, route.begin)], 12.0, STEPS, 2.25)
    assert (along + 2.25 <= route.begin + 60.0).all()
    assert (along - route.begin <= drawn.stop + 1e-6).all()
    assert (speed >= 0).all() and (np.diff(along, axis=0) >= -1e-9).all()
    passed = RouteLeader(wall.rear, wall.speed, passed=1.0)
    free = roll([Course(route, drawn, passed, route.begin)], 12.0, STEPS, 2.25)[0][0]
    assert (free[-1][~np.isfinite(drawn.stop)] > route.begin + 60.0).mean() > 0.8


def test_stop_signs_are_for_the_lane_at_whose_end_they_stand_and_lights_for_theirs(fork: Scenario) -> None:
    graph = LaneGraph(fork.lanes)
    end = graph.lanes[1].line[-1]
    (route, *_) = graph.routes(np.array([-40.0, 0.0]), 0.0, 100.0)
    away = float(end[0] + 40.0 - 2.25)

    def stop(*controls: TrafficControl) -> Stop | None:
        return StopLines(graph, controls).next_stop(route, 2.25, 10.0)

    assert stop(TrafficControl("sign", end + np.array([-3.0, -4.0]))) == Stop(pytest.approx(away, abs=0.2), "sign")
    assert (
        stop(TrafficControl("sign", end + np.array([-3.0, 4.0]))) is None
    )  # on the left: for those who come towards us
    assert stop(TrafficControl("sign", end + np.array([-40.0, -4.0]))) is None  # not at a junction
    assert stop(TrafficControl("sign", end + np.array([5.0, 30.0]), lanes=(1,))) == Stop(
        pytest.approx(away, abs=0.2), "sign"
    )
    assert stop(TrafficControl("stop", end, lanes=(route.chain[1],))) == Stop(pytest.approx(away, abs=0.2), "red")
    assert (
        stop(TrafficControl("stop", end, lanes=(99,))) is None and stop(TrafficControl("go", end, lanes=(1,))) is None
    )
    assert stop(TrafficControl("caution", end, lanes=(1,))) is not None
    near = graph.routes(np.array([-12.0, 0.0]), 0.0, 100.0)[0]
    assert (
        StopLines(graph, [TrafficControl("caution", end, lanes=(1,))]).next_stop(near, 2.25, 12.0) is None
    )  # too late to brake


def test_a_sign_is_stopped_at_and_left_and_a_red_light_is_waited_for(fork: Scenario) -> None:
    (route, *_) = LaneGraph(fork.lanes).routes(np.array([-40.0, 0.0]), 0.0, 100.0)
    ends = {}
    for kind in ("sign", "red"):
        one = middle(10.0, 13.4, Stop(25.0, kind))
        ((along, speed),) = roll([Course(route, one, nobody(200), route.begin)], 10.0, 200, 2.25)
        halt = int(np.argmax(speed[:, 0] < 0.5))
        assert along[halt, 0] - route.begin == pytest.approx(25.0, abs=1.5)
        ends[kind] = (halt, int(np.argmax((speed[:, 0] > 1.0) & (np.arange(200) > halt))))
    assert ends["sign"][1] - ends["sign"][0] < 25  # 1 s of waiting and the start
    assert ends["red"][1] >= 80  # it opens after 8 s


def test_a_stop_line_ahead_makes_stopping_likely_unless_the_second_says_otherwise(fork: Scenario) -> None:
    (route, *_) = LaneGraph(fork.lanes).routes(np.array([-40.0, 0.0]), 0.0, 100.0)
    line = Stop(20.0, "sign")

    def shares(speeds: np.ndarray) -> tuple[float, float]:
        """Those who stop at the line, and those who stop anywhere."""
        drawn, weight = posterior([second_of(route, speeds, stop=line)])[0]
        at_line, anywhere = np.isfinite(drawn.wait), np.isfinite(drawn.stop)
        return float(weight[at_line].sum() / weight.sum()), float(weight[anywhere].sum() / weight.sum())

    steady, braking, faster = np.full(11, 10.0), np.linspace(12.5, 10.0, 11), np.linspace(8.5, 10.0, 11)
    assert shares(braking)[0] > 0.7 > 0.4 > shares(steady)[0] > 2.0 * shares(faster)[0]
    assert shares(braking)[1] > 0.85
    assert sum(h.share for h in hypotheses(second_of(route, steady, stop=line))) == pytest.approx(1.0)


def test_drivers_are_fitted_to_the_second_by_the_projects_fit(fork: Scenario) -> None:
    """Strong acceleration shifts max_accel up, and what the second does not tell keeps the prior's spread."""
    (route, *_) = LaneGraph(fork.lanes).routes(np.array([-40.0, 0.0]), 0.0, 100.0)
    medians = {}
    for name, rate in (("gentle", 0.6), ("strong", 2.6)):
        drawn, weight = posterior([second_of(route, 3.0 + rate * 0.1 * np.arange(11))])[0]
        going = ~np.isfinite(drawn.stop) & (weight > 0.1 * weight.max())
        medians[name] = float(np.median(drawn.max_accel[going]))
        assert np.std(np.log(drawn.time_gap)) == pytest.approx(0.3, rel=0.25)
    assert medians["gentle"] < 1.6 < medians["strong"]


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
        scene = MapScene(Scenario("s", (changed,), fork.lanes, (0,)))
        found = predict(scene, 0)
        near = found.futures[:, -1, 0] < -5.0
        shares.append(found.confidence[near].sum() / found.confidence.sum())
    assert shares[1] > shares[0] + 0.2


def test_nobody_is_predicted_worse_than_by_constant_velocity(fork: Scenario) -> None:
    """It is one of the six, to the last bit, for every kind, on and off the lanes."""
    scene = MapScene(fork)
    for index in range(4):
        straight = straight_on(scene, index).futures[0]
        assert np.abs(predict(scene, index).futures - straight).max(axis=(1, 2)).min() == 0.0


def test_who_stands_may_stay(fork: Scenario) -> None:
    agent = fork.agents[0]
    still = np.zeros_like(agent.velocity)
    parked = agent.__class__(
        agent.id, agent.kind, agent.length, agent.width, np.broadcast_to(agent.position[0], agent.position.shape),
        agent.heading, still, agent.valid,
    )  # fmt: skip
    found = predict(MapScene(Scenario("s", (parked,), fork.lanes, (0,))), 0)
    moved = np.hypot(*(found.futures[:, -1] - agent.position[0]).T)
    assert found.confidence[moved < 2.0].sum() > 0.3 and (moved > 20.0).any()


def test_each_kind_gets_its_method_and_six_futures(fork: Scenario) -> None:
    scene = MapScene(fork)
    found = [predict(scene, index) for index in range(4)]
    assert [prediction.source for prediction in found] == ["lane", "free", "lane", "free"]
    for prediction in found:
        assert prediction.futures.shape[1:] == (STEPS, 2) and 1 <= len(prediction.futures) <= 6
        assert 0.0 < prediction.confidence.sum() <= 1.0 + 1e-9
        assert (np.diff(prediction.confidence) <= 0).all()
    ends = found[0].futures[:, -1]
    assert (ends[:, 1] > 15).any() and (np.abs(ends[:, 1]) < 2).any()  # both branches
    assert set(found[0].parameters) == {"max_accel", "comfort_decel", "time_gap", "min_gap", "desired_speed"}


def test_the_leader_is_who_is_next_on_the_route(fork: Scenario) -> None:
    scene = MapScene(fork)
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


def test_confidence_is_the_chance_to_hit_what_the_others_miss() -> None:
    time = np.linspace(0.1, 1.0, STEPS)[:, None]
    far, side = time * [80.0, 0.0], time * [0.0, 80.0]
    samples = np.stack([far, far, far, side, side, time * [-80.0, 0.0]])
    chosen = np.stack([side, far, far])
    futures, confidence = chances(samples, np.full(6, 1 / 6), chosen, 10.0)
    assert np.allclose(futures, np.stack([far, side, far]))
    assert np.allclose(confidence, [0.5, 1 / 3, 0.0])


def test_a_fit_by_the_paper_s_recipe_drives_the_paper_s_row(fork: Scenario) -> None:
    """Its bounds ask for 5 m/s² and 20 m/s at least, so that a free road is taken at once; leaders are yielded to."""
    scene = MapScene(fork)
    alone = as_published(scene, 0).futures[0]
    assert alone.shape == (STEPS, 2) and abs(alone[-1, 1]) < 0.1  # straight on
    assert alone[-1, 0] > straight_on(scene, 0).futures[0, -1, 0] + 20.0
    behind = published_distance(scene, 2, {})
    gap = 80.0 + published_distance(scene, 0, {}) - behind - 4.5
    assert (np.diff(behind) >= 0).all() and gap.min() > 0.0


def test_baselines_are_what_they_say(fork: Scenario) -> None:
    scene = MapScene(fork)
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
        on_progress=lambda phase, done, total, words: seen.append(done) if phase == "predict" else None,
    )
    assert {p.name for p in (tmp_path / "out").iterdir()} == {
        "predictions.parquet", "parameters.parquet", "report.json", "report.html", "run.json",
    }  # fmt: skip
    assert report["scenarios"] == 3 and report["agents"] == 4 and seen == [0, 1, 1, 2, 2, 3, 4]
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
    (tmp_path / "also_broken.json").write_text("{")
    with pytest.raises(DataError, match=r"broken.json.*And 1 more: also_broken.json"):
        predict_files([tmp_path / "broken.json", tmp_path / "also_broken.json"], tmp_path / "none")


def test_an_interrupted_run_goes_on_after_the_last_file(tmp_path: Path) -> None:
    paths = [write_json(tmp_path / f"{i}.json", wanted=[i]) for i in range(3)]
    whole = predict_files(paths, tmp_path / "whole")

    def stop(phase: str, done: int, total: int, words: float | str) -> None:
        if (done, words) == (2, "1.json"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        predict_files(paths, tmp_path / "out", on_progress=stop)
    assert (tmp_path / "out" / UNFINISHED / "predict" / "000001.kept").exists()
    with pytest.raises(ValueError, match="other data or options"):
        predict_files(paths[:2], tmp_path / "out", resume=True)
    paths[0].write_text(paths[0].read_text())  # as new: another file by its time
    with pytest.raises(ValueError, match="other data or options"):
        predict_files(paths, tmp_path / "out", resume=True)
    with pytest.raises(KeyboardInterrupt):
        predict_files(paths, tmp_path / "out", on_progress=stop)
    seen: list[int] = []
    report = predict_files(paths, tmp_path / "out", resume=True, on_progress=lambda *at: seen.append(at[1]))
    assert report["methods"] == whole["methods"] and seen[1:-1] == [2, 2, 3]
    tables = [pl.read_parquet(tmp_path / name / "predictions.parquet") for name in ("whole", "out")]
    assert tables[0].equals(tables[1]) and not (tmp_path / "out" / UNFINISHED).exists()


def test_better_than_all_three_single_futures_on_measured_scenes(measured) -> None:  # type: ignore[no-untyped-def]
    folder = measured("womd_json")
    cases = {name: [] for name in METHODS}
    for path in sorted(folder.glob("*.json.gz")):
        for scenario in scenarios(path):
            scene = MapScene(scenario)
            for index in scenario.to_predict:
                for name, method in METHODS.items():
                    cases[name].append(score(case_of(scenario, method(scene, index))))
    rows = {name: summary(items) for name, items in cases.items()}
    ours = rows.pop("drivers on routes")
    assert ours["agents"] == 12
    for name, row in rows.items():
        for what in ("minADE_3s", "minADE_5s", "minADE_8s", "miss_rate_3s", "miss_rate_5s", "miss_rate_8s"):
            assert ours[what] < row[what], (name, what)


def test_held_out_no_kind_is_predicted_worse_than_by_constant_velocity(measured) -> None:  # type: ignore[no-untyped-def]
    """Each scene with the shares of the ways fitted to the other two; those of all three are the shipped ones."""
    scenes = [
        benchmark.known_agents(scenario)
        for path in sorted(measured("womd_json").glob("*.json.gz"))
        for scenario in scenarios(path)
    ]
    fitted = benchmark.fit_shares(one.seen for scene in scenes for one in scene)
    assert all(fitted[key] == pytest.approx(SHARES[key], abs=2e-3) for key in SHARES)
    agents = benchmark.held_out(scenes)
    groups = {(one.seen.kind, one.seen.pace) for one, _ in agents}
    assert len(groups) == 4
    for group in groups:
        here = [item for item in agents if (item[0].seen.kind, item[0].seen.pace) == group]
        rows = {name: summary(kept) for name, kept in benchmark.compared(here, [benchmark.STRAIGHT]).items()}
        ours, straight = rows[OURS], rows[benchmark.STRAIGHT]
        assert ours["mAP"] >= straight["mAP"] - 1e-12, group
        for what in ("minADE", "minFDE", "miss_rate"):
            for seconds in (3, 5, 8):
                assert ours[f"{what}_{seconds}s"] <= straight[f"{what}_{seconds}s"], (group, what, seconds)
