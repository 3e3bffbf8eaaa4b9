"""Numbers and state formulas of the IR as C expressions, with common sub-expressions shared.

A writer turns `ir.Num` into branch-free scalar statements `const double r7 = …;`, so that the compiler can
vectorize the enclosing loop over trajectories.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import reduce
from typing import TypeAlias, assert_never

from stlc.compile.ir import nodes as ir
from stlc.compile.ir.functions import FUNCTIONS, SHARED

LISTED = "\0"
"""Prefix of frozen values and columns that are table entries, followed by their C name."""


class Untranslatable(Exception):  # noqa: N818 - not an error: another back end is used
    """The IR has a node that a back end cannot express, such as a Python function of the system."""


Leaf: TypeAlias = ir.Signal | ir.ShiftedSignal | ir.FrozenVar | ir.Extern


class NumberWriter:
    """Writer of numbers as C statements; equal numbers share a register.

    Args:
        place: C expression of a column, a frozen value or an available function result; None for a function
            that must be inlined.
    """

    def __init__(self, place: Callable[[Leaf], str | None]) -> None:
        self.lines: list[str] = []
        self._place = place
        self._known: dict[ir.Num, str] = {}
        self._texts: dict[str, str] = {}
        self._calls: dict[tuple[str, ...], list[str]] = {}

    def number(self, num: ir.Num) -> str:
        """Write the statements of a number; return its C name."""
        known = self._known.get(num)
        if known is None:
            known = self._known[num] = self._number(num)
        return known

    def assign(self, name: str, value: str) -> None:
        """Bind the environment entry `name` to the C expression `value`."""
        self._known[ir.Signal(name)] = value

    def truth(self, cond: ir.Formula) -> str:
        """Exact truth of a condition as a C expression, 0 or 1; each predicate keeps its own strictness."""
        match cond:
            case ir.Truth(value):
                return "1" if value else "0"
            case ir.Predicate(num, sign, strict):
                op = (">" if sign > 0 else "<") + ("" if strict else "=")
                return f"({self.number(num)} {op} 0.0)"
            case ir.BoolOp(op, items):
                return "(" + (" & " if op == "and" else " | ").join(map(self.truth, items)) + ")"
            case _:
                raise Untranslatable(type(cond).__name__)

    def _number(self, num: ir.Num) -> str:
        match num:
            case ir.Const(value):
                return literal(value)
            case ir.Op(name, args):
                return self._op(name, [self.number(arg) for arg in args])
            case ir.Indicator(cond):
                return self._indicator(cond)
            case ir.Where(cond, yes, no):
                return self._choice(cond, self.number(yes), self.number(no))
            case ir.FrozenVar(name) if name.startswith(LISTED):
                return name.removeprefix(LISTED)
            case ir.Signal() | ir.ShiftedSignal() | ir.FrozenVar() | ir.Extern():
                place = self._place(num)
                return self._written_out(num) if place is None else self._load(place)
            case _:
                assert_never(num)

    def _load(self, place: str) -> str:
        return self._register(place)

    def _written_out(self, num: Leaf) -> str:
        if not isinstance(num, ir.Extern) or not isinstance(num.function, ir.Body):
            raise Untranslatable(f"the function `{num.name}`")
        args = [self.number(arg) for arg in num.args]
        return self._inlined(num.name, num.function, args)[num.output]

    def _indicator(self, cond: ir.Formula) -> str:
        return self._register(f"(double){self.truth(cond)}")

    def _choice(self, cond: ir.Formula, yes: str, no: str) -> str:
        return self._register(f"{self.truth(cond)} ? {yes} : {no}")

    def _inlined(self, name: str, body: ir.Body, args: list[str]) -> list[str]:
        """Write the statements of a function given as straight-line code; return its components."""
        outputs = self._calls.get((name, *args))
        if outputs is None:
            inner = self._inside()
            for formal, arg in zip(body.formals, args, strict=True):
                inner.assign(formal, arg)
            for let, num in body.lets:
                inner.assign(let, inner.number(num))
            outputs = self._calls[name, *args] = [inner.number(output) for output in body.outputs]
        return outputs

    def _inside(self) -> NumberWriter:
        """Return a writer with its own bindings that shares the registers."""
        inner = NumberWriter(self._place)
        inner.lines, inner._texts = self.lines, self._texts
        return inner

    def _op(self, name: str, args: list[str]) -> str:
        function = FUNCTIONS[name]
        if function.of_each is not None:
            name, args = function.of_each[1], [self._apply(function.of_each[0], [arg]) for arg in args]
            return reduce(lambda a, b: self._apply(name, [a, b]), args)
        if function.most is None and function.slopes == SHARED:
            return reduce(lambda a, b: self._apply(name, [a, b]), args)
        return self._apply(name, args)

    def _apply(self, name: str, args: list[str]) -> str:
        """Write one function of the table into a register; extrema take two arguments at a time."""
        form = FUNCTIONS[name].c
        if form is None:
            raise Untranslatable(name)
        return self._register(form(*args))

    def _register(self, text: str) -> str:
        known = self._texts.get(text)
        if known is None:
            known = self._texts[text] = f"r{len(self._texts)}"
            self.lines.append(f"const double {known} = {text};")
        return known


def literal(value: float) -> str:
    """Return a C literal that reads back to the same double, bit for bit."""
    if math.isnan(value):
        return "NAN"
    if math.isinf(value):
        return "INFINITY" if value > 0 else "(-INFINITY)"
    return f"({value.hex()})"
