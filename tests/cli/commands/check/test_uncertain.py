"""`stlc check --uncertain`: texts, the document, exit codes, and what it refuses."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from stlc.cli.framework.app import main

ROOT = Path(__file__).parents[4]
GOLDEN = ROOT / "tests" / "golden" / "check"
SPEC = """signal x [m]
signal v [m/s]
signal m: bool
require near: always x < 2 m
require fast: eventually v > 3 m/s
require slow: always v < 1 m/s
require moving: always (m -> x > 0 m)
"""
TRACE = "t [s],x [m],v [m/s],m\n0,1.0,2.0,1\n0.1,1.5,2.5,0\n0.2,1.95,3.2,1\n0.3,1.0,3.05,1\n"


@pytest.fixture(autouse=True)
def _files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.stl").write_text(SPEC, encoding="utf-8")
    (tmp_path / "a.csv").write_text(TRACE, encoding="utf-8")
    monkeypatch.chdir(tmp_path)


def check(*arguments: str) -> int:
    return main(["check", "a.stl", "a.csv", *arguments])


def test_the_golden_text(capsys: pytest.CaptureFixture[str], pytestconfig: pytest.Config) -> None:
    assert check("--uncertain", "x=0.1m", "--uncertain", "v=2%") == 1
    text, path = capsys.readouterr().out, GOLDEN / "uncertain.txt"
    if pytestconfig.getoption("--regenerate"):
        path.write_text(text, encoding="utf-8")
    assert text == path.read_text(encoding="utf-8")


@pytest.mark.parametrize(("error", "code"), [("x=1cm", 0), ("x=0.1m", 4), ("v=50%", 0)])
def test_the_exit_code_is_the_verdict(error: str, code: int) -> None:
    assert check("--require", "near", "--uncertain", error) == code


def test_the_document(capsys: pytest.CaptureFixture[str]) -> None:
    assert check("--require", "near", "--uncertain", "x=10 cm", "--uncertain", "v=2%", "--json") == 4
    found = json.loads(capsys.readouterr().out)["result"]
    assert found["uncertain"] == {
        "x": {"absolute": 10.0, "relative": 0.0, "unit": "cm"},
        "v": {"absolute": 0.0, "relative": 0.02, "unit": ""},
    }
    assert found["verdict"] == "inconclusive"
    bounds = found["requirements"][0]["robustness"]
    assert (bounds["low"], bounds["high"]) == pytest.approx((-0.05, 0.15))


def test_several_traces_in_processes() -> None:
    files = ["a.stl", "a.csv", "b.csv"]
    Path("b.csv").write_text(TRACE.replace("1.95", "1.8"), encoding="utf-8")
    assert main(["check", *files, "--jobs", "2", "--require", "near", "--uncertain", "x=0.1m"]) == 4
    assert main(["check", *files, "--jobs", "2", "--require", "near", "--uncertain", "x=0.01m"]) == 0


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--uncertain", "y=1m"], "no signal `y`"),
        (["--uncertain", "x=1s"], "declared here"),
        (["--uncertain", "m=1"], "type bool has no error"),
        (["--uncertain", "x=far"], "is not an amount"),
        (["--uncertain", "x=1furlong"], "unknown unit"),
        (["--uncertain", "x"], "is not of the form SIGNAL=ERROR"),
        (["--uncertain", "x=1m", "--uncertain", "x=2m"], "given twice"),
        (["--uncertain", "x=1m", "--chunk", "2"], "needs the whole trace"),
        (["--uncertain", "x=1m", "--out", "r.npz"], "leave `--uncertain` out"),
        (["--uncertain", "x=1m", "--semantics", "agm"], "exact semantics only"),
    ],
)
def test_what_is_refused(capsys: pytest.CaptureFixture[str], options: list[str], words: str) -> None:
    assert check(*options) == 2
    assert words in capsys.readouterr().err


def test_streams_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", "a.stl", "-", "--uncertain", "x=1m"]) == 2
    assert "needs the whole trace" in capsys.readouterr().err
