"""The guard in full: mend the policy's plan, then search from other places, and stop at a time limit.

The paper's backup policy tries a grid of prefixes and lets the policy finish them. Most plans that the
monitor rejects are nearly right: gradient steps on a batch of plans around them mend most, and a hill climb
from the best of these many of the others. What is still unsafe is hunted for from plans at the ends of the
controls. Where a plan is safe and no more, plans that begin anew with a few actions and that the policy
finishes come before it: what satisfies nothing now should at least lead back to where the policy knows its
way.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from stlc.compile.semantics.semantics import TOLERANCE
from stlc.controller.guard.feasibility import Hunt, safely
from stlc.controller.guard.gradient_refine import Ascent
from stlc.controller.guard.sampled_shooting import Beginnings
from stlc.controller.guard.shooting import Backup, Found, finite, grid_of
from stlc.controller.guard.tightened import Spare
from stlc.controller.training.local_search import Searcher
from stlc.runtime.prefixes import Grid

if TYPE_CHECKING:
    from stlc.controller.policies.policy import Policy
    from stlc.controller.problem.task import Task

POLISHED = 3
"""Index of a polished plan into `deploy.SOURCES`."""
TO_SPARE = 0.05
"""Share of the paper's gamma that a climb goes on for, beyond what satisfies."""
SEED = 20_231


@dataclass(frozen=True, slots=True)
class Limits:
    """How much a decision may cost.

    Attributes:
        seconds: per agent; the best plan so far is taken when they are over. None: no limit.
        tries: plans that a climb tries per place that polishing starts from.
        prefixes: of one length, at most, that the paper's rule tries where nothing safe was found.
        drawn: prefixes of one length, at most, that plans are begun anew with; where the grid has more, a
            sample of them.
        places: of the plans that prefixes gave, how many are climbed from.
        again: plans that each of these climbs tries.
        rescue: whether phi_safe alone is hunted for, without the policy, where nothing else was safe.
        margin: what a plan must have to spare of safety requirements before the guard lets it pass, by their
            names, in their units; of the paper's guard too.
        paper: seconds per agent of the paper's guard, which nobody hurries by default.
    """

    seconds: float | None = 0.1
    tries: int = 2000
    prefixes: int = 1000
    drawn: int = 256
    places: int = 8
    again: int = 2000
    rescue: bool = True
    margin: Spare = field(default_factory=dict)
    paper: float | None = None


class FullBackup:
    """Polishing, and staged prefixes behind it.

    Args:
        task: specification and system.
        policy: who finishes prefixes.
        grid: values of the controls; by default what the system file says.
        limits: of a decision.
    """

    def __init__(
        self, task: Task, policy: Policy, *, grid: Grid | None = None, limits: Limits | None = None
    ) -> None:
        self.task = task
        self.limits = limits or Limits()
        grid = grid or grid_of(task)
        few = tuple(length for length in grid.lengths if grid.count(length) <= self.limits.prefixes)
        self.beginnings = Beginnings(task, policy, grid, self.limits.drawn)
        self.paper = Backup(task, policy, grid=replace(grid, lengths=few or grid.lengths[:1]))
        self._generator = torch.Generator().manual_seed(SEED)
        enough = TO_SPARE * task.system.decl.objective.gamma
        self._ascent = Ascent(task, torch.Generator().manual_seed(SEED), enough=enough)
        self._whole = Searcher(task, self._generator, enough=enough)
        self._safe = self._whole
        self._hunt = Hunt(safely(task) if task.compiled.safety else task)
        if task.compiled.safety and len(task.compiled.safety) < len(task.rules):
            self._safe = Searcher(safely(task), self._generator, enough=enough)

    @torch.no_grad()
    def search(self, x: Tensor, plan: Tensor, rest: Tensor | None = None) -> Found:
        """Better plans for states whose own plan was found wanting.

        Args:
            x: (agents, n) float64.
            plan: (agents, T, m), what the policy would do; entries that are not finite are replaced.
            rest: (agents, T, m), what is left of the plans that were followed until now.

        Returns:
            One plan an agent: one that satisfies phi if any was found in time, else phi_safe, else the one
            with the longest safe prefix that the paper's backup knows.
        """
        until = math.inf if self.limits.seconds is None else perf_counter() + self.limits.seconds * len(x)
        plan = finite(plan.to(x.dtype), self.task)
        places = [plan] if rest is None else [plan, finite(rest.to(x.dtype), self.task)]
        found = self._polished(x, torch.stack(places, 1), until)
        lost = (~found.safe).nonzero()[:, 0]
        if len(lost) and self.limits.rescue:
            _improve(found, lost, self._rescued(x[lost], until))
        hopeful = found.safe if self.limits.rescue else torch.ones_like(found.safe)
        todo = (hopeful & (found.rho < -TOLERANCE)).nonzero()[:, 0]
        if len(todo) and perf_counter() < until and len(self.beginnings.heads):
            anew = self._begun_anew(x[todo])
            safe = anew.safe.nonzero()[:, 0]
            found.put(todo[safe], anew.of(safe))
        lost = (~found.safe).nonzero()[:, 0]
        if len(lost):
            found.put(lost, self.paper.search(x[lost], plan[lost]))
        return found

    def _polished(self, x: Tensor, places: Tensor, until: float) -> Found:
        """The best that gradient steps and then climbs reach from `places`, (agents, places, T, m)."""
        tries = self.limits.tries
        raised = self._ascent.rise(x, places, 0.5 * (perf_counter() + until))
        found = self._judged(x, raised[:, 0])
        left = (found.rho < self._whole.enough).nonzero()[:, 0]
        if len(left):
            _improve(found, left, self._climbed(x[left], raised[left], self._whole, tries)[0])
        unsafe = (~found.safe).nonzero()[:, 0]
        if len(unsafe) and self._safe is not self._whole:
            places = found.plan[unsafe][:, None]
            _improve(found, unsafe, self._climbed(x[unsafe], places, self._safe, tries)[0])
        return found

    def _rescued(self, x: Tensor, until: float) -> Found:
        """Plans for phi_safe that have nothing to do with the policy."""
        return self._judged(x, self._hunt.plans(x, lambda: perf_counter() >= until)[0])

    def _judged(self, x: Tensor, plans: Tensor) -> Found:
        """Plans (agents, T, m) as polished ones."""
        judged = self.task.judge(x, plans, states=False)
        number = torch.zeros(len(x), dtype=torch.int64, device=x.device)
        return Found(plans, number + POLISHED, number, judged.rho, judged.safe >= -TOLERANCE)

    def _climbed(self, x: Tensor, places: Tensor, searcher: Searcher, tries: int) -> tuple[Found, Tensor]:
        """The best plan an agent of climbs from each of its places, as polished ones, and which place."""
        agents, count = places.shape[:2]
        starts = x.repeat_interleave(count, 0)
        plans = searcher.at_once(starts, places.flatten(0, 1), tries=tries).plans.to(x.device)
        judged = self.task.judge(starts, plans, states=False)
        value = _value(judged.rho, judged.safe >= -TOLERANCE, judged.safe).view(agents, count)
        place = value.argmax(1)
        pick = place + count * torch.arange(agents, device=x.device)
        number = torch.zeros_like(place)
        safe = judged.safe[pick] >= -TOLERANCE
        return Found(plans[pick], number + POLISHED, number, judged.rho[pick], safe), place

    def _begun_anew(self, x: Tensor) -> Found:
        """Plans from sampled beginnings, the best of them climbed from."""
        begun = self.beginnings.finished(x)
        value = _value(begun.rho, begun.safe >= -TOLERANCE, begun.rho)
        picked = value.topk(min(self.limits.places, value.shape[1]), 1).indices
        rows = torch.arange(len(x), device=x.device)
        best = picked[:, 0]
        ones = torch.ones_like(best)
        safe = begun.safe[rows, best] >= -TOLERANCE
        found = Found(begun.plans[rows, best], ones, begun.length[best], begun.rho[rows, best], safe)
        plans = begun.plans[rows[:, None], picked]
        climbed, place = self._climbed(x, plans, self._whole, self.limits.again)
        _improve(found, rows, replace(climbed, source=ones, t0=begun.length[picked[rows, place]]))
        return found


def _value(rho: Tensor, safe: Tensor, margin: Tensor) -> Tensor:
    """Larger is better: plans that satisfy phi by robustness, then safe ones, then the rest by `margin`."""
    good = rho >= -TOLERANCE
    within = torch.where(good | safe, rho, margin).nan_to_num(-1e9, 1e9, -1e9)
    return within / (1.0 + within.abs()) + 4.0 * good + 2.0 * (safe & ~good)


def _improve(found: Found, rows: Tensor, other: Found) -> None:
    """Take over what is better in `other`, the plans of `rows`."""
    now = _value(found.rho[rows], found.safe[rows], found.rho[rows])
    better = (_value(other.rho, other.safe, other.rho) > now).nonzero()[:, 0]
    found.put(rows[better], other.of(better))
