"""Sampled shooting: plans that begin with a few sampled actions (a prefix), after which the policy plans.

The backup policy of Meng and Fan (2023) tries all prefixes with one action, then all with two, and so on.
Here a sample of the prefixes of every length is judged in one batch. Local search then starts from the best
plans.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from stlc.controller.guard.candidates import BACKUP, Candidates, Deadline, finite
from stlc.controller.guard.stages import GuardStage, Rejected, Setup
from stlc.controller.guard.stages.local_search import improved_from
from stlc.controller.search.local_search import Searcher

if TYPE_CHECKING:
    from stlc.controller.policies.policy import Policy
    from stlc.controller.problem.task import Task
    from stlc.runtime.prefixes import PrefixGrid


class SampledPrefixes:
    """Sample of prefixes (first actions of plans), drawn once; the policy plans the actions after a prefix.

    Args:
        task: specification and system.
        policy: policy that plans from the states that the prefixes lead to.
        grid: values of the controls, and lengths of prefixes.
        most: maximum number of prefixes per length; if there are more, a random sample is used.
    """

    def __init__(self, task: Task, policy: Policy, grid: PrefixGrid, most: int) -> None:
        self.task, self.policy = task, policy
        few = replace(grid, samples=min(grid.samples, most))
        longest = max(grid.lengths, default=0)
        heads, lengths = [torch.zeros(0, longest, len(grid.values), dtype=torch.float64)], []
        for length in grid.lengths:
            some = torch.from_numpy(few.prefixes(length))
            heads.append(torch.cat((some, some.new_zeros(len(some), longest - length, some.shape[2])), 1))
            lengths += [length] * len(some)
        self.heads, self.lengths = torch.cat(heads), torch.tensor(lengths, dtype=torch.int64)
        self._most = max(grid.batch // max(len(self.heads), 1), 1)

    def finished(self, x: Tensor) -> Candidates:
        """Complete all prefixes to plans, and judge the plans: (agents, prefixes).

        A prefix is applied from a state in `x`, (agents, n) float64; the policy plans from the state that the
        prefix leads to. At most `grid.batch` trajectories are computed at a time.
        """
        return Candidates.concatenated([self._finished(part) for part in torch.split(x, self._most)])

    def _finished(self, x: Tensor) -> Candidates:
        count, longest, controls = self.heads.shape
        lengths = self.lengths.to(x.device).repeat(len(x))
        heads = self.heads.to(x).repeat(len(x), 1, 1)
        starts = x.repeat_interleave(count, 0)
        rows = torch.arange(len(starts), device=x.device)
        reached = self.task.rollout(starts, heads)[rows, lengths]
        tails = finite(self.policy.continuation(reached).to(x.dtype), self.task)
        when = torch.arange(self.task.horizon, device=x.device)
        after = (when - lengths[:, None]).clamp(min=0)[..., None].expand(-1, -1, controls)
        plans = tails.gather(1, after)
        head = (when[:longest] < lengths[:, None])[..., None]
        plans[:, :longest] = torch.where(head, heads, plans[:, :longest])
        shape = (len(x), count)
        found = Candidates.judged(self.task, x, plans.view(*shape, *plans.shape[1:]), BACKUP)
        return replace(found, prefix_length=lengths.view(shape))


class SampledShooting(GuardStage):
    """Guard stage: plans from sampled prefixes, and local searches that start from the best of them.

    A prefix is a sequence of the first actions of a plan; the policy plans the rest.
    """

    def __init__(self, setup: Setup) -> None:
        self.task, self.limits = setup.task, setup.limits
        self.prefixes = SampledPrefixes(setup.task, setup.policy, setup.grid, setup.limits.drawn)
        self._searcher = Searcher(setup.task, setup.generator, target=setup.target)

    def wanted(self, best: Candidates) -> Tensor:
        """Mask of the agents whose plan does not satisfy the specification.

        If `Limits.rescue` is True, agents without a safe plan are excluded, because the stage of random
        restarts has already searched for one. All False if there are no prefixes.
        """
        none = len(self.prefixes.heads) == 0
        return (best.is_safe | (not self.limits.rescue)) & ~best.satisfies & (not none)

    def propose(self, rejected: Rejected, rows: Tensor, deadline: Deadline) -> Candidates:
        """The best plan of each agent, if it is safe.

        An agent without a safe plan gets an unjudged one, which does not replace its present plan.
        """
        found = Candidates.unjudged(rejected.plan[rows])
        if deadline.over:
            return found
        x = rejected.x[rows]
        tried = self.prefixes.finished(x)
        picked = tried.standing.topk(min(self.limits.guesses, tried.rho.shape[1]), 1).indices
        agents = torch.arange(len(rows), device=rows.device)
        best = tried.pick(picked[:, 0])
        improved = improved_from(self._searcher, x, tried.plans[agents[:, None], picked], self.limits.again)
        place = improved.standing.argmax(1)
        length = tried.prefix_length[agents, picked[agents, place]]
        improved = improved.pick(place)
        source = torch.full_like(improved.source, BACKUP)
        best.improve(agents, replace(improved, source=source, prefix_length=length))
        safe = best.is_safe.nonzero()[:, 0]
        found.put(safe, best.of(safe))
        return found


STAGE = SampledShooting
