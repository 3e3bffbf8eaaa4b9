"""Probability that the backup policy finds a satisfying plan: a lower bound, and the exact value.

The lower bound is Theorem 1 of Meng and Fan (2023). A prefix is a sequence of T0 actions, the first of a
plan. It is assumed that every prefix near a certain prefix u* leads to a satisfying plan. The prefix u* is
unknown, and uniformly distributed over the control ranges. Another prefix is near u* if, at every step, each
control differs by at most `radius` between the two. The backup policy tries the prefixes in which each
control takes one of L given values. It finds a satisfying plan if one of these prefixes is near u*.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import expm1, log1p, prod
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

    from stlc.controller.problem.task import Task
    from stlc.runtime.prefixes import PrefixGrid

RADII = (0.01, 0.02, 0.05, 0.1, 0.2, 0.25)
"""Radii as shares of the control ranges."""


@dataclass(frozen=True, slots=True)
class Axis:
    """One control, and the values that it takes in the prefixes that the backup policy tries.

    Attributes:
        name: name of the control.
        low: lower end of its range.
        high: upper end of its range.
        values: these values in ascending order.
    """

    name: str
    low: float
    high: float
    values: tuple[float, ...]

    def covered(self, radius: float) -> float:
        """Exact share of the control's range that lies within `radius` (in its unit) of one of `values`."""
        total, reached = 0.0, self.low
        for value in self.values:
            left, right = max(value - radius, reached), min(value + radius, self.high)
            total += max(right - left, 0.0)
            reached = max(reached, right)
        return total / (self.high - self.low)

    def bound(self, radius: float) -> float:
        """Lower bound of Theorem 1 on the covered share, (2 L - 4) radius / range, for L values.

        The theorem does not account for the ends of the range, so the bound is 0 for 2 values or fewer.
        """
        return max(2 * len(self.values) - 4, 0) * radius / (self.high - self.low)


@dataclass(frozen=True, slots=True)
class Chance:
    """Probability that the backup policy finds a satisfying plan, with prefixes of one length.

    A prefix consists of the first T0 actions of a plan. The backup policy tries the prefixes in which each of
    the m controls takes one of L given values. It is assumed that a prefix leads to a satisfying plan if it
    differs from an unknown prefix u* by at most `radius` in each control. All values of u* within the control
    ranges are equally likely.

    Attributes:
        radius: greatest distance from u* at which a prefix leads to a satisfying plan, as a share of each
            control's range.
        length: number of actions of a prefix, T0.
        candidates: number of prefixes that are tried: M = L^(m T0), or the size of the sample of them.
        theorem: the bound of Meng and Fan (2023), a product with one factor per control and step; limited
            to 1.
        bound: the same product, but with each factor limited to 1. In `theorem` a factor may exceed 1,
            because overlapping intervals around the values are counted more than once. Therefore `theorem`
            may exceed the exact probability.
        exact: exact probability under the same assumptions; for a sample of the prefixes, a lower bound.
        sampled: whether only a sample of the prefixes is tried.
    """

    radius: float
    length: int
    candidates: int
    theorem: float
    bound: float
    exact: float
    sampled: bool = False


def axes_of(task: Task, grid: PrefixGrid) -> tuple[Axis, ...]:
    """The controls of a task, with the values that they take in the prefixes of `grid`."""
    controls = zip(task.system.decl.controls, grid.values, strict=True)
    return tuple(Axis(each.name, each.low, each.high, tuple(sorted(values))) for each, values in controls)


def chance(axes: Sequence[Axis], radius: float, length: int, samples: int | None = None) -> Chance:
    """Compute the probability that the backup policy finds a satisfying plan with prefixes of one length.

    A prefix consists of the first `length` actions of a plan. The backup policy tries the prefixes in which
    each control takes one of its values in `axes`. It is assumed that a prefix leads to a satisfying plan if
    it differs from an unknown prefix u* by at most `radius` in each control. All values of u* within the
    control ranges are equally likely.

    If there are M > `samples` prefixes, a sample of them is drawn with replacement. A given prefix is then
    tried with probability 1 - (1 - 1 / M)^samples; `bound` and `exact` are multiplied by this number. Both
    are then lower bounds, since several prefixes may lead to a satisfying plan.

    Args:
        axes: the controls, with the values that they take in prefixes.
        radius: greatest distance from u* at which a prefix leads to a satisfying plan, as a share of each
            control's range.
        length: number of actions of a prefix, T0.
        samples: maximum number of prefixes that are tried; None: all.
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


def chances(task: Task, grid: PrefixGrid) -> list[Chance]:
    """Compute `chance` for each prefix length of `grid` and each radius in `RADII`.

    Each result is a probability that the backup policy finds a satisfying plan. It is assumed that a prefix
    (the first actions of a plan) leads to a satisfying plan if it differs from an unknown prefix by at most
    the radius in each control. The radius is a share of the control's range.
    """
    axes = axes_of(task, grid)
    return [chance(axes, radius, length, grid.samples) for length in grid.lengths for radius in RADII]


ASSUMED = (
    "there is a prefix of T0 actions such that every prefix within the radius of it, in every control at "
    "every step, leads to a plan that satisfies the specification when the policy finishes it",
    "that prefix lies anywhere in the ranges of the controls with equal probability, independently of the "
    "grid",
)


@dataclass(frozen=True, slots=True)
class Guarantee:
    """Lower bounds on the probability that the backup policy of a run finds a satisfying plan."""

    run: str
    assumptions: tuple[str, ...]
    controls: tuple[Axis, ...]
    chances: tuple[Chance, ...]


def guarantee(run: str, task: Task) -> Guarantee:
    """Compute the bounds for a run of a task: one for each length of the prefix and each radius."""
    from stlc.controller.guard.candidates import grid_of

    grid = grid_of(task)
    return Guarantee(run, ASSUMED, tuple(axes_of(task, grid)), tuple(chances(task, grid)))
