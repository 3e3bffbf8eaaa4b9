"""A feedback beneath the plans: the law, its gain, and everything that plans with it."""

from __future__ import annotations

import json
import math
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg
import torch
from dynamics.model.test_motion_in_c import agree
from helpers.exported import untrained

from stlc.controller.deployment.batched import Setting, Worlds
from stlc.controller.problem.task import Task
from stlc.controller.world import world_type
from stlc.diagnostics import SystemFileError
from stlc.dynamics.load import load_system_decl
from stlc.dynamics.model.feedback import growth_of, linearised, riccati, unstable
from stlc.dynamics.scenario import truth, under
from stlc.dynamics.system import System
from stlc.export.write import export
from stlc.grammar.spec import Spec
from stlc.native import compiler
from stlc.runtime import Controller
from stlc.source import Source

Make = Callable[..., System]
F64 = torch.float64

ONE = """stlc: 1
name: one
time: {{dt: 0.1 s, horizon: 20 steps}}
state:
  x: {{unit: m, range: [-1, 1]}}
control:
  u: {{unit: m/s, range: [-6, 8]}}
flow: {{x: "4 / (1 s) * x + u"}}
init: {{mixture: [{{draw: {{x: "uniform(-1, 1)"}}}}]}}
objective: {{terms: [{{name: work, weight: 1, expr: "u * u / (1 m/s) / (1 m/s)"}}]}}
policy: {{{policy}}}
scenario:
  wrong: {{errors: {{actuator_gain: 20 %}}}}
"""
POLE = """stlc: 1
name: pole
time: {dt: 0.05 s, horizon: 40 steps, integrator: rk4}
const: {g: 9.8 m/s^2, l: 0.5 m, m: 0.1 kg, M: 1 kg}
state:
  p: {unit: m, range: [-3, 3]}
  v: {unit: m/s, range: [-4, 4]}
  a: {unit: rad, range: [-0.8, 0.8]}
  w: {unit: rad/s, range: [-4, 4]}
  far: {unit: m, range: [0, 3], role: env}
control:
  f: {unit: N, range: [-10, 10]}
def:
  pull: (f + m * l * w * w * sin(a)) / (m + M)
  turn: (g * sin(a) - cos(a) * pull) / (l * (4 / 3 - m * cos(a) * cos(a) / (m + M)))
flow:
  p: v
  v: pull - m * l * turn * cos(a) / (m + M)
  a: w
  w: turn
init: {mixture: [{draw: {p: 0, v: 0, a: "uniform(-0.2, 0.2)", w: 0, far: 1}}]}
policy: {feedback: {weights: {a: 4}}}
"""
HOVER = """stlc: 1
name: hover
time: {dt: 0.1 s, horizon: 10 steps}
state:
  h: {unit: m, range: [0, 10]}
  v: {unit: m/s, range: [-5, 5]}
control:
  thrust: {unit: N, range: [0, 20]}
flow: {h: v, v: "thrust / (1 kg) - 9.8 m/s^2 - 0.5 / (1 s) * v"}
init: {mixture: [{draw: {h: "uniform(0, 5)", v: 0}}]}
policy: {feedback: lqr}
"""


@pytest.fixture
def make(tmp_path: Path) -> Make:
    """A system from its text, in a file."""

    def build(text: str) -> System:
        (tmp_path / "plant.yaml").write_text(text, encoding="utf-8")
        return System.load(tmp_path / "plant.yaml")

    return build


def one(make: Make, policy: str = "feedback: lqr") -> System:
    return make(ONE.format(policy=policy))


# -------------------------------------------------------------------------------- gains


def test_the_gain_is_that_of_the_algebraic_equation(make: Make) -> None:
    system = make(POLE)
    feedback = system.decl.feedback
    assert feedback is not None
    point = np.array(feedback.state), np.array(feedback.control)
    plain = System.load(system.decl.path, {"policy.feedback": "null"})
    linear = linearised(plain.decl, *point)
    assert linear.moving == ("p", "v", "a", "w")
    q = np.diag([0.0, 1 / 4**2, 4 / 0.8**2, 1 / 4**2])
    r = np.array([[1 / 10**2]])
    a, b = linear.a[1:, 1:], linear.b[1:]  # where it stands decides nothing, and costs nothing
    whole = scipy.linalg.solve_discrete_are(a, b, q[1:, 1:], r)
    expected = np.linalg.solve(r + b.T @ whole @ b, b.T @ whole @ a)
    np.testing.assert_allclose(feedback.gain[0][1:4], expected[0], rtol=1e-6)
    assert feedback.gain[0][0] == pytest.approx(0.0, abs=1e-9)
    assert feedback.gain[0][4] == 0.0


def test_slopes_are_those_of_the_plant(make: Make) -> None:
    linear = linearised(one(make, "hidden: [8]").decl, np.zeros(1), np.zeros(1))
    assert linear.a[0, 0] == pytest.approx(1.4)
    assert linear.b[0, 0] == pytest.approx(0.1)
    assert linear.rest[0] == 0.0


def test_an_integrator_out_of_reach_has_a_gain_all_the_same() -> None:
    a = np.array([[1.2, 0.3], [0.0, 1.0]])
    gain = riccati(a, np.array([[1.0], [0.0]]), np.eye(2), np.eye(1))
    assert abs(np.linalg.eigvals(a - np.array([[1.0], [0.0]]) @ gain)).min() < 0.9
    assert np.isfinite(gain).all()


def test_the_point_of_operation_is_where_the_plant_rests(make: Make) -> None:
    feedback = make(HOVER).decl.feedback
    assert feedback is not None
    assert feedback.control == pytest.approx((9.8,))
    assert feedback.gain[0][0] == 0.0


def test_a_given_gain_is_taken_as_it_is(make: Make) -> None:
    system = one(make, "feedback: {gain: {u: {x: 5}}, around: {x: 0.2 m, u: 1 m/s}, authority: 0.5}")
    feedback = system.decl.feedback
    assert feedback is not None
    assert feedback.gain == ((5.0,),)
    assert (feedback.state, feedback.control, feedback.authority) == ((0.2,), (1.0,), (3.5,))


# ------------------------------------------------------------------------------ the law


def test_actuators_get_the_law(make: Make) -> None:
    system = one(make, "feedback: {gain: {u: {x: 5}}, around: {x: 0.2 m, u: 1 m/s}, authority: 0.5}")
    x = torch.tensor([[0.0], [0.2], [-3.0], [0.1], [0.1]], dtype=F64)
    v = torch.tensor([[0.0], [-0.5], [2.0], [100.0], [-100.0]], dtype=F64)
    expected = torch.tensor([[2.0], [0.5], [6.5], [8.0], [-6.0]], dtype=F64)
    assert torch.allclose(system.commanded(x, v), expected)
    assert torch.allclose(system.step(x, v), x + 0.1 * (4.0 * x + expected))
    within = torch.tensor([[0], [1], [2]])[:, 0]
    assert torch.allclose(system.planned(x[within], expected[within]), v[within])


def test_every_control_can_be_had_in_every_state(make: Make) -> None:
    system = one(make)
    x = torch.linspace(-1, 1, 41, dtype=F64)[:, None]
    for wanted in (-6.0, -1.0, 3.0, 8.0):
        plan = system.planned(x, torch.full_like(x, wanted))
        assert bool((system.control_low <= plan + 1e-6).all())
        assert bool((plan - 1e-6 <= system.control_high).all())
        assert torch.allclose(system.commanded(x, plan), torch.full_like(x, wanted))


def test_without_a_feedback_plans_are_controls(make: Make) -> None:
    system = one(make, "hidden: [8]")
    x, v = torch.zeros(2, 1, dtype=F64), torch.ones(2, 1, dtype=F64)
    assert system.commanded(x, v) is v
    assert system.planned(x, v) is v


def test_what_differs_is_forgotten(make: Make) -> None:
    """Two starts that differ by 1e-3: open loop 837 times as much at the end, closed loop nothing."""
    x = torch.tensor([[0.0], [1e-3]], dtype=F64)
    plans = torch.zeros(2, 20, 1, dtype=F64)
    apart = [
        float((each.rollout(x, plans)[1, -1] - each.rollout(x, plans)[0, -1]).abs())
        for each in (one(make, "hidden: [8]"), one(make))
    ]
    assert apart[0] == pytest.approx(1e-3 * 1.4**20, rel=1e-6)
    assert apart[1] < 1e-6


def test_terms_of_the_objective_read_what_actuators_get(make: Make) -> None:
    system = one(make)
    x0, plan = torch.tensor([[0.5]], dtype=F64), torch.zeros(1, 20, 1, dtype=F64)
    columns = system.rollout_columns(x0, plan)
    command = [system.commanded(columns["x"][k, :, None], plan[:, k])[0, 0] for k in range(20)]
    cost = system.performance(columns, torch.ones(1, dtype=F64), u=plan)
    assert float(cost) == pytest.approx(float(torch.stack(command).square().mean()))


@pytest.mark.skipif(compiler() is None, reason="there is no C compiler here")
def test_rollouts_in_c_equal_torch(make: Make) -> None:
    two = POLE.replace(
        "f: {unit: N, range: [-10, 10]}", "f: {unit: N, range: [-10, 10]}\n  d: {range: [-1, 1]}"
    )
    agree(make(two))


def test_reset_maps_read_what_actuators_get(make: Make) -> None:
    text = ONE.format(policy="feedback: {gain: {u: {x: 5}}, authority: 1}")
    text += "jump: [{name: kick, guard: x > 0.9 m, reset: {x: 0.1 s * u}}]\n"
    x = torch.tensor([[0.95]], dtype=F64)
    assert float(make(text).step(x, torch.zeros(1, 1, dtype=F64))) == pytest.approx(0.1 * (0.0 - 4.75))


# ------------------------------------------------------------------- what it goes through


def test_wrong_actuators_are_wrong_of_what_they_get(make: Make) -> None:
    decl = under(one(make).decl, "wrong")
    system = System(decl)
    task = Task.of(
        Spec.parse(Source("s.stl", "require r: always[0, T] x < 5 m\nstate signal x [m]\n")), system
    )
    worlds = Worlds(task, world_type(decl), Setting((0,), 6, 5))
    x = 0.2 * worlds.reset()  # where nothing saturates
    plan = torch.full((6, 1), 0.5, dtype=F64)
    rate = (worlds.advance(x, plan, 1) - x) / 0.1 - 4.0 * x
    gains = rate / system.commanded(x, plan)
    assert torch.allclose((gains - 1.0).abs(), torch.full_like(gains, 0.2))


def test_the_truth_of_another_plant_keeps_the_feedback(make: Make) -> None:
    decl = under(make(POLE + "scenario: {long: {model_mismatch: {l: 0.7 m}}}\n").decl, "long")
    assert truth(decl).feedback == decl.feedback
    assert truth(decl).constants != decl.constants
    assert truth(decl).controls == decl.controls


SPEC = (
    "spec s\nstate signal p [m]\nstate signal a [rad]\n@safety\nrequire up: always[0, T] abs(a) < 0.6 rad\n"
)


@pytest.mark.apart
def test_exports_say_what_actuators_get(tmp_path: Path) -> None:
    (tmp_path / "pole.yaml").write_text(POLE + "backup: {bins: 3, T0: [1, 2]}\n")
    (tmp_path / "s.stl").write_text(SPEC)
    run = untrained(tmp_path / "s.stl", tmp_path / "pole.yaml", tmp_path / "runs")
    done = export(run, "onnx", tmp_path / "onnx")
    controller = Controller.load(done.folder)
    x = run.task.sample(8, seed=1).double()
    decided = controller.decide(x.numpy())
    expected = run.task.system.commanded(x, torch.from_numpy(decided.plan[:, 0]))
    np.testing.assert_allclose(decided.control, expected.numpy(), atol=1e-9)
    assert np.abs(decided.control - decided.plan[:, 0]).max() > 0.1
    if compiler() is None:
        return
    done = export(run, "c", tmp_path / "c")
    main = (done.folder / "main.c").read_text()
    body = "double command[STLC_CONTROLS]; stlc_command(state, plan[0], command);"
    body += ' printf("command %.17g\\n", command[0]);'
    (done.folder / "main.c").write_text(main.replace('printf("\\n");', f'printf("\\n"); {body}'))
    built = ["cc", "-std=c99", "-Wall", "-Wextra", "-Werror", "-o", "x", "main.c", "-lm"]
    subprocess.run(built, cwd=done.folder, check=True)
    lines = "\n".join(" ".join(f"{value:.17g}" for value in row) for row in x.tolist())
    said = subprocess.run(
        [done.folder / "x", "policy"], input=lines, text=True, capture_output=True, check=True
    )
    out = said.stdout.split("\n")
    rules, plans = len(run.task.rules), [list(map(float, line.split())) for line in out[0:-1:2]]
    first = torch.tensor([[row[4 + rules]] for row in plans], dtype=F64)
    commands = [float(line.split()[1]) for line in out[1::2] if line]
    np.testing.assert_allclose(commands, run.task.system.commanded(x, first)[:, 0].numpy(), atol=1e-9)


@pytest.mark.apart
def test_a_controller_without_a_feedback_gives_its_plan(tmp_path: Path) -> None:
    (tmp_path / "pole.yaml").write_text(POLE.replace("policy: {feedback: {weights: {a: 4}}}", ""))
    (tmp_path / "s.stl").write_text(SPEC)
    run = untrained(tmp_path / "s.stl", tmp_path / "pole.yaml", tmp_path / "runs")
    done = export(run, "onnx", tmp_path / "onnx")
    assert json.loads((done.folder / "controller.json").read_text())["feedback"] is None
    decided = Controller.load(done.folder).decide(run.task.sample(3, seed=1).double().numpy())
    assert np.array_equal(decided.control, decided.plan[:, 0])


# ------------------------------------------------------------------------------ findings


def test_an_unstable_plant_is_told_of(make: Make) -> None:
    plain, held = one(make, "hidden: [8]"), one(make)
    assert growth_of(plain.decl) == pytest.approx(1.4**20)
    (finding,) = unstable(plain.decl)
    assert finding.code == "W602"
    assert any("feedback: lqr" in text for text in finding.help)
    assert growth_of(held.decl) < 1.0
    assert not unstable(held.decl)
    assert "W602" in [each.code for each in plain.probe(64)]


def test_a_plant_that_gives_no_number_at_rest_is_not_called_unstable(make: Make) -> None:
    plain = one(make, "hidden: [8]").decl.source.text
    for wild in ("1 / x * 1 m^2 / (1 s)", "log(x / (1 m)) * (1 m/s)", "sqrt(x / (1 m) - 2) * (1 m/s)"):
        assert unstable(make(plain.replace("4 / (1 s) * x", wild)).decl) == ()


@pytest.mark.parametrize("name", ["car", "maze", "panda", "rover", "ship_safe", "ship_track", "unicycle"])
def test_the_benchmarks_are_not(name: str) -> None:
    system = System.load(Path(__file__).parents[3] / "examples" / f"{name}.yaml")
    assert not unstable(system.decl)
    assert math.isfinite(growth_of(system.decl))


@pytest.mark.parametrize(
    ("text", "code", "says"),
    [
        (ONE.format(policy="feedback: pid"), "S103", "lqr"),
        (ONE.format(policy="feedback: {gains: {}}"), "S101", "gain"),
        (ONE.format(policy="feedback: {around: {y: 0}}"), "S101", "y"),
        (ONE.format(policy="feedback: {around: {x: 3 s}}"), "E203", "[m]"),
        (ONE.format(policy="feedback: {gain: {w: {x: 1}}}"), "S101", "w"),
        (ONE.format(policy="feedback: lqr").replace("* x + u", "* x + 0 * u"), "S205", "out of reach"),
        (
            ONE.format(policy="feedback: lqr").replace("range: [-6, 8]}", "range: [-6, 8], squash: angle}"),
            "S205",
            "direction",
        ),
    ],
)
def test_what_cannot_be_had_is_refused(make: Make, text: str, code: str, says: str) -> None:
    with pytest.raises(SystemFileError) as caught:
        make(text)
    finding = caught.value.diagnostics[0]
    assert finding.code == code
    assert says in f"{finding.message} {finding.label} {' '.join(finding.help)}"
    assert finding.span is not None


TANK = """
stlc: 1
name: tank
time: {dt: 1 s, horizon: 60 steps, integrator: rk4}
state: {h: {unit: m, range: [0 m, 4 m]}}
control: {q: {unit: m/s, range: [0, 0.2]}}
flow: {h: "q - FLOW"}
init: {mixture: [{draw: {h: "uniform(0 m, 4 m)"}}]}
"""


@pytest.mark.parametrize("flow", ["0.1 * sqrt(max(h, 0 m) * 1 m) / 1 s", "0.1 / 1 s * h"])
def test_a_stable_tank_is_not_called_unstable(tmp_path, flow):
    path = tmp_path / "tank.yaml"
    path.write_text(TANK.replace("FLOW", flow))
    assert unstable(load_system_decl(path)) == ()


def test_an_unstable_tank_is(tmp_path):
    path = tmp_path / "tank.yaml"
    path.write_text(TANK.replace("FLOW", "-0.2 / 1 s * h"))
    assert [finding.code for finding in unstable(load_system_decl(path))] == ["W602"]
