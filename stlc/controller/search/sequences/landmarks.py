"""Landmarks: conditions that hold on every safe way to a target (Hoffmann, Porteous & Sebastia 2004).

A safety requirement such as `door open -> at rest at a floor` is a choice: door closed, or at rest at a
floor. A target with an open door leaves the second alternative only. Whoever opens the door must have taken
it before, while the first one still held. So there are two landmarks on the way to the target: the first
alternative, door closed, and what the target asks together with the second one, at rest at the floor.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from stlc.compile.backends.array.graph import evaluate
from stlc.compile.backends.array.numpy_ops import NUMPY
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.normal_form import joined
from stlc.compile.ir.support import columns
from stlc.compile.semantics.tolerance import satisfied

if TYPE_CHECKING:
    from stlc.signature import Column

VALUES = 1001
"""Number of values of a state at which it is looked up whether two conditions on it exclude each other."""
YES, NO = ir.Truth(True), ir.Truth(False)


@dataclass(frozen=True, slots=True)
class Landmarks:
    """Landmarks of targets under safety requirements.

    Attributes:
        clauses: the safety requirements as choices, tuples of alternatives.
        ranges: states that the controls move without jumps, name -> column.
    """

    clauses: Sequence[tuple[ir.Formula, ...]]
    ranges: dict[str, Column]
    _apart: dict[tuple[ir.Formula, ir.Formula], bool] = field(default_factory=dict)

    def of(self, target: ir.Formula) -> tuple[ir.Formula, ...]:
        """Return the landmarks on the way to a target, the first to reach first; none where none is known."""
        asked = tuple(_literals(target))
        left, rest, before = list(asked), list[ir.Formula](), list[ir.Formula]()
        for clause in self.clauses:
            barred = [each for each in clause if any(self._excludes(one, each) for one in asked)]
            open_ = [each for each in clause if each not in barred]
            gate = [one for one in barred if any(self._together(one, each) for each in open_)]
            if gate:
                before.append(joined("or", gate, NO))
                rest.append(joined("or", open_, NO))
                left = [one for one in left if not any(self._excludes(one, each) for each in gate)]
        if not before:
            return ()
        near = joined("and", (*left, *(self._with(left, each) for each in rest)), YES)
        return joined("and", before, YES), near

    def _together(self, one: ir.Formula, other: ir.Formula) -> bool:
        return not any(self._excludes(literal, other) for literal in _literals(one))

    def _with(self, asked: Sequence[ir.Formula], formula: ir.Formula) -> ir.Formula:
        """Return a formula without alternatives that conditions exclude."""
        match formula:
            case ir.BoolOp(op, items):
                kept = [self._with(asked, item) for item in items]
                return joined(op, kept, ir.Truth(op == "and"))
            case _:
                return NO if any(self._excludes(one, formula) for one in asked) else formula

    def _excludes(self, literal: ir.Formula, formula: ir.Formula) -> bool:
        """True if a literal and a conjunction never hold together."""
        return any(self._exclusive(literal, each) for each in _literals(formula))

    def _exclusive(self, one: ir.Formula, other: ir.Formula) -> bool:
        key = one, other
        if key not in self._apart:
            self._apart[key] = False
            read = columns(one)
            column = self.ranges.get(next(iter(read))) if len(read) == 1 and read == columns(other) else None
            if column is not None and column.low is not None and column.high is not None:
                env = {column.name: np.linspace(column.low, column.high, VALUES)[None]}
                held = [np.broadcast_to(satisfied(each[0]), VALUES) for each in evaluate(key, env, ops=NUMPY)]
                self._apart[key] = not bool((held[0] & held[1]).any())
        return self._apart[key]


def _literals(formula: ir.Formula) -> Iterator[ir.Formula]:
    """Yield the predicates that hold wherever a formula holds."""
    match formula:
        case ir.Predicate():
            yield formula
        case ir.BoolOp("and", items):
            for item in items:
                yield from _literals(item)
        case ir.Temporal("always", _, body):
            yield from _literals(body)
