"""Running summary of a requirement over instants: verdict, least robustness and where it occurs."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stlc.monitor.judgement import Status

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]


class JudgedInstants(NamedTuple):
    """Bounds and verdicts at consecutive instants, (instants,) each.

    Attributes:
        low: least robustness over all continuations of the trace.
        high: greatest robustness over all continuations.
        holds: whether the requirement is certainly satisfied, that is, for all samples that may follow.
        fails: whether the requirement is certainly violated.
    """

    low: Floats
    high: Floats
    holds: Flags
    fails: Flags


@dataclass(slots=True)
class RequirementSummary:
    """Summary of a requirement at consecutive instants of one trace.

    Attributes:
        instants: number of counted instants.
        holds: number of instants at which the requirement is certainly satisfied.
        fails: number of instants at which the requirement is certainly violated.
        low: minimum over the instants of the least robustness over all continuations; +inf if there are no
            instants.
        high: minimum over the instants of the greatest robustness over all continuations.
        low_at: instant of `low`.
        high_at: instant of `high`.
        first: the first counted instant.
    """

    instants: int = 0
    holds: int = 0
    fails: int = 0
    low: float = math.inf
    high: float = math.inf
    low_at: int = 0
    high_at: int = 0
    first: int = 0

    def add(self, judged: JudgedInstants, count: int) -> None:
        """Add the first `count` instants of `judged`; they must follow the instants already counted."""
        if count == 1:
            self._add_one(float(judged.low[0]), float(judged.high[0]))
            self.holds += bool(judged.holds[0])
            self.fails += bool(judged.fails[0])
        elif count > 1:
            self.low, self.low_at = _least(judged.low[:count], self.low, self.low_at, self.next)
            self.high, self.high_at = _least(judged.high[:count], self.high, self.high_at, self.next)
            self.holds += int(np.count_nonzero(judged.holds[:count]))
            self.fails += int(np.count_nonzero(judged.fails[:count]))
        self.instants += count

    def _add_one(self, low: float, high: float) -> None:
        if low < self.low:
            self.low, self.low_at = low, self.next
        if high < self.high:
            self.high, self.high_at = high, self.next

    @property
    def next(self) -> int:
        """The instant after the last counted one."""
        return self.first + self.instants

    def with_more(self, judged: JudgedInstants) -> RequirementSummary:
        """Return a copy to which the instants of `judged` are added."""
        more = replace(self)
        more.add(judged, len(judged.low))
        return more

    @property
    def status(self) -> Status:
        """Status over all counted instants: `violated`, `satisfied` or `inconclusive`.

        It is violated if the requirement is violated at any instant, and satisfied if it is satisfied at all
        of them.
        """
        if self.fails:
            return "violated"
        return "satisfied" if self.instants and self.holds == self.instants else "inconclusive"

    @property
    def robustness(self) -> float:
        """The least robustness over the counted instants.

        If it is not known exactly, `low` is returned for a satisfied requirement, `high` for a violated one,
        and NaN if the verdict is inconclusive.
        """
        if self.low == self.high or self.status == "satisfied":
            return self.low
        return self.high if self.status == "violated" else math.nan

    @property
    def worst(self) -> int:
        """The instant of `high` if the requirement is violated, else the instant of `low`."""
        return self.high_at if self.fails else self.low_at

    @property
    def share(self) -> float:
        """Share of the counted instants at which the requirement certainly holds."""
        return self.holds / self.instants if self.instants else math.nan


def _least(values: Floats, known: float, at: int, offset: int) -> tuple[float, int]:
    i = int(np.argmin(values))
    least = float(values[i])
    return (least, offset + i) if least < known else (known, at)
