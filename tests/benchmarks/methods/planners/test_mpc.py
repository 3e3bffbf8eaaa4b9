"""Nonlinear programs of plans: what is solved, what is refused; expressions agree with the arrays."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.methods.planners.mpc import Mpc
from stlc.controller.problem.task import Task
from stlc.controller.search.local_search import Searcher
from stlc.controller.search.planner import PlanBudget, PlanSearch, plan
from stlc.diagnostics import UsageError
from stlc.dynamics.system import System
from stlc.grammar.spec import Spec
from stlc.source import Source

pytestmark = pytest.mark.apart
casadi = pytest.importorskip("casadi")

SYSTEM = """
stlc: 1
name: boat
time: {dt: 0.5 s, horizon: 8 steps, integrator: euler, substeps: 2}
state:
  p: {range: [-9, 9]}
  q: {range: [-9, 9]}
  v: {range: [-1, 1], clamp: true}
  h: {range: [-4, 4]}
  n: {range: [0, 9]}
control:
  a: {range: [-1, 1]}
  w: {range: [-1, 1]}
flow:
  p: v * cos(h)
  q: v * sin(h)
  v: a
  h: w
  n: ind(p > 1)
init:
  mixture:
    - {name: any, draw: {p: "uniform(-1, 1)", q: "uniform(-1, 1)", v: "uniform(-1, 1)", h: 0, n: 0}}
"""


@pytest.fixture(scope="module")
def boat(tmp_path_factory: pytest.TempPathFactory) -> System:
    path: Path = tmp_path_factory.mktemp("boat") / "boat.yaml"
    path.write_text(SYSTEM)
    return System.load(path)


def task_of(system: System, text: str) -> Task:
    return Task.of(Spec.parse(Source("boat.stl", f"signal p, q, v, h, n\nrequire r: {text}")), system)


@pytest.mark.parametrize(
    "text",
    [
        "eventually[0 s, 4 s] (p > 1.5 and q > 0.5)",
        "(norm(p, q) < 3) until[0 s, 4 s] (always[0 s, end] p > 0.5)",
        "always[1 s, 4 s] (p > 0.2 or q > 0.2)",
        "eventually[0 s, 3 s] always[0 s, 1 s] abs(p - 1.2) < 0.3",
        "eventually[0 s, 4 s] n > 0.5",
        "always[3 s, 4 s] once[0 s, 1 s] p > 1",
    ],
)
def test_plans_are_found(boat: System, text: str) -> None:
    task = task_of(boat, text)
    x0 = torch.tensor([[0.0, 0.0, 1.0, 0.0, 0.0], [0.3, -0.2, 0.5, 0.0, 0.0]])
    x0 = task.system.with_added(x0, torch.Generator())
    found = plan(task, x0, "mpc", budget=PlanBudget(20.0), guesses=5)
    assert found.satisfied.all()
    assert not found.infeasible.any()


def test_other_guesses_leave_a_local_minimum(boat: System) -> None:
    """Straight ahead of the boat, the middle of every control range touches an obstacle at its centre."""
    task = task_of(boat, "eventually[0 s, 4 s] p > 2.5 and always[0 s, 4 s] norm(p - 1.5, q) > 0.6")
    x0 = torch.tensor([[0.0, 0.0, 1.0, 0.0, 0.0]])
    one = plan(task, x0, "mpc", budget=PlanBudget(20.0), guesses=1)
    found = plan(task, x0, "mpc", budget=PlanBudget(20.0))
    assert not one.satisfied.all()
    assert found.satisfied.all()
    assert int(found.evaluations) > int(one.evaluations)


def test_nearly_robust_plans_are_repaired(boat: System) -> None:
    task = task_of(boat, "eventually[0 s, 4 s] p > 1.55")
    search = PlanSearch(task, torch.tensor([[0.0, 0.0, 0.5, 0.0, 0.0]]), PlanBudget(20.0))
    rows = torch.tensor([0])
    search.offer(rows, torch.zeros(1, 8, 2))  # p = 2 at the end
    search.budget = PlanBudget(20.0, target=0.5)
    Mpc()._mend(search, rows, Searcher(task, search.generator, target=0.5))
    assert float(search.rho) >= 0.5


def test_robustness_is_maximised(boat: System) -> None:
    """Straight ahead at full speed: p(4 s) is 4 from rest at speed 1."""
    task = task_of(boat, "eventually[0 s, 4 s] p > 1")
    x0 = torch.tensor([[0.0, 0.0, 1.0, 0.0, 0.0]])
    found = plan(task, x0, "mpc", budget=PlanBudget(20.0, target=torch.inf))
    assert float(found.rho) == pytest.approx(3.0, abs=0.05)


@pytest.mark.parametrize(
    ("text", "blamed"),
    [
        ("always[0 s, 4 s] floor(p) < 2", r"floor\(p\)"),
        ("always[0 s, 4 s] (if p > 1 then q else v) < 2", "if p > 1"),
    ],
)
def test_what_jumps_is_named(boat: System, text: str, blamed: str) -> None:
    with pytest.raises(UsageError, match=f"planner `mpc` cannot .*{blamed}"):
        plan(task_of(boat, text), torch.zeros(1, 5), "mpc")


_numbers = st.integers(-8, 8).map(lambda n: n / 4)
_linear = st.sampled_from(
    ["p", "q - v", "p * q", "abs(p)", "max(p, q)", "min(p, -q)", "norm(p, q)", "sin(p)"]
)
_atoms = st.builds("{} > {}".format, _linear, _numbers) | st.builds("{} <= {}".format, _linear, _numbers)
_formulas = st.recursive(
    _atoms,
    lambda inner: (
        st.builds("({} {} {})".format, inner, st.sampled_from(["and", "or"]), inner)
        | st.builds("(not {})".format, inner)
        | st.builds("({}[0 s, 1 s] {})".format, st.sampled_from(["always", "eventually"]), _atoms)
        | st.builds("({} until[0.5 s, 2 s] {})".format, _atoms, _atoms)
        | st.builds("(eventually[0 s, 2 s] (historically[0 s, 1 s] {}))".format, _atoms)
    ),
    max_leaves=4,
)


@given(text=_formulas, seed=st.integers(0, 1000))
@settings(max_examples=18, deadline=None)
def test_conditions_agree_with_the_exact_robustness(boat: System, text: str, seed: int) -> None:
    """The least of the conditions is the robustness, up to what is rounded; no dynamics are off."""
    task = task_of(boat, text)
    generator = torch.Generator().manual_seed(seed)
    plans = 0.4 * torch.rand(1, 8, 2, generator=generator).double() - 0.2
    x0 = task.system.with_added(torch.tensor([[0.1, 0.2, 0.1, 0.3, 0.0]]).double(), torch.Generator())
    task.__dict__["native"] = None  # no C is built for every formula
    shooting = Mpc(smoothing=2000.0, sharpness=2000.0)._shooting(task)
    columns = {name: each[:, 0].numpy() for name, each in task.system.rollout_columns(x0, plans).items()}
    constraints = casadi.Function(
        "g", [shooting.program["x"], shooting.program["p"]], [shooting.program["g"]]
    )
    found = np.array(constraints(shooting.guess(plans[0].numpy(), columns), shooting.data(columns, 0.0)))[
        :, 0
    ]
    equations = len(shooting.states) * 8
    assert np.abs(found[:equations]).max(initial=0.0) < 1e-6
    rho = float(task.judge(x0, plans).rho)
    values = found[equations:]
    assert float(values.min(initial=1e9)) == pytest.approx(rho, abs=0.02) or (not len(values) and rho >= 0), (
        text
    )
