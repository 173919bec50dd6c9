"""Inputs of practitioners' kinds in the folder beside the measured data: each as its row in the README there says."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from idm_env.data import DataError, load
from idm_env.data.joined import joined
from idm_env.data.load import read
from tests.data.tables import kinds

CHAIN = {("0", None), ("1", "0"), ("2", "1")}
NGSIM = {("1", None), ("2", "1"), ("3", "2")}
FCD = {("f.0", None), ("f.1", None), ("f.2", "f.0")}
NAMED = "time_s=timestep_time,vehicle_id=vehicle_id,position_m=vehicle_pos,speed_mps=vehicle_speed"
WIDE = "time_s=t,follower.position_m=x_f,leader.position_m=x_l,leader.length_m=length"
RADAR = "time_s=Time,follower.speed_mps=VehSpd_kph[kph],gap_m=RadarRange_m,range_rate_mps=RangeRate_mps"
PAIR = {("follower", "leader"), ("leader", None)}

READ: dict[str, tuple[str | None, set[tuple[str, str | None]], tuple[float, float], str]] = {
    "sumo_fcd.csv": (None, FCD, (30.5, 30.5), ""),
    "sumo_fcd.csv ": (f"{NAMED},lane=vehicle_lane", FCD, (30.5, 30.5), ""),
    "fcd.xml": (None, FCD, (30.5, 30.5), ""),
    "missing_as_9999.csv": (None, CHAIN, (25.3, 25.7), "position jumps"),
    "ngsim_arterial_names.csv": (None, NGSIM, (17.80, 25.74), ""),
    "ngsim_no_header.csv": (None, NGSIM, (25.58, 25.59), ""),
    "utf16.csv": (None, CHAIN, (25.5, 25.5), ""),
    "excel_sep_line.csv": (None, CHAIN, (25.5, 25.5), ""),
    "comment_lines.csv": (None, CHAIN, (25.5, 25.5), ""),
    "pair_wide.csv": (WIDE, PAIR, (25.0, 25.0), ""),
    "radar_log.csv": (RADAR, PAIR, (23.3, 25.0), ""),
    "vissim.fzp": (None, NGSIM, (25.0, 25.0), ""),
}
"""Options, who follows whom, smallest and largest gap (m), and what is counted."""
REFUSED = {
    "sumo_fcd.csv": (NAMED, ["vehicles overlap in 6 of 12 rows: is a lane missing"]),
    "edge_positions.csv": (None, ["falls in 2 of 3 tracks", "from 200 to 0.2 m within 1 s", "--ring-length"]),
    "interaction_tracks.csv": (None, ["position_m=?", "x and y are two coordinates", "vehicle_id=track_id"]),
    "interaction_tracks.csv ": (
        "vehicle_id=track_id,time_s=timestamp_ms[ms],position_m=x,speed_mps=vx,length_m=length",
        ["x is one of two coordinates", "the way along the road"],
    ),
    "pneuma_slow.csv": (None, ["pNEUMA has no leaders", "filter takes it"]),
    "pair_wide.csv": (None, [f"--pair {WIDE[:27]}", "leader.position_m=x_l"]),
    "radar_log.csv": (None, [f"--pair '{RADAR[:11]}", "follower.speed_mps=VehSpd_kph[kph]"]),
}


@pytest.fixture
def told(measured: Callable[[str], Path]) -> Path:
    folder = measured("ngsim_i80_lanes.parquet").parents[1] / "field_inputs"
    if not folder.is_dir():
        pytest.skip(f"{folder} is not there")
    return folder


@pytest.mark.parametrize("name", READ)
def test_told_inputs_are_read_as_they_are_meant(name: str, told: Path) -> None:
    columns, leaders, (low, high), count = READ[name]
    found = load(told / name.strip(), columns=columns)
    assert set(found.table.select("vehicle_id", "leader_id").rows()) == leaders
    gaps = found.table["gap_m"].drop_nulls()
    assert np.allclose((gaps.min(), gaps.max()), (low, high), atol=0.02), gaps  # type: ignore[arg-type]
    assert not count or kinds(found.repairs)[count] == 1


@pytest.mark.parametrize("name", REFUSED)
def test_told_inputs_are_refused_with_the_cure_that_helps(name: str, told: Path) -> None:
    columns, words = REFUSED[name]
    with pytest.raises(DataError) as caught:
        load(told / name.strip(), columns=columns)
    assert all(word in str(caught.value) for word in words), caught.value
    assert "position_m=x," not in str(caught.value)


def test_the_other_told_inputs(told: Path) -> None:
    again = load(told / "identifier_used_again.csv")
    assert kinds(again.repairs)["track split"] == 1
    way, _ = read(told / "pneuma_slow.csv")
    assert way["position_m"].max() == pytest.approx(11.92, rel=0.02)  # type: ignore[arg-type]
    both = load(joined([told / "folder_of_csv"])).table
    for _, run in both.group_by("run_id"):
        assert set(run.select("vehicle_id", "leader_id").rows()) == CHAIN
    assert both["run_id"].unique().sort().to_list() == ["01_tracks", "02_tracks"]
    lengths = load(told / "ngsim_arterial_names.csv").table["length_m"].unique().sort()
    assert np.allclose(lengths, [4.27, 12.19], atol=0.01)
    speed = load(told / "radar_log.csv", columns=RADAR).table
    assert np.allclose(speed.filter(pl.col("vehicle_id") == "leader")["speed_mps"][0], 10.0 - 0.3)
