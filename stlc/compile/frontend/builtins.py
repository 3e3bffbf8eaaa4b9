"""Function calls: built-in functions, regions, values at other samples, functions of a system."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from types import MappingProxyType

from stlc.compile.frontend.arithmetic import (
    absolute,
    agree,
    apply,
    broadcast,
    cross,
    dot,
    in_unit,
    minus,
    norm,
)
from stlc.compile.frontend.coerce import (
    Expectation,
    as_formula,
    as_number,
    as_state_formula,
    as_vector,
    loose_number,
)
from stlc.compile.frontend.intervals import moment
from stlc.compile.frontend.regions import area, dimension, points, signed_distance, simple
from stlc.compile.frontend.scope import External, Scope
from stlc.compile.frontend.values import (
    REGION_TYPES,
    BoxRegion,
    Combined,
    Complement,
    Dilated,
    HalfSpace,
    NormBall,
    Number,
    Polygon,
    Region,
    Swept,
    TimeExpr,
    Value,
    VectorValue,
    literal,
    noun,
    shifted,
)
from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.ir.discretize import Grid, no_delay
from stlc.compile.ir.functions import FUNCTIONS, REGIONS, REWRITTEN, STEPPING
from stlc.diagnostics import Diagnostic
from stlc.grammar import ast
from stlc.source import Span
from stlc.units import Unit

FORMALS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "circle": ("center", "radius"),
        "ball": ("center", "radius"),
        "box": ("lower", "upper"),
        "halfspace": ("normal", "offset"),
        "complement": ("region",),
        "dilate": ("region", "margin"),
    }
)
"""Names of the arguments of region functions.

`polygon`, `union` and `intersect` take any number of arguments without names.
"""


def region(name: str, call: ast.Call, values: Sequence[Value], scope: Scope) -> Region:
    """Return the region that a call such as `circle(...)` constructs.

    Raises:
        Failed: wrong arguments (E105), or arguments of a wrong type (E205).
    """
    if name not in FORMALS:
        _positional(name, call, scope)
        pairs = [(arg.value, value) for arg, value in zip(call.args, values, strict=True)]
        return _polygon_of(call, pairs, scope) if name == "polygon" else _combined(name, call, pairs, scope)
    given = _bound(name, call, values, scope)
    match name:
        case "circle" | "ball":
            return _ball_of(name, call, given, scope)
        case "box":
            return _box_of(call, given, scope)
        case "halfspace":
            normal = as_vector(
                given[0][1], given[0][0], Expectation("the normal of a half-space is a vector"), scope
            )
            offset = as_number(
                given[1][1], given[1][0], Expectation("the offset of a half-space is a number"), scope
            )
            return HalfSpace(normal, offset, span=call.span)
        case "complement":
            return Complement(_as_region(name, *given[0], scope), span=call.span)
        case _:
            margin = as_number(given[1][1], given[1][0], Expectation("`dilate` grows by a length"), scope)
            return Dilated(_as_region(name, *given[0], scope), margin, span=call.span)


def _bound(
    name: str, call: ast.Call, values: Sequence[Value], scope: Scope
) -> tuple[tuple[ast.Expr, Value], ...]:
    """Return (expression, value) of each argument in the order of the function's parameter names.

    Raises:
        Failed: an argument is unknown, repeated or missing (E105).
    """
    formals = FORMALS[name]
    found: dict[str, tuple[ast.Expr, Value]] = {}
    shape = f"{name}({', '.join(formals)})"
    for index, (arg, value) in enumerate(zip(call.args, values, strict=True)):
        formal = arg.name if arg.name is not None else (formals[index] if index < len(formals) else "")
        if formal not in formals or formal in found:
            scope.fail(Diagnostic("E105", f"`{name}` does not take this argument", arg.span, help=(shape,)))
        found[formal] = (arg.value, value)
    missing = [formal for formal in formals if formal not in found]
    if missing:
        scope.fail(Diagnostic("E105", f"`{name}` needs `{missing[0]}`", call.span, help=(shape,)))
    return tuple(found[formal] for formal in formals)


def _as_region(name: str, expr: ast.Expr, value: Value, scope: Scope) -> Region:
    if isinstance(value, REGION_TYPES):
        return value
    return scope.fail(Diagnostic("E205", f"`{name}` takes regions, this is {noun(value)}", expr.span))


def _ball_of(name: str, call: ast.Call, given: Sequence[tuple[ast.Expr, Value]], scope: Scope) -> NormBall:
    center = as_vector(given[0][1], given[0][0], Expectation(f"the center of a {name} is a vector"), scope)
    radius = as_number(given[1][1], given[1][0], Expectation(f"the radius of a {name} is a number"), scope)
    if name == "circle" and len(center.items) != 2:
        message = f"a circle lies in the plane, this center has {len(center.items)} components"
        scope.fail(
            Diagnostic("E205", message, given[0][0].span, help=("`ball` takes any number of components",))
        )
    if radius.constant is not None and radius.constant < 0:
        scope.fail(Diagnostic("E205", "a radius is not negative", given[1][0].span))
    return NormBall(center, radius, span=call.span)


def _box_of(call: ast.Call, given: Sequence[tuple[ast.Expr, Value]], scope: Scope) -> BoxRegion:
    lower, upper = (
        as_vector(value, expr, Expectation("a corner of a box is a vector"), scope) for expr, value in given
    )
    if len(lower.items) != len(upper.items):
        message = f"corners of {len(lower.items)} and {len(upper.items)} components do not span a box"
        scope.fail(Diagnostic("E205", message, call.span))
    for low, high in zip(lower.items, upper.items, strict=True):
        if low.bare is not high.bare:
            continue  # the bare corner takes the unit of the tested point
        if not low.bare:
            low, high = absolute(low), absolute(high)
        if low.constant is not None and high.constant is not None and low.constant > high.constant:
            scope.fail(
                Diagnostic("E205", "this box is empty: a lower bound is above the upper one", call.span)
            )
    return BoxRegion(lower, upper, span=call.span)


def _polygon_of(call: ast.Call, pairs: Sequence[tuple[ast.Expr, Value]], scope: Scope) -> Polygon:
    need = Expectation("a corner of a polygon is a vector")
    corners = tuple(as_vector(value, expr, need, scope) for expr, value in pairs)
    known = points(corners)
    if len(corners) < 3:
        scope.fail(Diagnostic("E105", "a polygon has at least 3 corners", call.span))
    if known is None:
        message = "the corners of a polygon are constant points of the plane"
        scope.fail(
            Diagnostic("E205", message, call.span, help=("a moving obstacle can be a `circle` or a `box`",))
        )
    if not simple(known) or area(known) == 0:
        scope.fail(Diagnostic("E205", "this polygon has no inside, or crosses itself", call.span))
    return Polygon(corners if area(known) > 0 else corners[::-1], span=call.span)


def _combined(name: str, call: ast.Call, pairs: Sequence[tuple[ast.Expr, Value]], scope: Scope) -> Combined:
    if not pairs:
        scope.fail(Diagnostic("E105", f"`{name}` needs at least one region", call.span))
    parts = tuple(_as_region(name, expr, value, scope) for expr, value in pairs)
    sizes = set(map(dimension, parts))
    if len(sizes) > 1:
        message = f"regions of {' and '.join(map(str, sorted(sizes)))} dimensions do not go together"
        scope.fail(Diagnostic("E205", message, call.span))
    return Combined("union" if name == "union" else "intersect", parts, span=call.span)


_SECOND = Unit.SYMBOLS["s"]


def stepping(name: str, call: ast.Call, values: Sequence[Value], scope: Scope) -> Value:
    """Return the value of a function that reads other samples, such as `next`, `shift` or `rise`.

    The caller has already checked the number of arguments.

    Raises:
        Failed: an argument is not a formula (E201) or has a wrong type (E205).
    """
    value, expr = values[0], call.args[0].value
    match name:
        case "rise" | "fall":
            return typed.Edge(call.span, name, as_formula(value, expr, Expectation(f"`{name}`"), scope))
        case "sweep":
            if not isinstance(value, VectorValue):
                number = as_number(value, expr, Expectation("`sweep` follows a point"), scope)
                value = VectorValue((number,), span=expr.span)
            return Swept(value, span=call.span)
        case "delta":
            return _delta(value, expr, call.span, scope)
    delay = typed.Time(steps=Fraction({"next": 1, "prev": -1}.get(name, 0)))
    if name == "shift":
        delay = _delay(values[1], call.args[1].value, scope)
    return _shifted(value, delay, expr, call.span, f"`{name}`", scope)


def _shifted(value: Value, delay: typed.Time, expr: ast.Expr, span: Span, name: str, scope: Scope) -> Value:
    """Return a number, a vector or a formula shifted in time by `delay`.

    `name` is the name of the function, for messages.
    """
    match value:
        case Number() if value.kind != "bool":
            return replace(value, num=_delayed_number(value.num, delay), origin=None)
        case VectorValue(items):
            moved = []
            for item in items:  # a number such as `if c then p else q`, with bools p and q, has a formula too
                formula = None if item.formula is None else _delayed_formula(item.formula, delay, span)
                moved.append(replace(item, num=_delayed_number(item.num, delay), formula=formula))
            return VectorValue(tuple(moved), span=span)
        case _:
            return _delayed_formula(as_formula(value, expr, Expectation(name), scope), delay, span)


def _delayed_number(num: ir.Num, delay: typed.Time) -> ir.Num:
    if delay.seconds or delay.horizons:
        return shifted(num, 0, delay=delay)
    return shifted(num, int(delay.steps))


def _delayed_formula(formula: typed.Formula, delay: typed.Time, span: Span) -> typed.Formula:
    if delay.seconds or delay.horizons:
        return typed.Shift(span, 1, formula, delay=delay)
    return typed.Shift(span, int(delay.steps), formula)


def _delta(value: Value, expr: ast.Expr, span: Span, scope: Scope) -> Value:
    """Return the change of a number or vector since the previous sample."""
    now = (
        value
        if isinstance(value, VectorValue)
        else as_number(value, expr, Expectation("`delta` takes numbers"), scope)
    )
    before = _shifted(now, typed.Time(steps=Fraction(-1)), expr, span, "`delta`", scope)
    assert isinstance(before, Number | VectorValue)
    return broadcast("sub", (now, before), span, scope)


def _delay(value: Value, expr: ast.Expr, scope: Scope) -> typed.Time:
    """Return a delay: a number of samples (`3`, `-1`, `3 steps`), or a time (`0.1 s`).

    A time is converted to samples later, when the time step is known.

    Raises:
        Failed: the expression is neither a number of samples nor a time (E205).
    """
    match value:
        case TimeExpr(end=False):
            time = value.on(expr.span)
        case Number(bare=True, exact=known) if known is not None:
            time = typed.Time(steps=known, span=expr.span)
        case Number(bare=False, flexible=False) if value.constant is not None and value.unit.same_dims(
            _SECOND
        ):
            time = moment(expr, value, scope).on(expr.span)
        case _:
            message = "`shift` goes a whole number of samples, known at compile time"
            return scope.fail(no_delay(message, expr.span))
    if not (time.seconds or time.horizons):
        finding = Grid().delay_fault(time.steps, expr.span)
        if finding is not None:
            scope.fail(finding)
    return time


def _before(value: Value, call: ast.Call, scope: Scope) -> Value:
    """Return a number, a vector or a formula at the previous sample, as an expression of one instant.

    Raises:
        Failed: the value is none of these (E202, E205).
    """

    def renamed(leaf: ir.Num) -> ir.Num:
        return leaf.before if isinstance(leaf, ir.Signal) else leaf

    match value:
        case Number():
            formula = None if value.formula is None else value.formula.map_leaves(renamed)
            return replace(value, num=value.num.map_leaves(renamed), formula=formula, origin=None)
        case VectorValue(items):
            return replace(
                value, items=tuple(replace(each, num=each.num.map_leaves(renamed)) for each in items)
            )
        case _:
            return as_formula(value, call.args[0].value, Expectation("`prev`"), scope).map_leaves(renamed)


def outside(entry: External, call: ast.Call, values: Sequence[Value], scope: Scope) -> Value:
    """Return the value of a call of a function that the system provides.

    Raises:
        Failed: wrong arguments (E105), or arguments of a wrong type (E202, E205) or unit (E203).
    """
    _positional(entry.name, call, scope, "give its arguments in order")
    count_arguments(entry.name, call, len(entry.arguments), len(entry.arguments), scope)
    flat: list[ir.Num] = []
    for index, (arg, value, size) in enumerate(zip(call.args, values, entry.arguments, strict=True)):
        need = Expectation(
            f"`{entry.name}` takes {'a number' if size is None else f'a vector of {size}'}", "this"
        )
        if size is None:
            number = loose_number(value, arg.value, need, scope)
            unit = entry.units[index] if entry.units else None
            if unit is not None and number.bare:
                number = in_unit(number, unit, scope)
            elif unit is not None and not number.flexible and not number.unit.same_dims(unit):
                message = f"{need.who} in [{unit}], this is in [{number.unit}]"
                scope.fail(Diagnostic("E203", message, arg.span))
            flat.append(absolute(number).num)
            continue
        vector = as_vector(value, arg.value, need, scope)
        if len(vector.items) != size:
            scope.fail(Diagnostic("E205", f"{need.who}, this has {len(vector.items)} components", arg.span))
        flat += [absolute(item).num for item in vector.items]
    numbers = []
    for index in range(entry.result or 1):
        num: ir.Num = ir.Extern(entry.name, (*flat, *entry.further), index, entry.function)
        if entry.unit.ratio != 1:
            num = num * entry.unit.scale
        numbers.append(Number(num, entry.unit, flexible=not entry.unit.text, kind=entry.kind))
    if entry.result is None:
        return replace(numbers[0], span=call.span)
    return VectorValue(tuple(numbers), span=call.span)


def builtin(name: str, call: ast.Call, values: Sequence[Value], scope: Scope) -> Value:
    """Return the value of a call of a built-in function.

    Raises:
        Failed: the function is unknown (E101), its arguments are invalid, or it is not allowed in this place.
    """
    if name in REGIONS:
        return region(name, call, values, scope)
    if name == "ind":
        return _indicator(call, values, scope)
    _positional(name, call, scope)
    if name in STEPPING:
        count_arguments(name, call, *STEPPING[name], scope)
        if name == "prev" and scope.earlier:
            return _before(values[0], call, scope)
        if not scope.temporal:
            scope.fail(unsupported(f"`{name}`", call.span, scope))
        return stepping(name, call, values, scope)
    if name in REWRITTEN:
        count_arguments(name, call, *REWRITTEN[name], scope)
        return _rewritten(name, call, values, scope)
    function = FUNCTIONS.get(name)
    if function is None or function.kind == "operator":
        assert isinstance(call.func, ast.Name)
        return scope.unknown(call.func, called=True)
    if function.kind == "sampler" and not scope.samplers:
        message = f"`{name}` draws at random, which only initial states and events can"
        scope.fail(Diagnostic("E205" if scope.in_spec else "S201", message, call.span))
    return _function(name, call, values, scope)


def unsupported(what: str, span: Span, scope: Scope) -> Diagnostic:
    """Return the error for a construct that is not supported: S201 in a system file, else E015."""
    if not scope.in_spec:
        return Diagnostic("S201", f"{what} is not part of the expression language of system files", span)
    return Diagnostic("E015", f"{what} is not compiled by this version", span)


def count_arguments(name: str, call: ast.Call, least: int, most: int | None, scope: Scope) -> None:
    """Raise Failed (E105) if a call has fewer than `least` or more than `most` arguments.

    If `most` is None, the number of arguments has no upper limit.
    """
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


def _positional(name: str, call: ast.Call, scope: Scope, *help_: str) -> None:
    """Raise Failed (E105) if an argument of a call is named; `help_` are hints for the message."""
    for arg in call.args:
        if arg.name is not None:
            message = f"`{name}` has no argument called `{arg.name}`"
            scope.fail(Diagnostic("E105", message, arg.span, help=help_))


def _function(name: str, call: ast.Call, values: Sequence[Value], scope: Scope) -> Value:
    """Return the value of a call of a function in the table `FUNCTIONS`.

    A function that takes any number of arguments, such as `min`, is applied once, to the components of all
    arguments together. Any other function is applied component by component.
    """
    items: list[Number | VectorValue] = []
    for index, (arg, value) in enumerate(zip(call.args, values, strict=True), start=1):
        need = Expectation(f"`{name}` takes numbers", f"argument {index}")
        if isinstance(value, VectorValue):
            items.append(value)
        elif name == "choice":
            items.append(loose_number(value, arg.value, need, scope))
        else:
            items.append(as_number(value, arg.value, need, scope))
    function = FUNCTIONS[name]
    if function.most is None and function.kind == "function" and items:
        flat = [n for item in items for n in (item.items if isinstance(item, VectorValue) else (item,))]
        return apply(name, flat, call.span, scope) if flat else Number(ir.Const(0.0), span=call.span)
    count_arguments(name, call, function.least, function.most, scope)
    return broadcast(name, items, call.span, scope)


def _rewritten(name: str, call: ast.Call, values: Sequence[Value], scope: Scope) -> Value:
    span, exprs = call.span, [arg.value for arg in call.args]
    if name in ("deg", "rad"):
        angle = as_number(values[0], exprs[0], Expectation(f"`{name}` converts an angle"), scope)
        ratio = Fraction(math.pi) / 180  # an angle in degrees is a plain number
        (angle, _), _ = agree((angle, Number(ir.Const(1.0))), f"`{name}`", span, scope)
        factor = literal(1 / ratio if name == "deg" else ratio, span)
        return replace(apply("mul", (angle, factor), span, scope), flexible=False, bare=False)
    if name == "sdist":
        point = as_vector(values[0], exprs[0], Expectation("`sdist` takes a point"), scope)
        place = values[1]
        if not isinstance(place, REGION_TYPES):
            scope.fail(Diagnostic("E205", f"`sdist` takes a region, this is {noun(place)}", exprs[1].span))
        return signed_distance(point, place, span, scope)
    left, right = (
        as_vector(value, expr, Expectation(f"`{name}` takes two vectors", f"argument {index}"), scope)
        for index, (value, expr) in enumerate(zip(values, exprs, strict=True), start=1)
    )
    if name == "cross":
        return cross(left, right, span, scope)
    return (
        dot(left, right, span, scope) if name == "dot" else norm(minus(left, right, span, scope), span, scope)
    )


def _indicator(call: ast.Call, values: Sequence[Value], scope: Scope) -> Number:
    """Return `ind(phi, sharpness = w)`: 1 where the state formula phi holds, else 0.

    In training the indicator is smoothed with the factor w (`stlc.compile.ir.nodes.Indicator`).
    """
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
        width = as_number(values[1], arg.value, Expectation("the sharpness of `ind` is a number"), scope)
        sharpness = width.constant
        if sharpness is None or sharpness <= 0:
            scope.fail(Diagnostic("E205", "the sharpness of `ind` is a positive constant", arg.value.span))
    cond = as_state_formula(values[0], call.args[0].value, Expectation("`ind`", "argument 1"), scope)
    if cond.constant is not None:
        return replace(literal(int(cond.constant), call.span), flexible=False, bare=False)
    return Number(cond.indicator(sharpness), kind="int", span=call.span)
