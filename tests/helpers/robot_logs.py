"""Robot logs written without libraries, for tests and `tools/fuzz.py`."""

import bz2
import io
import sqlite3
import struct
import tempfile
from collections.abc import Callable
from pathlib import Path

START = 1_700_000_000_000_000_000
STEP = 100_000_000
"""Nanoseconds from one message to the next."""

DEFINITION = """Header header
geometry_msgs/Point position
float64[3] q
float64[] more
bool flag
string frame
uint8 KIND=3
================================================================================
MSG: std_msgs/Header
uint32 seq
time stamp
string frame_id
================================================================================
MSG: geometry_msgs/Point
float64 x
float64 y
"""
DEFINITION_2 = DEFINITION.replace("uint32 seq\ntime stamp", "builtin_interfaces/Time stamp") + (
    "=" * 80 + "\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
)


def message(x: float, k: int) -> bytes:
    """A ROS 1 message by `DEFINITION`."""
    head = struct.pack("<III", k, 5, 6) + _text(b"map")
    values = struct.pack("<5d", x, 2.0, 1.0, 2.0, 3.0)
    return head + values + struct.pack("<I2d", 2, 7.0, 8.0) + struct.pack("<?", k > 7) + _text(b"base")


def message_2(x: float, k: int) -> bytes:
    """A ROS 2 message by `DEFINITION_2`."""
    head = struct.pack("<iII", 5, 6, 4) + b"map\0"
    values = struct.pack("<5d", x, 2.0, 1.0, 2.0, 3.0)
    more = struct.pack("<I4x2d", 2, 7.0, 8.0) + struct.pack("<?3xI", k > 7, 5) + b"base\0"
    return b"\0\1\0\0" + head + values + more


def _text(data: bytes) -> bytes:
    return struct.pack("<I", len(data)) + data


def _record(content: bytes, **fields: bytes) -> bytes:
    head = b"".join(_text(name.encode() + b"=" + value) for name, value in fields.items())
    return _text(head) + _text(content)


def bag(values: list[float], *, compression: str = "bz2", change: Callable[[bytes], bytes] = bytes) -> bytes:
    """A bag of ROS 1 with one topic, `/robot/state`, in one chunk, changed before compression."""
    facts = {
        "type": b"demo/State",
        "md5sum": b"0" * 32,
        "topic": b"/robot/state",
        "message_definition": DEFINITION.encode(),
    }
    content = b"".join(_text(name.encode() + b"=" + value) for name, value in facts.items())
    connection = _record(content, op=b"\7", conn=struct.pack("<I", 0), topic=b"/robot/state")
    chunk = connection
    for k, x in enumerate(values):
        stamp = struct.pack("<II", *divmod(START + k * STEP, 10**9))
        chunk += _record(message(x, k), op=b"\2", conn=struct.pack("<I", 0), time=stamp)
    chunk = change(chunk)
    packed = {"bz2": bz2.compress, "none": bytes}[compression](chunk)
    body = _record(packed, op=b"\5", compression=compression.encode(), size=struct.pack("<I", len(chunk)))
    place = 13 + 4096 + len(body)
    head = {"op": b"\3", "index_pos": struct.pack("<Q", place), "conn_count": b"\1\0\0\0"}
    front = _record(b"", **head, chunk_count=b"\1\0\0\0")
    padded = front[:-4] + _text(b" " * (4096 - len(front)))
    return b"#ROSBAG V2.0\n" + padded + body + connection


def bag2(values: list[float]) -> bytes:
    """The database of a bag of ROS 2 with one topic, `/robot/state`, and the definition of its messages."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.db3"
        database = sqlite3.connect(path)
        database.executescript(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT);"
            "CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT, encoding TEXT,"
            " encoded_message_definition TEXT, type_description_hash TEXT);"
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB);"
        )
        database.execute("INSERT INTO topics VALUES(1, '/robot/state', 'demo/msg/State', 'cdr')")
        row = (1, "demo/msg/State", "ros2msg", DEFINITION_2, "")
        database.execute("INSERT INTO message_definitions VALUES(?, ?, ?, ?, ?)", row)
        rows = [(1, START + k * STEP, message_2(x, k)) for k, x in enumerate(values)]
        database.executemany("INSERT INTO messages(topic_id, timestamp, data) VALUES(?, ?, ?)", rows)
        database.commit()
        database.close()
        return path.read_bytes()


def json_mcap(values: list[float]) -> bytes:
    """A log of JSON messages with one topic, `/robot/state`; needs `mcap`."""
    import json

    from mcap.writer import Writer

    file = io.BytesIO()
    writer = Writer(file)
    writer.start()
    schema = writer.register_schema("demo.State", "jsonschema", b'{"type": "object"}')
    channel = writer.register_channel("/robot/state", "json", schema)
    for k, x in enumerate(values):
        content = {"position": {"x": x, "y": 2.0}, "q": [1.0, 2.0, 3.0], "flag": k > 7, "frame": "base"}
        content["header"] = {"stamp": {"sec": 5, "nsec": 6}}
        stamp = START + k * STEP
        writer.add_message(channel, stamp, json.dumps(content).encode(), stamp)
    writer.finish()
    return file.getvalue()
