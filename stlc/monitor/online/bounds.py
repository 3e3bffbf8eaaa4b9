"""Interface of the evaluators of one requirement on a growing trace, and the bounds that they return."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol, TypeAlias

from stlc.monitor.online.history import Floats

Ending: TypeAlias = Literal["open", "truncate"]


@dataclass(frozen=True, slots=True)
class TrackingOptions:
    """Options for the evaluation of one requirement on a growing trace.

    Attributes:
        ending: treatment of windows that extend beyond the end of the trace: "open" leaves missing samples
            unknown, "truncate" clips the windows.
        begin: the first sample at which the requirement is evaluated.
    """

    ending: Ending = "open"
    begin: int = 0


class RobustnessBounds(NamedTuple):
    """Least and greatest robustness at consecutive instants, (instants,) each."""

    low: Floats
    high: Floats


class Tracker(Protocol):
    """Incremental evaluator of one requirement on a growing trace.

    An instant is settled if later samples can no longer change its value. Instants are settled in order.
    """

    @property
    def samples(self) -> int:
        """Number of samples received."""

    def grow(self, signals: Mapping[str, Floats], first: int, samples: int) -> None:
        """Add samples, now `samples` in total; `signals` has those from `first` on, (stored, traces) each."""

    @property
    def settled(self) -> int:
        """Index of the first instant that is not settled yet."""

    def live(self, start: int, stop: int) -> RobustnessBounds:
        """Bounds at the instants from `start` to `stop` (exclusive), over all continuations of the trace."""

    def ended(self, starts: range) -> RobustnessBounds:
        """Bounds at the instants `starts`, if the trace, and windows to its end, end with the last sample."""

    def drop(self, start: int) -> int:
        """Free the memory of instants before `start`; returns the index of the first sample still needed."""
