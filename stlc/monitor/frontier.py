"""Windows that run to the end of the trace, judged from its first sample on in bounded memory.

What has been seen up to a frontier is a monotone function of what the endless operators will be worth from
the frontier on: a lattice polynomial. It is known by its values where each of them is -inf or +inf, which are
the formula on the samples seen, with each endless operator continued by that constant.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from stlc.compile import ir
from stlc.compile.horizon import nodes, reach
from stlc.monitor.columns import NOTHING, Reader, Side
from stlc.monitor.streams import EndlessError, Plan, column, endless
from stlc.monitor.values import history

Floats: TypeAlias = NDArray[np.float64]
Subset: TypeAlias = frozenset[int]

_MOST = 6
"""More endless operators than this are not worth their 2^n coefficients."""


@dataclass(frozen=True, slots=True)
class Moved:
    """A formula without endless windows, read some samples later than its instant."""

    formula: ir.Formula
    steps: int

    @property
    def reach(self) -> int:
        """Samples after the instant that it reads."""
        return self.steps + reach(self.formula).future


@dataclass(slots=True)
class Skeleton:
    """The endless operators of a formula over columns `$0`, `$1`, …; each with `lo` 0.

    Attributes:
        root: the formula.
        parts: column -> what it stands for.
        variables: the endless operators in it.
        origins: for each of them, itself before its lower bound was taken off, and that bound.
    """

    root: ir.Formula
    parts: dict[str, Moved] = field(default_factory=dict)
    variables: tuple[ir.Formula, ...] = ()
    origins: dict[ir.Formula, Moved] = field(default_factory=dict)

    @property
    def reach(self) -> int:
        """Samples after an instant that have to be known before it goes into a polynomial."""
        return max((part.reach for part in (*self.parts.values(), *self.origins.values())), default=0)

    def unsure(self, plan: Plan) -> int:
        """After how many unknown samples one more makes no difference."""
        streams = sum(stream.back + stream.ahead for stream in plan.streams)
        return self.reach + self.back + streams + 1

    @property
    def back(self) -> int:
        """Rows before an instant that the parts read."""
        return max((history(part.formula) for part in self.parts.values()), default=0)


def skeleton(formula: ir.Formula) -> Skeleton:
    """Take a formula over columns apart.

    Raises:
        EndlessError: an endless operator stands under one with an end, or there are too many.
    """
    found = Skeleton(formula)
    root = _taken(formula, 0, found)
    variables = tuple(dict.fromkeys(node for node in nodes(root) if endless_node(node)))
    if len(variables) > _MOST:
        raise EndlessError
    found.root, found.variables = root, variables
    return found


def endless_node(node: ir.Formula) -> bool:
    """Whether the window of an operator has no end."""
    return isinstance(node, (ir.Over, ir.Until)) and node.window.hi is None


def _taken(formula: ir.Formula, steps: int, found: Skeleton) -> ir.Formula:
    """The formula `steps` samples later, over columns."""
    if not endless(formula):
        return _part(formula, steps, found)
    forever = ir.Window(0, None)
    match formula:
        case ir.Join(op, items):
            return ir.Join(op, tuple(_taken(item, steps, found) for item in items))
        case ir.Shift(later, body, None) if later >= 0:
            return _taken(body, steps + later, found)
        case ir.Over(op, ir.Window(lo, None), body):
            node: ir.Formula = ir.Over(op, forever, _taken(body, steps + lo, found))
            found.origins[node] = Moved(formula, steps)
            return node
        case ir.Until(op, ir.Window(lo, None), left, right):
            parts = _taken(left, steps + lo, found), _taken(right, steps + lo, found)
            node = ir.Until(op, forever, *parts)
            found.origins[node] = Moved(ir.Until(op, forever, left, right), steps + lo)
            if not lo:
                return node
            return _held(op == "until", ir.Window(0, lo - 1), (left, steps, found), node)
        case _:
            raise EndlessError


def _held(
    every: bool, window: ir.Window, left: tuple[ir.Formula, int, Skeleton], then: ir.Formula
) -> ir.Formula:
    """What `until` asks of its left side before its window starts; of `release` the dual."""
    formula, steps, found = left
    if endless(formula):
        raise EndlessError
    before = ir.Over("always" if every else "eventually", window, formula)
    return ir.Join("and" if every else "or", (_part(before, steps, found), then))


def _part(formula: ir.Formula, steps: int, found: Skeleton) -> ir.Formula:
    if isinstance(formula, ir.Truth):
        return formula
    moved = Moved(formula, steps)
    for name, known in found.parts.items():
        if known == moved:
            return column(name)
    name = f"${len(found.parts)}"
    found.parts[name] = moved
    return column(name)


def continued(formula: ir.Formula, variables: Sequence[ir.Formula], chosen: Subset) -> ir.Formula:
    """The formula where the endless operators go on as true (the chosen ones) or false."""
    match formula:
        case ir.Join(op, items):
            return ir.Join(op, tuple(continued(item, variables, chosen) for item in items))
        case ir.Over(op, window, body):
            rest = ir.Truth(variables.index(formula) in chosen)
            until_now = ir.Over(op, window, continued(body, variables, chosen))
            return ir.Join("and" if op == "always" else "or", (until_now, rest))
        case ir.Until(op, window, left, right):
            rest = ir.Truth(variables.index(formula) in chosen)
            held, met = (continued(part, variables, chosen) for part in (left, right))
            seen = ir.Until(op, window, held, met)
            if op == "until":
                return ir.Join("or", (seen, ir.Join("and", (ir.Over("always", window, held), rest))))
            return ir.Join("and", (seen, ir.Join("or", (ir.Over("eventually", window, held), rest))))
        case _:
            return formula


def subsets(count: int) -> list[Subset]:
    """All subsets of the first `count` numbers."""
    return [frozenset(some) for size in range(count + 1) for some in combinations(range(count), size)]


@dataclass(slots=True)
class Frontier:
    """The value of a formula at the first sample, at one end of what is possible.

    Attributes:
        bones: the formula.
        side: the columns.
        at: number of the first sample that is not yet in the polynomial.
        coefficients: subset of the operators that are +inf -> value (1, traces); None at first.
    """

    bones: Skeleton
    side: Side
    at: int = 0
    coefficients: dict[Subset, Floats] | None = None
    _parts: dict[int, tuple[list[str], Reader]] = field(default_factory=dict, init=False)
    _readers: dict[tuple[bool, bool], Reader] = field(default_factory=dict, init=False)
    _unsure: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        for steps in dict.fromkeys(part.steps for part in self.bones.parts.values()):
            alike = {name: part.formula for name, part in self.bones.parts.items() if part.steps == steps}
            self._parts[steps] = (list(alike), Reader(list(alike.values()), self.side.end))
        variables = self.bones.variables
        for goals in ((self.bones.root,), variables):
            asked = [continued(goal, variables, some) for some in subsets(len(variables)) for goal in goals]
            self._readers[goals is variables, True] = Reader(asked, "truncate")
            self._readers[goals is variables, False] = Reader(goals, "truncate")
        self._unsure = self.bones.unsure(self.side.plan)

    def advance(self, settled: int) -> None:
        """Put the samples before `settled` into the polynomial."""
        count = settled - self.at
        if count <= 0:
            return
        values = self._first(count, going_on=True)
        every = subsets(len(self.bones.variables))
        size = len(values) // len(every)
        found = {chosen: values[i * size : (i + 1) * size] for i, chosen in enumerate(every)}
        if self.coefficients is None:
            self.coefficients = {chosen: some[0] for chosen, some in found.items()}
        else:
            self.coefficients = {chosen: self._at(some) for chosen, some in found.items()}
        self.at = settled

    def value(self, samples: int) -> Floats:
        """The value while the trace goes on: as many unknown samples follow as the formula can tell apart."""
        found = self._first(samples - self.at + self._unsure, going_on=False)
        return found[0] if self.coefficients is None else self._at(found)

    def ended(self, formula: ir.Formula, samples: int) -> Floats:
        """The value where the last sample is the end of the trace."""
        if self.coefficients is None:
            return self._plain(formula, 0, samples)
        origins = [self.bones.origins[variable] for variable in self.bones.variables]
        return self._at([self._plain(o.formula, self.at + o.steps, samples) for o in origins])

    def _first(self, count: int, *, going_on: bool) -> list[Floats]:
        """The formula, or once there is a polynomial the operators, at the frontier."""
        reader = self._readers[self.coefficients is not None, going_on]
        return reader(self._columns(count), 0, 1)

    def _plain(self, formula: ir.Formula, at: int, samples: int) -> Floats:
        """A formula over columns at one sample, endless windows up to the last sample."""
        parts: dict[str, Moved] = {}
        plain = _outlined(formula, parts)
        first = min(self.at, at)
        reader = Reader([part.formula for part in parts.values()], self.side.end)
        found = self.side.values(reader, first, samples - first) if parts else []
        env = dict(zip(parts, found, strict=True))
        env[NOTHING] = np.zeros((samples - first, self.side.rows[NOTHING].shape[1]))
        return Reader([plain], self.side.end)(env, at - first, 1)[0]

    def _columns(self, count: int) -> dict[str, Floats]:
        """The parts at the next `count` samples."""
        env = {NOTHING: np.zeros((count, self.side.rows[NOTHING].shape[1]))}
        for steps, (names, reader) in self._parts.items():
            env |= zip(names, self.side.values(reader, self.at + steps, count), strict=True)
        return env

    def _at(self, values: Sequence[Floats]) -> Floats:
        """The polynomial where the operators have these values."""
        assert self.coefficients is not None
        terms = [
            np.minimum.reduce([coefficient, *(values[i] for i in chosen)])
            for chosen, coefficient in self.coefficients.items()
        ]
        return np.asarray(np.maximum.reduce(terms))


def _outlined(formula: ir.Formula, parts: dict[str, Moved]) -> ir.Formula:
    """The formula with columns for all that has no endless window."""
    if not endless(formula):
        return _part(formula, 0, Skeleton(formula, parts))
    match formula:
        case ir.Join(op, items):
            return ir.Join(op, tuple(_outlined(item, parts) for item in items))
        case ir.Shift(steps, body, outside):
            return ir.Shift(steps, _outlined(body, parts), outside)
        case ir.Over(op, window, body):
            return ir.Over(op, window, _outlined(body, parts))
        case ir.Until(op, window, left, right):
            return ir.Until(op, window, _outlined(left, parts), _outlined(right, parts))
        case _:
            raise EndlessError
