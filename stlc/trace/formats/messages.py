"""Logged messages converted to signals: every topic has its own times, every number of a message is a signal.

The number `twist.twist.linear.x` in the topic `/odom` is the signal `odom.twist.twist.linear.x`, or
`/odom.twist.twist.linear.x`, which no other topic can give. If `data` is the only field of a message, the
signal has the name of the topic. A time is the time at which a message was logged, or a stamp in the message.
Elements of arrays that are addressed by their names (`stlc.trace.formats.paths`) have the times of the
messages that contain them.
"""

from __future__ import annotations

import bz2
import math
import re
import sys
from array import array
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from mmap import ACCESS_READ, mmap
from pathlib import Path as FilePath
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from stlc.diagnostics import Diagnostic, StlcError, TraceError
from stlc.extras import needed
from stlc.signature import Column
from stlc.trace.formats.paths import ARRAYS, HEADER, Enclosing, Path, RefusedError, Selection, element_names
from stlc.trace.formats.registry import MAX_LETTERS, opened, unreadable
from stlc.trace.recording import ALL, Array, ClockGroup, Recording, Wanted

MAX_BYTES = 2_000_000_000
MAX_VALUES = 100_000_000
LONGEST = 64
"""Arrays of more numbers than this (images, scans) are read only if they are asked for."""
DEEPEST = 12
"""Greatest nesting depth of a number that is a signal."""
STAMPS = ({"sec", "nanosec"}, {"secs", "nsecs"}, {"sec", "nsec"}, {"seconds", "nanos"})
"""Field names of a time stamp in the message languages."""
SECONDS = frozenset({"sec", "secs", "seconds"})
"""Names of the fields that count seconds; the others count nanoseconds."""
LOG, PUBLISH = "log", "publish"
"""Names of the times at which messages were recorded, and sent."""

_ROOM = 64_000_000
_RATIO = 50
"""Compressed data may expand to `_ROOM` bytes, or to this multiple of the file's size."""
_LATEST = 2**63 - 1
_ZSTD = b"\x28\xb5\x2f\xfd"
_REDUCED = re.compile(r"(?P<how>min|max)\((?P<name>.*)\)")
_SECOND, _YEAR = 10**9, 31_536_000 * 10**9
_FAR = 10
"""A gap of a year is an error if it is longer than this multiple of the rest of the time."""
_SHOWN = 2000
_SIGNAL = 1000
"""Numbers that take as much memory as a signal without values."""

Bytes: TypeAlias = bytes | mmap
Decode = Callable[[bytes], object]
"""Function from the bytes of a message to its tree (`stlc.trace.formats.paths`)."""


class DamageError(Exception):
    """Error in a file or a message: its bytes violate the format."""


@contextmanager
def mapped(path: FilePath) -> Iterator[mmap]:
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


# ------------------------------------------------------------------------------- signals


@dataclass(slots=True)
class _Signal:
    """A part of messages and its values; `how` is "min" or "max" of an array, or ""."""

    name: str
    exact: str
    path: Path
    how: str = ""
    numbers: array[float] = field(default_factory=lambda: array("d"))
    others: dict[int, str | NDArray[np.float64]] = field(default_factory=dict)
    whole: bool = True
    refused: str = ""

    def take(self, count: int, tree: object) -> int:
        """Append the value in a message after `count` others; return its room, 0 if there is none."""
        try:
            found = [] if self.refused else self.path.find(tree)
            return self.put(count, _bare(found[0])) if found else 0
        except RefusedError as error:
            self.refused = str(error)
            return 0

    def put(self, count: int, value: Any) -> int:
        """Append a value after `count` others, NaN for those that lack, and return the room that it takes.

        Raises RefusedError if it is no number, text or vector.
        """
        missing, size, number = count - len(self.numbers), 1, math.nan
        if isinstance(value, ARRAYS):
            size, vector = len(value) + 1, _vector(value)
            if self.how:
                self.whole = False
                number = float(getattr(np, f"f{self.how}").reduce(vector, initial=math.nan))
            else:
                self.others[count] = vector
        elif isinstance(value, str):
            size, self.others[count] = MAX_LETTERS // 2, sys.intern(value[:MAX_LETTERS])
        elif isinstance(value, dict):
            self.whole, number = False, _seconds(value)
        elif value is not None:
            self.whole = self.whole and isinstance(value, (int, np.integer, np.bool_))
            number = float(value)
        if missing:
            self.numbers.extend([math.nan] * missing)
        self.numbers.append(number)
        return missing + size

    def array(self, count: int) -> Array:
        """Return the values of `count` messages. Raises RefusedError if they do not fit together."""
        numbers = np.full(count, math.nan)
        numbers[: len(self.numbers)] = self.numbers
        vectors = [each for each in self.others.values() if not isinstance(each, str)]
        if not vectors:
            if not self.others:
                return numbers
            words = ["" if x != x else repr(x).removesuffix(".0") for x in numbers.tolist()]
            return np.array([self.others.get(i, word) for i, word in enumerate(words)], dtype=np.str_)
        least, most = min(map(len, vectors)), max(map(len, vectors))
        mixed = len(vectors) < len(self.others) or not np.isnan(numbers).all()
        if least != most or most > Column.MAX_COMPONENTS or mixed:
            told = f"is an array of {least} to {most} numbers"
            raise RefusedError(f"{told}: read an element such as `[0]`, or `min(…)` or `max(…)` of it")
        stacked = np.full((count, most), math.nan)
        stacked[[*self.others]] = vectors
        return stacked


def _vector(values: Any) -> NDArray[np.float64]:
    try:
        found = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        found = np.zeros((0, 0))
    if found.ndim != 1 or (len(values) and isinstance(values[0], str)):
        raise RefusedError("is an array of texts or structures: name an element, and a field of it")
    return found


def _seconds(stamp: Mapping[str, Any]) -> float:
    """Seconds of a time stamp, name of the field -> value. Raises RefusedError for other structures."""
    if set(stamp) not in STAMPS:
        fields = ", ".join(f"`{str(name)[:40]}`" for name in [*stamp][:9])
        raise RefusedError(f"holds the fields {fields}: read one of them")
    numbers = {key: value if isinstance(value, (int, float)) else math.nan for key, value in stamp.items()}
    return sum(value if name in SECONDS else 1e-9 * value for name, value in numbers.items())


def _bare(value: object) -> object:
    """Return the only field of a message, or the value of a pair; other values as they are."""
    if isinstance(value, dict) and (value.keys() == {"data"} or value.keys() == {"key", "value"}):
        return next(item for key, item in value.items() if key != "key")
    return value


def _parts(
    name: str, value: Any, depth: int = 0, above: Enclosing = None, *, shown: bool = False
) -> Iterator[tuple[str, float]]:
    """Yield the numbers of a message with their names; if `shown`, everything that can be asked for."""
    if isinstance(value, (int, float)):
        yield name, value
    elif value is None or (shown and isinstance(value, str)):
        yield name, math.nan
    elif depth > DEEPEST:
        return
    elif isinstance(value, dict) and set(value) in STAMPS:
        yield name, _seconds(value)
    elif isinstance(value, dict):
        for key, item in value.items():
            if key != HEADER or shown:
                inner = f"{name}.{key}" if name else str(key)
                yield from _parts(inner, item, depth + 1, (value, above), shown=shown)
    elif isinstance(value, ARRAYS) and len(value) > LONGEST:
        yield from ((name, math.nan),) if shown else ()
    elif isinstance(value, ARRAYS):
        for i, item in enumerate(value):
            labels = element_names(value, i, above) if shown else []
            yield from _parts(f"{name}[{[*labels, i][0]}]", item, depth + 1, above, shown=shown)


# --------------------------------------------------------------------------------- topics


@dataclass(slots=True)
class _Series:
    """Signals of a topic with common times: those of all messages, or of those that contain an `element`."""

    source: Source
    element: str = ""
    signals: dict[str, _Signal] = field(default_factory=dict)
    stamped: tuple[Path, ...] = ()
    times: array[int] = field(default_factory=lambda: array("q"))
    stamps: int = 0

    def take(self, time: int, tree: object, *, every: bool) -> int:
        """Add a message, and return the room that it takes; if `every`, each of its numbers is a signal."""
        count, room = len(self.times), 0
        if not every:
            for signal in self.signals.values():
                room += signal.take(count, tree)
        for part, value in _parts("", _bare(tree)) if every else ():
            found = self.signals.get(part)
            if found is None:
                found = self.signals[part] = self.source.signal(part)
                room += _SIGNAL
            if len(found.numbers) > count:  # two fields have this name
                found.take(count, tree)
            else:
                room += found.put(count, value)
        if room or not self.element:
            for stamp in (each for path in self.stamped for each in path.find(tree)):
                if isinstance(stamp, dict) and set(stamp) in STAMPS:
                    time = sum(int(n) * (_SECOND if name in SECONDS else 1) for name, n in stamp.items())
                    self.stamps += 1
                    break
            self.times.append(time)
        return room


@dataclass(slots=True)
class Source:
    """Messages of one topic.

    Attributes:
        selection: the fields that are decoded; None if nothing in the messages is read.
        unread: reason why the messages cannot be read; "".
        series: the signals, by the elements whose times they have.
    """

    topic: str
    kind: str
    selection: Selection | None = None
    count: int = 0
    first: tuple[Channel, bytes] | None = None
    unread: str = ""
    series: dict[tuple[str, ...], _Series] = field(default_factory=dict)

    def called(self, part: str, *, exact: bool = False) -> str:
        """Name of the signal of a part of the messages; if `exact`, one that no other topic can give."""
        topic = self.topic.strip("/")
        topic = f"/{topic}" if exact else topic.replace("/", ".")
        return topic + (f".{part}" if part and part[0] != "[" and topic else part)

    def part(self, name: str) -> str | None:
        """Return the part of the messages that is the signal `name`; None if it is of another topic."""
        for topic in (self.called("", exact=True), self.called("")):
            rest = name.removeprefix(topic)
            if name.startswith(topic) and (not rest or rest[0] in ".["):
                return rest.removeprefix(".")
        return None

    def signal(self, part: str, name: str = "", how: str = "") -> _Signal:
        """Return a signal without values; `name` is "" for the usual one."""
        exact = self.called(part, exact=True)
        return _Signal(name or self.called(part), f"{how}({exact})" if how else exact, Path(part), how)


@dataclass(slots=True)
class Channel:
    """Messages with one definition: where their values go, and their decoder once it is needed."""

    source: Source
    make: Callable[[Selection], Decode]
    decode: Decode | None = None


class Log:
    """Collection of what is asked for in logged messages, from one or several files.

    Attributes:
        published: whether times are those at which messages were sent, not those of the log.
        remarks: warnings about the files.
    """

    def __init__(self, path: FilePath, wanted: Wanted = ALL) -> None:
        self.path = path
        self.wanted = wanted
        self.remarks: list[Diagnostic] = []
        self.published = wanted.clock == PUBLISH
        self._clock = "" if wanted.clock in (LOG, PUBLISH) else wanted.clock
        self._sources: dict[str, Source] = {}
        self._room = 0

    @property
    def count(self) -> int:
        """Number of messages, also of those that are not read."""
        return sum(each.count for each in self._sources.values())

    @property
    def missing(self) -> bool:
        """True if a name that is asked for has no values so far."""
        signals = (signal for series in self._series() for signal in series.signals.values())
        names = {signal.name for signal in signals if signal.numbers}
        return self.wanted.names is not None and not names >= self.wanted.names

    def _series(self) -> Iterator[_Series]:
        for source in self._sources.values():
            yield from source.series.values()

    def channel(self, topic: str, kind: str, make: Callable[[Selection], Decode]) -> Channel:
        """Return a channel of messages of the type `kind` in a topic.

        `make` returns their decoder. It raises DamageError if there is none.
        """
        source = self._sources.get(topic)
        if source is None:
            source = self._sources[topic] = self._source(Source(topic, kind))
        elif source.kind != kind:
            source.unread = f"its topic holds messages of two types, `{source.kind}` and `{kind[:80]}`"
        return Channel(source, make)

    def _source(self, source: Source) -> Source:
        inner = source.part(self._clock) if self._clock else None
        stamp = self._clock if inner is None else inner
        for name in sorted({*(self.wanted.names or ()), *self.wanted.groups}):
            reduced = _REDUCED.fullmatch(name)
            part = source.part(reduced["name"] if reduced else name)
            if part is not None:
                signal = source.signal(part, name, reduced["how"] if reduced else "")
                series = source.series.setdefault(signal.path.keys, _Series(source, signal.path.element))
                series.signals[name] = signal
        every = self.wanted.names is None
        if every or inner is not None:
            source.series.setdefault((), _Series(source))
        for series in source.series.values() if self._clock else ():
            series.stamped = (Path(stamp),)
            if series.element:
                series.stamped = (Path(f"{series.element}.{stamp}"), *series.stamped)
            elif not every:
                series.signals.setdefault(self._clock, source.signal(stamp, self._clock))
        paths = [signal.path for series in source.series.values() for signal in series.signals.values()]
        paths += [path for series in source.series.values() for path in series.stamped]
        read = Selection.of(paths) if paths else None
        source.selection = Selection(long=False) if every else read
        return source

    def add(self, channel: Channel, time: int, data: bytes, room: Room) -> None:
        """Add a message at `time` in ns, which `room` decompresses. What is not read is not decoded.

        Raises TraceError (E603) for too many values, and MissingError (R301) if a package is not installed.
        """
        source = channel.source
        source.count += 1
        source.first = source.first or (channel, data)
        if source.selection is None or source.unread:
            return
        try:
            if channel.decode is None:
                channel.decode = channel.make(source.selection)
            if data.startswith(_ZSTD):  # of ROS 2
                data = room.unpacked("zstd", data)
            tree = channel.decode(data)
            if time > _LATEST:
                raise DamageError(f"it was logged at {time} ns, which is no time")
            for series in source.series.values():
                self._room += series.take(time, tree, every=self.wanted.names is None)
        except StlcError:
            raise
        except Exception as error:  # of any library that decodes messages
            told = reason(error)
            source.unread = told if channel.decode is None else f"message {source.count} is damaged ({told})"
        self._require_room(self._room)

    def _require_room(self, values: int) -> None:
        if values > MAX_VALUES:
            raise unreadable(self.path, f"it holds more than {MAX_VALUES:,} numbers", advice="split it")

    @contextmanager
    def partly(self, path: FilePath, advice: str) -> Iterator[None]:
        """Context in which a file is read; of one that is damaged, what was read before is kept."""
        before = self.count
        try:
            yield
        except StlcError:
            raise
        except Exception as error:  # of any library that decompresses
            if not (count := self.count - before):
                raise
            message = f"`{path}` is cut off or damaged ({reason(error)}): {count:,} messages were read"
            self.remarks.append(Diagnostic("W305", message, help=(advice,)))

    def recording(self) -> Recording:
        """Convert the messages to signals.

        Raises:
            TraceError: E602, a message is years away from the others; E603, there are no messages, or no
                numbers in them.
        """
        clashes = self._clashes()
        latest = max((max(each.times, default=0) for each in self._series()), default=0)
        refused: dict[str, str] = {}
        groups: list[ClockGroup] = []
        columns: dict[str, Column] = {}
        for series in self._series():
            times, (clock, lacking) = np.array(series.times, dtype=np.int64), self._clock_of(series)
            self._require_room(len(series.signals) * len(times))
            arrays: dict[str, Array] = {}
            for signal in series.signals.values():
                name = signal.exact if self.wanted.names is None and signal.name in clashes else signal.name
                if name in clashes or (name == clock and name not in (self.wanted.names or ())):
                    continue
                try:
                    if why := lacking or signal.refused:
                        raise RefusedError(why)
                    if signal.numbers:
                        arrays[name] = signal.array(len(times))
                        if signal.path.moved:
                            message = f"in `{series.source.topic}`, {signal.path.moved}"
                            self.remarks.append(Diagnostic("W305", message, help=("read it by its name",)))
                        if signal.whole and not signal.others:
                            columns[name] = Column(name, kind="int")
                except RefusedError as error:
                    refused.setdefault(name, str(error))
            order = self._order(series.source.topic, times, clock, latest) if arrays else times[:0]
            if len(order):
                groups.append(ClockGroup({n: x[order] for n, x in arrays.items()}, times[order], clock))
            else:
                refused |= dict.fromkeys(arrays, "is in messages that are stamped 0 s only")
        if not groups and (self.wanted.names is None or not self.count):
            reasons = [*dict.fromkeys(each.unread for each in self._sources.values() if each.unread)][:3]
            told = "it holds no message with numbers" + (f": {', '.join(reasons)}" if reasons else "")
            raise unreadable(self.path, told)
        read = {name for group in groups for name in group.arrays}
        return Recording(
            str(self.path),
            tuple(groups),
            columns,
            others=self._others(read) if self.missing else (),
            clashes=clashes,
            refused={name: why for name, why in refused.items() if name not in read},
            remarks=tuple(self.remarks),
        )

    def _clashes(self) -> dict[str, dict[str, str]]:
        """Names with several sources -> source -> the name that is unambiguous."""
        places: dict[str, dict[str, str]] = {}
        for series in self._series():
            for signal in series.signals.values():
                if signal.numbers and signal.name != self._clock:
                    part = f": {signal.path.text}" if signal.path.text else ""
                    places.setdefault(signal.name, {})[series.source.topic + part] = signal.exact
        return {name: found for name, found in places.items() if len(found) > 1}

    def _clock_of(self, series: _Series) -> tuple[str, str]:
        """Name of the clock of a series, and the reason why nothing in it can be read; ""."""
        source = series.source
        if not source.count:
            return "", f"is in the topic `{source.topic}`, which has no messages"
        if source.unread:
            return "", f"cannot be read: {source.unread}"
        named = {each.topic for each in self._sources.values() if each.part(self._clock) is not None}
        if self._clock and (source.topic in named or not named):
            if series.stamps == len(series.times):
                return self._clock, ""
            part = series.stamped[-1].text
            plain = any(each.path.text == part and each.numbers for each in series.signals.values())
            if series.stamps or not plain:  # else a number or text, which may be a time
                return "", f"is in messages without the stamp `{self._clock}`, which is to be the clock"
        return PUBLISH if self.published else LOG, ""

    def _order(self, topic: str, times: NDArray[np.int64], clock: str, latest: int) -> NDArray[np.int64]:
        """Return the order of the messages in time, without those that were stamped before time was known."""
        early = (np.abs(times) < _SECOND) & (latest > 20 * _YEAR)
        if early.any():
            message = f"{early.sum():,} of {len(times):,} messages of `{topic}` are stamped 0 s and left out"
            help_ = (f"times are those of `{clock}`; simulated time is 0 s until /clock is published",)
            self.remarks.append(Diagnostic("W305", message, help=help_))
        order = np.argsort(times, kind="stable")
        order = order[~early[order]]
        gaps = np.diff(times[order].astype(np.float64))
        at = int(gaps.argmax()) if len(gaps) else 0
        if len(gaps) and gaps[at] > max(_YEAR, _FAR * (gaps.sum() - gaps[at])):
            odd = int(order[at + 1] if 2 * at >= len(gaps) else order[at])
            when, years = np.datetime64(int(times[odd]) // _SECOND, "s"), gaps[at] / _YEAR
            message = f"message {odd + 1:,} of `{topic}` is stamped {when}, {years:.0f} years off the others"
            other = "header.stamp" if clock in (LOG, PUBLISH) else LOG
            ways_out = (f"--clock {other}  takes other times", "or leave the message out of the file")
            raise TraceError.of("E602", message, help=ways_out)
        return order

    def _others(self, read: set[str]) -> tuple[str, ...]:
        """Names of what is in the log and not read, by one message of each topic."""
        names: dict[str, None] = {}
        for channel, data in (each.first for each in self._sources.values() if each.first):
            try:
                tree = channel.make(Selection())(data)
            except Exception:  # what is not read may be anything
                continue
            names |= {channel.source.called(part): None for part, _ in _parts("", _bare(tree), shown=True)}
        return tuple(name for name in names if name not in read)[:_SHOWN]


def reason(error: Exception) -> str:
    """The first line of an error, or its kind."""
    return str(error).strip().partition("\n")[0][:100] or type(error).__name__


# ------------------------------------------------------------------------- compressed data


class Room:
    """Decompressor that limits the total number of bytes decompressed from one file."""

    def __init__(self, path: FilePath, size: int) -> None:
        self.path = path
        self.left = min(MAX_BYTES, max(_ROOM, _RATIO * size))

    def unpacked(self, how: str, data: bytes, size: int | None = None, *, whole: bool = True) -> bytes:
        """Decompress `data` to `size` bytes, or less if it is not `whole`; None: unknown.

        `how` is the compression method: `bz2`, `lz4` or `zstd`; `none` or "" for data that is not compressed.

        Raises:
            TraceError: E603, this is more than may still be decompressed from this file.
            MissingError: R301, the compression method needs a package.
            DamageError: the decompressed data has another size.
        """
        most = self.left if size is None else min(size, self.left)
        if how in ("", "none"):
            out = data
        elif how == "bz2":
            out = bz2.BZ2Decompressor().decompress(data, max_length=most + 1)
        elif how == "lz4":
            out = needed("lz4.frame").LZ4FrameDecompressor().decompress(data, max_length=most + 1)
        elif how == "zstd":
            with needed("zstandard").ZstdDecompressor().stream_reader(data) as reader:
                out = reader.read(most + 1)
        else:
            raise DamageError(f"the compression `{how[:20]}` is not known")
        if max(len(out), size or 0) > self.left:
            why = f"it unpacks to more than {self.left / 1e9:.3g} GB"
            raise unreadable(self.path, why, advice="split it")
        if size is not None and (len(out) > size or (whole and len(out) < size)):
            raise DamageError(f"{size} bytes are declared where {len(out)} are packed")
        self.left -= len(out)
        return out
