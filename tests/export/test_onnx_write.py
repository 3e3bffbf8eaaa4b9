"""Export as ONNX: files that describe themselves, of any task or with the reason why not."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import onnx
import pytest
import torch
from helpers.exported import exported, run_of, untrained, written

from stlc.diagnostics import MissingError, RunError, UsageError
from stlc.export.verify import SINGLE, same_verdicts
from stlc.export.write import export, precision_of
from stlc.runtime import Controller
from stlc.runtime.facts import read_facts
from stlc.runtime.graphs import Graphs

BENCHMARKS = [
    ("traffic", "car"),
    ("reach_n_avoid", "maze"),
    ("ship_safe", "ship_safe"),
    ("ship_track", "ship_track"),
    ("navigation", "rover"),
    ("manipulation", "panda"),
    ("patrol", "unicycle"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("spec", "system"), BENCHMARKS)
def test_every_benchmark_has_graphs(spec: str, system: str, tmp_path: Path) -> None:
    done = export(run_of(spec, system, tmp_path), "onnx", tmp_path / "out")
    assert done.agreement is not None
    assert done.agreement.rho <= 1e-9
    assert done.agreement.ties <= 1


@pytest.mark.slow
@pytest.mark.parametrize(("spec", "system"), BENCHMARKS)
def test_every_benchmark_has_graphs_in_float32(spec: str, system: str, tmp_path: Path) -> None:
    done = export(run_of(spec, system, tmp_path), "onnx", tmp_path / "out", "float32")
    assert done.agreement is not None


@pytest.mark.apart
def test_graphs_in_float32_hold_no_float64(tmp_path: Path) -> None:
    run = run_of("traffic", "car", tmp_path)
    done = export(run, "onnx", tmp_path / "out", "float32")
    assert done.agreement is not None
    assert 0.0 < done.agreement.rho <= SINGLE.rho
    assert json.loads((done.folder / "controller.json").read_text())["precision"] == "float32"
    for name in done.files:
        if name.endswith(".onnx"):
            assert "DOUBLE" not in onnx.printer.to_text(onnx.load(done.folder / name)).upper()
    controller, state = Controller.load(done.folder), run.task.sample(1, seed=2, dtype=torch.float64)
    decision = controller.decide(state[0].numpy())
    (wanted,) = run.policy.plan(state)
    assert decision.control == pytest.approx(wanted[0].numpy(), abs=1e-4)
    with pytest.raises(UsageError, match="float64"):
        precision_of("float32", "c")


@pytest.mark.apart
def test_the_files_say_what_they_are() -> None:
    run, done = written("traffic", "car")
    assert done.files == (
        "continue.onnx",
        "controller.json",
        "decide.onnx",
        "fall.onnx",
        "follow.onnx",
        "judge.onnx",
    )
    assert done.agreement is not None
    assert done.agreement.rho <= 1e-9
    assert done.latency is not None
    assert 0.0 < done.latency.median <= done.latency.p99
    beside = json.loads((done.folder / "controller.json").read_text())
    model = onnx.load(done.folder / "decide.onnx")
    inside = json.loads(next(each.value for each in model.metadata_props if each.key == "stlc"))
    digests = beside.pop("files")
    assert inside == beside
    assert set(digests) == set(done.files) - {"controller.json"}
    assert beside["controls"] == [
        {"name": "u", "unit": "m/s^2", "low": -10.0, "high": 10.0, "added": "", "initial": None}
    ]
    assert beside["states"][1]["unit"] == "m/s"
    assert beside["dt"] == run.task.system.dt
    assert [each.name for each in model.graph.input] == ["state"]
    assert [each.name for each in model.graph.output] == ["plan", "rho", "safe", "cost", "requirements"]


HAND = "import torch\n\n\ndef reach(q):\n    return torch.sin(q)\n"
CART = """stlc: 1
name: cart
time: {dt: 0.1 s, horizon: 4 steps}
state:
  x: {unit: m, range: [-2, 2]}
  v: {unit: m/s, range: [-2, 2]}
control:
  u: {unit: m/s^2, range: [-3, 3]}
flow: {x: v, v: u}
functions: {reach: {kind: python, target: "hand.py:reach"}}
init:
  mixture:
    - draw: {x: "uniform(-1, 1)", v: 0}
"""
NEAR = """extern fn reach(q: real) -> real[1]
signal x: real [m]
spec near
require close: always[0, T] reach(x / 1 m)[0] < 2
"""


def test_a_task_without_a_form_as_a_graph_says_why(tmp_path: Path) -> None:
    for name, text in {"hand.py": HAND, "cart.yaml": CART, "near.stl": NEAR}.items():
        (tmp_path / name).write_text(text)
    run = untrained(tmp_path / "near.stl", tmp_path / "cart.yaml", tmp_path / "runs")
    with pytest.raises(UsageError, match="reach"):
        export(run, "onnx", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_what_disagrees_is_not_handed_out(monkeypatch: pytest.MonkeyPatch) -> None:
    run, folder = exported("traffic", "car")
    graphs = Graphs(read_facts(folder))
    assert same_verdicts(run.task, graphs, states=4) <= 1e-9
    monkeypatch.setattr(run.task, "cost", lambda judged: judged.rho + 1e-3)
    with pytest.raises(RunError, match="does not do what the run does"):
        same_verdicts(run.task, graphs, states=4)


def test_without_the_package_the_way_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = run_of("traffic", "car", tmp_path)
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(MissingError, match="needs `onnx`") as caught:
        export(run, "onnx", tmp_path / "out")
    assert "[onnx]" in caught.value.diagnostics[0].help[0]


def test_a_plan_that_is_no_number_counts_as_violated() -> None:
    run, folder = exported("traffic", "car")
    graphs = Graphs(read_facts(folder))
    x = run.task.sample(3, seed=2, dtype=torch.float64)
    plans = torch.zeros(3, run.task.horizon, len(run.task.system.decl.controls), dtype=torch.float64)
    plans[0, 2, 0], plans[1, 0, 0] = torch.nan, torch.inf
    wanted = run.task.judge(x, plans)
    found, _ = graphs.judged(x.numpy(), plans.numpy())
    assert found.rho[:2].tolist() == found.safe[:2].tolist() == [-torch.inf, -torch.inf]
    torch.testing.assert_close(torch.from_numpy(found.each), wanted.requirements, rtol=0.0, atol=1e-12)


@pytest.mark.apart
def test_without_changed_copies_there_is_one_graph_less(tmp_path: Path) -> None:
    done = export(run_of("traffic", "car", tmp_path, varied=False), "onnx", tmp_path / "out")
    assert "continue.onnx" not in done.files
    assert done.agreement is not None
    assert done.agreement.rho <= 1e-9
