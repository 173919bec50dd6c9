"""Headers of other people: names, units, separators, decimal commas and clocks, in every reader."""

from __future__ import annotations

import importlib
import re
import shlex
from collections.abc import Callable
from pathlib import Path

import polars as pl
import pytest

from idm_env.data import DataError, Trajectories, folder, load
from idm_env.data.names import guessed
from idm_env.trajectories.spool import Reading, Spool
from tests.data.tables import platoon
from tests.test_commands_read_alike import COMMANDS, alike, read, tracks  # noqa: F401

OTHERS = {
    "vehicle_id": "car", "time_s": "t", "position_m": "x[ft]", "speed_mps": "Speed (km/h)", "leader_id": "ahead",
    "length_m": "l", "run_id": "trip", "lane": "Lane No.",
}  # fmt: skip
TEXT = "time=t,vehicle_id=car,position_m=x[ft],speed=Speed (km/h),leader=ahead,length=l,run=trip,lane=Lane No."
EXPECTED = tracks(Trajectories.from_frame(platoon()))


def foreign() -> pl.DataFrame:
    factors = {"position_m": 1 / 0.3048, "speed_mps": 3.6}
    table = platoon().with_columns(pl.col(name) * factor for name, factor in factors.items())
    return table.rename({"position_m": "x"} | {k: v for k, v in OTHERS.items() if k != "position_m"})


@pytest.fixture
def path(tmp_path: Path) -> Path:
    foreign().write_csv(tmp_path / "foreign.csv")
    return tmp_path / "foreign.csv"


@pytest.mark.parametrize(
    ("columns", "rule"),
    [
        (["time_s=t"], "is no text such as"),
        ({"time_s": 3}, "is no text such as"),
        (7, "is no text such as"),
        ("time_s=t,time=x", "time_s is given twice, as 't' and 'x'"),
        ("position_m=x[1e999]", "has the unit '1e999'"),
        ("position_m=x[1e-999]", "has the unit '1e-999'"),
    ],
)
def test_columns_that_say_nothing_are_one_line(path: Path, columns: object, rule: str) -> None:
    with pytest.raises(DataError, match=re.escape(rule)) as caught:
        load(path, columns=columns)  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)


def test_a_column_called_as_a_pattern_is_a_column(tmp_path: Path) -> None:
    platoon().rename({"position_m": "^.*$", "length_m": "*"}).write_csv(tmp_path / "a.csv")
    found = load(tmp_path / "a.csv", columns="position_m=^.*$,length_m=*")
    alike(tracks(found), EXPECTED)
    assert (found.table["length_m"] == 4.0).all()


@pytest.mark.parametrize(("zone", "hours"), [("", 0), ("Z", 0), ("+02:00", -2), ("-0230", 2.5), ("+05", -5)])
def test_times_with_an_offset_are_of_one_clock(zone: str, hours: float) -> None:
    moment = pl.format("2024-05-01T12:30:{}{}", (pl.col("time_s") + 10).round(1).cast(pl.String), pl.lit(zone))
    found = Trajectories.from_frame(platoon().with_columns(time_s=moment)).table["time_s"][0]
    assert found == 1714566610.0 + 3600 * hours


@pytest.mark.parametrize("columns", [TEXT, OTHERS])
def test_columns_are_read_under_their_names_and_in_their_units(path: Path, columns: object) -> None:
    before = path.read_bytes()
    loaded = load(path, columns=columns)  # type: ignore[arg-type]
    alike(tracks(loaded), EXPECTED)
    assert abs(loaded.table["speed_mps"].max() - 13.0) < 1e-6  # type: ignore[operator]
    said = [repair.text for repair in loaded.repairs if repair.kind == "column named"]
    assert "Column 'x' was read as position_m (× 0.3048)." in said and len(said) == len(OTHERS)
    assert path.read_bytes() == before


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_takes_them(command: str, read: Callable[..., object], path: Path) -> None:  # noqa: F811
    alike(read(command, path, "--columns", TEXT), EXPECTED)


def test_a_folder_takes_them(path: Path, tmp_path: Path) -> None:
    (tmp_path / "all").mkdir()
    foreign().write_parquet(tmp_path / "all" / "1.parquet")
    (share,) = folder.shares(tmp_path / "all", 100, TEXT)
    alike(tracks(share.trajectories()), EXPECTED)
    alike(tracks(Spool(tmp_path / "all", tmp_path / "spool", 2, Reading(columns=TEXT))), EXPECTED)


@pytest.mark.parametrize(
    ("columns", "told"),
    [
        ("time_s", "is no text such as time_s=t"),
        ("time_s=t,", "is no text such as time_s=t"),
        ("tmie=t", "'tmie' is no column that is read; did you mean 'time'?"),
        ("time_s=tt,vehicle=car,position=x", "there is no column 'tt' for time_s"),
        ("time_s=t,vehicle=cars,position=x", "did you mean 'car'?"),
        ("time_s=t,vehicle=car,position=x[yards]", "has the unit 'yards'; use one of m, ft"),
        ("time_s=t[m],vehicle=car,position=x", "has the unit 'm'; use one of s"),
        ("time_s=t,vehicle=car[m],position=x", "has the unit 'm'; leave it out"),
        ("time_s=t,vehicle=car,position=trip[ft]", "position_m = 'a' in row 1 is not a number"),
        ("time_s=t,vehicle=car", "column 'position_m' is missing"),
    ],
)
def test_what_names_no_column_is_one_line(path: Path, tmp_path: Path, columns: str, told: str) -> None:
    for reader in (load, lambda given, columns: Spool(given, tmp_path / "spool", 2, Reading(columns=columns))):
        with pytest.raises(DataError) as caught:
            reader(path, columns=columns)
        assert told in str(caught.value) and "\n" not in str(caught.value)
    with pytest.raises(DataError, match="Leave one of them out"):
        load(path, layout="ngsim", columns=TEXT)


@pytest.mark.parametrize(
    ("header", "option"),
    [
        (["car", "t", "x_ft"], "vehicle_id=car,time_s=t,position_m=x_ft[ft]"),
        (["Vehicle ID", "Time [ms]", "Position (m)"], "vehicle_id=Vehicle ID,time_s=Time [ms],position_m=Position (m)"),
        (["track_id", "timestamp", "station", "velocity_kmh", "preceding_id", "lane_index"],
         "vehicle_id=track_id,time_s=timestamp,position_m=station,leader_id=preceding_id,lane=lane_index,"
         "speed_mps=velocity_kmh[kmh]"),
        (["a", "b"], "vehicle_id=?,time_s=?,position_m=?"),
    ],
)  # fmt: skip
def test_an_unknown_header_is_answered_with_a_line_to_copy(tmp_path: Path, header: list[str], option: str) -> None:
    pl.DataFrame({name: [1.0] for name in header}).write_csv(tmp_path / "a.csv")
    with pytest.raises(DataError) as caught:
        load(tmp_path / "a.csv")
    assert str(caught.value).endswith(f"Name them: {guessed(header)}")
    assert guessed(header) == f"--columns {shlex.quote(option)}"


def test_the_line_to_copy_is_read(tmp_path: Path) -> None:
    ours = {"vehicle_id": "Car", "time_s": "Time [ms]", "position_m": "X (ft)", "leader_id": "Leader"}
    table = platoon().select(*ours).with_columns(pl.col("time_s") * 1e3, pl.col("position_m") / 0.3048).rename(ours)
    table.write_csv(tmp_path / "a.csv")
    with pytest.raises(DataError) as caught:
        load(tmp_path / "a.csv")
    option = str(caught.value).split("--columns ")[1].strip("'")
    alike(
        tracks(load(tmp_path / "a.csv", columns=option)),
        {("0", vehicle): rows for (_, vehicle), rows in EXPECTED.items()},
    )


@pytest.mark.parametrize("mark", [";", "\t"])
@pytest.mark.parametrize("comma", [True, False])
def test_semicolons_tabs_and_decimal_commas(
    tmp_path: Path, mark: str, comma: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(importlib.import_module("idm_env.data.load"), "BATCH_BYTES", 3000)
    platoon().write_csv(tmp_path / "a.csv", separator=mark, decimal_comma=comma)
    alike(tracks(load(tmp_path / "a.csv")), EXPECTED)
    alike(tracks(Spool(tmp_path / "a.csv", tmp_path / "spool", 2)), EXPECTED)


@pytest.mark.parametrize("how", ["clock", "comma", "date", "iso", "datetime", "time"])
def test_times_may_be_clocks_and_dates(tmp_path: Path, how: str) -> None:
    date = pl.datetime(2024, 5, 1, 12, 59, 55) + pl.duration(
        microseconds=(pl.col("time_s") * 1e6).round().cast(pl.Int64)
    )
    told = {
        "clock": date.dt.strftime("%H:%M:%S%.3f"), "comma": date.dt.strftime("%H:%M:%S%.3f").str.replace(r"\.", ","),
        "date": date.dt.strftime("%Y-%m-%d %H:%M:%S%.3f"), "iso": date.dt.strftime("%Y-%m-%dT%H:%M:%S%.3fZ"),
        "datetime": date, "time": date.dt.time(),
    }[how]  # fmt: skip
    platoon().with_columns(time_s=told).write_parquet(tmp_path / "a.parquet")
    loaded, clean = load(tmp_path / "a.parquet"), Trajectories.from_frame(platoon())
    start = 1714568395.0 if how in ("date", "iso", "datetime") else 46795.0
    assert loaded.steps == clean.steps
    moved = loaded.table.with_columns((pl.col("time_s") - start).round(5))
    assert moved["time_s"].to_list() == pytest.approx(clean.table["time_s"].to_list(), abs=1e-5)
    assert moved["position_m"].to_list() == pytest.approx(clean.table["position_m"].to_list())


@pytest.mark.parametrize("word", ["Space", "Spatial"])
def test_pairs_of_ultra_av_are_a_leader_and_a_follower(tmp_path: Path, word: str) -> None:
    """Positions there are of centres; the gap is the file's, and both have the mean length."""
    table = platoon(vehicles=2)
    first, second = (table.filter(pl.col("vehicle_id") == n) for n in (1, 2))
    pl.DataFrame({
        "Trajectory_ID": 7, "Time_Index": first["time_s"], "ID_LV": -1, "Pos_LV": first["position_m"] - 2.0,
        "Speed_LV": first["speed_mps"], "ID_FAV": 3, "Pos_FAV": second["position_m"] - 2.0,
        "Speed_FAV": second["speed_mps"], f"{word}_Gap": first["position_m"] - 4.0 - second["position_m"],
        f"{word}_Headway": first["position_m"] - second["position_m"],
    }).write_csv(tmp_path / "pairs.csv")  # fmt: skip
    loaded = load(tmp_path / "pairs.csv")
    expected = {("7", vehicle): rows for (_, vehicle), rows in tracks(Trajectories.from_frame(table)).items()}
    alike(tracks(loaded), expected)
    assert loaded.table["length_m"].unique().to_list() == pytest.approx([4.0])
    assert loaded.table.filter(pl.col("vehicle_id") == "2")["gap_m"].to_list() == pytest.approx([16.0] * 100)
    assert loaded.where("vehicle_name=3").drivers is None or loaded.where("vehicle_name=3").followers() == [("7", "2")]
    alike(tracks(Spool(tmp_path / "pairs.csv", tmp_path / "spool", 2)), expected)
