"""Section `inputs`: input signals that no policy chooses, such as a disturbance or a driver's pedal.

An input signal is a function of time that a few numbers determine: its values at the pieces of a time span
and, if the switching times are free, these times. The numbers are drawn once per trajectory.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING, Literal, TypeAlias

from stlc.units import Unit

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Floats: TypeAlias = NDArray[np.float64]

Interpolate: TypeAlias = Literal["hold", "linear", "pchip"]
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

    name: str
    unit: Unit
    low: float
    high: float
    pieces: int
    interpolate: Interpolate
    duration: Fraction
    free_times: bool

    @property
    def points(self) -> int:
        """Number of values."""
        return self.pieces if self.interpolate == "hold" else self.pieces + 1

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


def drawn_numbers(decl: InputDecl, uniforms: Floats) -> Floats:
    """Return the numbers of an input signal that uniform random numbers give, as initial states do.

    The values are evenly distributed over the range. The times are those of independent uniform times,
    sorted.

    Args:
        decl: the input signal.
        uniforms: numbers between 0 and 1, one per column of the signal, (batch, columns).

    Returns:
        The numbers in the order of `decl.columns`, (batch, columns), float64: values in the unit of the
        signal, then times in seconds.
    """
    import numpy as np

    found = np.array(uniforms, dtype=np.float64)
    found[:, : decl.points] = decl.low + (decl.high - decl.low) * found[:, : decl.points]
    rest = np.full(len(found), float(decl.duration))
    for index in range(len(decl.times)):
        column = decl.points + index
        rest = rest * found[:, column] ** (1.0 / (len(decl.times) - index))
        found[:, column] = float(decl.duration) - rest
    return found


def signal_values(decl: InputDecl, values: Floats, times: Floats) -> Floats:
    """Return an input signal at given times.

    A sample at a switching time belongs to the later piece. Before 0 the signal has its first value, after
    the duration its last one.

    Args:
        decl: the input signal.
        values: its numbers in the order of `decl.columns`, (batch, columns): values in the unit of the
            signal, then the free times in seconds, which must not decrease.
        times: times in seconds, (steps,).

    Returns:
        The signal in its unit, (batch, steps), float64.
    """
    import numpy as np

    numbers = np.asarray(values, dtype=np.float64)
    at = np.asarray(times, dtype=np.float64)
    points, batch = numbers[:, : decl.points], len(numbers)
    length = float(decl.duration)
    if decl.free_times:
        ends = np.zeros((batch, decl.pieces + 1))
        ends[:, 1:-1], ends[:, -1] = numbers[:, decl.points :], length
    else:
        ends = np.broadcast_to([float(end) for end in decl.ends], (batch, decl.pieces + 1))
    if decl.interpolate == "hold":
        found = np.repeat(points[:, :1], len(at), axis=1)
        for index in range(1, decl.pieces):
            passed = at >= ends[:, index, None] - SLACK * length
            found = np.where(passed, points[:, index, None], found)
        return found
    widths = np.maximum(np.diff(ends, axis=1), SLACK * length)
    share = np.clip((at - ends[:, :-1, None]) / widths[:, :, None], 0.0, 1.0)
    rises = np.diff(points, axis=1)[:, :, None]
    if decl.interpolate == "linear":
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
