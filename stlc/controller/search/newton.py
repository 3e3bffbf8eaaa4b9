"""Gauss-Newton steps that change plans so that their states meet conditions at given samples.

An example of a condition is `x > 1` at sample 5. A step linearises the dynamics and the conditions along the
trajectory of a plan. Then it minimises the squared distances by which the linearised conditions are missed.
This is a linear-quadratic problem, and a Riccati recursion solves it (Li and Todorov 2004). It gives feedback
gains besides the changes of the controls: where the true trajectory departs from the linear prediction, the
controls are corrected, so that early changes do not grow along the trajectory of an unstable system. A
logarithmic barrier keeps the controls within their bounds (Pavlov et al. 2021).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from stlc.compile.backends.array.graph import evaluate
from stlc.compile.backends.torch.ops import TORCH
from stlc.controller.problem.native import NativeStep
from stlc.controller.problem.rows import Rows

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from stlc.compile.ir import nodes as ir
    from stlc.controller.problem.task import Task

    Numbers = NDArray[np.float64]

PROBE = 1e-6
"""Difference of a state or control for its derivative, as a share of its range."""
UNIFORM = 12.0**-0.5
"""Standard deviation of a uniform distribution, as a share of its range."""
TINY = 1e-9
FAR = 1e6
"""Value that stands for an infinite state."""
FLAT = 0.1
"""Least slope of a condition, as a share of its greatest slope along the trajectory, by which its distance is
measured: at the top of a hill, a condition has no slope, but the distance is not infinite."""
INSIDE = 0.01
"""Least distance of a control from its bounds, at first as a share of its range; later, of the distance that
it had before."""
BARRIER = 0.03
"""Weight of the barrier, as a multiple of the cost for each control of the plan."""
LENGTHS = np.array([1.0, 0.4, 0.1])
"""Shares of the changes of the controls that are tried."""
MARGIN = 0.03
"""Greatest margin of a condition."""
DEPTHS = 2.0 * MARGIN * np.array([1.0, 0.5, 0.25, 0.1, 0.05, 0.02, 0.01])
"""Distances from the boundary of a condition at which it may hold. Its margin is half of the greatest."""
PROJECTIONS = 10
"""Steps of a projection onto a condition."""


@dataclass(frozen=True, slots=True)
class Trajectories(Rows):
    """Trajectories of B plans, and the conditions along them.

    Attributes:
        shares: controls of the plans as shares of their ranges, (B, T, m).
        states: states under them, (B, T + 1, all states).
        distance: distance of each state from the boundary of each condition, negative if the condition is
            violated, (B, conditions, T + 1).
    """

    shares: Numbers
    states: Numbers
    distance: Numbers

    def cost(self, needed: NDArray[np.bool_], margin: Numbers) -> Numbers:
        """Cost of the distances that are less than a margin, (B,): half their squares, linear beyond 1.

        Args:
            needed: True where a condition must hold at a sample, (B, conditions, T + 1).
            margin: distance that states should keep from the boundary of each condition, (B, conditions).
        """
        short = np.where(needed, margin[..., None] - self.distance, 0.0).clip(0.0, FAR)
        cost: Numbers = np.where(short < 1.0, 0.5 * short**2, short - 0.5).sum((1, 2))
        return cost

    def barrier(self) -> Numbers:
        """Barrier of the bounds of the controls, with weight 1, (B,)."""
        found: Numbers = -np.log(self.shares * (1.0 - self.shares)).sum((1, 2))
        return found


@dataclass(frozen=True, slots=True)
class Linearised(Trajectories):
    """Trajectories of B plans, with the conditions linearised along them.

    Attributes:
        size: slopes of the conditions, by which their values are divided to give distances,
            (B, conditions, T + 1).
        slopes: derivative of the distance with respect to the states that move, (B, conditions, T + 1, n).
    """

    size: Numbers
    slopes: Numbers


@dataclass(frozen=True, slots=True)
class Places:
    """States that meet conditions.

    Attributes:
        states: a state for each condition, (conditions, n).
        violated: True for each condition that the state from which they were sought violates, (conditions,).
        margins: distance from its boundary that each condition allows there, at most `MARGIN`,
            (conditions,).
    """

    states: Tensor
    violated: Tensor
    margins: Numbers


class GaussNewton:
    """Gauss-Newton steps for plans of one task.

    Each condition is linearised at each state. The distance of a state from a condition is the distance to
    the nearest state at which the linearised condition just holds. Each state component is first divided by
    its `spread`, so that distances have no unit.

    Attributes:
        spread: typical range of each state, (n,).
    """

    def __init__(self, task: Task, conditions: Sequence[ir.Formula], spread: Tensor) -> None:
        """Prepare the steps.

        Args:
            task: specification and system.
            conditions: formulas over the states of one sample.
            spread: typical range of each state, (n,).
        """
        self.task, self.spread = task, spread
        self._conditions = conditions
        names, timers = task.system.names, {timer.name for timer in task.system.timers}
        read = frozenset().union(*(each.columns for each in conditions))
        self._read = torch.tensor([i for i, name in enumerate(names) if name in read])
        self._scale = self.spread[self._read]
        moving = task.system.exact_step.next.keys() - timers
        self._moving = np.array([i for i, name in enumerate(names) if name in moving], dtype=np.int64)
        self._low = task.system.control_low.double().numpy()
        self._span = np.maximum(task.system.control_high.double().numpy() - self._low, TINY)
        self._native = NativeStep.of(task.system, rewarded=False)

    def begin(self, x0: Tensor, plans: Tensor) -> Linearised:
        """Linearise the conditions along plans (B, T, m) from x0 (n,), with controls off their bounds."""
        shares = ((plans.numpy() - self._low) / self._span).clip(INSIDE, 1.0 - INSIDE)
        states = self.task.rollout(x0.expand(len(plans), -1), self.plans(shares))
        return self.linearised(shares, states.nan_to_num(FAR, FAR, -FAR).numpy())

    def linearised(self, shares: Numbers, states: Numbers) -> Linearised:
        """Linearise the conditions along plans, given as shares of the ranges, and the states under them."""
        values, slopes = self._linear(torch.from_numpy(states))
        size = slopes.mul(self._scale[:, None]).square().sum(2).sqrt()
        size = torch.maximum(size, FLAT * size.amax(1, keepdim=True)).clamp(min=TINY)
        rows = slopes.new_zeros(*values.shape, states.shape[2])
        rows[..., self._read] = (slopes / size[:, :, None]).permute(0, 1, 3, 2)
        distance, sizes = ((part.permute(2, 0, 1)).numpy() for part in (values / size, size))
        moving = rows[..., self._moving].permute(2, 0, 1, 3).numpy()
        return Linearised(shares, states, distance, sizes, moving)

    def plans(self, shares: Numbers) -> Tensor:
        """Return the plans whose controls are given as shares of their ranges."""
        return torch.from_numpy(self._low + self._span * shares)

    def step(
        self, now: Linearised, needed: NDArray[np.bool_], margin: Numbers, damping: Numbers
    ) -> Trajectories:
        """Change plans by one step, in each of the `LENGTHS`.

        Args:
            now: the plans, all from the same initial state.
            needed: True where a condition must hold at a sample, (B, conditions, T + 1).
            margin: distance that states should keep from the boundary of each condition, (B, conditions).
            damping: weights of squared changes of the controls, relative to their mean effect, (B,).

        Returns:
            The changed plans, (B * lengths); distances are by the slopes along the present ones.
        """
        least = margin[..., None]
        near = needed & (now.distance < 1.5 * least)  # also those that just hold, so that they go on
        rows = np.where(near[..., None], now.slopes, 0.0)
        rest = np.where(near, least - now.distance, 0.0).clip(0.0)
        weight = 1.0 / np.maximum(rest, 1.0)  # far from its boundary, a condition costs its distance
        curve = np.einsum("bcki,bckj,bck->kbij", rows, rows, weight, optimize=True)
        pull = -np.einsum("bcki,bck->kbi", rows, weight * rest)
        by_state, by_control = self._jacobians(now)
        effects = by_control @ by_control.swapaxes(2, 3)  # squared, of the controls before each sample
        for k in range(1, len(effects)):
            effects[k] += by_state[k] @ effects[k - 1] @ by_state[k].swapaxes(1, 2)
        effect = np.nan_to_num(np.einsum("kbij,kbij->b", effects, curve[1:]), nan=1.0, posinf=1e12)
        effect = effect / np.maximum(1, near.sum((1, 2)))
        weight = barrier_weight(now.cost(needed, margin), now.shares)[:, None, None]
        below, above = now.shares, 1.0 - now.shares
        own = weight / below**2 + weight / above**2 + (effect * damping + TINY**2)[:, None, None]
        push = weight / above - weight / below
        cost = curve, pull, own.swapaxes(0, 1), push.swapaxes(0, 1)
        solve = riccati if self._native is None else self._native.compiled.riccati
        return self._followed(now, solve(by_state, by_control, *cost))

    def _followed(self, now: Linearised, gains: Numbers) -> Trajectories:
        """Apply gains and, in the last column, changes of the controls, (T, B, m, n + 1), in all lengths."""
        if self._native is None:
            shares, states = self._followed_by_arrays(now, gains)
        else:
            bounds = {"low": self._low, "span": self._span, "inside": INSIDE}
            shares, states = self._native.compiled.follow(
                gains, now.shares, now.states, moving=self._moving, lengths=LENGTHS, **bounds
            )
        found = np.nan_to_num(states, nan=FAR, posinf=FAR, neginf=-FAR)
        values = values_of(self.task, self._conditions, torch.from_numpy(found)).permute(2, 0, 1).numpy()
        return Trajectories(shares, found, values / np.repeat(now.size, len(LENGTHS), 0))

    def _followed_by_arrays(self, now: Linearised, gains: Numbers) -> tuple[Numbers, Numbers]:
        """Controls as shares and states, (B * lengths, T or T + 1, m or n), where there is no compiler."""
        many = len(LENGTHS)
        about, path = (part.swapaxes(0, 1).repeat(many, 1) for part in (now.shares, now.states))
        gains = gains.repeat(many, 1)
        apart = np.empty((len(path[0]), len(self._moving) + 1, 1))
        apart[:, -1, 0] = np.tile(LENGTHS, len(now.shares))
        low, high = INSIDE * about, 1.0 - INSIDE * (1.0 - about)
        shares, states, x = np.empty_like(about), path.copy(), path[0]
        for k in range(len(about)):
            apart[:, :-1, 0] = x[:, self._moving] - path[k][:, self._moving]
            share = np.clip(about[k] + (gains[k] @ apart)[..., 0], low[k], high[k])
            shares[k] = np.where(np.isfinite(share), share, about[k])
            x = states[k + 1] = self._stepped(x, self._low + self._span * shares[k])
        return shares.swapaxes(0, 1), states.swapaxes(0, 1)

    def _jacobians(self, now: Linearised) -> tuple[Numbers, Numbers]:
        """Derivatives of each step by states and controls, (T, B, n, n) and (T, B, n, m), by differences.

        Controls are in shares of their ranges; n is the number of states that move.
        """
        count, batch, steps = len(self._moving), len(now.shares), now.shares.shape[1]
        scale = self.spread.numpy()[self._moving]
        probes = PROBE * np.concatenate((scale, self._span))
        x = now.states[:, :-1].reshape(-1, now.states.shape[2])
        u = (self._low + self._span * now.shares).reshape(-1, len(self._span))
        x, u = (np.repeat(part[None], 2 * len(probes), 0) for part in (x, u))
        for number, probe in enumerate(probes):
            part, column = (x, self._moving[number]) if number < count else (u, number - count)
            part[2 * number, :, column] += 0.5 * probe
            part[2 * number + 1, :, column] -= 0.5 * probe
        after = self._stepped(x.reshape(-1, now.states.shape[2]), u.reshape(-1, len(self._span)))[
            :, self._moving
        ]
        ends = after.reshape(len(probes), 2, batch, steps, count)
        slopes = np.nan_to_num((ends[:, 0] - ends[:, 1]) / probes[:, None, None, None])
        each = slopes.transpose(2, 1, 3, 0)
        return np.ascontiguousarray(each[..., :count]), each[..., count:] * self._span

    def _stepped(self, x: Numbers, u: Numbers) -> Numbers:
        """States after one step from states (rows, n) under controls (rows, m)."""
        if self._native is None:
            return self.task.system.step(torch.from_numpy(x), torch.from_numpy(u)).numpy()
        return self._native.compiled.advance(np.ascontiguousarray(x), np.ascontiguousarray(u), 0.0)[0]

    @torch.no_grad()
    def nearest(self, state: Tensor) -> Places:
        """For each condition, find a state near `state`, (n,), that meets it; dynamics are ignored."""
        count = len(self._conditions)
        places, index = state.repeat(count, 1), torch.arange(count)
        violated = torch.zeros(count, dtype=torch.bool)
        for number in range(PROJECTIONS):
            values, slopes = self._linear(places[:, None])
            value, slope = values[index, 0, index], slopes[index, 0, :, index]
            if number == 0:
                violated = value < 0.0
            if not bool((value < 0.0).any()):
                break
            along = slope * self._scale**2
            share = -1.05 * value / (along * slope).sum(1).clamp(min=TINY**2)
            places[:, self._read] += torch.where(value < 0.0, share, 0.0)[:, None] * along
        size = (slope * self._scale).norm(dim=1, keepdim=True).clamp(min=TINY)
        moved, depths = places[:, None].repeat(1, len(DEPTHS), 1), torch.from_numpy(DEPTHS)
        moved[..., self._read] += depths[:, None] * (slope * self._scale**2 / size)[:, None]
        reached = values_of(self.task, self._conditions, moved)[index, :, index] / size
        margins = torch.where(reached >= 0.5 * depths, 0.5 * depths, 0.5 * DEPTHS[-1]).amax(1)
        return Places(places, violated, margins.numpy())

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


def barrier_weight(cost: Numbers, shares: Numbers) -> Numbers:
    """Weight of the barrier of plans, (B, T, m), by their cost, (B,): it falls with the cost."""
    found: Numbers = (BARRIER / max(1, shares[0].size) * cost).clip(TINY, 0.1)
    return found


def riccati(
    by_state: Numbers, by_control: Numbers, curve: Numbers, pull: Numbers, own: Numbers, push: Numbers
) -> Numbers:
    """Changes of the controls that minimise a quadratic cost of linear dynamics.

    Args:
        by_state: derivatives of each step by the states, (T, B, n, n).
        by_control: derivatives of each step by the controls, (T, B, n, m).
        curve: second derivatives of the cost by the states, (T + 1, B, n, n).
        pull: derivatives of the cost by the states, (T + 1, B, n).
        own: second derivatives of the cost by each control, (T, B, m).
        push: derivatives of the cost by each control, (T, B, m).

    Returns:
        The gains of the feedback and, in the last column, the changes, (T, B, m, n + 1).
    """
    steps, batch, n, m = by_control.shape
    state, control = slice(n), slice(n + 1, None)
    motion = np.zeros((steps, batch, n + 1, n + 1 + m))  # of (states, 1) by (states, 1, controls)
    motion[..., state, state], motion[..., state, control], motion[..., n, n] = by_state, by_control, 1.0
    cost = np.zeros((steps + 1, batch, n + 1 + m, n + 1 + m))
    cost[..., state, state], cost[..., state, n], cost[..., n, state] = curve, pull, pull
    each = np.arange(n + 1, n + 1 + m)
    cost[:-1, :, each, each], cost[:-1, :, n, control], cost[:-1, :, control, n] = own, push, push
    found = np.empty((steps, batch, m, n + 1))
    ahead, turned = cost[-1, :, : n + 1, : n + 1], motion.swapaxes(2, 3)
    for k in range(steps - 1, -1, -1):
        whole = turned[k] @ ahead @ motion[k] + cost[k]
        mixed = whole[:, control, : n + 1]
        found[k] = -np.linalg.solve(whole[:, control, control], mixed)
        ahead = whole[:, : n + 1, : n + 1] + mixed.swapaxes(1, 2) @ found[k]
        ahead = 0.5 * (ahead + ahead.swapaxes(1, 2))
    return found


def spread_of(task: Task, states: Tensor) -> Tensor:
    """Typical range of each state, (n,): its standard deviation, at most that over its declared range.

    On an unstable system, the states of random plans say little about those of good ones.

    Args:
        task: specification and system.
        states: trajectories under random plans, (k, T + 1, n).
    """
    found = states.nan_to_num(0.0, 0.0, 0.0).flatten(0, 1).std(0)
    for i, column in enumerate(task.system.signature.columns):
        if column.low is not None and column.high is not None and column.high > column.low:
            found[i] = found[i].clamp(max=(column.high - column.low) * UNIFORM)
    return found.clamp(min=TINY)


@torch.no_grad()
def values_of(task: Task, conditions: Sequence[ir.Formula], states: Tensor) -> Tensor:
    """Robustness of conditions at the samples of states (B, T + 1, n): (conditions, T + 1, B)."""
    samples, names = states.shape[1], task.system.names
    env = {name: states[..., i].t().contiguous() for i, name in enumerate(names)}
    found = evaluate(conditions, env, ops=TORCH, count=samples)
    return torch.stack([each.expand(samples, len(states)) for each in found]).nan_to_num(nan=-1e9)
