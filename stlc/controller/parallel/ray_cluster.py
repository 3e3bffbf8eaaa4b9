"""Tasks of a Ray cluster (`pip install 'stlc[cluster]'`): calls of functions, and training runs."""

from __future__ import annotations

import io
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, redirect_stdout, suppress
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Self, TextIO, cast

from stlc.controller.parallel.bundle import BundleResult, JobBundle, import_run, run_bundle
from stlc.controller.parallel.elsewhere import RemoteCall, RemoteValue, answer
from stlc.controller.parallel.jobs import Job, JobResult
from stlc.controller.parallel.workers import NO_FILES, CallFiles, LostCall
from stlc.diagnostics import Diagnostic, MissingError

LOST = -signal.SIGKILL
"""Exit code of a job whose worker is lost."""

_QUIET = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0"}
_PATIENCE = 60.0
"""Seconds for interrupted trainings to save."""
_AHEAD = 2
"""Submitted calls per CPU of the cluster, so that no worker waits for the next one."""


class RayWorkers:
    """Workers of a Ray cluster, as many at a time as it has CPUs for.

    Args:
        address: address of the cluster; `auto`: the cluster to which this machine belongs; `local`: this
            machine alone.
        cores: CPUs per call.
        gpus: GPUs per call.
    """

    def __init__(self, address: str, cores: int = 1, gpus: int = 0) -> None:
        self._address, self._cores, self._gpus = address, cores, gpus
        self._ray: Any = None
        self._remotes: dict[Callable[[Any], Any], Any] = {}
        self._going: dict[Any, int] = {}
        self._calls: dict[int, RemoteCall] = {}
        self._sends = False
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        """Connect to the cluster.

        Raises:
            MissingError: R301, Ray is not installed; R302, there is no such cluster.
        """
        self._ray = _connected(self._address)
        if sys.stdout is not None:  # closed by the caller
            self._stack.enter_context(redirect_stdout(cast(TextIO, _WithoutNotices(sys.stdout))))
        return self

    def __exit__(self, *_: object) -> None:
        """Disconnect; the cluster ends the calls in progress."""
        self._going.clear()
        try:
            with redirect_stdout(io.StringIO()):  # the last notices
                self._ray.shutdown()
        finally:
            self._stack.close()

    @property
    def size(self) -> int:
        """Number of calls that are made at a time, with the CPUs that the cluster has now."""
        return max(int(self._ray.cluster_resources().get("CPU", 0.0)) // self._cores, 1)

    @property
    def free(self) -> int:
        """Number of calls for which there is room: `_AHEAD` times `size`, less those in progress."""
        return _AHEAD * self.size - len(self._going)

    def submit(
        self, key: int, function: Callable[[Any], Any], argument: object, files: CallFiles = NO_FILES
    ) -> None:
        """Start a call. Once a worker has asked for its files, those of later calls are sent at once."""
        call = RemoteCall.of(function, argument, files)
        self._calls[key] = call
        self.start(key, answer, call.with_files() if self._sends else call)

    def start(self, key: int, function: Callable[[Any], Any], argument: object) -> None:
        """Start a call as it is, in the working directory of the worker."""
        if function not in self._remotes:
            options = {"num_cpus": self._cores, "num_gpus": self._gpus, "max_retries": 0}
            self._remotes[function] = self._ray.remote(function).options(**options)
        self._going[self._remotes[function].remote(argument)] = key

    def result(self) -> tuple[int, Any]:
        """Wait for the end of a call, and return its key with its value or a `LostCall`.

        Raises:
            Exception: what the function raised.
        """
        while True:
            (done, *_), _ = self._ray.wait(list(self._going))
            key = self._going.pop(done)
            call = self._calls.pop(key, None)
            value = self._value(done, raises=call is not None)
            if call is None or not isinstance(value, RemoteValue):
                return key, value
            if not value.missing:
                return key, value.delivered()
            self._calls[key], self._sends = call, True
            self.start(key, answer, call.with_files())

    def recalled(self, patience: float) -> Iterator[tuple[int, Any]]:
        """Ask all calls in progress to end, and yield the results of those that do within `patience` seconds.

        A call that has not begun is dropped; in any other one `KeyboardInterrupt` is raised.
        """
        for task in self._going:
            with suppress(Exception):
                self._ray.cancel(task, force=False)
        going, self._going = self._going, {}
        ended: list[Any] = []
        if going:
            ended, _ = self._ray.wait(list(going), num_returns=len(going), timeout=patience)
        for task in ended:
            with suppress(Exception):
                yield going[task], self._value(task, raises=False)

    def _value(self, task: Any, *, raises: bool) -> Any:
        """Value of a finished task; a `LostCall` if its worker was lost.

        An exception of the function is raised if `raises`; otherwise it counts as a lost worker.
        """
        try:
            return self._ray.get(task)
        except self._ray.exceptions.RayError as error:
            raised = isinstance(error, self._ray.exceptions.RayTaskError)
            if raised and raises:
                raise getattr(error, "cause", error) from error
            lines = [line.strip() for line in str(error).splitlines() if line.strip()]
            return LostCall((lines or [type(error).__name__])[-1 if raised else 0])


@dataclass(frozen=True, slots=True)
class RayExecutor:
    """Executor of jobs as Ray tasks, as many at a time as the cluster has CPUs for.

    Attributes:
        address: address of the cluster, see `RayWorkers`.
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
        going: dict[int, _Sent] = {}
        with RayWorkers(self.address, self.cores, self.gpus) as workers:
            try:
                for key, job in enumerate(jobs):
                    bundle = JobBundle.of(job, self.cores)
                    going[key] = _Sent(job, bundle)
                    workers.start(key, run_bundle, bundle)
                    started(job)
                while going:
                    key, found = workers.result()
                    yield going.pop(key).received(found)
            except BaseException:
                for sent in going.values():
                    sent.bundle.close()
                for key, found in workers.recalled(_PATIENCE):
                    with suppress(Exception):
                        going[key].received(found)
                raise
            finally:
                for sent in going.values():
                    sent.bundle.close()


@dataclass(frozen=True, slots=True)
class _Sent:
    """A submitted job and its bundle."""

    job: Job
    bundle: JobBundle

    def received(self, found: BundleResult | LostCall) -> JobResult:
        """Store the run of a finished job among the caller's runs, and return its result.

        If the job was lost, the result has the exit code `LOST`.
        """
        self.bundle.close()
        if isinstance(found, LostCall):
            return JobResult(self.job, LOST, None, found.reason, 0)
        return import_run(self.job, self.bundle, found)


class _WithoutNotices:
    """Standard output without what threads of Ray print.

    Ray prints notices there, of lost workers for example, which would mix with the results of a command.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        if threading.current_thread().name.startswith("ray_"):
            return len(text)
        return self._stream.write(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


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
