"""The tasks of `examples/tasks`: they compile, known plans satisfy them, and training comes to drive them."""

from __future__ import annotations

import json
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from examples.test_plants import PLANTS
from helpers.tools import load_tool

from stlc.cli.framework.app import main
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.problem.task import Task
from stlc.controller.run.run import Run
from stlc.dynamics.system import System
from stlc.files import File
from stlc.grammar.spec import Spec
from stlc.lint.lint import lint
from stlc.monitor.verdict import Monitor
from stlc.rundir import RunDir

ROOT = Path(__file__).resolve().parents[2]
TASKS = ROOT / "examples" / "tasks"
NAMES = sorted(json.loads((ROOT / "tests" / "data" / "task_plans.json").read_text()))
PLANS: dict[str, Any] = json.loads((ROOT / "tests" / "data" / "task_plans.json").read_text())
"""For each task a start and the controls of a whole mission, found by exploration."""
DRIVES, ENOUGH, AGREEMENT = 200, 0.95, 0.05
"""Fresh drives; the least share of them that satisfies a task; how far off the reported share may be."""


def task(name: str) -> Task:
    return Task.of(Spec.parse(File(TASKS / f"{name}.stl").read()), System.load(TASKS / f"{name}.yaml"))


def test_every_task_has_a_system_a_plan_and_a_row() -> None:
    assert {path.stem for path in TASKS.glob("*.yaml")} == {*PLANS, *PLANTS}
    table = (TASKS / "README.md").read_text()
    assert all(f"`{name}`" in table for name in (*NAMES, *PLANTS))


@pytest.mark.parametrize("name", NAMES)
def test_a_task_compiles_and_nothing_is_to_be_said(name: str) -> None:
    found = task(name)
    assert found.compiled.timers
    assert not lint(File(TASKS / f"{name}.stl").read())


@pytest.mark.apart
@pytest.mark.parametrize("name", NAMES)
def test_a_known_plan_satisfies_the_task(name: str) -> None:
    found = task(name)
    start = torch.tensor([PLANS[name]["start"][column] for column in found.plain.names], dtype=torch.float64)
    x0 = found.sample(1, seed=0, dtype=torch.float64)[0]
    x0[: len(start)] = start
    controls = torch.tensor(PLANS[name]["controls"], dtype=torch.float64)
    low, high = found.system.control_low - 1e-6, found.system.control_high + 1e-6
    assert bool(((controls >= low) & (controls <= high)).all())
    path = found.rollout(x0[None], controls[None])[0].numpy()
    spec = Spec.parse(File(TASKS / f"{name}.stl").read())
    horizon = Fraction(found.system.decl.horizon) * found.system.decl.dt
    monitor = Monitor(spec, dt=found.system.decl.dt, horizon=horizon)
    driven = {column: values[None] for column, values in zip(found.system.names, path.T, strict=True)}
    assert np.all(monitor.check(driven).robustness >= -TOLERANCE)
    still = found.rollout(x0[None], torch.zeros_like(controls)[None])[0].numpy()
    driven = {column: values[None] for column, values in zip(found.system.names, still.T, strict=True)}
    assert np.all(monitor.check(driven).robustness < 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted((*NAMES, *PLANTS)))
def test_a_minute_of_training_satisfies_the_task(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With the guard that training recommends, and as often as it reports."""
    budget = ["--budget", "60s", "--budget-clock", "processor", "--threads", "1", "--seed", "1"]
    words = ["train", str(TASKS / f"{name}.stl"), *budget, "--no-pictures", "--runs", str(tmp_path)]
    assert main([*words, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)["result"]["closed_loop"]
    (run,) = RunDir.every(tmp_path)
    assert told["recommended"] is not None, told
    satisfied, drives = load_tool("fresh_drives").fresh_drives(
        Run.open(run.path), told["recommended"], DRIVES
    )
    share = satisfied / drives
    with capsys.disabled():
        print(name, told["recommended"], told["share"], told["interval"], share)  # noqa: T201
    assert share >= ENOUGH
    assert abs(share - told["share"]) <= AGREEMENT
