"""Feasibility: search for a plan that satisfies the specification, or at least its safety requirements."""

from __future__ import annotations

import torch
from torch import Tensor

from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.problem.task import Task
from stlc.controller.search.local_search import THOROUGH, Searcher, SearchResult
from stlc.controller.search.starts import extremes
from stlc.native import Stop, never

PASSES = 4
TRIES = 20_000
"""Number of plans judged per state and pass if native code judges them."""
TARGET = 1e-4
"""Target robustness at which the search from a state ends."""


@torch.no_grad()
def solve(
    task: Task,
    x0: Tensor,
    start: Tensor | None = None,
    library: Tensor | None = None,
    passes: int = PASSES,
    *,
    tries: int | None = None,
    generator: torch.Generator | None = None,
    stop: Stop = never,
) -> SearchResult:
    """Search for a satisfying plan from each state; equal arguments give equal plans.

    The search consists of passes of a local search, which changes plans at random. The first pass starts from
    the plans `start`. Each later pass starts from random plans of `library`, and is made only for the states
    without a satisfying plan. The returned robustness is exact. If no satisfying plan is found from a state,
    there may still be one.

    Args:
        task: specification and system.
        x0: states, (B, n).
        start: starting plans, (B, T, m). None: plans that hold each control at the middle of its range.
        library: plans for later passes, (k, T, m); the search also copies parts of these plans into others.
            None: plans of 3 constant pieces at the ends and middles of the control ranges (see `extremes`).
        passes: maximum number of passes.
        tries: number of plans judged per pass and state.
        generator: source of the random numbers of the search; a generator with seed 0 if None.
        stop: function that returns True to end the search early.

    Returns:
        The best plan found from each state, and its robustness, in float64. The robustness is -inf for a
        state whose search was stopped before it began.
    """
    if not task.system.decl.controls:  # nothing to search for
        plans = x0.new_zeros((len(x0), task.horizon, 0), dtype=torch.float64)
        return SearchResult(x0, plans, task.judge(x0.double(), plans, states=False).rho)
    generator = generator or torch.Generator().manual_seed(0)
    if library is None:
        library = extremes(task, torch.Generator().manual_seed(0))
    if start is None:
        middle = 0.5 * (task.system.control_low + task.system.control_high)
        start = middle.expand(len(x0), task.horizon, -1)
    tries = tries or (THOROUGH if task.native is None else TRIES)
    searcher = Searcher(task, generator, target=TARGET)
    best = SearchResult(x0, start.double().clone(), x0.new_full((len(x0),), -torch.inf, dtype=torch.float64))
    for number in range(passes):
        if number:
            start = library[torch.randint(len(library), (len(x0),), generator=generator)]
        still = torch.nonzero(TOLERANCE.violated(best.rho)).squeeze(1)
        if not len(still) or stop():
            break
        begun = x0[still].float(), start[still].float()
        plans = searcher.repair(*begun, library.float(), tries=tries, stop=stop).plans.double()
        best.plans[still] = plans
        best.rho[still] = task.judge(x0[still].double(), plans, states=False).rho
    return best


def solvable(task: Task, x0: Tensor) -> Tensor:
    """Mask of the states from which a search finds a satisfying plan: (B, n) -> (B,)."""
    return TOLERANCE.satisfied(solve(task, x0).rho)


def viable(task: Task, x0: Tensor) -> Tensor:
    """Mask of the states from which a search finds a safe plan: (B, n) -> (B,).

    A plan is safe if it satisfies the requirements tagged `@safety`. If there are none, all entries are True.
    """
    if not task.compiled.safety:
        return torch.ones(len(x0), dtype=torch.bool)
    return solvable(task.safety_task, x0)
