"""Two nodes fit a folder of drives: a small Ray cluster on this machine, used as one of several machines would be.

On two machines: `export RAY_AUTH_MODE=token` and the same `~/.ray/auth_token` on both, `ray start --head --port 6379`
on one, `ray start --address HOST:6379` on the other, then `idm-env fit drives/ --out fit --executor ray --ray-address
HOST:6379` with both folders on a storage that both see. Without a token whoever reaches the port runs code there.
"""

import tempfile
from pathlib import Path

from idm_env.data import synthetic
from idm_env.fitting.job import fit_file
from idm_env.fitting.options import Options, Source
from idm_env.jobs.executor import opened

FILES = ("parameters.parquet", "drivers.csv", "model.yaml")


def fitted(folder: Path, out: Path, kind: str, address: str | None = None) -> list[bytes]:
    """Fit run by run, and return what no executor may change."""
    with opened(kind, address=address) as executor:
        fit_file(Source(folder), Options(starts=1, substeps=1), out, part=3, executor=executor)
    return [(out / name).read_bytes() for name in FILES]


with tempfile.TemporaryDirectory() as place:
    drives = Path(place) / "drives"
    drives.mkdir()
    table = synthetic.generate(5, runs=2, followers=2, seconds=12.0)[0].table
    table.drop("gap_m", "gap_measured").write_parquet(drives / "rows.parquet")
    alone = fitted(drives, Path(place) / "alone", "serial")
    try:
        from ray.cluster_utils import Cluster
    except ImportError:
        print("Fitted here only: ray is not installed (pip install 'idm-env[ray]').")
    else:
        cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
        for _ in range(2):
            cluster.add_node(num_cpus=1)
        together = fitted(drives, Path(place) / "together", "ray", cluster.address)
        cluster.shutdown()
        assert together == alone
        print(f"Two nodes fitted {len(alone[1].splitlines()) - 1} drivers: the same bytes as one process alone.")
