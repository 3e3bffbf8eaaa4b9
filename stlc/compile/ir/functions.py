"""Table of built-in functions: one entry each, read by all parts of the compiler.

An entry gives the number of arguments, their units, implementations for numbers, arrays and C, the derivative
and the range. A function added here is available in the front end, the array back ends, the C code with its
gradients, interval arithmetic and the editors.

An `ir.Op` refers to an entry by its name. Functions that the front end rewrites to arithmetic (`REWRITTEN`)
have no entry.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import reduce
from itertools import product
from types import MappingProxyType
from typing import Any, Final, Literal, TypeAlias

UnitRule: TypeAlias = Literal["same", "mul", "div", "pow", "sqrt", "square", "plain", "ratio", "sign"]
FunctionKind: TypeAlias = Literal["operator", "function", "sampler"]
Bounds: TypeAlias = tuple[float, float]
RangeRule: TypeAlias = Callable[[Sequence[Bounds]], Bounds]
DomainRule: TypeAlias = Callable[[Sequence[Bounds]], bool]

SHARED: Final = "shared"
"""Derivative of `min`, `max` and `clip`: operands that are equal share it."""


@dataclass(frozen=True, slots=True)
class Function:
    """Entry of the table of built-in functions.

    Attributes:
        name: name of the function in an `ir.Op`.
        least: smallest number of arguments.
        most: largest number of arguments; None if there is no limit.
        rule: units of arguments and result. `same`: arguments and result have one unit. `plain`: neither has
            dimensions. `ratio`: the arguments have one unit, the result has no dimensions. `sign`: the
            arguments have any unit, the result has no dimensions. `mul`, `div`, `pow`, `sqrt`, `square`:
            units are multiplied, divided, … like the numbers.
        kind: `operator` for a function that is written with a sign; `sampler` for a function that draws
            random values, only in initial sets and events; `function` for any other.
        doc: one sentence for editors; "" for operators.
        fold: Python function that computes the value for constant arguments (exactly for `Fraction`s if
            `exact`); None for samplers.
        array: function that appends the array operations for the function to a tape
            (`stlc.compile.backends.array.tape`), a list of such operations, and returns the result. If it is
            None, the function of the same name of the array library is called.
        numpy: name of the function in NumPy; "" if `NumpyOps` defines the function itself.
        torch: name of the function in torch; "" if `TorchOps` defines the function itself.
        c: function from the C expressions of the arguments to the C expression of the result; for `min` and
            `max`, of two arguments.
        slopes: function from the C expressions of the result and of the arguments to the C expressions of the
            derivatives, one per argument. `SHARED` for `min`, `max` and `clip`, where operands that are equal
            share the derivative.
        of_each: for a function without `c` and `slopes`: name of the function applied to every argument, and
            name of the function that reduces the results (`norm1` is `abs`, then `add`).
        singular: indices of the arguments by which the derivative may be infinite or NaN where the arguments
            are finite: a quotient's by its divisor, a root's at 0. There the derivative counts as 0, in all
            back ends with gradients.
        bounds: range of the result: a constant pair, or a function of the ranges of the arguments that raises
            ValueError, OverflowError or ZeroDivisionError where it is undefined.
        domain: function from the ranges of the arguments to True if all finite arguments in them give a
            number, neither NaN nor infinite; None if every argument does, up to overflow.
        exact: whether rational arguments give a rational result.
        whole: whether integer arguments give an integer result.
        integral: whether the result is always an integer.
        linear: whether scaling all arguments by a positive factor scales the result by that factor.
        symbol: sign with which an operator is written; "" for others.
    """

    name: str
    least: int
    most: int | None
    rule: UnitRule
    kind: FunctionKind = "function"
    doc: str = ""
    fold: Callable[..., Any] | None = None
    array: Callable[..., Any] | None = None
    numpy: str = ""
    torch: str = ""
    c: Callable[..., str] | None = None
    slopes: Callable[..., Sequence[str]] | Literal["shared"] | None = None
    of_each: tuple[str, str] | None = None
    singular: tuple[int, ...] = ()
    bounds: RangeRule | Bounds | None = None
    domain: DomainRule | None = None
    exact: bool = False
    whole: bool = False
    integral: bool = False
    linear: bool = False
    symbol: str = ""


# ----------------------------------------------------------------------- meanings on numbers


def _sign(x: Any) -> int:
    return int(x > 0) - int(x < 0)


def _norm(*xs: Any) -> float:
    return math.hypot(*(float(x) for x in xs))


def _pow(base: Any, exponent: Any) -> Any:
    """Return the power; a rational base with a small integer exponent stays rational."""
    if isinstance(base, Fraction) and isinstance(exponent, Fraction):
        if exponent.denominator == 1 and abs(exponent) <= 64:
            return base ** int(exponent)
        return math.pow(base, exponent)
    return math.pow(base, exponent)


# ------------------------------------------------------------------------------------ ranges


def _corners(fold: Callable[..., Any]) -> RangeRule:
    """Return the range rule of a function that is monotone in each argument.

    A range rule is the function from the ranges of the arguments to the range of the result. The extremes are
    among the values at the corners: every argument at its least or greatest value.
    """

    def rule(args: Sequence[Bounds]) -> Bounds:
        values = [float(fold(*corner)) for corner in product(*args)]
        return (min(values), max(values))

    return rule


def _quotient(args: Sequence[Bounds]) -> Bounds:
    low, high = args[1]
    if low <= 0 <= high:
        return (-math.inf, math.inf)
    return _corners(operator.truediv)(args)


def _even(args: Sequence[Bounds]) -> Bounds:
    low, high = args[0]
    top = max(abs(low), abs(high))
    return (0.0 if low <= 0 <= high else min(abs(low), abs(high)), top)


def _squared(args: Sequence[Bounds]) -> Bounds:
    low, high = _even(args)
    return (low * low, high * high)


def _catenary(args: Sequence[Bounds]) -> Bounds:
    low, high = _even(args)
    return (math.cosh(low), math.cosh(high))


def _modulo(args: Sequence[Bounds]) -> Bounds:
    low, high = args[1]
    return (min(low, 0.0), max(high, 0.0))


def _lengths(combine: Callable[[Sequence[float]], float]) -> RangeRule:
    """Return the range rule of a norm: the function from the ranges of its components to its range.

    `combine` is the norm itself, applied to the least and to the greatest magnitude of each component.
    """

    def rule(args: Sequence[Bounds]) -> Bounds:
        sides = [_even([arg]) for arg in args]
        return (combine([side[0] for side in sides]), combine([side[1] for side in sides]))

    return rule


def _powers(args: Sequence[Bounds]) -> Bounds:
    """Range of a power, monotone in both arguments; ValueError unless the base is positive."""
    if args[0][0] <= 0:
        raise ValueError("not monotone")
    return _corners(math.pow)(args)


# ----------------------------------------------------------------------------------- domains


def _divides(args: Sequence[Bounds]) -> bool:
    low, high = args[1]
    return low > 0 or high < 0


def _has_power(args: Sequence[Bounds]) -> bool:
    (base, _), (low, high) = args
    return base > 0 or (low == high >= 0 and low == math.floor(low))


def _has_root(args: Sequence[Bounds]) -> bool:
    return args[0][0] >= 0


def _has_logarithm(args: Sequence[Bounds]) -> bool:
    return args[0][0] > 0


def _is_sine(args: Sequence[Bounds]) -> bool:
    return args[0][0] >= -1 and args[0][1] <= 1


def _has_exponential(args: Sequence[Bounds]) -> bool:
    return max(map(abs, args[0])) < _OVERFLOW


_OVERFLOW = 700.0
"""Magnitude below which the exponential of a number and of its negative are finite."""


# --------------------------------------------------------------------------------- the table


def _function(
    name: str,
    doc: str,
    rule: UnitRule,
    fold: Callable[..., Any],
    c: str,
    slopes: Sequence[str],
    bounds: RangeRule | Bounds | None = None,
    **rest: Any,
) -> Function:
    """Return the table entry of a function with one argument per slope.

    Args:
        name: as in `Function`.
        doc: as in `Function`.
        rule: as in `Function`.
        fold: as in `Function`.
        c: C expression of the result, in the arguments `{0}`, `{1}`, ….
        slopes: one C expression per argument, for the derivative of the result with respect to this argument.
            The expression may use the arguments `{0}`, `{1}`, … and the result `{r}`.
        bounds: as in `Function`. If it is None, the function is monotone in each argument.
        **rest: other attributes of `Function`.
    """
    return Function(
        name,
        len(slopes),
        len(slopes),
        rule,
        doc=doc,
        fold=fold,
        c=c.format,
        slopes=lambda r, *args: [slope.format(*args, r=r) for slope in slopes],
        bounds=bounds or _corners(fold),
        **rest,
    )


def _operator(name: str, symbol: str, rule: UnitRule, *rest: Any, **flags: Any) -> Function:
    """Return the table entry of an operator; `symbol` is the sign with which it is written.

    The array back ends compute the operator with the method `name` of a tape, which is a list of array
    operations (`stlc.compile.backends.array.tape`). If `flags` contains `numpy`, the name of a NumPy
    function, the array back ends call this function instead.
    """
    flags = {"kind": "operator", "exact": True, "whole": True, **flags}
    if "numpy" not in flags:
        flags["array"] = lambda tape, *xs: getattr(tape, name)(*xs)
    return _function(name, "", rule, *rest, symbol=symbol, **flags)


def _step(name: str, doc: str, fold: Callable[..., Any], kernel: str, c: str, rule: UnitRule) -> Function:
    """Return the table entry of a step function with integer values, such as `floor`; its slope is 0.

    `kernel` is the name of the function in NumPy.
    """
    flags: dict[str, Any] = {"numpy": kernel, "torch": name, "exact": True, "whole": True, "integral": True}
    return _function(name, doc, rule, fold, c, ("0.0",), **flags)


def _smooth(
    name: str,
    doc: str,
    slope: str,
    bounds: RangeRule | Bounds | None,
    kernel: str = "",
    domain: DomainRule | None = None,
) -> Function:
    """Return the table entry of a smooth function of one argument.

    `slope` is the C expression of its derivative, in the argument `{0}` and the result `{r}`. `kernel` is the
    name of the function in NumPy, if it differs from `name`. `domain` is as in `Function`; where there is
    one, the derivative is infinite or NaN at its ends and beyond.
    """
    fold, c, numpy = getattr(math, name), f"{name}({{0}})", kernel or name
    rest: dict[str, Any] = {"numpy": numpy, "torch": name, "singular": (0,) if domain else ()}
    return _function(name, doc, "plain", fold, c, (slope,), bounds, domain=domain, **rest)


def _variadic(name: str, doc: str, fold: Callable[..., Any], bounds: RangeRule, **rest: Any) -> Function:
    """Return the table entry of a function of one or more arguments, such as `min`.

    Its arguments have one unit, which is that of the result. Scaling all arguments by a positive factor
    scales the result by that factor (`Function.linear`).
    """
    return Function(name, 1, None, "same", doc=doc, fold=fold, bounds=bounds, linear=True, **rest)


def _sampler(
    name: str, least: int, most: int | None, rule: UnitRule = "same", *, whole: bool = False
) -> Function:
    return Function(name, least, most, rule, "sampler", whole=whole)


_OPERATORS = (
    _operator("add", "+", "same", operator.add, "({0} + {1})", ("1.0", "1.0"), linear=True),
    _operator("sub", "-", "same", operator.sub, "({0} - {1})", ("1.0", "(-1.0)"), linear=True),
    _operator("mul", "*", "mul", operator.mul, "({0} * {1})", ("{1}", "{0}")),
    _operator(
        "div",
        "/",
        "div",
        operator.truediv,
        "({0} / {1})",
        ("(1.0 / {1})", "(-{r} / {1})"),
        _quotient,
        singular=(1,),
        domain=_divides,
        whole=False,
    ),
    _operator(
        "mod",
        "%",
        "same",
        operator.mod,
        "floored_mod({0}, {1})",
        ("1.0", "(-rint(({0} - {r}) / {1}))"),
        _modulo,
        singular=(1,),
        domain=_divides,
        numpy="mod",
        torch="remainder",
    ),
    _operator(
        "pow",
        "^",
        "pow",
        _pow,
        "pow({0}, {1})",
        ("({1} * pow({0}, {1} - 1.0))", "({0} > 0.0 ? {r} * log({0}) : 0.0)"),
        _powers,
        singular=(0, 1),
        domain=_has_power,
        whole=False,
    ),
    _operator("neg", "-", "same", operator.neg, "(-{0})", ("(-1.0)",), linear=True),
    _operator(
        "square",
        "^",
        "square",
        lambda x: x * x,
        "({0} * {0})",
        ("(2.0 * {0})",),
        _squared,
        numpy="square",
        torch="square",
    ),
)

_FUNCTIONS = (
    _function(
        "abs",
        "`abs(x)`: without its sign.",
        "same",
        abs,
        "fabs({0})",
        ("(double)(({0} > 0.0) - ({0} < 0.0))",),
        _even,
        numpy="abs",
        torch="abs",
        exact=True,
        whole=True,
        linear=True,
    ),
    _variadic(
        "min",
        "`min(a, b, …)`: the least.",
        lambda *xs: min(xs),
        _corners(lambda *xs: min(xs)),
        array=lambda tape, *xs: reduce(tape.least, xs),
        c="LEAST({0}, {1})".format,
        slopes=SHARED,
        exact=True,
        whole=True,
    ),
    _variadic(
        "max",
        "`max(a, b, …)`: the greatest.",
        lambda *xs: max(xs),
        _corners(lambda *xs: max(xs)),
        array=lambda tape, *xs: reduce(tape.greatest, xs),
        c="MOST({0}, {1})".format,
        slopes=SHARED,
        exact=True,
        whole=True,
    ),
    Function(
        "clip",
        3,
        3,
        "same",
        doc="`clip(x, low, high)`: x, kept between low and high.",
        fold=lambda x, low, high: min(max(x, low), high),
        array=lambda tape, x, low, high: tape.least(tape.greatest(x, low), high),
        c="LEAST(MOST({0}, {1}), {2})".format,
        slopes=SHARED,
        bounds=_corners(lambda x, low, high: min(max(x, low), high)),
        exact=True,
        whole=True,
    ),
    _function(
        "relu",
        "`relu(x)`: x where it is positive, else 0.",
        "same",
        lambda x: max(x, 0),
        "MAX({0}, 0.0)",
        ("(double)({0} >= 0.0)",),
        array=lambda tape, x: tape.greatest(x, 0.0),
        exact=True,
        whole=True,
        linear=True,
    ),
    _step("floor", "`floor(x)`: the next whole number below.", math.floor, "floor", "floor({0})", "same"),
    _step("ceil", "`ceil(x)`: the next whole number above.", math.ceil, "ceil", "ceil({0})", "same"),
    _step("round", "`round(x)`: the nearest whole number.", round, "rint", "rint({0})", "same"),
    _step("sign", "`sign(x)`: -1, 0 or 1.", _sign, "sign", "(double)(({0} > 0.0) - ({0} < 0.0))", "sign"),
    _function(
        "sqrt",
        "`sqrt(x)`: the square root; of a unit too.",
        "sqrt",
        math.sqrt,
        "sqrt({0})",
        ("(0.5 / {r})",),
        singular=(0,),
        domain=_has_root,
        numpy="sqrt",
        torch="sqrt",
    ),
    _smooth("exp", "`exp(x)` of a plain number.", "{r}", None, domain=_has_exponential),
    _smooth(
        "log",
        "`log(x)`: the natural logarithm of a plain number.",
        "(1.0 / {0})",
        None,
        domain=_has_logarithm,
    ),
    _smooth(
        "log10",
        "`log10(x)`: the logarithm of a plain number to the base 10.",
        f"({1.0 / math.log(10.0)!r} / {{0}})",
        None,
        domain=_has_logarithm,
    ),
    _smooth("sin", "`sin(x)` of an angle.", "cos({0})", (-1.0, 1.0)),
    _smooth("cos", "`cos(x)` of an angle.", "(-sin({0}))", (-1.0, 1.0)),
    _smooth("tan", "`tan(x)` of an angle.", "(1.0 + {r} * {r})", (-math.inf, math.inf)),
    _smooth(
        "sinh",
        "`sinh(x)`: the hyperbolic sine of a plain number.",
        "cosh({0})",
        None,
        domain=_has_exponential,
    ),
    _smooth(
        "cosh",
        "`cosh(x)`: the hyperbolic cosine of a plain number.",
        "sinh({0})",
        _catenary,
        domain=_has_exponential,
    ),
    _smooth("tanh", "`tanh(x)`: the hyperbolic tangent of a plain number.", "(1.0 - {r} * {r})", (-1.0, 1.0)),
    _smooth("asin", "`asin(x)`: an angle.", "(1.0 / sqrt(1.0 - {0} * {0}))", None, "arcsin", _is_sine),
    _smooth("acos", "`acos(x)`: an angle.", "(-1.0 / sqrt(1.0 - {0} * {0}))", None, "arccos", _is_sine),
    _smooth("atan", "`atan(x)`: an angle.", "(1.0 / (1.0 + {0} * {0}))", None, "arctan"),
    _function(
        "atan2",
        "`atan2(y, x)`: the angle of the vector [x, y].",
        "ratio",
        math.atan2,
        "atan2({0}, {1})",
        ("({1} / ({0} * {0} + {1} * {1}))", "(-{0} / ({0} * {0} + {1} * {1}))"),
        (-math.pi, math.pi),
        singular=(0, 1),
        numpy="arctan2",
    ),
    _variadic(
        "norm",
        "`norm(v)`: the Euclidean length.",
        _norm,
        _lengths(lambda sides: math.hypot(*sides)),
        array=lambda tape, *xs: tape.norm(*xs),
        c=lambda *xs: "sqrt(" + " + ".join(f"{x} * {x}" for x in xs) + ")",
        slopes=lambda r, *xs: [f"({r} > 0.0 ? {x} / {r} : 0.0)" for x in xs],
    ),
    _variadic(
        "norm1",
        "`norm1(v)`: the sum of the absolute values.",
        lambda *xs: sum(map(abs, xs)),
        _lengths(math.fsum),
        array=lambda tape, *xs: reduce(tape.add, [tape.call("abs", x) for x in xs]),
        of_each=("abs", "add"),
        exact=True,
        whole=True,
    ),
    _variadic(
        "norminf",
        "`norminf(v)`: the greatest absolute value.",
        lambda *xs: max(map(abs, xs)),
        _lengths(max),
        array=lambda tape, *xs: reduce(tape.greatest, [tape.call("abs", x) for x in xs]),
        of_each=("abs", "max"),
        exact=True,
        whole=True,
    ),
)

_SAMPLERS = (
    _sampler("uniform", 2, 2),
    _sampler("normal", 2, 2),
    _sampler("truncnorm", 4, 4),
    _sampler("bernoulli", 1, 1, "plain", whole=True),
    _sampler("choice", 1, None, whole=True),
    _sampler("randint", 2, 2, whole=True),
)

FUNCTIONS: Mapping[str, Function] = MappingProxyType(
    {function.name: function for function in (*_OPERATORS, *_FUNCTIONS, *_SAMPLERS)}
)
"""Table of built-in functions: entry by name, to which an `ir.Op` refers."""

REWRITTEN: Mapping[str, tuple[int, int | None]] = MappingProxyType(
    {
        "dot": (2, 2),
        "cross": (2, 2),
        "dist": (2, 2),
        "deg": (1, 1),
        "rad": (1, 1),
        "sdist": (2, 2),
        "ind": (1, 2),
    }
)
"""Functions that the front end rewrites to arithmetic -> least and largest number of arguments."""

REGIONS: tuple[str, ...] = (
    *("circle", "ball", "box", "polygon", "halfspace"),
    *("union", "intersect", "complement", "dilate"),
)
"""Functions that construct regions."""

OPERATORS: Mapping[str, str] = MappingProxyType(
    {function.symbol: function.name for function in _OPERATORS if function.least == 2}
)
"""Sign of an arithmetic operator with two operands -> name of its function."""

STEPPING: Mapping[str, tuple[int, int]] = MappingProxyType(
    {
        **dict.fromkeys(("next", "prev", "rise", "fall"), (1, 1)),
        **{"shift": (2, 2), "delta": (1, 1), "sweep": (1, 1)},
    }
)
"""Functions that read other samples -> least and largest number of arguments."""


def callable_names() -> tuple[str, ...]:
    """Return all callable built-in names except samplers, the functions that draw random values."""
    table = (name for name, function in FUNCTIONS.items() if function.kind == "function")
    return (*table, *REWRITTEN, *REGIONS, *STEPPING)


def sampler_names() -> tuple[str, ...]:
    """Return the names of the samplers, the functions that draw random values."""
    return tuple(name for name, function in FUNCTIONS.items() if function.kind == "sampler")
