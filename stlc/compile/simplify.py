"""Local laws on the IR. Each preserves exact robustness wherever both sides are defined.

`G[a,b] G[c,d] p` is `G[a+c, b+d] p` and so for `F`, `H` and `O`; windows of the present alone vanish; nested
`and`s become one, without repetitions; constants are folded, so that no infinity reaches a gradient.
"""

from __future__ import annotations

from dataclasses import replace
from typing import assert_never

from stlc.compile import ir
from stlc.compile.horizon import numbers
from stlc.compile.samples import held_by, thawed

_NOW = ir.Window(0, 0)


def simplify(formula: ir.Formula) -> ir.Formula:
    """An equivalent formula with fewer nodes; simplifying again changes nothing."""
    match formula:
        case ir.Truth() | ir.Atom():
            return formula
        case ir.Join(_, items):
            return _join(formula, [simplify(item) for item in items])
        case ir.Over():
            return _over(replace(formula, body=simplify(formula.body)))
        case ir.Past():
            return _past(replace(formula, body=simplify(formula.body)))
        case ir.Until() | ir.Since():
            return _binary(replace(formula, left=simplify(formula.left), right=simplify(formula.right)))
        case ir.Shift():
            body = simplify(formula.body)
            return body if formula.steps == 0 else replace(formula, body=body)
        case ir.Freeze():
            return _freeze(replace(formula, body=simplify(formula.body)))
        case ir.AtStart():
            body = simplify(formula.body)
            return body if isinstance(body, ir.Truth) else replace(formula, body=body)
        case _:
            assert_never(formula)


def _join(whole: ir.Join, items: list[ir.Formula]) -> ir.Formula:
    flat: dict[ir.Formula, None] = {}
    for item in items:
        parts = item.items if isinstance(item, ir.Join) and item.op == whole.op else (item,)
        flat.update(dict.fromkeys(parts))
    absorbing = whole.op == "or"
    kept = [item for item in flat if not isinstance(item, ir.Truth)]
    if any(isinstance(item, ir.Truth) and item.value is absorbing for item in flat):
        return ir.Truth(absorbing, whole.span)
    if not kept:
        return ir.Truth(not absorbing, whole.span)
    return kept[0] if len(kept) == 1 else replace(whole, items=tuple(kept))


def _over(node: ir.Over) -> ir.Formula:
    body, window = node.body, node.window
    if isinstance(body, ir.Truth) and (body.value is (node.op == "always") or window.lo == 0):
        return replace(body, span=node.span)
    if window == _NOW:
        return body
    if isinstance(body, ir.Over) and body.op == node.op:
        together = _sum(window, body.window)
        if together is not None:
            return replace(node, window=together, body=body.body)
    return node


def _past(node: ir.Past) -> ir.Formula:
    body, window = node.body, node.window
    if isinstance(body, ir.Truth) and (body.value is (node.op == "historically") or window.lo == 0):
        return replace(body, span=node.span)
    if window == _NOW:
        return body
    if isinstance(body, ir.Past) and body.op == node.op:
        together = _sum(window, body.window)
        if together is not None:
            return replace(node, window=together, body=body.body)
    return node


def _freeze(node: ir.Freeze) -> ir.Formula:
    """Without what nobody reads; a predicate of this very instant reads the number itself."""
    read = frozenset().union(*map(held_by, numbers(node.body)))
    kept = tuple((name, num) for name, num in node.bindings if name in read)
    if not kept:
        return node.body
    if not isinstance(node.body, ir.Atom):
        return replace(node, bindings=kept)
    return replace(node.body, num=thawed(node.body.num, dict(kept)))


def _sum(outer: ir.Window, inner: ir.Window) -> ir.Window | None:
    """The window of both, one after the other, if it asks for no less of the trace than they did."""
    if outer.hi is not None and inner.hi is not None:
        return ir.Window(outer.lo + inner.lo, outer.hi + inner.hi)
    if outer.hi is None and inner == ir.Window(0, None):
        return outer
    return None


def _binary(node: ir.Until | ir.Since) -> ir.Formula:
    """`true until q` is `eventually q`, and the like for the other three."""
    strong = node.op in ("until", "since")
    if not (isinstance(node.left, ir.Truth) and node.left.value is strong):
        return node
    if isinstance(node, ir.Until):
        return simplify(ir.Over("eventually" if strong else "always", node.window, node.right, node.span))
    return simplify(ir.Past("once" if strong else "historically", node.window, node.right, node.span))
