"""Where the parts of long work run, as a command line says it: read before anything that does them is imported."""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

if TYPE_CHECKING:
    from idm_env.jobs.executor import Executor

Kind = Literal["serial", "processes", "ray"]


@dataclass(frozen=True)
class Workers:
    """Where the parts of long work run; no result depends on it.

    Args:
        executor: Where parts of the work run: serial, processes or ray. Results are the same.
        jobs: Parts that run at a time, one thread each; default: one per processor.
        ray_address: Address of a Ray cluster, host:port or auto; default: Ray on this machine.
    """

    executor: Kind = "serial"
    jobs: Annotated[int | None, (1, 1e5)] = None  # where it may lie
    ray_address: str | None = None

    def opened(self) -> AbstractContextManager[Executor]:
        """Return the executor of the parts, for a ``with``."""
        from idm_env.jobs.executor import opened

        return opened(self.executor, self.jobs, self.ray_address)


HERE, IN_PROCESSES = Workers(), Workers("processes")
