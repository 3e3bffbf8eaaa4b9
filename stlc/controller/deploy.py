"""Deployment in MPC fashion: plan at every step, judge the plan, execute its first action."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, Protocol, TypeAlias, runtime_checkable

import torch
from torch import Tensor

from stlc.compile.semantics import TOLERANCE
from stlc.controller.backup import Backup, Grid

if TYPE_CHECKING:
    from stlc.controller.policy import Policy
    from stlc.controller.task import Judged, Task

Mode: TypeAlias = Literal["none", "paper"]
SOURCES = ("policy", "backup", "safest")


@dataclass(frozen=True, slots=True)
class Decision:
    """What agents do now, and why.

    Attributes:
        action: (agents, m) float64, physical units.
        plan: (agents, T, m) that it begins.
        source: (agents,) int64, an index into `SOURCES`.
        t0: (agents,) int64, length of the backup's prefix; 0 for the policy's own plan.
        rho: (agents,) float64, robustness of `plan`.
        safe: (agents,) bool, whether `plan` satisfies phi_safe.
        policy_rho: (agents,) float64, robustness of what the policy planned; -inf where that is no number.
    """

    action: Tensor
    plan: Tensor
    source: Tensor
    t0: Tensor
    rho: Tensor
    safe: Tensor
    policy_rho: Tensor


@runtime_checkable
class _JudgesItself(Protocol):
    """A policy that has judged its plan while choosing it."""

    def plan_judged(self, x0: Tensor) -> tuple[Tensor, Judged]: ...


class Guard:
    """Who stands between the policy and the actuators.

    Args:
        task: specification and system.
        policy: plans.
        mode: "paper" calls the backup policy where the monitor finds a plan violated, "none" only records.
        grid: candidates of the backup; by default what the system file says.
    """

    def __init__(self, task: Task, policy: Policy, mode: Mode = "paper", *, grid: Grid | None = None) -> None:
        self.task, self.policy, self.mode = task, policy, mode
        self.backup = Backup(task, policy, grid=grid) if mode == "paper" else None

    @torch.no_grad()
    def decide(self, x: Tensor) -> Decision:
        """Decide for (agents, n) states; verdicts are taken in float64.

        Without a guard a plan that is no number is handed on as it is, with robustness -inf.
        """
        x = x.to(torch.float64)
        plan, judged = self._plan(x)
        rho, safe = judged.rho, judged.safe >= -TOLERANCE
        source = torch.zeros(len(x), dtype=torch.int64, device=x.device)
        t0, policy_rho = source.clone(), rho
        failing = torch.nonzero(~(rho >= -TOLERANCE)).squeeze(1)
        if self.backup is not None and len(failing):
            found = self.backup.search(x[failing], plan[failing])
            plan = plan.index_copy(0, failing, found.plan)
            source, t0 = source.index_copy(0, failing, found.source), t0.index_copy(0, failing, found.t0)
            rho, safe = rho.index_copy(0, failing, found.rho), safe.index_copy(0, failing, found.safe)
        return Decision(plan[:, 0], plan, source, t0, rho, safe, policy_rho)

    def _plan(self, x: Tensor) -> tuple[Tensor, Judged]:
        if isinstance(self.policy, _JudgesItself):
            plan, judged = self.policy.plan_judged(x)
            return plan.to(x.dtype), judged
        plan = self.policy.plan(x).to(x.dtype)
        return plan, self.task.judge(x, plan)
