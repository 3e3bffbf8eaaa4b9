"""Random numbers, formulas and traces for hypothesis."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import numpy as np
from hypothesis import strategies as st

from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.ir.discretize import Grid
from stlc.compile.pipeline import CompiledRequirement
from stlc.monitor.verdict import Monitor
from stlc.source import Source, Span

SPAN: Span = Source("random", "").span(0, 0)
NAMES = ("x", "y", "z")
GRID = Grid(Fraction(1, 10), 6)

_values = st.integers(-40, 40).map(lambda n: n / 8)
_columns = st.sampled_from(NAMES).map(ir.Signal)


def _op(name: str, *args: st.SearchStrategy[ir.Num]) -> st.SearchStrategy[ir.Num]:
    return st.tuples(*args).map(lambda parts: ir.Op(name, parts))


def state_formulas(numbers: st.SearchStrategy[ir.Num]) -> st.SearchStrategy[ir.Formula]:
    """Formulas of the IR without temporal operators."""
    atoms = st.builds(ir.Predicate, numbers, sign=st.sampled_from([1, -1]), strict=st.booleans())
    joins = st.builds(ir.BoolOp, st.sampled_from(["and", "or"]), st.tuples(atoms, atoms))
    return atoms | joins


def _grown(inner: st.SearchStrategy[ir.Num]) -> st.SearchStrategy[ir.Num]:
    binary = st.sampled_from(["add", "sub", "mul", "min", "max"])
    unary = st.sampled_from(["neg", "abs", "square", "relu", "sin", "tanh_free"]).map(
        lambda name: "atan" if name == "tanh_free" else name
    )
    return (
        st.builds(lambda name, a, b: ir.Op(name, (a, b)), binary, inner, inner)
        | st.builds(lambda name, a: ir.Op(name, (a,)), unary, inner)
        | _op("clip", inner, _values.map(ir.Const), st.integers(5, 9).map(lambda n: ir.Const(float(n))))
        | _op("mod", inner, st.sampled_from([ir.Const(2.0), ir.Const(0.75)]))
        | _op("div", inner, st.sampled_from([ir.Const(2.0), ir.Const(-0.5)]))
        | _op("pow", inner, st.sampled_from([ir.Const(2.0), ir.Const(3.0)]))
        | _op("norm", inner, inner)
        | _op("norm1", inner, inner)
        | _op("norminf", inner, inner)
        | st.builds(ir.Indicator, state_formulas(inner))
        | st.builds(ir.Where, state_formulas(inner), inner, inner)
    )


numbers: st.SearchStrategy[ir.Num] = st.recursive(_columns | _values.map(ir.Const), _grown, max_leaves=8)

_linear = st.builds(
    lambda a, b, c: ir.Op("sub", (ir.Op("add", (a, ir.Op("mul", (b, ir.Const(0.5))))), ir.Const(c))),
    _columns,
    _columns,
    _values,
)
_predicates = st.builds(
    typed.Predicate,
    st.just(SPAN),
    _columns | _linear,
    strict=st.booleans(),
    guard=st.sampled_from([False] * 7 + [True]),
)


_seen = (
    _columns
    | _columns
    | st.builds(
        ir.ShiftedSignal, st.sampled_from(NAMES), st.sampled_from([-2, -1, 1, 2]), clamped=st.booleans()
    )
)
"""A column, now or at another sample."""


def _looking(held: tuple[str, ...]) -> st.SearchStrategy[typed.Formula]:
    """Predicates about other samples and frozen values."""
    right = _seen | st.sampled_from(held).map(ir.FrozenVar) if held else _seen
    number = st.builds(
        lambda a, b, c: ir.Op("sub", (ir.Op("sub", (a, b)), ir.Const(c))), _seen, right, _values
    )
    return st.builds(typed.Predicate, st.just(SPAN), number, strict=st.booleans())


def _interval(*, bounded_only: bool) -> st.SearchStrategy[typed.Interval]:
    def build(lo: int, width: int | None, opened: tuple[bool, bool], unit: str) -> typed.Interval:
        lo_open, hi_open = opened
        if width is not None and width <= lo_open + hi_open:
            lo_open = hi_open = False
        if unit == "steps":
            make = lambda k: typed.Time(steps=Fraction(k))  # noqa: E731
        else:
            make = lambda k: typed.Time(seconds=Fraction(k, 10))  # noqa: E731
        hi = None if width is None else make(lo + width)
        return typed.Interval(make(lo), hi, lo_open, hi_open and hi is not None)

    widths = st.integers(0, 9)
    return st.builds(
        build,
        st.integers(0, 4),
        widths if bounded_only else st.none() | widths | widths,
        st.tuples(st.booleans(), st.booleans()),
        st.sampled_from(["steps", "seconds"]),
    )


_UNARY = ("always", "eventually", "once", "historically")
_BINARY = ("until", "release", "unless", "since")
_KINDS = ("unary", "unary", "unary", "binary", "binary", "many", "two", "not", "shift", "edge")


@st.composite
def formulas(
    draw: st.DrawFn,
    *,
    bounded_only: bool = False,
    truth: bool = True,
    depth: int | None = None,
    held: tuple[str, ...] | None = None,
) -> typed.Formula:
    """Typed formulas with every operator, bounds on the grid of `GRID`, up to three operators deep.

    With `held` (names that are frozen around) `freeze` is among them, and numbers read other samples.
    """
    if depth is None:
        depth = draw(st.sampled_from([0, 1, 1, 2, 2, 2, 3, 3]))
    if depth == 0:
        if truth and draw(st.integers(0, 9)) == 0:
            return typed.Truth(SPAN, draw(st.booleans()))
        return draw(_predicates if held is None else _looking(held))

    def part() -> typed.Formula:
        return draw(formulas(bounded_only=bounded_only, truth=truth, depth=depth - 1, held=held))

    def smaller() -> typed.Formula:
        inner = draw(st.integers(0, depth - 1))
        return draw(formulas(bounded_only=bounded_only, truth=truth, depth=inner, held=held))

    interval = _interval(bounded_only=bounded_only)
    match draw(st.sampled_from(_KINDS if held is None else (*_KINDS, "freeze", "freeze", "freeze"))):
        case "freeze":
            assert held is not None
            names = tuple(f"f#{len(held) + i}" for i in range(draw(st.integers(1, 2))))
            bindings = tuple((name, draw(_seen)) for name in names)
            inner = formulas(bounded_only=bounded_only, truth=truth, depth=depth - 1, held=(*held, *names))
            return typed.Freeze(SPAN, bindings, draw(inner))
        case "unary":
            return typed.Temporal(SPAN, draw(st.sampled_from(_UNARY)), draw(interval), part())
        case "binary":
            pair = (part(), smaller()) if draw(st.booleans()) else (smaller(), part())
            return typed.Until(SPAN, draw(st.sampled_from(_BINARY)), draw(interval), *pair)
        case "many":
            return typed.Logic(SPAN, draw(st.sampled_from(["and", "or"])), (part(), smaller(), smaller()))
        case "two":
            return typed.Logic(SPAN, draw(st.sampled_from(["->", "<->", "xor"])), (smaller(), part()))
        case "not":
            return typed.Not(SPAN, part())
        case "shift":
            return typed.Shift(SPAN, draw(st.sampled_from([-1, 1])), part())
        case _:
            return typed.Edge(SPAN, draw(st.sampled_from(["rise", "fall"])), part())


def traces(low: int = 1, high: int = 14, batch: int = 2) -> st.SearchStrategy[dict[str, np.ndarray]]:
    """Columns `(time, batch)` of numbers with many ties."""

    def build(samples: int, seed: int) -> dict[str, np.ndarray]:
        rng = np.random.default_rng(seed)
        return {name: rng.integers(-24, 24, size=(samples, batch)) / 8 for name in NAMES}

    return st.builds(build, st.integers(low, high), st.integers(0, 2**32 - 1))


def a_rule(formula: ir.Formula) -> CompiledRequirement:
    """A requirement that is judged once, or at every sample."""
    like = Monitor("signal x\nrequire r: x > 0\n", dt=0.1).compiled.requirements[0]
    return replace(
        like,
        formula=formula,
        lowered=formula,
        reach=formula.reach.future,
        windowed=False,
        uses_end=formula.uses_end,
        absolute=False,
    )
