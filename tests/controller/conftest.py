"""The traffic task, compiled once, and a project in two folders."""

from __future__ import annotations

from pathlib import Path

import pytest

from stlc.controller.problem.task import Task
from stlc.controller.training.config import TrainConfig
from stlc.controller.training.launch import Launch, open_folder
from stlc.dynamics.system import System
from stlc.files import File
from stlc.grammar.spec import Spec
from stlc.rundir import RunDir

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="session")
def car_task() -> Task:
    """`specs/traffic.stl` with `examples/car.yaml`."""
    spec = Spec.parse(File(ROOT / "specs" / "traffic.stl").read())
    return Task.of(spec, System.load(ROOT / "examples" / "car.yaml"))


@pytest.fixture
def car_run(car_task: Task, tmp_path: Path) -> RunDir:
    """The folder of a run that has not begun."""
    return open_folder(car_task, TrainConfig(steps=1), Launch(root=tmp_path / "runs", name="test"))


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a specification and its system in a folder beside."""
    home = tmp_path / "project"
    (home / "specs").mkdir(parents=True)
    (home / "models").mkdir()
    car = (ROOT / "examples/car.yaml").read_text()
    (home / "models/base.yaml").write_text(car)
    (home / "models/car.yaml").write_text("extends: base.yaml\n")
    text = (ROOT / "specs/traffic.stl").read_text().replace('"../examples/car.yaml"', '"../models/car.yaml"')
    (home / "specs/drive.stl").write_text(text)
    (home / "specs/driving_rules.stl").write_text((ROOT / "specs/driving_rules.stl").read_text())
    monkeypatch.chdir(home)
    return home
