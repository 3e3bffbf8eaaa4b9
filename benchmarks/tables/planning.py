"""Planning problems from the literature: success, robustness and processor time, beside published figures.

Problems of stlpy and STLCCP have a single initial state. Their robustness is maximised until it reaches a
target. The problems `circles_linear`, `circles_dubins` and `arm` consist of random tasks, drawn as in
TeLoGraF. For these, the search ends at the first satisfying plan. The time of the compilation is not counted.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from math import inf
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING, Annotated, Any

import torch
import typer

from benchmarks.arm import draw_arm
from benchmarks.circles import STEPS, draw
from benchmarks.options import OnlyOption, ResultsOption
from benchmarks.store import RESULTS, Key, ResultStore, inputs_of, load
from benchmarks.table import Columns, Table, show
from benchmarks.timing import one_thread
from stlc.cli.framework.options import JsonOption
from stlc.cli.framework.program import command
from stlc.controller.search.planner import PlanBudget, PlanResult, plan, planning_version
from stlc.diagnostics import StlcError, UsageError
from stlc.files import File
from stlc.provenance import sha256

if TYPE_CHECKING:
    from torch import Tensor

    from stlc.controller.problem.task import Task

SEED = 12345
"""Seed of the planner, and of the first random task. The other tasks have the seeds after it."""
SLOW = {"umax": "0.2 m/s^2"}
"""Limit of the controls in the problems of STLCCP."""
METHODS = ("search", "halving", "schedule", "gradient", "cem", "milp")
PROOF = 5.0
"""Processor time (s) for a plan of a random task, and then for a proof that no plan exists."""
MARGIN = 1e-3
"""Robustness at which the search for a random task ends. It exceeds the tolerance of verdicts."""


@dataclass(frozen=True, slots=True)
class Problem:
    """A planning problem: a single specification, or a system with many random tasks.

    Attributes:
        spec: name of the specification in `specs/planning`, or of the system of random tasks.
        published: results of other tools, with their source.
        steps: horizon in steps; None for the horizon in the system file.
        target: robustness at which the search ends.
        seconds: processor time per initial state.
        tasks: number of random tasks; 0 for a single specification.
    """

    spec: str
    published: str
    steps: int | None = None
    target: float = inf
    seconds: float = 5.0
    tasks: int = 0

    @property
    def name(self) -> str:
        """Name of the specification, with the horizon if that is changed."""
        return self.spec + (f", T = {self.steps}" if self.steps else "")


PROBLEMS = (
    *(
        Problem(name, "stlpy: by MILP, no figures")
        for name in (
            "reach_avoid",
            "either_or",
            "narrow_passage",
            "door_puzzle_1",
            "door_puzzle_2",
            "stepping_stones",
            "many_target",
        )
    ),
    Problem("nonlinear_reach_avoid", "stlpy: by SNOPT, no figures"),
    Problem("many_target", "STLCCP: Gurobi .50 / 2,527 s; CCP .36 to .50 / 12 to 22 s", 50, 0.48, 12.0),
    Problem(
        "narrow_passage", "STLCCP: Gurobi stopped at 15,000 s; CCP -.29 to .14 / 19 to 192 s", 75, 0.2, 20.0
    ),
    Problem("either_or", "STLCCP: Gurobi / 7,371 s; CCP at T = 100 .50 / 30 to 47 s", 105, 0.45, 20.0),
    Problem(
        "circles_linear",
        "gradient .94 / 4.9 s; TeLoGraF .52 / 1.3 s, fast .51 / .13 s",
        None,
        MARGIN,
        0.15,
        100,
    ),
    Problem("circles_dubins", "TeLoGraF .62 / 1.3 s; gradient .60 / 6.7 s", None, MARGIN, 0.15, 100),
    Problem("arm", "TeLoGraF .83 / 1.4 s", None, MARGIN, 1.4, 100),
)
DRAWS = {"circles_linear": draw, "circles_dubins": draw, "arm": draw_arm}
"""System -> function that draws a task for it."""


@dataclass(frozen=True, slots=True)
class Solution:
    """Plans of one method for a problem.

    Attributes:
        found: number of satisfying plans; plans are judged by the published formula.
        starts: number of initial states. The table leaves out those from which provably no plan exists.
        rho: robustness of the plan; the median if there are several initial states.
        seconds: mean processor time per initial state.
        evaluations: mean number of plans that were evaluated per initial state.
    """

    found: int
    starts: int
    rho: float
    seconds: float
    evaluations: float


@dataclass(frozen=True, slots=True)
class PlanningRow:
    """Results of one method for one problem.

    `reason` says why the method cannot solve the problem; it is "" if `solution` is given.
    """

    problem: str
    method: str
    budget: float
    target: float
    seed: int
    solution: Solution | None
    reason: str
    published: str


COLUMNS: Columns[PlanningRow] = {
    "problem": "{problem}",
    "method": "{method}",
    "budget": lambda row: f"{row.budget:g} s" + ("" if row.target == inf else f", rho ≥ {row.target:g}"),
    "seed": "{seed}",
    "found": lambda row: f"{row.solution.found} of {row.solution.starts}" if row.solution else row.reason,
    "robustness": "{solution.rho:.3f}",
    "processor s": "{solution.seconds:.3f}",
    "plans": "{solution.evaluations:,.0f}",
    "published (other machines)": "{published}",
}


@command("python -m benchmarks planning", "python -m benchmarks planning --only either_or --method milp")
def planning(
    only: OnlyOption = None,
    method: Annotated[
        list[str] | None, typer.Option("--method", metavar="NAME", help="Some of the planners; repeatable.")
    ] = None,
    out: ResultsOption = RESULTS,
    as_json: JsonOption = False,
) -> None:
    """Plan for problems of stlpy, STLCCP and TeLoGraF; finished results are kept, so that a run continues."""
    wanted = None if only is None else {each.strip() for each in only.split(",")}
    store = ResultStore("planning", out)
    cells = [
        (problem, name)
        for problem in PROBLEMS
        if wanted is None or problem.spec in wanted
        for name in method or METHODS
        if not (name == "milp" and problem.tasks)
    ]
    with one_thread():
        table = Table("planning", cells, lambda cell: measured(*cell, store), COLUMNS, "{problem}, {method}")
        show("planning", {"rows": table}, as_json=as_json)


def measured(problem: Problem, method: str, store: ResultStore) -> PlanningRow:
    """Return the row of a problem and a method, from the stored result or from a new measurement.

    If the method cannot solve the problem, the row contains the reason.
    """
    budget, target = problem.seconds, problem.target
    shown = (problem.name, method, budget, target, SEED)
    try:
        if problem.tasks:
            texts = sha256("\0".join(DRAWS[problem.spec](SEED + i).text for i in range(problem.tasks)))
            inputs: Mapping[str, Any] = {"tasks": texts, "system": sha256(_system(problem).read_bytes())}
        else:
            inputs = inputs_of(_task(problem))
        key = Key(
            f"{problem.name}, {method}",
            {
                **{**inputs, "steps": problem.steps, "seconds": budget, "target": str(target), "seed": SEED},
                **({"planner_version": version} if (version := planning_version(method)) > 1 else {}),
            },
        )
        kept = store.get(
            key, lambda: _values(_drawn(problem, method) if problem.tasks else _one(problem, method))
        )
        none = len(_impossible(problem, inputs, store)) if problem.tasks else 0
    except StlcError as why:
        return PlanningRow(*shown, None, str(why), problem.published)
    found = Solution(**{each.name: kept[each.name] for each in fields(Solution)})
    return PlanningRow(*shown, replace(found, starts=found.starts - none), "", problem.published)


def _impossible(problem: Problem, inputs: Mapping[str, Any], store: ResultStore) -> list[int]:
    """Return the seeds of the random tasks for which `milp` proves that no satisfying plan exists.

    The list is empty if `milp` cannot encode the system. `inputs` identifies the tasks and the system in the
    stored results.
    """
    key = Key(f"{problem.name}, no plan", {**inputs, "seconds": PROOF})

    def proved() -> Mapping[str, Any]:
        left = (
            seed for seed in _seeds(problem) if not bool(_planned(problem, seed, "schedule", PROOF).satisfied)
        )
        try:
            return {
                "seeds": [seed for seed in left if bool(_planned(problem, seed, "milp", PROOF).infeasible)]
            }
        except UsageError:  # the system has no mixed-integer linear form
            return {"seeds": []}

    seeds: list[int] = store.get(key, proved)["seeds"]
    return seeds


def _values(solution: Solution) -> dict[str, float]:
    return {each.name: getattr(solution, each.name) for each in fields(Solution)}


def _task(problem: Problem) -> Task:
    changed = {} if problem.steps is None else {"time.horizon": f"{problem.steps} steps", **SLOW}
    return load(f"planning/{problem.spec}", tuple(changed.items()))


def _one(problem: Problem, method: str) -> Solution:
    task = _task(problem)
    x0 = task.sample(1, seed=0, dtype=torch.float64)
    found = plan(task, x0, method, budget=PlanBudget(problem.seconds, target=problem.target), seed=SEED)
    values = (found.rho, found.seconds, found.evaluations.double())
    return Solution(int(found.satisfied.sum()), 1, *(float(each[0]) for each in values))


def _system(problem: Problem) -> Path:
    return File(f"examples/planning/{problem.spec}.yaml").system()


def _seeds(problem: Problem) -> range:
    return range(SEED, SEED + problem.tasks)


def _planned(problem: Problem, seed: int, method: str, seconds: float) -> PlanResult:
    """Plan for the random task of a seed for `seconds`; the time of the compilation is not counted."""
    task, x0 = _task_of(problem, seed)
    idle = torch.zeros(1, STEPS, len(task.system.control_names))
    task.judge(x0.float(), idle, states=False)
    return plan(task, x0, method, budget=PlanBudget(seconds, target=problem.target), seed=SEED)


def _task_of(problem: Problem, seed: int) -> tuple[Task, Tensor]:
    """Return the random task of a seed, and its initial state, (1, n)."""
    import stlc
    from stlc.controller.problem.task import Task
    from stlc.dynamics.system import System

    drawn, system = DRAWS[problem.spec](seed), System.load(_system(problem))
    x0 = torch.tensor([drawn.x0[: len(system.names)]], dtype=torch.float64)
    return Task.of(stlc.parse(drawn.text), system, end="truncate"), x0


def _drawn(problem: Problem, method: str) -> Solution:
    """Plan for all random tasks of a problem and return the results.

    Plans are judged by the monitor. Time windows are cut at the last sample.
    """
    import stlc

    rows = []
    for seed in _seeds(problem):
        made = _planned(problem, seed, method, problem.seconds)
        task, _ = _task_of(problem, seed)
        states = task.rollout(made.states, made.plans)[0].numpy()
        signals = dict(zip(task.system.names, states.T, strict=True))
        monitor = stlc.Monitor(task.compiled.spec, system=_system(problem))
        rho = monitor.robustness(signals, at=0, end="truncate")
        rows.append((float(rho), float(made.seconds[0]), float(made.evaluations[0])))
    rho, seconds, evaluations = zip(*rows, strict=True)
    found = sum(each >= 0.0 for each in rho)
    return Solution(found, len(rows), sorted(rho)[len(rho) // 2], fmean(seconds), fmean(evaluations))
