"""Traces as `.npz` archives, read without unpickling.

The archive is read one array at a time. To be safe against pickles and decompression bombs, the header of
each array is checked against the size that the archive declares before memory is allocated.
"""

from __future__ import annotations

import math
import warnings
import zipfile
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import IO

import numpy as np
import numpy.lib.format as npy

from stlc.diagnostics import TraceError
from stlc.files import File
from stlc.signature import Column
from stlc.trace.formats.arrays import Array, Arrays, no_letters
from stlc.trace.formats.registry import damage, opened, require_room, unreadable
from stlc.trace.meta import TraceMeta, read_meta
from stlc.trace.recording import ALL, EXTRA, Recording, Wanted
from stlc.trace.trace import Trace

MAX_NAME = 60_000
"""Greatest length in bytes of the name of an array in an archive."""
MAX_ARRAYS = 10_000
META = "meta"
_OBJECTS = "holds Python objects, and unpickling them can run code: store numbers, one array per signal"
_ZIP_MAGIC = (b"PK\x03\x04", b"PK\x05\x06")


def read(path: Path, wanted: Wanted = ALL) -> Recording:
    """Read the arrays that are kept; no other is unpacked. Raises UsageError (U102) or TraceError (E603)."""
    with opened(path):
        file = File(path).opened()
    found, extras = Arrays(wanted), dict[str, Array]()
    total = 0
    with file, damage(path):
        _check_magic(path, file)
        with zipfile.ZipFile(file) as archive:
            infos, meta, columns = _infos(path, archive, found)
            for name, info in infos.items():
                with ExitStack() as stack:
                    member = ArchiveMember(path, archive, info, stack)
                    if member.refused:
                        found.refuse(name, member.refused)
                        continue
                    total += member.size
                    require_room(path, total)
                    if name.startswith(EXTRA):
                        extras[name.removeprefix(EXTRA)] = member.whole()
                    else:
                        found.add(name, member.whole())
    return found.recording(path, meta=meta, columns=columns, extras=extras)


def read_arrays(path: Path) -> dict[str, Array]:
    """Read all arrays of an archive, by name. Raises UsageError (U102) or TraceError (E603), as `read`."""
    with opened(path):
        file = File(path).opened()
    found: dict[str, Array] = {}
    total = 0
    with file, damage(path):
        _check_magic(path, file)
        with zipfile.ZipFile(file) as archive:
            if len(archive.infolist()) > MAX_ARRAYS:
                raise unreadable(path, f"it holds more than {MAX_ARRAYS} arrays")
            for info in archive.infolist():
                with ExitStack() as stack:
                    member = ArchiveMember(path, archive, info, stack)
                    if member.refused:
                        raise unreadable(path, f"`{info.filename}` {member.refused}")
                    total += member.size
                    require_room(path, total)
                    found[info.filename.removesuffix(".npy")] = member.whole()
    return found


def _check_magic(path: Path, file: IO[bytes]) -> None:
    start = file.read(6)
    file.seek(0)
    if start[:1] in (b"\x93", b"\x80"):
        why = "it is a single array" if start[1:] == b"NUMPY" else "it is a pickle, and pickles can run code"
        raise unreadable(path, why, advice="save one array per signal with `np.savez`")
    if start[:4] not in _ZIP_MAGIC:
        raise unreadable(path, "it is not an `.npz` archive" if start else "it is empty")
    if not zipfile.is_zipfile(file):
        raise unreadable(path, "the archive is damaged or cut short")


class ArchiveMember:
    """An array of an open archive, read as a whole or in consecutive chunks of samples.

    Attributes:
        length: number of samples; -1 for an array of another shape than (samples,) or (samples, components),
            with or without (1, …), for a square one, whose rows are traces, and for one in Fortran order.
        size: number of bytes.
        refused: why it has no values; "" if it has some.
        text: whether it is a single text.
    """

    def __init__(self, path: Path, archive: zipfile.ZipFile, info: zipfile.ZipInfo, stack: ExitStack) -> None:
        self._path, self._name = path, info.filename.removesuffix(".npy")
        self._stream = stack.enter_context(archive.open(info))
        version = npy.read_magic(self._stream)
        readers = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
        if version not in readers:
            raise unreadable(path, f"`{self._name}` has the array format {version[0]}.{version[1]}")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            self._shape, self._fortran, self._dtype = readers[version](self._stream)
        self.refused = _OBJECTS if self._dtype.hasobject else ""
        self.text = self._dtype.kind == "U" and not self._shape
        self._vector: tuple[int, ...] = ()
        self.length, self.size = -1, math.prod(self._shape) * self._dtype.itemsize
        room = info.file_size - self._stream.tell()
        if min(self._shape, default=1) < 0 or (self.size != room and not self.refused):
            shown = " x ".join(map(str, self._shape))
            raise unreadable(path, f"`{self._name}` declares {shown} values, but {max(room, 0)} bytes follow")
        match self._shape:
            case (samples,) | (1, samples) | (samples, 1) | (1, samples, 1):
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


def _infos(
    path: Path, archive: zipfile.ZipFile, found: Arrays
) -> tuple[dict[str, zipfile.ZipInfo], TraceMeta, Mapping[str, Column]]:
    """Return the files of the arrays that are kept, by name, and what the text `meta` tells."""
    members = archive.infolist()
    if len(members) > MAX_ARRAYS:
        raise unreadable(path, f"it holds {len(members)} arrays, more than {MAX_ARRAYS}")
    infos = {member.filename.removesuffix(".npy"): member for member in members}
    if len(infos) < len(members):
        twice = Counter(member.filename.removesuffix(".npy") for member in members).most_common(1)[0][0]
        raise unreadable(path, f"it holds the array `{twice}` twice")
    described = None
    if META in infos:
        with ExitStack() as stack:
            member = ArchiveMember(path, archive, infos[META], stack)
            if member.text:
                require_room(path, member.size)
                described = member.whole()
                del infos[META]
    ours = described is not None
    kept = {n: info for n, info in infos.items() if (ours and n.startswith(EXTRA)) or found.takes(n)}
    return kept, *read_meta(path, described)


def _check_letters(path: Path, name: str, values: Array) -> None:
    for part in values.dtype.names or ():
        _check_letters(path, f"{name}.{part}", values[part])
    if values.dtype.kind == "U" and values.dtype.itemsize and values.size:
        letters = np.ascontiguousarray(values).view(np.dtype(np.uint32).newbyteorder(values.dtype.byteorder))
        if no_letters(letters).any():
            raise unreadable(path, f"`{name}` holds texts with numbers that are no letters")


def size(path: Path, wanted: Wanted = ALL) -> int:
    """Size of the arrays that are kept, unpacked, in bytes; 0 if the file is not an archive that opens."""
    try:
        with zipfile.ZipFile(path) as archive:
            kept = [each for each in archive.infolist() if wanted.keeps(each.filename.removesuffix(".npy"))]
            return sum(member.file_size for member in kept)
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError):
        return 0


def chunks(path: Path, samples: int, wanted: Wanted = ALL) -> Iterator[Recording]:
    """Yield the trace of a file in chunks of `samples` samples. Raises the errors of `read`."""
    with ExitStack() as stack, damage(path):
        archive = stack.enter_context(zipfile.ZipFile(path))
        found = Arrays(wanted)
        infos, meta, columns = _infos(path, archive, found)
        arrays = {name: info for name, info in infos.items() if not name.startswith(EXTRA)}
        members = {name: ArchiveMember(path, archive, info, stack) for name, info in arrays.items()}
        for name in [name for name, member in members.items() if member.refused]:
            found.refuse(name, members.pop(name).refused)
        read = {name: member for name, member in members.items() if wanted.reads(name)}
        length = max((member.length for member in read.values()), default=0)
        for name, member in read.items():
            if member.length != max(length, 0):
                why = f"`{name}` in `{path}` is not one value per sample: it cannot be read in pieces"
                raise TraceError.of("E605", why)
        members = {name: member for name, member in members.items() if member.length == length}
        share = min(samples, length) / max(length, 1)
        require_room(path, int(share * sum(member.size for member in members.values())), chunk=True)
        for begin in range(0, length, samples):
            piece = replace(found, kept={})
            for name, member in members.items():
                piece.add(name, member.read(min(samples, length - begin)), piece=True)
            yield piece.recording(path, meta=meta, columns=columns)


def write(path: Path | str, trace: Trace) -> None:
    """Write a trace with its extras and metadata. Raises the errors of `write_npz`."""
    arrays: dict[str, Array] = {"t": trace.times, **trace.data}
    arrays |= {f"{EXTRA}{name}": np.asarray(values) for name, values in trace.extras.items()}
    arrays[META] = replace(trace.meta, dt=trace.dt).array(trace.signature)
    write_npz(path, arrays)


def write_npz(path: Path | str, arrays: Mapping[str, Array]) -> None:
    """Write arrays to a temporary file and rename it to `path`; equal arrays always give equal bytes.

    Raises:
        TraceError: E603, a name is too long.
        MissingError: R201, no space left or no permission; an existing file is not changed.
    """
    with File(path).replaced() as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED) as archive:
        for name, array in arrays.items():
            if len(name.encode()) > MAX_NAME:
                raise unreadable(Path(path), f"a name of {len(name)} characters is too long for an archive")
            with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as stream:
                npy.write_array(stream, np.asarray(array), allow_pickle=False)
