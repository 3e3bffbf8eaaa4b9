"""Parquet: structures, lists, dates and missing values; columns that are not wanted do not matter."""

from __future__ import annotations

import datetime
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest

pa = pytest.importorskip("pyarrow")
parquet = pytest.importorskip("pyarrow.parquet")

from stlc.trace.formats.parquet import chunks, read, size  # noqa: E402
from stlc.trace.recording import Recording, Wanted  # noqa: E402

T = [0.0, 0.1, 0.2]


def write(path: Path, **columns: object) -> Path:
    parquet.write_table(pa.table(columns), path)
    return path


def arrays_of(recording: Recording) -> dict[str, np.ndarray]:
    (group,) = recording.groups
    return dict(group.arrays)


def test_structures_and_lists(tmp_path: Path) -> None:
    pose = [{"pos": {"x": k + 0.5, "name": "n"}, "q": [1.0, k], "more": [{"a": 1}]} for k in range(3)]
    path = write(tmp_path / "a.parquet", t=T, pose=[*pose[:2], None], ragged=[[1], [1, 2], [3]])
    found = read(path)
    arrays = arrays_of(found)
    np.testing.assert_array_equal(arrays["pose.pos.x"], [0.5, 1.5, np.nan])
    np.testing.assert_array_equal(arrays["pose.q[1]"], [0.0, 1.0, np.nan])
    assert arrays["pose.pos.name"].tolist() == ["n", "n", ""]
    assert set(found.refused) == {"pose.more", "ragged"}
    assert "lengths" in found.refused["ragged"]
    only = read(path, Wanted(frozenset(["pose.pos.x"])))
    assert arrays_of(only).keys() == {"t", "pose.pos.x"}
    assert "pose.q" in only.others
    assert arrays_of(read(path, Wanted(frozenset(["pose.q"])))).keys() == {"t", "pose.q[0]", "pose.q[1]"}


def test_kinds_of_numbers(tmp_path: Path) -> None:
    day = datetime.datetime(2024, 1, 1, tzinfo=datetime.UTC)
    far = pa.array([253_370_764_800, 0, 0], pa.timestamp("s"))
    path = write(
        tmp_path / "a.parquet",
        big=pa.array([2**63, 2**64 - 1, 0], pa.uint64()),
        clock=pa.array([1_700_000_000_000_000_001, 2, 3], pa.int64()),
        half=pa.array(np.array([0.5, 1, 2], np.float16)),
        price=pa.array([Decimal("1.25"), None, Decimal("3")]),
        on=pa.array([True, None, False]),
        nothing=pa.nulls(3),
        zone=pa.array([day, None, day], pa.timestamp("us", "Europe/Berlin")),
        date=pa.array([datetime.date(2024, 1, 1), None, None]),
        lasts=pa.array([1500, None, 3000], pa.duration("ms")),
        clocked=pa.array([1, None, 3], pa.time32("s")),
        far=far,
        blob=pa.array([b"a", b"b", b"c"]),
        pairs=pa.array([[("a", 1)]] * 3, pa.map_(pa.string(), pa.int64())),
        __index_level_0__=pa.array([0, 1, 2]),
    )
    found = read(path)
    arrays = arrays_of(found)
    assert arrays["big"].tolist() == [2**63, 2**64 - 1, 0]
    assert arrays["clock"][0] == 1_700_000_000_000_000_001
    assert arrays["half"].tolist() == [0.5, 1, 2]
    for name, values in {
        "price": [1.25, np.nan, 3],
        "on": [1, np.nan, 0],
        "nothing": [np.nan] * 3,
        "lasts": [1.5, np.nan, 3],
        "clocked": [1, np.nan, 3],
    }.items():
        np.testing.assert_array_equal(arrays[name], values)
    for name in ("zone", "date"):
        assert arrays[name].dtype == "M8[ns]"
        assert arrays[name][0] == np.datetime64("2024-01-01")
        assert np.isnat(arrays[name][1])
    assert set(found.refused) == {"far", "blob", "pairs"}
    assert arrays["__index_level_0__"].tolist() == [0, 1, 2]


def test_only_what_is_wanted_takes_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path / "a.parquet", t=T, v=T, long=[[0.0] * 900] * 3, word=["w" * 90_000] * 3)
    monkeypatch.setattr("stlc.trace.formats.registry._ROOM", 2000)
    monkeypatch.setattr("stlc.trace.formats.registry._RATIO", 0)
    only = Wanted(frozenset(["v"]))
    assert size(path, only) == 48 < size(path)
    assert arrays_of(read(path, only)).keys() == {"t", "v"}
    parts = [arrays_of(part) for part in chunks(path, 2, only)]
    assert [part["v"].tolist() for part in parts] == [[0.0, 0.1], [0.2]]


def test_units(tmp_path: Path) -> None:
    fields = [pa.field("v [km/h]", pa.float64()), pa.field("w", pa.float64(), metadata={"unit": "zz"})]
    parquet.write_table(pa.table([T, T], schema=pa.schema(fields)), tmp_path / "a.parquet")
    assert read(tmp_path / "a.parquet").units == {"v": "km/h", "w": "zz"}
