"""Arrays of intervals: two arrays of float64, the least and the greatest value of every element.

Results are rounded outward, so that an interval contains the exact value, and the value that the same
operations compute in float64, for all values of the operands (Moore, Kearfott and Cloud 2009, chapter 3).
Where a result may be undefined, such as 1 / 0 or the root of a negative number, both ends are NaN, and so
are those of everything that is computed from it. As the margin of a predicate it is any number (`margin`).

An operation rounds to nearest, and its ends are then moved outward by a bound on the rounding error (Rump,
Zimmermann, Boldo and Melquiond 2009). Ends are moved when an operation reads them. An extremum, a window
over time or another selection of elements does not read them, and keeps the bound for its result
(`Intervals.selected`): the minimum of ten sums is moved once, instead of ten sums once each. No result is
searched for NaN and overflow as long as bounds on the magnitudes of the operands exclude both.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias, cast, final

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]
Bools: TypeAlias = NDArray[np.bool_]
End: TypeAlias = Any
"""An array of floats, or a float."""

EPSILON = float(np.finfo(np.float64).eps)
"""Distance from 1 to the next float64, 2^-52."""

_GROWTH = 1.0 + 1e-9
"""Factor above all rounding errors of one operation, for bounds on magnitudes."""

_LARGE = 1e300
"""Magnitude up to which ends and their rounding errors are finite without a test."""

TINY = 5e-324
"""Least positive float64. Products below the normal range are off by less than this."""


class RoundingError(NamedTuple):
    """Bound on the difference between computed and exact values: `relative * |value| + absolute`.

    Attributes:
        relative: error relative to the magnitude of the computed value: 0, or from `EPSILON` to 2^-40.
        absolute: further error, in the unit of the values.
    """

    relative: float
    absolute: float


EXACT = RoundingError(0.0, 0.0)
"""No error."""

SUM = RoundingError(EPSILON, 0.0)
"""Error of one sum. An end of 0 stays where it is: a sum that rounds to 0 is 0 exactly (Hauser 1996)."""

PRODUCT = RoundingError(EPSILON, TINY)
"""Error of one product or quotient, which may be below the normal range."""


class Ends(NamedTuple):
    """Both ends of an array of intervals, as far as they are computed.

    Attributes:
        low: least values.
        high: greatest values, of the same shape.
        error: rounding error of both ends, by which the intervals are enlarged. If it is not `EXACT`, every
            end is finite, or infinite exactly.
        bound: number above the magnitudes of all ends, with their error; None if it is not known.
        shift: number that has yet to be added to both ends.
    """

    low: Floats
    high: Floats
    error: RoundingError = EXACT
    bound: float | None = None
    shift: float = 0.0

    def shifted(self) -> Ends:
        """Ends to which the shift has been added."""
        if not self.shift:
            return self
        low = self.low + self.shift
        return Ends(low, low if self.low is self.high else self.high + self.shift, self.error, self.bound)

    def rounded(self) -> Ends:
        """Ends moved outward by their rounding error."""
        return self if self.error is EXACT else _moved_apart(self.shifted())


@final
class Intervals:
    """Array of intervals, indexed like an array of NumPy.

    If no element has a width, `low` and `high` are the same object, and operations compute one end only.

    Args:
        low: least values.
        high: greatest values, of the same shape.
        error: rounding error of both ends (`Ends`).
        bound: number above the magnitudes of all ends; None if it is not known.
        shift: number that has yet to be added to both ends.
    """

    __slots__ = ("_ends",)
    __array_ufunc__ = None  # NumPy leaves `array * intervals` to this class

    def __init__(
        self,
        low: Floats,
        high: Floats,
        error: RoundingError = EXACT,
        bound: float | None = None,
        shift: float = 0.0,
    ) -> None:
        self._ends = Ends(low, high, error, bound, shift)

    @staticmethod
    def point(values: Any) -> Intervals:
        """Return intervals of width 0 at `values`, an array or a number."""
        exact = np.asarray(values, dtype=np.float64)
        return Intervals(exact, exact)

    @property
    def low(self) -> Floats:
        """Least values."""
        return self._rounded().low

    @property
    def high(self) -> Floats:
        """Greatest values."""
        return self._rounded().high

    def _rounded(self) -> Ends:
        """Both ends, moved outward; one assignment, so that threads may read the same array."""
        found = self._ends = self._ends.rounded()
        return found

    def _bound(self) -> float:
        """Number above the magnitudes of all ends, with their error."""
        ends = self._ends
        if ends.bound is None:
            bound = _largest(ends.low, ends.high) * _GROWTH + ends.error.absolute
            self._ends = ends = ends._replace(bound=bound)
        return cast(float, ends.bound)

    @property
    def is_point(self) -> bool:
        """True if it is known that no element has a width."""
        ends = self._ends
        return ends.low is ends.high and ends.error is EXACT

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the array."""
        return self._ends.low.shape

    @property
    def ndim(self) -> int:
        """Number of axes."""
        return self._ends.low.ndim

    @property
    def T(self) -> Intervals:  # noqa: N802 - as in NumPy
        """Array with its axes reversed."""
        return self.selected(np.transpose)

    def each(self, function: Callable[[Any], Any]) -> Intervals:
        """Return the intervals between the images of both ends under a non-decreasing exact function."""
        low, high, *_ = self._rounded()
        first = function(low)
        return Intervals(first, first if low is high else function(high))

    def selected(self, function: Callable[[Any], Any]) -> Intervals:
        """Return the intervals between the images of both ends under a non-decreasing selection.

        Each element of an image is an element of the end, +inf or -inf: a sliding minimum, a slice, a
        transposition. The ends keep their rounding error. Moving an end outward is a non-decreasing function
        of its computed value (`_moved_apart`), so the selection may come first.
        """
        self._ends = self._ends.shifted()
        low, high, error, *_ = self._ends
        first = function(low)
        return Intervals(first, first if low is high else function(high), error)

    def reshape(self, *shape: Any) -> Intervals:
        """Array of another shape."""
        return self.selected(lambda end: end.reshape(*shape))

    def swapaxes(self, one: int, other: int) -> Intervals:
        """Array with two axes exchanged."""
        return self.selected(lambda end: end.swapaxes(one, other))

    def __len__(self) -> int:
        return len(self._ends.low)

    def __getitem__(self, key: Any) -> Intervals:
        return self.selected(lambda end: end[key])

    def __neg__(self) -> Intervals:
        low, high, error, bound, shift = self._ends
        least = -high
        return Intervals(least, least if low is high else -low, error, bound, -shift)

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
    if isinstance(x, Intervals):
        rounded = x._rounded()
        return rounded.low, rounded.high
    return x, x


def is_exact(x: Operand) -> bool:
    """True if it is known that an operand has no width: it is then the number that NumPy computes."""
    return not isinstance(x, Intervals) or x.is_point


def selected_from(function: Callable[[list[Any]], Any], parts: Sequence[Intervals]) -> Intervals:
    """Return the result of a non-decreasing selection from several arrays; see `Intervals.selected`.

    Arrays of different rounding errors are moved outward before. Shifted ends are not kept: those of `low`
    make room for those of `high`.
    """
    error = parts[0]._ends.error
    if any(part._ends.error != error for part in parts):
        error = EXACT
    taken = [part._rounded() if error is EXACT else part._ends for part in parts]
    low = function([part.low + part.shift if part.shift else part.low for part in taken])
    if all(part.low is part.high for part in taken):
        return Intervals(low, low, error)
    high = function([part.high + part.shift if part.shift else part.high for part in taken])
    return Intervals(low, high, error)


def extremum(function: Callable[[list[Any]], Any], parts: Sequence[Intervals]) -> Intervals:
    """Return the minimum or maximum of several arrays; those of equal rounding error are compared first."""
    alike: dict[RoundingError, list[Intervals]] = {}
    for part in parts:
        alike.setdefault(part._ends.error, []).append(part)
    found = [selected_from(function, group) if len(group) > 1 else group[0] for group in alike.values()]
    return found[0] if len(found) == 1 else selected_from(function, found)


def known(low: End, high: End) -> Intervals:
    """Return the intervals from `low` to `high`; where one end is NaN, the other becomes NaN too."""
    same = low is high
    if not same and (_has_nan(low) or _has_nan(high)):
        undefined = np.isnan(low) | np.isnan(high)
        low, high = np.where(undefined, np.nan, low), np.where(undefined, np.nan, high)
    first = np.asarray(low, dtype=np.float64)
    return Intervals(first, first if same else np.asarray(high, dtype=np.float64))


def _has_nan(values: End) -> bool:
    """Presence of a NaN; a minimum is faster to compute than a mask."""
    return bool(np.size(values)) and math.isnan(np.asarray(values).min())


def _largest(low: End, high: End) -> float:
    """Largest magnitude of the ends of intervals, `low <= high`; infinite if an end is NaN."""
    if not np.size(low):
        return 0.0
    first, last = -float(np.asarray(low).min()), float(np.asarray(high).max())
    return math.inf if math.isnan(first) or math.isnan(last) else max(first, last)


def widened(low: End, high: End, error: RoundingError = SUM, bound: float | None = None) -> Intervals:
    """Return the intervals from `low` to `high`, enlarged by a rounding error.

    Args:
        low: computed least values.
        high: computed greatest values; the same object if only one was computed.
        error: bound on the error of the computed values.
        bound: number above the magnitudes of all ends, with their error; None if it is not known.
    """
    if bound is None or not bound < _LARGE:
        bound = _largest(low, high) * _GROWTH + error.absolute
    if bound < _LARGE:
        first = np.asarray(low, dtype=np.float64)
        last = first if low is high else np.asarray(high, dtype=np.float64)
        return Intervals(first, last, error, bound)
    least, most = low - _slack(low, error), high + _slack(high, error)
    return known(np.where(low == np.inf, -np.inf, least), np.where(high == -np.inf, np.inf, most))


def _slack(values: End, error: RoundingError) -> Floats:
    size = np.asarray(np.abs(values))
    size *= error.relative
    if error.absolute:
        size += error.absolute
    return size


def _moved_apart(ends: Ends) -> Ends:
    """Ends of intervals, moved outward by their rounding error, which is `EXACT` afterwards.

    A computed end c becomes fl(c -+ fl(fl(r |c|) + a)) for the relative error r and the absolute error a, all
    rounded to nearest.

    For one operation, r = `EPSILON`: the end moves at least to the neighbouring float64 of c (Rump,
    Zimmermann, Boldo and Melquiond 2009), beyond the exact value, which is at most half a unit in the last
    place from c. Below the normal range it does not move: sums are exact there, and products have
    a = `TINY`. For a function, r is larger than its error by two units, which cover the rounding of the end.

    The moved end does not decrease when c grows: from one float64 to the next, c grows by a unit in its last
    place, but fl(fl(r |c|) + a) by much less, or, below the normal range, by one unit at most. So moving ends
    and selecting among them, such as by a minimum, give the same result in either order.

    An infinite end is exact and stays.
    """
    low, high, error, bound, _ = ends
    least, most = _slack(low, error), _slack(high, error)
    np.subtract(low, least, out=least)
    np.add(high, most, out=most)
    if bound is None and (_has_nan(least) or _has_nan(most)):
        np.copyto(least, low, where=np.isinf(low))
        np.copyto(most, high, where=np.isinf(high))
    return Ends(least, most, EXACT, bound)


def add(a: Operand, b: Operand) -> Intervals:
    """`a + b`; a number is added when the ends are read."""
    (a_low, a_high), (b_low, b_high) = ends(a), ends(b)
    most = (bound(a) + bound(b)) * _GROWTH
    if most < _LARGE and isinstance(a, Intervals) and isinstance(b, float):
        return Intervals(a_low, a_high, SUM, most, b)
    low = a_low + b_low
    high = low if a_low is a_high and b_low is b_high else a_high + b_high
    return widened(low, high, SUM, most)


def bound(x: Operand) -> float:
    """Number above the magnitudes of all values; infinite if there is none."""
    if isinstance(x, Intervals):
        return x._bound()
    return abs(x) if isinstance(x, float) else _largest(x, x)


def mul(a: Operand, b: Operand) -> Intervals:
    """`a * b`, for independent operands; a factor of 1 or -1 has no rounding error.

    An infinite end stands for any number, so that its product with 0 is 0.
    """
    if isinstance(a, Intervals) and isinstance(b, float) and abs(b) == 1.0:
        return a if b > 0 else -a
    most = bound(a) * bound(b) * _GROWTH + TINY
    return _extremes(a, b, np.multiply if most < math.inf else _products, most)


def _products(a: End, b: End) -> Any:
    """Products of ends, some of which may be infinite."""
    unbounded = (np.isinf(a) & np.equal(b, 0.0)) | (np.equal(a, 0.0) & np.isinf(b))
    return np.where(unbounded, 0.0, np.multiply(a, b))


def div(a: Operand, b: Operand) -> Intervals:
    """`a / b`; undefined where `b` may be 0."""
    b_low, b_high = ends(b)
    through_zero = np.logical_and(np.less_equal(b_low, 0.0), np.greater_equal(b_high, 0.0))
    found = _extremes(a, b, np.true_divide, None)
    return undefined_where(through_zero, found) if through_zero.any() else found


def _extremes(a: Operand, b: Operand, function: Callable[[Any, Any], Any], bound: float | None) -> Intervals:
    """Product or quotient of intervals: the extremes are among the values at the ends of the operands.

    A result that rounds to 0 may have been tiny. The sign of the operands says on which side of 0 it lay.
    """
    (a_low, a_high), (b_low, b_high) = ends(a), ends(b)
    low, high = _end_values(function, (a_low, a_high), (b_low, b_high))
    found = widened(low, high, PRODUCT, bound)
    if _nowhere_0(low) and (low is high or _nowhere_0(high)):
        return found
    a_up, a_down = np.greater_equal(a_low, 0.0), np.less_equal(a_high, 0.0)
    b_up, b_down = np.greater_equal(b_low, 0.0), np.less_equal(b_high, 0.0)
    least = np.where((low == 0.0) & ((a_up & b_up) | (a_down & b_down)), 0.0, found.low)
    most = np.where((high == 0.0) & ((a_up & b_down) | (a_down & b_up)), 0.0, found.high)
    return Intervals(least, most)


def _nowhere_0(values: End) -> bool:
    return bool(np.asarray(values).all())


def _end_values(
    function: Callable[[Any, Any], Any], a: tuple[End, End], b: tuple[End, End]
) -> tuple[End, End]:
    """Least and greatest products or quotients of the ends of two operands."""
    first = function(a[0], b[0])
    if a[0] is a[1] and b[0] is b[1]:
        return first, first
    if isinstance(b[0], float) and b[0] is b[1]:
        other = function(a[1], b[0])
        return (first, other) if b[0] > 0.0 else (other, first)
    values = [first]
    if a[0] is not a[1]:
        values.append(function(a[1], b[0]))
    if b[0] is not b[1]:
        values.append(function(a[0], b[1]))
    if len(values) == 3:
        values.append(function(a[1], b[1]))
    return _least(values), _most(values)


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


def undefined_where(mask: Bools, x: Intervals) -> Intervals:
    """Copy of `x` whose elements may be undefined where `mask` is True."""
    if not mask.any():
        return x
    return Intervals(np.where(mask, np.nan, x.low), np.where(mask, np.nan, x.high))


def margin(x: Intervals) -> Intervals:
    """Return `x` with all numbers in place of the elements that may be undefined."""
    if bound(x) < np.inf or not _has_nan(x.low):
        return x
    undefined = np.isnan(x.low)
    return Intervals(np.where(undefined, -np.inf, x.low), np.where(undefined, np.inf, x.high))


def hull(one: Operand, other: Operand) -> Intervals:
    """Least intervals that contain both operands."""
    (a_low, a_high), (b_low, b_high) = ends(one), ends(other)
    return Intervals(np.minimum(a_low, b_low), np.maximum(a_high, b_high))


def within(x: Intervals, low: float, high: float) -> Intervals:
    """Intersection of `x` with [`low`, `high`], which is known to contain the values."""
    return Intervals(np.clip(x.low, low, high), np.clip(x.high, low, high))
