"""Requirements as small trees: as text of stlc and of RTAMT, and their literal value on a recording.

The literal value is that of a plain reading: windows are cut to the recording, nothing is asked of the file.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Atom:
    """Comparison of a signal with a number.

    Attributes:
        signal: name of the signal.
        op: the sign.
        value: the number, in the unit of the recorded signal, as a literal reading compares it.
        text: the number as it is written in a specification, with its unit.
    """

    signal: str
    op: Literal["<", "<=", ">", ">="]
    value: float
    text: str


@dataclass(frozen=True, slots=True)
class Flag:
    """A signal that is true or false."""

    signal: str


@dataclass(frozen=True, slots=True)
class Joined:
    """Two formulas with a connective between them."""

    op: Literal["and", "or", "->"]
    left: Formula
    right: Formula


@dataclass(frozen=True, slots=True)
class Over:
    """Temporal operator with one operand; `window` is in seconds, None without an interval."""

    op: Literal["always", "eventually", "historically", "once"]
    window: tuple[float, float] | None
    body: Formula


@dataclass(frozen=True, slots=True)
class Until:
    """`left until right`, without an interval."""

    left: Formula
    right: Formula


Formula: TypeAlias = Atom | Flag | Joined | Over | Until


def written(formula: Formula) -> str:
    """Return a formula in the language of stlc."""
    match formula:
        case Atom(signal, op, _, text):
            return f"{signal} {op} {text}"
        case Flag(signal):
            return signal
        case Joined(op, left, right):
            return f"{_inner(left)} {op} {_inner(right)}"
        case Over(op, window, body):
            shown = "" if window is None else f"[{window[0]:g} s, {window[1]:g} s]"
            return f"{op}{shown} {_inner(body)}"
        case Until(left, right):
            return f"{_inner(left)} until {_inner(right)}"


def _inner(formula: Formula) -> str:
    text = written(formula)
    return text if isinstance(formula, Atom | Flag) else f"({text})"


def for_rtamt(formula: Formula) -> str:
    """Return a formula in the language of RTAMT; flags are compared with 1/2."""
    match formula:
        case Atom(signal, op, value):
            return f"({signal} {op} {_plain(value)})"
        case Flag(signal):
            return f"({signal} >= 0.5)"
        case Joined(op, left, right):
            return f"({for_rtamt(left)} {op} {for_rtamt(right)})"
        case Over(op, window, body):
            shown = "" if window is None else f"[{_plain(window[0])}:{_plain(window[1])}]"
            return f"({op}{shown} {for_rtamt(body)})"
        case Until(left, right):
            return f"({for_rtamt(left)} until {for_rtamt(right)})"


def _plain(value: float) -> str:
    return f"{value:.9f}" if value >= 0 else f"(0 - {-value:.9f})"


def signals_of(formula: Formula) -> frozenset[str]:
    """Return the names of the signals that a formula reads."""
    match formula:
        case Atom(signal) | Flag(signal):
            return frozenset({signal})
        case Joined(_, left, right) | Until(left, right):
            return signals_of(left) | signals_of(right)
        case Over(_, _, body):
            return signals_of(body)


def robustness(formula: Formula, data: Mapping[str, Floats], dt: float) -> Floats:
    """Return the robustness of a formula at every sample, (samples,); windows are cut to the recording."""
    match formula:
        case Atom(signal, op, value):
            return data[signal] - value if op[0] == ">" else value - data[signal]
        case Flag(signal):
            return data[signal] - 0.5
        case Joined(op, left, right):
            a, b = robustness(left, data, dt), robustness(right, data, dt)
            return np.minimum(a, b) if op == "and" else np.maximum(-a if op == "->" else a, b)
        case Over(op, window, body):
            return _over(op, window, robustness(body, data, dt), dt)
        case Until(left, right):
            a, b = robustness(left, data, dt), robustness(right, data, dt)
            found = np.empty_like(a)
            rest = -np.inf
            for k in range(len(a) - 1, -1, -1):
                rest = max(min(b[k], a[k]), min(a[k], rest))
                found[k] = rest
            return found


def _over(op: str, window: tuple[float, float] | None, inner: Floats, dt: float) -> Floats:
    samples = len(inner)
    lo, hi = (0, samples) if window is None else (round(end / dt) for end in window)
    least = op in ("always", "historically")
    pick: Any = np.min if least else np.max
    empty = np.inf if least else -np.inf
    found = np.full(samples, empty)
    for k in range(samples):
        start, stop = (k + lo, k + hi + 1) if op in ("always", "eventually") else (k - hi, k - lo + 1)
        part = inner[max(start, 0) : max(stop, 0)]
        if len(part):
            found[k] = pick(part)
    return found
