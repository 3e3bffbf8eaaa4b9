"""Signals of logged messages: names, elements by their names, stamps, texts; messages without values."""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import robot_logs
from hypothesis import given, settings
from hypothesis import strategies as st

from stlc.diagnostics import StlcError
from stlc.trace.formats import bag, mcap, ros
from stlc.trace.formats.paths import Path as PartPath
from stlc.trace.formats.paths import Selection
from stlc.trace.recording import Recording, Wanted

writers = pytest.importorskip("mcap.writer")
START, SECOND = robot_logs.START, 10**9

Messages = Mapping[str, Iterable[tuple[int, object]]]


def a_log(path: Path, topics: Messages, **options: Any) -> Path:
    """Topic or `TOPIC@TYPE` -> (ns since `START`, content in JSON) of each message; bytes are not changed."""
    file = io.BytesIO()
    writer = writers.Writer(file, **options)
    writer.start()
    for topic, messages in topics.items():
        name, _, kind = topic.partition("@")
        schema = writer.register_schema(kind, "jsonschema", b"{}")
        channel = writer.register_channel(name, "json", schema)
        for time, content in messages:
            data = content if isinstance(content, bytes) else json.dumps(content).encode()
            writer.add_message(channel, START + time, data, START + time + 7)
    writer.finish()
    path.write_bytes(file.getvalue())
    return path


def read(path: Path, *names: str, clock: str = "") -> Recording:
    module = mcap if path.suffix == ".mcap" else bag
    return module.read(path, Wanted(frozenset(names), clock))


def values(recording: Recording, name: str) -> list[Any]:
    (found,) = (group.arrays[name] for group in recording.groups if name in group.arrays)
    return found.tolist()


def times(recording: Recording, name: str) -> list[int]:
    (group,) = (group for group in recording.groups if name in group.arrays)
    assert group.clock is not None
    assert group.clock.dtype == np.int64
    return [int(t) - START for t in group.clock]


# ---------------------------------------------------------------------------------- names


def test_what_is_not_asked_for_never_matters(tmp_path: Path) -> None:
    broken = [(0, b"{"), (1, b"\xff"), (2**62, b"")]
    path = a_log(tmp_path / "a.mcap", {"/v": [(0, {"x": 1, "bad": [{}, [1]]})], "/broken": broken})
    found = read(path, "v.x")
    assert (found.signals, found.refused, found.others) == (("v.x",), {}, ())
    found = read(path, "broken.x", "v.y", "v.bad", "w")
    assert found.refused["broken.x"].startswith("cannot be read: message 1 is damaged")
    assert "structures" in found.refused["v.bad"]
    assert "v.x" in found.others


def test_two_topics_with_one_name_are_told_apart_by_their_paths(tmp_path: Path) -> None:
    topics = {
        "/cmd": [(0, {"linear": {"x": 9}})],
        "/cmd/linear": [(0, {"x": 1})],
        "/cmd/other": [(0, {"x": 2})],
    }
    path = a_log(tmp_path / "a.mcap", topics)
    found = read(path, "cmd.linear.x", "cmd.other.x")
    assert found.clashes == {
        "cmd.linear.x": {"/cmd: linear.x": "/cmd.linear.x", "/cmd/linear: x": "/cmd/linear.x"}
    }
    assert found.signals == ("cmd.other.x",)
    found = read(path, "/cmd.linear.x", "/cmd/linear.x")
    assert [values(found, n) for n in ("/cmd.linear.x", "/cmd/linear.x")] == [[9.0], [1.0]]
    everything = mcap.read(path)
    assert {"/cmd.linear.x", "/cmd/linear.x", "cmd.other.x"} == set(everything.signals)


def test_two_fields_with_one_name_are_told_apart_by_brackets(tmp_path: Path) -> None:
    path = a_log(tmp_path / "a.mcap", {"/v": [(0, {"x": 2, "a.b": 3, "a": {"b": 4}})]})
    found = read(path, "v.x", "v.a.b")
    assert found.refused["v.a.b"].startswith("may be `[a][b]` or `[a.b]` of a message")
    assert found.signals == ("v.x",)
    found = read(path, "v[a][b]", "v[a.b]")
    assert [values(found, name) for name in ("v[a][b]", "v[a.b]")] == [[4.0], [3.0]]
    everything = mcap.read(path)
    assert everything.refused.keys() == {"v.a.b"}
    assert everything.signals == ("v.x",)


def test_a_topic_of_two_types_is_not_read(tmp_path: Path) -> None:
    path = a_log(
        tmp_path / "a.mcap", {"/v@A": [(0, {"x": 1})], "/v@B": [(0, {"x": 2})], "/w": [(0, {"x": 3})]}
    )
    found = read(path, "v.x", "w.x")
    assert found.refused["v.x"] == "cannot be read: its topic holds messages of two types, `A` and `B`"
    assert found.signals == ("w.x",)


# ------------------------------------------------------------------------------- elements


def test_joints_by_their_names(tmp_path: Path) -> None:
    messages = [
        (0, {"name": ["a", "b"], "position": [1, 2], "velocity": []}),
        (1, {"name": ["b", "a"], "position": [3, 4], "velocity": [5, 6]}),
        (2, {"name": ["b"], "position": [7], "velocity": [8]}),
        (3, {"name": ["c"], "position": [9], "velocity": [9]}),
    ]
    path = a_log(tmp_path / "a.mcap", {"/js": messages})
    found = read(path, "js.position[a]", "js.velocity[a]", "js.position[b]", "js.position[z]")
    assert (values(found, "js.position[a]"), times(found, "js.position[a]")) == ([1.0, 4.0], [0, 1])
    assert str(values(found, "js.velocity[a]")) == "[nan, 6.0]"
    assert (values(found, "js.position[b]"), times(found, "js.position[b]")) == ([2.0, 3.0, 7.0], [0, 1, 2])
    assert "js.position[b]" not in found.others
    (remark,) = read(path, "js.position[0]").remarks
    assert remark.code == "W305"
    assert (
        remark.message
        == "in `/js`, `position[0]` is `position[a]` in some messages, and `position[b]` in others"
    )


def test_elements_by_a_text_in_them(tmp_path: Path) -> None:
    def transform(parent: str, child: str, x: float) -> dict[str, Any]:
        stamp = {"sec": 5, "nanosec": int(x)}
        return {
            "header": {"stamp": stamp, "frame_id": parent},
            "child_frame_id": child,
            "transform": {"x": x},
        }

    topics = {
        "/tf": [
            (0, {"transforms": [transform("/map", "odom", 1), transform("odom", "base", 2)]}),
            (1, {"transforms": [transform("map", "base", 3)]}),
            (2, {"transforms": []}),
        ],
        "/objects": [
            (0, {"objects": [{"id": 3, "label": "car", "v": 1}, {"id": 4, "label": "car", "v": 2}]})
        ],
        "/diagnostics": [(0, {"status": [{"name": "m", "values": [{"key": "t", "value": "4.5"}]}]})],
        "/arm": [(0, {"joint_names": ["a", "b"], "error": {"positions": [1, 2]}})],
    }
    path = a_log(tmp_path / "a.mcap", topics)
    one, two = "tf[map/odom].x", "tf.transforms[map/odom].transform.x"
    arm, motor = "arm.error.positions[b]", "diagnostics.status[m].values[t]"
    found = read(path, one, two, "tf[base].x", "objects[car].v", "objects[4].v", arm, motor)
    assert [values(found, name) for name in (one, two, arm, motor)] == [[1.0], [1.0], [2.0], ["4.5"]]
    assert found.refused["objects[car].v"] == "may be several elements of one array (`3`, `4`)"
    assert found.refused["tf[base].x"] == "may be several elements of one array (`map/base`, `odom/base`)"
    (group,) = read(path, one, clock="header.stamp").groups
    assert group.clock is not None
    assert (group.clock.tolist(), group.named) == ([5 * SECOND + 1], "header.stamp")


# -------------------------------------------------------------------------- kinds of data


def test_kinds_of_values(tmp_path: Path) -> None:
    nan, long = float("nan"), [float(i) for i in range(99)]
    messages = [
        (
            0,
            {
                "v": 1,
                "mode": "IDLE",
                "on": True,
                "odd": 1,
                "q": [1, 2],
                "scan": [*long, nan, float("inf")],
                "few": [1],
            },
        ),
        (1, {"mode": "R" * 99, "on": False, "odd": "b", "q": [3, None], "scan": [-1.0], "few": [1, 2]}),
        (2, {"v": None, "on": True, "odd": 2.5, "scan": []}),
        (3, {"v": 4}),
    ]
    path = a_log(tmp_path / "a.mcap", {"/s": messages})
    names = ("s.v", "s.mode", "s.on", "s.odd", "s.q", "s.q[1]", "min(s.scan)", "max(s.scan)", "s.scan[98]")
    found = read(path, *names, "s.few", "s", "s.scan", "s.q.x")
    assert [str(values(found, name)) for name in names] == [
        "[1.0, nan, nan, 4.0]",
        str(["IDLE", "R" * 64, "", ""]),
        "[1.0, 0.0, 1.0, nan]",
        "['1', 'b', '2.5', '']",
        "[[1.0, 2.0], [3.0, nan], [nan, nan], [nan, nan]]",
        "[2.0, nan, nan, nan]",
        "[0.0, -1.0, nan, nan]",
        "[inf, -1.0, nan, nan]",
        "[98.0, nan, nan, nan]",
    ]
    assert found.refused["s.few"].startswith("is an array of 1 to 2 numbers")
    assert found.refused["s.scan"].startswith("is an array of 0 to 101 numbers")
    assert found.refused["s"].startswith("holds the fields `v`, `mode`")
    assert found.columns.keys() == {"s.v", "s.on", "s.q[1]"}


def test_texts_and_scans_of_ros() -> None:
    text = "Header header\nstring[] name\nwstring wide\nfloat32[] ranges\nuint8 KIND=3\nuint8 kind\n"
    text += "string data\n"
    text += f"{'=' * 80}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
    text += f"{'=' * 80}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
    head = struct.pack("<iII4s", 5, 6, 4, b"map\0") + struct.pack("<II2sxx", 1, 2, b"a\0")
    for wide in ("<I3I", "<I3Hxx"):
        data = b"\0\1\0\0" + head + struct.pack(wide, 3, *b"abc")
        data += struct.pack("<I100f", 100, *range(100)) + struct.pack("<B3xI3s", 3, 3, b"\xc3\xa4\0")
        tree = ros.decoder(text, "cdr", Selection())(data)
        assert isinstance(tree, dict)
        found = [tree["wide"], tree["name"], tree["ranges"][99], tree["kind"], tree["data"]]
        assert found == ["abc", ["a"], 99, 3, "ä"]
        short = ros.decoder(text, "cdr", Selection(long=False))(data)
        assert short == tree | {"ranges": ()}
        for name in ("wide", "kind", "data"):
            assert ros.decoder(text, "cdr", Selection.of([PartPath(name)]))(data) == {name: tree[name]}


PLAIN = {"int8": "b", "uint16": "H", "float32": "f", "float64": "d", "bool": "?"}
LEAVES = st.sampled_from([*PLAIN, "string"])
ARRAYS = st.sampled_from(["", "", "[]", "[3]"])


@st.composite
def structures(draw: st.DrawFn, depth: int = 0) -> list[tuple[Any, str, str]]:
    inner = structures(depth + 1) if depth < 2 else LEAVES
    kinds = draw(st.lists(st.tuples(st.one_of(LEAVES, inner), ARRAYS), min_size=1, max_size=4))
    return [(kind, many, f"f{i}") for i, (kind, many) in enumerate(kinds)]


def described(fields: list[tuple[Any, str, str]], texts: list[str]) -> str:
    lines = []
    for kind, many, name in fields:
        if not isinstance(kind, str):
            text = described(kind, texts)
            texts.append(f"{'=' * 80}\nMSG: p/T{len(texts)}\n{text}")
            kind = f"p/T{len(texts) - 1}"
        lines.append(f"{kind}{many} {name}\n")
    return "".join(lines)


def written(
    fields: list[tuple[Any, str, str]], out: bytearray, rng: np.random.Generator, aligned: bool
) -> None:
    def put(code: str, value: Any) -> None:
        size = struct.calcsize("<" + code)
        out.extend(bytes(-len(out) % size if aligned else 0) + struct.pack("<" + code, value))

    for kind, many, _ in fields:
        count = {"": 1, "[3]": 3}.get(many, int(rng.integers(3)))
        if many == "[]":
            put("I", count)
        for _ in range(count):
            if kind == "string":
                text = b"abc\0"[int(rng.integers(4)) :]
                put("I", len(text))
                out.extend(text)
            elif isinstance(kind, str):
                put(PLAIN[kind], int(rng.integers(2)))
            else:
                written(kind, out, rng, aligned)


@given(structures(), st.integers(0, 999), st.sampled_from(["cdr", "ros1"]), st.data())
@settings(max_examples=60, deadline=None)
def test_a_part_is_the_same_whether_or_not_the_rest_is_read(
    fields: list[tuple[Any, str, str]], seed: int, form: ros.Form, data: st.DataObject
) -> None:
    texts: list[str] = []
    root = described(fields, texts)
    out = bytearray()
    written(fields, out, np.random.default_rng(seed), aligned=form == "cdr")
    message = (b"\0\1\0\0" if form == "cdr" else b"") + bytes(out)
    definition = root + "".join(texts)
    whole = ros.decoder(definition, form, Selection())(message)
    names, inner = [], fields
    while not isinstance(inner, str):
        inner, many, name = data.draw(st.sampled_from(inner))
        names.append(name + ("[0]" if many else ""))
    path = PartPath(".".join(names))
    part = ros.decoder(definition, form, Selection.of([path]))(message)
    assert repr(path.find(part)) == repr(path.find(whole))


# --------------------------------------------------------------------------------- clocks


def test_clocks(tmp_path: Path) -> None:
    def stamped(at: int) -> dict[str, Any]:
        return {"header": {"stamp": {"sec": START // SECOND, "nanosec": at}}, "x": at}

    topics: Messages = {
        "/a": [(0, stamped(5)), (9, stamped(3))],
        "/b": [(1, {"x": 1})],
        "/d": [(1, {"t": 7, "x": 1})],
    }
    path = a_log(tmp_path / "a.mcap", topics)
    assert times(read(path, "a.x"), "a.x") == times(read(path, "a.x", clock="log"), "a.x") == [0, 9]
    assert times(read(path, "a.x", clock="publish"), "a.x") == [7, 16]
    found = read(path, "a.x", "b.x", clock="a.header.stamp")
    assert (times(found, "a.x"), values(found, "a.x"), times(found, "b.x")) == ([3, 5], [3.0, 5.0], [1])
    assert [group.named for group in found.groups] == ["a.header.stamp", "log"]
    found = read(path, "a.x", "b.x", clock="header.stamp")
    assert found.signals == ("a.x",)
    assert "`header.stamp`, which is to be the clock" in found.refused["b.x"]
    assert values(read(path, "d.x", clock="d.t"), "d.t") == [7.0]
    (tmp_path / "a.bag").write_bytes(robot_logs.bag([1.0]))
    with pytest.raises(StlcError, match="E603"):
        read(tmp_path / "a.bag", "robot.state.flag", clock="publish")


def test_messages_far_away_in_time_are_named(tmp_path: Path) -> None:
    messages = [(k * SECOND, {"x": k}) for k in range(9)]
    path = a_log(tmp_path / "a.mcap", {"/v": [(-START, {"x": 99}), *messages], "/w": [(-START, {"x": 1})]})
    found = read(path, "v.x", "w.x")
    assert values(found, "v.x") == [float(k) for k in range(9)]
    assert "w.x" in found.refused
    assert found.remarks[0].message.startswith("1 of 10 messages of `/v` are stamped 0 s")
    assert not read(a_log(tmp_path / "b.mcap", {"/v": [(-START + t, c) for t, c in messages]}), "v.x").remarks
    path = a_log(tmp_path / "c.mcap", {"/v": [*messages, (3600 - 40 * 365 * 86400 * SECOND, {"x": 1})]})
    with pytest.raises(StlcError, match=r"E602: message 10 of `/v` is stamped 1983-11-2\dT.*40 years off"):
        read(path, "v.x")


# ------------------------------------------------------------------- files that were cut off


@pytest.mark.parametrize("compression", ["NONE", "LZ4", "ZSTD"])
@pytest.mark.parametrize("chunked", [True, False])
def test_a_log_that_ends_early(tmp_path: Path, compression: str, chunked: bool) -> None:
    options = {
        "compression": writers.CompressionType[compression],
        "use_chunking": chunked,
        "chunk_size": 50_000,
    }
    rng = np.random.default_rng(0)
    messages = [(k * SECOND, {"x": k, "r": rng.random(9).tolist()}) for k in range(2000)]
    path = a_log(tmp_path / "a.mcap", {"/v": messages}, **options)
    raw = path.read_bytes()
    before = 0
    for part in (0.3, 0.6, 0.9):
        path.write_bytes(raw[: int(part * len(raw))])
        found = read(path, "v.x")
        got = values(found, "v.x")
        assert got == [float(k) for k in range(len(got))]
        assert before < len(got) < 2000
        before = len(got)
        (remark,) = found.remarks
        assert f"{len(got):,} messages were read" in remark.message
        assert "mcap recover" in remark.help[0]
    path.write_bytes(raw[:200])
    with pytest.raises(StlcError, match="E603"):
        read(path, "v.x")


@pytest.mark.parametrize("compression", ["none", "bz2"])
def test_a_bag_that_ends_early(tmp_path: Path, compression: str) -> None:
    raw = robot_logs.bag([float(k) for k in range(500)], compression=compression)
    path = tmp_path / "a.bag"
    path.write_bytes(raw[: 13 + 4096 + 5 * (len(raw) - 4109) // 6] if compression == "none" else raw[:-600])
    if compression == "bz2":
        with pytest.raises(StlcError, match="E603"):
            read(path, "robot.state.position.x")
        return
    found = read(path, "robot.state.position.x")
    got = values(found, "robot.state.position.x")
    assert got == [float(k) for k in range(len(got))]
    assert 0 < len(got) < 500
    assert found.remarks[0].code == "W305"
    at = raw.index(b"index_pos=") + 10
    path.write_bytes(raw[:at] + bytes(8) + raw[at + 8 :])
    assert "was not closed" in read(path, "robot.state.flag").remarks[0].message


def test_what_the_recorder_had_not_yet_moved_into_the_database_is_missed(tmp_path: Path) -> None:
    (tmp_path / "a.db3").write_bytes(robot_logs.bag2([1.0] * 5))
    assert not read(tmp_path / "a.db3", "robot.state.flag").remarks
    (tmp_path / "a.db3-wal").write_bytes(b"x")
    (remark,) = read(tmp_path / "a.db3", "robot.state.flag").remarks
    assert "(it was not closed, and `a.db3-wal` is not read): 5 messages were read" in remark.message


def test_a_database_with_a_damaged_page(tmp_path: Path) -> None:
    raw = robot_logs.bag2([float(k) for k in range(3000)])
    path = tmp_path / "a.db3"
    at = len(raw) // 8192 * 4096
    path.write_bytes(raw[:at] + b"\xff" * 4096 + raw[at + 4096 :])
    found = read(path, "robot.state.position.x")
    got = values(found, "robot.state.position.x")
    assert got == [float(k) for k in range(len(got))]
    assert 0 < len(got) < 3000
    assert "is cut off or damaged (database disk image is malformed)" in found.remarks[0].message
