"""Array operations on CasADi expressions (Andersson et al. 2019), for nonlinear programs.

An array is `(time, 1)`, since a nonlinear program computes one trajectory. Kinks of functions (`abs`, `min`,
`max`, `clip`) are rounded over the width `ROUNDING`, so that Newton's method applies. Step functions
(`floor`, `sign`) stay exact, with derivative 0. CasADi comes with the extra `bench`.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import reduce
from typing import Any, TypeAlias, cast, final

import casadi
import numpy as np
from numpy.typing import NDArray

from stlc.compile.namespace import FloatConstants, Ops, Pick, Sliding

ROUNDING = 1e-3
"""Width of a rounded kink, in the unit of the operand; the error is half of it."""
GREAT = 1e3
"""Robustness of a time test that depends on data."""
TINY = 1e-12
"""Added under square roots, whose slope at 0 would be infinite."""


@final
@dataclass(frozen=True, slots=True, eq=False)
class SymbolicColumn:
    """Time series of symbolic expressions.

    Attributes:
        entries: `casadi.SX`, (time, 1).
    """

    entries: Any

    @property
    def shape(self) -> tuple[int, int]:
        """Shape, (time, 1)."""
        return (int(self.entries.shape[0]), 1)

    @property
    def ndim(self) -> int:
        """Number of axes, which is 2."""
        return 2

    @property
    def T(self) -> SymbolicColumn:  # noqa: N802 - as arrays call it
        """Transpose; only for a series of length 1, which is its own transpose."""
        assert len(self) == 1
        return self

    def __len__(self) -> int:
        return int(self.entries.shape[0])

    def __getitem__(self, rows: slice | int) -> SymbolicColumn:
        return SymbolicColumn(self.entries[rows, 0])

    def rows(self) -> list[SymbolicColumn]:
        """The expressions at each instant, one series (1, 1) per instant."""
        return [self[k] for k in range(len(self))]

    def __add__(self, other: Operand) -> SymbolicColumn:
        return SymbolicColumn(self.entries + _entries(other))

    def __radd__(self, other: float) -> SymbolicColumn:
        return self + other

    def __sub__(self, other: Operand) -> SymbolicColumn:
        return SymbolicColumn(self.entries - _entries(other))

    def __rsub__(self, other: float) -> SymbolicColumn:
        return SymbolicColumn(other - self.entries)

    def __mul__(self, other: Operand) -> SymbolicColumn:
        return SymbolicColumn(self.entries * _entries(other))

    def __rmul__(self, other: float) -> SymbolicColumn:
        return self * other

    def __truediv__(self, other: Operand) -> SymbolicColumn:
        return SymbolicColumn(self.entries / _entries(other))

    def __rtruediv__(self, other: float) -> SymbolicColumn:
        return SymbolicColumn(other / self.entries)

    def __neg__(self) -> SymbolicColumn:
        return SymbolicColumn(-self.entries)


Operand: TypeAlias = SymbolicColumn | float


@final
@dataclass(frozen=True, slots=True)
class StackedColumns:
    """Several time series, stacked along a new first axis, over which an extremum is computed."""

    parts: tuple[SymbolicColumn, ...]

    def __len__(self) -> int:
        return len(self.parts)

    def __getitem__(self, index: int) -> SymbolicColumn:
        return self.parts[index]

    def rows(self) -> list[SymbolicColumn]:
        """List of the stacked time series."""
        return list(self.parts)


def _entries(operand: Operand) -> Any:
    return operand.entries if isinstance(operand, SymbolicColumn) else operand


def _elementwise(function: Any) -> Any:
    """Make a method of `CasadiOps` from a CasADi function that works elementwise."""

    def method(_: CasadiOps, *operands: Operand) -> SymbolicColumn:
        return SymbolicColumn(casadi.SX(function(*map(_entries, operands))))

    return method


def _floored_mod(a: Any, b: Any) -> Any:
    rest = casadi.fmod(a, b)
    return casadi.if_else(rest * casadi.sign(b) < 0.0, rest + b, rest)


def _each(*functions: Any) -> list[Any]:
    """Make methods of `CasadiOps` from several elementwise functions."""
    return [_elementwise(function) for function in functions]


@final
class CasadiOps(FloatConstants):
    """Implementation of `stlc.compile.namespace.Ops` for CasADi expressions."""

    name = "casadi"

    add, sub, mul, div = _each(operator.add, operator.sub, operator.mul, operator.truediv)
    exp, expm1, log, log1p = _each(casadi.exp, casadi.expm1, casadi.log, casadi.log1p)
    sin, cos, tan = _each(casadi.sin, casadi.cos, casadi.tan)
    sinh, cosh, tanh, log10 = _each(casadi.sinh, casadi.cosh, casadi.tanh, casadi.log10)
    asin, acos, atan, atan2 = _each(casadi.asin, casadi.acos, casadi.atan, casadi.atan2)
    sign, floor, ceil = _each(casadi.sign, casadi.floor, casadi.ceil)
    gt, ge, pow, where = _each(operator.gt, operator.ge, operator.pow, casadi.if_else)
    both, either = _each(casadi.logic_and, casadi.logic_or)
    round = _elementwise(lambda x: casadi.floor(x + 0.5))
    mod = _elementwise(_floored_mod)
    square = _elementwise(lambda x: x * x)
    sqrt = _elementwise(lambda x: casadi.sqrt(x + TINY))
    sigmoid = _elementwise(lambda x: 0.5 + 0.5 * casadi.tanh(0.5 * x))
    abs = _elementwise(lambda x: casadi.sqrt(x * x + ROUNDING**2))
    maximum = _elementwise(lambda a, b: _rounded(a, b, 1.0))
    minimum = _elementwise(lambda a, b: _rounded(a, b, -1.0))

    def axpy(self, a: Operand, b: SymbolicColumn, factor: float) -> SymbolicColumn:
        return b * factor + a

    def addcmul(self, a: Operand, b: SymbolicColumn, c: SymbolicColumn, factor: float) -> SymbolicColumn:
        return b * c * factor + a

    def clamp(self, x: SymbolicColumn, low: float | None, high: float | None) -> SymbolicColumn:
        """Clamp `x` to [low, high], with rounded kinks at both ends."""
        raised = x if low is None else self.maximum(x, low)
        held: SymbolicColumn = raised if high is None else self.minimum(raised, high)
        return held

    def norm(self, *components: Operand) -> SymbolicColumn:
        total = sum(part * part for part in map(_entries, components))
        return SymbolicColumn(casadi.sqrt(total + TINY))

    # ------------------------------------------------------------------- truth

    def settled(self, weight: SymbolicColumn, mask: SymbolicColumn) -> SymbolicColumn:  # noqa: ARG002
        """Return `weight` unchanged. The exact truth `mask`, 0 or 1, would not be smooth."""
        return weight

    def number(self, mask: SymbolicColumn, like: SymbolicColumn) -> SymbolicColumn:  # noqa: ARG002
        """Return the mask itself, whose entries are 0 or 1."""
        return mask

    def lerp(self, no: Operand, yes: Operand, weight: SymbolicColumn) -> SymbolicColumn:
        return weight * (yes - no) + no

    def infinite(self, mask: SymbolicColumn, like: SymbolicColumn) -> SymbolicColumn:  # noqa: ARG002
        """Return +inf where `mask` is true, else -inf.

        Where the mask depends on variables of the program, the number `GREAT` replaces infinity.
        """
        rows = []
        for each in mask.rows():
            size = math.inf if each.entries.is_constant() else GREAT
            rows.append(SymbolicColumn(casadi.if_else(each.entries, size, -size)))
        return self.cat(rows)

    def straight_through(self, rho: SymbolicColumn, strict: bool, slope: float) -> SymbolicColumn:  # noqa: ARG002
        """Return the smooth step `(1 + tanh(slope rho)) / 2`, not 0 or 1 as with other array libraries.

        In this way the gradient is the true derivative of the value.
        """
        return SymbolicColumn(0.5 + 0.5 * casadi.tanh(slope * rho.entries))

    # -------------------------------------------------------------- along time

    def join(self, items: Sequence[SymbolicColumn], pick: Pick) -> SymbolicColumn:
        """Elementwise minimum or maximum of one or more series, with rounded kinks."""
        return reduce(self.minimum if pick == "min" else self.maximum, items)

    def amin(self, x: SymbolicColumn) -> SymbolicColumn:
        """Minimum over time with rounded kinks, (1, 1)."""
        return self.join(x.rows(), "min")

    def amax(self, x: SymbolicColumn) -> SymbolicColumn:
        """Maximum over time with rounded kinks, (1, 1)."""
        return self.join(x.rows(), "max")

    def sum(self, x: SymbolicColumn) -> SymbolicColumn:
        """Sum over time, (1, 1)."""
        return SymbolicColumn(casadi.sum1(x.entries))

    def cummin(self, x: SymbolicColumn) -> SymbolicColumn:
        """Running minimum along time, with rounded kinks."""
        return self.cat([self.amin(x[: k + 1]) for k in range(len(x))])

    def cummax(self, x: SymbolicColumn) -> SymbolicColumn:
        """Running maximum along time, with rounded kinks."""
        return self.cat([self.amax(x[: k + 1]) for k in range(len(x))])

    def softmax(self, x: SymbolicColumn | StackedColumns, k: float) -> SymbolicColumn | StackedColumns:
        """`log(sum(exp(k x))) / k` over the first axis, which is kept with length 1.

        The terms are combined in pairs by `softmax2`.
        """
        parts = x.rows()
        while len(parts) > 1:
            pairs = [self.softmax2(a, b, k) for a, b in zip(parts[::2], parts[1::2], strict=False)]
            parts = [*pairs, *parts[len(parts) - len(parts) % 2 :]]
        return parts[0] if isinstance(x, SymbolicColumn) else StackedColumns((parts[0],))

    def softmax2(self, a: SymbolicColumn, b: SymbolicColumn, k: float) -> SymbolicColumn:
        """`log(exp(k a) + exp(k b)) / k` without overflow, also if an operand is an infinite constant."""
        neutral = -math.inf if k > 0.0 else math.inf
        rows = []
        for one, other in zip(a.rows(), b.rows(), strict=True):
            if _is(one, neutral) or _is(other, -neutral):
                rows.append(other)
                continue
            if _is(other, neutral) or _is(one, -neutral):
                rows.append(one)
                continue
            top = (casadi.fmax if k > 0.0 else casadi.fmin)(one.entries, other.entries)
            gap = casadi.fabs(one.entries - other.entries)
            rows.append(SymbolicColumn(top + casadi.log1p(casadi.exp(-abs(k) * gap)) / k))
        return self.cat(rows)

    def extrema(self, x: SymbolicColumn, pick: Pick, window: Sliding) -> None:
        """Return None: there is no special method for extrema over sliding windows."""

    def until(self, left: SymbolicColumn, right: SymbolicColumn, pick: Pick, window: Sliding) -> None:
        """Return None: there is no special method for `until`."""

    # ------------------------------------------------------ constants and shapes

    def full(self, shape: tuple[int, ...], value: float, like: SymbolicColumn) -> SymbolicColumn:  # noqa: ARG002
        """Time series of a constant."""
        return SymbolicColumn(casadi.SX([value] * (shape[0] if shape else 1)))

    def counted(self, first: int, count: int, like: SymbolicColumn) -> SymbolicColumn:  # noqa: ARG002
        """Time series of the numbers `first`, `first + 1`, …, `first + count - 1`."""
        return SymbolicColumn(casadi.SX([float(k) for k in range(first, first + count)]))

    def empty(self, shape: tuple[int, ...], like: SymbolicColumn) -> SymbolicColumn:
        """Time series of zeros."""
        return self.full(shape, 0.0, like)

    def cat(self, parts: Sequence[SymbolicColumn]) -> SymbolicColumn:
        """Concatenate series along time."""
        return SymbolicColumn(casadi.vertcat(*(part.entries for part in parts)))

    def stack(self, parts: Sequence[SymbolicColumn]) -> StackedColumns:
        """Stack series along a new first axis."""
        return StackedColumns(tuple(parts))

    def flip(self, x: SymbolicColumn) -> SymbolicColumn:
        """Reverse `x` in time."""
        return x[::-1]

    def rows(self, keep: NDArray[np.bool_], x: SymbolicColumn, value: float) -> SymbolicColumn:
        """Copy of `x` with `value` at the samples where `keep` is False."""
        blank = casadi.SX(value)
        return SymbolicColumn(casadi.vertcat(*(x[k].entries if keep[k] else blank for k in range(len(x)))))

    def columns(self, x: Any) -> Sequence[SymbolicColumn]:
        """Split `casadi.SX` (time, dim) into one time series per state."""
        return [SymbolicColumn(x[:, i]) for i in range(x.shape[1])]

    def quiet(self) -> AbstractContextManager[object]:
        """Empty context, since nothing is computed while an expression is built."""
        return nullcontext()


def _rounded(a: Any, b: Any, sign: float) -> Any:
    """Maximum (`sign` 1) or minimum (`sign` -1) of `a` and `b`, smooth also where `a` equals `b`.

    The error vanishes where `a` and `b` are far apart.
    """
    return 0.5 * (a + b + sign * casadi.sqrt((a - b) ** 2 + ROUNDING**2))


def _is(x: SymbolicColumn, value: float) -> bool:
    """True if `x` is a constant that equals `value`."""
    return bool(x.entries.is_constant()) and float(x.entries) == value


CASADI_OPS = CasadiOps()
CASADI: Ops = cast("Ops", CASADI_OPS)
