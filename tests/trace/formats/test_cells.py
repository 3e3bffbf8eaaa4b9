"""Numbers of large tables: every one correctly rounded, and none that the careful reader would refuse."""

from __future__ import annotations

import io
import math
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stlc import native
from stlc.diagnostics import StlcError
from stlc.trace.formats import cells as trace_cells
from stlc.trace.formats import csv as trace_csv
from stlc.trace.formats.cells import TableText, read_lines
from stlc.trace.formats.csv import table_of_text

NAME = Path("table.csv")
ALWAYS, NEVER = 0, 1 << 62
DIGITS = st.text("0123456789", max_size=21)
DECIMALS = st.builds(
    "{}{}.{}{}".format,
    st.sampled_from(["", "-", "+"]),
    DIGITS,
    DIGITS,
    st.one_of(st.just(""), st.builds("e{}".format, st.integers(-40, 40))),
).filter(lambda text: any(map(str.isdigit, text.partition("e")[0])))
HALVES = st.builds(
    lambda m, e, above: str(((2 * m + 1) << e) + above),
    st.integers(1 << 52, (1 << 53) - 1),
    st.integers(0, 9),
    st.integers(-1, 1),
)
"""Numbers in the middle between two doubles, and their neighbours."""

NUMBERS = st.one_of(
    st.integers(-999, 999).map(str),
    st.floats().map(repr),
    st.sampled_from(["", " 1 ", "\t", "1.", ".5", "-0", '"2"', "True", "nan", "-INF", "1e400", "٣"]),
)
DAMAGE = st.sampled_from([*"\0\r\n\t ,;\"'.eE+-_x0", "\ufeff", "\x0b", "\x85", "1e", "0x1", "stop", ",,"])


@pytest.fixture(params=["kernel", "arrow", "numpy"])
def reader(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every way of reading many lines."""
    if request.param == "arrow":
        pytest.importorskip("pyarrow.csv")
    if request.param == "numpy":
        monkeypatch.setattr(trace_cells, "_arrow", lambda: None)
    if request.param != "kernel":
        monkeypatch.setattr(trace_cells, "_library", lambda: None)
    elif native.compiler() is None:
        pytest.skip("there is no C compiler here")


@pytest.fixture
def choose(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """From how many bytes on a table is large."""
    return lambda size: monkeypatch.setattr(trace_csv, "LARGE", size)


def outcome(data: bytes) -> object:
    """The table, or what is said about it, in a form that can be compared."""
    try:
        table = table_of_text(NAME, data)
    except StlcError as error:
        return [(d.code, d.message, d.span and (d.span.line, d.span.column)) for d in error.diagnostics]
    return [
        (name, table.units[name], [repr(value) for value in values.tolist()])
        for name, values in table.columns.items()
    ]


@pytest.mark.usefixtures("reader")
@given(st.lists(st.one_of(DECIMALS, HALVES), min_size=1, max_size=60))
@settings(deadline=None, max_examples=25)
def test_every_number_is_the_nearest_double(cells: list[str]) -> None:
    room = [*cells, *["0"] * (40 * len(cells))]  # a few may be doubts
    columns = read_lines(TableText("\n".join(room).encode(), 0, 1, ","))
    assert columns is not None
    for cell, value in zip(cells, columns[0].tolist(), strict=False):
        assert value == float(cell), cell
        assert math.copysign(1, value) == math.copysign(1, float(cell)), cell


@st.composite
def texts(draw: st.DrawFn) -> bytes:
    """A table, well formed or not quite, in one of the forms of a text."""
    width, mark = draw(st.integers(1, 4)), draw(st.sampled_from(",;\t"))
    row = st.lists(NUMBERS, min_size=width, max_size=width).map(mark.join)
    lines = [mark.join("abcd"[:width]), *draw(st.lists(row, max_size=6))]
    text = draw(st.sampled_from(["\n", "\r\n", "\r"])).join(lines) + draw(st.sampled_from(["", "\n"]))
    for _ in range(draw(st.integers(0, 3))):
        at = draw(st.integers(0, len(text)))
        text = text[:at] + draw(DAMAGE) + text[at + draw(st.integers(0, 2)) :]
    data = text.encode(draw(st.sampled_from(["utf-8", "utf-8-sig", "utf-8"])))
    return data + draw(st.sampled_from([b"", b"", b"\xff"]))


@pytest.mark.usefixtures("reader")
def test_large_tables_are_read_like_small_ones(choose: Callable[[int], None]) -> None:
    @given(texts())
    @settings(deadline=None, max_examples=150)
    def agree(data: bytes) -> None:
        choose(NEVER)
        careful = outcome(data)
        choose(ALWAYS)
        assert outcome(data) == careful

    agree()


@pytest.mark.usefixtures("reader")
@pytest.mark.parametrize("end", [b"\n", b"\r\n"])
@pytest.mark.parametrize("start", [b"", b"\xef\xbb\xbf", b"\r\n \n"])
def test_usual_files_need_no_careful_reader(
    monkeypatch: pytest.MonkeyPatch, choose: Callable[[int], None], start: bytes, end: bytes
) -> None:
    choose(ALWAYS)
    monkeypatch.setattr(trace_csv, "_read_body", None)
    monkeypatch.setattr(trace_cells, "STRETCH", 64)
    rows = [b"%d,%r,-1.5e-3, nan ,1e300" % (k, k / 7) for k in range(40)]
    table = table_of_text(NAME, start + end.join([b"t [s],a,b,c,d", *rows, b"", b"7,1,2,3,4"]))
    assert table.units["t"] == "s"
    assert table.columns["t"].tolist() == [*range(40), 7]
    assert table.columns["a"].tolist() == [*(k / 7 for k in range(40)), 1]
    assert np.isnan(table.columns["c"][:40]).all()
    assert table.columns["d"].tolist() == [*[1e300] * 40, 4]


@pytest.mark.parametrize("line", [b"1,2,", b"1", b"1,2,3", b"1,x", b"1,1_0", b"1,2 3", b"1,--2", b"1,\0"])
@pytest.mark.usefixtures("reader")
def test_what_does_not_fit_is_left_to_the_careful_reader(line: bytes) -> None:
    assert read_lines(TableText(b"0,1\n" * 50 + line + b"\n0,1\n", 0, 2, ",")) is None


def test_empty_cells_and_lines(reader: None) -> None:  # noqa: ARG001 - both ways
    columns = read_lines(TableText(b"head\n1,2\n\n , \t\n" + b"3,4\n" * 3, 5, 2, ","))
    assert columns is not None
    assert [column.tolist() for column in columns] == [[1, 3, 3, 3], [2, 4, 4, 4]]


@pytest.mark.usefixtures("reader")
def test_memory_is_that_of_the_text_and_the_numbers(choose: Callable[[int], None]) -> None:
    data = b"a,b\n" + b"0.25,1.123456\n" * 100_000
    choose(ALWAYS)
    table_of_text(NAME, data)
    tracemalloc.start()
    try:
        table = table_of_text(NAME, data)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert table.rows == 100_000
    assert peak < 2.5 * 16 * table.rows  # of text 14 bytes a line, of numbers 16


@pytest.mark.bench
def test_without_a_compiler_a_table_takes_as_long_as_numpy(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [",".join(map(repr, row)) for row in np.random.default_rng(0).normal(size=(280_000, 9)).tolist()]
    data = "\n".join(["t,a,b,c,d,e,f,g,h", *rows]).encode()
    gaps = "\n".join(
        ["t,a,b,c,d,e,f,g,h", *(row.replace(",", ",,", 1).rpartition(",")[0] for row in rows)]
    ).encode()
    monkeypatch.setattr(trace_cells, "_library", lambda: None)
    begun = time.process_time()
    np.loadtxt(io.BytesIO(data), delimiter=",", skiprows=1)
    by_numpy = time.process_time() - begun
    print(f"\n{len(data) / 1e6:.0f} MB: np.loadtxt {by_numpy:.2f} s")  # noqa: T201
    for arrow in (None, trace_cells._arrow()):
        monkeypatch.setattr(trace_cells, "_arrow", lambda arrow=arrow: arrow)
        for name, text in (("numbers", data), ("with a gap in every line", gaps)):
            begun = time.process_time()
            table_of_text(NAME, text)
            spent = time.process_time() - begun
            print(f"{'Arrow' if arrow else 'NumPy'}, {name}: {spent:.2f} s, {spent / by_numpy:.2f} times")  # noqa: T201
            assert name != "numbers" or spent < 1.5 * by_numpy
