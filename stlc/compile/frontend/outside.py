"""Calls of functions that the system provides."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from stlc.compile.frontend.algebra import absolute
from stlc.compile.frontend.scope import External, Scope
from stlc.compile.frontend.sorts import Need, as_vector, loose_number
from stlc.compile.frontend.values import Number, Value, Vector
from stlc.compile.ir import nodes as ir
from stlc.diagnostics import Diagnostic
from stlc.grammar import ast


def outside(entry: External, call: ast.Call, values: Sequence[Value], scope: Scope) -> Value:
    """A call. Raises Failed (E105, E202, E205)."""
    _check_arguments(entry, call, scope)
    flat: list[ir.Num] = []
    for arg, value, size in zip(call.args, values, entry.arguments, strict=True):
        need = Need(f"`{entry.name}` takes {'a number' if size is None else f'a vector of {size}'}", "this")
        if size is None:
            flat.append(absolute(loose_number(value, arg.value, need, scope)).num)
            continue
        vector = as_vector(value, arg.value, need, scope)
        if len(vector.items) != size:
            scope.fail(Diagnostic("E205", f"{need.who}, this has {len(vector.items)} components", arg.span))
        flat += [absolute(item).num for item in vector.items]
    numbers = [_output(entry, index, tuple(flat)) for index in range(entry.result or 1)]
    if entry.result is None:
        return replace(numbers[0], span=call.span)
    return Vector(tuple(numbers), call.span)


def _output(entry: External, index: int, args: tuple[ir.Num, ...]) -> Number:
    num: ir.Num = ir.Extern(entry.name, args, index, entry.function)
    if entry.unit.ratio != 1:
        num = ir.Op("mul", (num, ir.Const(entry.unit.scale)))
    return Number(num, entry.unit, flexible=not entry.unit.text, kind=entry.kind)


def _check_arguments(entry: External, call: ast.Call, scope: Scope) -> None:
    given, count = len(call.args), len(entry.arguments)
    named = next((arg for arg in call.args if arg.name is not None), None)
    if named is not None:
        message = f"`{entry.name}` has no argument called `{named.name}`"
        scope.fail(Diagnostic("E105", message, named.span, help=("give its arguments in order",)))
    if given != count:
        were = "was" if given == 1 else "were"
        message = f"`{entry.name}` takes {count} argument{'s' if count != 1 else ''}, {given} {were} given"
        scope.fail(Diagnostic("E105", message, call.span))
