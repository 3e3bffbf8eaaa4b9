"""Workers of a Ray cluster (extra `cluster`)."""

from __future__ import annotations

import io
import os
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, redirect_stdout, suppress
from pathlib import Path
from typing import Any, Self, TextIO, cast

from stlc.controller.parallel.elsewhere import RemoteCall, RemoteValue, answer, linked
from stlc.controller.parallel.workers import NO_FILES, CallFiles, CallWorkers, LostCall
from stlc.diagnostics import MissingError
from stlc.extras import needed

_QUIET = {"RAY_USAGE_STATS_ENABLED": "0", "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0"}
_AHEAD = 2
"""Submitted calls per CPU of the cluster, so that no worker waits for the next one."""

_RECOUNT = 1.0
"""Seconds after which the CPUs of the cluster are counted again."""


class RayWorkers(CallWorkers):
    """Workers of a Ray cluster, as many at a time as it has CPUs for.

    Args:
        address: address of the cluster; `auto`: the cluster to which this machine belongs; `local`: this
            machine alone.
        cores: CPUs per call.
        gpus: GPUs per call.
        files: files and folders that calls read, sent to every machine of the cluster.
    """

    def __init__(self, address: str, cores: int = 1, gpus: int = 0, files: Sequence[Path] = ()) -> None:
        self._address, self._cores, self._gpus, self._files = address, cores, gpus, files
        self._ray: Any = None
        self._answer: Any = None
        self._linked: Mapping[str, str] = {}
        self._going: dict[Any, int] = {}
        self._calls: dict[int, RemoteCall] = {}
        self._sends = False
        self._size, self._counted = 1, -_RECOUNT
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        """Connect to the cluster, and hand it the files.

        Raises:
            MissingError: R301, Ray is not installed; R302, there is no such cluster, or it does not take the
                files, which are too large.
            RunError: R110, a folder of a run contains a link.
        """
        ray = sys.modules.get("ray")
        with tempfile.TemporaryDirectory(prefix="stlc-") as folder:
            if ray is None or not ray.is_initialized():  # a connection that is there keeps its own folder
                self._linked = linked(self._files, Path(folder))
            self._ray = _connected(self._address, folder if self._linked else None)
        options = {"num_cpus": self._cores, "num_gpus": self._gpus, "max_retries": 0}
        self._answer = self._ray.remote(answer).options(**options)
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
        now = time.monotonic()
        if now > self._counted + _RECOUNT:
            cpus = int(self._ray.cluster_resources().get("CPU", 0.0))
            self._counted, self._size = now, max(cpus // self._cores, 1)
        return self._size

    @property
    def free(self) -> int:
        """Number of calls for which there is room: `_AHEAD` times `size`, less those in progress."""
        return _AHEAD * self.size - len(self._going)

    def submit(
        self, key: int, function: Callable[[Any], Any], argument: object, files: CallFiles = NO_FILES
    ) -> None:
        """Start a call. Once a worker has asked for its files, those of later calls are sent at once."""
        call = RemoteCall.of(function, argument, files, self._linked)
        self._start(key, call.with_files() if self._sends else call)

    def _start(self, key: int, call: RemoteCall) -> None:
        self._calls[key] = call
        self._going[self._answer.remote(call)] = key

    def result(self) -> tuple[int, Any]:
        """Wait for the end of a call, and return its key with its value or a `LostCall`.

        Raises:
            Exception: what the function raised.
        """
        key, found = self.answered(raises=True)
        return key, found if isinstance(found, LostCall) else found.delivered()

    def answered(self, *, raises: bool = False) -> tuple[int, RemoteValue | LostCall]:
        """Wait for the end of a call, and return its key with the answer of the worker.

        An exception of the function is raised if `raises`; otherwise it counts as a lost worker.
        """
        while True:
            (done, *_), _ = self._ray.wait(list(self._going))
            key = self._going.pop(done)
            call = self._calls.pop(key)
            found = self._value(done, raises=raises)
            if isinstance(found, LostCall) or not found.missing:
                return key, found
            self._sends = True
            self._start(key, call.with_files())

    def recalled(self, patience: float) -> Iterator[tuple[int, RemoteValue | LostCall]]:
        """Ask all calls in progress to end, and yield the answers of those that do within `patience` seconds.

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

    def _value(self, task: Any, *, raises: bool) -> RemoteValue | LostCall:
        """Answer of a finished task; a `LostCall` if its worker was lost.

        An exception of the function is raised if `raises`; otherwise it counts as a lost worker.
        """
        try:
            found: RemoteValue = self._ray.get(task)
            return found
        except self._ray.exceptions.RayError as error:
            raised = isinstance(error, self._ray.exceptions.RayTaskError)
            if raised and raises:
                raise getattr(error, "cause", error) from error
            lines = [line.strip() for line in str(error).splitlines() if line.strip()]
            return LostCall((lines or [type(error).__name__])[-1 if raised else 0])


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


def _connected(address: str, folder: str | None) -> Any:
    """Connect to the cluster at `address` and return the module `ray`.

    `folder`: files for the working directories of the workers; None if there are none.

    Raises:
        MissingError: R301, Ray is not installed; R302, there is no such cluster, or it refuses the files.
    """
    os.environ.update({key: value for key, value in _QUIET.items() if key not in os.environ})
    ray = needed("ray", "`--cluster` needs")
    settings = {"log_to_driver": False, "logging_level": "error", "ignore_reinit_error": True}
    environment = None if folder is None else {"working_dir": folder}
    try:
        ray.init(address=address, runtime_env=environment, **settings)
    except ray.exceptions.RuntimeEnvSetupError as error:
        ray.shutdown()
        message = f"the cluster at `{address}` does not take the input files"
        raise _no_cluster(message, str(error).partition("\n")[2]) from error
    except (ConnectionError, ValueError, RuntimeError, OSError) as error:
        raise _no_cluster(
            f"there is no cluster at `{address}`",
            str(error),
            "`ray start --head` begins one",
            "`--cluster local` is one of this machine alone",
            "if the cluster asks for a token, set RAY_AUTH_MODE=token",
        ) from error
    return ray


def _no_cluster(message: str, reason: str, *ways_out: str) -> MissingError:
    return MissingError.of("R302", message, note=tuple(reason.strip().splitlines()[:1]), help=ways_out)
