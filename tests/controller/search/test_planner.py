from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import planner_laws as laws
from helpers.planner_laws import line_task, planned

import stlc
from stlc.controller.problem.task import Task
from stlc.controller.search.plan_traces import following, starts_of, trace_of
from stlc.controller.search.planner import PlanBudget, PlanSearch, plan, planner_named
from stlc.controller.search.planner_policy import PlannerPolicy
from stlc.diagnostics import TraceError, UsageError
from stlc.monitor.verdict import Monitor
from stlc.registry import PLANNERS
from stlc.trace import Trace


@pytest.fixture(params=[name for name in PLANNERS.own if name != "policy"])
def planner(request: pytest.FixtureRequest) -> str:
    return laws.available(request.param)


def test_plans_are_judged_exactly_and_within_bounds(car_task: Task, planner: str) -> None:
    laws.judges_exactly_and_within_bounds(car_task, planner)


def test_the_same_seed_gives_the_same_plans(car_task: Task) -> None:
    x0 = car_task.sample(3, seed=5, dtype=torch.float64)
    for name in ("search", "schedule"):
        first, second = planned(car_task, name, x0), planned(car_task, name, x0)
        assert torch.equal(first.plans, second.plans), name


def test_evaluations_are_a_limit_and_a_target_ends_the_search(car_task: Task) -> None:
    x0 = car_task.sample(2, seed=1, dtype=torch.float64)
    most = plan(car_task, x0, "search", budget=PlanBudget(5.0, 120, torch.inf))
    assert most.evaluations.tolist() == [120, 120]
    few = plan(car_task, x0, "search", budget=PlanBudget(5.0))
    assert bool(few.satisfied.all())
    stopped = plan(car_task, x0, "search", budget=PlanBudget(5.0, stop=lambda: True))
    assert stopped.evaluations.tolist() == [0, 0]
    assert not bool(stopped.satisfied.any())


def test_no_planner_judges_more_plans_than_allowed(car_task: Task, planner: str) -> None:
    laws.judges_no_more_than_allowed(car_task, planner)


def test_plans_of_a_single_number(tmp_path: Path, planner: str) -> None:
    laws.plans_a_single_number(tmp_path, planner)


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
    trace_of(car_task, found, 2).save(tmp_path / "plan.npz")
    trace = Trace.load(tmp_path / "plan.npz")
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
    trace_of(car_task, found).save(tmp_path / "plan.npz")
    assert torch.equal(starts_of(car_task, str(tmp_path / "plan.npz"), None, 0), given)
    assert starts_of(car_task, "random", 3, 0).shape == (3, len(names))
    holes = Trace.load(tmp_path / "plan.npz")
    speeds = holes.data["v"].copy()
    speeds[1, 0] = np.nan
    replace(holes, data={**holes.data, "v": speeds}).save(tmp_path / "holes.npz")
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


def test_options_are_checked() -> None:
    with pytest.raises(UsageError, match="a whole number, not `many`"):
        planner_named("schedule", tries="many")
    assert planner_named("schedule", tries="7") == planner_named("schedule", tries=7)
    for wrong in ({"tries": 2.5}, {"tries": True}, {"library": None}):
        with pytest.raises(UsageError, match="of planner `schedule` is"):
            planner_named("schedule", **wrong)
    with pytest.raises(UsageError, match="unknown planner `serach`"):
        planner_named("serach")


def test_numbers_out_of_their_bounds_are_refused(planner: str) -> None:
    laws.refuses_numbers_out_of_bounds(planner)


@pytest.mark.slow
def test_least_numbers_plan_too(car_task: Task, planner: str) -> None:
    laws.plans_with_least_numbers(car_task, planner)


def test_a_planner_is_a_policy(car_task: Task) -> None:
    policy = PlannerPolicy(car_task, planner_named("search"), PlanBudget(torch.inf, 500))
    x0 = car_task.sample(6, seed=4)
    plans, judged = policy.plan_judged(x0)
    assert plans.dtype == x0.dtype
    assert float((judged.rho >= -1e-5).double().mean()) >= 0.8
    assert policy.continuation(x0.repeat(50, 1)).shape == (300, car_task.system.horizon, 1)


def test_a_planner_says_what_it_left_of_its_budget(car_task: Task) -> None:
    x0 = car_task.sample(6, seed=4)
    easy = PlannerPolicy(car_task, planner_named("search"), PlanBudget(5.0, target=-1e6))
    assert easy.take_use() is None
    easy.for_task(car_task).plan(x0)
    easy.continuation(x0)  # no decision
    use = easy.take_use()
    assert use is not None
    assert (use.budget, use.searches, use.early) == (5.0, 6, 1.0)
    assert 0.0 < use.median <= use.p99 < 5.0
    assert easy.take_use() is None, "each search counts once"
    hard = PlannerPolicy(car_task, planner_named("search"), PlanBudget(0.01, target=1e6))
    hard.plan(x0)
    use = hard.take_use()
    assert use is not None
    assert (use.searches, use.early) == (6, 0.0)
    assert use.median >= 0.01


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
