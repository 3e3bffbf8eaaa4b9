"""Gradient ascent on the exact robustness, for a batch of plans per state.

A gradient changes a whole plan at once, and a few steps repair most plans with a small violation. Gradients
do not lead across an obstacle, so ascent starts from a batch: given plans, and copies of them that are
perturbed over an interval of time. If no plan of the batch reaches the target robustness, the best plans are
perturbed and refined again, together with plans whose controls are at the ends or middles of their ranges. A
repaired plan is moved back towards the first given one as far as the target robustness allows.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from time import perf_counter
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.backends.torch.ops import TORCH
from stlc.compile.semantics.switch import StraightThrough
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.controller.problem.kernel import ObjectiveSlopes
from stlc.controller.search.starts import extremes

if TYPE_CHECKING:
    from stlc.controller.problem.task import Task

NEAR = 8
"""Number of plans in the batch of a round: given plans and perturbations of them."""
FAR = 24
"""Number of plans with constant pieces that are added to every later round."""
KEPT = 2
"""Number of best plans of a round; the next round starts from them, or they are returned."""
STEPS = 30
RATES = 0.1, 0.2, 0.2
"""Initial step size of each round, as a share of the control range; it falls to 0 at the last step."""
SHARES = 8
"""Number of interpolation steps between the policy's plan and the repaired one."""
SLOPE = 5.0
"""Slope, per unit, that replaces the derivative of a switching condition (straight-through estimator)."""
STEEP = 1e100
"""Gradients of at least this magnitude are set to 0."""
AGENTS = 256
"""Maximum number of agents per batch."""
SEED = 20_231
APART = 1e6
"""Offset between the values of satisfying plans, of plans that are only safe, and of others."""

Numbers: TypeAlias = NDArray[np.float64]
Pull: TypeAlias = Callable[[Numbers], Numbers]


class GradientAscent:
    """Gradient ascent on plans of one task; the result depends on states and plans alone.

    Args:
        task: specification and system.
        generator: source of the random numbers of the perturbations, which are drawn once.
        target: target robustness; the ascent of an agent's plans ends once one of them reaches it.
    """

    def __init__(self, task: Task, generator: torch.Generator, *, target: float) -> None:
        self.task, self.target = task, target
        self._native = task.gradient
        system = task.system
        self._low, self._high = (
            bound.double().numpy(force=True) for bound in (system.control_low, system.control_high)
        )
        self._span = self._high - self._low
        self._turns = np.array([control.squash == "angle" for control in system.decl.controls])
        self._factors = np.array([rule.factor for rule in task.rules])
        safe = {rule.name for rule in task.compiled.safety}
        self._safe = [at for at, rule in enumerate(task.rules) if rule.name in safe]
        self._changes = self._drawn(NEAR, generator)
        guesses = extremes(task, generator).double().numpy(force=True)
        self._far = [
            guesses[torch.randperm(len(guesses), generator=generator)[:FAR].numpy()] for _ in RATES[1:]
        ]

    @torch.no_grad()
    def refine(self, x: Tensor, guesses: Tensor, until: float = math.inf) -> Tensor:
        """Refine plans and return the two best of each agent, the best first, (agents, 2, T, m) float64.

        Args:
            x: states, (agents, n) float64.
            guesses: starting plans, (agents, guesses, T, m); finite. The first is the policy's.
            until: deadline, as a reading of `perf_counter()`.
        """
        if len(x) == 0:
            return guesses.new_zeros(0, KEPT, *guesses.shape[2:], dtype=torch.float64)
        states, plans = x.double().numpy(force=True), guesses.double().numpy(force=True)
        parts = [
            self._refined(states[at : at + AGENTS], plans[at : at + AGENTS], until)
            for at in range(0, len(states), AGENTS)
        ]
        return torch.from_numpy(np.concatenate(parts)).to(guesses.device)

    def _refined(self, x: Numbers, guesses: Numbers, until: float) -> Numbers:
        best, value = self._ascended(x, self._changed(guesses), RATES[0], until)
        for at, rate in enumerate(RATES[1:]):
            left = np.flatnonzero(value[:, 0] < APART + self.target)
            if not len(left) or perf_counter() >= until:
                break
            far = np.broadcast_to(self._far[at], (len(left), *self._far[at].shape))
            starts = np.concatenate((self._changed(best[left]), far), 1)
            best[left], value[left] = self._ascended(x[left], starts, rate, until)
        done = np.flatnonzero(value[:, 0] >= APART + self.target)
        best[done, 0] = self._eased(x[done], guesses[done, 0], best[done, 0])
        return best

    def _eased(self, x: Numbers, own: Numbers, found: Numbers) -> Numbers:
        """Move repaired plans `found` back towards the policy's plans `own`, (agents, T, m) each.

        The line from `own` to `found` is divided into `SHARES` equal parts. Of the points on it, the one
        nearest to `own` that reaches the target robustness is returned, (agents, T, m).
        """
        share = np.arange(1, SHARES)[:, None, None] / SHARES
        tried = np.concatenate((own[:, None] + share * (found - own)[:, None], found[:, None]), 1)
        each, _ = self._judged(np.repeat(x, SHARES, 0), tried.reshape(-1, *own.shape[1:]))
        reached = each.min(1).reshape(-1, SHARES) >= self.target
        reached[:, -1] = True
        eased: Numbers = tried[np.arange(len(x)), reached.argmax(1)]
        return eased

    def _ascended(self, x: Numbers, plans: Numbers, rate: float, until: float) -> tuple[Numbers, Numbers]:
        """Run one round of gradient ascent from the plans `plans`, (agents, k, T, m).

        `x`: states, (agents, n). `rate`: initial step size. `until`: deadline.

        Returns:
            The best plans, (agents, KEPT, T, m), and their values, (agents, KEPT), best first. The value of
            a plan that satisfies the specification is its robustness plus the large number `APART`; of one
            that is only safe, its robustness; of an unsafe one, the robustness of the safety requirements
            minus `APART`.
        """
        agents, count = plans.shape[:2]
        starts, rows = np.repeat(x, count, 0), plans.reshape(-1, *plans.shape[2:])
        best, value = rows.copy(), np.full(len(rows), -np.inf)
        first, second, every = np.zeros_like(rows), np.zeros_like(rows), np.arange(len(rows))
        solved = np.zeros(agents, dtype=bool)
        for step in range(STEPS + 1):
            each, pull = self._judged(starts, rows)
            rho = each.min(1)
            safe = each[:, self._safe].min(1) if self._safe else np.full_like(rho, np.inf)
            below = np.where(TOLERANCE.satisfied(safe), rho, safe - APART)
            now = np.where(TOLERANCE.satisfied(rho), APART + rho, below)
            better = (now > value) & ~np.repeat(solved, count)
            value[better], best[better] = now[better], rows[better]
            solved = value.reshape(agents, count).max(1) >= APART + self.target
            if step == STEPS or solved.all() or perf_counter() >= until:
                break
            which = each.argmin(1)
            by = np.zeros_like(each)
            by[every, which] = self._factors[which]
            slope = pull(by) * self._span
            slope[~(np.abs(slope) < STEEP)] = 0.0
            first += 0.1 * (slope - first)
            second += 0.01 * (slope * slope - second)
            size = np.sqrt(second / (1.0 - 0.99 ** (step + 1))) + 1e-8
            far = rate * (1.0 - step / STEPS) / (1.0 - 0.9 ** (step + 1))
            rows = self._bounded(rows + far * self._span * first / size)
        order = np.argsort(-value.reshape(agents, count), axis=1, kind="stable")[:, :KEPT]
        rows = order + count * np.arange(agents)[:, None]
        return best[rows], value[rows]

    def _judged(self, x: Numbers, u: Numbers) -> tuple[Numbers, Pull]:
        """Compute the robustness of plans per requirement, and a function that returns gradients.

        `x`: states, (rows, n). `u`: plans, (rows, T, m).

        Returns:
            The robustness, (rows, R), multiplied by the weight of each requirement and divided by its scale;
            NaN becomes -inf. The function maps weights w, (rows, R), to the gradient of the sum of w times
            the unscaled robustness with respect to the plans, (rows, T, m).
        """
        native, threads = self._native, torch.get_num_threads()

        def natively(by: Numbers) -> Numbers:
            assert native is not None
            return native.adjoint.pull(x, u, ObjectiveSlopes(by, None, SLOPE), threads=threads)

        if native is None:
            each, pull = self._differentiated(torch.from_numpy(x), torch.from_numpy(u))
        else:
            each, pull = native.judge.kernel.judge(x, u, threads=threads)[0], natively
        found = np.stack(
            [TOLERANCE.weighed(row, f, NUMPY) for row, f in zip(each.T, self._factors, strict=True)], 1
        )
        found[np.isnan(found)] = -np.inf
        return found, pull

    def _differentiated(self, x: Tensor, u: Tensor) -> tuple[Numbers, Pull]:
        """Compute the robustness of plans in torch, and a function that returns gradients.

        `x`: states, (rows, n). `u`: plans, (rows, T, m).

        Returns:
            The unscaled robustness per requirement, (rows, R). The function maps weights (rows, R) to the
            gradient of the weighted sum of robustness values with respect to the plans, (rows, T, m).
        """
        with torch.enable_grad():
            u = u.requires_grad_()
            columns = self.task.system.rollout_columns(x, u, StraightThrough(SLOPE))
            each = self.task.graph.per_requirement_columns(columns, ops=TORCH)

        def pull(by: Numbers) -> Numbers:
            if not each.requires_grad:
                return np.zeros(u.shape)
            gradient: Numbers = torch.autograd.grad(each, u, torch.from_numpy(by))[0].numpy()
            return gradient

        return each.detach().clone().numpy(), pull

    def _changed(self, plans: Numbers) -> Numbers:
        """Return `plans`, (agents, k, T, m), and random perturbations of them: (agents, NEAR, T, m)."""
        agents, guesses, *shape = plans.shape
        changed = plans[:, :, None] + self._changes[: NEAR // guesses]
        changed[:, :, 1:] = self._bounded(changed[:, :, 1:])
        return changed.reshape(agents, -1, *shape)

    def _drawn(self, count: int, generator: torch.Generator) -> Numbers:
        """Random perturbations that can be added to plans, (count, T, m).

        A perturbation is nonzero only in a random interval of time. There it is either constant or white
        noise. The first perturbation is zero.
        """
        steps, controls = self.task.horizon, len(self._low)
        begin = torch.randint(0, steps, (count, 1, controls), generator=generator).numpy()
        length = torch.randint(1, steps + 1, (count, 1, controls), generator=generator).numpy()
        time = np.arange(steps)[:, None]
        size = 2.0 ** -torch.randint(1, 6, (count, 1, 1), generator=generator).double().numpy()
        noise = torch.randn(count, steps, controls, generator=generator).double().numpy()
        noise[::2] = noise[::2, :1]
        stretch = (time >= begin) & (time < begin + length)
        changes: Numbers = stretch * size * noise * self._span
        changes[0] = 0.0
        return changes

    def _bounded(self, plans: Numbers) -> Numbers:
        clipped: Numbers = np.minimum(np.maximum(plans, self._low), self._high)
        if not self._turns.any():
            return clipped
        turned = self._low + np.remainder(plans - self._low, self._span)
        bounded: Numbers = np.where(self._turns, turned, clipped)
        return bounded
