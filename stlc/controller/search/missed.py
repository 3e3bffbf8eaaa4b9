"""Requirements that the best plans violate, and planners that satisfy them where another one did not."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.problem.task import Task
from stlc.controller.search.planner import PlanBudget, plan
from stlc.diagnostics import StlcError

STRUCTURED = ("schedule", "milp")
"""Planners that use the structure of a specification, for which a local search finds no plan."""
SHARE, LEAST_SECONDS, MOST_SECONDS = 0.3, 0.05, 0.5
"""Time for all of them: share of the time already spent; seconds per plan: not tried for less, at most."""
STARTS = 2
"""Number of initial states from which they are tried."""


@dataclass(frozen=True, slots=True)
class Missed:
    """Requirement that best plans violate.

    Attributes:
        requirement: its name.
        starts: number of initial states whose best plan violates it.
        robustness: greatest robustness of these plans; -inf if it was lost before the plans began.
    """

    requirement: str
    starts: int
    robustness: float


@dataclass(frozen=True, slots=True)
class BetterPlanner:
    """Planner that found satisfying plans where another one found none.

    Attributes:
        method: its name.
        satisfied: number of initial states from which it found a satisfying plan.
        starts: number of initial states from which it was tried.
        seconds: mean processor time of a plan.
    """

    method: str
    satisfied: int
    starts: int
    seconds: float


def missed(task: Task, x0: Tensor, plans: Tensor) -> tuple[Missed, ...]:
    """Requirements that plans violate, the one that most of them violate first.

    Args:
        task: specification and system.
        x0: initial states, (B, n).
        plans: the best plan known from each, (B, T, m).
    """
    each = task.judge(x0.double(), plans.double(), states=False).requirements
    violated = ~TOLERANCE.satisfied(each)
    found = [
        Missed(rule.name, int(failing.sum()), float(values[failing].max()))
        for rule, failing, values in zip(task.rules, violated.T, each.T, strict=True)
        if bool(failing.any())
    ]
    return tuple(sorted(found, key=lambda one: -one.starts))


def better_planner(task: Task, x0: Tensor, tried: str, seconds: float) -> BetterPlanner | None:
    """The first of the structured planners that finds satisfying plans in a short time; None if none does.

    Args:
        task: specification and system.
        x0: initial states from which no satisfying plan was found, (B, n).
        tried: name of the planner that found none.
        seconds: processor time that it took; the others get the share `SHARE` of it.
    """
    states = x0[:STARTS].double()
    names = [name for name in STRUCTURED if name != tried]
    limit = min(SHARE * seconds / (len(names) * max(1, len(states))), MOST_SECONDS)
    for name in names if len(states) and limit >= LEAST_SECONDS else ():
        try:
            found = plan(task, states, name, budget=PlanBudget(limit))
        except StlcError:  # it cannot plan for this task, or its package is missing
            continue
        good = int(found.satisfied.sum())
        if good:
            return BetterPlanner(name, good, len(states), float(found.seconds.mean()))
    return None
