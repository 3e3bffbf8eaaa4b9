"""Traces as `.npz` archives, read without unpickling.

The archive is read one array at a time. To be safe against pickles and decompression bombs, the header of
each array is checked against the size that the archive declares before memory is allocated.
"""

from __future__ import annotations

import math
import struct
import tokenize
import warnings
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
import numpy.lib.format as npy
from numpy.typing import NDArray

from stlc.diagnostics import Diagnostic, TraceError
from stlc.files import atomic_path
from stlc.trace.formats.registry import damage, opened, require_room, unreadable
from stlc.trace.meta import meta_array, read_meta
from stlc.trace.recording import EXTRA, Recording, of_arrays

if TYPE_CHECKING:
    from stlc.trace.trace import Trace

try:
    from lzma import LZMAError
except ImportError:  # a Python without it: `zipfile` reports it
    LZMAError = zlib.error  # type: ignore[misc, assignment]

Array = NDArray[Any]

MAX_NAME = 60_000
"""Greatest length in bytes of the name of an array in an archive."""
MAX_ARRAYS = 10_000

_LAST_LETTER, _PAIRS = 0x10FFFF, (0xD800, 0xDFFF)
"""The last code point, and the range of surrogates."""
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


def read_npz(path: Path) -> dict[str, Array]:
    """Return the arrays of an `.npz` file: numbers of any shape, and texts.

    Raises:
        UsageError: U102, the file does not exist or cannot be opened.
        TraceError: E603, the file is not an archive of plain arrays, is damaged, or would not fit into
            memory.
    """
    with opened(path):
        file = path.open("rb")
    try:
        with file:
            _check_magic(path, file)
            with zipfile.ZipFile(file) as archive:
                return _read_members(path, archive)
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


class ArchiveMember:
    """An array of an open archive, read as a whole or in consecutive chunks of samples.

    Attributes:
        length: number of samples of an array (samples,), (1, samples), (samples, components) or (1, samples,
            components). It is -1 for other arrays, for a square one, whose rows are traces, and for a vector
            in Fortran order, whose samples are not contiguous.
        size: number of bytes.
    """

    def __init__(self, path: Path, archive: zipfile.ZipFile, info: zipfile.ZipInfo, stack: ExitStack) -> None:
        self._path, self._name = path, info.filename.removesuffix(".npy")
        self._stream = stack.enter_context(archive.open(info))
        self._shape, self._fortran, self._dtype = _checked_header(path, self._stream, info, self._name)
        self._vector: tuple[int, ...] = ()
        self.length, self.size = -1, math.prod(self._shape) * self._dtype.itemsize
        match self._shape:
            case (samples,) | (1, samples):
                self.length = samples
            case (samples, components) | (1, samples, components) if not self._fortran:
                square = len(self._shape) == 2 and samples == components
                self.length, self._vector = -1 if square else samples, (components,)

    def read(self, count: int) -> Array:
        """Read the next `count` samples, (count,) or (1, count, components)."""
        values = self._values(count * math.prod(self._vector))
        return values.reshape(1, count, *self._vector) if self._vector else values

    def whole(self) -> Array:
        """Read the whole array, in its own shape."""
        values = self._values(math.prod(self._shape)).copy()
        return values.reshape(self._shape, order="F" if self._fortran else "C")

    def _values(self, count: int) -> Array:
        data = self._stream.read(count * self._dtype.itemsize)
        if len(data) != count * self._dtype.itemsize:
            raise unreadable(self._path, f"`{self._name}` is cut short")
        values = np.frombuffer(data, dtype=self._dtype) if data else np.zeros(0, self._dtype)
        _check_letters(self._path, self._name, values)
        return values


def _infos(path: Path, archive: zipfile.ZipFile) -> dict[str, zipfile.ZipInfo]:
    """Return the files in an archive: name of the array -> description of its file."""
    members = archive.infolist()
    if len(members) > MAX_ARRAYS:
        raise unreadable(path, f"it holds {len(members)} arrays, more than {MAX_ARRAYS}")
    found: dict[str, zipfile.ZipInfo] = {}
    for member in members:
        name = member.filename.removesuffix(".npy")
        if name in found:
            raise unreadable(path, f"it holds the array `{name}` twice")
        found[name] = member
    return found


def _read_members(path: Path, archive: zipfile.ZipFile) -> dict[str, Array]:
    infos = _infos(path, archive)
    require_room(path, sum(info.file_size for info in infos.values()))
    arrays: dict[str, Array] = {}
    for name, info in infos.items():
        with ExitStack() as stack:
            arrays[name] = ArchiveMember(path, archive, info, stack).whole()
    return arrays


def _check_letters(path: Path, name: str, values: Array) -> None:
    """Check that texts consist of valid Unicode code points. Raises TraceError (E603)."""
    if values.dtype.kind == "U" and values.dtype.itemsize and values.size:
        letters = values.view(np.dtype(np.uint32).newbyteorder(values.dtype.byteorder))
        if ((letters > _LAST_LETTER) | ((letters >= _PAIRS[0]) & (letters <= _PAIRS[1]))).any():
            raise unreadable(path, f"`{name}` holds texts with numbers that are no letters")


def _checked_header(
    path: Path, stream: IO[bytes], member: zipfile.ZipInfo, name: str
) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Read the header (shape, Fortran order, dtype) of an array of numbers or texts.

    Raises:
        TraceError: E603, another kind of array, or its size differs from the size in the archive.
    """
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


# ------------------------------------------------------------------------------- as a format


def read(path: Path) -> Recording:
    """Return the content of a trace file.

    Raises the errors of `read_npz`, and E603 if the array `meta` is invalid.
    """
    arrays = read_npz(path)
    meta, columns = read_meta(path, arrays.pop("meta", None))
    return replace(of_arrays(path, arrays, meta), columns=columns)


def size(path: Path) -> int:
    """Size of all unpacked arrays in bytes; 0 if the file is not an archive, or cannot be opened."""
    if not zipfile.is_zipfile(path):
        return 0
    try:
        with zipfile.ZipFile(path) as archive:
            return sum(member.file_size for member in archive.infolist())
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError):
        return 0


def chunks(path: Path, samples: int) -> Iterator[Recording]:
    """Yield the trace of a file in chunks of `samples` samples. Raises the errors of `read`."""
    with ExitStack() as stack, damage(path):
        archive = stack.enter_context(zipfile.ZipFile(path))
        members = {name: ArchiveMember(path, archive, i, stack) for name, i in _infos(path, archive).items()}
        described = members.pop("meta", None)
        signals = {name: m for name, m in members.items() if not name.startswith(EXTRA)}
        length = max((member.length for member in signals.values()), default=0)
        odd = [name for name, member in signals.items() if member.length != max(length, 0)]
        if odd:
            message = (
                f"`{odd[0]}` in `{path}` is not one value per sample: such a file cannot be read in pieces"
            )
            raise TraceError(Diagnostic("E605", message))
        share = min(samples, length) / max(length, 1)
        size = share * sum(member.size for member in signals.values())
        require_room(path, int(size) + (0 if described is None else described.size), chunk=True)
        meta, columns = read_meta(path, None if described is None else described.whole())
        for begin in range(0, length, samples):
            count = min(samples, length - begin)
            arrays = {name: member.read(count) for name, member in signals.items()}
            yield replace(of_arrays(path, arrays, meta), columns=columns)


def write(path: Path | str, trace: Trace) -> None:
    """Write a trace with its extras and metadata. Raises the errors of `write_npz`."""
    arrays: dict[str, Array] = {"t": trace.times, **trace.data}
    arrays |= {f"{EXTRA}{name}": np.asarray(values) for name, values in trace.extras.items()}
    arrays["meta"] = meta_array(replace(trace.meta, dt=trace.dt), trace.signature)
    write_npz(path, arrays)


def write_npz(path: Path | str, arrays: Mapping[str, Array]) -> None:
    """Write arrays to a temporary file and rename it to `path`; equal arrays always give equal bytes.

    Raises:
        TraceError: E603, a name is too long.
        MissingError: R201, no space left or no permission; an existing file is not changed.
    """
    with atomic_path(path) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED) as archive:
        for name, array in arrays.items():
            if len(name.encode()) > MAX_NAME:
                raise unreadable(Path(path), f"a name of {len(name)} characters is too long for an archive")
            with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as stream:
                npy.write_array(stream, np.asarray(array), allow_pickle=False)
