"""Calls of built-in functions on values: arithmetic, norms, regions, indicators, neighbouring samples."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction

from stlc.compile.frontend.algebra import agree, apply
from stlc.compile.frontend.builders import region
from stlc.compile.frontend.regions import signed_distance
from stlc.compile.frontend.scope import Scope
from stlc.compile.frontend.sorts import Need, as_number, as_state_formula, as_vector, loose_number
from stlc.compile.frontend.stepping import stepping
from stlc.compile.frontend.values import REGION_TYPES, Number, Value, Vector, literal, noun
from stlc.compile.frontend.vectors import broadcast, cross, dot, minus, norm
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.functions import FUNCTIONS, REGIONS, REWRITTEN, STEPPING
from stlc.diagnostics import Diagnostic
from stlc.grammar import ast
from stlc.source import Span


def builtin(name: str, call: ast.Call, values: Sequence[Value], scope: Scope) -> Value:
    """`name(values)` for a built-in function. Raises Failed; E101 where there is no such function."""
    if name in REGIONS:
        return region(name, call, values, scope)
    if name == "ind":
        return _indicator(call, values, scope)
    _positional(name, call, scope)
    if name in STEPPING:
        count_arguments(name, call, STEPPING[name], scope)
        if not scope.temporal:
            scope.fail(unsupported(f"`{name}`", call.span, scope))
        return stepping(name, call, values, scope)
    if name in REWRITTEN:
        count_arguments(name, call, REWRITTEN[name], scope)
        return _rewritten(name, call, values, scope)
    function = FUNCTIONS.get(name)
    if function is None or function.kind == "operator":
        assert isinstance(call.func, ast.Name)
        return scope.unknown(call.func, called=True)
    if function.kind == "sampler" and not scope.samplers:
        scope.fail(_no_samplers(name, call, scope))
    return _function(name, call, values, scope)


def unsupported(what: str, span: Span, scope: Scope) -> Diagnostic:
    """A part of the language that is not compiled here."""
    if not scope.in_spec:
        return Diagnostic("S201", f"{what} is not part of the expression language of system files", span)
    return Diagnostic("E015", f"{what} is not compiled by this version", span)


def count_arguments(name: str, call: ast.Call, arity: tuple[int, int | None], scope: Scope) -> None:
    """Refuse a wrong number of arguments (E105)."""
    least, most = arity
    given = len(call.args)
    if least <= given and (most is None or given <= most):
        return
    if most is None:
        wants = f"at least {least} argument{'s' if least != 1 else ''}"
    elif least == most:
        wants = f"{least} argument{'s' if least != 1 else ''}"
    else:
        wants = f"{least} to {most} arguments"
    were = "was" if given == 1 else "were"
    scope.fail(Diagnostic("E105", f"`{name}` takes {wants}, {given} {were} given", call.span))


def _positional(name: str, call: ast.Call, scope: Scope) -> None:
    for arg in call.args:
        if arg.name is not None:
            scope.fail(Diagnostic("E105", f"`{name}` has no argument called `{arg.name}`", arg.span))


def _no_samplers(name: str, call: ast.Call, scope: Scope) -> Diagnostic:
    message = f"`{name}` draws at random, which only initial states and events can"
    return Diagnostic("E205" if scope.in_spec else "S201", message, call.span)


def _function(name: str, call: ast.Call, values: Sequence[Value], scope: Scope) -> Value:
    """A function of the table: component by component, or over all components at once."""
    items: list[Number | Vector] = []
    for index, (arg, value) in enumerate(zip(call.args, values, strict=True), start=1):
        need = Need(f"`{name}` takes numbers", f"argument {index}")
        if isinstance(value, Vector):
            items.append(value)
        elif name == "choice":
            items.append(loose_number(value, arg.value, need, scope))
        else:
            items.append(as_number(value, arg.value, need, scope))
    function = FUNCTIONS[name]
    if function.most is None and function.kind == "function" and items:
        flat = [n for item in items for n in (item.items if isinstance(item, Vector) else (item,))]
        return apply(name, flat, call.span, scope) if flat else Number(ir.Const(0.0), span=call.span)
    count_arguments(name, call, (function.least, function.most), scope)
    return broadcast(name, items, call.span, scope)


def _rewritten(name: str, call: ast.Call, values: Sequence[Value], scope: Scope) -> Value:
    span, exprs = call.span, [arg.value for arg in call.args]
    if name in ("deg", "rad"):
        angle = as_number(values[0], exprs[0], Need(f"`{name}` converts an angle"), scope)
        return _convert(name, angle, span, scope)
    if name == "sdist":
        point = as_vector(values[0], exprs[0], Need("`sdist` takes a point"), scope)
        place = values[1]
        if not isinstance(place, REGION_TYPES):
            scope.fail(Diagnostic("E205", f"`sdist` takes a region, this is {noun(place)}", exprs[1].span))
        return signed_distance(point, place, span, scope)
    left, right = (
        as_vector(value, expr, Need(f"`{name}` takes two vectors", f"argument {index}"), scope)
        for index, (value, expr) in enumerate(zip(values, exprs, strict=True), start=1)
    )
    if name == "cross":
        return cross(left, right, span, scope)
    return (
        dot(left, right, span, scope) if name == "dot" else norm(minus(left, right, span, scope), span, scope)
    )


def _convert(name: str, angle: Number, span: Span, scope: Scope) -> Number:
    """`deg(x)`: how many degrees an angle is; `rad(x)`: the angle of so many degrees."""
    ratio = Fraction(math.pi) / 180
    factor = literal(1 / ratio if name == "deg" else ratio, span)
    (angle, _), _ = agree((angle, Number(ir.Const(1.0))), f"`{name}`", span, scope)
    return replace(apply("mul", (angle, factor), span, scope), flexible=False, bare=False)


def _indicator(call: ast.Call, values: Sequence[Value], scope: Scope) -> Number:
    """`ind(phi, sharpness = w)`: 1 where phi holds, else 0 (the paper's Eq. 6 in training)."""
    if not call.args or call.args[0].name is not None or len(call.args) > 2:
        message = "`ind` takes a formula, and perhaps `sharpness = w`"
        scope.fail(Diagnostic("E105", message, call.span, help=("ind(x > 0, sharpness = 500)",)))
    sharpness = None
    if len(call.args) == 2:
        arg = call.args[1]
        if arg.name not in (None, "sharpness"):
            scope.fail(
                Diagnostic(
                    "E105",
                    f"`ind` has no argument called `{arg.name}`",
                    arg.span,
                    help=("its second argument is `sharpness`",),
                )
            )
        width = as_number(values[1], arg.value, Need("the sharpness of `ind` is a number"), scope)
        sharpness = width.constant
        if sharpness is None or sharpness <= 0:
            scope.fail(Diagnostic("E205", "the sharpness of `ind` is a positive constant", arg.value.span))
    cond = as_state_formula(values[0], call.args[0].value, Need("`ind`", "argument 1"), scope)
    if isinstance(cond, ir.Truth):
        return replace(literal(int(cond.value), call.span), flexible=False, bare=False)
    return Number(ir.Indicator(cond, sharpness), kind="int", span=call.span)
