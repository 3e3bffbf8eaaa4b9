"""Planners: methods that search for the best plan from each given initial state, without training.

A planner proposes plans; `PlanSearch` judges them exactly in float64, keeps the best plan of each initial
state, and compares time and number of judged plans with the budget. A planner is one file in
`stlc.controller.search.planners`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass
from time import process_time
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

import torch
from torch import Tensor

from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.options import value_of
from stlc.controller.problem.rows import Rows
from stlc.diagnostics import usage
from stlc.native import Stop, never
from stlc.registry import PLANNERS

if TYPE_CHECKING:
    from stlc.controller.problem.task import Task

RATE = 50_000.0
"""Judged plans that count as a second where time is not limited."""
SECONDS = 1.0
"""Default budget per initial state, in seconds of processor time."""


@dataclass(frozen=True, slots=True)
class PlanBudget:
    """Limits of a search for plans; except for `stop`, they apply to each initial state separately.

    Attributes:
        seconds: processor time in seconds; the time of a batch is shared evenly among its initial states.
        evaluations: number of plans that are judged; None for no limit.
        target: robustness at which the search for an initial state ends; inf to maximise it until the budget
            is spent.
        stop: condition that ends the whole search early; the best plans until then are returned.
    """

    seconds: float = SECONDS
    evaluations: int | None = None
    target: float = 0.0
    stop: Stop = never


@dataclass(frozen=True, slots=True)
class PlanResult(Rows):
    """Plans from given initial states, judged exactly in float64.

    Attributes:
        states: initial states, (B, n).
        plans: the best plan found for each state, in physical units, (B, T, m).
        rho: robustness of that plan, (B,); -inf if no plan was found for which the states stay finite.
        infeasible: mask of the states from which the planner proved that no plan satisfies the specification,
            (B,).
        seconds: processor time spent on each state, (B,).
        evaluations: number of plans judged for each state, (B,) int64.
    """

    states: Tensor
    plans: Tensor
    rho: Tensor
    infeasible: Tensor
    seconds: Tensor
    evaluations: Tensor

    def __repr__(self) -> str:
        good, count = int(self.satisfied.sum()), len(self.rho)
        return f"PlanResult({good:,} of {count:,} plans satisfy it, least robustness {self.rho.min():.4g})"

    @property
    def satisfied(self) -> Tensor:
        """Mask of the initial states whose plan satisfies the specification, (B,)."""
        return TOLERANCE.satisfied(self.rho)

    @property
    def tried(self) -> PlanResult:
        """Results of the initial states for which a plan was judged or a proof was found."""
        return self.of((self.evaluations > 0) | self.infeasible)


class PlanSearch:
    """Search for plans in progress: the best plan of each initial state, and what was spent on it.

    Attributes:
        task: specification and system.
        states: initial states, (B, n) float64.
        budget: limits of the search.
        continued: True if the plans are followed, and another search begins from states on the way.
        generator: source of the random numbers of the planner.
        start: initial guesses of plans, within the control bounds, (B, T, m); the middle of every control
            range if none were given.
        plans: the best plans found, (B, T, m).
        rho: robustness of these plans, (B,); -inf before the first plan.
        worth: what these plans are compared by (`Task.preference`), (B,).
        infeasible: mask of the initial states from which the planner proved that no plan satisfies the
            specification, (B,).
        ended: mask of the initial states for which the planner has nothing more to try, (B,).
        seconds: processor time spent, (B,).
        evaluations: number of plans judged, (B,) int64.
    """

    def __init__(
        self,
        task: Task,
        states: Tensor,
        budget: PlanBudget,
        *,
        seed: int = 0,
        start: Tensor | None = None,
        progress: Callable[[PlanSearch], None] | None = None,
        continued: bool = False,
    ) -> None:
        self.task, self.budget, self.continued = task, budget, continued
        self.states = states.double()
        self.generator = torch.Generator().manual_seed(seed)
        low, high = task.system.control_low.double(), task.system.control_high.double()
        whole = (0.5 * (low + high)).expand(len(states), task.system.horizon, -1)
        self.start = whole if start is None else _guesses(start, whole).clamp(low, high)
        self.plans = self.start.clone()
        self.rho = torch.full((len(states),), -torch.inf, dtype=torch.float64)
        self.worth = self.rho.clone()
        self.infeasible = torch.zeros(len(states), dtype=torch.bool)
        self.ended = torch.zeros(len(states), dtype=torch.bool)
        self.seconds = torch.zeros(len(states), dtype=torch.float64)
        self.evaluations = torch.zeros(len(states), dtype=torch.int64)
        self._progress = progress

    @property
    def result(self) -> PlanResult:
        """The best plans found until now."""
        return PlanResult(self.states, self.plans, self.rho, self.infeasible, self.seconds, self.evaluations)

    @property
    def spent(self) -> Tensor:
        """Cost of the search for each state, (B,): processor time in seconds.

        If only the number of judged plans is limited, it is the time that these would take at `RATE`, so that
        equal seeds give equal plans.
        """
        limited = math.isfinite(self.budget.seconds) or self.budget.evaluations is None
        return self.seconds if limited else self.evaluations / RATE

    def open(self) -> Tensor:
        """Indices of the initial states for which the search is to continue, (k,).

        The search for a state ends when the best plan reaches the target robustness, when the budget is
        spent, or when the planner sets `infeasible` or `ended` for the state.
        """
        if self.budget.stop():
            return torch.zeros(0, dtype=torch.int64)
        going = (
            (self.rho < self.budget.target - TOLERANCE)
            & ~self.infeasible
            & ~self.ended
            & (self.seconds < self.budget.seconds)
        )
        if self.budget.evaluations is not None:
            going &= self.evaluations < self.budget.evaluations
        return going.nonzero()[:, 0]

    def allowed(self, rows: Tensor, most: int) -> int:
        """Number of plans, from 1 to `most`, that the limit of judged plans still allows for each state."""
        if self.budget.evaluations is None or not len(rows):
            return most
        return max(1, min(most, self.budget.evaluations - int(self.evaluations[rows].max())))

    def affordable(self, rows: Tensor, most: int) -> int:
        """Number of plans, from 1 to `most`, that the budget still allows for each state in `rows`."""
        left = float(self.allowed(rows, most))
        spent, judged = float(self.seconds[rows].sum()), int(self.evaluations[rows].sum())
        if judged and spent:
            left = min(left, (self.budget.seconds - float(self.seconds[rows].max())) * judged / spent)
        return max(1, int(left))

    def offer(self, rows: Tensor, plans: Tensor, *, evaluations: int | None = None) -> Tensor:
        """Judge plans and store each one that is better than the best plan of its initial state.

        A plan under which a state becomes infinite is not stored: the monitor judges no such trace. Plans
        beyond the limit of judged plans are not judged.

        Args:
            rows: indices of the initial states, (k,).
            plans: plans in physical units, (k, T, m), or p plans per state, (k, p, T, m); clipped to the
                control bounds.
            evaluations: number of evaluations to count per state, if the planner has judged other plans
                itself; by default the number of plans judged here.

        Returns:
            Robustness of the plans, (k,) or (k, p); -inf for those that were not judged.
        """
        whole = plans[:, None] if plans.dim() == 3 else plans
        each, system = whole, self.task.system
        if evaluations is None:
            each = whole[:, : self.allowed(rows, whole.shape[1])]
        each = each.double().clamp(system.control_low.double(), system.control_high.double())
        count = each.shape[1]
        x0 = self.states[rows].repeat_interleave(count, 0)
        judged = self.task.judge(x0, each.flatten(0, 1), states=False)
        rho, worth = judged.rho.view(-1, count), self.task.preference(judged).view(-1, count)
        value, which = worth.max(1)
        better = (value > self.worth[rows]).nonzero()[:, 0]
        if len(better):
            states = self.task.rollout(self.states[rows[better]], each[better, which[better]])
            better = better[torch.isfinite(states).all(2).all(1)]
        self.worth[rows[better]] = value[better]
        self.rho[rows[better]] = rho[better, which[better]]
        self.plans[rows[better]] = each[better, which[better]]
        self.evaluations[rows] += count if evaluations is None else evaluations
        if count < whole.shape[1]:
            rho = torch.cat((rho, rho.new_full((len(rho), whole.shape[1] - count), -torch.inf)), 1)
        return rho if plans.dim() == 4 else rho[:, 0]

    @contextmanager
    def charged(self, rows: Tensor) -> Iterator[None]:
        """Context whose processor time is added to `seconds`, in equal parts for the states `rows`, (k,).

        At the end of the context, the function `progress` is called, if the search was given one.
        """
        before = process_time()
        try:
            yield
        finally:
            self.seconds[rows] += (process_time() - before) / max(1, len(rows))
        if self._progress is not None:
            self._progress(self)


def _guesses(start: Tensor, whole: Tensor) -> Tensor:
    """Given initial guesses of plans in float64. Raises UsageError (U101) unless they are like `whole`."""
    found = torch.as_tensor(start, dtype=torch.float64)
    if found.shape != whole.shape:
        message = f"initial guesses of {tuple(found.shape)} are not {tuple(whole.shape)}"
        raise usage(message, "initial states, steps, controls")
    if not bool(torch.isfinite(found).all()):
        raise usage("initial guesses of plans hold NaN or infinity")
    return found


Solver: TypeAlias = Callable[[PlanSearch], None]
"""Function that improves the plans of a search until `PlanSearch.open` returns no state."""


class Planner(Protocol):
    """Interface of planners; a planner is a dataclass whose fields are its options."""

    def prepare(self, task: Task) -> Solver:
        """Return a function that improves the plans of a `PlanSearch` of this task within its budget.

        Raises:
            UsageError: U101, the planner cannot plan for this task; the message says why.
            MissingError: R301, the planner needs a package that is not installed.
        """


def is_planner(found: object) -> bool:
    """True for a dataclass with the method of `Planner`."""
    return isinstance(found, type) and is_dataclass(found) and callable(getattr(found, "prepare", None))


def planning_version(name: str) -> int:
    """Version of the planner `name`, raised when it finds other plans within a budget; at first 1."""
    return getattr(PLANNERS.get(name), "version", 1)


def planner_named(name: str, **options: Any) -> Planner:
    """Return the planner `name` with the given options.

    Args:
        name: name in `stlc.registry.PLANNERS`.
        options: fields of the planner; values may be texts, as on a command line.

    Raises:
        UsageError: U101, there is no such planner or option, or a value has the wrong type or is out of
            bounds.
    """
    kind = PLANNERS.get(name)
    known = {each.name: each for each in fields(kind)}
    values = {}
    for key, value in options.items():
        if key not in known:
            listed = f"options: {', '.join(known)}" if known else "it has none"
            raise usage(f"planner `{name}` has no option `{key}`").near(key, known, listed=listed)
        values[key] = value_of(f"planner `{name}`", known[key], value)
    planner: Planner = kind(**values)
    return planner


def prepared(planner: Planner, task: Task) -> Solver:
    """Return the function that improves the plans of a search with a planner.

    A system without controls has a single, empty plan, which is judged instead.
    """
    return planner.prepare(task) if task.system.decl.controls else _without_choice


def _without_choice(search: PlanSearch) -> None:
    """Judge the only plan of a system without controls."""
    rows = search.open()
    with search.charged(rows):
        search.offer(rows, search.start[rows])
    search.ended[rows] = True


def plan(
    task: Task,
    x0: Tensor,
    method: str = "search",
    *,
    budget: float | PlanBudget | None = None,
    seed: int = 0,
    start: Tensor | None = None,
    progress: Callable[[PlanSearch], None] | None = None,
    **options: Any,
) -> PlanResult:
    """Search for the best plan from each given initial state, without training.

    Args:
        task: specification and system.
        x0: initial states, (B, n) or (n,), in the order of `task.system.names`.
        method: name of a planner, or path of its file.
        budget: processor time per initial state in seconds, or further limits of the search; by default
            `SECONDS`.
        seed: seed of the planner's random numbers.
        start: initial guesses of plans, (B, T, m).
        progress: function that receives the search after each round.
        options: options of the planner.

    Returns:
        The best plans, judged exactly in float64.

    Raises:
        UsageError: U101, there is no such planner or option; or the planner cannot plan for this task; or the
            last dimension of `x0` differs from the number of states; or `start` has another shape or holds
            values that are not finite.
        MissingError: R301, the planner needs a package that is not installed.
    """
    given = torch.as_tensor(x0, dtype=torch.float64)
    states = given if given.dim() == 2 else given[None]
    names = task.system.names
    if states.dim() != 2 or states.shape[1] != len(names):
        raise usage(f"initial states of {tuple(given.shape)} are not (B, {len(names)})", ", ".join(names))
    solver = prepared(planner_named(PLANNERS.chosen(method), **options), task)
    limits = PlanBudget(budget) if isinstance(budget, int | float) else budget or PlanBudget()
    search = PlanSearch(task, states, limits, seed=seed, start=start, progress=progress)
    solver(search)
    return search.result
