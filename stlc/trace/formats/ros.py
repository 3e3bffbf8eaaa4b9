"""Decoders of ROS 1 and ROS 2 messages, made from the message definitions in the bag.

A definition is the text of a `.msg` file. The definitions of nested messages follow it. Each of them begins
with a line of `=` and a line `MSG: package/Type` (https://wiki.ros.org/msg,
https://design.ros2.org/articles/interface_definition.html). A ROS 1 message is a sequence of values without
gaps. A ROS 2 message is in the format CDR: a header of 4 bytes, then values aligned to multiples of their
size. Definitions are interpreted, never executed.
"""

from __future__ import annotations

import re
import struct
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

from stlc.trace.formats.messages import (
    DEEPEST,
    HEADER,
    LONGEST,
    STAMPS,
    DamageError,
    MessageNumber,
    seconds_of,
)

Form = Literal["ros1", "cdr"]

_TYPES = "bool byte char octet int8 uint8 int16 uint16 int32 uint32 int64 uint64 float32 float64"
_CODES = dict(zip(_TYPES.split(), "?BBBbBhHiIqQfd", strict=True))
"""Plain type of a field -> its code in `struct`."""
_STAMPS = {"time": "II", "duration": "ii"}
_TEXTS = ("string", "wstring")
_SECTION = re.compile(r"^={3,}[ \t]*\n(?:MSG: ?)", re.MULTILINE)
_FIELD = re.compile(
    r"\s*(?P<type>[A-Za-z]\w*(?:/\w+)*)(?:<=\d+)?(?P<array>\[(?:<=)?\d*\])?\s+(?P<name>[A-Za-z]\w*)\s*(?P<rest>.*)",
    re.ASCII,
)
_MAX_TEXT = 1_000_000
_MAX_NESTED = 32


@dataclass(frozen=True, slots=True)
class _Field:
    """A field of a message.

    Attributes:
        name: name of the field.
        kind: type of the field, as the definition names it.
        count: length of a fixed-length array, -1 for an array of variable length, None for a single value.
        inner: layout of a nested message; None for a number, text or time.
    """

    name: str
    kind: str
    count: int | None
    inner: _Layout | None


@dataclass(frozen=True, slots=True)
class _Layout:
    """The fields of a message in order, and its smallest possible number of bytes."""

    fields: tuple[_Field, ...]
    least: int

    @property
    def stamp(self) -> bool:
        """True if the message is a time stamp (seconds and nanoseconds)."""
        return {each.name for each in self.fields} in STAMPS


def decoder(definition: str, form: Form) -> Decoder:
    """Return a decoder of the messages that `definition` describes.

    `form` is the encoding of the messages: "ros1" or "cdr" (ROS 2).

    Raises:
        DamageError: the text is not a definition, contains itself, or refers to an undefined message.
    """
    if len(definition) > _MAX_TEXT:
        raise DamageError("a definition of more than a million letters")
    root, *others = _SECTION.split(definition.replace("\r\n", "\n"))
    texts = {}
    for other in others:
        name, _, text = other.partition("\n")
        texts[_short(name.strip())] = text
    return Decoder(_Builder(texts, form).layout(root, "", 0), form)


def _short(name: str) -> str:
    """Return the message type `name` as `package/Type`.

    In ROS 2, a name also contains a folder `msg`, `action` or `srv`, which is removed.
    """
    return name.replace("/msg/", "/").replace("/action/", "/").replace("/srv/", "/")


class _Builder:
    """Builder of message layouts from the texts of definitions."""

    def __init__(self, texts: dict[str, str], form: Form) -> None:
        self.texts, self.form = texts, form
        self.made: dict[str, _Layout] = {}

    def layout(self, text: str, package: str, depth: int) -> _Layout:
        if depth > _MAX_NESTED:
            raise DamageError("a definition that contains itself, or is nested too deeply")
        fields = tuple(self.field(line, package, depth) for line in text.split("\n") if _declares(line))
        least = sum(self.least(each) for each in fields)
        return _Layout(fields, max(least, 1) if self.form == "cdr" else least)

    def field(self, line: str, package: str, depth: int) -> _Field:
        match = _FIELD.fullmatch(line.split("#")[0].rstrip())
        if match is None:
            raise DamageError(f"`{line.strip()[:40]}` is no line of a definition")
        size = (match["array"] or "").strip("[]")
        fixed = match["array"] is not None and size.isdigit()
        count = None if match["array"] is None else int(size) if fixed else -1
        kind = match["type"]
        return _Field(match["name"], kind, count, self.inner(kind, package, depth))

    def inner(self, kind: str, package: str, depth: int) -> _Layout | None:
        """Layout of a nested message type; None for a basic type. Raises DamageError for an undefined one."""
        if kind in _CODES or kind in _TEXTS or (kind in _STAMPS and self.form == "ros1"):
            return None
        name = "std_msgs/Header" if kind == "Header" else _short(kind)
        known = [full for full in (name, f"{package}/{name}") if full in self.texts]
        known += [full for full in self.texts if full.endswith(f"/{name}")] if "/" not in name else []
        if not known:
            raise DamageError(f"`{kind[:40]}` is not defined")
        full = known[0]
        if full not in self.made:
            self.made[full] = self.layout(self.texts[full], full.rpartition("/")[0], depth + 1)
        return self.made[full]

    def least(self, each: _Field) -> int:
        if each.count == -1:
            return 4
        many = 1 if each.count is None else each.count
        if each.inner is not None:
            return many * each.inner.least
        if each.kind in _TEXTS:
            return 4 * many
        return many * struct.calcsize("<" + (_CODES.get(each.kind) or _STAMPS[each.kind]))


def _declares(line: str) -> bool:
    """True if a line declares a field, not a constant or a comment."""
    text = line.split("#")[0].rstrip()
    match = _FIELD.fullmatch(text)
    return bool(text) and (match is None or not match["rest"].startswith("="))


@dataclass(frozen=True, slots=True)
class Decoder:
    """Decoder of the ROS messages that one definition describes."""

    layout: _Layout
    form: Form

    def __call__(self, data: bytes) -> Iterator[MessageNumber]:
        """Yield all numbers of a message with their paths, except in fields called `header`.

        Raises:
            DamageError: the message is shorter than its definition, or an array is longer than the message.
            struct.error: the message ends early.
        """
        if self.form == "ros1":
            cursor = _Cursor(data, 0, "<", self.form)
        elif len(data) < 4 or data[1] not in (0, 1):
            raise DamageError("a message that is not plain CDR")
        else:
            cursor = _Cursor(data, 4, "<" if data[1] else ">", self.form)
        if [each.name for each in self.layout.fields] == ["data"]:
            return cursor.field("", self.layout.fields[0], 0)
        return cursor.fields("", self.layout, 0)


def _kept(numbers: Iterator[MessageNumber], wanted: bool) -> Iterable[MessageNumber]:
    """Return the numbers if `wanted`, else nothing.

    Unwanted numbers are read all the same, so that the read position moves past them.
    """
    if wanted:
        return numbers
    deque(numbers, maxlen=0)
    return ()


class _Cursor:
    """Read position in a message."""

    def __init__(self, data: bytes, start: int, order: str, form: Form) -> None:
        self.data, self.at, self.start, self.order, self.form = data, start, start, order, form

    def fields(self, name: str, layout: _Layout, depth: int) -> Iterator[MessageNumber]:
        if layout.least > len(self.data) - self.at:
            raise DamageError("a message that is shorter than its definition")
        if not layout.fields:
            self.at += layout.least  # a message without fields takes a byte in CDR
        for each in layout.fields:
            inner = f"{name}.{each.name}" if name else each.name
            yield from _kept(self.field(inner, each, depth), each.name != HEADER)

    def field(self, name: str, each: _Field, depth: int) -> Iterator[MessageNumber]:
        if each.count is None:
            yield from self.value(name, each, depth)
            return
        count = each.count
        if count < 0:
            (count,) = self.take("I")
        wanted = count <= LONGEST
        if each.inner is None and each.kind in _CODES:
            yield from self.numbers(name, each.kind, count, wanted=wanted)
            return
        if each.inner is not None and each.inner.least * count > len(self.data) - self.at:
            raise DamageError("an array that is longer than its message")
        if each.inner is not None and not each.inner.least:
            return
        for i in range(count):
            yield from _kept(self.value(f"{name}[{i}]", each, depth + 1), wanted)

    def numbers(self, name: str, kind: str, count: int, *, wanted: bool) -> Iterator[MessageNumber]:
        """Yield the numbers of an array if `wanted`, and move the read position past the array.

        Otherwise the array is only skipped, for example an image or a point cloud.
        """
        size = struct.calcsize(_CODES[kind])
        if count and self.form == "cdr":
            self.align(size)
        if count * size > len(self.data) - self.at:
            raise DamageError("an array that is longer than its message")
        if wanted:
            values = struct.unpack_from(f"{self.order}{count}{_CODES[kind]}", self.data, self.at)
            whole = not kind.startswith("float")
            for i, value in enumerate(values):
                yield MessageNumber(f"{name}[{i}]", float(value), whole)
        self.at += count * size

    def value(self, name: str, each: _Field, depth: int) -> Iterator[MessageNumber]:
        if each.inner is not None:
            if each.inner.stamp:
                yield self.stamp(name, each.inner)
            else:
                yield from _kept(self.fields(name, each.inner, depth + 1), depth <= DEEPEST)
        elif each.kind in _TEXTS:
            self.text(each.kind)
        elif each.kind in _CODES:
            (value,) = self.take(_CODES[each.kind])
            yield MessageNumber(name, float(value), not each.kind.startswith("float"))
        else:
            seconds, parts = self.take(_STAMPS[each.kind])
            yield MessageNumber(name, seconds + 1e-9 * parts)

    def stamp(self, name: str, layout: _Layout) -> MessageNumber:
        values = (number.value for number in self.fields("", layout, 0))
        return MessageNumber(
            name, seconds_of({each.name: value for each, value in zip(layout.fields, values, strict=True)})
        )

    def text(self, kind: str) -> None:
        (length,) = self.take("I")
        if kind == "wstring":
            raise DamageError("texts of wide letters are not read")
        if length > len(self.data) - self.at:
            raise DamageError("a text that is longer than its message")
        self.at += length

    def take(self, code: str) -> tuple[Any, ...]:
        """Read values of the `struct` format `code` and move past them."""
        if self.form == "cdr":
            self.align(struct.calcsize(code[0]))
        values = struct.unpack_from(self.order + code, self.data, self.at)
        self.at += struct.calcsize(self.order + code)
        return values

    def align(self, size: int) -> None:
        self.at += -(self.at - self.start) % size
