"""A task whose safety requirements ask for something to spare: for worlds that are not as the model says."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, TypeAlias, assert_never

from stlc.compile.ir import nodes as ir
from stlc.controller.problem.task import Task
from stlc.dynamics.model.algebra import add

if TYPE_CHECKING:
    from stlc.compile.pipeline import CompiledRequirement


Spare: TypeAlias = Mapping[str, float]
"""How much plans must have to spare: safety requirement -> robustness, in its own unit; none if left out."""


def sparing(task: Task, margin: Spare) -> Task:
    """The same task, in which the robustness of each safety requirement is less by its `margin`.

    Time tests and constants, which never limit a robustness, stay.
    """
    if not any(margin.values()):
        return task
    safe = {rule.name: _tightened(rule, margin.get(rule.name, 0.0)) for rule in task.compiled.safety}
    rules = tuple(safe.get(rule.name, rule) for rule in task.rules)
    return Task(replace(task.compiled, requirements=rules), task.plain)


def _tightened(rule: CompiledRequirement, margin: float) -> CompiledRequirement:
    return replace(rule, formula=tighter(rule.formula, margin), lowered=tighter(rule.lowered, margin))


def tighter(formula: ir.Formula, margin: float) -> ir.Formula:
    """The formula whose robustness is less by `margin`, everywhere and exactly."""
    match formula:
        case ir.Truth():
            return formula
        case ir.Predicate():
            if formula.guard:
                return formula
            return replace(formula, num=add(formula.num, ir.Const(-formula.sign * margin)))
        case ir.BoolOp(items=items):
            return replace(formula, items=tuple(tighter(item, margin) for item in items))
        case ir.Temporal() | ir.PastTemporal() | ir.Shift() | ir.Freeze() | ir.AtStart():
            return replace(formula, body=tighter(formula.body, margin))
        case ir.Until(left=left, right=right) | ir.Since(left=left, right=right):
            return replace(formula, left=tighter(left, margin), right=tighter(right, margin))
    assert_never(formula)
