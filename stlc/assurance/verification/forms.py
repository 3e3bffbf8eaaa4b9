"""Arrays of affine forms: sums of a centre, of generators times symbols from -1 to 1, and of a remainder.

A form `c + g1 e1 + … + gk ek + r e` contains the values of a quantity over a box. The symbols e1, …, ek are
shared by all forms of a computation, so differences of dependent quantities stay small (de Figueiredo and
Stolfi 2004); `e` belongs to one form. Operations that are not linear keep the linear part that fits best, and
add the rest to the remainder (Singh et al. 2018 for networks).

Values are computed in float64 without outward rounding. `SLACK` covers the rounding errors, which are below
1e-12 of the values here, and proofs are stated up to the tolerance of the monitor, 1e-6.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from functools import reduce
from typing import Any, TypeAlias, cast, final

import numpy as np
from numpy.typing import NDArray

from stlc.compile.backends.array.interval import Belief, Intervals
from stlc.compile.backends.array.interval_ops import INTERVALS
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.namespace import FloatConstants, Ops

Floats: TypeAlias = NDArray[np.float64]
Bools: TypeAlias = NDArray[np.bool_]

_TURN = 2.0 * np.pi

SLACK = 1e-10
"""Widening of every range, relative to its magnitude plus 1; it covers rounding errors."""


@final
@dataclass(frozen=True, slots=True, eq=False)
class Forms:
    """Array of affine forms.

    Attributes:
        centre: (batch,).
        generators: (symbols, batch); a form may have fewer than others, the missing ones are 0.
        rest: radius of the remainder, (batch,); NaN where the value may be undefined.
        floor: lower bounds that are known in addition to the form, (batch,); None if none are known. The
            result of `relu`, for example, is at least 0, although its form may extend below 0.
        ceiling: upper bounds that are known in addition to the form, (batch,); None if none are known.
    """

    centre: Floats
    generators: Floats
    rest: Floats
    floor: Floats | None = None
    ceiling: Floats | None = None
    _radius: Floats | None = field(default=None, init=False, repr=False)

    __array_ufunc__ = None

    @staticmethod
    def point(values: Any) -> Forms:
        """Return forms of width 0 at `values`, (batch,)."""
        centre = np.asarray(values, dtype=np.float64)
        return Forms(centre, np.zeros((0, *centre.shape)), np.zeros_like(centre))

    @staticmethod
    def between(low: Floats, high: Floats) -> Forms:
        """Return forms without shared symbols that contain all values from `low` to `high`.

        Where the ends are NaN, the remainder is NaN: the value may be undefined.
        """
        finite, low, high = _unbounded(low, high)
        centre = np.where(finite, 0.5 * np.where(finite, low, 0.0) + 0.5 * np.where(finite, high, 0.0), 0.0)
        return Forms(centre, np.zeros((0, *centre.shape)), np.maximum(high - centre, centre - low))

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the array."""
        return self.centre.shape

    @property
    def radius(self) -> Floats:
        """Half the width of each form, (batch,); computed once."""
        found = self._radius
        if found is None:
            found = np.abs(self.generators).sum(0) + self.rest
            object.__setattr__(self, "_radius", found)
        return found

    @property
    def range(self) -> Intervals:
        """Intervals that contain the forms; undefined where the radius is NaN."""
        reach = self.radius + SLACK * (1.0 + np.abs(self.centre))
        low, high = self.centre - reach, self.centre + reach
        if self.floor is not None:
            low = np.maximum(low, self.floor)
        if self.ceiling is not None:
            high = np.minimum(high, self.ceiling)
        return Intervals(*_unbounded(low, high)[1:])

    def times(self, factor: Any) -> Forms:
        """Product with exact numbers, one float or one per element; known bounds are kept for a float."""
        floor, ceiling = self.floor, self.ceiling
        if not isinstance(factor, float):
            floor = ceiling = None
        elif factor < 0.0:
            floor, ceiling = ceiling, floor
        return Forms(
            self.centre * factor,
            self.generators * factor,
            self.rest * np.abs(factor),
            None if floor is None else _below(floor * factor),
            None if ceiling is None else _above(ceiling * factor),
        )

    def widened(self, middle: Any, radius: Any) -> Forms:
        """Sum with numbers from `middle - radius` to `middle + radius`, which belong to this form alone."""
        return Forms(self.centre + middle, self.generators, self.rest + radius)

    def at(self, rows: NDArray[np.int64]) -> Forms:
        """The forms of some elements, without known bounds."""
        return Forms(self.centre[rows], self.generators[:, rows], self.rest[rows])

    def with_symbol(self, index: int) -> Forms:
        """The same forms, whose remainder is the generator of symbol number `index`, a new one."""
        assert not self.generators[index:].any(), "a new symbol has the number of one in use"
        generators = np.zeros((index + 1, *self.shape))
        generators[: len(self.generators)] = self.generators
        known = np.isfinite(self.rest)
        generators[index] = np.where(known, self.rest, 0.0)
        rest = np.where(known, 0.0, self.rest)
        return Forms(self.centre, generators, rest, self.floor, self.ceiling)

    def __neg__(self) -> Forms:
        floor = None if self.ceiling is None else -self.ceiling
        ceiling = None if self.floor is None else -self.floor
        return Forms(-self.centre, -self.generators, self.rest, floor, ceiling)


Operand: TypeAlias = Forms | float


def _unbounded(low: Floats, high: Floats) -> tuple[Bools, Floats, Floats]:
    """Mask of intervals with finite ends, and the ends; of others NaN if one of them is, else infinite."""
    finite = np.isfinite(low) & np.isfinite(high)
    if finite.all():
        return finite, low, high
    most = np.where(np.isnan(low) | np.isnan(high), np.nan, np.inf)
    return finite, np.where(finite, low, -most), np.where(finite, high, most)


def _below(values: Floats) -> Floats:
    """Numbers a little less than `values`, by more than their rounding errors."""
    found: Floats = values - SLACK * (1.0 + np.abs(values))
    return found


def _above(values: Floats) -> Floats:
    """Numbers a little greater than `values`, by more than their rounding errors."""
    return -_below(-values)


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
    """The part of `stlc.compile.namespace.Ops` that one step of a system needs.

    Other operations are computed on the range of the form, and their results share no symbols.
    """

    name = "forms"

    def add(self, a: Operand, b: Operand) -> Forms:
        """`a + b`; known bounds are kept if both operands have them."""
        if not isinstance(a, Forms):
            a, b = b, a
        assert isinstance(a, Forms)
        if not isinstance(b, Forms):
            floor = None if a.floor is None else _below(a.floor + b)
            ceiling = None if a.ceiling is None else _above(a.ceiling + b)
            return Forms(a.centre + b, a.generators, a.rest, floor, ceiling)
        floor = None if a.floor is None or b.floor is None else _below(a.floor + b.floor)
        ceiling = None if a.ceiling is None or b.ceiling is None else _above(a.ceiling + b.ceiling)
        generators = _combined(a.generators, b.generators)
        return Forms(a.centre + b.centre, generators, a.rest + b.rest, floor, ceiling)

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
        with np.errstate(invalid="ignore"):  # 0 times infinity
            rest = np.abs(b.centre) * a.rest + np.abs(a.centre) * b.rest + a.radius * b.radius
        found = Forms(a.centre * b.centre, linear.generators, rest)
        return _bounded(found, INTERVALS.mul(a.range, b.range))

    def square(self, x: Forms) -> Forms:
        """`x * x`, which is known to be between the squares of the ends of the range."""
        half = 0.5 * x.radius**2
        found = x.times(2.0 * x.centre).widened(half - x.centre**2, half)
        plain = INTERVALS.square(x.range)
        return Forms(found.centre, found.generators, found.rest, plain.low, plain.high)

    def div(self, a: Operand, b: Operand) -> Forms:
        """`a / b`: linear in both; unknown where `b` may be 0."""
        if not isinstance(b, Forms):
            assert isinstance(a, Forms)
            return a.times(1.0 / b)
        return self.mul(a, self._reciprocal(b))

    def _reciprocal(self, x: Forms) -> Forms:
        """`1 / x`: between the chord over the range and the tangent parallel to it."""
        bound = x.range
        low, high = bound.low, bound.high
        plain = INTERVALS.div(1.0, bound)
        with np.errstate(all="ignore"):
            slope = -1.0 / (low * high)
            middle = np.sign(low) * np.sqrt(low * high)
            return _between_lines(x, slope, plain, [1.0 / low, 1.0 / middle], [low, middle])

    def pow(self, a: Operand, b: Operand) -> Forms:
        """`a ^ b`: products for the whole exponents 1 to 4."""
        if not isinstance(a, Forms) or not isinstance(b, float) or b not in (1.0, 2.0, 3.0, 4.0):
            return self._by_range("pow", a, b)
        if b == 1.0:
            return a
        square = self.square(a)
        return square if b == 2.0 else self.mul(square, a) if b == 3.0 else self.square(square)

    def mod(self, a: Operand, b: Operand) -> Forms:
        """Floored modulo: linear where it does not jump."""
        plain = self._by_range("mod", a, b)
        if not isinstance(a, Forms) or not isinstance(b, float) or b <= 0.0:
            return plain
        bound = a.range
        turns = np.floor(bound.low / b)
        smooth = turns == np.floor(bound.high / b)
        found = a.widened(np.where(smooth, -turns * b, 0.0), 0.0)
        return picked(smooth, found, plain)

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
        floor, ceiling = np.maximum(bound.low, 0.0), np.maximum(bound.high, 0.0)
        return Forms(found.centre, found.generators, found.rest, floor, ceiling)

    def maximum(self, a: Operand, b: Operand) -> Forms:
        """Elementwise maximum, which is known to be at least as large as either operand."""
        found = self.add(self.relu(self.sub(a, b)), b)
        plain = INTERVALS.maximum(*_ranges(a, b))
        return Forms(found.centre, found.generators, found.rest, plain.low, plain.high)

    def minimum(self, a: Operand, b: Operand) -> Forms:
        """Elementwise minimum, which is known to be at most as large as either operand."""
        found = self.sub(a, self.relu(self.sub(a, b)))
        plain = INTERVALS.minimum(*_ranges(a, b))
        return Forms(found.centre, found.generators, found.rest, plain.low, plain.high)

    def clamp(self, x: Forms, low: float | None, high: float | None) -> Forms:
        """Clamp `x` to [low, high]; the plain range where the form of the result is twice as wide."""
        bound = x.range
        first, last = np.clip(bound.low, low, high), np.clip(bound.high, low, high)
        x = x if low is None else self.maximum(x, low)
        x = x if high is None else self.minimum(x, high)
        return _bounded(x, Intervals(first, last))

    def abs(self, x: Forms) -> Forms:
        """`|x|`."""
        return _bounded(self.sub(self.relu(x).times(2.0), x), INTERVALS.abs(x.range))

    def sqrt(self, x: Forms) -> Forms:
        """Square root: the chord over the range, and half its greatest distance from the curve.

        It is undefined where a number may be negative by more than rounding.
        """
        bound, slack = x.range, 4.0 * SLACK * (1.0 + np.abs(x.centre))
        low, high = np.maximum(bound.low, 0.0), np.maximum(bound.high, 1e-300)
        slope = 1.0 / (np.sqrt(low) + np.sqrt(high))
        start = np.sqrt(low) - slope * low
        half = 0.5 * (0.25 / slope - start)
        found, good = x.times(slope).widened(start + half, half + slope * slack), bound.low >= -slack
        return found if good.all() else picked(good, found, self._by_range("sqrt", x))

    def norm(self, *components: Operand) -> Forms:
        """Euclidean norm: at least its tangent at the centre, which is at most `h` below it.

        With g the direction of the centre, `norm(v) >= g v`, because g has length 1. The part of v across g
        is P at most, so the norm is `sqrt((g v)^2 + P^2)` at most; `h` is its distance from `g v` where that
        is least.
        """
        parts = [each for each in components if isinstance(each, Forms)]
        if len(parts) < len(components):
            like = parts[0].centre
            parts = [
                each if isinstance(each, Forms) else Forms.point(np.full(like.shape, each))
                for each in components
            ]
        size = np.sqrt(np.sum([part.centre**2 for part in parts], axis=0))
        along = [part.centre / np.maximum(size, 1e-300) for part in parts]
        shares = [part.times(share) for part, share in zip(parts, along, strict=True)]
        linear = reduce(FORMS.add, shares)
        linear = Forms(linear.centre, linear.generators, linear.rest)
        aside = [self.sub(part, linear.times(share)) for part, share in zip(parts, along, strict=True)]
        across = np.sqrt(np.sum([part.radius**2 for part in aside], axis=0))
        least = linear.range.low
        half = 0.5 * (np.sqrt(least**2 + across**2) - least)
        plain = INTERVALS.norm(*(part.range for part in parts))
        return _bounded(linear.widened(half, half + SLACK * (1.0 + np.abs(half))), plain)

    def sin(self, x: Forms) -> Forms:
        """Sine: parallel to the chord over ranges of at most half a turn."""
        bound = x.range
        middle, width = 0.5 * (bound.low + bound.high), bound.high - bound.low
        plain = INTERVALS.sin(bound)
        with np.errstate(all="ignore"):
            chord = (np.sin(bound.high) - np.sin(bound.low)) / np.maximum(width, 1e-300)
            slope = np.where(width < 1e-6, np.cos(middle), np.clip(chord, -1.0, 1.0))
            at = [bound.low, bound.high]
            for turn in (np.arccos(slope), -np.arccos(slope)):  # where the tangent is parallel to the chord
                near = turn + _TURN * np.rint((middle - turn) / _TURN)
                at.append(np.clip(near, bound.low, bound.high))
            found = _between_lines(x, slope, plain, [np.sin(each) for each in at], at)
        return picked(width <= 0.5 * _TURN, found, Forms.between(plain.low, plain.high))

    def cos(self, x: Forms) -> Forms:
        """Cosine."""
        return self.sin(self.add(x, 0.25 * _TURN))

    def tan(self, x: Forms) -> Forms:
        """Tangent; unknown where a pole may lie in the range."""
        return _bounded(self.div(self.sin(x), self.cos(x)), INTERVALS.tan(x.range))

    def exp(self, x: Forms) -> Forms:
        """`e ^ x`: between the chord over the range and the tangent parallel to it."""
        bound = x.range
        plain = INTERVALS.exp(bound)
        with np.errstate(all="ignore"):
            width = bound.high - bound.low
            chord = np.exp(bound.low) * np.expm1(width) / np.maximum(width, 1e-300)
            slope = np.where(width < 1e-6, np.exp(bound.low), chord)
            at = [bound.low, bound.high, np.clip(np.log(slope), bound.low, bound.high)]
            return _between_lines(x, slope, plain, [np.exp(each) for each in at], at)

    def tanh(self, x: Forms) -> Forms:
        """Hyperbolic tangent."""
        return _bounded(tanh(x), INTERVALS.tanh(x.range))

    def sigmoid(self, x: Forms) -> Forms:
        """`1 / (1 + exp(-x))`."""
        found = self.add(tanh(x.times(0.5)).times(0.5), 0.5)
        return _bounded(found, INTERVALS.sigmoid(x.range))

    def atan(self, x: Forms) -> Forms:
        """Arc tangent."""
        return _bounded(arctan(x), INTERVALS.atan(x.range))

    def atan2(self, a: Operand, b: Operand) -> Forms:
        """Direction of the point (b, a), from -pi to pi; all directions where the point may be near the cut.

        Around the direction of the centre it is the arc tangent of the part across by the part along.
        """
        plain = self._by_range("atan2", a, b)
        if not (isinstance(a, Forms) and isinstance(b, Forms)):
            return plain
        size = np.maximum(np.hypot(b.centre, a.centre), 1e-300)
        cosine, sine = b.centre / size, a.centre / size
        along = self.add(b.times(cosine), a.times(sine))
        across = self.sub(a.times(cosine), b.times(sine))
        turned = self.add(arctan(self.div(across, along)), Forms.point(np.arctan2(sine, cosine)))
        bound = turned.range
        good = (along.range.low > 0.0) & (bound.low > -np.pi) & (bound.high < np.pi)
        return picked(good, turned, plain)

    def floor(self, x: Forms) -> Forms:
        """Next whole number below."""
        return self._rounded("floor", x, -0.5)

    def ceil(self, x: Forms) -> Forms:
        """Next whole number above."""
        return self._rounded("ceil", x, 0.5)

    def round(self, x: Forms) -> Forms:
        """Nearest whole number."""
        return self._rounded("round", x, 0.0)

    def _rounded(self, name: str, x: Forms, middle: float) -> Forms:
        """A whole number within 1/2 of `x + middle`."""
        return _bounded(x.widened(middle, 0.5), getattr(INTERVALS, name)(x.range))

    def gt(self, a: Operand, b: Operand) -> Belief:
        """`a > b`."""
        found = self.sub(a, b).range
        return Belief(found.low > 0.0, ~(found.high <= 0.0))

    def ge(self, a: Operand, b: Operand) -> Belief:
        """`a >= b`."""
        found = self.sub(a, b).range
        return Belief(found.low >= 0.0, ~(found.high < 0.0))

    def both(self, a: Belief, b: Belief) -> Belief:
        """Conjunction."""
        return INTERVALS.both(a, b)  # type: ignore[no-any-return]

    def either(self, a: Belief, b: Belief) -> Belief:
        """Disjunction."""
        return INTERVALS.either(a, b)  # type: ignore[no-any-return]

    def number(self, mask: Belief, _like: Forms) -> Forms:
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
        """`x` times a share; 0 where it is 0, even if `x` may be undefined there."""
        if not isinstance(x, Forms):
            return Forms.point(x * factor)
        found = x.times(factor)
        return Forms(found.centre, found.generators, np.where(factor == 0.0, 0.0, found.rest))

    def full(self, shape: tuple[int, ...], value: float, _like: Forms) -> Forms:
        """Array of a constant."""
        return Forms.point(np.full(shape, value))

    def quiet(self) -> AbstractContextManager[object]:
        """Context manager in which division by zero and invalid operations give inf and NaN, not warnings."""
        return NUMPY.quiet()

    def _by_range(self, name: str, *args: Any) -> Forms:
        found = getattr(INTERVALS, name)(*_ranges(*args))
        return Forms.between(found.low, found.high)

    def __getattr__(self, name: str) -> Any:
        return lambda *args: self._by_range(name, *args)


def _ranges(*args: Any) -> list[Any]:
    """The ranges of forms, and other operands as they are."""
    return [each.range if isinstance(each, Forms) else each for each in args]


def picked(mask: Any, yes: Forms, no: Forms) -> Forms:
    """The elements of `yes` where `mask` is True, else those of `no`, with the known bounds of both."""
    generators = _combined(np.where(mask, yes.generators, 0.0), np.where(mask, 0.0, no.generators))
    one, other = yes.range, no.range
    return Forms(
        np.where(mask, yes.centre, no.centre),
        generators,
        np.where(mask, yes.rest, no.rest),
        np.where(mask, one.low, other.low),
        np.where(mask, one.high, other.high),
    )


def _bounded(x: Forms, plain: Intervals) -> Forms:
    """The form `x` with known bounds; without symbols where its radius is twice that of the bounds."""
    other = Forms.between(plain.low, plain.high)
    with np.errstate(invalid="ignore"):
        keep = x.radius <= 2.0 * other.rest
    generators = x.generators if keep.all() else np.where(keep, x.generators, 0.0)
    return Forms(
        np.where(keep, x.centre, other.centre),
        generators,
        np.where(keep, x.rest, other.rest),
        plain.low,
        plain.high,
    )


def _between_lines(
    x: Forms, slope: Floats, plain: Intervals, values: Sequence[Floats], at: Sequence[Floats]
) -> Forms:
    """A function of `x` between two lines of a slope; `plain` where they are not finite.

    Args:
        x: the argument.
        slope: slope of both lines, (batch,).
        plain: bounds on the function.
        values: values of the function where its distance from a line of that slope may be extreme.
        at: arguments of these values.
    """
    off = [value - slope * place for value, place in zip(values, at, strict=True)]
    low, high = np.min(off, axis=0), np.max(off, axis=0)
    good = np.isfinite(slope) & np.isfinite(low) & np.isfinite(high) & np.isfinite(plain.low + plain.high)
    slope, low, high = (np.where(good, each, 0.0) for each in (slope, low, high))
    error = SLACK * (1.0 + np.abs(low) + np.abs(high) + np.abs(slope) * (1.0 + np.abs(x.centre)))
    found = x.times(slope).widened(0.5 * (low + high), 0.5 * (high - low) + error)
    return _bounded(picked(good, found, Forms.between(plain.low, plain.high)), plain)


def tanh(x: Forms) -> Forms:
    """Hyperbolic tangent."""
    return _rising(x, np.tanh, lambda slope: np.arctanh(np.sqrt(1.0 - slope)))


def arctan(x: Forms) -> Forms:
    """Arc tangent."""
    return _rising(x, np.arctan, lambda slope: np.sqrt(1.0 / slope - 1.0))


def _rising(x: Forms, function: Callable[[Floats], Floats], steep: Callable[[Floats], Floats]) -> Forms:
    """A rising odd function, steepest at 0 with slope 1: between two lines parallel to the chord.

    `steep` gives the positive argument at which the function has a slope. Over short ranges the lines are
    four times as close as those of the least slope in the range (Singh et al. 2018).
    """
    bound = x.range
    first, last = function(bound.low), function(bound.high)
    with np.errstate(all="ignore"):
        width = bound.high - bound.low
        chord = (last - first) / width
        slope = np.where(width < 1e-9, 0.0, np.clip(chord, 0.0, 1.0))
        at = steep(np.maximum(slope, 1e-300))
        places = [bound.low, bound.high, *(np.clip(each, bound.low, bound.high) for each in (at, -at))]
        values = [first, last, function(places[2]), function(places[3])]
        return _between_lines(x, slope, Intervals(_below(first), _above(last)), values, places)


def ranges(forms: Sequence[Forms]) -> Intervals:
    """Ranges of a sequence of forms (batch,) over time: (time, batch)."""
    found = [form.range for form in forms]
    return Intervals(np.stack([each.low for each in found]), np.stack([each.high for each in found]))


def over_time(forms: Sequence[Forms]) -> Forms:
    """A sequence of forms (batch,) over time as one: (time, batch)."""
    if len(forms) == 1:  # no copy
        only = forms[0]
        ends = (None if end is None else end[None] for end in (only.floor, only.ceiling))
        return Forms(only.centre[None], only.generators[:, None], only.rest[None], *ends)
    generators = np.zeros((in_use(forms), len(forms), *forms[0].shape))
    for time, form in enumerate(forms):
        generators[: len(form.generators), time] = form.generators
    bound = (
        ranges(forms) if any(form.floor is not None or form.ceiling is not None for form in forms) else None
    )
    centre, rest = (np.stack([getattr(form, name) for form in forms]) for name in ("centre", "rest"))
    return Forms(centre, generators, rest, *(() if bound is None else (bound.low, bound.high)))


def in_use(forms: Iterable[Forms]) -> int:
    """Number of symbols in forms: the number of the next new one, if these are all forms of a computation."""
    return max(len(form.generators) for form in forms)


def together(parts: Sequence[Forms]) -> Forms:
    """Forms (batch,) of several batches as one, without known bounds."""
    generators = np.zeros((max(len(part.generators) for part in parts), sum(len(p.centre) for p in parts)))
    at = 0
    for part in parts:
        generators[: len(part.generators), at : at + len(part.centre)] = part.generators
        at += len(part.centre)
    centre, rest = (np.concatenate(each) for each in zip(*((p.centre, p.rest) for p in parts), strict=True))
    return Forms(centre, generators, rest)


def spread(form: Forms, *shape: int) -> Forms:
    """The form in a shape, such as one element per box; forms of a constant have a single element."""
    if form.shape == shape:
        return form
    rows = len(form.generators)
    generators = np.broadcast_to(form.generators.reshape(rows, *(1,) * len(shape)), (rows, *shape))
    ends = (None if end is None else np.broadcast_to(end, shape) for end in (form.floor, form.ceiling))
    return Forms(np.broadcast_to(form.centre, shape), generators, np.broadcast_to(form.rest, shape), *ends)


FORMS: Ops = cast("Ops", FormOps())
