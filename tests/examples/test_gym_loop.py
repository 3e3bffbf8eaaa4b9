"""The example that drives an environment runs, and drives with the controller's decisions."""

from __future__ import annotations

import importlib.util
import runpy
import sys

import pytest
from helpers.exported import ROOT, exported

from stlc.gym import make
from stlc.runtime import Controller

pytestmark = pytest.mark.apart  # worlds of the examples: their own programs

PATH = ROOT / "examples" / "gym_loop.py"
SPEC = str(ROOT / "specs" / "traffic.stl")


@pytest.mark.apart
def test_the_program_runs(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    _, folder = exported("traffic", "car")
    monkeypatch.setattr(sys, "argv", [str(PATH), str(folder), SPEC, "--episodes", "2", "--guard", "paper"])
    runpy.run_path(str(PATH), run_name="__main__")
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in lines] == ["seed 0", "seed 1"]
    assert all("satisfied" in line or "violated" in line for line in lines)


def test_an_episode_is_that_of_the_decisions() -> None:
    spec = importlib.util.spec_from_file_location("gym_loop", PATH)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["gym_loop"] = module
    spec.loader.exec_module(module)
    run, folder = exported("traffic", "car")
    controller, env = Controller.load(folder), make(SPEC)
    found = module.drive(controller, env, seed=4)
    controller.reset()
    _, info = env.reset(seed=4)
    for _ in range(run.task.horizon):
        _, _, over, _, info = env.step(controller.decide(info["state"]).control)
    assert over
    assert found.robustness == pytest.approx(info["rho"])
    assert sum(found.rules.values()) == run.task.horizon
