"""The layout of findings, in text and in JSON."""

from __future__ import annotations

import json
import re
from textwrap import dedent

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stlc.cli.framework.render import MAX_COLUMNS, render_text
from stlc.diagnostics import Diagnostic, Fix
from stlc.jsontext import plain
from stlc.source import Source, Span

TEXT = "spec s\nconst T_total = 0 s\n\n\n\n\n\n\n\ndef red = tau % T_total <= T_red\n"
SOURCE = Source("specs/traffic.stl", TEXT)


def at(piece: str, source: Source = SOURCE, nth: int = 0) -> Span:
    start = -1
    for _ in range(nth + 1):
        start = source.text.index(piece, start + 1)
    return source.span(start, start + len(piece))


def shown(*diagnostics: Diagnostic) -> str:
    return render_text(diagnostics, color=False)


def test_places_in_several_lines():
    finding = Diagnostic(
        "E401", "modulo by zero", at("T_total", nth=1), "is 0 s", (at("0 s").label("from here"),)
    )
    assert shown(finding) == dedent("""\
        error[E401]: modulo by zero
          --> specs/traffic.stl:10:17
           |
         2 | const T_total = 0 s
           |                 --- from here
           ...
        10 | def red = tau % T_total <= T_red
           |                 ^^^^^^^ is 0 s
           |
    """)


def test_places_in_one_line_and_all_advice():
    source = Source("a.stl", "require g: always[0, T] x < v")
    finding = Diagnostic(
        "E203",
        "cannot compare [m] with [m/s]",
        at("<", source),
        "",
        (at("x", source).label("[m], line 5"), at("v", source).label("[m/s], line 6")),
        help=("a time is missing:\n`x < v * 1 s`", "or drop the units"),
        note=("why",),
        fix=Fix(((at("v", source), "v * 1 s"),), "multiply by 1 s"),
    )
    assert shown(finding) == dedent("""\
        error[E203]: cannot compare [m] with [m/s]
         --> a.stl:1:27
          |
        1 | require g: always[0, T] x < v
          |                           ^
          |                         - [m], line 5
          |                             - [m/s], line 6
          |
          = help: a time is missing:
                  `x < v * 1 s`
          = help: or drop the units
          = fix: multiply by 1 s
          = note: why
    """)


def test_without_a_place():
    finding = Diagnostic("E602", "time is not uniform", help=("`--resample 0.1s`",))
    assert shown(finding) == "error[E602]: time is not uniform\n  = help: `--resample 0.1s`\n"


def test_several_findings_have_an_empty_line_between_them():
    finding = Diagnostic("W304", "off the grid")
    assert shown(finding, finding) == "warning[W304]: off the grid\n\nwarning[W304]: off the grid\n"
    assert shown() == ""


def test_another_file():
    system = Source("car.yaml", "time:\n  dt: 0.1 s\n")
    finding = Diagnostic("E104", "differs", at("0 s"), labels=(at("0.1 s", system).label("here"),))
    assert shown(finding).splitlines()[1:] == [
        " --> specs/traffic.stl:2:17",
        "  |",
        "2 | const T_total = 0 s",
        "  |                 ^^^",
        " ::: car.yaml:2:7",
        "  |",
        "2 |   dt: 0.1 s",
        "  |       ----- here",
        "  |",
    ]


@pytest.mark.parametrize(
    ("line", "piece", "expanded", "indent", "width"),
    [
        ("\tx > 0", "x", "    x > 0", 4, 1),
        ("ab\tx > 0", "x", "ab  x > 0", 4, 1),
        ("a\tb\tc", "b\t", "a   b   c", 4, 4),
        ("漢字 x", "x", "漢字 x", 5, 1),
        ("x 漢字", "漢字", "x 漢字", 2, 4),
        ("e\u0301 x", "x", "e\u0301 x", 2, 1),
        ("a\x1b[31mb x", "x", "a␛[31mb x", 8, 1),
        ("a\u202eb x", "x", "a\ufffdb x", 4, 1),
        ("a\x7f x", "x", "a␡ x", 3, 1),
    ],
)
def test_tabs_wide_characters_and_controls(line, piece, expanded, indent, width):
    source = Source("a.stl", line)
    rows = shown(Diagnostic("E001", "m", at(piece, source))).splitlines()
    assert rows[3] == f"1 | {expanded}"
    assert rows[4] == f"  | {' ' * indent}{'^' * width}"


def test_no_text_of_a_file_steers_the_terminal():
    source = Source("\x1b[2J.stl", "\x9b31m x")
    finding = Diagnostic(
        "E001", "a\x07b", source.span(0, 1), "\x1b", (source.span(5, 6).label("\r"),), ("\x08",)
    )
    text = shown(finding)
    assert not re.search(r"[\x00-\x09\x0b-\x1f\x7f-\x9f]", text)


def test_a_place_at_the_end_of_a_line_has_a_caret():
    source = Source("a.stl", "x >\ny")
    rows = shown(Diagnostic("E010", "m", source.span(3, 3), "here")).splitlines()
    assert rows[4] == "  |    ^ here"
    assert shown(Diagnostic("E010", "m", Source("a", "").span(0, 0))).splitlines()[3:5] == ["1 |", "  | ^"]


def test_a_place_over_several_lines_is_marked_in_its_first():
    source = Source("a.stl", "abc def\nghi\n")
    rows = shown(Diagnostic("E010", "m", source.span(4, 11))).splitlines()
    assert rows[3:] == ["1 | abc def", "  |     ^^^", "  |"]


def test_a_carriage_return_is_not_shown():
    source = Source("a.stl", "x > 0\r\ny\r\n")
    assert shown(Diagnostic("E010", "m", source.span(4, 7))).splitlines()[3:5] == ["1 | x > 0", "  |     ^"]


def test_a_long_line_is_cut_around_the_place():
    source = Source("a.stl", "a" * 500 + " x " + "b" * 500)
    rows = shown(Diagnostic("E010", "m", at("x", source), "here")).splitlines()
    assert rows[3].startswith("1 | …a")
    assert rows[3].endswith("b…")
    assert len(rows[3]) <= MAX_COLUMNS + 6
    assert rows[3][rows[4].index("^")] == "x"


def test_colours_change_nothing_but_the_colour():
    finding = Diagnostic(
        "E401", "zero", at("T_total", nth=1), "is 0", (at("0 s").label("from"),), ("h",), ("n",)
    )
    colored = render_text([finding], color=True)
    assert "\x1b[1;31merror[E401]\x1b[0m" in colored
    assert re.sub(r"\x1b\[[\d;]*m", "", colored) == shown(finding)
    assert "\x1b" not in shown(finding)
    assert "\x1b[1;33mwarning" in render_text([Diagnostic("W304", "m")], color=True)


def test_json():
    finding = Diagnostic(
        "W304",
        "off the grid",
        at("0 s"),
        "here",
        (at("tau").label("there"),),
        ("do",),
        ("because",),
        Fix(((at("0 s"), "1 s"),), "round"),
    )
    value = plain(finding)
    here = {"start": {"line": 2, "column": 17}, "end": {"line": 2, "column": 20}}
    there = {"start": {"line": 10, "column": 11}, "end": {"line": 10, "column": 14}}
    assert value == {
        "code": "W304",
        "severity": "warning",
        "message": "off the grid",
        "file": "specs/traffic.stl",
        "range": here,
        "label": "here",
        "labels": [{"file": "specs/traffic.stl", "range": there, "text": "there"}],
        "help": ["do"],
        "note": ["because"],
        "fix": {
            "text": "round",
            "edits": [{"file": "specs/traffic.stl", "range": here, "replacement": "1 s"}],
        },
    }
    assert json.loads(json.dumps(value)) == value


def test_json_without_a_place():
    value = plain(Diagnostic("U102", "no file"))
    assert (value["file"], value["range"], value["fix"], value["severity"]) == (None, None, None, "error")


@given(st.text(max_size=80), st.data())
def test_every_text_and_place_can_be_shown(text, data):
    source = Source("a.stl", text)
    spans = []
    for _ in range(3):
        start = data.draw(st.integers(0, len(text)))
        spans.append(source.span(start, data.draw(st.integers(start, len(text)))))
    finding = Diagnostic("E001", "m", spans[0], "p", tuple(span.label("s") for span in spans[1:]))
    rows = shown(finding).splitlines()
    assert sum("^" in row and row.endswith(" p") for row in rows) >= 1
    assert json.dumps(plain(finding))
