"""What is asked of a requirement whose signals come in, and what its trackers share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from stlc.compile.ir import nodes as ir
from stlc.monitor.online.columns import End, Side
from stlc.monitor.online.streams import ColumnPlan
from stlc.monitor.prefix_bounds import prefix_bound

Floats: TypeAlias = NDArray[np.float64]
Ending: TypeAlias = Literal["open", "truncate"]
ColumnPlans: TypeAlias = Mapping[End, ColumnPlan]
"""Least and greatest value wherever the trace ends, and the requirement as it is written."""


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


def worst(
    formula: ir.Formula, end: Literal["lower", "upper"], ending: Ending, window: int | None
) -> ir.Formula:
    """The formula for one end of what is possible; with a `window`, an early end is unknown or cuts."""
    cut = ending == "truncate"
    return prefix_bound(formula, end, cut=cut) if cut or window is None else formula


def sides_of(plans: ColumnPlans, beyond: int, asked: TrackingOptions) -> list[Side]:
    """Both ends of what is possible, and where windows are cut at the end both of what it is there."""
    going_on: list[End] = ["lower", "upper"]
    sides = [Side(plans[end], end, beyond, asked.truth, least=end == "lower") for end in going_on]
    if asked.ending == "open":
        return sides
    return sides + [
        Side(plans["truncate"], "truncate", 0, asked.truth, least=least) for least in (True, False)
    ]


def first_needed(planned: ColumnPlan, samples: int) -> int:
    """The first sample whose signals a column still reads."""
    reads = [samples - stream.ahead - stream.back for stream in planned.streams if hasattr(stream, "formula")]
    return max(min(reads, default=samples), 0)


class Cutting(Protocol):
    """A tracker that knows settled instants where windows are cut, and bounds of any others."""

    @property
    def settled(self) -> int:
        """The first instant whose value may still change."""

    def certain(self, starts: range) -> Bounds:
        """At settled instants, where windows are cut to the trace."""

    def either(self, start: int, stop: int) -> Bounds:
        """At any instants, where nothing is assumed of what lies outside of the trace."""


def decided_first(tracker: Cutting, start: int, stop: int) -> Bounds:
    """Where windows are cut, what a settled instant reads before the first sample is false, not unknown."""
    middle = min(max(tracker.settled, start), stop)
    if middle <= start:
        return tracker.either(start, stop)
    known, rest = tracker.certain(range(start, middle)), tracker.either(middle, stop)
    return Bounds(*map(np.concatenate, zip(known, rest, strict=True)))
