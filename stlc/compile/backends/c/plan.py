"""Formulas of the IR -> steps over buffers, which become C forwards and backwards.

Only instants that the roots need are computed, and equal sub-formulas at equal instants once. `freeze` is a
loop over its instants; what does not read a frozen value is computed outside of it. Operands and requirements
of equal shape are a loop over a table (`c_families`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import assert_never

from stlc.compile.backends.c.families import Family, families
from stlc.compile.backends.c.index import Index, Stretch, at, between
from stlc.compile.backends.c.numbers import Untranslatable
from stlc.compile.backends.c.steps import (
    PICKS,
    Buffer,
    Called,
    CallKey,
    Extremum,
    Fill,
    Frozen,
    Joined,
    Margin,
    Meeting,
    Moved,
    Pick,
    Place,
    Plan,
    Repeated,
    Step,
    Tabled,
    call_of,
)
from stlc.compile.ir import nodes as ir
from stlc.compile.ir.support import columns_of, reach_of
from stlc.compile.ir.traverse import frozen_in, operands, subexpressions


def plan_of(formulas: Sequence[ir.Formula], samples: int) -> Plan:
    """The steps that give formulas at the first sample.

    Raises:
        Untranslatable: a window leaves the trajectory.
    """
    planner = _Planner(samples)
    roots = planner.roots(formulas)
    return Plan(
        samples, tuple(planner.scopes[0].steps), roots, tuple(planner.buffers), planner.size, planner.calls
    )


@dataclass(slots=True)
class _Scope:
    """What is computed together: everything, or the inside of one `freeze`, or of the loop over a table."""

    held: dict[str, Buffer] = field(default_factory=dict)
    listed: frozenset[str] = frozenset()
    steps: list[Step] = field(default_factory=list)
    own: list[Buffer] = field(default_factory=list)
    known: dict[tuple[ir.Formula, Stretch], Buffer] = field(default_factory=dict)


@dataclass(slots=True)
class _Planner:
    samples: int
    scopes: list[_Scope] = field(default_factory=lambda: [_Scope()])
    buffers: list[Buffer] = field(default_factory=list)
    size: int = 0
    calls: dict[CallKey, tuple[Buffer, ...]] = field(default_factory=dict)
    _loops: int = 0

    def value(self, formula: ir.Formula, run: Stretch) -> Buffer:
        """The buffer with the robustness of a formula at the instants of `run`."""
        formula = _split(formula)
        depth = self._depth(formula)
        if depth < len(self.scopes) - 1:
            inner, self.scopes = self.scopes, self.scopes[: depth + 1]
            frozen = any(not scope.listed for scope in inner[depth + 1 :])
            found = self.value(formula, run.settled if frozen else run)
            self.scopes = inner
            return found
        known = self.scopes[-1].known
        key = (formula, run)
        if key not in known:
            known[key] = self._value(formula, run)
        return known[key]

    def _depth(self, formula: ir.Formula) -> int:
        """How many of the loops around a formula it depends on."""
        if len(self.scopes) == 1:
            return 0
        read = _frozen_names(formula)
        known = (scope.held.keys() | scope.listed for scope in self.scopes)
        return max((depth for depth, names in enumerate(known) if read & names), default=0)

    def _value(self, formula: ir.Formula, run: Stretch) -> Buffer:
        match formula:
            case ir.Truth(value):
                return self._add(Fill(self._buffer(run), run, math.inf if value else -math.inf))
            case ir.Predicate():
                self._check(formula.num, run)
                return self._add(Margin(self._buffer(run), run, formula, self._held()))
            case ir.BoolOp(op, items):
                return self._join(PICKS[op], _operands(op, items), run)
            case ir.Temporal() | ir.PastTemporal():
                return self._window(formula, run)
            case ir.Until() | ir.Since():
                return self._meeting(formula, run)
            case ir.Shift():
                return self._shift(formula, run)
            case ir.Freeze():
                return self._freeze(formula, run)
            case ir.AtStart(body):
                first = self.value(body, between(0, 0))
                return self._add(Repeated(self._buffer(run), run, first))
            case _:
                assert_never(formula)

    def roots(self, formulas: Sequence[ir.Formula]) -> tuple[Place, ...]:
        """Where the robustness of formulas at the first sample stands; those of equal shape side by side."""
        places: dict[int, Place] = {}
        for family in self._families(list(map(_split, formulas))):
            rows = self._tabled(family, between(0, 0), None)
            places.update((member, Place(rows, row)) for row, member in enumerate(family.members))
        for i, formula in enumerate(formulas):
            if i not in places:
                places[i] = Place(self.value(formula, between(0, 0)), 0)
        return tuple(places[i] for i in range(len(formulas)))

    def _join(self, pick: Pick, items: Sequence[ir.Formula], run: Stretch) -> Buffer:
        """The extremum of formulas, those of equal shape first made one."""
        found = self._families(items)
        loops = {family.members[0]: family for family in found}
        taken = {member for family in found for member in family.members[1:]}
        parts = tuple(
            self._tabled(loops[i], run, pick) if i in loops else self.value(item, run)
            for i, item in enumerate(items)
            if i not in taken
        )
        return parts[0] if len(parts) == 1 else self._add(Joined(self._buffer(run), run, pick, parts))

    def _families(self, formulas: Sequence[ir.Formula]) -> list[Family]:
        found = families(formulas, self._loops + 1)
        self._loops += len(found)
        return found

    def _tabled(self, family: Family, run: Stretch, pick: Pick | None) -> Buffer:
        table = family.table
        out = self._buffer(run if pick else between(0, table.rows - 1))
        inner = _Scope(listed=table.names)
        self.scopes.append(inner)
        body = self.value(family.shape, run)
        self.scopes.pop()
        self._loops += 1
        steps, own = tuple(inner.steps), tuple(inner.own)
        return self._add(Tabled(out, run, pick, f"p{self._loops}", table, steps, own, body))

    def _window(self, node: ir.Temporal | ir.PastTemporal, run: Stretch) -> Buffer:
        window, back = node.window, isinstance(node, ir.PastTemporal)
        if back:
            inner = Stretch(self._first(window, run), run.last.plus(-window.lo))
        else:
            inner = Stretch(run.first.plus(window.lo), self._last(window, run))
        if inner.rows <= 0:
            return self._nothing(node.op, run)
        body = self.value(node.body, inner)
        return self._add(Extremum(self._buffer(run), run, PICKS[node.op], window, body, back))

    def _meeting(self, node: ir.Until | ir.Since, run: Stretch) -> Buffer:
        window, back = node.window, isinstance(node, ir.Since)
        if back:
            first = self._first(window, run)
            whole, inner = Stretch(first, run.last), Stretch(first, run.last.plus(-window.lo))
        else:
            last = self._last(window, run)
            whole, inner = Stretch(run.first, last), Stretch(run.first.plus(window.lo), last)
        if inner.rows <= 0:
            return self._nothing(node.op, run)
        left, right = self.value(node.left, whole), self.value(node.right, inner)
        return self._add(Meeting(self._buffer(run), run, PICKS[node.op], window, left, right, back))

    def _nothing(self, op: str, run: Stretch) -> Buffer:
        """The extremum over no instants."""
        return self._add(Fill(self._buffer(run), run, math.inf if PICKS[op] == "MIN" else -math.inf))

    def _first(self, window: ir.Window, run: Stretch) -> Index:
        """The first instant that a window of the past reads."""
        return at(0) if window.hi is None else run.first.plus(-window.hi).at_least(0)

    def _last(self, window: ir.Window, run: Stretch) -> Index:
        """The last instant that a window of the future reads."""
        last = at(self.samples - 1) if window.hi is None else run.last.plus(window.hi)
        if max(run.last.high + window.lo, last.high) >= self.samples:
            raise Untranslatable("a window that leaves the plan")
        return last

    def _shift(self, node: ir.Shift, run: Stretch) -> Buffer:
        there = Stretch(run.first.plus(node.steps).at_least(0), run.last.plus(node.steps))
        last = self.samples - 1
        if there.last.high > last:
            there = replace(there, last=at(last))
        inside = run.first.low + node.steps >= 0 and run.last.high + node.steps <= last
        if node.outside is None and not inside:
            raise Untranslatable("a sample outside of the plan")
        body = self.value(node.body, there) if there.rows > 0 else None
        outside = math.inf if node.outside else -math.inf
        return self._add(Moved(self._buffer(run), run, body, node.steps, outside))

    def _freeze(self, node: ir.Freeze, run: Stretch) -> Buffer:
        for _, num in node.bindings:
            self._check(num, run)
        self._loops += 1
        index = f"f{self._loops}"
        now = Index(index, run.first.low, run.last.high)
        around, out, inner = self._held(), self._buffer(run), _Scope()
        inner.held.update((name, self._buffer(between(0, 0), inner)) for name, _ in node.bindings)
        self.scopes.append(inner)
        body = self.value(node.body, Stretch(now, now))
        self.scopes.pop()
        numbers = tuple((inner.held[name], num) for name, num in node.bindings)
        return self._add(Frozen(out, run, index, numbers, around, tuple(inner.steps), tuple(inner.own), body))

    def _check(self, num: ir.Num, run: Stretch) -> None:
        """Refuse what reads beyond the plan; see to the functions that a number calls."""
        past, future = reach_of(num)
        if run.first.low < past or run.last.high + future >= self.samples:
            raise Untranslatable("a sample outside of the plan")
        for part in subexpressions(num):
            key = call_of(part)
            if key is not None and key not in self.calls:
                self._call(key, part)

    def _call(self, key: CallKey, num: ir.Num) -> None:
        assert isinstance(num, ir.Extern)
        assert isinstance(num.function, ir.Body)
        whole, first = between(0, self.samples - 1), self.scopes[0]
        outs = tuple(self._buffer(whole, first) for _ in num.function.outputs)
        first.steps.append(Called(outs, whole, replace(num, args=key[1], output=0)))
        self.calls[key] = outs

    def _held(self) -> dict[str, Buffer]:
        return {name: buffer for scope in self.scopes for name, buffer in scope.held.items()}

    def _buffer(self, run: Stretch, scope: _Scope | None = None) -> Buffer:
        buffer = Buffer(f"b{len(self.buffers)}", run.first.low, run.rows, self.size)
        self.buffers.append(buffer)
        (scope or self.scopes[-1]).own.append(buffer)
        self.size += buffer.rows
        return buffer

    def _add(
        self, step: Fill | Margin | Joined | Extremum | Meeting | Moved | Repeated | Frozen | Tabled
    ) -> Buffer:
        self.scopes[-1].steps.append(step)
        return step.out


def _frozen_names(formula: ir.Formula) -> frozenset[str]:
    """The frozen values that a formula reads and does not bind, and its columns."""
    match formula:
        case ir.Predicate(num):
            return frozen_in(num) | columns_of(num)
        case ir.Freeze(bindings, body):
            inner = _frozen_names(body) - {name for name, _ in bindings}
            return inner.union(*(frozen_in(num) | columns_of(num) for _, num in bindings))
        case _:
            return frozenset().union(*map(_frozen_names, operands(formula)))


LARGE = 64
"""Nodes of a number from which on its extrema are computed apart: compilers take long over long loops."""


def _split(formula: ir.Formula) -> ir.Formula:
    """A predicate over the extremum of large numbers as a formula over predicates; anything else as it is."""
    if not isinstance(formula, ir.Predicate) or formula.guard or not isinstance(formula.num, ir.Op):
        return formula
    if not _large(formula.num):
        return formula
    num = _raised(formula.num)
    name, args = num.name, num.args
    if name not in ("min", "max", "neg"):
        return formula
    if name == "neg":
        return _split(replace(formula, num=args[0], sign=-formula.sign, strict=formula.strict))
    if len(args) == 1:
        return _split(replace(formula, num=args[0]))
    both = (name == "min") == (formula.sign > 0)
    return ir.BoolOp("and" if both else "or", tuple(replace(formula, num=arg) for arg in args), formula.span)


def _raised(num: ir.Op) -> ir.Op:
    """An extremum plus or minus a number as the extremum of sums: bit for bit, since rounding is monotone."""
    if num.name not in ("add", "sub") or len(num.args) != 2:
        return num
    for i, part in enumerate(num.args):
        other = num.args[1 - i]
        if (
            isinstance(part, ir.Op)
            and part.name in ("min", "max")
            and isinstance(other, ir.Const | ir.Signal | ir.FrozenVar)
        ):
            name = part.name
            if num.name == "sub" and i == 1:
                name = "max" if name == "min" else "min"
            sums = [tuple((arg, other) if i == 0 else (other, arg)) for arg in part.args]
            return ir.Op(name, tuple(ir.Op(num.name, pair) for pair in sums))
    return num


def _operands(op: str, items: Sequence[ir.Formula]) -> list[ir.Formula]:
    """The operands of a join, those of joins of the same kind among them."""
    found: list[ir.Formula] = []
    for item in map(_split, items):
        found += _operands(op, item.items) if isinstance(item, ir.BoolOp) and item.op == op else [item]
    return found


def _large(num: ir.Num) -> bool:
    return next(islice(subexpressions(num), LARGE, None), None) is not None
