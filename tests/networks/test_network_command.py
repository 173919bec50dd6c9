"""``idm-env network``: what it writes agrees with itself; an interrupted run goes on to the same end."""

from __future__ import annotations

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
