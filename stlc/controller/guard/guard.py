"""Runtime guard for receding-horizon deployment: plans are judged before an action is executed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from stlc.compile.backends.torch.ops import TORCH
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.guard.candidates import Candidates, Limits, finite
from stlc.controller.guard.kind import GuardInputs
from stlc.controller.guard.kinds.paper import GUARD as PAPER
from stlc.controller.guard.margins import with_margins
from stlc.controller.guard.safe_prefix import robustness_until
from stlc.controller.problem.rows import Rows
from stlc.controller.problem.task import PlanVerdicts, Task
from stlc.registry import GUARDS
from stlc.runtime.prefixes import PrefixGrid

if TYPE_CHECKING:
    from stlc.controller.policies.policy import Policy


@dataclass(frozen=True, slots=True)
class GuardDecision(Rows):
    """Decisions of a guard: plans, their first actions, and their sources.

    Attributes:
        action: (agents, m) float64, physical units.
        plan: (agents, T, m), the followed plan.
        source: (agents,) int64, the method that made `plan`, an index into `SOURCES`.
        t0: (agents,) int64, prefix length of `plan`: number of its first actions that come from the guard's
            sampled prefixes; 0 for the policy's own plan.
        rho: (agents,) float64, robustness of `plan`.
        safe: (agents,) bool, whether `plan` satisfies phi_safe (the requirements tagged `@safety`).
        policy_rho: (agents,) float64, robustness of the policy's plan; -inf if this plan is not finite.
        proposed: (agents, T, m), the policy's plan, whether it is followed or not.
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
        """The decision as it stands `steps` steps later: each plan without its first `steps` actions.

        `steps`: one number for all agents, or one per agent, (agents,). Every shortened plan is extended to T
        steps again by repeating its last action.
        """
        agents, length, controls = self.plan.shape
        ahead = torch.as_tensor(steps).expand(agents)[:, None] + torch.arange(length)
        index = ahead.clamp(max=length - 1)[..., None].expand(-1, -1, controls)
        plan = self.plan.gather(1, index.to(self.plan.device))
        return replace(self, plan=plan, action=plan[:, 0])

    def with_new(self, rows: Tensor, new: GuardDecision) -> GuardDecision:
        """Return this decision with the entries of some agents replaced by those of `new`.

        `rows`: indices of these agents, (k,). `new`: decision for these agents only.
        """
        pairs = zip(self.parts, new.parts, strict=True)
        return GuardDecision(*(old.index_copy(0, rows, fresh) for old, fresh in pairs))


class Guard:
    """Runtime safety filter: judges every plan of a policy and replaces plans that violate the specification.

    Args:
        task: specification and system.
        policy: proposes plans.
        guard: name of the guard, one of `stlc.registry.GUARDS`; by default the backup policy of Meng and Fan
            (2023).
        grid: control values of the backup policy; by default those of the system file.
        limits: computational limits and robustness margins of a decision. A margin changes which plans are
            accepted; reported robustness and verdicts are those of the task without margin.

    Raises:
        UsageError: U101, there is no such guard, or the task lacks what the guard needs.
    """

    def __init__(
        self,
        task: Task,
        policy: Policy,
        guard: str = PAPER.name,
        *,
        grid: PrefixGrid | None = None,
        limits: Limits | None = None,
    ) -> None:
        self.task, self.kind, limits = task, GUARDS.get(guard), limits or Limits()
        self.strict = with_margins(task, limits.margin if self.kind.intervenes else {})
        given = GuardInputs(task, self.strict, policy, grid, limits)
        self.backup = self.kind.search(given) if self.kind.intervenes else None
        self.policy = policy.for_task(task) if self.backup is None else self.backup.policy

    @torch.no_grad()
    def decide(self, x: Tensor, previous: GuardDecision | None = None) -> GuardDecision:
        """Decide which plans the agents follow from states (agents, n); verdicts are computed in float64.

        The previous plan is retained if it still satisfies the specification and the new plan ranks no
        higher. Without this rule, an agent could postpone a goal at every step. The previous plan is also
        retained if it satisfies the specification and its next step increases the robustness margin of a
        pending goal (`stlc.controller.problem.pending_goals`).

        Args:
            x: (agents, n) states.
            previous: remainder of the previous decision (see `GuardDecision.later`); None at first.

        Returns:
            The decision. If the guard does not intervene, even a plan that is not finite is followed; its
            robustness is -inf.
        """
        x = x.to(torch.float64)
        fresh, judged = self.policy.plan_judged(x, None if previous is None else previous.plan)
        if self.policy.task is not self.strict:
            judged = self.strict.judge(x, fresh)
        found = self._with_previous(x, previous, fresh, judged)
        if self.backup is not None:
            failing = torch.nonzero(~self.backup.passes(x, found)).squeeze(1)
            if len(failing):
                rest_plans = None if previous is None else previous.plan[failing]
                found.put(failing, self.backup.search(x[failing], fresh[failing], rest_plans))
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
        if self.strict is self.task:
            return decision
        taken = self.task.judge(x, decision.plan, states=False)  # without robustness margins
        policy_rho = self.task.judge(x, fresh, states=False).rho
        return replace(decision, rho=taken.rho, safe=TOLERANCE.satisfied(taken.safe), policy_rho=policy_rho)

    @torch.no_grad()
    def endangered(self, x: Tensor, previous: GuardDecision, steps: int | Tensor) -> Tensor:
        """Mask of the agents whose previous plan is predicted to become unsafe within `steps` steps.

        Args:
            x: (agents, n) states.
            previous: remainder of the previous decision.
            steps: number of steps to check, one number or (agents,).

        Returns:
            (agents,) booleans; all are False if the guard does not monitor plans.
        """
        formulas = [rule.formula for rule in self.strict.compiled.safety]
        if not (self.kind.monitors and formulas):
            return torch.zeros(len(x), dtype=torch.bool)
        columns = self.strict.system.rollout_columns(x.to(torch.float64), previous.plan.to(torch.float64))
        return ~TOLERANCE.satisfied(robustness_until(formulas, columns, steps))

    @torch.no_grad()
    def prefer(self, options: Tensor, previous: GuardDecision | None = None) -> Tensor:
        """For each agent, the index of the option with the best plan; the first of equally good options.

        An option is an alternative that the world offers, such as the station to go to.

        Args:
            options: (agents, k, n), states under the options; option 0 is the present state.
            previous: remainder of the previous decision, which belongs to option 0.

        Returns:
            (agents,) int64.
        """
        agents, count, _ = options.shape
        options = options.to(torch.float64)
        _, judged = self.policy.plan_judged(options.flatten(0, 1))
        score = self._score(judged).view(agents, count)
        if previous is not None:
            rest = self._score(self.strict.judge(options[:, 0], previous.plan))
            score[:, 0] = torch.maximum(score[:, 0], rest)
        return (score >= score.amax(1, keepdim=True)).to(torch.uint8).argmax(1)

    def _score(self, judged: PlanVerdicts) -> Tensor:
        return self.strict.rank(judged)

    @torch.no_grad()
    def extended(self, x: Tensor, previous: GuardDecision, taken: Tensor) -> GuardDecision:
        """Return the previous decision with its plans extended at their ends by the policy.

        In `previous`, the remainder of each plan is filled up to T steps by repeating its last action. These
        repeated actions are replaced: the policy plans from the predicted state at the end of the remainder,
        and the first actions of the new plan are appended.

        Args:
            x: (agents, n) states.
            previous: remainder of the previous decision.
            taken: number of steps of each plan that were executed, which is the number of actions to append,
                (agents,).
        """
        x, plan = x.to(torch.float64), previous.plan.clone()
        length = plan.shape[1]
        for steps in dict.fromkeys(taken.tolist()):
            rows = torch.nonzero(taken == steps).squeeze(1)
            left = length - steps
            if not 0 < left < length:
                continue
            end = self.task.rollout(x[rows], plan[rows, :left])[:, -1]
            tail = finite(self.policy.plan(end).to(plan.dtype), self.task)
            plan[rows] = torch.cat((plan[rows, :left], tail[:, : length - left]), 1)
        return replace(previous, plan=plan, action=plan[:, 0])

    def _with_previous(
        self, x: Tensor, previous: GuardDecision | None, fresh: Tensor, judged: PlanVerdicts
    ) -> Candidates:
        """For each agent, take the policy's plan (`fresh`, with verdicts `judged`) or the previous plan.

        The previous plan is taken if it satisfies the specification and either ranks no lower than the
        policy's plan or increases the margin of a pending goal; see `decide`.
        """
        zero, free = torch.zeros(len(x), dtype=torch.int64, device=x.device), torch.zeros_like(judged.rho)
        found = Candidates(fresh.clone(), judged.rho.clone(), judged.safe.clone(), free, zero, zero.clone())
        if previous is None:
            return found
        rest = self.strict.judge(x, previous.plan)
        better = self.strict.rank(rest) >= self.strict.rank(judged)
        if self.task.pending_goals.items:
            better |= self.task.pending_goals.deepened(rest.columns, TORCH)[0]
        keep = (better & TOLERANCE.satisfied(rest.rho)).nonzero()[:, 0]
        before = Candidates(previous.plan, rest.rho, rest.safe, found.cost, previous.source, previous.t0)
        found.put(keep, before.of(keep))
        return found
