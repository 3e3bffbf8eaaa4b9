"""Causes of a violation at an instant (a sample of the trace), as a tree of sub-formulas.

A node of the tree is a sub-formula at an instant, at which it has the wrong truth value. The children of a
node explain this value. A violated conjunction has one child: the operand with the least robustness. A
violated disjunction has all operands as children. A violated `always` has one child: its body at the worst
instant. The body of a violated `eventually` fails at all instants of the window. The only child is the body
at the instant at which it is closest to being true.

The main path leads from the root to one predicate at one instant, the deciding predicate. Its value is the
robustness of the whole formula. Several predicate values may be equal to the robustness. The path then leads,
if possible, to one that decides alone: a change of this value changes the robustness.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeAlias, assert_never

import numpy as np
from numpy.typing import NDArray

from stlc.compile.backends.array.graph import evaluate_parts
from stlc.compile.ir import nodes as ir
from stlc.compile.ir import typed
from stlc.compile.ir.defined import defined
from stlc.compile.ir.discretize import Grid
from stlc.compile.ir.support import columns_of, history
from stlc.compile.ir.traverse import from_now, leaves, numbers, on_clock, operands, substitute_frozen
from stlc.compile.lowering.lower import lower
from stlc.monitor.cells import over_columns
from stlc.monitor.holes import KNOWN
from stlc.monitor.values import Record, assume_missing_true, bounds
from stlc.source import Span

Floats = NDArray[np.float64]

MOST_TIED = 64
"""Greatest number of values equal to the robustness that are tried for one that decides alone."""

_MOST_NUMBERS = 1 << 26
"""Greatest number of stored predicate values for that search."""

_MOST_LATER = 64
"""Greatest number of instants after the last sample at which past operators are still evaluated."""


@dataclass(frozen=True, slots=True)
class CauseNode:
    """Node of a tree of causes: a sub-formula that has the wrong truth value at an instant.

    Attributes:
        formula: the sub-formula, type-checked.
        holds: truth value that the sub-formula has; the opposite value is needed.
        sample: the instant, as a sample number.
        rho: robustness of the sub-formula at `sample`; its sign gives `holds`.
        until: last instant of the window, if the node is a temporal operator whose body has the wrong truth
            value in the whole window; `sample` is then the first instant. Otherwise None.
        reads: pairs (signal, offset) of a predicate, which reads the signal `offset` samples after `sample`.
        parts: the children, which explain this node; empty for a predicate.
        main: index in `parts` of the child on the main path, whose robustness determines that of the node.
        premise: whether the sub-formula is the left side of an implication.
        moves: whether the robustness changes if only the value of the deciding predicate (`leaf`) changes.
            Not if a `freeze` stores a value that the predicate inside reads at the same sample.
    """

    formula: typed.Formula
    holds: bool
    sample: int
    rho: float
    until: int | None = None
    reads: tuple[tuple[str, int], ...] = ()
    parts: tuple[CauseNode, ...] = ()
    main: int = 0
    premise: bool = False
    moves: bool = True

    @property
    def span(self) -> Span:
        """Source location of the sub-formula."""
        return self.formula.span

    @property
    def leaf(self) -> CauseNode:
        """Node of the deciding predicate, reached by following `parts[main]` from node to node."""
        return self.parts[self.main].leaf if self.parts else self

    @property
    def path_moves(self) -> bool:
        """True if the attribute `moves` is True for this node and for all nodes below it on the main path."""
        return self.moves and (not self.parts or self.parts[self.main].path_moves)

    @property
    def leaves(self) -> tuple[CauseNode, ...]:
        """All predicate nodes of the tree."""
        return tuple(leaf for part in self.parts for leaf in part.leaves) if self.parts else (self,)


Spot: TypeAlias = tuple[ir.Formula, int]
"""A predicate, or a `freeze` formula, at an instant."""

Goal: TypeAlias = tuple[typed.Formula, int, bool]
"""A formula, an instant, and the truth value that the formula should have there."""


@dataclass(frozen=True, slots=True)
class _Tied:
    """Columns of predicate values (samples, 1), of which `raised` is increased to the next larger float.

    The increase shows whether this value alone determines the robustness. `coded` adds missing columns to
    `names` and `env`; `done` holds its results by the identity of the formula.
    """

    record: Record
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
        found = self.record.values(missing, range(self.record.samples), "upper", self.stop) if missing else []
        for leaf, values in zip(missing, found, strict=True):
            self.names[leaf] = f"#{len(self.names)}"
            self.env[self.names[leaf]] = np.asarray(values, np.float64)
        over = over_columns(formula, self.names)
        self.done[id(formula)] = formula, over  # which keeps the formula, and so its identity
        return over

    def worth(self, formula: ir.Formula, sample: int) -> float:
        coded = self.coded(formula)
        record = replace(self.record, env=self.columns)
        return float(record.values([coded], range(sample, sample + 1), "upper", self.stop)[0][0, 0])


def _leaves_of(formula: ir.Formula) -> dict[ir.Formula, None]:
    """Predicates of a formula, each once, as the keys of a dictionary; a `freeze` counts as one."""
    if isinstance(formula, (ir.Predicate, ir.Freeze)):
        return {formula: None}
    return {leaf: None for part in operands(formula) for leaf in _leaves_of(part)}


@dataclass(frozen=True, slots=True)
class CauseFinder:
    """Finder of the causes of violations on one trace.

    Attributes:
        record: signals of the trace, (samples, 1), up to the end of the evaluated window.
        grid: time step and horizon of the signals.
        cache: (formula, truth value that it should have) -> the lowered formula, negated for False.
        known: lowered formula -> list of pairs (range of instants, upper bounds on the robustness at them).
        tied: predicate values, one of them slightly increased, on which formulas are then evaluated.
        stop: number of samples that the complete trace would have, if the recording is shorter; else None.
    """

    record: Record
    grid: Grid
    cache: dict[tuple[typed.Formula, bool], ir.Formula] = field(default_factory=dict)
    known: dict[ir.Formula, list[tuple[range, Floats]]] = field(default_factory=dict)
    tied: _Tied | None = None
    stop: int | None = None

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
            return tree, len(equal) == 1 and tree.path_moves
        samples = self.record.samples
        if equal[-1][1] >= samples or samples * len(_leaves_of(lowered)) > _MOST_NUMBERS:
            return tree, False
        tied = _Tied(self.record, self.stop)
        if tied.worth(lowered, sample) != worth:
            return tree, False
        leaf = tree.leaf
        own = _leaves_of(self._lowered(leaf.formula, not leaf.holds))
        first = [each for each in equal if each[1] == leaf.sample and each[0] in own]
        for chosen in (*first, *equal[:MOST_TIED]):
            raised = replace(tied, raised=chosen)
            if raised.worth(lowered, sample) > worth:
                if chosen not in first:
                    tree = replace(self, cache={}, known={}, tied=raised).blame(formula, sample, wanted)
                return tree, tree.path_moves
        return tree, False

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
        match formula:
            case typed.Truth() | typed.Recalled():
                return self._node(formula, sample, wanted)
            case typed.Predicate():
                return self._predicate(formula, sample, wanted)
            case typed.Not(span, body) if span == body.span and span.text:
                return self._predicate(formula, sample, wanted)  # `not in`: to a reader one predicate
            case typed.Not(_, body):
                return self.blame(body, sample, not wanted)
            case typed.Logic():
                return self._logic(formula, sample, wanted)
            case typed.Temporal() | typed.Until() if on_clock(formula):
                return self.blame(from_now(formula), 0, wanted)
            case typed.Temporal():
                return self._temporal(formula, sample, wanted)
            case typed.Until(span, "unless", interval, left, _):
                whole = replace(interval, lo=typed.Time(), lo_open=False)
                either = (typed.Temporal(span, "always", whole, left), replace(formula, op="until"))
                return self.blame(typed.Logic(span, "or", either), sample, wanted)
            case typed.Until():
                return self._until(formula, sample, wanted)
            case typed.Shift(_, steps, body):
                there = sample + steps
                decided = there < self.record.samples or self._margin(body, there, wanted) != math.inf
                parts = (self.blame(body, there, wanted),) if there >= 0 and decided else ()
                return replace(self._node(formula, sample, wanted), parts=parts)
            case typed.Edge():
                return self._edge(formula, sample, wanted)
            case typed.Freeze():
                return self._freeze(formula, sample, wanted)
        assert_never(formula)

    def _lowered(self, formula: typed.Formula, wanted: bool) -> ir.Formula:
        """Return the formula with basic operators and intervals in samples, negated if `wanted` is False.

        Predicates on missing signals are assumed true. If samples are unknown, it is the upper bound.
        """
        key = (formula, wanted)
        if key not in self.cache:
            goal = formula if wanted else typed.Not(formula.span, formula)
            given = assume_missing_true(lower(goal, self.grid, []), self.record.env)
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
            parts = evaluate_parts(lowered, env, instants, ops=self.record.ops, end="upper", stop=self.stop)
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

    def _node(self, formula: typed.Formula, sample: int, wanted: bool) -> CauseNode:
        margin = self._margin(formula, sample, wanted)
        return CauseNode(formula, not wanted, sample, margin if wanted else -margin)

    def _predicate(self, formula: typed.Formula, sample: int, wanted: bool) -> CauseNode:
        reads = self._reads(numbers(self._lowered(formula, wanted)), sample)
        return replace(self._node(formula, sample, wanted), reads=tuple(sorted(reads)))

    def _reads(self, nums: Iterable[ir.Num], sample: int) -> set[tuple[str, int]]:
        """Pairs (signal, offset) of the values that expressions read when evaluated at `sample`."""
        found = set()
        for leaf in (leaf for num in nums for leaf in leaves(num)):
            if isinstance(leaf, ir.Signal) and not leaf.name.startswith(KNOWN):
                found.add((leaf.name, 0))
            elif isinstance(leaf, ir.ShiftedSignal) and not leaf.name.startswith(KNOWN):
                there = min(max(sample + leaf.steps, 0), self.record.samples - 1)
                found.add((leaf.name, there - sample if leaf.clamped else leaf.steps))
        return found

    def _freeze(self, formula: typed.Freeze, sample: int, wanted: bool) -> CauseNode:
        thawed = substitute_frozen(formula.body, self._values(formula, sample))
        tree, alone = replace(self, cache={}, known={}, tied=None).why(thawed, sample, wanted=wanted)
        stored = self._reads((num for _, num in formula.bindings), sample)
        frozen = {(name, sample + later) for name, later in stored}
        read = {(name, tree.leaf.sample + later) for name, later in tree.leaf.reads}
        return replace(tree, moves=alone and not frozen & read)

    def _values(self, formula: typed.Freeze, sample: int) -> dict[str, ir.Num]:
        """Constants that a `freeze` stores; an unknown one is a signal after the end of the trace."""
        values: dict[str, ir.Num] = {}
        last = self.record.samples - 1
        for name, num in formula.bindings:
            values[name] = ir.ShiftedSignal(next(iter(self.record.env)), last + 1)
            given = columns_of(num) <= self.record.env.keys()
            if given and sample <= last and defined(ir.Predicate(num), last + 1)[sample]:
                low, high = bounds(ir.Predicate(num), self.record, range(sample, sample + 1), "open")
                if low[0, 0] == high[0, 0]:
                    values[name] = ir.Const(float(low[0, 0]))
        return values

    # ---------------------------------------------------------------- connectives

    def _logic(self, formula: typed.Logic, sample: int, wanted: bool) -> CauseNode:
        node = self._node(formula, sample, wanted)
        items: Sequence[Goal]
        match formula.op:
            case "and" | "or":
                items = [(item, sample, wanted) for item in formula.items]
                all_needed = (formula.op == "and") is wanted
            case "->":
                left, right = formula.items
                items = [(left, sample, not wanted), (right, sample, wanted)]
                all_needed = not wanted
            case "<->" | "xor":  # of each way to become true, the operand that is farthest from it
                left, right = formula.items
                same = (formula.op == "<->") is wanted
                ways = [[(left, sample, its), (right, sample, its is same)] for its in (True, False)]
                items = sorted(map(self._least, ways), key=lambda item: item[0] is right)
                all_needed = False
            case _:
                assert_never(formula.op)
        if all_needed:
            return replace(node, parts=(self.blame(*self._least(items)),))
        parts = tuple(self.blame(*item) for item in items)
        margins = np.array([self._margin(*item) for item in items])
        if formula.op == "->":
            main = int(margins[1] >= margins[0])
            return replace(node, parts=(replace(parts[0], premise=True), parts[1]), main=main)
        return replace(node, parts=parts, main=_greatest_known(margins))

    def _edge(self, formula: typed.Edge, sample: int, wanted: bool) -> CauseNode:
        node = self._node(formula, sample, wanted)
        if sample == 0:
            return node
        now = formula.op == "rise"
        items = [(formula.body, sample, now is wanted), (formula.body, sample - 1, now is not wanted)]
        if wanted:
            return replace(node, parts=(self.blame(*self._least(items)),))
        main = int(np.argmax([self._margin(*item) for item in items]))
        return replace(node, parts=tuple(self.blame(*item) for item in items), main=main)

    # ------------------------------------------------------------------- windows

    def _instants(self, lowered: ir.Formula, sample: int) -> range:
        """Instants in the window of `lowered` at `sample`, except where operands cannot be known."""
        if not isinstance(lowered, ir.Windowed):
            raise TypeError(f"{type(lowered).__name__} has no window")
        window, known = lowered.window, self._stop(lowered)
        if lowered.back:
            return range(0 if window.hi is None else max(sample - window.hi, 0), sample - window.lo + 1)
        if window.hi is not None:
            known = min(sample + window.hi + 1, known)
        else:
            known = self.record.samples if self.stop is None else min(self.stop, known)
        return range(sample + window.lo, known)

    def _stop(self, lowered: ir.Formula) -> int:
        """First instant at which operands are unknown; past operators read samples before it, too."""
        return self.record.samples + min(max(map(history, operands(lowered))), _MOST_LATER)

    def _temporal(self, formula: typed.Temporal, sample: int, wanted: bool) -> CauseNode:
        node = self._node(formula, sample, wanted)
        instants = self._instants(self._lowered(formula, wanted), sample)
        if not instants:
            return node
        margins = self._margins(formula.body, wanted, instants)
        if (formula.op in ("always", "historically")) is wanted:
            worst = instants[int(np.argmin(margins))]
            return replace(node, parts=(self.blame(formula.body, worst, wanted),))
        part = self.blame(formula.body, instants[_greatest_known(margins)], wanted)
        return replace(node, sample=instants[0], until=instants[-1], parts=(part,))

    def _until(self, formula: typed.Until, sample: int, wanted: bool) -> CauseNode:
        node, lowered = self._node(formula, sample, wanted), self._lowered(formula, wanted)
        instants = self._instants(lowered, sample)
        last = lowered.window.hi if isinstance(lowered, ir.Until) else None
        # the window extends to instants at which operands are unknown
        beyond = last is not None and (not instants or instants[-1] < sample + last)
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
        part = self.blame(formula.left if is_left else formula.right, sample + way * offset, wanted)
        if is_left or beyond or (right >= 0).any():
            return replace(node, parts=(part,))
        return replace(node, sample=instants[0], until=instants[-1], parts=(part,))


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
