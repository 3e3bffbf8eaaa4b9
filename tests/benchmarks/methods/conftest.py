"""The traffic task, compiled once."""

from __future__ import annotations

from pathlib import Path

import pytest

from stlc.controller.problem.task import Task

ROOT = Path(__file__).parents[3]


@pytest.fixture(scope="session")
def car_task() -> Task:
    """`specs/traffic.stl` with `examples/car.yaml`."""
    return Task.load(ROOT / "specs/traffic.stl", "car.yaml")
