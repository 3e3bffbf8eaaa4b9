"""Evidence of results, and their repetition from a stored result."""

from __future__ import annotations

import json
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import Any

import pytest

from stlc.cli.commands.check.evidence import Repetition
from stlc.cli.commands.check.options import Judging
from stlc.cli.framework.app import main

SPEC = """import "part.stl" as part
signal x
const limit = part.limit
@id("R1")
require r: always x < limit
require s: always x > -1
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "part.stl").write_text("const limit = 3.5\n")
    (tmp_path / "a.stl").write_text(SPEC)
    (tmp_path / "a.csv").write_text("time_ms,x\n0,1\n1000,2\n2000,3\n")
    return tmp_path


def stored(capsys: pytest.CaptureFixture[str], *words: str) -> dict[str, Any]:
    main(["check", "a.stl", *words, "--json"])
    text = capsys.readouterr().out
    Path("result.json").write_text(text)
    found: dict[str, Any] = json.loads(text)["result"]
    return found


def test_a_result_says_what_it_was_made_from(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = stored(capsys, "a.csv", "--set", "limit=4", "--resample", "0.5s", "--require", "r")
    evidence = found["evidence"]
    files = {each["path"]: each["sha256"] for each in (evidence["trace"], *evidence["inputs"])}
    assert files == {
        name: sha256((folder / name).read_bytes()).hexdigest() for name in ("a.csv", "a.stl", "part.stl")
    }
    assert evidence["options"]["--resample"] == ["0.5s"]
    assert evidence["options"]["--set"] == ["limit=4"]
    assert [(each["name"], each["unit"], each["why"]) for each in found["clocks"]] == [
        ("time_ms", "ms", "its unit is stated")
    ]
    assert found["requirements"][0]["id"] == "R1"


@pytest.mark.parametrize(
    "words",
    [
        ("a.csv",),
        ("a.csv", "--set", "limit=2"),
        ("a.csv", "--resample", "0.25s", "--between", "x=hold", "--at", "all", "--tolerance", "0"),
        ("a.csv", "--clock", "time_ms:ms", "--require", "s", "--uncertain", "x=10%", "--strict"),
        ("a.csv", "b.csv"),
    ],
)
def test_a_result_can_be_repeated(
    words: tuple[str, ...], folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "b.csv").write_text("t,x\n0,1\n1,9\n")
    stored(capsys, *words)
    assert main(["check", "--again", "result.json"]) == 0
    assert "the same result as result.json" in capsys.readouterr().out


def test_another_result_is_told(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = stored(capsys, "a.csv")
    text = (folder / "result.json").read_text()
    (folder / "result.json").write_text(text.replace('"satisfied"', '"violated"'))
    assert main(["check", "--again", "result.json"]) == 1
    assert 'r: verdict "violated" then, "satisfied" now' in capsys.readouterr().out
    assert Repetition(folder / "result.json").differences([found])


@pytest.mark.parametrize("name", ["a.csv", "a.stl", "part.stl"])
def test_a_changed_file_is_told(name: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    stored(capsys, "a.csv")
    with (folder / name).open("a") as stream:
        stream.write("\n")
    assert main(["check", "--again", "result.json"]) == 2
    assert f"`{name}` has changed since" in capsys.readouterr().err
    (folder / name).unlink()
    assert main(["check", "--again", "result.json"]) == 2
    assert "is not here" in capsys.readouterr().err


def _with(change: Callable[[dict[str, Any]], object]) -> Callable[[str], str]:
    def changed(text: str) -> str:
        read = json.loads(text)
        change(read["result"])
        return json.dumps(read)

    return changed


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: text[:50],
        lambda _: "[" * 100_000,
        lambda _: "[]",
        lambda _: '{"result": {"files": 3}}',
        _with(lambda result: result.pop("evidence")),
        _with(lambda result: result["evidence"].pop("options")),
        _with(lambda result: result["evidence"]["options"].update({"--out": ["x.csv"]})),
        _with(lambda result: result["evidence"]["options"].update({"--set": "limit=3"})),
        _with(lambda result: result["evidence"]["options"].update({"--tolerance": ["x"]})),
        _with(lambda result: result["evidence"]["trace"].update(path="/dev/zero")),
        _with(lambda result: result["evidence"].update(trace=3)),
        _with(lambda result: result.update(files=[1])),
    ],
)
def test_damaged_results_are_refused(
    damage: Callable[[str], str], folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stored(capsys, "a.csv")
    path = folder / "result.json"
    path.write_text(damage(path.read_text()))
    assert main(["check", "--again", "result.json"]) == 2
    assert "error[U10" in capsys.readouterr().err


def test_options_come_back_from_their_words() -> None:
    options = Judging(
        spec=Path("a.stl"),
        map_=["x=col a"],
        resample="100ms",
        between=["x=hold:0.5s", "y=angle"],
        clock="frame:frames",
        fps=25.0,
        uncertain=["x=0.1m", "y=2%"],
        strict=True,
    )
    assert options.words() == {
        "--spec": ("a.stl",),
        "--map": ("x=col a",),
        "--resample": ("100ms",),
        "--between": ("x=hold:0.5s", "y=angle"),
        "--clock": ("frame:frames",),
        "--fps": ("25.0",),
        "--uncertain": ("x=0.1m", "y=2%"),
        "--end": ("open",),
        "--tolerance": ("1e-06",),
        "--semantics": ("exact",),
        "--strict": ("",),
    }
    assert Judging.from_words(options.words()) == options
