"""The measured files that the project is developed with: what must be found in them, and how fast."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from idm_env.data import Trajectories, episodes, load
from idm_env.data.smooth import fuse
from tests.data.tables import kinds

Find = Callable[[str], Path]


def finite_and_consistent(found: object) -> None:
    for episode in found:  # type: ignore[attr-defined]
        for record in (episode, episode.leader, episode.second_leader, episode.behind, episode.adjacent):
            assert np.isfinite(record.position_m).all() and np.isfinite(record.speed_mps).all()
        for values in (episode.gap_m, episode.place_m, episode.leader.accel_mps2, *episode.columns.values()):
            assert np.isfinite(values).all()
        assert (episode.gap_m > 0).all()
        gap = episode.leader.position_m - episode.leader.length_m - episode.position_m
        assert np.abs(gap - episode.gap_m).max() < 1e-9
        assert np.allclose(np.diff(episode.time_s), episode.dt)


def test_pairs(measured: Find) -> None:
    made = load(measured("ngsim_i80_pairs.parquet"))
    found = episodes(made)
    assert len(found) == 228
    assert kinds(found.left_out) == {"gap above 80 m": 19}
    whole = episodes(made, max_gap=None)
    assert len(whole) == 228 and sum(map(len, whole)) == 155297
    finite_and_consistent(found)
    chosen = made.where("in_manifest=true")
    fit, test = chosen.split("split=test")
    assert (len(episodes(fit)), len(episodes(test))) == (100, 20)
    assert {episode.labels["split"] for episode in episodes(test)} == {"test"}


def test_lanes(measured: Find) -> None:
    made = load(measured("ngsim_i80_lanes.parquet"))
    found = episodes(made)
    counts = kinds(found.left_out)
    assert counts["gap not positive"] == 24 and counts["gap above 80 m"] == 9
    assert len({(episode.run_id, episode.vehicle_id) for episode in found}) == 142
    finite_and_consistent(found)


def test_leaders_of_the_lanes_can_be_derived(measured: Find) -> None:
    """The file's leaders are those of a vehicle's whole stay; where it names one, it is mostly the next ahead."""
    table = pl.read_parquet(measured("ngsim_i80_lanes.parquet"))
    named = Trajectories.from_frame(table).table
    derived = Trajectories.from_frame(table.drop("leader_id", "gap_m")).table
    both = named["leader_id"].is_not_null() & derived["leader_id"].is_not_null()
    assert (named["leader_id"] == derived["leader_id"]).filter(both).mean() > 0.95


def test_rawlike(measured: Find) -> None:
    raw = load(measured("ngsim_i80_rawlike.csv.gz"))
    clean = load(measured("ngsim_i80_lanes.parquet"))
    key = pl.col("time_s").round(2).alias("time")
    truth = clean.table.select("vehicle_id", key, x="position_m", v="speed_mps", a="accel_mps2")
    joined = raw.table.with_columns(key).join(truth, on=["vehicle_id", "time"], maintain_order="left")
    assert joined.height == raw.table.height
    error = (joined["position_m"] - joined["x"]).to_numpy()
    assert 0.25 < np.sqrt(np.mean(error**2)) < 0.4
    assert kinds(raw.repairs)["missing row"] == 2
    found = episodes(raw)
    assert len({episode.vehicle_id for episode in found}) == 142
    finite_and_consistent(found)
    errors = []
    for _, track in list(joined.group_by("vehicle_id", maintain_order=True))[:60]:
        if np.allclose(np.diff(track["time_s"]), 0.1):
            motion = fuse(track["position_m"].to_numpy(), track["speed_mps"].to_numpy(), 0.1)
            errors.append((motion.speed - track["v"].to_numpy(), motion.accel - track["a"].to_numpy()))
    speed, accel = (np.concatenate(part) for part in zip(*errors, strict=True))
    assert np.sqrt(np.mean(speed**2)) < 0.25 and np.sqrt(np.mean(accel**2)) < 0.5


def test_zalazone(measured: Find) -> None:
    made = load(measured("openacc_zalazone.parquet"), place="track_s_m")
    found = episodes(made)
    assert len({(episode.run_id, episode.vehicle_id) for episode in found}) == 220
    counts = kinds(found.left_out)
    assert counts["gap not positive"] == 1164 and 8000 < counts["gap above 80 m"] < 9000
    assert all(episode.place_m.min() >= 0 and episode.place_m.max() <= 1840 for episode in found)
    assert {"vehicle_name", "acc_run", "time_gap_setting"} <= set(found[0].labels)
    assert any("grade" in episode.columns for episode in found)
    finite_and_consistent(found)


@pytest.mark.parametrize(("name", "drivers"), [("openacc_astazero.parquet", 28), ("tgsim_pairs.parquet", 91)])
def test_others(measured: Find, name: str, drivers: int) -> None:
    found = episodes(load(measured(name)))
    assert len({(episode.run_id, episode.vehicle_id) for episode in found}) == drivers
    finite_and_consistent(found)
