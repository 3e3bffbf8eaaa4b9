"""Order of plans, and the search and choices of the backup policy, over arrays of any library.

Axis 0 of all arrays is that of the plans to choose from. A choice is a mask of the plans that are equally
good; the first of them is taken. The C header has the same in `decision.c.txt` and in its `fall_back`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Generic, Protocol, TypeVar

from stlc.compile.semantics.tolerance import TOLERANCE

if TYPE_CHECKING:
    from stlc.compile.namespace import Array, Mask, Ops

TIE = 1e-4
"""Weight of the cost among violating plans, whose robustness is the same where a deadline cannot be met."""


def rank(rho: Array, cost: Array, safe: Array | None, ops: Ops) -> Array:
    """Values that rank plans: satisfying ones by cost, others by robustness; unsafe ones below all safe ones.

    Args:
        rho: robustness, any shape.
        cost: performance terms, the same shape.
        safe: robustness of phi_safe, the same shape; if None, safety is not considered.
        ops: library of the arrays.

    Returns:
        Values of the same shape; larger is better. A plan that satisfies the specification gets a value above
        1, which decreases with its cost. Any other plan gets a value below 1, which increases with its
        robustness; of two equally robust plans, the cheaper one gets more. If `safe` is given, 2 is
        subtracted from the value of a plan that violates phi_safe.
    """
    known, size = ops.ge(cost, cost), ops.abs(rho)
    cheap = ops.where(known, 1.0 / (1.0 + ops.clamp(cost, 0.0, None)), 0.0)
    poor = ops.where(ops.gt(math.inf, size), rho / (1.0 + size), -1.0) + TIE * cheap
    if safe is not None:
        poor = ops.where(TOLERANCE.satisfied(safe), poor, poor - 2.0)
    return ops.where(ops.both(TOLERANCE.satisfied(rho), known), 1.0 + cheap, poor)


def best(allowed: Mask, keys: Sequence[Array], ops: Ops) -> Mask:
    """Mask of the best allowed plans, (plans, …).

    Args:
        allowed: mask of the plans to choose from, (plans, …).
        keys: values, (plans, …); larger is better, and NaN is the smallest value. A later key decides between
            plans that are equal in all earlier ones, up to `TOLERANCE`.
        ops: library of the arrays.
    """
    for key in keys:
        value = ops.where(ops.both(allowed, ops.ge(key, key)), key, -math.inf)
        allowed = ops.both(allowed, ops.ge(value, ops.amax(value) - TOLERANCE))
    return allowed


def acceptable(rho: Array, safe: Array, ops: Ops) -> Mask:
    """Mask of the plans that satisfy the specification, or at least phi_safe."""
    return ops.either(TOLERANCE.satisfied(rho), TOLERANCE.satisfied(safe))


def continued(rho: Array, safe: Array, cost: Array, ops: Ops) -> Mask:
    """Mask of the best plans that begin with a prefix and that the policy continues.

    Satisfying plans are preferred to safe ones, then robust ones, then cheap ones. Unacceptable plans are not
    chosen while there are others.
    """
    good = ops.number(TOLERANCE.satisfied(rho), rho)
    return best(acceptable(rho, safe, ops), (good, rho, -cost), ops)


def longest(falls: Array, rho: Array, cost: Array, ops: Ops) -> Mask:
    """Mask of the plans that stay safe for the longest time.

    Of these, robust plans are preferred, then those with the least violation of phi_safe (mean over the
    samples), then cheap ones.

    Args:
        falls: robustness of phi_safe on the first samples of each plan, (time, plans, …).
        rho: robustness, (plans, …).
        cost: performance terms, (plans, …).
        ops: library of the arrays.
    """
    samples = ops.sum(ops.number(TOLERANCE.satisfied(falls), falls))[0]
    depth = ops.sum(ops.clamp(falls, None, 0.0))[0] / len(falls)
    return best(ops.ge(samples, 0.0), (samples, rho, depth, -cost), ops)


class JudgedChoices(Protocol):
    """Plans to choose from, with their verdicts: robustness, that of phi_safe, and cost, (plans, …)."""

    @property
    def rho(self) -> Array:
        """Robustness of the specification."""

    @property
    def safe(self) -> Array:
        """Robustness of phi_safe."""

    @property
    def cost(self) -> Array:
        """Performance terms."""


Choices = TypeVar("Choices", bound=JudgedChoices)


@dataclass(frozen=True, slots=True)
class Shot(Generic[Choices]):
    """Plans with prefixes of one length, for a group of states.

    Attributes:
        length: T0, the length of the prefixes.
        last: True if no longer prefixes follow.
        plans: the plans that were tried.
        found: mask of the states with an acceptable plan, (…).
        ops: library of the arrays.
    """

    length: int
    last: bool
    plans: Choices
    found: Mask
    ops: Ops

    def chosen(self, falls: Array | None = None) -> Mask:
        """Mask of the best plans, (plans, …): to continue where one is acceptable, else by `longest`.

        `falls`: see `longest`; without it, the choice has a meaning only where a plan is acceptable.
        """
        plans, ops = self.plans, self.ops
        chosen = continued(plans.rho, plans.safe, plans.cost, ops)
        if falls is None:
            return chosen
        return ops.where(self.found, chosen, longest(falls, plans.rho, plans.cost, ops))


def prefix_shooting(
    lengths: Sequence[int], tried: Callable[[int], Iterable[Choices]], ops: Ops
) -> Iterator[Shot[Choices]]:
    """Plans that the backup policy of Meng and Fan (2023) tries, with prefixes of growing length T0.

    The first length with an acceptable plan decides: the caller leaves out the states that are decided, or
    their later choices. If there is none, the plans with the longest prefixes decide, by `Shot.chosen`.

    Args:
        lengths: lengths of the prefixes, in the order in which they are tried.
        tried: length -> the plans with such prefixes, in groups of states.
        ops: library of the arrays.
    """
    for length in lengths:
        for plans in tried(length):
            found = acceptable(plans.rho, plans.safe, ops).any(0)
            yield Shot(length, length == lengths[-1], plans, found, ops)
