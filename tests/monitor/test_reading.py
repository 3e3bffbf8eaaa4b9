"""Statements of a specification about the files that are judged by it."""

from __future__ import annotations

from pathlib import Path

import pytest

import stlc
from stlc.cli.framework.app import main
from stlc.diagnostics import TraceError
from stlc.monitor.signals import reading_of
from stlc.trace import Reading

SPEC = """
enum Light { red, green }
signal light : Light from "Lamp"
signal on : bool
signal n : int
signal x [m]
require stop: always (light == red and on -> x < 1)
"""


def written(folder: Path, rows: str) -> Path:
    path = folder / "drive.csv"
    path.write_text("t,Lamp,on,n,x,note\n" + rows)
    return path


def test_kinds_and_words_are_those_of_the_declarations() -> None:
    reading = reading_of(stlc.parse(SPEC), Reading({"x": "px"}, 0.5))
    assert reading.kinds == {"Lamp": "enum", "on": "bool", "n": "int", "x": "real"}
    assert reading.words is not None
    assert dict(reading.words["Lamp"]) == {"red": 0, "green": 1}
    assert (reading.words["on"]["yes"], reading.words["x"]) == (1.0, {})
    assert (dict(reading.names), reading.resample) == ({"x": "px"}, 0.5)


@pytest.mark.parametrize(("x", "satisfied"), [("0.5", True), ("1.5", False)])
def test_the_library_reads_the_words_that_the_program_reads(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], x: str, satisfied: bool
) -> None:
    trace = written(tmp_path, f"0,green,no,1,2,fine\n1,red,yes,,{x},\n")
    spec = tmp_path / "lights.stl"
    spec.write_text(SPEC)
    assert stlc.Monitor(SPEC).check(trace).satisfied is satisfied
    assert stlc.Monitor(spec).check(str(trace)).satisfied is satisfied
    assert main(["check", str(spec), str(trace)]) == (0 if satisfied else 1)
    assert "VIOLATED" in capsys.readouterr().out or satisfied


def test_a_word_that_is_no_member_and_a_cell_that_is_missing(tmp_path: Path) -> None:
    monitor = stlc.Monitor(SPEC)
    with pytest.raises(TraceError, match=r"E603.*cannot be `blue`"):
        monitor.check(written(tmp_path, "0,green,no,1,2,\n1,blue,yes,1,0,\n"))
    assert monitor.check(written(tmp_path, "0,green,no,1,2,\n1,red,yes,1,,\n")).satisfied is None
    assert monitor.check(written(tmp_path, "0,green,no,1,2,\n1,,yes,1,2,\n")).satisfied is None


def test_a_signal_is_mapped_by_its_own_name_or_that_of_its_column() -> None:
    spec = stlc.parse('signal rpm from "engine speed"\nsignal p : real[2] from "q"\nrequire r: rpm < p[0]')
    for name in ("rpm", "engine speed"):
        assert reading_of(spec, Reading({name: "log.engine"})).names == {"engine speed": "log.engine"}
    assert reading_of(spec, Reading({"p[1]": "east"})).names == {"q[1]": "east"}
