"""Parallel training: local jobs, Ray, and several ranks for one training."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from stlc.controller.parallel.jobs import Executor


def executor(workers: int = 1, cluster: str | None = None, *, cores: int = 1, gpus: int = 0) -> Executor:
    """Executor of a command: local processes, or a Ray cluster if an address is given.

    Args:
        workers: number of local processes.
        cluster: its address; None for this machine.
        cores: CPUs per job on a cluster, which limits how many run at a time.
        gpus: GPUs per job on a cluster.
    """
    if cluster is None:
        from stlc.controller.parallel.jobs import LocalExecutor

        return LocalExecutor(workers)
    from stlc.controller.parallel.ray_cluster import RayExecutor

    return RayExecutor(cluster, cores, gpus)
