"""Training runs in parallel, each in a process of its own; a run that fails does not affect the others."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from stlc.stopping import CHILD, PATIENCE, leaving
from stlc.toolchain import kill_session

TAIL = 12
"""Number of stored lines of a process's error output."""


@dataclass(frozen=True, slots=True)
class Job:
    """A training job.

    Attributes:
        name: name by which the caller recognises the job.
        arguments: arguments of `stlc train`, without `--json`.
        inputs: input files and folders; they are sent to workers that do not share the file system.
        runs: folder on this machine in which the run is stored, even if another machine trains; None: the
            default folder.
    """

    name: str
    arguments: tuple[str, ...]
    inputs: tuple[Path, ...] = ()
    runs: Path | None = None


@dataclass(frozen=True, slots=True)
class JobResult:
    """Result of a job.

    Attributes:
        job: the job.
        code: exit code; negative if a signal ended the process.
        document: JSON object that `stlc train --json` printed; None if it printed none.
        said: the last lines of the standard error of the process.
        cores: number of cores reserved for the job.
    """

    job: Job
    code: int
    document: dict[str, Any] | None
    said: str
    cores: int

    @classmethod
    def of(cls, job: Job, code: int, outputs: tuple[str, str], share: frozenset[int]) -> JobResult:
        """Result of a process, from its standard output and error, on the cores `share`."""
        document = None
        with suppress(ValueError):
            document = json.loads(outputs[0])
        tail = "\n".join(outputs[1].splitlines()[-TAIL:])
        return cls(job, code, document if isinstance(document, dict) else None, tail, len(share))

    @property
    def result(self) -> dict[str, Any]:
        """The entry `result` of the printed JSON object, which describes the run; empty if there is none."""
        return (self.document or {}).get("result") or {}

    @property
    def why(self) -> str:
        """Cause of a failure: the error messages that the job printed, else the end of its standard error."""
        findings = (self.document or {}).get("diagnostics") or []
        lines = [f"{each['severity']}[{each['code']}]: {each['message']}" for each in findings]
        return "\n".join(lines) or self.said


@dataclass(slots=True)
class LocalExecutor:
    """Executor of up to `workers` local processes at a time; each is pinned to its share of the cores.

    A second interrupt kills all processes. The method `run` of an object may be called only once.
    """

    workers: int
    live: set[subprocess.Popen[str]] = field(default_factory=set)
    stopped: bool = False
    lock: threading.Lock = field(default_factory=threading.Lock)
    shares: SimpleQueue[frozenset[int]] = field(default_factory=SimpleQueue)

    def run(
        self, jobs: Sequence[Job], started: Callable[[Job], None] = lambda _: None
    ) -> Iterator[JobResult]:
        """Run jobs and yield the result of each when it ends.

        When the caller is interrupted or closes the iterator, every job that is still running is asked to
        save and stop, and its end is awaited.

        Args:
            jobs: jobs in the order in which they start.
            started: function that receives each job when it starts; it runs in another thread.
        """
        for share in core_shares(self.workers):
            self.shares.put(share)
        with ThreadPoolExecutor(self.workers) as pool, leaving(self.kill):
            futures = [pool.submit(self.send, job, started) for job in jobs]
            try:
                for future in as_completed(futures):
                    yield future.result()
            except BaseException:
                for future in futures:
                    future.cancel()
                self.stop()
                raise

    def send(self, job: Job, started: Callable[[Job], None]) -> JobResult:
        """Run one job to its end on free cores, and return its result."""
        share = self.shares.get()
        try:
            with self.lock:
                if self.stopped:
                    return JobResult(job, -signal.SIGINT, None, "", len(share))
                process = start(job.arguments, share if self.workers > 1 else None)
                self.live.add(process)
            started(job)
            outputs = process.communicate()
            with self.lock:
                self.live.discard(process)
        finally:
            self.shares.put(share)
        return JobResult.of(job, process.returncode, outputs, share)

    def stop(self) -> None:
        """Ask all processes to save and stop, and wait for them; an interrupt meanwhile kills them."""
        with self.lock:
            self.stopped = True
            going = tuple(self.live)
        try:
            for process in going:
                with suppress(OSError, ValueError):
                    process.send_signal(signal.SIGINT)
            for process in going:
                process.wait()
        except BaseException:
            self.kill()
            raise

    def kill(self, _code: int = 0) -> None:
        """Kill every process and its children."""
        for process in tuple(self.live):
            kill_session(process)


def start(arguments: Sequence[str], share: frozenset[int] | None = None) -> subprocess.Popen[str]:
    """Start a process of `stlc train --json` with pipes for its outputs, and return it.

    Args:
        arguments: arguments of `stlc train`.
        share: cores to which the process is pinned; all if None.
    """
    process = subprocess.Popen(
        [sys.executable, "-m", "stlc", "train", *arguments, "--json"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        encoding="utf-8",
        env={**os.environ, "PYTHONIOENCODING": "utf-8", CHILD: f"{0.7 * PATIENCE}"},
        start_new_session=True,  # Ctrl-C reaches it once, through the caller
    )
    if share and hasattr(os, "sched_setaffinity"):
        with suppress(OSError):
            os.sched_setaffinity(process.pid, share)
    return process


def core_shares(jobs: int) -> list[frozenset[int]]:
    """Equal shares of this process's cores for `jobs` simultaneous jobs.

    With more jobs than cores, every share contains all cores.
    """
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    cores = cores or list(range(os.cpu_count() or 1))
    if jobs > len(cores):
        return [frozenset(cores)] * jobs
    edges = [round(i * len(cores) / jobs) for i in range(jobs + 1)]
    return [frozenset(cores[edges[i] : edges[i + 1]]) for i in range(jobs)]
