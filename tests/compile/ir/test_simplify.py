"""Single laws; that robustness stays the same is a property in test_graph."""

from __future__ import annotations

import pytest

from stlc.compile.ir import nodes as ir
from stlc.compile.ir.simplify import simplify

P, Q, R = (ir.Predicate(ir.Signal(name)) for name in "pqr")
TRUE, FALSE = ir.Truth(True), ir.Truth(False)


def g(lo: int, hi: int | None, body: ir.Formula) -> ir.Temporal:
    return ir.Temporal("always", ir.Window(lo, hi), body)


def f(lo: int, hi: int | None, body: ir.Formula) -> ir.Temporal:
    return ir.Temporal("eventually", ir.Window(lo, hi), body)


def h(lo: int, hi: int | None, body: ir.Formula) -> ir.PastTemporal:
    return ir.PastTemporal("historically", ir.Window(lo, hi), body)


def both(*items: ir.Formula) -> ir.BoolOp:
    return ir.BoolOp("and", items)


def either(*items: ir.Formula) -> ir.BoolOp:
    return ir.BoolOp("or", items)


@pytest.mark.parametrize(
    ("formula", "slim"),
    [
        (g(1, 2, g(3, 5, P)), g(4, 7, P)),
        (g(1, 2, f(3, 5, P)), g(1, 2, f(3, 5, P))),
        (f(1, None, f(0, None, P)), f(1, None, P)),
        (g(1, None, g(0, 3, P)), g(1, None, g(0, 3, P))),
        (h(1, 2, h(0, 4, P)), h(1, 6, P)),
        (g(0, 0, P), P),
        (h(0, 0, P), P),
        (ir.Shift(0, P), P),
        (both(P, both(Q, R)), both(P, Q, R)),
        (both(P, either(Q, R)), both(P, either(Q, R))),
        (both(P, P, Q), both(P, Q)),
        (both(P, P), P),
        (both(P, TRUE), P),
        (both(P, FALSE), FALSE),
        (either(P, TRUE), TRUE),
        (either(FALSE, FALSE), FALSE),
        (g(2, 3, TRUE), TRUE),
        (f(0, 3, TRUE), TRUE),
        (f(2, 3, TRUE), f(2, 3, TRUE)),
        (ir.Until("until", ir.Window(1, 2), TRUE, P), f(1, 2, P)),
        (ir.Until("release", ir.Window(1, 2), FALSE, P), g(1, 2, P)),
        (ir.Since("trigger", ir.Window(0, 2), FALSE, P), h(0, 2, P)),
        (ir.Until("until", ir.Window(1, 2), Q, P), ir.Until("until", ir.Window(1, 2), Q, P)),
        (g(0, 2, both(g(0, 0, P), either(FALSE, Q))), g(0, 2, both(P, Q))),
    ],
)
def test_laws(formula: ir.Formula, slim: ir.Formula) -> None:
    assert simplify(formula) == slim
