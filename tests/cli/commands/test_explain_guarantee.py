"""`stlc explain RUN --guarantee`: probabilities and their assumptions."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from helpers.documents import misfits

from stlc.cli.commands.schema import load_schema
from stlc.cli.framework.app import main
from stlc.controller.problem.task import Task
from stlc.controller.training.config import TrainConfig
from stlc.controller.training.launch import Launch, open_folder
from stlc.dynamics.system import System
from stlc.files import File
from stlc.grammar.spec import Spec

ROOT = Path(__file__).parents[3]


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A run of ship_safe that has not begun: the guarantee is of the grid, not of the policy."""
    monkeypatch.chdir(tmp_path)
    spec = Spec.parse(File(ROOT / "specs" / "ship_safe.stl").read())
    task = Task.of(spec, System.load(ROOT / "examples" / "ship_safe.yaml"))
    return open_folder(task, TrainConfig(steps=1), Launch(root=tmp_path / "runs")).path


@pytest.mark.usefixtures("run")
def test_the_newest_run_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["explain", "--guarantee"]) == 0
    out = capsys.readouterr().out
    assert "the backup policy tries 3 of thrust in [-0.5, 0.5], 3 of rudder in [-3, 3]" in out
    assert "with equal probability" in out
    (line,) = [line for line in out.splitlines() if "T0=1" in line]
    assert line.split()[-2:] == ["0.16", "0.25"]


def test_as_json(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["explain", str(run), "--guarantee", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert misfits(document, load_schema("explain/1")) == []
    chances = document["result"]["chances"]
    assert [each["candidates"] for each in chances if each["radius"] == 0.1] == [9, 81, 729]


@pytest.mark.usefixtures("run")
def test_what_is_no_run(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["explain", "0099", "--guarantee"]) == 2
    assert "0099" in capsys.readouterr().err
