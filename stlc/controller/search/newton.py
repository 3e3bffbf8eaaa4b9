"""Gauss-Newton steps that change a plan so that its states meet conditions at given samples.

An example of a condition is `x > 1` at sample 5. Each step linearises the predicted states of a plan and the
conditions on them. Then it makes the smallest change of the controls for which the linearised conditions hold
(a damped least-squares problem with bounds). The derivatives of the conditions are approximated by
differences.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
import torch
from torch import Tensor

from stlc.compile.backends.array.graph import evaluate
from stlc.compile.backends.c.adjoint import emit_adjoint
from stlc.compile.backends.numbers import Untranslatable
from stlc.compile.backends.torch.ops import TORCH
from stlc.compile.ir.support import columns as columns_read
from stlc.controller.problem.native import motion_of, sizes_of
from stlc.native import Adjoint, ObjectiveSlopes, load

if TYPE_CHECKING:
    from stlc.compile.ir import nodes as ir
    from stlc.controller.problem.task import Task
    from stlc.dynamics.model.system import System

PROBE = 1e-6
"""Difference of a state or control for its derivative, as a share of its range."""
TINY = 1e-9
SLOPE = 1.0
"""Slope, per unit, that replaces the derivative of jumps and conditions."""
Pull: TypeAlias = Callable[[Tensor, Tensor, Tensor], Tensor]
"""Derivative by plans of linear forms of states, see `state_gradient`."""
PROJECTIONS = 10
"""Steps of a projection onto a condition."""


class GaussNewton:
    """Gauss-Newton steps for plans of one task.

    Each condition is linearised at each state. The distance of a state from a condition is the distance to
    the nearest state at which the linearised condition just holds. Each state component is first divided by
    its `spread`, so that distances have no unit.

    Attributes:
        spread: typical range of each state, (n,).
    """

    def __init__(
        self,
        task: Task,
        conditions: Sequence[ir.Formula],
        spread: Tensor,
        pull: Pull,
        *,
        rows: int = 16,
        margin: float = 0.03,
        damping: float = 1e-3,
    ) -> None:
        """Prepare the steps.

        Args:
            task: specification and system.
            conditions: formulas over the states of one sample.
            spread: typical range of each state, (n,).
            pull: function that `state_gradient` returned for the system.
            rows: a step considers at most this many pairs of condition and sample per plan, the most violated
                ones.
            margin: distance that states should keep from the boundaries of the conditions.
            damping: damping of the least-squares problem, relative to the mean of its diagonal.
        """
        self.task, self.spread = task, spread.clamp(min=TINY)
        self._conditions, self._rows, self._margin, self._damping = conditions, rows, margin, damping
        read = frozenset().union(*map(columns_read, conditions))
        self._read = torch.tensor([i for i, name in enumerate(task.system.names) if name in read])
        self._scale = self.spread[self._read]
        self._pull = pull
        self._low, self._high = task.system.control_low.double(), task.system.control_high.double()
        self._span = (self._high - self._low).clamp(min=TINY)

    @torch.no_grad()
    def step(self, x0: Tensor, plans: Tensor, needed: Tensor) -> tuple[Tensor, Tensor]:
        """Improve plans by one step.

        Args:
            x0: initial states, (B, n).
            plans: plans, (B, T, m).
            needed: True where a condition must hold at a sample, (B, conditions, T + 1).

        Returns:
            The changed plans, (B, T, m); and the sum of the distances by which the states under each plan
            missed the needed conditions before the change, (B,).
        """
        states = self.task.rollout(x0, plans)
        values, slopes = self._linear(states)
        size = slopes.mul(self._scale[:, None]).square_().sum(2).sqrt_().clamp_(min=TINY)
        lost = torch.where(needed.permute(1, 2, 0), values / size, torch.inf).flatten(0, 1)
        distance, index = lost.t().topk(min(self._rows, len(lost)), 1, largest=False)
        near = distance < 2.0 * self._margin  # also those that just hold, so that they go on holding
        missing = torch.where(near, self._margin - distance, 0.0).clamp(min=0.0)
        picked = index, torch.arange(len(plans))[:, None]
        share = near / size.flatten(0, 1)[picked]
        rows = states.new_zeros(*index.shape, states.shape[2])
        rows[..., self._read] = slopes.flatten(0, 1).transpose(1, 2)[picked] * share[..., None]
        effect = self._effects(x0, plans, rows, index % states.shape[1]) * self._span.repeat(plans.shape[1])
        return plans + self._change(plans, effect, missing), missing.sum(1)

    @torch.no_grad()
    def nearest(self, state: Tensor) -> tuple[Tensor, Tensor]:
        """For each condition, find a state near `state`, (n,), that meets it; dynamics are ignored.

        Returns:
            The states, (conditions, n); and True for each condition that `state` itself violates,
            (conditions,).
        """
        count = len(self._conditions)
        places, index = state.repeat(count, 1), torch.arange(count)
        violated = torch.zeros(count, dtype=torch.bool)
        for number in range(PROJECTIONS):
            values, slopes = self._linear(places[:, None])
            value, slope = values[index, 0, index], slopes[index, 0, :, index]
            violated = value < 0.0 if number == 0 else violated
            along = slope * self._scale**2
            share = -1.05 * value / (along * slope).sum(1).clamp(min=TINY**2)
            places[:, self._read] += torch.where(value < 0.0, share, 0.0)[:, None] * along
        return places, violated

    def _linear(self, states: Tensor) -> tuple[Tensor, Tensor]:
        """Values of the conditions at states (B, T + 1, n), and derivatives of these values.

        Returns:
            Values, (conditions, T + 1, B); and derivatives, (conditions, T + 1, r, B), with respect to the r
            components of the state that occur in the conditions.
        """
        probe = PROBE * self._scale
        moves = states.new_zeros(1 + len(probe), states.shape[2])
        moves[torch.arange(len(probe)) + 1, self._read] = probe
        moved = (states[None] + moves[:, None, None]).flatten(0, 1)
        values = values_of(self.task, self._conditions, moved)
        values = values.view(*values.shape[:2], len(moves), len(states))
        return values[:, :, 0], (values[:, :, 1:] - values[:, :, :1]) / probe[:, None]

    def _effects(self, x0: Tensor, plans: Tensor, rows: Tensor, when: Tensor) -> Tensor:
        """Derivatives of weighted sums of state components with respect to the controls of the plans.

        Args:
            x0: initial states, (B, n).
            plans: plans, (B, T, m).
            rows: weights of K sums per plan, (B, K, n).
            when: sample at which the state of each sum is taken, (B, K).

        Returns:
            Derivatives of each sum with respect to all controls of its plan, (B, K, T * m).
        """
        batch, count, size = rows.shape
        columns = rows.new_zeros(size, plans.shape[1] + 1, batch * count)
        columns[:, when.flatten(), torch.arange(batch * count)] = rows.flatten(0, 1).t()
        each = x0.repeat_interleave(count, 0), plans.repeat_interleave(count, 0)
        return self._pull(*each, columns).view(batch, count, -1)

    def _change(self, plans: Tensor, effect: Tensor, missing: Tensor) -> Tensor:
        """Smallest change of each plan after which K linearised conditions hold, within the control bounds.

        A control that would leave its bounds is set to the nearest bound. The change of the other controls is
        then computed again, to compensate for this.

        Args:
            plans: plans, (B, T, m).
            effect: derivative of each condition's distance with respect to the controls, (B, K, T * m).
            missing: distance by which each condition is missed, (B, K).

        Returns:
            The change, (B, T, m).
        """
        span = self._span
        now = (plans / span).flatten(1)
        low, high = ((end / span).repeat(plans.shape[1]) - now for end in (self._low, self._high))
        fixed, free = torch.zeros_like(now), torch.ones_like(now)
        one = torch.eye(missing.shape[1], dtype=torch.float64)
        for _ in range(2):
            own = effect * free[:, None]
            normal = own @ effect.mT
            level = self._damping * normal.diagonal(dim1=1, dim2=2).mean(1) + TINY
            rest = missing - (effect @ fixed[..., None])[..., 0]
            weights, _ = torch.linalg.solve_ex(normal + level[:, None, None] * one, rest[..., None])
            change = (own.mT @ weights)[..., 0].nan_to_num(0.0, 0.0, 0.0) + fixed
            inside = change.clamp(low, high)
            free = free * (inside == change)
            fixed = torch.where(free > 0.0, 0.0, inside)
        changed: Tensor = inside.view_as(plans) * span
        return changed


@torch.no_grad()
def values_of(task: Task, conditions: Sequence[ir.Formula], states: Tensor) -> Tensor:
    """Robustness of conditions at the samples of states (B, T + 1, n): (conditions, T + 1, B)."""
    samples, names = states.shape[1], task.system.names
    env = {name: states[..., i].t().contiguous() for i, name in enumerate(names)}
    found = evaluate(conditions, env, ops=TORCH, count=samples)
    return torch.stack([each.expand(samples, len(states)) for each in found]).nan_to_num(nan=-1e9)


def state_gradient(system: System) -> Pull:
    """Return a function that computes the derivative of a weighted sum of predicted states.

    The derivative is taken with respect to the controls of the plan. The arguments of the returned function,
    all float64, are B initial states (B, n), B plans (B, T, m), and the weight of every state at every
    sample, (n, T + 1, B). It returns one derivative per plan, (B, T, m). It runs in C if a compiler is
    installed.
    """
    try:
        fixed = [timer.name for timer in system.timers]
        library = load(emit_adjoint(motion_of(system), [], fixed=fixed))
    except Untranslatable:
        library = None
    if library is None:
        return partial(_pulled_by_torch, system)
    adjoint = Adjoint(library, sizes_of(system, []))

    def pull(x0: Tensor, plans: Tensor, columns: Tensor) -> Tensor:
        none = np.zeros((len(x0), 0))
        slopes = ObjectiveSlopes(none, columns.numpy(), SLOPE)
        return torch.from_numpy(adjoint.pull(x0.numpy(), plans.numpy(), slopes))

    return pull


def _pulled_by_torch(system: System, x0: Tensor, plans: Tensor, columns: Tensor) -> Tensor:
    with torch.enable_grad():
        plans = plans.detach().requires_grad_()
        total = (system.rollout(x0, plans) * columns.permute(2, 1, 0)).sum()
        gradient: Tensor = torch.autograd.grad(total, plans)[0]
    return gradient
