"""Symbolic derivatives of numeric expressions, for integrators that need the Jacobian of the flow.

At a kink, such as that of `abs` at 0, the derivative is that of one side. Conditions have none: the
derivative of `if c then a else b` is that of the chosen branch. A function from outside, whose body is not
known, counts as a constant.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import TypeAlias

from stlc.compile.ir import nodes as ir

Partials: TypeAlias = Callable[..., Sequence[ir.Num | None]]
"""The partial derivatives of a function, from its result and its arguments; None for 0."""
SMALL = 1e-30
"""Least divisor where a derivative is infinite, such as that of `sqrt` at 0."""


def derivative(num: ir.Num, of: str) -> ir.Num | None:
    """Derivative of a numeric expression with respect to the column `of`; None if it is 0 everywhere."""
    return _along(num, {of: ir.Const(1.0)})


def _along(num: ir.Num, slopes: Mapping[str, ir.Num]) -> ir.Num | None:
    """Derivative of an expression, given those of the names in it; names without one are constants."""
    if not num.columns & slopes.keys():
        return None
    match num:
        case ir.Signal(name):
            return slopes.get(name)
        case ir.Where(cond, yes, no):
            return _choice(cond, _along(yes, slopes), _along(no, slopes))
        case ir.Op("min" | "max" as name, (best, *rest)):  # derivative of the first extreme argument
            found = _along(best, slopes)
            for arg in rest:
                gap = best - arg if name == "max" else arg - best
                found = _choice(ir.Predicate(gap), found, _along(arg, slopes))
                best = _call(name, best, arg)
            return found
        case ir.Op("clip", (x, low, high)):
            return _along(_call("min", _call("max", x, low), high), slopes)
        case ir.Op("norminf", args):
            return _along(_call("max", *(_call("abs", arg) for arg in args)), slopes)
        case ir.Op(name, args):
            partials = _PARTIALS.get(name)
            return None if partials is None else _chain(partials(num, *args), args, slopes)
        case ir.Extern(args=args, function=ir.Body()):
            return _chain([_slope_of(num, index) for index in range(len(args))], args, slopes)
        case _:
            return None


def _choice(cond: ir.Formula, yes: ir.Num | None, no: ir.Num | None) -> ir.Num | None:
    """Derivative of a choice, given those of its branches."""
    if yes is None and no is None:
        return None
    return cond.select(yes or ir.Const(0.0), no or ir.Const(0.0))


def _chain(
    partials: Sequence[ir.Num | None], args: Sequence[ir.Num], slopes: Mapping[str, ir.Num]
) -> ir.Num | None:
    """Sum of the partial derivatives, each times the derivative of its argument."""
    parts = [
        _product(partial, slope)
        for partial, slope in zip(partials, (_along(arg, slopes) for arg in args), strict=True)
        if partial is not None and slope is not None
    ]
    return ir.Num.total(parts) if parts else None


def _slope_of(call: ir.Extern, index: int) -> ir.Num | None:
    """Partial derivative of a function with a known body: the derivatives of its local values, in order."""
    body = call.function
    assert isinstance(body, ir.Body)
    formal = body.formals[index]
    slopes: dict[str, ir.Num] = {formal: ir.Const(1.0)}
    lets = list(body.lets)
    for name, num in body.lets:
        found = _along(num, slopes)
        if isinstance(found, ir.Const):
            slopes[name] = found
        elif found is not None:
            lets.append((f"{name}'{formal}", found))
            slopes[name] = ir.Signal(lets[-1][0])
    out = _along(body.outputs[call.output], slopes)
    if out is None or isinstance(out, ir.Const):
        return out
    return ir.Extern(f"{call.name}'{index}", call.args, 0, ir.Body(body.formals, tuple(lets), (out,)))


# ------------------------------------------------------------------------ partial derivatives


def _product(left: ir.Num, right: ir.Num) -> ir.Num:
    if left == ir.Const(1.0):
        return right
    return left if right == ir.Const(1.0) else left * right


def _call(name: str, *args: ir.Num) -> ir.Num:
    return ir.Op(name, args)


def _power(result: ir.Num, base: ir.Num, exponent: ir.Num) -> Sequence[ir.Num | None]:
    one_less = ir.Const(exponent.value - 1.0) if isinstance(exponent, ir.Const) else exponent - 1.0
    by_base = exponent * _call("pow", base, one_less)
    return by_base, result * _call("log", _call("max", base, ir.Const(SMALL)))


def _arc_tangent(_result: ir.Num, y: ir.Num, x: ir.Num) -> Sequence[ir.Num | None]:
    size = _call("max", _call("square", x) + _call("square", y), ir.Const(SMALL))
    return x / size, -(y / size)


def _root(num: ir.Num) -> ir.Num:
    return _call("sqrt", _call("max", 1.0 - _call("square", num), ir.Const(SMALL)))


def _one(slope: Callable[[ir.Num, ir.Num], ir.Num]) -> Partials:
    """Partial derivative of a function of one argument; `slope` gives it from the result and the argument."""
    return lambda result, arg: (slope(result, arg),)


def _norm(result: ir.Num, *args: ir.Num) -> Sequence[ir.Num | None]:
    return [arg / _call("max", result, ir.Const(SMALL)) for arg in args]


_ONE = ir.Const(1.0)
_PARTIALS: Mapping[str, Partials] = MappingProxyType(
    {
        "add": lambda _, _a, _b: (_ONE, _ONE),
        "sub": lambda _, _a, _b: (_ONE, ir.Const(-1.0)),
        "neg": lambda _, _a: (ir.Const(-1.0),),
        "mul": lambda _, a, b: (b, a),
        "div": lambda r, _, b: (_ONE / b, -(r / b)),
        "mod": lambda _, a, b: (_ONE, -_call("floor", a / b)),
        "pow": _power,
        "square": _one(lambda _, x: 2.0 * x),
        "abs": _one(lambda _, x: _call("sign", x)),
        "relu": _one(lambda _, x: ir.Predicate(x).select(_ONE, 0.0)),
        "sqrt": _one(lambda r, _: 0.5 / _call("max", r, ir.Const(SMALL))),
        "exp": _one(lambda r, _: r),
        "log": _one(lambda _, x: _ONE / x),
        "log10": _one(lambda _, x: ir.Const(1.0 / math.log(10.0)) / x),
        "sin": _one(lambda _, x: _call("cos", x)),
        "cos": _one(lambda _, x: -_call("sin", x)),
        "tan": _one(lambda r, _: _ONE + _call("square", r)),
        "sinh": _one(lambda _, x: _call("cosh", x)),
        "cosh": _one(lambda _, x: _call("sinh", x)),
        "tanh": _one(lambda r, _: _ONE - _call("square", r)),
        "asin": _one(lambda _, x: _ONE / _root(x)),
        "acos": _one(lambda _, x: -(_ONE / _root(x))),
        "atan": _one(lambda _, x: _ONE / (_ONE + _call("square", x))),
        "atan2": _arc_tangent,
        "norm": _norm,
        "norm1": lambda _, *xs: [_call("sign", x) for x in xs],
    }
)
"""Partial derivatives by name of a function; functions with steps, such as `floor`, have none."""
