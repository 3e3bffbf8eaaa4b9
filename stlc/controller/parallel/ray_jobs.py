"""Training runs on a Ray cluster; runs come back from machines that do not share the caller's folders."""

from __future__ import annotations

import os
import secrets
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

from stlc.cache import Unusable, private
from stlc.controller.parallel.elsewhere import RemoteValue, absolute
from stlc.controller.parallel.jobs import Job, JobResult, start
from stlc.controller.parallel.ray_cluster import RayWorkers
from stlc.controller.parallel.workers import CallFiles, LostCall
from stlc.files import RECORD, File
from stlc.rundir import RunDir

LOST = -9
"""Exit code of a job whose worker is lost, as after SIGKILL."""
_OTHER_VERSION = 5
_PATIENCE = 60.0
"""Seconds for interrupted trainings to save."""


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
            MissingError: R201, the folder of the runs cannot be written; R301, Ray is not installed; R302,
                there is no such cluster.
            RunError: R110, the folder of a run contains a link.
        """
        inputs = [path for job in jobs for path in job.inputs]
        with RayWorkers(self.address, self.cores, self.gpus, inputs) as workers, _probes(jobs) as probes:
            try:
                for key, job in enumerate(jobs):
                    probe = probes[_runs(job)]
                    own = tuple(path for path in job.inputs if (path / RECORD).is_file())
                    files = CallFiles((*job.inputs, probe), (_runs(job), *own))
                    workers.submit(key, trained, TrainingCall(job, self.cores, probe), files)
                    started(job)
                for _ in jobs:
                    key, found = workers.answered()
                    yield received(jobs[key], found)
            except BaseException:
                _delete(probes)
                for key, found in workers.recalled(_PATIENCE):
                    with suppress(Exception):
                        received(jobs[key], found)
                raise


def _runs(job: Job) -> Path:
    return absolute(job.runs or RunDir.RUNS)


@contextmanager
def _probes(jobs: Sequence[Job]) -> Iterator[Mapping[Path, Path]]:
    """Context with a probe file in each folder of runs; yields folder -> probe.

    Only machines that share the file system of this one see the probe file. When it is deleted, they save and
    stop the jobs.

    Raises:
        MissingError: R201, a folder cannot be written.
    """
    probes: dict[Path, Path] = {}
    try:
        for folder in dict.fromkeys(map(_runs, jobs)):
            probes[folder] = folder / f".probe-{secrets.token_hex(8)}"
            with File(probes[folder]).replaced() as written:
                written.touch()
        yield probes
    finally:
        _delete(probes)


def _delete(probes: Mapping[Path, Path]) -> None:
    for probe in probes.values():
        with suppress(OSError):
            probe.unlink(missing_ok=True)


# ---------------------------------------------------------------------- caller


def received(job: Job, found: RemoteValue | LostCall) -> JobResult:
    """Store the run that a worker sent back, and return the result of its job.

    A new run gets the next free number in the folder of runs; a resumed run is overwritten. A worker with the
    caller's file system sends no run. If the job was lost, the result has the exit code `LOST`.
    """
    if isinstance(found, LostCall):
        return JobResult(job, LOST, None, found.reason, 0)
    if found.refused:
        return JobResult(job, _OTHER_VERSION, None, found.refused, 0)
    result: JobResult = found.value
    outputs = {Path(path): data for path, data in (found.outputs or {}).items()}
    resumed = {absolute(path) for path in job.inputs}
    runs = sorted((path.parent for path in outputs if path.name == RECORD), key=lambda run: run in resumed)
    if runs:
        sent = runs[-1]
        if sent in resumed:
            home = RunDir(sent)
        else:
            _, _, words = sent.name.partition("-")
            home = RunDir.create(_runs(job), sent.parent.name, words)
        files = {path.relative_to(sent): data for path, data in outputs.items() if path.is_relative_to(sent)}
        _replace(home, files)
        if result.result:
            result.result["run"] = home.shown
    return result


def _replace(run: RunDir, files: Mapping[Path, bytes]) -> None:
    """Move files into a run's folder, so that a kill at any moment leaves a whole run.

    They are written beside the folder. Files that the run does not have yet come first, such as the tensors
    of a checkpoint; then those that replace one, such as the pointer to it; then the run's record.
    """
    beside = run.path.with_name(f".{run.name}.received")
    shutil.rmtree(beside, ignore_errors=True)
    targets = {name: run.place(name.as_posix()) for name in files}
    try:
        for name, data in files.items():
            (beside / name).parent.mkdir(parents=True, exist_ok=True)
            (beside / name).write_bytes(data)
        for name in sorted(files, key=lambda name: (name.as_posix() == RECORD, targets[name].exists())):
            (beside / name).replace(targets[name])
    finally:
        shutil.rmtree(beside, ignore_errors=True)


# ---------------------------------------------------------------------- worker


@dataclass(frozen=True, slots=True)
class TrainingCall:
    """Argument of `trained`.

    Attributes:
        job: the job.
        cores: number of cores for it.
        probe: file whose deletion ends it.
    """

    job: Job
    cores: int
    probe: Path


def trained(call: TrainingCall) -> JobResult:
    """Train in a subprocess in the current folder, on cores that no other job of this machine has.

    After Ctrl-C, or once the probe file is deleted, the subprocess is asked to save and end.
    """
    with claimed(call.cores) as share:
        process = start(call.job.arguments, share)
        wanted = True
        while True:
            try:
                outputs = process.communicate(timeout=0.5 if wanted else None)
                return JobResult.of(call.job, process.returncode, outputs, share)
            except (subprocess.TimeoutExpired, KeyboardInterrupt) as event:
                # a long wait would not notice an interrupt by Ray
                if isinstance(event, KeyboardInterrupt) or not call.probe.exists():
                    wanted = False
                    process.terminate()  # workers of Ray ignore SIGINT; the process would inherit that


@contextmanager
def claimed(count: int) -> Iterator[frozenset[int]]:
    """Context that reserves `count` cores that no other job on this machine uses; yields their numbers.

    If fewer cores are free, the numbers of all cores are yielded, and jobs share cores.
    """
    everything = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    held: dict[int, TextIO] = {}
    try:
        with suppress(ImportError, Unusable):  # not on Windows; the folder must not be writable by others
            import fcntl

            folder = private(Path(tempfile.gettempdir()) / f"stlc-cores-{os.getuid()}").folder
            for core in everything:
                file = (folder / str(core)).open("w")
                try:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except OSError:
                    file.close()
                    continue
                held[core] = file
                if len(held) == count:
                    break
        yield frozenset(held) if len(held) == count else frozenset(everything)
    finally:
        for lock in held.values():
            lock.close()
