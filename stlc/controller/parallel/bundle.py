"""An errand for another machine: what it reads travels there, its run travels back, as archives.

A worker that sees the caller's folders works in them. Any other makes a mirror of them in a temporary folder,
in which every file lies under its whole path, so that what files say of one another stays true.
"""

from __future__ import annotations

import io
import os
import secrets
import socket
import subprocess
import tarfile
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from stlc.cache import Unusable, private
from stlc.controller.parallel.jobs import TAIL, Job, JobResult, document_of, start
from stlc.files import atomic_path, write_atomic
from stlc.rundir import RECORD, RUNS, RunDir, every_run
from stlc.version import __version__

_OTHER_VERSION = 5


@dataclass(frozen=True, slots=True)
class JobBundle:
    """An errand on its way to a worker.

    Attributes:
        arguments: of `stlc train`.
        folder: where the caller stands.
        runs: the folder of its runs.
        inputs: files and folders that are read; all absolute.
        files: an archive of them.
        probe: a file that only who shares the caller's folders can see.
        cores: that the errand may use.
        version: of the caller's stlc.
    """

    arguments: tuple[str, ...]
    folder: str
    runs: str
    inputs: tuple[str, ...]
    files: bytes
    probe: str
    cores: int
    version: str

    @property
    def shared(self) -> bool:
        """Whether the caller's folders are seen from here."""
        seen = (self.folder, self.probe, *self.inputs)
        return all(Path(path).exists() for path in seen)

    def close(self) -> None:
        """Remove the probe."""
        with suppress(OSError):
            Path(self.probe).unlink(missing_ok=True)


@dataclass(frozen=True, slots=True)
class BundleResult:
    """What a worker sends back.

    Attributes:
        code: exit code of the training.
        out: its standard output.
        said: the end of its standard error.
        cores: that it had.
        run: the path of its run, as the caller would write it; None where nothing has to travel.
        files: an archive of that run.
    """

    code: int
    out: str
    said: str
    cores: int
    run: str | None = None
    files: bytes = b""


# ---------------------------------------------------------------------- the caller


def wrap(errand: Job, cores: int) -> JobBundle:
    """Make an errand ready to travel. Raises MissingError (R201) where its runs cannot be written."""
    folder, runs = Path.cwd(), _absolute(errand.runs or RUNS)
    inputs = tuple(dict.fromkeys(map(_absolute, errand.inputs)))
    probe = runs / f".probe-{secrets.token_hex(8)}"
    with atomic_path(probe) as written:
        written.touch()
    return JobBundle(
        errand.arguments,
        str(folder),
        str(runs),
        tuple(map(str, inputs)),
        pack({str(path.relative_to(path.anchor)): path for path in inputs if path.exists()}),
        str(probe),
        cores,
        __version__,
    )


def _absolute(path: Path) -> Path:
    """The whole path, without `..`; links stay as they are."""
    return Path(os.path.normpath(Path.cwd() / path))


def bring_home(errand: Job, parcel: JobBundle, delivery: BundleResult) -> JobResult:
    """Enter the run that a worker sent into the caller's runs, under the next free number.

    A run that was sent to be gone on with is written over.
    """
    document = document_of(delivery.out)
    if delivery.run is not None:
        sent = Path(delivery.run)
        if str(sent) in parcel.inputs:
            home = RunDir(sent)
        else:
            _, _, words = sent.name.partition("-")
            home = RunDir.create(Path(parcel.runs), sent.parent.name, words)
        unpack(delivery.files, home.path)
        if document is not None and isinstance(document.get("result"), dict):
            document["result"]["run"] = home.shown
    return JobResult(errand, delivery.code, document, delivery.said, delivery.cores)


# ---------------------------------------------------------------------- the worker


def carry(parcel: JobBundle) -> BundleResult:
    """Run an errand on this machine, in the caller's folders or in a mirror of them."""
    if parcel.version != __version__:
        said = f"{socket.gethostname()} has stlc {__version__}; {parcel.version} is needed"
        return BundleResult(_OTHER_VERSION, "", said, 0)
    with claimed(parcel.cores) as share:
        if parcel.shared:
            return _ran(parcel.arguments, Path(parcel.folder), share, Path(parcel.probe))
        with tempfile.TemporaryDirectory(prefix="stlc-") as temporary:
            return _ran_in_mirror(parcel, Path(temporary).resolve(), share)


def _ran_in_mirror(parcel: JobBundle, root: Path, share: frozenset[int]) -> BundleResult:
    unpack(parcel.files, root)
    folder, runs = mirrored(root, parcel.folder), mirrored(root, parcel.runs)
    folder.mkdir(parents=True, exist_ok=True)
    known = {*parcel.inputs, parcel.runs}
    arguments = [str(mirrored(root, word)) if word in known else word for word in parcel.arguments]
    back = _ran(arguments, folder, share)
    sent = [RunDir(mirrored(root, path)) for path in parcel.inputs]
    made = [*every_run(runs), *(run for run in sent if (run.path / RECORD).is_file())]
    if not made:
        return back
    run = made[-1].path
    text = (run / RECORD).read_text(encoding="utf-8")
    write_atomic(run / RECORD, text.replace(f"{root}{os.sep}", "/"))  # paths as the caller knows them
    first, *rest = sorted(run.iterdir(), key=lambda path: path.name == RECORD, reverse=True)
    files = pack({path.name: path for path in (*rest, first)})  # a folder becomes a run with its record
    return BundleResult(back.code, back.out, back.said, back.cores, f"/{run.relative_to(root)}", files)


def _ran(
    arguments: Sequence[str], folder: Path, share: frozenset[int], probe: Path | None = None
) -> BundleResult:
    """Train in a process of its own; one that is called off, or whose probe is gone, may save."""
    process = start(arguments, share, folder)
    try:
        out, said = _awaited(process, probe)
    except KeyboardInterrupt:
        process.terminate()  # workers of Ray ignore SIGINT, and so would the process
        out, said = process.communicate()
    tail = "\n".join(said.splitlines()[-TAIL:])
    return BundleResult(process.returncode, out, tail, len(share))


def _awaited(process: subprocess.Popen[str], probe: Path | None) -> tuple[str, str]:
    """What a process says, awaited in short steps: an interrupt by Ray is not seen within a long one."""
    while True:
        with suppress(subprocess.TimeoutExpired):
            return process.communicate(timeout=0.5)
        if probe is not None and not probe.exists():
            raise KeyboardInterrupt


@contextmanager
def claimed(count: int) -> Iterator[frozenset[int]]:
    """Cores that no other errand on this machine has claimed; all, where so many are not free."""
    everything = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    try:
        import fcntl
    except ImportError:  # not on Windows
        yield frozenset(everything)
        return
    try:
        folder = private(Path(tempfile.gettempdir()) / f"stlc-cores-{os.getuid()}").folder
    except Unusable:  # nothing is written where others may write too
        yield frozenset(everything)
        return
    held = {}
    try:
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
        for file in held.values():
            file.close()


# ---------------------------------------------------------------------- archives


def mirrored(root: Path, path: str) -> Path:
    """Where an absolute path lies in a mirror."""
    return root / Path(path).relative_to(Path(path).anchor)


def pack(entries: dict[str, Path]) -> bytes:
    """An archive of files and folders, each under its name. Links are followed."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w:gz", dereference=True, compresslevel=1) as archive:
        for name, path in entries.items():
            archive.add(path, arcname=name)
    return buffer.getvalue()


def unpack(data: bytes, folder: Path) -> None:
    """Write what an archive holds below a folder. Raises `tarfile.FilterError` for what leads out of it."""
    with tarfile.open(fileobj=io.BytesIO(data), mode="r:gz") as archive:
        archive.extractall(folder, filter="data")
