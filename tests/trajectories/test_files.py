"""Whole files: output, report, chunks, resume, and bad input."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from idm_env.data import DataError
from idm_env.jobs.storage import UNFINISHED
from idm_env.trajectories import files
from tests.trajectories.test_recipe import correlated
from tests.trajectories.tracks import swinging

OUTPUT = {"trajectories.parquet", "parameters.parquet", "report.json", "report.html", "run.json"}


def lane(path: Path, vehicles: int = 4, seconds: float = 25.0, every: int = 1) -> Path:
    """A lane of vehicles 30 m apart in one file, noisy, from the front to the back."""
    rng = np.random.default_rng(0)
    frames = []
    for i in range(vehicles):
        motion = swinging(seconds, phase=-0.3 * i)
        noise = correlated(rng, len(motion.time_s))
        frames.append(
            pl.DataFrame(
                {"vehicle_id": i, "lane": 1, "time_s": motion.time_s, "position_m": motion.position_m - 30 * i + noise}
            )[::every]
        )
    pl.concat(frames).write_csv(path)
    return path


def test_filter_writes_tidy_output_and_a_report(tmp_path: Path) -> None:
    seen: list[tuple[str, int, int]] = []
    report = files.filter_file(
        lane(tmp_path / "lane.csv"), tmp_path / "out", on_progress=lambda *at: seen.append(at[:3])
    )
    assert {path.name for path in (tmp_path / "out").iterdir()} == OUTPUT
    table = pl.read_parquet(tmp_path / "out" / "trajectories.parquet")
    assert table.height == 4 * 251
    back = table.filter(pl.col("vehicle_id") == "3")
    assert back["leader_id"].unique().to_list() == ["2"] and back["gap_m"].null_count() == 0
    assert table.filter(pl.col("vehicle_id") == "0")["gap_m"].null_count() == 251
    parameters = pl.read_parquet(tmp_path / "out" / "parameters.parquet")
    assert dict(parameters.select("vehicle_id", "source").rows()) == {"0": "none", **dict.fromkeys("123", "leader")}
    assert json.loads((tmp_path / "out" / "report.json").read_text())["tracks"] == report["tracks"] == 4
    methods = {row["method"]: row for row in report["methods"]}
    assert methods["simulator, imagined leader"]["implausible_percent"] == 0.0
    assert methods["linear"]["implausible_percent"] == 100.0
    filtering = [at for at in seen if at[0] == "filter"]
    assert filtering[0] == ("filter", 0, 4) and filtering[-1] == ("filter", 4, 4)
    assert filtering == sorted(filtering) and len(filtering) > 4  # it moves within a chunk too
    assert [at[0] for at in seen if at not in filtering] == ["compiling", "reading", "writing"]
    page = (tmp_path / "out" / "report.html").read_text()
    assert page.count("data:image/png") == 5 and "Savitzky–Golay" in page


def test_chunks_and_resume_change_nothing(tmp_path: Path) -> None:
    path = lane(tmp_path / "lane.csv", vehicles=5)
    files.filter_file(path, tmp_path / "whole", baselines=False)

    class StoppedError(Exception):
        pass

    def stop(phase: str, done: int, total: int, words: float | str) -> None:
        if phase == "filter" and done >= 4:
            raise StoppedError

    with pytest.raises(StoppedError):
        files.filter_file(path, tmp_path / "out", baselines=False, chunk=2, on_progress=stop)
    assert (tmp_path / "out" / UNFINISHED).exists()
    files.filter_file(path, tmp_path / "out", baselines=False, chunk=2, resume=True)
    whole, out = (pl.read_parquet(tmp_path / name / "trajectories.parquet") for name in ("whole", "out"))
    for name in ("position_m", "speed_mps", "accel_mps2"):
        assert np.allclose(whole[name], out[name], atol=1e-9)
    gaps = [table["gap_m"].fill_null(-1.0).to_numpy() for table in (whole, out)]
    assert np.allclose(gaps[0], gaps[1], atol=1e-9)
    assert not (tmp_path / "out" / UNFINISHED).exists()


def test_resume_refuses_other_settings(tmp_path: Path) -> None:
    path = lane(tmp_path / "lane.csv", vehicles=2)

    def stop(phase: str, done: int, total: int, words: float | str) -> None:
        if done == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        files.filter_file(path, tmp_path / "out", chunk=1, baselines=False, on_progress=stop)
    with pytest.raises(ValueError, match="other data or options"):
        files.filter_file(path, tmp_path / "out", chunk=2, baselines=False, resume=True)


def test_bad_tracks_are_counted_and_the_others_done(tmp_path: Path) -> None:
    time = np.arange(0, 12.0, 0.1)
    rows = {
        "good": (time, 10 * time),
        "point": (np.array([3.0]), np.array([1.0])),
        "two": (np.array([0.0, 0.1]), np.array([0.0, 1.0])),
        "parked": (time, np.zeros_like(time)),
        "jump": (time, 10 * time + 100.0 * (time > 6.0)),
        "reverse": (time, np.minimum(8 * time, 40 - 2 * time)),
        "shuffled": (time[::-1], 10 * time[::-1]),
        "double": (np.repeat(time, 2), np.repeat(10 * time, 2)),
    }
    # 200 m apart: where all begin at one place they overlap, and the file is asked about its lanes
    frames = [
        pl.DataFrame({"vehicle_id": name, "time_s": t, "position_m": x + 200.0 * n})
        for n, (name, (t, x)) in enumerate(rows.items())
    ]
    pl.concat(frames).write_parquet(tmp_path / "bad.parquet")
    report = files.filter_file(tmp_path / "bad.parquet", tmp_path / "out")
    assert {item["track"] for item in report["left_out"]} == {"0/point", "0/reverse/0"}
    assert {item["kind"] for item in report["repairs"]} == {
        "time not increasing", "duplicated time", "length assumed", "leaders derived", "leader flickers", "track split",
    }  # fmt: skip
    assert report["tracks"] == 7  # the jump makes two
    table = pl.read_parquet(tmp_path / "out" / "trajectories.parquet")
    assert table["accel_mps2"].abs().max() < 10  # type: ignore[operator]
    assert table["speed_mps"].min() >= 0  # type: ignore[operator]
    assert "drives backwards" in (tmp_path / "out" / "report.html").read_text()


def test_a_file_of_nothing_usable_is_refused(tmp_path: Path) -> None:
    pl.DataFrame({"vehicle_id": [1, 2], "time_s": [0.0, 0.0], "position_m": [0.0, 5.0]}).write_csv(tmp_path / "x.csv")
    with pytest.raises(DataError, match="no vehicle has two different times"):
        files.filter_file(tmp_path / "x.csv", tmp_path / "out")


@pytest.mark.parametrize(("every", "worst"), [(10, 0.5), (20, 0.8), (50, 1.5), (100, 4.0)])
def test_reconstruction_fills_in_what_was_left_out(tmp_path: Path, every: int, worst: float) -> None:
    report = files.reconstruct_file(
        lane(tmp_path / "sparse.csv", seconds=60.0, every=every), tmp_path / "out", dt=0.1, baselines=False
    )
    table = pl.read_parquet(tmp_path / "out" / "trajectories.parquet")
    mine = table.filter(pl.col("vehicle_id") == "0")
    truth = swinging(60.0)
    assert np.allclose(mine["time_s"], truth.time_s)
    assert np.sqrt(np.mean((mine["position_m"].to_numpy() - truth.position_m) ** 2)) < worst
    assert report["noise"]["sigma"] == 0.0


def test_the_paper_s_recipe_and_its_ablation(tmp_path: Path) -> None:
    pytest.importorskip("numba")
    path = lane(tmp_path / "lane.csv", vehicles=2, seconds=10.0)
    files.filter_file(path, tmp_path / "free", recipe="paper", baselines=False)
    files.filter_file(path, tmp_path / "fixed", recipe="paper", fixed_parameters=True, baselines=False)
    free, fixed = (pl.read_parquet(tmp_path / name / "parameters.parquet") for name in ("free", "fixed"))
    assert fixed["desired_speed"].to_list() == [50.0, 50.0]
    assert free["desired_speed"].to_list() != [50.0, 50.0]
    report = files.reconstruct_file(path, tmp_path / "sparse", recipe="paper", baselines=False)
    assert report["settings"]["dt"] == 1.0


def test_wrong_choices_are_named(tmp_path: Path) -> None:
    path = lane(tmp_path / "lane.csv", vehicles=1, seconds=5.0)
    with pytest.raises(DataError, match="recipe = 'papers' is unknown"):
        files.filter_file(path, tmp_path / "out", recipe="papers")  # type: ignore[arg-type]
    with pytest.raises(DataError, match="dt = 5 s is outside"):
        files.reconstruct_file(path, tmp_path / "out", dt=5.0)
