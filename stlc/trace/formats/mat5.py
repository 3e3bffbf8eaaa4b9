"""MATLAB's file format of version 5 ("MAT-File Level 5"), without executing any of its content.

A file consists of elements. An element is a tag (type, number of bytes), followed by data padded to 8 bytes.
A compressed element contains one element in compressed form (deflate). Sizes are checked against the
available bytes before memory is allocated.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path

import numpy as np

from stlc.trace.formats.arrays import Array, no_letters
from stlc.trace.formats.registry import room_for

_HEADER = 128
_MATRIX, _COMPRESSED = 14, 15
_UTF8, _UTF16, _UTF32 = 16, 17, 18
_DTYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_DTYPES |= {_UTF16: "u2", _UTF32: "u4"}
_CELL, _STRUCT, _OBJECT, _CHAR, _SPARSE, _FUNCTION, _OPAQUE = 1, 2, 3, 4, 5, 16, 17
_CLASSES = {6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8"}
_LOGICAL, _COMPLEX = 0x02, 0x08
MAX_NODES = 200_000
"""Most values in a file."""
_START = 4096
"""Bytes of a compressed element that are unpacked to read the name of its variable."""


@dataclass(frozen=True, slots=True)
class Node:
    """Value in a MATLAB file. Nothing in it is decoded before it is asked for.

    Attributes:
        load: function that returns its numbers, or the codes of its letters; None if it has none.
        cells: elements of a cell array.
        fields: of each element of a structure, in the order of the file: name -> value.
        text: whether each of its rows is a text.
        kind: what it is in MATLAB if it has no plain values, such as `timeseries` or `sparse`; "" if it has.
    """

    shape: tuple[int, ...] = (0,)
    load: Callable[[], Array] | None = None
    cells: Iterable[Node] = ()
    fields: Iterable[Mapping[str, Node]] = ()
    text: bool = False
    kind: str = ""

    @property
    def single(self) -> bool:
        """True for a single text."""
        return self.text and self.shape[0] < 2

    def values(self) -> Array:
        """Decode its numbers or texts; an array without values is empty."""
        made = self.load() if self.load else np.zeros(0)
        return texts_of(made) if self.text else made


@dataclass(frozen=True, slots=True)
class Variable:
    """Variable of a workspace: its name, whether it is more than an array, and its value."""

    name: str
    nested: bool
    node: Callable[[], Node]


@dataclass(frozen=True, slots=True)
class _Element:
    kind: int
    data: memoryview


class Mat5:
    """A file of version 5."""

    def __init__(self, path: Path) -> None:
        self._raw = memoryview(np.memmap(path, np.uint8, mode="r"))  # type: ignore[arg-type]
        self._order = "<" if bytes(self._raw[126:128]) == b"IM" else ">"
        self._room = room_for(path)

    def variables(self) -> Iterator[Variable]:
        """Yield the variables. The data of compressed ones are unpacked when their values are needed."""
        for element in self._elements(self._raw[_HEADER:]):
            inner = element
            if element.kind == _COMPRESSED:
                start = memoryview(zlib.decompressobj().decompress(element.data[:_START], _START))
                inner = _Element(struct.unpack_from(f"{self._order}I", start)[0], start[8:])
            if inner.kind == _MATRIX:
                _, kind, name = self._head(list(islice(self._elements(inner.data), 3)))
                if name:
                    yield Variable(name, kind not in (_CHAR, *_CLASSES), partial(self._value, element))

    def _value(self, element: _Element) -> Node:
        if element.kind == _COMPRESSED:
            engine = zlib.decompressobj()
            data = engine.decompress(element.data, max(self._room, 1))
            if engine.unconsumed_tail:
                raise ValueError(f"it unpacks to more than {self._room / 1e9:.1f} GB")
            if not engine.eof:
                raise ValueError("compressed data that ends early")
            self._room -= len(data)
            element = next(self._elements(memoryview(data)))
        return self._node(element.data)

    def _elements(self, data: memoryview) -> Iterator[_Element]:
        at = 0
        while at + 8 <= len(data):
            kind, size = struct.unpack_from(f"{self._order}II", data, at)
            if kind >> 16:  # a small element: both in one word, up to 4 bytes behind it
                kind, size, start = kind & 0xFFFF, kind >> 16, at + 4
                if size > 4:
                    raise ValueError("a small element of more than 4 bytes")
                end = at + 8
            else:
                start = at + 8
                end = start + size if kind == _COMPRESSED else start + (size + 7) // 8 * 8
            if start + size > len(data):
                raise ValueError(f"{size} bytes are declared, {len(data) - start} follow")
            yield _Element(kind, data[start : start + size])
            at = end
        if at < len(data) and any(data[at:]):
            raise ValueError("bytes behind the last element")

    def _head(self, parts: list[_Element]) -> tuple[int, int, str]:
        """Flags, class and name of an array, from its first three parts: flags, shape and name."""
        if len(parts) < 3 or len(parts[0].data) < 8:
            raise ValueError("an array without a head")
        flags, kind = divmod(struct.unpack_from(f"{self._order}I", parts[0].data)[0], 0x100)
        return flags, kind, bytes(parts[1 if kind == _OPAQUE else 2].data).decode("latin-1").rstrip("\0")

    def _node(self, data: memoryview) -> Node:
        parts = list(islice(self._elements(data), MAX_NODES + 1))
        if len(parts) > MAX_NODES:
            raise ValueError("too many values")
        if not parts:  # an empty array
            return Node()
        flags, kind, _ = self._head(parts)
        if kind in (_OPAQUE, _OBJECT) and len(parts) > 3:
            return Node(kind=bytes(parts[3].data[:60]).decode("latin-1") or "object")
        if kind in (_SPARSE, _FUNCTION):
            return Node(kind="sparse" if kind == _SPARSE else "function_handle")
        shape = tuple(int(n) for n in self._numbers(parts[1]))
        if not shape or min(shape) < 0:
            raise ValueError("an array without dimensions")
        if kind == _CELL:
            return Node(shape, cells=(self._node(each.data) for each in parts[3:] if each.kind == _MATRIX))
        if kind == _STRUCT:
            return Node(shape, fields=self._structures(parts[3:], math.prod(shape)))
        if len(parts) < 4 or kind not in (_CHAR, *_CLASSES):
            return Node(shape)
        if flags & _COMPLEX and len(parts) > 4 and self._numbers(parts[4]).any():
            return Node(kind="complex")
        dtype = "u4" if kind == _CHAR else "?" if flags & _LOGICAL else _CLASSES[kind]
        return Node(shape, partial(self._array, parts[3], shape, dtype), text=kind == _CHAR)

    def _array(self, part: _Element, shape: tuple[int, ...], dtype: str) -> Array:
        values = self._numbers(part)
        if len(values) != math.prod(shape):
            raise ValueError(f"it declares {' x '.join(map(str, shape))} values, {len(values)} follow")
        return values.astype(dtype).reshape(shape, order="F")

    def _structures(self, parts: list[_Element], count: int) -> Iterator[Mapping[str, Node]]:
        if len(parts) < 2:
            return
        width = int(self._numbers(parts[0])[:1].sum())
        raw = bytes(parts[1].data)
        if width <= 0 or len(raw) % width:
            raise ValueError("a structure without names")
        names = [raw[i : i + width].split(b"\0")[0].decode("latin-1") for i in range(0, len(raw), width)]
        if len(names) * count != len(parts) - 2:
            raise ValueError(f"a structure of {len(names)} fields with {len(parts) - 2} values")
        if len(set(names)) < len(names):
            raise ValueError("a structure with several fields of one name")
        values = iter(parts[2:])
        for _ in range(count):
            yield {name: self._node(next(values).data) for name in names}

    def _numbers(self, element: _Element) -> Array:
        if element.kind == _UTF8:  # shapes count units of UTF-16
            text = bytes(element.data).decode("utf-8", "replace")
            return np.frombuffer(text.encode("utf-16-le"), "<u2")
        if element.kind not in _DTYPES:
            raise ValueError(f"data of type {element.kind} where numbers are expected")
        return np.frombuffer(element.data, dtype=np.dtype(self._order + _DTYPES[element.kind]))


def texts_of(codes: Array) -> Array:
    """Return the texts in a matrix of letters (texts, letters), without the blanks at their ends."""
    with np.errstate(invalid="ignore"):
        letters = codes.reshape(len(codes), math.prod(codes.shape[1:])).astype("<u4")
    letters[no_letters(letters)] = 0xFFFD
    if not letters.size:
        return np.zeros(len(letters), "U1")
    return np.char.rstrip(np.ascontiguousarray(letters).view(f"<U{letters.shape[1]}").reshape(-1))
