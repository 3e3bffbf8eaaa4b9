"""Planner cells: one planner, one benchmark, one budget a plan, on the same starts for all.

Each is stored when it ends; a planner that refuses a task is stored with its reason. A trained policy is such
a cell, too: its plans from the same starts, and how long one takes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, is_dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from benchmarks.measured import Measured, has_changed, measured, reason
from benchmarks.roster import REPLAYED, Contender
from benchmarks.store import Key, Result, ResultStore, inputs_of, load
from benchmarks.timing import WARM, Times, one_thread
from benchmarks.training import pack, unpack
from stlc.controller.evaluation.held_out import wilson
from stlc.controller.planning.planner import PLANNING_VERSION, PlanBudget, PlanSearch, Solver, planner_named
from stlc.controller.problem.task import Task
from stlc.diagnostics import UsageError
from stlc.provenance import sha256
from stlc.rundir import RunDir

SEED = 12_345
"""Of the starts; for reporting only."""
STARTS = 1_000
SECONDS = (0.001, 0.01, 0.1, 1.0)
"""Processor time a plan."""
LONG = 1.0
"""From this budget on a cell is measured only if more time has found more plans before."""
ALONE = 100
"""Starts that are planned one at a time, for the time of a decision."""


@dataclass(frozen=True)
class PlanCell:
    """One measurement of a planner.

    Attributes:
        benchmark: name of the specification.
        contender: the planner and its options.
        seconds: processor time a plan; inf if the planner's own settings end the search.
        starts: number of initial states.
        run: of the trained policy whose plans are judged; None for a planner.
        label: of that policy, such as `guided-60s-seed0`.
    """

    benchmark: str
    contender: Contender
    seconds: float
    starts: int = STARTS
    run: RunDir | None = None
    label: str = ""

    @property
    def name(self) -> str:
        """Of its result, such as `traffic-plan-search-10ms`."""
        own = (
            self.label
            or f"{self.contender.name.replace(':', '-')}-{time_text(self.seconds).replace(' ', '')}"
        )
        return f"{self.benchmark}-{own}"

    @cached_property
    def options(self) -> dict[str, Any]:
        """All options of the planner, those by default too. Raises UsageError for one that does not fit."""
        if self.run is not None:
            return {
                "policy_sha256": sha256((self.run.path / "ckpt" / "last.json").read_text(encoding="utf-8"))
            }
        planner = planner_named(self.contender.method, **self.contender.options_on(self.benchmark))
        return asdict(planner) if is_dataclass(planner) and not isinstance(planner, type) else {}

    @property
    def evaluations(self) -> int | None:
        """Judged plans a start at most."""
        return None if math.isfinite(self.seconds) else self.contender.evaluations.get(self.benchmark)

    @property
    def key(self) -> Key:
        """The key of its result. Raises UsageError, SpecError, SystemFileError for a bad file."""
        return Key(
            self.name,
            {
                **inputs_of(load(self.benchmark)),
                **{"benchmark": self.benchmark, "contender": self.contender.name, "label": self.label},
                **{"planner": self.contender.method if self.run is None else REPLAYED},
                **{"options": self.options, "planner_version": PLANNING_VERSION},
                **{"seconds": self.seconds if math.isfinite(self.seconds) else None},
                **{"evaluations": self.evaluations, "starts": self.starts, "starts_seed": SEED, "seed": 0},
            },
        )

    def solver(self, task: Task) -> Solver:
        """The planner, prepared. Raises UsageError if it refuses the task, MissingError without a package."""
        if self.run is not None:
            return planner_named(REPLAYED, run=str(self.run.path)).prepare(task)
        return planner_named(self.contender.method, **self.contender.options_on(self.benchmark)).prepare(task)


def time_text(seconds: float) -> str:
    """A budget a plan, such as `10 ms`; `own settings` without a limit."""
    if math.isinf(seconds):
        return "own settings"
    return f"{1e3 * seconds:g} ms" if seconds < 1.0 else f"{seconds:g} s"


def measure(cell: PlanCell) -> Result:
    """Plan from all starts, then from some of them one at a time.

    Raises:
        MissingError: R301, a package is missing; nothing is known then.
    """
    task = load(cell.benchmark)
    states = task.sample(cell.starts, seed=SEED, dtype=torch.float64)
    budget = PlanBudget(cell.seconds, cell.evaluations)
    with one_thread():
        try:
            solver = cell.solver(task)
        except UsageError as error:
            return {"refused": reason(error)}
        found = _planned(task, solver, states, budget)
        alone = [_planned(task, solver, one[None], budget) for one in (*states[:WARM], *states[:ALONE])]
    alone = alone[min(WARM, cell.starts) :]
    solved, result = found.result.satisfied, found.result
    times = Times.of([float(each.seconds[0]) for each in alone])
    assert times is not None
    return {
        "accuracy": float(solved.double().mean()),
        "solved": pack(solved.tolist()),
        "infeasible": pack(result.infeasible.tolist()),
        "mean_ms": 1e3 * float(result.seconds.mean()),
        "evaluations": float(result.evaluations.double().mean()),
        "alone": {
            **{"median": times.median, "p99": times.p99, "samples": times.samples},
            "accuracy": sum(bool(each.result.satisfied[0]) for each in alone) / len(alone),
        },
    }


def _planned(task: Task, solver: Solver, states: Tensor, budget: PlanBudget) -> PlanSearch:
    search = PlanSearch(task, states, budget, seed=0)
    solver(search)
    return search


@dataclass(frozen=True, slots=True)
class PlanRow:
    """A planner, or a trained policy, on the starts of a benchmark.

    Attributes:
        benchmark: name of the specification.
        method: name of the contender.
        label: of a trained policy, such as `guided-60s-seed0`; "" for a planner.
        seconds: processor time a plan; None if its own settings end the search.
        starts: number of initial states.
        accuracy: share with a satisfying plan; None if the planner refuses the task.
        interval: its 95 % Wilson interval.
        infeasible: share of the starts proved to have no satisfying plan.
        mean_ms: processor time a plan, all starts in one batch.
        median_ms: of a decision, one start at a time.
        p99_ms: its 99th percentile.
        evaluations: judged plans a start.
        refused: why the planner refuses the task; "" if it does not.
        outdated: whether specification, system or version have changed since.
    """

    benchmark: str
    method: str
    label: str
    seconds: float | None
    starts: int
    accuracy: float | None
    interval: tuple[float, float] | None
    infeasible: float
    mean_ms: float | None
    median_ms: float | None
    p99_ms: float | None
    evaluations: float | None
    refused: str = ""
    outdated: bool = False

    @classmethod
    def of(cls, result: Result) -> PlanRow:
        """The row of a result."""
        key, alone = result["key"], result.get("alone", {})
        accuracy, starts = result.get("accuracy"), int(key["starts"])
        proved = unpack(result["infeasible"], starts) if "infeasible" in result else []
        return cls(
            *(key["benchmark"], key["contender"], key["label"], key["seconds"], starts, accuracy),
            interval=None if accuracy is None else wilson(accuracy, starts),
            infeasible=sum(proved) / starts,
            mean_ms=result.get("mean_ms"),
            median_ms=alone.get("median"),
            p99_ms=alone.get("p99"),
            evaluations=result.get("evaluations"),
            refused=result.get("refused", ""),
            outdated=is_outdated(result),
        )


def is_outdated(result: Result) -> bool:
    """True if the specification, the system or the version of planning has changed since a measurement."""
    return has_changed(result, {"planner_version": PLANNING_VERSION})


@dataclass(frozen=True, slots=True)
class Ceiling:
    """Shares of feasible and infeasible starts of a benchmark that all plans together show.

    Attributes:
        benchmark: name of the specification.
        starts: number of initial states.
        known: share with a known satisfying plan, a lower bound of the feasible share.
        proved: share proved to have none.
        contradictions: starts proved to have none for which a plan is known: a defect if there are any.
    """

    benchmark: str
    starts: int
    known: float
    proved: float
    contradictions: int


def ceilings(results: Iterable[Result]) -> dict[str, Ceiling]:
    """Known and proved shares of each benchmark, on the starts that most of its cells share."""
    groups: dict[str, list[Result]] = {}
    for each in results:
        if "solved" in each and not is_outdated(each):
            groups.setdefault(each["key"]["benchmark"], []).append(each)
    found = {}
    for name, own in groups.items():
        starts = max(int(each["key"]["starts"]) for each in own)
        same = [each for each in own if int(each["key"]["starts"]) == starts]
        known = [any(flags) for flags in zip(*(unpack(each["solved"], starts) for each in same), strict=True)]
        none = [
            any(flags) for flags in zip(*(unpack(each["infeasible"], starts) for each in same), strict=True)
        ]
        both = sum(a and b for a, b in zip(known, none, strict=True))
        found[name] = Ceiling(name, starts, sum(known) / starts, sum(none) / starts, both)
    return found


def improves(cell: PlanCell, store: ResultStore) -> bool:
    """True if a cell is worth its time: a long one only if ten times the time has found more plans before."""
    if cell.seconds < LONG or math.isinf(cell.seconds):
        return True
    shorter = [
        PlanCell(cell.benchmark, cell.contender, cell.seconds / by, cell.starts) for by in (100.0, 10.0)
    ]
    before = [store.find(each.key) for each in shorter]
    if any(each is None or "refused" in each for each in before):
        return not any(each is not None and "refused" in each for each in before)
    few, many = (float(each["accuracy"]) for each in before if each is not None)
    return many > few


def planned(
    cells: Iterable[PlanCell], store: ResultStore, *, measuring: Callable[[PlanCell], Result] = measure
) -> Measured:
    """Results of cells, stored or newly measured; those that are not worth their time are left out."""
    worth = (cell for cell in cells if improves(cell, store))
    return measured(worth, store, measuring, doing="planning", told=_summary)


def _summary(result: Mapping[str, Any]) -> str:
    if "refused" in result:
        return f"refused: {result['refused']}"
    return f"accuracy {result['accuracy']:.3f}  {result['mean_ms']:.3g} ms a plan"
