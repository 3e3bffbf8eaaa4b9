"""MATLAB files of versions 4, 5 and 7.3: workspaces, what Simulink logs, results of Modelica, objects."""

from __future__ import annotations

import struct
import warnings
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from stlc.diagnostics import StlcError, TraceError
from stlc.trace.formats.mat import read
from stlc.trace.recording import ALL, Recording, Wanted

scipy_io = pytest.importorskip("scipy.io")
h5py = pytest.importorskip("h5py")

N = 20
T = np.arange(N) * 0.1
V = 0.5 + T


def wanted(*names: str, clock: str = "") -> Wanted:
    return Wanted(frozenset(names), clock)


def arrays_of(recording: Recording) -> dict[str, np.ndarray]:
    return {name: values for group in recording.groups for name, values in group.arrays.items()}


def cells(*values: object) -> np.ndarray:
    made = np.empty((1, len(values)), dtype=object)
    for i, value in enumerate(values):
        made[0, i] = value
    return made


class Hdf5:
    """A file of version 7.3, as MATLAB writes it: what is in cells and structure arrays are references."""

    def __init__(self, path: Path) -> None:
        self.file = h5py.File(path, "w", userblock_size=512)
        self.count = 0

    def put(self, group: Any, name: str, value: object) -> None:
        if isinstance(value, dict):
            inner = group.create_group(name)
            inner.attrs["MATLAB_class"] = np.bytes_("struct")
            for field, each in value.items():
                self.put(inner, field, each)
        elif isinstance(value, list):  # a structure array
            inner = group.create_group(name)
            inner.attrs["MATLAB_class"] = np.bytes_("struct")
            for field in value[0]:
                inner.create_dataset(field, data=self.refs([each[field] for each in value]))
        elif isinstance(value, str):
            data = np.frombuffer(value.encode("utf-16-le"), np.uint16)[:, None]
            group.create_dataset(name, data=data).attrs["MATLAB_class"] = np.bytes_("char")
        elif isinstance(value, np.ndarray) and value.dtype == object:
            data = self.refs(value.ravel(order="F").tolist())
            group.create_dataset(name, data=data).attrs["MATLAB_class"] = np.bytes_("cell")
        else:
            values = np.atleast_2d(np.asarray(value))
            group.create_dataset(name, data=values.T).attrs["MATLAB_class"] = np.bytes_("double")

    def refs(self, values: list[object]) -> np.ndarray:
        made = []
        for value in values:
            self.count += 1
            self.put(self.file.require_group("#refs#"), f"r{self.count}", value)
            made.append(self.file[f"#refs#/r{self.count}"].ref)
        return np.array(made, dtype=h5py.ref_dtype)[:, None]


def save(path: Path, version: str, **variables: object) -> Path:
    if version == "7.3":
        made = Hdf5(path)
        for name, value in variables.items():
            made.put(made.file, name, value)
        made.file.close()
        return path
    plain = {name: np.array(v, dtype=object) if isinstance(v, list) else v for name, v in variables.items()}
    for name, value in variables.items():
        if isinstance(value, list):
            struct_array = np.empty((1, len(value)), dtype=[(field, object) for field in value[0]])
            for i, each in enumerate(value):
                struct_array[0, i] = tuple(each.values())
            plain[name] = struct_array
    scipy_io.savemat(path, plain, do_compression=True)
    return path


BOTH = pytest.mark.parametrize("version", ["5", "7.3"])


@BOTH
def test_what_is_not_wanted_does_not_matter(tmp_path: Path, version: str) -> None:
    odd = {"A": np.zeros((4, 4)), "c": cells("x", np.zeros(3)), "note": "hello", "s": {"t2": np.zeros(7)}}
    path = save(tmp_path / "a.mat", version, t=T, v=V, **odd)
    found = read(path, wanted("v"))
    assert arrays_of(found).keys() == {"t", "v"}
    assert set(found.others) == odd.keys()
    np.testing.assert_array_equal(arrays_of(found)["v"], V)
    assert arrays_of(read(path, wanted("v[0]"))).keys() == {"t", "v", "v[0]"}
    assert arrays_of(read(path, wanted("note")))["note"].tolist() == ["hello"]
    assert arrays_of(read(path, wanted("c[1]")))["c[1]"].shape == (3,)


@BOTH
def test_structure_with_time(tmp_path: Path, version: str) -> None:
    one = {"values": V[:, None], "dimensions": 1.0, "label": "speed"}
    two = {"values": np.stack([V, -V], axis=1), "dimensions": 2.0, "label": ""}
    if version == "7.3":
        scope: dict[str, object] = {"time": T, "signals": [one, two], "blockName": "m/Scope"}
    else:
        signals = np.array(
            [(V[:, None], 1.0, "speed"), (two["values"], 2.0, "")], dtype=[(f, object) for f in one]
        )
        scope = {"time": T, "signals": signals, "blockName": "m/Scope"}
    path = save(tmp_path / "a.mat", version, ScopeData=scope, tout=np.arange(3.0))
    for name in ("ScopeData.signals[0].values", "ScopeData.speed", "speed"):
        found = read(path, wanted(name))
        assert arrays_of(found).keys() == {"ScopeData.time", name}
        assert len(found.groups) == 1
        np.testing.assert_array_equal(arrays_of(found)[name], V)
    component = "ScopeData.signals[1].values[1]"
    assert arrays_of(read(path, wanted(component)))["ScopeData.signals[1].values"].shape == (N, 2)


@BOTH
def test_a_dataset_in_cells(tmp_path: Path, version: str) -> None:
    def element(name: str, values: np.ndarray) -> dict[str, object]:
        times = np.arange(values.shape[-1]) * 1.0
        return {"Name": name, "BlockPath": "m/x", "Values": {"Time": times[:, None], "Data": values}}

    three = np.arange(10.0).reshape(1, 2, 5)
    logs = cells(
        element("v", V), element("w", np.arange(5.0)), element("w", np.arange(6.0)), element("m", three)
    )
    path = save(tmp_path / "a.mat", version, logsout=logs)
    for name in ("logsout.v.Data", "logsout[0].Values.Data", "logsout.v", "v"):
        (group,) = read(path, wanted(name)).groups
        assert group.arrays.keys() == {"logsout.v.Time", name}
        np.testing.assert_array_equal(group.arrays[name], V)
    both = read(path, wanted("v", "m")).groups
    assert [set(group.arrays) for group in both] == [{"logsout.v.Time", "v"}, {"logsout.m.Time", "m"}]
    np.testing.assert_array_equal(both[1].arrays["m"], three[0].T)
    twice = read(path, wanted("w")).clashes
    assert twice == {"w": {place: place for place in ("logsout[1].Values.Data", "logsout[2].Values.Data")}}
    assert len(arrays_of(read(path, wanted("logsout[2].Values.Data")))["logsout[2].Values.Data"]) == 6
    assert {"logsout.v.Data", "logsout[1].Values.Data"} <= arrays_of(read(path)).keys()
    chosen = read(path, wanted("logsout.v", clock="logsout.m.Time"))
    assert len(chosen.groups) == 1
    shadowed = save(tmp_path / "b.mat", version, logsout=logs, v=-V, t=T)
    np.testing.assert_array_equal(arrays_of(read(shadowed, wanted("v")))["v"], -V)


@pytest.mark.parametrize("shape", [(1, 1, N), (N, 1), (1, N)])
@BOTH
def test_series_in_structures(tmp_path: Path, version: str, shape: tuple[int, ...]) -> None:
    series = {"Time": T[:, None], "Data": V.reshape(shape)}
    path = save(tmp_path / "a.mat", version, speed=series, square={"Time": T, "Data": np.eye(N)})
    np.testing.assert_array_equal(arrays_of(read(path, wanted("speed.Data")))["speed.Data"], V)
    np.testing.assert_array_equal(arrays_of(read(path, wanted("speed")))["speed"], V)
    assert arrays_of(read(path, wanted("square.Data[3]")))["square.Data"].shape == (1, N, N)


def test_texts(tmp_path: Path) -> None:
    modes = np.array(["IDLE", "RUN "])
    scipy_io.savemat(tmp_path / "a.mat", {"mode": modes, "state": cells("on", "", "öff")})
    arrays = arrays_of(read(tmp_path / "a.mat"))
    assert arrays["mode"].tolist() == ["IDLE", "RUN"]
    assert arrays["state"].tolist() == ["on", "", "öff"]


def element5(kind: int, data: bytes, order: str = "<") -> bytes:
    return struct.pack(f"{order}II", kind, len(data)) + data + b"\0" * (-len(data) % 8)


def matrix5(kind: int, *parts: bytes) -> bytes:
    return element5(14, element5(6, struct.pack("<II", kind, 0)) + b"".join(parts))


def numbers5(name: str, values: np.ndarray) -> bytes:
    shape = element5(5, struct.pack("<ii", 1, len(values)))
    return matrix5(6, shape, element5(1, name.encode()), element5(9, values.astype("<f8").tobytes()))


def opaque5(name: str, kind: str) -> bytes:
    texts = (name, "MCOS", kind)
    return matrix5(17, *(element5(1, text.encode()) for text in texts), matrix5(6))


HEAD5 = b"MATLAB 5.0".ljust(124) + b"\x00\x01IM"


@pytest.mark.parametrize(
    ("kind", "line"),
    [
        ("timeseries", "t = ts.Time; v = ts.Data; save FILE t v -v7"),
        ("timetable", "s = table2struct(timetable2table(ts, 'ConvertRowTimes', false), 'ToScalar', true)"),
        ("table", "s = table2struct(ts, 'ToScalar', true); save FILE s -v7"),
        ("string", "s = cellstr(ts)"),
        ("Simulink.SimulationData.Dataset", "v = ts{1}.Values.Data"),
        ("my.Class", "s = struct(ts)"),
    ],
)
@BOTH
def test_objects_are_refused_with_the_line_that_converts_them(
    tmp_path: Path, version: str, kind: str, line: str
) -> None:
    path = tmp_path / "a.mat"
    if version == "5":
        path.write_bytes(HEAD5 + numbers5("t", T) + opaque5("ts", kind) + numbers5("v", V))
    else:
        save(path, "7.3", t=T, v=V, ts=np.zeros(6))
        with h5py.File(path, "r+") as file:
            file["ts"].attrs["MATLAB_class"] = np.bytes_(kind)
            file["ts"].attrs["MATLAB_object_decode"] = 3
    assert arrays_of(read(path, wanted("v"))).keys() == {"t", "v"}
    refused = read(path, wanted("ts.Data")).refused
    assert line in refused["ts.Data"]
    assert kind in refused["ts"]


@BOTH
def test_sparse_and_complex_are_refused_where_they_are_wanted(tmp_path: Path, version: str) -> None:
    path = tmp_path / "a.mat"
    if version == "5":
        sparse = pytest.importorskip("scipy.sparse")
        scipy_io.savemat(path, {"t": T, "s": sparse.csc_matrix(np.eye(3)), "z": T * 1j})
    else:
        save(path, "7.3", t=T)
        with h5py.File(path, "r+") as file:
            file.create_group("s").attrs["MATLAB_sparse"] = np.uint64(3)
            pair = np.array([(1.0, 2.0)], dtype=[("real", "f8"), ("imag", "f8")])
            file["z"] = pair
    refused = read(path, wanted("s", "z")).refused
    assert "v = full(s); save FILE v -v7" in refused["s"] if version == "5" else "full(s)" in refused["s"]
    assert "imag" in refused["z"]
    assert not read(path, wanted("t")).refused


def test_a_file_that_is_cut_short(tmp_path: Path) -> None:
    whole = HEAD5 + numbers5("t", T) + numbers5("v", V) + numbers5("w", V)
    (tmp_path / "a.mat").write_bytes(whole[:-20])
    found = read(tmp_path / "a.mat", wanted("v"))
    np.testing.assert_array_equal(arrays_of(found)["v"], V)
    assert "cut short behind `v`" in found.remarks[0].message
    for names in (wanted("w"), ALL):
        with pytest.raises(StlcError, match="damaged"):
            read(tmp_path / "a.mat", names)


# ----------------------------------------------------------------------------- version 4


def matrix4(name: str, values: np.ndarray, order: str = "<", kind: str = "f8", text: int = 0) -> bytes:
    codes = {"f8": 0, "f4": 1, "i4": 2, "i2": 3, "u2": 4, "u1": 5}
    number = (1000 if order == ">" else 0) + codes[kind] * 10 + text
    head = struct.pack(f"{order}5i", number, *values.shape, 0, len(name) + 1)
    return head + name.encode() + b"\0" + values.astype(order + kind).tobytes(order="F")


def letters(*texts: str) -> np.ndarray:
    width = max(map(len, texts))
    return np.array([[ord(letter) for letter in text.ljust(width)] for text in texts])


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("kind", ["f8", "f4", "i4", "i2", "u2", "u1"])
def test_version_4(tmp_path: Path, order: str, kind: str) -> None:
    raw = matrix4("t", T[None], order) + matrix4("v", np.arange(N)[:, None], order, kind)
    (tmp_path / "a.mat").write_bytes(raw + matrix4("mode", letters("IDLE", "RUN"), order, "u1", 1))
    arrays = arrays_of(read(tmp_path / "a.mat"))
    np.testing.assert_array_equal(arrays["t"], T)
    assert arrays["v"].tolist() == list(range(N))
    assert arrays["mode"].tolist() == ["IDLE", "RUN"]
    assert arrays_of(read(tmp_path / "a.mat", wanted("v"))).keys() == {"t", "v"}
    (tmp_path / "a.mat").write_bytes(raw[:-1])
    assert "cut short behind `t`" in read(tmp_path / "a.mat", wanted("t")).remarks[0].message
    with pytest.raises(StlcError, match="damaged"):
        read(tmp_path / "a.mat", wanted("v"))


@pytest.mark.parametrize("layout", ["binTrans", "binNormal"])
def test_results_of_modelica(tmp_path: Path, layout: str) -> None:
    def turned(values: np.ndarray) -> np.ndarray:
        return values.T if layout == "binTrans" else values

    names = letters("time", "tank.level", "der(x[1])", "minus", "mass", "drift")
    notes = letters("Time [s]", "height [m]", "rate [m/s2|km/h2]", "alias [m]", "[kg]", "word [what?]")
    info = np.array([[0, 1, 0, -1], [2, 2, 0, 0], [2, 3, 0, 0], [2, -2, 0, 0], [1, 2, 0, 0], [1, -3, 0, 0]])
    once = np.array([[0.0, 80.0, 1.0], [T[-1], 80.0, 2.0]])
    many = np.stack([T, V, V**2], axis=1)
    raw = matrix4("Aclass", letters("Atrajectory", "1.1", "", layout), "<", "u1", 1)
    raw += matrix4("name", turned(names), "<", "u1", 1) + matrix4("description", turned(notes), "<", "u1", 1)
    raw += matrix4("dataInfo", turned(info), "<", "i4")
    raw += matrix4("data_1", turned(once)) + matrix4("data_2", turned(many), "<", "f4")
    (tmp_path / "a.mat").write_bytes(raw)
    found = read(tmp_path / "a.mat")
    once_group, main = found.groups
    assert main.clock is not None
    np.testing.assert_allclose(main.clock, T, rtol=1e-6)
    for name, values in {"tank.level": V, "der(x[1])": V**2, "minus": -V, "mass": np.full(N, 80.0)}.items():
        np.testing.assert_allclose(main.arrays[name], values, rtol=1e-6)
    assert once_group.arrays["drift"].tolist() == [-1.0, -2.0]
    assert found.units == {"tank.level": "m", "der(x[1])": "m/s2", "minus": "m", "mass": "kg"}
    (only,) = read(tmp_path / "a.mat", wanted("mass")).groups
    assert only.arrays.keys() == {"mass"}


@pytest.mark.parametrize("kind", ["f8", "f4"])
def test_a_result_as_openmodelica_writes_it(tmp_path: Path, kind: str) -> None:
    """As `simulation_result_mat4.cpp` does: zeros behind texts, an event at which a time occurs twice."""
    times, x = np.array([0, 0.5, 0.5, 1]), np.array([1, 2, -3, 4.0])
    signals = {  # name -> description, matrix, row
        "time": ("Simulation time [s]", 0, 1),
        "$cpuTime": ("cpu time [s]", 2, 2),
        "body.x": ("height of [1] [m]", 2, 3),
        "steady": ("does not vary", 1, 2),
        "g": ("gravity [m/s2]", 1, 3),
        "minus": ("alias [m]", 2, -3),
        "up": ("alias of a parameter [m/s2]", 1, -3),
        "clock": ("alias of the time [s]", 2, 1),
        "off": ("", 2, 4),
    }

    def texts(*each: str) -> np.ndarray:
        width = max(map(len, each)) + 1
        return np.frombuffer("".join(text.ljust(width, "\0") for text in each).encode(), "u1").reshape(
            -1, width
        )

    rows = np.array([[k, row, 0, 0 if k else -1] for _, k, row in signals.values()])
    raw = matrix4("Aclass", texts("Atrajectory", "1.1", "", "binTrans")[:, :11], kind="u1", text=1)
    raw += matrix4("name", texts(*signals).T, kind="u1", text=1)
    raw += matrix4("description", texts(*(note for note, *_ in signals.values())).T, kind="u1", text=1)
    raw += matrix4("dataInfo", rows.T, kind="i4")
    raw += matrix4("data_1", np.array([[0, 1], [7, 7], [9.5, 9.5]]), kind=kind)
    raw += matrix4("data_2", np.stack([times, times * 2, x, x < 0]), kind=kind)
    (tmp_path / "a.mat").write_bytes(raw)
    found = read(tmp_path / "a.mat")
    (group,) = found.groups
    assert group.named == "time"
    assert group.clock is not None
    assert group.clock.tolist() == times.tolist()
    assert {name: values.tolist() for name, values in group.arrays.items()} == {
        "$cpuTime": [0, 1, 1, 2],
        "body.x": [1, 2, -3, 4],
        "steady": [7] * 4,
        "g": [9.5] * 4,
        "minus": [-1, -2, 3, -4],
        "up": [-9.5] * 4,
        "clock": times.tolist(),
        "off": [0, 0, 1, 0],
    }
    assert found.units["body.x"] == found.units["minus"] == "m"
    assert "steady" not in found.units


def test_the_older_layout_of_modelica(tmp_path: Path) -> None:
    raw = matrix4("Aclass", letters("Atrajectory", "1.0", "Stored by Dymola", "binNormal"), "<", "u1", 1)
    raw += matrix4("names", letters("Time", "h.v"), "<", "u1", 1) + matrix4("data", np.stack([T, V], axis=1))
    (tmp_path / "a.mat").write_bytes(raw)
    (group,) = read(tmp_path / "a.mat").groups
    np.testing.assert_array_equal(group.arrays["h.v"], V)
    np.testing.assert_array_equal(group.clock, T)


# ----------------------------------------------------------------------------- MATLAB's own


def leaves(value: Any, name: str) -> Iterator[tuple[str, np.ndarray]]:
    """Arrays as scipy reads them, by our names."""
    if value.dtype.names:
        for i, each in enumerate(value.ravel(order="F")):
            for field in value.dtype.names:
                yield from leaves(
                    np.asarray(each[field]), f"{name}.{field}" if value.size == 1 else f"{name}[{i}].{field}"
                )
    elif value.dtype == object and value.ndim:
        for i, each in enumerate(value.ravel(order="F")):
            yield from leaves(np.asarray(each), f"{name}[{i}]")
    elif value.dtype.kind in "biuf" and value.size:
        yield name, value


def test_the_files_of_scipy() -> None:
    folder = Path(scipy_io.__file__).parent / "matlab" / "tests" / "data"
    compared = 0
    for path in sorted(folder.glob("*.mat")):
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                theirs = scipy_io.loadmat(path)
        except Exception:
            with suppress(TraceError):  # what scipy cannot read is read or refused
                read(path)
            continue
        if path.name == "nasty_duplicate_fieldnames.mat":
            continue
        found = read(path)
        ours = arrays_of(found)
        for name, value in theirs.items():
            if name.startswith("__"):
                continue
            for place, values in leaves(value, name):
                if not any(place.startswith(head) for head in found.refused):
                    np.testing.assert_array_equal(ours[place].reshape(values.shape), values)
                    compared += 1
    if not compared:
        pytest.skip("scipy is installed without its tests")


def whole_5(path: Path) -> None:
    scope = {"time": T, "signals": {"values": V[:, None], "label": "v"}, "blockName": "m"}
    scipy_io.savemat(path, {"t": T, "v": V, "ScopeData": scope, "c": cells("a", T)}, do_compression=False)


def whole_4(path: Path) -> None:
    path.write_bytes(matrix4("t", T[None]) + matrix4("v", V[None]))


def whole_73(path: Path) -> None:
    save(path, "7.3", t=T, v=V, c=cells("a", {"Name": "w", "Values": {"Time": T, "Data": V}}))


@pytest.mark.parametrize("write", [whole_4, whole_5, whole_73])
@given(
    cut=st.integers(0, 200), flips=st.lists(st.tuples(st.integers(0, 10**5), st.integers(0, 255)), max_size=4)
)
@settings(deadline=None, max_examples=18, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_damage_is_a_diagnostic_or_harmless(
    tmp_path: Path, write: Callable[[Path], None], cut: int, flips: list[tuple[int, int]]
) -> None:
    whole = tmp_path / f"{write.__name__}.mat"
    if not whole.exists():
        write(whole)
    raw = bytearray(whole.read_bytes()[: -cut or None])
    for at, value in flips:
        raw[at % len(raw)] = value
    (tmp_path / "damaged.mat").write_bytes(raw)
    for names in (ALL, wanted("v")):
        with suppress(TraceError):
            read(tmp_path / "damaged.mat", names)
