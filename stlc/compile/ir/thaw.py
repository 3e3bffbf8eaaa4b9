"""Typed formulas with frozen values put in."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import assert_never

from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.ir.samples import thawed


def thaw(formula: typed.Formula, values: Mapping[str, ir.Num]) -> typed.Formula:
    """`formula` with the frozen values of `values` replaced by numbers; places stay."""
    match formula:
        case typed.Truth():
            return formula
        case typed.Predicate():
            return replace(formula, num=thawed(formula.num, values))
        case typed.Not() | typed.Temporal() | typed.Shift() | typed.Edge():
            return replace(formula, body=thaw(formula.body, values))
        case typed.Logic():
            return replace(formula, items=tuple(thaw(item, values) for item in formula.items))
        case typed.Until():
            return replace(formula, left=thaw(formula.left, values), right=thaw(formula.right, values))
        case typed.Recalled():
            return replace(formula, now=thaw(formula.now, values), along=thaw(formula.along, values))
        case typed.Freeze():
            bindings = tuple((name, thawed(num, values)) for name, num in formula.bindings)
            own = {name for name, _ in bindings}
            outer = {name: value for name, value in values.items() if name not in own}
            return replace(formula, bindings=bindings, body=thaw(formula.body, outer))
        case _:
            assert_never(formula)
