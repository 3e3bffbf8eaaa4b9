"""Training loss: the paper's truncated robustness and performance terms (Eq. 8 to 10)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from stlc.compile.backends.torch.ops import TORCH
from stlc.compile.semantics.switch import StraightThrough, Switch, Tanh
from stlc.controller.problem.task import satisfied

if TYPE_CHECKING:
    from collections.abc import Mapping

    from stlc.controller.problem.task import Task


@dataclass(frozen=True, slots=True)
class Objective:
    """Parameters of the loss.

    Attributes:
        margin: the paper's gamma, at which robustness is truncated.
        smoothing: the paper's k; None: exact min and max with subgradients.
        switch: differentiable form of jumps and indicators.
        saturation: s of `s log(1 + hinge / s)`, so that infeasible states do not dominate; None: plain hinge.
        stl_weight: the paper's lambda.
        performance_weight: factor of the performance terms.
    """

    margin: float
    smoothing: float | None
    switch: Switch
    saturation: float | None
    stl_weight: float = 1.0
    performance_weight: float = 1.0


def paper_objective(task: Task) -> Objective:
    """The paper's objective: hinge at gamma on log-sum-exp robustness, tanh switching (Eq. 6 to 10)."""
    declared = task.system.decl.objective
    return Objective(
        margin=declared.gamma,
        smoothing=declared.smoothing,
        switch=Tanh(),
        saturation=None,
        stl_weight=declared.stl_weight,
    )


def guided_objective(margin: float, *, slope: float, performance_weight: float) -> Objective:
    """Objective of the `guided` method: exact operators, a feasible margin, a saturating hinge."""
    return Objective(
        margin=margin,
        smoothing=None,
        switch=StraightThrough(slope),
        saturation=2.0 * margin,
        performance_weight=performance_weight,
    )


def loss(task: Task, objective: Objective, x0: Tensor, u: Tensor) -> Tensor:
    """Compute the loss of plans (Eq. 10: L_perf + lambda L_STL).

    Args:
        task: specification and system.
        objective: parameters of the loss.
        x0: initial states, (B, n).
        u: plans in physical units, (B, T, m), differentiable.

    Returns:
        Loss per plan, (B,), differentiable; the performance terms count where the plan satisfies exactly.
    """
    rho, columns = _rolled(task, objective, x0, u)
    exact = rho if objective.smoothing is None else task.graph.columns(columns, ops=TORCH)
    good = satisfied(exact.detach())
    hinge = (objective.margin - rho).clamp(min=0.0)
    if objective.saturation is not None:
        hinge = objective.saturation * torch.log1p(hinge / objective.saturation)
    cost = task.performance(columns, rho, u)
    gated = torch.where(good, cost, torch.zeros_like(cost))
    return objective.stl_weight * hinge + objective.performance_weight * gated


def native_rolled(
    task: Task, objective: Objective, x0: Tensor, u: Tensor
) -> tuple[Tensor, Mapping[str, Tensor]] | None:
    """Robustness per requirement (B, R) and states (T+1, B) by name, differentiable, by generated C.

    None where the objective has another meaning, or where torch has to be used.
    """
    switch = objective.switch
    if objective.smoothing is None and isinstance(switch, StraightThrough) and x0.device.type == "cpu":
        native = task.gradient
        return None if native is None else native(x0, u, slope=switch.slope)
    return None


def _rolled(task: Task, objective: Objective, x0: Tensor, u: Tensor) -> tuple[Tensor, Mapping[str, Tensor]]:
    """Robustness (B,) and states (T+1, B) by name, differentiable: natively where the meaning is the same."""
    native = native_rolled(task, objective, x0, u)
    if native is not None:
        return task.graph.overall(native[0]), native[1]
    columns = task.system.rollout_columns(x0, u, objective.switch)
    return task.graph.columns(columns, ops=TORCH, smoothing=objective.smoothing), columns
