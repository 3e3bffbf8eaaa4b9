"""A run keeps what its specification imports, and the functions that its system names."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch

from stlc.controller.problem.task import Task
from stlc.controller.run.run import Run
from stlc.controller.training.config import TrainConfig
from stlc.controller.training.launch import Launch, open_folder
from stlc.dynamics.system import System
from stlc.files import File
from stlc.grammar.spec import Spec

DATA = Path(__file__).parent.parent / "data"

SPEC = """
import "common/places.stl" as places
import std
extern fn hand(q: real[2]) -> real[2] [m]
signal a, b [rad]
require clear: always[0, T] hand([a, b]) not in places.post
require calm: always[0, T] std.response(a > 1, b > 1, 0 s)
"""


@pytest.fixture
def home(tmp_path: Path) -> Path:
    (tmp_path / "common").mkdir()
    (tmp_path / "common/places.stl").write_text("region post = circle([1, 1], 0.5)\n", encoding="utf-8")
    (tmp_path / "arm.stl").write_text(SPEC, encoding="utf-8")
    for name in ("arm.yaml", "arm_kinematics.py"):
        shutil.copy(DATA / name, tmp_path / name)
    return tmp_path


def test_a_run_stands_on_its_own(home: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    task = Task.of(Spec.parse(File(home / "arm.stl").read()), System.load(home / "arm.yaml"))
    folder = open_folder(task, TrainConfig(), Launch(root=tmp_path_factory.mktemp("runs")))
    x = torch.randn(200, 6, 2, generator=torch.Generator().manual_seed(0))
    wanted = task.robustness(x)
    shutil.rmtree(home)
    again = Run.task_in(folder)
    torch.testing.assert_close(again.robustness(x), wanted)
    assert (folder.path / "lib/common/places.stl").is_file()
    before = folder.hashes["spec_hash"]
    (folder.path / "lib/common/places.stl").write_text(
        "region post = circle([1, 1], 0.6)\n", encoding="utf-8"
    )
    assert folder.hashes["spec_hash"] != before
    assert not torch.equal(Run.task_in(folder).robustness(x), wanted)
