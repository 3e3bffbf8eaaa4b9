"""Numbers of tables: correctly rounded by every reader, and none that the careful one would refuse."""

from __future__ import annotations

import io
import random
import re
import struct
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
from stlc.trace.formats.cells import numbers, read_lines, value_of
from stlc.trace.formats.csv import read
from stlc.trace.formats.jsonl import _DECODER
from stlc.trace.recording import ALL, Recording, Wanted

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
    st.sampled_from(["NA", "n/a", "null", "-", "#N/A", "1.#INF", "-1.#IND", "1,5", '"1,5"', '"a ""b"" c"']),
    st.sampled_from(
        ['"go, on"', '"go\non"', ' "4" ', '""', "# go", "9223372036854775808.000000", "\u0131nf"]
    ),
)
DAMAGE = st.sampled_from(
    [*"\0\r\n\t ,;\"'.eE+-_x0#%|", "\ufeff", "\x0b", "\x85", "1e", "0x1", "stop", ",,", "//"]
)
WANTED = st.sampled_from([ALL, ALL, Wanted(frozenset("a")), Wanted(frozenset("bc")), Wanted(frozenset())])


@pytest.fixture(params=["kernel", "python"])
def reader(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every way of reading many lines."""
    if request.param != "kernel":
        monkeypatch.setattr(trace_cells, "_library", lambda: None)
    elif native.compiler() is None:
        pytest.skip("there is no C compiler here")


@pytest.fixture
def kernel() -> None:
    if native.compiler() is None:
        pytest.skip("there is no C compiler here")


def lines_of(data: bytes, width: int, wanted: tuple[int, ...] | None = None) -> list[list[float]] | None:
    """Numbers that the kernel reads, a list for each column."""
    columns = read_lines(data, 0, width, ",", range(width) if wanted is None else wanted)
    return None if columns is None else [column.tolist() for column in columns]


@pytest.fixture
def choose(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """From how many bytes on a table is large."""
    return lambda size: monkeypatch.setattr(trace_csv, "LARGE", size)


def read_text(data: bytes, wanted: Wanted = ALL) -> Recording:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trace_csv, "unpacked", lambda _: data)
        return read(NAME, wanted)


def outcome(data: bytes, wanted: Wanted = ALL) -> object:
    """The table, or what is said about it, in a form that can be compared."""
    try:
        table = read_text(data, wanted)
    except StlcError as error:
        return [(d.code, d.message, d.span and (d.span.line, d.span.column)) for d in error.diagnostics]
    return [
        (name, table.units.get(name), [repr(value) for value in values.tolist()])
        for name, values in table.groups[0].arrays.items()
    ]


@pytest.mark.usefixtures("kernel")
def test_a_multiple_of_2_to_the_64_is_no_zero() -> None:
    hostile = [
        "9223372036854775808.000000",
        "18446744073709551616",
        "-36893488147419103232e-3",
        "00.0184467440737",
    ]
    room = [*hostile, *["0"] * 200]  # a few may be doubts
    assert lines_of("\n".join(room).encode(), 1) == [list(map(float, room))]


def hostile(seed: int, count: int) -> list[str]:
    """Texts of numbers that are hard to read: long ones, halves between doubles, multiples of powers of 2."""
    draw = random.Random(seed)
    digits = "0123456789"

    def decimal() -> str:
        left, right = (draw.choices(digits, k=draw.choice((0, 1, 5, 9, 10, 18, 19, 20))) for _ in range(2))
        return "".join([*left, draw.choice([".", "", "."]), *right]) + exponent()

    def exponent() -> str:
        return draw.choice(
            ("", "", f"e{draw.randint(-30, 30)}", f"E+{draw.randint(0, 400)}", f"e-{draw.randint(0, 400)}")
        )

    def power() -> str:
        whole = draw.randint(1, 9) << draw.randint(40, 75)
        return f"{whole + draw.choice((-1, 0, 0, 0, 1))}{draw.choice(('', '.', '.0', '.000000', '000'))}"

    def half() -> str:
        middle = ((2 * draw.randint(1 << 52, (1 << 53) - 1) + 1) << draw.randint(0, 9)) + draw.randint(-1, 1)
        return str(middle) if draw.random() < 0.5 else f"{middle}e-{draw.randint(1, 27)}"

    def double() -> str:
        return repr(abs(struct.unpack("d", draw.randbytes(8))[0]))

    def padded() -> str:
        left, right = ("0" * draw.randint(0, 25) for _ in range(2))
        return f"{left}{draw.choice(('.', ''))}{right}{draw.randint(0, 99)}"

    makers = [decimal, power, half, double, padded]
    texts = (draw.choice(("", "", "-", "+")) + draw.choice(makers)() for _ in range(count))
    return [text if text.strip("+-.").lstrip("eE") == text.strip("+-.") != "" else "-0.0" for text in texts]


def require_floats(texts: list[str]) -> None:
    """Every reader gives what `float` gives, to the bit."""
    right = np.array(list(map(float, texts))).view(np.int64)

    def check(name: str, values: list[float] | np.ndarray | None) -> None:
        assert values is not None, name
        got = np.asarray(values, dtype=np.float64)
        wrong = np.flatnonzero((got.view(np.int64) != right) & ~np.isnan(got))
        assert not len(wrong), (name, texts[wrong[0]], got[wrong[0]])

    check("cell", [value_of(text) for text in texts])
    check("column", numbers(texts, comma=False)[0])
    plain = [text.lstrip("+") for text in texts]
    lawful = [text for text in plain if JSON_NUMBER.fullmatch(text)]
    of_json = _DECODER.decode(f"[{','.join(lawful)}]")
    assert list(map(repr, of_json)) == list(map(repr, map(float, lawful)))
    if native.compiler() is not None:
        table = "\n".join(",".join([text, *["1"] * 40]) for text in texts)  # any text may be a doubt
        lines = read_lines(table.encode(), 0, 41, ",", range(41))
        check("kernel", None if lines is None else lines[0])


JSON_NUMBER = re.compile(r"-?(?:0|[1-9]\d*)(?:\.\d+)?(?:[eE][+-]?\d+)?")


def test_every_reader_of_numbers_gives_what_float_gives() -> None:
    require_floats(hostile(0, 20_000))


@pytest.mark.slow
def test_every_reader_of_numbers_gives_what_float_gives_on_ten_million() -> None:
    for seed in range(1, 101):
        require_floats(hostile(seed, 100_000))


@st.composite
def texts(draw: st.DrawFn) -> bytes:
    """A table, well formed or not quite, in one of the forms of a text."""
    width, mark = draw(st.integers(1, 4)), draw(st.sampled_from(",;\t|"))
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
    @given(texts(), WANTED)
    @settings(deadline=None, max_examples=60)
    def agree(data: bytes, wanted: Wanted) -> None:
        choose(NEVER)
        careful = outcome(data, wanted)
        choose(ALWAYS)
        assert outcome(data, wanted) == careful

    agree()


@pytest.mark.usefixtures("reader")
@pytest.mark.parametrize("end", [b"\n", b"\r\n"])
@pytest.mark.parametrize("start", [b"", b"\xef\xbb\xbf", b"\r\n \n"])
def test_usual_files_need_no_careful_reader(
    monkeypatch: pytest.MonkeyPatch, choose: Callable[[int], None], start: bytes, end: bytes
) -> None:
    choose(ALWAYS)
    monkeypatch.setattr(trace_csv._Body, "_rows", None)
    monkeypatch.setattr(trace_csv, "STRETCH", 64)
    rows = [b"%d,%r,-1.5e-3, nan ,1e300" % (k, k / 7) for k in range(40)]
    table = read_text(start + end.join([b"t [s],a,b,c,d", *rows, b"", b"7,1,2,3,4"]))
    assert table.units["t"] == "s"
    columns = table.groups[0].arrays
    assert columns["t"].tolist() == [*range(40), 7]
    assert columns["a"].tolist() == [*(k / 7 for k in range(40)), 1]
    assert np.isnan(columns["c"][:40]).all()
    assert columns["d"].tolist() == [*[1e300] * 40, 4]


@pytest.mark.usefixtures("kernel")
@pytest.mark.parametrize(
    "line",
    [b"1", b"1,2,3", b"1,x", b"1,1_0", b"1,2 3", b"1,--2", b"1,\0", b"# 1", b"%", b"//", b'1,"2', b'"1"2,3'],
)
def test_what_does_not_fit_is_left_to_the_careful_reader(line: bytes) -> None:
    assert lines_of(b"0,1\n" * 50 + line + b"\n0,1\n", 2) is None


@pytest.mark.usefixtures("kernel")
def test_empty_cells_and_lines() -> None:
    text = b'1,2\n\n , \t\n"", ""\n1,2, ,\n' + b"3,4\n" * 3
    assert lines_of(text, 2) == [[1, 1, 3, 3, 3], [2, 2, 4, 4, 4]]


@pytest.mark.usefixtures("kernel")
def test_columns_that_nobody_wants_are_passed_over() -> None:
    text = b'1,"go, ""now""\nor never" ,2\n3,stop,4\n5,"",6\n7,it\'s 5" long,8\n'
    assert lines_of(text, 3, (2, 0)) == [[2, 4, 6, 8], [1, 3, 5, 7]]
    assert lines_of(text, 3) is None


@pytest.mark.usefixtures("reader")
def test_memory_is_that_of_the_text_and_the_numbers(choose: Callable[[int], None]) -> None:
    data = b"a,b\n" + b"0.25,1.123456\n" * 100_000
    choose(ALWAYS)
    read_text(data)
    tracemalloc.start()
    try:
        table = read_text(data)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert len(table.groups[0].arrays["a"]) == 100_000
    assert peak < 2.5 * 16 * 100_000  # of text 14 bytes a line, of numbers 16


@pytest.mark.bench
def test_without_a_compiler_a_table_takes_three_times_as_long_as_numpy(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
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
    for name, text in (("numbers", data), ("with a gap in every line", gaps)):
        begun = time.process_time()
        read_text(text)
        spent = time.process_time() - begun
        print(f"{name}: {spent:.2f} s, {spent / by_numpy:.2f} times")  # noqa: T201
        assert name != "numbers" or spent < 3 * by_numpy
