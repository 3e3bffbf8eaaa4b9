"""Tape of array operations: common sub-expressions are shared, constants folded, operations fused.

In training each array operation has microseconds of overhead, so the tape minimizes their number:
`a * 0.1 + b` becomes one `axpy`, the addition of a product becomes one `addcmul`, and `min` and `max` with
constants become one `clamp`. Each rule preserves the value up to rounding, also where it is NaN or infinite,
except that a product with the constant 0 is 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.ir.functions import FUNCTIONS

Operand: TypeAlias = int | float
"""An int is the register that an instruction writes; a float is a constant."""


_TRUTHS = frozenset({"gt", "ge", "both", "either", "number", "settle"})
"""Operations whose results are truth values, finite whatever the operands are."""

_FLAT = _TRUTHS | {
    "add",
    "sub",
    "axpy",
    "minimum",
    "maximum",
    "clamp",
    "where",
    "floor",
    "ceil",
    "round",
    "pick",
}
"""Operations whose derivatives are finite whatever the operands are."""


@dataclass(frozen=True, slots=True)
class Instr:
    """Array operation.

    Attributes:
        kernel: name of the operation. This is a method of `Ops` (array library), a method of `Switch` (which
            converts conditions to numbers), or one of three special names. `input` reads a signal, `extern`
            calls a function of the system, and `pick` selects a component of that function's result.
        args: operands, each a register number or a constant.
        params: further arguments of the operation, after the operands.
    """

    kernel: str
    args: tuple[Operand, ...] = ()
    params: tuple[object, ...] = ()


class GradientTape:
    """List of instructions, each of which writes one register; equal instructions share a register."""

    def __init__(self) -> None:
        self.code: list[Instr] = []
        self._known: dict[tuple[object, ...], int] = {}

    def emit(self, kernel: str, *args: Operand, params: tuple[object, ...] = ()) -> int:
        """Append an instruction, unless an equal one exists; return the number of its register."""
        key = (kernel, params, *((type(arg), arg) for arg in args))
        register = self._known.get(key)
        if register is None:
            register = self._known[key] = len(self.code)
            self.code.append(Instr(kernel, args, params))
        return register

    def parts(self, operand: Operand, kernel: str) -> tuple[Operand, ...] | None:
        """Operands of the instruction that computes `operand`.

        The result is None if `operand` is a constant, or the instruction is not the operation `kernel`.
        """
        if isinstance(operand, float) or self.code[operand].kernel != kernel:
            return None
        return self.code[operand].args

    def guarded(self) -> set[int]:
        """Return the registers whose derivatives by the operands may be infinite or NaN.

        These are the results of partial functions, such as a quotient, of operations with a constant that is
        infinite or NaN, such as `log(0)`, and of what is computed from them.
        """
        unbounded: set[int] = set()
        found: set[int] = set()
        for register, each in enumerate(self.code):
            kernel, args = each.kernel, each.args
            operands = {arg for arg in args if isinstance(arg, int)}
            singular = FUNCTIONS[kernel].singular if kernel in FUNCTIONS else ()
            partial = any(isinstance(args[i], int) or args[i] == 0.0 for i in singular)
            wild = not all(math.isfinite(it) for it in (*args, *each.params) if isinstance(it, float))
            if partial or wild or unbounded & operands:
                if kernel not in (*_TRUTHS, "indicator"):
                    unbounded.add(register)
                flat = kernel in _FLAT or (kernel == "mul" and isinstance(args[1], float))
                if wild or not flat:
                    found.add(register)
        return found

    # ------------------------------------------------------------ arithmetic

    def add(self, a: Operand, b: Operand) -> Operand:
        """`a + b`."""
        a, b = _constant_last(a, b)
        if isinstance(a, float):
            return a + float(b)
        if isinstance(b, float):
            return a if b == 0.0 else self.emit("add", a, b)
        for whole, part in ((a, b), (b, a)):
            fused = self._plus_product(whole, part, 1.0)
            if fused is not None:
                return fused
        return self.emit("add", a, b)

    def sub(self, a: Operand, b: Operand) -> Operand:
        """`a - b`."""
        if isinstance(a, float) and isinstance(b, float):
            return a - b
        if isinstance(b, float):
            return a if b == 0.0 else self.emit("sub", a, b)
        if isinstance(a, int):
            fused = self._plus_product(a, b, -1.0)
            if fused is not None:
                return fused
        return self.emit("sub", a, b)

    def _plus_product(self, whole: int, part: int, sign: float) -> int | None:
        """Compute `whole + sign * part` by one operation, if `part` is a product; return the register.

        If `part` is not a product, the result is None.
        """
        factors = self.parts(part, "mul")
        if factors is None:
            return None
        left, right = factors
        if not isinstance(right, float):
            return self.emit("addcmul", whole, left, right, params=(sign,))
        inner = self.parts(left, "mul")
        if inner is not None and not isinstance(inner[1], float):
            return self.emit("addcmul", whole, *inner, params=(sign * right,))
        if right == -1.0:
            return self.emit("sub" if sign > 0 else "add", whole, left)
        return self.emit("axpy", whole, left, params=(sign * right,))

    def mul(self, a: Operand, b: Operand) -> Operand:
        """`a * b`."""
        a, b = _constant_last(a, b)
        if isinstance(a, float):
            return a * float(b)
        if isinstance(b, float):
            return self._scaled(a, b)
        for one, other in ((a, b), (b, a)):
            scaled = self.parts(one, "mul")
            if scaled is not None and isinstance(scaled[1], float):
                return self.mul(self.mul(scaled[0], other), scaled[1])
        return self.emit("square", a) if a == b else self.emit("mul", a, b)

    def _scaled(self, a: int, factor: float) -> Operand:
        if factor == 0.0:
            return 0.0
        if factor == 1.0:
            return a
        inner = self.parts(a, "mul")
        if inner is not None and isinstance(inner[1], float):
            return self.mul(inner[0], inner[1] * factor)
        if factor == -1.0:
            difference = self.parts(a, "sub")
            if difference is not None:
                return self.sub(difference[1], difference[0])
        return self.emit("mul", a, factor)

    def neg(self, a: Operand) -> Operand:
        """`-a`."""
        return self.mul(a, -1.0)

    def div(self, a: Operand, b: Operand) -> Operand:
        """`a / b`."""
        if b == 1.0 and isinstance(b, float):
            return a
        return self.call("div", a, b)

    def pow(self, a: Operand, b: Operand) -> Operand:
        """`a ^ b`; common constant exponents become multiplications or roots."""
        if isinstance(b, int):
            return self.call("pow", a, b)
        match b:
            case 0.0:
                return 1.0
            case 0.5:
                return self.call("sqrt", a)
            case 1.0:
                return a
            case 2.0:
                return self.call("square", a)
            case 3.0 if isinstance(a, int):
                return self.emit("mul", self.emit("square", a), a)
            case -1.0:
                return self.div(1.0, a)
            case _:
                return self.call("pow", a, b)

    def call(self, kernel: str, *args: Operand) -> Operand:
        """Result of the operation called `kernel` on the operands `args`.

        The result is a number if all operands are constants, and a register otherwise.
        """
        if all(isinstance(arg, float) for arg in args):
            with NUMPY.quiet():
                return float(getattr(NUMPY, kernel)(*(np.float64(arg) for arg in args)))
        return self.emit(kernel, *args)

    def least(self, a: Operand, b: Operand) -> Operand:
        """`min(a, b)`."""
        return self._bounded(a, b, "minimum")

    def greatest(self, a: Operand, b: Operand) -> Operand:
        """`max(a, b)`."""
        return self._bounded(a, b, "maximum")

    def _bounded(self, a: Operand, b: Operand, kernel: str) -> Operand:
        a, b = _constant_last(a, b)
        pick = min if kernel == "minimum" else max
        if isinstance(a, float):
            return pick(a, float(b))
        if isinstance(b, int):
            return a if a == b else self.emit(kernel, *sorted((a, b)))
        low, high, inner = -math.inf, math.inf, a
        if self.code[a].kernel == "clamp":
            below, above = self.code[a].params
            low = below if isinstance(below, float) else low
            high = above if isinstance(above, float) else high
            inner = int(self.code[a].args[0])
        low, high = pick(low, b), pick(high, b)
        if low == high:
            return low
        if (low, high) == (-math.inf, math.inf):
            return inner
        bounds = (None if low == -math.inf else low, None if high == math.inf else high)
        return self.emit("clamp", inner, params=bounds)

    def norm(self, *parts: Operand) -> Operand:
        """Euclidean norm of a vector given by its components."""
        return self.call("abs", parts[0]) if len(parts) == 1 else self.call("norm", *parts)

    # ---------------------------------------------------------------- choice

    def compare(self, margin: Operand, strict: bool) -> int | bool:
        """Register of the mask `margin > 0` (if `strict`) or `margin >= 0` (otherwise).

        If `margin` is a constant, the result is the truth value. If `margin` is a difference `a - b`, the
        mask is computed as `a > b` or `a >= b`, and the difference is not needed.
        """
        if isinstance(margin, float):
            return margin > 0 if strict else margin >= 0
        kernel = "gt" if strict else "ge"
        difference = self.parts(margin, "sub")
        if difference is not None:
            return self.emit(kernel, *difference)
        total = self.parts(margin, "add")
        if total is not None and isinstance(total[1], float):
            return self.emit(kernel, total[0], -total[1])
        return self.emit(kernel, margin, 0.0)

    def number(self, mask: int) -> int:
        """Register of an array that is 1 where `mask` is True, else 0.

        Its dtype is that of the arrays whose comparison gave the mask.
        """
        return self.emit("number", mask, self._compared(mask))

    def _compared(self, mask: int) -> int:
        args = self.code[mask].args
        if self.code[mask].kernel in ("both", "either"):
            return self._compared(int(args[0]))
        return next(arg for arg in args if isinstance(arg, int))


def _constant_last(a: Operand, b: Operand) -> tuple[Operand, Operand]:
    """Order the operands of a commutative operation: first registers in ascending order, then constants."""
    if isinstance(a, float):
        return (a, b) if isinstance(b, float) else (b, a)
    return (b, a) if isinstance(b, int) and b < a else (a, b)
