"""Plans for whole missions, from which the training of a network begins.

A gradient does not find out in which order a mission is done: a search does. Therefore plans are searched for
some missions before the first step. Few of them often satisfy the specification from most starts, and the
network begins at those.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from stlc.controller.problem.task import Task
from stlc.controller.search.local_search import THOROUGH, Searcher, SearchResult
from stlc.controller.search.planner import PlanBudget, plan

EFFORTS = {16: 20_000, 4: 60_000}
"""Number of missions for which plans are searched -> plans judged for each; the next if none is found."""
TORCH_EFFORTS = {4: 2_000}
"""The same without compiled code, where judging takes some hundred times as long."""


@dataclass(frozen=True, slots=True)
class MissionPlans:
    """Satisfying plans for whole missions.

    Attributes:
        found: the plans, with their initial states and robustness.
        best: a few of the plans, which together satisfy the specification from most starts, (k, T, m); empty
            if none was found.
    """

    found: SearchResult
    best: Tensor


def mission_plans(task: Task, count: int, generator: torch.Generator) -> MissionPlans:
    """Search for plans for missions from random initial states.

    A local search raises the robustness of each plan found. One after the other, the plan is taken with which
    the robustness that one of the plans taken has at each start rises most.

    Args:
        task: specification and system, with plans that reach to the end of a mission.
        count: number of plans to choose, k; if fewer are found, they are repeated.
        generator: source of all random numbers.
    """
    compiled = task.native is not None
    for missions, judged in (EFFORTS if compiled else TORCH_EFFORTS).items():
        starts = task.sample(missions, generator=generator)
        seed = int(torch.randint(2**62, (), generator=generator))
        searched = plan(task, starts, budget=PlanBudget(torch.inf, judged), seed=seed)
        good = searched.satisfied
        if bool(good.any()):
            break
    x0, plans = starts[good], searched.plans[good].to(starts.dtype)
    if not len(x0):
        return MissionPlans(SearchResult(x0, plans, searched.rho[good]), plans)
    found = Searcher(task, generator, target=torch.inf).repair(
        x0, plans, plans, tries=THOROUGH if compiled else TORCH_EFFORTS[4]
    )
    every = starts.repeat(len(x0), 1), found.plans.repeat_interleave(len(starts), 0)
    most = float(found.rho.median())
    rho = task.judge(*every, states=False).rho.view(-1, len(starts)).clamp(-most, most)
    reached, best = torch.full_like(rho[0], -most), list[int]()
    for _ in range(count):
        best.append(int(torch.maximum(rho, reached).sum(1).argmax()))
        reached = torch.maximum(reached, rho[best[-1]])
    return MissionPlans(found, found.plans[best])
