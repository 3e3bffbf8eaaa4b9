"""Search for better plans by the stages (search methods) of a guard, without and with robustness margins."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.guard.candidates import REPAIRED, SAFEST, Candidates, Deadline, Limits, finite, grid_of
from stlc.controller.guard.safe_prefix import robustness_until
from stlc.controller.guard.stages import STAGES, Rejected, Setup
from stlc.controller.search.ascent import SEED
from stlc.controller.search.local_search import Searcher

if TYPE_CHECKING:
    from stlc.controller.guard.kind import GuardKind
    from stlc.controller.policies.policy import Policy
    from stlc.controller.problem.task import Task
    from stlc.runtime.prefixes import PrefixGrid


class GuardSearch(ABC):
    """Search of a guard for better plans.

    Attributes:
        task: specification and system by which plans are judged.
        policy: policy that proposes plans, and completes those that the search begins.
        limits: computational limits of a decision.
    """

    task: Task
    policy: Policy
    limits: Limits

    def passes(self, x: Tensor, found: Candidates) -> Tensor:  # noqa: ARG002
        """Mask of the agents whose plan in `found` is followed without a search, (agents,).

        `x`: states, (agents, n) float64.
        """
        return found.satisfies

    @torch.no_grad()
    def search(self, x: Tensor, plan: Tensor, previous: Tensor | None = None) -> Candidates:
        """Search for better plans in states whose plan was rejected.

        Args:
            x: states, (agents, n) float64.
            plan: (agents, T, m), the policy's plan; entries that are not finite are replaced.
            previous: (agents, T, m), remainders of the previous plans.

        Returns:
            The plan that ranks highest among the proposals, one per agent.
        """
        plan = finite(plan.to(x.dtype), self.task)
        return self._best(x, plan, None if previous is None else finite(previous.to(x.dtype), self.task))

    @abstractmethod
    def _best(self, x: Tensor, plan: Tensor, previous: Tensor | None) -> Candidates:
        """`search`, from finite plans of the dtype of `x`."""


class StagedSearch(GuardSearch):
    """Search for better plans: runs the stages (search methods) of a guard in order.

    Args:
        task: specification and system.
        policy: policy that completes plans: it plans from the state after a prefix (sampled first actions).
        guard: guard whose stages run.
        grid: control values and lengths of prefixes; by default those of the system file.
        limits: computational limits of a decision; the defaults of `Limits` if None.
    """

    def __init__(
        self,
        task: Task,
        policy: Policy,
        guard: GuardKind,
        *,
        grid: PrefixGrid | None = None,
        limits: Limits | None = None,
    ) -> None:
        self.task, self.policy, self.limits = task, policy, limits or Limits()
        self.seconds = self.limits.seconds if guard.timed else self.limits.paper
        generator = torch.Generator().manual_seed(SEED)
        stages = tuple(map(STAGES.get, guard.stages))
        setup = Setup(task, policy, grid or grid_of(task), self.limits, stages, generator)
        self.stages = [stage(setup) for stage in stages]

    def _best(self, x: Tensor, plan: Tensor, previous: Tensor | None) -> Candidates:
        deadline = Deadline(self.seconds, len(x))
        rejected = Rejected(x, plan, previous, Candidates.unjudged(plan))
        for stage in self.stages:
            rows = stage.wanted(rejected.best).nonzero()[:, 0]
            if len(rows):
                before = len(rejected.tried)
                rejected.best.improve(rows, stage.propose(rejected, rows, deadline))
                del rejected.tried[:before]
        best = rejected.best
        left = (best.source < 0).nonzero()[:, 0]
        if len(left):  # no stage judged a plan, for example because no prefix is shorter than the plan
            best.put(left, Candidates.judged(self.task, x[left], best.plans[left], SAFEST))
        return best


class RelaxedSearch(GuardSearch):
    """Search by the stages of a guard, with robustness margins of safety requirements.

    If no plan keeps the required margins, the safe plan with the largest margin is taken. Example: a rover is
    already closer to a wall than the margin allows. It may continue at this distance. A plan that keeps the
    full margin for some steps and then becomes unsafe would be worse.

    If the present state itself is nearer to a violation than the margin, no plan can keep the margin. Then
    the stages (search methods) ignore the margin, and their plans start a search for the largest margin.
    Verdicts include the margins.

    Args:
        task: specification without margins, and system.
        strict: the task with margins.
        policy: policy that completes plans: it plans from the state after a prefix (sampled first actions).
        guard: guard whose stages run.
        grid: control values and lengths of prefixes; by default those of the system file.
        limits: computational limits of a decision.
    """

    def __init__(
        self,
        task: Task,
        strict: Task,
        policy: Policy,
        guard: GuardKind,
        *,
        grid: PrefixGrid | None = None,
        limits: Limits,
    ) -> None:
        seconds = None if limits.seconds is None else limits.seconds / 2
        half = replace(limits, seconds=seconds)
        self.task, self.policy, self.limits = strict, policy, half
        self._strict = StagedSearch(strict, policy, guard, grid=grid, limits=half)
        self._plain = StagedSearch(task, policy, guard, grid=grid, limits=half)
        generator = torch.Generator().manual_seed(SEED)
        self._searcher = Searcher(strict.safety_task, generator, target=0.0)
        self._formulas = [rule.formula for rule in strict.compiled.safety]

    def _best(self, x: Tensor, plan: Tensor, previous: Tensor | None) -> Candidates:
        previous = plan if previous is None else previous
        present = self.task.system.rollout_columns(x, plan)
        lacking = ~TOLERANCE.satisfied(robustness_until(self._formulas, present, 0))
        found = self._plain_found(x, plan, previous, lacking)
        far = (~lacking).nonzero()[:, 0]
        if len(far):
            strict = self._strict.search(x[far], plan[far], previous[far])
            found.put(far, strict)
            short = far[~strict.is_safe]
            close = self._closer(found, short, x, previous[short])
            if len(close):
                self._closer(found, close, x, self._plain.search(x[close], plan[close]).plans)
        return found

    def _plain_found(self, x: Tensor, plan: Tensor, previous: Tensor, lacking: Tensor) -> Candidates:
        """Run the stages (search methods) without margins for the agents in `lacking`.

        A search for the largest margin then starts from the safe plans found.

        Args:
            x: states, (agents, n).
            plan: the policy's plans, (agents, T, m).
            previous: remainders of the previous plans, (agents, T, m).
            lacking: mask of the agents whose present state has less than the required margin, (agents,).

        Returns:
            One plan per agent. Agents that are not in `lacking` get unjudged plans.
        """
        found = Candidates.unjudged(plan)
        rows = lacking.nonzero()[:, 0]
        if len(rows):
            plain = self._plain.search(x[rows], plan[rows], previous[rows])
            safe = plain.is_safe
            found.put(rows, plain)
            found.rho[rows] = self.task.judge(x[rows], plain.plans, states=False).rho
            found.safe[rows] = -torch.inf
            self._closer(found, rows[safe], x, plain.plans[safe])
        return found

    def _closer(self, found: Candidates, rows: Tensor, x: Tensor, start: Tensor) -> Tensor:
        """Search for safe plans with the largest margin, and put the safe plans found into `found`.

        Args:
            found: plans of all agents; changed in place.
            rows: indices of the agents for which to search, (k,).
            x: states of all agents, (agents, n).
            start: starting plans, (k, T, m).

        Returns:
            The entries of `rows` for which no safe plan was found.
        """
        if not len(rows):
            return rows
        tries, threads = self.limits.tries, torch.get_num_threads()
        improved = self._searcher.repair(x[rows], start, tries=tries, threads=threads).plans.to(x.dtype)
        plain = Candidates.judged(self._plain.task, x[rows], improved, REPAIRED)
        strict = Candidates.judged(self.task, x[rows], improved, REPAIRED)
        safe = plain.is_safe
        unsafe = torch.full_like(strict.safe[safe], -torch.inf)
        found.put(rows[safe], replace(strict.of(safe), safe=unsafe))
        return rows[~safe]
