"""Roads that a user says: tables of trips, classes, limits, closed lanes, ramps; what cannot be is one line."""

from __future__ import annotations

import csv
import math
from pathlib import Path
from typing import Any

import numpy as np
import polars
import pytest
import torch

from idm_env.model_file import load_environment
from idm_env.multilane import demand
from idm_env.tasks import Draw, Task, make_task, trip_table as table
from idm_env.tasks.open_roads import OpenHighwayTask
from idm_env.tasks.said_roads import KEYS
from idm_env.types import Command, Trips

ROOT = Path(__file__).resolve().parents[2]
ROWS = [
    {"depart": 30.0, "lane": 1, "class": "truck", "destination": "exit"},
    {"depart": 5.0, "lane": 0, "speed": 22.0},
    {"depart": 12.0, "lane": 2, "speed": 25.0, "class": ""},
]
TRUCK = {"truck": {"length": 12.0, "share": 0.25, "parameters": {"idm.desired_speed": 20.0, "idm": {"max_accel": 0.6}}}}
RAMPS: dict[str, Any] = {"lanes_count": 2, "length": 1500.0, "on_ramp": [400.0, 600.0], "off_ramp": [900.0, 1100.0]}


def begun(task: Task, rows: int = 1) -> Any:
    """Return the first states of a task and its parameters."""
    params = task.params(torch.float64, "cpu")
    return task.reset(Draw.of(torch.arange(rows), torch.zeros(rows, dtype=torch.int64)), params).state, params


def test_a_table_is_rows_columns_or_a_file(tmp_path: Path) -> None:
    """The same trips, in the order of departure; speeds that are not said are 20 m/s."""
    pandas = pytest.importorskip("pandas")
    path = tmp_path / "trips.csv"
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, ["depart", "lane", "speed", "class", "destination"])
        writer.writeheader()
        writer.writerows([{"speed": 20.0, **row} for row in ROWS])
    full = [{"speed": 20.0, **row} for row in ROWS]
    frames = pandas.DataFrame(full), polars.DataFrame(full)
    tables = [table.read(x) for x in (full, *frames, path, str(path))]
    assert all(x == tables[0] for x in tables)
    trips = Trips.from_table(pandas.DataFrame(full), torch.float64)
    assert trips.departs.tolist() == [5.0, 12.0, 30.0] and trips.lane.tolist() == [0, 2, 1]
    assert trips.speed.tolist() == [22.0, 25.0, 20.0] and bool(trips.again.isinf().all())
    assert tables[0].kind == ("", "", "truck") and tables[0].destination == ("", "", "exit")


def test_everybody_departs_when_and_as_his_row_says() -> None:
    """Length and parameters are those of the class, and all three are out in the end."""
    rows = [{"speed": 20.0, **row} for row in ROWS]
    task = make_task("open_highway", **RAMPS, trips=rows, classes=TRUCK, controlled=1, spread=0.0)
    state, params = begun(task)
    assert task.vehicles == 3 and state.length.tolist() == [[5.0, 5.0, 12.0]]
    assert params["idm"]["desired_speed"].tolist() == [30.0, 30.0, 20.0]
    assert params["idm"]["max_accel"].tolist() == [1.5, 1.5, 0.6]
    entered = torch.full((3,), -1.0)
    lane = torch.zeros(3, dtype=torch.int64)
    for _ in range(2000):
        state = task.simulator.advance(state, {"control": _nobody(state)}, params)
        now = float(task.simulator.time(state))
        fresh = (state.lanes.trips.entered[0] > 0) & (entered < 0)
        entered[fresh] = now
        lane = torch.where(state.present[0] > 0, state.lanes.lane[0], lane)
    assert torch.allclose(entered, torch.tensor([5.0, 12.0, 30.0]), atol=1.2)
    assert int(demand.counts(task.simulator, state).left) == 3 and lane.tolist()[2] == 0 and lane.tolist()[0] > 0


def _nobody(state: Any) -> Command:
    return Command(state.speed.new_zeros(()), torch.zeros(state.speed.shape[-1], dtype=torch.bool))


def test_demand_by_time_is_a_table() -> None:
    """As many as asked for in each part, the same with the same seed, nobody where there is none."""
    given = {"per_hour": {1: [[0, 1800], [600, 0], [1200, 900]], 2: 1200}, "seconds": 1800.0, "seed": 3}
    made = table.table(**given, classes={"truck": 0.2})
    assert made == table.table(**given, classes={"truck": 0.2}) != table.table(**{**given, "seed": 4})
    first = [t for t, lane in zip(made["depart"], made["lane"], strict=True) if lane == 1]
    assert 270 < sum(t < 600 for t in first) < 330 and 120 < sum(t > 1200 for t in first) < 180
    assert not any(610 < t < 1200 for t in first)
    assert 0.15 < made["class"].count("truck") / len(made["class"]) < 0.25


def test_what_is_not_said_leaves_no_trace() -> None:
    """Classes without a share, limits that nobody reaches and closures later on: states to the last bit."""
    plain = make_task("merge", vehicles=24)
    said = make_task(
        "merge", vehicles=24, classes={"truck": {"share": 0.0, "length": 12.0}}, limits=[{"speed": 99.0}],
        closures=[{"lane": 1, "begin": 100.0, "end": 200.0, "since": 900.0}],
    )  # fmt: skip
    (one, params), (other, own) = begun(plain), begun(said)
    for _ in range(400):
        one = plain.simulator.step(one, {"control": _nobody(one)}, params)
        other = said.simulator.step(other, {"control": _nobody(other)}, own)
    assert torch.equal(one.position, other.position) and torch.equal(one.lanes.lane, other.lanes.lane)


ROW = {"depart": 5.0, "lane": 1}
BAD: dict[str, tuple[str, dict[str, Any]]] = {
    "departs at 700 s, after the end of the episode at 600 s": ("merge", {"trips": [{**ROW, "depart": 700.0}]}),
    "enters on lane 7": ("merge", {"trips": [{**ROW, "lane": 7}]}),
    "destination 'exit'": ("merge", {"trips": [{**ROW, "destination": "exit"}]}),
    "depart = 'soon' of row 0": ("merge", {"trips": [{**ROW, "depart": "soon"}]}),
    "depart = -1": ("merge", {"trips": [{**ROW, "depart": -1.0}]}),
    "lane = 0.5 of row 0": ("merge", {"trips": [{**ROW, "lane": 0.5}]}),
    "column 'departs' is unknown. Did you mean 'depart'": ("merge", {"trips": [{"departs": 1.0, "lane": 1}]}),
    "class 'bus' is unknown": ("merge", {"trips": [{**ROW, "class": "bus"}], "classes": TRUCK}),
    "classes.truck.share = -0.1 must be at least 0": ("merge", {"classes": {"truck": {"share": -0.1}}}),
    "shares of 1.2 in all": ("merge", {"classes": {"a": {"share": 0.7}, "b": {"share": 0.5}}}),
    "parameter 'idm.speed' does not exist": ("merge", {"classes": {"a": {"parameters": {"idm.speed": 3.0}}}}),
    "limits[0].speed = 0": ("merge", {"limits": [{"speed": 0.0}]}),
    "limits[0].lane = 3 does not exist": ("merge", {"limits": [{"speed": 20.0, "lane": 3}]}),
    "must end behind its beginning": ("merge", {"closures": [{"lane": 1, "begin": 300.0, "end": 200.0}]}),
    "nobody gets past 120 m at 30 s": (
        "merge",
        {"closures": [{"lane": k, "begin": 100.0 + 10 * k, "end": 200.0, "since": 15.0 * k} for k in range(3)]},
    ),
    "off_ramp = [500.0, 700.0] must begin behind the end of the on-ramp": (
        "open_highway", {"on_ramp": [400.0, 600.0], "off_ramp": [500.0, 700.0]}),
    "trips = 'none.csv' is not a file": ("merge", {"trips": "none.csv"}),
    "is not CSV in UTF-8": ("merge", {"trips": str(ROOT / "docs" / "ring.gif")}),
    "keyword argument 'lanes'. Did you mean 'lanes_count'": ("approach", {"lanes": 3}),
    "lets nobody depart": ("merge", {"trips": {"per_hour": {1: 0}}}),
    "trips: class 'bus' is unknown. Known: none.": ("merge", {"trips": [{**ROW, "class": "bus"}]}),
    "nobody gets past 700 m at 0 s. Leave a way on.": (
        "bottleneck", {"closures": [{"lane": 1, "begin": 700.0, "end": 750.0}]}),
    "nobody gets past 300 m at 60 s": (
        "merge", {"closures": [{"lane": k, "begin": 300.0, "end": 350.0, "since": 60.0} for k in (1, 2)]}),
    "limits[0].begin = 5000 m must be at most 900": ("merge", {"limits": [{"speed": 20.0, "begin": 5000.0}]}),
    "limits[0].end = 901 m must be at most 900": ("merge", {"limits": [{"speed": 20.0, "end": 901.0}]}),
    "signal.red = 70 s must not exceed signal.cycle = 60 s": ("approach", {"parameters": {"signal": {"red": 70.0}}}),
    "signal.red = 30 s must not exceed signal.cycle = 20 s": ("approach", {"parameters": {"signal.cycle": 20.0}}),
    "signal.red = 50 s must not exceed signal.cycle = 40 s": (
        "approach", {"randomise": {"signal.red": [20.0, 50.0], "signal.cycle": [40.0, 60.0]}}),
    "signal.place must be 500 m": ("approach", {"parameters": {"signal.place": 300.0}}),
    "trips.seconds = 1e+08 s lets 1.39e+07 vehicles depart, of at most 100000": (
        "merge", {"trips": {"per_hour": {1: 500}, "seconds": 1e8}}),
    "trips.seconds = 1e+12 s must be at most 1e+09": ("merge", {"trips": {"per_hour": {1: 500}, "seconds": 1e12}}),
    "trips.per_hour of lane 1 is given twice": ("merge", {"trips": {"per_hour": {1: 500, "1": 600}}}),
    "must rise in time": ("merge", {"trips": {"per_hour": {1: [[300, 500], [0, 900]]}}}),
    "limits = {'speed': 20.0} must be a list": ("merge", {"limits": {"speed": 20.0}}),
    "a name = '' must be a text": ("merge", {"classes": {"": {"share": 0.2}}}),
    "inflow = 0 vehicles an hour must be at least 1": ("approach", {"inflow": 0.0}),
    "off_ramp = [400.0, 400.0] must be [begin, end] (m)": ("open_highway", {"off_ramp": [400.0, 400.0]}),
    "parameters = [] must be a mapping": ("merge", {"parameters": []}),
}  # fmt: skip


def test_a_motorway_in_yaml_is_that_in_python() -> None:
    """configs/motorway.yaml and examples/motorway.py: the same keywords, so the same environment."""
    said: dict[str, Any] = {}
    exec((ROOT / "examples" / "motorway.py").read_text(encoding="utf-8").split("\nenv = ")[0], said)
    given = load_environment(ROOT / "configs" / "motorway.yaml")
    assert given == {"task": "open_highway", "controlled": 1, **said["road"]}


def test_a_destination_behind_the_entry_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a road of one's own: on those of the package every exit is behind every entry."""
    monkeypatch.setattr(OpenHighwayTask, "exits", {"exit": 300.0})
    rows = [{"depart": 1.0, "lane": 0, "destination": "exit"}]
    with pytest.raises(
        ValueError, match=r"row 0, .* has destination 'exit' at 300 m, behind the entry of lane 0 at 400 m"
    ):
        make_task("open_highway", on_ramp=[700.0, 800.0], trips=rows)


def test_two_columns_of_one_name_are_refused(tmp_path: Path) -> None:
    """The last of them must not win."""
    (tmp_path / "trips.csv").write_text("depart,lane,lane\n1.0,0,1\n")
    with pytest.raises(ValueError, match=r"trips\.csv': column 'lane' is there twice\. Remove one\.$"):
        make_task("merge", trips=str(tmp_path / "trips.csv"))
    frame = pytest.importorskip("pandas").DataFrame({"depart": [1.0], "lane": [1]})
    with pytest.raises(ValueError, match=r"^trips: column 'lane' is there twice\. Remove one\.$"):
        make_task("merge", trips=frame[["depart", "lane", "lane"]])


ODD: tuple[Any, ...] = (
    True, math.nan, -math.inf, "no", b"1", [], [1, 2], {"a": 1}, 10**400, -1e300, object(), 1 + 2j, "",
    np.array([1.0, 2.0]), torch.tensor([1.0, 2.0]),
)  # fmt: skip
FITS = {"parameters": ([], {}), "name": ("no",), "class": (math.nan, "", None), "destination": (math.nan, "", None)}
"""Of the odd values, those that a key takes."""
WHOLE: dict[str, dict[str, Any]] = {
    "classes": {"share": 0.2, "length": 12.0, "parameters": {"idm.time_gap": 1.5}},
    "limits": {"lane": 1, "begin": 10.0, "end": 20.0, "speed": 20.0},
    "closures": {"lane": 1, "begin": 10.0, "end": 20.0, "since": 5.0, "until": 9.0},
    "detectors": {"lane": 1, "place": 10.0, "every": 5.0, "name": "one"},
    "trips": {"depart": 5.0, "lane": 1, "speed": 20.0, "class": "", "destination": ""},
    "trips of a demand": {"per_hour": {1: 500}, "seconds": 60.0, "seed": 1, "speed": 20.0, "classes": {},
                          "destinations": {}},
}  # fmt: skip


def nested(name: str, value: Any) -> Task:
    """Return a task with one value of a nested keyword."""
    keyword = name.split(" ")[0]
    if keyword == "classes":
        return make_task("merge", classes={"truck": value})
    return make_task("merge", **{keyword: value if "demand" in name or not isinstance(value, dict) else [value]})


def test_every_key_of_a_nested_keyword_refuses_what_it_does_not_take_by_its_name() -> None:
    """Whatever stands for a value, an entry or the whole; the keyword, one line, and no words of a library."""
    wrong = []
    for name, usual in WHOLE.items():
        nested(name, usual)
        assert "trips" in name or usual.keys() == KEYS[name].keys()
        odd = [
            (f"{name}.{key}", {**usual, key: value})
            for key in usual
            for value in ODD
            if not any(value is x or (type(value) is type(x) and value == x) for x in FITS.get(key, ()))
        ]
        lists = name in ("limits", "closures", "detectors")  # of which an empty one is right
        odd += [(name, value) for value in (*ODD, 1, 0.5) if not (lists and isinstance(value, list) and not value)]
        odd += [(f"{name}: unknown", {**usual, key: 1}) for key in ("x", 3, ("a",))]
        for case, value in odd:
            try:
                nested(name, value)
                wrong.append((case, value, "accepted"))
            except ValueError as error:
                if "\n" in str(error) or not str(error).startswith(name.split(" ")[0]) or len(str(error)) > 400:
                    wrong.append((case, value, error))
            except Exception as error:
                wrong.append((case, value, repr(error)))
    assert not wrong, wrong[:20]


def test_numbers_of_numpy_and_a_mark_before_a_file_are_right(tmp_path: Path) -> None:
    """Python's own and NumPy's say the same; Excel writes a mark (BOM) before the first column."""
    (tmp_path / "trips.csv").write_text("\ufeffdepart,lane,class\n5.0,1,truck\n", encoding="utf-8")
    said = {
        "classes": {"truck": {"share": np.float32(0.25), "length": np.int64(12)}},
        "limits": [{"lane": np.int64(1), "speed": np.float32(20.0)}],
        "closures": [{"lane": np.int32(2), "begin": np.int64(100), "end": np.float64(200.0)}],
        "detectors": [{"lane": np.int8(1), "place": np.float32(100.0)}],
        "controlled": np.int64(1), "max_episode_steps": np.int64(50),
    }  # fmt: skip
    for trips in (
        str(tmp_path / "trips.csv"),
        {"per_hour": {np.int64(1): np.float32(900.0)}, "seconds": np.int64(50), "seed": np.int32(3)},
        [{"depart": np.float32(1.0), "lane": np.int64(1), "class": None}],
    ):
        task = make_task("merge", trips=trips, **said)
        assert task.rules[0].zones[0][:1] == (1.0,) and task.loops[0].lane == 1 and task.horizon == 50
    assert task.kinds == ("",) and make_task("merge", trips=str(tmp_path / "trips.csv"), **said).kinds == ("truck",)


def test_a_road_of_which_one_way_is_left_is_made() -> None:
    """Lanes one after the other, the ramp, a lane for a time: traffic finds its way round."""
    between = [{"lane": 1, "begin": 100.0, "end": 200.0}, {"lane": 2, "begin": 250.0, "end": 300.0}]
    for task, closures in (
        ("merge", between),
        ("merge", [{"lane": 0, "begin": 200.0, "end": 300.0}]),
        ("bottleneck", [{"lane": k, "begin": 200.0, "end": 300.0} for k in (0, 2, 3)]),
        ("merge", [{"lane": k, "begin": 100.0, "end": 200.0, "since": 60.0 * k, "until": 60.0 * k + 60.0}
                   for k in (1, 2)]),
    ):  # fmt: skip
        make_task(task, closures=closures)


@pytest.mark.parametrize("says", BAD)
def test_what_cannot_be_is_one_line_with_its_name(says: str) -> None:
    """Before anything starts."""
    task, given = BAD[says]
    with pytest.raises(ValueError) as error:
        make_task(task, **given)
    text = str(error.value)
    assert "\n" not in text
    assert says in text, text
