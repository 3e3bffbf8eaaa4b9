"""Derivatives of expressions as C statements: reverse mode over the registers of a `NumberWriter`.

The derivatives equal those of `backends.torch.ops`, also at ties and kinks. Conditions have the value 0 or 1
and the derivative of the smooth step `(1 + tanh(slope margin)) / 2`, as in `switch.StraightThrough`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

from stlc.compile.backends.c.numbers import NumberWriter, literal
from stlc.compile.backends.numbers import Leaf
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.functions import FUNCTIONS

Slope = tuple[str, str]
"""Register, and the C expression of the derivative with respect to it."""

NOUGHT = literal(0.0)
FLAT = "0.0"
"""The derivative of a step function."""
COUNTED = "(double)"
"""Start of the C expression of the elapsed time, a leaf without a gradient."""
LESS = {"min": "<", "max": ">"}
"""Extremum -> comparison that selects an operand."""


class SlopeWriter(NumberWriter):
    """Writer of expressions that records the partial derivatives of each register (C variable).

    A branch that is not taken, such as `a / y` in `y > 0.1 -> a / y < 2`, may be infinite or NaN. A gradient
    that would be infinite or NaN counts as 0, and the step between branches then has no slope.

    Args:
        place: returns the C expression of a leaf (signal, call, or frozen value).
        soft: whether conditions have the gradient of a smooth step. If not, conditions have no gradient; a
            choice between two branches then passes its gradient to the branch taken only.
    """

    def __init__(self, place: Callable[[Leaf], str | None], *, soft: bool) -> None:
        super().__init__(place)
        self._soft = soft
        self._slopes: dict[str, tuple[Slope, ...]] = {}
        self._inputs: dict[str, str] = {}
        self._constants: set[str] = set()
        self._unbounded: set[str] = set()

    def backward(self, seeds: Mapping[str, str]) -> tuple[list[str], dict[str, str]]:
        """Return C statements that propagate gradients from registers to leaves (signals, calls).

        Args:
            seeds: register -> C expression of the derivative of the final output with respect to the
                register.

        Returns:
            The statements, and a mapping that tells which register must be added to the gradient of each
            leaf. The keys are C expressions of gradients, such as `gx[…]` for the leaf `x[…]`; the values are
            registers.
        """
        registers = list(self._texts.values())
        lines = [f"double d{name} = {seeds.get(name, '0.0')};" for name in registers]
        for name in reversed(registers):
            sift = "finite" if name in self._unbounded else ""
            lines += [f"d{of} += {sift}(d{name} * {slope});" for of, slope in self._slopes.get(name, ())]
        gathered = {f"g{place}": f"d{name}" for name, place in self._inputs.items()}
        return lines, gathered

    def gradients(self, outputs: Iterable[tuple[ir.Num, str]]) -> list[str]:
        """Return C statements that compute expressions and propagate gradients to the signals in them.

        A gradient is a derivative of the final output. For a signal `x[…]`, the statements add to the C
        variable `gx[…]`.

        Args:
            outputs: pairs of an expression and its gradient. The gradient is the C expression of the
                derivative of the final output with respect to the expression.
        """
        seeds: dict[str, str] = {}
        for num, own in outputs:
            register = self.number(num)
            seeds[register] = f"{seeds[register]} + {own}" if register in seeds else own
        lines, gathered = self.backward(seeds)
        return [*self.lines, *lines, *(f"{place} += {value};" for place, value in gathered.items())]

    def _load(self, place: str) -> str:
        register = super()._load(place)
        if not place.startswith(COUNTED):
            self._inputs[register] = place
        return register

    def _indicator(self, cond: ir.Formula, sharpness: float | None) -> str:
        bump = [self._bump(cond)] if self._soft else []
        register = super()._indicator(cond, sharpness)
        self._remember(register, bump)
        return register

    def _bump(self, cond: ir.Formula) -> Slope:
        """Margin of a condition, and the derivative of its truth value by the margin."""
        margin = self.margin(cond)
        return margin, f"{'finite' if margin in self._unbounded else ''}(bump({margin}, slope))"

    def _choice(self, cond: ir.Formula, yes: str, no: str) -> str:
        bump, taken = self._bump(cond) if self._soft else None, f"(double){self.truth(cond)}"
        register = super()._choice(cond, yes, no)
        slopes, step = [(yes, taken), (no, f"(1.0 - {taken})")], f"({yes} - {no})"
        if self._unbounded & {yes, no}:
            self._unbounded.add(register)
            step = f"finite{step}"
        if bump is not None:
            slopes.append((bump[0], f"({step} * {bump[1]})"))
        self._remember(register, slopes)
        return register

    def _apply(self, name: str, args: list[str]) -> str:
        register = super()._apply(name, args)
        if not any(map(self._varies, args)):
            self._constants.add(register)
        function = FUNCTIONS[name]
        critical = [args[i] for i in function.singular]
        if self._unbounded.intersection(args) or any(map(self._varies, critical)) or NOUGHT in critical:
            self._unbounded.add(register)
        derivative = function.slopes
        if name == "clip":  # derivatives of min(max(x, low), high)
            x, low, high = args
            raised = super()._apply("max", [x, low])
            of_x, of_low = self._shares("max", x, low)
            of_raised, of_high = self._shares("min", raised, high)
            slopes = [(x, f"({of_x} * {of_raised})"), (low, f"({of_low} * {of_raised})"), (high, of_high)]
        elif callable(derivative):
            slopes = [each for each in zip(args, derivative(register, *args), strict=True) if each[1] != FLAT]
        else:
            slopes = list(zip(args, self._shares(name, args[0], args[1]), strict=True))
        self._remember(register, slopes)
        return register

    def _shares(self, name: str, first: str, second: str) -> tuple[str, str]:
        """C expressions of the derivatives of a minimum or maximum with respect to its two operands.

        `name` is "min" or "max"; `first` and `second` are the operands. Equal operands share the derivative;
        a constant operand gets none.
        """
        sign = LESS[name]
        if not self._varies(second):
            return f"(double)!({second} {sign} {first})", "0.0"
        if not self._varies(first):
            return "0.0", f"(double)!({first} {sign} {second})"
        equal = f"0.5 * ({first} == {second})"
        return f"(({first} {sign} {second}) + {equal})", f"(({second} {sign} {first}) + {equal})"

    def _varies(self, operand: str) -> bool:
        """True if an operand depends on a signal; constants and functions of constants do not."""
        return operand in self._texts.values() and operand not in self._constants

    def _remember(self, register: str, slopes: list[Slope]) -> None:
        registers = set(self._texts.values())
        self._slopes.setdefault(register, tuple(slope for slope in slopes if slope[0] in registers))
