"""Folder of a run, `runs/<spec>/<number>-<words>`, with everything needed to repeat the run.

A run is never overwritten; a new run takes the next number. `runs/latest` and `runs/<spec>/latest` are links
to the newest run. Files are written atomically. Files of rows are an exception: rows are appended, so that at
most the last row is lost if the process is killed.

A run may come from anybody. All its files are read and written through `RunDir`: no link in its folder is
followed, no pipe or device is opened, every size has a limit, stored JSON has the expected types, and the
Python that a run names is run only by commands that drive (`stlc.foreign`).
"""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, ClassVar, Literal

from stlc.diagnostics import Diagnostic, RunError, StlcError, UsageError, os_reason, usage
from stlc.escape import file_part, shell
from stlc.files import (
    RECORD,
    File,
    alone_in,
    decoded,
    place,
    read_regular,
    refused,
    reported,
    run_folder,
    within,
)
from stlc.jsontext import data_of, dumps
from stlc.provenance import sha256
from stlc.records import read
from stlc.source import Source

Status = Literal["running", "finished", "interrupted", "failed"]


@dataclass(frozen=True, slots=True)
class Hardware:
    """Machine of a run; see `stlc.provenance.hardware`."""

    cores: int = 0
    memory_gib: float = 0.0


@dataclass(frozen=True, slots=True)
class StoredDrives:
    """Stored results of a training: its drives, and its rounds of falsification."""

    share: float | None = None
    recommended: str | None = None
    last_share: float | None = None


@dataclass(frozen=True, slots=True)
class StoredResult:
    """Result of a training, as its run stores it."""

    accuracy: float | None = None
    feasible: float | None = None
    seconds: float | None = None
    judged_seconds: float | None = None
    held_out: int | None = None
    searched: int | None = None
    interval: tuple[float, float] | None = None
    requirements: dict[str, float] | None = None
    closed_loop: StoredDrives | None = None
    falsification: StoredDrives | None = None


@dataclass(frozen=True, slots=True)
class RunRecord:
    """Content of `run.json` as far as it is read; a run that is going on has only a part of it."""

    status: str | None = None
    spec: str | None = None
    spec_path: str | None = None
    system: str | None = None
    system_path: str | None = None
    device: str | None = None
    started: str | None = None
    schedule: str | None = None
    spec_hash: str | None = None
    system_hash: str | None = None
    seed: int | None = None
    threads: int | None = None
    steps: int | None = None
    margin: float | None = None
    seconds_allowed: float | None = None
    budget: float | str | None = None
    overrides: dict[str, str] | None = None
    options: dict[str, Any] | None = None
    engine: dict[str, Any] | None = None
    versions: dict[str, Any] | None = None
    git: dict[str, Any] | None = None
    hardware: Hardware | None = None
    result: StoredResult | None = None


@dataclass(frozen=True, slots=True)
class TrainingRow:
    """A line of `train.jsonl` as far as it is read."""

    step: int | None = None
    steps: int | None = None
    repaired: int | None = None
    failing: int | None = None
    seconds: float | None = None
    loss: float | None = None
    accuracy: float | None = None
    feasible: float | None = None
    lr: float | None = None
    requirements: dict[str, float | None] | None = None


_NUMBERED = re.compile(r"(\d{4,})-(.+)")


@dataclass(frozen=True, slots=True)
class RunDir:
    """The folder of one run.

    Attributes:
        path: path of the folder.
    """

    RUNS: ClassVar = Path("runs")
    """Folder of all runs."""
    LATEST: ClassVar = "latest"
    ROWS: ClassVar = "train.jsonl"
    CONFIG: ClassVar = "config.resolved.yaml"
    SPEC: ClassVar = "spec.stl"
    SYSTEM: ClassVar = "system.yaml"
    TRACE: ClassVar = "trace.npz"
    SCENE: ClassVar = "scene.npz"
    UNGUARDED: ClassVar = ("eval/unguarded_trace.npz", "eval/unguarded_scene.npz")
    """Trace and scene of the first seed without guard, stored beside the guarded ones."""
    SIMULATION: ClassVar = "eval/simulate.json"
    HELD_OUT: ClassVar = "eval/held_out.npz"
    LIB: ClassVar = "lib"
    INDEX: ClassVar = "index.json"
    """Folder of the imports of the specification, and the file there that has their names."""
    MOST_JSON: ClassVar = 50_000_000
    MOST_ARRAYS: ClassVar = 2_000_000_000
    """Largest sizes in bytes of a file of JSON, and of a file of arrays or tensors."""

    path: Path

    # ------------------------------------------------------------------ making and finding

    @classmethod
    def create(cls, root: Path, spec_name: str, words: str | None = None) -> RunDir:
        """Create the folder of a new run, and redirect the links `latest` to it.

        Args:
            root: folder of all runs.
            spec_name: name of the specification.
            words: name of the run; random words if None.

        Raises:
            UsageError: U101, `words` cannot be part of a folder's name.
            MissingError: R201, the folder cannot be created.
        """
        words = cls.require_name(words) if words is not None else draw_words()
        home = root / _slug(spec_name)
        with reported(f"make a run below `{root}`"):
            home.mkdir(parents=True, exist_ok=True)
            path = _reserve(home, words)
            _point(home / RunDir.LATEST, path.name)
            _point(root / RunDir.LATEST, f"{home.name}/{path.name}")
        return cls(path)

    @classmethod
    def newest(cls, root: Path = RUNS) -> RunDir:
        """The run to which `latest` points; without that link, the most recently changed run.

        Raises:
            UsageError: R101, there is no run below `root`.
        """
        linked = root / RunDir.LATEST
        if (linked / RECORD).is_file():
            return _resolved(linked)
        runs = sorted(RunDir.every(root), key=lambda run: run.path.stat().st_mtime)
        if not runs:
            help_ = ("train one: stlc train specs/traffic.stl --system car.yaml",)
            raise usage(f"there is no run in `{root}`", *help_, code="R101")
        return runs[-1]

    @classmethod
    def open(cls, where: Path | str, root: Path = RUNS) -> RunDir:
        """Open the run called `where`; `found` lists the possible names.

        Raises:
            UsageError: R101, there is no such run, or several fit.
            RunError: R101, the folder is damaged.
        """
        return cls.found(where, root).checked()

    @classmethod
    def found(cls, where: Path | str, root: Path = RUNS) -> RunDir:
        """The run called `where`, even if its record (`run.json`) is damaged.

        Possible names: a folder, or a file in it; `latest`; the name or file of a specification (its newest
        run); the number of a run, its words, or both, with or without `SPEC/` before it.

        Raises:
            UsageError: R101, there is no such run, or several fit.
            RunError: R101, the folder has no record.
        """
        given = Path(where)
        if given.exists() and given.resolve() != Path.cwd() / root:
            folder = run_folder(given) or given
            if given.suffix == ".stl" and folder == given:
                return _of_spec(given, root)
            run = _resolved(folder)
            return run if (run.path / RECORD).is_file() else run.checked()
        return cls.newest(root) if str(where) == RunDir.LATEST else _by_name(str(where), root)

    @classmethod
    def every(cls, root: Path = RUNS) -> list[RunDir]:
        """Runs below `root` that have a record (`run.json`), ordered by specification and number."""
        numbered = [
            (path.parent.name, int(match[1]), path)
            for path in root.glob("*/*")
            if (match := _NUMBERED.fullmatch(path.name))
            and not (path.is_symlink() or path.parent.is_symlink())
        ]
        return [cls(path) for _, _, path in sorted(numbered) if (path / RECORD).is_file()]

    @classmethod
    def recorded_trace(cls, what: str, runs: Path) -> Path:
        """Return the path of the trace file `what`, or of the trace in the run called `what`.

        Raises:
            UsageError: U102, there is no such trace or run, or the run has no trace.
        """
        try:
            if not Path(what).is_dir():
                return File(what).trace(runs)
        except UsageError as missing:
            try:
                folder = cls.open(what, runs)
            except StlcError:
                raise missing from None
        else:
            folder = cls.open(what, runs)
        if not folder.has(RunDir.TRACE):
            advice = (f"record one: {shell(('stlc', 'simulate', folder.name))}",)
            raise usage(f"`{folder.shown}` has no trace", *advice, code="U102")
        folder.file(RunDir.TRACE, RunDir.MOST_ARRAYS)
        return Path(folder.shown) / RunDir.TRACE

    def remove(self) -> None:
        """Delete the folder; links `latest` to it are redirected to the newest remaining run.

        Raises:
            MissingError: R201, the folder cannot be deleted.
        """
        home = self.path.parent
        with reported(f"remove `{self.shown}`"):
            shutil.rmtree(self.path)
        runs = RunDir.every(home.parent)
        for folder in (home, home.parent):
            link = folder / RunDir.LATEST
            if not link.is_symlink() or link.exists():
                continue
            left = [entry for entry in runs if folder in entry.path.parents]
            link.unlink()
            if left:
                newest = max(left, key=lambda entry: entry.path.stat().st_mtime)
                _point(link, newest.path.relative_to(folder).as_posix())

    @staticmethod
    def now() -> str:
        """The current time in UTC, in the format of run records and traces."""
        return datetime.now(UTC).isoformat(timespec="seconds")

    @staticmethod
    def require_name(words: str) -> str:
        """Return the name of a run; raise UsageError (U101) if no folder can have it."""
        if _slug(words) != words:
            raise usage(f"`{words}` cannot name a run", "use letters, digits, `-`, `_` and `.`")
        return words

    def checked(self) -> RunDir:
        """Return this run if its record (`run.json`) can be read. Raises RunError (R101) if not."""
        self.record()
        return self

    # ------------------------------------------------------------------ its name

    @property
    def name(self) -> str:
        """Name of the folder: number and words, such as `0007-quiet-heron`."""
        return self.path.name

    @property
    def shown(self) -> str:
        """The path as printed: relative to the current folder if it lies below it."""
        with suppress(ValueError):
            return self.path.resolve().relative_to(Path.cwd()).as_posix()
        return self.path.as_posix()

    # ------------------------------------------------------------------ whole files

    def has(self, name: str) -> bool:
        """True if something in the folder has this name; reading it can still fail."""
        return os.path.lexists(self.path / name)

    def file(self, name: str, most: int = File.MAX_BYTES) -> Path:
        """Return the path of a file of the run, for a reader that opens it by its path.

        Args:
            name: path of the file, relative to the folder of the run.
            most: largest size in bytes.

        Raises:
            RunError: R110, a link leads there, it is no regular file, it is too large, or the name leads out
                of the folder.
        """
        return within(self.path, name, most)

    def place(self, name: str) -> Path:
        """Return the path at which a file of the run is to be written; see `stlc.files.place`."""
        return place(self.path, name)

    def write(self, name: str, data: bytes | str) -> None:
        """Write a file atomically. Raises the errors of `place`, and MissingError (R201) if that fails."""
        File(self.place(name)).write(data)

    def read(self, name: str, most: int = File.MAX_BYTES) -> bytes:
        """Read a file of the run. Raises the errors of `file`, and RunError (R101) if it cannot be read."""
        try:
            return read_regular(self.file(name, most), most)
        except OSError as error:
            raise RunError(self.damaged(name, error)) from error

    def source(self, name: str) -> Source:
        """Read a text of the run, in which names of files do not leave the folder of the run.

        Raises:
            RunError: the errors of `read`.
            SpecError: E003, it is not UTF-8.
        """
        return decoded(str(self.path / name), self.read(name), str(self.path))

    def write_json(self, name: str, value: object) -> None:
        """Write `value` as the JSON file `name`. Raises the errors of `write`."""
        self.write(name, dumps(value, indent=2) + "\n")

    def read_json(self, name: str, kind: Any = Any) -> Any:
        """Read the JSON file `name` of the run, whose content is that of a record of the type `kind`.

        Raises:
            RunError: R101, it is missing, damaged, or not of that type (see `stlc.records.read`); R110, it is
                no file of the run.
        """
        data = self.read(name, RunDir.MOST_JSON)
        try:
            return of_kind(data, kind)
        except (ValueError, RecursionError) as error:
            raise RunError(self.damaged(name, error)) from error

    def record(self) -> dict[str, Any]:
        """Content of `run.json`. Raises RunError (R101) if it is missing or damaged."""
        record: dict[str, Any] = self.read_json(RECORD, RunRecord)
        return record

    def update(self, facts: Mapping[str, object]) -> dict[str, Any]:
        """Set the entries `facts` in `run.json` (created if missing), and return the file's whole content."""
        before = self.record() if self.has(RECORD) else {}
        after = {**before, **facts}
        self.write_json(RECORD, after)
        return after

    @property
    def status(self) -> Status:
        """Status of the run. Raises RunError (R101) if `run.json` is damaged."""
        status: Status = self.record().get("status") or "running"
        return status

    def finish(self, status: Status, result: object = None) -> None:
        """Write status, end time and, if given, the result of the run to `run.json`."""
        ended = {"status": status, "finished": self.now()}
        self.update(ended if result is None else {**ended, "result": result})

    def claimed(self) -> AbstractContextManager[bool]:
        """Context in which this process alone trains the run; its value is False if another process does."""
        return alone_in(self.path)

    # ------------------------------------------------------------------ specification and system

    def library(self, below: str = LIB) -> dict[str, str]:
        """Texts that the specification imports, by name of the import, from the subfolder `below`.

        Raises:
            RunError: R101, a text is damaged; R110, a name leads out of the run.
        """
        if not self.has(f"{below}/{RunDir.INDEX}"):
            return {}
        index: dict[str, str] = self.read_json(f"{below}/{RunDir.INDEX}", dict[str, str])
        return {key: self.source(f"{below}/{name}").text for key, name in index.items()}

    @property
    def hashes(self) -> dict[str, str]:
        """SHA-256 of the specification with its imports, and of the system, each with the `--set` changes."""
        changes = json.dumps(self.record().get("overrides") or {}, sort_keys=True)
        library = self.library()
        imports = json.dumps(dict(sorted(library.items()))) if library else ""
        return {
            "spec_hash": sha256(self.source(RunDir.SPEC).text + changes + imports),
            "system_hash": sha256(self.source(RunDir.SYSTEM).text + changes),
        }

    # ------------------------------------------------------------------ rows

    def damaged(self, name: str, error: Exception) -> Diagnostic:
        """Return the diagnostic R101 for a file of the run that cannot be read, or has wrong content."""
        if isinstance(error, FileNotFoundError):
            return Diagnostic("R101", f"`{self.shown}` is not a run: it has no {name}")
        if isinstance(error, RecursionError):
            return Diagnostic("R101", f"`{self.shown}/{name}` is damaged", note=("it is nested too deeply",))
        reason = os_reason(error) if isinstance(error, OSError) else str(error) or type(error).__name__
        return Diagnostic("R101", f"`{self.shown}/{name}` is damaged", note=(reason[:200],))

    # ------------------------------------------------------------------ rows

    def append_row(self, row: Mapping[str, object], name: str = ROWS) -> None:
        """Append `row` to the file of JSON lines `name`, in a single write.

        First, an incomplete last line is removed; it is left if a process was killed.
        """
        data = (dumps(row) + "\n").encode()
        path = self.place(name)
        with reported(f"write `{self.shown}/{name}`"), path.open("ab+") as file:
            descriptor = file.fileno()
            size = os.fstat(descriptor).st_size
            if size and os.pread(descriptor, 1, size - 1) != b"\n":
                os.ftruncate(descriptor, os.pread(descriptor, size, 0).rfind(b"\n") + 1)
            os.write(descriptor, data)

    def rows(self, name: str = ROWS) -> list[dict[str, Any]]:
        """Read the rows of a file of JSON lines, without an incomplete last one; [] if there is no file.

        Raises:
            RunError: R101, a complete line is not a JSON object, or has a value of a wrong type; R110, the
                file is no file of the run.
        """
        if not self.has(name):
            return []
        data, rows = self.read(name, RunDir.MOST_JSON), []
        for number, line in enumerate(data[: data.rfind(b"\n") + 1].split(b"\n"), 1):
            try:
                rows += [of_kind(line, TrainingRow)] if line else []
            except (ValueError, RecursionError) as error:
                message = f"`{self.shown}/{name}`, line {number}, is damaged"
                raise RunError(replace(self.damaged(name, error), message=message)) from error
        return rows

    def keep_rows(self, wanted: Callable[[dict[str, Any]], bool], name: str = ROWS) -> None:
        """Keep only the rows of a file of JSON lines for which `wanted` returns True; remove the others.

        A resumed run removes the rows after its checkpoint.
        """
        kept = [row for row in self.rows(name) if wanted(row)]
        self.write(name, "".join(dumps(row) + "\n" for row in kept))


def of_kind(text: bytes, kind: Any) -> Any:
    """Parse JSON that a run has stored, and check that it is the content of a record of the type `kind`.

    Raises ValueError or RecursionError, as `stlc.jsontext.data_of` and `stlc.records.read`.
    """
    found = data_of(text)
    read(kind, found)
    return found


def _resolved(folder: Path) -> RunDir:
    """Return the run in a folder; a link `latest` is followed only to a run below its own folder.

    Raises:
        RunError: R110, `latest` leads elsewhere.
    """
    path = folder.resolve()
    if folder.name == RunDir.LATEST and not path.is_relative_to(folder.parent.resolve()):
        raise refused(folder, "it leads out of its folder")
    return RunDir(path)


# ---------------------------------------------------------------------- names


def _by_name(where: str, root: Path) -> RunDir:
    runs = RunDir.every(root)
    if any(run.path.parent.name == where for run in runs):
        return [run for run in runs if run.path.parent.name == where][-1]
    spec, _, wanted = where.rpartition("/")
    fitting = [run for run in runs if spec in ("", run.path.parent.name) and wanted in _names(run)]
    if len(fitting) == 1:
        return fitting[0]
    if fitting:
        choices = tuple(f"{run.path.parent.name}/{run.name}" for run in fitting)
        raise usage(f"several runs are called `{where}`", *choices, code="R101")
    names = {name for run in runs for name in (run.name, _names(run)[-1], run.path.parent.name)}
    raise usage(f"there is no run `{where}` in `{root}`", code="R101").near(where, names)


def _of_spec(path: Path, root: Path) -> RunDir:
    """Return the newest run that was trained for the specification file `path`.

    If there is none, return the newest run for a specification of the same name in another folder.

    Raises:
        UsageError: R101, there is no such run either.
    """
    runs = RunDir.every(root)
    trained = []
    for run in runs:
        with suppress(RunError):  # it has no readable record
            if Path(str(run.record().get("spec_path"))).resolve() == path.resolve():
                trained.append(run)
    found = trained or [run for run in runs if run.path.parent.name == _slug(path.stem)]
    if not found:
        help_ = (f"train one: {shell(('stlc', 'train', str(path)))}",)
        raise usage(f"there is no run of `{path}` in `{root}`", *help_, code="R101")
    return found[-1]


def _names(run: RunDir) -> tuple[str, str, str, str]:
    """Return the names by which a run can be called: folder name, padded number, number, words.

    For `0007-quiet-heron` these are `0007-quiet-heron`, `0007`, `7` and `quiet-heron`.
    """
    number, _, words = run.name.partition("-")
    return run.name, number, str(int(number)), words


def _slug(name: str) -> str:
    """Part of a path for the name of a specification or run; never that of the link `latest`."""
    part = file_part(name, empty="spec")
    return f"{part}-spec" if part.lower() == RunDir.LATEST else part


# ---------------------------------------------------------------------- the file system


def _reserve(home: Path, words: str) -> Path:
    """Create a run folder with the next free number and return its path.

    No concurrent process gets the same number: the process that creates the marker file of a number owns it,
    and then checks again that the number is unused. Creating the folder does not suffice, because folders of
    one number may have different words.
    """
    number = max(_numbers(home), default=0)
    while True:
        number += 1
        with _marker(home / f".{number:04d}") as owned:
            if owned and number not in _numbers(home):
                path = home / f"{number:04d}-{words}"
                path.mkdir()
                return path


def _numbers(home: Path) -> set[int]:
    matches = (_NUMBERED.fullmatch(path.name) for path in home.iterdir())
    return {int(match[1]) for match in matches if match}


@contextmanager
def _marker(path: Path) -> Iterator[bool]:
    try:
        path.mkdir()
    except FileExistsError:
        yield False
        return
    try:
        yield True
    finally:
        path.rmdir()


def _point(link: Path, target: str) -> None:
    """Make the symbolic link `link` point to `target`, atomically; no effect where links are not allowed."""
    temporary = link.with_name(f".{link.name}.{os.urandom(4).hex()}")
    try:
        temporary.symlink_to(target, target_is_directory=True)
    except (OSError, NotImplementedError):
        return
    temporary.replace(link)


# ---------------------------------------------------------------------- words


_ADJECTIVES = """
    able amber ample azure blunt bold brisk broad calm candid clear coral crisp deft dusky eager
    early even fair fleet fresh gentle glad golden grand green hardy hazel honest humble jolly keen
    kind level light lively lucid lunar mellow merry mild misty modest neat nimble noble open
    patient plain polar prompt proud quick quiet rapid ready robust rosy rustic sandy serene sharp
    silent silver sleek smooth solid sound spry steady still stout sunny supple swift tall tawny
    tidy timely tranquil true upbeat vivid warm wary wise witty
"""
_ANIMALS = """
    adder alpaca auk badger bat beaver bee bison boar bobcat bream bunting buzzard carp civet cod
    condor coot crane cricket crow curlew deer dipper dolphin dove duck dunlin eagle egret eider elk
    ermine falcon ferret finch fox gannet gecko goose goshawk grebe grouse gull hare harrier hawk
    hedgehog heron hoopoe ibex ibis jackdaw jay kestrel kite lark lemur linnet lizard llama loon
    lynx magpie marten merlin mole moose moth newt ocelot orca oriole osprey otter owl panda pika
    pike plover puffin quail raven robin salmon seal shrew siskin skua snipe sparrow stoat stork
    swallow swan swift tapir teal tern thrush toad trout turtle vole walrus warbler weasel whale
    wigeon wolf wombat wren yak zebra
"""


def draw_words() -> str:
    """Two random words, such as `quiet-heron`, independent of all seeds of an experiment."""
    import secrets

    return f"{secrets.choice(_ADJECTIVES.split())}-{secrets.choice(_ANIMALS.split())}"
