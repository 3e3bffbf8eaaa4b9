"""Bag files of ROS 1 (`.bag`) and ROS 2 (folders, `.db3`), read without a ROS installation.

A ROS 1 bag is a file of records, some of them in compressed chunks (http://wiki.ros.org/Bags/Format/2.0). A
ROS 2 bag is a folder with an SQLite database or `.mcap` files. Bags from before ROS 2 Iron contain no message
definitions. For standard messages, the definitions in the package `rosbags` (extra `bag`) are then used.
"""

from __future__ import annotations

import re
import sqlite3
import struct
import tempfile
from collections.abc import Iterator
from contextlib import closing, suppress
from functools import cache, partial
from pathlib import Path
from typing import Any

from stlc.diagnostics import StlcError, usage
from stlc.extras import needed
from stlc.files import is_stored
from stlc.trace.formats.messages import Bytes, Channel, DamageError, Decode, Log, Room, mapped
from stlc.trace.formats.paths import Selection
from stlc.trace.formats.registry import damage, unreadable
from stlc.trace.formats.ros import decoder
from stlc.trace.recording import ALL, Recording, Wanted

_MAGIC = b"#ROSBAG V2.0\n"
_MESSAGE, _HEADER, _CHUNK, _CONNECTION = 2, 3, 5, 7
_PACKED = ".zstd"
_LONGEST = 256_000_000
"""Greatest number of bytes of a message."""


def read(path: Path, wanted: Wanted = ALL) -> Recording:
    """Read what is wanted of the messages of a bag: a `.bag` file, a `.db3` file, or a folder.

    Raises:
        UsageError: U102, there is no such file, or no bag in the folder.
        MissingError: R301, a package is not installed.
        TraceError: E603, the file is of another format, damaged, or without messages.
    """
    log, stored = Log(path, wanted), [path]
    if path.is_dir():
        stored = sorted((each for each in path.iterdir() if is_stored(each)), key=_order)
    if not stored:
        help_ = ("the folder of a bag holds .db3 or .mcap files",)
        raise usage(f"cannot read `{path}`: is a directory", *help_, code="U102")
    for each in stored:
        with damage(path):
            _add_stored(log, each)
    return log.recording()


def _order(path: Path) -> list[object]:
    """Sort key of a file: digits are compared as numbers, so that `bag_9.db3` precedes `bag_10.db3`."""
    return [int(part) if i % 2 else part for i, part in enumerate(re.split(r"(\d{1,18})", path.name))]


def _add_stored(log: Log, path: Path) -> None:
    if path.name.lower().endswith(_PACKED):
        with mapped(path) as data:
            content = Room(path, len(data)).unpacked("zstd", data[:])
        with tempfile.TemporaryDirectory(prefix="stlc-bag-") as folder:
            inner = Path(folder) / f"bag{Path(path.stem).suffix.lower()}"
            inner.write_bytes(content)
            del content
            _add_stored(log, inner)
    elif path.suffix.lower() == ".mcap":
        from stlc.trace.formats.mcap import add_mcap

        add_mcap(log, path)
    elif log.published:
        raise unreadable(log.path, "it does not hold the times at which messages were published")
    elif path.suffix.lower() == ".bag":
        _add_bag(log, path)
    else:
        _add_database(log, path)


# --------------------------------------------------------------------------------- ROS 1


def _add_bag(log: Log, path: Path) -> None:
    """Add the messages of a ROS 1 bag; of a bag that is cut off, those before its end."""
    channels: dict[bytes, Channel] = {}
    with mapped(path) as data:
        if data[: len(_MAGIC)] != _MAGIC:
            raise DamageError("it does not begin like a bag of version 2.0")
        room = Room(path, len(data))
        with log.partly(path, "rosbag reindex FILE  repairs its index"):
            closed = True
            for fields, content in _records(data, len(_MAGIC), room):
                kind = fields[b"op"][0]
                if kind == _HEADER:
                    closed = any(fields[b"index_pos"])
                elif kind == _CONNECTION and fields[b"conn"] not in channels:
                    facts = dict(_fields(content))
                    text = facts[b"message_definition"].decode("utf-8", "replace")
                    name = facts.get(b"type", b"").decode("utf-8", "replace")
                    make = partial(decoder, text, "ros1")
                    channels[fields[b"conn"]] = log.channel(fields[b"topic"].decode(), name, make)
                elif kind == _MESSAGE:
                    if fields[b"conn"] not in channels:
                        raise DamageError("a message of an unknown connection")
                    seconds, rest = struct.unpack("<II", fields[b"time"])
                    log.add(channels[fields[b"conn"]], seconds * 10**9 + rest, content, room)
            if not closed:
                raise DamageError("it was not closed")


def _records(data: Bytes, at: int, room: Room) -> Iterator[tuple[dict[bytes, bytes], bytes]]:
    """Yield the header and the content of each record from byte `at` on, and of those in chunks."""
    while at < len(data):
        head, at = _sized(data, at)
        fields = dict(_fields(head))
        (size,) = struct.unpack_from("<I", data, at)
        content, at = data[at + 4 : at + 4 + size], at + 4 + size
        if fields[b"op"][0] == _CHUNK:
            how, (unpacked,) = fields[b"compression"].decode(), struct.unpack("<I", fields[b"size"])
            inner = room.unpacked(how, content, unpacked, whole=at <= len(data))
            yield from _records(inner, 0, room)
        if at > len(data):
            raise DamageError(f"{size} bytes are declared, {len(content)} follow")
        yield fields, content


def _sized(data: Bytes, at: int) -> tuple[bytes, int]:
    (size,) = struct.unpack_from("<I", data, at)
    if at + 4 + size > len(data):
        raise DamageError(f"{size} bytes are declared, {len(data) - at - 4} follow")
    return data[at + 4 : at + 4 + size], at + 4 + size


def _fields(head: bytes) -> Iterator[tuple[bytes, bytes]]:
    at = 0
    while at < len(head):
        pair, at = _sized(head, at)
        name, _, value = pair.partition(b"=")
        yield name, value


# --------------------------------------------------------------------------------- ROS 2


def _add_database(log: Log, path: Path) -> None:
    with mapped(path) as data:
        room = Room(path, len(data))
        if data[:16] != b"SQLite format 3\0":
            raise DamageError("it is not a database of SQLite")
    ahead = path.with_name(f"{path.name}-wal")
    help_ = "sqlite3 FILE .recover  writes what is readable"
    with log.partly(path, help_), closing(_opened(path)) as database:
        _add_messages(log, room, database)
        if ahead.exists() and ahead.stat().st_size:
            raise DamageError(f"it was not closed, and `{ahead.name}` is not read")


def _add_messages(log: Log, room: Room, database: sqlite3.Connection) -> None:
    texts: dict[str, str] = {}
    with suppress(sqlite3.OperationalError):  # before Iron, there is no such table
        query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
        texts = {str(n): str(text) for n, how, text in database.execute(query) if how == "ros2msg"}
    topics = database.execute("SELECT id, name, type, serialization_format FROM topics").fetchall()
    channels = {
        number: log.channel(str(name), str(kind), partial(_decoder, str(kind), str(form), texts.get(kind)))
        for number, name, kind, form in topics
        if isinstance(number, int)
    }
    read = ", ".join(str(n) for n, each in channels.items() if each.source.selection is not None)
    query = "SELECT topic_id, timestamp, data FROM messages"
    for number, time, content in database.execute(f"{query} WHERE topic_id IN ({read})"):
        if not isinstance(time, int) or not isinstance(content, bytes):
            raise DamageError("a message without a time, or without content")
        room.left -= len(content) + 16
        if room.left < 0:
            raise unreadable(log.path, "its messages are larger than its file")
        log.add(channels[number], time, content, room)
    for number, channel in channels.items() if log.missing else ():
        for _, time, content in database.execute(f"{query} WHERE topic_id = {number} LIMIT 1"):
            if channel.source.selection is None and isinstance(content, bytes):
                log.add(channel, time, content, room)


def _opened(path: Path) -> sqlite3.Connection:
    database = sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)
    database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _LONGEST)
    tables = dict(database.execute("SELECT name, sql FROM sqlite_master WHERE type = 'table'"))
    for name in ("topics", "messages"):
        if not re.match(r"CREATE TABLE\b", str(tables.get(name)), re.IGNORECASE):
            database.close()
            raise DamageError(f"the database has no table `{name}`")
    allowed = (sqlite3.SQLITE_SELECT, sqlite3.SQLITE_READ)  # no functions, pragmas or recursion
    database.set_authorizer(lambda a, *_: sqlite3.SQLITE_OK if a in allowed else sqlite3.SQLITE_DENY)
    return database


def _decoder(kind: str, form: str, text: str | None, selection: Selection) -> Decode:
    if form != "cdr":
        raise DamageError(f"its messages are written as `{form[:40]}`")
    if not text:
        try:
            text = str(_usual().generate_msgdef(kind, ros_version=2)[0])
        except StlcError:
            raise
        except Exception:  # the library's error for an unknown name
            raise DamageError(f"`{kind[:60]}` is defined neither in the bag nor by ROS itself") from None
    return decoder(text, "cdr", selection)


@cache
def _usual() -> Any:
    types = needed("rosbags.typesys")
    return types.get_typestore(types.Stores.LATEST)
