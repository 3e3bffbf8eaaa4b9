"""Local simplification laws on the IR; each preserves robustness wherever both sides are defined.

Under every semantics windows [0, 0] are removed, `G[a,a] G[c,d] p` is `G[a+c, a+d] p`, `true until q` is
`eventually q`, and constants are folded, so that gradients stay finite. Nested `and`s merge where the
semantics is associative, without repetitions where it is idempotent; where it is both,
`G[a,b] G[c,d] p` is `G[a+c, b+d] p`, and likewise for `F`, `H` and `O`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

from stlc.compile.ir import nodes as ir
from stlc.compile.ir.normal_form import joined
from stlc.compile.ir.traverse import frozen_in, map_children, numbers, operands, substitute_frozen
from stlc.compile.semantics.semantics import Exact, Semantics

_EXACT = Exact()
_NOW = ir.Window(0, 0)


def simplify(formula: ir.Formula, semantics: Semantics = _EXACT) -> ir.Formula:
    """Return an equivalent formula with fewer nodes; the result is a fixed point.

    Args:
        formula: in negation normal form.
        semantics: whose robustness is preserved; the exact one allows all laws.
    """
    whole = map_children(formula, formulas=lambda part: simplify(part, semantics))
    law = _LAWS.get(type(whole))
    return whole if law is None else law(whole, semantics)


def _join(whole: ir.BoolOp, semantics: Semantics) -> ir.Formula:
    """Merge nested operators, and remove repetitions and constants."""
    flat: list[ir.Formula] = []
    for item in whole.items:
        same = isinstance(item, ir.BoolOp) and item.op == whole.op and semantics.associative
        flat += operands(item) if same else (item,)
    if semantics.idempotent:
        flat = list(dict.fromkeys(flat))
    return joined(whole.op, flat, ir.Truth(whole.op == "and", whole.span))


def _window(node: ir.Temporal | ir.PastTemporal, semantics: Semantics) -> ir.Formula:
    """Remove windows over constants and windows [0, 0]; merge nested windows of one operator."""
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
    """Drop unused bindings; substitute the number in predicates at the instant of the `freeze`."""
    read = frozenset().union(*map(frozen_in, numbers(node.body)))
    kept = tuple((name, num) for name, num in node.bindings if name in read)
    if not kept:
        return node.body
    if not isinstance(node.body, ir.Predicate):
        return replace(node, bindings=kept)
    return replace(node.body, num=substitute_frozen(node.body.num, dict(kept)))


def _sum(outer: ir.Window, inner: ir.Window, semantics: Semantics) -> ir.Window | None:
    """Return the sum of two nested windows, if it requires the same samples; else None.

    Two wide windows count samples repeatedly, so they need an idempotent and associative semantics.
    """
    lattice = semantics.associative and semantics.idempotent
    if outer.hi is not None and inner.hi is not None:
        single = outer.lo == outer.hi or inner.lo == inner.hi
        return ir.Window(outer.lo + inner.lo, outer.hi + inner.hi) if lattice or single else None
    if outer.hi is None and inner == ir.Window(0, None) and lattice:
        return outer
    return None


def _binary(node: ir.Until | ir.Since, semantics: Semantics) -> ir.Formula:
    """Simplify `true until q` to `eventually q`, and likewise `release`, `since` and `trigger`."""
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
"""Node class -> law, for nodes with simplified operands."""
