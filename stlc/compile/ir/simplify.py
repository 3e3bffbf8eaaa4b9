"""Local simplification laws on the IR; each preserves robustness wherever both sides are defined.

In the following, `G` stands for `always`; the laws hold in the same form for `eventually`, `historically` and
`once`.

Some laws hold under every semantics: windows [0, 0] are removed, `G[a,a] G[c,d] p` becomes `G[a+c, a+d] p`,
`true until q` becomes `eventually q`, and constants are folded, so that gradients stay finite. If the
semantics is associative, nested `and`s and nested `or`s are merged. If the semantics is idempotent, repeated
items are removed. If the semantics is both, `G[a,b] G[c,d] p` becomes `G[a+c, b+d] p`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

from stlc.compile.ir import nodes as ir
from stlc.compile.semantics.semantics import Exact, Semantics

_EXACT = Exact()
_NOW = ir.Window(0, 0)


def simplify(formula: ir.Formula, semantics: Semantics = _EXACT) -> ir.Formula:
    """Return an equivalent formula with fewer nodes; simplifying the result again changes nothing.

    Args:
        formula: formula in negation normal form.
        semantics: semantics under which the robustness is preserved; the exact semantics allows all laws.
    """
    whole = formula.map_children(formulas=lambda part: simplify(part, semantics))
    law = _LAWS.get(type(whole))
    return whole if law is None else law(whole, semantics)


def _join(whole: ir.BoolOp, semantics: Semantics) -> ir.Formula:
    """Merge nested `and`s or `or`s, and remove repeated items and constants, as the semantics allows."""
    flat: list[ir.Formula] = []
    for item in whole.items:
        same = isinstance(item, ir.BoolOp) and item.op == whole.op and semantics.associative
        flat += item.operands if same else (item,)
    if semantics.idempotent:
        flat = list(dict.fromkeys(flat))
    return ir.BoolOp.joined(whole.op, flat, whole.span)


def _window(node: ir.Temporal | ir.PastTemporal, semantics: Semantics) -> ir.Formula:
    """Remove an operator with the window [0, 0] or a constant operand; merge two nested equal operators."""
    body, window = node.body, node.window
    every = node.op == node.names[0]
    if isinstance(body, ir.Truth) and (body.value is every or window.lo == 0):
        return replace(body, span=node.span)
    if window == _NOW:
        return body
    if isinstance(body, (ir.Temporal, ir.PastTemporal)) and body.op == node.op:
        together = _sum(window, body.window, semantics)
        if together is not None:
            return replace(node, window=together, body=body.body)
    return node


def _shift(node: ir.Shift, _semantics: Semantics) -> ir.Formula:
    return node.body if node.steps == 0 else node


def _at_start(node: ir.AtStart, _semantics: Semantics) -> ir.Formula:
    return node.body if isinstance(node.body, ir.Truth) else node


def _freeze(node: ir.Freeze, _semantics: Semantics) -> ir.Formula:
    """Drop unused bindings of a `freeze`; if its body is a predicate, insert the bound numbers there."""
    read = frozenset().union(*(each.frozen for each in node.body.numbers()))
    kept = tuple((name, num) for name, num in node.bindings if name in read)
    if not kept:
        return node.body
    if not isinstance(node.body, ir.Predicate):
        return replace(node, bindings=kept)
    return replace(node.body, num=node.body.num.substitute_frozen(dict(kept)))


def _sum(outer: ir.Window, inner: ir.Window, semantics: Semantics) -> ir.Window | None:
    """Return the window that replaces two nested windows of one operator; None if they cannot be merged.

    If both windows have several samples, some samples are read repeatedly. Merging these windows needs a
    semantics that is idempotent and associative.
    """
    lattice = semantics.associative and semantics.idempotent
    if outer.hi is not None and inner.hi is not None:
        single = outer.lo == outer.hi or inner.lo == inner.hi
        return ir.Window(outer.lo + inner.lo, outer.hi + inner.hi) if lattice or single else None
    if outer.hi is None and inner == ir.Window(0, None) and lattice:
        return outer
    return None


def _binary(node: ir.Until | ir.Since, semantics: Semantics) -> ir.Formula:
    """Simplify `true until q` to `eventually q`, and `release`, `since` and `trigger` accordingly."""
    strong = node.op in ("until", "since")
    if not (isinstance(node.left, ir.Truth) and node.left.value is strong):
        return node
    kind: Any = ir.PastTemporal if node.back else ir.Temporal
    return simplify(kind(kind.names[strong], node.window, node.right, node.span), semantics)


_LAWS: Mapping[type, Callable[[Any, Semantics], ir.Formula]] = MappingProxyType(
    {
        ir.BoolOp: _join,
        **dict.fromkeys((ir.Temporal, ir.PastTemporal), _window),
        **dict.fromkeys((ir.Until, ir.Since), _binary),
        ir.Shift: _shift,
        ir.Freeze: _freeze,
        ir.AtStart: _at_start,
    }
)
"""Node class -> law that simplifies a node whose operands are simplified already."""
