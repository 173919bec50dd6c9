"""A reconstruction is scored on points of the user's own file that it was not given."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from idm_env.trajectories import files
from idm_env.trajectories.left_out import thinned
from idm_env.trajectories.tracks import TrackPiece
from tests.trajectories.test_files import lane


def test_every_second_inner_point_is_left_out_and_the_ends_stay() -> None:
    time, nobody = np.arange(8.0), np.full(8, "")
    track = TrackPiece("", "", 0, time, 10 * time, 4.5, nobody, np.full(8, -1))
    given, out = thinned(track)
    assert given.time_s.tolist() == [0, 2, 4, 6, 7] and out.tolist() == [1, 3, 5]


def test_errors_are_those_at_the_points_left_out(tmp_path: Path) -> None:
    """Steady driving is met exactly; points moved by 3 m, given to nobody, are missed by 3 m."""
    time = 2.0 * np.arange(21)
    for name, moved in (("steady", 0.0), ("moved", 3.0)):
        position = 15.0 * time
        position[1:-1:2] += moved
        frames = [
            pl.DataFrame({"vehicle_id": i, "lane": 1, "time_s": time, "position_m": position - 40 * i})
            for i in range(3)
        ]  # fmt: skip
        pl.concat(frames).write_csv(tmp_path / f"{name}.csv")
        report = files.reconstruct_file(tmp_path / f"{name}.csv", tmp_path / name)
        ours, line = report["left_out_points"][:2]
        assert (ours["points"], ours["tracks"], ours["spacing_s"]) == (30, 3, 4.0)
        assert ours["rmse_m"] == pytest.approx(moved, abs=0.05) and line["rmse_m"] == pytest.approx(moved, abs=1e-6)
        assert ours["bias_m"] == pytest.approx(-moved, abs=0.05)


def test_the_report_says_it_first(tmp_path: Path) -> None:
    report = files.reconstruct_file(lane(tmp_path / "sparse.csv", seconds=60.0, every=20), tmp_path / "out")
    rows = {row["method"]: row for row in report["left_out_points"]}
    assert rows["simulator, imagined leader"]["rmse_m"] < 0.7 * rows["linear"]["rmse_m"]
    assert json.loads((tmp_path / "out" / "report.json").read_text())["left_out_points"] == report["left_out_points"]
    page = (tmp_path / "out" / "report.html").read_text()
    assert page.index("Points of the file that were left out") < page.index("Methods on these data")
    sparse = tmp_path / "sparse.csv"
    published = files.reconstruct_file(sparse, tmp_path / "paper", recipe="paper", baselines=False)
    (row,) = published["left_out_points"]
    assert row["method"] == "the paper's recipe" and row["points"] == rows["linear"]["points"]
    filtered = files.filter_file(lane(tmp_path / "dense.csv", seconds=10.0), tmp_path / "filtered")
    assert filtered["left_out_points"] == []
