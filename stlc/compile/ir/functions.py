"""The function table: arity, unit rule, and the meaning on plain numbers that constant folding uses.

The names are those of `stlc.compile.ir.nodes.Op`; `stlc.compile.backends.array.arith` evaluates them on
arrays. `dot cross dist deg rad sdist ind` never become an `Op`: `stlc.compile.frontend.calls` rewrites them.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from fractions import Fraction
from types import MappingProxyType
from typing import Any, Literal

Rule = Literal["same", "mul", "div", "pow", "sqrt", "square", "plain", "ratio", "sign"]
Kind = Literal["operator", "function", "sampler"]


@dataclass(frozen=True, slots=True)
class Function:
    """One entry of the table.

    Attributes:
        name: of the `ir.Op`.
        least: smallest number of arguments.
        most: largest number of arguments; None for any.
        rule: units of arguments and result. `same`: all agree, the result too; `plain`: no dimensions;
            `ratio`: arguments agree, the result has no dimensions; `sign`: any argument, no dimensions.
        kind: operators are written with a sign; samplers are only for initial sets and events.
        fold: the value for numbers (`Fraction`s stay exact where `exact`); None for samplers.
        exact: rational arguments give a rational result.
        whole: whole arguments give a whole result.
        integral: every argument gives a whole result.
        symbol: how an operator is written.
    """

    name: str
    least: int
    most: int | None
    rule: Rule
    kind: Kind = "function"
    fold: Callable[..., Any] | None = None
    exact: bool = False
    whole: bool = False
    integral: bool = False
    symbol: str = ""


_INTEGRAL = ("floor", "ceil", "round", "sign")


def _sign(x: Any) -> int:
    return int(x > 0) - int(x < 0)


def _norm(*xs: Any) -> float:
    return math.hypot(*(float(x) for x in xs))


def _pow(base: Any, exponent: Any) -> Any:
    """Rational to a small whole power stays rational."""
    if isinstance(base, Fraction) and isinstance(exponent, Fraction):
        if exponent.denominator == 1 and abs(exponent) <= 64:
            return base ** int(exponent)
        return math.pow(base, exponent)
    return math.pow(base, exponent)


def _build() -> Mapping[str, Function]:
    table: dict[str, Function] = {}

    def operators(*rows: tuple[str, str, int, Rule, Callable[..., Any], bool]) -> None:
        for name, symbol, arity, rule, fold, whole in rows:
            table[name] = Function(name, arity, arity, rule, "operator", fold, True, whole, symbol=symbol)

    def functions(*rows: tuple[str, int, int | None, Rule, Callable[..., Any], bool, bool]) -> None:
        for name, least, most, rule, fold, exact, whole in rows:
            table[name] = Function(name, least, most, rule, "function", fold, exact, whole, name in _INTEGRAL)

    operators(
        ("add", "+", 2, "same", operator.add, True),
        ("sub", "-", 2, "same", operator.sub, True),
        ("mul", "*", 2, "mul", operator.mul, True),
        ("div", "/", 2, "div", operator.truediv, False),
        ("mod", "%", 2, "same", operator.mod, True),
        ("pow", "^", 2, "pow", _pow, False),
        ("neg", "-", 1, "same", operator.neg, True),
        ("square", "^", 1, "square", lambda x: x * x, True),
    )
    functions(
        ("abs", 1, 1, "same", abs, True, True),
        ("min", 1, None, "same", lambda *xs: min(xs), True, True),
        ("max", 1, None, "same", lambda *xs: max(xs), True, True),
        ("clip", 3, 3, "same", lambda x, low, high: min(max(x, low), high), True, True),
        ("relu", 1, 1, "same", lambda x: max(x, 0), True, True),
        ("floor", 1, 1, "same", math.floor, True, True),
        ("ceil", 1, 1, "same", math.ceil, True, True),
        ("round", 1, 1, "same", round, True, True),
        ("sign", 1, 1, "sign", _sign, True, True),
        ("sqrt", 1, 1, "sqrt", math.sqrt, False, False),
        ("exp", 1, 1, "plain", math.exp, False, False),
        ("log", 1, 1, "plain", math.log, False, False),
        ("sin", 1, 1, "plain", math.sin, False, False),
        ("cos", 1, 1, "plain", math.cos, False, False),
        ("tan", 1, 1, "plain", math.tan, False, False),
        ("asin", 1, 1, "plain", math.asin, False, False),
        ("acos", 1, 1, "plain", math.acos, False, False),
        ("atan", 1, 1, "plain", math.atan, False, False),
        ("atan2", 2, 2, "ratio", math.atan2, False, False),
        ("norm", 1, None, "same", _norm, False, False),
        ("norm1", 1, None, "same", lambda *xs: sum(abs(x) for x in xs), True, True),
        ("norminf", 1, None, "same", lambda *xs: max(abs(x) for x in xs), True, True),
    )
    samplers: tuple[tuple[str, int, int | None, Rule, bool], ...] = (
        ("uniform", 2, 2, "same", False),
        ("normal", 2, 2, "same", False),
        ("truncnorm", 4, 4, "same", False),
        ("bernoulli", 1, 1, "plain", True),
        ("choice", 1, None, "same", True),
        ("randint", 2, 2, "same", True),
    )
    for name, least, most, rule, whole in samplers:
        table[name] = Function(name, least, most, rule, "sampler", whole=whole)
    return MappingProxyType(table)


FUNCTIONS: Mapping[str, Function] = _build()
"""Every `ir.Op` by name."""

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
"""Functions that calls may name and that become arithmetic: least and largest number of arguments."""

REGIONS: tuple[str, ...] = (
    "circle",
    "ball",
    "box",
    "polygon",
    "halfspace",
    "union",
    "intersect",
    "complement",
    "dilate",
)
"""Functions that make regions."""

OPERATORS: Mapping[str, str] = MappingProxyType(
    {"+": "add", "-": "sub", "*": "mul", "/": "div", "%": "mod", "^": "pow"}
)
"""The written sign of binary arithmetic -> name of the function."""

STEPPING: Mapping[str, tuple[int, int]] = MappingProxyType(
    {
        "next": (1, 1),
        "prev": (1, 1),
        "rise": (1, 1),
        "fall": (1, 1),
        "shift": (2, 2),
        "delta": (1, 1),
        "sweep": (1, 1),
    }
)
"""Calls that look at other samples: least and largest number of arguments."""


def callable_names() -> tuple[str, ...]:
    """Every built-in name that can stand before `(`, samplers apart."""
    table = (name for name, function in FUNCTIONS.items() if function.kind == "function")
    return (*table, *REWRITTEN, *REGIONS, *STEPPING)


def sampler_names() -> tuple[str, ...]:
    """The samplers."""
    return tuple(name for name, function in FUNCTIONS.items() if function.kind == "sampler")
