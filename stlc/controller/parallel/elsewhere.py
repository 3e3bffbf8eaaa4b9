"""Calls of functions on machines that may not see the caller's files.

A worker that sees the same files makes the call in the caller's working directory. Any other worker asks for
the files, unpacks them into a temporary folder, and makes the call there. As for training jobs
(`stlc.controller.parallel.bundle`), a copy keeps the whole path of the original below that folder. Absolute
paths in the argument and in the value are translated.
"""

from __future__ import annotations

import os
import socket
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

from stlc.controller.parallel.bundle import absolute, mirrored, pack, unpack
from stlc.controller.parallel.workers import CallFiles
from stlc.diagnostics import Diagnostic, MissingError
from stlc.files import write_atomic
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


@dataclass(frozen=True, slots=True)
class RemoteCall:
    """Call of a function on another machine.

    Attributes:
        function: function of a module.
        argument: its argument.
        folder: working directory of the caller.
        inputs: files that the call reads.
        outputs: absolute paths of the files that it writes.
        version: version of the caller's stlc.
        packed: archive of the inputs; None: they are sent only if the worker asks for them.
    """

    function: Callable[[Any], Any]
    argument: Any
    folder: str
    inputs: tuple[SeenFile, ...]
    outputs: tuple[str, ...]
    version: str
    packed: bytes | None = None

    @classmethod
    def of(cls, function: Callable[[Any], Any], argument: object, files: CallFiles) -> RemoteCall:
        """Describe a call; no file is read."""
        inputs = dict.fromkeys(absolute(path) for path in files.inputs if path.exists())
        outputs = tuple(str(absolute(path)) for path in files.outputs)
        seen = tuple(map(SeenFile.of, inputs))
        return cls(function, argument, str(Path.cwd()), seen, outputs, __version__)

    def with_files(self) -> RemoteCall:
        """Return the same call with the contents of its files."""
        paths = [Path(each.path) for each in self.inputs]
        return replace(self, packed=pack({str(path.relative_to(path.anchor)): path for path in paths}))

    @property
    def shared(self) -> bool:
        """True if this machine sees the folder and the files of the caller."""
        return Path(self.folder).is_dir() and all(each.here for each in self.inputs)


@dataclass(frozen=True, slots=True)
class RemoteValue:
    """Answer to a call.

    Attributes:
        value: value of the function; None if the files were missing.
        missing: whether the worker needs the files of the call.
        outputs: path on the caller's machine -> content of a file that the call wrote.
    """

    value: Any = None
    missing: bool = False
    outputs: Mapping[str, bytes] | None = None

    def delivered(self) -> Any:
        """Write the files that the call wrote, and return its value.

        Raises:
            MissingError: R201, a file cannot be written.
        """
        for path, data in (self.outputs or {}).items():
            write_atomic(path, data)
        return self.value


def answer(call: RemoteCall) -> RemoteValue:
    """Make a call on this machine, a worker.

    Raises:
        MissingError: R406, this machine has another version of stlc.
        Exception: what the function raised.
    """
    if call.version != __version__:
        message = f"{socket.gethostname()} has stlc {__version__}; {call.version} is needed"
        raise MissingError(Diagnostic("R406", message, help=("install the same version on every machine",)))
    if call.shared:
        with _inside(Path(call.folder)):
            return RemoteValue(call.function(call.argument))
    if call.packed is None:
        return RemoteValue(missing=True)
    with tempfile.TemporaryDirectory(prefix="stlc-") as temporary:
        return _answer_in_copy(call, call.packed, Path(temporary).resolve())


def _answer_in_copy(call: RemoteCall, packed: bytes, root: Path) -> RemoteValue:
    unpack(packed, root)
    folder = mirrored(root, call.folder)
    folder.mkdir(parents=True, exist_ok=True)
    known = {each.path for each in call.inputs}

    def to_copy(text: str | Path) -> str:
        inside = str(text) in known or (isinstance(text, Path) and text.is_absolute())
        return str(mirrored(root, str(text))) if inside else str(text)

    def from_copy(text: str | Path) -> str:
        return str(text).replace(f"{root}{os.sep}", "/")

    with _inside(folder):
        value = call.function(translated(call.argument, to_copy))
    copies = {path: mirrored(root, path) for path in call.outputs}
    outputs = {path: copy.read_bytes() for path, copy in copies.items() if copy.is_file()}
    return RemoteValue(translated(value, from_copy), outputs=outputs)


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
        return replace(value, **{name: translated(getattr(value, name), change) for name in names})
    return value
