"""Policy that lets a planner search for a plan from each state."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.policies.policy import Policy
from stlc.controller.problem.task import PlanVerdicts, Task
from stlc.controller.search.planner import PlanBudget, Planner, PlanSearch, Solver, planner_named, prepared
from stlc.diagnostics import usage

SHORT = 64
"""Number of plans judged in the search for a plan that continues a prefix."""
FIRST = 50
"""Budgets of a decision that the first plan of a mission may take: it is made before the mission begins."""


@dataclass(frozen=True, slots=True)
class PlannerChoice:
    """A planner for closed-loop planning, with its options.

    Attributes:
        name: name in `stlc.registry.PLANNERS`.
        options: options of the planner, name -> text.
        seconds: processor time for each plan, in seconds.
        evaluations: maximum number of candidate plans that are judged to find a plan; None for no limit.
    """

    name: str
    options: Mapping[str, str]
    seconds: float
    evaluations: int | None = None


@dataclass(frozen=True, slots=True)
class SearchUse:
    """Use of the budget by the searches of a policy that plans, one search for each decision.

    Attributes:
        budget: allowed processor time of a search, in seconds.
        searches: number of searches.
        median: median of the processor time, in seconds.
        p99: 99 % quantile of the processor time, in seconds.
        early: share of the searches that ended before the budget was spent, as the plan was good enough.
    """

    budget: float
    searches: int
    median: float
    p99: float
    early: float


class PlannerPolicy(Policy):
    """Policy that lets a planner search for a plan from each state, within the planner's budget."""

    def __init__(self, task: Task, planner: Planner, budget: PlanBudget, *, seed: int = 0) -> None:
        super().__init__(task)
        self._planner, self._budget, self._seed = planner, budget, seed
        self._prepared = task, prepared(planner, task)
        self._short: tuple[Task, Solver] | None = None
        self._clock = None if task.compiled.grid.end is None else task.clock
        self._spent: list[Tensor] = []
        self._reached: list[Tensor] = []

    def take_use(self) -> SearchUse | None:
        """Use of the budget since the last call, by the policy and its copies; None without a search."""
        if not self._spent:
            return None
        spent, reached = torch.cat(self._spent), torch.cat(self._reached)
        self._spent.clear()
        self._reached.clear()
        middle, most = spent.quantile(torch.tensor([0.5, 0.99], dtype=spent.dtype)).tolist()
        return SearchUse(self._budget.seconds, len(spent), middle, most, float(reached.double().mean()))

    def candidates(self, x0: Tensor) -> Tensor:
        """The best plan found from each state: (B, n) -> (B, 1, T, m)."""
        return self._decided(x0)[:, None]

    @torch.no_grad()
    def plan_judged(self, x0: Tensor, rest: Tensor | None = None) -> tuple[Tensor, PlanVerdicts]:
        plans = self._decided(x0, rest)
        return plans, self.task.judge(x0, plans)

    def _decided(self, x0: Tensor, rest: Tensor | None = None) -> Tensor:
        """Search within the budget; it begins at `rest`, (B, T, m), which is kept if it is good enough.

        A search draws other random numbers than the one before: what has failed is not tried again.
        """
        if self._prepared[0] is not self.task:
            self._prepared = self.task, prepared(self._planner, self.task)
        budget = self._budget
        if self._clock is not None and bool((x0[:, self._clock] == 0.0).all()):
            budget = replace(budget, seconds=FIRST * budget.seconds)
        search = self._searched(x0, self._prepared[1], budget, rest, seed=self._seed + len(self._spent))
        self._spent.append(search.seconds)
        self._reached.append(search.rho >= self._budget.target - TOLERANCE)
        return search.plans.to(x0.dtype)

    def continuation(self, x0: Tensor) -> Tensor:
        """Plans found by a short local search from each state: (B, n) -> (B, T, m).

        The planner of this policy is not used here, because it would take too long.
        """
        if self._short is None or self._short[0] is not self.task:
            self._short = self.task, prepared(planner_named("search", tries=SHORT), self.task)
        found = self._searched(x0, self._short[1], PlanBudget(torch.inf, SHORT), seed=self._seed)
        return found.plans.to(x0.dtype)

    def _searched(
        self, x0: Tensor, solver: Solver, budget: PlanBudget, rest: Tensor | None = None, *, seed: int = 0
    ) -> PlanSearch:
        search = PlanSearch(self.task, x0, budget, seed=seed, start=rest, continued=True)
        with torch.enable_grad():
            if rest is not None:
                rows = torch.arange(len(x0))
                with search.charged(rows):
                    search.offer(rows, search.start)
            solver(search)
        return search


def planner_policy(task: Task, choice: PlannerChoice, *, seed: int = 0) -> PlannerPolicy:
    """Return the planner `choice` as a policy for `task`. Raises UsageError (U101), see `planner_of`."""
    budget = PlanBudget(choice.seconds, choice.evaluations)
    return PlannerPolicy(task, planner_of(choice.name, choice.options), budget, seed=seed)


def planner_of(name: str, options: Mapping[str, str]) -> Planner:
    """Return the planner `name` with its options, for planning in closed loop.

    Raises:
        UsageError: U101, there is no such planner or option; or `name` is `policy`, the planner that takes
            the plans of a trained policy. In closed loop, simulate the run of this policy instead.
    """
    if name == "policy":
        raise usage(
            "planner `policy` takes the plans of a trained run", "simulate that run: stlc simulate RUN"
        )
    return planner_named(name, **options)
