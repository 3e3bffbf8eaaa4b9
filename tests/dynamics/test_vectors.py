"""States, controls and constants of several components."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from stlc.compile.ir.discretize import Grid
from stlc.compile.pipeline import compile_spec
from stlc.diagnostics import StlcError
from stlc.dynamics.load import parse_system
from stlc.dynamics.system import System
from stlc.grammar.spec import Spec
from stlc.source import Source

Make = Callable[..., System]

ARM = """\
time: {dt: 0.1 s, horizon: 5 steps}
const:
  low: [-2 rad, -1 rad]
  high: "[2 rad, 1 rad]"
  home: [0.5 m, 0.25 m]
state:
  q: {size: 2, unit: rad, range: [low, high], clamp: true}
  goal: {size: 2, unit: m, role: env}
  touched: {size: 2, bool: true, role: env}
  tau: {unit: s}
control:
  dq: {size: 2, unit: rad/s, range: [-4, 4]}
def:
  tip: "[cos(q[0]) * 1 m + cos(q[1]) * 1 m, sin(q[0]) * 1 m + sin(q[1]) * 1 m]"
flow:
  q: dq
  tau: ind(norm(tip - goal) < 0.3)
jump:
  - {guard: tau > 2 s, reset: {goal: home, "q[1]": 0}}
init:
  mixture:
    - let: {shift: "[1 m, 2 m]"}
      draw:
        q: uniform(low, high)
        goal: home + uniform(0, 1) * shift
        touched: [false, bernoulli(0.5)]
        tau: 0
  where: [norm(goal - home) > 0.1]
policy: {observe: [q, tip - goal, tau, "touched[1]"]}
test:
  events: [{every: 1 s, set: {goal: "[uniform(0, 1), 0]", touched: true}}]
"""


@pytest.fixture(scope="module")
def arm(make: Make) -> System:
    return make(ARM)


def test_a_vector_is_a_column_for_each_component(arm: System) -> None:
    assert arm.names == ("q[0]", "q[1]", "goal[0]", "goal[1]", "touched[0]", "touched[1]", "tau")
    assert arm.control_names == ("dq[0]", "dq[1]")
    assert [(c.low, c.high) for c in arm.signature.columns[:2]] == [(-2.0, 2.0), (-1.0, 1.0)]
    assert arm.decl.constants["high[1]"][0] == 1.0
    assert arm.decl.places["q[1]"] == arm.decl.places["q"]


def test_components_move_each_for_itself(arm: System) -> None:
    x = torch.tensor([[0.1, 0.2, 1.0, 2.0, 0.0, 1.0, 0.0], [0.1, 0.95, 1.0, 2.0, 0.0, 1.0, 2.5]])
    moved = arm.step(x, torch.tensor([[1.0, -2.0], [1.0, 4.0]]))
    torch.testing.assert_close(moved[0], torch.tensor([0.2, 0.0, 1.0, 2.0, 0.0, 1.0, 0.0]))
    torch.testing.assert_close(moved[1], torch.tensor([0.2, 0.0, 0.5, 0.25, 0.0, 1.0, 2.5]))


def test_a_draw_is_made_as_often_as_it_is_written(arm: System) -> None:
    x = arm.sample(500, seed=0, dtype=torch.float64)
    low, high = torch.tensor([-2.0, -1.0]), torch.tensor([2.0, 1.0])
    assert bool(((x[:, :2] >= low) & (x[:, :2] <= high)).all())
    assert abs(float(torch.corrcoef(x[:, :2].T)[0, 1])) < 0.2
    offset = x[:, 2:4] - torch.tensor([0.5, 0.25])
    torch.testing.assert_close(offset[:, 1], 2 * offset[:, 0])
    assert bool((offset.norm(dim=1) > 0.1).all())
    assert set(x[:, 4].tolist()) == {0.0}
    assert set(x[:, 5].tolist()) == {0.0, 1.0}


def test_one_number_stands_for_every_component_and_is_drawn_for_each(make: Make) -> None:
    system = make(ARM.replace("q: uniform(low, high)", 'q: "uniform(-1, 1)"'))
    x = system.sample(200, seed=0)
    assert not bool((x[:, 0] == x[:, 1]).any())


def test_the_policy_sees_components(arm: System) -> None:
    x = torch.tensor([[0.0, 0.0, 1.0, 2.0, 0.0, 1.0, 0.5]])
    assert arm.observed_count == 6
    torch.testing.assert_close(arm.observe(x), torch.tensor([[0.0, 0.0, 1.0, -2.0, 0.5, 1.0]]))


def test_a_specification_names_the_vector(arm: System) -> None:
    text = "signal q: real[2] [rad]\nrequire small: always[0, T] norm(q) < 3\n"
    compiled = compile_spec(
        Spec.parse(Source("a.stl", text)), grid=Grid(arm.decl.dt, arm.horizon), interface=arm.interface()
    )
    assert compiled.signature.names == ("q[0]", "q[1]")


def test_events_set_vectors(arm: System) -> None:
    (event,) = arm.decl.test.events
    assert [assign.name for assign in event.sets] == ["goal[0]", "goal[1]", "touched[0]", "touched[1]"]


@pytest.mark.parametrize(
    ("old", "new", "code"),
    [
        ("  q: dq\n", "  q: [1, 2, 3]\n", "S203"),
        ("touched: [false, bernoulli(0.5)]", "touched: [false]", "S203"),
        ("range: [low, high], clamp", "range: [low, home], clamp", "E203"),
        ("size: 2, unit: rad, ", "size: 0, unit: rad, ", "S103"),
        ("tau: {unit: s}", "tau: {unit: s, size: 2, timer: up}", "S103"),
        ('"q[1]": 0', '"q[2]": 0', "S202"),
        ("        goal: home + uniform(0, 1) * shift\n", "", "S102"),
        ("guard: tau > 2 s", "guard: q > 2", "E205"),
    ],
)
def test_what_does_not_go_together_is_said(old: str, new: str, code: str) -> None:
    assert ARM.count(old) == 1
    with pytest.raises(StlcError) as caught:
        parse_system(Source("a.yaml", "stlc: 1\nname: arm\n" + ARM.replace(old, new)), Path("a.yaml"))
    assert code in {finding.code for finding in caught.value.diagnostics}


def test_a_name_that_is_not_declared_is_shown_as_a_vector(arm: System) -> None:
    spec = Spec.parse(Source("a.stl", "require small: always[0, T] norm(q) < 3\n"))
    with pytest.raises(StlcError) as caught:
        compile_spec(spec, grid=Grid(arm.decl.dt, arm.horizon), interface=arm.interface())
    assert "`signal q: real[2] [rad]`" in caught.value.diagnostics[0].help[0]
