"""Robustness margins of guards: how they are requested, calibrated and added to a task.

A guard accepts a plan that is safe according to the model. When the plan is executed, it loses robustness,
because the true dynamics and the true initial state differ from those of the model. If the plan was accepted
with a margin larger than this loss, its rest is still safe when the guard judges again. The guard then knows
at least one safe plan.

Calibration measures the loss of the policy's plans from training states. The first steps of each plan, until
the guard judges again, are simulated with the scenario's true dynamics, and the other steps with the model.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from stlc.compile.ir import nodes as ir
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.problem.task import Task
from stlc.diagnostics import usage
from stlc.dynamics.model.samplers import seeded
from stlc.dynamics.uncertainty.disturbance import Disturbance
from stlc.registry import GUARDS

if TYPE_CHECKING:
    from stlc.compile.pipeline import CompiledRequirement
    from stlc.controller.policies.policy import Policy


def with_margins(
    task: Task, margin: Mapping[str, float], ramp: Mapping[str, float] = MappingProxyType({})
) -> Task:
    """Return the task with tightened safety requirements: the robustness of each is reduced by its margin.

    Predicates that read only time and constants (such as `t <= 5`) are unchanged. They influence whether a
    formula holds, but their values never enter its robustness.

    Args:
        task: the task.
        margin: name of a safety requirement -> its margin, in its unit.
        ramp: name of a requirement -> steps in which its margin grows from 0 at the start of a plan to
            `margin`. The margin of any other requirement is the same for all samples.
    """
    if not any(margin.values()):
        return task
    safe: dict[str, CompiledRequirement] = {}
    for rule in task.compiled.safety:
        less: ir.Num = ir.Const(margin.get(rule.name, 0.0))
        if (steps := ramp.get(rule.name)) is not None:
            share = ir.Signal(ir.ELAPSED) * (1.0 / steps)
            less = less * share.apply("min", 1.0)
        formula, lowered = tightened(rule.formula, less), tightened(rule.lowered, less)
        safe[rule.name] = replace(rule, formula=formula, lowered=lowered)
    rules = tuple(safe.get(rule.name, rule) for rule in task.rules)
    return Task(replace(task.compiled, requirements=rules), task.plain)


def tightened(formula: ir.Formula, margin: ir.Num) -> ir.Formula:
    """The formula whose predicates have a robustness that is smaller by `margin`.

    If `margin` is a constant, so is the difference of the robustness of the formulas, for every trajectory.
    """
    if isinstance(formula, ir.Predicate):
        less: ir.Num = ir.Const(float(-formula.sign)) * margin
        if isinstance(margin, ir.Const):
            less = ir.Const(-formula.sign * margin.value)
        return formula if formula.guard else replace(formula, num=formula.num + less)
    return formula.map_children(formulas=lambda part: tightened(part, margin))


SHARE = 0.99
"""Default share of plans whose loss of robustness is at most the margin."""
STARTS = 4000
SEED = 20_251


@torch.no_grad()
def calibrated_margins(
    task: Task, policy: Policy, steps: int = 1, share: float = SHARE
) -> Mapping[str, float]:
    """Compute a margin for each safety requirement from the robustness that safe plans lose when executed.

    Args:
        task: specification and system. The errors, disturbances and noise of the scenario cause the loss.
        policy: policy that makes the plans.
        steps: number of steps between two judgements of the guard; one that monitors plans judges at every
            step.
        share: share of the plans whose loss is at most the margin; the margin is this quantile of the loss.

    Returns:
        Requirement -> margin, without margins of 0. It is empty if the scenario has no errors or the policy
        makes no safe plan.
    """
    x0 = task.sample(STARTS, generator=seeded(SEED, 0), dtype=torch.float64)
    disturbance = Disturbance(task.plain, [seeded(SEED, 1)], STARTS)
    seen = disturbance.seen(x0, 0)
    plan = policy.plan(seen).to(x0.dtype)
    planned = task.judge(seen, plan)
    followed = task.requirement_robustness(_followed(task, disturbance, x0, plan, min(steps, task.horizon)))
    lost = (planned.requirements - followed)[planned.safe >= 0.0]
    safety = {rule.name for rule in task.compiled.safety}
    found = {
        rule.name: float(lost[:, index].nan_to_num(0.0, 0.0, 0.0).quantile(share))
        for index, rule in enumerate(task.rules)
        if rule.name in safety and len(lost)
    }
    return {name: loss for name, loss in found.items() if loss > TOLERANCE}


def _followed(task: Task, disturbance: Disturbance, x: Tensor, plan: Tensor, steps: int) -> Tensor:
    """States, (B, T+1, n), reached from `x` under `plan`.

    The first `steps` steps are simulated with the true dynamics, the other steps with the model.
    """
    (truth,) = disturbance.truths(task.plain.truth)
    count, states = len(task.plain.names), [x]
    for step in range(steps):
        known = x[:, :count]
        moved = truth.step(known, disturbance.acted(plan[:, step]))
        x = torch.cat((disturbance.pushed(moved, known, step + 1), task.system.added_later(x)), 1)
        states.append(x)
    later = task.rollout(x, plan[:, steps:])[:, 1:] if steps < task.horizon else x[:, None, :][:, :0]
    return torch.cat((torch.stack(states, 1), later), 1)


AUTO = "auto"
FORMS = "--margin 0.2, --margin NAME=0.2, --margin auto, or auto:95 to cover 95 % of plans, not 99"


@dataclass(frozen=True, slots=True)
class MarginRequest:
    """Margins requested on the command line; see `parse_margins`.

    Attributes:
        every: margin of each safety requirement that `named` does not contain.
        named: requirement -> margin.
        share: share of the plans whose loss of robustness is at most the calibrated margin; None if margins
            are not calibrated.
    """

    every: float = 0.0
    named: Mapping[str, float] = field(default_factory=dict)
    share: float | None = None

    def of(self, task: Task, policy: Policy, guard: str, replan: int = 1) -> Mapping[str, float]:
        """Return the requested margin of each safety requirement, without margins of 0.

        The margin of a requirement is its entry in the attribute `named`. If it has none, its calibrated
        margin is taken. If it has neither, its margin is the attribute `every`. Margins are calibrated only
        if `share` is not None, for the given policy.

        Args:
            task: specification and system.
            policy: policy that makes the plans.
            guard: name of the guard; no margin is calibrated for one that does not intervene.
            replan: number of steps between two decisions of the guard.

        Raises:
            UsageError: U101, a name in `named` belongs to no safety requirement.
        """
        names = [rule.name for rule in task.compiled.safety]
        for name in self.named:
            if name not in names:
                listed = f"safety requirements: {', '.join(names) or 'none'}"
                raise usage(f"`{name}` is no safety requirement", listed).near(name, names)
        found = dict.fromkeys(names, self.every)
        kind = GUARDS.get(guard)
        if self.share is not None and kind.intervenes:
            found |= calibrated_margins(task, policy, 1 if kind.monitors else replan, self.share)
        found |= self.named
        return {name: margin for name, margin in found.items() if margin}


def parse_margins(texts: Sequence[str]) -> MarginRequest:
    """Parse texts such as `0.2` (all requirements), `avoid=0.2` (one requirement), `auto` and `auto:99`.

    `auto` calibrates the margins such that 99 % of the plans lose no more robustness than the margin. Another
    percentage may be given, as in `auto:95`. If several texts set the same margin, the last one counts.

    Raises:
        UsageError: U101, a text is not a margin.
    """
    asked = MarginRequest()
    for text in texts:
        name, equals, number = text.rpartition("=")
        kind, colon, percent = text.partition(":")
        if kind.strip() == AUTO:
            asked = replace(asked, share=_number(percent, text, 100.0) / 100 if colon else SHARE)
        elif equals:
            asked = replace(asked, named={**asked.named, name.strip(): _number(number, text)})
        else:
            asked = replace(asked, every=_number(text, text))
    return asked


def _number(text: str, whole: str, most: float = 1e9) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.0 <= value <= most:
        raise usage(f"`{whole}` is no margin", FORMS)
    return value
