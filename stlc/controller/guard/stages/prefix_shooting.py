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

from collections.abc import Iterable, Iterator
from dataclasses import replace

import torch
from torch import Tensor

from stlc.compile.backends.torch.ops import TORCH
from stlc.controller.guard.candidates import BACKUP, Candidates, Deadline, completed, first
from stlc.controller.guard.stages import GuardStage, Rejected, Setup, Tried
from stlc.runtime.decision import prefix_shooting

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
        undecided = torch.ones(len(rows), dtype=torch.bool, device=rows.device)

        def tried(length: int) -> Iterable[Tried]:
            todo = undecided.nonzero()[:, 0]
            stopped = not len(todo) or (length != self.grid.lengths[0] and deadline.over)
            return () if stopped else self.candidates(rejected, rows, todo, length, deadline)

        for shot in prefix_shooting(self.grid.lengths, tried, TORCH):
            group, candidates, done = shot.plans.rows, shot.plans.candidates, shot.found
            if bool(done.any()):
                found.put(group[done], candidates.pick(first(shot.chosen())).of(done))
            undecided[group] = ~done
            if deadline.over or shot.last:
                room -= int((~done).sum()) * candidates.rho.shape[1]
                if room >= 0 and not bool(done.all()):
                    rejected.tried.append(Tried(rows[group[~done]], candidates.of(~done)))
        return found

    def candidates(
        self, rejected: Rejected, rows: Tensor, todo: Tensor, length: int, deadline: Deadline
    ) -> Iterator[Tried]:
        """Yield candidate plans with prefixes of `length` actions, for one group of agents at a time.

        Args:
            rejected: agents whose plans the guard rejected.
            rows: indices of agents in `rejected`.
            todo: the entries of `rows` that need candidate plans, as indices into `rows`.
            length: number of first actions (a prefix) that come from fixed control values; the policy plans
                the rest.
            deadline: once it is over, no further prefixes are tried.

        Yields:
            The part of `todo` that forms the group, and the candidate plans of its agents. Choice 0 has the
            prefix of the policy's own plan. If there are previous plans, the last choice is the remainder of
            the previous plan.
        """
        prefixes = torch.from_numpy(self.grid.prefixes(length)).to(rejected.x)
        for group in torch.split(todo, max(self.grid.batch // (len(prefixes) + 1), 1)):
            agents = rows[group]
            tried = prefixes[:0] if deadline.over else prefixes
            found = self._finished(rejected.x[agents], rejected.plan[agents], tried, deadline)
            if rejected.previous is not None:
                before = rejected.previous[agents][:, None]
                rest = Candidates.judged(self.task, rejected.x[agents], before, BACKUP, length, cost=True)
                found = Candidates.concatenated((found, rest), 1)
            yield Tried(group, found)

    def _finished(self, x: Tensor, own: Tensor, prefixes: Tensor, deadline: Deadline) -> Candidates:
        """Judge plans that begin with M + 1 different prefixes: (agents, M + 1).

        After a prefix, the policy plans the rest, from the state that the prefix leads to.

        The first prefix consists of the first T0 actions of `own`, the policy's plans, (agents, T, m). The
        others are `prefixes`, (M, T0, m). At most `grid.batch` trajectories are computed at a time. For a
        single agent, the computation ends early, after a batch, if the deadline is over.
        """
        agents, length = len(x), prefixes.shape[1]
        heads = torch.cat((own[:, None, :length], prefixes.expand(agents, -1, -1, -1)), 1)
        parts = []
        for some in torch.split(heads, self.grid.batch, 1):
            plans = completed(x, some, self.task, self.task.rollout, self.policy.continuation)
            parts.append(Candidates.judged(self.task, x, plans, BACKUP, length, cost=True))
            if agents == 1 and deadline.over:
                break
        return Candidates.concatenated(parts, 1)


STAGE = PrefixShooting
