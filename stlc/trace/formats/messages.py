"""Logged messages converted to signals: every number is a signal, and every topic has its own times.

The number `twist.twist.linear.x` in the topic `/odom` is the signal `odom.twist.twist.linear.x`. If `data` is
the only field of a message, the signal has the name of the topic. A time is the time at which a message was
logged, in seconds since the first message. Since topics have different times, most logs are read with
`--resample`.
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
SECONDS = frozenset({"sec", "secs", "seconds"})
"""Names of the fields that count seconds; the others count nanoseconds."""
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
        name: path of the number in the message, such as `twist.linear.x`.
        value: the number.
        whole: whether the field contains an integer or a truth value.
    """

    name: str
    value: float
    whole: bool = False


Decode = Callable[[bytes], Iterable[MessageNumber]]
"""Function from the bytes of a message to its numbers; the name "" stands for the topic itself."""


class DamageError(Exception):
    """Error in a file or a message: its bytes violate the format."""


@dataclass(slots=True)
class _Topic:
    times: array[int] = field(default_factory=lambda: array("q"))
    values: dict[str, array[float]] = field(default_factory=dict)
    whole: set[str] = field(default_factory=set)

    def arrays(self) -> tuple[NDArray[np.int64], dict[str, NDArray[np.float64]]]:
        """Return the times of all messages in ns, in increasing order, and the signals.

        The signals are a mapping: name -> values, (messages,). Only numbers that every message contains
        become signals.
        """
        times = np.array(self.times, dtype=np.int64)
        kept = {n: np.array(x, dtype=np.float64) for n, x in self.values.items() if len(x) == len(times)}
        if (np.diff(times) < 0).any():
            order = np.argsort(times, kind="stable")
            return times[order], {name: values[order] for name, values in kept.items()}
        return times, kept


@contextmanager
def mapped(path: Path) -> Iterator[mmap]:
    """Open a file as a memory map.

    Raises:
        UsageError: U102, the file does not exist or cannot be opened.
        TraceError: E603, the file is empty, or larger than the limit.
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
    """Collection of the numbers in logged messages, from one or several files.

    Attributes:
        path: path of the log, for messages.
        unread: topic -> reason why its messages were left out.
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
        """Convert the messages to signals.

        A number becomes a signal only if every message of its topic contains it.

        Raises:
            TraceError: E603, no message contains a number.
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
        """Return the times of the topic `name` in ns, increasing, and its signals: name -> (messages,).

        Both are empty if there was no message.
        """
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
        OverflowError: a number exceeds the range of floats.
    """
    if isinstance(content, dict) and set(content) == {"data"}:
        content = content["data"]
    yield from _walk("", content, 0)


def seconds_of(stamp: Mapping[str, float]) -> float:
    """Seconds of a time stamp, name of the field -> value, whose fields may stand in any order."""
    return sum(value if name in SECONDS else 1e-9 * value for name, value in stamp.items())


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
        parts = {key: v if isinstance(v, (int, float)) else math.nan for key, v in value.items()}
        yield MessageNumber(name, seconds_of(parts))
        return
    for key, item in value.items():
        if key != HEADER:
            yield from _walk(f"{name}.{key}" if name else key, item, depth + 1)


# ------------------------------------------------------------------------- compressed data


class Room:
    """Decompressor that limits the total number of bytes decompressed from one file."""

    def __init__(self, path: Path, size: int) -> None:
        self.path = path
        self.left = min(MAX_BYTES, max(_ROOM, _RATIO * size))

    def unpacked(self, how: str, data: bytes, size: int) -> bytes:
        """Decompress `data`, whose decompressed size should be `size` bytes.

        `how` is the compression method: `bz2`, `lz4` or `zstd`; `none` or "" for data that is not compressed.

        Raises:
            TraceError: E603, `size` is more than may still be decompressed from this file.
            MissingError: R301, the compression method needs a package.
            DamageError: the decompressed data has another size.
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
        """Return a message, decompressed if necessary.

        ROS 2 can compress single messages as `zstd` frames.
        """
        return self.of_unknown_size(message) if message.startswith(_ZSTD) else message

    def of_unknown_size(self, data: bytes) -> bytes:
        """Decompress a `zstd` frame whose decompressed size is unknown.

        Raises TraceError (E603) if the size exceeds the remaining limit.
        """
        with needed("zstandard").ZstdDecompressor().stream_reader(data) as reader:
            out: bytes = reader.read(self.left + 1)
        if len(out) > self.left:
            raise unreadable(
                self.path, f"it unpacks to more than {self.left / 1e9:.3g} GB", advice="split it"
            )
        self.left -= len(out)
        return out
