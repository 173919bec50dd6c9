"""Ray, on a cluster of four nodes on this machine: nodes, workers and whoever asked may go, the bytes stay the same."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import polars as pl
import pytest

from idm_env.data import synthetic
from idm_env.fitting.job import fit_file
from idm_env.fitting.options import Options, Source
from idm_env.jobs import executor, storage
from idm_env.jobs.progress import OnProgress
from tests.test_executor import Part, square

ROOT = Path(__file__).resolve().parents[1]
FILES = ("parameters.parquet", "drivers.csv", "model.yaml")

try:
    import ray
    from ray.cluster_utils import Cluster
except ImportError:
    warnings.warn("ray is not installed (pip install 'idm-env[ray]'): its tests are skipped", stacklevel=1)
    pytest.skip("ray is not installed", allow_module_level=True)

# Ray's own sockets and log files are closed by its processes' ends.
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """A head without processors, which only keeps the books, and three nodes of one each."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        patch.setenv("RAY_memory_monitor_refresh_ms", "0")  # a full machine is another test's affair
        patch.setenv("PYTHONPATH", str(ROOT))
        size = {"object_store_memory": 80_000_000}
        patience = {
            "health_check_initial_delay_ms": 1000,
            "health_check_period_ms": 1000,
            "health_check_failure_threshold": 3,
        }
        made = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "_system_config": patience, **size})
        for _ in range(3):
            made.add_node(num_cpus=1, **size)
        yield made
        ray.shutdown()
        made.shutdown()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six generated runs of two followers, 12 s, in two files."""
    path = tmp_path_factory.mktemp("data") / "drive"
    path.mkdir()
    table = synthetic.generate(5, runs=6, followers=2, seconds=12.0)[0].table.drop("gap_m", "gap_measured")
    for number, rows in enumerate(table.iter_slices(1 + table.height // 2)):
        rows.write_parquet(path / f"{number}.parquet")
    return path


def fitted(path: Path, out: Path, kind: str = "serial", address: str | None = None, **more: Any) -> dict[str, bytes]:
    """Fit run by run and return the bytes of what was found."""
    with executor.opened(kind, address=address) as workers:
        fit_file(Source(path), Options(starts=2, substeps=1), out, part=3, executor=workers, **more)
    return {name: (out / name).read_bytes() for name in FILES}


def node_and_wait(part: Part, on_progress: OnProgress) -> str:
    """Leave the name of the node that works on a part, and wait for the word to go; the node it names waits on."""
    node = str(ray.get_runtime_context().get_node_id())
    (part.folder / f"{part.number}-on-{node}-{time.monotonic_ns()}").touch()
    go = part.folder / "go"
    while not go.exists() or go.read_text() == node:
        time.sleep(0.02)
    return node


def test_a_cluster_of_this_machine_is_heard_by_nobody_else(tmp_path: Path) -> None:
    """Whatever of it listens does so on 127.0.0.1, and asks for a token."""
    code = (
        "import os, sys; from pathlib import Path; from idm_env.jobs import executor\n"
        "from tests.test_executor import Part, square\n"
        "if sys.argv[2] == 'imported': import ray\n"
        "with executor.opened('ray', 1) as run:\n"
        "    assert list(run.map(square, [Part(3, Path(sys.argv[1]))])) == [(0, 9)]\n"
        "    import psutil; me = psutil.Process(); family = {p.pid for p in (me, *me.children(recursive=True))}\n"
        "    heard = {c.laddr.ip for c in psutil.net_connections('inet') if c.status == 'LISTEN' and c.pid in family}\n"
        "    print(sorted(heard), os.environ.get('RAY_AUTH_MODE'))\n"
    )
    environment = {k: v for k, v in os.environ.items() if not k.startswith("RAY_")} | {"PYTHONPATH": str(ROOT)}
    for when in ("new", "imported"):
        done = subprocess.run([sys.executable, "-c", code, str(tmp_path), when], env=environment, capture_output=True,
                              text=True)  # fmt: skip
        *heard, mode = done.stdout.strip().replace("::ffff:", "").split(" ")
        assert set(re.findall(r"[\d.:]+", " ".join(heard))) == {"127.0.0.1"} and mode in ("token", "None"), done.stderr
        assert when == "imported" or mode == "token"


def test_workers_that_die_are_replaced_and_the_part_that_raises_is_named(cluster: Any, tmp_path: Path) -> None:
    """A worker killed with −9 costs nothing but its time; the others do not wait for a part that cannot be done."""
    wrong = {1: "dies once", 3: "raise"}
    parts = [Part(i, tmp_path, wrong.get(i, "")) for i in range(8)]
    found = []
    told = r"1 of 8 parts failed \(driver 3: ZeroDivisionError: no gap\)"
    with executor.opened("ray", address=cluster.address) as run, pytest.raises(executor.PartsError, match=told):
        found.extend(run.map(square, parts))
    assert sorted(found) == [(i, i**2) for i in range(8) if i != 3]
    full = [Part(i, tmp_path / "full", "full") for i in range(8)]
    (tmp_path / "full").mkdir()
    with executor.opened("ray", address=cluster.address) as run, pytest.raises(OSError, match="No space left"):
        list(run.map(square, full))


def test_a_node_that_is_removed_without_grace_loses_nothing_and_bytes_are_those_of_one_process(
    cluster: Any, folder: Path, tmp_path: Path
) -> None:
    """Its parts are done elsewhere."""
    marks = tmp_path / "marks"
    marks.mkdir()
    removed: list[str] = []

    def remove() -> None:
        until = time.monotonic() + 600
        try:
            while not (begun := sorted(marks.glob("*-on-*"))) and time.monotonic() < until:
                time.sleep(0.02)
            removed.append(begun[0].name.split("-")[2])
            node = next(node for node in cluster.worker_nodes if node.node_id == removed[0])
            cluster.remove_node(node, allow_graceful=False)
        finally:  # whoever waits must not wait for ever
            (marks / "told").write_text(removed[0] if removed else "nobody")
            (marks / "told").rename(marks / "go")

    remover = threading.Thread(target=remove)
    remover.start()
    with executor.opened("ray", address=cluster.address) as run:
        found = dict(run.map(node_and_wait, [Part(i, marks) for i in range(5)]))
    remover.join()
    assert sorted(found) == list(range(5)) and removed[0] not in found.values()
    assert len(list(marks.glob("*-on-*"))) > 5  # what the lost node had begun was done again
    assert fitted(folder, tmp_path / "ray", "ray", cluster.address) == fitted(folder, tmp_path / "serial")


def test_whoever_asked_may_be_killed_and_goes_on_with_another_executor(
    cluster: Any, folder: Path, tmp_path: Path
) -> None:
    """What was finished is not done again, and the bytes are those of an undisturbed run."""
    code = (
        "import sys; from pathlib import Path; from tests.test_ray import fitted\n"
        "fitted(Path(sys.argv[1]), Path(sys.argv[2]), 'ray', sys.argv[3])"
    )
    out = tmp_path / "out"
    kept = out / storage.UNFINISHED / "fit-parts"
    asked = subprocess.Popen(
        [sys.executable, "-c", code, str(folder), str(out), cluster.address],
        env=os.environ | {"PYTHONPATH": str(ROOT)}, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
    )  # fmt: skip
    until = time.monotonic() + 120
    while len(list(kept.glob("[0-9]*.kept"))) < 2 and time.monotonic() < until and asked.poll() is None:
        time.sleep(0.01)
    asked.send_signal(signal.SIGKILL)
    asked.wait()
    before = {path.name: path.stat().st_mtime_ns for path in kept.glob("[0-9]*.kept")}
    assert 2 <= len(before) <= 6
    seen: list[tuple[int, int]] = []

    def watch(phase: str, done: int, total: int, words: float | str = "") -> None:
        if phase == "parts":
            seen.append((done, total))

    assert fitted(folder, out, resume=True, on_progress=watch) == fitted(folder, tmp_path / "serial")
    assert len(seen) == 6 - len(before)
    assert pl.read_csv(out / "drivers.csv").n_unique(["run_id", "vehicle_id"]) == 12
