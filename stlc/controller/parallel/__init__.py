"""Parallel work: calls and training runs, here or on a Ray cluster; one run in several processes."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from stlc.controller.parallel.jobs import LocalExecutor
    from stlc.controller.parallel.ray_jobs import RayExecutor
    from stlc.controller.parallel.workers import CallWorkers


def executor(
    workers: int = 1, cluster: str | None = None, *, cores: int = 1, gpus: int = 0
) -> LocalExecutor | RayExecutor:
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
    from stlc.controller.parallel.ray_jobs import RayExecutor

    return RayExecutor(cluster, cores, gpus)


def workers_of(
    count: int = 1, cluster: str | None = None, *, fresh: bool = False, files: Sequence[Path] = ()
) -> CallWorkers:
    """Return workers that call functions: local processes, or a Ray cluster if an address is given.

    Args:
        count: number of local processes.
        cluster: address of the Ray cluster; None: local processes.
        fresh: whether local processes start with an empty interpreter, see `LocalProcesses`.
        files: files and folders that calls read, sent to every machine of a cluster.
    """
    if cluster is None:
        from stlc.controller.parallel.workers import LocalProcesses

        return LocalProcesses(count, fresh=fresh)
    from stlc.controller.parallel.ray_cluster import RayWorkers

    return RayWorkers(cluster, files=files)
