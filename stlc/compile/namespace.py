"""The array operations that the evaluators need, as an interface to array libraries.

`stlc.compile.backends.array.numpy_ops` and `stlc.compile.backends.torch.ops` implement it; for intervals,
`stlc.compile.backends.array.interval_ops`. Operands named `x`, `a`, `b` are arrays; a float is allowed where
a method says so. Operators (`a + b`, `a * 2.0`) are used directly.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, Literal, Protocol, Self, TypeAlias, final

Array: TypeAlias = Any
"""A NumPy array or a torch tensor."""

Mask: TypeAlias = Any
"""An array of booleans."""

Pick: TypeAlias = Literal["min", "max"]
"""The extremum that an operator takes."""

ScanBody: TypeAlias = Callable[[Sequence[Array], Sequence[Array]], tuple[Sequence[Array], Sequence[Array]]]
"""Function that `Ops.scan` calls at each time."""


@final
@dataclass(frozen=True, slots=True)
class Sliding:
    """Layout of sliding windows: `count` windows of `width` rows over an array of `rows` rows.

    Window `j` starts at row `j`, and ends with the last row of the array at the latest. There is at least one
    window, and at most one per row.
    """

    rows: int
    count: int
    width: int

    @property
    def to_end(self) -> bool:
        """True if every window extends to the last row."""
        return self.width >= self.rows


class Ops(Protocol):
    """Operations of an array library. Reductions and running extrema work along axis 0, which is time."""

    name: str

    @property
    def guarded(self) -> Ops:
        """The same operations with gradients that are finite where values are infinite or NaN.

        A derivative that is not finite counts as 0. Libraries without gradients return themselves.
        """

    # arithmetic: one array operation each
    add: Callable[[Array, Array], Array]
    sub: Callable[[Array, Array], Array]
    mul: Callable[[Array, Array], Array]
    div: Callable[[Array, Array], Array]
    abs: Callable[[Array], Array]
    sqrt: Callable[[Array], Array]
    exp: Callable[[Array], Array]
    expm1: Callable[[Array], Array]
    log: Callable[[Array], Array]
    log1p: Callable[[Array], Array]
    log10: Callable[[Array], Array]
    sin: Callable[[Array], Array]
    cos: Callable[[Array], Array]
    tan: Callable[[Array], Array]
    sinh: Callable[[Array], Array]
    cosh: Callable[[Array], Array]
    tanh: Callable[[Array], Array]
    asin: Callable[[Array], Array]
    acos: Callable[[Array], Array]
    atan: Callable[[Array], Array]
    sigmoid: Callable[[Array], Array]
    sign: Callable[[Array], Array]
    floor: Callable[[Array], Array]
    ceil: Callable[[Array], Array]
    round: Callable[[Array], Array]
    square: Callable[[Array], Array]
    minimum: Callable[..., Array]
    """Elementwise minimum of two arrays; `out=` receives the result without a gradient."""
    maximum: Callable[..., Array]

    def pow(self, a: Array | float, b: Array | float) -> Array:
        """`a ^ b`."""

    def mod(self, a: Array | float, b: Array | float) -> Array:
        """Floored modulo: the result has the sign of `b`; the gradient with respect to `a` is 1."""

    def atan2(self, a: Array | float, b: Array | float) -> Array:
        """Angle of the point (b, a), in radians."""

    def axpy(self, a: Array, b: Array, factor: float) -> Array:
        """`a + factor * b`; `a` may be a float."""

    def addcmul(self, a: Array, b: Array, c: Array, factor: float) -> Array:
        """`a + factor * b * c`; `a` may be a float."""

    def clamp(self, x: Array, low: float | None, high: float | None) -> Array:
        """Clamp `x` to [low, high]; None for a bound that is not imposed."""

    def norm(self, *components: Array | float) -> Array:
        """Euclidean norm of a vector given by its components; its gradient at 0 is 0."""

    # truth
    def gt(self, a: Array | float, b: Array | float) -> Mask:
        """`a > b`."""

    def ge(self, a: Array | float, b: Array | float) -> Mask:
        """`a >= b`."""

    def both(self, a: Mask, b: Mask) -> Mask:
        """Elementwise conjunction of masks."""

    def either(self, a: Mask, b: Mask) -> Mask:
        """Elementwise disjunction of masks."""

    def settled(self, weight: Array, mask: Mask) -> Array:
        """Array that is 1 where `mask` is True, else 0; its gradient is that of `weight`."""

    def number(self, mask: Mask, like: Array) -> Array:
        """Array that is 1 where `mask` is True, else 0, in the dtype of `like`."""

    def where(self, mask: Mask, yes: Array | float, no: Array | float) -> Array:
        """Elements of `yes` where `mask` is True, else of `no`; one of the two may be a float."""

    def lerp(self, no: Array | float, yes: Array | float, weight: Array) -> Array:
        """`no + weight (yes - no)`, exact if `weight` is 0 or 1; one of `no` and `yes` may be a float.

        Where `no` or `yes` is infinite or NaN, guarded operations return the nearer of both.
        """

    def margin(self, x: Array) -> Array:
        """`x` as the margin of a predicate: of intervals, any number where `x` may be undefined."""

    def infinite(self, mask: Mask, like: Array) -> Array:
        """Array that is +inf where `mask` is True, else -inf, in the dtype of `like`, without gradient."""

    def straight_through(self, rho: Array, strict: bool, slope: float) -> Array:
        """Array that is 1 where the condition with robustness `rho` holds, else 0, with a smooth gradient.

        The condition is `rho > 0` if `strict`, and `rho >= 0` otherwise. The gradient is that of
        `(1 + tanh(slope rho)) / 2`.
        """

    # along time
    def amin(self, x: Array) -> Array:
        """Minimum over axis 0, which is kept with length 1."""

    def amax(self, x: Array) -> Array:
        """Maximum over axis 0, which is kept with length 1."""

    def sum(self, x: Array) -> Array:
        """Sum over axis 0, which is kept with length 1."""

    def cummin(self, x: Array) -> Array:
        """Running minimum along axis 0."""

    def cummax(self, x: Array) -> Array:
        """Running maximum along axis 0."""

    def accumulate(self, start: Array, x: Array) -> Array:
        """Running sum along axis 0 of `start`, (1, …), and `x`, (count, …): (count + 1, …)."""

    def scan(
        self, body: ScanBody, carry: Sequence[Array], rows: Sequence[Array], count: int
    ) -> Sequence[Sequence[Array]]:
        """Call `body` for each of `count` times, and return the arrays that it yields.

        Each is (count, …), and is given as its parts along axis 0, which `cat` puts together.

        Args:
            body: function (carry, rows) -> (carry of the next time, arrays to yield), all (1, …).
            carry: arrays (1, …) that go from one time to the next; these are the first ones.
            rows: arrays (count, …), or (1, …) if they are constant over time; `body` gets a row of each.
            count: number of calls, at least 1.
        """

    def softmax(self, x: Array, k: float) -> Array:
        """`log(sum(exp(k x))) / k` over axis 0, which is kept with length 1; stable, also with infinities.

        This is a smooth maximum for `k` > 0 and a smooth minimum for `k` < 0.
        """

    def softmax2(self, a: Array, b: Array, k: float) -> Array:
        """`log(exp(k a) + exp(k b)) / k`: `softmax` of two arrays of the same shape."""

    def join(self, items: Sequence[Array], pick: Pick) -> Array:
        """Exact elementwise minimum or maximum of one or more arrays."""

    def windows(self, operands: Sequence[Array], pick: Pick, window: Sliding) -> Array | None:
        """Exact extrema of one array over sliding windows, or `until` of two; see `Windows.over`.

        Arrays are (time, batch), the result is (count, batch), or None if a combination of other operations
        is faster. The caller then uses that combination.
        """

    # constants and shapes
    def kind(self, like: Array) -> Hashable:
        """Key of the array `like`, such as (dtype, device).

        Constants are converted once per key. So arrays with equal keys share the converted constants.
        """

    def constant(self, value: float, like: Array) -> Array | float:
        """Convert a number to the form that is fastest in operations with `like`."""

    def full(self, shape: tuple[int, ...], value: float, like: Array) -> Array:
        """Array of a constant, with dtype and device of `like`."""

    def counted(self, first: int, count: int, like: Array) -> Array:
        """Array of the numbers `first`, `first + 1`, … along time, `(count, batch)`.

        Batch size, dtype and device are those of `like`.
        """

    def empty(self, shape: tuple[int, ...], like: Array) -> Array:
        """Uninitialized array with dtype and device of `like`."""

    def cat(self, parts: Sequence[Array]) -> Array:
        """Concatenate arrays along axis 0."""

    def stack(self, parts: Sequence[Array]) -> Array:
        """Stack arrays along a new axis 0."""

    def split(self, x: Array) -> Sequence[Array]:
        """Split `x` into its rows, (1, …) each."""

    def repeat(self, x: Array, count: int) -> Array:
        """Expand `x`, (1, …) or (count, …), to (count, …)."""

    def flip(self, x: Array) -> Array:
        """Reverse `x` along axis 0."""

    def rows(self, where: Sequence[range], x: Array, value: float) -> Array:
        """Copy of `x` with `value` in the rows `where`, ranges of axis 0; `x` itself if there are none."""

    def columns(self, x: Array) -> Sequence[Array]:
        """Split trajectories `(batch, time, dim)` into one array `(time, batch)` per state."""

    def quiet(self) -> AbstractContextManager[object]:
        """Context manager in which division by zero and invalid operations give inf and NaN, not warnings."""


class ScanByRows:
    """Base of array libraries: `Ops.scan` as a loop over rows."""

    __slots__ = ()
    split: Callable[[Array], Sequence[Array]]

    def scan(
        self, body: ScanBody, carry: Sequence[Array], rows: Sequence[Array], count: int
    ) -> Sequence[Sequence[Array]]:
        """Call `body` for each of `count` times; return the rows of each array that it yields."""
        taken = [[each] * count if len(each) == 1 else self.split(each) for each in rows]
        history = []
        for row in zip(*taken, strict=True) if taken else [()] * count:
            carry, found = body(carry, row)
            history.append(found)
        return list(zip(*history, strict=True))


class FloatConstants:
    """Base of array libraries in which a Python float is the fastest constant, whatever the array."""

    __slots__ = ()

    @property
    def guarded(self) -> Self:
        """Return the library itself."""
        return self

    def kind(self, _like: Array) -> Hashable:
        """Return None for every array, so that all arrays share converted constants."""
        return None

    def constant(self, value: float, _like: Array) -> float:
        """Return the float itself."""
        return value

    def straight_through(self: Ops, rho: Array, strict: bool, _slope: float) -> Array:
        """Return 1 where the condition holds, else 0: there are no gradients."""
        return self.number(self.gt(rho, 0.0) if strict else self.ge(rho, 0.0), rho)

    def margin(self, x: Array) -> Array:
        """Return `x` itself."""
        return x
