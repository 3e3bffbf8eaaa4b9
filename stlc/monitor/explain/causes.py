"""Causes of a violation at an instant (a sample of the trace), as a tree of sub-formulas.

A node of the tree is a sub-formula as written in the source, at an instant at which it has the wrong truth
value. The children of a node explain this value. A violated conjunction has one child: the operand with the
least robustness. A violated disjunction has all operands as children; other connectives are conjunctions and
disjunctions by their definition. A violated `always` has one child: its body at the worst instant. The body
of a violated `eventually` fails at all instants of the window. The only child is the body at the instant at
which it is closest to being true.

The main path leads from the root to one predicate at one instant, the deciding predicate. Its value is the
robustness of the whole formula. Several predicate values may be equal to the robustness. The path then leads,
if possible, to one that decides alone: a change of this value changes the robustness.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from stlc.compile.backends.array.graph import evaluate_parts
from stlc.compile.backends.schedule import Boundary
from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.ir.defined import defined_at
from stlc.compile.ir.discretize import Grid
from stlc.compile.ir.holes import KNOWN
from stlc.compile.semantics.tolerance import TOLERANCE
from stlc.monitor.cells import over_columns
from stlc.monitor.values import Record, assume_missing_true, bounds
from stlc.source import Span
from stlc.units import Unit

Floats = NDArray[np.float64]

MOST_TIED = 64
"""Greatest number of values equal to the robustness that are tried for one that decides alone."""

_MOST_NUMBERS = 1 << 26
"""Greatest number of stored predicate values for that search."""

_SMALL = 1e-7
"""Relative change of a signal, to see whether the value of a predicate moves with it."""

_FALSE = -1e-300
"""Margin of a predicate that is false with the margin 0, if truth values decide."""

_MOST_LATER = 64
"""Greatest number of instants after the last sample at which past operators are still evaluated."""


@dataclass(frozen=True, slots=True)
class FrozenValue:
    """Value that a `freeze` has stored.

    Attributes:
        name: name to which the `freeze` binds it.
        num: the value, as a constant in SI units; a signal after the end of the trace if it is unknown.
        unit: unit of the value in the source.
        sample: instant of the `freeze`, as a sample number.
    """

    name: str
    num: ir.Num
    unit: Unit
    sample: int


@dataclass(frozen=True, slots=True)
class CauseNode:
    """Node of a tree of causes: a sub-formula that has the wrong truth value at an instant.

    Attributes:
        formula: the sub-formula, type-checked.
        holds: truth value that the sub-formula has; the opposite value is needed.
        sample: the instant, as a sample number.
        rho: robustness of the sub-formula at `sample`; its sign gives `holds`.
        during: instants of a window of the parent at all of which the sub-formula has this truth value;
            `sample` is the one at which it is closest to the other. None if only `sample` matters.
        reads: pairs (signal, offset) of a predicate, which reads the signal `offset` samples after `sample`.
        frozen: frozen values that a predicate reads.
        parts: the children, which explain this node; empty for a predicate.
        main: index in `parts` of the child on the main path, whose robustness determines that of the node.
        premise: whether the sub-formula is the left side of an implication, or the condition of an `if`.
        moves: whether the robustness changes if only the value of the deciding predicate (`leaf`) changes.
            Not if a `freeze` stores a value that the predicate inside reads at the same sample.
    """

    formula: typed.Formula
    holds: bool
    sample: int
    rho: float
    during: range | None = None
    reads: tuple[tuple[str, int], ...] = ()
    frozen: tuple[FrozenValue, ...] = ()
    parts: tuple[CauseNode, ...] = ()
    main: int = 0
    premise: bool = False
    moves: bool = True

    @property
    def span(self) -> Span:
        """Source location of the sub-formula."""
        return self.formula.span

    @property
    def substituted(self) -> typed.Formula:
        """The sub-formula of a predicate with its frozen values in place."""
        values = {key: kept.num for key, kept in zip(_frozen_in(self), self.frozen, strict=True)}
        return self.formula.substitute_frozen(values)

    @property
    def leaf(self) -> CauseNode:
        """Node of the deciding predicate, reached by following `parts[main]` from node to node."""
        return self.parts[self.main].leaf if self.parts else self

    @property
    def path_moves(self) -> bool:
        """True if the attribute `moves` is True for this node and for all nodes below it on the main path."""
        return self.moves and (not self.parts or self.parts[self.main].path_moves)

    @property
    def violated(self) -> int:
        """Instant at which the body of the outermost `always` is violated; without one, `sample`."""
        outer = self.formula.word == ("eventually" if self.holds else "always") or isinstance(
            self.formula, (typed.Not, typed.Logic)
        )
        return self.parts[0].violated if outer and len(self.parts) == 1 else self.sample

    @property
    def leaves(self) -> tuple[CauseNode, ...]:
        """All predicate nodes of the tree."""
        return tuple(leaf for part in self.parts for leaf in part.leaves) if self.parts else (self,)


Spot: TypeAlias = tuple[ir.Formula, int]
"""A predicate, or a `freeze` formula, at an instant."""

Goal: TypeAlias = tuple[typed.Formula, int, bool]
"""A formula, an instant, and the truth value that the formula should have there."""


@dataclass(frozen=True, slots=True)
class Violations:
    """Instants at which a sub-formula of a requirement does not have the truth value `wanted`."""

    formula: typed.Formula
    wanted: bool
    instants: NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class _Tied:
    """Columns of predicate values (samples, 1), of which `raised` is increased to the next larger float.

    The increase shows whether this value alone determines the robustness. `coded` adds missing columns to
    `names` and `env`; `done` holds its results by the identity of the formula.
    """

    record: Record
    end: Boundary
    stop: int | None
    raised: Spot | None = None
    names: dict[ir.Formula, str] = field(default_factory=dict)
    env: dict[str, Floats] = field(default_factory=dict)
    done: dict[int, tuple[ir.Formula, ir.Formula]] = field(default_factory=dict)

    @property
    def columns(self) -> dict[str, Floats]:
        if self.raised is None:
            return self.env
        predicate, sample = self.raised
        name = self.names[predicate]
        column = self.env[name].copy()
        column[sample] = np.nextafter(column[sample], np.inf)
        return {**self.env, name: column}

    def coded(self, formula: ir.Formula) -> ir.Formula:
        """Return the formula with each predicate replaced by the column (time series) of its values."""
        known = self.done.get(id(formula))
        if known is not None:
            return known[1]
        missing = [leaf for leaf in _leaves_of(formula) if leaf not in self.names]
        found = (
            self.record.values(missing, range(self.record.samples), self.end, self.stop) if missing else []
        )
        for leaf, values in zip(missing, found, strict=True):
            self.names[leaf] = f"#{len(self.names)}"
            self.env[self.names[leaf]] = np.asarray(values, np.float64)
        over = over_columns(formula, self.names)
        self.done[id(formula)] = formula, over  # which keeps the formula, and so its identity
        return over

    def worth(self, formula: ir.Formula, sample: int) -> float:
        coded = self.coded(formula)
        record = replace(self.record, env=self.columns)
        return float(record.values([coded], range(sample, sample + 1), self.end, self.stop)[0][0, 0])


def _leaves_of(formula: ir.Formula) -> dict[ir.Formula, None]:
    """Predicates of a formula, each once, as the keys of a dictionary; a `freeze` counts as one."""
    if formula.own_numbers:
        return {formula: None}
    return {leaf: None for part in formula.operands for leaf in _leaves_of(part)}


@dataclass(frozen=True, slots=True)
class CauseFinder:
    """Finder of the causes of violations on one trace.

    Attributes:
        record: signals of the trace, (samples, 1), up to the end of the evaluated window.
        grid: time step and horizon of the signals.
        end: treatment of windows that extend beyond the end of the trace: "upper" gives the upper bound,
            "truncate" clips them.
        cache: (formula, truth value that it should have) -> the lowered formula, negated for False.
        known: lowered formula -> list of pairs (range of instants, upper bounds on the robustness at them).
        tied: predicate values, one of them slightly increased, on which formulas are then evaluated.
        given: finder with the values as they are, which are told; None if this one has them.
        stop: number of samples that the complete trace would have, if the recording is shorter; else None.
        exact: whether truth values decide, so that `x > 0` is false at 0: the tolerance is 0.
        frozen: values of the enclosing `freeze` operators.
    """

    record: Record
    grid: Grid
    end: Boundary = "upper"
    cache: dict[tuple[typed.Formula, bool], ir.Formula] = field(default_factory=dict)
    known: dict[ir.Formula, list[tuple[range, Floats]]] = field(default_factory=dict)
    tied: _Tied | None = None
    given: CauseFinder | None = None
    stop: int | None = None
    exact: bool = False
    frozen: Mapping[str, FrozenValue] = field(default_factory=dict)

    def why(self, formula: typed.Formula, sample: int, *, wanted: bool = True) -> tuple[CauseNode, bool]:
        """Explain why `formula` does not have the truth value `wanted` at `sample`.

        Returns:
            The tree of causes, and whether the deciding predicate decides alone: a change of only its value
            changes the robustness. Of several values equal to the robustness, the first `MOST_TIED` are
            tried; the main path leads to one that decides alone, if one is found.
        """
        tree = self.blame(formula, sample, wanted)
        lowered = self._lowered(formula, wanted)
        worth = self._margin(formula, sample, wanted)
        equal = self._equal(lowered, worth) if np.isfinite(worth) else []
        if len(equal) < 2:
            return tree, len(equal) == 1 and self._alone(tree, lowered)
        samples = self.record.samples
        if equal[-1][1] >= samples or samples * len(_leaves_of(lowered)) > _MOST_NUMBERS:
            return tree, False
        tied = _Tied(self.record, self.end, self.stop)
        if tied.worth(lowered, sample) != worth:
            return tree, False
        leaf = tree.leaf
        own = _leaves_of(self._lowered(leaf.formula, not leaf.holds))
        first = [each for each in equal if each[1] == leaf.sample and each[0] in own]
        for chosen in (*first, *equal[:MOST_TIED]):
            raised = replace(tied, raised=chosen)
            if raised.worth(lowered, sample) > worth:
                if chosen not in first:
                    tree = replace(self, cache={}, known={}, tied=raised, given=self).blame(
                        formula, sample, wanted
                    )
                return tree, self._alone(tree, lowered)
        return tree, False

    def _alone(self, tree: CauseNode, lowered: ir.Formula) -> bool:
        """True if the deciding predicate, whose value decides alone, also does if its signals change.

        Not if its value only moves with a step of a signal, as that of `floor(x) > 2`, which may change other
        predicates or instants that read the signal.
        """
        leaf, record = tree.leaf, self.record
        names = {name for name, _ in leaf.reads}
        own = self._lowered(leaf.substituted, not leaf.holds)
        others = set(lowered.predicates()) - set(_leaves_of(own))
        shared = len(names) < len(leaf.reads) or any(other.num.columns & names for other in others)
        if not tree.path_moves or not shared:
            return tree.path_moves

        def worth(env: Mapping[str, Floats]) -> float:
            at = range(leaf.sample, leaf.sample + 1)
            return float(replace(record, env=env).values([own], at, self.end, self.stop)[0][0, 0])

        before = worth(record.env)
        spots = [
            (name, leaf.sample + later, side) for name, later in leaf.reads for side in (_SMALL, -_SMALL)
        ]
        for name, there, step in spots:
            if 0 <= there < record.samples:
                column = record.env[name].copy()
                column[there] += step * max(1.0, abs(column[there, 0]))
                if worth({**record.env, name: column}) > before:
                    return True
        return False

    def _equal(self, lowered: ir.Formula, worth: float) -> list[Spot]:
        """Predicates of `lowered` and instants at which they have the value `worth`, in order of time."""
        wanted = _leaves_of(lowered)
        found = {
            (node, its.start + int(k)): None
            for node, entries in self.known.items()
            if node in wanted
            for its, values in entries
            for k in np.flatnonzero(values == worth)
        }
        return sorted(found, key=lambda spot: spot[1])

    def blame(self, formula: typed.Formula, sample: int, wanted: bool = True) -> CauseNode:
        """Return the tree that explains why `formula` does not have the truth value `wanted` at `sample`."""
        margin = (self.given or self)._margin(formula, sample, wanted)
        margin = 0.0 if margin == _FALSE else margin
        node = CauseNode(formula, not wanted, sample, margin if wanted else -margin)
        match formula:
            case typed.Predicate():
                return self._predicate(node)
            case _ if _is_written_predicate(formula):
                return self._predicate(node)
            case typed.Not(_, body):
                found = replace(node, parts=(self.blame(body, sample, not wanted),))
            case typed.Logic():
                found = self._logic(node, formula)
            case _ if formula.on_clock:
                found = replace(self.blame(formula.from_now(), 0, wanted), formula=formula, sample=sample)
            case typed.Temporal():
                found = self._temporal(node, formula)
            case typed.Until(_, "unless"):
                found = replace(node, parts=(self.blame(formula.unless(), sample, wanted),))
            case typed.Until():
                found = self._until(node, formula)
            case typed.Shift(_, steps, body):
                there = sample + steps
                decided = there < self.record.samples or (
                    self.end == "upper" and self._margin(body, there, wanted) != math.inf
                )
                parts = (self.blame(body, there, wanted),) if there >= 0 and decided else ()
                found = replace(node, parts=parts)
            case typed.Edge():
                found = self._edge(node, formula)
            case typed.Freeze():
                found = self._freeze(node, formula)
            case _:
                return node
        return _merged(found)

    def violations(
        self, formula: typed.Formula, instants: NDArray[np.int64], *, wanted: bool = True
    ) -> Iterator[Violations]:
        """Yield the instants at which the bodies of the outermost `always` are violated.

        Args:
            formula: formula that does not have the truth value `wanted` at `instants`, in ascending order.
            instants: samples.
            wanted: truth value that is needed.
        """
        match formula:
            case typed.Not(_, body):
                yield from self.violations(body, instants, wanted=not wanted)
            case typed.Temporal(_, op, _, body) if op == ("always" if wanted else "eventually"):
                here, starts = (formula.from_now(), [0]) if formula.on_clock else (formula, instants.tolist())
                windows = [self._instants(self._lowered(here, wanted), k) for k in starts]
                edges = np.zeros(max((each.stop for each in windows), default=0) + 1, np.int64)
                for window in windows:
                    if window:
                        edges[window.start] += 1
                        edges[window.stop] -= 1
                inside = np.flatnonzero(np.cumsum(edges) > 0)
                yield from self._failing(body, inside, wanted)
            case typed.Logic():
                outer = formula.connective(1 if wanted else -1)
                if outer.op == "or" or any(len(group) > 1 for group in outer.groups):
                    yield Violations(formula, wanted, instants)
                    return
                for ((part, sign),) in outer.groups:
                    yield from self._failing(part, instants, sign > 0)
            case _:
                yield Violations(formula, wanted, instants)

    def _failing(
        self, formula: typed.Formula, instants: NDArray[np.int64], wanted: bool
    ) -> Iterator[Violations]:
        if len(instants):
            span = range(int(instants[0]), int(instants[-1]) + 1)
            margins = self._margins(formula, wanted, span)[instants - span.start]
            fails = TOLERANCE.violated(margins, 0.0 if self.exact else None)
            if fails.any():
                yield from self.violations(formula, instants[fails], wanted=wanted)

    def _lowered(self, formula: typed.Formula, wanted: bool) -> ir.Formula:
        """Return the formula with basic operators and intervals in samples, negated if `wanted` is False.

        Predicates on missing signals are assumed true. If samples are unknown, it is the upper bound.
        """
        key = (formula, wanted)
        if key not in self.cache:
            goal = formula if wanted else typed.Not(formula.span, formula)
            bound = {key: kept.num for key, kept in self.frozen.items()}
            substituted = self.grid.lower(goal, []).substitute_frozen(bound)
            given = assume_missing_true(_strict(substituted) if self.exact else substituted, self.record.env)
            self.cache[key] = self.record.sides(given)[1]
        return self.cache[key]

    def _margins(self, formula: typed.Formula, wanted: bool, instants: range) -> Floats:
        """Upper bounds, (instants,), on the robustness of `formula`; of its negation unless `wanted`."""
        lowered = self._lowered(formula, wanted)
        if self.tied is not None:
            lowered = self.tied.coded(lowered)
        found = self._found(lowered, instants)
        if found is None:
            env = self.record.env if self.tied is None else self.tied.columns
            ops, end, stop = self.record.ops, self.end, self.stop
            parts = evaluate_parts(lowered, env, instants, ops=ops, end=end, stop=stop)
            for node, its, values in parts:
                self.known.setdefault(node, []).append((its, values[:, 0]))
            found = self._found(lowered, instants)
        assert found is not None
        return found

    def _found(self, lowered: ir.Formula, instants: range) -> Floats | None:
        """Upper bounds, (instants,), in `known`; None if it does not contain them."""
        for its, values in self.known.get(lowered, ()):
            if its.start <= instants.start and instants.stop <= its.stop:
                return values[instants.start - its.start : instants.stop - its.start].astype(np.float64)
        return None

    def _margin(self, formula: typed.Formula, sample: int, wanted: bool) -> float:
        """Upper bound on the robustness at `sample`; +inf if the trace ends before it is decided."""
        return float(self._margins(formula, wanted, range(sample, sample + 1))[0])

    def _least(self, parts: Sequence[Goal]) -> Goal:
        return parts[int(np.argmin([self._margin(*part) for part in parts]))]

    def _predicate(self, node: CauseNode) -> CauseNode:
        reads = self._reads(self._lowered(node.formula, not node.holds).numbers(), node.sample)
        frozen = tuple(self.frozen[key] for key in _frozen_in(node))
        return replace(node, reads=tuple(sorted(reads)), frozen=frozen)

    def _reads(self, nums: Iterable[ir.Num], sample: int) -> set[tuple[str, int]]:
        """Pairs (signal, offset) of the values that expressions read when evaluated at `sample`."""
        found = set()
        for name, later, clamped in (read for num in nums for read in num.reads()):
            if not name.startswith(KNOWN):
                there = min(max(sample + later, 0), self.record.samples - 1)
                found.add((name, there - sample if clamped else later))
        return found

    def _freeze(self, node: CauseNode, formula: typed.Freeze) -> CauseNode:
        values = {**self.frozen, **self._values(formula, node.sample)}
        inner = replace(self, cache={}, known={}, tied=None, given=None, frozen=values)
        tree, alone = inner.why(formula.body, node.sample, wanted=not node.holds)
        stored = self._reads((num for _, num in formula.bindings), node.sample)
        frozen = {(name, node.sample + later) for name, later in stored}
        read = {(name, tree.leaf.sample + later) for name, later in tree.leaf.reads}
        return replace(node, parts=(tree,), moves=alone and not frozen & read)

    def _values(self, formula: typed.Freeze, sample: int) -> dict[str, FrozenValue]:
        values: dict[str, FrozenValue] = {}
        last = self.record.samples - 1
        outer = {key: kept.num for key, kept in self.frozen.items()}
        units = formula.units or (Unit.ONE,) * len(formula.bindings)
        for (key, written), unit in zip(formula.bindings, units, strict=True):
            num = written.substitute_frozen(outer)
            value: ir.Num = ir.ShiftedSignal(next(iter(self.record.env)), last + 1)
            given = num.columns <= self.record.env.keys()
            here = range(sample, sample + 1)
            if given and sample <= last and defined_at(ir.Predicate(num), last + 1, here):
                low, high = bounds(ir.Predicate(num), self.record, here, "open")
                if low[0, 0] == high[0, 0]:
                    value = ir.Const(float(low[0, 0]))
            values[key] = FrozenValue(key.partition("#")[0], value, unit, sample)
        return values

    # ---------------------------------------------------------------- connectives

    def _logic(self, node: CauseNode, formula: typed.Logic) -> CauseNode:
        outer = formula.connective(-1 if node.holds else 1)
        groups = [[(part, node.sample, sign > 0) for part, sign in group] for group in outer.groups]
        if outer.op == "and":  # of the group that is farthest from holding, no operand has the needed value
            items = min(groups, key=lambda group: max(self._margin(*item) for item in group))
        else:  # of each group, the operand that is farthest from the needed value
            order = {id(item): index for index, item in enumerate(formula.items)}
            items = sorted(map(self._least, groups), key=lambda item: order[id(item[0])])
        if formula.op in ("->", "if") and len(items) > 1:
            return replace(node, **self._decision(formula.items[0], items))
        margins = np.array([self._margin(*item) for item in items])
        return replace(node, parts=tuple(self.blame(*item) for item in items), main=_greatest_known(margins))

    def _decision(self, premise: typed.Formula, items: Sequence[Goal]) -> dict[str, Any]:
        """Parts of an implication or `if`: what it decides on first, and then the operands in its scope."""
        margins = np.array([self._margin(*item) for item in items])
        main = len(items) - 1 - _greatest_known(margins[::-1])  # of equal ones the last
        found = [self.blame(*item) for item in items]
        if items[0][0] is not premise:
            sample = items[0][1]
            fails = [side for side in (True, False) if self._margin(premise, sample, side) < 0]
            found[:0] = [self.blame(premise, sample, side) for side in fails[:1]]
            main += len(fails[:1])
        first, *rest = found
        if first.formula is premise:
            first = replace(first, premise=True)
        return {"parts": (first, *rest), "main": main}

    def _edge(self, node: CauseNode, formula: typed.Edge) -> CauseNode:
        if node.sample == 0:
            return node
        now, wanted = formula.op == "rise", not node.holds
        items = [
            (formula.body, node.sample, now is wanted),
            (formula.body, node.sample - 1, now is not wanted),
        ]
        if wanted:
            return replace(node, parts=(self.blame(*self._least(items)),))
        main = int(np.argmax([self._margin(*item) for item in items]))
        return replace(node, parts=tuple(self.blame(*item) for item in items), main=main)

    # ------------------------------------------------------------------- windows

    def _instants(self, lowered: ir.Formula, sample: int) -> range:
        """Instants in the window of `lowered` at `sample`, except where operands cannot be known."""
        operator, known = lowered.windowed, self._stop(lowered)
        if operator is None:
            raise TypeError(f"{type(lowered).__name__} has no window")
        window = operator.window
        if operator.back:
            return range(0 if window.hi is None else max(sample - window.hi, 0), sample - window.lo + 1)
        if window.hi is not None:
            known = min(sample + window.hi + 1, known)
        else:
            known = self.record.samples if self.stop is None else min(self.stop, known)
        return range(sample + window.lo, known)

    def _stop(self, lowered: ir.Formula) -> int:
        """First instant at which operands are unknown; past operators read samples before it, too."""
        if self.end == "truncate":
            return self.record.samples
        return self.record.samples + min(max(each.history for each in lowered.operands), _MOST_LATER)

    def _temporal(self, node: CauseNode, formula: typed.Temporal) -> CauseNode:
        wanted = not node.holds
        instants = self._instants(self._lowered(formula, wanted), node.sample)
        if not instants:
            return node
        margins = self._margins(formula.body, wanted, instants)
        if (formula.op in ("always", "historically")) is wanted:
            worst = instants[int(np.argmin(margins))]
            return replace(node, parts=(self.blame(formula.body, worst, wanted),))
        part = self.blame(formula.body, instants[_greatest_known(margins)], wanted)
        return replace(node, parts=(_throughout(part, instants),))

    def _until(self, node: CauseNode, formula: typed.Until) -> CauseNode:
        sample, wanted = node.sample, not node.holds
        lowered = self._lowered(formula, wanted)
        instants = self._instants(lowered, sample)
        last = None if formula.op == "since" or lowered.windowed is None else lowered.windowed.window.hi
        # the window extends to instants at which operands are unknown
        beyond = last is not None and (not instants or instants[-1] < sample + last)
        beyond = beyond and self.end == "upper"
        if not instants and not beyond:
            return node
        way = -1 if formula.op == "since" else 1
        if way < 0:
            held = range(instants[0], sample + 1)
        else:
            held = range(sample, max(instants[-1] + 1 if instants else self._stop(lowered), sample))
        left = self._margins(formula.left, wanted, held) if held else np.zeros(0)
        right = self._margins(formula.right, wanted, instants) if instants else np.zeros(0)
        if beyond:
            left = np.append(left, self._margin(formula.left, held.stop, wanted))
            right = np.append(right, self._margin(formula.right, held.stop, wanted))
        left, right = left[::way], right[::way]
        if (formula.op == "release") is wanted:
            met, far, main = _released(left, right)
            freed = self.blame(formula.left, sample + way * far, wanted)
            failed = self.blame(formula.right, sample + way * met, wanted)
            return replace(node, parts=(freed, failed), main=main)
        offset, is_left = _unmet(left, right)
        there = sample + way * offset
        part = self.blame(formula.left if is_left else formula.right, there, wanted)
        if not (is_left or beyond) and self._margin(formula.right, there, wanted) == right.max() < 0:
            part = _throughout(part, instants)
        return replace(node, parts=(part,))


def _throughout(node: CauseNode, instants: range) -> CauseNode:
    """The node, and what it negates, with all instants of a window, at which the truth value is the same."""
    if len(instants) < 2:
        return node
    negated = node.formula.word == "not" and len(node.parts) == 1
    parts = (_throughout(node.parts[0], instants),) if negated else node.parts
    return replace(node, during=instants, parts=parts)


def _strict(formula: ir.Formula) -> ir.Formula:
    """The formula with the margin `_FALSE` for every predicate that is false with the margin 0."""
    if isinstance(formula, ir.Predicate):
        least = ir.Op("add", (formula.num, ir.Const(formula.sign * _FALSE)))
        return replace(formula, num=least) if formula.strict else formula
    return formula.map_children(formulas=_strict)


def _is_written_predicate(formula: typed.Formula) -> bool:
    """True for a formula that is one predicate in the source, such as `a != b` or `x not in [1, 2]`."""
    whole = formula.span
    return bool(whole.text) and formula.is_state() and all(node.span == whole for node in formula.walk())


def _merged(node: CauseNode) -> CauseNode:
    """Put the children of children at the same place of the source in place of these.

    They come from the definition of an operator, such as `unless`, and have no text of their own.
    """
    merged = [bool(part.parts) and part.span == node.span and bool(node.span.text) for part in node.parts]
    if not any(merged):
        return node
    groups = [part.parts if its else (part,) for part, its in zip(node.parts, merged, strict=True)]
    main, moves = sum(map(len, groups[: node.main])), node.moves
    if merged[node.main]:
        main, moves = main + node.parts[node.main].main, moves and node.parts[node.main].moves
    return replace(node, parts=tuple(chain.from_iterable(groups)), main=main, moves=moves)


def _frozen_in(node: CauseNode) -> list[str]:
    """Keys of the frozen values that a predicate reads, in the order of their names."""
    return sorted(frozenset().union(*(each.frozen for each in node.formula.numbers())))


def _greatest_known(margins: Floats) -> int:
    return int(np.argmax(np.where(np.isposinf(margins), -np.inf, margins)))


def _unmet(left: Floats, right: Floats) -> tuple[int, bool]:
    """Offset of the value that decides a violated `until` from the start of `left`, and if it is a left one.

    `left` has the robustness from the instant of evaluation on, `right` in the window. That of `until` is the
    greatest, over instants k of the window, of the least of the right value at k and the left values up to k.
    """
    skipped = len(left) - len(right)
    held = np.minimum.accumulate(left)[skipped:]
    best = int(np.argmax(np.minimum(held, right)))
    if held[best] < right[best]:
        return int(np.argmin(left[: skipped + best + 1])), True
    return skipped + best, False


def _released(left: Floats, right: Floats) -> tuple[int, int, int]:
    """Offsets of the two values that decide a violated `release` (see `_unmet`), and the deciding side.

    These are the right value that fails and the greatest left value up to it; side 0 is left, 1 right.
    """
    skipped = len(left) - len(right)
    freed = np.maximum.accumulate(left)[skipped:]
    worst = int(np.argmin(np.maximum(freed, right)))
    return skipped + worst, int(np.argmax(left[: skipped + worst + 1])), int(right[worst] >= freed[worst])
