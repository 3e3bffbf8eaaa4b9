"""Running summary of evaluated instants: verdict, least robustness, and its instant."""

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
    """Bounds and verdicts at consecutive instants, each (instants,).

    Attributes:
        low: least robustness over all continuations.
        high: greatest robustness.
        holds: satisfied, whatever follows.
        fails: violated, whatever follows.
    """

    low: Floats
    high: Floats
    holds: Flags
    fails: Flags


@dataclass(slots=True)
class Tally:
    """Summary of a requirement at consecutive instants of one trace.

    Attributes:
        instants: how many.
        holds: at how many it is certainly satisfied.
        fails: at how many it is certainly violated.
        low: least robustness over all continuations, the least over the instants; +inf without any.
        high: greatest robustness, the least over the instants.
        low_at: instant of `low`.
        high_at: instant of `high`.
        first: the first of them.
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
        """Count the first `count` of the next instants."""
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

    def with_more(self, judged: JudgedInstants) -> Tally:
        """A copy with more instants."""
        more = replace(self)
        more.add(judged, len(judged.low))
        return more

    @property
    def status(self) -> Status:
        """Violated if one instant is violated, satisfied if all instants are."""
        if self.fails:
            return "violated"
        return "satisfied" if self.instants and self.holds == self.instants else "inconclusive"

    @property
    def robustness(self) -> float:
        """The least robustness; where unknown, the bound from which the verdict follows, else NaN."""
        if self.low == self.high or self.status == "satisfied":
            return self.low
        return self.high if self.status == "violated" else math.nan

    @property
    def worst(self) -> int:
        """The instant of the least robustness; for a violated requirement, of its worst violation."""
        return self.high_at if self.fails else self.low_at

    @property
    def share(self) -> float:
        """Share of the instants at which it certainly holds."""
        return self.holds / self.instants if self.instants else math.nan


def _least(values: Floats, known: float, at: int, offset: int) -> tuple[float, int]:
    i = int(np.argmin(values))
    least = float(values[i])
    return (least, offset + i) if least < known else (known, at)
