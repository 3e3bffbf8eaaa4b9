"""Arithmetic on numbers and vectors: unit checks, constant folding, broadcasting.

A number in a unit with an offset, such as 20 degC, is a temperature, as opposed to a temperature difference.
Temperatures can be compared, and selected by `if`, `min` and `max`; the difference of two is in kelvin; a
temperature plus kelvin is a temperature. `abs` and other magnitudes reject temperatures in degC, all other
functions convert them to kelvin.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction
from functools import reduce
from typing import Literal

from stlc.compile.frontend.scope import Scope
from stlc.compile.frontend.values import Number, VectorValue, literal, unit_text
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.functions import FUNCTIONS, Function
from stlc.compile.ir.ranges import bounds
from stlc.diagnostics import Diagnostic
from stlc.signature import Kind
from stlc.source import Span
from stlc.units import Unit, nearest

_MAX_BITS = 512
_QUANTITY = re.compile(r"(-? *[\d.]+(?:[eE][+-]?\d+)?) *(?:[^\W\d]|°)\S*")
"""Pattern of a number with its unit in the source."""
_OF_POINTS = ("min", "max", "clip", "choice", "uniform")
"""Functions that select among temperatures in degC, or draw between them."""

_LENGTHS = ("abs", "norm", "norm1", "norminf")
_TEMPERATURE = Unit.SYMBOLS["K"].dims
_MISSING = {
    Unit.SYMBOLS["m"].dims: ("length", "m"),
    Unit.SYMBOLS["kg"].dims: ("mass", "kg"),
    Unit.SYMBOLS["s"].dims: ("time", "s"),
}


def apply(name: str, args: Sequence[Number], span: Span, scope: Scope) -> Number:
    """Return `name(args)`, with units checked and constants folded.

    Args:
        name: name of an entry of `stlc.compile.ir.functions.FUNCTIONS`.
        args: arguments, as many as the function takes.
        span: source location of the whole expression, for findings.
        scope: receives findings.

    Raises:
        Failed: units do not agree (E203), a divisor is zero (E401), or the function has no value for its
            constant arguments (E205). The error has been added to `scope`.
    """
    function = FUNCTIONS[name]
    for arg in args:
        if arg.kind == "enum" and name != "choice":
            members = ", ".join(f"`{label}`" for label, _ in arg.labels)
            help_ = f"compare it with one of its members: {members}"
            message = f"`{function.symbol or name}` does not apply to an enum"
            scope.fail(Diagnostic("E205", message, arg.span or span, help=(help_,)))
    typed_args, template = _units(function, args, span, scope)
    if name in ("div", "mod"):
        _check_divisor(function, typed_args[1], span, scope)
    if function.fold is not None and all(arg.constant is not None for arg in typed_args):
        return _fold(function, typed_args, template, scope)
    kind: Kind = (
        "bool" if name == "bernoulli" else "int" if _whole(function, typed_args, template) else "real"
    )
    if name == "choice" and len({(arg.kind, arg.labels) for arg in typed_args}) == 1:
        return replace(
            template, num=_op(name, typed_args), kind=typed_args[0].kind, labels=typed_args[0].labels
        )
    return replace(template, num=_op(name, typed_args), kind=kind)


def agree(args: Sequence[Number], what: str, span: Span, scope: Scope) -> tuple[tuple[Number, ...], Number]:
    """Convert numbers to a common unit. A number without a unit takes the unit of the others.

    Args:
        args: the numbers; those with a unit must have units of the same dimensions.
        what: verb for the message: "compare", "add", or the name of a function.
        span: source location for the finding.
        scope: receives findings.

    Returns:
        The converted numbers, and a template for the result: the number 0 in the common unit. The caller
        replaces the 0.

    Raises:
        Failed: the units do not agree (E203).
    """
    rigid = [arg for arg in args if not arg.flexible]
    for other in rigid[1:]:
        if not rigid[0].unit.same_dims(other.unit):
            scope.fail(_mismatch(rigid[0], other, what, span))
    if any(arg.unit.offset for arg in args):
        return _on_one_scale(args, what, span, scope)
    known = rigid or [arg for arg in args if not arg.bare]
    if not known:
        return tuple(args), Number(ir.Const(0.0), Unit.ONE, True, True, span=span)
    unit, senses = known[0].unit, {arg.sense for arg in args}
    sense: Sense = "open" if "open" in senses else "difference" if "difference" in senses else ""
    bare = next((arg for arg in args if arg.bare), None)
    if bare is not None and sense == "open":
        scope.fail(_which(bare, Unit.SYMBOLS["degC"], span))
    blank = Number(ir.Const(0.0), unit, not rigid, sense=sense, span=span)
    return tuple(in_unit(arg, unit, scope) if arg.bare else arg for arg in args), blank


def gap(left: Number, right: Number, span: Span, scope: Scope) -> Number:
    """Return `left - right`, which is in kelvin if one of them is a temperature in degC.

    Raises:
        Failed: the units do not agree (E203).
    """
    if not (left.unit.offset or right.unit.offset):
        return apply("sub", (left, right), span, scope)
    sides, _ = agree((left, right), "subtract", span, scope)
    plain = [replace(side, unit=side.unit.interval, sense="") for side in sides]
    return replace(apply("sub", plain, span, scope), sense="difference")


def rebased(number: Number, unit: Unit) -> Number:
    """Return `number` converted to `unit`, which has the same dimensions: 20 degC becomes 293.15 K."""
    shift = number.unit.offset - unit.offset
    if not shift:
        return replace(number, unit=unit)
    value, amount = number.constant, float(shift)
    exact = None if number.exact is None else number.exact + shift
    num: ir.Num
    match number.num:
        case ir.Const():
            assert value is not None
            num = ir.Const(nearest(exact) if exact is not None else value + amount)
        case ir.Op("add" | "sub" as name, (inner, ir.Const(before))) if before == (
            -amount if name == "add" else amount
        ):
            num = inner
        case inner:
            num = inner.apply("add" if amount > 0 else "sub", abs(amount))
    return replace(number, num=num, unit=unit, exact=exact, kind="real", sense="")


def absolute(number: Number) -> Number:
    """Return `number` in a unit without an offset: 20 degC becomes 293.15 K."""
    return rebased(number, number.unit.interval)


def on_scale(number: Number, unit: Unit, place: Span | None, scope: Scope) -> Number:
    """Return `number` converted to `unit`, which has the same dimensions, with a check.

    A temperature difference cannot be converted to a temperature in degC. `place` is the source location for
    the error.

    Raises:
        Failed: `number` is a temperature difference, and `unit` has an offset, such as degC (E203).
    """
    if unit.offset and number.sense == "difference":
        scope.fail(difference_for_point(number, unit, place))
    return rebased(number, unit)


def difference_for_point(number: Number, unit: Unit, place: Span | None) -> Diagnostic:
    """Return the error E203 for a temperature difference where a temperature in `unit` is needed.

    `place` is the source location for the error.
    """
    message = f"a difference of temperatures, in [{unit.interval}], is no temperature in [{unit}]"
    help_ = (f"declare it in [{unit.interval}], or add it to a temperature: `20 {unit} + …`",)
    return Diagnostic("E203", message, number.span or place, "a difference", help=help_)


def too_large(span: Span | None) -> Diagnostic:
    """Return the error E005 for a number that exceeds the range of double precision."""
    return Diagnostic(
        "E005",
        "this number is beyond double precision",
        span,
        note=("in SI units the largest is about 1.8e308",),
    )


def in_unit(number: Number, unit: Unit, scope: Scope) -> Number:
    """Return a number that was written without a unit as a number of `unit`: for deg, 30 becomes 30 deg.

    Raises:
        Failed: the result exceeds the range of double precision (E005).
    """
    if unit.ratio == 1:
        return replace(number, unit=unit, bare=False, flexible=False)
    exact = None if number.exact is None else number.exact * unit.ratio
    value = number.constant
    num: ir.Num = number.num * unit.scale
    if value is not None:
        stored = nearest(exact) if exact is not None else value * unit.scale
        if not math.isfinite(stored):
            scope.fail(too_large(number.span))
        num = ir.Const(stored)
    return replace(number, num=num, unit=unit, exact=exact, kind="real", bare=False, flexible=False)


def _units(
    function: Function, args: Sequence[Number], span: Span, scope: Scope
) -> tuple[tuple[Number, ...], Number]:
    """Convert the arguments of a function as its unit rule (`Function.rule`) requires.

    Return the converted arguments, and a template for the result: the number 0 in the unit of the function's
    result. The caller replaces the 0.
    """
    flexible, bare = any(arg.flexible for arg in args), all(arg.bare for arg in args)
    if function.rule == "same":
        return _alike(function, args, span, scope)
    scaled = _scaled_point(function, args)
    if function.rule == "sign":
        args = [_length(function, arg, span, scope) for arg in args]
    args = [absolute(arg) for arg in args]
    match function.rule:
        case "ratio":
            return agree(args, _verb(function), span, scope)[0], Number(ir.Const(0.0), span=span)
        case "mul":
            unit = args[0].unit * args[1].unit
        case "div":
            unit = args[0].unit / args[1].unit
        case "square":
            unit = args[0].unit ** 2
        case "sqrt":
            unit = _root(args[0], span, scope)
        case "pow":
            unit = _power(args[0], args[1], span, scope)
            flexible, bare = args[0].flexible, args[0].bare
        case "plain" | "sign":
            if function.rule == "plain":
                _check_plain(function, args, scope)
            unit, flexible = Unit.ONE, bare
    sense: Sense = "difference" if _length_or_multiple(function, args, unit) else "open" if scaled else ""
    return tuple(args), Number(ir.Const(0.0), unit, flexible, bare, sense=sense, span=span)


# ---------------------------------------------------------------------- points of a scale

Sense = Literal["", "difference", "open"]
Agreed = tuple[tuple[Number, ...], Number]


def _alike(function: Function, args: Sequence[Number], span: Span, scope: Scope) -> Agreed:
    """Convert all arguments of a function to one unit (unit rule `same`).

    Return the converted arguments, and a template for the result: the number 0 in the unit of the function's
    result. The caller replaces the 0.
    """
    name, verb = function.name, _verb(function)
    if name in ("normal", "truncnorm"):
        return _spread(function, args, span, scope)
    if name in ("add", "sub") and any(arg.unit.offset for arg in args):
        return _sum(function, (args[0], args[1]), span, scope)
    if name not in ("add", "sub", *_OF_POINTS):
        args = [_length(function, arg, span, scope) for arg in args]
    found, blank = agree(args, verb, span, scope)
    if name in _LENGTHS and blank.unit.dims == _TEMPERATURE:
        blank = replace(blank, sense="difference")
    elif blank.sense == "difference" and any(not arg.sense and arg.constant is None for arg in args):
        blank = replace(blank, sense="")
    return found, blank


def _length_or_multiple(function: Function, args: Sequence[Number], unit: Unit) -> bool:
    """True if the result of a function is a temperature difference.

    There are two cases. First, a temperature difference multiplied or divided by a plain number. Second, a
    root or power whose result is in kelvin, such as `sqrt(x)` with x in K^2. `unit` is the unit of the
    result.
    """
    if function.rule in ("sqrt", "pow"):
        return unit.dims == _TEMPERATURE != args[0].unit.dims
    if function.rule not in ("mul", "div"):
        return False
    first, second = args
    if second.sense == "difference" and function.rule == "mul":
        first, second = second, first
    return first.sense == "difference" and not second.sense and second.unit.dimensionless


def _scaled_point(function: Function, args: Sequence[Number]) -> bool:
    """True if a temperature in degC is multiplied or divided by a plain number, as in `0.5 * temp`."""
    points = [arg for arg in args if arg.unit.offset or arg.sense == "open"]
    rest = [arg for arg in args if arg not in points]
    plain = all(arg.bare or (arg.unit.dimensionless and not arg.flexible) for arg in rest)
    first = function.rule == "mul" or (function.rule == "div" and points[:1] == [args[0]])
    return first and len(points) == 1 and plain


def _on_one_scale(args: Sequence[Number], what: str, span: Span, scope: Scope) -> Agreed:
    """Convert numbers, some of them temperatures in degC, to a common unit.

    If one of the numbers is a temperature difference, the common unit is kelvin. Otherwise, if there are
    varying numbers and all of them have the same unit, that is the common unit. In all other cases, it is
    degC. `what` names the operator or function for the message.

    Return the converted numbers, and a template for the result: the number 0 in the common unit. The caller
    replaces the 0.
    """
    points = [arg for arg in args if arg.unit.offset]
    measured = [arg for arg in args if not arg.bare]
    bare = next((arg for arg in args if arg.bare), None)
    difference = next((arg for arg in measured if arg.sense == "difference"), None)
    undecided = all(arg.sense == "open" for arg in points)
    if difference is not None:
        if not undecided:
            fixed = next(arg for arg in points if arg.sense != "open")
            scope.fail(_compared_with_point(difference, fixed, what, span))
        unit = points[0].unit.interval
    else:
        varying = [arg for arg in measured if arg.constant is None]
        moved = next((arg for arg in varying if arg.unit.offset), None) or next(iter(varying), points[0])
        unit = moved.unit if moved.unit.offset else points[0].unit.interval
        if bare is not None and (undecided or not unit.offset):
            scope.fail(_which(bare, points[0].unit, span))
    sense: Sense = "difference" if difference is not None else "open" if undecided and unit.offset else ""
    blank = Number(ir.Const(0.0), unit, sense=sense, span=span)
    return tuple(in_unit(arg, unit, scope) if arg.bare else rebased(arg, unit) for arg in args), blank


def _sum(function: Function, args: tuple[Number, Number], span: Span, scope: Scope) -> Agreed:
    """Convert the operands of a sum or difference, one or both of which are temperatures in degC.

    Return the converted operands, and a template for the result: the number 0 in the unit of the result. The
    caller replaces the 0.
    """
    left, right = args
    first = left.unit.offset and (not right.unit.offset or left.sense != "open")
    point, other = (left, right) if first else (right, left)
    if not other.flexible and not point.unit.same_dims(other.unit):
        scope.fail(_mismatch(left, right, _verb(function), span))
    if function.name == "sub" and right.unit.offset:
        return _less_point(left, right, span, scope)
    if other.sense == "open":
        other = absolute(other)
    elif other.unit.offset:
        scope.fail(_sum_of_points(left, right, span))
    if other.bare and function.name == "sub":
        scope.fail(_which(other, point.unit, span))
    if other.bare:
        other = in_unit(other, point.unit.interval, scope)
    drops = function.name == "sub" and other.constant is None and other.sense != "difference"
    blank = Number(ir.Const(0.0), point.unit, sense="open" if drops else point.sense, span=span)
    return (point, other) if first else (other, point), blank


def _less_point(left: Number, right: Number, span: Span, scope: Scope) -> Agreed:
    """Convert the operands of `left - right`, where `right` is a temperature in degC.

    The result of the subtraction is a temperature difference. There is one exception: if `right` may be
    either a temperature or a difference (`Number.sense` is `open`), the result may be either, too.

    Return the converted operands, and a template for the result: the number 0 in the unit of the result. The
    caller replaces the 0.
    """
    if right.sense == "open" and not left.bare and left.sense != "difference":
        sense: Sense = "open" if left.unit.offset else ""
        return (left, absolute(right)), Number(
            ir.Const(0.0), left.unit, left.flexible, sense=sense, span=span
        )
    found, _ = agree((left, right), "subtract", span, scope)
    return found, Number(ir.Const(0.0), right.unit.interval, sense="difference", span=span)


def _spread(function: Function, args: Sequence[Number], span: Span, scope: Scope) -> Agreed:
    """Convert the arguments of `normal` and `truncnorm` to one unit.

    Mean and bounds may be temperatures in degC; the standard deviation is a temperature difference.

    Return the converted arguments, and a template for the result: the number 0 in the unit of the function's
    result. The caller replaces the 0.
    """
    middle, deviation, *ends = args
    places = [middle, *ends]
    if deviation.unit.offset:
        scope.fail(point_for_amount(f"the deviation of `{function.name}`", deviation, span))
    point = next((place for place in places if place.unit.offset), None)
    if point is None:
        found, blank = agree(args, _verb(function), span, scope)
        is_difference = not deviation.bare and deviation.unit.dims == _TEMPERATURE
        around = is_difference and all(place.bare for place in places)
        return found, replace(blank, sense="difference" if around else blank.sense)
    if not deviation.flexible and not point.unit.same_dims(deviation.unit):
        scope.fail(_mismatch(middle, deviation, _verb(function), span))
    (middle, *ends), blank = agree(places, _verb(function), span, scope)
    if deviation.bare:
        deviation = in_unit(deviation, blank.unit.interval, scope)
    return (middle, deviation, *ends), blank


def _length(function: Function, arg: Number, span: Span, scope: Scope) -> Number:
    """Return `arg`, the argument of a function such as `abs`, which takes no temperatures in degC.

    If `arg` is in degC, but may be a temperature difference (`Number.sense` is `open`), it is returned as a
    difference in kelvin. A number in any other unit is returned unchanged.

    Raises:
        Failed: the argument is a temperature in degC (E203).
    """
    if not arg.unit.offset:
        return arg
    if arg.sense == "open":
        return replace(absolute(arg), sense="difference")
    name = function.symbol or function.name
    return scope.fail(point_for_amount(f"`{name}`", arg, span))


def refuse_point(what: str, number: Number, span: Span, scope: Scope) -> None:
    """Raise Failed (E203) if a number is a temperature in degC where an amount is needed.

    An amount is needed in `abs(x)`, for example. `what` names the operator or function for the message.
    """
    if number.unit.offset:
        scope.fail(point_for_amount(what, number, span))


def point_for_amount(what: str, number: Number, span: Span) -> Diagnostic:
    """Return the error E203 for a temperature in degC where an amount is needed.

    An amount is needed in `abs(x)`, for example. `what` names the operator or function for the message.
    """
    unit = number.unit
    text = (number.span or span).text
    written = _QUANTITY.fullmatch(text)
    help_ = (
        f"write the amount in [{unit.interval}]: `{written[1]} {unit.interval}`"
        if written is not None
        else f"subtract another one first: `{text} - 20 {unit}` is a difference in [{unit.interval}]"
    )
    message = f"{what} takes no temperature in [{unit}], which counts from 0 {unit}"
    return Diagnostic("E203", message, number.span or span, f"[{unit}]", help=(help_,))


def _compared_with_point(difference: Number, point: Number, what: str, span: Span) -> Diagnostic:
    """Return the error E203 for a difference compared with a temperature: `abs(temp - 21 degC) <= 0.5 degC`.

    `what` names the operator or function for the message.
    """
    unit = point.unit
    text = (point.span or span).text
    if point.constant is not None:
        label = f"{float(point.constant + unit.offset):g} {unit.interval}"
        help_ = f"write the difference in kelvin: `{point.constant / unit.scale:g} {unit.interval}`"
    else:
        label = f"[{unit}]"
        help_ = f"make it a difference too: `{text} - 0 {unit}`"
    own, said = difference.span, f"a difference, in [{unit.interval}]"
    labels = (own.label(said),) if own is not None and point.span is not None and own != span else ()
    verb = what if what.startswith("`") else f"cannot {what}"
    message = f"{verb} a difference of temperatures with a temperature"
    return Diagnostic("E203", message, point.span or span, label, labels, help=(help_,))


def _sum_of_points(left: Number, right: Number, span: Span) -> Diagnostic:
    unit = right.unit
    first, second = ((side.span or span).text for side in (left, right))
    written = _QUANTITY.fullmatch(second)
    labels = tuple(
        side.span.label(f"[{side.unit}]")
        for side in (left, right)
        if side.span is not None and side.span != span
    )
    help_ = (
        f"a difference is in kelvin: `{first} + {written[1]} {unit.interval}`"
        if written is not None
        else f"a mean of both: `{first} + ({second} - {first}) / 2`"
    )
    return Diagnostic("E203", "cannot add two temperatures", span, labels=labels, help=(help_,))


def _which(bare: Number, unit: Unit, span: Span) -> Diagnostic:
    """Return the error E203 for `bare`, a number without a unit: it may be in `unit` (degC) or in kelvin."""
    text, kelvin = (bare.span or span).text, unit.interval
    help_ = (f"`{text} {unit}` is a temperature, `{text} {kelvin}` a difference or a temperature in kelvin",)
    message = f"`{text}` may be in [{unit}] or in [{kelvin}] here"
    return Diagnostic("E203", message, bare.span or span, "no unit", help=help_)


# ---------------------------------------------------------------------- rules


def _root(arg: Number, span: Span, scope: Scope) -> Unit:
    try:
        return arg.unit ** Fraction(1, 2)
    except ValueError:
        if arg.flexible:
            return Unit.ONE
    return scope.fail(
        Diagnostic("E203", f"the square root of {unit_text(arg)} has no unit", arg.span or span)
    )


def _power(base: Number, exponent: Number, span: Span, scope: Scope) -> Unit:
    if not exponent.flexible and not exponent.unit.dimensionless:
        message = f"an exponent has no unit, this is {unit_text(exponent)}"
        scope.fail(Diagnostic("E203", message, exponent.span or span))
    if base.unit.dimensionless:
        return Unit.ONE
    if exponent.constant is None:
        message = f"{unit_text(base)} to a power that varies has no unit"
        scope.fail(Diagnostic("E203", message, span, help=("use a constant exponent",)))
    try:
        return base.unit ** (exponent.exact if exponent.exact is not None else Fraction(exponent.constant))
    except ValueError as error:
        if base.flexible:
            return Unit.ONE
        return scope.fail(Diagnostic("E203", str(error), span))


def _check_plain(function: Function, args: Sequence[Number], scope: Scope) -> None:
    angle = function.name in ("sin", "cos", "tan")
    wants = "an angle or a plain number" if angle else "a plain number"
    for arg in args:
        if not arg.flexible and not arg.unit.dimensionless:
            message = f"`{function.name}` takes {wants}, this is {unit_text(arg)}"
            help_ = (f"divide by a reference first: `{function.name}(… / 1 {arg.unit})`",)
            scope.fail(Diagnostic("E203", message, arg.span, help=help_))


def _check_divisor(function: Function, divisor: Number, span: Span, scope: Scope) -> None:
    what = "modulo" if function.name == "mod" else "division"
    place = divisor.span or span
    if divisor.constant == 0:
        origin = divisor.origin
        labels = () if origin is None or origin.span is None else (origin.span.label("from here"),)
        amount = "0" if divisor.unit.dimensionless else f"0 {divisor.unit}"
        scope.fail(Diagnostic("E401", f"{what} by zero", place, f"is {amount}", labels))
    reach = bounds(divisor.num, scope.ranges)
    if divisor.constant is None and reach is not None and reach[0] <= 0 <= reach[1]:
        low, high = (f"{end / divisor.unit.scale:g}" for end in reach)
        unit = "" if divisor.unit.dimensionless and not divisor.unit.text else f" {divisor.unit}"
        text = f"between {low} and {high}{unit}"
        help_ = ("multiply by it instead, when its sign is known",)
        scope.report(Diagnostic("W402", "the divisor's range contains 0", place, text, help=help_))


def _op(name: str, args: Sequence[Number]) -> ir.Num:
    """Return the IR node of the function `name` applied to `args`, simplified if possible.

    For example, `x + 0` becomes `x`, and `x ^ 2` becomes `square(x)`.
    """
    nums = tuple(arg.num for arg in args)
    match name, nums:
        case ("add", (num, ir.Const(0.0))) | ("add", (ir.Const(0.0), num)) | ("sub", (num, ir.Const(0.0))):
            return num
        case ("mul", (num, ir.Const(1.0))) | ("mul", (ir.Const(1.0), num)) | ("div", (num, ir.Const(1.0))):
            return num
        case ("min" | "max" | "choice", (num,)):
            return num
        case "pow", (base, ir.Const(exponent)) if exponent in (0.5, 1.0, 2.0):
            return base if exponent == 1.0 else base.apply("sqrt" if exponent == 0.5 else "square")
        case _:
            return ir.Op(name, nums)


def _fold(function: Function, args: Sequence[Number], template: Number, scope: Scope) -> Number:
    """Compute a function of constants, and return its value as a number with the unit of `template`.

    The value is an exact fraction if all arguments are exact and the function turns fractions into fractions.

    Raises:
        Failed: the function has no value for these arguments (E205).
    """
    assert function.fold is not None
    exacts = [arg.exact for arg in args]
    rational = function.exact and all(exact is not None for exact in exacts)
    try:
        result = function.fold(*(exacts if rational else [arg.constant for arg in args]))
        value = float(result)
        if isinstance(result, complex) or not math.isfinite(value):
            raise ValueError("no finite value")
    except (ValueError, TypeError, OverflowError, ZeroDivisionError):
        written = ", ".join(f"{arg.constant:g}" for arg in args)
        name = function.symbol or function.name
        return scope.fail(Diagnostic("E205", f"`{name}` has no value for {written}", template.span))
    exact = Fraction(result) if isinstance(result, Fraction | int) else None
    if exact is not None and max(exact.numerator.bit_length(), exact.denominator.bit_length()) > _MAX_BITS:
        exact = None
    return replace(
        template, num=ir.Const(value), exact=exact, kind="int" if _whole(function, args, template) else "real"
    )


def _whole(function: Function, args: Sequence[Number], template: Number) -> bool:
    """True if the result of a function is an integer, whatever values its arguments take.

    `template` has the unit of the result. `floor` and other roundings give an integer in SI units. In another
    unit, this result need not be an integer: 1500 m is 1.5 km.
    """
    if function.integral:
        return template.unit.ratio == 1
    if function.name == "pow":
        exponent = args[1].exact
        return args[0].kind == "int" and exponent is not None and exponent.denominator == 1 and exponent >= 0
    return function.whole and all(arg.kind == "int" for arg in args)


def _verb(function: Function) -> str:
    verbs = {"add": "add", "sub": "subtract", "mod": "take the modulo of"}
    return verbs.get(function.name, f"`{function.name}`")


def _mismatch(left: Number, right: Number, what: str, span: Span) -> Diagnostic:
    """Return the error E203 for two numbers whose units do not agree.

    The error shows the locations of both numbers and suggests a correction. `what` is a verb for the message,
    such as "add", or the name of a function.
    """
    preposition = {"add": "and", "subtract": "and", "take the modulo of": "and"}.get(what, "with")
    verb = f"cannot {what}" if not what.startswith("`") else f"{what} cannot combine"
    labels = tuple(
        side.span.label(f"[{side.unit}]" + ("" if side.origin is None else f", {side.origin.text}"))
        for side in (left, right)
        if side.span is not None and side.span != span
    )
    headline = f"{verb} [{left.unit}] {preposition} [{right.unit}]"
    return Diagnostic("E203", headline, span, labels=labels, help=_repair(left, right, span))


def _repair(left: Number, right: Number, span: Span) -> tuple[str, ...]:
    drop = "drop the units from the declarations"
    if left.span is None or right.span is None:
        return (drop,)
    sign = span.text.strip()
    for number, other in ((left, right), (right, left)):
        written = _QUANTITY.fullmatch(number.span.text if number.span else "")
        if written and number.constant is not None:
            sides = [side.span.text for side in (left, right) if side.span is not None]
            bare = f" {sign} ".join(written[1] if side == written[0] else side for side in sides)
            return (f"a number without a unit takes the one that is needed, [{other.unit}]: `{bare}`",)
    for numerator, denominator, factor_right in ((left, right, True), (right, left, False)):
        quotient = (numerator.unit.si / denominator.unit.si).dims
        if quotient in _MISSING and sign in ("<", "<=", ">", ">=", "==", "!=", "+", "-"):
            noun, symbol = _MISSING[quotient]
            first, second = left.span.text, right.span.text
            first, second = (
                (first, f"{second} * 1 {symbol}") if factor_right else (f"{first} * 1 {symbol}", second)
            )
            return (f"a {noun} is missing: `{first} {sign} {second}`, or {drop}",)
    return (drop,)


def negated(number: Number, span: Span) -> Number:
    """Return the negated number."""
    value = number.constant
    num: ir.Num = ir.Const(-value) if value is not None else -number.num
    exact = None if number.exact is None else -number.exact
    return replace(number, num=num, exact=exact, span=span, origin=None)


def half(span: Span) -> Number:
    """Return the number 1/2.

    This is the threshold between neighbouring integers, and between `false` (0) and `true` (1).
    """
    return literal(Fraction(1, 2), span)


def broadcast(
    name: str, args: Sequence[Number | VectorValue], span: Span, scope: Scope
) -> Number | VectorValue:
    """Apply the function `name` component by component; a number is repeated for each component of a vector.

    Raises:
        Failed: vectors have different lengths (E205), or the function cannot be applied (see `apply`).
    """
    lengths = {len(arg.items) for arg in args if isinstance(arg, VectorValue)}
    if not lengths:
        return apply(name, [arg for arg in args if isinstance(arg, Number)], span, scope)
    check_lengths(lengths, span, scope)
    size = lengths.pop()
    rows = [arg.items if isinstance(arg, VectorValue) else (arg,) * size for arg in args]
    return VectorValue(tuple(apply(name, row, span, scope) for row in zip(*rows, strict=True)), span=span)


def check_lengths(lengths: set[int], span: Span, scope: Scope) -> None:
    """Raise Failed (E205) for vectors of different lengths."""
    if len(lengths) > 1:
        long, short = sorted(lengths, reverse=True)[:2]
        scope.fail(Diagnostic("E205", f"vectors of {short} and {long} components do not go together", span))


def negate(value: Number | VectorValue, span: Span) -> Number | VectorValue:
    """Return a number or vector with its sign reversed."""
    if isinstance(value, Number):
        return negated(value, span)
    return VectorValue(tuple(negated(item, span) for item in value.items), span=span)


def minus(left: VectorValue, right: VectorValue, span: Span, scope: Scope) -> VectorValue:
    """Return the difference of two vectors of equal length.

    Raises:
        Failed: the units (E203) or the lengths (E205) do not agree.
    """
    check_lengths({len(left.items), len(right.items)}, span, scope)
    pairs = zip(left.items, right.items, strict=True)
    return VectorValue(tuple(gap(a, b, span, scope) for a, b in pairs), span=span)


def norm(vector: VectorValue, span: Span, scope: Scope) -> Number:
    """Return the Euclidean length of a vector."""
    return apply("norm", vector.items, span, scope)


def total(items: Sequence[Number], span: Span, scope: Scope) -> Number:
    """Return the sum of `items`, which contains at least one number."""
    return reduce(lambda a, b: apply("add", (a, b), span, scope), items)


def dot(left: VectorValue, right: VectorValue, span: Span, scope: Scope) -> Number:
    """Return the inner product of two vectors."""
    products = broadcast("mul", (left, right), span, scope)
    assert isinstance(products, VectorValue)
    return total(products.items, span, scope)


def cross(left: VectorValue, right: VectorValue, span: Span, scope: Scope) -> Number | VectorValue:
    """Return the cross product: a number for vectors of 2 components, a vector for those of 3.

    Raises:
        Failed: vectors of other lengths (E205).
    """

    def minor(i: int, j: int) -> Number:
        ahead = apply("mul", (left.items[i], right.items[j]), span, scope)
        back = apply("mul", (left.items[j], right.items[i]), span, scope)
        return apply("sub", (ahead, back), span, scope)

    match len(left.items), len(right.items):
        case 2, 2:
            return minor(0, 1)
        case 3, 3:
            return VectorValue((minor(1, 2), minor(2, 0), minor(0, 1)), span=span)
        case m, n:
            message = f"`cross` takes two vectors of 2 or of 3 components, these have {m} and {n}"
            return scope.fail(Diagnostic("E205", message, span))
