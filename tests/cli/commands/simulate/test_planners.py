"""`stlc simulate SPEC --method PLANNER`: every planner deploys, and says so where it cannot."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from stlc.cli.framework.app import main
from stlc.registry import PLANNERS
from stlc.rundir import RunDir
from stlc.trace import Trace

ROOT = Path(__file__).parents[4]
SMALL = ["--seeds", "0", "--agents", "2", "--steps", "3", "--no-pictures"]
NEEDS = {"milp": "highspy"}


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.apart
@pytest.mark.parametrize("method", [name for name in PLANNERS.own if name != "policy"])
def test_every_planner_drives(method: str, capsys: pytest.CaptureFixture[str]) -> None:
    if method in NEEDS:
        pytest.importorskip(NEEDS[method])
    spec = str(ROOT / "specs/traffic.stl")
    assert main(["simulate", spec, "--method", method, *SMALL, "--json", "--fail-under", "0"]) == 0
    result = json.loads(capsys.readouterr().out)["result"]
    assert result["steps"] == 3
    run = RunDir.newest()
    assert main(["check", str(run.path / "trace.npz"), "--fail-under", "0"]) == 0
    trace = Trace.load(run.path / "trace.npz")
    assert len(next(iter(trace.data.values()))) == 2


@pytest.mark.parametrize(
    ("name", "method", "said"),
    [
        ("traffic", "mpc", "did you mean --method benchmarks/methods/planners/mpc.py"),
        ("ship_safe", "milp", "cannot encode cos"),
        ("traffic", "policy", "stlc simulate RUN"),
    ],
)
def test_a_planner_that_cannot_says_why_and_leaves_no_run(
    home: Path, name: str, method: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    if method in NEEDS:
        pytest.importorskip(NEEDS[method])
    assert main(["simulate", str(ROOT / f"specs/{name}.stl"), "--method", method, *SMALL]) == 2
    assert said in capsys.readouterr().err
    assert not (home / "runs").exists()
