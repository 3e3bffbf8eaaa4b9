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
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

import numpy as np

from stlc.trace.formats.messages import LONGEST, DamageError, Decode
from stlc.trace.formats.paths import NOTHING, Selection

Form = Literal["ros1", "cdr"]
Read: TypeAlias = Callable[[bytes, int], tuple[object, int]]
"""Function from a message and a position in it to the value there and the position after it."""

_TYPES = "bool byte char octet int8 uint8 int16 uint16 int32 uint32 int64 uint64 float32 float64"
_CODES = dict(zip(_TYPES.split(), "?BBBbBhHiIqQfd", strict=True))
"""Plain type of a field -> its code in `struct`."""
_STAMPS = {"time": "uint32 secs\nuint32 nsecs", "duration": "int32 secs\nint32 nsecs"}
"""Types of ROS 1 that are written like messages of two numbers."""
_TEXTS = ("string", "wstring")
_SECTION = re.compile(r"^={3,}[ \t]*\n(?:MSG: ?)", re.MULTILINE)
_FIELD = re.compile(
    r"\s*(?:(?P<type>[A-Za-z]\w*(?:/\w+)*)(?:<=\d+)?(?:\[(?P<array>(?:<=)?\d*)\])?\s+"
    r"(?P<name>[A-Za-z]\w*)\s*(?P<constant>=)?.*)?",
    re.ASCII,
)
_MAX_TEXT = 1_000_000
_MAX_NESTED = 32
_MANY = 100_000
"""Longer arrays of messages or texts are left out."""
_WIDEST = 8
"""Greatest alignment of a number in CDR, in bytes."""


@dataclass(frozen=True, slots=True, eq=False)
class _Type:
    """Type of a field: a number or text by its name, or a message of fields."""

    name: str
    fields: tuple[_Field, ...]
    least: int
    sizes: tuple[int, ...] | None


@dataclass(frozen=True, slots=True)
class _Field:
    """A field of a message; `count` is the length of an array, -1 if it varies, None for a single value."""

    name: str
    type: _Type
    count: int | None


def decoder(definition: str, form: Form, selection: Selection) -> Decode:
    """Return a decoder of the selected fields of the messages that `definition` describes.

    `form` is the encoding of the messages: "ros1" or "cdr" (ROS 2). The decoder raises DamageError or
    struct.error if a message is shorter than its definition, or an array is longer than its message.

    Raises DamageError if the text is not a definition, contains itself, or refers to an undefined message.
    """
    if len(definition) > _MAX_TEXT:
        raise DamageError("a definition of more than a million letters")
    root, *others = _SECTION.split(definition.replace("\r\n", "\n"))
    texts = dict(_STAMPS) if form == "ros1" else {}
    texts |= {_short(name.strip()): text for name, _, text in (other.partition("\n") for other in others)}
    message = _Builder(texts, form).message(root, "", 0)
    little, big = (_Plan(form, order).message(message, selection, whole=False) for order in "<>")

    def decode(data: bytes) -> object:
        if form == "ros1":
            return little(data, 0)[0]
        if len(data) < 4 or data[1] not in (0, 1):
            raise DamageError("a message that is not plain CDR")
        return (little if data[1] else big)(data[4:], 0)[0]

    return decode


def _short(name: str) -> str:
    """Return the message type `name` as `package/Type`, without the folder `msg` of ROS 2."""
    return re.sub("/(msg|action|srv)/", "/", name)


@dataclass(slots=True)
class _Builder:
    texts: dict[str, str]
    form: Form
    made: dict[str, _Type] = field(default_factory=dict)

    def message(self, text: str, package: str, depth: int) -> _Type:
        if depth > _MAX_NESTED:
            raise DamageError("a definition that contains itself, or is nested too deeply")
        fields, least = [], 0
        for line in text.split("\n"):
            match = _FIELD.fullmatch(line.split("#")[0].rstrip())
            if match is None:
                raise DamageError(f"`{line.strip()[:40]}` is no line of a definition")
            if match["name"] and not match["constant"]:
                size = match["array"]
                count = None if size is None else int(size) if size.isdigit() else -1
                kind = self.type(match["type"], package, depth)
                fields.append(_Field(match["name"], kind, count))
                least += 4 if count == -1 else kind.least * (1 if count is None else count)
        if not fields and self.form == "cdr":  # one byte is written, which has no name
            fields, least = [_Field("", self.type("byte", "", depth), None)], 1
        return _Type("", tuple(fields), least, _sizes(fields))

    def type(self, name: str, package: str, depth: int) -> _Type:
        """Return the type that is called `name` in a package. Raises DamageError if it is not defined."""
        if name in _TEXTS:
            return _Type(name, (), 4, None)
        if name in _CODES:
            size = struct.calcsize(_CODES[name])
            aligned = size if self.form == "cdr" else 1
            return _Type(name, (), size, tuple(-at % aligned + size for at in range(_WIDEST)))
        short = "std_msgs/Header" if name == "Header" else _short(name)
        similar = (each for each in self.texts if each.endswith(f"/{short}"))
        full = next((each for each in (short, f"{package}/{short}", *similar) if each in self.texts), None)
        if full is None:
            raise DamageError(f"`{name[:40]}` is not defined")
        if full not in self.made:
            self.made[full] = self.message(self.texts[full], full.rpartition("/")[0], depth + 1)
        return self.made[full]


def _sizes(fields: Iterable[_Field]) -> tuple[int, ...] | None:
    """Number of bytes of fields in a row by their position modulo `_WIDEST`; None if it varies."""
    found = [0] * _WIDEST
    for each in fields:
        kind, count = each.type, 1 if each.count is None else each.count
        if kind.sizes is None or count < 0 or (kind.fields and count > LONGEST):
            return None
        one_by_one = count if kind.fields else min(count, 1)  # further numbers are aligned
        for _ in range(one_by_one):
            found = [n + kind.sizes[(start + n) % _WIDEST] for start, n in enumerate(found)]
        found = [n + (count - one_by_one) * kind.least for n in found]
    return tuple(found)


@dataclass(slots=True)
class _Plan:
    """Builder of the functions that read messages in one byte order; what is not selected is skipped."""

    form: Form
    order: str
    made: dict[tuple[_Type, Selection, bool], Read] = field(default_factory=dict)

    def message(self, kind: _Type, selection: Selection, *, whole: bool = True) -> Read:
        """Function that reads a message, and that ends after the last selected field if not `whole`."""
        key = (kind, selection, whole)
        if key in self.made:
            return self.made[key]
        names = frozenset(each.name for each in kind.fields)
        parts: list[tuple[str, Read]] = []
        passed: list[_Field] = []
        for each in kind.fields:
            part = selection.part(each.name, names, nested=bool(each.type.fields)) if each.name else None
            if part is None and _sizes((each,)) is not None:
                passed.append(each)
                continue
            parts += [*_past(passed), (each.name if part else "", self.reader(each, part or NOTHING))]
            passed = []
        parts += _past(passed)
        while parts and not (whole or parts[-1][0]):
            parts.pop()
        least = kind.least

        def read(data: bytes, at: int) -> tuple[object, int]:
            if least > len(data) - at:
                raise DamageError("a message that is shorter than its definition")
            found: dict[str, object] = {}
            for name, part in parts if least else ():  # of what takes no byte, there may be any number
                value, at = part(data, at)
                if name:
                    found[name] = value
            return found, at

        self.made[key] = read
        return read

    def reader(self, each: _Field, part: Selection) -> Read:
        kind = each.type
        if kind.name in _CODES:
            return self.numbers(_CODES[kind.name], each.count, part)
        if kind.name in _TEXTS:
            one = self.text(wide=kind.name == "wstring", kept=part is not NOTHING)
        else:
            one = self.message(kind, part)
        return one if each.count is None else self.array(one, each.count, kind.least, part)

    def numbers(self, code: str, count: int | None, part: Selection) -> Read:
        """Function that reads a number, or an array of numbers."""
        unpack, size = struct.Struct(self.order + code).unpack_from, struct.calcsize(code)
        aligned = size if self.form == "cdr" else 1
        length, dtype = self.length(count or 0), np.dtype(self.order + code)

        def one(data: bytes, at: int) -> tuple[object, int]:
            at += -at % aligned
            return unpack(data, at)[0], at + size

        def many(data: bytes, at: int) -> tuple[object, int]:
            n, at = length(data, at)
            at += -at % aligned if n else 0
            end = at + n * size
            if end > len(data):
                raise DamageError("an array that is longer than its message")
            if part is NOTHING or (n > LONGEST and not part.long):
                return (), end
            if n > LONGEST:
                return np.frombuffer(data, dtype, n, at), end
            return struct.unpack_from(f"{self.order}{n}{code}", data, at), end

        return one if count is None else many

    def length(self, count: int) -> Callable[[bytes, int], tuple[int, int]]:
        """Function that reads the length of an array or text, unless it is always `count` >= 0."""
        unpack, aligned = struct.Struct(self.order + "I").unpack_from, 4 if self.form == "cdr" else 1

        def read(data: bytes, at: int) -> tuple[int, int]:
            at += -at % aligned
            return unpack(data, at)[0], at + 4

        return read if count < 0 else lambda _, at: (count, at)

    def array(self, one: Read, count: int, least: int, part: Selection) -> Read:
        """Function that reads an array of texts or messages, each of `least` bytes or more."""
        length = self.length(count)
        most = 0 if part is NOTHING else _MANY if part.long else LONGEST

        def read(data: bytes, at: int) -> tuple[object, int]:
            n, at = length(data, at)
            if least * n > len(data) - at:
                raise DamageError("an array that is longer than its message")
            found: list[object] = []
            for _ in range(n if least else 0):
                value, at = one(data, at)
                if n <= most:
                    found.append(value)
            return found, at

        return read

    def text(self, *, wide: bool, kept: bool) -> Read:
        length, padded = self.length(-1), np.dtype(self.order + "u4")
        ending = "-le" if self.order == "<" else "-be"

        def read(data: bytes, at: int) -> tuple[object, int]:
            n, at = length(data, at)
            end, coding = at + n * (2 if wide else 1), f"utf-16{ending}" if wide else "utf-8"
            if wide and at + 4 * n <= len(data) and (np.frombuffer(data, padded, n, at) < 2**16).all():
                end, coding = at + 4 * n, f"utf-32{ending}"  # until ROS 2 Jazzy, a letter takes 4 bytes
            if end > len(data):
                raise DamageError("a text that is longer than its message")
            found = data[at:end] if kept else b""
            return found.decode(coding, "replace").rstrip("\0"), end

        return read


def _past(fields: Iterable[_Field]) -> Iterator[tuple[str, Read]]:
    """Yield the function that moves past fields of constant size, if there are any."""
    sizes = _sizes(fields)
    if sizes is not None and any(sizes):
        yield "", lambda _, at: (None, at + sizes[at % _WIDEST])
