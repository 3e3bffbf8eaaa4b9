"""Round trips, and every way in which a trace file can be hostile or damaged."""

from __future__ import annotations

import io
import pickle
import tracemalloc
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.lib.format as npy
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from stlc.diagnostics import StlcError, TraceError, UsageError
from stlc.signature import Column, Signature
from stlc.trace import Reading, Trace, TraceMeta, as_fraction
from stlc.trace.formats import csv as trace_csv
from stlc.trace.formats.npz import read as read_npz
from stlc.units import Unit

FINITE = st.floats(allow_nan=False, allow_infinity=False, width=64)
SIGNATURE = Signature(
    (
        Column("x", Unit.parse("m"), low=-10.0, high=8.0),
        Column("sign", kind="enum", role="env", labels=(("stop", 0.0), ("light", 1.0))),
        Column("q[0]", Unit.parse("rad")),
    )
)


def a_trace(x: np.ndarray | None = None) -> Trace:
    x = np.linspace(-1, 1, 12).reshape(2, 6) if x is None else x
    data = {"x": x, "sign": np.ones_like(x), "q[0]": -x}
    meta = TraceMeta(
        "traffic", spec_text="spec traffic □", spec_set={"D": "1.5 m"}, run="r", seed=3, horizon=25, dt=0.1
    )
    return Trace(SIGNATURE, 0.1, data, 0.5, {"decision": np.array([[0, 1, 2]])}, meta, "unnamed")


def code_of(path: Path) -> str:
    with pytest.raises(StlcError) as caught:
        Trace.load(path)
    return caught.value.diagnostics[0].code


def message_of(path: Path) -> str:
    with pytest.raises(StlcError) as caught:
        Trace.load(path)
    return caught.value.diagnostics[0].message


def npz(path: Path, **arrays: object) -> Path:
    np.savez(path, **{name: np.asarray(values) for name, values in arrays.items()})
    return path


def zipped(path: Path, **members: bytes) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in members.items():
            archive.writestr(f"{name}.npy", data)
    return path


def header(shape: tuple[int, ...], descr: str = "<f8") -> bytes:
    buffer = io.BytesIO()
    npy.write_array_header_1_0(buffer, {"shape": shape, "fortran_order": False, "descr": descr})
    return buffer.getvalue()


# ------------------------------------------------------------------ round trips


@given(hnp.arrays(np.float64, st.tuples(st.integers(1, 3), st.integers(2, 5)), elements=FINITE))
@settings(deadline=None, max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@pytest.mark.parametrize("suffix", [".npz", ".csv"])
def test_round_trip_keeps_every_bit(tmp_path: Path, suffix: str, x: np.ndarray) -> None:
    path = tmp_path / f"a{suffix}"
    a_trace(x).save(path)
    back = Trace.load(path)
    assert list(back.data) == ["x", "sign", "q[0]"]
    assert all(np.array_equal(back.data[name], a_trace(x).data[name]) for name in back.data)
    assert (back.dt, back.t0, back.traces, back.samples) == (0.1, 0.5, *x.shape)
    assert back.signature["x"].unit.text == "m"


def test_npz_keeps_columns_extras_and_meta(tmp_path: Path) -> None:
    a_trace().save(tmp_path / "a.npz")
    back = Trace.load(tmp_path / "a.npz")
    assert back.signature == SIGNATURE
    assert back.meta == a_trace().meta
    assert back.extras["decision"].tolist() == [[0, 1, 2]]
    assert back.name == str(tmp_path / "a.npz")


def test_the_same_trace_gives_the_same_bytes(tmp_path: Path) -> None:
    a_trace().save(tmp_path / "a.npz")
    a_trace().save(tmp_path / "b.npz")
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_numpy_can_read_what_we_write(tmp_path: Path) -> None:
    a_trace().save(tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz", allow_pickle=False) as arrays:
        assert np.allclose(arrays["t"], 0.5 + 0.1 * np.arange(6))
        assert arrays["x"].shape == (2, 6)


def test_a_failed_save_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    a_trace().save(path)
    old = path.read_bytes()
    broken = replace(a_trace(), extras={"objects": np.array([object()])})
    with pytest.raises(ValueError, match="Object arrays"):
        broken.save(path)
    assert path.read_bytes() == old
    assert [p.name for p in tmp_path.iterdir()] == ["a.npz"]


@pytest.mark.parametrize("name", ["t", "meta", "extra.x"])
def test_reserved_names_are_refused(tmp_path: Path, name: str) -> None:
    trace = replace(a_trace(), signature=Signature((Column(name),)), data={name: np.zeros((1, 3))})
    with pytest.raises(TraceError, match="cannot be called"):
        trace.save(tmp_path / "a.npz")


def test_shapes_and_dtypes_that_are_accepted(tmp_path: Path) -> None:
    t = np.arange(4) * 0.1
    path = npz(
        tmp_path / "a.npz",
        t=t.astype(np.float32),
        one=np.arange(4),
        flag=np.array([[True, False, True, True]] * 3),
        p=np.zeros((3, 4, 2), np.float32),
        r=np.asfortranarray(np.arange(12.0).reshape(3, 4)),
    )
    trace = Trace.load(path)
    assert (trace.traces, trace.samples, trace.dt) == (3, 4, 0.1)
    assert list(trace.data) == ["one", "flag", "p[0]", "p[1]", "r"]
    assert trace.data["r"][2].tolist() == [8, 9, 10, 11]
    assert all(values.dtype == np.float64 and values.shape == (3, 4) for values in trace.data.values())


def test_renamed_signals() -> None:
    trace = a_trace().renamed({"position": "x"})
    assert list(trace.data) == ["position", "sign", "q[0]"]
    assert trace.signature["position"].unit.text == "m"
    with pytest.raises(TraceError, match=r"E601.*no signal `vlead`"):
        a_trace().renamed({"v_lead": "vlead"})


def test_renaming_onto_a_signal_replaces_it() -> None:
    trace = a_trace().renamed({"x": "q[0]"})
    assert list(trace.data) == ["sign", "x"]
    assert np.array_equal(trace.data["x"], -a_trace().data["x"])


# --------------------------------------------------------------- hostile archives


class Exploit:
    def __reduce__(self) -> tuple[object, tuple[str]]:
        return Path.touch, (Path("owned"),)


def test_an_array_of_objects_is_not_unpickled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    objects = np.array([Exploit()] * 3, dtype=object)
    path = npz(tmp_path / "a.npz", t=np.arange(3) * 0.1, v=np.zeros(3), x=objects)
    assert "Python objects" in read_npz(path).refused["x"]
    with pytest.raises(TraceError):
        Trace.load(path, Reading({"y": "x"}, words={"y": {}}))
    assert not Path("owned").exists()


def test_a_pickle_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "a.npz"
    path.write_bytes(pickle.dumps({"x": Exploit()}))
    assert code_of(path) == "E603"
    assert "pickle" in message_of(path)
    assert not Path("owned").exists()


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "it is empty"),
        (b"hello, world", "not an `.npz` archive"),
        (b"\x93NUMPY\x01\x00", "a single array"),
        (b"PK\x03\x04 and then nothing", "damaged"),
    ],
)
def test_files_that_are_no_archive(tmp_path: Path, data: bytes, words: str) -> None:
    (tmp_path / "a.npz").write_bytes(data)
    assert code_of(tmp_path / "a.npz") == "E603"
    assert words in message_of(tmp_path / "a.npz")


def test_a_huge_declared_shape_asks_for_no_memory(tmp_path: Path) -> None:
    path = zipped(tmp_path / "a.npz", t=header((10**15,)) + b"\0" * 64, x=header((10**15,)))
    tracemalloc.start()
    assert code_of(path) == "E603"
    assert tracemalloc.get_traced_memory()[1] < 10_000_000
    tracemalloc.stop()


def test_a_zip_bomb_is_refused_before_it_is_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stlc.trace.formats.registry.MAX_BYTES", 1_000_000)
    np.savez_compressed(tmp_path / "a.npz", t=np.zeros(1_000_000))
    assert (tmp_path / "a.npz").stat().st_size < 20_000
    assert "unpacks to" in message_of(tmp_path / "a.npz")


def test_a_small_archive_that_unpacks_to_a_large_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.npz"
    np.savez_compressed(path, t=np.arange(1_000_000.0), x=np.zeros(1_000_000))
    assert Trace.load(path).samples == 1_000_000
    monkeypatch.setattr("stlc.trace.formats.registry._ROOM", 1_000_000)
    assert Trace.load(path).samples == 1_000_000, "what is not all alike is packed far less"
    np.savez_compressed(path, t=np.zeros(1_000_000), x=np.zeros(1_000_000))
    assert "unpacks to" in message_of(path)


def test_too_many_arrays_and_arrays_given_twice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stlc.trace.formats.npz.MAX_ARRAYS", 2)
    assert "3 arrays" in message_of(npz(tmp_path / "a.npz", t=[0.0], x=[0.0], y=[0.0]))
    with zipfile.ZipFile(tmp_path / "b.npz", "w") as archive:
        archive.writestr("x.npy", header((0,)))
        with pytest.warns(UserWarning, match="Duplicate"):
            archive.writestr("x.npy", header((0,)))
    assert "twice" in message_of(tmp_path / "b.npz")


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("letter", [0x110000, 0xFFFFFFFF, 0xD800])
def test_texts_with_numbers_that_are_no_letters(tmp_path: Path, letter: int, order: str) -> None:
    text = np.array([0x61, letter], dtype=f"{order}u4").tobytes()
    for name in ("meta", "x"):
        path = zipped(
            tmp_path / "a.npz", t=header((1,)) + bytes(8), **{name: header((), f"{order}U2") + text}
        )
        assert "no letters" in message_of(path)


@pytest.mark.parametrize("nested", [b"(" * 3000, b"-" * 3000 + b"1", b"{'descr': '<f8'}"])
def test_malicious_headers(tmp_path: Path, nested: bytes) -> None:
    block = npy.magic(1, 0) + len(nested).to_bytes(2, "little") + nested
    assert code_of(zipped(tmp_path / "a.npz", t=block)) == "E603"


def outcome(path: Path) -> str:
    """ "read", or the code of the diagnostic; every other exception fails the test."""
    try:
        return "read" if Trace.load(path).samples > 0 else "nothing"
    except StlcError as error:
        return error.diagnostics[0].code


def damaged(data: bytes, cut: int, flips: list[tuple[int, int]]) -> bytes:
    changed = bytearray(data[: len(data) - cut])
    for at, value in flips:
        if changed:
            changed[at % len(changed)] = value
    return bytes(changed)


@given(
    cut=st.integers(0, 2000),
    flips=st.lists(st.tuples(st.integers(0, 10**6), st.integers(0, 255)), max_size=4),
)
@settings(deadline=None, max_examples=36, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_damage_is_a_diagnostic_or_harmless(tmp_path: Path, cut: int, flips: list[tuple[int, int]]) -> None:
    whole = tmp_path / "whole.npz"
    if not whole.exists():
        a_trace().save(whole)
    path = tmp_path / "damaged.npz"
    path.write_bytes(damaged(whole.read_bytes(), cut, flips))
    assert outcome(path) in ("read", "E601", "E602", "E603", "E604", "E605")


@pytest.mark.parametrize("cut", [1, 30, 400])
def test_a_truncated_file(tmp_path: Path, cut: int) -> None:
    a_trace().save(tmp_path / "a.npz")
    (tmp_path / "a.npz").write_bytes((tmp_path / "a.npz").read_bytes()[:-cut])
    assert code_of(tmp_path / "a.npz") == "E603"


@pytest.mark.parametrize(
    "meta",
    [
        np.array("{"),
        np.array("[" * 5000),
        np.array("[1]"),
        np.array('{"seed": "x"}'),
        np.array('{"horizon": true}'),
        np.array('{"spec_text": 3}'),
        np.array('{"spec_set": null}'),
        np.array('{"spec_set": {"D": 1.5}}'),
        np.array('{"signals": {"x": {"kind": "tensor"}}}'),
        np.array('{"signals": {"x": {"unit": "[["}}}'),
    ],
)
def test_damaged_meta(tmp_path: Path, meta: np.ndarray) -> None:
    assert code_of(npz(tmp_path / "a.npz", t=[0.0, 0.1], x=[0.0, 0.1], meta=meta)) == "E603"


def test_missing_file_and_folder(tmp_path: Path) -> None:
    for path in (tmp_path / "none.npz", tmp_path / "none.csv", tmp_path):
        with pytest.raises(UsageError):
            Trace.load(path)


def test_a_packed_array_that_is_damaged(tmp_path: Path) -> None:
    for method in (zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA):
        with zipfile.ZipFile(tmp_path / "a.npz", "w", method) as archive:
            for name in ("t", "x"):
                archive.writestr(f"{name}.npy", header((200,)) + np.arange(200.0).tobytes())
        assert Trace.load(tmp_path / "a.npz").samples == 200
        raw = (tmp_path / "a.npz").read_bytes()
        for at in range(36, 120, 7):
            (tmp_path / "b.npz").write_bytes(raw[:at] + bytes([raw[at] ^ 255]) + raw[at + 1 :])
            assert outcome(tmp_path / "b.npz") in ("read", "E603", "E602", "E601")


# -------------------------------------------------------------- shapes and times


@pytest.mark.parametrize(
    ("arrays", "code", "words"),
    [
        ({"x": [1.0, 2.0]}, "E601", "has no `t`"),
        ({"t": [0.0, 0.1]}, "E601", "no signals"),
        ({"t": [0.0, 0.1], "x": [1.0, 2.0, 3.0]}, "E605", "`x` in .* is 3, and `t` has 2 samples"),
        (
            {"t": [0.0, 0.1], "x": np.zeros((2, 2)), "y": np.zeros((3, 2))},
            "E605",
            "2 traces, other signals have 3",
        ),
        ({"t": [0.0, 0.1], "x": np.zeros((0, 2))}, "E605", "no traces"),
        ({"t": [], "x": []}, "E605", "no samples"),
        ({"t": [0.0], "x": [1.0]}, "E602", "one sample"),
        ({"t": [0.0, np.nan, 0.2], "x": [1.0, 2.0, 3.0]}, "E604", r"nan at t\[1\]"),
        ({"t": [0.0, 0.1, 0.1], "x": [1.0, 2.0, 3.0]}, "E602", "does not increase"),
        (
            {"t": [0.0, 0.1, 0.2, 0.9], "x": np.zeros(4)},
            "E602",
            r"missing in .*: dt is 0.1 s, and after t\[2\] = 0.2 s comes t\[3\] = 0.9 s",
        ),
        (
            {"t": [0.0, 0.1, 0.2, 0.87, 0.97], "x": np.zeros(5)},
            "E602",
            r"except at t\[2\] = 0.2 s, where it is 0.67 s",
        ),
    ],
)
def test_arrays_that_do_not_fit(tmp_path: Path, arrays: dict[str, object], code: str, words: str) -> None:
    path = npz(tmp_path / "a.npz", **arrays)
    assert code_of(path) == code
    with pytest.raises(TraceError, match=words):
        Trace.load(path)


def test_a_slow_drift_is_not_uniform(tmp_path: Path) -> None:
    gaps = np.repeat([0.100, 0.103], 50)
    path = npz(tmp_path / "a.npz", t=np.cumsum(gaps), x=np.zeros(100))
    assert "beside the grid" in message_of(path)


@pytest.mark.parametrize("dt", [0.1, 1 / 30, 0.004, 1e-6, 2.0])
def test_the_step_is_the_fraction_that_was_meant(tmp_path: Path, dt: float) -> None:
    times = 3 + np.cumsum(np.full(1000, dt))
    trace = Trace.load(npz(tmp_path / "a.npz", t=times, x=np.zeros(1000)))
    assert trace.dt == pytest.approx(dt, rel=1e-12)
    assert as_fraction(trace.dt).denominator <= 1_000_000


@pytest.mark.parametrize("dt", [1e-300, 5e-324, 1e-16, 1e13, 1e15])
def test_a_step_that_nothing_is_sampled_with(tmp_path: Path, dt: float) -> None:
    path = npz(tmp_path / "a.npz", x=np.zeros(5), meta=np.array(f'{{"dt": {dt!r}}}'))
    assert (code_of(path), message_of(path)[:17]) == ("E602", "the time step of ")
    if 1e-300 <= dt <= 1e300:
        path = npz(tmp_path / "b.npz", x=np.zeros(5), t=np.arange(5) * dt)
        assert (code_of(path), message_of(path)[:17]) == ("E602", "the time step of ")
    with pytest.raises(TraceError, match="E602: the time step of"):
        Trace.load(npz(tmp_path / "c.npz", x=np.zeros(5), t=np.arange(5)), Reading(resample=dt))


def test_fractions_of_steps() -> None:
    assert str(as_fraction(0.1)) == "1/10"
    assert str(as_fraction(1 / 30)) == "1/30"
    assert float(as_fraction(1e-9)) == 1e-9


# ----------------------------------------------------------------------------- csv


def csv(path: Path, text: str) -> Path:
    path.write_bytes(text.encode())
    return path


def test_csv_with_units_agents_and_blanks(tmp_path: Path) -> None:
    text = "\ufeff t ; agent ; v [km/h]; q[0] [rad]\r\n0;7;1;2\r\n0.5;7;3;4\r\n\r\n0;9;5;true\r\n"
    text += "0.5;9;-.5e1;0\r\n"
    trace = Trace.load(csv(tmp_path / "a.csv", text))
    assert (trace.dt, trace.traces, trace.samples) == (0.5, 2, 2)
    assert trace.data["v"].tolist() == [[1, 3], [5, -5]]
    assert trace.data["q[0]"].tolist() == [[2, 4], [1, 0]]
    assert trace.signature["v"].unit.text == "km/h"


def test_csv_lines_of_agents_may_alternate(tmp_path: Path) -> None:
    trace = Trace.load(csv(tmp_path / "a.csv", "t,trace,x\n0,0,1\n0,1,2\n1,0,3\n1,1,4\n"))
    assert trace.data["x"].tolist() == [[1, 3], [2, 4]]


@pytest.mark.parametrize(
    ("text", "code", "place", "words"),
    [
        ("t,x\n0,1\n0.1,oops\n", "E603", (3, 5), "`oops` is not a number"),
        ("t,x\n0,go\n0.1,stop\n", "E603", None, "`x` in .* holds words (`go`)"),
        ("t,x\nnow,1\nthen,2\n", "E603", None, "the clock `t` in .* holds words (`now`)"),
        ("t [m],x\n0,1\n1,2\n", "E605", None, "the clock `t` of .* is in [m], which is not a time"),
        ("time,Time,x\n0,1,1\n1,3,1\n", "E601", None, "which of `time`, `Time` is the clock"),
        ("t,x\n0,1\n,2\n", "E604", None, "time in .* is nan at t[1]"),
        ("t,x\n0,1\n0.1,1_0\n", "E603", (3, 5), "`1_0` is not a number"),
        ("t,x\n0,1\n0.1,0x10\n", "E603", (3, 5), "`0x10` is not a number"),
        ("t,x\n0,1\n0.1,__import__('os')\n", "E603", (3, 5), "is not a number"),
        ("t,x\n0,1\n0.1,2,3\n", "E605", (3, 1), "this line has 3 cells"),
        ("t,x\n0,1\n0.1\n", "E605", (3, 1), "this line has 1 cells"),
        ("0,1\n0.1,2\n", "E605", (1, 1), "must name the columns"),
        ("t,x\n", "E603", None, "no line of numbers"),
        (" \n ", "E603", None, "empty"),
        ("t,x\n0,1\0\n", "E603", None, "binary"),
        ("t,x [m/q]\n0,1\n1,2\n", "E605", None, "column `x`"),
        ("x\n1\n2\n", "E601", None, "no `t`"),
        (
            "t,trace,x\n0,0,1\n1,0,1\n0,1,1\n",
            "E605",
            None,
            "2 objects of different times",
        ),
        ("t,trace,x\n0,0,1\n1,0,1\n5,1,1\n6,1,1\n", "E605", None, "2 objects of different times"),
    ],
)
def test_csv_that_is_wrong(
    tmp_path: Path, text: str, code: str, place: tuple[int, int] | None, words: str
) -> None:
    with pytest.raises(StlcError) as caught:
        Trace.load(csv(tmp_path / "a.csv", text))
    finding = caught.value.diagnostics[0]
    assert finding.code == code
    assert all(part in finding.message for part in words.split(".*"))
    assert (finding.span and (finding.span.line, finding.span.column)) == place


def test_csv_reports_the_first_bad_cell_of_each_column(tmp_path: Path) -> None:
    with pytest.raises(TraceError) as caught:
        Trace.load(csv(tmp_path / "a.csv", "t,x,y\n0,1,2\n1,a,b\n1,2,c\n"))
    first, second = caught.value.diagnostics
    assert [d.message.split("`")[1] for d in (first, second)] == ["a", "b"]
    assert second.note == ("1 more cell of `y` not a number",)


@pytest.mark.parametrize(
    ("head", "times"),
    [
        ("time", "0 0.5 1"),
        ("Time [s]", "0 0.5 1"),
        ("t(s)", "0 0.5 1"),
        ("Timestamp (ms)", "0 500 1000"),
        ("# t [us]", "0 5e5 1e6"),
        ("time (sec)", "0 0.5 1"),
        ("%time", "0 500000000 1000000000"),
        ("t", "2026-01-31T23:59:59.5Z 2026-02-01T00:00:00Z 2026-02-01T00:00:00.5Z"),
    ],
)
def test_clocks_as_others_write_them(tmp_path: Path, head: str, times: str) -> None:
    lines = [
        f"{head},Speed over Ground (km/h),f(x)",
        *(f"{time},{k},0" for k, time in enumerate(times.split())),
    ]
    trace = Trace.load(csv(tmp_path / "a.csv", "\n".join(lines)))
    assert (trace.t0, trace.dt, trace.samples) == (0.0, 0.5, 3)
    assert list(trace.data) == ["Speed over Ground", "f(x)"]
    assert trace.signature["Speed over Ground"].unit.text == "km/h"


@pytest.mark.parametrize("cells", ["0,5", "-1,25e1"])
def test_decimal_commas_between_semicolons(tmp_path: Path, cells: str) -> None:
    trace = Trace.load(csv(tmp_path / "a.csv", f"t;x\n0,0;{cells}\n0,5;1\n"))
    assert trace.dt == 0.5
    assert trace.data["x"].tolist() == [[float(cells.replace(",", ".")), 1.0]]
    assert code_of(csv(tmp_path / "a.csv", f"t;x\n0,0;1\n0,5;{cells},\n")) == "E603"


def test_another_clock_than_the_usual_one(tmp_path: Path) -> None:
    path = csv(tmp_path / "a.csv", "time,stamp,x\n0,5,1\n1,5.5,2\n")
    assert Trace.load(path, Reading({"t": "time"})).dt == 1.0
    trace = Trace.load(path, Reading({"t": "stamp"}))
    assert (trace.t0, trace.dt) == (5.0, 0.5)
    assert set(trace.data) == {"x", "time"}


WORDS = {"sign": {"stop": 0.0, "light": 1.0}, "on": Column.TRUTH, "x": {}}


@pytest.mark.parametrize(
    "text",
    [
        "t,x,y\n0,1,2\n1,,3\n2,4, \n",
        "t\tx\ty\n0\t1\t2\n1\t\t3\n2\t4\t\n\t\t\n",
        "t;x;y\n0,0;1;2\n1,0;;3\n2,0;4;\n;;",
        't,x,y\n0,1,"2"\n1,"",3\n2,4,\n,,\n',
    ],
)
def test_an_empty_cell_is_no_number_and_an_empty_line_is_none(tmp_path: Path, text: str) -> None:
    trace = Trace.load(csv(tmp_path / "a.csv", text))
    np.testing.assert_array_equal(trace.data["x"], [[1.0, np.nan, 4.0]])
    np.testing.assert_array_equal(trace.data["y"], [[2.0, 3.0, np.nan]])


def test_a_column_of_words_may_begin_with_an_empty_cell(tmp_path: Path) -> None:
    path = csv(tmp_path / "a.csv", "t,Sign,x\n0,,1\n1,stop,\n2,,3\n")
    trace = Trace.load(path)
    assert trace.extras["Sign"].tolist() == ["", "stop", ""]
    np.testing.assert_array_equal(trace.data["x"], [[1.0, np.nan, 3.0]])
    read = Trace.load(path, Reading({"sign": "Sign"}, words=WORDS)).data["sign"][0]
    assert read.tolist()[1] == WORDS["sign"]["stop"]
    assert np.isnan(read[[0, 2]]).all()


@pytest.mark.parametrize("quote", ["", '"'])
def test_long_words_are_cut(tmp_path: Path, quote: str) -> None:
    path = csv(tmp_path / "a.csv", f"t,x,note\n0,1,{quote}ok{quote}\n1,2,{quote}{'a' * 5000}{quote}\n")
    note = Trace.load(path).extras["note"]
    assert note.tolist() == ["ok", "a" * 64]
    assert note.dtype.itemsize == 4 * 64


def test_traces_whose_names_may_have_been_cut_are_refused(tmp_path: Path) -> None:
    long = "run/" * 16
    path = csv(tmp_path / "a.csv", f"trace,t,x\n{long}1,0,1\n{long}1,1,1\n{long}2,0,1\n{long}2,1,1\n")
    assert code_of(path) == "E605"
    assert "names of 64 letters or more" in message_of(path)


def test_without_a_clock_the_arrays_are_named(tmp_path: Path) -> None:
    with pytest.raises(TraceError) as caught:
        Trace.load(csv(tmp_path / "a.csv", "when,x\n0,1\n1,2\n"))
    (finding,) = caught.value.diagnostics
    assert finding.message.endswith("has no `t`")
    assert finding.note == (f"arrays in {tmp_path / 'a.csv'}: when, x",)


@pytest.mark.parametrize("quote", ["", '"'])
def test_words_are_what_the_specification_says(tmp_path: Path, quote: str) -> None:
    rows = [("0", "stop", "Yes", "1", "map"), ("1", "Light", "no", "2", "map")]
    lines = ["t,Sign,on,x,frame", *(",".join(f"{quote}{cell}{quote}" for cell in row) for row in rows)]
    path = csv(tmp_path / "a.csv", "\n".join(lines))
    trace = Trace.load(path, Reading({"sign": "Sign"}, words=WORDS))
    assert {name: values.tolist() for name, values in trace.data.items()} == {
        "sign": [[0, 1]],
        "on": [[1, 0]],
        "x": [[1, 2]],
    }


@pytest.mark.parametrize(
    ("text", "message", "said"),
    [
        ("t,sign\n0,stop\n1,lihgt\n", "cannot be `lihgt`", "did you mean `light`?"),
        ("t,on\n0,maybe\n1,no\n", "cannot be `maybe`", "one of true, yes"),
        ("t,x\n0,fast\n1,slow\n", "holds words (`fast`)", "signal x : Kind"),
    ],
)
def test_words_that_a_signal_does_not_have(tmp_path: Path, text: str, message: str, said: str) -> None:
    with pytest.raises(TraceError) as caught:
        Trace.load(csv(tmp_path / "a.csv", text), Reading(words=WORDS))
    (finding,) = caught.value.diagnostics
    assert finding.code == "E603"
    assert message in finding.message
    assert said in " ".join([*finding.help, *finding.note])


def test_other_suffixes_are_listed(tmp_path: Path) -> None:
    with pytest.raises(TraceError, match=r"none of \.npz \.csv \.tsv \.txt \.jsonl \.ndjson \.parquet"):
        Trace.load(csv(tmp_path / "a.doc", "t,x\n0,1\n"))
    a_trace().save(tmp_path / "a.npz")
    (tmp_path / "a.npz").rename(tmp_path / "a.bin")
    assert Trace.load(tmp_path / "a.bin").samples == a_trace().samples
    assert Trace.load(csv(tmp_path / "a.tsv", "t\tx\n0\t1\n1\t2\n")).samples == 2
    for path in ("a.doc", "a"):
        with pytest.raises(UsageError, match=r"written as \.npz, \.csv or \.mcap"):
            a_trace().save(tmp_path / path)


def test_csv_that_is_not_text(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_bytes(b"t,x\n0,1\n1,\xff\xfe\n")
    assert "`ÿþ` is not a number" in message_of(tmp_path / "a.csv")


@given(st.text(alphabet='t,x\n0123.e-"; ', max_size=60))
@settings(deadline=None, max_examples=50, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_csv_is_read_or_refused(tmp_path: Path, text: str) -> None:
    assert outcome(csv(tmp_path / "a.csv", text)) in ("read", "E601", "E602", "E603", "E604", "E605")


@given(st.lists(st.lists(FINITE, min_size=2, max_size=2), min_size=1, max_size=5))
@settings(deadline=None, max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_both_csv_readers_agree(tmp_path: Path, rows: list[list[float]]) -> None:
    body = "".join(f"{a!r},{b!r}\n" for a, b in rows)
    fast = trace_csv.read(csv(tmp_path / "a.csv", "a,b\n" + body))
    strict = trace_csv.read(
        csv(tmp_path / "b.csv", "a,b\n\n" + body.replace(",", ',"', 1).replace("\n", '"\n', 1))
    )
    columns, others = fast.groups[0].arrays, strict.groups[0].arrays
    assert all(np.array_equal(columns[name], others[name]) for name in ("a", "b"))


def test_a_clock_of_words_without_samples_is_a_diagnostic(tmp_path: Path) -> None:
    empty = np.zeros(0)
    np.savez(tmp_path / "none.npz", x=empty, t=empty.astype("U4"))
    with pytest.raises(TraceError):
        Trace.load(tmp_path / "none.npz")


def test_a_csv_of_empty_cells_is_a_diagnostic(tmp_path: Path) -> None:
    (tmp_path / "gaps.csv").write_text("t,x\n,\n,\n,,")
    with pytest.raises(TraceError):
        Trace.load(tmp_path / "gaps.csv")


@pytest.mark.parametrize("reading", [Reading(), Reading(resample=1.0)])
def test_times_that_are_too_far_apart(tmp_path: Path, reading: Reading) -> None:
    (tmp_path / "a.csv").write_text("t,x\n-1e308,1\n1e308,1\n")
    with pytest.raises(TraceError, match="too long to be measured"):
        Trace.load(tmp_path / "a.csv", reading)


def test_a_frame_has_a_row_for_each_sample():
    pytest.importorskip("pandas")
    data = {"x": np.array([[1.0, 2.0], [3.0, 4.0]])}
    frame = Trace(Signature((Column("x"),)), 0.5, data, 1.0).to_frame()
    assert frame["trace"].tolist() == [0, 0, 1, 1]
    assert frame["t"].tolist() == [1.0, 1.5, 1.0, 1.5]
    assert frame["x"].tolist() == [1.0, 2.0, 3.0, 4.0]
