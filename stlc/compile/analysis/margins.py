"""Margins in the units that were written: where recorded traces are judged, robustness is in those.

In training everything is in SI, so that requirements can be weighed against each other. A person reads `speed
< 120 km/h` in km/h: each predicate is divided by the scale of its unit, which changes no sign.
"""

from __future__ import annotations

import math
from dataclasses import replace

from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.ir.functions import FUNCTIONS
from stlc.compile.ir.traverse import map_children, nodes
from stlc.units import Unit, same_dims


def as_written(requirement: typed.Requirement) -> typed.Requirement:
    """The requirement with margins in the units of what is compared, and `@scale` where there is one unit."""
    unit = _one_unit(requirement.formula)
    scale = requirement.scale if unit is None or requirement.scale == 1 else requirement.scale / unit.scale
    return replace(requirement, formula=_formula(requirement.formula), scale=scale)


def _one_unit(formula: typed.Formula) -> Unit | None:
    """The unit that all predicates have; None where they differ."""
    units = [node.written for node in nodes(formula) if isinstance(node, typed.Predicate) and not node.guard]
    first = next(iter(units), None)
    alike = first is not None and all(same_dims(u, first) and u.ratio == first.ratio for u in units)
    return first if alike else None


def _formula(formula: typed.Formula) -> typed.Formula:
    if isinstance(formula, typed.Predicate):
        return replace(formula, num=in_unit(formula.num, formula.written), unit=formula.written)
    return map_children(formula, formulas=_formula)


def in_unit(num: ir.Num, unit: Unit) -> ir.Num:
    """A number in SI units as one in `unit`; columns of that unit are read as they are."""
    if unit.ratio == 1:
        return num
    match num:
        case ir.Const(value):
            return ir.Const(_divided(value, unit))
        case ir.Op("mul", (inner, ir.Const(factor))) if factor == unit.scale:
            return inner
        case ir.Op(name, args) if FUNCTIONS[name].linear:
            return replace(num, args=tuple(in_unit(arg, unit) for arg in args))
        case ir.Where():
            return replace(num, yes=in_unit(num.yes, unit), no=in_unit(num.no, unit))
        case _:
            return ir.Op("div", (num, ir.Const(unit.scale)))


def _divided(value: float, unit: Unit) -> float:
    """A constant in a unit, as it was meant: 120 and not 120.00000000000001."""
    found = value / unit.scale
    short = float(f"{found:.14g}")
    return short if math.isclose(short, found, rel_tol=1e-15) else found
