"""What practitioners bring, made small: read as it is meant, or refused with the cure that helps; never wrongly."""

from __future__ import annotations

import gzip
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import polars as pl
import pytest

from idm_env.cli import refusals
from idm_env.data import DataError, Trajectories, load
from idm_env.data.load import files_of, read
from idm_env.trajectories.spool import Reading, Spool
from tests.commands import typed
from tests.data.tables import kinds
from tests.test_commands_read_alike import alike, tracks

TIMES = np.arange(6.0)
WAY = 10.0 * TIMES + 0.2 * TIMES**2
SPEED = 10.0 + 0.4 * TIMES
STARTS = (200.0, 170.0, 140.0)


def table(starts: tuple[float, ...] = STARTS) -> pl.DataFrame:
    """Vehicles 0, 1, 2 in one lane, 30 m apart."""
    parts = [
        pl.DataFrame({"vehicle_id": n, "time_s": TIMES, "position_m": start + WAY, "lane": 1})
        for n, start in enumerate(starts)
    ]
    return pl.concat(parts)


def text(mark: str = ",", **options: Any) -> str:
    return table().write_csv(separator=mark, **options)


def moved(vehicle: int, since: float, by: float) -> pl.DataFrame:
    late = (pl.col("vehicle_id") == vehicle) & (pl.col("time_s") >= since)
    return table().with_columns(
        pl.when(late).then(pl.col("position_m") + by).otherwise("position_m").alias("position_m")
    )


def leaders(found: Trajectories) -> set[tuple[str, str | None]]:
    return set(found.table.select("vehicle_id", "leader_id").rows())


CHAIN = {("0", None), ("1", "0"), ("2", "1")}


def as_tracks(path: Path, tmp_path: Path, columns: str | None = None) -> Any:
    return tracks(Spool(path, tmp_path / "spool", 2, Reading(columns=columns)))


def read_alike(path: Path, tmp_path: Path, columns: str | None = None) -> Trajectories:
    """Return what is read of a file, which commands that read it piece by piece read likewise."""
    before = path.read_bytes()
    found = load(path, columns=columns)
    alike(tracks(found), as_tracks(path, tmp_path, columns))
    assert path.read_bytes() == before
    return found


def refused(path: Path, tmp_path: Path, columns: str | None = None) -> str:
    """Return the one line with which a file is refused, whole and piece by piece."""
    told = []
    for reader in (lambda: load(path, columns=columns), lambda: as_tracks(path, tmp_path, columns)):
        with pytest.raises(DataError) as caught:
            reader()
        told.append(str(caught.value))
    assert told[0] == told[1] and "\n" not in told[0]
    return told[0]


@pytest.mark.parametrize("rows", [[8], [8, 9], [6], [11], [0, 8, 16]])
@pytest.mark.parametrize("value", [-9999.0, 9999.0, -1.0, 1e6])
def test_a_number_that_stands_for_no_value_is_no_position(rows: list[int], value: float, tmp_path: Path) -> None:
    numbers = pl.int_range(pl.len()).is_in(rows)
    spoilt = table().with_columns(pl.when(numbers).then(value).otherwise("position_m").alias("position_m"))
    spoilt.write_csv(tmp_path / "a.csv")
    found = load(tmp_path / "a.csv")
    assert kinds(found.repairs)["position jumps"] == len(rows)
    assert found.table["position_m"].is_between(139.0, 256.0).all()
    assert found.table["gap_m"].drop_nulls().is_between(24.0, 27.0).all()
    assert leaders(found) <= {*CHAIN, ("1", None), ("2", None), ("2", "0")}


def test_an_identifier_that_is_used_again_is_two_tracks(tmp_path: Path) -> None:
    moved(1, 3.0, 400.0).write_csv(tmp_path / "a.csv")
    found = read_alike(tmp_path / "a.csv", tmp_path)
    assert kinds(found.repairs)["track split"] == 1
    assert leaders(found) == {("0", None), ("0", "1.1"), ("1", "0"), ("1.1", None), ("2", "0"), ("2", "1")}


def test_leaders_that_a_file_names_are_those_of_the_time(tmp_path: Path) -> None:
    leader = pl.when(pl.col("vehicle_id") > 0).then(pl.col("vehicle_id") - 1)
    moved(1, 3.0, 25.0).filter(pl.col("vehicle_id") < 3).with_columns(leader_id=leader).write_csv(tmp_path / "a.csv")
    found = read_alike(tmp_path / "a.csv", tmp_path)
    assert {("2", "1"), ("2", "1.1")} <= leaders(found)


@pytest.mark.parametrize("fall", [210.0, 20.0])
def test_positions_that_begin_anew_are_asked_about(fall: float, tmp_path: Path) -> None:
    """Along an edge, or on a lap: of some tracks it is told, of one it is counted."""
    pl.concat(
        [moved(0, 1.0, -fall).filter(pl.col("vehicle_id") == 0), moved(1, 4.0, -fall).filter(pl.col("vehicle_id") > 0)]
    ).write_csv(tmp_path / "a.csv")
    told = refused(tmp_path / "a.csv", tmp_path)
    assert "position_m falls in 2 of 3 tracks (vehicle 0 of run 0 at t = 1 s" in told and "--ring-length" in told
    moved(1, 3.0, -fall).write_csv(tmp_path / "b.csv")
    assert kinds(load(tmp_path / "b.csv").repairs)["track split"] == 1


def test_rows_of_many_cars_under_one_name_are_refused(tmp_path: Path) -> None:
    rows = pl.concat([table(tuple(900.0 - 30 * n for n in range(60)))])
    mixed = rows.with_columns(pl.col("vehicle_id").shuffle(seed=1)).unique(
        ["vehicle_id", "time_s"], maintain_order=True
    )
    mixed.write_csv(tmp_path / "a.csv")
    assert "is vehicle_id of one vehicle each?" in refused(tmp_path / "a.csv", tmp_path)


def test_bodies_in_one_place_are_asked_about(tmp_path: Path) -> None:
    """The second lane of a file whose lane is not named."""
    beside = table((197.0, 166.0)).with_columns(pl.col("vehicle_id") + 3)
    pl.concat([table(), beside]).drop("lane").write_csv(tmp_path / "a.csv")
    told = refused(tmp_path / "a.csv", tmp_path)
    assert told.endswith("overlap in 12 of 24 rows: is a lane missing, or is position_m one of two coordinates?")


def test_one_vehicle_that_overlaps_does_not_count_the_file_out(tmp_path: Path) -> None:
    many = table(tuple(900.0 - 30.0 * n for n in range(12)))
    longer = pl.when(pl.col("vehicle_id") == 7).then(29.5).otherwise(4.5)
    behind = pl.when(pl.col("vehicle_id") == 7).then(pl.col("position_m") - 28.0).otherwise("position_m")
    for wrong in (many.with_columns(length_m=longer, position_m=behind), many.with_columns(position_m=behind)):
        wrong.write_csv(tmp_path / "a.csv")
        (said,) = (r for r in read_alike(tmp_path / "a.csv", tmp_path).repairs if r.kind == "one vehicle overlaps")
        assert said.text == "6 rows overlap with vehicle 7 or 8 of run 0: are its length, position and lane right?"


def test_no_measured_file_is_alarmed_about(measured: Callable[[str], Path]) -> None:
    names = [
        "highsim_i75_lanes.parquet", "ngsim_i80_lanes.parquet", "ngsim_i80_pairs.parquet", "ngsim_i80_rawlike.csv.gz",
        "openacc_astazero.parquet", "openacc_zalazone.parquet", "opencf_test_pairs.parquet", "tgsim_pairs.parquet",
        "transfollower_ngsim_pairs.parquet",
    ]  # fmt: skip
    for name in names:
        assert not kinds(load(measured(name)).repairs).keys() & {
            "position jumps",
            "track split",
            "one vehicle overlaps",
        }, name


FCD = pl.DataFrame({
    "timestep_time": np.repeat(TIMES, 3), "vehicle_id": ["f.0", "f.1", "f.2"] * 6,
    "vehicle_x": np.repeat(0.8 * WAY, 3), "vehicle_y": np.repeat(0.6 * WAY, 3), "vehicle_speed": np.repeat(SPEED, 3),
    "vehicle_pos": np.repeat(WAY, 3) + np.tile([200.0, 197.0, 165.0], 6), "vehicle_lane": ["E0_0", "E0_1", "E0_0"] * 6,
})  # fmt: skip
NAMED = "time_s=timestep_time,vehicle_id=vehicle_id,position_m=vehicle_pos,speed_mps=vehicle_speed"


ARTERIAL = [
    "Vehicle_ID",
    "Frame_ID",
    "Tot_Frames",
    "Epoch_ms",
    "Local_X",
    "Local_Y",
    "Global_X",
    "Global_Y",
    "Veh_Len",
    "Veh_Wid",
    "Veh_Class",
    "Veh_Velocity",
    "Vehicle_Acc",
    "Lane_ID",
    "Org_Zone",
    "Dest_Zone",
    "Intersection",
    "Section",
    "Direction",
    "Movement",
    "Preceding_Veh",
    "Following_Veh",
    "Spacing",
    "Headway",
]


def ngsim(lengths: tuple[float, ...], columns: int) -> list[list[float]]:
    """Rows of vehicles 1, 2, 3 in feet and frames; columns by the original files' order."""
    rows = []
    for n, (start, length) in enumerate(zip(STARTS, lengths, strict=True)):
        for time, way, speed in zip(TIMES, WAY, SPEED, strict=True):
            ids = [n + 1, 10 + 10 * time, 60, 1163033200 + 1000 * time]
            head = [*ids, 6.0, (start + way) / 0.3048, 1.0, 1.0, length, 7, 2, speed / 0.3048, 1.3, 1]
            tail = [n, 0, 0, 0]
            rows.append([*head, *([101, 201, 0, 2, 2, 1] if columns == 24 else []), *tail])
    return rows


def test_names_of_the_arterials_of_ngsim_are_read(tmp_path: Path) -> None:
    rows = ngsim((40.0, 14.0, 14.0), 24)
    pl.DataFrame(rows, schema=ARTERIAL, orient="row").with_columns(
        pl.col("Vehicle_ID", "Frame_ID", "Lane_ID", "Preceding_Veh").cast(pl.Int64)
    ).write_csv(tmp_path / "a.csv")
    found = read_alike(tmp_path / "a.csv", tmp_path)
    assert sorted(set(found.table["length_m"].round(2))) == [4.27, 12.19]
    gaps = found.table.filter(pl.col("time_s") == 1.0)["gap_m"]
    assert gaps[1] == pytest.approx(30 - 12.19, abs=0.02) and gaps[2] == pytest.approx(25.73, abs=0.02)
    assert "leaders derived" not in kinds(found.repairs)


def on_a_plane(path: Path, names: tuple[str, ...] = ("track_id", "x", "y", "psi_rad")) -> pl.DataFrame:
    """Two vehicles on a road at 30°, 35 m apart, and one on a road at 75°."""
    parts = []
    for n, (angle, start) in enumerate(((30.0, 200.0), (30.0, 165.0), (75.0, 10.0))):
        a = np.radians(angle)
        parts.append(pl.DataFrame({
            names[0]: n + 1, "frame_id": 1 + 10 * TIMES.astype(int), "timestamp_ms": 100 + (1000 * TIMES).astype(int),
            "agent_type": "car", names[1]: (start + WAY) * np.cos(a), names[2]: (start + WAY) * np.sin(a),
            "vx": SPEED * np.cos(a), "vy": SPEED * np.sin(a), names[3]: a, "length": 4.8, "width": 1.8,
        }))  # fmt: skip
    pl.concat(parts).write_csv(path)
    return pl.concat(parts)


def test_a_cure_never_names_one_of_two_coordinates_nor_a_frame_without_a_rate(tmp_path: Path) -> None:
    on_a_plane(tmp_path / "a.csv", ("track_id", "x", "y", "yaw"))
    told = refused(tmp_path / "a.csv", tmp_path)
    assert "position_m=?" in told and "x and y are two coordinates" in told and "position_m=x" not in told
    pl.DataFrame({"car": [1, 1], "frame": [1, 2], "s": [0.0, 1.0]}).write_csv(tmp_path / "b.csv")
    told = refused(tmp_path / "b.csv", tmp_path)
    assert "time_s=frame[0.04]" in told and "give 1/rate" in told


def test_a_slow_way_of_pneuma_is_that_of_its_speeds(tmp_path: Path) -> None:
    """At 2 m/s and 45°, in degrees of six decimals, between which distances add up to 17 % more."""
    time = np.arange(0, 6.0, 0.04)
    degree = np.degrees(2.0 * time / 6_371_000.0 * np.sqrt(0.5))
    points = zip(37.977 + degree, 23.737 + degree / np.cos(np.radians(37.977)), time, strict=True)
    line = "; ".join(f"{a:.6f}; {b:.6f}; 7.2000; 0.0; 0.0; {t:.6f}" for a, b, t in points)
    head = "track_id; type; traveled_d; avg_speed; lat; lon; speed; lon_acc; lat_acc; time\n"
    (tmp_path / "a.csv").write_text(f"{head}1; Car; 11.92; 7.200000; {line};\n")
    found, _ = read(tmp_path / "a.csv")
    assert found["position_m"].max() == pytest.approx(11.92, rel=0.02)  # type: ignore[arg-type]
    with pytest.raises(DataError, match=r"pNEUMA has no leaders, .*; filter takes it\.$"):
        load(tmp_path / "a.csv")


def test_lanes_that_are_labels_are_lanes(tmp_path: Path) -> None:
    FCD.write_csv(tmp_path / "a.csv", separator=";")
    found = read_alike(tmp_path / "a.csv", tmp_path, f"{NAMED},lane=vehicle_lane")
    assert leaders(found) == {("f.0", None), ("f.1", None), ("f.2", "f.0")}
    assert np.allclose(found.table["gap_m"].drop_nulls(), 30.5)
    told = refused(tmp_path / "a.csv", tmp_path, NAMED)
    assert "vehicles overlap in 6 of 12 rows: is a lane missing" in told


def chain_of(found: Trajectories, gap: float = 25.5) -> None:
    assert leaders(found) == CHAIN
    assert np.allclose(found.table["gap_m"].drop_nulls(), gap, atol=0.01)


def zipped(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.csv", text())


def ends() -> str:
    return text().replace("\n", ",\n")


WRITTEN: dict[str, tuple[str, Callable[[Path], object]]] = {
    "lines above the header": ("a.csv", lambda p: p.write_text("# exported 2024\n# by hand\n" + text())),
    "Excel's line of the mark": ("a.csv", lambda p: p.write_text("sep=;\n" + text(";"))),
    "Unicode text of Excel": ("a.csv", lambda p: p.write_bytes(text("\t").encode("utf-16"))),
    "a byte order mark": ("a.csv", lambda p: p.write_bytes(b"\xef\xbb\xbf" + text().encode())),
    "a mark at the end of rows": ("a.csv", lambda p: p.write_text(ends().replace("lane,", "lane", 1))),
    "tabs": ("a.tsv", lambda p: p.write_text(text("\t"))),
    "a text file": ("a.txt", lambda p: p.write_text(text())),
    "gz of a text file": ("a.txt.gz", lambda p: p.write_bytes(gzip.compress(text().encode()))),
    "zip": ("a.csv.zip", zipped),
    "ends of lines of Windows": ("a.csv", lambda p: p.write_text(text().replace("\n", "\r\n"))),
}


@pytest.mark.parametrize("name", WRITTEN)
def test_a_table_is_read_however_it_is_written(name: str, tmp_path: Path) -> None:
    file, write = WRITTEN[name]
    write(tmp_path / file)
    chain_of(read_alike(tmp_path / file, tmp_path))


REFUSED: dict[str, tuple[str, Callable[[Path], object], str]] = {
    "no header": ("a.csv", lambda p: p.write_text(text().partition("\n")[2]), "the first line holds numbers"),
    "several files in one": (
        "a.zip",
        lambda p: [zipfile.ZipFile(p, "a").writestr(f"{n}.csv", text()) for n in range(2)],
        "holds 2 files",
    ),
    "another xml": ("a.xml", lambda p: p.write_text("<routes><vehicle id='a'/></routes>"), "is XML of <routes>"),
    "half of an xml": ("a.xml", lambda p: p.write_text("<fcd-export><timestep time='0'>"), "is no whole XML"),
    "more cells": (
        "a.csv",
        lambda p: p.write_text(text() + "3,1,2,1,5\n"),
        "line 20 has 5 cells, and the header 4: 3,1",
    ),
    "an open quote": (
        "a.csv",
        lambda p: p.write_text(text() + '3,1,"2,1\n'),
        "line 20 has a quote that does not end: 3",
    ),
    "a sheet": ("a.ods", lambda p: p.write_bytes(b"PK"), "save the sheet as csv"),
    "a workbook": ("a.xlsx", lambda p: p.write_bytes(b"PK"), "save the sheet as csv, or pip install"),
    "no zip": ("a.zip", lambda p: p.write_bytes(b"PK"), "cannot be read"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_read_is_told(name: str, tmp_path: Path) -> None:
    file, write, rule = REFUSED[name]
    write(tmp_path / file)
    assert rule in refused(tmp_path / file, tmp_path)


def sumo_csv(path: Path) -> None:
    FCD.write_csv(path, separator=";")


def sumo_xml(path: Path, head: str = "", more: Mapping[str, str] = MappingProxyType({})) -> None:
    steps = []
    for (time,), rows in FCD.group_by("timestep_time", maintain_order=True):
        cars = "".join(
            f'<vehicle id="{r["vehicle_id"]}" x="1" y="2" speed="{r["vehicle_speed"]}" pos="{r["vehicle_pos"]}" '
            f'lane="{r["vehicle_lane"]}" {more.get(r["vehicle_id"], "")}/>'
            for r in rows.iter_rows(named=True)
        )
        steps.append(f'<timestep time="{time}">{cars}<person id="p" pos="1" edge="E0"/></timestep>')
    content = f"<?xml version='1.0'?>{head}<fcd-export>{''.join(steps)}</fcd-export>".encode()
    path.write_bytes(gzip.compress(content) if path.suffix == ".gz" else content)


@pytest.mark.parametrize(("write", "name"), [(sumo_csv, "a.csv"), (sumo_xml, "a.xml"), (sumo_xml, "a.xml.gz")])
def test_lanes_of_sumo_are_those_of_an_edge(write: Callable[[Path], None], name: str, tmp_path: Path) -> None:
    write(tmp_path / name)
    found = read_alike(tmp_path / name, tmp_path)
    assert leaders(found) == {("f.0", None), ("f.1", None), ("f.2", "f.0")} and found.runs() == ["E0"]
    assert np.allclose(found.table["gap_m"].drop_nulls(), 30.5)


def test_each_edge_of_sumo_is_a_road_of_its_own(tmp_path: Path) -> None:
    """Positions begin anew on the next edge, also on an internal one; leaderID is a leader."""
    late = pl.col("timestep_time") >= 3
    edge = pl.when(late).then(pl.lit(":J0_1_0")).otherwise("vehicle_lane").alias("vehicle_lane")
    back = pl.when(late).then(pl.col("vehicle_pos") - 210.0).otherwise("vehicle_pos").alias("vehicle_pos")
    more = FCD.filter(pl.col("vehicle_id") != "f.1").with_columns(edge, back)
    more.write_csv(tmp_path / "a.csv", separator=";")
    assert read_alike(tmp_path / "a.csv", tmp_path).runs() == [":J0_1", "E0"]
    ahead = pl.when(pl.col("vehicle_id") == "f.2").then(pl.lit("f.0")).otherwise(pl.lit("")).alias("vehicle_leaderID")
    more.with_columns(ahead).write_csv(tmp_path / "c.csv", separator=";")
    assert leaders(load(tmp_path / "c.csv")) == {("f.0", None), ("f.2", "f.0")}


def test_a_workbook_is_read_by_the_library_that_is_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.xlsx").write_bytes(b"PK")
    monkeypatch.setattr(pl, "read_excel", lambda path: table())
    chain_of(read_alike(tmp_path / "a.xlsx", tmp_path))


def test_lengths_of_sumo_are_those_of_its_types_and_gaps_those_that_it_measures(tmp_path: Path) -> None:
    """Types are read from the files that the head of the output names; gaps need no lengths."""
    head = '<!-- <route-files value="r.xml,absent.xml"/> -->'
    (tmp_path / "r.xml").write_text('<routes><vType id="lorry" length="12.0"/><vType id="bus" vClass="bus"/></routes>')
    kind = {"f.0": 'type="lorry"', "f.2": 'type="bus"', "f.1": 'type="DEFAULT_VEHTYPE"'}
    sumo_xml(tmp_path / "a.xml", head, kind)
    found = read_alike(tmp_path / "a.xml", tmp_path).table
    assert dict(found.select("vehicle_id", "length_m").rows()) == {"f.0": 12.0, "f.1": 5.0, "f.2": 12.0}
    assert np.allclose(found["gap_m"].drop_nulls(), 35.0 - 12.0)
    ahead = {"f.0": 'leaderID="" leaderGap="-1"', "f.1": 'leaderID="" leaderGap="-1"'}
    sumo_xml(tmp_path / "b.xml", head, {**ahead, "f.2": 'leaderID="f.0" leaderGap="30.25"'})
    measured = read_alike(tmp_path / "b.xml", tmp_path).table
    assert set(measured["gap_m"].drop_nulls()) == {30.25} and measured["gap_m"].count() == 6


def test_one_coordinate_of_two_is_no_position(tmp_path: Path) -> None:
    """But it is on a straight road along it."""
    both = table().with_columns(y=pl.col("position_m") * 1.0, z=0.5 * pl.col("time_s")).rename({"position_m": "x"})
    both.write_csv(tmp_path / "a.csv")
    assert "x is one of two coordinates" in refused(tmp_path / "a.csv", tmp_path, "position_m=x")
    straight = both.with_columns(y=pl.col("z"))
    straight.write_csv(tmp_path / "b.csv")
    chain_of(read_alike(tmp_path / "b.csv", tmp_path, "position_m=x"))


@pytest.mark.parametrize("columns", [18, 24])
def test_text_files_of_ngsim_have_no_header(columns: int, tmp_path: Path) -> None:
    lines = ["   ".join(f"{x:g}" if x < 1e6 else f"{x:.0f}" for x in row) for row in ngsim((14.5,) * 3, columns)]
    (tmp_path / "trajectories-0400-0415.txt").write_text("\n".join(lines) + "\n")
    found = read_alike(tmp_path / "trajectories-0400-0415.txt", tmp_path)
    assert leaders(found) == {("1", None), ("2", "1"), ("3", "2")}
    assert np.allclose(found.table["gap_m"].drop_nulls(), 30 - 14.5 * 0.3048, atol=0.01)


def test_vehicle_records_of_vissim_are_read(tmp_path: Path) -> None:
    rows = [
        f"{t:.2f};{n + 1};7;1;{start + w:.2f};{3.6 * v:.2f};5.0"
        for t, w, v in zip(TIMES, WAY, SPEED, strict=True)
        for n, start in enumerate(STARTS)
    ]
    head = ["$VISION", "* PTV Vissim", "* km/h", "$VEHICLE:SIMSEC;NO;LANE\\LINK\\NO;LANE\\INDEX;POS;SPEED;LENGTH"]
    (tmp_path / "a.fzp").write_text("\n".join([*head, *rows, ""]))
    found = read_alike(tmp_path / "a.fzp", tmp_path)
    assert leaders(found) == {("1", None), ("2", "1"), ("3", "2")} and found.runs() == ["7"]
    assert np.allclose(found.table["gap_m"].drop_nulls(), 25.0)
    assert abs(found.table["speed_mps"].max() - 12.0) < 1e-6  # type: ignore[operator]


WIDE = pl.DataFrame({
    "t": TIMES, "x_l": 200 + WAY, "x_f": 170 + WAY, "v_l": 3.6 * SPEED, "v_f": 3.6 * SPEED, "len": 5.0,
    "range": 25.0, "rate": 0.0, "trip": "a",
})  # fmt: skip
PAIRED = {
    "both positions": "follower.position_m=x_f,leader.position_m=x_l,leader.length_m=len",
    "both speeds as well": "follower.position_m=x_f,leader.position_m=x_l,leader.length_m=len,"
    "follower.speed_mps=v_f[km/h],leader.speed_mps=v_l[km/h]",
    "own position and gap": "follower.position_m=x_f,gap_m=range,run_id=trip",
    "own speed, range and range rate": "follower.speed_mps=v_f[km/h],gap_m=range,range_rate_mps=rate",
    "own speed and leader's position": "follower.speed_mps=v_f[km/h],leader.position_m=x_l,gap_m=range",
}


@pytest.mark.parametrize("name", PAIRED)
def test_leader_and_follower_in_one_row_are_read_by_one_option(name: str, tmp_path: Path) -> None:
    WIDE.write_csv(tmp_path / "a.csv")
    found = read_alike(tmp_path / "a.csv", tmp_path, f"time_s=t,{PAIRED[name]}").table
    assert set(found.select("vehicle_id", "leader_id").rows()) == {("follower", "leader"), ("leader", None)}
    assert np.allclose(found["gap_m"].drop_nulls(), 25.0) and found["gap_m"].null_count() == 6
    own = found.filter(pl.col("vehicle_id") == "follower")
    assert np.allclose(own["position_m"] - own["position_m"][0], WAY, atol=1e-9)
    if "speed_mps" in PAIRED[name]:
        assert np.allclose(own["speed_mps"], SPEED) and np.allclose(found["speed_mps"].max(), SPEED[-1], atol=0.3)  # type: ignore[arg-type]


def test_nobody_in_the_radar_is_no_leader_and_a_target_has_its_name(tmp_path: Path) -> None:
    seen = WIDE.with_columns(range=pl.Series([25.0, 25, 25, 0, 0, 0]), target=pl.Series([1, 1, 1, 2, 2, 2]))
    seen.write_csv(tmp_path / "a.csv")
    pair = "time_s=t,follower.speed_mps=v_f[km/h],gap_m=range,leader.vehicle_id=target"
    found = read_alike(tmp_path / "a.csv", tmp_path, pair)
    assert kinds(found.repairs)["nobody ahead"] == 3
    assert leaders(found) == {("follower", "1"), ("follower", None), ("1", None)}


HEADERS = {
    "t,x_l,x_f,v_l,v_f,length": {"follower.position_m=x_f", "leader.position_m=x_l", "leader.length_m=length"},
    "Time,VehSpd_kph,RadarRange_m,RangeRate_mps": {"follower.speed_mps=VehSpd_kph[kph]", "gap_m=RadarRange_m"},
    "t,ego_speed,lead_speed,gap": {"follower.speed_mps=ego_speed", "leader.speed_mps=lead_speed", "gap_m=gap"},
    "timestamp,FV_position,LV_position,trip_id": {"run_id=trip_id", "leader.position_m=LV_position"},
}


@pytest.mark.parametrize("header", HEADERS)
def test_the_option_for_a_pair_is_printed_as_it_is_needed(header: str, tmp_path: Path) -> None:
    rows = [[0.5 * i, *(30.0 + 5 * i + n for n in range(header.count(",")))] for i in range(9)]
    (tmp_path / "a.csv").write_text("\n".join([header, *(",".join(map(str, row)) for row in rows)]) + "\n")
    told = refused(tmp_path / "a.csv", tmp_path)
    option = told.partition("--pair ")[2].strip("'")
    assert HEADERS[header] <= set(option.split(",")), told
    assert read(tmp_path / "a.csv", columns=option)[0].height == 18


@pytest.mark.parametrize(
    ("pair", "words"),
    [
        ("time_s=t,follower.position_m=x_f", "names none of leader.position_m and gap_m"),
        ("time_s=t,leader.position_m=x_l", "names none of follower.position_m and follower.speed_mps"),
        ("time_s=t,follower.positon_m=x_f", "did you mean follower.position_m?"),
        ("time_s=t,follower.position_m=x_g,gap_m=range", "no column 'x_g'"),
        ("time_s=t,follower.position_m=x_f[mph],gap_m=range", "has the unit 'mph'"),
    ],
)
def test_half_a_pair_is_refused(pair: str, words: str, tmp_path: Path) -> None:
    WIDE.write_csv(tmp_path / "a.csv")
    assert words in refused(tmp_path / "a.csv", tmp_path, pair)


def test_a_row_of_units_below_the_header_names_the_units(tmp_path: Path) -> None:
    rows = [f"{t:.1f},{3.6 * v:.2f},{25.0 - t / 10:.2f},-0.1" for t, v in zip(TIMES, SPEED, strict=True)]
    file = tmp_path / "can.csv"
    file.write_text("\n".join(["Time,EgoSpeed,ACC_Distance,ACC_RelSpeed", "s,km/h,m,m/s", *rows]) + "\n")
    with pytest.raises(DataError) as caught:
        load(file)
    option = (
        "time_s=Time [s],follower.speed_mps=EgoSpeed [km/h],gap_m=ACC_Distance [m],range_rate_mps=ACC_RelSpeed [m/s]"
    )
    assert f"--pair '{option}'" in str(caught.value)
    speeds = load(file, columns=option).table.filter(vehicle_id="follower")["speed_mps"]
    assert np.allclose(speeds, SPEED, atol=0.01)


VISSIM = "  {:.1f}; {}; 1; 1; {:.3f}; {:.2f};"


@pytest.mark.parametrize(
    ("head", "foot", "speed"),
    [
        ("$VISION\n* POS: Position [ft]\n* SPEED: Speed [mph]\n$VEHICLE:SIMSEC;NO;LANE\\LINK\\NO;LANE\\INDEX;POS;SPEED",
         0.3048, 0.44704),
        ("Vehicle Record\n\nx : Link Coordinate [m]\nv : Speed [km/h]\n\n  t;  VehNr;  Link; Lane;  x;  v;",
         1.0, 1 / 3.6),
    ],
    ids=["feet and miles", "of old"],
)  # fmt: skip
def test_records_of_vissim_have_the_units_that_they_tell(head: str, foot: float, speed: float, tmp_path: Path) -> None:
    rows = [
        VISSIM.format(t, n, (start + x) / foot, v / speed)
        for n, start in enumerate(STARTS) for t, x, v in zip(TIMES, WAY, SPEED, strict=True)
    ]  # fmt: skip
    (tmp_path / "a.fzp").write_text("\n".join([head, *rows]) + "\n")
    found = read_alike(tmp_path / "a.fzp", tmp_path)
    assert leaders(found) == CHAIN and np.allclose(found.table["gap_m"].drop_nulls(), 25.5, atol=0.01)
    assert np.allclose(found.table["speed_mps"].unique().sort(), SPEED, atol=0.01)


def test_a_folder_of_highd_as_it_is_delivered_has_its_tracks(tmp_path: Path) -> None:
    text = "frame,id,x,width,xVelocity,laneId\n" + "".join(
        f"{k},{n},{50 - 20 * n + 0.8 * k},4.5,20,5\n" for n in (0, 1) for k in range(9)
    )
    (tmp_path / "01_tracks.csv").write_text(text)
    (tmp_path / "01_tracksMeta.csv").write_text("id,width,height\n1,4.5,2\n")
    assert files_of([tmp_path]) == [tmp_path / "01_tracks.csv"]
    with pytest.raises(DataError, match="Name the file of tracks beside it"):
        load(tmp_path / "01_tracksMeta.csv")


@pytest.mark.parametrize(
    ("header", "words"),
    [
        ("Fahrzeug;Zeit [s];Weg [m];Geschwindigkeit [km/h];Spur",
         "position_m=Weg [m],lane=Spur,speed_mps=Geschwindigkeit [km/h]"),
        ("oid;ent;laneIndex;xCoord;yCoord;timeSta;speed", "vehicle_id=oid,time_s=timeSta,position_m=?"),
        ("vehicle_id,stamp_ns,s,v", "time_s=stamp_ns[ns],position_m=s"),
        ("id,time,latitude,longitude", "longitude and latitude are two coordinates"),
        ("time,x1,x2,v1,v2", "look like vehicles side by side: give a row per vehicle and time"),
    ],
)  # fmt: skip
def test_a_header_that_is_unknown_is_answered_with_a_line_to_copy(header: str, words: str, tmp_path: Path) -> None:
    cells = len(header.replace(",", ";").split(";"))
    (tmp_path / "a.csv").write_text(f"{header}\n" + (";" if ";" in header else ",").join("1" * cells) + "\n")
    assert words in refused(tmp_path / "a.csv", tmp_path)


@pytest.mark.parametrize(
    ("ending", "cure"), [("mat", "writetable"), ("mf4", "asammdf"), ("ods", "save the sheet as csv")]
)
def test_a_file_of_another_program_is_refused_with_how_to_export_it(ending: str, cure: str, tmp_path: Path) -> None:
    (tmp_path / f"a.{ending}").write_bytes(bytes(9))
    with pytest.raises(DataError, match=cure):
        load(tmp_path / f"a.{ending}")


def test_reading_sumo_s_xml_shows_its_progress(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    vehicles = "".join(
        f'<vehicle id="{n}" pos="{STARTS[n] + x}" speed="{v}" lane="e_0"/>' for n in range(3) for x, v in [(0.0, 10.0)]
    )
    steps = "".join(f'<timestep time="{t}">{vehicles}</timestep>' for t in 0.1 * np.arange(200))
    (tmp_path / "fcd.xml").write_text(f"<fcd-export>{steps}</fcd-export>")
    monkeypatch.setattr(refusals, "LARGE_BYTES", 10_000)
    size = (tmp_path / "fcd.xml").stat().st_size
    done = typed("plot", tmp_path / "fcd.xml", "--out", tmp_path / "a.png")
    assert done.returncode == 0 and f"reading {size}/{size} in " in done.stderr
