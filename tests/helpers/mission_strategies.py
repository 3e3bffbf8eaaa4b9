"""Random mission formulas, traces to judge them on, and the auxiliary columns of a trace."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fractions import Fraction

import numpy as np
from helpers.formula_strategies import NAMES, SPAN
from hypothesis import strategies as st

from stlc.compile.augment.timers import Timer
from stlc.compile.backends.array.arith import ArrayProgram
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.ir.discretize import Grid
from stlc.compile.semantics.switch import Hard
from stlc.grammar.parser import parse_expr
from stlc.source import Source

GRID = Grid(Fraction(1, 10), 5)
SAMPLES = 36
"""Longer than any formula below looks."""

_predicates = st.builds(
    lambda name, level, strict: typed.Predicate(
        SPAN, ir.Op("sub", (ir.Signal(name), ir.Const(level))), strict=strict
    ),
    st.sampled_from(NAMES),
    st.sampled_from([-1.0, 0.0, 0.5, 1.0]),
    st.booleans(),
)


def _times(low: int, high: int) -> st.SearchStrategy[Fraction]:
    """Times on the grid, and now and then between two samples."""
    return st.integers(low, high).map(Fraction) | st.integers(2 * low, 2 * high).map(lambda n: Fraction(n, 2))


@st.composite
def _intervals(
    draw: st.DrawFn, *, latest: int, clock: str = "now", now: bool = False, endless: bool = False
) -> typed.Interval:
    """Intervals with at least one sample up to step `latest`; from now on, or maybe later."""
    lo = Fraction(0) if now else draw(_times(0, latest - 3))
    hi = None if endless else lo + draw(_times(2, 9) | st.just(Fraction(0)) if now else _times(2, 9))
    opened = st.sampled_from([False, False, True])
    make = (lambda k: typed.Time(steps=k)) if draw(st.booleans()) else (lambda k: typed.Time(seconds=k / 10))
    wide = hi is None or hi - lo >= 3
    return typed.Interval(
        make(lo),
        None if hi is None else make(hi),
        wide and not now and draw(opened),
        wide and hi is not None and draw(opened),
        clock,  # type: ignore[arg-type]
    )


def _boolean(items: st.SearchStrategy[typed.Formula]) -> st.SearchStrategy[typed.Formula]:
    several = st.lists(items, min_size=2, max_size=3).map(tuple)
    return (
        st.builds(typed.Not, st.just(SPAN), items)
        | st.builds(typed.Logic, st.just(SPAN), st.sampled_from(["and", "or"]), several)
        | st.builds(
            typed.Logic,
            st.just(SPAN),
            st.sampled_from(["->", "->", "<->", "xor"]),
            st.tuples(items, items),
        )
    )


def _back(bodies: st.SearchStrategy[typed.Formula]) -> st.SearchStrategy[typed.Formula]:
    """Operators of the past that end now."""
    spans = _intervals(latest=9, now=True) | _intervals(latest=9, now=True, endless=True)
    return (
        st.builds(typed.Temporal, st.just(SPAN), st.sampled_from(["once", "historically"]), spans, bodies)
        | st.builds(typed.Until, st.just(SPAN), st.just("since"), spans, bodies, bodies)
        | st.builds(typed.Edge, st.just(SPAN), st.sampled_from(["rise", "fall"]), bodies)
    )


bodies: st.SearchStrategy[typed.Formula] = st.recursive(
    _predicates, lambda inner: _boolean(inner) | _back(inner), max_leaves=3
)
"""Formulas of the present and the past."""


@st.composite
def _goals(draw: st.DrawFn) -> typed.Formula:
    """One absolute operator, or what stands beside one."""
    kind = draw(
        st.sampled_from(["unary", "unary", "unary", "binary", "binary", "beside", "endless", "state"])
    )
    on_clock = _intervals(latest=20, clock="start")
    match kind:
        case "unary":
            op = draw(st.sampled_from(["always", "eventually"]))
            return typed.Temporal(SPAN, op, draw(on_clock), draw(bodies))
        case "binary":
            op = draw(st.sampled_from(["until", "release", "unless"]))
            return typed.Until(SPAN, op, draw(on_clock), draw(bodies), draw(bodies))
        case "beside":
            op = draw(st.sampled_from(["always", "eventually"]))
            return typed.Temporal(SPAN, op, draw(_intervals(latest=20)), draw(bodies))
        case "endless":
            interval = draw(_intervals(latest=20, clock="start", endless=True))
            return typed.Temporal(SPAN, "always", interval, draw(bodies))
        case _:
            return draw(bodies)


@st.composite
def _lifted(draw: st.DrawFn) -> typed.Formula:
    """A temporal operator around something that does not depend on now."""
    ops = st.sampled_from(["always", "eventually"])
    on_clock = _intervals(latest=20, clock="start")
    body: typed.Formula = typed.Temporal(SPAN, draw(ops), draw(on_clock), draw(bodies))
    if draw(st.booleans()):
        body = typed.Logic(SPAN, draw(st.sampled_from(["and", "or", "->"])), (draw(bodies), body))
    return typed.Temporal(SPAN, draw(ops), draw(_intervals(latest=10)), body)


missions: st.SearchStrategy[typed.Formula] = st.recursive(
    _goals() | _goals() | _goals() | _lifted(), _boolean, max_leaves=3
)
"""Requirements that may hold absolute operators under any Boolean structure."""


@st.composite
def _ahead(draw: st.DrawFn, depth: int) -> typed.Formula:
    """Formulas that look ahead by windows with an end, and what stands beside them."""
    if depth == 0:
        return draw(_predicates | _predicates | bodies)
    part = lambda: draw(_ahead(draw(st.integers(0, depth - 1))))  # noqa: E731
    spans = _intervals(latest=3, now=True) | _intervals(latest=5)
    match draw(st.sampled_from(["unary", "unary", "unary", "binary", "logic", "logic", "next"])):
        case "unary":
            return typed.Temporal(SPAN, draw(st.sampled_from(["always", "eventually"])), draw(spans), part())
        case "binary":
            op = draw(st.sampled_from(["until", "release", "unless"]))
            return typed.Until(SPAN, op, draw(spans), part(), part())
        case "next":
            return typed.Shift(SPAN, 1, part())
        case _:
            return draw(_boolean(st.builds(part)))


@st.composite
def _over_the_future(draw: st.DrawFn) -> typed.Formula:
    """An absolute operator over formulas that look ahead."""
    inner = _ahead(draw(st.integers(1, 3)))
    interval = draw(_intervals(latest=8, clock=draw(st.sampled_from(["start", "start", "now"]))))
    if not draw(st.integers(0, 5)):
        interval = draw(_intervals(latest=8, clock="start", endless=True))
        return typed.Temporal(SPAN, "always", interval, draw(inner))
    if draw(st.integers(0, 3)):
        return typed.Temporal(SPAN, draw(st.sampled_from(["always", "eventually"])), interval, draw(inner))
    op = draw(st.sampled_from(["until", "release", "unless"]))
    return typed.Until(SPAN, op, interval, draw(inner), draw(inner))


nested: st.SearchStrategy[typed.Formula] = st.recursive(
    _over_the_future() | _over_the_future() | _goals(), _boolean, max_leaves=3
)
"""The same over formulas that look ahead."""


def requirement(formula: typed.Formula) -> typed.Requirement:
    """A requirement `r`."""
    written = parse_expr(Source("random", "true"))
    return typed.Requirement("r", "", frozenset(), 1.0, 1.0, "", "", formula, written, SPAN)


def walks(seed: int, batch: int, samples: int = SAMPLES) -> dict[str, np.ndarray]:
    """Columns `(time, batch)` that keep their value for some time, with many ties."""
    rng = np.random.default_rng(seed)
    out = {}
    for name in NAMES:
        fresh = rng.integers(-3, 5, size=(samples, batch)) / 2
        keep = rng.random((samples, batch)) < rng.choice([0.5, 0.8, 0.95], size=batch)
        keep[0] = False
        index = np.maximum.accumulate(np.where(keep, 0, np.arange(samples)[:, None]), axis=0)
        out[name] = np.take_along_axis(fresh, index, axis=0)
    return out


def augmented(timers: Sequence[Timer], columns: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The columns of a trace and those of the timers, computed along it."""
    samples, batch = next(iter(columns.values())).shape
    state = {timer.name: np.full(batch, timer.initial) for timer in timers}
    if not timers:
        return dict(columns)
    program = ArrayProgram({timer.name: timer.update for timer in timers})
    rows = [state]
    for k in range(samples - 1):
        env = {name: column[k] for name, column in columns.items()} | rows[-1]
        moved = program(env, NUMPY, Hard())
        rows.append({name: np.broadcast_to(value, (batch,)) for name, value in moved.items()})
    return dict(columns) | {name: np.stack([row[name] for row in rows]) for name in state}
