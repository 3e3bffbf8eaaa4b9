"""Measurements of ASAM MDF: groups and their times, names that occur twice, and what is not evaluated."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from stlc.diagnostics import StlcError, TraceError
from stlc.trace.formats.mf4 import read
from stlc.trace.recording import ALL, Recording, Wanted

asammdf = pytest.importorskip("asammdf")

T = np.arange(20) * 0.1
SLOW = np.arange(5) * 0.5
STATES = {"val_0": 0, "text_0": b"IDLE", "val_1": 1, "text_1": b"RUN", "default_addr": b""}


def signal(name: str, values: np.ndarray, times: np.ndarray, **more: Any) -> Any:
    return asammdf.Signal(values, times, name=name, **more)


def a_measurement(path: Path, version: str = "4.10", **more: Any) -> Path:
    with asammdf.MDF(version=version) as made:
        states = signal("mode", np.arange(20) % 2, T, conversion=STATES)
        made.append([signal("v", T**2, T, unit="km/h"), states])
        holes = {"invalidation_bits": np.array([0, 1, 0, 0, 1], bool)} if version > "4" else {}
        made.append([signal("v", SLOW + 1, SLOW, unit="m/s"), signal("w", SLOW.astype("f4"), SLOW, **holes)])
        made.save(path, overwrite=True, **more)
    return path


def wanted(*names: str) -> Wanted:
    return Wanted(frozenset(names))


def arrays_of(recording: Recording) -> dict[str, np.ndarray]:
    return {name: values for group in recording.groups for name, values in group.arrays.items()}


@pytest.mark.parametrize("packed", [0, 1, 2])
def test_groups_have_times_of_their_own(tmp_path: Path, packed: int) -> None:
    path = a_measurement(tmp_path / "a.mf4", compression=packed)
    found = read(path, wanted("mode", "w"))
    first, second = found.groups
    assert first.arrays["mode"].tolist() == ["IDLE", "RUN"] * 10
    np.testing.assert_array_equal(first.clock, T)
    np.testing.assert_array_equal(second.arrays["w"], [0, np.nan, 1, 1.5, np.nan])
    np.testing.assert_array_equal(second.clock, SLOW)
    assert not found.clashes
    assert "v" in found.others


def test_one_name_in_two_groups(tmp_path: Path) -> None:
    path = a_measurement(tmp_path / "a.mf4")
    assert read(path, wanted("v")).clashes == {"v": {"group 0": "group[0].v", "group 1": "group[1].v"}}
    found = read(path, wanted("group[1].v"))
    assert arrays_of(found)["group[1].v"].tolist() == (SLOW + 1).tolist()
    assert found.units == {"group[1].v": "m/s"}
    assert {"group[0].v", "group[1].v", "mode", "w"} == arrays_of(read(path)).keys()


def test_version_3(tmp_path: Path) -> None:
    found = read(a_measurement(tmp_path / "a.mdf", "3.30"), wanted("group[0].v", "mode", "w"))
    np.testing.assert_array_equal(arrays_of(found)["group[0].v"], T**2)
    assert arrays_of(found)["mode"].tolist() == ["IDLE", "RUN"] * 10
    assert arrays_of(found)["w"].tolist() == SLOW.tolist()


@pytest.mark.parametrize("version", ["3.30", "4.10"])
def test_formulas_are_not_evaluated(tmp_path: Path, version: str) -> None:
    touched = tmp_path / "owned"
    formula = f"X1 + __import__('pathlib').Path({str(touched)!r}).touch()"
    with asammdf.MDF(version=version) as made:
        made.append([signal("f", T, T, conversion={"formula": formula}), signal("v", T, T)])
        path = Path(made.save(tmp_path / "a.mdf"))  # or `.mf4`
    found = read(path, wanted("f", "v"))
    assert "formula" in found.refused["f"]
    assert arrays_of(found).keys() == {"v"}
    assert not touched.exists()


def test_a_master_that_is_no_time(tmp_path: Path) -> None:
    with asammdf.MDF(version="4.10") as made:
        made.append([signal("v", T, T)])
        made.groups[0].channels[0].sync_type = 2
        made.save(tmp_path / "a.mf4")
    assert "not a time" in read(tmp_path / "a.mf4", wanted("v")).refused["v"]


def test_blocks_that_unpack_to_much(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with asammdf.MDF(version="4.10") as made:
        made.append([signal("v", np.zeros(100_000), np.arange(100_000.0))])
        made.save(tmp_path / "a.mf4", compression=1)
    assert len(arrays_of(read(tmp_path / "a.mf4"))["v"]) == 100_000
    raw = (tmp_path / "a.mf4").read_bytes()
    at = raw.index(b"##DZ") + 32  # the size that the first packed block declares
    small = raw[:at] + (1000).to_bytes(8, "little") + raw[at + 8 :]
    (tmp_path / "b.mf4").write_bytes(small)
    with pytest.raises(StlcError, match="more than it declares"):
        read(tmp_path / "b.mf4")
    monkeypatch.setattr("stlc.trace.formats.registry._ROOM", 1000)
    monkeypatch.setattr("stlc.trace.formats.registry._RATIO", 0)
    with pytest.raises(StlcError, match="unpacks to more"):
        read(tmp_path / "a.mf4")


def test_files_that_are_none(tmp_path: Path) -> None:
    (tmp_path / "a.mf4").write_bytes(b"hello, world")
    with pytest.raises(StlcError, match="damaged or of another format"):
        read(tmp_path / "a.mf4")
    with pytest.raises(StlcError, match="no such file"):
        read(tmp_path / "none.mf4")


@given(
    cut=st.integers(0, 900), flips=st.lists(st.tuples(st.integers(0, 10**4), st.integers(0, 255)), max_size=4)
)
@settings(deadline=None, max_examples=12, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_damage_is_a_diagnostic_or_harmless(tmp_path: Path, cut: int, flips: list[tuple[int, int]]) -> None:
    whole = tmp_path / "whole.mf4"
    if not whole.exists():
        a_measurement(whole)
    raw = bytearray(whole.read_bytes()[: -cut or None])
    for at, value in flips:
        raw[at % len(raw)] = value
    (tmp_path / "a.mf4").write_bytes(raw)
    with suppress(TraceError):
        read(tmp_path / "a.mf4", ALL)
