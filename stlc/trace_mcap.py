"""ROS 2 bags in `.mcap` files (extra `mcap`), read without a ROS installation.

Every number in a message is a signal: `/odom` with `twist.twist.linear.x` gives `odom.twist.twist.linear.x`;
a message that holds nothing but `data` is called by its topic. Times are those at which a message was logged,
in seconds since the first one. Every topic has a clock of its own, so most bags are read with `--resample`.
"""

from __future__ import annotations

import io
import math
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from stlc.diagnostics import Diagnostic, UsageError
from stlc.signature import Column
from stlc.trace_extras import needed
from stlc.trace_npz import unreadable
from stlc.trace_parquet import damage
from stlc.trace_recording import Recording, Strand

MAX_BYTES = 2_000_000_000
MAX_VALUES = 500_000_000

_LONGEST = 64
"""Arrays of more numbers than this are data (images, scans), not signals."""

_DEEPEST = 12


@dataclass(slots=True)
class _Topic:
    times: list[int] = field(default_factory=list)
    values: dict[str, list[float]] = field(default_factory=dict)
    held: set[str] = field(default_factory=set)


def read_mcap(path: Path) -> Recording:
    """The numbers in all messages; signals that are not in every message of their topic are left out.

    Raises:
        UsageError: U102, the file does not exist or cannot be opened.
        MissingError: R301, `mcap` or `mcap-ros2-support` is not installed.
        TraceError: E603, another format, damaged, or without numbers.
    """
    try:
        with path.open("rb") as file:
            raw = file.read(MAX_BYTES + 1)
    except OSError as error:
        reason = (error.strerror or type(error).__name__).lower()
        raise UsageError(Diagnostic("U102", f"cannot read `{path}`: {reason}")) from None
    if len(raw) > MAX_BYTES:
        raise unreadable(path, f"it is larger than {MAX_BYTES / 1e9:.0f} GB", advice="split it")
    with damage(path):
        topics = _topics(path, raw)
    strands: list[Strand] = []
    columns: dict[str, Column] = {}
    origin = min((topic.times[0] for topic in topics.values()), default=0)
    for topic in topics.values():
        whole = {n: x for n, x in topic.values.items() if len(x) == len(topic.times)}
        clock = (np.array(topic.times, dtype=np.int64) - origin).astype(np.float64) * 1e-9
        strands.append(Strand({n: np.array(x, dtype=np.float64) for n, x in whole.items()}, clock))
        columns |= {n: Column(n, kind="int") for n in topic.held if n in whole}
    if not any(strand.arrays for strand in strands):
        raise unreadable(path, "it holds no message with numbers")
    return Recording(str(path), tuple(strands), columns)


def _topics(path: Path, raw: bytes) -> dict[str, _Topic]:
    reader = needed("mcap.reader").make_reader(io.BytesIO(raw))
    factory = needed("mcap_ros2.decoder").DecoderFactory()
    decoders: dict[int, Any] = {}
    topics: dict[str, _Topic] = {}
    total = 0
    for schema, channel, message in reader.iter_messages():
        if channel.id not in decoders:
            decoders[channel.id] = factory.decoder_for(channel.message_encoding, schema)
        decode = decoders[channel.id]
        if decode is None:  # not a message of ROS 2
            continue
        topic = topics.setdefault(channel.topic, _Topic())
        topic.times.append(message.log_time)
        total += _append(topic, channel.topic.strip("/").replace("/", "."), decode(message.data))
        if total > MAX_VALUES:
            raise unreadable(path, f"it holds more than {MAX_VALUES:,} numbers", advice="split it")
    return topics


def _append(topic: _Topic, name: str, content: Any) -> int:
    """Add a message to its topic; how many numbers it has."""
    count = 0
    for signal, value in _numbers(name, content, 0):
        topic.values.setdefault(signal, []).append(float(value))
        if isinstance(value, int):
            topic.held.add(signal)
        count += 1
    return count


def _numbers(name: str, value: Any, depth: int) -> Iterator[tuple[str, float]]:
    """All numbers in a message, by path; stamps are left to the clock."""
    if isinstance(value, (int, float)):
        yield name, value
    elif isinstance(value, (str, bytes)) or value is None or depth > _DEEPEST:
        return
    elif isinstance(value, (list, tuple, array)):
        if len(value) <= _LONGEST:
            for i, item in enumerate(value):
                yield from _numbers(f"{name}[{i}]", item, depth + 1)
    else:
        yield from _fields(name, value, depth)


def _fields(name: str, value: Any, depth: int) -> Iterator[tuple[str, float]]:
    fields = [f for f in getattr(value, "__slots__", ()) if not f.startswith("_")]
    if {*fields} in ({"sec", "nanosec"}, {"secs", "nsecs"}):
        seconds, nanoseconds = (getattr(value, f) for f in fields)
        total = seconds + 1e-9 * nanoseconds
        if math.isfinite(total):
            yield name, float(total)
        return
    for part in fields:
        if part != "header":
            inner = name if depth == 0 and fields == ["data"] else f"{name}.{part}"
            yield from _numbers(inner, getattr(value, part), depth + 1)
