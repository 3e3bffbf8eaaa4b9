from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch

import stlc
from stlc.controller.options import FINITE, bounds_of
from stlc.controller.planning.planner import PlanBudget, PlannerPolicy, PlanSearch, plan, planner_named
from stlc.controller.planning.traces import following, starts_of, trace_of
from stlc.controller.problem.task import Task
from stlc.diagnostics import TraceError, UsageError
from stlc.monitor.verdict import Monitor
from stlc.registry import PLANNERS
from stlc.trace import load_trace, save_trace

NEEDS = {"cma": "cma", "milp": "highspy", "mpc": "casadi"}
QUICK = {"cem": {"population": 50, "elites": 10}, "gradient": {"steps": 5, "starts": 2}}


@pytest.fixture(params=[name for name in PLANNERS.names if name != "policy"])
def planner(request: pytest.FixtureRequest) -> str:
    name: str = request.param
    if name in NEEDS:
        pytest.importorskip(NEEDS[name])
    return name


def planned(task: Task, name: str, x0: torch.Tensor, evaluations: int = 300) -> stlc.PlanResult:
    return plan(task, x0, name, budget=PlanBudget(5.0, evaluations), **QUICK.get(name, {}))


def test_plans_are_judged_exactly_and_within_bounds(car_task: Task, planner: str) -> None:
    x0 = car_task.sample(4, seed=3, dtype=torch.float64)
    if planner == "mpc":  # a planner for smooth systems
        with pytest.raises(UsageError, match="cannot"):
            planned(car_task, planner, x0)
        return
    found = planned(car_task, planner, x0)
    done = torch.isfinite(found.rho)
    assert bool(done.any())
    rho = car_task.judge(x0[done], found.plans[done]).rho
    assert torch.equal(rho, found.rho[done])
    system = car_task.system
    assert bool((found.plans >= system.control_low).all() & (found.plans <= system.control_high).all())
    assert bool((found.evaluations > 0).all())


def test_the_same_seed_gives_the_same_plans(car_task: Task) -> None:
    x0 = car_task.sample(3, seed=5, dtype=torch.float64)
    for name in ("search", "cem", "gradient"):
        first, second = planned(car_task, name, x0), planned(car_task, name, x0)
        assert torch.equal(first.plans, second.plans), name


def test_evaluations_are_a_limit_and_a_target_ends_the_search(car_task: Task) -> None:
    x0 = car_task.sample(2, seed=1, dtype=torch.float64)
    most = plan(car_task, x0, "cem", budget=PlanBudget(5.0, 120, torch.inf), population=50, elites=10)
    assert most.evaluations.tolist() == [120, 120]
    few = plan(car_task, x0, "search", budget=PlanBudget(5.0))
    assert bool(few.satisfied.all())
    stopped = plan(car_task, x0, "search", budget=PlanBudget(5.0, stop=lambda: True))
    assert stopped.evaluations.tolist() == [0, 0]
    assert not bool(stopped.satisfied.any())


def test_no_planner_judges_more_plans_than_allowed(car_task: Task, planner: str) -> None:
    if planner == "mpc":  # a planner for smooth systems
        return
    x0 = car_task.sample(3, seed=1, dtype=torch.float64)
    for most in (1, 70):
        budget = PlanBudget(20.0, most, torch.inf if planner != "milp" else 0.0)
        found = plan(car_task, x0, planner, budget=budget, **QUICK.get(planner, {}))
        assert bool((found.evaluations <= most).all()), found.evaluations


LINE = """stlc: 1
name: line
time: {dt: 1 s, horizon: HORIZON steps, integrator: euler, substeps: 1}
state: {x: {range: [-10, 10]}}
control: {u: {range: [-1, 1]}}
flow: {x: FLOW}
init: {mixture: [{draw: {x: "uniform(-1, 1)"}}]}
"""


def line_task(folder: Path, flow: str, horizon: int) -> Task:
    path = folder / "line.yaml"
    path.write_text(LINE.replace("FLOW", flow).replace("HORIZON", str(horizon)))
    return Task.of(
        stlc.parse("spec line\nstate signal x\nrequire far: eventually[0 s, T] x >= 0.5"),
        stlc.System.load(path),
    )


def test_plans_of_a_single_number(tmp_path: Path, planner: str) -> None:
    task = line_task(tmp_path, "u / (1 s)", 1)
    found = plan(task, torch.zeros(2, 1), planner, budget=PlanBudget(5.0, 2_000))
    assert bool(found.satisfied.all())


def test_plans_with_infinite_states_are_none(tmp_path: Path) -> None:
    task = line_task(tmp_path, "(x * x + u * u) * 1e300 / (1 s)", 3)
    assert torch.isposinf(task.judge(torch.ones(1, 1).double(), torch.ones(1, 3, 1).double()).rho)
    found = plan(task, torch.ones(1, 1), budget=PlanBudget(5.0, 100))
    assert torch.isneginf(found.rho)
    endless = plan(
        line_task(tmp_path, "u / (1 s)", 3), torch.full((1, 1), torch.inf), budget=PlanBudget(5.0, 9)
    )
    assert torch.isneginf(endless.rho)


def test_initial_guesses_are_checked_and_within_bounds(tmp_path: Path) -> None:
    task = line_task(tmp_path, "u / (1 s)", 2)
    start = torch.full((1, 2, 1), 5.0)
    assert plan(task, torch.zeros(1, 1), budget=PlanBudget(0.0), start=start).plans.max() == 1.0
    for wrong in (start[0], start.expand(3, 2, 1), start[:, :1]):
        with pytest.raises(UsageError, match=r"initial guesses of .* are not \(1, 2, 1\)"):
            plan(task, torch.zeros(1, 1), start=wrong)
    with pytest.raises(UsageError, match="hold NaN"):
        plan(task, torch.zeros(1, 1), start=start * torch.nan)


def test_a_plan_is_a_trace_that_the_monitor_judges_alike(car_task: Task, tmp_path: Path) -> None:
    x0 = car_task.sample(5, seed=2, dtype=torch.float64)
    found = planned(car_task, "search", x0)
    save_trace(tmp_path / "plan.npz", trace_of(car_task, found, 2))
    trace = load_trace(tmp_path / "plan.npz")
    verdict = Monitor(car_task.compiled.spec).check(trace)
    assert verdict.satisfied == bool(found.satisfied.all())
    assert np.allclose(trace.extras["plan_rho"], found.rho.numpy())


def test_starts_are_drawn_written_or_recorded(car_task: Task, tmp_path: Path) -> None:
    given = starts_of(car_task, "x=-5, v = 36km/h, sign=light", 2, 0)
    names = car_task.system.names
    assert given[:, names.index("x")].tolist() == [-5.0, -5.0]
    assert given[:, names.index("v")].tolist() == [10.0, 10.0]
    assert given[:, names.index("sign")].tolist() == [1.0, 1.0]
    found = planned(car_task, "search", given)
    save_trace(tmp_path / "plan.npz", trace_of(car_task, found))
    assert torch.equal(starts_of(car_task, str(tmp_path / "plan.npz"), None, 0), given)
    assert starts_of(car_task, "random", 3, 0).shape == (3, len(names))
    holes = load_trace(tmp_path / "plan.npz")
    speeds = holes.data["v"].copy()
    speeds[1, 0] = np.nan
    save_trace(tmp_path / "holes.npz", replace(holes, data={**holes.data, "v": speeds}))
    with pytest.raises(UsageError, match=r"trace 1 of `.*holes\.npz` has no first value of `v`"):
        starts_of(car_task, str(tmp_path / "holes.npz"), None, 0)


def test_recorded_starts_are_in_units_and_words(car_task: Task, tmp_path: Path) -> None:
    path, names = tmp_path / "start.csv", car_task.system.names
    head = "time,x [km],v [km/h],sign,tau,dx,v_lead,yielding"
    path.write_text(f"{head}\n0,-0.005,36,light,0,-1,0,true\n0.1,-0.004,36,light,0,-1,0,true\n")
    given = dict(zip(names, starts_of(car_task, str(path), None, 0)[0].tolist(), strict=True))
    assert (given["x"], given["v"], given["sign"], given["yielding"]) == (-5.0, 10.0, 1.0, 1.0)
    path.write_text(f"{head}\n0,-0.005,36,7,0,-1,0,true\n0.1,-0.004,36,7,0,-1,0,true\n")
    with pytest.raises(UsageError, match=r"begins with 7: `sign` is one of stop, light"):
        starts_of(car_task, str(path), None, 0)
    path.write_text(f"{head.replace('km/h', 's')}\n0,-0.005,36,0,0,-1,0,1\n0.1,-0.004,36,0,0,-1,0,1\n")
    with pytest.raises(TraceError, match=r"`v` is in \[s\]"):
        starts_of(car_task, str(path), None, 0)
    yielding = starts_of(car_task, "yielding=TRUE", None, 0)[0, names.index("yielding")]
    assert float(yielding) == 1.0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("yielding=0.5", "`yielding` is one of true"),
        ("vv=1", "has no state `vv`"),
        ("v=fast", "`fast` is not a finite number"),
        ("v=1e400", "`1e400` is not a finite number"),
        ("v=nan", "`nan` is not a finite number"),
        ("v=5 m", r"`m` is not a unit of \[m/s\]"),
        ("sign=7", "`sign` is one of stop, light"),
        ("sign=halt", "`halt` is not a finite number"),
        ("nowhere.npz", "there is no file `nowhere.npz`"),
    ],
)
def test_starts_that_make_no_sense(car_task: Task, text: str, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        starts_of(car_task, text, None, 0)


def test_options_are_checked(car_task: Task, planner: str) -> None:
    kind = PLANNERS.get(planner)
    assert all(type(each.default) in (bool, int, float, str) for each in fields(kind))
    with pytest.raises(UsageError, match="has no option `nonsense`"):
        planner_named(planner, nonsense="1")
    with pytest.raises(UsageError, match="a whole number, not `many`"):
        planner_named("cem", population="many")
    assert planner_named("cem", physical="true", population="7") == planner_named(
        "cem", physical=True, population=7
    )
    for wrong in ({"population": 2.5}, {"population": True}, {"physical": 1}, {"over": 3}, {"floor": None}):
        with pytest.raises(UsageError, match="of planner `cem` is"):
            planner_named("cem", **wrong)
    with pytest.raises(UsageError, match="neither `exact` nor `paper`"):
        plan(car_task, car_task.sample(1), "gradient", objective="smooth")
    with pytest.raises(UsageError, match="unknown planner `serach`"):
        planner_named("serach")


def test_numbers_out_of_their_bounds_are_refused(planner: str) -> None:
    kind = PLANNERS.get(planner)
    numbers = [each for each in fields(kind) if type(each.default) in (int, float)]
    assert numbers
    for each in numbers:
        bounds = bounds_of(each, FINITE)
        assert each.default in bounds
        for value in ("nan", str(2 * int(bounds.most)), str(bounds.least - 1)[:-2]):
            with pytest.raises(UsageError, match=f"option `{each.name}` of planner `{planner}` is a"):
                planner_named(planner, **{each.name: value})


@pytest.mark.slow
def test_least_numbers_plan_too(car_task: Task, planner: str) -> None:
    x0 = car_task.sample(2, seed=3, dtype=torch.float64)
    for each in fields(PLANNERS.get(planner)):
        if type(each.default) in (int, float) and planner != "mpc":
            least = type(each.default)(max(bounds_of(each, FINITE).least, 0))
            plan(car_task, x0, planner, budget=PlanBudget(0.05), **{each.name: least})


def test_a_planner_is_a_policy(car_task: Task) -> None:
    policy = PlannerPolicy(car_task, planner_named("search"), PlanBudget(torch.inf, 500))
    x0 = car_task.sample(6, seed=4)
    plans, judged = policy.plan_judged(x0)
    assert plans.dtype == x0.dtype
    assert float((judged.rho >= -1e-5).double().mean()) >= 0.8
    assert policy.continuation(x0.repeat(50, 1)).shape == (300, car_task.system.horizon, 1)


def test_progress_is_reported(car_task: Task) -> None:
    seen: list[int] = []
    x0 = car_task.sample(3, seed=0)

    def note(search: PlanSearch) -> None:
        seen.append(int(search.evaluations.sum()))

    plan(car_task, x0, "search", budget=PlanBudget(5.0, 4_000, torch.inf), progress=note)
    assert seen == sorted(seen)
    assert len(seen) >= 2


def test_states_with_other_columns_are_refused() -> None:
    task = stlc.compile(stlc.load("specs/reach_n_avoid.stl"), stlc.System.load("examples/maze.yaml"))
    with pytest.raises(UsageError, match="initial states of"):
        stlc.plan(task, torch.zeros(2))


HELD = """\
stlc: 1
name: held
time: {dt: 0.1 s, horizon: 4 steps}
state: {x: {range: [-5, 5]}}
control: {u: {range: [-1, 1]}}
held: {twice: {value: 2 * x}, thrice: {value: twice + x}}
flow: {x: u - thrice}
init: {mixture: [{draw: {x: "uniform(-1, 1)"}}]}
"""


def test_columns_that_follow_from_given_states_are_computed_from_them(tmp_path: Path) -> None:
    path = tmp_path / "held.yaml"
    path.write_text(HELD)
    task = stlc.compile(stlc.parse("signal x\nrequire r: always[0, T] x < 4"), stlc.System.load(path))
    assert task.system.names == ("x", "twice", "thrice")
    assert starts_of(task, "x=3", 1, 0).tolist() == [[3.0, 6.0, 9.0]]
    assert starts_of(task, "x=3, twice=1", 1, 0).tolist() == [[3.0, 1.0, 4.0]]
    assert following(task, "x=3, twice=1") == ("thrice",)
    assert following(task, "random") == ("twice", "thrice")
    assert following(task, "recording.npz") == ()
