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
from collections.abc import Mapping, Sequence
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
from stlc.compile.ir.traverse import (
    from_now,
    leaves,
    map_children,
    numbers,
    on_clock,
    operands,
    substitute_frozen,
)
from stlc.compile.lowering.lower import lower
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
        reads: pairs (signal, offset), if the node is a predicate. The predicate reads the signal `offset`
            samples after `sample`.
        parts: the children, which explain this node; empty for a predicate.
        main: index in `parts` of the child on the main path. The robustness of this child determines that of
            the sub-formula.
        premise: whether the sub-formula is the left side of an implication.
        moves: whether the robustness of the sub-formula changes if only the value of the deciding predicate
            (`leaf`) changes. Example of False: a `freeze` stores the value of a signal at a sample, and the
            predicate inside it reads the signal at the same sample.
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
    def signals(self) -> tuple[str, ...]:
        """Names of the signals that a predicate reads."""
        return tuple(dict.fromkeys(name for name, _ in self.reads))

    @property
    def instants(self) -> set[tuple[str, int]]:
        """Pairs (signal, sample) of the values that a predicate reads."""
        return {(name, self.sample + later) for name, later in self.reads}

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


@dataclass(frozen=True, slots=True)
class _Tied:
    """Table of the predicate values on a trace, in which one value may be increased slightly.

    The increase, to the next larger float, shows whether this value alone determines the robustness.

    Attributes:
        record: the trace.
        names: predicate -> name of the column (time series) with its values.
        env: name of a column -> predicate values (samples, 1). The method `coded` adds missing columns.
        raised: (predicate, sample) of the value to increase; None increases no value.
        stop: number of samples that the complete trace would have, if the recording is shorter; else None.
        done: identity of a formula -> this formula, and the result of `coded`.
    """

    record: Record
    names: dict[ir.Formula, str]
    env: dict[str, Floats]
    raised: Spot | None = None
    stop: int | None = None
    done: dict[int, tuple[ir.Formula, ir.Formula]] = field(default_factory=dict)

    @property
    def columns(self) -> dict[str, Floats]:
        """Predicate values by column name; the value at `raised` is increased to the next larger float."""
        return self.env if self.raised is None else self._with(self.raised)

    def _with(self, spot: Spot) -> dict[str, Floats]:
        name, column = self.names[spot[0]], self.env[self.names[spot[0]]].copy()
        column[spot[1]] = np.nextafter(column[spot[1]], np.inf)
        return {**self.env, name: column}

    def coded(self, formula: ir.Formula) -> ir.Formula:
        """Return the formula with each predicate replaced by the column (time series) of its values.

        The values of a predicate without a column are computed and added to `env`.
        """
        known = self.done.get(id(formula))
        if known is not None:
            return known[1]
        for leaf in _leaves_of(formula):
            if leaf not in self.names:
                self.names[leaf] = f"#{len(self.names)}"
                values = self.record.values([leaf], range(self.record.samples), "upper", self.stop)[0]
                self.env[self.names[leaf]] = np.asarray(values, np.float64)
        over = _over_columns(formula, self.names)
        self.done[id(formula)] = formula, over  # which keeps the formula, and so its identity
        return over

    def worth(self, formula: ir.Formula, sample: int, raised: Sequence[Spot]) -> float:
        """Return the robustness of `formula` at `sample`, with one predicate value slightly increased.

        The first pair (predicate, sample) in `raised` selects this value; other pairs are ignored. The value
        is increased to the next larger float. If `raised` is empty, no value is changed.
        """
        coded = self.coded(formula)
        env = self._with(raised[0]) if raised else self.env
        record = replace(self.record, env=env)
        return float(record.values([coded], range(sample, sample + 1), "upper", self.stop)[0][0, 0])


def _leaves_of(formula: ir.Formula) -> dict[ir.Formula, None]:
    """Return the predicates of a formula, each once, as the keys of a dictionary.

    A `freeze` counts as one predicate.
    """
    if isinstance(formula, (ir.Predicate, ir.Freeze)):
        return {formula: None}
    return {leaf: None for part in operands(formula) for leaf in _leaves_of(part)}


def _over_columns(formula: ir.Formula, names: Mapping[ir.Formula, str]) -> ir.Formula:
    if isinstance(formula, (ir.Predicate, ir.Freeze)):
        return ir.Predicate(ir.Signal(names[formula]))
    return map_children(formula, formulas=lambda part: _over_columns(part, names))


@dataclass(frozen=True, slots=True)
class CauseFinder:
    """Finder of the causes of violations on one trace.

    Attributes:
        record: signals of the trace, (samples, 1), up to the end of the evaluated window.
        grid: time step and horizon of the signals.
        cache: (formula, wanted) -> the lowered formula (intervals in samples, only basic operators). It is
            negated if `wanted`, the truth value that the formula should have, is False.
        known: lowered formula -> list of pairs (range of instants, upper bounds on the robustness at them).
        tied: table of predicate values, one of them slightly increased. If given, formulas are evaluated on
            the table instead of the trace.
        stop: number of samples that the complete trace would have, if the recording is shorter; else None.
    """

    record: Record
    grid: Grid
    cache: dict[tuple[typed.Formula, bool], ir.Formula] = field(default_factory=dict)
    known: dict[ir.Formula, list[tuple[range, Floats]]] = field(default_factory=dict)
    tied: _Tied | None = None
    stop: int | None = None

    # --------------------------------------------------------------------- ties

    def why(self, formula: typed.Formula, sample: int, *, wanted: bool = True) -> tuple[CauseNode, bool]:
        """Explain why `formula` does not have the truth value `wanted` at `sample`.

        Returns:
            The tree of causes, and a flag. The flag is True if the value of the deciding predicate decides
            alone: a change of only this value changes the robustness. If several predicate values are equal
            to the robustness, the first `MOST_TIED` of them are tried. The main path then leads to a value
            that decides alone, if one is found.
        """
        tree = self.blame(formula, sample, wanted=wanted)
        lowered = self._lowered(formula, wanted)
        worth = self._margin(formula, sample, wanted)
        equal = self._equal(lowered, worth) if np.isfinite(worth) else []
        if len(equal) < 2:
            return tree, len(equal) == 1 and tree.path_moves
        tied = self._tied(lowered, equal)
        if tied is None or tied.worth(lowered, sample, ()) != worth:
            return tree, False
        leaf = tree.leaf
        own = _leaves_of(self._lowered(leaf.formula, not leaf.holds))
        first = [each for each in equal if each[1] == leaf.sample and each[0] in own]
        for chosen in (*first, *equal[:MOST_TIED]):
            if tied.worth(lowered, sample, (chosen,)) > worth:
                if chosen not in first:
                    raised = replace(self, cache={}, known={}, tied=replace(tied, raised=chosen))
                    tree = raised.blame(formula, sample, wanted=wanted)
                return tree, tree.path_moves
        return tree, False

    def _equal(self, lowered: ir.Formula, worth: float) -> list[Spot]:
        """Pairs (predicate, instant), in order of time, at which the predicate has the value `worth`.

        The argument `worth` is the robustness of the formula `lowered`. Only predicates in `lowered` are
        searched.
        """
        wanted = _leaves_of(lowered)
        found = {
            (node, its.start + int(k)): None
            for node, entries in self.known.items()
            if node in wanted
            for its, values in entries
            for k in np.flatnonzero(values == worth)
        }
        return sorted(found, key=lambda spot: spot[1])

    def _tied(self, lowered: ir.Formula, equal: Sequence[Spot]) -> _Tied | None:
        """Table of the values of all predicates in `lowered`, at all samples of the trace.

        None is returned if the table would be too large, or if a pair (predicate, instant) in `equal` lies
        after the last sample.
        """
        leaves = list(_leaves_of(lowered))
        samples = self.record.samples
        if any(instant >= samples for _, instant in equal) or samples * len(leaves) > _MOST_NUMBERS:
            return None
        values = self.record.values(leaves, range(samples), "upper", self.stop)
        names = {leaf: f"#{k}" for k, leaf in enumerate(leaves)}
        env = {name: np.asarray(x, np.float64) for name, x in zip(names.values(), values, strict=True)}
        return _Tied(self.record, names, env, stop=self.stop)

    def blame(self, formula: typed.Formula, sample: int, *, wanted: bool = True) -> CauseNode:
        """Return the tree that explains why `formula` does not have the truth value `wanted` at `sample`."""
        match formula:
            case typed.Truth() | typed.Recalled():
                return self._node(formula, wanted, sample)
            case typed.Predicate():
                return self._predicate(formula, sample, wanted)
            case typed.Not(span, body) if span == body.span and span.text:
                return self._predicate(formula, sample, wanted)  # `not in`: to a reader one predicate
            case typed.Not(_, body):
                return self.blame(body, sample, wanted=not wanted)
            case typed.Logic():
                return self._logic(formula, sample, wanted)
            case typed.Temporal() | typed.Until():
                return self._timed(formula, sample, wanted)
            case typed.Shift(_, steps, body):
                there = sample + steps
                inside = there >= 0 and (
                    there < self.record.samples or not self._unknown(body, there, wanted)
                )
                parts = (self.blame(body, there, wanted=wanted),) if inside else ()
                return replace(self._node(formula, wanted, sample), parts=parts)
            case typed.Edge():
                return self._edge(formula, sample, wanted)
            case typed.Freeze(_, _, body):
                thawed = substitute_frozen(body, self._values(formula, sample))
                inner = replace(self, cache={}, known={}, tied=None)
                tree, alone = inner.why(thawed, sample, wanted=wanted)
                return replace(tree, moves=alone and not self._frozen(formula, sample) & tree.leaf.instants)
        assert_never(formula)

    # ------------------------------------------------------------------- values

    def _frozen(self, formula: typed.Freeze, sample: int) -> set[tuple[str, int]]:
        """Pairs (signal, sample) of the values that a `freeze` formula stores at instant `sample`.

        A `freeze` stores the values of signals at one instant under names, for use inside the formula.
        """
        return {
            (leaf.name, sample + self._later(leaf, sample))
            for _, num in formula.bindings
            for leaf in leaves(num)
            if isinstance(leaf, (ir.Signal, ir.ShiftedSignal))
        }

    def _values(self, formula: typed.Freeze, sample: int) -> dict[str, ir.Num]:
        """Return the values that a `freeze` formula stores at instant `sample`: name -> constant.

        An unknown value is represented by an expression that reads a signal after the end of the trace.
        Predicates that use this value are then unknown.
        """
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

    def _lowered(self, formula: typed.Formula, wanted: bool) -> ir.Formula:
        """Return the formula with basic operators and intervals in samples, negated if `wanted` is False.

        Predicates on signals that the trace does not contain are assumed true. If samples are unknown, the
        upper bound of the formula is returned.
        """
        key = (formula, wanted)
        if key not in self.cache:
            goal = formula if wanted else typed.Not(formula.span, formula)
            given = assume_missing_true(lower(goal, self.grid, []), self.record.env)
            self.cache[key] = self.record.sides(given)[1]
        return self.cache[key]

    def _margins(self, formula: typed.Formula, wanted: bool, instants: range) -> Floats:
        """Upper bounds on the robustness of `formula`, or of its negation if `wanted` is False.

        There is one value per instant in `instants`: (instants,).
        """
        lowered = self._lowered(formula, wanted)
        if self.tied is not None:
            lowered = self.tied.coded(lowered)
        found = self._found(lowered, instants)
        if found is None:
            env = self.record.env if self.tied is None else self.tied.columns
            found_in = evaluate_parts(
                lowered, env, instants, ops=self.record.ops, end="upper", stop=self.stop
            )
            for node, its, values in found_in:
                self.known.setdefault(node, []).append((its, values[:, 0]))
            found = self._found(lowered, instants)
        assert found is not None
        return found

    def _unknown(self, formula: typed.Formula, sample: int, wanted: bool) -> bool:
        """True if the trace ends before `formula` is decided at `sample`: its upper bound is then +inf."""
        return self._margin(formula, sample, wanted) == math.inf

    def _found(self, lowered: ir.Formula, instants: range) -> Floats | None:
        """Upper bounds, (instants,), on the robustness of `lowered`, if they were computed before.

        The bounds are taken from the attribute `known`. The result is None if `known` does not contain them.
        """
        for known, values in self.known.get(lowered, ()):
            if known.start <= instants.start and instants.stop <= known.stop:
                rows = values[instants.start - known.start : instants.stop - known.start]
                return rows.astype(np.float64)
        return None

    def _node(self, formula: typed.Formula, wanted: bool, sample: int) -> CauseNode:
        margin = self._margin(formula, sample, wanted)
        return CauseNode(formula, not wanted, sample, margin if wanted else -margin)

    def _predicate(self, formula: typed.Formula, sample: int, wanted: bool) -> CauseNode:
        found = {
            (leaf.name, self._later(leaf, sample))
            for num in numbers(self._lowered(formula, wanted))
            for leaf in leaves(num)
            if isinstance(leaf, (ir.Signal, ir.ShiftedSignal)) and not leaf.name.startswith(KNOWN)
        }
        return replace(self._node(formula, wanted, sample), reads=tuple(sorted(found)))

    def _later(self, leaf: ir.Signal | ir.ShiftedSignal, sample: int) -> int:
        """Return how many samples later than `sample` a predicate reads the signal `leaf`.

        The predicate is evaluated at `sample`.
        """
        if isinstance(leaf, ir.Signal):
            return 0
        there = sample + leaf.steps
        return min(max(there, 0), self.record.samples - 1) - sample if leaf.clamped else leaf.steps

    def _least(self, parts: Sequence[tuple[typed.Formula, int, bool]]) -> tuple[typed.Formula, int, bool]:
        """Return the triple (formula, sample, wanted) in `parts` with the smallest result of `_margin`."""
        return parts[int(np.argmin([self._margin(*part) for part in parts]))]

    def _margin(self, formula: typed.Formula, sample: int, wanted: bool) -> float:
        """Upper bound on the robustness of `formula` at `sample`, or of its negation if `wanted` is False."""
        return float(self._margins(formula, wanted, range(sample, sample + 1))[0])

    # ---------------------------------------------------------------- connectives

    def _logic(self, formula: typed.Logic, sample: int, wanted: bool) -> CauseNode:
        node = self._node(formula, wanted, sample)
        match formula.op:
            case "and" | "or":
                items = [(item, sample, wanted) for item in formula.items]
                all_needed = (formula.op == "and") is wanted
            case "->":
                left, right = formula.items
                items = [(left, sample, not wanted), (right, sample, wanted)]
                all_needed = not wanted
            case "<->" | "xor":
                items, all_needed = self._least_of_both(formula, sample, wanted), False
            case _:
                assert_never(formula.op)
        if all_needed:
            part, there, its = self._least(items)
            return replace(node, parts=(self.blame(part, there, wanted=its),))
        parts = tuple(self.blame(part, there, wanted=its) for part, there, its in items)
        if formula.op == "->":
            main = int(self._margin(*items[1]) >= self._margin(*items[0]))
            return replace(node, parts=(replace(parts[0], premise=True), parts[1]), main=main)
        margins = np.array([self._margin(*item) for item in items])
        known = np.where(np.isposinf(margins), -np.inf, margins)
        return replace(node, parts=parts, main=int(np.argmax(known)))

    def _least_of_both(
        self, formula: typed.Logic, sample: int, wanted: bool
    ) -> list[tuple[typed.Formula, int, bool]]:
        """Return the two operands that explain a violated `a <-> b` or `a xor b`.

        `a <-> b` can become true in two ways: both operands are true, or both are false. `a xor b` can become
        true in two other ways: only `a` is true, or only `b`. If `wanted` is False, the ways of the other
        operator count. For each way, the operand that is farthest from the truth value it needs is returned,
        as a triple (operand, sample, needed truth value).
        """
        left, right = formula.items
        same = (formula.op == "<->") is wanted
        ways = [[(left, sample, its), (right, sample, its is same)] for its in (True, False)]
        return sorted(map(self._least, ways), key=lambda item: item[0] is right)

    def _edge(self, formula: typed.Edge, sample: int, wanted: bool) -> CauseNode:
        node = self._node(formula, wanted, sample)
        if sample == 0:
            return node
        now = formula.op == "rise"
        parts = [(formula.body, sample, now is wanted), (formula.body, sample - 1, now is not wanted)]
        if wanted:
            part, there, its = self._least(parts)
            return replace(node, parts=(self.blame(part, there, wanted=its),))
        main = int(np.argmax([self._margin(*part) for part in parts]))
        found = tuple(self.blame(part, there, wanted=its) for part, there, its in parts)
        return replace(node, parts=found, main=main)

    # ------------------------------------------------------------------- windows

    def _instants(self, formula: typed.Formula, sample: int, wanted: bool) -> range:
        """Return the instants in the window of `formula` at `sample`.

        Instants at which the operands cannot be known are left out.
        """
        lowered = self._lowered(formula, wanted)
        match lowered:
            case ir.Windowed(window=window, back=False):
                last, known = self.record.samples - 1, self._stop(lowered) - 1
                end = known if self.stop is None else min(self.stop - 1, known)
                high = (
                    (last if self.stop is None else end)
                    if window.hi is None
                    else min(sample + window.hi, known)
                )
                return range(sample + window.lo, high + 1)
            case ir.Windowed(window=window):
                low = 0 if window.hi is None else max(sample - window.hi, 0)
                return range(low, sample - window.lo + 1)
        raise TypeError(f"{type(lowered).__name__} has no window")

    def _stop(self, lowered: ir.Formula) -> int:
        """Return the first instant at which the operands of the operator `lowered` are unknown.

        Usually this is the first instant after the last sample. An operand with past operators still reads
        recorded samples at later instants. The number of samples that it reads back is then added, but at
        most `_MOST_LATER`.
        """
        return self.record.samples + min(max(map(history, operands(lowered))), _MOST_LATER)

    def _timed(self, formula: typed.Temporal | typed.Until, sample: int, wanted: bool) -> CauseNode:
        if on_clock(formula):
            return self._timed(from_now(formula), 0, wanted)
        if isinstance(formula, typed.Temporal):
            return self._temporal(formula, sample, wanted)
        return self._until(formula, sample, wanted)

    def _temporal(self, formula: typed.Temporal, sample: int, wanted: bool) -> CauseNode:
        node = self._node(formula, wanted, sample)
        instants = self._instants(formula, sample, wanted)
        if not instants:
            return node
        margins = self._margins(formula.body, wanted, instants)
        if (formula.op in ("always", "historically")) is wanted:
            worst = instants[int(np.argmin(margins))]
            return replace(node, parts=(self.blame(formula.body, worst, wanted=wanted),))
        best = instants[int(np.argmax(np.where(np.isposinf(margins), -np.inf, margins)))]
        part = self.blame(formula.body, best, wanted=wanted)
        return replace(node, sample=instants[0], until=instants[-1], parts=(part,))

    def _until(self, formula: typed.Until, sample: int, wanted: bool) -> CauseNode:
        if formula.op == "unless":
            return self._unless(formula, sample, wanted)
        node = self._node(formula, wanted, sample)
        instants = self._instants(formula, sample, wanted)
        past, beyond = formula.op == "since", self._looks_beyond(formula, sample, wanted)
        if not instants and not beyond:
            return node
        if past:
            held = range(instants[0], sample + 1)
        else:
            stop = instants[-1] + 1 if instants else self._stop(self._lowered(formula, wanted))
            held = range(sample, max(stop, sample))
        left = self._margins(formula.left, wanted, held) if held else np.zeros(0)
        right = self._margins(formula.right, wanted, instants) if instants else np.zeros(0)
        if beyond:
            left = np.append(left, self._margin(formula.left, held.stop, wanted))
            right = np.append(right, self._margin(formula.right, held.stop, wanted))
        left = left[::-1] if past else left
        right = right[::-1] if past else right
        if (formula.op == "release") is wanted:
            met, far, main = _released(left, right)
            there = (sample - far, sample - met) if past else (sample + far, sample + met)
            parts = (
                self.blame(formula.left, there[0], wanted=wanted),
                self.blame(formula.right, there[1], wanted=wanted),
            )
            return replace(node, parts=parts, main=main)
        offset, is_left = _unmet(left, right)
        there_ = sample - offset if past else sample + offset
        part = self.blame(formula.left if is_left else formula.right, there_, wanted=wanted)
        if is_left or beyond or (right >= 0).any():
            return replace(node, parts=(part,))
        return replace(node, sample=instants[0], until=instants[-1], parts=(part,))

    def _looks_beyond(self, formula: typed.Until, sample: int, wanted: bool) -> bool:
        """True if the window of `formula` at `sample` extends to instants at which operands are unknown.

        Always False for an unbounded window. The argument `wanted` is the truth value that `formula` should
        have.
        """
        lowered = self._lowered(formula, wanted)
        if not isinstance(lowered, ir.Until) or lowered.window.hi is None:
            return False
        instants = self._instants(formula, sample, wanted)
        return not instants or instants[-1] < sample + lowered.window.hi

    def _unless(self, formula: typed.Until, sample: int, wanted: bool) -> CauseNode:
        """Tree of causes of `left unless[a, b] right`, as `always[0, b] left or left until[a, b] right`."""
        whole = replace(formula.interval, lo=typed.Time(), lo_open=False)
        held = typed.Temporal(formula.span, "always", whole, formula.left)
        met = typed.Until(formula.span, "until", formula.interval, formula.left, formula.right)
        return self.blame(typed.Logic(formula.span, "or", (held, met)), sample, wanted=wanted)


def _unmet(left: Floats, right: Floats) -> tuple[int, bool]:
    """Find the value that decides a violated `until`.

    `left` and `right` are robustness values of the two operands, one per instant. `left` begins at the
    instant at which `until` is evaluated. `right` begins later, with the window of `until`. For each instant
    k of the window, take the least of two numbers: the right value at k, and the least left value up to k.
    The greatest result over all k is the robustness of `until`.

    Returns:
        The number of samples from the start of `left` to the deciding value. Then True if it is a value of
        `left`, False if it is a value of `right`.
    """
    skipped = len(left) - len(right)
    held = np.minimum.accumulate(left)[skipped:]
    best = int(np.argmax(np.minimum(held, right)))
    if held[best] < right[best]:
        return int(np.argmin(left[: skipped + best + 1])), True
    return skipped + best, False


def _released(left: Floats, right: Floats) -> tuple[int, int, int]:
    """Find the two values that decide a violated `release`.

    `left` and `right` are robustness values of the two operands, one per instant. `left` begins at the
    instant at which `release` is evaluated. `right` begins later, with the window of `release`.

    Returns:
        Three numbers. The first is the offset at which the right side fails. The second is the offset of the
        greatest left value up to this instant. The third is the side whose value is the robustness: 0 left, 1
        right. Offsets are samples from the start of `left`.
    """
    skipped = len(left) - len(right)
    freed = np.maximum.accumulate(left)[skipped:]
    worst = int(np.argmin(np.maximum(freed, right)))
    return skipped + worst, int(np.argmax(left[: skipped + worst + 1])), int(right[worst] >= freed[worst])
