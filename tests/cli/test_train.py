"""`stlc train` at the command line: what it refuses, and how a run that was cut short is told."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from stlc.cli.app import main

ROOT = Path(__file__).parents[2]
TRAIN = [
    "train",
    str(ROOT / "specs/traffic.stl"),
    "--system",
    str(ROOT / "examples/car.yaml"),
    "--no-pictures",
]


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize(
    "options",
    [
        ["--seed", "-1"],
        ["--seed", str(2**64)],
        ["--lr", "0"],
        ["--lr", "-1"],
        ["--lr", "nan"],
        ["--lr", "inf"],
        ["--steps", "3", "--budget", "3s"],
    ],
)
def test_options_out_of_range_are_usage_errors_and_make_no_run(
    options: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    steps = [] if "--steps" in options else ["--steps", "1"]
    assert main([*TRAIN, *steps, *options, "--json"]) == 2
    document = json.loads(capsys.readouterr().out)
    assert [finding["code"] for finding in document["diagnostics"]] == ["U101"]
    assert options[0] in document["diagnostics"][0]["message"]
    assert not Path("runs").exists()


@pytest.mark.parametrize(
    "option",
    [["--seed", "0"], ["--method", "gradient"], ["--lr", "1e-3"], ["--threads", "1"], ["--set", "T_red=3s"]],
)
def test_what_a_resumed_run_cannot_change_is_refused(
    option: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["train", "--resume", "latest", *option, "--json"]) == 2
    (finding,) = json.loads(capsys.readouterr().out)["diagnostics"]
    assert finding["code"] == "R104"
    assert finding["message"].startswith(option[0])
