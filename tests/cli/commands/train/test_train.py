"""`stlc train` at the command line: what it refuses, and how a run that was cut short is told."""

from __future__ import annotations

import json
import os
import re
import signal
from pathlib import Path

import pytest
from helpers.documents import misfits

from stlc.cli.commands.schema import load_schema
from stlc.cli.framework.app import main
from stlc.controller.training.learner import Trainer
from stlc.rundir import RunDir

ROOT = Path(__file__).parents[4]
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
    [
        ["--seed", "0"],
        ["--method", "gradient"],
        ["--lr", "1e-3"],
        ["--threads", "1"],
        ["--set", "T_red=3s"],
        ["--budget-clock", "processor"],
    ],
)
def test_what_a_resumed_run_cannot_change_is_refused(
    option: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["train", "--resume", "latest", *option, "--json"]) == 2
    (finding,) = json.loads(capsys.readouterr().out)["diagnostics"]
    assert finding["code"] == "R104"
    assert finding["message"].startswith(option[0])


@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, 130), pytest.param(signal.SIGTERM, 143, marks=pytest.mark.apart)]
)
def test_an_interrupted_run_is_saved_and_told(
    number: int, code: int, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    advance, asked = Trainer.advance, [number]

    def interrupted(self: Trainer) -> float:
        if asked:
            os.kill(os.getpid(), asked.pop())
        return advance(self)

    monkeypatch.setattr(Trainer, "advance", interrupted)
    few = ["--steps", "5", "--batch", "16", "--held-out", "40"]
    assert main([*TRAIN, *few, "--runs", "elsewhere", "--json"]) == code
    told = capsys.readouterr()
    document = json.loads(told.out)
    assert (document["ok"], document["exit_code"]) == (False, code)
    assert misfits(document, load_schema("train/1")) == []
    folder = RunDir.newest(Path("elsewhere"))
    assert document["result"]["run"] == folder.shown
    assert f"stlc train --resume {folder.shown}" in told.err
    assert folder.status == "interrupted"
    assert main(["train", "--resume", folder.shown, "--no-pictures"]) == 0
    assert re.search(rf"Next:  stlc (simulate|train --resume) {folder.shown} --b", capsys.readouterr().out)


def test_a_run_that_breaks_off_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_self: Trainer) -> float:
        raise OSError(28, "No space left on device", "ckpt")

    monkeypatch.setattr(Trainer, "advance", full)
    assert main([*TRAIN, "--steps", "5"]) == 5
    assert RunDir.newest().status == "failed"


@pytest.mark.parametrize(
    ("option", "code"),
    [
        (["--device", "meta"], 5),
        (["--device", "hpu"], 5),
        (["--device", "cuda:77"], 5),
        (["--method", "sac"], 2),
        (["--name", "a/b"], 2),
    ],
)
def test_what_is_refused_makes_no_run(
    option: list[str], code: int, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*TRAIN, "--steps", "5", *option]) == code
    assert "error[" in capsys.readouterr().err
    assert not Path("runs").exists()


@pytest.mark.parametrize("planned", [False, True])
def test_a_refused_continuation_leaves_the_run_as_it_was(
    planned: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    few = ["--steps", "3", "--batch", "16", "--held-out", "40", "--drives", "0", "--no-pictures"]
    simulated = ["simulate", *TRAIN[1:], "--method", "search", "--agents", "1", "--steps", "2"]
    assert main(simulated if planned else [*TRAIN, *few]) in (0, 1)
    folder = RunDir.newest()
    before = (folder.path / "run.json").read_bytes()
    assert main(["train", "--resume", folder.shown, "--steps", "9", "--device", "meta"]) == 5
    assert "there is no device `meta` here" in capsys.readouterr().err
    assert (folder.path / "run.json").read_bytes() == before


@pytest.mark.parametrize("killed", [False, pytest.param(True, marks=pytest.mark.apart)])
def test_a_continuation_that_breaks_off_before_its_first_step_has_failed(
    killed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    few = ["--steps", "3", "--batch", "16", "--held-out", "40", "--drives", "0", "--no-pictures"]
    assert main([*TRAIN, *few]) in (0, 1)
    folder = RunDir.newest()

    def broken(_self: Trainer) -> dict[str, str]:
        raise KeyboardInterrupt if killed else OSError(28, "No space left on device", "run.json")

    monkeypatch.setattr(Trainer, "torch_reasons", broken)
    assert main(["train", "--resume", folder.shown, "--steps", "9"]) == (130 if killed else 5)
    assert folder.status == ("interrupted" if killed else "failed")
