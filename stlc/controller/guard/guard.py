"""Deployment in MPC fashion: plan at every step, judge the plan, execute its first action."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from stlc.compile.semantics.semantics import TOLERANCE
from stlc.controller.guard.candidates import Candidates, Limits, Mode, finite
from stlc.controller.guard.margins import with_margins
from stlc.controller.guard.safe_prefix import robustness_until
from stlc.controller.guard.search import RelaxedSearch, StagedSearch
from stlc.controller.policies.policy import BestOfKPolicy, plan_judged
from stlc.controller.problem.task import rank
from stlc.runtime.prefixes import Grid

if TYPE_CHECKING:
    from stlc.controller.policies.policy import Policy
    from stlc.controller.problem.task import PlanVerdicts, Task

GUARD_VERSION = 1
"""Raised with every change of a guard's decisions; benchmarks drive anew what older guards drove."""


@dataclass(frozen=True, slots=True)
class GuardDecision:
    """Decisions of a guard: actions, the plans that they begin, and their sources.

    Attributes:
        action: (agents, m) float64, physical units.
        plan: (agents, T, m) that it begins.
        source: (agents,) int64, an index into `SOURCES`.
        t0: (agents,) int64, length of the backup's prefix; 0 for the policy's own plan.
        rho: (agents,) float64, robustness of `plan`.
        safe: (agents,) bool, whether `plan` satisfies phi_safe.
        policy_rho: (agents,) float64, robustness of what the policy planned; -inf where that is no number.
        proposed: (agents, T, m), what the policy planned, whether it was followed or not.
    """

    action: Tensor
    plan: Tensor
    source: Tensor
    t0: Tensor
    rho: Tensor
    safe: Tensor
    policy_rho: Tensor
    proposed: Tensor

    def later(self, steps: int | Tensor = 1) -> GuardDecision:
        """The same decision so many steps later, (agents,) or one number: what is left of the plans.

        Their last actions are held on.
        """
        agents, length, controls = self.plan.shape
        ahead = torch.as_tensor(steps).expand(agents)[:, None] + torch.arange(length)
        index = ahead.clamp(max=length - 1)[..., None].expand(-1, -1, controls)
        plan = self.plan.gather(1, index.to(self.plan.device))
        return replace(self, plan=plan, action=plan[:, 0])

    def of(self, rows: Tensor) -> GuardDecision:
        """Rows of some agents, (k,) indices."""
        return GuardDecision(*(getattr(self, name)[rows] for name in _FIELDS))

    def with_new(self, rows: Tensor, new: GuardDecision) -> GuardDecision:
        """The same with the rows of some agents, (k,) indices, replaced by `new`."""
        pairs = ((getattr(self, name), getattr(new, name)) for name in _FIELDS)
        return GuardDecision(*(old.index_copy(0, rows, fresh) for old, fresh in pairs))


_FIELDS = tuple(each.name for each in fields(GuardDecision))


class Guard:
    """Runtime safety filter: judges every plan of a policy, and replaces it where it is not safe.

    Args:
        task: specification and system.
        policy: plans.
        mode: where the monitor finds a plan violated, "paper" calls the paper's backup policy and "full" the
            polishing one; "none" only records.
        grid: candidates of the backup; by default what the system file says.
        limits: of a decision. With a margin robustness and verdicts of decisions are those of the task all
            the same; only what the guard lets pass is another.
    """

    def __init__(
        self,
        task: Task,
        policy: Policy,
        mode: Mode = "paper",
        *,
        grid: Grid | None = None,
        limits: Limits | None = None,
    ) -> None:
        self.task, self.mode = task, mode
        self.strict = with_margins(task, {} if mode == "none" or limits is None else limits.margin)
        self.policy: Policy = policy
        if isinstance(policy, BestOfKPolicy):
            self.policy = policy.for_task(self.strict)  # the choice among its plans keeps the margin
        self.backup: StagedSearch | RelaxedSearch | None = None
        if mode == "full" and self.strict is not task and limits is not None:
            self.backup = RelaxedSearch(task, self.strict, self.policy, grid=grid, limits=limits)
        elif mode != "none":
            self.backup = StagedSearch(self.strict, self.policy, mode, grid=grid, limits=limits)

    @torch.no_grad()
    def decide(self, x: Tensor, begun: GuardDecision | None = None) -> GuardDecision:
        """Decide for (agents, n) states; verdicts are taken in float64.

        A plan that was begun and still satisfies the specification is gone on with where the new one is no
        better; otherwise an agent that may do something later could put it off at every step. So is one that
        is about to keep a promise of a mission with more to spare (`stlc.controller.problem.pending_goals`).

        Args:
            x: (agents, n) states.
            begun: what is left of the decision before; see `GuardDecision.later`.

        Returns:
            The decision. Without a guard a plan that is no number is handed on, with robustness -inf.
        """
        x = x.to(torch.float64)
        fresh, judged = plan_judged(self.strict, self.policy, x)
        found = self._kept(x, begun, fresh, judged)
        failing = torch.nonzero(~found.satisfies).squeeze(1)
        if self.backup is not None and len(failing):
            previous = None if begun is None else begun.plan[failing]
            found.put(failing, self.backup.search(x[failing], fresh[failing], previous))
        decision = GuardDecision(
            found.plans[:, 0],
            found.plans,
            found.source,
            found.prefix_length,
            found.rho,
            found.is_safe,
            judged.rho,
            fresh,
        )
        return decision if self.strict is self.task else self._plainly(decision, x, fresh)

    def _plainly(self, decision: GuardDecision, x: Tensor, fresh: Tensor) -> GuardDecision:
        """The decision with the verdicts of the task itself."""
        taken = self.task.judge(x, decision.plan, states=False)
        policy_rho = self.task.judge(x, fresh, states=False).rho
        return replace(decision, rho=taken.rho, safe=taken.safe >= -TOLERANCE, policy_rho=policy_rho)

    @torch.no_grad()
    def endangered(self, x: Tensor, begun: GuardDecision, steps: int | Tensor) -> Tensor:
        """Agents that would, by the model, violate safety requirements with the next steps of a begun plan.

        Args:
            x: (agents, n) states.
            begun: what is left of the decision before.
            steps: how many count, one number or (agents,).

        Returns:
            (agents,) booleans; nobody without the full guard: the paper's looks at plans as they are made.
        """
        formulas = [rule.formula for rule in self.strict.compiled.safety]
        if self.mode != "full" or not formulas:
            return torch.zeros(len(x), dtype=torch.bool)
        columns = self.strict.system.rollout_columns(x.to(torch.float64), begun.plan.to(torch.float64))
        return ~(robustness_until(formulas, columns, steps) >= -TOLERANCE)

    @torch.no_grad()
    def prefer(self, options: Tensor, begun: GuardDecision | None = None) -> Tensor:
        """Option of each agent that it plans best for; of equals the first.

        Args:
            options: (agents, k, n) states; option 0 is how things are.
            begun: what is left of the decision before, which belongs to option 0.

        Returns:
            (agents,) int64.
        """
        agents, count, _ = options.shape
        options = options.to(torch.float64)
        _, judged = plan_judged(self.strict, self.policy, options.flatten(0, 1))
        score = self._score(judged).view(agents, count)
        if begun is not None:
            rest = self._score(self.strict.judge(options[:, 0], begun.plan))
            score[:, 0] = torch.maximum(score[:, 0], rest)
        return (score >= score.amax(1, keepdim=True)).to(torch.uint8).argmax(1)

    def _score(self, judged: PlanVerdicts) -> Tensor:
        return rank(judged.rho, self.strict.cost(judged), judged.safe)

    @torch.no_grad()
    def carried_on(self, x: Tensor, begun: GuardDecision, taken: Tensor) -> GuardDecision:
        """Remainders of plans for (agents, n) states, continued by the policy from their end on.

        `taken`: how many steps of each are behind it, (agents,); so many of its last actions are replaced.
        """
        x, plan = x.to(torch.float64), begun.plan.clone()
        length = plan.shape[1]
        for steps in dict.fromkeys(taken.tolist()):
            rows = torch.nonzero(taken == steps).squeeze(1)
            left = length - steps
            if not 0 < left < length:
                continue
            end = self.task.rollout(x[rows], plan[rows, :left])[:, -1]
            tail = finite(self.policy.plan(end).to(plan.dtype), self.task)
            plan[rows] = torch.cat((plan[rows, :left], tail[:, : length - left]), 1)
        return replace(begun, plan=plan, action=plan[:, 0])

    def _kept(
        self, x: Tensor, begun: GuardDecision | None, fresh: Tensor, judged: PlanVerdicts
    ) -> Candidates:
        """The policy's plans, or what is left of those that were begun."""
        zero, free = torch.zeros(len(x), dtype=torch.int64, device=x.device), torch.zeros_like(judged.rho)
        found = Candidates(fresh.clone(), judged.rho.clone(), judged.safe.clone(), free, zero, zero.clone())
        if begun is None:
            return found
        rest = self.strict.judge(x, begun.plan)
        better = rank(rest.rho, self.strict.cost(rest)) >= rank(judged.rho, self.strict.cost(judged))
        keep = ((better | self._deepened(rest)) & (rest.rho >= -TOLERANCE)).nonzero()[:, 0]
        before = Candidates(begun.plan, rest.rho, rest.safe, found.cost, begun.source, begun.t0)
        found.put(keep, before.of(keep))
        return found

    def _deepened(self, rest: PlanVerdicts) -> Tensor:
        """Agents whose remaining plan increases the margin of a reached goal, (agents,) booleans."""
        if not self.task.promises.items:
            return torch.zeros_like(rest.rho, dtype=torch.bool)
        return self.task.promises.deepened(rest.columns)
