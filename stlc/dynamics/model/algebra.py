"""Rewriting of IR numbers: which names they read, replacing names, and what can be computed early."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from stlc.compile.ir import nodes as ir
from stlc.compile.ir.traverse import leaves, map_children


def names_in(num: ir.Num | ir.Formula) -> frozenset[str]:
    """Names of all columns that a number or a state formula reads."""
    return frozenset(leaf.name for leaf in leaves(num) if isinstance(leaf, (ir.Signal, ir.ShiftedSignal)))


Rewrite = Callable[[ir.Num], ir.Num]


def map_formula(formula: ir.Formula, rewrite: Rewrite) -> ir.Formula:
    """A state formula with every predicate's number rewritten."""
    return map_children(formula, formulas=lambda part: map_formula(part, rewrite), numbers=rewrite)


def map_parts(num: ir.Num, rewrite: Rewrite) -> ir.Num:
    """A number with its direct parts rewritten."""
    return map_children(num, formulas=lambda cond: map_formula(cond, rewrite), numbers=rewrite)


def substitute(num: ir.Num, table: Mapping[str, ir.Num]) -> ir.Num:
    """A number with the columns of `table` replaced."""
    if isinstance(num, ir.Signal):
        return table.get(num.name, num)
    return map_parts(num, lambda part: substitute(part, table))


def blend(cond: ir.Formula, yes: ir.Num, no: ir.Num, sharpness: float | None) -> ir.Num:
    """`I yes + (1 - I) no` with the paper's I_w (Eq. 6); equal to a choice wherever I is exactly 0 or 1."""
    weight = ir.Indicator(cond, sharpness)
    kept = multiply(ir.Op("sub", (ir.Const(1.0), weight)), no)
    return kept if yes == ir.Const(0.0) else add(multiply(weight, yes), kept)


def add(left: ir.Num, right: ir.Num) -> ir.Num:
    """Their sum."""
    return ir.Op("add", (left, right))


def multiply(left: ir.Num, right: ir.Num) -> ir.Num:
    """Their product."""
    return ir.Op("mul", (left, right))


# ------------------------------------------------------------------------------ hoisting


@dataclass
class Hoist:
    """Splits numbers into what changes within a loop and what can be computed before it.

    Attributes:
        moving: names that change within the loop.
        early: name -> number that does not depend on them; fills up as numbers are split.
        prefix: of the names that are made.
    """

    moving: frozenset[str]
    prefix: str
    early: dict[str, ir.Num] = field(default_factory=dict)

    def split(self, num: ir.Num) -> ir.Num:
        """`num` with its largest steady parts replaced by columns of `early`."""
        if not names_in(num) & self.moving:
            return self._steady(num)
        match num:
            case ir.Op("add" | "sub" | "neg"):
                return self._sum(num)
            case ir.Op("mul"):
                return self._product(num)
            case ir.Where(cond, yes, no) if not names_in(cond) & self.moving:
                return self._choice(cond, yes, no)
            case _:
                return map_parts(num, self.split)

    def _steady(self, num: ir.Num) -> ir.Num:
        """A steady number, named; what is a number or a name already stays."""
        if isinstance(num, ir.Const | ir.Signal):
            return num
        for name, known in self.early.items():
            if known == num:
                return ir.Signal(name)
        name = f"{self.prefix}{len(self.early)}"
        self.early[name] = num
        return ir.Signal(name)

    def _choice(self, cond: ir.Formula, yes: ir.Num, no: ir.Num) -> ir.Num:
        """A choice whose condition is steady: the condition becomes a mask."""
        if yes == ir.Const(0.0):
            keep = self._steady(ir.Op("sub", (ir.Const(1.0), ir.Indicator(cond))))
            return multiply(keep, self.split(no))
        mask = self._steady(ir.Op("sub", (ir.Indicator(cond), ir.Const(0.5))))
        return ir.Where(ir.Predicate(mask), self.split(yes), self.split(no))

    def _sum(self, num: ir.Num) -> ir.Num:
        """Terms of a sum, the steady ones gathered into one."""
        terms = _terms(num)
        moving = [(sign, self.split(term)) for sign, term in terms if names_in(term) & self.moving]
        steady = [(sign, term) for sign, term in terms if not names_in(term) & self.moving]
        moving.sort(key=lambda pair: pair[0] < 0)
        total = _signed(*moving[0])
        for sign, term in moving[1:]:
            total = ir.Op("add" if sign > 0 else "sub", (total, term))
        rest = _total(steady)
        return total if rest == ir.Const(0.0) else add(total, self._steady(rest))

    def _product(self, num: ir.Num) -> ir.Num:
        """Factors of a product, the steady ones gathered into one."""
        factors = _factors(num)
        moving = [self.split(factor) for factor in factors if names_in(factor) & self.moving]
        steady = [factor for factor in factors if not names_in(factor) & self.moving]
        result = moving[0]
        for factor in moving[1:]:
            result = multiply(result, factor)
        if not steady:
            return result
        scale = steady[0]
        for factor in steady[1:]:
            scale = multiply(scale, factor)
        return multiply(result, self._steady(scale))


def _terms(num: ir.Num, sign: int = 1) -> list[tuple[int, ir.Num]]:
    """The signed terms of a sum."""
    match num:
        case ir.Op("add", (left, right)):
            return [*_terms(left, sign), *_terms(right, sign)]
        case ir.Op("sub", (left, right)):
            return [*_terms(left, sign), *_terms(right, -sign)]
        case ir.Op("neg", (operand,)):
            return _terms(operand, -sign)
        case _:
            return [(sign, num)]


def _factors(num: ir.Num) -> list[ir.Num]:
    """The factors of a product."""
    match num:
        case ir.Op("mul", (left, right)):
            return [*_factors(left), *_factors(right)]
        case _:
            return [num]


def _signed(sign: int, num: ir.Num) -> ir.Num:
    return num if sign > 0 else ir.Op("neg", (num,))


def _total(terms: list[tuple[int, ir.Num]]) -> ir.Num:
    """Steady terms as one number, constants folded."""
    constant = sum(sign * term.value for sign, term in terms if isinstance(term, ir.Const))
    total: ir.Num | None = None
    for sign, term in sorted(
        ((s, t) for s, t in terms if not isinstance(t, ir.Const)), key=lambda pair: pair[0] < 0
    ):
        total = _signed(sign, term) if total is None else ir.Op("add" if sign > 0 else "sub", (total, term))
    if total is None:
        return ir.Const(constant)
    return total if constant == 0.0 else add(total, ir.Const(constant))
