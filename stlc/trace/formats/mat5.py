"""MATLAB's file format of version 5 ("MAT-File Level 5"), restricted to numbers; no content is executed.

A file consists of elements. An element is a tag (type, number of bytes), followed by data padded to 8 bytes.
A compressed element contains one element in compressed form (deflate). Sizes are checked against the
available bytes before memory is allocated.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stlc.trace.formats.npz import MAX_ARRAYS
from stlc.trace.formats.registry import room_for, unreadable

Array = NDArray[Any]

_HEADER = 128
_MATRIX, _COMPRESSED = 14, 15
_DTYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_STRUCT = 2
_NUMERIC = range(6, 16)
_CLASSES = {6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8"}
_LOGICAL, _COMPLEX = 0x02, 0x08
_DEEPEST = 16


class _DamageError(Exception):
    """Error in a file: its bytes violate the file format."""


@dataclass(frozen=True, slots=True)
class _Element:
    kind: int
    data: memoryview


def read_mat5(path: Path) -> dict[str, Array]:
    """Return numeric and logical arrays by name; the fields of a 1 x 1 structure `s` are called `s.field`.

    An array is complex only if an imaginary part is not 0.

    Raises:
        TraceError: E603, the file is damaged, or larger than the limit.
    """
    try:
        raw = path.read_bytes()
        order = "<" if raw[126:128] == b"IM" else ">"
        found: dict[str, Array] = {}
        room = room_for(path)
        for element in _elements(memoryview(raw)[_HEADER:], order):
            if element.kind == _COMPRESSED:
                data = _inflated(element.data, room)
                room -= len(data)
                element = next(_elements(memoryview(data), order), _Element(0, memoryview(b"")))
            if element.kind == _MATRIX:
                name, rest = _named(element.data, order)
                _add(found, name, rest, order, 0)
    except (_DamageError, struct.error, zlib.error, ValueError, OverflowError, UnicodeDecodeError) as error:
        raise unreadable(path, f"it is damaged or cut short ({error})") from None
    return found


def _inflated(data: memoryview, room: int) -> bytes:
    """Decompress an element, which may expand to at most `room` bytes."""
    engine = zlib.decompressobj()
    out = engine.decompress(data, room)
    if engine.unconsumed_tail:
        raise _DamageError(f"it unpacks to more than {room / 1e9:.1f} GB")
    if not engine.eof:
        raise _DamageError("compressed data that ends early")
    return out


def _elements(data: memoryview, order: str) -> Iterator[_Element]:
    at = 0
    while at + 8 <= len(data):
        kind, size = struct.unpack_from(f"{order}II", data, at)
        if kind >> 16:  # a small element: both in one word, up to 4 bytes behind it
            kind, size, start = kind & 0xFFFF, kind >> 16, at + 4
            if size > 4:
                raise _DamageError("a small element of more than 4 bytes")
            end = at + 8
        else:
            start = at + 8
            end = start + size if kind == _COMPRESSED else start + (size + 7) // 8 * 8
        if start + size > len(data):
            raise _DamageError(f"{size} bytes are declared, {len(data) - start} follow")
        yield _Element(kind, data[start : start + size])
        at = end
    if at < len(data) and any(data[at:]):
        raise _DamageError("bytes behind the last element")


@dataclass(frozen=True, slots=True)
class _Matrix:
    """Type, shape and data of an array in the file."""

    kind: int
    logical: bool
    imaginary: bool
    shape: tuple[int, ...]
    parts: tuple[_Element, ...]


def _named(data: memoryview, order: str) -> tuple[str, _Matrix]:
    """Return the name and the content of an array element.

    An element without sub-elements is an empty array without a name.
    """
    parts = list(islice(_elements(data, order), MAX_ARRAYS + 1))
    if len(parts) > MAX_ARRAYS:
        raise _DamageError("too many parts")
    if not parts:
        return "", _Matrix(6, False, False, (0,), ())
    if len(parts) < 3 or len(parts[0].data) < 8:
        raise _DamageError("an array without a head")
    flags = struct.unpack_from(f"{order}I", parts[0].data)[0]
    shape = tuple(int(n) for n in _numbers(parts[1], order))
    if not shape or min(shape) < 0:
        raise _DamageError("an array without dimensions")
    name = bytes(parts[2].data).decode("latin-1").rstrip("\0")
    bits = flags >> 8
    return name, _Matrix(flags & 0xFF, bool(bits & _LOGICAL), bool(bits & _COMPLEX), shape, tuple(parts[3:]))


def _add(found: dict[str, Array], name: str, matrix: _Matrix, order: str, depth: int) -> None:
    """Add a numeric array, or the fields of a structure, to `found`; other variables are left out."""
    if depth > _DEEPEST or len(found) > MAX_ARRAYS:
        raise _DamageError("nested too deeply, or too many arrays")
    if matrix.kind == _STRUCT:
        for field, inner in _fields(matrix, order):
            _add(found, f"{name}.{field}", inner, order, depth + 1)
    elif matrix.kind in _NUMERIC and matrix.parts:
        dtype = "?" if matrix.logical else _CLASSES[matrix.kind]
        values = _part(name, matrix, 0, order).astype(dtype)
        if matrix.imaginary and (turned := _part(name, matrix, 1, order)).any():
            values = complex_of(values, turned)
        found[name] = values.reshape(matrix.shape, order="F")


def complex_of(real: Array, turned: Array) -> Array:
    """Return complex numbers with the real parts `real` and the imaginary parts `turned`."""
    made = np.empty(real.shape, dtype=np.complex128)
    made.real, made.imag = real, turned
    return made


def _part(name: str, matrix: _Matrix, index: int, order: str) -> Array:
    """Return the real parts (`index` 0) or the imaginary parts (`index` 1) of an array, flattened."""
    values = _numbers(matrix.parts[index], order) if index < len(matrix.parts) else np.zeros(0)
    if len(values) != math.prod(matrix.shape):
        shown = " x ".join(map(str, matrix.shape))
        raise _DamageError(f"`{name}` declares {shown} values, {len(values)} follow")
    return values


def _fields(matrix: _Matrix, order: str) -> Iterator[tuple[str, _Matrix]]:
    if math.prod(matrix.shape) != 1 or len(matrix.parts) < 2:
        return
    width = int(_numbers(matrix.parts[0], order)[:1].sum())
    names = bytes(matrix.parts[1].data)
    if width <= 0 or len(names) % width:
        raise _DamageError("a structure without names")
    fields = [names[i : i + width].split(b"\0")[0].decode("latin-1") for i in range(0, len(names), width)]
    if len(fields) != len(matrix.parts) - 2:
        raise _DamageError(f"a structure of {len(fields)} fields with {len(matrix.parts) - 2} values")
    for field, part in zip(fields, matrix.parts[2:], strict=True):
        if part.kind == _MATRIX:
            yield field, _named(part.data, order)[1]


def _numbers(element: _Element, order: str) -> Array:
    if element.kind not in _DTYPES:
        raise _DamageError(f"data of type {element.kind} where numbers are expected")
    return np.frombuffer(element.data, dtype=np.dtype(order + _DTYPES[element.kind]))
