"""Base of the evaluators of numeric expressions in all back ends.

Each expression is evaluated once. A function call can be replaced by the body of the function.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from copy import copy
from typing import Any, Generic, Self, TypeAlias, TypeVar

from stlc.compile.ir import nodes as ir


class Untranslatable(Exception):  # noqa: N818 - not an error: another back end is used
    """Error: a back end cannot express a node of the IR, such as a Python function of the system."""


Leaf: TypeAlias = ir.Signal | ir.ShiftedSignal | ir.FrozenVar | ir.Extern
V = TypeVar("V")


class NumberEvaluator(ABC, Generic[V]):
    """Evaluator of numeric expressions. The type of a value depends on the back end.

    For example, a value is a register of a tape, or a name in C code.

    Attributes:
        bound: name of a signal -> value that replaces it.
    """

    def __init__(self) -> None:
        self.bound: dict[str, V] = {}
        self._seen: dict[int, tuple[ir.Num, V]] = {}
        self._calls: dict[tuple[Any, ...], Self] = {}

    def number(self, num: ir.Num) -> V:
        """Return the value of an expression; each expression is evaluated once."""
        seen = self._seen.get(id(num))
        if seen is None:
            seen = self._seen[id(num)] = num, self._number(num)  # holds `num`, so that its id stays unique
        return seen[1]

    def margin(self, cond: ir.Formula) -> V:
        """Return the exact robustness of a state formula (a formula without temporal operators)."""
        return self.number(margin_of(cond))

    def _number(self, num: ir.Num) -> V:
        match num:
            case ir.Const(value):
                return self._constant(value)
            case ir.Op(name, args):
                return self._function(name, [self.number(arg) for arg in args])
            case ir.Indicator(cond, sharpness):
                return self._indicator(cond, sharpness)
            case ir.Where(cond, yes, no):
                return self._choice(cond, self.number(yes), self.number(no))
            case _:
                leaf: Any = num
                return self._leaf(leaf)

    def inlined(self, body: ir.Body, args: Sequence[V]) -> Self:
        """Return an evaluator for the body of a function whose parameters have the values `args`.

        In the returned evaluator, the intermediate variables of the body already have their values.
        """
        key = (id(body), *map(repr, args))
        inner = self._calls.get(key)
        if inner is None:
            inner = self._calls[key] = copy(self)
            inner.bound, inner._seen, inner._calls = dict(zip(body.formals, args, strict=True)), {}, {}
            for name, num in body.lets:
                inner.bound[name] = inner.number(num)
        return inner

    @abstractmethod
    def _constant(self, value: float) -> V: ...

    @abstractmethod
    def _leaf(self, num: Leaf) -> V: ...

    @abstractmethod
    def _function(self, name: str, args: list[V]) -> V: ...

    @abstractmethod
    def _indicator(self, cond: ir.Formula, sharpness: float | None) -> V: ...

    @abstractmethod
    def _choice(self, cond: ir.Formula, yes: V, no: V) -> V: ...


def margin_of(formula: ir.Formula, *, guarded: bool = False) -> ir.Num:
    """Return the robustness of a state formula (one without temporal operators) as an expression.

    Guards are treated as ordinary predicates; if `guarded`, the robustness of a guard is +inf or -inf, as it
    is elsewhere.

    Raises:
        Untranslatable: the formula has a temporal operator.
    """
    match formula:
        case ir.Predicate(guard=True) if guarded:
            return formula.select(math.inf, -math.inf)
        case ir.Predicate(num, sign):
            return num if sign > 0 else -num
        case ir.BoolOp(op, items):
            parts = tuple(margin_of(item, guarded=guarded) for item in items)
            return ir.Op("min" if op == "and" else "max", parts)
        case ir.Truth(value):
            return ir.Const(math.inf if value else -math.inf)
        case _:
            raise Untranslatable(type(formula).__name__)
