from __future__ import annotations

import io
import json
import os

import pytest

from stlc.cli.framework import output
from stlc.cli.framework.output import (
    COLOR,
    Document,
    console,
    emit,
    say,
    show_diagnostics,
    table,
    wants_color,
)
from stlc.diagnostics import Diagnostic


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def color():
    """Set `--color`, and put the old mode back."""
    before = COLOR.get()
    yield COLOR.set
    COLOR.set(before)


def test_the_result_and_the_talk_take_different_ways(capsys):
    emit("the result")
    say("the talk")
    assert capsys.readouterr() == ("the result\n", "the talk\n")


def test_a_document_is_json_for_every_reader(capsys):
    Document("check/1", 1, result={"robustness": [float("-inf"), 0.5]}).print()
    document = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    assert document["result"] == {"robustness": ["-inf", 0.5]}
    assert list(document) == ["stlc", "schema", "ok", "exit_code", "diagnostics", "result"]


def test_no_findings_say_nothing(capsys):
    show_diagnostics(())
    show_diagnostics((Diagnostic("W304", "rounded"),))
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize(
    ("mode", "stream", "environment", "wanted"),
    [
        ("auto", Terminal(), {}, True),
        ("auto", io.StringIO(), {}, False),
        ("auto", Terminal(), {"NO_COLOR": "1"}, False),
        ("auto", Terminal(), {"NO_COLOR": ""}, True),
        ("auto", Terminal(), {"TERM": "dumb"}, False),
        ("always", io.StringIO(), {"NO_COLOR": "1"}, True),
        ("never", Terminal(), {}, False),
    ],
)
def test_when_there_is_color(color, monkeypatch, mode, stream, environment, wanted):
    monkeypatch.setenv("TERM", "xterm")
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    color(mode)
    assert wants_color(stream) is wanted


@pytest.mark.parametrize("mode", ["always", "never"])
def test_the_console_obeys(color, monkeypatch, capsys, mode):
    monkeypatch.setenv("TERM", "xterm-256color")
    color(mode)
    console().print("done", style="bold red")
    out = capsys.readouterr().out
    assert ("\x1b[" in out) is (mode == "always")
    assert "done" in out


def test_the_console_takes_brackets_literally_and_never_wraps_a_pipe(capsys):
    line = " ".join(["always[0, T]"] * 30)
    console().print(line)
    assert capsys.readouterr().out == line + "\n"


def test_a_letter_that_the_terminal_lacks_is_replaced(monkeypatch):
    raw = io.BytesIO()
    monkeypatch.setattr(output.sys, "stdout", io.TextIOWrapper(raw, encoding="ascii"))
    emit("0.1 ± 0.2")
    assert raw.getvalue() == b"0.1 ? 0.2" + os.linesep.encode()


def test_a_table_is_aligned():
    text = table(
        [("no_collision", "satisfied", "+0.4"), ("give_way", "violated", "-12.25")],
        header=("", "verdict", ""),
    )
    assert text.splitlines() == [
        "                verdict",
        "  no_collision  satisfied    +0.4",
        "  give_way      violated   -12.25",
    ]
    assert table([]) == ""


def test_numbers_of_every_notation_are_aligned_to_the_right():
    cells = ("+1,000.000 m", "+2.0e-05 m", "+2.8e-04", "-inf", "+.5", "boundary", "[-1.000, +inf]", "-one m")
    lines = table([(cell, "at") for cell in cells], indent="").splitlines()
    assert [line.index("at") for line in lines] == [16] * len(cells)
    assert [line[0] == " " for line in lines] == [True] * 5 + [False] * 3
