"""One recording in every format, with three clocks and three rates: one verdict, one value, one statement."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stlc.cli.framework.app import main

SPEC = """
signal a [m]
signal b
@hold signal c
require low: always a < 3 m
require near: always (b > 0 -> a < 8 m)
require soon: always (a > 2.5 m -> eventually[0 s, 0.5 s] a < 2 m)
require quiet: always c > 0
require never: always[0 s, 2 s] b < 0.5
"""
RATES = {"a": (0.0, 0.05, 121), "b": (1.0, 0.25, 20), "c": (0.4, 0.7, 7)}
"""Signal -> first time, step, samples; `a` is faster than the grid, `b` begins later."""
BASES = {"seconds": 0.0, "boot": 20.5, "epoch": 1_700_000_000.0}
Signals = Mapping[str, tuple[np.ndarray, np.ndarray]]


def signals() -> Signals:
    found = {}
    for name, (first, step, count) in RATES.items():
        times = np.round(first + step * np.arange(count), 6)
        found[name] = (times, np.round(1.5 + np.sin(3.0 * times + len(found)), 3))
    found["a"][1][23] = 9.5  # between two instants of the grid
    return found


def nanoseconds(times: np.ndarray, base: float) -> np.ndarray:
    return np.round(times * 1e6).astype(np.int64) * 1000 + round(base) * 10**9 + round(base % 1 * 1e9)


def clock(times: np.ndarray, base: str) -> tuple[str, np.ndarray]:
    """Name and numbers of a clock: seconds, microseconds since boot, nanoseconds since 1970."""
    ticks = nanoseconds(times, BASES[base])
    if base == "seconds":
        return "t", ticks / 1e9
    return ("timestamp_us", ticks // 1000) if base == "boot" else ("stamp", ticks)


def joined(given: Signals) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    times = np.unique(np.concatenate([times for times, _ in given.values()]))
    columns = {name: np.full(len(times), np.nan) for name in given}
    for name, (own, values) in given.items():
        columns[name][np.searchsorted(times, own)] = values
    return times, columns


def as_csv(path: Path, given: Signals, base: str) -> Path:
    times, columns = joined(given)
    name, ticks = clock(times, base)
    rows = [f"{name},a,b,c"]
    for k, tick in enumerate(ticks.tolist()):
        rows.append(
            ",".join([repr(tick), *("" if np.isnan(x[k]) else repr(float(x[k])) for x in columns.values())])
        )
    path.with_suffix(".csv").write_text("\n".join(rows) + "\n")
    return path.with_suffix(".csv")


def as_lines(path: Path, given: Signals, base: str) -> Path:
    rows: list[tuple[float, str]] = []
    for name, (times, values) in given.items():
        key, ticks = clock(times, base)
        rows += [
            (t, json.dumps({key: t, name: v})) for t, v in zip(ticks.tolist(), values.tolist(), strict=True)
        ]
    path.with_suffix(".jsonl").write_text("\n".join(text for _, text in sorted(rows)) + "\n")
    return path.with_suffix(".jsonl")


def as_npz(path: Path, given: Signals, base: str) -> Path:
    arrays = {}
    for name, (times, values) in given.items():
        key, ticks = clock(times, base)
        arrays |= {f"{name}.{key}": ticks, f"{name}.v": values}
    np.savez(path.with_suffix(".npz"), **arrays, unread=np.eye(3))
    return path.with_suffix(".npz")


def as_mat(path: Path, given: Signals, base: str) -> Path:
    io = pytest.importorskip("scipy.io")
    structs = {}
    for name, (times, values) in given.items():
        key, ticks = clock(times, base)
        structs[name] = {key: ticks, "v": values}
    io.savemat(path.with_suffix(".mat"), {**structs, "gain": np.eye(4)})
    return path.with_suffix(".mat")


def as_parquet(path: Path, given: Signals, base: str) -> Path:
    arrow = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    times, columns = joined(given)
    name, ticks = clock(times, base)
    table: dict[str, Any] = {name: arrow.array(ticks)}
    if base == "epoch":
        table = {"when": arrow.array(ticks, type=arrow.timestamp("ns"))}
        table = {"timestamp": table["when"]}
    table |= {key: arrow.array(x, mask=np.isnan(x)) for key, x in columns.items()}
    parquet.write_table(arrow.table(table), path.with_suffix(".parquet"))
    return path.with_suffix(".parquet")


def messages(given: Signals, base: str) -> Iterator[tuple[int, str, float]]:
    rows = [
        (int(tick), name, float(value))
        for name, (times, values) in given.items()
        for tick, value in zip(nanoseconds(times, BASES[base]), values, strict=True)
    ]
    return iter(sorted(rows))


def as_mcap(path: Path, given: Signals, base: str) -> Path:
    writers = pytest.importorskip("mcap.writer")
    with path.with_suffix(".mcap").open("wb") as file:
        writer = writers.Writer(file)
        writer.start()
        schema = writer.register_schema("v", "jsonschema", b"{}")
        channels = {name: writer.register_channel(f"/{name}", "json", schema) for name in given}
        for tick, name, value in messages(given, base):
            writer.add_message(channels[name], tick, json.dumps({"v": value}).encode(), tick)
        writer.finish()
    return path.with_suffix(".mcap")


def as_bag(path: Path, given: Signals, base: str) -> Path:
    rosbags = pytest.importorskip("rosbags.rosbag1")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    kind = "std_msgs/msg/Float64"
    with rosbags.Writer(path.with_suffix(".bag")) as writer:
        topics = {name: writer.add_connection(f"/{name}", kind, typestore=store) for name in given}
        for tick, name, value in messages(given, base):
            writer.write(topics[name], tick, store.serialize_ros1(store.types[kind](data=value), kind))
    return path.with_suffix(".bag")


def as_db3(path: Path, given: Signals, base: str) -> Path:
    rosbags = pytest.importorskip("rosbags.rosbag2")
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    kind = "std_msgs/msg/Float64"
    with rosbags.Writer(path, version=8) as writer:
        topics = {name: writer.add_connection(f"/{name}", kind, typestore=store) for name in given}
        for tick, name, value in messages(given, base):
            writer.write(topics[name], tick, store.serialize_cdr(store.types[kind](data=value), kind))
    return path


def as_ulg(path: Path, given: Signals, base: str) -> Path:
    pytest.importorskip("pyulog")

    def message(kind: str, data: bytes) -> bytes:
        return struct.pack("<HB", len(data), ord(kind)) + data

    raw = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0) + message("B", bytes(40))
    raw += b"".join(message("F", f"{name}:uint64_t timestamp;double v;".encode()) for name in given)
    numbers = {name: number for number, name in enumerate(given)}
    raw += b"".join(message("A", struct.pack("<BH", 0, k) + name.encode()) for name, k in numbers.items())
    for tick, name, value in messages(given, base):
        raw += message("D", struct.pack("<HQd", numbers[name], tick // 1000, value))
    path.with_suffix(".ulg").write_bytes(raw)
    return path.with_suffix(".ulg")


def as_mf4(path: Path, given: Signals, base: str) -> Path:
    asammdf = pytest.importorskip("asammdf")
    with asammdf.MDF(version="4.10") as file:
        for name, (times, values) in given.items():
            file.append([asammdf.Signal(values, nanoseconds(times, BASES[base]) / 1e9, name=name)])
        file.save(path.with_suffix(".mf4"))
    return path.with_suffix(".mf4")


FORMATS: dict[str, tuple[Callable[[Path, Signals, str], Path], str]] = {
    "csv": (as_csv, "{}"),
    "jsonl": (as_lines, "{}"),
    "npz": (as_npz, "{}.v"),
    "mat": (as_mat, "{}.v"),
    "parquet": (as_parquet, "{}"),
    "mcap": (as_mcap, "{}.v"),
    "bag": (as_bag, "{}"),
    "db3": (as_db3, "{}"),
    "ulg": (as_ulg, "{}.v"),
    "mf4": (as_mf4, "{}"),
}
"""Format -> how it is written, and what a signal is called in it."""


def judged(folder: Path, name: str, base: str, capsys: pytest.CaptureFixture[str]) -> list[dict[str, Any]]:
    write, called = FORMATS[name]
    spec = folder / "s.stl"
    spec.write_text(SPEC)
    path = write(folder / f"log_{base}", signals(), base)
    maps = [word for key in RATES for word in ("--map", f"{key}={called.format(key)}")]
    maps = [] if called == "{}" else maps
    code = main(["check", str(spec), str(path), "--resample", "0.1s", *maps, "--json"])
    out = capsys.readouterr().out
    assert code == 1, out
    (first, *_) = (
        min(row["robustness"]["argmin"]["start"] for row in json.loads(out)["result"]["requirements"]),
    )
    return [
        {
            "name": row["name"],
            "verdict": row["verdict"],
            "robustness": [row["robustness"][key] for key in ("min", "low", "high")],
            "judged": {key: round(value, 5) for key, value in (row["judged"] or {}).items()},
            "at": None if row["cause"] is None else round(row["cause"]["time"] - first, 5),
        }
        for row in json.loads(out)["result"]["requirements"]
    ]


WANTED = [
    {"name": "low", "verdict": "violated", "at": 1.15, "judged": {}},
    {"name": "near", "verdict": "violated", "at": 1.15, "judged": {"first": 1.0, "last": 5.75, "of": 6.0}},
    {"name": "quiet", "judged": {"first": 0.4, "last": 6.0, "of": 6.0}},
    {"name": "never", "verdict": "violated", "judged": {"first": 1.0, "last": 3.0, "of": 6.0}},
]


@pytest.mark.parametrize("base", BASES)
@pytest.mark.parametrize("name", FORMATS)
def test_one_recording_has_one_verdict(
    name: str, base: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = judged(tmp_path, name, base, capsys)
    reference = judged(tmp_path, "npz", "seconds", capsys)
    for wanted in WANTED:
        row = next(row for row in reference if row["name"] == wanted["name"])
        assert {key: row[key] for key in wanted} == wanted
    assert found == reference
