"""`schedule`: the planner `search`, with schedules of the goals from the beginning."""

from __future__ import annotations

from dataclasses import dataclass

from stlc.controller.options import bounded
from stlc.controller.search.planners.search import SearchPlanner


@dataclass(frozen=True, slots=True)
class SchedulePlanner(SearchPlanner):
    """The planner `search`, which looks for schedules and for an order of phases before its local search."""

    rounds: int = bounded(0, 0, 10**9)


PLANNER = SchedulePlanner
