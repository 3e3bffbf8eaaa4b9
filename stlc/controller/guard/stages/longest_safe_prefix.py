"""Longest safe prefix: the last resort of Meng and Fan (2023) if no plan is safe over the whole horizon.

Of all plans, the one is chosen that stays safe for the longest time.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import torch
from torch import Tensor

from stlc.compile.backends.torch.ops import TORCH
from stlc.controller.guard.candidates import SAFEST, Candidates, Deadline, first
from stlc.controller.guard.safe_prefix import anchored, copied, prefix_robustness
from stlc.controller.guard.stages import GuardStage, Rejected, Setup, Tried
from stlc.controller.guard.stages.prefix_shooting import PrefixShooting
from stlc.runtime.decision import longest


class LongestSafePrefix(GuardStage):
    """Guard stage: the plan with the longest safe prefix.

    The safe prefix of a plan is the first part of its trajectory, before the first sample at which a safety
    requirement (tagged `@safety`) is violated.

    Of plans with equally long safe prefixes, the plan with the highest robustness of the specification is
    taken. If plans are still equal, the one with the smaller violation of the safety requirements, averaged
    over time, is taken; then the one with the smaller performance cost.
    """

    def __init__(self, setup: Setup) -> None:
        self.task = setup.task
        self._formulas = [rule.formula for rule in setup.task.compiled.safety]
        self._shooting = PrefixShooting(setup)
        copies = self.task.horizon if any(copied(anchored(formula)) for formula in self._formulas) else 1
        self._size = max(setup.grid.batch // copies, 1)

    def wanted(self, best: Candidates) -> Tensor:
        """Mask of the agents without a safe plan."""
        return ~best.is_safe

    def propose(self, rejected: Rejected, rows: Tensor, deadline: Deadline) -> Candidates:
        """Return, for each agent in `rows`, the plan with the longest safe prefix.

        The plans are those that the stage "prefix shooting" has judged; see `PrefixShooting`.
        """
        found = Candidates.unjudged(rejected.best.plans)
        for tried in self._tried(rejected, rows, deadline):
            found.put(tried.rows, self._safest(rejected.x[tried.rows], tried.candidates))
        return found.of(rows)

    def _tried(self, rejected: Rejected, rows: Tensor, deadline: Deadline) -> Iterator[Tried]:
        """Yield the plans of the stage "prefix shooting" for the agents `rows`, group by group.

        That stage stores its judged plans in `rejected.tried`. For agents whose plans it did not store, the
        plans are computed and judged again.
        """
        missing = torch.zeros(len(rejected.x), dtype=torch.bool, device=rows.device)
        missing[rows] = True
        for tried in rejected.tried:
            missing[tried.rows] = False
            yield tried
        todo, lengths = torch.nonzero(missing)[:, 0], self._shooting.grid.lengths
        if len(todo) and lengths:
            every = torch.arange(len(todo), device=rows.device)
            again = Deadline() if self._shooting.last_resort else deadline
            for tried in self._shooting.candidates(rejected, todo, every, lengths[-1], again):
                yield Tried(todo[tried.rows], tried.candidates)

    def _safest(self, x: Tensor, candidates: Candidates) -> Candidates:
        agents, choices = candidates.rho.shape
        starts, plans = x.repeat_interleave(choices, 0), candidates.plans.flatten(0, 1)
        fallen = []
        for some, theirs in zip(torch.split(starts, self._size), torch.split(plans, self._size), strict=True):
            states = self.task.rollout(some, theirs).permute(2, 1, 0).contiguous()
            columns = dict(zip(self.task.system.names, states, strict=True))
            fallen.append(prefix_robustness(self._formulas, columns))
        falls = torch.cat(fallen, 1).view(-1, agents, choices).transpose(1, 2)
        chosen = candidates.pick(first(longest(falls, candidates.rho.t(), candidates.cost.t(), TORCH)))
        return replace(chosen, source=torch.full_like(chosen.source, SAFEST))


STAGE = LongestSafePrefix
