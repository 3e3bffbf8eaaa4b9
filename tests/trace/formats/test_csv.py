"""Tables of text in the dialects that people have: read right by every reader, or refused with the place."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from stlc.diagnostics import StlcError, TraceError
from stlc.trace.formats import csv as trace_csv
from stlc.trace.formats import table as trace_table
from stlc.trace.formats.csv import chunks, read, size, split_head, write_csv
from stlc.trace.formats.registry import format_of
from stlc.trace.recording import ALL, Recording, Wanted

V = Wanted(frozenset({"v"}))
BASE = "t,v\n0,0.5\n0.1,-1.5\n0.2,2.5\n"
"""The recording that all `DIALECTS` hold."""


def named(*columns: str) -> Wanted:
    return Wanted(frozenset({"v"}), columns=columns)


DIALECTS: dict[str, str | bytes] = {
    "plain": BASE,
    "comments": f"# exported by tool X\n% date, 2020\n// v in m/s\n{BASE}",
    "comments between rows": 't,v\n# "one, two\n0,0.5\n0.1,-1.5\n#0.15,9\n % end\n0.2,2.5\n',
    "header as np.savetxt writes it": "# t v\n0 0.5\n0.1 -1.5\n0.2 2.5\n",
    "comments and a header as TUM writes them": "# path\n# file: 'a, b'\n# t v\n0 0.5\n0.1 -1.5\n0.2 2.5\n",
    "header as EuRoC writes it": "#t, v []\n0, 0.5\n0.1, -1.5\n0.2, 2.5\n",
    "header as MATLAB writes it": "% t v\n  0.0   0.5\n  0.1  -1.5\n  0.2   2.5\n",
    "quoted cells": 't,v,msg\n0,0.5,"go, ""now"""\n0.1,"-1.5","or\nnever\n\n"\n0.2,2.5,\n',
    "quoted header": '"t","v","a\n""b"", c"\n0,0.5,\n0.1,-1.5,\n0.2,2.5,\n',
    "blanks around quotes": '"t" , "v"\n"0" ,"0.5"\n"0.1", "-1.5" \n"0.2","2.5"\n',
    "preamble": f'Some recorder\n"of us, indeed"\n\nRate,10,,\nname: x\n{BASE}',
    "preamble of key and value": f"Operator,Smith\nDate,2020-05-06\n{BASE}",
    "preamble as LabVIEW writes it": "LabVIEW\nChannels\t1\nSamples\t3\t3\nX0\t0\t0\n***End***\n\n"
    "t\tv\tc\n0,0\t0,5\t\n0,1\t-1,5\t\n0,2\t2,5\t\n",
    "long preamble": "text of the device\n" * 90 + BASE,
    "padded preamble": "Title,by me,,\nRate,10,,\n,,,\nt,v,,\n0,0.5,,\n0.1,-1.5,,\n0.2,2.5,,\n",
    "sep=": "sep=;\nt;v\n0;0,5\n0,1;-1,5\n0,2;2,5\n",
    "semicolons": "t;v\n0;0.5\n0.1;-1.5\n0.2;2.5\n",
    "pipes": "t|v\n0|0.5\n0.1|-1.5\n0.2|2.5\n",
    "tabs, decimal commas": "t\tv\n0\t,5\n0,1\t-1,5e0\n0,2\t2,5\n",
    "blanks": "  t   v  \n  0   0.5\n0.1\t-1.5  \n  0.2   2.5\n",
    "blanks, decimal commas": "t v\n0 0,5\n0,1 -1,5\n0,2 2,5\n",
    "trailing delimiters": "t,v,\n0,0.5,\n0.1,-1.5,\n0.2,2.5,\n",
    "trailing delimiters of rows": "t;v\n0;0.5;\n0.1;-1.5;\n0.2;2.5;;\n",
    "trailing delimiter of the header": "t,v,\n0,0.5\n0.1,-1.5\n0.2,2.5\n",
    "index of pandas": ",t,v\n0,0.0,0.5\n1,0.1,-1.5\n2,0.2,2.5\n",
    "names that are numbers": "t,v,0,1\n0,0.5,1,2\n0.1,-1.5,1,2\n0.2,2.5,1,2\n",
    "unread words": "t,note,v\n0,1,0.5\n0.1,oops,-1.5\n0.2,0x10,2.5\n",
    "CR": BASE.replace("\n", "\r"),
    "CRLF": f"\r\n{BASE}\n".replace("\n", "\r\n"),
    "byte order mark": f"\ufeff{BASE}",
    "UTF-16": BASE.encode("utf-16"),
    "UTF-16 BE": b"\xfe\xff" + BASE.encode("utf-16-be"),
    "UTF-16 LE without a mark": BASE.encode("utf-16-le"),
    "UTF-16 BE without a mark": BASE.encode("utf-16-be"),
    "Windows-1252": "t,v,Temp\xe9rature\n0,0.5,\xb5\n0.1,-1.5,\n0.2,2.5,\n".encode("cp1252"),
    "gzip": gzip.compress(BASE.encode(), mtime=0),
    "a long cell": f"t,v,image\n0,0.5,{'x' * 200_000}\n0.1,-1.5,\n0.2,2.5,\n",
}


def arrays_of(recordings: list[Recording]) -> dict[str, list[object]]:
    found = [recording.groups[0].arrays for recording in recordings]
    return {name: [value for each in found for value in each[name].tolist()] for name in found[0]}


def table(path: Path, text: str | bytes) -> Path:
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


@pytest.mark.parametrize("large", [0, 1 << 60])
@pytest.mark.parametrize("dialect", DIALECTS)
def test_dialects(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, dialect: str, large: int) -> None:
    monkeypatch.setattr(trace_csv, "LARGE", large)
    path = table(tmp_path / "a.csv", DIALECTS[dialect])
    right = {"t": [0, 0.1, 0.2], "v": [0.5, -1.5, 2.5]}
    assert arrays_of([read(path, V)]) == right
    for samples in (1, 2, 9):
        assert arrays_of(list(chunks(path, samples, V))) == right


@pytest.mark.parametrize(
    ("text", "units"),
    [
        ("t,v\n[s],[m/s]\n0,1\n", {"t": "s", "v": "m/s"}),
        ("t,v,w\ns,m/s,-\n\n0,1,2\n", {"t": "s", "v": "m/s"}),
        ("t;v\n(ms);(kph)\n0;1\n", {"t": "ms", "v": "kph"}),
        ("t\tv\tn\tw\nsec\tkm/h\t1\tbool\n0\t1\t2\tgo\n", {"t": "sec", "v": "km/h", "w": "bool"}),
        ("t [s],v\n[ms],[m/s]\n0,1\n", {"t": "s", "v": "m/s"}),
        ("t [s], v (km/h),f(x)\n0,1,2\n", {"t": "s", "v": "km/h"}),
        ("t_[s],v [furlong]\n0,1\n", {"t": "s", "v": "furlong"}),
        ('"t\n[s]",v\n0,1\n', {"t": "s"}),
    ],
)
def test_units(tmp_path: Path, text: str, units: dict[str, str]) -> None:
    found = read(table(tmp_path / "a.csv", text))
    assert found.units == units
    assert arrays_of([found])["t"] == [0]


def test_units_with_signs_of_windows_1252(tmp_path: Path) -> None:
    path = table(tmp_path / "a.csv", "t [\xb5s],T [\xb0C]\n0,1\n".encode("latin-1"))
    assert read(path).units == {"t": "µs", "T": "°C"}


@pytest.mark.parametrize(
    "cell",
    ["", '""', " ", "NA", "n/a", "null", "NULL", "None", "NaN", "-", "--", "#N/A", "<NA>", "-1.#IND00"],
)
@pytest.mark.parametrize("first", [True, False])
def test_missing(tmp_path: Path, cell: str, first: bool) -> None:
    rows = [f"0,{cell}", "1,2"] if first else ["0,2", f"1,{cell}"]
    values = read(table(tmp_path / "a.csv", "\n".join(["t,v", *rows]))).groups[0].arrays["v"]
    np.testing.assert_array_equal(values, [np.nan, 2] if first else [2, np.nan])


@pytest.mark.parametrize("cell", ["inf", "+Infinity", "INF", "1.#INF", "1.#INF00"])
def test_infinity_is_a_value(tmp_path: Path, cell: str) -> None:
    path = table(tmp_path / "a.csv", f"t,v\n0,1\n1,{cell}\n2,-{cell.lstrip('+')}\n")
    assert read(path).groups[0].arrays["v"].tolist() == [1, np.inf, -np.inf]


@pytest.mark.parametrize("unknown", ["nan", "NaN", "-nan(ind)", ""])
def test_an_unknown_first_cell_does_not_tell_words_from_numbers(tmp_path: Path, unknown: str) -> None:
    path = table(tmp_path / "a.csv", f"t,mode,x,none\n0,{unknown},{unknown},nan\n1,go,2,nan\n")
    arrays = read(path, Wanted(("t", "mode", "x", "none"))).groups[0].arrays
    assert arrays["mode"].tolist() == [unknown, "go"]
    np.testing.assert_array_equal(arrays["x"], [np.nan, 2.0])
    np.testing.assert_array_equal(arrays["none"], [np.nan, np.nan])


def test_words_dates_and_times_are_texts(tmp_path: Path) -> None:
    text = "Date,Time,mode,code\n2026-01-01,10:30:25.0,NA,None\n2026-01-01,10:30:25.1,go,null\n"
    assert arrays_of([read(table(tmp_path / "a.csv", text))]) == {
        "Date": ["2026-01-01"] * 2,
        "Time": ["10:30:25.0", "10:30:25.1"],
        "mode": ["NA", "go"],
        "code": ["None", "null"],
    }


@pytest.mark.parametrize(
    ("text", "names", "arrays"),
    [
        ("1 1 -0.5 \n1  2 0.5\n", ("unit", "t", "v"), {"unit": [1, 1], "t": [1, 2], "v": [-0.5, 0.5]}),
        ("0;0,5;go\n1;1,5;stop\n", ("t [ms]", "v", ""), {"t": [0, 1], "v": [0.5, 1.5]}),
        ("# lx ly\nSome text\n0,1\n1,2", ("t", "v"), {"t": [0, 1], "v": [1, 2]}),
        ("t,v\n0,1\n", ("t", "v"), {"t": [0], "v": [1]}),
    ],
)
def test_names_of_columns_without_a_header(
    tmp_path: Path, text: str, names: tuple[str, ...], arrays: dict[str, list[float]]
) -> None:
    assert arrays_of([read(table(tmp_path / "a.csv", text), named(*names))]) == arrays


@pytest.mark.parametrize(
    ("text", "wanted", "place", "words"),
    [
        ("0,1\n1,2\n", ALL, (1, 1), "holds numbers, not names"),
        ("\n# by me\n1 2 0.5\n1 3 0.7\n", ALL, (3, 1), "holds numbers, not names"),
        ("0,0.5,go\n1,0.6,stop\n", ALL, (1, 1), "holds numbers, not names"),
        ("2026-01-01T00:00:00;0,5\n2026-01-01T00:00:01;0,6\n", ALL, (1, 1), "holds numbers, not names"),
        ("0,1\n1,2\n", named("t", "v", "w"), None, "2 numbers, --columns names 3 columns"),
        ("t,v\n0,1\n", named("v", "t"), (1, 1), "names its columns itself: t, v"),
        ("t,v\n0,1\n1,2,3\n2\n3,4\n", V, (3, 1), "this line has 3 cells, the header names 2 columns"),
        ("t,v\n0,5,1,5\n", V, (2, 1), "this line has 4 cells"),
        ('t,v,m\n0,1,"a\nb"\n1,x,\n', V, (4, 3), "`x` is not a number"),
        ("t v\n0 1\n 1   x\n", V, (3, 6), "`x` is not a number"),
        ("t,v\n0,1\n1,2\nt,v\n0,1\n", V, (4, 3), "`v` is not a number"),
        ("t,v\n0,1_0\n", V, None, ""),
        ("t;v\n0;1\n1;1,234.5\n", V, (3, 3), "`1,234.5` is not a number"),
        ('t,v,m\n0,1,"foo\n1,9,bar\n', V, (2, 1), "opens a quote that nothing closes"),
        ('t,v,m\n0,1,"foo\n1,9,bar\n2,1,"baz\n', V, (2, 1), "text behind closing quotes"),
        ("t,v\n", V, None, "no line of numbers"),
        ("# t,v\n# 0,1\n", V, None, "no line of numbers"),
        ("t,v\n0,1\0\n", V, None, "binary"),
        (gzip.compress(b"t,v\n0,1\n1,2\n", mtime=0)[:-9], V, None, "damaged"),
    ],
)
def test_refused(
    tmp_path: Path, text: str | bytes, wanted: Wanted, place: tuple[int, int] | None, words: str
) -> None:
    path = table(tmp_path / "a.csv", text)
    if not words:
        assert read(path, wanted).groups[0].arrays["v"].tolist() == ["1_0"]
        return
    with pytest.raises(TraceError) as caught:
        read(path, wanted)
    (finding,) = caught.value.diagnostics
    assert words in finding.message
    assert (finding.span and (finding.span.line, finding.span.column)) == place
    if place is not None and "--columns" not in finding.message:
        with pytest.raises(TraceError) as caught:
            list(chunks(path, 1, wanted))
        assert (finding.span.line, finding.span.column) == place


def test_how_many_more_lines_and_cells_are_wrong(tmp_path: Path) -> None:
    path = table(tmp_path / "a.csv", "t,v\n0\n" + "1,2,3\n" * 20_000)
    with pytest.raises(TraceError) as caught:
        read(path)
    assert [each.note for each in caught.value.diagnostics] == [
        ("20000 more lines with another number of cells",)
    ]


def test_columns_of_one_name(tmp_path: Path) -> None:
    found = read(table(tmp_path / "a.csv", "t,v,v [m/s],v#1\n0,1,2,3\n"))
    assert found.clashes == {"v": {"column 2": "v##1", "column 3": "v##2"}}
    assert arrays_of([found]) == {"t": [0], "v##1": [1], "v##2": [2], "v#1": [3]}
    path = table(tmp_path / "a.csv", "t,v,v\n0,1,oops\n")
    assert arrays_of([read(path, Wanted(frozenset({"v#1"})))]) == {"t": [0], "v#1": [1]}


def test_columns_that_are_not_read_refuse_nothing(tmp_path: Path) -> None:
    text = 't,v,id,w,q[0],q[1]\n0,1,1,2,5,6\n1,2,A3,oops,7,x\n2,3,4,"[1, 2]",8,\n'
    path = table(tmp_path / "a.csv", text)
    found = read(path, V)
    assert arrays_of([found]) == {"t": [0, 1, 2], "v": [1, 2, 3], "id": ["1", "A3", "4"]}
    assert found.others == ("w", "q[0]", "q[1]")
    assert "q[1]" not in read(path, Wanted(frozenset({"q[0]"}))).signals
    with pytest.raises(TraceError, match="`x` is not a number"):
        read(path, Wanted(frozenset({"q"})))
    with pytest.raises(TraceError, match="oops"):
        read(path)


@given(
    st.lists(
        st.lists(st.sampled_from(["1", "-2.5", "", "NA", '"4"', '"a\nb"', "# x"]), min_size=2, max_size=2)
    )
)
@settings(deadline=None, max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_pieces_are_the_whole(tmp_path: Path, rows: list[list[str]]) -> None:
    body = "".join(f"{k},{','.join(row)}\n" for k, row in enumerate(rows))
    path = table(tmp_path / "a.csv", f"t,v,w\n0,1,x\n{body}")
    for wanted in (Wanted(frozenset({"t"})), Wanted(frozenset({"w"}))):
        whole = str(arrays_of([read(path, wanted)]))
        assert all(str(arrays_of(list(chunks(path, n, wanted)))) == whole for n in (1, 2, 3))


def test_the_memory_of_chunks_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trace_table, "MAX_LINE", 1000)
    monkeypatch.setattr(trace_table, "_BLOCK", 100)
    path = table(tmp_path / "a.csv", f"{BASE}{'0' * 5000}")
    with pytest.raises(TraceError, match="a line of more than"):
        list(chunks(path, 1, V))


def test_a_packed_file_that_unpacks_to_much(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = table(tmp_path / "a.csv.gz", gzip.compress(b"t,v\n" + b"0,1\n" * 100_000))
    assert format_of(path).module == "csv"
    assert size(path) == 400_004
    monkeypatch.setattr(trace_table, "MAX_BYTES", 1000)
    with pytest.raises(TraceError, match="larger than"):
        read(path, V)
    assert sum(len(part.groups[0].arrays["v"]) for part in chunks(path, 40_000, V)) == 100_000
    assert format_of(tmp_path / "a.jsonl.gz").module == "jsonl"
    with pytest.raises(StlcError, match="cannot read"):
        read(tmp_path / "none.csv")


@pytest.mark.parametrize(
    "name", ["v", "q[0]", "a, b", 'say "go"', "=1+1", "2nd", "a;b", "x\ty", "time", "NA"]
)
def test_what_is_written_is_read_again(tmp_path: Path, name: str) -> None:
    path = tmp_path / "a.csv"
    write_csv(path, {"t": np.arange(3.0), name: np.array([1.0, np.nan, -np.inf])}, {name: "m/s"})
    found = read(path)
    assert (list(found.signals), found.units) == (["t", name], {name: "m/s"})
    np.testing.assert_array_equal(found.groups[0].arrays[name], [1.0, np.nan, -np.inf])


@pytest.mark.parametrize(
    ("head", "name", "unit"),
    [
        ("v [km/h]", "v", "km/h"),
        (" v (km/h) ", "v", "km/h"),
        ("v_[m]", "v", "m"),
        ("v_ [m]", "v_", "m"),
        ("q[0]", "q[0]", ""),
        ("q[0] [rad]", "q[0]", "rad"),
        ("f(x)", "f(x)", ""),
        ("p_RS_R_x [m]", "p_RS_R_x", "m"),
        ("t(s)", "t", "s"),
        ("", "", ""),
    ],
)
def test_split_head(head: str, name: str, unit: str) -> None:
    assert split_head(head) == (name, unit)
