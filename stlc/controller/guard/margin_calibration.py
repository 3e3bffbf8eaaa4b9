"""How much a plan's robustness falls short in the world of a scenario: the margin that a guard needs there.

A guard passes a plan that is safe by the model. When it looks again the agent is where the truth has brought
it, from where it really was. Had the plan more to spare than its robustness has lost by then, what is left of
it is still safe by the model, and so there is a safe plan to be found. That loss is measured: plans of the
policy, from starts as in training, are followed on the truth of the scenario until a guard looks again, and
by the model from there.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from stlc.compile.semantics.semantics import TOLERANCE
from stlc.controller.deployment.disturbance import Disturbance
from stlc.controller.streams import seeded

if TYPE_CHECKING:
    from stlc.controller.guard.tightened import Spare
    from stlc.controller.policies.policy import Policy
    from stlc.controller.problem.task import Task

SHARE = 0.99
"""Of plans whose loss a margin covers."""
STARTS = 4000
SEED = 20_251


@torch.no_grad()
def measured_margin(task: Task, policy: Policy, steps: int = 1, share: float = SHARE) -> Spare:
    """For each safety requirement the loss that so large a share of safe plans stays below.

    Args:
        task: under its scenario, whose errors, disturbances and noise count.
        policy: who plans.
        steps: from one look of the guard to the next; the full guard looks at every step.
        share: of plans.

    Returns:
        Requirement -> robustness, at least 0 each; empty where the scenario has nothing that is wrong, or the
        policy has no safe plan.
    """
    x0 = task.sample(STARTS, generator=seeded(SEED, 0), dtype=torch.float64)
    disturbance = Disturbance(task.plain, [seeded(SEED, 1)], STARTS)
    seen = disturbance.seen(x0, 0)
    plan = policy.plan(seen).to(x0.dtype)
    planned = task.judge(seen, plan)
    followed = task.requirement_robustness(_followed(task, disturbance, (x0, plan), min(steps, task.horizon)))
    lost = (planned.requirements - followed)[planned.safe >= 0.0]
    safety = {rule.name for rule in task.compiled.safety}
    found = {
        rule.name: float(lost[:, index].nan_to_num(0.0, 0.0, 0.0).quantile(share))
        for index, rule in enumerate(task.rules)
        if rule.name in safety and len(lost)
    }
    return {name: loss for name, loss in found.items() if loss > TOLERANCE}


def _followed(task: Task, disturbance: Disturbance, plans: tuple[Tensor, Tensor], steps: int) -> Tensor:
    """States (B, T+1, n) of plans that are followed on the truth for some steps, then by the model."""
    x, plan = plans
    (truth,) = disturbance.truths(task.plain.truth)
    count, states = len(task.plain.names), [x]
    for step in range(steps):
        known = x[:, :count]
        moved = truth.step(known, disturbance.acted(plan[:, step]))
        x = torch.cat((disturbance.pushed(moved, known, step + 1), task.system.added_later(x)), 1)
        states.append(x)
    later = task.rollout(x, plan[:, steps:])[:, 1:] if steps < task.horizon else x[:, None, :][:, :0]
    return torch.cat((torch.stack(states, 1), later), 1)
