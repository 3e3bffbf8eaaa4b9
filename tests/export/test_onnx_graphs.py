"""The graphs say what the task says, about promises, mirrors, angles and everything that steps."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.exported import CART, exported, mission, untrained
from helpers.onnx_graphs import computed

from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.backends.onnx import ops
from stlc.compile.backends.onnx.graph import BATCH, OnnxGraph
from stlc.compile.backends.onnx.ops import ONNX
from stlc.compile.backends.torch.ops import TORCH
from stlc.compile.ir import nodes as ir
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.dynamics.model.rollout import Stepper
from stlc.dynamics.model.step import ModelStep
from stlc.export.onnx_graphs import columns_of, deciding, judged, judging, rollout
from stlc.export.verify import previous_plan_agreement, same_verdicts
from stlc.registry import INTEGRATORS
from stlc.runtime.facts import read_facts
from stlc.runtime.graphs import Graphs


@pytest.mark.apart
def test_promises_deepen_as_the_task_says() -> None:
    run, folder = mission()
    x = run.task.sample(80, seed=1, dtype=torch.float64)
    x[:, 0] = torch.linspace(-1.0, 1.0, 80)
    x[:, 1] = torch.linspace(0.6, -0.6, 80).roll(20)
    plans = torch.zeros(80, run.task.horizon, 1, dtype=torch.float64)
    goals, columns = run.task.pending_goals, run.task.judge(x, plans).columns
    wanted = goals.deepened(columns, TORCH)[0]
    graph = OnnxGraph()
    start = columns_of(graph.input("state", (BATCH, len(run.task.system.names))), run.task.system.names)
    given = graph.input("plan", (BATCH, run.task.horizon, 1))
    found = goals.deepened(judged(run.task, start, given).states, ONNX)
    said = computed({"deepened": found}, {"state": x.numpy(), "plan": plans.numpy()})["deepened"]
    assert said[0].tolist() == wanted.tolist()
    assert set(wanted.tolist()) == {True, False}
    assert same_verdicts(run.task, Graphs(read_facts(folder)), states=30) <= 1e-9


@pytest.mark.apart
def test_a_begun_plan_is_gone_on_with_where_the_guard_does() -> None:
    run, folder = mission()
    found = previous_plan_agreement(run.policy, Graphs(read_facts(folder)), states=100)
    assert found.plan <= 1e-5
    assert found.rho <= 1e-9


def test_what_a_mission_adds_moves_as_in_the_model() -> None:
    run, folder = mission()
    x = run.task.sample(20, seed=2, dtype=torch.float64)
    for _ in range(8):
        x = run.task.system.step(x, torch.full((20, 1), 3.0, dtype=torch.float64))
    _, said = Graphs(read_facts(folder)).decided(x.numpy())
    np.testing.assert_array_equal(said["added"], run.task.system.added_later(x))


def test_mirrors_and_angles_are_those_of_the_network(tmp_path: Path) -> None:
    system = CART.replace("{x: v, v: u}", "{x: v, v: 3 m/s^2 * sin(u / 1 m/s^2)}").replace(
        "range: [-8, 8]", "range: [-3, 4], squash: angle"
    )
    system += "policy: {observe: [x + 0.1 m, v * 2], mirror: {x: -x, v: -v, u: -u}}\n"
    spec = "spec cart\nsignal x [m]\nrequire near: always[0, T] abs(x) < 1 m\n"
    (tmp_path / "cart.yaml").write_text(system)
    (tmp_path / "near.stl").write_text(spec)
    run = untrained(tmp_path / "near.stl", tmp_path / "cart.yaml", tmp_path / "runs")
    x = run.task.sample(60, seed=3, dtype=torch.float64)
    assert set((x[:, 0] < 0).tolist()) == {True, False}
    wanted, verdict = run.plan_judged(x)
    found = computed(deciding(run.task, run.network), {"state": x.numpy()})
    np.testing.assert_allclose(found["plan"], wanted, rtol=0.0, atol=2e-6)
    np.testing.assert_allclose(found["rho"], verdict.rho, rtol=0.0, atol=1e-6)
    np.testing.assert_array_equal(found["safe"], np.full(60, np.inf))
    assert "added" not in found


@pytest.mark.parametrize("written_out", [True, False])
def test_every_stage_of_a_step_is_rolled(written_out: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ops, "UNROLLED_NODES", 10**9 if written_out else 0)
    x, y, z, u = (ir.Signal(name) for name in ("x", "y", "z", "u"))
    feeds = ir.Op("add", (ir.Op("mul", (y, z)), u))
    step = ModelStep(
        (("gain", ir.Op("sin", (u,))), ("fed", feeds)),
        {
            "x": ir.Op("add", (x, ir.Signal("gain"))),
            "y": ir.Op("sub", (ir.Signal("fed"), ir.Op("mul", (z, ir.Const(0.5))))),
            "z": ir.Op("mul", (y, ir.Const(0.25))),
            "w": ir.Op("mul", (x, x)),
            "c": ir.Const(4.0),
        },
    )
    graph = OnnxGraph()
    names = ("x", "y", "z", "w", "c", "s")
    start = {name: graph.input(name, (1, BATCH)) for name in names}
    controls = {"u": graph.input("u", (5, BATCH))}
    rng = np.random.default_rng(4)
    given = {name: rng.normal(size=(1, 9)) for name in names} | {"u": rng.normal(size=(5, 9))}
    moved = rollout(step, start, controls)
    assert ("Scan" in {node.op for node in graph.nodes}) != written_out
    found = computed({f"{name}*": value for name, value in moved.items()}, given)
    now = {name: given[name][0] for name in names}
    for k in range(6):
        for name in names:
            np.testing.assert_allclose(found[f"{name}*"][k], now[name], rtol=1e-12, atol=1e-12, err_msg=name)
        if k < 5:
            a, b, c, drive = now["x"], now["y"], now["z"], given["u"][k]
            later = {"x": a + np.sin(drive), "y": b * c + drive - 0.5 * c, "z": 0.25 * b, "w": a * a}
            now = {**now, **later, "c": np.full(9, 4.0)}


@pytest.mark.apart
def test_a_graph_takes_any_number_of_agents() -> None:
    run, _ = exported("traffic", "car")
    outputs = judging(run.task)
    for count in (1, 2, 33):
        x = run.task.sample(count, seed=5, dtype=torch.float64)
        plans = torch.ones(count, run.task.horizon, 1, dtype=torch.float64)
        found = computed(outputs, {"state": x.numpy(), "plan": plans.numpy()})
        np.testing.assert_allclose(found["rho"], run.task.judge(x, plans).rho, rtol=0.0, atol=1e-12)


@pytest.mark.apart
def test_changed_copies_are_judged_where_the_plan_of_some_agent_fails() -> None:
    run, _ = exported("traffic", "car")
    outputs = deciding(run.task, run.network)
    assert {node.op for node in outputs["plan"].graph.nodes} >= {"If"}
    x = run.task.sample(60, seed=6, dtype=torch.float64)
    proposed = run.policy.continuation(x)
    good = TOLERANCE.satisfied(run.task.judge(x, proposed).rho)
    assert set(good.tolist()) == {True, False}
    plans, judged = run.plan_judged(x)
    assert (plans != proposed)[~good].any()
    for rows in (slice(None), good, ~good, slice(0, 1)):
        found = computed(outputs, {"state": x[rows].numpy()})
        np.testing.assert_allclose(found["plan"], plans[rows], rtol=0.0, atol=1e-4)
        np.testing.assert_allclose(found["cost"], run.task.cost(judged)[rows], rtol=0.0, atol=1e-4)
    alone = computed(deciding(run.task, run.network, varied=False), {"state": x.numpy()})
    np.testing.assert_allclose(alone["plan"], proposed, rtol=0.0, atol=1e-4)


@pytest.mark.parametrize("substeps", [1, 6])
def test_a_step_of_many_parts_is_written_once(substeps: int) -> None:
    """Written out, a plan of 40 steps of RK4 with 6 substeps would be some ten thousand nodes."""
    angle, speed, push = (ir.Signal(name) for name in ("angle", "speed", "push"))
    pull = ir.Op("sub", (push, ir.Op("sin", (angle,))))
    state: dict[str, ir.Num] = {"angle": angle, "speed": speed}
    lets: list[tuple[str, ir.Num]] = []
    for part in range(substeps):
        rk4 = INTEGRATORS.get("rk4")
        moved = rk4(lambda at: {"angle": at["speed"], "speed": pull.substitute(at)}, state, 0.1 / substeps)
        lets += [(f"{name}#{part}", number) for name, number in moved.items()]
        state = {name: ir.Signal(f"{name}#{part}") for name in moved}
    step = ModelStep(tuple(lets), {name: state[name] for name in ("angle", "speed")})
    graph = OnnxGraph()
    start = {name: graph.input(name, (1, BATCH)) for name in ("angle", "speed")}
    states = rollout(step, start, {"push": graph.input("push", (40, BATCH))})
    assert len(graph.needed(list(states.values()))) < 30
    rng = np.random.default_rng(5)
    given = {
        "angle": rng.normal(size=(1, 4)),
        "speed": rng.normal(size=(1, 4)),
        "push": rng.normal(size=(40, 4)),
    }
    found = computed({f"{name}*": value for name, value in states.items()}, given)
    start = {name: given[name] for name in ("angle", "speed")}
    plain = Stepper(step).rollout(start, {"push": given["push"]}, 40, NUMPY)
    for name in start:
        np.testing.assert_allclose(found[f"{name}*"], plain[name], rtol=1e-12, atol=1e-12)
