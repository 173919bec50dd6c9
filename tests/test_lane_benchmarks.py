"""What figures on several lanes rest on: demand that rises evenly, breakdowns that are found, rows that are kept."""

from __future__ import annotations

import argparse
from pathlib import Path

import pytest
import torch

from benchmarks import lanes_capacity, workers
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
    flow = [3000] * 21 + [2800] * 5 + [2700] * 15 + [9999] * 19
    assert lanes_capacity.broken(speed) == 21
    assert lanes_capacity.drops([{"flow": flow, "speed": speed}]) == [(3000.0, 2700.0, 3000.0)]
    assert lanes_capacity.drops([{"flow": flow, "speed": [25.0] * 60}]) == []


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
    for work in (_squared, _refused):
        assert workers.named(work, rows, tmp_path / "out" / "rows.jsonl", given) == {"two": 4, "three": 9}
