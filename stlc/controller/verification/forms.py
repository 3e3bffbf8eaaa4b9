"""Arrays of affine forms: sums of a centre, of generators times symbols from -1 to 1, and of a remainder.

A form `c + g1 e1 + … + gk ek + r e` contains the values of a quantity over a box. The symbols e1, …, ek are
shared by all forms of a computation, so differences of dependent quantities stay small (de Figueiredo and
Stolfi 2004); `e` belongs to one form. Operations that are not linear keep the linear part that fits best, and
add the rest to the remainder (Singh et al. 2018 for networks).

Values are computed in float64 without outward rounding. `SLACK` covers the rounding errors, which are below
1e-12 of the values here, and proofs are stated up to the tolerance of the monitor, 1e-6.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, TypeAlias, cast, final

import numpy as np
from numpy.typing import NDArray

from stlc.compile.backends.array.interval import Belief, Intervals
from stlc.compile.backends.array.interval_ops import INTERVALS
from stlc.compile.backends.array.namespace import FloatConstants, Ops
from stlc.compile.backends.array.numpy_ops import NUMPY

Floats: TypeAlias = NDArray[np.float64]

SLACK = 1e-10
"""Widening of every range, relative to its magnitude plus 1; it covers rounding errors."""


@final
@dataclass(frozen=True, slots=True, eq=False)
class Forms:
    """Array of affine forms.

    Attributes:
        centre: (batch,).
        generators: (symbols, batch); a form may have fewer than others, the missing ones are 0.
        rest: radius of the remainder, (batch,).
        floor: lower bounds that are known in addition to the form, (batch,); None if none are known. The
            result of `relu`, for example, is at least 0, although its form may extend below 0.
    """

    centre: Floats
    generators: Floats
    rest: Floats
    floor: Floats | None = None

    __array_ufunc__ = None

    @staticmethod
    def point(values: Any) -> Forms:
        """Return forms of width 0 at `values`, (batch,)."""
        centre = np.asarray(values, dtype=np.float64)
        return Forms(centre, np.zeros((0, *centre.shape)), np.zeros_like(centre))

    @staticmethod
    def between(low: Floats, high: Floats) -> Forms:
        """Return forms without shared symbols that contain all values from `low` to `high`."""
        finite = np.isfinite(low) & np.isfinite(high)
        low, high = np.where(finite, low, -np.inf), np.where(finite, high, np.inf)
        centre = np.where(finite, 0.5 * np.where(finite, low, 0.0) + 0.5 * np.where(finite, high, 0.0), 0.0)
        return Forms(centre, np.zeros((0, *centre.shape)), np.maximum(high - centre, centre - low))

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the array."""
        return self.centre.shape

    @property
    def radius(self) -> Floats:
        """Half the width of each form, (batch,)."""
        found: Floats = np.abs(self.generators).sum(0) + self.rest
        return found

    @property
    def range(self) -> Intervals:
        """Intervals that contain the forms."""
        reach = self.radius + SLACK * (1.0 + np.abs(self.centre))
        low, high = self.centre - reach, self.centre + reach
        if self.floor is not None:
            low = np.maximum(low, self.floor)
        finite = np.isfinite(low) & np.isfinite(high)
        if finite.all():
            return Intervals(low, high)
        return Intervals(np.where(finite, low, -np.inf), np.where(finite, high, np.inf))

    def times(self, factor: Any) -> Forms:
        """Product with exact numbers, one float or one per element."""
        return Forms(self.centre * factor, self.generators * factor, self.rest * np.abs(factor))

    def widened(self, middle: Any, radius: Any) -> Forms:
        """Sum with numbers from `middle - radius` to `middle + radius`, which belong to this form alone."""
        return Forms(self.centre + middle, self.generators, self.rest + radius)

    def __neg__(self) -> Forms:
        return self.times(-1.0)


Operand: TypeAlias = Forms | float


def _combined(a: Floats, b: Floats) -> Floats:
    """Sum of generators; the missing ones of the shorter array are 0."""
    if len(a) < len(b):
        a, b = b, a
    if not len(b) and a.shape[1:] == b.shape[1:]:
        return a
    out = a + np.zeros(b.shape[1:])
    out[: len(b)] += b
    return out


@final
class FormOps(FloatConstants):
    """The part of `stlc.compile.backends.array.namespace.Ops` that one step of a system needs.

    Other operations are computed on the range of the form, and their results share no symbols.
    """

    name = "forms"

    def add(self, a: Operand, b: Operand) -> Forms:
        """`a + b`."""
        if not isinstance(a, Forms):
            a, b = b, a
        assert isinstance(a, Forms)
        if not isinstance(b, Forms):
            floor = None if a.floor is None else a.floor + b - SLACK * (1.0 + np.abs(a.floor))
            return Forms(a.centre + b, a.generators, a.rest, floor)
        return Forms(a.centre + b.centre, _combined(a.generators, b.generators), a.rest + b.rest)

    def sub(self, a: Operand, b: Operand) -> Forms:
        """`a - b`."""
        return self.add(a, -b)

    def mul(self, a: Operand, b: Operand) -> Forms:
        """`a * b`: linear in both around their centres, the product of the radii goes to the remainder."""
        if not isinstance(a, Forms):
            a, b = b, a
        assert isinstance(a, Forms)
        if not isinstance(b, Forms):
            return a.times(b)
        linear = self.add(a.times(b.centre), b.times(a.centre))
        rest = np.abs(b.centre) * a.rest + np.abs(a.centre) * b.rest + a.radius * b.radius
        return Forms(a.centre * b.centre, linear.generators, rest)

    def square(self, x: Forms) -> Forms:
        """`x * x`."""
        half = 0.5 * x.radius**2
        return x.times(2.0 * x.centre).widened(half - x.centre**2, half)

    def div(self, a: Operand, b: Operand) -> Forms:
        """`a / b`: linear if `b` is a number."""
        if isinstance(a, Forms) and not isinstance(b, Forms):
            return a.times(1.0 / b)
        return self._by_range("div", a, b)

    def axpy(self, a: Operand, b: Forms, factor: float) -> Forms:
        """`a + factor * b`."""
        return self.add(a, b.times(factor))

    def addcmul(self, a: Operand, b: Forms, c: Forms, factor: float) -> Forms:
        """`a + factor * b * c`."""
        return self.add(a, self.mul(b, c).times(factor))

    def relu(self, x: Forms) -> Forms:
        """`max(x, 0)`: the chord over the range, and half its distance from the kink (Singh et al. 2018)."""
        bound = x.range
        low, high = np.minimum(bound.low, 0.0), np.maximum(bound.high, 0.0)
        slope = high / np.maximum(high - low, 1e-300)
        half = -0.5 * slope * low
        found = x.times(slope).widened(half, half)
        return Forms(found.centre, found.generators, found.rest, np.maximum(bound.low, 0.0))

    def maximum(self, a: Operand, b: Operand) -> Forms:
        """Elementwise maximum."""
        return self.add(self.relu(self.sub(a, b)), b)

    def minimum(self, a: Operand, b: Operand) -> Forms:
        """Elementwise minimum."""
        return self.sub(a, self.relu(self.sub(a, b)))

    def clamp(self, x: Forms, low: float | None, high: float | None) -> Forms:
        """Clamp `x` to [low, high]; the plain range where the form of the result is twice as wide."""
        bound = x.range
        first, last = np.clip(bound.low, low, high), np.clip(bound.high, low, high)
        x = x if low is None else self.maximum(x, low)
        x = x if high is None else self.minimum(x, high)
        plain = Forms.between(first, last)
        keep = x.radius <= 2.0 * plain.rest
        return Forms(
            np.where(keep, x.centre, plain.centre),
            x.generators * keep,
            np.where(keep, x.rest, plain.rest),
            first - SLACK * (1.0 + np.abs(first)),
        )

    def abs(self, x: Forms) -> Forms:
        """`|x|`."""
        return self.sub(self.relu(x).times(2.0), x)

    def sqrt(self, x: Forms) -> Forms:
        """Square root: the chord over the range, and half its greatest distance from the curve.

        Raises:
            ValueError: a number may be negative by more than rounding.
        """
        bound, slack = x.range, 4.0 * SLACK * (1.0 + np.abs(x.centre))
        if not (bound.low >= -slack).all():
            raise ValueError("the root of a number that may be negative")
        low, high = np.maximum(bound.low, 0.0), np.maximum(bound.high, 1e-300)
        slope = 1.0 / (np.sqrt(low) + np.sqrt(high))
        start = np.sqrt(low) - slope * low
        half = 0.5 * (0.25 / slope - start)
        return x.times(slope).widened(start + half, half + slope * slack)

    def sin(self, x: Forms) -> Forms:
        """Sine: the tangent at the centre, from which it is off by at most half the squared radius."""
        return self._wave("sin", x, np.sin(x.centre), np.cos(x.centre))

    def cos(self, x: Forms) -> Forms:
        """Cosine: the tangent at the centre, from which it is off by at most half the squared radius."""
        return self._wave("cos", x, np.cos(x.centre), -np.sin(x.centre))

    def _wave(self, name: str, x: Forms, value: Floats, slope: Floats) -> Forms:
        """Tangent of a function whose second derivative is within [-1, 1]; its range if `x` is wide."""
        radius = x.radius
        found = x.times(slope).widened(value - slope * x.centre, 0.5 * radius**2 + SLACK)
        keep = radius <= 1.0
        if keep.all():
            return found
        plain = self._by_range(name, x)
        return Forms(
            np.where(keep, found.centre, plain.centre),
            found.generators * keep,
            np.where(keep, found.rest, plain.rest),
        )

    def gt(self, a: Operand, b: Operand) -> Belief:
        """`a > b`."""
        found = self.sub(a, b).range
        return Belief(found.low > 0.0, found.high > 0.0)

    def ge(self, a: Operand, b: Operand) -> Belief:
        """`a >= b`."""
        found = self.sub(a, b).range
        return Belief(found.low >= 0.0, found.high >= 0.0)

    def both(self, a: Belief, b: Belief) -> Belief:
        """Conjunction."""
        return INTERVALS.both(a, b)  # type: ignore[no-any-return]

    def either(self, a: Belief, b: Belief) -> Belief:
        """Disjunction."""
        return INTERVALS.either(a, b)  # type: ignore[no-any-return]

    def number(self, mask: Belief, like: Forms) -> Forms:  # noqa: ARG002
        """1 where `mask` is true, 0 where it is false, else [0, 1]."""
        return Forms.between(mask.sure.astype(np.float64), mask.possible.astype(np.float64))

    def where(self, mask: Belief, yes: Operand, no: Operand) -> Forms:
        """`yes` where `mask` is true, `no` where it is false, else their mean and half their difference."""
        unsure = mask.possible & ~mask.sure
        weight = np.where(mask.sure, 1.0, np.where(unsure, 0.5, 0.0))
        bound = self.sub(yes, no).range
        half = 0.5 * np.maximum(np.abs(bound.low), np.abs(bound.high))
        chosen, other = (self._scaled(each, share) for each, share in ((yes, weight), (no, 1.0 - weight)))
        return self.add(chosen, other).widened(0.0, np.where(unsure, half, 0.0))

    def _scaled(self, x: Operand, factor: Floats) -> Forms:
        return x.times(factor) if isinstance(x, Forms) else Forms.point(x * factor)

    def full(self, shape: tuple[int, ...], value: float, like: Forms) -> Forms:  # noqa: ARG002
        """Array of a constant."""
        return Forms.point(np.full(shape, value))

    def quiet(self) -> AbstractContextManager[object]:
        """Context manager in which division by zero and invalid operations give inf and NaN, not warnings."""
        return NUMPY.quiet()

    def _by_range(self, name: str, *args: Any) -> Forms:
        ranges = [each.range if isinstance(each, Forms) else each for each in args]
        found = getattr(INTERVALS, name)(*ranges)
        return Forms.between(found.low, found.high)

    def __getattr__(self, name: str) -> Any:
        return lambda *args: self._by_range(name, *args)


def tanh(x: Forms) -> Forms:
    """Hyperbolic tangent: a line with the least slope over the range, and the deviation from it.

    Source: Singh et al. 2018.
    """
    bound = x.range
    first, last = np.tanh(bound.low), np.tanh(bound.high)
    slope = np.minimum(1.0 - first**2, 1.0 - last**2)
    low, high = first - slope * bound.low, last - slope * bound.high
    return x.times(slope).widened(0.5 * (low + high), 0.5 * (high - low) + SLACK)


def ranges(forms: Sequence[Forms]) -> Intervals:
    """Ranges of a sequence of forms (batch,) over time: (time, batch)."""
    found = [form.range for form in forms]
    return Intervals(np.stack([each.low for each in found]), np.stack([each.high for each in found]))


FORMS: Ops = cast("Ops", FormOps())
