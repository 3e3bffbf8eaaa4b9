"""Logs in MCAP: JSON, Protocol Buffers, what is not read, and margins that are written and read again."""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

from stlc.diagnostics import StlcError
from stlc.signature import Column, Signature
from stlc.trace import Reading, Trace, TraceMeta
from stlc.units import Unit

writers = pytest.importorskip("mcap.writer")
from helpers import robot_logs  # noqa: E402

X = np.sin(np.arange(21) / 10)


def message_of(path: Path) -> str:
    with pytest.raises(StlcError) as caught:
        Trace.load(path)
    return str(caught.value)


def a_log(
    path: Path, encodings: tuple[str, str], schema: bytes, messages: Iterable[tuple[int, bytes]]
) -> Path:
    """One topic `/state`; the schema is called `demo.State`."""
    file = io.BytesIO()
    writer = writers.Writer(file)
    writer.start()
    described = writer.register_schema("demo.State", encodings[1], schema)
    channel = writer.register_channel("/state", encodings[0], described)
    for stamp, data in messages:
        writer.add_message(channel, stamp, data, stamp)
    writer.finish()
    path.write_bytes(file.getvalue())
    return path


def test_json(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(robot_logs.json_mcap(X.tolist()))
    (tmp_path / "b.mcap").write_bytes((tmp_path / "a.mcap").read_bytes()[:-60])  # without all of its index
    assert Trace.load(tmp_path / "b.mcap").samples == 21
    trace = Trace.load(tmp_path / "a.mcap")
    assert (trace.dt, trace.samples, trace.meta.origin) == (0.1, 21, robot_logs.START)
    np.testing.assert_array_equal(trace.data["robot.state.position.x"][0], X)
    assert set(trace.data) == {
        f"robot.state.{n}" for n in ("position.x", "position.y", "q[0]", "q[1]", "q[2]", "flag")
    }


@pytest.mark.parametrize(
    "text", [b"{", b"[" * 5000, b'{"x": 1e999}', b"\xff", b'{"x": 1' + b"0" * 400 + b"}"]
)
def test_json_that_is_odd(tmp_path: Path, text: bytes) -> None:
    path = a_log(tmp_path / "a.mcap", ("json", "jsonschema"), b"{}", [(0, text), (10**9, text)])
    if b"999" in text:
        assert np.isinf(Trace.load(path).data["state.x"]).all()
    else:
        assert message_of(path).startswith("E603")


def test_messages_out_of_order_and_times_that_are_none(tmp_path: Path) -> None:
    messages = [(k * 10**8, json.dumps({"data": k}).encode()) for k in (1, 0, 3, 2)]
    path = a_log(tmp_path / "a.mcap", ("json", "jsonschema"), b"{}", messages)
    assert Trace.load(path).data["state"].tolist() == [[0.0, 1.0, 2.0, 3.0]]
    late = a_log(tmp_path / "b.mcap", ("json", ""), b"", [(2**63, b"{}"), (2**64 - 1, b"{}")])
    assert "which is no time" in message_of(late)


def test_protocol_buffers(tmp_path: Path) -> None:
    descriptors = pytest.importorskip("google.protobuf.descriptor_pb2")
    file = descriptors.FileDescriptorProto(name="demo.proto", package="demo", syntax="proto3")
    inner = file.message_type.add(name="Stamp")
    inner.field.add(name="seconds", number=1, type=3, label=1)
    inner.field.add(name="nanos", number=2, type=5, label=1)
    kind = file.message_type.add(name="State")
    kind.field.add(name="x", number=1, type=1, label=1)
    kind.field.add(name="q", number=2, type=2, label=3)
    kind.field.add(name="at", number=3, type=11, label=1, type_name=".demo.Stamp")
    kind.field.add(name="word", number=4, type=9, label=1)
    kind.field.add(name="again", number=5, type=11, label=1, type_name=".demo.State")
    schema = descriptors.FileDescriptorSet(file=[file]).SerializeToString()
    messages = [
        (
            k * 10**8,
            b"\x09"
            + struct.pack("<d", x)
            + b"\x12\x08"
            + struct.pack("<2f", 1, 2)
            + b"\x1a\x02\x08\x05"
            + b"\x22\1a",
        )
        for k, x in enumerate(X.tolist())
    ]
    trace = Trace.load(a_log(tmp_path / "a.mcap", ("protobuf", "protobuf"), schema, messages))
    np.testing.assert_array_equal(trace.data["state.x"][0], X)
    assert set(trace.data) == {"state.x", "state.q[0]", "state.q[1]", "state.at"}
    assert trace.data["state.at"][0, 0] == 5.0
    broken = a_log(tmp_path / "b.mcap", ("protobuf", "protobuf"), schema[:-9], messages)
    assert message_of(broken).startswith("E603")


def test_what_is_not_read_is_named(tmp_path: Path) -> None:
    path = a_log(tmp_path / "a.mcap", ("cbor", "cddl"), b"", [(0, b"x")])
    assert "its messages are written as `cbor` by `cddl` (read are JSON" in message_of(path)


def test_messages_of_ros_1(tmp_path: Path) -> None:
    messages = [(k * 10**8, robot_logs.message(x, k)) for k, x in enumerate(X.tolist())]
    path = a_log(tmp_path / "a.mcap", ("ros1", "ros1msg"), robot_logs.DEFINITION.encode(), messages)
    np.testing.assert_array_equal(Trace.load(path).data["state.position.x"][0], X)


def test_a_chunk_that_was_changed_or_unpacks_without_end(tmp_path: Path) -> None:
    zstandard = pytest.importorskip("zstandard")
    raw = robot_logs.json_mcap(X.tolist())
    at = raw.index(b"\x28\xb5\x2f\xfd")
    (tmp_path / "a.mcap").write_bytes(raw[: at + 60] + b"\0" + raw[at + 61 :])
    assert message_of(tmp_path / "a.mcap").startswith("E603")
    bomb = zstandard.compress(bytes(300_000_000))
    head = struct.pack("<QQQII4sQ", 0, 0, 300_000_000, 0, 4, b"zstd", len(bomb))
    record = b"\x06" + struct.pack("<Q", len(head) + len(bomb)) + head + bomb
    start = raw.index(b"\x06", 8)
    (tmp_path / "b.mcap").write_bytes(raw[:17] + raw[17:start] + record)
    assert "unpacks to" in message_of(tmp_path / "b.mcap")


# ------------------------------------------------------------------------------- written


@pytest.mark.parametrize("traces", [1, 3])
def test_what_is_written_is_read_again(tmp_path: Path, traces: int) -> None:
    rng = np.random.default_rng(0)
    x = rng.normal(size=(traces, 8))
    x[0, :4] = np.nan, np.inf, -np.inf, -0.0
    columns = Signature((Column("keep gap", Unit.parse("m")), Column("mode", kind="int"), Column("q[0]")))
    data = {"keep gap": x, "mode": np.ones((traces, 8)), "q[0]": -x}
    meta = TraceMeta("traffic", seed=3, dt=1 / 30, origin=robot_logs.START)
    trace = Trace(columns, 1 / 30, data, -0.5, meta=meta)
    trace.save(tmp_path / "margins.mcap")
    back = Trace.load(tmp_path / "margins.mcap")
    assert (back.signature, back.dt, back.meta, back.t0) == (columns, 1 / 30, meta, -0.5)
    assert all(np.array_equal(back.data[name], data[name], equal_nan=True) for name in data)


def test_others_find_messages_of_json_with_a_schema(tmp_path: Path) -> None:
    data = {"r": np.array([[1.0, np.nan], [2.0, np.inf]])}
    meta = TraceMeta(origin=robot_logs.START)
    Trace(Signature((Column("r", Unit.parse("m")),)), 0.1, data, meta=meta).save(tmp_path / "my margins.mcap")
    reader = pytest.importorskip("mcap.reader").make_reader(
        io.BytesIO((tmp_path / "my margins.mcap").read_bytes())
    )
    found = [
        (channel.topic, message.log_time - robot_logs.START, json.loads(message.data))
        for schema, channel, message in reader.iter_messages()
        if (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
    ]
    assert sorted(found, key=lambda each: each[:2]) == [
        ("/my_margins/0", 0, {"r": 1.0}),
        ("/my_margins/0", 10**8, {"r": None}),
        ("/my_margins/1", 0, {"r": 2.0}),
        ("/my_margins/1", 10**8, {"r": float("inf")}),
    ]
    (schema,) = reader.get_summary().schemas.values()
    assert json.loads(schema.data)["properties"] == {"r": {"type": "number", "description": "m"}}


def test_a_record_of_ours_that_lies(tmp_path: Path) -> None:
    Trace(Signature((Column("r"),)), 0.1, {"r": np.zeros((1, 3))}).save(tmp_path / "a.mcap")
    raw = (tmp_path / "a.mcap").read_bytes()
    for old, new in ((b'["/a"]', b'["/b"]'), (b'["/a"]', b'[["a"]'), (b'{"spec_name"', b'["spec_name"')):
        (tmp_path / "b.mcap").write_bytes(raw.replace(old, new))
        try:
            assert Trace.load(tmp_path / "b.mcap", Reading()).samples == 3
        except StlcError as error:
            assert error.diagnostics[0].code == "E603"  # noqa: PT017


@pytest.mark.parametrize("order", [("sec", "nanosec"), ("nanosec", "sec")])
@pytest.mark.parametrize("names", [("sec", "nanosec"), ("secs", "nsecs"), ("seconds", "nanos")])
def test_the_fields_of_a_time_stamp_may_have_any_order(
    tmp_path: Path, order: tuple[str, str], names: tuple[str, str]
) -> None:
    values = dict(zip(("sec", "nanosec"), zip(names, (3, 500_000_000), strict=True), strict=True))
    text = json.dumps({"st": dict(values[each] for each in order)}).encode()
    path = a_log(tmp_path / "a.mcap", ("json", "jsonschema"), b"{}", [(0, text), (10**9, text)])
    assert Trace.load(path).data["state.st"].tolist() == [[3.5, 3.5]]


def test_a_time_stamp_that_is_no_number(tmp_path: Path) -> None:
    text = b'{"st": {"sec": 1e999, "nanosec": -1e999}}'
    path = a_log(tmp_path / "a.mcap", ("json", "jsonschema"), b"{}", [(0, text), (10**9, text)])
    assert np.isnan(Trace.load(path).data["state.st"]).all()


def test_names_that_utf_8_cannot_encode_are_replaced(tmp_path: Path) -> None:
    text = b'{"x\\ud800": 1}'
    path = a_log(tmp_path / "a.mcap", ("json", "jsonschema"), b"{}", [(0, text), (10**9, text)])
    assert [*Trace.load(path).data] == ["state.x\ufffd"]
