"""The whole chain on small data with a hidden effect: verdicts, report and the corrected model."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch

from idm_env.data import Trajectories, synthetic
from idm_env.discovery import Discovery, discover, solve, write_report
from idm_env.jobs.storage import UNFINISHED, Store
from idm_env.model_file import load_model
from idm_env.roads import Lane

pytestmark = pytest.mark.usefixtures("two_laws")

FEW = ("lag", "leader_acceleration", "drag", "grade", "speed_zone", "regime_shift")


def data(effect: str | None, runs: int = 8, **changes: object) -> Trajectories:
    options: dict[str, object] = {"runs": runs, "followers": 2, "seconds": 90.0, "effect": effect} | changes
    return synthetic.generate(21, **options)[0]  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def drag() -> Discovery:
    return discover(data("leader_acceleration"), effects=FEW)


def test_the_hidden_effect_is_named(drag: Discovery) -> None:
    assert drag.verdict == "named"
    assert [f["effect"] for f in drag.report["found"]] == ["leader_acceleration"]
    gain = drag.report["found"][0]["parameters"]["gain"]
    assert gain["estimate"] == pytest.approx(0.4, rel=0.1)
    assert gain["low"] < 0.4 < gain["high"]
    error = drag.report["error"]
    assert error["after"]["gap_rmse_m"] < 0.5 * error["before"]["gap_rmse_m"]
    fitted_on = set(drag.problem.rows.records.runs)
    assert error["held_out_runs"] and not fitted_on & set(error["held_out_runs"])


def test_report_files(drag: Discovery, tmp_path: Path) -> None:
    paths = write_report(drag, tmp_path)
    report = json.loads(paths["report.json"].read_text())
    assert {"schema", "verdict", "found", "error", "candidates", "data", "seed", "versions"} <= set(report)
    assert {c["effect"] for c in report["candidates"]} >= set(FEW) - {"leader_acceleration"}
    page = paths["report.html"].read_text()
    assert page.count("data:image/png;base64,") == 6
    assert not re.search(r'(src|href)="(?!data:)', page)  # nothing is fetched from elsewhere
    model = load_model(paths["model.yaml"])
    assert [e.name for e in model.effects] == ["idm", "leader_acceleration", "brakes"]
    simulator = model.simulator(Lane())
    params = model.params(dtype=torch.float64)
    state = simulator.state(torch.tensor([100.0, 60.0]).double(), torch.tensor([20.0, 20.0]).double(), params)
    end, _ = simulator.rollout(state, {}, params, 50)
    assert torch.isfinite(end.gap).all()


def test_nothing_is_found_where_nothing_is_hidden() -> None:
    # Noise of drivers hides what is not there as well as what is, unless the errors look like it in every test.
    for ou, verdicts in ((0.0, ["none"]), (0.3, ["cannot_tell", "undecided", "none"])):
        found = discover(data(None, ou=ou), effects=FEW)
        assert found.verdict in verdicts
        assert not ou or "unsteady drivers" in found.report["sentence"]
        assert found.report["found"] == []
        assert found.report["error"]["after"] == found.report["error"]["before"]


def test_drivers_of_many_runs_may_share_parameters() -> None:
    alike = data("grade", runs=6, seconds=70.0, spread=0.05, grade_column=True)
    found = discover(alike, effects=["lag", "grade"], by="all")
    assert [f["effect"] for f in found.report["found"]] == ["grade"]
    given = discover(alike, effects=["lag"], by="vehicle_id", known=["grade"])
    # Drivers of one identifier differ by 5 %: what a shared model leaves of them is nine times the sensors' noise.
    assert given.verdict == "undecided" and given.report["found"] == []
    assert given.report["known"][0]["estimate"] == pytest.approx(1.0, abs=0.05)


def test_few_runs_cannot_tell() -> None:
    found = discover(data("leader_acceleration", runs=3), effects=FEW)
    assert found.verdict == "cannot_tell"
    assert "2 runs" in found.report["sentence"]
    assert found.report["found"] == []


def test_the_only_candidate_may_become_every_drivers_own_strength() -> None:
    """A law with it is compared, and beyond that law nothing is left to try."""
    stiff = synthetic.generate(5, runs=7, followers=1, seconds=60.0, effect="gap_stiffness", dt=0.2)[0]
    assert discover(stiff, effects=["gap_stiffness"]).report["verdict"] == "named"


def test_followers_are_counted_where_runs_are_few() -> None:
    """One candidate alone may be asked for: the round after its addition has nothing left to try."""
    found = discover(data("leader_acceleration", runs=5, followers=3), effects=["leader_acceleration"])
    assert [f["effect"] for f in found.report["found"]] == ["leader_acceleration"]
    assert found.report["found"][0]["p_value"] < 2.0**-4
    faint = discover(data("leader_acceleration", runs=4, ou=0.3), effects=FEW).report
    assert faint["verdict"] != "none"


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_single_run_is_told_and_drawn(tmp_path: Path) -> None:
    """Nothing can be left out for a gain: its interval has no ends, which no axis can show."""
    found = discover(data(None, runs=1), effects=("lag", "drag", "speed_zone"))
    assert "only 1 run is left" in found.report["sentence"]
    assert all(None in c["interval"] for c in found.report["candidates"])
    assert write_report(found, tmp_path)["report.html"].exists()


@pytest.mark.parametrize("dt", [0.04, 0.2])
def test_a_report_is_drawn_at_every_time_step(dt: float, tmp_path: Path) -> None:
    """Windows are of whole samples of about half a second, and not of whole seconds at every step."""
    found = discover(data(None, runs=7, followers=1, seconds=30.0, dt=dt), effects=["drag"])
    assert write_report(found, tmp_path)["report.html"].exists()


def test_candidates_that_cannot_be_tried_are_named() -> None:
    with pytest.raises(ValueError, match="lateral: no vehicle in an adjacent lane is measured"):
        discover(data(None, runs=2), effects=["lateral"])


def test_unknown_effect_is_refused() -> None:
    with pytest.raises(ValueError, match="Did you mean 'grade'"):
        discover(data(None, runs=2), effects=["grad"])


def test_an_interrupted_search_goes_on(drag: Discovery, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Solves nothing twice, in the search or after it, and ends as one that was not interrupted.

    With other options it is refused, and stays to be gone on with.
    """
    solved: list[list[str]] = [[]]
    put = Store.put

    def seen(self: Store, key: str, content: object) -> None:
        solved[-1].append(key)
        put(self, key, content)

    def stop(phase: str, done: int, total: int, candidate: float | str) -> None:
        if phase == "other laws" and done == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr(Store, "put", seen)
    monkeypatch.setattr(solve, "LONG_S", -1.0)
    trajectories = data("leader_acceleration")
    with pytest.raises(KeyboardInterrupt):
        discover(trajectories, effects=FEW, out=tmp_path, on_progress=stop)
    assert (tmp_path / UNFINISHED).exists()
    with pytest.raises(ValueError, match="other data or options"):
        discover(trajectories, effects=FEW[:3], out=tmp_path, resume=True)
    solved.append([])
    resumed = discover(trajectories, effects=FEW, out=tmp_path, resume=True)
    assert len(solved[0]) > 50 and solved[1] and len({*solved[0], *solved[1]}) == len(solved[0]) + len(solved[1])
    assert not (tmp_path / UNFINISHED).exists()
    assert resumed.report["verdict"] == drag.report["verdict"]
    assert np.array_equal(resumed.final.values, drag.final.values)


def test_the_corrected_model_is_fitted_to_other_drivers(drag: Discovery, tmp_path: Path) -> None:
    from idm_env.fitting.job import fit_file
    from idm_env.fitting.options import Options, Source

    corrected = write_report(drag, tmp_path)["model.yaml"]
    others = synthetic.generate(22, runs=2, followers=2, seconds=60.0, effect="leader_acceleration")[0]
    others.table.write_parquet(tmp_path / "others.parquet")
    source = Source(tmp_path / "others.parquet")
    plain, better = (
        fit_file(source, Options(starts=1, model=m), tmp_path / str(i)) for i, m in enumerate((None, str(corrected)))
    )
    assert better["fit"]["gap_rmse_m"] < 0.6 * plain["fit"]["gap_rmse_m"]
    again = load_model(tmp_path / "1" / "model.yaml")
    assert "leader_acceleration" in [e.name for e in again.effects]
    assert (
        again.parameters["leader_acceleration"]["gain"]
        == load_model(corrected).parameters["leader_acceleration"]["gain"]
    )
