"""The guard in full: polish the policy's plan, then search from better places, and stop at a time limit.

The paper's backup policy tries a grid of prefixes and lets the policy finish them. Most plans that the
monitor rejects are nearly right, and a hill climb that starts at them mends them within a millisecond. What
it cannot mend is started anew from prefixes, few enough to be judged in time, and the best of those are
climbed from. Where not even phi_safe is in sight, climbs from plans at the ends of the controls come before.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.quasirandom import SobolEngine

from stlc.compile.semantics import TOLERANCE
from stlc.controller.backup import Backup, Found, finite, grid_of
from stlc.controller.savable import Hunt, safely
from stlc.controller.search import Searcher
from stlc.controller.spare import Spare
from stlc.runtime.prefixes import Grid

if TYPE_CHECKING:
    from stlc.controller.policy import Policy
    from stlc.controller.task import Task

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
        tries: plans that a climb tries per place that it starts from.
        prefixes: prefixes of one length at most; where the grid has more, a low-discrepancy sample of them.
        places: of the plans that prefixes gave, how many are climbed from.
        rescue: whether phi_safe alone is hunted for, without the policy, where nothing else was safe.
        margin: what a plan must have to spare of safety requirements before the guard lets it pass, by their
            names, in their units; of the paper's guard too.
    """

    seconds: float | None = 0.1
    tries: int = 2000
    prefixes: int = 1000
    places: int = 8
    rescue: bool = True
    margin: Spare = field(default_factory=dict)


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
        self.grid = grid
        self.paper = Backup(task, policy, grid=replace(grid, lengths=few or grid.lengths[:1]))
        self._generator = torch.Generator().manual_seed(SEED)
        enough = TO_SPARE * task.system.decl.objective.gamma
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
        until = None if self.limits.seconds is None else perf_counter() + self.limits.seconds * len(x)
        plan = finite(plan.to(x.dtype), self.task)
        places = [plan] if rest is None else [plan, finite(rest.to(x.dtype), self.task)]
        found = self._polished(x, torch.stack(places, 1))
        lost = (~found.safe).nonzero()[:, 0]
        if len(lost) and self.limits.rescue:
            _improve(found, lost, self._rescued(x[lost], until))
        for length in self.grid.lengths:
            todo = (found.rho < -TOLERANCE).nonzero()[:, 0]
            if len(todo) == 0 or (until is not None and perf_counter() >= until):
                break
            begun = self._begun_anew(x[todo], plan[todo], length)
            _improve(found, todo, begun)
        lost = (~found.safe).nonzero()[:, 0]
        if len(lost):
            _put(found, lost, self.paper.search(x[lost], plan[lost]))
        return found

    def _polished(self, x: Tensor, places: Tensor) -> Found:
        """The best that climbs reach from `places`, (agents, places, T, m)."""
        found = self._climbed(x, places, self._whole)
        unsafe = (~found.safe).nonzero()[:, 0]
        if len(unsafe) and self._safe is not self._whole:
            _improve(found, unsafe, self._climbed(x[unsafe], found.plan[unsafe][:, None], self._safe))
        return found

    def _rescued(self, x: Tensor, until: float | None) -> Found:
        """Plans for phi_safe that have nothing to do with the policy."""
        plans, _ = self._hunt.plans(x, math.inf if until is None else until)
        judged = self.task.judge(x, plans)
        number = torch.zeros(len(x), dtype=torch.int64, device=x.device)
        return Found(plans, number + POLISHED, number, judged.rho, judged.safe >= -TOLERANCE)

    def _climbed(self, x: Tensor, places: Tensor, searcher: Searcher) -> Found:
        """The best plan an agent of climbs from each of its places, as polished ones."""
        agents, count = places.shape[:2]
        starts = x.repeat_interleave(count, 0)
        climb = searcher.begin(
            starts,
            places.flatten(0, 1),
            places.new_zeros(0, *places.shape[2:]),
            tries=self.limits.tries,
            threads=torch.get_num_threads(),
        )
        plans = climb.result().plans
        judged = self.task.judge(starts, plans)
        value = _value(judged.rho, judged.safe >= -TOLERANCE, judged.safe).view(agents, count)
        pick = value.argmax(1) + count * torch.arange(agents, device=x.device)
        number = torch.zeros(agents, dtype=torch.int64, device=x.device)
        return Found(
            plans[pick], number + POLISHED, number, judged.rho[pick], judged.safe[pick] >= -TOLERANCE
        )

    def _begun_anew(self, x: Tensor, plan: Tensor, length: int) -> Found:
        """Plans from prefixes of one length, the best of them climbed from."""
        candidates = self.paper.candidates(x, plan, self._prefixes(length).to(x))
        value = _value(candidates.rho, candidates.safe, candidates.rho)
        picked = value.topk(min(self.limits.places, value.shape[1]), 1).indices
        rows = torch.arange(len(x), device=x.device)[:, None]
        found = self._climbed(x, candidates.plans[rows, picked], self._whole)
        first, row = picked[:, 0], rows[:, 0]
        number = torch.full((len(x),), length, dtype=torch.int64, device=x.device)
        head = Found(
            candidates.plans[row, first],
            torch.ones_like(number),
            number,
            candidates.rho[row, first],
            candidates.safe[row, first],
        )
        _improve(head, torch.arange(len(x), device=x.device), found)
        return replace(head, source=torch.ones_like(number), t0=number)

    def _prefixes(self, length: int) -> Tensor:
        """The grid's prefixes where they are few, else a low-discrepancy sample of their range."""
        grid = self.grid
        if grid.count(length) <= self.limits.prefixes:
            return torch.from_numpy(grid.prefixes(length))
        low = torch.tensor([values[0] for values in grid.values], dtype=torch.float64)
        high = torch.tensor([values[-1] for values in grid.values], dtype=torch.float64)
        engine = SobolEngine(length * len(low), scramble=True, seed=SEED)  # type: ignore[no-untyped-call]
        unit = engine.draw(self.limits.prefixes, dtype=torch.float64).view(-1, length, len(low))
        return low + (high - low) * unit


def _value(rho: Tensor, safe: Tensor, margin: Tensor) -> Tensor:
    """Larger is better: plans that satisfy phi by robustness, then safe ones, then the rest by `margin`."""
    good = rho >= -TOLERANCE
    within = torch.where(good | safe, rho, margin).nan_to_num(-1e9, 1e9, -1e9)
    return within / (1.0 + within.abs()) + 4.0 * good + 2.0 * (safe & ~good)


def _improve(found: Found, rows: Tensor, other: Found) -> None:
    """Take over what is better in `other`, the plans of `rows`."""
    now = _value(found.rho[rows], found.safe[rows], found.rho[rows])
    better = (_value(other.rho, other.safe, other.rho) > now).nonzero()[:, 0]
    picked = Found(*(getattr(other, name)[better] for name in Found.__slots__))
    _put(found, rows[better], picked)


def _put(found: Found, rows: Tensor, other: Found) -> None:
    for name in Found.__slots__:
        getattr(found, name)[rows] = getattr(other, name)
