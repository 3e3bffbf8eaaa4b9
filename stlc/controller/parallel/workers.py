"""Calls of functions in worker processes; a lost worker costs only the calls that it was making.

A call is a function of a module and an argument that can be pickled. Workers are processes of this machine
(`LocalProcesses`) or of a Ray cluster (`stlc.controller.parallel.ray_cluster.RayWorkers`).
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, Generic, Protocol, Self, TypeVar

from stlc.stopping import leaving

ATTEMPTS = 3
"""Number of times that a call is made before it counts as lost."""

A = TypeVar("A")
R = TypeVar("R")


@dataclass(frozen=True, slots=True)
class CallFiles:
    """Files of a call, for workers that do not share the caller's file system.

    Attributes:
        inputs: files and folders that the call reads.
        outputs: files that the call writes.
    """

    inputs: tuple[Path, ...] = ()
    outputs: tuple[Path, ...] = ()


NO_FILES = CallFiles()


@dataclass(frozen=True, slots=True)
class LostCall:
    """Outcome of a call whose worker ended, or could not be reached any more, before it answered.

    Attributes:
        reason: cause in one line.
        attempts: number of times that the call was made.
    """

    reason: str
    attempts: int = 1


@dataclass(frozen=True, slots=True)
class CallResult(Generic[R]):
    """Outcome of a call.

    Attributes:
        index: position of its argument.
        value: value of the function, or the reason for which there is none.
    """

    index: int
    value: R | LostCall


class CallWorkers(Protocol):
    """Interface of worker processes; they exist while the object is entered as a context."""

    def __enter__(self) -> Self:
        """Start the workers, or connect to them."""

    def __exit__(self, *_: object) -> None:
        """End the workers; calls in progress are dropped."""

    @property
    def size(self) -> int:
        """Number of calls that are made at a time."""

    @property
    def free(self) -> int:
        """Number of calls for which there is room."""

    def submit(
        self, key: int, function: Callable[[Any], Any], argument: object, files: CallFiles = NO_FILES
    ) -> None:
        """Start a call; `key` identifies it."""

    def result(self) -> tuple[int, Any]:
        """Wait for the end of a call, and return its key with its value or a `LostCall`.

        An exception that the function raised is raised here.
        """

    def results(
        self,
        function: Callable[[A], R],
        arguments: Iterable[A],
        *,
        files: Callable[[A], CallFiles] = lambda _: NO_FILES,
        attempts: int = ATTEMPTS,
    ) -> Iterator[CallResult[R]]:
        """Call a function for each argument, and yield the results in the order in which the calls end.

        A call whose worker is lost is made again, `attempts` times in all. Arguments are consumed as workers
        become free, so memory does not grow with their number.

        Args:
            function: function of a module.
            arguments: one argument per call.
            files: function that returns the files of the call with a given argument.
            attempts: number of times that a call is made before it counts as lost.
        """
        new = enumerate(arguments)
        again: deque[int] = deque()
        going: dict[int, tuple[A, int]] = {}
        while True:
            while self.free > 0:
                if again:
                    key = again.popleft()
                    argument, tried = going[key]
                elif (fresh := next(new, None)) is not None:
                    key, argument = fresh
                    tried = 0
                else:
                    break
                going[key] = argument, tried + 1
                self.submit(key, function, argument, files(argument))
            if not going:
                return
            key, value = self.result()
            if isinstance(value, LostCall):
                if going[key][1] < attempts:
                    again.append(key)
                    continue
                value = LostCall(value.reason, attempts)
            del going[key]
            yield CallResult(key, value)


# ------------------------------------------------------------------------ this machine


@dataclass(slots=True)
class _LocalWorker:
    """A worker process, the pipe to it, and the key of its call; None while it is idle."""

    process: BaseProcess
    pipe: Connection
    key: int | None = None


class CallError(Exception):
    """Cause of an exception that a function raised in a worker; its text is the traceback there."""


class LocalProcesses(CallWorkers):
    """Up to `count` processes of this machine, each with one call at a time; lost ones are replaced.

    Args:
        count: number of processes.
        fresh: whether processes start with an empty interpreter. By default they are forked where the system
            can do that, which is faster, but not safe after this process has used threads of PyTorch.
    """

    def __init__(self, count: int, *, fresh: bool = False) -> None:
        self._count = count
        self._context = multiprocessing.get_context("spawn" if fresh else None)
        self._workers: list[_LocalWorker] = []
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        """Return the object; processes start when they are needed."""
        self._stack.enter_context(leaving(self._kill))
        return self

    def __exit__(self, *_: object) -> None:
        """Kill all processes."""
        self._kill()
        for worker in self._workers:
            worker.process.join()
            worker.pipe.close()
        self._workers.clear()
        self._stack.close()

    @property
    def size(self) -> int:
        """Number of processes."""
        return self._count

    @property
    def free(self) -> int:
        """Number of further calls that can be made now."""
        return self._count - sum(worker.key is not None for worker in self._workers)

    def submit(
        self,
        key: int,
        function: Callable[[Any], Any],
        argument: object,
        files: CallFiles = NO_FILES,  # noqa: ARG002
    ) -> None:
        """Start a call in an idle process; files are where the caller sees them."""
        worker = next((each for each in self._workers if each.key is None), None) or self._started()
        worker.key = key
        with suppress(BrokenPipeError):  # noticed by `result`
            worker.pipe.send((function, argument))

    def _started(self) -> _LocalWorker:
        near, far = self._context.Pipe()
        process = self._context.Process(target=_serve, args=(far,), daemon=True)
        process.start()
        far.close()
        worker = _LocalWorker(process, near)
        self._workers.append(worker)
        return worker

    def result(self) -> tuple[int, Any]:
        """Wait for the end of a call, and return its key with its value or a `LostCall`.

        Raises:
            Exception: what the function raised; its cause is the traceback in the worker.
        """
        busy = {worker.pipe: worker for worker in self._workers if worker.key is not None}
        worker = busy[wait(list(busy))[0]]  # type: ignore[index]
        key, worker.key = worker.key, None
        assert key is not None
        try:
            raised, value = worker.pipe.recv()
        except (EOFError, OSError):
            self._workers.remove(worker)
            worker.pipe.close()
            worker.process.kill()
            worker.process.join()
            return key, LostCall(end_in_words(worker.process.exitcode or 0))
        if raised is not None:
            raise value from CallError(raised)
        return key, value

    def _kill(self, _code: int = 0) -> None:
        for worker in tuple(self._workers):
            worker.process.kill()


def end_in_words(code: int) -> str:
    """End of a worker process in words, from its exit code; negative if a signal ended it."""
    if code >= 0:
        return f"its process ended with exit code {code}"
    name = signal.Signals(-code).name if -code in {*signal.Signals} else f"signal {-code}"
    memory = ", as the system does for lack of memory" if name == "SIGKILL" else ""
    return f"its process was ended by {name}{memory}"


def _serve(pipe: Connection) -> None:
    """Answer calls until the caller closes the pipe; runs in a worker process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the caller ends its workers
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    while True:
        try:
            function, argument = pipe.recv()
        except (EOFError, OSError):
            os._exit(0)
        try:
            answer: tuple[str | None, Any] = None, function(argument)
        except Exception as error:
            answer = traceback.format_exc(), error
        pipe.send(answer)
