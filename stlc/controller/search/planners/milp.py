"""`milp`: mixed-integer linear programming by HiGHS (Huangfu & Hall 2018), in the extra `plan`.

This planner applies to piecewise linear systems. It uses the big-M encodings of Karaman et al. (2008) and
Raman et al. (2014). No other planner can prove that no plan from an initial state satisfies the
specification.
"""

from __future__ import annotations

import gc
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from time import process_time
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from stlc.compile.backends.milp.encode import MARGIN, Demand, Encoding
from stlc.compile.backends.milp.model import ZERO, Affine, Arrays, UnencodableError, constant
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.options import bounded
from stlc.controller.search.local_search import Searcher
from stlc.controller.search.starts import extremes
from stlc.diagnostics import usage
from stlc.extras import needed
from stlc.native import Stop

if TYPE_CHECKING:
    from torch import Tensor

    from stlc.controller.problem.task import Task
    from stlc.controller.search.planner import PlanSearch, Solver

FOUND, IMPOSSIBLE, UNKNOWN = "found", "impossible", "unknown"
FINEST = 1e-9
"""Feasibility tolerance of the solver, well below `MARGIN`, the distance kept from boundaries."""
MOST_RHO = 1e6


@dataclass(frozen=True, slots=True)
class Milp:
    """Mixed-integer linear program for each initial state, solved by HiGHS.

    If the program has no solution, a second one is solved, whose solutions include all satisfying plans. If
    the second has none either, no plan from the initial state satisfies the specification.

    Attributes:
        gap: relative optimality gap at which the maximisation of robustness ends.
        prove: whether to solve the second program.
        tries: number of plans that a local search tries first, for each initial state. A program is solved
            only for the states where these plans miss the target robustness. 0: no local search.
    """

    gap: float = bounded(1e-3, 0, 1)
    prove: bool = True
    tries: int = bounded(0, 0, 10**9)

    def prepare(self, task: Task) -> Solver:
        """Return a function that searches for plans by mixed-integer linear programs.

        The programs for a few random initial states are built before the search, to report expressions that
        cannot be encoded.

        Raises:
            UsageError: U101, an expression has no mixed-integer linear form; the message shows it.
            MissingError: R301, HiGHS is not installed.
        """
        highspy = needed("highspy", "planner `milp` needs")
        for state in task.sample(8, seed=0, dtype=torch.float64):
            _encoded(task, state, 0.0, tight=True)
        return partial(self._run, highs=highspy)

    def _run(self, search: PlanSearch, highs: Any) -> None:
        if self.tries:
            self._search(search)
        for row in search.open().tolist():
            with search.charged(torch.tensor([row])), _without_collection():
                self._solve(search, row, highs)
            if not len(search.open()):
                return

    def _search(self, search: PlanSearch) -> None:
        """Run a short local search for all initial states together, and offer its plans to `search`."""
        rows, task = search.open(), search.task
        with search.charged(rows):
            searcher = Searcher(task, search.generator, target=search.budget.target or TOLERANCE)
            guesses = extremes(task, search.generator).double()
            count = search.affordable(rows, self.tries)
            found = searcher.repair(
                search.states[rows], search.start[rows], guesses, tries=count, stop=search.budget.stop
            )
            search.offer(rows, found.plans, evaluations=count)

    def _solve(self, search: PlanSearch, row: int, highs: Any) -> None:
        """Find a satisfying plan from the initial state with index `row`, or prove that there is none.

        The plan or the proof is stored in `search`. If time runs out, there may be neither.
        """
        task, state, budget = search.task, search.states[row], search.budget
        limit = _Limit(process_time() + budget.seconds - float(search.seconds[row]), budget.stop)
        known = max(0.0, float(search.rho[row]))
        search.ended[row] = True
        for beyond in (MARGIN, -TOLERANCE / 2.0):  # off the boundary; then on it, where timers end exactly
            goal = _Goal(budget.target + beyond, known)
            found, plan = self._solved(task, state, goal, limit, highs, tight=True)
            search.evaluations[row] += 1
            if plan is not None:
                rho = search.offer(torch.tensor([row]), plan[None], evaluations=0)
                if float(rho) >= min(budget.target, 0.0) - TOLERANCE:
                    return
            elif found == IMPOSSIBLE and beyond > 0.0 and self.prove and TOLERANCE.violated(search.rho[row]):
                proof, _ = self._solved(task, state, _Goal(0.0), limit, highs, tight=False)
                search.infeasible[row] = proof == IMPOSSIBLE
                if proof == IMPOSSIBLE:
                    return
            if limit.reached():
                return

    def _solved(
        self, task: Task, state: Tensor, goal: _Goal, limit: _Limit, highs: Any, *, tight: bool
    ) -> tuple[str, Tensor | None]:
        """Search for a plan from the state `state`, (n,), that reaches the robustness in `goal`.

        Args:
            task: specification and system.
            state: the initial state, (n,).
            goal: the robustness to be reached.
            limit: condition that ends the solve early.
            highs: the module of HiGHS.
            tight: if True, every solution of the program is a plan with this robustness. If False, all plans
                with this robustness are solutions, but not only these. The program then serves only to prove
                that there is no such plan.

        Returns:
            A result: `FOUND`, `IMPOSSIBLE` (there is no solution) or `UNKNOWN`; and the plan, (T, m), or None
            if the result is not `FOUND`.
        """
        encoding, cost = _encoded(task, state, goal.target, known=goal.known, tight=tight)
        if not encoding.model.feasible:
            return IMPOSSIBLE, None
        if limit.reached():
            return UNKNOWN, None
        solver = highs.Highs()
        options: dict[str, Any] = {"output_flag": False, "threads": 1, "mip_rel_gap": self.gap}
        options |= {"mip_feasibility_tolerance": FINEST, "primal_feasibility_tolerance": FINEST}
        options |= {"presolve": "off", "mip_heuristic_effort": 0.0}  # both cost more than they save here
        for name, value in options.items():
            solver.setOptionValue(name, value)
        solver.cbMipInterrupt.subscribe(limit.interrupt)
        solver.passModel(_program(encoding.model.arrays(cost), highs))
        solver.run()
        if solver.getModelStatus() == highs.HighsModelStatus.kInfeasible:
            return IMPOSSIBLE, None
        if solver.getInfo().primal_solution_status != 2 or not tight:
            return UNKNOWN, None
        values = np.array(solver.getSolution().col_value)
        return FOUND, torch.tensor([[_at(each, values) for each in inputs] for inputs in encoding.controls])


@dataclass(frozen=True, slots=True)
class _Goal:
    """Robustness that a plan must reach.

    Attributes:
        target: the robustness to be reached; inf: the robustness is to be as large as possible.
        known: robustness of a plan that is already known, or 0. If `target` is inf, plans below this value
            are excluded.
    """

    target: float
    known: float = 0.0


@dataclass(frozen=True, slots=True)
class _Limit:
    """Condition that ends a solve: the budget of processor time is spent, or the whole search ends.

    The time limit of HiGHS is not used, since elapsed time depends on the other processes on the machine.
    HiGHS does not check the condition within its sub-programs, so a solve may end some tenths of a second
    late.

    Attributes:
        until: end of the budget on the clock of processor time.
        stop: condition that ends the whole search.
    """

    until: float
    stop: Stop

    def reached(self) -> bool:
        """True if the solve has to end."""
        return process_time() >= self.until or bool(self.stop())

    def interrupt(self, event: Any) -> None:
        """Interrupt HiGHS if the solve has to end; HiGHS calls this between linear programs."""
        if self.reached():
            event.interrupt()


@contextmanager
def _without_collection() -> Iterator[None]:
    """Context without cyclic garbage collection.

    A program consists of tens of thousands of small objects without cycles. Their creation would trigger
    collections, each of which visits all objects of the process.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def _at(form: Affine, values: Any) -> float:
    return form.const + sum(factor * float(values[index]) for index, factor in form.terms.items())


def _encoded(
    task: Task, state: Tensor, target: float, *, known: float = 0.0, tight: bool
) -> tuple[Encoding, Affine]:
    """Encode the search for a plan from the state `state`; return the program and the cost to be minimised.

    If `target` is finite, the robustness of the plan must be at least `target`, and the cost is 0. If
    `target` is inf, the robustness must be at least `known`, and the cost is the negative robustness.
    `tight`: if True, every solution of the program is a plan with this robustness. If False, all plans with
    this robustness are solutions, but not only these.

    Raises:
        UsageError: U101, an expression has no mixed-integer linear form.
    """
    encoding, system = Encoding(tight=tight, end=task.compiled.end), task.system
    step = system.exact_step
    low, high = system.control_low.tolist(), system.control_high.tolist()
    bounds = dict(zip(system.control_names, zip(low, high, strict=True), strict=True))
    maximise = math.isinf(target)
    try:
        x0 = dict(zip(task.system.names, state.tolist(), strict=True))
        rho = encoding.model.variable(known, MOST_RHO) if maximise else constant(target)
        factors = [rule.factor for rule in task.rules]
        wanted = [
            Demand(rule.formula, rho.times(1.0 / factor))
            for rule, factor in zip(task.rules, factors, strict=True)
        ]
        trees = encoding.rollout(x0, bounds, step.lets, step.next, task.system.horizon, wanted)
        for tree, factor in zip(trees, factors, strict=True):
            if maximise:
                encoding.model.limit(rho, factor * encoding.model.most(tree))
            encoding.model.imply(ZERO, tree)
    except UnencodableError as what:
        raise usage(f"planner `milp` cannot encode {what}", "search plans for any system") from None
    return encoding, rho.times(-1.0) if maximise else ZERO


def _program(arrays: Arrays, highs: Any) -> Any:
    """Convert a program, given as arrays, to the form that HiGHS reads."""
    program, inf = highs.HighsLp(), highs.kHighsInf
    program.num_col_, program.num_row_ = len(arrays.lower), len(arrays.row_lower)
    program.col_cost_, program.col_lower_, program.col_upper_ = arrays.cost, arrays.lower, arrays.upper
    program.row_lower_ = np.where(np.isinf(arrays.row_lower), -inf, arrays.row_lower)
    program.row_upper_ = np.where(np.isinf(arrays.row_upper), inf, arrays.row_upper)
    program.a_matrix_.format_ = highs.MatrixFormat.kRowwise
    program.a_matrix_.start_, program.a_matrix_.index_ = arrays.starts, arrays.indices
    program.a_matrix_.value_ = arrays.values
    kinds = highs.HighsVarType.kContinuous, highs.HighsVarType.kInteger
    program.integrality_ = [kinds[int(each)] for each in arrays.integer]
    return program


PLANNER = Milp
