"""Facts beside verdicts: in rows, JSON and JUnit, and what `--strict` makes of them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from stlc.cli.framework.app import main

GOLDEN = Path(__file__).resolve().parents[3] / "golden/check"
SPEC = """signal x [m]
signal y [m]
signal z [m]
const unused = 1

require first: x < 2 m
require answer: always (x > 10 m -> eventually[0 s, 1 s] y > 5 m)
require start: x > 10 m -> eventually[0 s, 1 s] y > 5 m
require past: historically[0 s, 1 s] x < 5 m
require part: always[0 s, 20 s] x < 5 m
require far: always x < 3000 m
require early: x < 3 m until y < 5 m
require held: y > 0 m release x < 4 m
require soon: always eventually[0 s, 2 s] z > 2 m
require whole: always (x > 0.5 m -> eventually[0 s, 5 s] (x < 0 m or y > 0 m))
"""


@pytest.fixture(autouse=True)
def _in_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("s.stl").write_text(SPEC)
    t = 0.1 * np.arange(601)
    columns = np.stack([t, np.sin(t), np.cos(t), np.full(601, 3.0)], 1)
    np.savetxt("l.csv", columns, delimiter=",", header="t,x,y,z", comments="", fmt="%.9g")


def run(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, str]:
    capsys.readouterr()
    code = main([*words])
    return code, capsys.readouterr().out


def found(capsys: pytest.CaptureFixture[str], *words: str) -> dict[str, Any]:
    result: dict[str, Any] = json.loads(run(capsys, *words, "--json")[1])["result"]
    return result


def test_the_golden_text(capsys: pytest.CaptureFixture[str], pytestconfig: pytest.Config) -> None:
    code, text = run(capsys, "check", "s.stl", "l.csv")
    assert code == 0
    path = GOLDEN / "facts.txt"
    if pytestconfig.getoption("--regenerate"):
        path.write_text(text, encoding="utf-8")
    assert text == path.read_text(encoding="utf-8")


def test_strict_counts_what_was_not_judged(capsys: pytest.CaptureFixture[str]) -> None:
    for name, code in {
        "first": 4,
        "answer": 4,
        "part": 4,
        "early": 4,
        "far": 0,
        "soon": 0,
        "whole": 0,
    }.items():
        assert run(capsys, "check", "s.stl", "l.csv", "--require", name)[0] == 0
        assert run(capsys, "check", "s.stl", "l.csv", "--require", name, "--strict")[0] == code, name
    text = run(capsys, "check", "s.stl", "l.csv", "--strict")[1]
    assert "not fully judged (--strict): first, answer, start, past, part, early, held\n" in text
    Path("s.stl").write_text(SPEC.replace("x < 2 m\n", "x < 2 m  # stlc: allow W711\n"))
    assert run(capsys, "check", "s.stl", "l.csv", "--require", "first", "--strict")[0] == 0


def test_json(capsys: pytest.CaptureFixture[str]) -> None:
    result = found(capsys, "check", "s.stl", "l.csv")
    rows = {row["name"]: row for row in result["requirements"]}
    assert rows["first"]["judged"] == {"first": 0.0, "last": 0.0, "of": 60.0}
    assert rows["part"]["judged"] == {"first": 0.0, "last": 20.0, "of": 60.0}
    assert (rows["whole"]["judged"], rows["whole"]["facts"]) == (None, [])
    (never, far) = rows["answer"]["facts"]
    assert (never["code"], never["count"], never["of"], never["unjudged"]) == ("W712", 0, 601, True)
    assert (far["code"], far["unjudged"]) == ("W714", False)
    assert [(fact["code"], fact["signal"]) for fact in result["facts"]] == [("W715", "z")]
    assert result["lint"] == ["W105", "W311"]


def test_junit(capsys: pytest.CaptureFixture[str]) -> None:
    for option, skipped in (("--strict", 7), ("--quiet", 0)):
        run(capsys, "check", "s.stl", "l.csv", "--junit", "j.xml", option)
        (suite,) = ElementTree.parse("j.xml").getroot()
        assert suite.get("skipped") == str(skipped)
        cases = {case.get("name"): case for case in suite.iter("testcase")}
        assert len(list(suite.iter("skipped"))) == skipped
        assert (
            cases["answer"].findtext("system-out", "").startswith("satisfied, never triggered (0 of 601)\n")
        )
        assert cases["whole"].find("system-out") is None
        assert suite.findtext("system-out") == "`z` is 3 m throughout"


def test_several_files_are_counted(capsys: pytest.CaptureFixture[str]) -> None:
    Path("m.csv").write_text(Path("l.csv").read_text())
    text = run(capsys, "check", "s.stl", "l.csv", "m.csv", "--require", "first", "--require", "answer")[1]
    assert (
        "requirement  violated in  inconclusive in  read in part in  never triggered in  other facts in"
        in text
    )
    assert "  answer" in text
    assert text.count("lint: 4 warnings: W105, W311; stlc lint s.stl") == 1
    text = run(capsys, "check", "s.stl", "l.csv", "m.csv", "--require", "soon")[1]
    assert "`z`: a signal that is constant, or stuck for a while, in 2 of 2 files" in text


def test_pieces_tell_what_was_read(capsys: pytest.CaptureFixture[str]) -> None:
    code, text = run(capsys, "check", "s.stl", "l.csv", "--chunk", "100", "--require", "part")
    assert code == 0
    assert "read 0 s to 20 s of 60 s" in text
    (row,) = found(capsys, "check", "s.stl", "l.csv", "--chunk", "100", "--require", "part")["requirements"]
    assert row["judged"] == {"first": 0.0, "last": 20.0, "of": 60.0}
    assert run(capsys, "check", "s.stl", "l.csv", "--chunk", "100", "--require", "part", "--strict")[0] == 4


def test_warnings_are_diagnostics(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", "s.stl", "l.csv", "--require", "first", "--map", "x=y"]) == 0
    assert "warning[W720]: `x` is read from `y`" in capsys.readouterr().err


def test_lint_tells_what_a_recording_does_not_test(capsys: pytest.CaptureFixture[str]) -> None:
    code, text = run(capsys, "lint", "s.stl", "--trace", "l.csv", "--ignore", "W714,W715")
    assert code == 0
    assert "fact[W711]: `first`: judged at 0 s only, of 60 s" in text
    assert "fact[W712]: `answer`: never triggered (0 of 601)\n --> s.stl:7:25" in text
    text = run(capsys, "lint", "s.stl", "--trace", "l.csv", "--format", "github", "--select", "W712")[1]
    assert text.startswith("::notice title=W712,file=s.stl,line=7,")
    log = json.loads(
        run(capsys, "lint", "s.stl", "--trace", "l.csv", "--format", "sarif", "--select", "W7")[1]
    )
    assert {each["level"] for each in log["runs"][0]["results"]} == {"note"}
    assert run(capsys, "lint", "s.stl", "--trace", "none.csv")[0] == 3


@pytest.mark.parametrize(
    ("formula", "verdict"),
    [
        ("always[100 s, 200 s] x > 5 m", "inconclusive"),
        ("eventually[100 s, 200 s] x > 5 m", "inconclusive"),
        ("always@[100 s, 200 s] x > 5 m", "inconclusive"),
        ("always x < 3 m and always[100 s, 200 s] x > 5 m", "inconclusive"),
        ("always x < 0 m and always[100 s, 200 s] x > 5 m", "violated"),
        ("eventually (x > 0.9 m) or always[100 s, 200 s] x > 5 m", "satisfied"),
        ("always[0 s, 30 s] always[40 s, 50 s] x < 3 m", "satisfied"),  # cut, with samples
        ("x < 3 m until[100 s, 200 s] x > 5 m", "inconclusive"),
    ],
)
@pytest.mark.parametrize("options", [(), ("--chunk", "100"), ("--tolerance", "0"), ("--resample", "0.2s")])
def test_a_window_beyond_the_end_decides_nothing(
    capsys: pytest.CaptureFixture[str], formula: str, verdict: str, options: tuple[str, ...]
) -> None:
    Path("s.stl").write_text(f"signal x [m]\nrequire r: {formula}\n")
    result = found(capsys, "check", "s.stl", "l.csv", "--end", "truncate", *options)
    assert result["verdict"] == verdict
