"""Every command and every exit code that it has."""

from __future__ import annotations

import io
import json
import sys
from pathlib import Path

import pytest

from stlc.cli.framework.app import main
from stlc.rundir import RunDir

GOOD = "signal x [m]\n\nrequire low: always[0 s, 0.2 s] x < 3 m\n"
UNCLEAR = "signal x [m]\nrequire low: always[0 s, 1 s] x < 3 m and x > 0 m\n"
BAD = "signal x [m]\nrequire low: always[0 s, 1 s] x <\n"
UNTYPED = "signal x [m]\n\nrequire low: always[0 s, 1 s] y < 3 m\n"


@pytest.fixture(autouse=True)
def _project(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    for name, text in {"good": GOOD, "unclear": UNCLEAR, "bad": BAD, "untyped": UNTYPED}.items():
        Path(f"{name}.stl").write_text(text)
    main(["init", "--example", "cart"])
    system = Path("systems/cart.yaml").read_text()
    Path("broken.yaml").write_text(system.replace("x: v", "x: w + 1"))
    Path("drive.csv").write_text("t,x\n0,1\n0.1,1\n0.2,1\n")
    Path("fails.csv").write_text("t,x\n0,1\n0.1,4\n0.2,1\n")
    Path("short.csv").write_text("t,x\n0,1\n0.1,1\n")
    Path("torn.csv").write_text("t,x\n0,1\n0.1\n")
    run = RunDir.create(Path("runs"), "cart", "first")
    run.update({"status": "finished", "spec": "cart", "seed": 1, "result": {"accuracy": 0.5, "seconds": 3.0}})
    other = RunDir.create(Path("runs"), "cart", "second")
    other.update({"status": "running", "spec": "cart", "seed": 2})
    capsys.readouterr()


CODES = {
    "lint": {
        0: ["good.stl", "unclear.stl"],
        1: ["unclear.stl", "--strict"],
        2: ["good.stl", "--select", "Q1"],
        3: ["untyped.stl"],
    },
    "lint: github": {
        0: ["good.stl", "--format", "github"],
        1: ["unclear.stl", "--strict", "--format", "github"],
        3: ["bad.stl", "--format", "github"],
    },
    "lint: sarif": {1: ["unclear.stl", "--strict", "--format", "sarif"], 3: ["bad.stl", "--format", "sarif"]},
    "lint: system": {
        0: ["specs/cart.stl", "-s", "systems/cart.yaml"],
        3: ["specs/cart.stl", "-s", "broken.yaml"],
    },
    "fmt": {0: ["good.stl", "--check"], 1: ["unclear.stl", "--check"], 2: ["none.stl"], 3: ["bad.stl"]},
    "fmt: diff": {0: ["good.stl", "--diff"], 1: ["unclear.stl", "--diff"], 3: ["bad.stl", "--diff"]},
    "explain": {0: ["E203"], 1: ["fails.csv", "--spec", "good.stl"], 2: ["E999"], 3: ["bad.stl"]},
    "explain: trace": {
        0: ["drive.csv", "--spec", "good.stl"],
        2: ["none.csv"],
        3: ["torn.csv", "--spec", "good.stl"],
        4: ["short.csv", "--spec", "good.stl"],
    },
    "compile": {0: ["specs/cart.stl"], 2: ["good.stl"], 3: ["specs/cart.stl", "-s", "broken.yaml"]},
    "check": {
        0: ["good.stl", "drive.csv"],
        1: ["good.stl", "fails.csv"],
        2: ["good.stl"],
        3: ["good.stl", "torn.csv"],
        4: ["good.stl", "short.csv"],
    },
    "plot": {
        0: ["drive.csv", "--spec", "good.stl"],
        2: ["drive.csv"],
        3: ["torn.csv", "--spec", "good.stl"],
        5: ["drive.csv", "--spec", "good.stl", "-o", "/proc/picture.svg"],
    },
    "init": {0: ["fresh"], 2: ["."], 5: ["/proc/fresh"]},
    "init --spec": {0: ["parking"], 2: ["always"], 3: ["parking", "--from", "broken.yaml"]},
    "init --system": {0: ["wagon"], 2: ["cart"], 5: ["/proc/wagon"]},
    "system show": {0: ["systems/cart.yaml"], 2: ["none.yaml"], 3: ["broken.yaml"]},
    "system check": {0: ["systems/cart.yaml", "--steps", "2"], 2: ["none.yaml"], 3: ["broken.yaml"]},
    "system list": {0: [], 2: ["--none"]},
    "runs": {0: [], 2: ["none"]},
    "runs list": {0: ["--sort", "acc"], 2: ["--sort", "none"]},
    "runs show": {0: ["first"], 2: ["none"]},
    "runs diff": {0: ["first", "first"], 1: ["first", "second"], 2: ["first", "none"]},
    "runs rm": {0: ["first"], 2: ["second"]},
    "schema": {0: [], 2: ["none"]},
    "doctor": {0: ["--quick"], 2: ["--none"]},
}


@pytest.mark.parametrize(
    ("words", "code"),
    [
        pytest.param([*command.split(":")[0].split(), *arguments], code, id=f"{command}-{code}")
        for command, cases in CODES.items()
        for code, arguments in cases.items()
    ],
)
def test_an_exit_code(words, code, capsys):
    assert main(words) == code
    said = capsys.readouterr()
    assert "Traceback" not in said.err + said.out
    if code in (2, 3, 5):
        assert "error" in said.err + said.out


def test_missing_packages_are_told(monkeypatch, capsys):
    monkeypatch.setattr("stlc.cli.commands.doctor._NEEDED", ("numpy", "no-such-package"))
    assert main(["doctor", "--quick"]) == 5
    assert "no-such-package" in capsys.readouterr().err
    monkeypatch.setattr("stlc.view.find_spec", lambda _: None)
    assert main(["plot", "drive.csv", "--spec", "good.stl"]) == 5


@pytest.mark.parametrize("command", ["lint", "fmt", "compile --show ast"])
def test_a_bug_is_told_as_one(command, monkeypatch, capsys):
    def fail(*_):
        raise ZeroDivisionError("oh")

    monkeypatch.setattr("stlc.files.File.read", fail)
    assert main([*command.split(), "good.stl"]) == 70
    assert "B001" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("command", "result"), [("lint", 0), ("fmt", 0), ("compile --show ast", 0), ("explain", 0)]
)
def test_the_standard_input(command, result, monkeypatch, capsys):
    stream = io.TextIOWrapper(io.BytesIO(GOOD.encode()))
    monkeypatch.setattr(sys, "stdin", stream)
    assert main([*command.split(), "-"]) == result
    out = capsys.readouterr().out
    if command == "fmt":
        assert out == GOOD


@pytest.mark.parametrize("option", ["--fix", "--watch"])
def test_the_standard_input_cannot_be_written(option, capsys):
    assert main(["lint", "-", option]) == 2
    assert "standard input" in capsys.readouterr().err


@pytest.mark.parametrize(
    "words", [["lint", "none.stl", "--format", "json"], ["compile", "none.stl", "--show=ast", "--json"]]
)
def test_json_by_another_option_holds_for_failures_too(words, capsys):
    assert main(words) == 2
    assert json.loads(capsys.readouterr().out)["diagnostics"][0]["code"] == "U102"
