"""Bounds of a requirement on a growing trace, and the interface of the trackers that compute them."""

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
    """Options for the values of a requirement.

    Attributes:
        ending: treatment of windows that the end of the trace cuts.
        truth: predicates are true or false (+inf or -inf), without any tolerance.
        begin: the first sample at which the requirement is evaluated.
    """

    ending: Ending = "open"
    truth: bool = False
    begin: int = 0


class Bounds(NamedTuple):
    """Least and greatest robustness at consecutive instants, each (instants,)."""

    low: Floats
    high: Floats


class Tracker(Protocol):
    """Incremental evaluator of one requirement.

    Instants are settled in order: the value of a settled instant cannot change.
    """

    @property
    def samples(self) -> int:
        """Number of samples taken in."""

    def grow(self, signals: Mapping[str, Floats], first: int, samples: int) -> None:
        """Take in new samples; the arguments are those of `Side.grow`."""

    @property
    def settled(self) -> int:
        """The first instant whose value may still change."""

    def live(self, start: int, stop: int) -> Bounds:
        """Bounds over all continuations at instants that are not settled, or just were."""

    def ended(self, starts: range) -> Bounds:
        """Final bounds: the trace has ended, and windows to its end are clipped at the last sample."""

    def drop(self, start: int) -> int:
        """Drop instants before `start`; returns the number of the first sample that is still needed."""
