"""Published layouts of recordings from above, as files that these tests write by the formats' definitions."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from idm_env.data import DataError, episodes, load
from idm_env.data.load import read

STEPS = 400
TIME = 0.04 * np.arange(STEPS)
SPEED = 20.0 + 2.0 * np.sin(TIME / 3.0)
WAY = np.concatenate([[0.0], np.cumsum(0.02 * (SPEED[1:] + SPEED[:-1]))])
LENGTH, GAP = 4.5, 30.0
"""Two vehicles of 4.5 m, 30 m from bumper to bumper, with the same speed."""


def highd(path: Path) -> None:
    """Two pairs, one to the right and one to the left; x is the corner with the smallest coordinate."""
    parts = []
    for number, (sign, ahead) in enumerate(((1, 0.0), (1, -GAP - LENGTH), (-1, 0.0), (-1, -GAP - LENGTH))):
        front = sign * (200.0 + ahead + WAY)
        parts.append(pl.DataFrame({
            "frame": np.arange(1, STEPS + 1), "id": number + 1, "x": front - LENGTH if sign > 0 else front,
            "y": 10.0, "width": LENGTH, "height": 1.8, "xVelocity": sign * SPEED, "yVelocity": 0.0,
            "precedingId": number if number % 2 else 0, "laneId": 5 if sign > 0 else 2,
        }))  # fmt: skip
    pl.concat(parts).write_csv(path)


def exid(path: Path) -> None:
    """A pair on a straight road at 30°, each with the way since its own beginning."""
    parts = []
    for number, ahead in enumerate((0.0, -GAP - LENGTH)):
        centre = 200.0 + ahead + WAY - LENGTH / 2
        parts.append(pl.DataFrame({
            "recordingId": 3, "trackId": number, "frame": np.arange(STEPS), "xCenter": centre * np.cos(np.pi / 6),
            "yCenter": centre * np.sin(np.pi / 6), "width": 1.8, "length": LENGTH, "lonVelocity": SPEED,
            "traveledDistance": WAY, "leadId": number - 1,
        }))  # fmt: skip
    pl.concat(parts).write_csv(path)


def i24(path: Path) -> None:
    """A pair each way, in feet, back centres, clocks of their own, the second lane from the yellow line."""
    documents = []
    for number, (direction, ahead) in enumerate(((1, 0.0), (1, -GAP - LENGTH), (-1, 0.0), (-1, -GAP - LENGTH))):
        back = 200.0 + ahead + WAY - LENGTH
        documents.append({
            "_id": {"$oid": f"6380{number}"}, "direction": direction,
            "timestamp": (1.6e9 + TIME + 0.013 * number).tolist(),
            "x_position": (direction * back / 0.3048).tolist(), "y_position": [direction * 18.0] * STEPS,
            "length": LENGTH / 0.3048, "width": 6.0, "height": 5.0, "coarse_vehicle_class": 0,
        })  # fmt: skip
    path.write_text(json.dumps([*documents, {"_id": "broken"}]))


@pytest.mark.parametrize(
    ("write", "name", "pairs"), [(highd, "01_tracks.csv", 2), (exid, "03_tracks.csv", 1), (i24, "a.json", 2)]
)
def test_gaps_speeds_and_leaders_are_those_of_the_road(write, name: str, pairs: int, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    """Whatever point of a vehicle, unit, direction and clock the layout has."""
    write(tmp_path / name)
    before = (tmp_path / name).read_bytes()
    trajectories = load(tmp_path / name)
    assert len(trajectories.runs()) == pairs and len(trajectories.followers()) == pairs
    for episode in episodes(trajectories):
        # Clocks that are 13 ms apart are 0.3 m at this speed.
        assert np.abs(episode.gap_m - GAP).max() < (0.35 if write is i24 else 0.01)
        assert np.abs(episode.speed_mps - SPEED[: len(episode)])[5:-5].max() < 0.3
        assert episode.length_m == pytest.approx(LENGTH) and len(episode) >= STEPS - 2
    assert (tmp_path / name).read_bytes() == before


def test_pneuma_gives_tracks(tmp_path: Path) -> None:
    """One vehicle per line, degrees and km/h; broken lines are counted."""
    latitude = 37.98 + np.degrees(WAY / 6_371_000.0)
    cells = np.stack([latitude, np.full(STEPS, 23.73), SPEED * 3.6, TIME * 0, TIME * 0, TIME], 1).ravel()
    line = f"1; Car; {WAY[-1]:.2f}; 70.0; " + "; ".join(f"{x:.9f}" for x in cells) + ";"
    head = "track_id; type; traveled_d; avg_speed; lat; lon; speed; lon_acc; lat_acc; time\n"
    (tmp_path / "p.csv").write_text(head + line + "\n2; Bus; 1; 2; 37.9; 23.7\n")
    table, repairs = read(tmp_path / "p.csv")
    assert np.abs(table["position_m"].to_numpy() - WAY).max() < 0.05
    assert np.abs(table["speed_mps"].to_numpy() - SPEED).max() < 1e-6
    assert {r.kind: r.count for r in repairs} == {"length assumed": 1, "broken line": 1, "no leaders": 1}
    with pytest.raises(DataError, match="nobody follows anybody"):
        load(tmp_path / "p.csv")


def test_what_is_no_file_of_the_layout_is_one_line(tmp_path: Path) -> None:
    """The column that is missing, or what the file is not."""
    highd(tmp_path / "h.csv")
    pl.read_csv(tmp_path / "h.csv").drop("width").write_csv(tmp_path / "w.csv")
    (tmp_path / "x.json").write_text('[{"a": 1}]')
    (tmp_path / "y.json").write_text("[")
    (tmp_path / "z.json").write_text(200_000 * "[")
    for name, told in (
        ("w.csv", "'width' is missing"),
        ("x.json", "no document has _id"),
        ("y.json", "is no JSON"),
        ("z.json", "is no JSON"),
    ):
        with pytest.raises(DataError, match=told):
            load(tmp_path / name)
