"""Every operator as C equals the array evaluators, forwards and backwards."""

from __future__ import annotations

import re

import numpy as np
import pytest
from helpers.emitted import (
    STEPS,
    assert_every_kind,
    follower,
    gradients_agree,
    kernel_of,
    planned_formulas,
    traces_of,
    values_agree,
)
from helpers.formula_strategies import NAMES

from stlc import native
from stlc.compile.backends.array.graph import evaluate
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.backends.c.emit import emit
from stlc.compile.backends.c.plan import plan_of
from stlc.compile.ir import nodes as ir

pytestmark = pytest.mark.skipif(native.compiler() is None, reason="there is no C compiler here")

LAST = STEPS
X, Y, Z = (ir.Predicate(ir.Signal(name)) for name in NAMES)


@pytest.fixture(autouse=True)
def _quickly(monkeypatch: pytest.MonkeyPatch) -> None:
    """Many formulas in one text: the compiler is to spend little on it."""
    monkeypatch.setattr(native, "FLAGS", (*native.FLAGS, "-O0"))


def test_random_formulas_equal_the_evaluator() -> None:
    rules = planned_formulas(90)
    assert_every_kind(rules)
    values_agree(rules, np.round(traces_of(1, 60) * 8) / 8)


def test_random_formulas_have_the_gradient_of_torch() -> None:
    gradients_agree(planned_formulas(50), traces_of(2, 40), 3)


@pytest.mark.slow
def test_thousands_of_random_formulas() -> None:
    rules = planned_formulas(3000)
    assert len(rules) > 2000
    for seed, first in enumerate(range(0, len(rules), 50)):
        some = rules[first : first + 50]
        values_agree(some, np.round(traces_of(seed, 60) * 8) / 8)
        gradients_agree(some, traces_of(seed, 40), seed)


WINDOWS = [ir.Window(*ends) for ends in ((0, None), (2, None), (0, 5), (3, 7), (9, 12), (0, 0))]


def _every_window() -> list[ir.Formula]:
    """Every temporal operator over every kind of window, judged at one sample and at many."""
    found: list[ir.Formula] = []
    for window in WINDOWS:
        wide = 0 if window.hi is None else window.hi
        around = ir.Window(0, LAST - max(wide, window.lo))
        back = ir.Window(0, LAST)
        for op in ("always", "eventually"):
            inner = ir.Temporal(op, window, X)
            found += [inner, ir.Temporal("always" if op == "eventually" else "eventually", around, inner)]
        for op in ("until", "release"):
            inner = ir.Until(op, window, X, Y)
            found += [inner, ir.Temporal("always", around, inner)]
        for op in ("once", "historically"):
            inner = ir.PastTemporal(op, window, X)
            found += [inner, ir.Temporal("always" if op == "once" else "eventually", back, inner)]
        for op in ("since", "trigger"):
            inner = ir.Since(op, window, X, Y)
            found += [
                inner,
                ir.Temporal("eventually", back, inner),
                ir.Temporal("always", ir.Window(4, 11), inner),
            ]
    return found


def test_every_operator_over_every_window() -> None:
    values_agree(_every_window(), traces_of(4, 40))
    gradients_agree(_every_window(), traces_of(5, 40), 6)


def _gap(name: str, held: str, most: float) -> ir.Predicate:
    """`abs(name - held) <= most`."""
    gap = ir.Op("abs", (ir.Op("sub", (ir.Signal(name), ir.FrozenVar(held))),))
    return ir.Predicate(ir.Op("sub", (ir.Const(most), gap)))


def _frozen() -> list[ir.Formula]:
    """`freeze` under and over windows, inside of itself, over the past and on the mission clock."""
    near = ir.Temporal("always", ir.Window(0, 3), _gap("x", "a", 1.0))
    to_end = ir.Temporal("eventually", ir.Window(1, None), ir.BoolOp("or", (_gap("y", "a", 0.5), Z)))
    before = ir.PastTemporal("once", ir.Window(1, 4), _gap("x", "a", 2.0))
    since = ir.Since("since", ir.Window(0, None), _gap("z", "a", 3.0), Y)
    start = ir.AtStart(ir.Temporal("always", ir.Window(0, 2), _gap("x", "a", 1.5)))
    edge = ir.BoolOp("and", (_gap("x", "a", 2.5), ir.Shift(-1, _gap("y", "a", 1.0), False)))
    both = ir.Op("sub", (ir.Op("sub", (ir.Signal("x"), ir.FrozenVar("b"))), ir.FrozenVar("a")))
    nested = ir.Freeze(
        (("b", ir.Op("mul", (ir.FrozenVar("a"), ir.Signal("z")))),),
        ir.Temporal("always", ir.Window(0, 2), ir.Predicate(both)),
    )
    apart = ir.BoolOp("and", (ir.Temporal("eventually", ir.Window(0, 2), Y), _gap("x", "a", 2.0)))
    found: list[ir.Formula] = []
    for body in (near, to_end, before, since, start, edge, nested, apart, Y):
        node = ir.Freeze((("a", ir.Signal("x")),), body)
        found += [
            node,
            ir.Temporal("always", ir.Window(0, 9), node),
            ir.Temporal("eventually", ir.Window(2, 9), node),
        ]
    ahead = ir.Freeze(
        (("a", ir.ShiftedSignal("x", 2)), ("c", ir.ShiftedSignal("y", -3, clamped=True))), _gap("x", "a", 1.0)
    )
    return [*found, ir.Temporal("always", ir.Window(0, 12), ahead)]


def test_frozen_values() -> None:
    values_agree(_frozen(), traces_of(7, 40))
    gradients_agree(_frozen(), traces_of(8, 40), 9)


def test_shifts_and_the_start() -> None:
    late = ir.Shift(3, ir.Until("until", ir.Window(1, 4), X, Y))
    rules = [late, ir.Temporal("always", ir.Window(2, 7), late), ir.AtStart(late)]
    for outside in (True, False):
        for steps in (-1, -20, 2, 20):
            edge = ir.BoolOp("or", (X, ir.Shift(steps, Y, outside)))
            rules += [edge, ir.Temporal("always", ir.Window(0, LAST), edge)]
    rules += [
        ir.Temporal("eventually", ir.Window(3, 9), ir.AtStart(ir.Temporal("always", ir.Window(0, 4), Z)))
    ]
    values_agree(rules, traces_of(10, 40))
    gradients_agree(rules, traces_of(11, 40), 12)


def test_what_no_loop_changes_is_computed_outside_of_it() -> None:
    shared = ir.Temporal("eventually", ir.Window(0, 2), Y)
    node = ir.Freeze((("a", ir.Signal("x")),), ir.BoolOp("and", (shared, _gap("x", "a", 1.0))))
    plan = plan_of([ir.Temporal("always", ir.Window(0, 9), node)], LAST + 1)
    found = [type(step.node).__name__ for step in plan.schedule.steps]
    assert found == ["Predicate", "Temporal", "Frozen", "Temporal"]


def test_windows_to_the_end_are_one_pass() -> None:
    """Quadratic loops over a long plan would take seconds."""
    steps = 3000
    rule = ir.Temporal("always", ir.Window(0, None), ir.Temporal("eventually", ir.Window(0, None), X))
    since = ir.Temporal("always", ir.Window(0, None), ir.Since("since", ir.Window(0, None), X, Y))
    rng = np.random.default_rng(1)
    trace = rng.normal(size=(steps + 1, 8, 3))
    kernel = kernel_of(follower(steps), [rule, since])
    found, _ = kernel.judge(trace[0].copy(), trace[1:].transpose(1, 0, 2).copy())
    env = {name: trace[:, :, i].copy() for i, name in enumerate(NAMES)}
    np.testing.assert_allclose(found.T, np.concatenate(evaluate([rule, since], env, ops=NUMPY)))


def test_extrema_of_many_operands_stand_side_by_side() -> None:
    """A macro that doubles its operand, within itself 40 times, would be a text without end."""
    columns = [ir.Op("sub", (ir.Signal(NAMES[i % 3]), ir.Const(i / 8))) for i in range(40)]
    nums = [ir.Op("min", tuple(columns)), ir.Op("max", tuple(columns)), ir.Op("norminf", tuple(columns))]
    parts = [
        ir.Temporal("always", ir.Window(0, i % 9), ir.Predicate(column)) for i, column in enumerate(columns)
    ]
    rules = [*map(ir.Predicate, nums), ir.BoolOp("and", tuple(parts)), ir.BoolOp("or", tuple(parts))]
    assert max(map(_depth, emit(follower(), rules).splitlines())) <= 3
    values_agree(rules, traces_of(13, 40))
    gradients_agree(rules, traces_of(14, 40), 15)


def _depth(line: str) -> int:
    """Depth of macros that repeat their operands, nested in each other."""
    deepest, around = 0, []
    for name in re.findall(r"(\w*\()|(\))", line):
        if name[0]:
            around.append(name[0] in ("MIN(", "MAX(", "LEAST(", "MOST("))
        elif around:
            around.pop()
        deepest = max(deepest, sum(around))
    return deepest
