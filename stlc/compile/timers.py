"""Absolute intervals: on the mission clock instead of from now on.

For training, the paper's rewriting: `always@[a, b] p` with a state formula p becomes a timer state `clock`
and `always[0, T] (a <= clock <= b -> p)`, so that a plan knows how late it is. On a recorded trace a
requirement with an absolute interval is judged once, at the first sample, where the mission clock and the
time from now agree.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import assert_never

from stlc.compile import ir, typed
from stlc.compile.bounds import report, to_window
from stlc.compile.interface import Grid
from stlc.diagnostics import Diagnostic
from stlc.signature import Column
from stlc.source import Span

CLOCK = "clock"


@dataclass(frozen=True, slots=True)
class Timer:
    """A state that the compiler adds: it grows by `rate` every step until `saturation`.

    Attributes:
        name: of its column.
        saturation: where it stops, in steps; beyond it no formula tells instants apart.
        rate: what one step adds; a clock counts steps, so that no rounding enters.
    """

    name: str
    saturation: int
    rate: int = 1

    @property
    def column(self) -> Column:
        """The column that it adds to a state."""
        return Column(self.name, kind="int", role="timer", low=0.0, high=float(self.saturation), fact=True)


def absolute(formula: typed.Formula) -> bool:
    """Whether an interval of `formula` is on the mission clock."""
    return any(_on_clock(node) for node in _nodes(formula))


def _on_clock(node: typed.Formula) -> bool:
    return isinstance(node, (typed.Temporal, typed.Until)) and node.interval.clock == "start"


def augment(
    formula: typed.Formula, grid: Grid, sink: list[Diagnostic]
) -> tuple[typed.Formula, tuple[Timer, ...]]:
    """The formula of a requirement for training, and the timers that it needs.

    Findings go to `sink`: E310 for a body that looks into the future, E307 and E015 for absolute intervals
    that have no rewriting yet.
    """
    if not absolute(formula):
        return formula, ()
    match formula:
        case typed.Temporal(span, "always", interval, body) if not absolute(body):
            if not _is_state_formula(body):
                report(sink, _looks_ahead(body.span))
                return typed.Truth(span, True), ()
            return _clocked(formula, interval, grid, sink)
        case _:
            report(sink, _without_rewriting(formula))
            return typed.Truth(formula.span, True), ()


def _clocked(
    node: typed.Temporal, interval: typed.Interval, grid: Grid, sink: list[Diagnostic]
) -> tuple[typed.Formula, tuple[Timer, ...]]:
    """`always[0, T] (a <= clock <= b -> body)`, with the test of the clock as a guard."""
    window = to_window(interval, grid, sink, outward=True)
    span, clock = node.span, ir.Col(CLOCK)
    tests: list[typed.Formula] = [_at_least(clock, ir.Lit(float(window.lo)), span)]
    if window.hi is not None:
        tests.append(_at_least(ir.Lit(float(window.hi)), clock, span))
    inside = tests[0] if len(tests) == 1 else typed.Logic(span, "and", tuple(tests))
    horizon = typed.Interval(typed.Time(), typed.Time(horizons=Fraction(1), span=interval.span))
    body = typed.Logic(span, "->", (inside, node.body))
    latest = window.lo if window.hi is None else window.hi
    timer = Timer(CLOCK, saturation=latest + (grid.horizon or 0) + 1)
    return typed.Temporal(span, "always", horizon, body), (timer,)


def _at_least(left: ir.Num, right: ir.Num, span: Span) -> typed.Pred:
    return typed.Pred(span, ir.Op("sub", (left, right)), strict=False, guard=True)


def merged(timers: Iterable[Timer]) -> tuple[Timer, ...]:
    """One timer for each name, with the latest saturation."""
    latest: dict[str, Timer] = {}
    for timer in timers:
        known = latest.get(timer.name, timer)
        latest[timer.name] = replace(timer, saturation=max(timer.saturation, known.saturation))
    return tuple(latest.values())


def recorded(formula: typed.Formula, sink: list[Diagnostic]) -> typed.Formula:
    """The formula of a requirement for a recorded trace that is judged at its first sample alone.

    There the mission clock and the time from now agree. An absolute interval under another temporal operator
    is asked for at other instants too: E307.
    """
    for node in _nodes(formula):
        if isinstance(node, (typed.Temporal, typed.Until)):
            for inner in _operands(node):
                for part in _nodes(inner):
                    if _on_clock(part):
                        report(sink, _nested(part.span, node.span))
    return _from_now(formula)


def _from_now(formula: typed.Formula) -> typed.Formula:
    match formula:
        case typed.Truth() | typed.Pred():
            return formula
        case typed.Not() | typed.Shift() | typed.Edge():
            return replace(formula, body=_from_now(formula.body))
        case typed.Logic():
            return replace(formula, items=tuple(map(_from_now, formula.items)))
        case typed.Temporal():
            interval = replace(formula.interval, clock="now")
            return replace(formula, interval=interval, body=_from_now(formula.body))
        case typed.Until():
            interval = replace(formula.interval, clock="now")
            left, right = _from_now(formula.left), _from_now(formula.right)
            return replace(formula, interval=interval, left=left, right=right)
        case _:
            assert_never(formula)


def _operands(formula: typed.Formula) -> tuple[typed.Formula, ...]:
    match formula:
        case typed.Truth() | typed.Pred():
            return ()
        case typed.Logic(_, _, items):
            return items
        case typed.Until(_, _, _, left, right):
            return (left, right)
        case typed.Not() | typed.Shift() | typed.Edge() | typed.Temporal():
            return (formula.body,)
        case _:
            assert_never(formula)


def _nodes(formula: typed.Formula) -> Iterator[typed.Formula]:
    yield formula
    for part in _operands(formula):
        yield from _nodes(part)


def _is_state_formula(formula: typed.Formula) -> bool:
    state = (typed.Truth, typed.Pred, typed.Not, typed.Logic)
    return all(isinstance(node, state) for node in _nodes(formula))


def _looks_ahead(span: Span) -> Diagnostic:
    return Diagnostic(
        "E310",
        "the body of an absolute operator looks at more than the present",
        span,
        help=("use a formula without temporal operators here; `stlc check` judges this one as it is",),
    )


def _nested(span: Span, outer: Span) -> Diagnostic:
    return Diagnostic(
        "E307",
        "an absolute interval under another temporal operator",
        span,
        help=("its truth does not depend on now: move it out of the operator around it",),
    ).with_note(f"the operator around it starts at line {outer.line}, column {outer.column}")


def _without_rewriting(formula: typed.Formula) -> Diagnostic:
    place = next(node for node in _nodes(formula) if _on_clock(node))
    return Diagnostic(
        "E015",
        "this absolute interval cannot be compiled for training yet",
        place.span,
        help=("`always@[a, b] p` with a state formula p, as a requirement of its own, can",),
        note=("`stlc check` judges all absolute intervals on recorded traces",),
    )


def mentions_horizon(formula: typed.Formula) -> bool:
    """Whether a bound of `formula` is written with `T`."""
    temporal = (node for node in _nodes(formula) if isinstance(node, (typed.Temporal, typed.Until)))
    return any(_with_horizon(node.interval.lo) or _with_horizon(node.interval.hi) for node in temporal)


def _with_horizon(time: typed.Time | None) -> bool:
    return time is not None and time.horizons != 0
