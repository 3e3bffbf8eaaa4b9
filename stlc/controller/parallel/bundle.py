"""Job bundles for other machines: inputs are sent, and runs returned, as archives.

A worker is a machine that runs a job. If it shares the caller's file system, it uses the caller's folders.
Any other worker copies them to a temporary folder. A copy keeps the whole path of the original below this
folder (`/home/ann/a.stl` becomes `TEMPORARY/home/ann/a.stl`), so that references between files stay valid.
"""

from __future__ import annotations

import io
import os
import secrets
import shutil
import socket
import subprocess
import tarfile
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from stlc.cache import Unusable, private
from stlc.compile.frontend.modules import Module, load_modules
from stlc.controller.parallel.jobs import TAIL, Job, JobResult, document_of, start
from stlc.diagnostics import StlcError
from stlc.dynamics.declaration.load import load_system_decl
from stlc.dynamics.robots.functions import function_files
from stlc.files import RECORD, atomic_path, find_spec, find_system, read_source, within, write_atomic
from stlc.grammar.parse.parser import parse
from stlc.rundir import RUNS, RunDir, every_run
from stlc.version import __version__

_OTHER_VERSION = 5


@dataclass(frozen=True, slots=True)
class JobBundle:
    """Training job with its input files, to be sent to a worker.

    Attributes:
        arguments: arguments of `stlc train`.
        folder: working directory of the caller.
        runs: folder of the caller's runs.
        inputs: absolute paths of the input files and folders.
        files: archive of the inputs.
        probe: file that only machines with the caller's file system can see.
        cores: number of cores for the job.
        version: version of the caller's stlc.
    """

    arguments: tuple[str, ...]
    folder: str
    runs: str
    inputs: tuple[str, ...]
    files: bytes
    probe: str
    cores: int
    version: str

    @classmethod
    def of(cls, job: Job, cores: int) -> JobBundle:
        """Pack the input files of a job, and create its probe file.

        The probe file can be seen only by machines that share the file system of this machine. When it is
        deleted, such a machine saves and stops the job.

        Raises:
            MissingError: R201, the folder of the job's runs cannot be written.
        """
        folder, runs = Path.cwd(), absolute(job.runs or RUNS)
        inputs = tuple(dict.fromkeys(map(absolute, job.inputs)))
        probe = runs / f".probe-{secrets.token_hex(8)}"
        with atomic_path(probe) as written:
            written.touch()
        for path in inputs:
            if (path / RECORD).is_file():  # links would be followed: a run holds none
                for each in path.rglob("*"):
                    within(path, f"{each.relative_to(path).as_posix()}", folders=each.is_dir())
        files = pack({str(path.relative_to(path.anchor)): path for path in inputs if path.exists()})
        known = tuple(map(str, inputs))
        return cls(job.arguments, str(folder), str(runs), known, files, str(probe), cores, __version__)

    @property
    def shared(self) -> bool:
        """True if this machine shares the caller's file system."""
        seen = (self.folder, self.probe, *self.inputs)
        return all(Path(path).exists() for path in seen)

    def close(self) -> None:
        """Delete the probe file.

        A worker that shares the file system saves and stops when the file is deleted.
        """
        with suppress(OSError):
            Path(self.probe).unlink(missing_ok=True)


@dataclass(frozen=True, slots=True)
class BundleResult:
    """Result of a job, as a worker returns it.

    Attributes:
        code: exit code of the training process.
        out: standard output of this process.
        said: the last lines of its standard error.
        cores: number of cores that the job had.
        run: path of the run on the caller's machine; None if nothing has to be transferred.
        files: archive of the run.
    """

    code: int
    out: str
    said: str
    cores: int
    run: str | None = None
    files: bytes = b""


# ---------------------------------------------------------------------- caller


def absolute(path: Path) -> Path:
    """Absolute path without `..`; symbolic links are not resolved."""
    return Path(os.path.normpath(Path.cwd() / path))


def import_run(job: Job, bundle: JobBundle, found: BundleResult) -> JobResult:
    """Store the run that a worker sent back, and return the result of its job.

    A new run gets the next free number in the folder of runs; a resumed run is overwritten. A worker with the
    caller's file system sends no run.
    """
    document = document_of(found.out)
    if found.run is not None:
        sent = Path(found.run)
        if str(sent) in bundle.inputs:
            home = RunDir(sent)
        else:
            _, _, words = sent.name.partition("-")
            home = RunDir.create(Path(bundle.runs), sent.parent.name, words)
        _replace(home, found.files)
        if document is not None and isinstance(document.get("result"), dict):
            document["result"]["run"] = home.shown
    return JobResult(job, found.code, document, found.said, found.cores)


def _replace(run: RunDir, files: bytes) -> None:
    """Move the files of an archive into a run's folder, so that a kill at any moment leaves a whole run.

    The archive is extracted beside the folder. Files that the run does not have yet come first, such as the
    tensors of a checkpoint; then those that replace one, such as the pointer to it; then the run's record.
    """
    beside = run.path.with_name(f".{run.name}.received")
    shutil.rmtree(beside, ignore_errors=True)
    try:
        unpack(files, beside)
        moves = [(path, run.path / path.relative_to(beside)) for path in beside.rglob("*") if path.is_file()]
        for path, target in sorted(moves, key=lambda move: (move[1].name == RECORD, move[1].exists())):
            path.replace(run.place(target.relative_to(run.path).as_posix()))
    finally:
        shutil.rmtree(beside, ignore_errors=True)


# ---------------------------------------------------------------------- worker


def run_bundle(bundle: JobBundle) -> BundleResult:
    """Run a job on this machine (the worker), in the caller's folders or in a copy of them."""
    if bundle.version != __version__:
        said = f"{socket.gethostname()} has stlc {__version__}; {bundle.version} is needed"
        return BundleResult(_OTHER_VERSION, "", said, 0)
    with claimed(bundle.cores) as share:
        if bundle.shared:
            return _ran(bundle.arguments, Path(bundle.folder), share, Path(bundle.probe))
        with tempfile.TemporaryDirectory(prefix="stlc-") as temporary:
            return _ran_in_mirror(bundle, Path(temporary).resolve(), share)


def _ran_in_mirror(bundle: JobBundle, root: Path, share: frozenset[int]) -> BundleResult:
    unpack(bundle.files, root)
    folder, runs = mirrored(root, bundle.folder), mirrored(root, bundle.runs)
    folder.mkdir(parents=True, exist_ok=True)
    known = {*bundle.inputs, bundle.runs}
    arguments = [str(mirrored(root, word)) if word in known else word for word in bundle.arguments]
    back = _ran(arguments, folder, share)
    sent = [RunDir(mirrored(root, path)) for path in bundle.inputs]
    made = [*every_run(runs), *(run for run in sent if (run.path / RECORD).is_file())]
    if not made:
        return back
    run = made[-1].path
    text = (run / RECORD).read_text(encoding="utf-8")
    write_atomic(run / RECORD, text.replace(f"{root}{os.sep}", "/"))  # paths on the caller's machine
    first, *rest = sorted(run.iterdir(), key=lambda path: path.name == RECORD, reverse=True)
    files = pack({path.name: path for path in (*rest, first)})  # a folder becomes a run with its record
    return BundleResult(back.code, back.out, back.said, back.cores, f"/{run.relative_to(root)}", files)


def _ran(
    arguments: Sequence[str], folder: Path, share: frozenset[int], probe: Path | None = None
) -> BundleResult:
    """Train in a subprocess on the cores `share`, and return its result, without the files of the run.

    After Ctrl-C, or once the file `probe` is deleted, the subprocess is asked to save and end.
    """
    process = start(arguments, share, folder)
    try:
        out, said = _awaited(process, probe)
    except KeyboardInterrupt:
        process.terminate()  # workers of Ray ignore SIGINT; the process would inherit that
        out, said = process.communicate()
    tail = "\n".join(said.splitlines()[-TAIL:])
    return BundleResult(process.returncode, out, tail, len(share))


def _awaited(process: subprocess.Popen[str], probe: Path | None) -> tuple[str, str]:
    """Wait for `process` to end, and return its standard output and standard error.

    The function checks at short intervals whether the process has ended, so that it notices an interrupt by
    Ray.

    Raises:
        KeyboardInterrupt: the file `probe` has been deleted.
    """
    while True:
        with suppress(subprocess.TimeoutExpired):
            return process.communicate(timeout=0.5)
        if probe is not None and not probe.exists():
            raise KeyboardInterrupt


@contextmanager
def claimed(count: int) -> Iterator[frozenset[int]]:
    """Context that reserves `count` cores that no other job on this machine uses; yields their numbers.

    If fewer cores are free, the numbers of all cores are yielded, and jobs share cores.
    """
    everything = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    try:
        import fcntl
    except ImportError:  # not on Windows
        yield frozenset(everything)
        return
    try:
        folder = private(Path(tempfile.gettempdir()) / f"stlc-cores-{os.getuid()}").folder
    except Unusable:  # the lock folder must not be writable by others
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
    """Path of the copy of `path`, an absolute path on the caller's machine, in the worker's folder `root`."""
    return root / Path(path).relative_to(Path(path).anchor)


def pack(entries: dict[str, Path]) -> bytes:
    """Pack files and folders into a compressed archive, and return its bytes.

    `entries`: name in the archive -> path of the file or folder. Symbolic links are replaced by their
    targets.
    """
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w:gz", dereference=True, compresslevel=1) as archive:
        for name, path in entries.items():
            archive.add(path, arcname=name)
    return buffer.getvalue()


def unpack(data: bytes, folder: Path) -> None:
    """Extract an archive into a folder.

    Raises:
        tarfile.FilterError: the archive contains a path outside the folder.
    """
    with tarfile.open(fileobj=io.BytesIO(data), mode="r:gz") as archive:
        archive.extractall(folder, filter="data")


# ---------------------------------------------------------------------- input files


def input_files(
    path: Path, system: str | None = None, overrides: Mapping[str, str] | None = None
) -> tuple[Path, ...]:
    """Paths of the input files of a training run.

    If a file has errors, the files that it names may be missing; the training itself reports the errors.

    Args:
        path: path of the specification.
        system: system file that replaces the one named by the specification.
        overrides: values of `--set`.
    """
    path = find_spec(path)
    found: dict[Path, None] = {path: None}
    with suppress(StlcError):
        spec = parse(read_source(path))
        found.update(dict.fromkeys(_imported(load_modules(spec))))
        if (wanted := system or spec.system) is not None:
            there = find_system(wanted, path)
            found[there] = None
            decl = load_system_decl(there, overrides or {})
            found.update(dict.fromkeys(function_files(decl).values()))
            found.update(dict.fromkeys(world.path for world in decl.worlds))
            for judge in decl.judges:
                found[judge.path] = None
                found.update(dict.fromkeys(_imported(load_modules(parse(read_source(judge.path))))))
    return tuple(file for file in found if file.is_file())


def _imported(modules: tuple[Module, ...]) -> Iterator[Path]:
    for module in modules:
        yield Path(module.spec.source.name)
        yield from _imported(module.imports)
