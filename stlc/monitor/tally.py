"""What is left of judged instants once they are counted: verdict, least robustness, and where."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stlc.monitor.asked import Bounds
from stlc.monitor.judgement import Status

Floats = NDArray[np.float64]
Verdicts = NDArray[np.int8]
"""0 not known, 1 satisfied, 2 violated."""


@dataclass(slots=True)
class Tally:
    """A requirement at consecutive instants of one trace.

    Attributes:
        instants: how many.
        holds: at how many it is certainly satisfied.
        fails: at how many it is certainly violated.
        low: least robustness over all continuations, the least over the instants; +inf without any.
        high: greatest robustness, the least over the instants.
        low_at: instant of `low`.
        high_at: instant of `high`.
    """

    instants: int = 0
    holds: int = 0
    fails: int = 0
    low: float = math.inf
    high: float = math.inf
    low_at: int = 0
    high_at: int = 0

    def add(self, low: Floats, high: Floats, verdicts: Verdicts) -> None:
        """Count the next instants."""
        if not len(verdicts):
            return
        self.low, self.low_at = _least(low, self.low, self.low_at, self.instants)
        self.high, self.high_at = _least(high, self.high, self.high_at, self.instants)
        self.holds += int((verdicts == 1).sum())
        self.fails += int((verdicts == 2).sum())
        self.instants += len(verdicts)

    def with_more(self, bounds: Bounds, verdicts: Verdicts) -> Tally:
        """The same with more instants, itself unchanged."""
        more = replace(self)
        more.add(bounds.low, bounds.high, verdicts)
        return more

    @property
    def status(self) -> Status:
        """Violated if it is at one instant, satisfied if it is at all."""
        if self.fails:
            return "violated"
        return "satisfied" if self.instants and self.holds == self.instants else "inconclusive"

    @property
    def robustness(self) -> float:
        """The least; where that is not known, the bound from which the verdict follows, else NaN."""
        if self.low == self.high or self.status == "satisfied":
            return self.low
        return self.high if self.status == "violated" else math.nan

    @property
    def worst(self) -> int:
        """The instant of the least robustness; of a violation where there is one."""
        return self.high_at if self.fails else self.low_at

    @property
    def share(self) -> float:
        """Share of the instants at which it certainly holds."""
        return self.holds / self.instants if self.instants else math.nan


def _least(values: Floats, known: float, at: int, offset: int) -> tuple[float, int]:
    i = int(np.argmin(values))
    least = float(values[i])
    return (least, offset + i) if least < known or not offset else (known, at)
