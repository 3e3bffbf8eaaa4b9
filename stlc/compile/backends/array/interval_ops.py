"""Array operations on intervals: bounds on every value, and so on robustness, over a box of signals.

The evaluators run unchanged over this array library. A condition on intervals is true, false or unknown, and
unknown on an undefined value; a choice by an unknown condition is the hull of both values. Extrema over
windows and `until` are monotone in their operands, so each end of an interval is computed by NumPy with the
same algorithms as for numbers.

The functions of NumPy are within 4 units in the last place (the bound that its own tests assert for the
vectorised ones). A value computed inside an interval and the value at its end may be off in opposite
directions, hence `_ULPS` = 8. Elementary operations and the square root are rounded correctly (IEEE 754).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from functools import partial, reduce
from typing import Any, cast, final

import numpy as np

from stlc.compile.backends.array.interval import (
    EPSILON,
    PRODUCT,
    TINY,
    Belief,
    Bools,
    End,
    Floats,
    Intervals,
    Operand,
    RoundingError,
    add,
    bound,
    corners,
    div,
    ends,
    extremum,
    hull,
    is_exact,
    known,
    magnitudes,
    margin,
    mul,
    selected_from,
    undefined_where,
    widened,
    within,
)
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.backends.array.windows import Windows
from stlc.compile.ir.functions import FUNCTIONS
from stlc.compile.namespace import FloatConstants, Ops, Pick, Sliding
from stlc.compile.semantics.semantics import Exact
from stlc.diagnostics import usage

_ULPS = 8.0
"""Rounding error of functions, in units of the last place, both ways."""

_RELATIVE = (_ULPS + 2.0) * EPSILON
"""The same relative to the value: a unit in the last place is at most `EPSILON` times the value."""

_ERROR = RoundingError(_RELATIVE, _ULPS * TINY)

_SMALLEST = 1e-150
"""Error of a norm whose squares are below the range of float64."""

_FEW_TURNS = 1024.0
_FEW_TURNS_ERROR = 4.0 * EPSILON * (1.0 + _FEW_TURNS)
"""Error of positions in half periods, up to `_FEW_TURNS`."""

_WINDOWS = Windows(Exact(), NUMPY)


@final
class IntervalOps(FloatConstants):
    """Implementation of `stlc.compile.namespace.Ops` for `Intervals`, without gradients."""

    name = "intervals"

    add = staticmethod(add)
    mul = staticmethod(mul)
    div = staticmethod(div)
    abs = staticmethod(magnitudes)
    margin = staticmethod(margin)

    # ---------------------------------------------------------------------------- arithmetic

    def sub(self, a: Operand, b: Operand) -> Intervals:
        return add(a, -b)

    def square(self, x: Operand) -> Intervals:
        size = magnitudes(x)
        found = widened(*_mapped(np.square, size), PRODUCT)
        return Intervals(np.maximum(found.low, 0.0), found.high)

    def sqrt(self, x: Operand) -> Intervals:
        """Square root; undefined where `x` may be negative."""
        return widened(*_mapped(np.sqrt, x))

    def pow(self, a: Operand, b: Operand) -> Intervals:
        """`a ^ b`; undefined where `a` may be negative and `b` is not one whole number, and at a pole."""
        if isinstance(b, float) and b.is_integer():
            return _whole_power(a, b)
        (a_low, a_high), (b_low, b_high) = ends(a), ends(b)
        found = _widened(*corners(np.power, a, b))
        pole = np.less_equal(a_low, 0.0) & np.greater_equal(a_high, 0.0) & np.less(b_low, 0.0)
        whole = np.equal(b_low, b_high) & np.equal(np.floor(b_low), b_low) & np.less(a_low, 0.0)
        if np.any(whole):
            powers = _whole_power(a, np.where(whole, b_low, 1.0))
            found = Intervals(
                np.where(whole, powers.low, found.low), np.where(whole, powers.high, found.high)
            )
        return undefined_where(np.asarray(pole | (np.less(a_low, 0.0) & ~whole)), found)

    def mod(self, a: Operand, b: Operand) -> Intervals:
        """Floored modulo: undefined where `b` may be 0; the whole range of the remainder where it jumps."""
        (a_low, a_high), (b_low, b_high) = ends(a), ends(b)
        first, last = np.mod(a_low, b_low), np.mod(a_high, b_low)
        up = np.greater(b_low, 0.0)
        rising = np.less_equal(first, last)
        short = (a_high - a_low) <= np.abs(b_low) * (1.0 - 1e-9)
        smooth = rising & short & np.equal(b_low, b_high)
        error = np.maximum(np.abs(b_low), np.abs(b_high)) * 4.0 * EPSILON
        low = np.where(smooth, first - error, np.where(up, 0.0, b_low))
        high = np.where(smooth, last + error, np.where(up, b_high, 0.0))
        through_zero = np.less_equal(b_low, 0.0) & np.greater_equal(b_high, 0.0)
        return undefined_where(through_zero | np.isnan(first) | np.isnan(last), known(low, high))

    def atan2(self, a: Operand, b: Operand) -> Intervals:
        """Angle of the point (b, a); all angles where the box of points reaches the cut or the origin.

        On the cut, the sign of a zero decides between -pi and pi. It is known for exact operands only.
        """
        (y_low, y_high), (x_low, _) = ends(a), ends(b)
        found = _widened(*corners(np.arctan2, a, b))
        if is_exact(a) and is_exact(b):
            return found
        crossing = np.less_equal(y_low, 0.0) & np.greater_equal(y_high, 0.0) & np.less_equal(x_low, 0.0)
        if not np.any(crossing):
            return found
        return Intervals(np.where(crossing, -_PI, found.low), np.where(crossing, _PI, found.high))

    def axpy(self, a: Operand, b: Intervals, factor: float) -> Intervals:
        return add(a, mul(b, factor))

    def addcmul(self, a: Operand, b: Intervals, c: Intervals, factor: float) -> Intervals:
        product = mul(b, c)
        return add(a, product if factor == 1.0 else mul(product, factor))

    def clamp(self, x: Intervals, low: float | None, high: float | None) -> Intervals:
        return x.each(lambda end: np.clip(end, low, high))

    def norm(self, *components: Operand) -> Intervals:
        sizes = [magnitudes(part) for part in components]
        low = np.sqrt(reduce(np.add, (np.square(size.low) for size in sizes)))
        error = (len(sizes) + 3.0) * EPSILON
        if all(size.is_point for size in sizes):
            high = low
        else:
            high = np.sqrt(reduce(np.add, (np.square(size.high) for size in sizes)))
        found = widened(low, high, RoundingError(error, _SMALLEST))
        return Intervals(np.maximum(found.low, 0.0), found.high)

    # ----------------------------------------------------------------------------- functions

    def exp(self, x: Operand) -> Intervals:
        found = _monotone(np.exp, x)
        return Intervals(np.maximum(found.low, 0.0), found.high)

    def sin(self, x: Operand) -> Intervals:
        """Sine: 1 or -1 where an extremum may lie in the interval, else the values at its ends."""
        return _wave(np.sin, x, 0.5)

    def cos(self, x: Operand) -> Intervals:
        return _wave(np.cos, x, 0.0)

    def tan(self, x: Operand) -> Intervals:
        """Tangent; undefined where a pole may lie in the interval."""
        low, high = ends(x)
        first, last = _crossed(low, high, np.pi, 0.5)
        return undefined_where(~(first > last), _monotone(np.tan, x))

    def acos(self, x: Operand) -> Intervals:
        """Arc cosine, which falls; undefined outside of [-1, 1]."""
        high, low = _mapped(np.arccos, x)
        return _widened(low, high)

    def sigmoid(self, x: Operand) -> Intervals:
        return within(widened(*_mapped(NUMPY.sigmoid, x), RoundingError(_RELATIVE, _RELATIVE)), 0.0, 1.0)

    def sign(self, x: Intervals) -> Intervals:
        return x.each(np.sign)

    def floor(self, x: Intervals) -> Intervals:
        return x.each(np.floor)

    def ceil(self, x: Intervals) -> Intervals:
        return x.each(np.ceil)

    def round(self, x: Intervals) -> Intervals:
        return x.each(np.rint)

    def minimum(self, a: Operand, b: Operand) -> Intervals:
        return _smaller_or_greater(np.minimum, a, b)

    def maximum(self, a: Operand, b: Operand) -> Intervals:
        return _smaller_or_greater(np.maximum, a, b)

    # --------------------------------------------------------------------------------- truth

    def gt(self, a: Operand, b: Operand) -> Belief:
        (a_low, a_high), (b_low, b_high) = ends(a), ends(b)
        return Belief(np.greater(a_low, b_high), ~np.less_equal(a_high, b_low))

    def ge(self, a: Operand, b: Operand) -> Belief:
        (a_low, a_high), (b_low, b_high) = ends(a), ends(b)
        return Belief(np.greater_equal(a_low, b_high), ~np.less(a_high, b_low))

    def both(self, a: Belief, b: Belief) -> Belief:
        return Belief(a.sure & b.sure, a.possible & b.possible)

    def either(self, a: Belief, b: Belief) -> Belief:
        return Belief(a.sure | b.sure, a.possible | b.possible)

    def settled(self, weight: Intervals, mask: Belief) -> Intervals:
        """1 where `mask` is true, 0 where it is false, else [0, 1]; with the shape of `weight`."""
        shape = weight.shape
        return self.number(mask, weight).each(lambda end: np.broadcast_to(end, shape))

    def number(self, mask: Belief, _like: Intervals) -> Intervals:
        """1 where `mask` is true, 0 where it is false, else [0, 1]."""
        return Intervals(np.asarray(mask.sure, np.float64), np.asarray(mask.possible, np.float64))

    def where(self, mask: Belief, yes: Operand, no: Operand) -> Intervals:
        """`yes` where `mask` is true, `no` where it is false, else the hull of both."""
        (a_low, a_high), (b_low, b_high) = ends(yes), ends(no)
        if np.array_equal(mask.sure, mask.possible):
            low = _chosen(mask.sure, a_low, b_low)
            same = a_low is a_high and b_low is b_high
            return Intervals(low, low if same else _chosen(mask.sure, a_high, b_high))
        either = hull(yes, no)
        low = _chosen(mask.possible, either.low, b_low)
        high = _chosen(mask.possible, either.high, b_high)
        return Intervals(_chosen(mask.sure, a_low, low), _chosen(mask.sure, a_high, high))

    def lerp(self, no: Operand, yes: Operand, weight: Intervals) -> Intervals:
        """`no + weight (yes - no)`, for a weight from 0 to 1: a mean of both, so within their hull."""
        mixed = add(no, mul(weight, add(yes, -no)))
        bound = hull(no, yes)
        return Intervals(np.maximum(mixed.low, bound.low), np.minimum(mixed.high, bound.high))

    def infinite(self, mask: Belief, _like: Intervals) -> Intervals:
        """+inf where `mask` is true, -inf where it is false, else all numbers."""
        return Intervals(_infinite(mask.sure), _infinite(mask.possible))

    # ---------------------------------------------------------------------------- along time

    def amin(self, x: Intervals) -> Intervals:
        return x.selected(NUMPY.amin)

    def amax(self, x: Intervals) -> Intervals:
        return x.selected(NUMPY.amax)

    def sum(self, x: Intervals) -> Intervals:
        """Sum over axis 0, which is kept with length 1 (error: Higham 2002, section 4.2)."""
        low, high = _mapped(NUMPY.sum, x)
        size = np.abs(x.low).sum(axis=0, keepdims=True) + np.abs(x.high).sum(axis=0, keepdims=True)
        error = size * (len(x) + 2.0) * EPSILON
        return known(low - error, high + error)

    def cummin(self, x: Intervals) -> Intervals:
        return x.selected(NUMPY.cummin)

    def cummax(self, x: Intervals) -> Intervals:
        return x.selected(NUMPY.cummax)

    def softmax(self, *_operands: Any) -> Intervals:
        """Not available.

        Raises:
            UsageError: U101. Bounds are computed for exact extrema only.
        """
        raise usage("intervals have exact extrema only", "--semantics exact")

    softmax2 = softmax

    def join(self, items: Sequence[Intervals], pick: Pick) -> Intervals:
        return extremum(partial(NUMPY.join, pick=pick), items)

    def windows(self, operands: Sequence[Intervals], pick: Pick, window: Sliding) -> Intervals:
        """Exact extrema over sliding windows, or `until`."""
        over = partial(_WINDOWS.over, pick=pick, count=window.count, width=window.width)
        return selected_from(over, operands)

    # ------------------------------------------------------------------- constants and shapes

    def full(self, shape: tuple[int, ...], value: float, _like: Intervals) -> Intervals:
        return Intervals.point(np.full(shape, value))

    def counted(self, first: int, count: int, like: Intervals) -> Intervals:
        """Array with the numbers `first`, `first + 1`, …, `first + count - 1` along time."""
        return Intervals.point(NUMPY.counted(first, count, like.low))

    def empty(self, shape: tuple[int, ...], _like: Intervals) -> Intervals:
        """Array without defined values."""
        return Intervals(np.empty(shape), np.empty(shape))

    def cat(self, parts: Sequence[Intervals]) -> Intervals:
        return selected_from(np.concatenate, parts)

    def stack(self, parts: Sequence[Intervals]) -> Intervals:
        return selected_from(np.stack, parts)

    def flip(self, x: Intervals) -> Intervals:
        return x[::-1]

    def rows(self, where: Sequence[range], x: Intervals, value: float) -> Intervals:
        return x.each(lambda end: NUMPY.rows(where, end, value))

    def columns(self, x: Intervals) -> Sequence[Intervals]:
        return [x.selected(partial(_column, index=index)) for index in range(x.shape[-1])]

    def quiet(self) -> AbstractContextManager[object]:
        return NUMPY.quiet()


# --------------------------------------------------------------------------------- functions


_PI = float(np.pi) * (1.0 + EPSILON)
"""A number above pi."""


def _mapped(function: Callable[[Any], Any], x: Operand) -> tuple[End, End]:
    """Values of a function of one argument at both ends; the same object twice for a point."""
    low, high = ends(x)
    first = function(low)
    return first, (first if low is high else function(high))


def _widened(low: End, high: End) -> Intervals:
    return widened(low, high, _ERROR)


def _monotone(function: Callable[[Any], Any], x: Operand) -> Intervals:
    """Function that rises wherever it is defined; undefined where an end is outside of its domain."""
    return _widened(*_mapped(function, x))


def _smaller_or_greater(function: Callable[[Any, Any], Any], a: Operand, b: Operand) -> Intervals:
    if isinstance(a, Intervals) and isinstance(b, Intervals):
        return selected_from(lambda both: function(*both), (a, b))
    (a_low, a_high), (b_low, b_high) = ends(a), ends(b)
    low = function(a_low, b_low)
    return Intervals(low, low if a_low is a_high and b_low is b_high else function(a_high, b_high))


def _chosen(mask: Bools, yes: End, no: End) -> Any:
    return np.where(mask, yes, no)


def _infinite(mask: Bools) -> Any:
    return np.where(mask, np.inf, -np.inf)


def _crossed(low: End, high: End, spacing: float, offset: float) -> tuple[Floats, Floats]:
    """Least and greatest whole number k for which `spacing * (k + offset)` may lie in an interval.

    There is none if the least is above the greatest. The positions in units of `spacing` are computed with an
    error below 4 `EPSILON` of their magnitude; more than 2^52 units from 0 there is always such a number.
    """
    first, last = np.asarray(low / spacing), np.asarray(high / spacing)
    first -= offset
    last -= offset
    error: Any = _FEW_TURNS_ERROR
    if first.size and not (first.min() > -_FEW_TURNS and last.max() < _FEW_TURNS):
        error = 4.0 * EPSILON * (1.0 + np.maximum(np.abs(first), np.abs(last)))
    first -= error
    last += error
    return np.ceil(first, out=first), np.floor(last, out=last)


def _wave(function: Callable[[Any], Any], x: Operand, offset: float) -> Intervals:
    """Sine or cosine: its extrema are half a period apart, a maximum at `offset` half periods."""
    low, high = ends(x)
    one, other = _mapped(function, x)
    least, most = (one, one) if one is other else (np.minimum(one, other), np.maximum(one, other))
    first, last = _crossed(low, high, np.pi, offset)
    inside = ~(first > last)
    if inside.any():
        several = ~(first >= last)
        half = 0.5 * first
        even = np.floor(half) == half
        least = np.where(inside & (several | ~even), -1.0, least)
        most = np.where(inside & (several | even), 1.0, most)
    if bound(x) < np.inf:
        return widened(least, most, _ERROR, 1.1)
    return undefined_where(np.isnan(one) | np.isnan(other), widened(least, most, _ERROR))


def _whole_power(a: Operand, exponent: float | Any) -> Intervals:
    """`a ^ exponent` for whole exponents: even ones are powers of the magnitude, odd ones rise.

    A negative exponent turns a falling power, and has a pole at 0.
    """
    even = np.equal(np.mod(exponent, 2.0), 0.0)
    size = magnitudes(a)
    a_low, a_high = ends(a)
    low, high = np.where(even, size.low, a_low), np.where(even, size.high, a_high)
    one, other = np.power(low, exponent), np.power(high, exponent)
    found = _widened(np.minimum(one, other), np.maximum(one, other))
    positive = np.asarray(even | np.greater_equal(a_low, 0.0))
    found = Intervals(np.where(positive, np.maximum(found.low, 0.0), found.low), found.high)
    pole = np.less(exponent, 0.0) & np.less_equal(a_low, 0.0) & np.greater_equal(a_high, 0.0)
    return undefined_where(np.asarray(pole), found)


def _column(values: Floats, index: int) -> Floats:
    """One column of an array `(batch, time, dim)`, as `(time, batch)`."""
    return np.ascontiguousarray(values[..., index].T)


def _anything(bounds: object, *args: Operand) -> Intervals:
    """Result of a function that has no method here: the constant range of its table entry.

    Without one, and where an operand may be undefined, it is undefined.
    """
    undefined = reduce(np.logical_or, (np.isnan(ends(arg)[0]) for arg in args))
    low, high = bounds if isinstance(bounds, tuple) else (np.nan, np.nan)
    low, high = low - _RELATIVE * abs(low), high + _RELATIVE * abs(high)
    return Intervals(np.where(undefined, np.nan, low), np.where(undefined, np.nan, high))


for _name, _function in {
    "expm1": np.expm1,
    "log": np.log,
    "log10": np.log10,
    "log1p": np.log1p,
    "asin": np.arcsin,
    "atan": np.arctan,
    "tanh": np.tanh,
    "sinh": np.sinh,
}.items():
    setattr(IntervalOps, _name, staticmethod(partial(_monotone, _function)))


def _cosh(x: Operand) -> Intervals:
    """Function that falls up to 0 and rises from there."""
    low, high = ends(x)
    inside = np.less_equal(low, 0.0) & np.greater_equal(high, 0.0)
    one, other = np.cosh(low), np.cosh(high)
    found = _widened(np.minimum(one, other), np.maximum(one, other))
    return Intervals(np.where(inside, 1.0, np.maximum(found.low, 1.0)), found.high)


IntervalOps.cosh = staticmethod(_cosh)  # type: ignore[attr-defined]

for _entry in FUNCTIONS.values():
    if _entry.numpy and not hasattr(IntervalOps, _entry.name):
        setattr(IntervalOps, _entry.name, staticmethod(partial(_anything, _entry.bounds)))

INTERVALS: Ops = cast("Ops", IntervalOps())
