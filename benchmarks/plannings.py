"""Measurements of planners: one planner on one benchmark with one time budget per plan.

All planners plan from the same initial states (starts). Each result is stored as soon as it is measured. If a
planner cannot solve a task, the reason is stored instead. Trained policies are measured in the same way:
their plans are judged, and the time of a plan is measured.
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
from stlc.controller.problem.task import Task
from stlc.controller.search.planner import PlanBudget, PlanSearch, Solver, planner_named, planning_version
from stlc.diagnostics import UsageError
from stlc.provenance import sha256
from stlc.rundir import RunDir

SEED = 12_345
"""Seed of the initial states; they serve only for reports, never for training."""
STARTS = 1_000
SECONDS = (0.001, 0.01, 0.1, 1.0)
"""Time budgets: processor time per plan in seconds."""
LONG = 1.0
"""A time budget (s) from which on a planner is measured only if more time has found more plans before."""
ALONE = 100
"""Number of initial states from which plans are computed singly, to time a decision."""


@dataclass(frozen=True)
class PlanCell:
    """Description of one measurement of a planner or of a trained policy.

    Attributes:
        benchmark: name of the specification.
        contender: the planner and its options.
        seconds: processor time per plan; inf if the planner's own settings end its search.
        starts: number of initial states.
        run: run of the trained policy whose plans are judged; None for a planner.
        label: label of that policy, such as `guided-60s-seed0`; "" for a planner.
    """

    benchmark: str
    contender: Contender
    seconds: float
    starts: int = STARTS
    run: RunDir | None = None
    label: str = ""

    @property
    def name(self) -> str:
        """Name under which the result is stored, such as `traffic-plan-search-10ms`."""
        own = (
            self.label
            or f"{self.contender.name.replace(':', '-')}-{time_text(self.seconds).replace(' ', '')}"
        )
        return f"{self.benchmark}-{own}"

    @property
    def planner(self) -> str:
        """Name of the planner; of the one that replays plans, for a trained policy."""
        return self.contender.method if self.run is None else REPLAYED

    @cached_property
    def options(self) -> dict[str, Any]:
        """All options of the planner, including defaults; for a trained policy, the hash of its checkpoint.

        Raises:
            UsageError: an option is invalid.
        """
        if self.run is not None:
            return {
                "policy_sha256": sha256((self.run.path / "ckpt" / "last.json").read_text(encoding="utf-8"))
            }
        planner = planner_named(self.contender.method, **self.contender.options_on(self.benchmark))
        return asdict(planner) if is_dataclass(planner) and not isinstance(planner, type) else {}

    @property
    def evaluations(self) -> int | None:
        """Largest number of plans that the planner evaluates per initial state; None without such a limit."""
        return None if math.isfinite(self.seconds) else self.contender.evaluations.get(self.benchmark)

    @property
    def key(self) -> Key:
        """Key under which the result is stored: its name and all its inputs.

        Raises:
            UsageError, SpecError, SystemFileError: an input file is missing or invalid.
        """
        return Key(
            self.name,
            {
                **inputs_of(load(self.benchmark)),
                **{"benchmark": self.benchmark, "contender": self.contender.name, "label": self.label},
                **{"planner": self.planner, "planner_version": planning_version(self.planner)},
                **{"options": self.options},
                **{"seconds": self.seconds if math.isfinite(self.seconds) else None},
                **{"evaluations": self.evaluations, "starts": self.starts, "starts_seed": SEED, "seed": 0},
            },
        )

    def solver(self, task: Task) -> Solver:
        """Return the planner, prepared for `task`.

        Raises:
            UsageError: the planner cannot solve this task.
            MissingError: a package is missing.
        """
        if self.run is not None:
            return planner_named(REPLAYED, run=str(self.run.path)).prepare(task)
        return planner_named(self.contender.method, **self.contender.options_on(self.benchmark)).prepare(task)


def time_text(seconds: float) -> str:
    """Return a time budget per plan as text, such as `10 ms`; inf gives `own settings`."""
    if math.isinf(seconds):
        return "own settings"
    return f"{1e3 * seconds:g} ms" if seconds < 1.0 else f"{seconds:g} s"


def measure(cell: PlanCell) -> Result:
    """Measure a planner or policy: plan from all initial states in one batch, then from some of them singly.

    If the planner cannot solve the task, the result contains only the reason, under the key `refused`.

    Raises:
        MissingError: R301, a package is missing.
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
    """Results of a planner, or of a trained policy, on the initial states (starts) of a benchmark.

    Attributes:
        benchmark: name of the specification.
        method: name of the method.
        label: label of a trained policy, such as `guided-60s-seed0`; "" for a planner.
        seconds: processor time per plan; None if the planner's own settings end its search.
        starts: number of initial states.
        accuracy: share of the starts for which a satisfying plan was found; None if the planner cannot solve
            the task.
        interval: 95 % Wilson interval of `accuracy`.
        infeasible: share of the starts from which provably no satisfying plan exists.
        mean_ms: mean processor time per plan, with all starts in one batch.
        median_ms: median processor time of a plan from a single start.
        p99_ms: 99th percentile of the processor time of a plan from a single start.
        evaluations: mean number of plans that were evaluated per start.
        refused: reason why the planner cannot solve the task; "" if it can.
        outdated: whether the specification, the system or the planners' version has changed since the
            measurement.
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
        """Return the row of the table that shows a stored result."""
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
    """True if the specification, the system or the planners' version has changed since a measurement."""
    return has_changed(result, {"planner_version": planning_version(result["key"]["planner"])})


@dataclass(frozen=True, slots=True)
class FeasibleBounds:
    """Shares of a benchmark's initial states (starts) that are known to be feasible, or proved infeasible.

    They are computed from the stored results of all planners and policies together.

    Attributes:
        benchmark: name of the specification.
        starts: number of initial states.
        known: share of the starts from which a satisfying plan is known; a lower bound of the feasible share.
        proved: share of the starts from which provably no satisfying plan exists.
        contradictions: number of starts with both a known plan and a proof that none exists. This must be 0.
    """

    benchmark: str
    starts: int
    known: float
    proved: float
    contradictions: int


def feasible_bounds(results: Iterable[Result]) -> dict[str, FeasibleBounds]:
    """Return for each benchmark the shares of starts with a known plan, and with a proof that no plan exists.

    Of each benchmark, only the results with the greatest number of starts are used.
    """
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
        found[name] = FeasibleBounds(name, starts, sum(known) / starts, sum(none) / starts, both)
    return found


def improves(cell: PlanCell, store: ResultStore) -> bool:
    """True if a measurement is worth its time.

    A measurement with a short time budget always is. A measurement with a long time budget is worth its time
    if, between two shorter budgets, ten times the time found more plans.
    """
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
    """Return the results of the measurements `cells`; those that are not stored yet are carried out now.

    Measurements that are not worth their time (see `improves`) are left out. `measuring` is the function that
    carries out a measurement.
    """
    worth = (cell for cell in cells if improves(cell, store))
    return measured(worth, store, measuring, doing="planning", told=_summary)


def _summary(result: Mapping[str, Any]) -> str:
    if "refused" in result:
        return f"refused: {result['refused']}"
    return f"accuracy {result['accuracy']:.3f}  {result['mean_ms']:.3g} ms a plan"
