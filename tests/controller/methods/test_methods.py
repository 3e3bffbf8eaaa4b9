"""Methods are files: found by name, read by schema and command line, judged, and opened again."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

import stlc.controller.methods as package
from stlc import Run, System
from stlc.cli.framework.app import main
from stlc.controller.policies.policy import ModelRollout, plan_judged
from stlc.controller.problem.task import Task
from stlc.controller.training.config import TrainConfig, resolve_config
from stlc.diagnostics import RunError, SystemFileError, UsageError
from stlc.registry import METHODS

ROOT = Path(__file__).parents[3]
SPEC, CAR = str(ROOT / "specs/traffic.stl"), str(ROOT / "examples/car.yaml")

COASTING = '''"""Coasting: the least force at every step, a planner that learns nothing."""

from stlc.controller.policies.policy import ModelRollout
from stlc.controller.training.config import base_config


class Coasting:
    def resolve(self, task, config):
        return base_config(task, config)

    def learner(self, task, config, **_):
        return None

    def load(self, task, run, config, device):
        low = task.system.control_low
        return ModelRollout(lambda x: low.to(x).expand(len(x), -1), task)


METHOD = Coasting()
'''


@pytest.fixture
def coasting(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A method more, in a file of its own."""
    (tmp_path / "methods").mkdir()
    (tmp_path / "methods" / "coasting.py").write_text(COASTING, encoding="utf-8")
    package.__path__.append(str(tmp_path / "methods"))
    monkeypatch.chdir(tmp_path)
    yield
    package.__path__.pop()
    METHODS._entries.pop("coasting", None)
    sys.modules.pop("stlc.controller.methods.coasting", None)


def test_the_default_comes_first_and_parts_of_methods_are_none() -> None:
    assert METHODS.names == ("guided", "gradient")
    assert all(METHODS.get(name).resolve is not None for name in METHODS)


def test_an_unknown_method_is_a_finding_with_a_way_out(car_task: Task) -> None:
    with pytest.raises(UsageError) as caught:
        resolve_config(car_task, TrainConfig(method="guide"))
    (finding,) = caught.value.diagnostics
    assert finding.message == "unknown method `guide`"
    assert finding.help == ("did you mean `guided`?  methods: guided, gradient",)
    with pytest.raises(SystemFileError):
        System.load(CAR, {"train.method": "guide"})


@pytest.mark.usefixtures("coasting")
def test_a_method_is_one_file(capsys: pytest.CaptureFixture[str]) -> None:
    assert METHODS.names == ("guided", "coasting", "gradient")
    assert System.load(CAR, {"train.method": "coasting"}).decl.train.method == "coasting"
    options = ["--method", "coasting", "--held-out", "40", "--drives", "4", "--no-pictures", "--json"]
    code = main(["train", SPEC, "--system", CAR, *options])
    document = json.loads(capsys.readouterr().out)
    result = document["result"]
    assert code == 0, document["diagnostics"]
    assert (result["steps"], result["held_out"]) == (0, 40)
    assert 0.0 < result["accuracy"] < 1.0
    assert {guard["guard"] for guard in result["closed_loop"]["guards"]} <= {"none", "paper", "full"}
    run = Run.open(result["run"])
    x = run.task.sample(5, seed=0, dtype=torch.float64)
    plans, judged = run.plan_judged(x)
    assert plans.shape == (5, run.task.horizon, 1)
    torch.testing.assert_close(judged.rho, run.task.judge(x, plans).rho)
    with pytest.raises(RunError, match="no network"):
        _ = run.network
    assert main(["train", "--resume", result["run"], "--no-pictures", "--json"]) == 0
    capsys.readouterr()


def test_an_actor_plans_along_the_model(car_task: Task) -> None:
    policy = ModelRollout(lambda x: 0.1 * x[:, :1], car_task)
    x = car_task.sample(4, seed=1, dtype=torch.float64)
    plans, _ = plan_judged(car_task, policy, x)
    path = car_task.rollout(x, plans)
    torch.testing.assert_close(plans, 0.1 * path[:, :-1, :1])


def test_names_are_known_without_torch() -> None:
    code = "import sys; from stlc.registry import METHODS; METHODS.names; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False).returncode == 0
