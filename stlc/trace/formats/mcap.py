"""Logs in `.mcap` files (extra `mcap`), read and written.

Messages of ROS 1 and 2, JSON and Protocol Buffers can be read. Files are written as JSON messages with a
schema, which Foxglove can plot: one topic per trace, one message per sample. A metadata record describes the
signals, so that reading the file back gives the same trace.
"""

from __future__ import annotations

import json
import math
import zlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, cast

import numpy as np

from stlc.escape import topic as topic_of
from stlc.files import atomic_path
from stlc.jsontext import loads
from stlc.trace.formats.messages import (
    DEEPEST,
    HEADER,
    LONGEST,
    STAMPS,
    DamageError,
    Decode,
    Log,
    MessageNumber,
    Room,
    mapped,
    numbers_of,
    seconds_of,
)
from stlc.trace.formats.registry import damage, needed, unreadable
from stlc.trace.formats.ros import decoder
from stlc.trace.meta import meta_array, read_meta
from stlc.trace.recording import ClockGroup, Recording

if TYPE_CHECKING:
    from stlc.trace.trace import Trace

OURS = "stlc"
"""The metadata record that describes the signals."""
_READ = "read are JSON, Protocol Buffers, and ROS 1 and 2"


def read(path: Path) -> Recording:
    """Read the numbers in all messages.

    A number becomes a signal only if every message of its topic contains it.

    Raises:
        UsageError: U102, the file does not exist or cannot be opened.
        MissingError: R301, `mcap`, or a package for an encoding, is not installed.
        TraceError: E603, the file is of another format, damaged, or without numbers.
    """
    log = Log(path)
    with damage(path):
        ours = add_mcap(log, path)
        found = None if ours is None else _as_written(log, ours)
    return log.recording() if found is None else found


@dataclass(slots=True)
class _File:
    """Reader of the records of one file: its schemas, its channels and their decoders."""

    log: Log
    room: Room
    schemas: dict[int, Any] = field(default_factory=dict)
    channels: dict[int, Any] = field(default_factory=dict)
    decoders: dict[int, Decode | None] = field(default_factory=dict)

    def take(self, record: Any) -> None:
        """Process one record: store a schema or channel, or add the numbers of a message to the log."""
        match type(record).__name__:
            case "Schema":
                self.schemas.setdefault(record.id, record)
            case "Channel":
                self.channels.setdefault(record.id, record)
            case "Message":
                self.message(record)

    def message(self, message: Any) -> None:
        channel = self.channels.get(message.channel_id)
        if channel is None:
            raise DamageError("a message of an unknown channel")
        if channel.id not in self.decoders:
            self.decoders[channel.id] = self.decoder(channel)
        decode = self.decoders[channel.id]
        if decode is not None:
            self.log.add(channel.topic, message.log_time, decode(self.room.whole(message.data)))

    def decoder(self, channel: Any) -> Decode | None:
        """Return the decoder of a channel's messages; None if they cannot be decoded.

        In this case the reason is stored in `log.unread`.
        """
        schema, encoding = self.schemas.get(channel.schema_id), channel.message_encoding
        described = "" if schema is None else schema.encoding
        try:
            if encoding == "json":
                return _of_json
            if encoding == "protobuf" and described == "protobuf":
                return _protobuf(schema)
            if schema and (encoding, described) in (("cdr", "ros2msg"), ("ros1", "ros1msg")):
                return decoder(schema.data.decode("utf-8", "replace"), encoding)
        except DamageError as error:
            self.log.unread[channel.topic] = str(error)
            return None
        shown = f"`{encoding[:40]}`" + (f" by `{described[:40]}`" if described else "")
        self.log.unread[channel.topic] = f"its messages are written as {shown} ({_READ})"
        return None


def add_mcap(log: Log, path: Path) -> Mapping[str, str] | None:
    """Add the messages of a file to a log.

    Returns the metadata if stlc wrote the file, None for other files.
    """
    reader = needed("mcap.stream_reader").StreamReader
    ours: Mapping[str, str] | None = None
    with mapped(path) as data:
        size, room = len(data), Room(path, len(data))
        file = _File(log, room)
        stream = cast("IO[bytes]", data)
        for record in reader(stream, emit_chunks=True, record_size_limit=size).records:
            if type(record).__name__ == "Chunk":
                inner = room.unpacked(record.compression, record.data, record.uncompressed_size)
                if record.uncompressed_crc and zlib.crc32(inner) != record.uncompressed_crc:
                    raise DamageError("the content of a chunk is not what was written")
                parts = needed("mcap.records").Chunk(
                    compression="",
                    data=inner,
                    message_end_time=0,
                    message_start_time=0,
                    uncompressed_crc=0,
                    uncompressed_size=len(inner),
                )
                for part in needed("mcap.stream_reader").breakup_chunk(parts):
                    file.take(part)
            elif type(record).__name__ == "Metadata" and record.name == OURS:
                ours = record.metadata
            elif type(record).__name__ == "DataEnd":  # followed by an index
                break
            else:
                file.take(record)
    return ours


# ------------------------------------------------------------------------------ encodings


def _of_json(data: bytes) -> Iterable[MessageNumber]:
    return numbers_of(loads(data.decode(json.detect_encoding(data))))


def _protobuf(schema: Any) -> Decode:
    """Return the decoder of Protocol Buffers messages, made from the descriptors in the file."""
    pool = needed("google.protobuf.descriptor_pool").DescriptorPool()
    files = needed("google.protobuf.descriptor_pb2").FileDescriptorSet.FromString(schema.data)
    left = {each.name: each for each in files.file}
    while left:
        ready = [each for each in left.values() if not left.keys() & set(each.dependency)]
        if not ready:
            raise DamageError("descriptors that need each other")
        for each in ready:
            pool.Add(left.pop(each.name))
    kind = needed("google.protobuf.message_factory").GetMessageClass(pool.FindMessageTypeByName(schema.name))

    def decode(data: bytes) -> Iterator[MessageNumber]:
        message = kind.FromString(data)
        fields = message.DESCRIPTOR.fields
        if [each.name for each in fields] == ["data"]:
            return _proto_field("", message, fields[0], 0)
        return _proto_fields("", message, 0)

    return decode


def _proto_fields(name: str, message: Any, depth: int) -> Iterator[MessageNumber]:
    fields = message.DESCRIPTOR.fields
    if {each.name for each in fields} in STAMPS:
        yield MessageNumber(name, seconds_of({each.name: getattr(message, each.name) for each in fields}))
        return
    for each in fields:
        if each.name != HEADER:
            yield from _proto_field(f"{name}.{each.name}" if name else each.name, message, each, depth)


def _proto_field(name: str, message: Any, each: Any, depth: int) -> Iterator[MessageNumber]:
    value = getattr(message, each.name)
    if each.is_repeated:
        is_map = each.message_type is not None and each.message_type.GetOptions().map_entry
        if not is_map and len(value) <= LONGEST:
            for i, item in enumerate(value):
                yield from _proto_value(f"{name}[{i}]", item, each, depth)
    elif not each.has_presence or message.HasField(each.name):
        yield from _proto_value(name, value, each, depth)


def _proto_value(name: str, value: Any, each: Any, depth: int) -> Iterator[MessageNumber]:
    if each.message_type is not None:
        if depth <= DEEPEST:
            yield from _proto_fields(name, value, depth + 1)
    elif isinstance(value, (int, float)):
        yield MessageNumber(name, float(value), isinstance(value, int))


# ---------------------------------------------------------------------------- stlc's own


def write(path: Path | str, trace: Trace) -> None:
    """Write the signals of a trace as JSON messages.

    The topic is `/NAME` for a file `NAME.mcap`; with several traces the topics are `/NAME/0`, `/NAME/1`, ….

    Raises:
        MissingError: R301, `mcap` is not installed; R201, no space left or no permission; an existing file is
            not changed.
    """
    writers = needed("mcap.writer")
    base = "/" + topic_of(Path(path).stem, empty="trace")
    topics = [base] if trace.traces == 1 else [f"{base}/{k}" for k in range(trace.traces)]
    first = math.floor(float(trace.times[0]) * 1e9)
    origin = max(trace.meta.origin or 0, -first)
    meta = meta_array(replace(trace.meta, dt=trace.dt), trace.signature)
    stamps = [origin + round(float(t) * 1e9) for t in trace.times]
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        writer = writers.Writer(file)
        writer.start(profile="", library="stlc")
        schema = writer.register_schema(base[1:], "jsonschema", json.dumps(_schema(trace)).encode())
        channels = [writer.register_channel(topic, "json", schema) for topic in topics]
        rows = {name: values.T.tolist() for name, values in trace.data.items()}
        for k, stamp in enumerate(stamps):
            for i, channel in enumerate(channels):
                cells = ", ".join(
                    f"{json.dumps(name)}: {_cell(values[k][i])}" for name, values in rows.items()
                )
                writer.add_message(channel, stamp, f"{{{cells}}}".encode(), stamp, sequence=k)
        writer.add_metadata(OURS, {"topics": json.dumps(topics), "origin": str(origin), "meta": str(meta)})
        writer.finish()


def _cell(value: float) -> str:
    """JSON text of a number: `null` for NaN, and a number beyond all floats such as 1e999 for infinity."""
    if math.isnan(value):
        return "null"
    return repr(value) if math.isfinite(value) else "1e999" if value > 0 else "-1e999"


def _schema(trace: Trace) -> dict[str, object]:
    units = {column.name: column.unit.text for column in trace.signature.columns}
    properties = {
        name: {"type": "number"} | ({"description": units[name]} if units.get(name) else {})
        for name in trace.data
    }
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "type": "object",
        "properties": properties,
    }


def _as_written(log: Log, ours: Mapping[str, str]) -> Recording | None:
    """Return the trace that stlc wrote to a file, given its messages (`log`) and its metadata (`ours`).

    None is returned if the messages no longer fit together, because the file was changed afterwards.
    """
    topics, origin = json.loads(ours.get("topics", "[]")), int(ours.get("origin", "0"))
    if not isinstance(topics, list) or not topics or not all(isinstance(topic, str) for topic in topics):
        return None
    found = [log.topic(topic) for topic in topics]
    times, first = found[0]
    alike = all(
        np.array_equal(times, others) and arrays.keys() == first.keys() for others, arrays in found[1:]
    )
    if not alike or not first:
        return None
    if not -(2**63) < origin < 2**63:
        raise unreadable(log.path, f"its time 0 is {origin} ns, which is no time")
    clock = np.array([(t - origin) * 1e-9 for t in times.tolist()], dtype=np.float64)
    data = {name: np.stack([arrays[name] for _, arrays in found]) for name in first}
    meta, columns = read_meta(log.path, np.array(ours.get("meta", "{}")))
    return Recording(str(log.path), (ClockGroup(data, clock),), columns, meta)
