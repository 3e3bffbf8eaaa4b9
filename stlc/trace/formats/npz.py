"""Named arrays in an `.npz` file, in and out, without ever unpickling anything.

The archive is read member by member: the header of each array is checked against the size that the archive
declares before memory is asked for, so that neither a pickle nor a bomb gets past the door.
"""

from __future__ import annotations

import math
import struct
import tokenize
import warnings
import zipfile
import zlib
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.lib.format as npy
from numpy.typing import NDArray

from stlc.diagnostics import Diagnostic, TraceError, UsageError
from stlc.files import atomic_path

try:
    from lzma import LZMAError
except ImportError:  # a Python without it: `zipfile` says so
    LZMAError = zlib.error  # type: ignore[misc, assignment]

Array = NDArray[Any]

MAX_BYTES = 4_000_000_000
MAX_NAME = 60_000
"""Bytes of the name of an array that an archive has room for."""
MAX_ARRAYS = 10_000

_ROOM = 500_000_000
_RATIO = 200
"""A packed file may unpack to `_ROOM`, or to so many times its size; records of sensors take a tenth."""

_LAST_LETTER, _PAIRS = 0x10FFFF, (0xD800, 0xDFFF)
"""What Unicode knows, and the halves of pairs that are no letters on their own."""
_NUMERIC = "biuf"
_TEXT = "U"
_ZIP_MAGIC = (b"PK\x03\x04", b"PK\x05\x06")
_DAMAGE = (
    ValueError,
    TypeError,
    SyntaxError,
    OverflowError,
    MemoryError,
    RecursionError,
    EOFError,
    OSError,
    NotImplementedError,
    RuntimeError,
    struct.error,
    tokenize.TokenError,
    zlib.error,
    LZMAError,
    zipfile.BadZipFile,
)


def unreadable(path: Path | str, why: str, *, advice: str = "") -> TraceError:
    """E603: the file cannot be read, or is not safe to read."""
    return TraceError(
        Diagnostic("E603", f"cannot read `{path}`: {why}", help=(advice,) if advice else ()),
    )


def read_npz(path: Path) -> dict[str, Array]:
    """The arrays of an `.npz` file: numbers of any shape, and texts.

    Raises:
        UsageError: U102, the file does not exist or cannot be opened.
        TraceError: E603, it is no archive of plain arrays, is damaged, or would not fit into memory.
    """
    try:
        with path.open("rb") as file:
            _check_magic(path, file)
            with zipfile.ZipFile(file) as archive:
                return _read_members(path, archive)
    except (FileNotFoundError, IsADirectoryError, PermissionError) as error:
        reason = (error.strerror or type(error).__name__).lower()
        raise UsageError(Diagnostic("U102", f"cannot read `{path}`: {reason}")) from None
    except _DAMAGE as error:
        raise unreadable(path, f"the archive is damaged or cut short ({_brief(error)})") from None


def _brief(error: BaseException) -> str:
    text = str(error).strip().splitlines()
    return text[0][:100] if text else type(error).__name__


def _check_magic(path: Path, file: IO[bytes]) -> None:
    start = file.read(6)
    file.seek(0)
    if start[:4] in _ZIP_MAGIC:
        return
    if start.startswith(b"\x93NUMPY"):
        raise unreadable(path, "it is a single array", advice="save one array per signal with `np.savez`")
    if start[:1] == b"\x80":
        raise unreadable(
            path, "it is a pickle, and pickles can run code", advice="save arrays with `np.savez`"
        )
    raise unreadable(path, "it is empty" if not start else "it is not an `.npz` archive")


def room_for(path: Path) -> int:
    """Bytes that a packed file may unpack to."""
    return min(MAX_BYTES, max(_ROOM, _RATIO * path.stat().st_size))


class Member:
    """One array of an open archive, read from its start on, so many values along the time axis at a time.

    Attributes:
        length: samples: of the last axis of (samples,) and (1, samples), else of the first one.
    """

    def __init__(self, path: Path, archive: zipfile.ZipFile, info: zipfile.ZipInfo, stack: ExitStack) -> None:
        self._path, self._name = path, info.filename.removesuffix(".npy")
        self._stream = stack.enter_context(archive.open(info))
        self._shape, fortran, self._dtype = _checked_header(path, self._stream, info, self._name)
        row = self._shape[:1] == (1,) or len(self._shape) == 1
        self._width = 1 if row else math.prod(self._shape[1:])
        self.length = self._shape[-1] if row and self._shape else (self._shape or (0,))[0]
        if fortran and not row and len(self._shape) > 1:
            self.length = -1

    def read(self, count: int) -> Array:
        """The next `count` samples: (count,) or (count, …)."""
        size = count * self._width * self._dtype.itemsize
        data = self._stream.read(size)
        if len(data) != size:
            raise unreadable(self._path, f"`{self._name}` is cut short")
        values = np.frombuffer(data, dtype=self._dtype)
        _check_letters(self._path, self._name, values)
        return values if self._width == 1 else values.reshape(count, *self._shape[1:])

    def whole(self) -> Array:
        """All of it, in its own shape."""
        data = self._stream.read(math.prod(self._shape) * self._dtype.itemsize)
        values = np.frombuffer(data, dtype=self._dtype)
        _check_letters(self._path, self._name, values)
        return values.reshape(self._shape)


def open_members(path: Path, stack: ExitStack) -> dict[str, Member]:
    """The arrays of an archive that stays open as long as the stack. Raises as `read_npz`."""
    archive = stack.enter_context(zipfile.ZipFile(path))
    members = archive.infolist()
    if len(members) > MAX_ARRAYS:
        raise unreadable(path, f"it holds {len(members)} arrays, more than {MAX_ARRAYS}")
    return {info.filename.removesuffix(".npy"): Member(path, archive, info, stack) for info in members}


def _read_members(path: Path, archive: zipfile.ZipFile) -> dict[str, Array]:
    members = archive.infolist()
    if len(members) > MAX_ARRAYS:
        raise unreadable(path, f"it holds {len(members)} arrays, more than {MAX_ARRAYS}")
    size = sum(member.file_size for member in members)
    most = room_for(path)
    if size > most:
        reason = f"it unpacks to {size / 1e9:.1f} GB, more than {most / 1e9:.1f} GB"
        raise unreadable(path, reason, advice="split it, or do not compress it")
    arrays: dict[str, Array] = {}
    for member in members:
        name = member.filename.removesuffix(".npy")
        if name in arrays:
            raise unreadable(path, f"it holds the array `{name}` twice")
        arrays[name] = _read_array(path, archive, member, name)
    return arrays


def _read_array(path: Path, archive: zipfile.ZipFile, member: zipfile.ZipInfo, name: str) -> Array:
    with archive.open(member) as stream:
        shape, fortran, dtype = _checked_header(path, stream, member, name)
        size = math.prod(shape) * dtype.itemsize
        data = stream.read(size)
    if len(data) != size:
        raise unreadable(path, f"`{name}` is cut short")
    flat = np.frombuffer(bytearray(data), dtype=dtype) if size else np.zeros(0, dtype)
    _check_letters(path, name, flat)
    return flat.reshape(shape, order="F" if fortran else "C")


def _check_letters(path: Path, name: str, values: Array) -> None:
    """Raise TraceError (E603) for a text with numbers that are no letters."""
    if values.dtype.kind == "U" and values.dtype.itemsize and values.size:
        letters = values.view(np.dtype(np.uint32).newbyteorder(values.dtype.byteorder))
        if ((letters > _LAST_LETTER) | ((letters >= _PAIRS[0]) & (letters <= _PAIRS[1]))).any():
            raise unreadable(path, f"`{name}` holds texts with numbers that are no letters")


def _checked_header(
    path: Path, stream: IO[bytes], member: zipfile.ZipInfo, name: str
) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """The header of an array of numbers or texts, of which as much follows as it declares."""
    shape, fortran, dtype = _read_header(stream)
    if dtype.hasobject:
        raise unreadable(
            path,
            f"`{name}` holds Python objects, and unpickling them can run code",
            advice="save it as an array of numbers, one array per signal",
        )
    if dtype.kind not in _NUMERIC + _TEXT or (dtype.kind == "f" and dtype.itemsize > 8):
        raise unreadable(path, f"`{name}` holds `{dtype}`, not numbers")
    size = math.prod(shape) * dtype.itemsize
    room = member.file_size - stream.tell()
    if min(shape, default=1) < 0 or size != room:
        shown = " x ".join(map(str, shape))
        raise unreadable(path, f"`{name}` declares {shown} values, but {max(room, 0)} bytes follow")
    return shape, fortran, dtype


def _read_header(stream: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    version = npy.read_magic(stream)
    readers = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
    if version not in readers:
        raise ValueError(f"array format {version[0]}.{version[1]}")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return readers[version](stream)


def write_npz(path: Path | str, arrays: Mapping[str, Array]) -> None:
    """Write arrays beside `path`, then rename; the same arrays always give the same bytes.

    Raises:
        TraceError: E603, a name is too long.
        MissingError: R201, no room or no permission; an old file stays as it was.
    """
    with atomic_path(path) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED) as archive:
        for name, array in arrays.items():
            if len(name.encode()) > MAX_NAME:
                raise unreadable(Path(path), f"a name of {len(name)} characters is too long for an archive")
            with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as stream:
                npy.write_array(stream, np.asarray(array), allow_pickle=False)
