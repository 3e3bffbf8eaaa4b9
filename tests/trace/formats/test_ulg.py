"""Logs of PX4 (ULog): topics and instances, damage, and definitions that are larger than any log."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from stlc.diagnostics import StlcError, TraceError
from stlc.trace.formats.ulg import read
from stlc.trace.recording import ALL, Wanted

pytest.importorskip("pyulog")

POSITION = "position:uint64_t timestamp;float z;float[2] q;bool ok;uint8_t[7] _padding0;"
BATTERY = "battery:uint64_t timestamp;uint64_t timestamp_sample;double volt;"


def message(kind: str, data: bytes) -> bytes:
    return struct.pack("<HB", len(data), ord(kind)) + data


def ulog(
    formats: Iterable[str], topics: Iterable[tuple[int, str]], rows: Iterable[tuple[int, bytes]]
) -> bytes:
    raw = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0)
    raw += message("B", bytes(40)) + b"".join(message("F", text.encode()) for text in formats)
    for number, (instance, name) in enumerate(topics):
        raw += message("A", struct.pack("<BH", instance, number) + name.encode())
    return raw + b"".join(message("D", struct.pack("<H", number) + data) for number, data in rows)


def a_log() -> bytes:
    rows = []
    for k in range(5):
        rows.append((0, struct.pack("<Qfff?", 1_000_000 + 100_000 * k, k, 2 * k, -k, k > 2)))
        rows.append((1, struct.pack("<QQd", 1_050_000 + 200_000 * k, 0, 12.5)))
        rows.append((2, struct.pack("<QQd", 1_060_000 + 200_000 * k, 0, 11.5 + k)))
    return ulog([POSITION, BATTERY], [(0, "position"), (0, "battery"), (1, "battery")], rows)


def a_file(path: Path, raw: bytes) -> Path:
    path.write_bytes(raw)
    return path


def wanted(*names: str) -> Wanted:
    return Wanted(frozenset(names))


def test_topics_have_times_of_their_own(tmp_path: Path) -> None:
    found = read(a_file(tmp_path / "a.ulg", a_log()))
    first, second, position = found.groups
    assert position.arrays.keys() == {f"position.{name}" for name in ("z", "q[0]", "q[1]", "ok")}
    assert position.arrays["position.q[1]"].tolist() == [0, -1, -2, -3, -4]
    assert position.named == "position.timestamp"
    np.testing.assert_allclose(position.clock, 1 + 0.1 * np.arange(5))
    assert first.arrays["battery.volt"].tolist() == [12.5] * 5
    assert second.arrays["battery_1.volt"].tolist() == [11.5, 12.5, 13.5, 14.5, 15.5]
    assert not found.remarks


@pytest.mark.parametrize(
    ("name", "arrays"),
    [
        ("position.z", {"position.z"}),
        ("position.q", {"position.q[0]", "position.q[1]"}),
        ("position.q[1]", {"position.q[1]"}),
        ("battery_1.volt", {"battery_1.volt"}),
        ("battery[1].volt", {"battery[1].volt"}),
        ("battery[0].volt", {"battery[0].volt"}),
        ("nothing.volt", set()),
    ],
)
def test_only_what_is_wanted_is_read(tmp_path: Path, name: str, arrays: set[str]) -> None:
    found = read(a_file(tmp_path / "a.ulg", a_log()), wanted(name))
    assert {array for group in found.groups for array in group.arrays} == arrays
    assert "battery.volt" in found.others


def test_two_topics_with_one_name(tmp_path: Path) -> None:
    row = struct.pack("<QQd", 1, 0, 1.0)
    other = BATTERY.replace("battery:", "battery_1:")
    path = a_file(
        tmp_path / "a.ulg", ulog([BATTERY, other], [(1, "battery"), (0, "battery_1")], [(0, row), (1, row)])
    )
    found = read(path, wanted("battery_1.volt"))
    assert found.clashes["battery_1.volt"] == {
        "battery 1": "battery[1].volt",
        "battery_1 0": "battery_1[0].volt",
    }
    assert read(path, wanted("battery_1[0].volt")).signals == ("battery_1[0].volt",)


def test_a_topic_without_times(tmp_path: Path) -> None:
    raw = ulog(["odd:uint64_t when;float z;"], [(0, "odd")], [(0, struct.pack("<Qf", 1, 2.0))])
    with pytest.raises(StlcError, match="damaged"):
        read(a_file(tmp_path / "a.ulg", raw[:12]))
    assert "timestamp" in read(a_file(tmp_path / "a.ulg", raw), wanted("odd.z")).refused["odd.z"]


def test_a_log_that_is_cut_short_or_damaged(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cut = read(a_file(tmp_path / "a.ulg", a_log()[:-3]))
    assert [len(group.clock) for group in cut.groups if group.clock is not None] == [5, 4, 5]
    assert "cut short" in cut.remarks[0].message
    lost = read(a_file(tmp_path / "b.ulg", a_log() + message("O", struct.pack("<H", 250))))
    assert "lost messages for 0.25 s" in lost.remarks[0].message
    unknown = read(a_file(tmp_path / "c.ulg", a_log() + message("D", struct.pack("<HQ", 77, 1))))
    assert "is damaged" in unknown.remarks[0].message
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    "formats",
    [
        ["a:uint64_t timestamp;" + "b[65535] x;" * 50, "b:" + "float[65535] x;" * 50],
        ["a:uint64_t timestamp;a x;"],
        ["a:uint64_t timestamp;" + "float[65535] x;" * 3000],
    ],
)
def test_definitions_that_expand_without_end(tmp_path: Path, formats: list[str]) -> None:
    path = a_file(tmp_path / "a.ulg", ulog(formats, [(0, "a")], []))
    with pytest.raises(StlcError, match="damaged"):
        read(path)


@given(
    cut=st.integers(0, 600), flips=st.lists(st.tuples(st.integers(0, 10**4), st.integers(0, 255)), max_size=4)
)
@settings(deadline=None, max_examples=24, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_damage_is_a_diagnostic_or_harmless(tmp_path: Path, cut: int, flips: list[tuple[int, int]]) -> None:
    raw = bytearray(a_log()[: -cut or None])
    for at, value in flips:
        raw[at % len(raw)] = value
    with suppress(TraceError):
        read(a_file(tmp_path / "a.ulg", bytes(raw)), ALL)
