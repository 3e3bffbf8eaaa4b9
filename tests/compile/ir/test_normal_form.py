"""Conjuncts of a formula, also of those under `always`."""

from __future__ import annotations

from stlc.compile.ir import nodes as ir


def test_pieces_are_what_a_formula_is_the_conjunction_of() -> None:
    a, b, c = (ir.Predicate(ir.Signal(name)) for name in "abc")
    window = ir.Window(0, 3)
    whole = ir.BoolOp("and", (c, ir.Temporal("always", window, ir.BoolOp("and", (a, b)))))
    assert whole.pieces == [c, ir.Temporal("always", window, a), ir.Temporal("always", window, b)]
    either = ir.Temporal("eventually", window, ir.BoolOp("and", (a, b)))
    assert either.pieces == [either]
