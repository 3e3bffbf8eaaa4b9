"""Laws of all planners, of stlc and of the comparison; `planner` is the name of one."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import pytest
import torch

import stlc
from stlc.controller.options import FINITE, bounds_of
from stlc.controller.problem.task import Task
from stlc.controller.search.planner import PlanBudget, plan, planner_named
from stlc.diagnostics import UsageError
from stlc.registry import PLANNERS

NEEDS = {"cma": "cma", "milp": "highspy", "mpc": "casadi"}
QUICK = {"cem": {"population": 50, "elites": 10}, "gradient": {"steps": 5, "starts": 2}}
LINE = """stlc: 1
name: line
time: {dt: 1 s, horizon: HORIZON steps, integrator: euler, substeps: 1}
state: {x: {range: [-10, 10]}}
control: {u: {range: [-1, 1]}}
flow: {x: FLOW}
init: {mixture: [{draw: {x: "uniform(-1, 1)"}}]}
"""


def available(planner: str) -> str:
    """The planner, if its package is installed; else the test is skipped."""
    if planner in NEEDS:
        pytest.importorskip(NEEDS[planner])
    return planner


def planned(task: Task, name: str, x0: torch.Tensor, evaluations: int = 300) -> stlc.PlanResult:
    """Plans within a small number of evaluations."""
    return plan(task, x0, name, budget=PlanBudget(5.0, evaluations), **QUICK.get(name, {}))


def line_task(folder: Path, flow: str, horizon: int) -> Task:
    """A point on a line, which has to get to 0.5."""
    path = folder / "line.yaml"
    path.write_text(LINE.replace("FLOW", flow).replace("HORIZON", str(horizon)))
    return Task.of(
        stlc.parse("spec line\nstate signal x\nrequire far: eventually[0 s, T] x >= 0.5"),
        stlc.System.load(path),
    )


def judges_exactly_and_within_bounds(task: Task, planner: str) -> None:
    """Plans are within the bounds of the controls, and their robustness is exact."""
    x0 = task.sample(4, seed=3, dtype=torch.float64)
    found = planned(task, planner, x0)
    done = torch.isfinite(found.rho)
    assert bool(done.any())
    rho = task.judge(x0[done], found.plans[done]).rho
    assert torch.equal(rho, found.rho[done])
    system = task.system
    assert bool((found.plans >= system.control_low).all() & (found.plans <= system.control_high).all())
    assert bool((found.evaluations > 0).all())


def judges_no_more_than_allowed(task: Task, planner: str) -> None:
    """The limit of evaluations holds."""
    x0 = task.sample(3, seed=1, dtype=torch.float64)
    for most in (1, 70):
        budget = PlanBudget(20.0, most, torch.inf if planner != "milp" else 0.0)
        found = plan(task, x0, planner, budget=budget, **QUICK.get(planner, {}))
        assert bool((found.evaluations <= most).all()), found.evaluations


def plans_a_single_number(folder: Path, planner: str) -> None:
    """A plan may be a single number."""
    found = plan(line_task(folder, "u / (1 s)", 1), torch.zeros(2, 1), planner, budget=PlanBudget(5.0, 2_000))
    assert bool(found.satisfied.all())


def refuses_numbers_out_of_bounds(planner: str) -> None:
    """Options are plain values, whose bounds hold."""
    kind = PLANNERS.get(planner)
    assert all(type(each.default) in (bool, int, float, str) for each in fields(kind))
    with pytest.raises(UsageError, match="has no option `nonsense`"):
        planner_named(planner, nonsense="1")
    numbers = [each for each in fields(kind) if type(each.default) in (int, float)]
    assert numbers
    for each in numbers:
        bounds = bounds_of(each, FINITE)
        assert each.default in bounds
        for value in ("nan", str(2 * int(bounds.most)), str(bounds.least - 1)[:-2]):
            with pytest.raises(UsageError, match=f"option `{each.name}` of planner `{planner}` is a"):
                planner_named(planner, **{each.name: value})


def plans_with_least_numbers(task: Task, planner: str) -> None:
    """The least value of each option is enough for a plan."""
    x0 = task.sample(2, seed=3, dtype=torch.float64)
    for each in fields(PLANNERS.get(planner)):
        if type(each.default) in (int, float):
            least = type(each.default)(max(bounds_of(each, FINITE).least, 0))
            plan(task, x0, planner, budget=PlanBudget(0.05), **{each.name: least})
