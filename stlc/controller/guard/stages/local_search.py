"""Local search (random changes of plans) on the exact robustness, from the plans of the previous stage."""

from __future__ import annotations

import torch
from torch import Tensor

from stlc.controller.guard.candidates import REPAIRED, Candidates, Deadline
from stlc.controller.guard.stages import GuardStage, Rejected, Setup
from stlc.controller.problem.task import Task
from stlc.controller.search.local_search import Searcher


class LocalSearch(GuardStage):
    """Guard stage: local search for a plan that satisfies the specification.

    If the result is unsafe, a second search starts from it, with the requirements tagged `@safety` as its
    only specification.
    """

    def __init__(self, setup: Setup) -> None:
        task, generator = setup.task, setup.generator
        self.task, self.tries = task, setup.limits.tries
        self.whole = self._safe = Searcher(task, generator, target=setup.target)
        if 0 < len(task.compiled.safety) < len(task.rules):
            self._safe = Searcher(task.safety_task, generator, target=setup.target)

    def wanted(self, best: Candidates) -> Tensor:
        """Mask of the agents whose plan has less than the target robustness."""
        return best.rho < self.whole.target

    def propose(self, rejected: Rejected, rows: Tensor, _deadline: Deadline) -> Candidates:
        """Return the best plan of each agent: its present plan, or the result of a local search.

        One local search begins at each starting plan of the agent. If the previous stage stored plans for all
        agents, these are taken; else the policy's plan and, if there is one, the previous plan.
        """
        x, found = rejected.x[rows], rejected.best.of(rows)
        if len(rejected.tried) == 1 and len(rejected.tried[0].rows) == len(rejected.x):
            starts = rejected.tried[0].candidates.plans[rejected.tried[0].rows.argsort()]
        else:
            plans = [rejected.plan] if rejected.previous is None else [rejected.plan, rejected.previous]
            starts = torch.stack(plans, 1)
        every = torch.arange(len(rows), device=rows.device)
        found.improve(every, best_improved(self.whole, x, starts[rows], self.tries))
        unsafe = (~found.is_safe).nonzero()[:, 0]
        if len(unsafe) and self._safe is not self.whole:
            starts = found.plans[unsafe][:, None]
            improved = best_improved(self._safe, x[unsafe], starts, self.tries, self.task)
            found.improve(unsafe, improved)
        return found


def best_improved(
    searcher: Searcher, x: Tensor, starts: Tensor, tries: int, task: Task | None = None
) -> Candidates:
    """Run a local search from each starting plan, (agents, k, T, m); return the best plan per agent.

    `task`: task that judges the plans found; that of `searcher` if None. `tries`: number of plans judged per
    search.
    """
    found = improved_from(searcher, x, starts, tries, task)
    return found.pick(found.standing.argmax(1))


def improved_from(
    searcher: Searcher, x: Tensor, starts: Tensor, tries: int, task: Task | None = None
) -> Candidates:
    """Run a local search from each starting plan, (agents, k, T, m); return their results, (agents, k).

    `task`: task that judges the plans found; that of `searcher` if None. `tries`: number of plans judged per
    search.
    """
    rows = x.repeat_interleave(starts.shape[1], 0)
    threads = torch.get_num_threads()
    plans = searcher.repair(rows, starts.flatten(0, 1), tries=tries, threads=threads).plans
    return Candidates.judged(task or searcher.task, x, plans.view(starts.shape), REPAIRED)


STAGE = LocalSearch
