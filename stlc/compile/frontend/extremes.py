"""Extremes (`max`, `min`) over a window in a comparison, written as temporal operators.

A comparison with the greatest value holds if it holds with every value where the value stands on its smaller
side, and with some value where it stands on its greater side:

    max[-a, 0](x) - y < c    is    freeze y0 = y in historically[0, a] (x - y0 < c)

The robustness is the same, since minimum and maximum commute with a margin that is monotone in the value.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import NoReturn, TypeAlias

from stlc.compile.frontend import intervals
from stlc.compile.frontend.scope import Scope
from stlc.compile.frontend.values import Number, Value
from stlc.diagnostics import Diagnostic
from stlc.grammar import ast
from stlc.grammar.printer import show_expr
from stlc.source import Span


def misplaced(expr: ast.Extreme, scope: Scope) -> NoReturn:
    """Raise Failed (E016): an extreme over a window is not in a comparison that can be rewritten."""
    scope.fail(_refused(expr, "is compared with `<`, `<=`, `>` or `>=`"))


def _refused(expr: ast.Extreme, need: str) -> Diagnostic:
    always, some = ("always", "eventually") if expr.op == "max" else ("eventually", "always")
    window = show_expr(expr.interval.lo), show_expr(expr.interval.hi)
    help_ = (
        f"such as `{expr.span.text} < c`, in sums and with constant factors, once in a comparison",
        f"or write `{always}[{window[0]}, {window[1]}] {expr.body.span.text} < c`; `{some}` for `>`",
    )
    return Diagnostic("E016", f"`{expr.op}` over a window {need}", expr.span, help=help_)


Evaluator: TypeAlias = Callable[[ast.Expr, Scope], Value]


def without_extremes(expr: ast.Compare, scope: Scope, evaluate: Evaluator) -> ast.Expr:
    """Return a comparison with an extreme over a window as an equivalent formula without it.

    `evaluate` gives the values of factors and of bounds.

    Raises:
        Failed: the comparison is not monotone in the extreme, or has several (E016).
    """
    found: ast.Expr | None = None
    for left, op, right in zip(expr.operands, expr.ops, expr.operands[1:], strict=False):
        span = expr.span if len(expr.ops) == 1 else left.span.to(right.span)
        part: ast.Expr = ast.Compare(span, (left, right), (op,))
        extremes = [node for node in part.walk() if isinstance(node, ast.Extreme)]
        if len(extremes) > 1:
            scope.fail(_refused(extremes[1], "stands once in a comparison"))
        if extremes:
            part = _Rewriting(extremes[0], scope, evaluate).comparison(left, op, right, span)
        found = part if found is None else ast.Logic(expr.span, "and", found, part)
    assert found is not None
    return found


@dataclass(frozen=True, slots=True)
class _Rewriting:
    """Rewriting of one comparison with one extreme.

    Attributes:
        extreme: the extreme over a window.
        scope: names of the comparison.
        evaluate: evaluation of an expression.
        bindings: (name, expression) of what stands beside the extreme, and is frozen.
    """

    extreme: ast.Extreme
    scope: Scope
    evaluate: Evaluator
    bindings: list[tuple[str, ast.Expr]] = field(default_factory=list)

    def comparison(self, left: ast.Expr, op: ast.Comparison, right: ast.Expr, span: Span) -> ast.Expr:
        """Return the comparison `left op right` without the extreme."""
        if not self.scope.temporal or op not in ("<", "<=", ">", ">="):
            misplaced(self.extreme, self.scope)
        inside = self.within(left)
        grows, one = self.opened(left if inside else right)
        other = self.held(right if inside else left)
        small = (op in ("<", "<=")) == inside  # the side with the extreme is the smaller one
        universal = (self.extreme.op == "max") == (small == grows)
        body = ast.Compare(span, (one, other) if inside else (other, one), (op,))
        return ast.Freeze(span, tuple(self.bindings), self.over(body, universal=universal))

    def within(self, expr: ast.Expr) -> bool:
        """True if an expression contains the extreme."""
        return any(node is self.extreme for node in expr.walk())

    def held(self, expr: ast.Expr) -> ast.Expr:
        """Return the name under which the value of an expression is frozen."""
        name = f"{len(self.bindings)} beside {self.extreme.span.start}"
        self.bindings.append((name, expr))
        return ast.Name(expr.span, name, quoted=True)

    def opened(self, expr: ast.Expr) -> tuple[bool, ast.Expr]:
        """Return whether an expression grows with the extreme in it, and the expression for one instant.

        What stands beside the extreme is frozen.

        Raises:
            Failed: the expression may be not monotone (E016).
        """
        match expr:
            case ast.Extreme():
                return True, expr.body
            case ast.Neg(operand=operand):
                grows, inner = self.opened(operand)
                return not grows, replace(expr, operand=inner)
            case ast.Binary(op="+" | "-" | "*" | "/" as op, left=left, right=right):
                first = self.within(left)
                beside = right if first else left
                if op in "*/":
                    factor = self.evaluate(beside, self.scope)
                    if (op == "/" and not first) or not isinstance(factor, Number) or not factor.constant:
                        misplaced(self.extreme, self.scope)
                    grows = factor.constant > 0
                else:
                    grows = first or op == "+"
                inner_grows, inner = self.opened(left if first else right)
                held = self.held(beside)
                sides = (inner, held) if first else (held, inner)
                return grows == inner_grows, replace(expr, left=sides[0], right=sides[1])
            case _:
                misplaced(self.extreme, self.scope)

    def over(self, body: ast.Expr, *, universal: bool) -> ast.Expr:
        """Return `body` at every (`universal`) or some sample of the window, whose bounds may be negative."""
        interval, quiet = self.extreme.interval, replace(self.scope, sink=[])
        low, high = (
            intervals.moment(end, self.evaluate(end, quiet), quiet) for end in (interval.lo, interval.hi)
        )
        ahead = high.end or intervals.sign(high) > 0
        if intervals.sign(low) >= 0:
            return ast.Temporal(body.span, "always" if universal else "eventually", interval, body)
        zero = ast.Quantity(interval.span, Fraction(0), "")
        near = zero if ahead else ast.Neg(interval.hi.span, interval.hi)
        recent = replace(interval, lo=near, hi=ast.Neg(interval.lo.span, interval.lo))
        before = ast.Temporal(body.span, "historically" if universal else "once", recent, body)
        if not ahead:
            return before
        after = ast.Temporal(
            body.span, "always" if universal else "eventually", replace(interval, lo=zero), body
        )
        return ast.Logic(body.span, "and" if universal else "or", before, after)
