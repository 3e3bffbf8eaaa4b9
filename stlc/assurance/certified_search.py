"""Search for certified plans: those that are safe for all errors within the bounds of the scenario.

A plan is certified if all states that it can lead to under errors within the bounds are safe, over the whole
plan (`stlc.assurance.verification.tubes`). Then the rest of the plan is certified at the next decision, too,
whatever the errors were: the guard keeps a certified plan until its end, unless an exogenous event occurs.

Where no certified plan is found, a weaker condition counts: errors act until the next decision only, and the
rest of the plan is safe on the model, from whichever state is reached. At the next decision, a plan is then
known that the guard of Meng and Fan (2023) accepts.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from stlc.assurance.verification.tubes import Tube, TubeModel
from stlc.compile.backends.torch.ops import TORCH
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.guard.candidates import (
    POLICY,
    REPAIRED,
    Candidates,
    finite,
    first,
)
from stlc.controller.guard.margins import with_margins
from stlc.controller.guard.search import GuardSearch, RelaxedSearch, StagedSearch
from stlc.diagnostics import usage
from stlc.dynamics.model.samplers import seeded
from stlc.runtime.decision import best

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from stlc.controller.guard.kind import GuardInputs, GuardKind
    from stlc.controller.policies.policy import Policy
    from stlc.controller.problem.task import Task

STARTS = 500
"""States from which the margins of a search are measured."""
SHARE = 0.9
"""Share of the plans whose loss of robustness in the tube is at most the margin of the search."""
SEED = 20_261


class Certifier:
    """Check of plans by their tubes.

    Args:
        task: specification and system, with the scenario whose errors are assumed.

    Raises:
        UsageError: U101, there is no requirement tagged `@safety`, or there are no tubes (see `TubeModel`).
    """

    def __init__(self, task: Task) -> None:
        if not task.compiled.safety:
            advice = "write `@safety` above what has to hold in spite of errors"
            raise usage("the guard `certified` needs a requirement tagged `@safety`", advice)
        self.task = task
        self._tubes = TubeModel(task)

    @torch.no_grad()
    def guaranteed(self, x: Tensor, plans: Tensor) -> Tensor:
        """Least robustness of phi_safe that is guaranteed for plans under errors at all steps, (B,).

        Args:
            x: measured states, (B, n).
            plans: plans in physical units, (B, T, m).
        """
        return self._tubes.safe(x, plans)

    @torch.no_grad()
    def until_next(self, x: Tensor, plans: Tensor) -> Tensor:
        """The same for errors until the next decision; from then on the model is followed, (B,)."""
        return self._tubes.safe(x, plans, steps=self.task.system.decl.test.replan)

    @torch.no_grad()
    def sought(self, policy: Policy, least: Mapping[str, float]) -> Task:
        """Return the task with margins of safety, for which a search on the model finds certified plans.

        The margin of a requirement at the end of a plan is a quantile of the robustness that plans of the
        policy lose in their tubes, and at least its entry in `least`. It grows along a plan as the tubes do.
        Whether a plan is accepted depends on its own tube only.
        """
        x = self.task.sample(STARTS, generator=seeded(SEED, 0), dtype=torch.float64)
        plans = finite(policy.plan(x).to(x.dtype), self.task)
        judged = self.task.judge(x, plans, states=False)
        tube = self._tubes.tube(x, plans)
        lost, safe = judged.requirements - tube.low, judged.safe >= 0.0
        margin, ramp = dict(least), {}
        for index, rule in enumerate(self.task.rules):
            if rule not in self.task.compiled.safety or not bool(safe.any()):
                continue
            loss = float(lost[safe, index].nan_to_num(0.0, 0.0, 0.0).quantile(SHARE))
            if loss > max(least.get(rule.name, 0.0), TOLERANCE):
                margin[rule.name] = loss
            if rule.name not in least:
                ramp[rule.name] = _growth(tube, rule.formula.columns)
        return with_margins(self.task, margin, ramp)


def _growth(tube: Tube, names: Iterable[str]) -> float:
    """Steps in which tubes become as wide as they are at the end, if they grew evenly.

    `names`: states whose widths count.
    """
    widths = [
        (tube.states[name].high - tube.states[name].low).mean(1) for name in names if name in tube.states
    ]
    shares = [width / width[-1] for width in widths if np.isfinite(width).all() and width[-1] > TOLERANCE]
    if not shares:
        return 1.0
    share = np.clip(np.max(shares, axis=0), 0.0, 1.0)
    wide = int(np.argmax(share >= SHARE))
    return max(wide / float(share[wide]), 1.0)


class CertifiedSearch(GuardSearch):
    """Search of a guard for certified plans: other proposals of the policy, then the stages of the guard.

    If no certified plan is found, a plan is taken that is certified until the next decision, else one that is
    safe on the model; of several, the one with the greatest robustness that is guaranteed in this weaker
    sense. Without such a plan, the one that the stages find is taken.

    The stages search on a task with margins for which plans on the model are likely to be certified.

    Args:
        given: task with the scenario, policy and limits.
        guard: guard whose stages run.

    Raises:
        UsageError: U101, there is nothing to certify, or the scenario has no bounds; see `Certifier`.
    """

    def __init__(self, given: GuardInputs, guard: GuardKind) -> None:
        self._certifier = Certifier(given.task)
        sought = self._certifier.sought(given.policy, given.limits.margin)
        self.task, self.policy, self.limits = given.strict, given.policy.for_task(sought), given.limits
        self._stages: GuardSearch
        if sought is self.task:
            self._stages = StagedSearch(sought, self.policy, guard, grid=given.grid, limits=self.limits)
        else:
            self._stages = RelaxedSearch(
                self.task, sought, self.policy, guard, grid=given.grid, limits=self.limits
            )

    def passes(self, x: Tensor, found: Candidates) -> Tensor:
        """Mask of the agents whose plan in `found` satisfies the specification and is certified."""
        passes = found.satisfies
        rows = passes.nonzero()[:, 0]
        if len(rows):
            passes[rows] = TOLERANCE.satisfied(self._certifier.guaranteed(x[rows], found.plans[rows]))
        return passes

    def _best(self, x: Tensor, plan: Tensor, previous: Tensor | None) -> Candidates:
        others = finite(self.policy.candidates(x).to(x.dtype).flatten(0, 1), self.task)
        others = others.view(len(x), -1, *plan.shape[1:])
        pool = [plan[:, None], others] if previous is None else [plan[:, None], others, previous[:, None]]
        found, tier = self._chosen(x, torch.cat(pool, 1))
        found.source[(found.plans == plan).flatten(1).all(1)] = POLICY
        rows = (tier < _CERTIFIED).nonzero()[:, 0]
        if len(rows):
            searched = self._stages.search(x[rows], plan[rows], None if previous is None else previous[rows])
            both = torch.stack((found.plans[rows], searched.plans), 1)
            better, _ = self._chosen(x[rows], both)
            new = (better.plans == searched.plans).flatten(1).all(1)
            source, length = (getattr(searched, name)[new] for name in ("source", "prefix_length"))
            taken = replace(better.of(new), source=source, prefix_length=length)
            found.put(rows[new], taken)
        return found

    def _chosen(self, x: Tensor, plans: Tensor) -> tuple[Candidates, Tensor]:
        """Choose among several plans of each agent, (agents, choices, T, m).

        Returns:
            The chosen plans, (agents,), and their tiers: see `_CERTIFIED`.
        """
        agents, choices = plans.shape[:2]
        judged = Candidates.judged(self.task, x, plans, REPAIRED, cost=True)
        starts = x.repeat_interleave(choices, 0)
        low = self._certifier.guaranteed(starts, plans.flatten(0, 1)).view(agents, choices)
        sure, usual = TOLERANCE.satisfied(low) & judged.is_safe, judged.standing
        tier = torch.where(judged.is_safe, 1, 0)
        tier = torch.where(sure, torch.where(judged.satisfies, _CERTIFIED, 3), tier)
        rows = (tier < 3).all(1).nonzero()[:, 0]
        if len(rows):
            again = x[rows].repeat_interleave(choices, 0), plans[rows].flatten(0, 1)
            low[rows] = self._certifier.until_next(*again).view(-1, choices)
            tier[rows] = torch.where((tier[rows] == 1) & TOLERANCE.satisfied(low[rows]), 2, tier[rows])
        bounded = (tier == 1) | (tier == 2)
        value = torch.where(tier == _CERTIFIED, -judged.cost, torch.where(bounded, low, usual))
        keys = (tier.to(x.dtype).t(), value.t())
        choice = first(best(torch.ones_like(sure).t(), keys, TORCH))
        return judged.pick(choice), tier.gather(1, choice[:, None])[:, 0]


_CERTIFIED = 4
"""Tier of a certified plan that satisfies the specification. The others are 3: certified; 2: certified until
the next decision, and safe on the model; 1: safe on the model; 0: unsafe."""
