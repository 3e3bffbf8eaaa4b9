"""Evaluation of expressions to values: the only recursion over the syntax tree.

The other modules of the front end work on values. This one resolves names, expands macros, unrolls
quantifiers, and reports all independent errors. The arguments of a macro are evaluated before it is expanded,
so names in them cannot clash with names in the macro.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cache, lru_cache, partial
from types import MappingProxyType
from typing import Any, TypeVar, cast

from stlc.compile.frontend import comparisons
from stlc.compile.frontend import intervals as moments
from stlc.compile.frontend.arithmetic import agree, broadcast, negate, refuse_point, too_large
from stlc.compile.frontend.builtins import builtin, outside, unsupported
from stlc.compile.frontend.coerce import Expectation, as_formula, as_number, as_state_formula, loose_number
from stlc.compile.frontend.extremes import misplaced, without_extremes
from stlc.compile.frontend.macros import arguments, cycle, finished, too_big
from stlc.compile.frontend.scope import Cost, Definition, External, Failed, Scope, reserved
from stlc.compile.frontend.values import (
    Number,
    Operand,
    Origin,
    Swept,
    TimeExpr,
    Value,
    VectorValue,
    at,
    is_formula,
    literal,
)
from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.ir.functions import OPERATORS as ARITHMETIC
from stlc.diagnostics import Diagnostic
from stlc.grammar import ast
from stlc.grammar.parser import parse_expr
from stlc.grammar.words import OPERATORS
from stlc.signature import Kind
from stlc.source import Source, Span
from stlc.units import Unit, nearest


def member_of(expr: ast.Attr, scope: Scope) -> tuple[ast.Name, Scope]:
    """Return `name` of an expression `m.name`, and the scope of the imported file that declares it.

    Raises:
        Failed: `m` is not an imported file (E101).
    """
    if not scope.in_spec:
        scope.fail(unsupported(f"`{expr.span.text}`", expr.span, scope))
    place = expr.span.source.span(expr.span.end - len(expr.name), expr.span.end)
    return ast.Name(place, expr.name, quoted=True), _module(expr.base, scope)


def _module(expr: ast.Expr, scope: Scope) -> Scope:
    match expr:
        case ast.Name(_, name) if name in scope.modules:
            return scope.modules[name]
        case ast.Attr(_, base, name):
            outer = _module(base, scope)
            if name in outer.modules:
                return outer.modules[name]
    missing = Diagnostic("E101", f"`{expr.span.text}` is not an imported file", expr.span)
    advice = 'import "file.stl" as m, or import std'
    return scope.fail(missing.near(expr.span.text, scope.modules, advice))


def choose(expr: ast.IfThenElse, values: Sequence[Value], scope: Scope) -> Value:
    """Return the value of `if ... then ... else ...` between formulas, numbers or vectors.

    If both branches are bools, the result can be used as a number and as a formula.

    Args:
        expr: the expression.
        values: values of the condition and of both branches.
        scope: receives findings.

    Raises:
        Failed: the condition is not a formula (E201), it selects between numbers and depends on several
            instants (E202), or the branches have different units (E203) or types (E205).
    """
    decides, yes, no = values
    cond = as_formula(decides, expr.cond, Expectation("`if`"), scope)
    if isinstance(yes, typed.Formula) or isinstance(no, typed.Formula):
        return _choice_of_formulas(expr, cond, (yes, no), scope)
    if _is_bool(yes) and _is_bool(no) and not cond.is_state():
        return _choice_of_formulas(expr, cond, (yes, no), scope)
    if not (isinstance(yes, VectorValue) and isinstance(no, VectorValue)):
        return _choose(expr, cond, (yes, no), scope)
    if len(yes.items) != len(no.items):
        message = f"vectors of {len(yes.items)} and {len(no.items)} components do not go together"
        scope.fail(Diagnostic("E205", message, expr.span))
    pairs = zip(yes.items, no.items, strict=True)
    return VectorValue(tuple(_choose(expr, cond, pair, scope) for pair in pairs), span=expr.span)


def _is_bool(value: Value) -> bool:
    return isinstance(value, Number) and value.kind == "bool"


def _choice_of_formulas(
    expr: ast.IfThenElse, cond: typed.Formula, branches: tuple[Value, Value], scope: Scope
) -> typed.Formula:
    """Return the formula `if cond then yes else no`; `branches` are `yes` and `no`."""
    yes = as_formula(branches[0], expr.yes, Expectation("`then`"), scope)
    no = as_formula(branches[1], expr.no, Expectation("`else`"), scope)
    return typed.Logic(expr.span, "if", (cond, yes, no))


def _choose(expr: ast.IfThenElse, cond: typed.Formula, branches: tuple[Value, Value], scope: Scope) -> Number:
    """Return the number `if cond then yes else no`; `branches` are the values of `yes` and `no`.

    If both branches are bools, the number can also be used as a formula, `Number.formula`.
    """
    decides = as_state_formula(cond, expr.cond, Expectation("`if`"), scope)
    need = Expectation("the branches of `if` are of one sort", "this")
    yes = loose_number(branches[0], expr.yes, need, scope)
    no = loose_number(branches[1], expr.no, need, scope)
    (yes, no), blank = agree((yes, no), "choose between", expr.span, scope)
    if decides.constant is not None:
        return yes if decides.constant else no
    formula = _choice_of_formulas(expr, cond, branches, scope) if _is_bool(yes) and _is_bool(no) else None
    same = yes.kind == no.kind and yes.labels == no.labels
    kind: Kind = yes.kind if same else "real"
    labels = yes.labels if same else ()
    num = decides.select(yes.num, no.num)
    return replace(blank, num=num, kind=kind, labels=labels, formula=formula)


T = TypeVar("T")
_VERBS = {"+": "adds", "-": "subtracts", "*": "multiplies", "/": "divides", "%": "divides", "^": "raises"}


@dataclass(frozen=True, slots=True)
class Operation:
    """Evaluation rule of a class of syntax nodes.

    Attributes:
        parts: function that returns the operands of a node in order.
        value: function that computes the value of a node. Its arguments are the node, the values of the
            operands, and the scope.
    """

    parts: Callable[[Any], Sequence[ast.Expr]]
    value: Callable[[Any, Sequence[Value], Scope], Value]


def _quantity(expr: ast.Quantity, _values: Sequence[Value], scope: Scope) -> Value:
    if not expr.unit:
        return literal(expr.value, expr.span)
    if expr.unit in ("step", "steps"):
        if not scope.in_spec:
            scope.fail(unsupported("a number of steps", expr.span, scope))
        return TimeExpr(steps=expr.value, span=expr.span)
    try:
        number = _measured(expr.value, expr.unit)
    except ValueError as error:
        scope.fail(Diagnostic("E203", str(error), expr.span))
    if number is None:
        scope.fail(too_large(expr.span))
    return replace(number, span=expr.span)


@lru_cache(maxsize=256)
def _measured(value: Fraction, unit_text: str) -> Number | None:
    """Return `value` with the unit `unit_text`; None if the number exceeds the range of double precision.

    Raises:
        ValueError: the unit is unknown.
    """
    unit = Unit.parse(unit_text)
    exact = value * unit.ratio
    if not math.isfinite(nearest(exact)):
        return None
    return replace(literal(exact), unit=unit, flexible=False, bare=False, kind="real")


def _vector(expr: ast.Vector, values: Sequence[Value], scope: Scope) -> Value:
    need = Expectation("a vector holds numbers", "this component")
    pairs = zip(values, expr.items, strict=True)
    return VectorValue(tuple(as_number(value, item, need, scope) for value, item in pairs), span=expr.span)


def _index(expr: ast.Index, values: Sequence[Value], scope: Scope) -> Value:
    base, index = values
    if not isinstance(base, VectorValue):
        scope.fail(Diagnostic("E205", "only a vector has components", expr.base.span))
    number = as_number(index, expr.index, Expectation("an index is a whole number"), scope)
    value = number.constant
    if value is None or value != int(value):
        message = "an index is a whole number that is known at compile time"
        scope.fail(Diagnostic("E205", message, expr.index.span))
    if not 0 <= value < len(base.items):
        last = len(base.items) - 1
        message = f"index {int(value)} is outside the vector: it has components 0 to {last}"
        scope.fail(Diagnostic("E205", message, expr.index.span))
    return base.items[int(value)]


def _neg(expr: ast.Neg, values: Sequence[Value], scope: Scope) -> Value:
    (value,) = values
    if isinstance(value, TimeExpr):
        return moments.negative(value, expr.span, scope)
    if not isinstance(value, VectorValue):
        value = as_number(value, expr.operand, Expectation("`-` takes a number"), scope)
    if not isinstance(expr.operand, ast.Quantity):  # -5 degC is a literal: a temperature cannot be negated
        for item in value.items if isinstance(value, VectorValue) else (value,):
            refuse_point("`-`", item, expr.operand.span, scope)
    return negate(value, expr.span)


def _binary(expr: ast.Binary, values: Sequence[Value], scope: Scope) -> Value:
    left, right = values
    if isinstance(left, TimeExpr) or isinstance(right, TimeExpr):
        return moments.combine(
            expr.op, Operand(expr.left, left), Operand(expr.right, right), expr.span, scope
        )
    who = f"`{expr.op}` {_VERBS[expr.op]} numbers"
    sides: list[Number | VectorValue] = []
    for value, side, which in ((left, expr.left, "left"), (right, expr.right, "right")):
        if isinstance(value, VectorValue):
            sides.append(value)
        else:
            sides.append(as_number(value, side, Expectation(who, f"the {which} side"), scope))
    place = comparisons.sign_span(expr.op, expr.left.span, expr.right.span)
    _refuse_products(expr, sides, place, scope)
    return broadcast(ARITHMETIC[expr.op], sides, place if expr.op in "+-%" else expr.span, scope)


def _refuse_products(
    expr: ast.Binary, sides: Sequence[Number | VectorValue], place: Span, scope: Scope
) -> None:
    """Raise Failed (E205) if an operator is not defined for its operands `sides`, one of them a vector.

    Examples are the sum or difference of a vector and a number, the product of two vectors, and `/`, `%` or
    `^` with a vector on the right.
    """
    vectors = [isinstance(side, VectorValue) for side in sides]
    if expr.op in "+-" and any(vectors) and not all(vectors):
        scope.fail(Diagnostic("E205", f"`{expr.op}` does not mix a vector and a number", place))
    if expr.op == "*" and all(vectors):
        left, right = expr.left.span.text, expr.right.span.text
        help_ = (f"`dot({left}, {right})` or `cross({left}, {right})`",)
        scope.fail(Diagnostic("E205", "`*` of two vectors is ambiguous", place, help=help_))
    if expr.op in "/%^" and vectors[1]:
        scope.fail(Diagnostic("E205", f"`{expr.op}` does not take a vector on its right", place))


def _membership(expr: ast.Member, values: Sequence[Value], scope: Scope) -> Value:
    region = expr.region
    item, rest = Operand(expr.item, values[0]), values[1:]
    if isinstance(values[0], Swept):
        return comparisons.sweeps(expr, values[0], list(map(Operand, _member_parts(expr)[1:], rest)), scope)
    if isinstance(region, ast.SetLiteral):
        inside = comparisons.in_set(item, list(map(Operand, region.items, rest)), expr.span, scope)
    elif isinstance(region, ast.Vector) and len(region.items) == 2:
        inside = comparisons.in_range(item, list(map(Operand, region.items, rest)), expr.span, scope)
    else:
        inside = comparisons.in_region(item, Operand(region, rest[0]), expr.span, scope)
    return typed.Not(expr.span, inside) if expr.negated else inside


def _member_parts(expr: ast.Member) -> Sequence[ast.Expr]:
    region = expr.region
    if isinstance(region, ast.SetLiteral) or (isinstance(region, ast.Vector) and len(region.items) == 2):
        return (expr.item, *region.items)
    return (expr.item, region)


def _nothing(_expr: ast.Expr) -> Sequence[ast.Expr]:
    return ()


OPERATIONS: Mapping[type[ast.Node], Operation] = MappingProxyType(
    {
        ast.Quantity: Operation(_nothing, _quantity),
        ast.String: Operation(
            _nothing,
            lambda expr, _, scope: scope.fail(Diagnostic("E205", "a text has no value here", expr.span)),
        ),
        ast.Bool: Operation(_nothing, lambda expr, *_: typed.Truth(expr.span, expr.value)),
        ast.Inf: Operation(_nothing, lambda expr, *_: TimeExpr(end=True, span=expr.span)),
        ast.Vector: Operation(lambda expr: expr.items, _vector),
        ast.Index: Operation(lambda expr: (expr.base, expr.index), _index),
        ast.Neg: Operation(lambda expr: (expr.operand,), _neg),
        ast.Binary: Operation(lambda expr: (expr.left, expr.right), _binary),
        ast.Member: Operation(_member_parts, _membership),
        ast.IfThenElse: Operation(lambda expr: (expr.cond, expr.yes, expr.no), choose),
    }
)
"""Node class -> evaluation rule."""


def evaluate(expr: ast.Expr, scope: Scope) -> Value:
    """Return the value of an expression.

    Raises:
        Failed: the expression has errors; all independent ones are in `scope.sink`.
    """
    meter = scope.meter
    meter.enter()
    before = meter.nodes
    try:
        _refuse_excess(expr.span, scope)
        operation = OPERATIONS.get(type(expr))
        if operation is None:
            value = _HANDLERS[type(expr)](expr, scope)
        else:
            value = operation.value(expr, evaluate_all(operation.parts(expr), scope), scope)
        if type(expr) in _REPEATS and _REPEATS[type(expr)](expr, value):
            _charge(Cost(meter.nodes - before), expr.span, scope)
        return at(value, expr.span)
    finally:
        meter.leave()


def evaluate_all(exprs: Sequence[ast.Expr], scope: Scope) -> list[Value]:
    """Return the values of independent expressions.

    All expressions are evaluated, even if one of them fails.

    Raises:
        Failed: an expression has errors; the errors of all expressions are in `scope.sink`.
    """
    return _all(partial(evaluate, expr, scope) for expr in exprs)


def _all(steps: Iterable[Callable[[], T]]) -> list[T]:
    """Return the results of `steps`; all steps are executed, even if one of them fails.

    Raises:
        Failed: a step failed.
    """
    results: list[T] = []
    failed = False
    for step in steps:
        try:
            results.append(step())
        except Failed:
            failed = True
    if failed:
        raise Failed
    return results


def formula(expr: ast.Expr, need: Expectation, scope: Scope) -> typed.Formula:
    """Return the value of an expression as a formula.

    Raises:
        Failed: the expression has errors, or its value is not a formula (E201).
    """
    return as_formula(evaluate(expr, scope), expr, need, scope)


def formulas(exprs: Sequence[tuple[ast.Expr, Expectation]], scope: Scope) -> list[typed.Formula]:
    """Return the values of independent expressions as formulas.

    Raises:
        Failed: an expression has errors, or its value is not a formula (E201).
    """
    return _all(partial(formula, expr, need, scope) for expr, need in exprs)


# ------------------------------------------------------------------------ names


def _name(expr: ast.Name, scope: Scope) -> Value:
    if expr.name in scope.locals:
        value, cost = scope.locals[expr.name]
        _charge(cost, expr.span, scope)
        return value
    if scope.in_spec and expr.name in moments.TIME_WORDS and not expr.quoted:
        return moments.TIME_WORDS[expr.name]
    return _named(expr, scope, scope)


def _attr(expr: ast.Attr, scope: Scope) -> Value:
    """Return the value of `m.name`, a name that an imported file declares."""
    name, home = member_of(expr, scope)
    return _named(name, home, scope)


def _named(expr: ast.Name, home: Scope, scope: Scope) -> Value:
    """Return the value of a name that is declared in the file whose names are in `home`.

    `scope` is the scope of the expression that uses the name. Errors are reported to `scope`.

    Raises:
        Failed: the name is not declared (E101), or stands for a function with arguments (E105).
    """
    entry = home.entries.get(expr.name)
    if entry is None:
        return home.unknown(expr)
    if isinstance(entry, External):
        scope.fail(Diagnostic("E105", f"`{entry.name}` takes arguments", expr.span))
    if isinstance(entry, Definition):
        if entry.formals:
            help_ = (f"{entry.name}({', '.join(entry.formals)})",)
            scope.fail(Diagnostic("E105", f"`{entry.name}` takes arguments", expr.span, help=help_))
        value = _defined(entry, expr.span, home)
    else:
        value = entry.value
    if isinstance(value, Number) and entry.span is not None:
        return replace(value, origin=Origin(entry.span, f"line {entry.span.line}"))
    return value


# --------------------------------------------------------------------- macros


def _defined(entry: Definition, place: Span, scope: Scope) -> Value:
    """Return the value of a definition without arguments.

    The value is computed at the first use only. But every use adds the size of the definition to the size of
    the expression around it, which is limited. `place` is the source location of the use.
    """
    if entry.name not in scope.cache:
        if entry.name in scope.open:
            scope.fail(cycle(entry, scope))
        inner = replace(scope, locals={}, open=(*scope.open, entry.name))
        scope.cache[entry.name] = None
        with scope.meter.measured() as cost:
            value = finished(entry, evaluate(entry.body, inner), inner)
        scope.cache[entry.name] = (value, cost)
    found = scope.cache[entry.name]
    if found is None:
        if entry.name in scope.open:
            scope.fail(cycle(entry, scope))
        raise Failed
    _charge(found[1], place, scope)
    return found[0]


def _measured_value(expr: ast.Expr, scope: Scope) -> tuple[Value, Cost]:
    with scope.meter.measured() as cost:
        value = evaluate(expr, scope)
    return value, cost


def _expanded(entry: Definition, call: ast.Call, scope: Scope, home: Scope) -> Value:
    """Return the value of a macro for the arguments of a call.

    The macro is declared in the file whose names are in `home`. The arguments are evaluated in `scope`.
    """
    if home.cache.get(entry.name, entry) is None:
        raise Failed
    if entry.name in home.open:
        scope.fail(cycle(entry, home))
    given = arguments(entry, call, scope)
    measured = _all(partial(_measured_value, expr, scope) for expr in given.values())
    bound = dict(zip(given, measured, strict=True))
    inner = replace(home, locals=bound, open=(*home.open, entry.name))
    with _traced(entry, call, scope):
        return finished(entry, evaluate(entry.body, inner), inner)


@contextmanager
def _traced(entry: Definition, call: ast.Call, scope: Scope) -> Iterator[None]:
    """Context for the expansion of a macro: on failure, the location of the call is added to the findings."""
    before = len(scope.sink)
    try:
        yield
    except Failed:
        label = call.span.label(f"in this use of `{entry.name}`")
        scope.sink[before:] = [
            finding
            if finding.labels and finding.labels[-1] == label
            else replace(finding, labels=(*finding.labels, label))
            for finding in scope.sink[before:]
        ]
        raise


def _charge(cost: Cost, place: Span, scope: Scope) -> None:
    scope.meter.charge(cost)
    _refuse_excess(place, scope)


def _refuse_excess(place: Span, scope: Scope) -> None:
    """Raise Failed if a declaration is too large once its macros are expanded.

    E005 is reported once per declaration.
    """
    meter = scope.meter
    if not meter.over:
        return
    if not meter.reported:
        meter.reported = True
        scope.report(too_big(meter, place))
    raise Failed


def _call(expr: ast.Call, scope: Scope) -> Value:
    if scope.in_spec and isinstance(expr.func, ast.Attr):
        return _called(expr, *member_of(expr.func, scope), scope)
    if not isinstance(expr.func, ast.Name):
        note = ("expressions are parsed, never evaluated as Python; for Python dynamics use `plugin:`",)
        message = "calls to attributes are not part of the expression language"
        place = expr.func.span
        if isinstance(expr.func, ast.Attr):
            place = place.source.span(expr.func.base.span.end, place.end)
        scope.fail(Diagnostic("S201", message, place, note=note))
    return _called(expr, expr.func, scope, scope)


def _called(expr: ast.Call, name: ast.Name, home: Scope, scope: Scope) -> Value:
    """Return the value of a call of the function `name`.

    The function is a built-in one, or it is declared in the file whose names are in `home`.
    """
    entry = home.entries.get(name.name)
    if isinstance(entry, Definition) and entry.formals:
        return _expanded(entry, expr, scope, home)
    if isinstance(entry, External):
        return outside(entry, expr, evaluate_all([arg.value for arg in expr.args], scope), scope)
    if entry is not None and (home is not scope or not reserved(name.name)):
        if home.cache.get(name.name, entry) is not None:
            scope.report(Diagnostic("E105", f"`{name.name}` is not a function", name.span))
        raise Failed
    if home is not scope:
        return home.unknown(name, called=True)
    values = evaluate_all([arg.value for arg in expr.args], scope)
    return builtin(name.name, expr, values, scope)


# ------------------------------------------------------------------- formulas


def _not(expr: ast.Not, scope: Scope) -> Value:
    return typed.Not(
        expr.span, formula(expr.operand, Expectation("`not`", span=_head(expr.span, expr.operand)), scope)
    )


def _logic(expr: ast.Logic, scope: Scope) -> Value:
    """Return the formula of a logical connective.

    A chain of `and` or `or` becomes one node.
    """
    operands: list[ast.Expr] = []
    waiting = [expr.right, expr.left]
    while waiting:
        item = waiting.pop()
        if expr.op in ("and", "or") and isinstance(item, ast.Logic) and item.op == expr.op:
            waiting += [item.right, item.left]
        else:
            operands.append(item)
    need = Expectation(f"`{expr.op}`")
    return typed.Logic(expr.span, expr.op, tuple(formulas([(item, need) for item in operands], scope)))


def _temporal(expr: ast.Temporal, scope: Scope) -> Value:
    place = _head(expr.span, expr.interval or expr.body, len(expr.alias or expr.op))
    return _timed(expr, [(expr.body, Expectation(f"`{expr.op}`", span=place))], place, scope)


def _until(expr: ast.Until, scope: Scope) -> Value:
    after = expr.interval.span if expr.interval is not None else expr.right.span
    place = comparisons.sign_span(expr.alias or expr.op, expr.left.span, after)
    need = Expectation(f"`{expr.op}`", span=place)
    return _timed(expr, [(expr.left, need), (expr.right, need)], place, scope)


def _timed(
    expr: ast.Temporal | ast.Until,
    operands: Sequence[tuple[ast.Expr, Expectation]],
    place: Span,
    scope: Scope,
) -> typed.Formula:
    """Return the formula of a temporal operator, which stands at the source location `place`.

    The operands and the interval are all evaluated, even if one of them fails, so that all errors are
    reported.
    """
    if not scope.temporal:
        scope.fail(unsupported(f"`{expr.op}`", expr.span, scope))
    window: typed.Interval | None = None
    body = operands[-1][0]
    try:
        bounds = (
            evaluate_all((expr.interval.lo, expr.interval.hi), scope) if expr.interval is not None else ()
        )
        window = moments.interval(expr.interval, bounds, expr.op, place, body, scope)
    finally:
        inner = formulas(operands, scope)
    return _timed_node(_expansion(expr.op), dict(zip("pq", inner, strict=False)), window, expr.span)


@cache
def _expansion(op: str) -> ast.Expr:
    """Return the formula by which the temporal operator `op` is defined, in terms of `p` and `q`.

    The formula has no intervals. A basic operator such as `until` has no definition in terms of others; for
    it, the formula is `p until q`.
    """
    plain = f"p {op} q" if OPERATORS[op].binary else f"{op} p"
    return parse_expr(Source(f"expansion of {op}", OPERATORS[op].expansion or plain))


@cache
def _repeats_operand(op: str) -> bool:
    """True if the expansion of a temporal operator contains an operand twice.

    The result is also True for `unless`, which is expanded at a later stage.
    """
    names = [node.name for node in _expansion(op).walk() if isinstance(node, ast.Name)]
    return op == "unless" or len(names) > len(set(names))


def _timed_node(
    pattern: ast.Node, operands: Mapping[str, typed.Formula], window: typed.Interval, span: Span
) -> typed.Formula:
    """Return the definition (`pattern`) of a temporal operator with its operands in place of `p` and `q`.

    Each temporal operator in the definition gets the interval `window`.
    """
    if isinstance(pattern, ast.Name):
        return operands[pattern.name]
    inner = [_timed_node(part, operands, window, span) for part in pattern.children()]
    match pattern:
        case ast.Temporal(op=op):
            return typed.Temporal(span, cast("typed.UnaryTemporal", op), window, *inner)
        case ast.Until(op=op):
            return typed.Until(span, cast("typed.BinaryTemporal", op), window, *inner)
        case ast.Logic(op=op):
            return typed.Logic(span, op, tuple(inner))
        case ast.Not():
            return typed.Not(span, *inner)
        case _:
            raise AssertionError("an expansion consists of connectives and temporal operators")


def _head(span: Span, inner: ast.Node, length: int | None = None) -> Span:
    """Return the source location of a prefix operator, without its operand.

    The operator begins at the start of `span` and ends before its operand `inner`. If `length` is given, the
    location has at most `length` characters.
    """
    end = min(inner.span.start, span.start + length) if length is not None else inner.span.start
    text = span.source.text[span.start : end].rstrip(" \t\n(")
    return span.source.span(span.start, span.start + max(1, len(text)))


def _quantifier(expr: ast.Quantifier, scope: Scope) -> Value:
    """Return the conjunction (`forall`) or disjunction (`exists`) of the body over a finite domain."""
    items: list[typed.Formula] = []
    need = Expectation(f"`{expr.kind}`")
    for value in _domain(expr, scope):
        inner = replace(scope, locals={**scope.locals, expr.var: (value, Cost(1, 1))})
        items.append(formula(expr.body, need, inner))
    if not items:
        return typed.Truth(expr.span, expr.kind == "forall")
    if len(items) == 1:
        return items[0]
    return typed.Logic(expr.span, "and" if expr.kind == "forall" else "or", tuple(items))


def _freeze(expr: ast.Freeze, scope: Scope) -> Value:
    """Return `freeze a = x in p`: p, in which a has the value of x at the instant of the `freeze`."""
    if not scope.temporal:
        scope.fail(unsupported("`freeze`", expr.span, scope))
    names = [name for name, _ in expr.bindings]
    if len(set(names)) < len(names):
        scope.fail(Diagnostic("E102", "`freeze` binds one name twice", expr.span))
    bindings: dict[str, Number] = {}
    bound: dict[str, tuple[Value, Cost]] = {}
    values = evaluate_all([value for _, value in expr.bindings], scope)
    for (name, written), value in zip(expr.bindings, values, strict=True):
        if isinstance(value, VectorValue):
            items = [_frozen(item, f"{name}[{i}]", expr, bindings) for i, item in enumerate(value.items)]
            bound[name] = (VectorValue(tuple(items), span=written.span), Cost(1, 1))
        else:
            number = loose_number(value, written, Expectation("`freeze` binds numbers and vectors"), scope)
            bound[name] = (_frozen(number, name, expr, bindings), Cost(1, 1))
    inner = replace(scope, locals={**scope.locals, **bound})
    body = formula(expr.body, Expectation("`freeze`"), inner)
    if not bindings:
        return body
    pairs = tuple((key, number.num) for key, number in bindings.items())
    return typed.Freeze(expr.span, pairs, body, tuple(number.unit for number in bindings.values()))


def _frozen(number: Number, name: str, expr: ast.Freeze, bindings: dict[str, Number]) -> Number:
    """Return the frozen value of `number`, which a `freeze` binds to `name`.

    The number is added to `bindings` under a unique name. For a constant, the result is `number` itself, and
    nothing is added.
    """
    if number.constant is not None:
        return number
    key = f"{name}#{expr.span.start}@{expr.span.source.name}"
    bindings[key] = number
    return replace(number, num=ir.FrozenVar(key), formula=None, origin=None)


def _domain(expr: ast.Quantifier, scope: Scope) -> Iterator[Number]:
    if isinstance(expr.domain, ast.SetLiteral):
        values = evaluate_all(expr.domain.items, scope)
        for item, value in zip(expr.domain.items, values, strict=True):
            yield as_number(value, item, Expectation(f"`{expr.kind}` runs over numbers"), scope)
        return
    ends = []
    for end, value in zip(expr.domain, evaluate_all(expr.domain, scope), strict=True):
        number = as_number(value, end, Expectation(f"`{expr.kind}` runs over whole numbers"), scope)
        if number.exact is None or number.exact.denominator != 1:
            message = f"`{expr.kind}` runs over whole numbers that are known at compile time"
            scope.fail(Diagnostic("E205", message, end.span))
        ends.append(int(number.exact))
    scope.meter.charge(Cost(nodes=max(0, ends[1] - ends[0])))
    _refuse_excess(expr.span, scope)
    for index in range(ends[0], ends[1] + 1):
        yield literal(Fraction(index), expr.span)


def _compare(expr: ast.Compare, scope: Scope) -> Value:
    if any(isinstance(node, ast.Extreme) for node in expr.walk()):
        return evaluate(without_extremes(expr, scope, evaluate), scope)
    return comparisons.comparison(expr, evaluate_all(expr.operands, scope), scope)


_HANDLERS: Mapping[type[ast.Node], Callable[[Any, Scope], Value]] = MappingProxyType(
    {
        ast.Compare: _compare,
        ast.Extreme: misplaced,
        ast.Name: _name,
        ast.Attr: _attr,
        ast.Call: _call,
        ast.Not: _not,
        ast.Logic: _logic,
        ast.Temporal: _temporal,
        ast.Until: _until,
        ast.Quantifier: _quantifier,
        ast.Freeze: _freeze,
    }
)

_REPEATS: Mapping[type[ast.Node], Callable[[Any, Value], bool]] = MappingProxyType(
    {
        ast.Logic: lambda expr, _: expr.op in ("<->", "xor"),
        ast.Temporal: lambda expr, _: _repeats_operand(expr.op),
        ast.Until: lambda expr, _: _repeats_operand(expr.op),
        ast.IfThenElse: lambda _, value: is_formula(value),
        ast.Compare: lambda _, value: isinstance(value, typed.Logic),
        ast.Call: lambda _, value: isinstance(value, typed.Edge),
    }
)
"""Class of expressions -> whether the expansion repeats operands: `a <-> b` is `a -> b` and `b -> a`."""
