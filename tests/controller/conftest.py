"""The traffic task, compiled once."""

from __future__ import annotations

from pathlib import Path

import pytest

from stlc.controller.problem.task import Task
from stlc.controller.training.config import TrainConfig
from stlc.controller.training.launch import Launch, open_folder
from stlc.dynamics.system import System
from stlc.files import read_source
from stlc.grammar.parser import parse
from stlc.rundir import RunDir

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="session")
def car_task() -> Task:
    """`specs/traffic.stl` with `examples/car.yaml`."""
    spec = parse(read_source(ROOT / "specs" / "traffic.stl"))
    return Task.of(spec, System.load(ROOT / "examples" / "car.yaml"))


@pytest.fixture
def car_run(car_task: Task, tmp_path: Path) -> RunDir:
    """The folder of a run that has not begun."""
    return open_folder(car_task, TrainConfig(steps=1), Launch(root=tmp_path / "runs", name="test"))
