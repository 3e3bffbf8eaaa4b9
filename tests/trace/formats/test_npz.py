"""Archives of NumPy: which arrays are read, what they become, and that the others do not matter."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest

from stlc.diagnostics import StlcError
from stlc.trace.formats.npz import chunks, read, size
from stlc.trace.recording import ClockGroup, Recording, Wanted

T = np.arange(6) * 0.1


def wanted(*names: str, clock: str = "") -> Wanted:
    return Wanted(frozenset(names), clock)


def arrays_of(recording: Recording) -> dict[str, np.ndarray]:
    (group,) = recording.groups
    assert isinstance(group, ClockGroup)
    assert group.clock is None
    return dict(group.arrays)


def test_only_what_is_wanted_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    odd = {"gains": np.zeros((4, 4)), "notes": np.array([{"a": 1}], dtype=object), "z": np.ones(3) * 1j}
    np.savez(path, t=T, v=T, **odd)
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("broken.npy", b"no header")
    found = read(path, wanted("v"))
    assert arrays_of(found).keys() == {"t", "v"}
    assert set(found.others) == {"gains", "notes", "z", "broken"}
    assert not found.refused
    assert size(path, wanted("v")) < size(path)
    refused = read(path, wanted("notes", "z")).refused
    assert "store numbers" in refused["notes"]
    assert "complex" in refused["z"]
    with pytest.raises(StlcError, match="damaged"):
        read(path, wanted("broken"))


def test_what_arrays_become(tmp_path: Path) -> None:
    days = np.array(["2024-01-01T00:00:00.5", "NaT"], "M8[ms]")
    many = np.zeros(2, [("t", "f8"), ("q", "f4", (3,)), ("in", [("x", "i8")])])
    np.savez(
        tmp_path / "a.npz",
        column=T[:, None],
        row=T[None],
        lasts=np.array([1500, "NaT"], "m8[ms]"),
        days=days,
        many=many,
        words=np.array([b"go", b"w" * 100]),
        wide=T.astype(np.longdouble),
        flat=T + 0j,
        far=np.array(["9999-01-01"], "M8[s]"),
        blob=np.zeros(2, "V3"),
    )
    found = read(tmp_path / "a.npz")
    arrays = arrays_of(found)
    for name in ("column", "row", "wide", "flat"):
        np.testing.assert_array_equal(arrays[name], T)
    np.testing.assert_array_equal(arrays["lasts"], [1.5, np.nan])
    assert arrays["days"].dtype == "M8[ns]"
    assert arrays["days"].view(np.int64)[0] == 1_704_067_200_500_000_000
    assert np.isnat(arrays["days"][1])
    assert arrays["many.q"].shape == (2, 3)
    assert arrays["many.in.x"].dtype == np.int64
    assert arrays["words"].tolist() == ["go", "w" * 64]
    assert set(found.refused) == {"far", "blob"}


def test_fields_and_components(tmp_path: Path) -> None:
    many = np.zeros(6, [("t", "f8"), ("v", "f8"), ("other", "f8")])
    np.savez(tmp_path / "a.npz", many=many, x=T)
    assert arrays_of(read(tmp_path / "a.npz", wanted("many.v"))).keys() == {"many.t", "many.v"}
    assert arrays_of(read(tmp_path / "a.npz", wanted("x[0]"))).keys() == {"x", "x[0]"}
    assert arrays_of(read(tmp_path / "a.npz", wanted("x", clock="many.other"))).keys() == {
        "x",
        "many.t",
        "many.other",
    }


def test_pieces_leave_out_what_is_not_wanted(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    many = np.zeros(6, [("v", "f8"), ("other", "f8")])
    np.savez(path, t=T, many=many, gains=np.zeros((4, 4)), notes=np.array([None]), step=np.zeros(2))
    parts = [arrays_of(part) for part in chunks(path, 4, wanted("many.v", "notes"))]
    assert [{name: len(values) for name, values in part.items()} for part in parts] == [
        {"t": 4, "many.v": 4},
        {"t": 2, "many.v": 2},
    ]
    assert "notes" in next(chunks(path, 4, wanted("many.v", "notes"))).refused
    with pytest.raises(StlcError, match="cannot be read in pieces"):
        list(chunks(path, 4, wanted("gains", "many.v")))


@pytest.mark.parametrize(
    "meta",
    [
        '{"dt": 1%s}' % ("0" * 310),
        '{"origin": 1%s}' % ("0" * 310),
        '{"seed": -1%s}' % ("0" * 19),
        '{"dt": Infinity}',
        '{"dt": NaN}',
        '{"signals": {"x": {"low": 1%s}}}' % ("0" * 310),
        '{"signals": {"x": {"low": NaN}}}',
        '{"signals": {"x": {"low": "1"}}}',
        '{"signals": {"x": {"labels": {"a": true}}}}',
        '{"signals": {"x": {"labels": {"a": [1]}}}}',
        '{"signals": {"x": {"kind": {"a": 1}}}}',
        '{"signals": {"x": {"unit": 5}}}',
        '{"signals": {"x": 5}}',
        '{"signals": [1]}',
        '{"seed": %s}' % ("9" * 5000),
        '{"spec_set": %s}' % ("[" * 2000),
    ],
)
def test_meta_that_nobody_wrote(tmp_path: Path, meta: str) -> None:
    np.savez(tmp_path / "a.npz", t=T, x=T, meta=np.array(meta))
    with pytest.raises(StlcError, match=r"E603.*`meta` is damaged"):
        read(tmp_path / "a.npz")


def test_an_array_that_is_called_meta(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", t=T, x=T, meta=np.array([{"car": 1}], dtype=object))
    assert arrays_of(read(tmp_path / "a.npz", wanted("x"))).keys() == {"t", "x"}
    np.savez(tmp_path / "a.npz", t=T, meta=T)
    np.testing.assert_array_equal(arrays_of(read(tmp_path / "a.npz", wanted("meta")))["meta"], T)
