"""Section `inputs`: input signals that no policy chooses, such as a disturbance or a driver's pedal.

An input signal is a function of time that a few numbers determine: its values at the pieces of a time span
and, if the switching times are free, these times. The numbers are drawn once per trajectory.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from itertools import pairwise
from typing import TYPE_CHECKING, ClassVar, Literal, TypeAlias, get_args

from stlc.compile.frontend.scope import Known, column_value
from stlc.compile.ir import nodes as ir
from stlc.dynamics.declaration.columns import RANGE, name_columns, read_ranges, unit_text
from stlc.dynamics.declaration.motion import Assign
from stlc.dynamics.declaration.sampled import CLOCK, Sampled, clock, declared
from stlc.dynamics.declaration.schema.expressions import SECOND
from stlc.dynamics.declaration.schema.names import Context, base_name
from stlc.dynamics.declaration.schema.reader import first_line
from stlc.dynamics.declaration.schema.record import OF, SECONDS, integer, key, read, word
from stlc.dynamics.declaration.schema.yaml_nodes import Entry, Node
from stlc.jsontext import Num
from stlc.signature import Column
from stlc.units import Unit

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Floats: TypeAlias = NDArray[np.float64]

Interpolate: TypeAlias = Literal["hold", "linear", "pchip"]
MAX_PIECES = 500
_LEADS = {"hold": 0, "linear": 1, "pchip": 2}
SLACK = 1e-9
"""Share of the duration by which a sample may precede a switching time that it is meant to coincide with."""


@dataclass(frozen=True, slots=True)
class InputDecl:
    """An input signal: a function of time, determined by numbers that are drawn once per trajectory.

    The numbers are the values of the signal, one per piece (`hold`) or one per end of a piece (`linear`,
    `pchip`), and then, if the times are free, the times at which one piece ends and the next begins.

    Attributes:
        name: name in the system file.
        unit: unit of the values.
        low: lower end of the range of the values, in `unit`.
        high: upper end of the range of the values, in `unit`.
        pieces: number of pieces.
        interpolate: `hold`: the signal is constant on each piece. `linear`: it is continuous, and linear on
            each piece. `pchip`: a cubic polynomial on each piece, without overshoot, with a continuous
            derivative (Fritsch and Butland 1984).
        duration: length of all pieces together, in seconds; afterwards the last value stays.
        free_times: whether the times at which pieces end are drawn, too. If not, all pieces have one length.
    """

    JSON: ClassVar = "name low high pieces interpolate free_times unit=unit.shown seconds columns"

    name: str
    unit: Unit
    low: Num
    high: Num
    pieces: int
    interpolate: Interpolate
    duration: Fraction
    free_times: bool

    @property
    def seconds(self) -> Num:
        """Length of all pieces together, in seconds."""
        return float(self.duration)

    @property
    def points(self) -> int:
        """Number of values."""
        return self.pieces if self.interpolate == "hold" else self.pieces + 1

    @property
    def lead(self) -> int:
        """Number of pieces by which a value acts before its own time, by interpolation."""
        return _LEADS[self.interpolate]

    @property
    def moves(self) -> bool:
        """True if the signal may change over time."""
        return self.points > 1

    @property
    def values(self) -> tuple[str, ...]:
        """Names of the columns that hold the values, in order."""
        return tuple(f"{self.name}_values[{index}]" for index in range(self.points))

    @property
    def times(self) -> tuple[str, ...]:
        """Names of the columns that hold the free times, in order; none if the times are fixed."""
        count = self.pieces - 1 if self.free_times else 0
        return tuple(f"{self.name}_times[{index}]" for index in range(count))

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns that determine the signal: the values, then the free times."""
        return (*self.values, *self.times)

    @property
    def ends(self) -> tuple[Fraction, ...]:
        """Ends of the pieces in seconds if the times are fixed: 0, the times in between, the duration."""
        return tuple(self.duration * index / self.pieces for index in range(self.pieces + 1))

    def drawn(self, uniforms: Floats) -> Floats:
        """Return the numbers of the signal that uniform random numbers give, as initial states do.

        The values are evenly distributed over the range. The times are those of independent uniform times,
        sorted.

        Args:
            uniforms: numbers between 0 and 1, one per column of the signal, (batch, columns).

        Returns:
            The numbers in the order of `columns`, (batch, columns), float64: values in the unit of the
            signal, then times in seconds.
        """
        import numpy as np

        found = np.array(uniforms, dtype=np.float64)
        values = self.low + (self.high - self.low) * found[:, : self.points]
        found[:, : self.points] = np.minimum(values, self.high)  # the sum may be rounded up
        rest = np.full(len(found), float(self.duration))
        for index in range(len(self.times)):
            column = self.points + index
            rest = rest * found[:, column] ** (1.0 / (len(self.times) - index))
            found[:, column] = float(self.duration) - rest
        return found

    def at(self, values: Floats, times: Floats) -> Floats:
        """Return the signal at given times.

        A sample at a switching time belongs to the later piece. Before 0 the signal has its first value,
        after the duration its last one.

        Args:
            values: its numbers in the order of `columns`, (batch, columns): values in the unit of the
                signal, then the free times in seconds, which must not decrease.
            times: times in seconds, (steps,).

        Returns:
            The signal in its unit, (batch, steps), float64.
        """
        import numpy as np

        numbers = np.asarray(values, dtype=np.float64)
        at = np.asarray(times, dtype=np.float64)
        points, batch = numbers[:, : self.points], len(numbers)
        length = float(self.duration)
        if self.free_times:
            ends = np.zeros((batch, self.pieces + 1))
            ends[:, 1:-1], ends[:, -1] = numbers[:, self.points :], length
        else:
            ends = np.broadcast_to([float(end) for end in self.ends], (batch, self.pieces + 1))
        if self.interpolate == "hold":
            found = np.repeat(points[:, :1], len(at), axis=1)
            for index in range(1, self.pieces):
                passed = at >= ends[:, index, None] - SLACK * length
                found = np.where(passed, points[:, index, None], found)
            return found
        widths = np.maximum(np.diff(ends, axis=1), SLACK * length)
        share = np.clip((at - ends[:, :-1, None]) / widths[:, :, None], 0.0, 1.0)
        rises = np.diff(points, axis=1)[:, :, None]
        if self.interpolate == "linear":
            return np.asarray(points[:, :1] + (rises * share).sum(1))
        slopes = pchip_slopes(points, widths)
        left, right = (widths * slopes[:, :-1])[:, :, None], (widths * slopes[:, 1:])[:, :, None]
        rest = 1.0 - share
        parts = rises * share**2 * (3.0 - 2.0 * share) + share * rest * (left * rest - right * share)
        return np.asarray(points[:, :1] + parts.sum(1))


def pchip_slopes(points: Floats, widths: Floats) -> Floats:
    """Return the derivatives of a monotone piecewise cubic polynomial at its points.

    At an inner point, the derivative is a weighted harmonic mean of the mean slopes on both sides, or 0 where
    these have different signs (Fritsch and Butland 1984). At the ends, it is that of a parabola through three
    points, limited so that the polynomial is monotone (Moler 2004, section 3.4).

    Args:
        points: values at the points, (batch, n + 1).
        widths: lengths of the pieces, (batch, n).

    Returns:
        The derivatives, (batch, n + 1).
    """
    import numpy as np

    means = np.diff(points, axis=1) / widths
    if means.shape[1] == 1:
        return np.repeat(means, 2, axis=1)
    left, right, before, after = means[:, :-1], means[:, 1:], widths[:, :-1], widths[:, 1:]
    near, far = 2.0 * after + before, after + 2.0 * before
    below = np.maximum(near * np.abs(right) + far * np.abs(left), 1e-30)
    inner = np.sign(left) * 3.0 * (before + after) * np.maximum(left * right, 0.0) / below
    first = _end_slope(means[:, 0], means[:, 1], widths[:, 0], widths[:, 1])
    last = _end_slope(means[:, -1], means[:, -2], widths[:, -1], widths[:, -2])
    return np.concatenate((first[:, None], inner, last[:, None]), axis=1)


def _end_slope(mean: Floats, following: Floats, width: Floats, next_width: Floats) -> Floats:
    """Return the derivative at an end: (batch,) mean slopes and lengths of the outer piece and the next."""
    import numpy as np

    parabola = ((2.0 * width + next_width) * mean - width * following) / (width + next_width)
    limited = np.where(
        mean * following > 0.0, parabola, np.clip(parabola, *np.sort((0.0 * mean, 3.0 * mean), axis=0))
    )
    return np.asarray(np.where(parabola * mean > 0.0, limited, 0.0))


# ------------------------------------------------------------------------------ the section


@dataclass(repr=False, eq=False)
class InputKeys:
    """The keys that the declaration of one input signal may have."""

    unit: Unit = key(unit_text, "unit of the values", Unit())
    ends: Node | None = key(
        RANGE, "lower and upper end, between which values are drawn", name="range", required=True
    )
    pieces: int = key(integer(high=MAX_PIECES), "number of pieces", 1)
    interpolate: Interpolate = key(
        word(get_args(Interpolate)),
        "`hold`: constant pieces; `linear`, `pchip`: between values at their ends",
        "hold",
    )
    duration: Fraction | None = key(SECONDS, "length of all pieces together; the horizon unless given")
    times: str = key(word(("fixed", "free")), "`free`: the times between pieces are drawn, too", "fixed")


@dataclass(frozen=True, slots=True)
class Inputs:
    """The section `inputs`: the input signals, and the columns that they add to the system."""

    signals: tuple[InputDecl, ...] = ()
    sampled: Sampled = field(default_factory=Sampled)


def read_inputs(node: Node | None, cx: Context) -> Inputs:
    """Read the section `inputs`, and declare its signals and the numbers that determine them as names."""
    signals: list[InputDecl] = []
    sampled = Sampled()
    for entry in cx.reader.entries(node, "`inputs`"):
        if cx.names.declare(entry.key, "input signal", cx.reader):
            signal = _signal(entry, cx)
            if signal is not None:
                signals.append(signal)
                sampled += _sampled(signal, entry, cx)
    if node is not None and any(signal.moves for signal in signals):
        flows = any(signal.interpolate != "hold" for signal in signals)
        sampled = clock(cx, first_line(node.span), flows=flows) + sampled
    return Inputs(tuple(signals), sampled)


def _signal(entry: Entry, cx: Context) -> InputDecl | None:
    """Read the declaration of one input signal; None if its range is missing or invalid."""
    where = f"the input signal `{entry.key.text}`"
    keys = read(InputKeys, cx.plain, entry.value, where, OF)
    ranges = read_ranges(keys.ends, keys.unit, 1, where, cx.plain)
    if ranges is None:
        return None
    duration = keys.duration or cx.horizon * cx.dt or Fraction(1)
    return InputDecl(
        entry.key.text, keys.unit, *ranges[0], keys.pieces, keys.interpolate, duration, keys.times == "free"
    )


def _sampled(decl: InputDecl, entry: Entry, cx: Context) -> Sampled:
    """Declare the columns of an input signal: its present value, and the numbers that determine it.

    `entry` is its declaration in the file.
    """
    names, span = cx.names, entry.key.span
    present = Column(decl.name, decl.unit, "real", "env", decl.low, decl.high)
    names.columns.append(present)
    values, times = Column("", decl.unit, low=decl.low, high=decl.high), Column("", SECOND, low=0.0)
    times = replace(times, high=float(decl.duration))
    for column, group in ((values, decl.values), (times, decl.times)):
        for name in group:
            declared(cx, replace(column, name=name, role="env"), span)
        if group:
            names.places.setdefault(base_name(group[0]), span)
    name_columns(names, "input signal")
    value = _present(decl, cx.dt)
    if decl.interpolate != "hold" and not cx.discrete:
        known = column_value(present)
        names.entries[decl.name] = Known(
            replace(known, num=known.num.substitute({decl.name: value})), "input signal", span
        )
    shown = Assign(decl.name, value, decl.interpolate)
    return Sampled(_draws(decl), (shown,), (shown,) if decl.moves else (), (), decl.columns)


def _draws(decl: InputDecl) -> tuple[Assign, ...]:
    """Return the distributions of the numbers of an input signal, as `InputDecl.drawn` has them."""
    low, high = ir.Const(decl.low), ir.Const(decl.high)
    found = [
        Assign(name, ir.Op("uniform", (low, high)), f"uniform({decl.low:g}, {decl.high:g})")
        for name in decl.values
    ]
    length = ir.Const(float(decl.duration))
    rest: ir.Num = length
    for index, name in enumerate(decl.times):
        share = ir.Op("uniform", (ir.Const(0.0), ir.Const(1.0)))
        root = share.apply("pow", 1.0 / (len(decl.times) - index))
        found.append(Assign(name, length - rest * root, "sorted uniform times"))
        rest = length - ir.Signal(name)
    return tuple(found)


def _present(decl: InputDecl, dt: Fraction) -> ir.Num:
    """Return the value of an input signal now, as an expression of the clock and the signal's numbers."""
    points: list[ir.Num] = [ir.Signal(name) for name in decl.values]
    least = ir.Const(SLACK * float(decl.duration))
    times = [ir.Signal(name) for name in decl.times]
    now = ir.Signal(CLOCK) * float(dt)
    if decl.interpolate == "hold":
        if decl.free_times:
            passed = [_minus(now + least, time) for time in times]
        else:
            instants = (ir.Const(float(math.ceil(end / dt))) for end in decl.ends[1:-1])
            passed = [_minus(ir.Signal(CLOCK), instant) for instant in instants]
        return _piece(points, passed)
    ends: list[ir.Num] = [ir.Const(float(end)) for end in decl.ends]
    if decl.free_times:
        ends = [ir.Const(0.0), *times, ir.Const(float(decl.duration))]
    widths = [_largest(_minus(after, before), least) for before, after in pairwise(ends)]
    unit = (ir.Const(0.0), ir.Const(1.0))
    shares = [
        (_minus(now, before) / width).apply("clip", *unit)
        for before, width in zip(ends, widths, strict=False)
    ]
    rises = [_minus(after, before) for before, after in pairwise(points)]
    if decl.interpolate == "linear":
        parts: Sequence[ir.Num] = [rise * share for rise, share in zip(rises, shares, strict=True)]
    else:
        slopes = _slopes(rises, widths)
        parts = [
            _cubic(rise, share, width * left, width * right)
            for rise, share, width, (left, right) in zip(rises, shares, widths, pairwise(slopes), strict=True)
        ]
    return ir.Num.total([points[0], *parts])


def _piece(points: Sequence[ir.Num], passed: Sequence[ir.Num]) -> ir.Num:
    """Return the value of the present piece, by bisection.

    `passed` has one number for each piece but the first: negative before the piece begins, then 0 or more.
    """
    if not passed:
        return points[0]
    half = len(passed) // 2
    later, earlier = _piece(points[half + 1 :], passed[half + 1 :]), _piece(points[: half + 1], passed[:half])
    return ir.Predicate(passed[half]).select(later, earlier)


def _cubic(rise: ir.Num, share: ir.Num, left: ir.Num, right: ir.Num) -> ir.Num:
    """Return the increase of a cubic polynomial over the first `share` of its piece.

    `rise` is the increase over the whole piece; `left` and `right` are the derivatives at its ends, times its
    length.
    """
    rest = _minus(ir.Const(1.0), share)
    eased = share.apply("square") * _minus(ir.Const(3.0), 2.0 * share)
    bent = share * rest * _minus(left * rest, right * share)
    return rise * eased + bent


def _slopes(rises: Sequence[ir.Num], widths: Sequence[ir.Num]) -> list[ir.Num]:
    """Return the derivatives at the ends of the pieces, as `pchip_slopes` has them."""
    means = [rise / width for rise, width in zip(rises, widths, strict=True)]
    if len(means) == 1:
        return [means[0], means[0]]
    found = [_end(means[0], means[1], widths[0], widths[1])]
    for (left, right), (before, after) in zip(pairwise(means), pairwise(widths), strict=True):
        near = 2.0 * after + before
        far = after + 2.0 * before
        below = near * right.apply("abs") + far * left.apply("abs")
        above = (left * right).apply("relu") * (3.0 * (before + after))
        turned = left.apply("sign") * above
        found.append(turned / _largest(below, ir.Const(1e-30)))
    return [*found, _end(means[-1], means[-2], widths[-1], widths[-2])]


def _end(mean: ir.Num, following: ir.Num, width: ir.Num, next_width: ir.Num) -> ir.Num:
    """Return the derivative at an end, from mean slopes and lengths of the outer piece and the next."""
    both = 2.0 * width + next_width
    above = _minus(both * mean, width * following)
    parabola = above / (width + next_width)
    most = 3.0 * mean
    zero = ir.Const(0.0)
    bounded = parabola.apply("clip", zero.apply("min", most), zero.apply("max", most))
    same = ir.Predicate(mean * following, strict=True)
    ahead = ir.Predicate(parabola * mean, strict=True)
    return ahead.select(same.select(parabola, bounded), zero)


def _minus(left: ir.Num, right: ir.Num) -> ir.Num:
    if isinstance(left, ir.Const) and isinstance(right, ir.Const):
        return ir.Const(left.value - right.value)
    return left - right


def _largest(left: ir.Num, right: ir.Const) -> ir.Num:
    if isinstance(left, ir.Const):
        return ir.Const(max(left.value, right.value))
    return left.apply("max", right)
