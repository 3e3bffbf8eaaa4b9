"""Running summary of a requirement over instants: verdict, least robustness and where it occurs."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stlc.compile.semantics.tolerance import Status, satisfied, status_of, violated
from stlc.monitor.online.history import Floats

Flags = NDArray[np.bool_]


class JudgedInstants(NamedTuple):
    """Bounds on the robustness and verdicts at consecutive instants, (instants,) each.

    The requirement certainly `holds` or `fails` if it does so for all samples that may follow.
    """

    low: Floats
    high: Floats
    holds: Flags
    fails: Flags

    @staticmethod
    def of(bounds: Floats, tolerance: float) -> JudgedInstants:
        """From bounds on the robustness and on that which decides, (instants, 4)."""
        low, high, least, most = bounds.T
        return JudgedInstants(low, high, satisfied(least, tolerance), violated(most, tolerance))

    def followed_by(self, other: JudgedInstants) -> JudgedInstants:
        """These instants, then those of `other`."""
        return JudgedInstants(*(np.concatenate(both) for both in zip(self, other, strict=True)))

    def widened(self, where: Flags, other: JudgedInstants) -> JudgedInstants:
        """Bounds and verdicts that hold for both at the instants `where`."""
        low, high = np.minimum(self.low, other.low), np.maximum(self.high, other.high)
        both = JudgedInstants(low, high, self.holds & other.holds, self.fails & other.fails)
        return JudgedInstants(*(np.where(where, a, b) for a, b in zip(both, self, strict=True)))


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
        if not count:
            return
        low, high = int(np.argmin(judged.low[:count])), int(np.argmin(judged.high[:count]))
        if judged.low[low] < self.low:
            self.low, self.low_at = float(judged.low[low]), self.next + low
        if judged.high[high] < self.high:
            self.high, self.high_at = float(judged.high[high]), self.next + high
        self.holds += int(np.count_nonzero(judged.holds[:count]))
        self.fails += int(np.count_nonzero(judged.fails[:count]))
        self.instants += count

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
        """Violated if violated at any counted instant, satisfied if satisfied at all, else inconclusive."""
        return status_of(self.fails > 0, 0 < self.instants == self.holds)

    @property
    def robustness(self) -> float:
        """The least robustness over the counted instants.

        If it is not known exactly, `low` is returned for a satisfied requirement, `high` for a violated one,
        and NaN if the verdict is inconclusive.
        """
        if self.low == self.high or self.status == "satisfied":
            return self.low
        return self.high if self.status == "violated" else math.nan
