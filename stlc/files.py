"""Files: checked reading, atomic writing, and search by name."""

from __future__ import annotations

import codecs
import errno
import glob
import os
import re
import stat
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path, PurePosixPath
from typing import BinaryIO, ClassVar

from stlc.diagnostics import Diagnostic, MissingError, RunError, SpecError, UsageError, os_reason, usage
from stlc.escape import operand, shell
from stlc.similar import closest
from stlc.source import Source
from stlc.stopping import leaving

RECORD = "run.json"
"""Name of the record of a run; a folder with this file is a run."""
_INSTALLED = Path(__file__).parent / "library"
LIBRARY = _INSTALLED if _INSTALLED.is_dir() else Path(__file__).parents[1]
"""Folder of the installed data files, laid out as the source tree (in an editable install, that tree)."""
_SPEC_SUFFIXES = (".stl", ".stlc")
_SYSTEM_SUFFIXES = ("", ".yaml", ".yml")
_MESH = re.compile(r"\s*(solid\b[^\n]*)\n\s*(facet|endsolid)\b")


@dataclass(frozen=True, slots=True)
class File:
    """A file as a user names it: by its path, by a name that is looked up, or as `-`, the standard input."""

    MAX_BYTES: ClassVar = 10_000_000
    """Largest size of a text."""
    STDIN: ClassVar = "-"
    SYSTEMS: ClassVar = LIBRARY / "examples"
    SPECS: ClassVar = LIBRARY / "specs"
    """Folders of the installed systems and specifications, which refer to each other by `../`."""

    name: Path | str

    # ------------------------------------------------------------------ reading and writing

    def read(self, root: str = "") -> Source:
        """Read a text file in UTF-8; `-` is the standard input.

        Args:
            root: folder that names in the text do not leave; see `Source.root`.

        Raises:
            UsageError: U102, there is no such file, it cannot be opened, or it is a named pipe or a device.
            SpecError: E003, the file is a 3-D mesh (also `.stl`), another binary file, or not UTF-8; E005, it
                is larger than `MAX_BYTES`.
        """
        name, path = str(self.name), Path(self.name)
        if name == self.STDIN:
            return decoded("<stdin>", sys.stdin.buffer.read(self.MAX_BYTES + 1))
        try:
            data = read_regular(path, self.MAX_BYTES)
        except FileNotFoundError:
            near = closest(path.name, _siblings(path.parent))
            advice = (f"did you mean `{path.parent / near}`?",) if near else ()
            raise usage(f"there is no file `{path}`", *advice, code="U102") from None
        except OSError as error:
            raise (_too_large(name) if error.errno == errno.EFBIG else unreadable(path, error)) from None
        except ValueError:  # a zero byte in the name
            raise usage(f"no file can be called {name!r}", code="U102") from None
        return decoded(name, data, root)

    def opened(self) -> BinaryIO:
        """Open a regular file, or a pipe that this process has inherited (`/dev/fd/63`), for reading.

        Anything else could wait for ever, or never end.

        Raises:
            OSError: the path is a folder, a named pipe, a device or a socket, or cannot be opened.
        """
        descriptor = os.open(self.name, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))
        mode = os.fstat(descriptor).st_mode
        if stat.S_ISFIFO(mode) and not os.path.lexists(self.real):
            os.set_blocking(descriptor, True)
        elif not stat.S_ISREG(mode):
            os.close(descriptor)
            raise OSError(errno.EINVAL, f"it is {_noun(mode)}, not a file", str(self.name))
        return open(descriptor, "rb")  # noqa: PTH123 - of a descriptor

    def require_regular(self) -> None:
        """Check that it is a regular file, for readers that open it by its path.

        Raises:
            OSError: it cannot be opened, or is something else; see `opened`.
        """
        self.opened().close()

    def write(self, data: bytes | str) -> None:
        """Write the file atomically: a reader sees the old or the new content, never a part.

        Raises:
            MissingError: R201, the disk is full, or the user may not write there; the old file is unchanged.
        """
        with self.replaced() as temporary:
            temporary.write_bytes(data.encode() if isinstance(data, str) else data)

    @contextmanager
    def replaced(self) -> Iterator[Path]:
        """Context that yields a temporary path; the file there replaces this one if the block succeeds.

        The temporary path has the same suffix. Missing folders are created. A file that is replaced keeps its
        permissions. A path that is not a regular file (a pipe, `/dev/null`) is written in place.

        Raises:
            MissingError: R201, the disk is full, or the user may not write there; the old file is unchanged,
                and the temporary one removed.
        """
        path, target = self.name, self.real
        if target.exists() and not target.is_file() and not target.is_dir():
            with reported(f"write `{path}`"):
                yield target
            return
        temporary = target.with_name(f".{target.stem}.{os.urandom(4).hex()}{target.suffix}")
        try:
            with reported(f"write `{path}`"), leaving(lambda _code: temporary.unlink(missing_ok=True)):
                target.parent.mkdir(parents=True, exist_ok=True)
                mode = stat.S_IMODE(target.stat().st_mode) if target.is_file() else None
                if mode is not None:
                    temporary.touch(0o600)  # nobody else reads it meanwhile
                yield temporary
                with temporary.open("rb+") as file:
                    os.fsync(file.fileno())
                if mode is not None:
                    with suppress(OSError):  # a file system without permissions
                        temporary.chmod(mode)
                temporary.replace(target)
        finally:
            with suppress(OSError):
                temporary.unlink(missing_ok=True)

    # ------------------------------------------------------------------ finding

    @property
    def real(self) -> Path:
        """Absolute path without links; unlike `Path.resolve`, it gives no error at a link back to itself."""
        return Path(os.path.realpath(self.name))

    def require_folder(self) -> None:
        """Check, before any work, that it is a folder or can become one.

        Raises:
            FileExistsError: it is a file.
        """
        path = Path(self.name)
        if path.exists() and not path.is_dir():
            raise FileExistsError(errno.EEXIST, "it is a file, and a folder is needed", str(path))

    @property
    def is_spec(self) -> bool:
        """True if its suffix is that of a specification."""
        return Path(self.name).suffix in _SPEC_SUFFIXES

    @property
    def is_pattern(self) -> bool:
        """True if its name is a pattern (`*`, `?`, `[…]`) and not the path of a file that is called so."""
        return glob.has_magic(str(self.name)) and not Path(self.name).exists()

    def system(self, spec_path: Path | str | None = None) -> Path:
        """Path of the system file of this name.

        The name is tried as a path, then beside the specification, in `systems`, in `examples`, and among the
        installed files. The suffix `.yaml` may be omitted.

        Raises:
            UsageError: U102, the file is in none of these places; the message lists them.
        """
        folders = [Path()]
        if spec_path is not None:
            folders.append(Path(spec_path).parent)
        folders += [Path("systems"), Path("examples"), self.SYSTEMS, LIBRARY]
        for folder in folders:
            for suffix in _SYSTEM_SUFFIXES:
                path = folder / f"{self.name}{suffix}"
                if path.is_file():
                    short = Path(
                        os.path.normpath(path)
                    )  # not `specs/../examples/car.yaml`, unless links differ
                    return short if short.is_file() and short.samefile(path) else path
        raise UsageError(_no_such("system", str(self.name), folders))

    def spec(self) -> Path:
        """Path of the specification of this name: a file at that path, else an installed specification.

        An installed specification is found as `specs/traffic.stl` and as `traffic.stl`. A name that is not
        found is returned unchanged; an attempt to read it then raises the error.
        """
        path = Path(self.name)
        if path.suffix in (".yaml", ".yml"):
            advice = f"name the specification, and  {shell(('--system', operand(str(path))))}"
            raise usage(f"`{self.name}` is a system file, not a specification", advice)
        if path.is_absolute() or ".." in path.parts or path.suffix != ".stl" or path.exists():
            return path
        return next((there for folder in (LIBRARY, self.SPECS) if (there := folder / path).is_file()), path)

    @staticmethod
    def specs(names: Sequence[str]) -> tuple[str, ...]:
        """Paths of specification files, in order, without duplicates; a folder stands for all files below it.

        Raises:
            UsageError: U102, a folder contains no specification; U101, `names` is empty.
        """
        if not names:
            raise usage("which file?", "a .stl file, a folder, or - for a pipe")
        return tuple(dict.fromkeys(path for name in names for path in _specs_below(name)))

    def trace(self, runs: Path = Path("runs")) -> Path:
        """Path of the trace of this name: a file at that path, else in the newest run below `runs`.

        Raises:
            UsageError: U102, it is in neither place; the message lists both.
            RunError: R110, it is in the folder of a run, and a link leads there.
        """
        name, folders = str(self.name), [Path(), runs / "latest"]
        for folder in folders:
            path = folder / name
            if path.is_file() or _is_bag(path):
                return File(path).of_run()
        if Path(name).is_dir():
            advice = f"name its traces: '{Path(name) / '*'}'"
            raise usage(f"`{name}` is a folder, not a trace", advice, code="U102")
        raise UsageError(_no_such("trace", name, folders))

    def seen(self, runs: Path = Path("runs")) -> Path:
        """Path of the trace of this name as users see it: relative to the current folder if it is below."""
        path = self.trace(runs)
        if path == Path(self.name):
            return path
        path = path.resolve()
        return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path

    def matches(self) -> list[str]:
        """Paths of the trace files that match its name, a pattern; `**` stands for any number of folders.

        Hidden files and folders are left out. `**` does not enter links to folders, which may lead back. A
        folder matches only if it is a trace itself (a ROS 2 bag); files inside it are then left out.

        Raises:
            UsageError: U102, no file matches.
        """
        pattern = str(self.name)
        parts = [part if part == "**" else re.sub(r"\*\*+", "*", part) for part in Path(pattern).parts]
        literal = tuple(takewhile(lambda part: not glob.has_magic(part), parts))
        rest = [*parts[len(literal) :], *(["*"] if parts[-1] == "**" else [])]
        start = Path(*literal)
        try:
            paths = [
                path
                for path in start.glob(str(Path(*rest)))
                if all(part in rest or not part.startswith(".") for part in path.relative_to(start).parts)
            ]
        except OSError as error:
            raise usage(f"cannot look up `{pattern}`: {os_reason(error)}", code="U102") from None
        found = {path for path in paths if path.is_file() or _is_bag(path)}
        bags = {path for path in found if path.is_dir()}
        names = sorted(str(path) for path in found if bags.isdisjoint(path.parents))
        if not names:
            advice = (
                () if "**" in parts else ("`**` stands for any number of folders, as in 'logs/**/*.csv'",)
            )
            raise usage(f"no file matches `{pattern}`", *advice, code="U102")
        return names

    def of_run(self) -> Path:
        """Return its path; of a run, `within` it. Raises RunError (R110)."""
        path = Path(self.name)
        folder = run_folder(path)
        return path if folder in (None, path) else within(folder, path.relative_to(folder).as_posix())


# ----------------------------------------------------------------------- reading


def read_regular(path: Path, most: int) -> bytes:
    """Read a file of at most `most` bytes. Raises OSError as `File.opened` does; EFBIG: it is larger."""
    with File(path).opened() as file:
        data = file.read(most + 1)
    if len(data) > most:
        raise OSError(errno.EFBIG, f"it is larger than {most // 1_000_000} MB", str(path))
    return data


def _noun(mode: int) -> str:
    nouns = {stat.S_IFIFO: "a pipe", stat.S_IFLNK: "a link", stat.S_IFDIR: "a folder", stat.S_IFREG: "a file"}
    return nouns.get(stat.S_IFMT(mode), "a device")


def unreadable(path: Path, error: OSError) -> UsageError:
    """Return the error U102 for a file that cannot be read."""
    advice = ("`-` stands for the standard input",) if error.errno == errno.EINVAL else ()
    return usage(f"cannot read `{path}`: {os_reason(error)}", *advice, code="U102")


def _too_large(name: str) -> SpecError:
    return SpecError.of("E005", f"`{name}` is larger than {File.MAX_BYTES // 1_000_000} MB")


def _siblings(folder: Path) -> list[str]:
    with suppress(OSError):
        return sorted(entry.name for entry in folder.iterdir() if entry.is_file())
    return []


def decoded(name: str, data: bytes, root: str = "") -> Source:
    """Return the content of a text file as a source. Raises SpecError (E003, E005), as `File.read` does."""
    if len(data) > File.MAX_BYTES:
        raise _too_large(name)
    # binary stereolithography, also `.stl`: a header of 80 bytes, the number of triangles, 50 bytes for each
    if len(data) >= 84 and b"\0" in data and len(data) == 84 + 50 * int.from_bytes(data[80:84], "little"):
        raise SpecError(_mesh(name, None))
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise SpecError(_not_utf8(name, data, error)) from None
    if "\0" in text:
        raise SpecError.of("E003", f"`{name}` is a binary file, not a text")
    source = Source(name, text, root)
    if _MESH.match(text):
        raise SpecError(_mesh(name, source))
    return source


def _mesh(name: str, source: Source | None) -> Diagnostic:
    start = 0 if source is None else len(source.text) - len(source.text.lstrip())
    return Diagnostic(
        "E003",
        f"`{name}` is a 3-D mesh, not a specification",
        span=None if source is None else source.span(start, start + len("solid")),
        label="" if source is None else "ASCII stereolithography starts like this",
        note=(
            "both formats use the suffix .stl; stlc specifications are UTF-8 text that start with a "
            "declaration or `spec NAME`",
        ),
    )


def _not_utf8(name: str, data: bytes, error: UnicodeDecodeError) -> Diagnostic:
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return Diagnostic("E003", f"`{name}` is UTF-16", help=("save it as UTF-8 in your editor",))
    if b"\0" in data[:1024]:
        return Diagnostic("E003", f"`{name}` is a binary file, not a text")
    line = data.count(b"\n", 0, error.start) + 1
    return Diagnostic(
        "E003",
        f"`{name}` is not UTF-8: byte 0x{data[error.start]:02x} in line {line}",
        help=("save it as UTF-8 in your editor",),
    )


# ----------------------------------------------------------------------- writing


@contextmanager
def reported(action: str) -> Iterator[None]:
    """Context that turns an error of the operating system into MissingError (R201).

    The message of the error is "cannot " and `action`, for example "cannot write `a.json`".
    """
    try:
        yield
    except OSError as error:
        raise MissingError.of("R201", f"cannot {action}: {os_reason(error)}") from error


# ----------------------------------------------------------------------- finding


def _specs_below(name: str) -> Iterator[str]:
    folder = Path(name)
    if name == File.STDIN or not folder.is_dir():
        yield name
        return
    found = sorted(
        path
        for path in folder.rglob("*")
        if path.suffix in _SPEC_SUFFIXES
        and path.is_file()
        and not any(part.startswith(".") for part in path.relative_to(folder).parts)  # hidden
    )
    if not found:
        raise usage(f"there is no specification in `{name}`", code="U102")
    yield from map(str, found)


def _is_bag(path: Path) -> bool:
    """True if a path is the folder of a ROS 2 bag (a recording of messages)."""
    with suppress(OSError):
        return path.is_dir() and ((path / "metadata.yaml").is_file() or any(map(is_stored, path.iterdir())))
    return False


def is_stored(path: Path) -> bool:
    """True if a path is a file in which a ROS 2 bag (a recording of messages) stores its messages.

    The file may be compressed.
    """
    return path.name.lower().removesuffix(".zstd").endswith((".db3", ".mcap")) and path.is_file()


def _no_such(kind: str, name: str, folders: Sequence[Path]) -> Diagnostic:
    wanted = Path(name).name
    nearby = {
        entry: folder for folder in reversed(folders) if folder != LIBRARY for entry in _siblings(folder)
    }
    if kind == "system":
        nearby = {entry: folder for entry, folder in nearby.items() if entry.endswith((".yaml", ".yml"))}
    near = closest(wanted, nearby)
    places = ", ".join(dict.fromkeys(_shown(folder / name) for folder in folders if folder != LIBRARY))
    advice = (f"did you mean `{_shown(nearby[near] / near)}`?",) if near else ()
    return Diagnostic("U102", f"there is no {kind} `{name}`", help=advice, note=(f"looked at: {places}",))


def _shown(path: Path) -> str:
    return f"installed: {path.name}" if File.SYSTEMS in path.parents else str(path)


def named_in(source: Source, name: str, *, copied: bool = False) -> Path:
    """Return the path of the file `name`, to which a text refers, relative to the folder of the text.

    A text of a run (`Source.root`) refers to files in the folder of the run alone. This folder holds copies
    of the files without their subfolders: if there is no `systems/car.yaml`, it is `car.yaml`.

    Args:
        source: the text.
        name: path of the file as it is written in the text.
        copied: whether any folder may hold copies without their subfolders.

    Raises:
        RunError: R110, the name leads over a link in the folder of the run, or to something else than a file.
    """
    home = Path(source.name).parent
    there, here = home / name, home / Path(name).name
    if not source.root:
        return here if copied and here.is_file() and not there.is_file() else there
    root, there = Path(source.root), Path(os.path.normpath(there))
    inside = there.is_relative_to(root) and os.path.lexists(there)
    return within(root, (there if inside else root / Path(name).name).relative_to(root).as_posix())


def within(root: Path, name: str, most: int | None = None, *, folders: bool = False) -> Path:
    """Return the path of the file `name` in the folder `root` of a run, if no link leads elsewhere.

    The file need not exist.

    Args:
        root: the folder, whose own path may go over links.
        name: path of the file, relative to `root`.
        most: largest size of the file in bytes; None for any.
        folders: whether only the folders on the way are checked.

    Raises:
        RunError: R110, a folder on the way or the file itself is a link, the file is no regular file or too
            large, or the name leads out of the folder.
    """
    path, parts = root, PurePosixPath(name).parts
    if not parts or PurePosixPath(name).is_absolute() or ".." in parts or "\0" in name:
        raise refused(root / name, "the name leads out of the folder of the run")
    for number, part in enumerate(parts[:-1] if folders else parts, 1):
        path, last = path / part, number == len(parts)
        try:
            found = path.lstat()
        except FileNotFoundError:
            break
        except OSError as error:
            raise refused(path, os_reason(error)) from None
        if not (stat.S_ISREG if last else stat.S_ISDIR)(found.st_mode):
            raise refused(path, f"it is {_noun(found.st_mode)}")
        if last and most is not None and found.st_size > most:
            raise refused(path, f"it is larger than {most // 1_000_000} MB")
    return root.joinpath(*parts)


def run_folder(path: Path) -> Path | None:
    """Return the nearest folder of a run at or above `path`; None if there is none."""
    return next((folder for folder in (path, *path.parents) if (folder / RECORD).is_file()), None)


def place(root: Path, name: str) -> Path:
    """Return the path at which a file is to be written in the folder `root`; missing folders are created.

    A link, a pipe or a device of that name is removed, so that nothing is written where it leads.

    Raises:
        RunError: R110, a folder on the way is a link, or the name leads out of the folder.
        MissingError: R201, a folder cannot be created.
    """
    path = within(root, name, folders=True)
    with reported(f"write `{path}`"):
        path.parent.mkdir(parents=True, exist_ok=True)
        if os.path.lexists(path) and not stat.S_ISREG(path.lstat().st_mode):
            path.unlink()
    return path


def refused(path: Path, why: str) -> RunError:
    """Return the error R110: a file of a run is not read or written."""
    advice = ("a run has regular files and folders alone: remove it, or copy what it leads to",)
    return RunError.of("R110", f"`{path}` is not a file of the run: {why}", help=advice)


@contextmanager
def alone_in(folder: Path, *, wait: bool = False) -> Iterator[bool]:
    """Context in which no other process is in this context of the same folder; yields False if one is.

    The lock lies on the folder itself: it ends with the process, and no copy of the folder has it. Where
    folders have no locks (on Windows, on some network drives), True is yielded.

    Args:
        folder: the folder, which exists.
        wait: whether to wait until the other process has left; then True is yielded.
    """
    descriptor = None
    with suppress(ImportError, OSError):
        import fcntl

        descriptor = os.open(folder, os.O_RDONLY)
    if descriptor is None:
        yield True
        return
    try:
        own = True
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            own = False
        except OSError:
            pass
        yield own
    finally:
        with suppress(OSError):
            fcntl.flock(descriptor, fcntl.LOCK_UN)  # although a worker process may have a copy
        os.close(descriptor)
