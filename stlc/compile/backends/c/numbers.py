"""Numeric expressions and state formulas of the IR as C expressions; common sub-expressions are shared.

A writer turns `ir.Num` into branch-free scalar statements `const double r7 = …;`, so that the compiler can
vectorize the enclosing loop over trajectories.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import reduce

from stlc.compile.backends.numbers import Leaf, NumberEvaluator, Untranslatable
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.functions import FUNCTIONS, SHARED

LISTED = "\0"
"""Prefix of frozen values and columns that are table entries, followed by their C name."""


class NumberWriter(NumberEvaluator[str]):
    """Writer of numeric expressions as C statements; equal expressions share a register (C variable).

    Args:
        place: function that returns the C expression of an operand: a signal, a value bound by `freeze`, or a
            function result that is already computed. If it returns None for a function call, the body of the
            function is written in place of the call.

    Attributes:
        lines: the statements.
    """

    def __init__(self, place: Callable[[Leaf], str | None]) -> None:
        super().__init__()
        self.lines: list[str] = []
        self._place = place
        self._texts: dict[str, str] = {}

    def truth(self, cond: ir.Formula) -> str:
        """C expression of the exact truth value of a condition, 0 or 1.

        A margin of exactly 0 satisfies `>=`, but not `>`.
        """
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

    def _constant(self, value: float) -> str:
        return literal(value)

    def _leaf(self, num: Leaf) -> str:
        if isinstance(num, ir.Signal) and num.name in self.bound:
            return self.bound[num.name]
        if isinstance(num, ir.FrozenVar) and num.name.startswith(LISTED):
            return num.name.removeprefix(LISTED)
        place = self._place(num)
        if place is not None:
            return self._load(place)
        if not isinstance(num, ir.Extern) or not isinstance(num.function, ir.Body):
            raise Untranslatable(f"the function `{num.name}`")
        inner = self.inlined(num.function, [self.number(arg) for arg in num.args])
        return [inner.number(output) for output in num.function.outputs][num.output]

    def _load(self, place: str) -> str:
        return self._register(place)

    def _indicator(self, cond: ir.Formula, _sharpness: float | None) -> str:
        return self._register(f"(double){self.truth(cond)}")

    def _choice(self, cond: ir.Formula, yes: str, no: str) -> str:
        return self._register(f"{self.truth(cond)} ? {yes} : {no}")

    def _function(self, name: str, args: list[str]) -> str:
        function = FUNCTIONS[name]
        if function.of_each is not None:
            name, args = function.of_each[1], [self._apply(function.of_each[0], [arg]) for arg in args]
            return reduce(lambda a, b: self._apply(name, [a, b]), args)
        if function.most is None and function.slopes == SHARED:
            return reduce(lambda a, b: self._apply(name, [a, b]), args)
        return self._apply(name, args)

    def _apply(self, name: str, args: list[str]) -> str:
        """Write a call of the function `name` as a statement; return the register of its value.

        Raises:
            Untranslatable: the function has no C form.
        """
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
