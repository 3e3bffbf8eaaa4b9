"""The laws that formulas are rewritten by, each against the definition, under every semantics.

Of each law both sides are judged by `reference`, at every sample, with windows cut and with both bounds over
all continuations: they are equal under the semantics where the law is said to hold. What the compiler makes
of the left side has that value under every semantics, so a law is applied only where it holds.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, Literal

import numpy as np
from helpers.formula_strategies import GRID, SPAN, formulas
from helpers.reference import EXTREMA, Interval, Robustness, Trace
from hypothesis import strategies as st

from stlc.compile.augment.lift import hoist_absolute
from stlc.compile.backends.array.graph import robustness_signal
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.ir.simplify import simplify
from stlc.compile.semantics.semantics import (
    ArithmeticGeometricMean,
    Exact,
    GeneralizedMean,
    LogSumExp,
    Semantics,
)

SEMANTICS: Mapping[str, Semantics] = {
    "exact": Exact(),
    "smooth": LogSumExp(2.0),
    "agm": ArithmeticGeometricMean(),
    "dgmsr": GeneralizedMean(0.1),
}
ALL = frozenset(SEMANTICS)
ASSOCIATIVE = frozenset(name for name, semantics in SEMANTICS.items() if semantics.associative)
IDEMPOTENT = frozenset(name for name, semantics in SEMANTICS.items() if semantics.idempotent)
LATTICE = frozenset({"exact"})
"""Minima and maxima that distribute over each other."""

ENDS: tuple[Literal["strict", "truncate", "open"], ...] = ("strict", "truncate", "open")
Formula = typed.Formula
Draw = Callable[[st.SearchStrategy[Any]], Any]


@dataclass(frozen=True)
class Law:
    """Two sides, drawn together, and the semantics under which they are one.

    Attributes:
        sides: draws both.
        holds: names of semantics.
        folds: the right side may have a value where the left one has none.
    """

    sides: Callable[[Draw], tuple[Formula, Formula]]
    holds: frozenset[str] = ALL
    folds: bool = False


small = formulas(depth=1)
part = formulas(truth=False, depth=1) | formulas(truth=False, depth=0)


def steps(lo: int, hi: int | None) -> typed.Interval:
    return typed.Interval(
        typed.Time(steps=Fraction(lo)), None if hi is None else typed.Time(steps=Fraction(hi))
    )


def windowed(op: str, window: typed.Interval, body: Formula) -> Formula:
    return typed.Temporal(SPAN, op, window, body)  # type: ignore[arg-type]


def logic(op: str, *items: Formula) -> Formula:
    return typed.Logic(SPAN, op, items)  # type: ignore[arg-type]


def negated(body: Formula) -> Formula:
    return typed.Not(SPAN, body)


def met(op: str, window: typed.Interval, left: Formula, right: Formula) -> Formula:
    return typed.Until(SPAN, op, window, left, right)  # type: ignore[arg-type]


def truth(value: bool) -> Formula:
    return typed.Truth(SPAN, value)


UNARY = st.sampled_from(["always", "eventually", "historically", "once"])
BOTH = st.sampled_from(["and", "or"])
DUAL = {"and": "or", "or": "and", "always": "eventually", "eventually": "always", "historically": "once",
        "once": "historically", "until": "release", "release": "until"}  # fmt: skip
few = st.integers(0, 3)


def interval(draw: Draw) -> typed.Interval:
    lo = draw(few)
    return steps(lo, lo + draw(few))


# ------------------------------------------------------------------------ the laws


def present_window(draw: Draw) -> tuple[Formula, Formula]:
    body = draw(part)
    return windowed(draw(UNARY), steps(0, 0), body), body


def single_windows(draw: Draw) -> tuple[Formula, Formula]:
    """A body that is such a window itself leaves two equal forms, by which two come together first."""
    op = draw(UNARY)
    body = draw(part.filter(lambda each: not (isinstance(each, typed.Temporal) and each.op == op)))
    a, (c, d) = draw(few), sorted((draw(few), draw(few)))
    outer, inner = (steps(a, a), steps(c, d)) if draw(st.booleans()) else (steps(c, d), steps(a, a))
    return windowed(op, outer, windowed(op, inner, body)), windowed(op, steps(a + c, a + d), body)


def windows_of_windows(draw: Draw) -> tuple[Formula, Formula]:
    op, body, (a, b), (c, d) = draw(UNARY), draw(part), (draw(few), draw(few)), (draw(few), draw(few))
    inner = windowed(op, steps(c, c + d), body)
    return windowed(op, steps(a, a + b), inner), windowed(op, steps(a + c, a + b + c + d), body)


def windows_to_the_end(draw: Draw) -> tuple[Formula, Formula]:
    op, body, lo = draw(UNARY), draw(part), draw(few)
    return windowed(op, steps(lo, None), windowed(op, steps(0, None), body)), windowed(
        op, steps(lo, None), body
    )


def nested_junctions(draw: Draw) -> tuple[Formula, Formula]:
    op, p, q, r = draw(BOTH), draw(part), draw(part), draw(part)
    return logic(op, logic(op, p, q), r), logic(op, p, q, r)


def repeated_operand(draw: Draw) -> tuple[Formula, Formula]:
    op, p, q = draw(BOTH), draw(part), draw(part)
    return logic(op, p, q, p), logic(op, p, q)


def neutral_constant(draw: Draw) -> tuple[Formula, Formula]:
    op, p = draw(BOTH), draw(part)
    return logic(op, p, truth(op == "and")), p


def deciding_constant(draw: Draw) -> tuple[Formula, Formula]:
    op, p = draw(BOTH), draw(part)
    return logic(op, p, truth(op == "or")), truth(op == "or")


def windowed_constant(draw: Draw) -> tuple[Formula, Formula]:
    """`always true`, and a constant of which the window has at least the present."""
    op, value, now = draw(UNARY), draw(st.booleans()), draw(st.booleans())
    if not now:
        value = op in ("always", "historically")
    lo = 0 if now else draw(few)
    return windowed(op, steps(lo, lo + draw(few)), truth(value)), truth(value)


def met_from_the_start(draw: Draw) -> tuple[Formula, Formula]:
    """`true until q`, `false release q`, `true since q`."""
    op, window, q = draw(st.sampled_from(["until", "release", "since"])), interval(draw), draw(part)
    alone = {"until": "eventually", "release": "always", "since": "once"}[op]
    return met(op, window, truth(op != "release"), q), windowed(alone, window, q)


def double_negation(draw: Draw) -> tuple[Formula, Formula]:
    p = draw(part)
    return negated(negated(p)), p


def junctions_negated(draw: Draw) -> tuple[Formula, Formula]:
    op, p, q = draw(BOTH), draw(part), draw(part)
    return negated(logic(op, p, q)), logic(DUAL[op], negated(p), negated(q))


def windows_negated(draw: Draw) -> tuple[Formula, Formula]:
    op, window, p = draw(UNARY), interval(draw), draw(part)
    return negated(windowed(op, window, p)), windowed(DUAL[op], window, negated(p))


def meetings_negated(draw: Draw) -> tuple[Formula, Formula]:
    op, window, p, q = draw(st.sampled_from(["until", "release"])), interval(draw), draw(part), draw(part)
    return negated(met(op, window, p, q)), met(DUAL[op], window, negated(p), negated(q))


def implication(draw: Draw) -> tuple[Formula, Formula]:
    p, q = draw(part), draw(part)
    return logic("->", p, q), logic("or", negated(p), q)


def equivalence(draw: Draw) -> tuple[Formula, Formula]:
    p, q = draw(part), draw(part)
    return logic("<->", p, q), logic("and", logic("or", negated(p), q), logic("or", p, negated(q)))


def exclusion(draw: Draw) -> tuple[Formula, Formula]:
    """Formula `if p then not q else q`."""
    p, q = draw(part), draw(part)
    return logic("xor", p, q), logic("or", logic("and", p, negated(q)), logic("and", negated(p), q))


def weak_until(draw: Draw) -> tuple[Formula, Formula]:
    lo, width, p, q = draw(few), draw(few), draw(part), draw(part)
    held, reached = windowed("always", steps(0, lo + width), p), met("until", steps(lo, lo + width), p, q)
    return met("unless", steps(lo, lo + width), p, q), logic("or", held, reached)


def no_step(draw: Draw) -> tuple[Formula, Formula]:
    p = draw(part)
    return typed.Shift(SPAN, 0, p), p


def unread_binding(draw: Draw) -> tuple[Formula, Formula]:
    p = draw(part)
    return typed.Freeze(SPAN, (("unread", ir.Signal("x")),), p), p


def frozen_now(draw: Draw) -> tuple[Formula, Formula]:
    """A predicate of the instant at which its values are kept."""
    name, column = draw(st.sampled_from("xyz")), ir.Signal(draw(st.sampled_from("xyz")))
    gap = lambda kept: typed.Predicate(SPAN, ir.Op("sub", (column, kept)), strict=True)  # noqa: E731
    return typed.Freeze(SPAN, (("kept", ir.Signal(name)),), gap(ir.FrozenVar("kept"))), gap(ir.Signal(name))


LAWS = {
    law.__name__: Law(law, *rest)
    for law, *rest in (
        (present_window,),
        (single_windows,),
        (windows_of_windows, LATTICE),
        (windows_to_the_end, LATTICE),
        (nested_junctions, ASSOCIATIVE),
        (repeated_operand, IDEMPOTENT),
        (neutral_constant,),
        (deciding_constant, ALL, True),
        (windowed_constant, ALL, True),
        (met_from_the_start,),
        (double_negation,),
        (junctions_negated,),
        (windows_negated,),
        (meetings_negated,),
        (implication,),
        (equivalence,),
        (exclusion,),
        (weak_until,),
        (no_step,),
        (unread_binding,),
        (frozen_now,),
    )
}


def check_law(law: Law, draw: Draw, env: dict[str, Any], *, flip: bool) -> None:
    """`flip`: the negations of both sides."""
    left, right = law.sides(draw)
    if flip:
        left, right = negated(left), negated(right)
    for name, semantics in SEMANTICS.items():
        if name in law.holds:
            same_by_definition(left, right, env, name, folds=law.folds)
            assert simplify(GRID.lower(left, []), semantics) == simplify(GRID.lower(right, []), semantics)
        compiled_as_defined(left, env, name)


# ------------------------------------------------------------------ the mission clock


class OnTheClock(Robustness):
    """The definitions, with absolute operators judged at the start of the mission wherever they stand."""

    def at(self, node: Formula, t: int, positive: bool = True) -> Interval | None:
        return super().at(node, 0 if node.on_clock else t, positive)


@st.composite
def absolutes(draw: st.DrawFn) -> Formula:
    clock = typed.Interval(
        typed.Time(steps=Fraction(draw(few))), typed.Time(steps=Fraction(4)), clock="start"
    )
    op = draw(st.sampled_from(["always", "eventually", "until", "release"]))
    if op in ("until", "release"):
        return met(op, clock, draw(part), draw(part))
    return windowed(op, clock, draw(part))


def check_moved(draw: Draw, env: dict[str, Any]) -> None:
    """`always[a, b] (q or always@ p)` is `always[a, b] q or always@ p`: minima distribute over maxima."""
    ops = st.sampled_from(["always", "eventually"])
    beside = logic(draw(BOTH), draw(part), draw(absolutes()))
    whole = windowed(draw(ops), interval(draw), beside if draw(st.booleans()) else draw(absolutes()))
    moved = hoist_absolute(whole, sink := [])
    assert not sink
    # a window behind the end of a trace is empty where it is cut, whatever is constant in it
    for end in ("open",) if len(env["x"]) < 7 else ENDS:
        one, other = (defined(side, env, "exact", end, OnTheClock)[0] for side in (whole, moved))
        assert one == other or (end == "strict" and None in (one, other))


def check_clock(draw: Draw, env: dict[str, Any]) -> None:
    """At the first sample the mission clock is the time from now."""
    mission = logic(draw(BOTH), draw(absolutes()), negated(draw(absolutes())))
    for name in ALL:
        for end in ENDS:
            one = defined(mission, env, name, end, OnTheClock)[0]
            assert one == defined(mission.from_first_sample(), env, name, end)[0]


# -------------------------------------------------------------------- whole formulas


def check_compiled(formula: Formula, env: Mapping[str, np.ndarray]) -> None:
    """Law: a compiled formula has the robustness of the written one under every semantics."""
    for name in ALL:
        compiled_as_defined(formula, env, name)


def defined(
    formula: Formula,
    env: Mapping[str, np.ndarray],
    name: str,
    end: Literal["strict", "truncate", "open"],
    judge: type[Robustness] = Robustness,
) -> list[Interval | None]:
    """The definition at every sample of the one trace."""
    trace = Trace({column: values[:, 0] for column, values in env.items()}, GRID, end)
    found = judge(trace, EXTREMA[name])
    return [found.at(formula, t) for t in range(trace.samples)]


def same_by_definition(
    left: Formula, right: Formula, env: Mapping[str, np.ndarray], name: str, *, folds: bool
) -> None:
    for end in ENDS:
        one, other = (_numbers(defined(side, env, name, end)) for side in (left, right))
        known = ~np.isnan(one) if folds and end == "strict" else slice(None)
        if folds and end == "open":
            assert (one[0] <= other[0]).all()
            assert (other[1] <= one[1]).all()
            continue
        np.testing.assert_allclose(one[known], other[known], atol=1e-9, err_msg=f"{name}, {end}")


def compiled_as_defined(formula: Formula, env: Mapping[str, np.ndarray], name: str) -> None:
    """Windows cut, strict, and both bounds; where a constant decides the compiler may know more."""
    semantics = SEMANTICS[name]
    node = simplify(GRID.lower(formula, []), semantics)
    judged = {
        end: robustness_signal(node, env, ops=NUMPY, semantics=semantics, end=end)[:, 0]  # type: ignore[arg-type]
        for end in ("truncate", "strict", "lower", "upper")
    }
    tight = {"atol": 1e-7, "rtol": 1e-7}
    np.testing.assert_allclose(
        judged["truncate"], _numbers(defined(formula, env, name, "truncate"))[0], **tight
    )
    strict = _numbers(defined(formula, env, name, "strict"))[0]
    known = ~np.isnan(strict)
    np.testing.assert_allclose(judged["strict"][known], strict[known], **tight)
    if not semantics.bounded:
        return  # what is put at infinity does not bound a mean: the monitor tells the sign alone
    low, high = _numbers(defined(formula, env, name, "open"))
    assert (low <= judged["lower"] + 1e-7).all()
    assert (judged["upper"] <= high + 1e-7).all()
    if not _has_constant(formula):
        np.testing.assert_allclose(judged["lower"], low, **tight)
        np.testing.assert_allclose(judged["upper"], high, **tight)


def _has_constant(formula: Formula) -> bool:
    return "Truth(" in repr(formula)


def _numbers(values: list[Interval | None]) -> np.ndarray:
    """Both ends, NaN where there is no value: (2, samples)."""
    return np.array([(np.nan, np.nan) if value is None else value for value in values]).T
