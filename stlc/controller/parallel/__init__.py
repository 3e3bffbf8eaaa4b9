"""Several trainings at a time, or one by several processes: jobs, Ray, ranks."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from stlc.controller.parallel.jobs import Executor


def executor(workers: int = 1, cluster: str | None = None, *, cores: int = 1, gpus: int = 0) -> Executor:
    """The executor of a command: processes of this machine, or a Ray cluster where one is named.

    Args:
        workers: processes at a time, here.
        cluster: its address; None for this machine.
        cores: processors of a job on a cluster, which decides how many run at a time.
        gpus: graphics processors of a job on a cluster.
    """
    if cluster is None:
        from stlc.controller.parallel.jobs import LocalExecutor

        return LocalExecutor(workers)
    from stlc.controller.parallel.ray_cluster import RayExecutor

    return RayExecutor(cluster, cores, gpus)
