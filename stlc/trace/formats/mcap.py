"""Logs in `.mcap` files (extra `mcap`), read and written.

Messages of ROS 1 and 2, JSON and Protocol Buffers can be read. Files are written as JSON messages with a
schema, which Foxglove can plot: one topic per trace, one message per sample. A metadata record describes the
signals, so that reading the file back gives the same trace.
"""

from __future__ import annotations

import json
import math
import re
import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import lru_cache, partial
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from stlc.extras import needed
from stlc.files import File
from stlc.jsontext import loads
from stlc.trace.formats.messages import LONGEST, Bytes, Channel, DamageError, Decode, Log, Room, mapped
from stlc.trace.formats.paths import Selection
from stlc.trace.formats.registry import damage, unreadable
from stlc.trace.formats.ros import Form, decoder
from stlc.trace.meta import read_meta
from stlc.trace.recording import ALL, ClockGroup, Recording, Wanted
from stlc.trace.trace import Trace

OURS = "stlc"
"""The metadata record that describes the signals."""
_ROS: dict[tuple[str, str], Form] = {("cdr", "ros2msg"): "cdr", ("ros1", "ros1msg"): "ros1"}
"""Encodings of messages and of their definitions -> form of ROS."""
_DIALECT = "https://json-schema.org/draft/2020-12/schema"
_UNUSUAL = {"nan": "null", "inf": "1e999", "-inf": "-1e999"}
"""Numbers that JSON lacks -> what is written: infinity is a number beyond all floats."""
_MAGIC = b"\x89MCAP0\r\n"
_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _METADATA, _DATA_END = 3, 4, 5, 6, 12, 15
_FRAME, _SENT = struct.Struct("<BQ"), struct.Struct("<HIQQ")


def read(path: Path, wanted: Wanted = ALL) -> Recording:
    """Read what is wanted of the messages.

    Raises:
        UsageError: U102, the file does not exist or cannot be opened.
        MissingError: R301, `mcap`, or a package for an encoding, is not installed.
        TraceError: E603, the file is of another format, damaged, or without messages.
    """
    log = Log(path, wanted)
    with damage(path):
        ours = add_mcap(log, path)
        if ours is not None and wanted.names is not None:
            log = Log(path)
            add_mcap(log, path)
        found = log.recording()
        return found if ours is None else _as_written(found, ours) or found


def add_mcap(log: Log, path: Path) -> Mapping[str, str] | None:
    """Add the messages of a file to a log; of a file that is cut off, those before its end.

    Returns the metadata if stlc wrote the file, None for other files.
    """
    needed("mcap")  # before the packages for compressed chunks, which come with it
    schemas: dict[int, Any] = {}
    channels: dict[int, Channel] = {}
    ours: Mapping[str, str] | None = None
    with mapped(path) as whole:
        if whole[: len(_MAGIC)] != _MAGIC:
            raise DamageError("it does not begin like an MCAP file")
        room = Room(path, len(whole))
        with log.partly(path, "mcap recover FILE -o FIXED  rewrites what is readable"):
            for kind, data, start, end in _records(whole, len(_MAGIC), room):
                if kind == _MESSAGE:
                    number, _, logged, published = _SENT.unpack_from(data, start)
                    if number not in channels:
                        raise DamageError("a message of an unknown channel")
                    time = published if log.published else logged
                    log.add(channels[number], time, data[start + _SENT.size : end], room)
                elif kind == _SCHEMA:
                    schema = _record("Schema", data[start:end])
                    schemas.setdefault(schema.id, schema)
                elif kind == _CHANNEL:
                    channel = _record("Channel", data[start:end])
                    schema = schemas.get(channel.schema_id)
                    make = partial(_decoder, channel.message_encoding, schema)
                    found = log.channel(channel.topic, "" if schema is None else schema.name, make)
                    channels.setdefault(channel.id, found)
                elif kind == _METADATA and (record := _record("Metadata", data[start:end])).name == OURS:
                    ours = record.metadata
                elif kind == _DATA_END:  # an index follows
                    break
            else:
                raise DamageError("it was not closed")
    return ours


def _records(data: Bytes, at: int, room: Room) -> Iterator[tuple[int, Bytes, int, int]]:
    """Yield (kind, data, start, end) of each record in `data`, from byte `at` on, and of those in chunks."""
    while at < len(data):
        kind, size = _FRAME.unpack_from(data, at)
        start, at = at + _FRAME.size, at + _FRAME.size + size
        whole = at <= len(data)
        if kind == _CHUNK:
            unpacked, crc, letters = struct.unpack_from("<QII", data, start + 16)
            first = start + 40 + letters
            how = data[start + 32 : first - 8].decode()
            inner = room.unpacked(how, data[first:at], unpacked, whole=whole)
            if whole and crc and zlib.crc32(inner) != crc:
                raise DamageError("the content of a chunk is not what was written")
            yield from _records(inner, 0, room)
        if not whole or not kind:
            raise DamageError("it ends inside a record")
        yield kind, data, start, at


def _record(name: str, content: bytes) -> Any:
    stream = needed("mcap.data_stream").ReadDataStream(BytesIO(content))
    return getattr(needed("mcap.records"), name).read(stream)


def _decoder(encoding: str, schema: Any, selection: Selection) -> Decode:
    described = "" if schema is None else schema.encoding
    if encoding == "json":
        return lambda data: loads(data.decode(json.detect_encoding(data)))
    if encoding == described == "protobuf":
        return _protobuf(schema, selection)
    if (form := _ROS.get((encoding, described))) is not None:
        return decoder(schema.data.decode("utf-8", "replace"), form, selection)
    shown = f"`{encoding[:40]}`" + (f" by `{described[:40]}`" if described else "")
    raise DamageError(f"its messages are written as {shown} (read are JSON, Protocol Buffers, and ROS)")


def _protobuf(schema: Any, selection: Selection) -> Decode:
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
    return lambda data: _tree(kind.FromString(data), selection)


def _tree(message: Any, selection: Selection) -> dict[str, object]:
    """Return the selected fields of a Protocol Buffers message; one that is absent is left out."""
    tree: dict[str, object] = {}
    for each, part in _selected(message.DESCRIPTOR, selection):
        inner = each.message_type
        if each.has_presence and not message.HasField(each.name):
            continue
        value = getattr(message, each.name)
        if each.is_repeated:
            if (inner is None or not inner.GetOptions().map_entry) and (part.long or len(value) <= LONGEST):
                tree[each.name] = list(value) if inner is None else [_tree(item, part) for item in value]
        elif not isinstance(value, bytes):
            tree[each.name] = value if inner is None else _tree(value, part)
    return tree


@lru_cache(maxsize=1000)
def _selected(kind: Any, selection: Selection) -> list[tuple[Any, Selection]]:
    """The selected fields of a type of messages, and what is selected in them."""
    names = frozenset(kind.fields_by_name)
    parts = [selection.part(each.name, names, nested=each.message_type is not None) for each in kind.fields]
    return [(each, part) for each, part in zip(kind.fields, parts, strict=True) if part is not None]


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
    origin = max(trace.meta.origin or 0, -math.floor(float(trace.times[0]) * 1e9))
    meta = replace(trace.meta, dt=trace.dt).array(trace.signature)
    properties = {
        each.name: {"type": "number"} | ({"description": each.unit.text} if each.unit.text else {})
        for each in trace.signature.columns
    }
    stamps = [origin + round(float(t) * 1e9) for t in trace.times]
    with File(path).replaced() as temporary, temporary.open("wb") as file:
        writer = writers.Writer(file)
        writer.start(profile="", library="stlc")
        described = {"$schema": _DIALECT, "type": "object", "properties": properties}
        schema = writer.register_schema(base[1:], "jsonschema", json.dumps(described).encode())
        channels = [writer.register_channel(topic, "json", schema) for topic in topics]
        rows = {json.dumps(name): values.T.tolist() for name, values in trace.data.items()}
        for k, stamp in enumerate(stamps):
            for i, channel in enumerate(channels):
                texts = {name: repr(values[k][i]) for name, values in rows.items()}
                cells = ", ".join(f"{name}: {_UNUSUAL.get(text, text)}" for name, text in texts.items())
                writer.add_message(channel, stamp, f"{{{cells}}}".encode(), stamp, sequence=k)
        writer.add_metadata(OURS, {"topics": json.dumps(topics), "origin": str(origin), "meta": str(meta)})
        writer.finish()


def _as_written(found: Recording, ours: Mapping[str, str]) -> Recording | None:
    """Return the trace that stlc wrote to a file, given its messages and its metadata (`ours`)."""
    starts = [f"{str(topic).strip('/').replace('/', '.')}." for topic in json.loads(ours.get("topics", "[]"))]
    if not found.groups or len(found.groups) != len(starts):
        return None
    times = np.asarray(found.groups[0].clock)
    parts = [
        {name.removeprefix(start): values for name, values in group.arrays.items() if name.startswith(start)}
        for group, start in zip(found.groups, starts, strict=True)
        if np.array_equal(np.asarray(group.clock), times)
    ]
    if len(parts) < len(starts) or not parts[0] or any(each.keys() != parts[0].keys() for each in parts):
        return None
    origin = int(ours.get("origin", "0"))
    if not -(2**63) < origin < 2**63:
        raise unreadable(found.name, f"its time 0 is {origin} ns, which is no time")
    clock = np.array([(t - origin) * 1e-9 for t in times.tolist()], dtype=np.float64)
    data = {name: np.stack([each[name] for each in parts]) for name in parts[0]}
    meta, columns = read_meta(Path(found.name), np.array(ours.get("meta", "{}")))
    return Recording(found.name, (ClockGroup(data, clock),), columns, meta)


def topic_of(name: str, *, empty: str) -> str:
    """Return a name as one part of the topic of a message: letters, digits, `_`, `-` and `.`.

    Other characters become `_`; `empty` replaces an empty name.
    """
    return re.sub(r"[^\w.-]+", "_", name) or empty
