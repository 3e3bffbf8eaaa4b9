"""Training runs as tasks of a Ray cluster (`pip install 'stlc[cluster]'`)."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from stlc.controller.parallel.bundle import JobBundle, import_run, run_bundle
from stlc.controller.parallel.jobs import Job, JobResult
from stlc.diagnostics import Diagnostic, MissingError

LOST = -signal.SIGKILL
"""Exit code of a job whose worker is lost."""

_QUIET = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0"}
_PATIENCE = 60.0
"""Seconds for interrupted trainings to save."""


@dataclass(frozen=True, slots=True)
class RayExecutor:
    """Executor of jobs as Ray tasks, as many at a time as the cluster has CPUs for.

    Attributes:
        address: address of the cluster; `auto`: the cluster to which this machine belongs; `local`: this
            machine alone.
        cores: CPUs per job.
        gpus: GPUs per job.
    """

    address: str
    cores: int = 1
    gpus: int = 0

    def run(
        self, jobs: Sequence[Job], started: Callable[[Job], None] = lambda _: None
    ) -> Iterator[JobResult]:
        """Run jobs, store their runs in the jobs' folders, and yield the result of each when it ends.

        When the caller is interrupted or closes the iterator, running jobs are asked to save and stop, and
        the runs that they save are stored in the same way.

        Raises:
            MissingError: R301, Ray is not installed; R302, there is no such cluster.
        """
        ray = _connected(self.address)
        going: dict[Any, _Sent] = {}
        try:
            remote = ray.remote(run_bundle).options(num_cpus=self.cores, num_gpus=self.gpus, max_retries=0)
            for job in jobs:
                bundle = JobBundle.of(job, self.cores)
                going[remote.remote(bundle)] = _Sent(job, bundle)
                started(job)
            while going:
                (done, *_), _ = ray.wait(list(going))
                yield _received(ray, done, going.pop(done))
        except BaseException:
            _call_back(ray, going)
            raise
        finally:
            for sent in going.values():
                sent.bundle.close()
            ray.shutdown()


@dataclass(frozen=True, slots=True)
class _Sent:
    """A submitted job and its bundle."""

    job: Job
    bundle: JobBundle


def _connected(address: str) -> Any:
    """Connect to the cluster at `address` and return the module `ray`.

    Raises:
        MissingError: R301, Ray is not installed; R302, there is no such cluster.
    """
    os.environ.update({key: value for key, value in _QUIET.items() if key not in os.environ})
    try:
        ray = import_module("ray")
    except ModuleNotFoundError:
        message = "`--cluster` needs ray, which is not installed"
        raise MissingError(Diagnostic("R301", message, help=("pip install 'stlc[cluster]'",))) from None
    try:
        ray.init(address=address, log_to_driver=False, logging_level="error", ignore_reinit_error=True)
    except (ConnectionError, ValueError, RuntimeError, OSError) as error:
        reason = str(error).strip().splitlines()[:1]
        raise MissingError(
            Diagnostic(
                "R302",
                f"there is no cluster at `{address}`",
                note=tuple(reason),
                help=("`ray start --head` begins one", "`--cluster local` is one of this machine alone"),
            )
        ) from error
    return ray


def _received(ray: Any, done: Any, sent: _Sent) -> JobResult:
    """Fetch the result of the finished Ray task `done` and store its run among the caller's runs.

    If the task was lost (a worker failed), the result has the exit code `LOST`.
    """
    try:
        found = ray.get(done)
    except ray.exceptions.RayError as error:
        said = str(error).strip().splitlines()[-1:]
        return JobResult(sent.job, LOST, None, "".join(said), 0)
    finally:
        sent.bundle.close()
    return import_run(sent.job, sent.bundle, found)


def _call_back(ray: Any, going: dict[Any, _Sent]) -> None:
    """Ask the running jobs `going` (Ray task -> job) to save and stop, and store the runs that they saved."""
    for each, sent in going.items():
        sent.bundle.close()
        with suppress(Exception):
            ray.cancel(each, force=False)
    ended, _ = ray.wait(list(going), num_returns=len(going), timeout=_PATIENCE) if going else ([], [])
    for each in ended:
        with suppress(Exception):
            _received(ray, each, going.pop(each))
