"""Probability that the backup policy's grid meets a plan that works: the paper's Theorem 1 and the truth.

Suppose that there is a prefix u* of T0 actions such that every prefix within `radius` of it, in every control
at every step, leads to satisfaction, and that u* lies anywhere in the control ranges with equal probability.
The backup policy finds it if a grid point lies within `radius` of it in every control at every step.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import expm1, log1p, prod
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

    from stlc.controller.problem.task import Task
    from stlc.runtime.prefixes import Grid

RADII = (0.01, 0.02, 0.05, 0.1, 0.2, 0.25)
"""Shares of the control ranges."""


@dataclass(frozen=True, slots=True)
class Axis:
    """One control of the grid.

    Attributes:
        name: of the control.
        low: of its range.
        high: of its range.
        values: that are tried, rising.
    """

    name: str
    low: float
    high: float
    values: tuple[float, ...]

    def covered(self, radius: float) -> float:
        """The share of the range within `radius`, in its unit, of a value; exact."""
        total, reached = 0.0, self.low
        for value in self.values:
            left, right = max(value - radius, reached), min(value + radius, self.high)
            total += max(right - left, 0.0)
            reached = max(reached, right)
        return total / (self.high - self.low)

    def bound(self, radius: float) -> float:
        """Theorem 1 for this control and one step: (2 L - 4) radius / range, which leaves out the ends."""
        return max(2 * len(self.values) - 4, 0) * radius / (self.high - self.low)


@dataclass(frozen=True, slots=True)
class Chance:
    """Probabilities that prefixes of `length` steps meet a plan that works.

    Attributes:
        radius: share of each control's range.
        length: T0.
        candidates: prefixes that are tried: M = L^(m T0), or a sample of them.
        theorem: as the paper writes it, min{1, product}.
        bound: the same with the minimum taken control by control. Where a control is covered more than once
            the paper's product counts it more than once, and may exceed the truth.
        exact: what the grid covers, under the same assumptions; of a sample at least that much.
        sampled: whether the grid has more prefixes than are tried.
    """

    radius: float
    length: int
    candidates: int
    theorem: float
    bound: float
    exact: float
    sampled: bool = False


def axes_of(task: Task, grid: Grid) -> tuple[Axis, ...]:
    """The controls of a task with the values that a grid tries."""
    controls = zip(task.system.controls, grid.values, strict=True)
    return tuple(Axis(each.name, each.low, each.high, tuple(sorted(values))) for each, values in controls)


def chance(axes: Sequence[Axis], radius: float, length: int, samples: int | None = None) -> Chance:
    """The probabilities for one radius, a share of each range, and one length of prefixes.

    Of a grid with more than `samples` prefixes as many are drawn, with replacement: a prefix of the grid is
    among them with probability 1 - (1 - 1 / M)^samples, and at least one that works is if one that does is.
    """
    radii = [radius * (axis.high - axis.low) for axis in axes]
    bounds = [axis.bound(each) for axis, each in zip(axes, radii, strict=True)]
    covered = [axis.covered(each) for axis, each in zip(axes, radii, strict=True)]
    size = prod(len(axis.values) for axis in axes) ** length
    sampled = samples is not None and samples < size
    tried = samples if samples is not None and sampled else size
    share = -expm1(tried * log1p(-1.0 / size)) if sampled else 1.0
    return Chance(
        radius,
        length,
        tried,
        min(1.0, prod(bounds) ** length),
        share * prod(min(1.0, each) for each in bounds) ** length,
        share * prod(covered) ** length,
        sampled,
    )


def chances(task: Task, grid: Grid, radii: Sequence[float] = RADII) -> list[Chance]:
    """All radii for each length of the grid."""
    axes = axes_of(task, grid)
    return [chance(axes, radius, length, grid.samples) for length in grid.lengths for radius in radii]
