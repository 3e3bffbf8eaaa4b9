"""Derivatives of numbers as C statements: reverse mode over the registers that a `NumberWriter` has filled.

Derivatives are those of `ops_torch`, at ties and kinks too. Conditions step hard and have the slope of
`(1 + tanh(slope margin)) / 2`, as `switch.StraightThrough` has it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import reduce

from stlc.compile.backends.c.numbers import Leaf, NumberWriter
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.functions import FUNCTIONS

Slope = tuple[str, str]
"""A register, and the derivative by it."""

FLAT = "0.0"
"""The derivative of a step function."""
LESS = {"min": "<", "max": ">"}
"""Of which operand an extremum is."""


class SlopeWriter(NumberWriter):
    """Writes numbers, and remembers how each register changes with those before it.

    Args:
        place: C expression of where a leaf stands.
        soft: whether conditions have a slope; where not, only the branch that is taken counts.
    """

    def __init__(self, place: Callable[[Leaf], str | None], *, soft: bool) -> None:
        super().__init__(place)
        self._soft = soft
        self._slopes: dict[str, tuple[Slope, ...]] = {}
        self._inputs: dict[str, str] = {}
        self._constants: set[str] = set()

    def backward(self, seeds: Mapping[str, str]) -> tuple[list[str], dict[str, str]]:
        """Statements that take a gradient back to columns.

        Args:
            seeds: register -> C expression of the derivative of the outcome by it.

        Returns:
            The statements, and what they give: place where the derivative by a leaf is gathered (that by
            `x[…]` in `gx[…]`) -> register.
        """
        registers = list(self._texts.values())
        lines = [f"double d{name} = {seeds.get(name, '0.0')};" for name in registers]
        for name in reversed(registers):
            lines += [f"d{of} += d{name} * {slope};" for of, slope in self._slopes.get(name, ())]
        gathered = {f"g{place}": f"d{name}" for name, place in self._inputs.items()}
        return lines, gathered

    def margin(self, cond: ir.Formula) -> str:
        """The exact robustness of a state formula."""
        match cond:
            case ir.Predicate(num, sign):
                value = self.number(num)
                return value if sign > 0 else self._apply("neg", [value])
            case ir.BoolOp(op, items):
                pick = "min" if op == "and" else "max"
                return reduce(lambda a, b: self._apply(pick, [a, b]), map(self.margin, items))
            case _:
                return "0.0"

    def _load(self, place: str) -> str:
        register = super()._load(place)
        self._inputs[register] = place
        return register

    def _inside(self) -> SlopeWriter:
        inner = SlopeWriter(self._place, soft=self._soft)
        inner.lines, inner._texts = self.lines, self._texts
        inner._slopes, inner._inputs, inner._constants = self._slopes, self._inputs, self._constants
        return inner

    def _indicator(self, cond: ir.Formula) -> str:
        margin = self.margin(cond) if self._soft else ""
        register = super()._indicator(cond)
        self._remember(register, [(margin, f"bump({margin}, slope)")] if self._soft else [])
        return register

    def _choice(self, cond: ir.Formula, yes: str, no: str) -> str:
        margin, taken = self.margin(cond) if self._soft else "", f"(double){self.truth(cond)}"
        register = super()._choice(cond, yes, no)
        slopes = [(yes, taken), (no, f"(1.0 - {taken})")]
        if self._soft:
            slopes.append((margin, f"(({yes} - {no}) * bump({margin}, slope))"))
        self._remember(register, slopes)
        return register

    def _apply(self, name: str, args: list[str]) -> str:
        register = super()._apply(name, args)
        if not any(map(self._varies, args)):
            self._constants.add(register)
        derivative = FUNCTIONS[name].slopes
        if name == "clip":
            slopes = self._clipped(*args)
        elif callable(derivative):
            slopes = [each for each in zip(args, derivative(register, *args), strict=True) if each[1] != FLAT]
        else:
            slopes = list(zip(args, self._shares(name, args[0], args[1]), strict=True))
        self._remember(register, slopes)
        return register

    def _shares(self, name: str, first: str, second: str) -> tuple[str, str]:
        """The derivatives of an extremum by its operands: equal ones share it, a constant has none of it."""
        sign = LESS[name]
        if not self._varies(second):
            return f"(double)!({second} {sign} {first})", "0.0"
        if not self._varies(first):
            return "0.0", f"(double)!({first} {sign} {second})"
        equal = f"0.5 * ({first} == {second})"
        return f"(({first} {sign} {second}) + {equal})", f"(({second} {sign} {first}) + {equal})"

    def _varies(self, operand: str) -> bool:
        """Whether an operand depends on a column: literals and functions of literals do not."""
        return operand in self._texts.values() and operand not in self._constants

    def _clipped(self, x: str, low: str, high: str) -> list[Slope]:
        """The derivatives of `min(max(x, low), high)`."""
        raised = super()._apply("max", [x, low])
        of_x, of_low = self._shares("max", x, low)
        of_raised, of_high = self._shares("min", raised, high)
        return [(x, f"({of_x} * {of_raised})"), (low, f"({of_low} * {of_raised})"), (high, of_high)]

    def _remember(self, register: str, slopes: list[Slope]) -> None:
        registers = set(self._texts.values())
        self._slopes.setdefault(register, tuple(slope for slope in slopes if slope[0] in registers))
