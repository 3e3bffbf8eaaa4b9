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
from contextlib import closing
from dataclasses import dataclass
from functools import cache
from mmap import mmap
from pathlib import Path
from typing import Any, TypeAlias

from stlc.diagnostics import Diagnostic, UsageError
from stlc.files import is_stored
from stlc.trace.formats.messages import MAX_BYTES, DamageError, Decode, Log, Room, mapped
from stlc.trace.formats.registry import damage, needed, unreadable
from stlc.trace.formats.ros import Form, decoder
from stlc.trace.recording import Recording

_MAGIC = b"#ROSBAG V2.0\n"
_MESSAGE, _HEADER, _CHUNK, _CONNECTION = 2, 3, 5, 7
_PACKED = ".zstd"
_ALLOWED = (sqlite3.SQLITE_SELECT, sqlite3.SQLITE_READ)
"""Database operations that a query may use: no functions, pragmas or recursion."""
_LONGEST = 256_000_000
"""Greatest number of bytes of a message."""


def read(path: Path) -> Recording:
    """Read all numbers in the messages of a bag: a `.bag` file, a `.db3` file, or a folder.

    Raises:
        UsageError: U102, there is no such file, or no bag in the folder.
        MissingError: R301, a package is not installed.
        TraceError: E603, the file is of another format, damaged, or without numbers.
    """
    return _read_ros1(path) if path.suffix.lower() == ".bag" and not path.is_dir() else _read_ros2(path)


@dataclass(frozen=True, slots=True)
class _Topic:
    """A ROS topic and the decoder of its messages; None if the messages cannot be decoded."""

    name: str
    decode: Decode | None

    @staticmethod
    def of(log: Log, name: str, definition: str, form: Form) -> _Topic:
        """Return the topic with the decoder of its messages.

        `definition` is the text of the message definition, `form` the encoding: "ros1" or "cdr" (ROS 2). If
        the definition is invalid, the decoder is None, and the reason is stored in `log.unread`.
        """
        try:
            return _Topic(name, decoder(definition, form))
        except DamageError as error:
            log.unread[name] = str(error)
            return _Topic(name, None)


# --------------------------------------------------------------------------------- ROS 1


def _read_ros1(path: Path) -> Recording:
    """Read all numbers in the messages of a ROS 1 bag."""
    log = Log(path)
    with mapped(path) as data, damage(path):
        if data[: len(_MAGIC)] != _MAGIC:
            raise DamageError("it does not begin like a bag of version 2.0")
        topics: dict[int, _Topic] = {}
        room = Room(path, len(data))
        for kind, fields, content in _records(data, len(_MAGIC)):
            if kind == _CHUNK:
                how, size = fields[b"compression"].decode(), _word(fields[b"size"])
                inner = room.unpacked(how, content, size)
                for record in _records(inner, 0):
                    _take(log, topics, *record)
            else:
                _take(log, topics, kind, fields, content)
        return log.recording()


Bytes: TypeAlias = bytes | mmap


def _records(data: Bytes, at: int) -> Iterator[tuple[int, dict[bytes, bytes], bytes]]:
    """Yield (record type, header fields, data) of each record in `data`, from byte `at` on."""
    while at < len(data):
        head, at = _sized(data, at)
        content, at = _sized(data, at)
        fields = dict(_fields(head))
        yield fields[b"op"][0], fields, content


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


def _word(field: bytes) -> int:
    value: int = struct.unpack("<I", field)[0]
    return value


def _take(log: Log, topics: dict[int, _Topic], kind: int, fields: dict[bytes, bytes], content: bytes) -> None:
    """Process one record of a file.

    The topic of a connection is added to `topics`, and the numbers in a message are added to `log`. `topics`
    maps the number of a connection to its topic. Other kinds of records are ignored.
    """
    if kind == _CONNECTION:
        number = _word(fields[b"conn"])
        if number not in topics:
            definition = dict(_fields(content))[b"message_definition"].decode("utf-8", "replace")
            topics[number] = _Topic.of(log, fields[b"topic"].decode(), definition, "ros1")
    elif kind == _MESSAGE:
        topic = topics.get(_word(fields[b"conn"]))
        if topic is None:
            raise DamageError("a message of an unknown connection")
        if topic.decode is not None:
            seconds, rest = struct.unpack("<II", fields[b"time"])
            log.add(topic.name, seconds * 10**9 + rest, topic.decode(content))


# --------------------------------------------------------------------------------- ROS 2


def _read_ros2(path: Path) -> Recording:
    """Read all numbers in the messages of a ROS 2 bag: a folder, or a single `.db3` file."""
    log = Log(path)
    if path.is_dir():
        stored = sorted((each for each in path.iterdir() if is_stored(each)), key=_order)
        if not stored:
            help_ = ("the folder of a bag holds .db3 or .mcap files",)
            raise UsageError(Diagnostic("U102", f"cannot read `{path}`: is a directory", help=help_))
    else:
        stored = [path]
    for each in stored:
        with damage(path):
            _add_stored(log, each)
    return log.recording()


def _order(path: Path) -> tuple[object, ...]:
    """Sort key of a file: digits are compared as numbers, so that `bag_9.db3` precedes `bag_10.db3`."""
    return tuple(
        (int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d{1,18})", path.name)
    )


def _add_stored(log: Log, path: Path) -> None:
    """Add the messages of one file; a compressed file is first unpacked to a temporary file."""
    if path.name.lower().endswith(_PACKED):
        with mapped(path) as data:
            content = Room(path, len(data)).of_unknown_size(data[:])
        with tempfile.TemporaryDirectory(prefix="stlc-bag-") as folder:
            inner = Path(folder) / f"bag{Path(path.stem).suffix.lower()}"
            inner.write_bytes(content)
            del content
            _add_stored(log, inner)
    elif path.suffix.lower() == ".mcap":
        from stlc.trace.formats.mcap import add_mcap

        add_mcap(log, path)
    else:
        _add_database(log, path)


def _add_database(log: Log, path: Path) -> None:
    with mapped(path) as data:
        room = Room(path, len(data))
        if data[:16] != b"SQLite format 3\0":
            raise DamageError("it is not a database of SQLite")
    with closing(_opened(path)) as database:
        topics = _topics(log, database)
        query = "SELECT topic_id, timestamp, data FROM messages"
        for number, time, content in database.execute(query):
            topic = topics.get(number)
            if topic is None or topic.decode is None:
                continue
            if not isinstance(time, int) or not isinstance(content, bytes):
                raise DamageError("a message without a time, or without content")
            room.left -= len(content) + 16
            if room.left < 0:
                raise unreadable(path, "its messages are larger than its file")
            log.add(topic.name, time, topic.decode(room.whole(content)))


def _opened(path: Path) -> sqlite3.Connection:
    """Open a database read-only, and forbid every operation in it other than reading tables."""
    where = path.resolve().as_uri()
    database = sqlite3.connect(f"{where}?mode=ro&immutable=1", uri=True)
    database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, min(_LONGEST, MAX_BYTES))
    tables = dict(database.execute("SELECT name, sql FROM sqlite_master WHERE type = 'table'"))
    for name in ("topics", "messages"):
        if not re.match(r"CREATE TABLE\b", str(tables.get(name)), re.IGNORECASE):
            database.close()
            raise DamageError(f"the database has no table `{name}`")

    def allow(action: int, *_: object) -> int:
        return sqlite3.SQLITE_OK if action in _ALLOWED else sqlite3.SQLITE_DENY

    database.set_authorizer(allow)
    return database


def _topics(log: Log, database: sqlite3.Connection) -> dict[int, _Topic]:
    """Read the topics of a database: topic number -> topic."""
    texts = _definitions(database)
    topics: dict[int, _Topic] = {}
    query = "SELECT id, name, type, serialization_format FROM topics"
    for number, name, kind, form in database.execute(query):
        if form != "cdr":
            log.unread[str(name)] = f"its messages are written as `{str(form)[:40]}`"
            continue
        text = texts.get(kind) or _usual(str(kind))
        if text is None:
            log.unread[str(name)] = f"`{str(kind)[:60]}` is defined neither in the bag nor by ROS itself"
        else:
            topics[number] = _Topic.of(log, str(name), text, "cdr")
    return topics


def _definitions(database: sqlite3.Connection) -> dict[str, str]:
    """Message definitions in the database: message type -> definition; {} if the database has none."""
    query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
    try:
        rows = database.execute(query).fetchall()
    except sqlite3.OperationalError:  # before Iron
        return {}
    return {str(kind): str(text) for kind, encoding, text in rows if encoding == "ros2msg"}


def _usual(kind: str) -> str | None:
    """Definition of the ROS 2 message type `kind`; None if this is not a standard type."""
    store = _usual_ones()
    try:
        return str(store.generate_msgdef(kind, ros_version=2)[0])
    except Exception:  # the library's error for an unknown name
        return None


@cache
def _usual_ones() -> Any:
    types = needed("rosbags.typesys")
    return types.get_typestore(types.Stores.LATEST)
