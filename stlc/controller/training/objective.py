"""Training loss: robustness up to a margin, plus performance terms (Meng and Fan 2023, Eq. 8 to 10)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from stlc.compile.backends.torch.ops import TORCH
from stlc.compile.semantics.switch import StraightThrough, Switch, Tanh
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.problem.task import Task

VIOLATION = 2.0
"""Weight of the hinge at robustness 0 in the objective of `guided`, relative to the hinge at the margin."""


@dataclass(frozen=True, slots=True)
class Objective:
    """Parameters of the loss; gamma, k and lambda are the symbols of Meng and Fan (2023).

    Attributes:
        margin: gamma; robustness above it does not reduce the loss.
        smoothing: k of smooth min and max; None: exact min and max with subgradients.
        switch: functions whose derivatives replace the derivatives of jumps and conditions in the dynamics.
        saturation: s in the loss term s log(1 + hinge / s), where hinge is max(margin - robustness, 0). This
            term grows slowly, so that states without a satisfying plan do not dominate the loss. None: the
            hinge itself is the loss term.
        violation: weight of a second hinge, max(-robustness, 0), which penalises only plans that violate the
            specification.
        stl_weight: lambda, the weight of the hinge on robustness.
        performance_weight: weight of the performance terms.
    """

    margin: float
    smoothing: float | None
    switch: Switch
    saturation: float | None
    violation: float = 0.0
    stl_weight: float = 1.0
    performance_weight: float = 1.0


def paper_objective(task: Task) -> Objective:
    """Objective of Meng and Fan (2023, Eq. 6 to 10): max(gamma - rho, 0), where rho is a smooth robustness.

    Minima and maxima are smoothed by log-sum-exp, and conditions in the dynamics by tanh.
    """
    declared = task.system.decl.objective
    return Objective(
        margin=declared.gamma,
        smoothing=declared.smoothing,
        switch=Tanh(),
        saturation=None,
        stl_weight=declared.stl_weight,
    )


def guided_objective(margin: float, *, slope: float, performance_weight: float) -> Objective:
    """Objective of the method `guided`, with exact minima and maxima.

    The penalty begins where the robustness falls below `margin`, and is steeper below 0. For robustness far
    below 0, it grows only like a logarithm. `slope` is k in the smooth step (1 + tanh(k x)) / 2, whose
    derivative replaces those of jumps and conditions in the dynamics.
    """
    return Objective(
        margin=margin,
        smoothing=None,
        switch=StraightThrough(slope),
        saturation=2.0 * margin,
        violation=VIOLATION,
        performance_weight=performance_weight,
    )


def loss(task: Task, objective: Objective, x0: Tensor, u: Tensor) -> Tensor:
    """Compute the loss of plans, L_perf + lambda L_STL (Meng and Fan 2023, Eq. 10).

    Args:
        task: specification and system.
        objective: parameters of the loss.
        x0: initial states, (B, n).
        u: plans in physical units, (B, T, m), differentiable.

    Returns:
        Loss per plan, (B,), differentiable; the performance terms count only for plans that satisfy the
        specification.
    """
    each, columns = rolled(task, objective, x0, u)
    rho = task.graph.overall(without_lost(task, each), objective.smoothing)
    exact = rho
    if objective.smoothing is not None:
        exact = task.graph.overall(without_lost(task, task.graph.per_requirement_columns(columns, ops=TORCH)))
    good = TOLERANCE.satisfied(exact.detach())
    cost = task.performance(columns, rho, u)
    gated = torch.where(good, cost, torch.zeros_like(cost))
    return objective.stl_weight * _shortfall(objective, rho) + objective.performance_weight * gated


def _shortfall(objective: Objective, rho: Tensor) -> Tensor:
    """Penalty on robustness `rho` (B,) below the margin, and on robustness below 0: (B,)."""

    def hinge(at: float) -> Tensor:
        below = (at - rho).clamp(min=0.0)
        scale = objective.saturation
        return below if scale is None else scale * torch.log1p(below / scale)

    penalty = hinge(objective.margin)
    return penalty + objective.violation * hinge(0.0) if objective.violation else penalty


def without_lost(task: Task, each: Tensor) -> Tensor:
    """Robustness per requirement, (B, R), with +inf in place of -inf where a requirement is lost.

    A requirement is lost in a state from which its clock, status and timers alone falsify it, whatever a plan
    does: a deadline that is over, for example. Its robustness is -inf on every plan, so that it says nothing
    about plans, and would hide the other requirements in their minimum. The robustness of a requirement that
    reads no such state is -inf only if its numbers overflow, and stays so.
    """
    lost = (each.detach() == -torch.inf) & task.timed.to(each.device)
    return each.masked_fill(lost, torch.inf)


def rolled(task: Task, objective: Objective, x0: Tensor, u: Tensor) -> tuple[Tensor, Mapping[str, Tensor]]:
    """Compute the robustness per requirement, (B, R), and the states, name -> (T+1, B).

    Both are differentiable with respect to `u`. They are computed in C if there is a native kernel for the
    task and the device, and the objective uses exact robustness; else in torch.
    """
    switch = objective.switch
    if objective.smoothing is None and isinstance(switch, StraightThrough) and x0.device.type == "cpu":
        native = task.gradient
        if native is not None:
            return native(x0, u, slope=switch.slope)
    columns = task.system.rollout_columns(x0, u, switch)
    return task.graph.per_requirement_columns(columns, ops=TORCH, smoothing=objective.smoothing), columns
