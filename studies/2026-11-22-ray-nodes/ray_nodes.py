"""Ray against one process: the same drivers, three nodes of one processor each, bytes and CPU time compared.

    python -m benchmarks.ray_nodes --drivers 100000 --nodes 3 --folder /tmp/drives

Drivers are those of ``benchmarks.larger_than_memory``. Each run is a process of its own, and its CPU time is
that of all processes below it when the work is done: with Ray its servers, agents and workers with their imports, too
(Linux tells). The nodes are on this machine; where it has fewer processors than nodes, wall time says nothing.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from benchmarks.larger_than_memory import FILES, make
from idm_env.executor import Executor, opened
from idm_env.fitting.job import fit_file
from idm_env.fitting.options import Options, Source

ROOT = Path(__file__).resolve().parents[1]


def cpu_seconds() -> float:
    """Return the CPU time of this process and of all below it, those included that have ended and were waited for."""
    spent, above = {}, {}
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            try:
                fields = (folder / "stat").read_text().rpartition(")")[2].split()
            except OSError:  # it has ended meanwhile
                continue
            above[int(folder.name)] = int(fields[1])
            spent[int(folder.name)] = sum(int(x) for x in fields[11:15])
    ours, more = {os.getpid()}, {os.getpid()}
    while more:
        more = {child for child, parent in above.items() if parent in more} - ours
        ours |= more
    return sum(spent[process] for process in ours) / os.sysconf("SC_CLK_TCK")


@contextmanager
def cluster(nodes: int) -> Iterator[Executor]:
    """Give an executor on a head without processors and so many nodes of one each."""
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    from ray.cluster_utils import Cluster

    size = {"object_store_memory": 100_000_000}
    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, **size})
    try:
        for _ in range(nodes):
            made.add_node(num_cpus=1, **size)
        with opened("ray", address=made.address) as executor:
            yield executor
    finally:
        made.shutdown()


def fitted(folder: Path, nodes: int) -> dict[str, float | str]:
    """Fit a folder, here where there are no nodes; return the digest of what must not differ, and CPU seconds."""
    with tempfile.TemporaryDirectory() as place, cluster(nodes) if nodes else opened("serial") as executor:
        out = Path(place) / "fit"
        report = fit_file(Source(folder), Options(starts=1, substeps=1), out, executor=executor)
        digest = hashlib.sha256(b"".join((out / name).read_bytes() for name in FILES)).hexdigest()
        return {"digest": digest, "cpu_s": cpu_seconds(), "groups": report["fit"]["groups"]}


def main() -> None:
    """Fit twice, compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drivers", type=int, default=20_000)
    parser.add_argument("--nodes", type=int, default=3)
    parser.add_argument("--folder", type=Path, default=Path("out/drives"))
    parser.add_argument("--one", type=int, help=argparse.SUPPRESS)  # a run, in a process of its own
    arguments = parser.parse_args()
    if arguments.one is not None:
        print(json.dumps(fitted(arguments.folder, arguments.one)))
        return
    make(arguments.folder, arguments.drivers)
    found = []
    for nodes in (0, arguments.nodes):
        command = [sys.executable, "-m", "benchmarks.ray_nodes", "--folder", str(arguments.folder), "--one", str(nodes)]
        environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "POLARS_MAX_THREADS": "1"}
        done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
        found.append(json.loads(done.stdout.splitlines()[-1]))
        print(f"{nodes or 'no'} nodes: {found[-1]['groups']} drivers, {found[-1]['cpu_s']:.1f} CPU s", flush=True)
    alone, together = found
    same = "the same bytes" if alone["digest"] == together["digest"] else "OTHER BYTES"
    print(f"{same}; Ray takes {100 * (together['cpu_s'] / alone['cpu_s'] - 1):.1f} % more CPU time")


if __name__ == "__main__":
    main()
