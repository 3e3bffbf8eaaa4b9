"""Landmarks: conditions that hold on every safe way to a target (Hoffmann, Porteous & Sebastia 2004).

A safety requirement such as `door open -> at rest at a floor` is a choice: door closed, or at rest at a
floor. A target with an open door leaves the second alternative only. Before the door opens, the second must
already hold together with the first. So there are two landmarks on the way to the target: the first
alternative, door closed, and the target together with the second one, at rest at the floor.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from stlc.compile.backends.array.graph import evaluate
from stlc.compile.ir import nodes as ir
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.signature import Column

VALUES = 1001
"""Number of values of a state at which it is looked up whether two conditions on it exclude each other."""


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
        """Return the landmarks on the way to a target, in the order in which they are reached."""
        asked = tuple(_literals(target))
        left, rest, before = list(asked), list[ir.Formula](), list[ir.Formula]()
        for clause in self.clauses:
            barred = [each for each in clause if any(self._excludes(one, each) for one in asked)]
            open_ = [each for each in clause if each not in barred]
            gate = [
                one
                for one in barred
                if any(all(not self._excludes(part, each) for part in _literals(one)) for each in open_)
            ]
            if gate:
                before.append(ir.BoolOp.joined("or", gate))
                rest.append(ir.BoolOp.joined("or", open_))
                left = [one for one in left if not any(self._excludes(one, each) for each in gate)]
        if not before:
            return ()

        def open_to(formula: ir.Formula) -> ir.Formula:
            return ir.Truth(False) if any(self._excludes(one, formula) for one in left) else formula

        left += [each.map_terms(open_to) for each in rest]
        return ir.BoolOp.joined("and", before), ir.BoolOp.joined("and", left)

    def _excludes(self, literal: ir.Formula, formula: ir.Formula) -> bool:
        """True if a literal and a conjunction never hold together."""
        return any(self._exclusive(literal, each) for each in _literals(formula))

    def _exclusive(self, one: ir.Formula, other: ir.Formula) -> bool:
        key = one, other
        if key not in self._apart:
            self._apart[key] = False
            read = one.columns
            column = self.ranges.get(next(iter(read))) if len(read) == 1 and read == other.columns else None
            if column is not None and column.low is not None and column.high is not None:
                env = {column.name: np.linspace(column.low, column.high, VALUES)[None]}
                held = [np.broadcast_to(TOLERANCE.satisfied(each[0]), VALUES) for each in evaluate(key, env)]
                self._apart[key] = not bool((held[0] & held[1]).any())
        return self._apart[key]


def _literals(formula: ir.Formula) -> Iterator[ir.Formula]:
    """Yield the predicates that hold wherever a formula holds."""
    for part in formula.terms("and"):
        if isinstance(part, ir.Temporal) and part.op == "always":
            yield from _literals(part.body)
        elif isinstance(part, ir.Predicate):
            yield part
