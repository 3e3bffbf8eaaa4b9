"""Calls of functions on machines that may not see the caller's files.

A worker that sees the same files makes the call in the caller's working directory. Any other worker makes it
in a temporary folder, to which it copies the files. Those of every call are in its working directory, where
Ray has put them (`runtime_env`); others, such as recordings, are sent with the call when the worker asks for
them. A copy keeps the whole path of the original below the folder (`/home/ann/a.stl` becomes
`TEMPORARY/home/ann/a.stl`), so that references between files stay valid. Absolute paths are translated in the
argument, in the value, and in JSON files that the call writes.
"""

from __future__ import annotations

import os
import socket
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

from stlc.controller.parallel.workers import CallFiles
from stlc.diagnostics import MissingError
from stlc.files import File, within
from stlc.version import __version__


@dataclass(frozen=True, slots=True)
class SeenFile:
    """An input file as the caller sees it, by which a worker recognises the same file.

    Attributes:
        path: absolute path.
        size: size in bytes.
        changed: time of the last change in nanoseconds.
    """

    path: str
    size: int
    changed: int

    @classmethod
    def of(cls, path: Path) -> SeenFile:
        """Look at a file or folder. Raises OSError if it does not exist."""
        found = path.stat()
        return cls(str(path), found.st_size, found.st_mtime_ns)

    @property
    def here(self) -> bool:
        """True if this machine sees the same file."""
        try:
            return SeenFile.of(Path(self.path)) == self
        except OSError:
            return False


def linked(paths: Iterable[Path], folder: Path) -> dict[str, str]:
    """Link files in the folder that Ray sends to its workers; path of each file -> its name there.

    The names are numbers: nothing in the folder can be imported as a module.
    """
    found = {str(file): str(number) for number, file in enumerate(dict.fromkeys(_files(paths)))}
    for file, name in found.items():
        (folder / name).symlink_to(file)
    return found


def _files(paths: Iterable[Path]) -> Iterator[Path]:
    """Absolute paths of files, and of the files in folders.

    Raises:
        RunError: R110, a file in a folder is a link.
    """
    for path in map(absolute, paths):
        if path.is_dir():
            for each in path.rglob("*"):
                within(path, each.relative_to(path).as_posix(), folders=each.is_dir())
                if each.is_file():
                    yield each
        elif path.exists():
            yield path


def absolute(path: Path) -> Path:
    """Absolute path without `..`; symbolic links are not resolved."""
    return Path(os.path.normpath(Path.cwd() / path))


@dataclass(frozen=True, slots=True)
class RemoteCall:
    """Call of a function on another machine.

    Attributes:
        function: function of a module.
        argument: its argument.
        folder: working directory of the caller.
        inputs: files and folders that the call reads.
        linked: path of a file of the inputs -> its name in the working directory of the worker.
        outputs: absolute paths of the files and folders that the call writes.
        version: version of the caller's stlc.
        sent: path of another file of the inputs -> its content; None: sent only if the worker asks for them.
    """

    function: Callable[[Any], Any]
    argument: Any
    folder: str
    inputs: tuple[SeenFile, ...]
    linked: Mapping[str, str]
    outputs: tuple[str, ...]
    version: str
    sent: Mapping[str, bytes] | None = None

    @classmethod
    def of(
        cls, function: Callable[[Any], Any], argument: object, files: CallFiles, linked: Mapping[str, str]
    ) -> RemoteCall:
        """Describe a call; no file is read. `linked`: files in the working directories of the workers."""
        paths = dict.fromkeys(map(absolute, files.inputs))
        inputs = tuple(SeenFile.of(path) for path in paths if path.exists())
        outputs = tuple(str(absolute(path)) for path in files.outputs)
        own = {file: name for file, name in linked.items() if any(_is_in(file, each.path) for each in inputs)}
        return cls(function, argument, str(Path.cwd()), inputs, own, outputs, __version__)

    @property
    def others(self) -> list[Path]:
        """Inputs that are not in the working directories of the workers."""
        paths = [each.path for each in self.inputs]
        return [Path(path) for path in paths if not any(_is_in(file, path) for file in self.linked)]

    def with_files(self) -> RemoteCall:
        """Return the same call with the contents of the other files."""
        return replace(self, sent={str(file): file.read_bytes() for file in _files(self.others)})

    @property
    def shared(self) -> bool:
        """True if this machine sees the folder and the files of the caller."""
        return Path(self.folder).is_dir() and all(each.here for each in self.inputs)


def _is_in(file: str, path: str) -> bool:
    return file == path or file.startswith(f"{path}{os.sep}")


@dataclass(frozen=True, slots=True)
class RemoteValue:
    """Answer to a call.

    Attributes:
        value: value of the function; None if the files were missing.
        missing: whether the worker needs the files of the call.
        outputs: path on the caller's machine -> content of a file that the call wrote in a copy.
        refused: reason for which the worker does not make the call; "" if it does.
    """

    value: Any = None
    missing: bool = False
    outputs: Mapping[str, bytes] | None = None
    refused: str = ""

    def delivered(self) -> Any:
        """Write the files that the call wrote, and return its value.

        Raises:
            MissingError: R201, a file cannot be written; R406, the worker has another version of stlc.
        """
        if self.refused:
            help_ = ("install the same version on every machine",)
            raise MissingError.of("R406", self.refused, help=help_)
        for path, data in (self.outputs or {}).items():
            File(path).write(data)
        return self.value


def answer(call: RemoteCall) -> RemoteValue:
    """Make a call on this machine, a worker. Raises what the function raised."""
    if call.version != __version__:
        needed = f"{socket.gethostname()} has stlc {__version__}; {call.version} is needed"
        return RemoteValue(refused=needed)
    if call.shared:
        with _inside(Path(call.folder)):
            return RemoteValue(call.function(call.argument))
    if call.sent is None and call.others:
        return RemoteValue(missing=True)
    with tempfile.TemporaryDirectory(prefix="stlc-") as temporary:
        return _answer_in_copy(call, Path(temporary).resolve())


def _answer_in_copy(call: RemoteCall, root: Path) -> RemoteValue:
    contents = {path: Path(name).read_bytes() for path, name in call.linked.items()} | dict(call.sent or {})
    for path, data in contents.items():
        copy = _mirrored(root, path)
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_bytes(data)
    folder = _mirrored(root, call.folder)
    folder.mkdir(parents=True, exist_ok=True)
    known = {*(each.path for each in call.inputs), *call.outputs}

    def to_copy(text: str | Path) -> str:
        inside = str(text) in known or (isinstance(text, Path) and text.is_absolute())
        return str(_mirrored(root, str(text))) if inside else str(text)

    def from_copy(text: str | Path) -> str:
        return str(text).replace(f"{root}{os.sep}", "/")

    with _inside(folder):
        value = call.function(translated(call.argument, to_copy))
    outputs = {}
    for path in call.outputs:
        copy = _mirrored(root, path)
        for file in (copy, *copy.rglob("*")):
            if file.is_file() and not file.is_symlink():
                data = file.read_bytes()
                json = file.suffix == ".json"
                outputs[from_copy(file)] = data.replace(f"{root}{os.sep}".encode(), b"/") if json else data
    return RemoteValue(translated(value, from_copy), outputs=outputs)


def _mirrored(root: Path, path: str) -> Path:
    """Path of the copy of `path`, an absolute path on the caller's machine, in the folder `root`."""
    return root / Path(path).relative_to(Path(path).anchor)


@contextmanager
def _inside(folder: Path) -> Iterator[None]:
    """Context with another working directory; a worker makes one call at a time."""
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


def translated(value: Any, change: Callable[[str | Path], str]) -> Any:
    """Copy of a value whose texts and paths are replaced, in records, mappings, lists and tuples.

    Args:
        value: the value.
        change: function that receives a text or a path, and returns the new text.
    """
    if isinstance(value, str):
        return change(value)
    if isinstance(value, Path):
        return Path(change(value))
    if isinstance(value, Mapping):
        return {translated(key, change): translated(each, change) for key, each in value.items()}
    if isinstance(value, list | tuple):
        parts = [translated(each, change) for each in value]
        return parts if isinstance(value, list) else tuple(parts)
    if is_dataclass(value) and not isinstance(value, type):
        names = [field.name for field in fields(value) if field.init]
        made = replace(value, **{name: translated(getattr(value, name), change) for name in names})
        known = {name: each for name, each in getattr(value, "__dict__", {}).items() if name not in names}
        if known:  # what a record has computed, and keeps
            made.__dict__.update(translated(known, change))
        return made
    return value
