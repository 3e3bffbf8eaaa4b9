"""Moving absolute operators (`always@[a, b]`) out of the operators around them.

The interval of an absolute operator counts from the start of the mission. The truth of the operator is
therefore the same at every instant: `always[0, T] (q -> always@[a, b] p)` is
`eventually[0, T] q -> always@[a, b] p`. Where an absolute operator cannot be moved out, training reports
E307. On recorded traces, absolute operators are evaluated where they stand.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from stlc.compile.ir import typed
from stlc.diagnostics import Diagnostic, tell


def hoist_absolute(formula: typed.Formula, sink: list[Diagnostic]) -> typed.Formula:
    """Move absolute operators (`always@[a, b]`) out of other temporal operators.

    The formula is in negation normal form. If an operator cannot be moved out, E307 is appended to `sink`.
    """
    if not formula.absolute:
        return formula
    match formula:
        case typed.Logic(_, "and" | "or"):
            return formula.map_children(formulas=lambda item: hoist_absolute(item, sink))
        case typed.Temporal(_, _, interval, body) if body.absolute:
            # a past window without the present sample may be empty; the body then makes no difference
            has_now = interval.lo == typed.Time() and not interval.lo_open
            if formula.op not in ("always", "eventually") and not has_now:
                return _stuck(formula, sink)
            return _out_of(formula, hoist_absolute(body, sink), sink)
        case typed.Temporal() | typed.Until() if not any(each.absolute for each in formula.operands):
            return formula
        case _:
            return _stuck(formula, sink)


def _out_of(node: typed.Temporal, body: typed.Formula, sink: list[Diagnostic]) -> typed.Formula:
    """Move the constant parts of `body` out of `node`, and return the result.

    A part is constant if its truth is the same at every instant, as for `always@[a, b] p`. The result is
    `node` applied to the other parts, joined to the constant parts by the `and` or `or` of `body`. If an
    absolute operator (`always@[a, b]`) cannot be moved out, E307 is reported, and the result is the formula
    `true`.
    """
    if _constant(body):
        return body
    if isinstance(body, typed.Logic) and body.op in ("and", "or"):
        fixed = [item for item in body.items if _constant(item)]
        moving = [item for item in body.items if not _constant(item)]
        if fixed and not any(each.absolute for each in moving):
            rest = moving[0] if len(moving) == 1 else replace(body, items=tuple(moving))
            op: Literal["and", "or"] = body.op
            return typed.Logic(node.span, op, (*fixed, replace(node, body=rest)))
    return _stuck(replace(node, body=body), sink)


def _constant(formula: typed.Formula) -> bool:
    """True if the truth of `formula` is the same at every instant."""
    match formula:
        case typed.Truth():
            return True
        case typed.Logic(_, _, items):
            return all(map(_constant, items))
        case typed.Not(_, body):
            return _constant(body)
        case _:
            return formula.on_clock


def _stuck(outer: typed.Formula, sink: list[Diagnostic]) -> typed.Formula:
    """Report the error E307 for the first absolute operator (`always@[a, b]`) below `outer`.

    The result is the formula `true`, a placeholder.
    """
    inner = next(node for node in outer.walk() if node.on_clock and node is not outer)
    finding = Diagnostic(
        "E307",
        "an absolute interval under another temporal operator",
        inner.span,
        help=("its truth does not depend on now: move it out of the operator around it",),
    )
    place = f"line {outer.span.line}, column {outer.span.column}"
    tell(sink, finding.with_note(f"the operator around it starts at {place}"))
    return typed.Truth(outer.span, True)
