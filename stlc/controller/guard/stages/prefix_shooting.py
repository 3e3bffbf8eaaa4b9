"""Prefix shooting: plans that begin with one of many prefixes (first actions), after which the policy plans.

The method is that of Meng and Fan (2023), section "MPC-based Deployment". The prefix lengths T0 = 1, 2, … are
tried in turn. A prefix of length T0 is a sequence of T0 actions in which each of the m controls has one of L
values. There are M = L^(m T0) such prefixes; if M is too large, a random sample is tried. Each prefix is
applied from the present state, and the policy plans from the state that the prefix leads to. The search ends
at the first T0 with which a plan satisfies the specification, or at least the requirements tagged `@safety`.

The remainder of the previous plan is also a candidate, so that a safe plan is not lost after its first
action. This is not in the paper (decision record 37 in `docs/decisions`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from stlc.compile.backends.torch.ops import TORCH
from stlc.controller.guard.candidates import BACKUP, Candidates, Deadline, finite, first
from stlc.controller.guard.stages import GuardStage, Rejected, Setup, Tried
from stlc.runtime.decision import continued

if TYPE_CHECKING:
    from collections.abc import Iterator

HANDED_ON = 65_536
"""Maximum number of trajectories stored for the next stage, which recomputes the others."""


class PrefixShooting(GuardStage):
    """Guard stage: the plan with the shortest prefix after which the policy can satisfy the specification.

    If no plan with a prefix of some length satisfies the specification, a safe plan with such a prefix is
    accepted. Of the plans with prefixes of equal length, the one with the highest robustness is taken, then
    the one with the least performance cost. If plans are equal in both, the plan with the policy's own first
    actions is preferred. The cost matters if a deadline of the specification cannot be met: then all plans
    have the same robustness.
    """

    def __init__(self, setup: Setup) -> None:
        self.task, self.policy, self.grid = setup.task, setup.policy, setup.grid
        self.last_resort = setup.stages[0] is not PrefixShooting
        if self.last_resort:  # after other stages: few prefixes, no deadline
            grid = setup.grid
            few = tuple(length for length in grid.lengths if grid.count(length) <= setup.limits.prefixes)
            self.grid = replace(grid, lengths=few or grid.lengths[:1])

    def wanted(self, best: Candidates) -> Tensor:
        """Mask of the agents without a safe plan."""
        return ~best.is_safe

    def propose(self, rejected: Rejected, rows: Tensor, deadline: Deadline) -> Candidates:
        """Return the best plan of each agent with the shortest possible prefix.

        Prefixes (first actions of plans) of length T0 = 1, 2, … are tried in turn, until a plan satisfies the
        specification or is at least safe. An agent without a safe plan at any length gets an unjudged plan.
        """
        deadline = Deadline() if self.last_resort else deadline
        found, room = Candidates.unjudged(rejected.plan[rows]), HANDED_ON
        todo = torch.arange(len(rows), device=rows.device)
        for length in self.grid.lengths:
            left = []
            for group, candidates in self.candidates(rejected, rows, todo, length, deadline):
                done = (candidates.satisfies | candidates.is_safe).any(1)
                some = candidates.of(done)
                choice = continued(some.rho.t(), some.safe.t(), some.cost.t(), TORCH)
                found.put(group[done], some.pick(first(choice)))
                left.append(group[~done])
                if deadline.over or length == self.grid.lengths[-1]:
                    room -= int((~done).sum()) * candidates.rho.shape[1]
                    if room >= 0 and not bool(done.all()):
                        rejected.tried.append(Tried(rows[group[~done]], candidates.of(~done)))
            todo = torch.cat(left) if left else todo
            if deadline.over or not len(todo):
                break
        return found

    def candidates(
        self, rejected: Rejected, rows: Tensor, todo: Tensor, length: int, deadline: Deadline
    ) -> Iterator[tuple[Tensor, Candidates]]:
        """Yield candidate plans with prefixes of `length` actions, for one group of agents at a time.

        Args:
            rejected: agents whose plans the guard rejected.
            rows: indices of agents in `rejected`.
            todo: the entries of `rows` that need candidate plans, as indices into `rows`.
            length: number of first actions (a prefix) that come from fixed control values; the policy plans
                the rest.
            deadline: once it is over, no further prefixes are tried.

        Yields:
            The part of `todo` that forms the group, (k,), and the candidate plans of its agents, (k,
            choices). Choice 0 has the prefix of the policy's own plan. If there are previous plans, the last
            choice is the remainder of the previous plan.
        """
        prefixes = torch.from_numpy(self.grid.prefixes(length)).to(rejected.x)
        for group in torch.split(todo, max(self.grid.batch // (len(prefixes) + 1), 1)):
            agents = rows[group]
            tried = prefixes[:0] if deadline.over else prefixes
            found = self._finished(rejected.x[agents], rejected.plan[agents], tried, deadline)
            if rejected.previous is not None:
                before = rejected.previous[agents][:, None]
                found = found.beside(
                    Candidates.judged(self.task, rejected.x[agents], before, BACKUP, length, cost=True)
                )
            yield group, found

    def _finished(self, x: Tensor, own: Tensor, prefixes: Tensor, deadline: Deadline) -> Candidates:
        """Judge plans that begin with M + 1 different prefixes: (agents, M + 1).

        After a prefix, the policy plans the rest, from the state that the prefix leads to.

        The first prefix consists of the first T0 actions of `own`, the policy's plans, (agents, T, m). The
        others are `prefixes`, (M, T0, m). At most `grid.batch` trajectories are computed at a time. For a
        single agent, the computation ends early, after a batch, if the deadline is over.
        """
        agents, (count, length, _) = len(x), prefixes.shape
        heads = torch.cat((own[:, None, :length], prefixes.expand(agents, -1, -1, -1)), 1).flatten(0, 1)
        starts = x.repeat_interleave(count + 1, 0)
        parts = []
        size = self.grid.batch
        for start, head in zip(torch.split(starts, size), torch.split(heads, size), strict=True):
            reached = self.task.rollout(start, head)[:, -1]
            tail = finite(self.policy.continuation(reached).to(x.dtype), self.task)
            plans = torch.cat((head, tail[:, : self.task.horizon - length]), 1)
            parts.append(Candidates.judged(self.task, start, plans, BACKUP, length, cost=True))
            if agents == 1 and deadline.over:
                break
        return Candidates.concatenated(parts).view(agents)


STAGE = PrefixShooting
