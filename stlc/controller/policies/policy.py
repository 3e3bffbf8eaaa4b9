"""Policies from states to plans: one network proposes several plans, the monitor selects one.

A continuous function cannot jump from left to right of an obstacle; a set of several can, and judging a few
plans exactly costs well under a millisecond.
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import torch
from torch import Tensor, nn

from stlc.controller.problem.task import PlanVerdicts, rank
from stlc.dynamics.model.controls import raw_width, squash

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from stlc.controller.problem.task import Task
    from stlc.dynamics.model.mirror import Mirror


class Policy(Protocol):
    """Interface of planners and trained networks."""

    def plan(self, x0: Tensor) -> Tensor:
        """Plans in physical units: (B, n) -> (B, T, m)."""


@runtime_checkable
class SelfJudging(Protocol):
    """A policy that judges its own plans for a task."""

    task: Task

    def plan_judged(self, x0: Tensor) -> tuple[Tensor, PlanVerdicts]:
        """The selected plan and its verdict: (B, n) -> (B, T, m), verdicts over (B,)."""


def plan_judged(task: Task, policy: Policy, x0: Tensor) -> tuple[Tensor, PlanVerdicts]:
    """Plans of a policy from states (B, n) in their dtype, (B, T, m), and their verdicts."""
    if isinstance(policy, SelfJudging) and policy.task is task:
        plans, judged = policy.plan_judged(x0)
        return plans.to(x0.dtype), judged
    plans = policy.plan(x0).to(x0.dtype)
    return plans, task.judge(x0, plans)


class ModelRollout:
    """Policy from a one-step actor: the plan is its closed-loop action sequence on the model.

    Args:
        actor: states (B, n), timers included, -> actions (B, m) in physical units.
        task: specification and system.
    """

    def __init__(self, actor: Callable[[Tensor], Tensor], task: Task) -> None:
        self.actor, self.task = actor, task

    @torch.no_grad()
    def plan(self, x0: Tensor) -> Tensor:
        """Plans in physical units: (B, n) -> (B, T, m)."""
        x, actions = x0, []
        for _ in range(self.task.horizon):
            actions.append(self.actor(x))
            x = self.task.system.step(x, actions[-1])
        return torch.stack(actions, 1)

    __call__ = plan


class PlanNetwork(nn.Module):
    """MLP from the observation to `plans` open-loop plans over the horizon.

    Where the system declares a mirror symmetry, states of the other side are mirrored, and so are their
    plans.

    Attributes:
        plans: number of plans.
        mirror: the system's symmetry; None where it has none, or where the method does not use it.
        centre: mean of the observations over initial states, (k,).
        spread: their standard deviation, (k,).
    """

    centre: Tensor
    spread: Tensor

    def __init__(self, task: Task, *, hidden: Sequence[int], plans: int, mirrored: bool = True) -> None:
        super().__init__()
        self.plans = plans
        self.mirror: Mirror | None = task.system.mirror if mirrored else None
        self._task = task
        self._width = raw_width(task.system.controls)
        widths = [task.system.observed_count, *hidden]
        layers: list[nn.Module] = []
        for inputs, outputs in pairwise(widths):
            layers += [nn.Linear(inputs, outputs), nn.ReLU()]
        layers.append(nn.Linear(widths[-1], plans * task.horizon * self._width))
        self.body = nn.Sequential(*layers)
        self.register_buffer("centre", torch.zeros(widths[0]))
        self.register_buffer("spread", torch.ones(widths[0]))

    def normalise(self, x0: Tensor) -> None:
        """Set the centre and the spread of the inputs from a sample of states, (n, dim).

        For timers they come from their ranges: early in training missions end early.
        """
        observed = self._task.system.observe(self._folded(x0)[0])
        centre, spread = observed.mean(0), observed.std(0)
        for index, timer in enumerate(reversed(self._task.compiled.timers), start=1):
            centre[-index] = 0.5 * (timer.low + timer.high)
            spread[-index] = 0.25 * (timer.high - timer.low)
        self.centre.copy_(centre)
        self.spread.copy_(torch.where(spread > 1e-6, spread, torch.ones_like(spread)))

    def forward(self, x0: Tensor) -> Tensor:
        """All plans, within the control bounds: (B, n) -> (B, plans, T, m)."""
        x0, swapped = self._folded(x0)
        observed = self._task.system.observe(x0).to(self.centre.dtype)
        raw = self.body((observed - self.centre) / self.spread)
        raw = raw.view(-1, self.plans, self._task.horizon, self._width)
        plans = squash(raw, self._task.system.controls)
        if self.mirror is None or swapped is None:
            return plans
        return torch.where(swapped[:, None, None, None], self.mirror.plans(plans), plans)

    def _folded(self, x0: Tensor) -> tuple[Tensor, Tensor | None]:
        """States mirrored onto one side, and a mask of the mirrored, (B,); unchanged without a mirror."""
        return (x0, None) if self.mirror is None else self.mirror.fold(x0)


class BestOfKPolicy:
    """Trained policy: the network proposes plans, the monitor selects the best.

    Of the plans that satisfy the specification the one with the least performance cost is selected, otherwise
    the one with the largest exact robustness.
    """

    def __init__(self, task: Task, network: PlanNetwork) -> None:
        self.task = task
        self.network = network

    def for_task(self, task: Task) -> BestOfKPolicy:
        """The same network, selecting plans for another task of the same system."""
        return self if task is self.task else BestOfKPolicy(task, self.network)

    @torch.no_grad()
    def candidates(self, x0: Tensor) -> Tensor:
        """All plans of the network in the dtype of `x0`: (B, n) -> (B, plans, T, m)."""
        plans: Tensor = self.network(x0)
        return plans.to(x0.dtype)

    def plan(self, x0: Tensor) -> Tensor:
        """The selected plan, physical units: (B, n) -> (B, T, m)."""
        return self.plan_judged(x0)[0]

    __call__ = plan

    def plan_judged(self, x0: Tensor) -> tuple[Tensor, PlanVerdicts]:
        """The selected plan and its verdict: (B, n) -> (B, T, m), verdicts over (B,)."""
        plans = self.candidates(x0)
        batch, count, steps, controls = plans.shape
        judged = self.task.judge(x0.repeat_interleave(count, 0), plans.reshape(-1, steps, controls))
        rows = torch.arange(batch, device=x0.device)
        best = rank(judged.rho, self.task.cost(judged), judged.safe).view(batch, count).argmax(1)
        index = rows * count + best
        return plans[rows, best], select(judged, index)


def select(judged: PlanVerdicts, index: Tensor) -> PlanVerdicts:
    """The verdicts at `index`, (k,) positions along the batch."""
    return PlanVerdicts(
        rho=judged.rho[index],
        safe=judged.safe[index],
        requirements=judged.requirements[index],
        plans=judged.plans[index],
        columns={name: column[:, index] for name, column in judged.columns.items()},
    )
