"""Choice of the measurements that a command asks for: training runs, plans, and closed-loop runs (drives).

One measurement of a table is called a cell.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from benchmarks.comparison import HOUR
from benchmarks.drives import WITH_BACKUP, Drive
from benchmarks.options import Comparing, Training
from benchmarks.plannings import PlanCell
from benchmarks.roster import Contender
from benchmarks.store import Result
from benchmarks.training import Cell, Length, Place

BUDGETS = (60.0, 300.0)
"""Training times in seconds if no budget is given."""


@dataclass(frozen=True, slots=True)
class Selection:
    """Benchmarks, methods (contenders) and options of one command."""

    benchmarks: tuple[str, ...]
    contenders: tuple[Contender, ...]
    training: Training
    comparing: Comparing

    def trainings(self) -> list[Cell]:
        """Return the requested training runs, ordered by length, seed, method and benchmark."""
        if not self.comparing.asks("learners"):
            return []
        lengths = self.training.seeds_and_lengths(BUDGETS)
        ours = [each for each in self.contenders if not each.plans]
        cells = [(seed, length, each) for seed, length in lengths for each in ours]
        if self.comparing.hour:
            cells += [(0, Length(HOUR, clock="processor"), each) for each in ours if each.hour]
        return [
            Cell(name, each.method, seed, length, self.training.held_out, options=each.options)
            for seed, length, each in cells
            for name in self.benchmarks
        ]

    def plans(self) -> list[PlanCell]:
        """Return the requested measurements of planners, those with a short time budget first."""
        if not self.comparing.asks("plans"):
            return []
        timed = [each for each in self.contenders if each.plans and not each.evaluations]
        own = [each for each in self.contenders if each.plans and each.evaluations]
        cells = [(seconds, each) for seconds in self.comparing.seconds for each in timed]
        cells += [(math.inf, each) for each in own]
        starts = self.comparing.starts
        return [PlanCell(name, each, seconds, starts) for seconds, each in cells for name in self.benchmarks]

    def policies(self, place: Place) -> list[PlanCell]:
        """Return the measurements of trained policies, one for each policy whose run folder still exists."""
        if not self.comparing.asks("plans"):
            return []
        return [each for result in place.valid() for each in self._policy(result, place)]

    def _policy(self, result: Result, place: Place) -> list[PlanCell]:
        cell, known = Cell.of(result), {each.name: each for each in self.contenders}
        if cell.benchmark not in self.benchmarks or cell.contender not in known:
            return []
        run = place.newest_run(cell.key)
        own = known[cell.contender], math.inf, self.comparing.starts
        return [] if run is None else [PlanCell(cell.benchmark, *own, run, cell.label)]

    def drives(self, place: Place) -> list[Drive]:
        """Return the requested closed-loop measurements.

        They are those of each planner at one time budget, and those of the best policy of each training
        method among the policies whose run folder still exists.
        """
        if not self.comparing.asks("drives"):
            return []
        decision, starts = self.comparing.seconds_of_decision, self.comparing.starts
        cells = [
            PlanCell(name, each, math.inf if each.evaluations else decision, starts)
            for each in self.contenders
            if each.plans
            for name in self.benchmarks
        ]
        best: dict[tuple[str, str], PlanCell] = {}
        for result in sorted(place.valid(), key=lambda result: float(result["accuracy"])):
            for each in self._policy(result, place):
                best[each.benchmark, each.contender.name] = each
        cells += best.values()
        return [
            Drive(
                each,
                guard,
                self.comparing.worlds,
                self.comparing.agents,
                self.comparing.drive_steps,
            )
            for each in cells
            for guard in WITH_BACKUP
        ]
