"""Bags of ROS 1 and 2: what is read, hostile definitions and databases, and what unpacks without end."""

from __future__ import annotations

import bz2
import sqlite3
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import robot_logs

from stlc.diagnostics import StlcError
from stlc.files import File
from stlc.trace import Reading, Trace
from stlc.trace.formats.messages import DamageError
from stlc.trace.formats.paths import Selection
from stlc.trace.formats.ros import decoder

X = np.sin(np.arange(21) / 10)


def message_of(path: Path) -> str:
    with pytest.raises(StlcError) as caught:
        Trace.load(path)
    return str(caught.value)


def check_state(trace: Trace) -> None:
    """Contents of every log of `robot_logs`."""
    assert (trace.dt, trace.samples, trace.t0) == (0.1, 21, 0.0)
    np.testing.assert_array_equal(trace.data["robot.state.position.x"][0], X)
    assert trace.data["robot.state.q[2]"][0].tolist() == [3.0] * 21
    assert trace.data["robot.state.flag"][0].tolist() == [0.0] * 8 + [1.0] * 13
    assert trace.signature["robot.state.flag"].kind == "int"
    assert not any("header" in name or "frame" in name for name in trace.data)
    assert trace.meta.origin == robot_logs.START


@pytest.mark.parametrize("compression", ["none", "bz2"])
def test_a_bag_of_ros_1(tmp_path: Path, compression: str) -> None:
    (tmp_path / "a.bag").write_bytes(robot_logs.bag(X.tolist(), compression=compression))
    trace = Trace.load(tmp_path / "a.bag")
    check_state(trace)
    assert trace.data["robot.state.more[1]"][0].tolist() == [8.0] * 21


def test_a_bag_of_ros_2(tmp_path: Path) -> None:
    folder = tmp_path / "drive"
    folder.mkdir()
    (folder / "drive_0.db3").write_bytes(robot_logs.bag2(X.tolist()))
    (folder / "metadata.yaml").write_text("rosbag2_bagfile_information: {}")
    check_state(Trace.load(folder / "drive_0.db3"))
    check_state(Trace.load(folder))


def test_a_folder_is_one_bag_of_several_files(tmp_path: Path) -> None:
    for k in (2, 10):
        (tmp_path / f"drive_{k}.db3").write_bytes(robot_logs.bag2([float(k)] * 3))
    trace = Trace.load(tmp_path, Reading(resample=0.1))
    assert trace.data["robot.state.position.y"][0].tolist() == [2.0] * 3
    assert trace.samples == 3


def test_a_folder_that_is_no_bag(tmp_path: Path) -> None:
    assert message_of(tmp_path).startswith("U102")


# ------------------------------------------------------------------- bags of the library


def library(which: str) -> Any:
    return pytest.importorskip(f"rosbags.{which}")


def filled(writer: Any, store: Any, *, two: bool) -> None:
    """Odometry, a truth value and joints, 21 messages each."""
    kinds = ("nav_msgs/msg/Odometry", "std_msgs/msg/Bool", "sensor_msgs/msg/JointState")
    places = [
        writer.add_connection(topic, kind, typestore=store)
        for topic, kind in zip(("/odom", "/on", "/js"), kinds, strict=True)
    ]

    def made(name: str, *values: object) -> Any:
        return store.types[name](*values)

    def vector(kind: str, *values: float) -> Any:
        return made(f"geometry_msgs/msg/{kind}", *values)

    for k in range(21):
        stamp = made("builtin_interfaces/msg/Time", 5, k)
        head = made("std_msgs/msg/Header", *(() if two else (k,)), stamp, "map")
        pose = vector(
            "Pose", vector("Point", float(X[k]), 2.0, 3.0), vector("Quaternion", 0.0, 0.0, 0.0, 1.0)
        )
        twist = vector("Twist", vector("Vector3", float(k), 0.0, 0.0), vector("Vector3", 0.0, 0.0, 0.0))
        spread = np.arange(36.0)
        odometry = made(
            kinds[0],
            head,
            "base",
            vector("PoseWithCovariance", pose, spread),
            vector("TwistWithCovariance", twist, spread),
        )
        joints = made(kinds[2], head, ["a", "bcd"], np.array([k / 10, 2.0]), np.zeros(0), np.array([1.0]))
        contents = (odometry, made(kinds[1], k > 7), joints)
        for place, kind, content in zip(places, kinds, contents, strict=True):
            data = (store.serialize_cdr if two else store.serialize_ros1)(content, kind)
            writer.write(place, robot_logs.START + k * robot_logs.STEP, data)


def check_filled(path: Path) -> None:
    trace = Trace.load(path, Reading(resample=0.1))
    np.testing.assert_allclose(trace.data["odom.pose.pose.position.x"][0], X, atol=1e-12)
    assert trace.data["odom.pose.covariance[35]"][0].tolist() == [35.0] * 21
    assert trace.data["on"][0].tolist() == [0.0] * 8 + [1.0] * 13
    np.testing.assert_allclose(trace.data["js.position[0]"][0], np.arange(21) / 10, atol=1e-12)
    assert "js.velocity[0]" not in trace.data


@pytest.mark.parametrize("compression", ["NONE", "BZ2", "LZ4"])
def test_bags_of_ros_1_that_rosbags_writes(tmp_path: Path, compression: str) -> None:
    writer = library("rosbag1").Writer(tmp_path / "a.bag")
    if compression != "NONE":
        writer.set_compression(writer.CompressionFormat[compression])
    store = library("typesys").get_typestore(library("typesys").Stores.ROS1_NOETIC)
    with writer:
        filled(writer, store, two=False)
    check_filled(tmp_path / "a.bag")


@pytest.mark.parametrize("version", [8, 9])
@pytest.mark.parametrize("storage", ["SQLITE3", "MCAP"])
@pytest.mark.parametrize("mode", ["NONE", "FILE", "MESSAGE", "STORAGE"])
def test_bags_of_ros_2_that_rosbags_writes(tmp_path: Path, version: int, storage: str, mode: str) -> None:
    bags = library("rosbag2")
    if (storage, mode) == ("SQLITE3", "STORAGE"):
        pytest.skip("there is none")
    writer = bags.Writer(tmp_path / "a", version=version, storage_plugin=bags.StoragePlugin[storage])
    if mode != "NONE":
        writer.set_compression(bags.CompressionMode[mode], bags.CompressionFormat.ZSTD)
    store = library("typesys").get_typestore(library("typesys").Stores.ROS2_HUMBLE)
    with writer:
        filled(writer, store, two=True)
    check_filled(tmp_path / "a")


def test_usual_messages_need_no_definition_in_the_bag(tmp_path: Path) -> None:
    library("typesys")
    path = tmp_path / "a.db3"
    with sqlite3.connect(path) as database:
        database.execute("CREATE TABLE topics(id INTEGER, name TEXT, type TEXT, serialization_format TEXT)")
        database.execute("CREATE TABLE messages(id INTEGER, topic_id INTEGER, timestamp INTEGER, data BLOB)")
        database.execute("INSERT INTO topics VALUES(1, '/x', 'std_msgs/msg/Float64', 'cdr')")
        database.execute("INSERT INTO topics VALUES(2, '/y', 'own_msgs/msg/Odd', 'cdr')")
        rows = [(k, n, k * 10**8, b"\0\1\0\0" + struct.pack("<d", k)) for k in range(5) for n in (1, 2)]
        database.executemany("INSERT INTO messages VALUES(?, ?, ?, ?)", rows)
    database.close()
    assert {n: x.tolist() for n, x in Trace.load(path).data.items()} == {"x": [[0.0, 1.0, 2.0, 3.0, 4.0]]}


# ---------------------------------------------------------------------------- hostile bags


def test_a_chunk_that_unpacks_without_end(tmp_path: Path) -> None:
    raw = robot_logs.bag(X.tolist())
    bomb = bz2.compress(bytes(100_000_000))
    at = raw.index(b"BZh")
    size = struct.unpack_from("<I", raw, at - 4)[0]
    (tmp_path / "a.bag").write_bytes(raw[: at - 4] + struct.pack("<I", len(bomb)) + bomb + raw[at + size :])
    assert "are declared where" in message_of(tmp_path / "a.bag")
    was = raw.index(b"size=") + 5
    raw = raw[:was] + struct.pack("<I", 100_000_000) + raw[was + 4 :]
    (tmp_path / "b.bag").write_bytes(raw)
    assert "unpacks to" in message_of(tmp_path / "b.bag")


@pytest.mark.parametrize(
    "table",
    [
        "CREATE VIEW messages AS SELECT 1 AS topic_id, 1 AS timestamp, zeroblob(900000000) AS data",
        "CREATE TABLE messages(topic_id INT, timestamp INT, data BLOB AS (zeroblob(900000000)))",
        "CREATE TABLE messages(topic_id INT, timestamp TEXT, data BLOB)",
        "CREATE TABLE messages(topic_id INT)",
    ],
)
def test_a_database_that_does_something(tmp_path: Path, table: str) -> None:
    (tmp_path / "a.db3").write_bytes(robot_logs.bag2(X.tolist()))
    with sqlite3.connect(tmp_path / "a.db3") as database:
        database.execute("DROP TABLE messages")
        database.execute(table)
        if "TEXT" in table:
            database.execute("INSERT INTO messages VALUES(1, 'now', x'00010000')")
        elif "AS (" in table:
            database.execute("INSERT INTO messages(topic_id, timestamp) VALUES(1, 1)")
    database.close()
    assert message_of(tmp_path / "a.db3").startswith("E603")


def test_definitions_without_an_end_and_messages_that_lie() -> None:
    for text in ("A a\n" + "=" * 80 + "\nMSG: p/A\nA a\n", "NoSuch x\n", "float64 = 3 x\n"):
        with pytest.raises(DamageError):
            decoder(text, "ros1", Selection())
    nested = "T0 a\n" + "".join(f"{'=' * 80}\nMSG: p/T{i}\nT{i + 1}[9] a\n" for i in range(25))
    empty = decoder(nested + f"{'=' * 80}\nMSG: p/T25\n", "ros1", Selection())
    assert empty(b"") == {}
    nested = "T0 a\n" + "".join(f"{'=' * 80}\nMSG: p/T{i}\nT{i + 1} a\nT{i + 1} b\n" for i in range(25))
    assert decoder(nested + f"{'=' * 80}\nMSG: p/T25\n", "ros1", Selection())(b"") == {}
    for form in ("ros1", "cdr"):
        read = decoder("float64[] x\nE[] e\n" + "=" * 80 + "\nMSG: p/E\n", form, Selection())
        for claim in (b"\xff\xff\xff\xff", b"\0\0\0\0\xff\xff\xff\xff"):
            data = (b"" if form == "ros1" else b"\0\1\0\0") + claim
            if form == "ros1" and claim.startswith(b"\0"):
                assert read(data) == {"x": (), "e": []}  # as many as one likes of what takes no byte
            else:
                with pytest.raises(DamageError):
                    read(data)


def test_types_and_remarks_of_definitions() -> None:
    text = "# odd\nint8 A=1\nstring S = x # y\n\nbyte b # odd\ntime at\nstring<=5 s\nint16[<=4] few 3\n"
    data = struct.pack("<bII", 5, 7, 500_000_000) + struct.pack("<I2sIhh", 2, b"ab", 2, -1, -2)
    found = decoder(text, "ros1", Selection())(data)
    assert found == {"b": 5, "at": {"secs": 7, "nsecs": 500_000_000}, "s": "ab", "few": (-1, -2)}
    big = b"\0\0\0\0" + struct.pack(">bxh4xd", 1, 2, 3.0)
    read = decoder("int8 a\nint16 b\nfloat64 c\n", "cdr", Selection())
    assert read(big) == {"a": 1, "b": 2, "c": 3.0}


def test_a_bag_is_found_by_its_folder(tmp_path: Path) -> None:
    folder = tmp_path / "drive"
    folder.mkdir()
    with pytest.raises(StlcError, match="is a folder, not a trace"):
        File(str(folder)).trace()
    (folder / "drive_0.db3").write_bytes(robot_logs.bag2(X.tolist()))
    assert File(str(folder)).trace() == folder


@pytest.mark.parametrize("fields", ["int32 sec\nuint32 nanosec", "uint32 nanosec\nint32 sec"])
def test_the_fields_of_a_time_stamp_may_have_any_order(fields: str) -> None:
    text = f"p/Stamp st\n{'=' * 80}\nMSG: p/Stamp\n{fields}\n"
    values = (3, 500_000_000) if fields.startswith("int32") else (500_000_000, 3)
    data = b"\0\1\0\0" + struct.pack("<ii", *values)
    assert decoder(text, "cdr", Selection())(data) == {"st": {"sec": 3, "nanosec": 500_000_000}}
