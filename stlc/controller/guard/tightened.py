"""A task whose safety requirements ask for something to spare: for worlds that are not as the model says."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, TypeAlias

from stlc.compile.ir import nodes as ir
from stlc.compile.ir.traverse import map_children
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
    if isinstance(formula, ir.Predicate):
        return (
            formula
            if formula.guard
            else replace(formula, num=add(formula.num, ir.Const(-formula.sign * margin)))
        )
    return map_children(formula, formulas=lambda part: tighter(part, margin))
