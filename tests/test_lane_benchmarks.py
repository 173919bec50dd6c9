"""What figures on several lanes rest on: demand that rises evenly, breakdowns that are found, rows that are kept."""

from __future__ import annotations

import argparse
from pathlib import Path

import pytest
import torch

from benchmarks import lanes, lanes_capacity, workers
from benchmarks.lanes_sumo import Edge, net
from idm_env.progress import OnProgress


@pytest.mark.parametrize("alike", [True, False])
def test_demand_rises_evenly(alike: bool) -> None:
    trips = lanes_capacity.departures(3, alike)
    first, last = lanes_capacity.FIRST, lanes_capacity.LAST
    for minute in (20, 40, 60):
        expected = minute / 60.0 * (first + 0.5 * (last - first) * minute / lanes_capacity.MINUTES)
        found = int((trips.departs < 60.0 * minute).sum())
        assert abs(found - expected) <= (3.0 if alike else 4.0 * expected**0.5)
    assert float((trips.lane == 0).double().mean()) == pytest.approx(lanes_capacity.RAMP, abs=0.02)
    assert torch.equal(trips.departs, trips.departs.sort().values)


def test_a_breakdown_is_counted_before_and_after_it() -> None:
    speed = [25.0] * 19 + [5.0, 25.0] + [5.0] * 39  # a minute that is slow by itself is no breakdown
    # Behind the ramp less flows some minutes before speed falls upstream of it: these do not count as "before".
    flow = [3000] * 16 + [2800] * 10 + [2700] * 15 + [9999] * 19
    assert lanes_capacity.broken(speed) == 21
    assert lanes_capacity.drops([{"flow": flow, "speed": speed}]) == [(3000.0, 2700.0, 3000.0)]
    assert lanes_capacity.drops([{"flow": flow, "speed": [25.0] * 60}]) == []


@pytest.mark.parametrize(("breaks", "counted"), [(6, 0), (12, 0), (13, 1), (50, 1)])
def test_a_breakdown_that_nothing_can_be_counted_before_is_too_early(breaks: int, counted: int) -> None:
    """It was looked for from minute 10 on, so that a jam that stood already was counted as flow before."""
    run = {"flow": [3000] * 60, "speed": [25.0] * breaks + [5.0] * (60 - breaks), "queued": 0}
    assert lanes_capacity.broken(run["speed"]) == breaks
    assert len(lanes_capacity.drops([run])) == counted
    row = lanes_capacity._row("name", [run])
    assert row[1:3] == ["1 of 1", str(1 - counted)]
    assert row[-2] == ("+0.0 %" if counted else "–")


def test_rows_have_a_cell_per_column() -> None:
    calm = {"flow": [3000] * 60, "speed": [25.0] * 60, "queued": 0}
    early = {"flow": [3000] * 60, "speed": [5.0] * 60, "queued": 0}
    for runs in (None, [calm], [early]):
        assert len(lanes_capacity._row("name", runs)) == len(lanes_capacity.COLUMNS)
    assert lanes_capacity._row("name", [calm])[3] == "3000 in the hour"


def test_lanes_go_on_where_the_next_edge_has_them() -> None:
    road = net([Edge("a", "m", "n", 3, 0.0, 100.0), Edge("b", "n", "o", 2, 100.0, 200.0, right=1)])
    links = [f'from="a" to="b" fromLane="{i}" toLane="{j}"' for i in range(3) for j in range(2)]
    assert [text in road for text in links] == [False, False, True, False, False, True]


def _squared(part: int, on_progress: OnProgress) -> int:
    return part * part


def _refused(part: int, on_progress: OnProgress) -> int:
    raise AssertionError("was done before")


def test_rows_are_kept_and_not_done_again(tmp_path: Path) -> None:
    given = argparse.Namespace(executor="serial", jobs=None, ray_address=None)
    rows = {"two": 2, "three": 3}
    at = tmp_path / "out" / "rows.jsonl"
    for work in (_squared, _refused):
        assert workers.named(work, rows, at, given) == {"two": 4, "three": 9}
    with pytest.raises(AssertionError, match="was done before"):
        workers.named(_refused, {"two": 5}, at, given)  # the same name, other settings
    assert workers.named(_squared, {"two": 5, "three": 3}, at, given) == {"two": 25, "three": 9}
    assert workers.named(_refused, {"two": 5, "three": 3}, at, given) == {"two": 25, "three": 9}
    at.write_text('{"name": "three", "found": 7}\n')  # as files were written before
    assert workers.named(_squared, rows, at, given) == {"two": 4, "three": 9}


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("laws x", "'laws x': 'x' is no number of 1000 or more. Usual is laws 1e+09."),
        ("laws nan", "'laws nan': 'nan' is no number of 1000 or more. Usual is laws 1e+09."),
        ("flow fast", "'flow fast': 'fast' is unknown. Leave it out."),
        ("merge published", "'merge published': 'published' is unknown. Leave it out."),
        ("capacity 3", "'capacity 3': '3' is unknown. Leave it out."),
        ("speed rings", "'speed rings': 'rings' is unknown. Take rollouts or highway, or leave it out."),
        ("merge --executor processes", "'merge' runs in one piece: leave out --executor, --jobs and --ray-address."),
        ("laws --jobs 2", "'laws' runs in one piece: leave out --executor, --jobs and --ray-address."),
    ],
)
def test_what_would_not_be_heeded_is_refused_in_one_line(
    words: str, says: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["lanes", *words.split()])
    with pytest.raises(SystemExit, match="2"):
        lanes.main()
    assert capsys.readouterr().err.splitlines()[-1].endswith(says)
