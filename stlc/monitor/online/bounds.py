"""Bounds of a requirement while its signals come in, and what gives them: a tracker."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]
Ending: TypeAlias = Literal["open", "truncate"]


@dataclass(frozen=True, slots=True)
class TrackingOptions:
    """How values are taken.

    Attributes:
        ending: what becomes of windows that the end of the trace cuts.
        truth: predicates are true or false (+inf or -inf), without any tolerance.
        begin: the first sample that is judged.
    """

    ending: Ending = "open"
    truth: bool = False
    begin: int = 0


class Bounds(NamedTuple):
    """Least and greatest robustness at consecutive instants, each (instants,)."""

    low: Floats
    high: Floats


class Tracker(Protocol):
    """What is known of a requirement.

    Instants are settled one after the other: from then on their value cannot change.
    """

    @property
    def samples(self) -> int:
        """How many it has taken in."""

    def grow(self, signals: Mapping[str, Floats], first: int, samples: int) -> None:
        """Take new samples in; the arguments are those of `Side.grow`."""

    @property
    def settled(self) -> int:
        """The first instant whose value may still change."""

    def live(self, start: int, stop: int) -> Bounds:
        """Bounds over all continuations at instants that are not settled, or just were."""

    def ended(self, starts: range) -> Bounds:
        """The same where the trace is over and windows to its end end with the last sample."""

    def drop(self, start: int) -> int:
        """Forget instants before `start`; the number of the first sample that is still needed."""
