"""Parallel training: several runs at a time (local processes, Ray), or one run in several processes."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from stlc.controller.parallel.jobs import Executor


def executor(workers: int = 1, cluster: str | None = None, *, cores: int = 1, gpus: int = 0) -> Executor:
    """Return an executor of training jobs in local processes, or on a Ray cluster if an address is given.

    Args:
        workers: number of local processes.
        cluster: address of the Ray cluster; None: local processes.
        cores: CPUs reserved per job on a cluster, which limits the number of simultaneous jobs.
        gpus: GPUs per job on a cluster.
    """
    if cluster is None:
        from stlc.controller.parallel.jobs import LocalExecutor

        return LocalExecutor(workers)
    from stlc.controller.parallel.ray_cluster import RayExecutor

    return RayExecutor(cluster, cores, gpus)
