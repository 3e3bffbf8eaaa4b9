"""Logged messages as a recording: every number is a signal, every topic has a clock.

`/odom` with `twist.twist.linear.x` gives `odom.twist.twist.linear.x`; a message with the single field `data`
is named after its topic. Times are those at which a message was logged, in seconds since the first one. Most
logs are read with `--resample`, since no two topics share a clock.
"""

from __future__ import annotations

import bz2
import math
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from mmap import ACCESS_READ, mmap
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stlc.signature import Column
from stlc.trace.formats.registry import needed, opened, unreadable
from stlc.trace.meta import TraceMeta
from stlc.trace.recording import ClockGroup, Recording

MAX_BYTES = 2_000_000_000
MAX_VALUES = 100_000_000
LONGEST = 64
"""Arrays of more numbers than this are data (images, scans), not signals."""
DEEPEST = 12
"""Greatest nesting depth of a number that is a signal."""
STAMPS = ({"sec", "nanosec"}, {"secs", "nsecs"}, {"sec", "nsec"}, {"seconds", "nanos"})
"""Field names of a time stamp in the message languages."""
HEADER = "header"
"""The field that is no signal: its time stamp repeats the clock."""

_ROOM = 64_000_000
_RATIO = 50
"""Compressed data may expand to `_ROOM` bytes, or to this multiple of the file's size."""
_LATEST = 2**63 - 1
_ZSTD = b"\x28\xb5\x2f\xfd"


@dataclass(frozen=True, slots=True)
class MessageNumber:
    """A number in a message.

    Attributes:
        name: its path in the message, `twist.linear.x`.
        value: the number.
        whole: it is an integer or a truth value.
    """

    name: str
    value: float
    whole: bool = False


Decode = Callable[[bytes], Iterable[MessageNumber]]
"""Function from the bytes of a message to its numbers; the name "" stands for the topic itself."""


class DamageError(Exception):
    """Bytes that do not follow the format."""


@dataclass(slots=True)
class _Topic:
    times: array[int] = field(default_factory=lambda: array("q"))
    values: dict[str, array[float]] = field(default_factory=dict)
    whole: set[str] = field(default_factory=set)

    def arrays(self) -> tuple[NDArray[np.int64], dict[str, NDArray[np.float64]]]:
        """Increasing times in ns, and the signals that occur in every message, as arrays (messages,)."""
        times = np.array(self.times, dtype=np.int64)
        kept = {n: np.array(x, dtype=np.float64) for n, x in self.values.items() if len(x) == len(times)}
        if (np.diff(times) < 0).any():
            order = np.argsort(times, kind="stable")
            return times[order], {name: values[order] for name, values in kept.items()}
        return times, kept


@contextmanager
def mapped(path: Path) -> Iterator[mmap]:
    """The bytes of a file, memory-mapped.

    Raises:
        UsageError: U102, the file does not exist or cannot be opened.
        TraceError: E603, it is empty, or larger than it may be.
    """
    with opened(path), path.open("rb") as file:
        size = file.seek(0, 2)
        if size > MAX_BYTES:
            raise unreadable(path, f"it is larger than {MAX_BYTES / 1e9:.0f} GB", advice="split it")
        if not size:
            raise unreadable(path, "it is empty")
        data = mmap(file.fileno(), 0, access=ACCESS_READ)
    with data:
        yield data


class Log:
    """The collected messages of one or several files.

    Attributes:
        path: for messages.
        unread: why topics are left out: topic -> reason.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.unread: dict[str, str] = {}
        self._topics: dict[str, _Topic] = {}
        self._values = 0

    def add(self, topic: str, time: int, numbers: Iterable[MessageNumber]) -> None:
        """Add a message, logged at `time` in ns. Raises TraceError (E603) for an invalid time."""
        if not -_LATEST <= time <= _LATEST:
            raise unreadable(
                self.path, f"a message of `{topic[:80]}` was logged at {time} ns, which is no time"
            )
        into = self._topics.setdefault(topic, _Topic())
        into.times.append(time)
        for number in numbers:
            name = number.name
            held = into.values.get(name)
            if held is None:
                held = into.values[name] = array("d")
                if len(into.values) > MAX_VALUES // 1000:
                    raise unreadable(self.path, f"a message of `{topic[:80]}` has too many fields")
            held.append(number.value)
            if number.whole:
                into.whole.add(name)
            self._values += 1
        if self._values > MAX_VALUES:
            raise unreadable(self.path, f"it holds more than {MAX_VALUES:,} numbers", advice="split it")

    def recording(self) -> Recording:
        """A recording with a clock for each topic; signals must be in every message of their topic.

        Raises:
            TraceError: E603, no message has a number.
        """
        found = {name: topic.arrays() for name, topic in self._topics.items()}
        origin = min((int(times[0]) for times, _ in found.values() if len(times)), default=0)
        groups: list[ClockGroup] = []
        columns: dict[str, Column] = {}
        for topic, (times, arrays) in found.items():
            base = topic.strip("/").replace("/", ".")
            named = {_called(base, name): values for name, values in arrays.items()}
            clock = np.array([(t - origin) * 1e-9 for t in times.tolist()], dtype=np.float64)
            groups.append(ClockGroup(named, clock))
            whole = self._topics[topic].whole
            columns |= {n: Column(n, kind="int") for n in (_called(base, m) for m in whole if m in arrays)}
        if not any(group.arrays for group in groups):
            raise unreadable(self.path, self._nothing())
        return Recording(str(self.path), tuple(groups), columns, TraceMeta(origin=origin))

    def topic(self, name: str) -> tuple[NDArray[np.int64], dict[str, NDArray[np.float64]]]:
        """Return times in ns and signals of one topic; empty where it has no message."""
        return self._topics.get(name, _Topic()).arrays()

    def _nothing(self) -> str:
        reasons = list(dict.fromkeys(self.unread.values()))
        return "it holds no message with numbers" + (f": {', '.join(reasons[:3])}" if reasons else "")


def _called(topic: str, name: str) -> str:
    return f"{topic}.{name}" if name and not name.startswith("[") and topic else topic + name


# ----------------------------------------------------------------------- JSON-like content


def numbers_of(content: object) -> Iterator[MessageNumber]:
    """Yield all numbers of a JSON message, with their paths.

    Raises:
        OverflowError: a number is larger than a float.
    """
    if isinstance(content, dict) and set(content) == {"data"}:
        content = content["data"]
    yield from _walk("", content, 0)


def _walk(name: str, value: object, depth: int) -> Iterator[MessageNumber]:
    if isinstance(value, (int, float)):
        yield MessageNumber(name, float(value), isinstance(value, int))
    elif value is None:
        yield MessageNumber(name, math.nan)
    elif depth > DEEPEST:
        return
    elif isinstance(value, (list, tuple)):
        if len(value) <= LONGEST:
            for i, item in enumerate(value):
                yield from _walk(f"{name}[{i}]", item, depth + 1)
    elif isinstance(value, dict):
        yield from _entries(name, value, depth)


def _entries(name: str, value: Mapping[str, object], depth: int) -> Iterator[MessageNumber]:
    if set(value) in STAMPS:
        seconds, parts = (v if isinstance(v, (int, float)) else math.nan for v in value.values())
        yield MessageNumber(name, seconds + 1e-9 * parts)
        return
    for key, item in value.items():
        if key != HEADER:
            yield from _walk(f"{name}.{key}" if name else key, item, depth + 1)


# ------------------------------------------------------------------------- compressed data


class Room:
    """The limit on decompressed bytes, shared by all parts of a file."""

    def __init__(self, path: Path, size: int) -> None:
        self.path = path
        self.left = min(MAX_BYTES, max(_ROOM, _RATIO * size))

    def unpacked(self, how: str, data: bytes, size: int) -> bytes:
        """The decompressed bytes (`bz2`, `lz4`, `zstd`, or none), as many as were declared.

        Raises:
            TraceError: E603, more than there is room for.
            MissingError: R301, the compression needs a package.
            DamageError: another number of bytes.
        """
        if size > self.left:
            raise unreadable(self.path, f"it unpacks to {size / 1e9:.3g} GB or more", advice="split it")
        if how in ("", "none"):
            out = bytes(data)
        elif how == "bz2":
            out = bz2.BZ2Decompressor().decompress(data, max_length=size + 1)
        elif how == "lz4":
            out = needed("lz4.frame").LZ4FrameDecompressor().decompress(data, max_length=size + 1)
        elif how == "zstd":
            with needed("zstandard").ZstdDecompressor().stream_reader(data) as reader:
                out = reader.read(size + 1)
        else:
            raise DamageError(f"the compression `{how[:20]}` is not known")
        if len(out) != size:
            raise DamageError(f"{size} bytes are declared where {len(out)} are packed")
        self.left -= size
        return out

    def whole(self, message: bytes) -> bytes:
        """A message, decompressed where it is a `zstd` frame of its own, as in ROS 2."""
        return self.of_unknown_size(message) if message.startswith(_ZSTD) else message

    def of_unknown_size(self, data: bytes) -> bytes:
        """The bytes of a `zstd` frame that may not declare its size."""
        with needed("zstandard").ZstdDecompressor().stream_reader(data) as reader:
            out: bytes = reader.read(self.left + 1)
        if len(out) > self.left:
            raise unreadable(
                self.path, f"it unpacks to more than {self.left / 1e9:.3g} GB", advice="split it"
            )
        self.left -= len(out)
        return out
