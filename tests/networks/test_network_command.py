"""``idm-env network``: what it writes agrees with itself; an interrupted run goes on to the same end."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from PIL import Image
from typer.testing import CliRunner

from idm_env.cli import commands as cli
from idm_env.fitting import network_job
from idm_env.fitting.network_job import simulate_network
from idm_env.jobs.storage import Store
from idm_env.roads.network import Network
from tests.networks.written import write_net

ROUTES = (
    '<routes><vType id="t" carFollowModel="IDM" accel="1.4" decel="2" speedDev="0"/>'
    '<flow id="a" type="t" from="left0A0" to="A0right0" begin="0" end="300" vehsPerHour="300" departSpeed="max"/>'
    '<flow id="b" type="t" from="bottom0A0" to="A0left0" begin="0" end="300" period="30" departSpeed="max"/></routes>'
)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Return a crossing and its demand."""
    folder = tmp_path_factory.mktemp("network")
    (folder / "my.rou.xml").write_text(ROUTES)
    return write_net(folder / "my.net.xml", Network.crossing()), folder / "my.rou.xml"


def tables(out: Path) -> dict[str, pl.DataFrame]:
    """Return what was written."""
    return {name: pl.read_csv(out / f"{name}.csv", glob=False) for name in network_job.TABLES}


def test_its_files_agree(files: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Everybody arrives, no sooner than at the limits; counts over time are of the trips; pictures are pictures."""
    monkeypatch.setattr(network_job, "FRAMES", 24)  # drawing one takes as long as 20 s of traffic
    result = simulate_network(files[0], [files[1]], tmp_path)
    rows = tables(tmp_path)
    trips, times = rows["trips"], rows["over_time"]
    assert result["vehicles"] == result["arrived"] == len(trips) == 35
    assert sorted(trips["id"]) == sorted([*(f"a.{k}" for k in range(25)), *(f"b.{k}" for k in range(10))])
    first = trips.filter(pl.col("id") == "b.1").row(0, named=True)
    assert (first["from"], first["due_s"]) == ("bottom0A0", 30.0)
    assert (trips["travel_time_s"] >= trips["free_time_s"]).all()
    assert (trips["arrived_s"] - trips["due_s"] - trips["travel_time_s"]).abs().max() <= 0.1
    assert result["travel_time_s"] == pytest.approx(trips["travel_time_s"].mean())
    for row in times.iter_rows(named=True):
        assert row["due"] == row["inside"] + row["arrived"] + row["queued"]
        assert row["arrived"] == (trips["arrived_s"] <= row["time_s"]).sum()
    links = rows["links"]
    assert links["link"].to_list() == list(Network.crossing().names)
    # Vehicle-seconds on links are those inside: a sample every 5 s.
    inside = links["mean_vehicles"].sum() * result["seconds"]
    assert inside == pytest.approx((trips["arrived_s"] - trips["entered_s"]).sum(), rel=0.05)
    with Image.open(tmp_path / "map.png") as drawn, Image.open(tmp_path / "animation.gif") as moving:
        assert np.asarray(drawn.convert("RGB")).std() > 5.0
        assert getattr(moving, "n_frames", 1) > 10
    assert "Longest queues" in (tmp_path / "report.html").read_text()


def test_a_standstill_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Four streams go round a block of short roads, which they fill."""
    monkeypatch.setattr(network_job, "FRAMES", 4)
    net = write_net(tmp_path / "my.net.xml", Network.grid(2, 2, block=40.0, arm=60.0, control="priority"))
    block = ["A0B0", "B0B1", "B1A1", "A1A0"]
    ends = [("left0A0", "A1left1"), ("bottom1B0", "A0bottom0"), ("right1B1", "B0right0"), ("top0A1", "B1top1")]
    ways = [[ends[k][0], *(block[(k + i) % 4] for i in range(3)), ends[k][1]] for k in range(4)]
    flows = [
        f'<flow id="{k}" begin="0" end="60" period="4"><route edges="{" ".join(way)}"/></flow>'
        for k, way in enumerate(ways)
    ]
    (tmp_path / "my.rou.xml").write_text(f"<routes>{''.join(flows)}</routes>")
    result = simulate_network(net, [tmp_path / "my.rou.xml"], tmp_path / "out", seconds=200.0)
    assert result["arrived"] < 60 and result["deadlocked"] > 3
    assert f"; {result['deadlocked']} wait for one another for ever." in result["sentence"]


def test_a_network_without_shapes_is_refused_at_once(files: tuple[Path, Path], tmp_path: Path) -> None:
    """A map needs them, and comes last."""
    bare = tmp_path / "bare.net.xml"
    bare.write_text(re.sub(r' shape="[^"]*"', "", files[0].read_text()))
    phases: list[str] = []
    with pytest.raises(ValueError, match=r"^link '.*' has no shape, and a map needs one\. Give every lane a shape\.$"):
        simulate_network(bare, [files[1]], tmp_path / "out", on_progress=lambda phase, *_: phases.append(phase))
    assert set(phases) == {"reading"}


def test_an_interrupted_run_goes_on(files: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """To the same files, bit by bit, and without doing again what was kept."""
    monkeypatch.setattr(network_job, "KEPT_S", 60.0)
    monkeypatch.setattr(network_job, "FRAMES", 4)
    simulate_network(files[0], [files[1]], tmp_path / "whole", seconds=200.0)
    done: list[int] = []

    def stop(phase: str, count: int, total: int, words: Any = "") -> None:
        if phase == "simulating":
            done.append(count)
            if count == 30 and len(done) == 30:
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate_network(files[0], [files[1]], tmp_path / "cut", seconds=200.0, on_progress=stop)
    simulate_network(files[0], [files[1]], tmp_path / "cut", seconds=200.0, resume=True, on_progress=stop)
    assert done == [*range(1, 31), *range(25, 41)]
    for name in network_job.TABLES:
        assert (tmp_path / "cut" / f"{name}.csv").read_bytes() == (tmp_path / "whole" / f"{name}.csv").read_bytes()
    with pytest.raises(ValueError, match="was left by a run on other data or options"):
        store = tmp_path / "cut" / "idm-env-unfinished" / "network"
        Store(store, "other", False)
        simulate_network(files[0], [files[1]], tmp_path / "cut", seconds=100.0, resume=True)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["{0}", "missing.rou.xml"], "missing.rou.xml' is no file"),
        (["{1}", "{1}"], "my.rou.xml begins with <routes>"),
        (["{0}", "{0}"], "my.net.xml begins with <net>"),
        (["{0}", "{1}", "--seconds", "0"], "--seconds = 0 s is outside"),
    ],
)
def test_bad_input_ends_in_one_line(
    words: list[str], told: str, files: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    command = [word.format(*files) for word in words]
    result = CliRunner().invoke(cli.app, ["network", *command, "--out", str(tmp_path / "out")])
    assert result.exit_code != 0 and told in f"{result.exception} {result.output}"
