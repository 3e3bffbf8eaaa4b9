"""Arrays of intervals: two arrays of float64, the least and the greatest value of every element.

Results are rounded outward, so that an interval contains the exact value, and the value that the same
operations compute in float64, for all values of the operands (Moore, Kearfott and Cloud 2009, chapter 3).
An undefined result, such as 0 / 0 or the root of a negative number, is the interval from -inf to +inf.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, TypeAlias, final

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]
Bools: TypeAlias = NDArray[np.bool_]
End: TypeAlias = Any
"""An array of floats, or a float."""

EPSILON = float(np.finfo(np.float64).eps)
"""Distance from 1 to the next float64, 2^-52."""

_MOST = 1 << 20
"""Elements of the largest intermediate results whose memory is kept."""

TINY = 5e-324
"""Least positive float64. Products below the normal range are off by less than this."""


@final
@dataclass(frozen=True, slots=True, eq=False)
class Intervals:
    """Array of intervals, indexed like an array of NumPy.

    If no element has a width, `low` and `high` are the same object, and operations compute one end only.

    Attributes:
        low: least values.
        high: greatest values, of the same shape.
    """

    low: Floats
    high: Floats

    __array_ufunc__ = None  # NumPy leaves `array * intervals` to this class

    @staticmethod
    def point(values: Any) -> Intervals:
        """Return intervals of width 0 at `values`, an array or a number."""
        exact = np.asarray(values, dtype=np.float64)
        return Intervals(exact, exact)

    @property
    def is_point(self) -> bool:
        """True if it is known that no element has a width."""
        return self.low is self.high

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the array."""
        return self.low.shape

    @property
    def ndim(self) -> int:
        """Number of axes."""
        return self.low.ndim

    @property
    def T(self) -> Intervals:  # noqa: N802 - as in NumPy
        """Array with its axes reversed."""
        return self.each(np.transpose)

    def each(self, function: Callable[[Any], Any]) -> Intervals:
        """Return the intervals between the images of both ends under a non-decreasing exact function."""
        low = function(self.low)
        return Intervals(low, low if self.is_point else function(self.high))

    def reshape(self, *shape: Any) -> Intervals:
        """Array of another shape."""
        return self.each(lambda end: end.reshape(*shape))

    def swapaxes(self, one: int, other: int) -> Intervals:
        """Array with two axes exchanged."""
        return self.each(lambda end: end.swapaxes(one, other))

    def __len__(self) -> int:
        return len(self.low)

    def __getitem__(self, key: Any) -> Intervals:
        return self.each(lambda end: end[key])

    def __neg__(self) -> Intervals:
        low = -self.high
        return Intervals(low, low if self.is_point else -self.low)

    def __add__(self, other: Intervals | float) -> Intervals:
        return add(self, other)

    def __sub__(self, other: Intervals | float) -> Intervals:
        return add(self, -other)

    def __mul__(self, other: Intervals | float) -> Intervals:
        return mul(self, other)

    __radd__ = __add__
    __rmul__ = __mul__


@final
@dataclass(frozen=True, slots=True, eq=False)
class Belief:
    """Truth of a condition on intervals: for each element it is true, false, or unknown.

    Attributes:
        sure: whether the condition holds for all values in the intervals.
        possible: whether it may hold for some of them.
    """

    sure: Bools
    possible: Bools


Operand: TypeAlias = Intervals | float


def ends(x: Operand) -> tuple[End, End]:
    """Least and greatest values of an operand; the same object twice if the operand has no width."""
    return (x.low, x.high) if isinstance(x, Intervals) else (x, x)


def known(low: End, high: End) -> Intervals:
    """Return the intervals from `low` to `high`; an end that is NaN becomes infinite."""
    same = low is high
    if _has_nan(low) or (not same and _has_nan(high)):
        undefined = np.isnan(low) | np.isnan(high)
        return Intervals(np.where(undefined, -np.inf, low), np.where(undefined, np.inf, high))
    first = np.asarray(low, dtype=np.float64)
    return Intervals(first, first if same else np.asarray(high, dtype=np.float64))


def _has_nan(values: End) -> bool:
    """Whether a value is NaN; a minimum is faster to compute than a mask."""
    return bool(np.size(values)) and bool(np.isnan(np.min(values)))


def widened(low: End, high: End, relative: float = EPSILON, absolute: float = 0.0) -> Intervals:
    """Return the intervals from `low` to `high`, enlarged by a rounding error.

    With the default error, every end moves at least to the next float64. An end of 0 stays where it is: a
    sum that rounds to 0 is 0 exactly (Hauser 1996).

    Args:
        low: computed least values.
        high: computed greatest values; the same object if only one was computed.
        relative: error of a computed value relative to its magnitude, `EPSILON` or more.
        absolute: further error, in the unit of the values.
    """
    if low is high:
        slack = _slack(low, relative, absolute)
        return known(low - slack, high + slack)
    least, most = _slack(low, relative, absolute), _slack(high, relative, absolute)
    return known(np.subtract(low, least, out=least), np.add(high, most, out=most))


def _slack(values: End, relative: float, absolute: float) -> Floats:
    size = np.asarray(np.abs(values))
    size *= relative
    if absolute:
        size += absolute
    return size


def add(a: Operand, b: Operand) -> Intervals:
    """`a + b`."""
    (a_low, a_high), (b_low, b_high) = ends(a), ends(b)
    low = a_low + b_low
    if a_low is a_high and b_low is b_high:
        return widened(low, low)
    return _moved_apart(low, a_high + b_high)


class _Memory(threading.local):
    """Memory of intermediate results, one array per thread: new large arrays cost more than sums."""

    def __init__(self) -> None:
        self._values = np.empty(0)

    def like(self, values: Floats) -> Floats:
        """Array of the same shape, valid until the next call."""
        if self._values.size < values.size:
            self._values = np.empty(values.size)
        return self._values[: values.size].reshape(values.shape)


_MEMORY = _Memory()


def _moved_apart(low: End, high: End) -> Intervals:
    """`widened` by the rounding error of one operation, in the memory of two new arrays."""
    if not isinstance(low, np.ndarray) or low.size > _MOST:
        return widened(low, high)
    slack = _MEMORY.like(low)
    for end, move in ((low, np.subtract), (high, np.add)):
        np.abs(end, out=slack)
        slack *= EPSILON
        move(end, slack, out=end)
    return known(low, high)


def mul(a: Operand, b: Operand) -> Intervals:
    """`a * b`, for independent operands; a factor of 1 or -1 has no rounding error."""
    if isinstance(a, Intervals) and isinstance(b, float) and abs(b) == 1.0:
        return a if b > 0 else -a
    return _extremes(a, b, np.multiply)


def div(a: Operand, b: Operand) -> Intervals:
    """`a / b`; unknown where `b` may be 0."""
    b_low, b_high = ends(b)
    through_zero = np.logical_and(np.less_equal(b_low, 0.0), np.greater_equal(b_high, 0.0))
    found = _extremes(a, b, np.true_divide)
    return unbounded_where(through_zero, found) if through_zero.any() else found


def _extremes(a: Operand, b: Operand, function: Callable[[Any, Any], Any]) -> Intervals:
    """Product or quotient of intervals: the extremes are among the values at the ends of the operands.

    A result that rounds to 0 may have been tiny. The sign of the operands says on which side of 0 it lay.
    """
    (a_low, a_high), (b_low, b_high) = ends(a), ends(b)
    corners = [function(a_low, b_low)]
    if a_low is not a_high:
        corners.append(function(a_high, b_low))
    if b_low is not b_high:
        corners.append(function(a_low, b_high))
    if a_low is not a_high and b_low is not b_high:
        corners.append(function(a_high, b_high))
    low, high = _least(corners), _most(corners)
    found = widened(low, high, absolute=TINY)
    if np.all(low) and np.all(high):
        return found
    a_up, a_down = np.greater_equal(a_low, 0.0), np.less_equal(a_high, 0.0)
    b_up, b_down = np.greater_equal(b_low, 0.0), np.less_equal(b_high, 0.0)
    least = np.where((low == 0.0) & ((a_up & b_up) | (a_down & b_down)), 0.0, found.low)
    most = np.where((high == 0.0) & ((a_up & b_down) | (a_down & b_up)), 0.0, found.high)
    return Intervals(least, most)


def _least(values: list[Any]) -> Any:
    out = values[0]
    for value in values[1:]:
        out = np.minimum(out, value)
    return out


def _most(values: list[Any]) -> Any:
    out = values[0]
    for value in values[1:]:
        out = np.maximum(out, value)
    return out


def corners(function: Callable[..., Any], *operands: Operand) -> tuple[End, End]:
    """Least and greatest values of a function of two operands that is monotone in each of them."""
    first, second = operands
    values = [function(one, other) for one in _distinct(first) for other in _distinct(second)]
    if len(values) == 1:
        return values[0], values[0]
    return _least(values), _most(values)


def _distinct(x: Operand) -> Iterable[End]:
    low, high = ends(x)
    return (low,) if low is high else (low, high)


def magnitudes(x: Operand) -> Intervals:
    """`|x|`."""
    low, high = ends(x)
    if low is high:
        size = np.abs(low)
        return Intervals(size, size)
    return Intervals(np.maximum(np.maximum(low, -high), 0.0), np.maximum(-low, high))


def unbounded_where(undefined: Bools, x: Intervals) -> Intervals:
    """Copy of `x` in which the elements where `undefined` is True may have any value."""
    if not undefined.any():
        return x
    return Intervals(np.where(undefined, -np.inf, x.low), np.where(undefined, np.inf, x.high))


def hull(one: Operand, other: Operand) -> Intervals:
    """Least intervals that contain both operands."""
    (a_low, a_high), (b_low, b_high) = ends(one), ends(other)
    return Intervals(np.minimum(a_low, b_low), np.maximum(a_high, b_high))


def within(x: Intervals, low: float, high: float) -> Intervals:
    """Intersection of `x` with [`low`, `high`], which is known to contain the values."""
    return Intervals(np.clip(x.low, low, high), np.clip(x.high, low, high))
